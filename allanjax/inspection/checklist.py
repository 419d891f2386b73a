"""Checks of a recording, one line each: whether it is fine, worth a look, or of no use as it is.

Facts of an inspection are told here line by line; where there is none of a kind, what was looked at is fine.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Literal

import numpy as np

from allanjax.base.earth import STANDARD_GRAVITY as _G
from allanjax.base.wording import duration, plain
from allanjax.inspection.facts import amount
from allanjax.inspection.first_look import Inspection
from allanjax.inspection.plausible import accelerometers, jitter_in_words, temperatures
from allanjax.record.recording import Recording
from allanjax.record.units import rate_unit_of

#: Verdicts, from good to bad.
Verdict = Literal["fine", "look", "stop"]

# Sample rate over bandwidth: from three to five, after Hou (2004) section 5.3, figure 5.10.
_LEAST_RATIO, _MOST_RATIO = 3.0, 5.0


@dataclasses.dataclass(frozen=True)
class Line:
    """One check: what was looked at, the verdict, and the reason in words with numbers and units."""

    name: str
    verdict: Verdict
    reason: str


def lines_of(recording: Recording, seen: Inspection, widths: Mapping[str, float | None]) -> Iterator[Line]:
    """Checks of a recording, given its inspection and the bandwidth of each axis by `bandwidth_in`."""

    def line(name: str, otherwise: str, verdict: Verdict = "fine") -> Line:
        facts = [fact for fact in seen.facts if fact.kind == name]
        if not facts:
            return Line(name, verdict, otherwise)
        grave = any(fact.grave for fact in facts)
        return Line(name, "stop" if grave else "look", "; ".join(fact.text for fact in facts))

    timed, rate = recording.jitter is not None, f"{recording.rate:.6g} Hz"
    unseen = "cannot be seen without time stamps"
    stated = "; ".join(note for note in recording.notes if note.startswith("sample rate")) or rate
    untimed = f"{rate} as given: without time stamps it cannot be checked"
    yield line("rate", stated) if timed else line("rate", untimed, "look")
    yield line("jitter", jitter_in_words(recording)) if timed else line("jitter", unseen, "look")
    none = "none among the time stamps"
    yield line("gaps", unseen, "look") if recording.gaps is None else line("gaps", none)
    yield line("repeated samples", "no more than rounding makes")
    yield line("interpolation", "no sensor's samples are interpolated")
    yield line("resolution", _resolution(recording, seen))
    yield line("saturation", "samples do not pile up at the ends of their range")
    yield line("dead axes", "every axis changes")
    yield line("at rest", "no axis moves more than a sensor at rest")
    yield line("disturbances", "; ".join(seen.notes) or "no stretch is unlike the rest")
    yield line("spikes", "no sample is far from both of its neighbours")
    yield line("lines", "no line is seen in the spectrum")
    sensors = {axis.sensor for axis in recording.axes}
    if "accel" in sensors:
        yield line("accel unit", *_gravity(seen))
    if "gyro" in sensors:
        gyros = [k for k, axis in enumerate(seen.axes) if axis.sensor == "gyro"]
        k = max(gyros, key=lambda k: abs(seen.mean[k]))
        bias = f"a bias of up to {amount(abs(seen.mean[k]), seen.axes[k])} ({seen.axes[k].name})"
        yield line("gyro unit", f"{bias} and the noise are those of a gyro")
    yield line("temperature", *_temperature(recording))
    yield line("length", f"{recording.n:,} samples, {duration(recording.duration)}")
    yield _bandwidth(recording.rate, widths)


def _resolution(recording: Recording, seen: Inspection) -> str:
    """Noise of the axes in steps of their output, in words."""
    rms = np.diff(recording.values, axis=0).std(axis=0) / np.sqrt(2.0)
    counts = [(float(r / q), k) for k, (r, q) in enumerate(zip(rms, seen.steps, strict=True)) if q > 0.0]
    if not counts:
        return "no step is seen in the samples"
    least, k = min(counts)
    step = f"{amount(seen.steps[k], recording.axes[k], 3)} ({recording.axes[k].name})"
    return f"the noise from sample to sample is {plain(least, 2)} counts of {step} or more"


def _gravity(seen: Inspection) -> tuple[str, Verdict]:
    """Size of gravity in the accelerometers, by which their unit shows."""
    accel = max(accelerometers(seen.axes), key=len)
    size = float(np.linalg.norm(seen.mean[accel]))
    unit, scale = rate_unit_of(seen.axes[accel[0]].unit, "accel")
    off = f"{plain(size / scale, 4)} {unit}, {plain(100.0 * abs(size / _G - 1.0), 2)} % off gravity"
    if abs(size / _G - 1.0) < 0.2:
        return f"the mean is {off}", "fine"
    if len(accel) < 3:
        alone = "without all three axes, gravity does not show the unit"
        return f"the mean is {amount(size, seen.axes[accel[0]])}: {alone}", "look"
    why = "the sensor moved" if seen.moving else "was gravity taken out, or simulated without?"
    return f"the mean is {off}: {why}", "look"


def _temperature(recording: Recording) -> tuple[str, Verdict]:
    """What channels of temperature there are, where no axis follows one."""
    channels = temperatures(recording)
    if not channels:
        return "no such column: what drifts with it counts as B, K and a ramp", "look"
    missing = [key for key, z in channels.items() if not np.isfinite(z).all()]
    if missing:
        return f"values of {', '.join(missing)} are missing: whether an axis follows cannot be said", "look"
    ranges = {key: plain(float(np.ptp(z)), 3) for key, z in channels.items()}
    said = "; ".join(f"{key} varies by {size} in its column's unit" for key, size in ranges.items())
    return f"{said}, and no axis follows it", "fine"


def _bandwidth(rate: float, widths: Mapping[str, float | None]) -> Line:
    """Sample rate compared with the bandwidth of the axes."""
    name, wanted = "bandwidth", "three to five times the bandwidth is right"
    known = {axis: value for axis, value in widths.items() if value is not None}
    below = {axis: value for axis, value in known.items() if np.isfinite(value)}
    if not known:
        return Line(name, "look", "undetermined: drift or the record's length hides the passband")
    if not below:
        unlimited = f"no filter is seen below {plain(rate / 2.0, 4)} Hz, half the rate"
        return Line(
            name,
            "look",
            f"{unlimited}: if the sensor has more, N has noise from beyond folded into it; {wanted}",
        )
    axis = max(below, key=below.__getitem__)
    widest = below[axis]
    said = f"{plain(widest, 3)} Hz ({axis}), the rate is {plain(rate / widest, 2)} times that"
    if rate < _LEAST_RATIO * widest:
        return Line(name, "look", f"{said}: {wanted}; noise from beyond half the rate is folded into N")
    if rate > _MOST_RATIO * widest:
        return Line(name, "fine", f"{said}: more than it takes, {wanted}")
    return Line(name, "fine", f"{said}: {wanted}")


def worst(lines: Sequence[Line]) -> Verdict:
    """The worst verdict of these lines."""
    order: Mapping[str, int] = {"fine": 0, "look": 1, "stop": 2}
    return max((line.verdict for line in lines), key=order.__getitem__, default="fine")
