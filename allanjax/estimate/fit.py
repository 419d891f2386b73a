"""Fits of a noise model to a recording: Allan or wavelet variances, Whittle's or the exact likelihood."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Literal, get_args

import numpy as np
from jaxtyping import Bool, Float

from allanjax.allan.deviation import AllanDeviation, allan_deviation
from allanjax.base.cache import release_programs
from allanjax.base.errors import AllanjaxError, FitError
from allanjax.estimate.axis_fits import check_count, fit_allan, fit_wavelet, fit_whittle, judged, with_curve
from allanjax.estimate.design import model_to_fit
from allanjax.estimate.exact import check_exact, fit_exact
from allanjax.estimate.extension.search import Extension, extended
from allanjax.estimate.ranking import ranked
from allanjax.estimate.result import AxisFit, Fit
from allanjax.estimate.selection import AxisSelection, TermSelection
from allanjax.estimate.stretch_fits import fit_stretches, joined, with_quiet_others
from allanjax.inspection import Inspection, inspect
from allanjax.noise.model import Model
from allanjax.noise.notation import ModelLike
from allanjax.noise.terms import Markov, Telegraph, basic_terms
from allanjax.noise.terms.transient import Transient
from allanjax.record.completion import widening
from allanjax.record.io.given import RecordingLike, as_recording
from allanjax.record.io.options import GapChoice
from allanjax.record.recording import Axis, DeadAxis, Recording

# Denser cluster times than octaves gain some 5 % in the middle of the curve; beyond four an octave, nothing.
_PER_OCTAVE = 4

Objective = Literal["allan", "whittle", "wavelet", "exact"]


def fit(
    recording: RecordingLike,
    model: ModelLike | None = None,
    objective: Objective = "allan",
    *,
    wavelet: str = "haar",
    regressors: Sequence[str] = (),
    as_is: bool = False,
    vibrating: bool = False,
    plain: bool = False,
    rate: float | None = None,
    gyro_unit: str | None = None,
    accel_unit: str | None = None,
    names: Sequence[str] | None = None,
    gaps: GapChoice | None = None,
) -> Fit:
    """Estimate the coefficients of a noise model from every axis of a recording.

    First the recording is looked at (see `inspect`): where it was handled it is left out, on all axes, as the
    fit's `warnings` and `stretch` say; if too little is left there is no result. A model with a step, a
    warm-up or a telegraph, and regressors, say that the mean may move: that is no handling then.

    `objective="allan"`: the overlapping Allan variances at four cluster times an octave are fitted by
    generalized least squares, weighted with their full covariance at the fitted model itself (see `gls`).
    `objective="whittle"`: maximum likelihood of the cosine spectrum (see `cosine`), which uses all that
    the record knows of its spectrum: more efficient where terms are alike in the Allan curve, and for
    lines by far. Ramps, lines and regressors are profiled out exactly.
    `objective="wavelet"`: the wavelet variances (see `wavelet_variance`) of all levels are fitted as the
    Allan variances are. With "haar" these are half the Allan variances at octaves.
    `objective="exact"`: maximum of the Gaussian likelihood of the samples themselves, by a Kalman filter: for
    a given model of noise terms and short records, up to 100,000 samples, in which the few lowest frequencies
    matter; missing samples are left out, not drawn. Where the model does not follow the data, an axis has
    Whittle's result.

    Of a recording in stretches between gaps (`gaps="segments"`) coefficients are of all of them together, by
    Whittle's likelihood, each less its own mean; `objective` is "whittle" then. Filters, resonances and lines
    are searched for in the longest alone, and what needs one record is fitted to it; a note says so.

    Args:
        recording: what `read` returns; or samples [samples, axes], a data frame, or a file's path.
        model: the terms, added up with `+`, or written as on the command line, `"N + B + K"`; parameters
            with a value start there, those held stay there. The time of a step and the time constant of a
            warm-up must have a value and are held; such terms need "whittle".
            Without one, the terms are those that `select_terms` chooses for each axis among the five basic
            ones and a Markov process; for the basic terms not chosen there is an upper limit. Where no set
            of terms follows the data, the spectrum is searched for a filter, resonances, lines and further
            Markov processes, and what is found is fitted jointly (`AxisFit.own_template`, `plain`).
        objective: "allan", "whittle", "wavelet" or "exact".
        wavelet: an orthogonal wavelet by its name in PyWavelets, for "wavelet"; all but "haar" leave ramps
            and lines undetermined.
        regressors: names of auxiliary channels (temperature, say) whose multiples may be part of the rate;
            with "whittle" only.
        as_is: whether to use all of the recording whatever it looks like; the warnings stay.
        vibrating: whether the platform moves or vibrates, and is to: motion is no reason for a warning then.
        plain: whether to leave it at the terms where they do not suffice.
        rate, gyro_unit, accel_unit, names: of an array, as `Recording.from_array` takes them; a data frame
            and a file may state their own.
        gaps: what to do about missing samples, as in `read`; of an array those that are nan.

    Returns:
        The fit. Axes that did not converge say so, and raise FitError when asked for coefficients.

    Raises:
        FitError: if the record is too short for the model; a step or warm-up without a time, or with "allan";
            with "exact" a record that is too long, no model, or one with lines or ramps.
        AllanjaxError: an unknown objective; a regressor that is no auxiliary channel, or is constant.
    """
    if model in get_args(Objective):
        raise AllanjaxError(f'{model!r} is an objective, not a model: give objective="{model}"')
    recording = as_recording(recording, rate, gyro_unit, accel_unit, names, gaps)
    seen = inspected(recording, model, regressors, as_is, vibrating)
    return fit_inspected(recording, seen, model, objective, regressors, plain, wavelet, as_is)


def fit_inspected(
    recording: Recording,
    seen: Inspection,
    model: ModelLike | None,
    objective: Objective,
    regressors: Sequence[str] = (),
    plain: bool = False,
    wavelet: str = "haar",
    as_is: bool = False,
) -> Fit:
    """Fit of a recording whose inspection is known already; see `fit`."""
    if objective not in get_args(Objective):
        told = ", ".join(f'"{name}"' for name in get_args(Objective))
        raise AllanjaxError(f"the objective must be one of {told}, not {objective!r}")
    # What is wrong with them is said before anything is computed.
    _regressors(recording, regressors, objective)
    if not seen.refusal:
        quiet = seen.quiet(recording)
        # As if it were complete, but for the exact likelihood; what that claims too much is made good after.
        exact = objective == "exact"
        whole = quiet if exact else dataclasses.replace(quiet, missing=None)
        whole = joined(with_quiet_others(recording, whole, as_is), model, objective, regressors)
        found = _fitted(whole, model, objective, regressors, plain, wavelet)
        if quiet.missing is not None and not exact:
            found = _with_missing(found, widening(quiet.missing))
        return with_what_was_seen(found, seen)
    template, _ = terms_to_fit(model, None, recording.axes, objective)
    curve = allan_deviation(recording, cluster_times=_PER_OCTAVE)
    return without_coefficients(seen, curve, template, objective, recording.notes, recording.dead)


def inspected(
    recording: Recording,
    model: ModelLike | None,
    regressors: Sequence[str],
    as_is: bool,
    vibrating: bool,
) -> Inspection:
    """Inspection of a recording for a fit of this model, which may say that the mean moves."""
    terms = () if model is None else model_to_fit(model, recording.axes, with_response=True).terms
    timed = any(isinstance(term, Transient) for term in terms)
    may_move = timed or bool(regressors) or any(isinstance(term, Telegraph) for term in terms)
    # The time of a step counts from the first sample.
    return inspect(recording, as_is=as_is or timed, vibrating=vibrating, may_move=may_move)


def _fitted(
    recording: Recording,
    model: ModelLike | None,
    objective: Objective,
    regressors: Sequence[str],
    plain: bool,
    wavelet: str,
) -> Fit:
    """Fit of all samples of a recording."""
    given = _regressors(recording, regressors, objective)
    notes: tuple[str, ...] = ()
    if objective == "exact":
        check_exact(None if model is None else model_to_fit(model, recording.axes, True), recording)
    release_programs(0.75)
    selection = ranked(recording) if model is None else None
    template, active = terms_to_fit(model, selection, recording.axes, objective)
    octaves = objective == "wavelet" and wavelet == "haar"
    curve = allan_deviation(recording, cluster_times="octave" if octaves else _PER_OCTAVE)
    check_length(curve, template, recording.name)
    if recording.others:
        results, objective = fit_stretches(recording, template, active), "whittle"
        results, curve = with_curve(curve, template, results)
    elif objective == "allan" or octaves:
        # Wavelet variances of Haar are half the Allan variances at octaves.
        results, curve = fit_allan(curve, recording.axes, template, active, recording.values)
        results = tuple(judged(recording, k, template, active[k], r) for k, r in enumerate(results))
        if any(result.spectrum is not None for result in results):
            results, curve = with_curve(curve, template, results)
    elif objective == "wavelet":
        unused = [label for label, used in zip(template.term_labels, active.T, strict=True) if not used.any()]
        template, active = template.without(unused), active[:, active.any(axis=0)]
        results = fit_wavelet(recording, template, active, wavelet)
        results = tuple(judged(recording, k, template, active[k], r) for k, r in enumerate(results))
        results, curve = with_curve(curve, template, results)
    elif objective == "exact":
        results, notes = _exact(recording, template, active)
        results, curve = with_curve(curve, template, results)
    else:
        axes = range(len(recording.axes))
        results = tuple(fit_whittle(recording, k, template, active[k], given) for k in axes)
        results, curve = with_curve(curve, template, results)
    # Regressors are part of a model that is given, or of the plain terms.
    if selection is not None and not (plain or given):
        results, selection = _extended(recording, results, curve, selection)
    if selection is not None:
        results = tuple(with_doubts(result, selection[result.axis.name]) for result in results)
    notes = (*recording.notes, *notes, *ambiguities(selection))
    return Fit(recording.name, template, curve, results, notes, objective, selection, recording.dead)


def _exact(
    recording: Recording, template: Model, active: Bool[np.ndarray, "axes terms"]
) -> tuple[tuple[AxisFit, ...], tuple[str, ...]]:
    """Results by the exact likelihood, and a note on axes that have Whittle's, widened where samples miss."""
    found = [fit_exact(recording, k, template, active[k]) for k in range(len(recording.axes))]
    by = np.ones(len(found)) if recording.missing is None else widening(recording.missing)
    results = tuple(
        result if exact else result.widened(float(factor))
        for (result, exact), factor in zip(found, by, strict=True)
    )
    names = [result.axis.name for result, exact in found if not exact]
    note = f"{', '.join(names)}: by Whittle's likelihood, as the model does not follow the data"
    return results, (note,) if names else ()


