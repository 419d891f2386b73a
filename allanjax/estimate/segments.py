"""Joint fits of the segments of a recording with gaps: which parts of them can be fitted jointly."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from allanjax.estimate.design import model_to_fit
from allanjax.estimate.deterministic import needs_record
from allanjax.inspection import Inspection, inspect
from allanjax.noise.model import Model
from allanjax.noise.notation import ModelLike
from allanjax.record.recording import Recording


def with_quiet_others(recording: Recording, quiet: Recording, as_is: bool) -> Recording:
    """Undisturbed parts of all segments of a recording, of which `quiet` has those of the longest."""
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
        note = f"only the longest segment was fitted: {why}"
        return dataclasses.replace(recording, others=(), notes=(*recording.notes, note))
    total = recording.n + sum(map(len, recording.others))
    count = len(recording.others) + 1
    note = f"joint fit of {count} segments, {total:,} samples, by Whittle's likelihood"
    return dataclasses.replace(recording, notes=(*recording.notes, note))
