"""Fits by averaged and joint spectra: of a stream, and of a recording with several segments."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from allanjax.base.errors import AllanjaxError, FitError
from allanjax.base.threads import for_each
from allanjax.estimate.axis_fits import fit_spectrum, result_of
from allanjax.estimate.design import model_to_fit
from allanjax.estimate.deterministic import AxisSpectrum, needs_record
from allanjax.estimate.result import AxisFit
from allanjax.estimate.selection import TermSelection, candidates_of, rank_terms
from allanjax.inspection import Inspection, inspect
from allanjax.noise.model import Model
from allanjax.noise.notation import ModelLike
from allanjax.noise.terms import NoiseTerm
from allanjax.record.recording import Axis, Recording
from allanjax.spectrum.cosine import Bins, SegmentSpectra, SpectralStatistics

_JOINT = "joint fit of {count} segments, {n:,} samples, by Whittle's likelihood"
_ALONE = "only the longest segment was fitted: {why}"


def check_terms(model: Model) -> None:
    """Raise FitError if a term can be estimated from the record itself only."""
    for term in model.terms:
        if needs_record(term):
            raise FitError(
                f"{term.name()} cannot be estimated from the averaged spectrum of a stream; leave it out, or "
                "read a part that fits into memory (start=, stop=) and fit that"
            )


def select_stream_terms(
    spectra: SegmentSpectra,
    axes: Sequence[Axis],
    candidates: Model | NoiseTerm | None = None,
    name: str = "",
) -> TermSelection:
    """Rank sets of noise terms by their evidence, as `select_terms` does for a recording.

    Args:
        spectra: spectral statistics of the stream.
        axes: axes of the stream, in order.
        candidates: the terms to choose from; by default the five basic ones and a Markov process.
        name: name of the stream.

    Raises:
        AllanjaxError, FitError: as `select_terms`; a deterministic candidate other than a ramp.
    """
    _check_axes(spectra, axes)
    model = candidates_of(candidates, spectra.rate)
    check_terms(model)
    return rank_terms(model, *spectra.statistics(), tuple(axes), name)


def fit_stream(
    spectra: SegmentSpectra, template: Model, axes: Sequence[Axis], active: Bool[np.ndarray, "axes terms"]
) -> tuple[AxisFit, ...]:
    """Fit every axis by Whittle's likelihood, as `fit` with `objective="whittle"` does for a recording.

    Args:
        spectra: spectral statistics of the stream.
        template: the terms; random ones that are not narrow, and a ramp.
        axes: the axes of the stream, in order.
        active: the terms in use, for each axis; for the others there is an upper limit.

    Raises:
        FitError: a term that needs the record itself; no random term; fewer than 64 samples.
    """
    _check_axes(spectra, axes)
    check_terms(template)
    return fit_statistics(*spectra.statistics(), template, axes, active)


def fit_statistics(
    bins: Bins,
    statistics: SpectralStatistics,
    template: Model,
    axes: Sequence[Axis],
    active: Bool[np.ndarray, "axes terms"],
) -> tuple[AxisFit, ...]:
    """Fit every axis to the statistics [axes, m] of a spectrum, as `fit_stream` does."""
    ramps = [k for k, term in enumerate(template.terms) if term.deterministic]

    def of(k: int) -> AxisFit:
        squares, cross, gram = (np.asarray(x[k]) for x in statistics)
        columns = (len(squares), len(ramps))
        spectrum = AxisSpectrum(
            bins,
            squares,
            np.zeros(len(squares)),
            np.broadcast_to(cross[:, None], columns),
            np.broadcast_to(gram[:, None, None], (*columns, len(ramps))),
            tuple(ramps),
            {},
        )
        found = fit_spectrum(template, axes[k], spectrum, active[k])
        return result_of(found, template, axes[k], active[k])

    return tuple(for_each(of, range(len(axes))))


def _check_axes(spectra: SegmentSpectra, axes: Sequence[Axis]) -> None:
    """Raise AllanjaxError if there are not as many axes as columns of samples."""
    if len(axes) != spectra.last.shape[1]:
        raise AllanjaxError(f"got {len(axes)} names of axes for {spectra.last.shape[1]} columns of samples")


def with_quiet_others(recording: Recording, quiet: Recording, as_is: bool) -> Recording:
    """The undisturbed parts of a recording's longest segment, with those of its other segments."""
    if not recording.others or as_is:
        return quiet
    others, parts = quiet.others[: len(recording.others)], quiet.others[len(recording.others) :]
    segments = [Recording(x, quiet.rate, quiet.axes) for x in others]
    looks = [inspect(segment, vibrating=True) for segment in segments]
    calm = [x for look, segment in zip(looks, segments, strict=True) for x in _calm(look, segment)]
    notes = quiet.notes
    if touched := sum(bool(look.parts or look.refusal) for look in looks):
        note = "parts in which the sensor was touched are left out"
        notes += (f"{touched} of {len(others) + 1} segments: {note}",)
    return dataclasses.replace(quiet, others=(*calm, *parts), notes=notes)


def _calm(look: Inspection, segment: Recording) -> list[Float[np.ndarray, "n axes"]]:
    """The parts of a segment that its inspection leaves for the estimation; there may be none."""
    quiet = segment if look.refusal else look.quiet(segment)
    return [] if look.refusal or quiet.names != segment.names else [quiet.values, *quiet.others]


def joined(
    recording: Recording, model: ModelLike | None, objective: str, regressors: Sequence[str]
) -> Recording:
    """The recording with all segments if they can be fitted jointly, else the longest; a note reports it."""
    if not recording.others:
        return recording
    why = ""
    template = Model(()) if model is None else model_to_fit(model, recording.axes, with_response=True)
    if objective not in ("allan", "whittle"):
        why = f'objective="{objective}" takes a single segment'
    elif regressors:
        why = "regressors need a single segment"
    elif template.response is not None:
        why = "a response is fitted to a single segment"
    elif lines := [term.name() for term in template.terms if needs_record(term)]:
        why = f"{lines[0]} is fitted to a single segment"
    if why:
        note = _ALONE.format(why=why)
        return dataclasses.replace(recording, others=(), notes=(*recording.notes, note))
    total = recording.n + sum(map(len, recording.others))
    note = _JOINT.format(count=len(recording.others) + 1, n=total)
    return dataclasses.replace(recording, notes=(*recording.notes, note))