def _extended(
    recording: Recording, results: Sequence[AxisFit], curve: AllanDeviation, selection: TermSelection
) -> tuple[tuple[AxisFit, ...], TermSelection]:
    """Results and selection in which axes that no set of terms follows have their extension."""

    def of(k: int) -> Extension | None:
        incomplete = not results[k].converged or results[k].discrepancy > 0.0
        return extended(recording.values[:, k], recording.rate, results[k], curve, k) if incomplete else None

    with ThreadPoolExecutor() as pool:
        found = list(pool.map(of, range(len(results))))
    rankings = [s if e is None else e.selection for s, e in zip(selection.results, found, strict=True)]
    fits = (r if e is None else e.result for r, e in zip(results, found, strict=True))
    return tuple(fits), dataclasses.replace(selection, results=tuple(rankings))


def _with_missing(found: Fit, factors: Float[np.ndarray, " axes"]) -> Fit:
    """Fit of a record of which samples are missing: wider intervals, fewer degrees of freedom."""
    results = zip(found.results, factors, strict=True)
    curve = dataclasses.replace(found.curve, edf=found.curve.edf / factors**2)
    return dataclasses.replace(
        found, curve=curve, results=tuple(result.widened(float(by)) for result, by in results)
    )


def without_coefficients(
    seen: Inspection,
    curve: AllanDeviation,
    template: Model,
    objective: Objective,
    notes: tuple[str, ...],
    dead: tuple[DeadAxis, ...],
) -> Fit:
    """A fit without coefficients: the curve of a recording, and why it has none."""
    nothing = np.zeros((0, 0))
    results = tuple(
        AxisFit(axis, False, seen.refusal, np.nan, 0, np.nan, np.nan, {}, nothing, template)
        for axis in seen.axes
    )
    return with_what_was_seen(Fit(seen.name, template, curve, results, notes, objective, None, dead), seen)


