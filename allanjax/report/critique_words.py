"""Numbers of a critique in words."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Mapping

import numpy as np

from allanjax.base.wording import format_with_error, plain
from allanjax.critic.finding import Discrepancy, Finding
from allanjax.critic.parameters import Detail, side_of_limit, values_of
from allanjax.noise.estimate import Estimate

# Statistics whose two values compare as a ratio: their name, and what stands before a place.
_RELATIVE = {
    "allan_deviation": ("Allan deviation", "at τ ="),
    "drift": ("drift", "over"),
    "psd": ("PSD", "at"),
    "window_variance": ("noise power", "around"),
}
# Values of a list that are shown; length from which on none is; and details that are not told.
_SHOWN, _LONGEST, _UNTOLD = 3, 20, frozenset({"axes", "sizes"})
# Errors below this share of a value are not shown: they are those of arithmetic, or of a file's digits.
_EXACT = 1e-5
# Parameters that are whole numbers.
_COUNTS = frozenset({"count", "jumps", "order", "longest"})
#: Parameters that are values of samples, and are given in the samples' unit.
AS_RECORDED = frozenset({"step", "upper_level", "lower_level"})
# Parameters that are places in time, whose limits have words of their own.
_PLACES = frozenset({"start", "end", "time"})
# Finer units for small values, the largest first, and their factors.
_FINER: Mapping[str, tuple[tuple[str, float], ...]] = {
    "g": (("mg", 1e3), ("µg", 1e6)),
    "mg": (("µg", 1e3),),
    "m/s²": (("mm/s²", 1e3), ("µm/s²", 1e6)),
    "deg/s": (("deg/h", 3600.0),),
    "rad/s": (("mrad/s", 1e3), ("µrad/s", 1e6)),
}
# Value below which a finer unit is taken.
_SMALL = 0.1
# Spaces at which no line is broken: in "p = 1e-30", "0.552 ± 0.001 Hz" and "τ = 0.7 s".
_TOGETHER = re.compile(r" (?=[±%=<→])|(?<=[±=<]) |(?<=\d) (?=[A-Za-zµσ(])|(?<=[pτ]) ")


def parameters(finding: Finding) -> list[str]:
    """Parameters in words, each with its error, e.g. "frequency 0.55200 ± 0.00010 Hz", and the details."""
    told = [(name, amount(e)) for name, e in finding.parameters.items()]
    told += [(name, several(detail)) for name, detail in finding.details.items() if _is_told(name, detail)]
    return [f"{name.replace('_', ' ')} {text}" for name, text in told]


def _is_told(name: str, detail: Detail) -> bool:
    """Whether a detail is told in words: a long list has been counted, and is in the JSON and the tables."""
    # The axes stand before the finding.
    return name not in _UNTOLD and len(values_of(detail)[0]) <= _LONGEST


def significance(finding: Finding) -> str:
    """How improbable a finding is by chance in words: a p-value where there is a test, else the odds."""
    if finding.p_value is not None:
        return p_value(finding.p_value)
    if finding.evidence is None:
        apart = finding.gain is not None or is_told_elsewhere(finding)
        return "" if apart else "seen in the samples themselves"
    return f"odds {_odds(finding.evidence)} : 1"


def _odds(evidence: float) -> str:
    """Odds by their logarithm, e.g. "41" or "1e+12"."""
    if evidence < np.log(1e4):
        return f"{np.exp(evidence):,.2g}" if evidence < np.log(100.0) else f"{np.exp(evidence):,.0f}"
    return f"1e+{int(evidence / np.log(10.0))}"


def gain_of(finding: Finding) -> str:
    """Gain of a finding in words, e.g. "gain 1,234 nats on held-out data"."""
    if finding.gain is not None:
        return f"gain {nats(finding.gain)} on held-out data"
    if is_told_elsewhere(finding):
        return "gain told with that of its axes' other outliers"
    return "gain cannot be held out"


def is_told_elsewhere(finding: Finding) -> bool:
    """Whether the gain of a finding is told with that of another one, of which it is a part."""
    return finding.gain is None and any(member.gain is not None for member in finding.members)


def nats(gain: float) -> str:
    """Gain in words, e.g. "1,234 nats"."""
    return f"{gain:,.0f} nats" if abs(gain) >= 10.0 else f"{gain:.1f} nats"


def amount(e: Estimate) -> str:
    """Value, error and unit of a finding's parameter; counts are whole, shares in per cent."""
    if limit := side_of_limit(e):
        unit, factor = suited(e.unit, e.value)
        number = f"{round(e.value):,}" if e.label in _COUNTS else f"{factor * e.value:.3g}"
        return f"{_beyond(limit, e.label)} {number}{f' {unit}' if unit else ''}"
    if e.label in _COUNTS and np.isfinite(e.value):
        return f"{round(e.value):,}{'' if e.unit == '1' else f' {e.unit}'}"
    if e.label == "fraction":
        return f"{plain(100.0 * e.value, 3)} %"
    unit, factor = (e.unit, 1.0) if e.label in AS_RECORDED else suited(e.unit, e.value)
    value, std = factor * e.value, factor * e.std
    known = std > _EXACT * abs(value)
    text = format_with_error(value, std) if known else plain(value, 6 if std > 0.0 else 4)
    return f"{text}{f' {unit}' if unit else ''}"


