"""Findings in one line each: the cause, where it is, how large in each axis, and what it changes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from allanjax.base.wording import duration, plain
from allanjax.critic.finding import CoefficientChange, Finding
from allanjax.critic.parameters import side_of_limit, values_of
from allanjax.noise.estimate import Estimate, title_of
from allanjax.record.recording import Axis
from allanjax.report.critique_words import AS_RECORDED, factor_off, percent, suited

#: Most findings that a printed critique tells.
MOST = 10
# Parameters that say which effect it is, the first that a finding has, and what stands before them.
_WHICH = {
    "frequency": "",
    "bandwidth": "",
    "time": "at ",
    "time_constant": "over ",
    "count": "",
    "exponent": "of exponent ",
    "correlation_time": "over ",
    "dwell_time": "of ",
    "correlation": "",
}
# Signs of a parameter of which only a limit is known.
_LIMIT = {"above": "> ", "below": "< ", "": ""}


def in_one_line(finding: Finding, axis: Axis, width: int) -> str:
    """A finding in one line of this width; `axis` is the one in which it matters most.

    Where it is too long for that, amplitudes are given as a range, then what it changes is left out.
    """
    name, change = title(finding), changed(finding, axis)
    texts = [
        f"{name}: {where}{end}"
        for end in ((f"; {change}", "") if change else ("",))
        for where in (_each(finding), _range(finding))
    ]
    fitting = next((text for text in texts if len(text) <= width), texts[-1])
    return fitting if len(fitting) <= width else f"{fitting[: width - 1]}…"


def title(finding: Finding) -> str:
    """Cause and place of a finding, e.g. "sinusoid 0.5355 Hz (and harmonics 2, 3)"."""
    words = [finding.named(finding.cause)]
    if "start" in finding.parameters and "end" in finding.parameters:
        start, end = (plain(finding.parameters[name].value, 4) for name in ("start", "end"))
        words.append(f"from {start} to {end} s")
    for label, before in _WHICH.items():
        if label in finding.parameters:
            amount = _amount(finding.parameters[label], digits=4)
            words.append(f"({amount})" if label == "count" else before + amount)
            break
    if isinstance(channel := finding.details.get("channel"), str):
        words.append(f"by {channel}")
    for name, called in (("harmonics", "harmonic"), ("further_frequencies", "")):
        if name in finding.details:
            values, _, unit = values_of(finding.details[name])
            each = ", ".join(plain(float(x), 4) for x in values)
            before = f"{called}{'s' if len(values) > 1 else ''} " if called else ""
            words.append(f"(and {before}{each}{'' if unit == '1' else f' {unit}'})")
    return " ".join(words)


def amplitudes(finding: Finding) -> str:
    """How large a finding is in each of its axes, e.g. "accel_x 0.382 mg, gyro_z 3.6 deg/h"."""
    return ", ".join(
        f"{axis} {_amount(e)}{f' ({e.remark})' if e.remark else ''}" for axis, e in finding.amplitudes.items()
    )


def changed(finding: Finding, axis: Axis) -> str:
    """What a finding changes most, e.g. "drift over 64 s 0.263 → 0.477 m/s"; "" for next to nothing."""
    effect = finding.effect
    if not effect.size >= 1e-3:
        return ""
    where = f"{axis.name}: " if len(finding.axes) > 1 else ""
    if effect.quantity == "sum":
        return f"the sum of two of them by {percent(effect.size)}"
    if effect.quantity == "allan_deviation":
        before = next(b for b, _ in finding.discrepancies if b.statistic == "allan_deviation")
        return f"{where}Allan deviation was {factor_off(before.size)} at {plain(effect.time, 3)} s"
    if effect.quantity == "drift" and finding.drift is not None:
        drift = finding.drift
        numbers = f"{plain(drift.before, 3)} → {plain(drift.after, 3)} {drift.unit}"
        return f"{where}drift over {duration(drift.horizon)} {numbers}"
    own = next(c for c in finding.coefficients if c.label == effect.quantity)
    return where + coefficient(own, axis)


def coefficient(c: CoefficientChange, axis: Axis) -> str:
    """Change of a coefficient in words, e.g. "angle random walk 2.53 → 1.46 deg/√h"."""
    before, after = (plain(x, 3) if np.isfinite(x) else "none" for x in (c.before, c.after))
    change = f"{before} {c.unit} → none" if after == "none" else f"{before} → {after} {c.unit}"
    return f"{title_of(c.label, axis.sensor)} {change}"


def _each(finding: Finding) -> str:
    """Axes with their amplitudes, where these say more than the title does."""
    return amplitudes(finding) if _is_sized(finding) else ", ".join(finding.axes)


def _range(finding: Finding) -> str:
    """Axes, and the smallest and the largest amplitude in each unit."""
    if not _is_sized(finding):
        return _names(finding.axes)
    by_unit: dict[tuple[str, str], dict[str, Estimate]] = {}
    for axis, e in finding.amplitudes.items():
        by_unit.setdefault((e.unit, e.label), {})[axis] = e
    return ", ".join(f"{_names(each)} {_between([*each.values()])}" for each in by_unit.values())


def _is_sized(finding: Finding) -> bool:
    """Whether a finding has an amplitude that its title does not tell."""
    return bool(finding.amplitudes) and not (len(finding.axes) == 1 and "bandwidth" in finding.parameters)


def _names(axes: Iterable[str]) -> str:
    """Names of axes, those of one sensor short, e.g. "accel_x, y, z"."""
    words: list[str] = []
    former = ""
    for axis in axes:
        sensor, mark, own = axis.rpartition("_")
        words.append(own if mark and sensor == former else axis)
        former = sensor
    return ", ".join(words)


def _between(each: Sequence[Estimate]) -> str:
    """Smallest and largest of several values, e.g. "0.2 … 0.382 mg"."""
    low, high = (choice(each, key=lambda e: abs(e.value)) for choice in (min, max))
    unit, factor = ("%", 100.0) if high.label == "fraction" else _unit(high)
    ends = dict.fromkeys(f"{_LIMIT[side_of_limit(e)]}{plain(factor * e.value, 3)}" for e in (low, high))
    return " … ".join(ends) + (f" {unit}" if unit else "")


def _unit(e: Estimate) -> tuple[str, float]:
    """Unit in which a value is told, and the factor to it: of values of samples that of the record."""
    return (e.unit, 1.0) if e.label in AS_RECORDED else suited(e.unit, e.value)


def _amount(e: Estimate, digits: int = 3) -> str:
    """Value of a parameter, short: without its error."""
    if e.label == "count":
        return f"{round(e.value):,}"
    if e.label == "fraction":
        return f"{plain(100.0 * e.value, 3)} %"
    limit = _LIMIT[side_of_limit(e)]
    if e.label == "ratio":
        return f"{limit}×{plain(e.value, 3)}"
    unit, factor = _unit(e)
    return f"{limit}{plain(factor * e.value, digits)}{f' {unit}' if unit else ''}"
