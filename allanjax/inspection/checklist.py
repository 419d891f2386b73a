"""Checks of a recording, one line each: whether it is fine, worth a look, or of no use as it is.

What an inspection finds is told here line by line, with what else can be read off the samples.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float

from allanjax.base.earth import STANDARD_GRAVITY as _G
from allanjax.base.wording import duration, plain
from allanjax.inspection.first_look import Inspection
from allanjax.inspection.levels import is_piled_up, lattice
from allanjax.inspection.words import amount
from allanjax.record.io.timestamps import told_jitter
from allanjax.record.recording import Recording
from allanjax.record.units import rate_unit_of

#: Verdicts, from good to bad.
Verdict = Literal["fine", "look", "stop"]

# Jitter, as a share of the interval, up to which samples are as good as even; readers refuse a fifth.
_JITTER = 0.05
# Least noise in steps of the output beside which rounding is little: a twelfth of its power.
_COUNTS = 1.0
# Stretches whose means are compared with the temperature's, and fewest that tell anything.
_STRETCHES, _FEWEST = 64, 12
# Chance of an axis that seems to follow a temperature that it does not feel.
_CHANCE = 0.01


@dataclasses.dataclass(frozen=True)
class Line:
    """One check: what was looked at, the verdict, and the reason in words with numbers and units."""

    name: str
    verdict: Verdict
    reason: str


def lines_of(recording: Recording, seen: Inspection) -> Iterator[Line]:
    """Checks of a recording that need no fit, given its inspection."""
    yield from _times(recording, seen)
    yield _told("repeated samples", "look", seen.about("repeats"), "no more than rounding makes")
    steps = [lattice(column) for column in recording.recorded]
    yield _resolution(recording, seen, steps)
    yield _saturation(recording, steps)
    dead = [f"{dead.axis.name}: {dead.reason}" for dead in recording.dead]
    yield _told("dead axes", "stop", dead, "every axis changes")
    yield _told("at rest", "stop", seen.about("motion"), "no axis moves more than a sensor at rest")
    undisturbed = "; ".join(seen.notes) or "no stretch is unlike the rest"
    yield _told("disturbances", "stop" if seen.refusal else "look", seen.about("events"), undisturbed)
    sensors = {axis.sensor for axis in recording.axes}
    if "accel" in sensors:
        yield _gravity(seen)
    if "gyro" in sensors:
        gyros = [k for k, axis in enumerate(seen.axes) if axis.sensor == "gyro"]
        k = max(gyros, key=lambda k: abs(seen.mean[k]))
        bias = f"a bias of up to {amount(abs(seen.mean[k]), seen.axes[k])} ({seen.axes[k].name})"
        yield _told("gyro unit", "stop", seen.about("gyro"), f"{bias} and the noise are those of a gyro")
    yield _temperature(recording)
    length = f"{recording.n:,} samples, {duration(recording.duration)}"
    yield _told("length", "look", seen.about("length"), length)


def _told(name: str, verdict: Verdict, sentences: Sequence[str], otherwise: str) -> Line:
    """Line with these sentences, or that all is fine if there are none."""
    return Line(name, verdict, "; ".join(sentences)) if sentences else Line(name, "fine", otherwise)


def _times(recording: Recording, seen: Inspection) -> Iterator[Line]:
    """Sample rate, jitter and gaps."""
    jitter, rate = recording.jitter, f"{recording.rate:.6g} Hz"
    if wrong := seen.about("rate"):
        yield Line("rate", "stop", "; ".join(wrong))
    elif jitter is None:
        yield Line("rate", "look", f"{rate} as given: without time stamps it cannot be checked")
    else:
        stated = [note for note in recording.notes if note.startswith("sample rate")]
        yield Line("rate", "fine", "; ".join(stated) or rate)
    lost = "; ".join(note for note in recording.notes if " are missing, in " in note)
    if jitter is None:
        unseen = "cannot be seen without time stamps"
        yield Line("jitter", "look", unseen)
        yield Line("gaps", "look", lost or unseen)
        return
    share = f"{told_jitter(jitter)}, {plain(100.0 * max(jitter, 1e-9) * recording.rate, 2)} % of the interval"
    if jitter * recording.rate > _JITTER:
        said = "samples are taken as evenly spaced; if the stamps are right, read those of the sensor's clock"
        yield Line("jitter", "look", f"{share}: {said}")
    else:
        yield Line("jitter", "fine", share)
    yield Line("gaps", "look" if lost else "fine", lost or "none among the time stamps")


def _resolution(recording: Recording, seen: Inspection, steps: Sequence[float | None]) -> Line:
    """Noise of the axes in steps of their output."""
    if below := seen.about("resolution"):
        return Line("resolution", "stop", "; ".join(below))
    rms = np.diff(recording.values, axis=0).std(axis=0) / np.sqrt(2.0)
    counts = [(float(r / q), k) for k, (r, q) in enumerate(zip(rms, steps, strict=True)) if q is not None]
    if not counts:
        return Line("resolution", "fine", "no step is seen in the samples")
    least, k = min(counts)
    unit, scale = rate_unit_of(recording.axes[k].unit, recording.axes[k].sensor)
    step = f"{plain((steps[k] or 0.0) / scale, 3)} {unit}"
    name = recording.axes[k].name
    said = f"the noise from sample to sample is {plain(least, 2)} counts of {step} ({name}) or more"
    if least < _COUNTS:
        return Line("resolution", "look", f"{said}: rounding is part of what looks like noise")
    return Line("resolution", "fine", said)


def _saturation(recording: Recording, steps: Sequence[float | None]) -> Line:
    """Axes with more samples at their largest or smallest value than a tail would leave there."""
    clipped = []
    for axis, column, q in zip(recording.axes, recording.recorded, steps, strict=True):
        for level, side in ((column.max(), 1.0), (column.min(), -1.0)):
            if is_piled_up(side * column, q):
                share = plain(100.0 * float(np.mean(column == level)), 2)
                unit, scale = rate_unit_of(axis.unit, axis.sensor)
                clipped.append(
                    f"{axis.name} is at {plain(level / scale, 4)} {unit} in {share} % of the samples"
                )
    said = "; ".join(clipped)
    if clipped:
        return Line(
            "saturation", "stop", f"{said}: its range ends there; use a wider one, or remove the offset"
        )
    return Line("saturation", "fine", "samples do not pile up at the ends of their range")


def _gravity(seen: Inspection) -> Line:
    """Size of gravity in the accelerometers, by which their unit shows."""
    name = "accel unit"
    if wrong := seen.about("accel"):
        return Line(name, "stop", "; ".join(wrong))
    accel = [k for k, axis in enumerate(seen.axes) if axis.sensor == "accel"]
    size = float(np.linalg.norm(seen.mean[accel]))
    unit, scale = rate_unit_of(seen.axes[accel[0]].unit, "accel")
    off = f"{plain(size / scale, 4)} {unit}, {plain(100.0 * abs(size / _G - 1.0), 2)} % off gravity"
    if abs(size / _G - 1.0) < 0.2:
        return Line(name, "fine", f"the mean is {off}")
    if len(accel) < 3:
        return Line(
            name,
            "look",
            f"the mean is {amount(size, seen.axes[accel[0]])}: without all three axes, "
            "gravity does not tell the unit",
        )
    why = "the sensor moved" if seen.moving else "was gravity taken out, or simulated without?"
    return Line(name, "look", f"the mean is {off}: {why}")


def _temperature(recording: Recording) -> Line:
    """Whether an axis follows a channel of temperature."""
    name = "temperature"
    channels = {key: z for key, z in recording.auxiliary.items() if "temp" in key.lower()}
    if not channels:
        return Line(name, "look", "no such column: what drifts with it counts as B, K and a ramp")
    missing = [key for key, z in channels.items() if not np.isfinite(z).all()]
    if missing:
        where = ", ".join(missing)
        return Line(name, "look", f"values of {where} are missing: whether an axis follows cannot be said")
    ranges = {key: plain(float(np.ptp(z)), 3) for key, z in channels.items()}
    said = [f"{key} varies by {size} in its column's unit" for key, size in ranges.items()]
    follows = [text for key, z in channels.items() for text in _following(recording, key, z)]
    if not follows:
        return Line(name, "fine", f"{'; '.join(said)}, and no axis follows it")
    remedy = f"fit with --objective whittle --regressors {','.join(channels)}"
    return Line(name, "look", f"{'; '.join((*said, *follows))}: {remedy}")


def _following(recording: Recording, key: str, z: Float[np.ndarray, " n"]) -> Iterator[str]:
    """Axes whose mean changes in proportion to a channel's, from one stretch of the record to the next.

    Changes of a random walk are independent of each other, and those of white noise and flicker add up to
    less: so the t test of a proportion between changes is right for the one and cautious for the others. One
    between the means themselves would find a slope between any two walks.
    """
    size = recording.n // _STRETCHES or 1
    whole = recording.n // size * size
    if whole // size < _FEWEST:
        return
    from scipy.special import stdtr

    dz = np.diff(z[:whole].reshape(-1, size).mean(axis=1))
    if not dz.any():
        return
    for axis, column in zip(recording.axes, recording.values.T, strict=True):
        dx = np.diff(column[:whole].reshape(-1, size).mean(axis=1))
        slope = float(dz @ dx / (dz @ dz))
        dof = len(dz) - 1
        t = slope / np.sqrt(np.sum((dx - slope * dz) ** 2) / dof / (dz @ dz))
        if 2.0 * stdtr(dof, -abs(t)) < _CHANCE / len(recording.axes):
            drift = amount(abs(slope) * float(np.ptp(z)), axis)
            yield f"{axis.name} follows {key}, by {drift} over its range"


def worst(lines: Sequence[Line]) -> Verdict:
    """The worst verdict of these lines."""
    order: Mapping[str, int] = {"fine": 0, "look": 1, "stop": 2}
    return max((line.verdict for line in lines), key=order.__getitem__, default="fine")
