"""What a critique says of a record, beside what was hidden in it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

import allanjax as aj
from allanjax.critic import Critique, Finding
from allanjax.record.units import unit_scale
from benchmarks.common import ours
from benchmarks.common.hidden_effects import TERMS, Effect, Hidden

BASIC = {letter.replace("q", "M"): term for letter, term in ours.TERMS.items() if letter != "A"}
#: Parameters that truth and finding have in common.
PARAMETERS = {
    "sinusoid": ("frequency", "amplitude"),
    "warm_up": ("time_constant", "amplitude"),
    "bias_step": ("time", "amplitude"),
    "telegraph": ("dwell_time", "amplitude"),
    "temperature": ("coefficient", "lag"),
    "outliers": ("count", "scale"),
    "disturbance": ("start", "end"),
    "resonance": ("frequency", "quality_factor", "amplitude"),
    "power_law": ("exponent",),
    "variance_change": ("start", "end", "ratio"),
    "saturation": ("level", "lower"),
    "rounding": ("step",),
    "repeated_samples": ("fraction", "longest"),
    "low_pass": ("bandwidth",),
    "common_mode": ("correlation",),
    "markov": ("amplitude", "correlation_time"),
} | {cause: ("coefficient",) for cause in TERMS if cause != "markov"}
_OTHER_NAMES = {"level": "upper_level", "lower": "lower_level"}
#: A place in time is near within this share of the record, any other parameter within this share of itself.
NEAR_PLACE, NEAR = 0.02, 0.2


class Compared(NamedTuple):
    """A parameter in SI. slack: what it is known no better than; near: what counts as near the truth."""

    truth: float
    value: float
    std: float
    slack: float
    near: float

    @property
    def error(self) -> float:
        return abs(self.value - self.truth)

    @property
    def within_3_sigma(self) -> bool:
        return self.error <= max(3.0 * self.std, self.slack)

    @property
    def is_near(self) -> bool:
        return self.error <= max(self.near, self.slack)


def recording_of(hidden: Hidden) -> aj.Recording:
    """The samples and what was recorded with them, in SI; nothing of the truth."""
    units = {"gyro": "rad/s", "accel": "m/s²"}
    given = {f"{k}_unit": unit for k, unit in units.items() if any(x.startswith(k) for x in hidden.names)}
    given |= {"names": hidden.names, "auxiliary": hidden.auxiliary}
    return aj.Recording.from_array(hidden.values, hidden.rate, **given)


def model_without(hidden: Hidden) -> aj.Model | None:
    """The sensor's other terms where the effect is a basic term; None where it is not."""
    lacking = {TERMS[e.cause] for e in hidden.effects if e.cause in TERMS}
    if not lacking:
        return None
    others = [term for letter, term in BASIC.items() if letter in hidden.sensor and letter not in lacking]
    # Without white noise and quantization there would be no noise to whiten by.
    return aj.Model(tuple(others or [aj.AngleRandomWalk()]))


def right(critique: Critique, effect: Effect) -> Finding | None:
    """The finding that names the effect, that with most evidence if there are several."""
    found = [f for f in critique.findings if f.cause == effect.cause and set(f.axes) <= set(effect.axes)]
    return max(found, key=lambda f: f.evidence or 0.0, default=None)


def others(critique: Critique, effects: Iterable[Effect]) -> list[str]:
    """Causes that were claimed and are not there."""
    return [
        f.cause
        for f in critique.findings
        if not any(f.cause == e.cause and set(f.axes) <= set(e.axes) for e in effects)
    ]


def compared(finding: Finding, effect: Effect, duration: float) -> dict[str, Compared]:
    """The finding's parameters beside the effect's, by name; nan where the finding lacks one."""
    truth = _told(finding, effect)
    sensor = "gyro" if effect.axes[0].startswith("gyro") else "accel"
    table = {}
    for name in PARAMETERS[effect.cause]:
        if name not in truth:
            continue
        true, value, std = float(truth[name]), float("nan"), float("nan")
        if effect.cause in ("telegraph", "drift_ramp") and name in ("amplitude", "coefficient"):
            true = abs(true)
        if (q := finding.parameters.get(_OTHER_NAMES.get(name, name))) is not None:
            scale = unit_scale(q.unit, sensor) if effect.cause in TERMS and q.unit != "s" else 1.0
            value, std = q.value * scale, q.std * scale
            if q.lower_limit is not None or q.upper_limit is not None:
                # Right if the truth is on that side of it.
                value, std = (min if q.lower_limit is None else max)(true, value), 0.0
        place = name in ("time", "start", "end", "lag")
        near = NEAR_PLACE * duration if place else NEAR * abs(true)
        table[name] = Compared(true, value, std, _slack(effect.cause, name, true, duration), near)
    return table


def _slack(cause: str, name: str, truth: float, duration: float) -> float:
    """Limits, steps and counts are exact but for floating point."""
    if cause == "disturbance":
        return 2.0
    return {"lag": NEAR_PLACE * duration, "exponent": 0.15}.get(name, 1e-9 * abs(truth))


def _told(finding: Finding, effect: Effect) -> dict[str, Any]:
    """What the finding can have meant: of two steps the nearer one, of faint outliers those found."""
    truth: dict[str, Any] = effect.parameters
    if effect.cause == "bias_step" and "time_2" in truth:
        time = finding.parameters["time"].value
        if abs(time - truth["time_2"]) < abs(time - truth["time"]):
            return {"time": truth["time_2"], "amplitude": truth["amplitude_2"]}
    if effect.cause == "outliers":
        times = np.array([t.value for t in finding.details["times"]])
        there = [t for t in truth["all_times"] if np.any(np.isclose(times, t, atol=1e-6))]
        return truth | {"count": float(len({*there, *truth["times"]}))}
    return truth