def _beyond(limit: str, name: str) -> str:
    """Words before a limit, e.g. "below"."""
    if name in _PLACES:
        return {"below": "at or before", "above": "at or after"}[limit]
    if name in _COUNTS:
        return {"below": "at most", "above": "at least"}[limit]
    return limit


def several(detail: Detail) -> str:
    """Words or a list of numbers with their unit, cut short."""
    values, _, unit = values_of(detail)
    numbers = [v for v in values if not isinstance(v, str)]
    unit, factor = suited(unit, max(numbers, key=abs, default=0.0))
    shown = [v if isinstance(v, str) else plain(factor * v, 4) for v in values[:_SHOWN]]
    more = f", … ({len(values)} in all)" if len(values) > _SHOWN else ""
    return f"{', '.join(shown)}{f' {unit}' if unit else ''}{more}"


def suited(unit: str, value: float) -> tuple[str, float]:
    """Unit in which a small value is easy to read, and the factor to it; a ratio has an empty name."""
    if unit in ("", "1"):
        return "", 1.0
    known = (name for name in _FINER if unit == name or unit.startswith((f"{name}/[", f"{name}/√")))
    base = max(known, key=len, default="")
    name, factor = base, 1.0
    for finer, times in _FINER.get(base, ()):
        if not 0.0 < factor * abs(value) < _SMALL:
            break
        name, factor = finer, times
    return name + unit[len(base) :], factor


def describe(d: Discrepancy) -> str:
    """Discrepancy in words, e.g. "simulated Allan deviation is 38 % low at τ = 0.7 s (p = 1e-30)"."""
    return f"{what(d)} ({p_value(d.p_value)})"


def p_value(p: float) -> str:
    """p-value in words, e.g. "p = 1e-30"."""
    if p <= 1e-300:
        return "p < 1e-300"
    return f"p = {p:.0e}" if p < 1e-3 else f"p = {p:.2g}"


def what(d: Discrepancy) -> str:
    """Discrepancy in words, without its p-value."""
    place = f"{plain(d.where, 3)} {d.where_unit}"
    if d.statistic in _RELATIVE:
        name, before = _RELATIVE[d.statistic]
        return f"simulated {name} is {factor_off(d.size)} {before} {place}"
    unit, factor = suited(d.unit, d.measured)
    value, simulated = (plain(factor * x, 2) for x in (d.measured, d.simulated))
    return {
        "psd_line": f"a line of {value} {unit} at {place}, simulations reach {simulated}",
        "autocorrelation": f"residuals correlate by {value} after {place}",
        "tails": f"residuals have an excess kurtosis of {value}",
        "largest_residual": f"a residual of {value} σ at {place}, simulations reach {simulated} σ",
        "lattice": "samples are multiples of one step",
        "repeated_values": f"{percent(d.measured)} of samples repeat the one before, "
        f"simulated {percent(d.simulated)}",
        "window_mean": f"residuals have a mean of {value} σ around {place}",
        "cross_correlation": f"residuals correlate by {value} with those of {d.channel}",
        "auxiliary_correlation": f"{value} {unit} follow {d.channel}, {simulated} by chance",
    }.get(d.statistic, f"{d.statistic.replace('_', ' ')}: {value} {unit}, simulated {simulated}")


def factor_off(size: float) -> str:
    """Relative error in words, e.g. "38 % low"; a large one as a factor."""
    if not np.isfinite(size):
        return "wrong"
    if size > 2.0:
        return f"{_factor(1.0 + size)} times too high"
    if size < -0.95:
        return f"{_factor(1.0 / max(1.0 + size, 1e-300))} times too low"
    return f"{percent(size)} {'low' if size < 0.0 else 'high'}"


def percent(size: float) -> str:
    """Relative size in per cent, e.g. "38 %" or "160 %"."""
    size = abs(100.0 * size)
    return f"{size:.2g} %" if size < 99.5 else f"{round(size, -1):.0f} %"


def _factor(x: float) -> str:
    return f"{x:.2g}" if x < 10.0 else f"{x:,.0f}" if x < 1e6 else f"{x:.0e}"


def wrap(text: str, width: int, first: str = "", rest: str = "") -> str:
    """Text broken into lines, but not between a number and its unit."""
    kept = _TOGETHER.sub("\u00a0", text)
    wrapper = textwrap.TextWrapper(width, first, rest, break_long_words=False, break_on_hyphens=False)
    return wrapper.fill(kept).replace("\u00a0", " ")
