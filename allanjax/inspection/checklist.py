"""Checks of a recording, one line each: fine, look (worth a look), or stop (unusable as it is).

Each kind of fact from an inspection is one line; without such a fact the line reads fine.
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
from allanjax.inspection.plausible import accelerometers, describe_jitter, temperatures
from allanjax.record.recording import Recording
from allanjax.record.units import rate_unit_of

#: Verdicts, the best first.
Verdict = Literal["fine", "look", "stop"]

# Sample rate over bandwidth: from three to five, after Hou (2004) section 5.3, figure 5.10.
_LEAST_RATIO, _MOST_RATIO = 3.0, 5.0


@dataclasses.dataclass(frozen=True)
class Line:
    """One check: its name, the verdict, and the reason in words with numbers and units.

    In the reason, the finding comes first; after the first semicolon follows what it means and what to do.
    """

    name: str
    verdict: Verdict
    reason: str


def lines_of(
    recording: Recording, inspection: Inspection, widths: Mapping[str, float | None]
) -> Iterator[Line]:
    """Yield the checks of a recording, given its inspection and the bandwidth of each axis."""

    def line(name: str, otherwise: str, verdict: Verdict = "fine") -> Line:
        facts = [fact for fact in inspection.facts if fact.kind == name]
        if not facts:
            return Line(name, verdict, otherwise)
        # Findings with the same advice share it.
        advice: dict[str, list[str]] = {}
        for fact in facts:
            finding, _, rest = fact.text.partition("; ")
            advice.setdefault(rest, []).append(finding)
        reason = "; ".join("; ".join(filter(None, (", ".join(of), rest))) for rest, of in advice.items())
        return Line(name, "stop" if any(fact.grave for fact in facts) else "look", reason)

    timed, rate = recording.jitter is not None, f"{recording.rate:.6g} Hz"
    unknown = "cannot be checked without time stamps"
    stated = "; ".join(note for note in recording.notes if note.startswith("sample rate")) or rate
    yield line("rate", stated) if timed else line("rate", f"{rate} as given; it {unknown}", "look")
    yield line("jitter", describe_jitter(recording)) if timed else line("jitter", unknown, "look")
    yield line("gaps", unknown, "look") if recording.gaps is None else line("gaps", "none")
    yield line("repeated samples", "no more than rounding explains")
    yield line("interpolation", "no samples are interpolated")
    yield line("resolution", _resolution(recording, inspection))
    yield line("saturation", "samples do not pile up at the ends of their range")
    yield line("dead axes", "every axis changes")
    yield line("at rest", "no axis moves more than a sensor at rest")
    yield line("disturbances", "; ".join(inspection.notes) or "none")
    yield line("spikes", "no outlying samples")
    yield line("lines", "no spectral lines")
    sensors = {axis.sensor for axis in recording.axes}
    if "accel" in sensors:
        yield line("accel unit", *_gravity(inspection))
    if "gyro" in sensors:
        gyros = [k for k, axis in enumerate(inspection.axes) if axis.sensor == "gyro"]
        k = max(gyros, key=lambda k: abs(inspection.mean[k]))
        bias = f"{amount(abs(inspection.mean[k]), inspection.axes[k])} ({inspection.axes[k].name})"
        yield line("gyro unit", f"biases up to {bias} and the noise are plausible for a gyro")
    yield line("temperature", *_temperature(recording))
    yield line("length", f"{recording.n:,} samples, {duration(recording.duration)}")
    yield _bandwidth(recording.rate, widths)


def _resolution(recording: Recording, inspection: Inspection) -> str:
    """Return the noise of the axes in steps of their output, in words."""
    change = np.diff(recording.values, axis=0)
    rms = np.sqrt(np.einsum("ij,ij->j", change, change) / len(change) / 2.0)
    counts = [
        (float(r / q), k) for k, (r, q) in enumerate(zip(rms, inspection.steps, strict=True)) if q > 0.0
    ]
    if not counts:
        return "the samples show no rounding"
    least, k = min(counts)
    step = f"{amount(inspection.steps[k], recording.axes[k], 3)} ({recording.axes[k].name})"
    return f"the noise is at least {plain(least, 2)} steps of {step}"


def _gravity(inspection: Inspection) -> tuple[str, Verdict]:
    """Return the size of gravity in the accelerometers, which verifies their unit."""
    accel = max(accelerometers(inspection.axes), key=len)
    size = float(np.linalg.norm(inspection.mean[accel]))
    unit, scale = rate_unit_of(inspection.axes[accel[0]].unit, "accel")
    off = f"{plain(size / scale, 4)} {unit}, {plain(100.0 * abs(size / _G - 1.0), 2)} % off gravity"
    if abs(size / _G - 1.0) < 0.2:
        return f"the mean is {off}", "fine"
    if len(accel) < 3:
        mean = amount(size, inspection.axes[accel[0]])
        return f"the mean is {mean}; without all three axes, gravity does not verify the unit", "look"
    why = "the sensor moved" if inspection.moving else "was gravity removed, or not simulated?"
    return f"the mean is {off}; {why}", "look"


def _temperature(recording: Recording) -> tuple[str, Verdict]:
    """Return the temperature channels in words, if no axis follows one."""
    channels = temperatures(recording)
    if not channels:
        return "no temperature column; temperature drift will be counted as B, K or ramp", "look"
    missing = [key for key, z in channels.items() if not np.isfinite(z).all()]
    if missing:
        return f"values of {', '.join(missing)} are missing; whether an axis follows it is unknown", "look"
    ranges = {key: plain(float(np.ptp(z)), 3) for key, z in channels.items()}
    varies = "; ".join(f"{key} varies by {size} (unit of its column)" for key, size in ranges.items())
    return f"{varies}, and no axis follows it", "fine"


def _bandwidth(rate: float, widths: Mapping[str, float | None]) -> Line:
    """Return the check of the sample rate against the bandwidth of the axes."""
    name, wanted = "bandwidth", "three to five times the bandwidth suffices"
    known = {axis: value for axis, value in widths.items() if value is not None}
    below = {axis: value for axis, value in known.items() if np.isfinite(value)}
    if not known:
        return Line(name, "look", "unknown; drift or a short record hides the passband")
    if not below:
        unlimited = f"no filter below {plain(rate / 2.0, 4)} Hz, half the rate"
        aliased = f"if the sensor has more bandwidth, aliased noise adds to N ({wanted})"
        return Line(name, "look", f"{unlimited}; {aliased}")
    axis = max(below, key=below.__getitem__)
    widest = below[axis]
    ratio = f"{plain(widest, 3)} Hz ({axis}); the rate is {plain(rate / widest, 2)} times that"
    if rate < _LEAST_RATIO * widest:
        return Line(name, "look", f"{ratio}; aliased noise adds to N ({wanted})")
    return Line(name, "fine", f"{ratio}; {'more than needed, as ' * (rate > _MOST_RATIO * widest)}{wanted}")


def worst(lines: Sequence[Line]) -> Verdict:
    """Return the worst verdict of these lines."""
    order: Mapping[str, int] = {"fine": 0, "look": 1, "stop": 2}
    return max((line.verdict for line in lines), key=order.__getitem__, default="fine")
