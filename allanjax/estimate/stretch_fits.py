"""Fits of recordings in several stretches, between which samples are missing, by their joint likelihood."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

from allanjax.estimate.design import model_to_fit
from allanjax.estimate.deterministic import needs_record
from allanjax.estimate.result import AxisFit
from allanjax.estimate.stream_fits import fit_statistics
from allanjax.inspection import inspect
from allanjax.noise.model import Model
from allanjax.noise.notation import ModelLike
from allanjax.record.recording import Recording
from allanjax.spectrum.cosine import joint_statistics

_JOINT = "coefficients by Whittle's likelihood of {count} stretches together, {n} samples"
_ALONE = "coefficients of the longest stretch alone: {why}"


def with_quiet_others(recording: Recording, quiet: Recording, as_is: bool) -> Recording:
    """The quiet parts of a recording's longest stretch, with other stretches in which nothing happened."""
    if not recording.others:
        return quiet
    others, parts = quiet.others[: len(recording.others)], quiet.others[len(recording.others) :]
    calm = [x for x in others if as_is or _calm(Recording(x, quiet.rate, quiet.axes))]
    notes = quiet.notes
    if touched := len(others) - len(calm):
        notes += (f"{touched} of {len(others) + 1} stretches not used, in which the sensor was touched",)
    return dataclasses.replace(quiet, others=(*calm, *parts), notes=notes)


def _calm(stretch: Recording) -> bool:
    """Whether nothing happened to the sensor in a stretch that would change its coefficients."""
    seen = inspect(stretch, vibrating=True)
    return seen.stretch is None and not seen.refusal


def joined(
    recording: Recording, model: ModelLike | None, objective: str, regressors: Sequence[str]
) -> Recording:
    """The recording with all its stretches if they can be fitted together, else the longest; a note tells."""
    if not recording.others:
        return recording
    why = ""
    template = Model(()) if model is None else model_to_fit(model, recording.axes, with_response=True)
    if objective not in ("allan", "whittle"):
        why = f'objective="{objective}" has one stretch'
    elif regressors:
        why = "regressors are of one stretch"
    elif template.response is not None:
        why = "responses are fitted to one stretch"
    elif lines := [term.name() for term in template.terms if needs_record(term)]:
        why = f"{lines[0]} is found in one stretch only"
    if why:
        note = _ALONE.format(why=why)
        return dataclasses.replace(recording, others=(), notes=(*recording.notes, note))
    total = recording.n + sum(map(len, recording.others))
    note = _JOINT.format(count=len(recording.others) + 1, n=total)
    return dataclasses.replace(recording, notes=(*recording.notes, note))


def fit_stretches(
    recording: Recording, template: Model, active: Bool[np.ndarray, "axes terms"]
) -> tuple[AxisFit, ...]:
    """Fit every axis to the spectra of all stretches, which are taken to be independent."""
    joint = joint_statistics((recording.values, *recording.others), recording.rate)
    return fit_statistics(*joint, template, recording.axes, active)