def with_what_was_seen(found: Fit, seen: Inspection) -> Fit:
    """A fit completed by its inspection: facts, parts, levels, and what these facts mean for each axis."""
    rate, results = found.curve.rate, []
    for r in found.results:
        k = [axis.name for axis in seen.axes].index(r.axis.name)
        r = dataclasses.replace(r, mean=float(seen.mean[k]), rms=float(seen.rms[k]))
        # Rounding adds a twelfth of the square of a step to each sample's variance.
        r = r.allowing(float(seen.allowance[k]), float(seen.steps[k]) / np.sqrt(12.0 * rate))
        kinds = seen.why_not(r.axis.name)
        results.append(r.unmeasured(not_measured=kinds) if r.converged and kinds else r)
    return dataclasses.replace(
        found, results=tuple(results), facts=seen.facts, parts=seen.parts, notes=found.notes + seen.notes
    )


def terms_to_fit(
    model: ModelLike | None,
    selection: TermSelection | None,
    axes: Sequence[Axis],
    objective: Objective,
) -> tuple[Model, Bool[np.ndarray, "axes terms"]]:
    """Model to fit, given or chosen, and which of its terms each axis has.

    Raises:
        FitError: a step or a warm-up without a time, or with "allan"; the same term twice.
    """
    if selection is None:
        spectral = objective != "allan"
        template = basic_terms() if model is None else model_to_fit(model, axes, with_response=spectral)
        template = _with_known_transients(template, objective)
        _check_distinct(template)
        return template, np.ones((len(axes), len(template)), bool)
    sets = [axis.chosen.terms for axis in selection.results]
    # A Markov process is part of the template where it is needed only: it costs time.
    template = basic_terms() + Markov() if any("markov" in s for s in sets) else basic_terms()
    return template, np.array([[label in s for label in template.term_labels] for s in sets])


