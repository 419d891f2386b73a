"""Checks of a recording, in one line each: fine, look (worth a look), or stop (unusable as it is).

Each kind of fact from an inspection is one line; without such a fact the line reads fine.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Literal, get_args

import numpy as np

from allanjax.base.earth import STANDARD_GRAVITY as _G
from allanjax.base.wording import clauses, duration, plain
from allanjax.inspection.facts import Fact, amount
from allanjax.inspection.first_look import Inspection
from allanjax.inspection.plausible import LOWEST_RATE, describe_jitter, temperatures
from allanjax.inspection.units import groups
from allanjax.record.recording import Recording
from allanjax.record.units import rate_unit_of

#: Verdicts, the best first.
Verdict = Literal["fine", "look", "stop"]

# Sample rate over bandwidth: from three to five, after Hou (2004) section 5.3, figure 5.10.
_LEAST_RATIO, _MOST_RATIO = 3.0, 5.0


@dataclasses.dataclass(frozen=True)
class Line:
    """One check: its name, the verdict, and the reason in words with numbers and units.

    Attributes:
        name: what was checked, the `kind` of a fact.
        verdict: fine, look or stop.
        finding: what was found, in words with numbers and units.
        advice: what it means and what to do; "" if nothing.
    """

    name: str
    verdict: Verdict
    finding: str
    advice: str = ""

    @property
    def reason(self) -> str:
        """Finding and advice."""
        return clauses(self.finding, self.advice)


def lines_of(
    recording: Recording, inspection: Inspection, widths: Mapping[str, float | None]
) -> Iterator[Line]:
    """Yield the checks of a recording, given its inspection and the bandwidth of each axis."""
    for otherwise in _without_facts(recording, inspection):
        facts = [fact for fact in inspection.facts if fact.kind == otherwise.name]
        yield _of_facts(facts) if facts else otherwise
    yield _bandwidth(recording.rate, widths)


def _of_facts(facts: Sequence[Fact]) -> Line:
    """Return facts of one kind as a line, in which findings with the same advice share it."""
    by_advice: dict[str, list[str]] = {}
    for fact in facts:
        by_advice.setdefault(fact.advice, []).append(fact.finding)
    (advice, findings), *others = by_advice.items()
    more = [clauses(", ".join(of), rest) for rest, of in others]
    verdict: Verdict = "stop" if any(fact.grave for fact in facts) else "look"
    return Line(facts[0].kind, verdict, ", ".join(findings), clauses(advice, *more))


def _without_facts(recording: Recording, inspection: Inspection) -> Iterator[Line]:
    """Yield the line of each check in case that the inspection has no fact of that kind."""
    rate, unknown = f"{recording.rate:.6g} Hz", "cannot be checked without time stamps"
    if recording.jitter is None:
        yield Line("rate", "look", f"{rate} as given; it {unknown}")
        yield Line("jitter", "look", unknown)
    else:
        yield Line("rate", "fine", f"{rate} by the time stamps")
        yield Line("jitter", "fine", describe_jitter(recording))
    yield Line("gaps", "look", unknown) if recording.gaps is None else Line("gaps", "fine", "none")
    fine = {
        "repeated samples": "no more than rounding explains",
        "interpolation": "no samples are interpolated",
        "resolution": _resolution(recording, inspection),
        "saturation": "samples do not pile up at the ends of their range",
        "dead axes": "every axis changes",
        "at rest": "no axis moves more than a sensor at rest",
        "disturbances": "; ".join(inspection.notes) or "none",
        "spikes": "no outlying samples",
        "lines": "no spectral lines",
    }
    yield from (Line(name, "fine", finding) for name, finding in fine.items())
    sensors = {axis.sensor for axis in recording.axes}
    if "accel" in sensors:
        yield _gravity(inspection)
    if "gyro" in sensors and recording.rate < LOWEST_RATE:
        yield Line("gyro unit", "look", "cannot be checked at a rate that no sensor has")
    elif "gyro" in sensors:
        of_gyros = [(abs(x), axis) for x, axis in zip(inspection.mean, inspection.axes, strict=True)]
        size, axis = max((pair for pair in of_gyros if pair[1].sensor == "gyro"), key=lambda pair: pair[0])
        bias = f"{amount(size, axis)} ({axis.name})"
        yield Line("gyro unit", "fine", f"biases up to {bias} and the noise are plausible for a gyro")
    yield _temperature(recording)
    yield Line("length", "fine", f"{recording.n:,} samples, {duration(recording.duration)}")


def _resolution(recording: Recording, inspection: Inspection) -> str:
    """Return the noise of the axes in steps of their output, in words."""
    change = np.diff(recording.values, axis=0)
    rms = np.sqrt(np.einsum("ij,ij->j", change, change) / len(change) / 2.0)
    steps = inspection.steps
    rounded = np.flatnonzero(steps > 0.0)
    if not len(rounded):
        return "the samples show no rounding"
    k = min(rounded.tolist(), key=lambda k: rms[k] / steps[k])
    step = f"{amount(steps[k], recording.axes[k], 3)} ({recording.axes[k].name})"
    return f"the noise is at least {plain(float(rms[k] / steps[k]), 2)} steps of {step}"


def _gravity(inspection: Inspection) -> Line:
    """Return the check of the size of gravity in the accelerometers, which verifies their unit."""
    accel = max(groups(inspection.axes, "accel"), key=len)
    size, axis = float(np.linalg.norm(inspection.mean[accel])), inspection.axes[accel[0]]
    unit, scale = rate_unit_of(axis.unit, "accel")
    off = abs(size / _G - 1.0)
    found = f"the mean is {plain(size / scale, 4)} {unit}, {plain(100.0 * off, 2)} % off gravity"
    if off < 0.2:
        return Line("accel unit", "fine", found)
    if len(accel) < 3:
        found = f"the mean is {amount(size, axis)}"
        return Line("accel unit", "look", found, "without all three axes, gravity does not verify the unit")
    why = "the sensor moved" if inspection.moving else "was gravity removed, or not simulated?"
    return Line("accel unit", "look", found, why)


def _temperature(recording: Recording) -> Line:
    """Return the check of the temperature channels, if no axis follows one."""
    name, varies = "temperature", []
    for key, z in temperatures(recording).items():
        if not np.isfinite(z).all():
            return Line(name, "look", f"values of {key} are missing", "whether an axis follows it is unknown")
        unit = recording.auxiliary_units.get(key, "(unit of its column)")
        varies.append(f"{key} varies by {plain(float(np.ptp(z)), 3)} {unit}")
    if not varies:
        counted = "temperature drift will be counted as B, K or ramp"
        return Line(name, "look", "no temperature column", counted)
    return Line(name, "fine", f"{' and '.join(varies)}, and no axis follows it")


def _bandwidth(rate: float, widths: Mapping[str, float | None]) -> Line:
    """Return the check of the sample rate against the bandwidth of the axes."""
    name, wanted = "bandwidth", "three to five times the bandwidth suffices"
    known = {axis: value for axis, value in widths.items() if value is not None}
    below = {axis: value for axis, value in known.items() if np.isfinite(value)}
    if not known:
        return Line(name, "look", "unknown", "drift or a short record hides the passband")
    if not below:
        unlimited = f"no filter below {plain(rate / 2.0, 4)} Hz, half the rate"
        aliased = f"if the sensor has more bandwidth, aliased noise adds to N ({wanted})"
        return Line(name, "look", unlimited, aliased)
    axis = max(below, key=below.__getitem__)
    widest = below[axis]
    found = f"{plain(widest, 3)} Hz ({axis}); the rate is {plain(rate / widest, 2)} times that"
    if rate < _LEAST_RATIO * widest:
        return Line(name, "look", found, f"aliased noise adds to N ({wanted})")
    return Line(name, "fine", found, f"{'more than needed, as ' * (rate > _MOST_RATIO * widest)}{wanted}")


def worst(lines: Sequence[Line]) -> Verdict:
    """Return the worst verdict of these lines."""
    return max((line.verdict for line in lines), key=get_args(Verdict).index, default="fine")