def check_length(curve: AllanDeviation, template: Model, name: str) -> None:
    """Raise FitError if there are no more Allan variances than parameters."""
    check_count(len(curve.cluster_size), "Allan variances", curve.n, template, name)


def _check_distinct(template: Model) -> None:
    """Raise FitError for two terms that differ in nothing but their amplitudes, which are to be found."""
    seen = set()
    for k, term in enumerate(template.terms):
        shape = [getattr(term, p.name) for p in term.parameters() if not term.is_free(p)]
        if len(term.parameters()) == len(shape) + 1:
            if (key := (type(term), *shape, template.inside[k : k + 1])) in seen:
                raise FitError(f"no data tell {term.name()} from {term.name()}: leave one of them out")
            seen.add(key)


def _with_known_transients(template: Model, objective: Objective) -> Model:
    """The model with the shapes of its steps and warm-ups held: a record is not searched for them."""
    terms = list(template.terms)
    for k, term in enumerate(template.terms):
        if not isinstance(term, Transient):
            continue
        if objective != "whittle":
            raise FitError(f'{term.name()} has no Allan variance of its own: give objective="whittle"')
        shapes = [p.name for p in term.parameters()[1:]]
        for shape in shapes:
            if getattr(term, shape) is None:
                raise FitError(
                    f"a fit does not search for the {shape} of a {term.name()}: give it, e.g. "
                    f'{type(term).__name__}({shape}=120.0).hold("{shape}"); the critique finds it'
                )
        terms[k] = term.hold(*shapes)
    return dataclasses.replace(template, terms=tuple(terms))


def _regressors(
    recording: Recording, names: Sequence[str], objective: Objective
) -> dict[str, Float[np.ndarray, " n"]]:
    """Auxiliary channels of these names, their means subtracted."""
    if names and objective != "whittle":
        raise AllanjaxError(
            'regressors are profiled out of the spectrum only: give objective="whittle" (--objective whittle)'
        )
    channels = {}
    for name in names:
        if name not in recording.auxiliary:
            there = ", ".join(recording.auxiliary) or "none"
            raise AllanjaxError(
                f"{recording.name or 'the recording'} has no auxiliary channel {name!r}; it has {there}"
            )
        channel = np.asarray(recording.auxiliary[name], float)
        channels[name] = channel - channel.mean()
        if not np.isfinite(channel).all() or not channels[name].any():
            raise AllanjaxError(
                f"auxiliary channel {name!r} is constant or not finite: nothing to regress on"
            )
    return channels


def with_doubts(result: AxisFit, ranking: AxisSelection) -> AxisFit:
    """Result that allows for the choice of terms.

    Where other sets are nearly as probable, intervals of amplitudes cover those averaged over all sets. Terms
    are detected only where the sets with them have nearly all the probability.
    """
    if not result.converged:
        return result
    doubtful, found = ranking.doubtful(), dict(result.coefficients)
    averaged = ranking.averaged.coefficients if ranking.averaged and result.own_template is None else {}
    for label, c in found.items():
        if label in averaged and c.detected and c.std > 0.0:
            found[label] = c = c.covering(averaged[label])
        if c.term in doubtful and c.detected:
            rivals = doubtful[c.term] if c.is_amplitude else ()
            found[label] = dataclasses.replace(c, detected=False, rivals=rivals)
    return result.with_estimates(found)


def ambiguities(selection: TermSelection | None) -> tuple[str, ...]:
    """Notes on terms that the data could not tell apart."""
    notes = []
    for axis in selection.values() if selection else ():
        if found := axis.ambiguities():
            notes.append(f"{axis.axis.name}: the data do not tell {'; '.join(found[:3])}")
    return tuple(notes)
