"""Stories of critiques, in sentences for people."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from allanjax.base.tables import printable
from allanjax.base.wording import duration, format_with_error, plain
from allanjax.critic.finding import CoefficientChange, Discrepancy, Finding
from allanjax.critic.parameters import Detail, side_of_limit, values_of
from allanjax.critic.result import AxisCritique, Critique
from allanjax.estimate.result import LIMIT
from allanjax.noise.estimate import Estimate, title_of
from allanjax.record.recording import Axis

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


#: Largest p-value of a discrepancy that is reported: of some fourteen an axis, a few are small by chance. A
#: judgement.
UNEXPLAINED = 1e-4
# Smallest relative change of a coefficient or of the drift that is reported.
_NOTABLE = 0.05
# The best-known statistic comes first, unless another one improved by this many times as many nats.
_KNOWN, _CLEARER = "allan_deviation", 3.0
# Statistics whose remainder is given as a ratio.
_RATIOS = frozenset({"allan_deviation", "drift", "psd", "window_variance"})
_BETWEEN = frozenset({"cross_correlation", "auxiliary_correlation"})
# Most unexplained discrepancies that are listed, most notes on a screen, and characters in a line.
_TOLD, _NOTES = 3, 1
_WIDTH = 108


def story(critique: Critique) -> str:
    """Story of a critique: a line for each of the findings that change most, a headline for each axis."""
    causes = _causes(critique)
    lines = _beginning(critique, bool(causes))
    axes = {name: critique[name].axis for name in critique}
    for f in causes[:MOST]:
        lines.append(f"  - {in_one_line(f, axes[f.shown], _WIDTH - 4)}")
    if len(causes) > MOST:
        lines.append(f"  and {len(causes) - MOST} more: see the pictures, the JSON, or `critique.details()`")
    return "\n".join([*lines, *_end(critique, brief=True)])


def details(critique: Critique) -> str:
    """Story of a critique at length: a paragraph for each finding, and a headline for each axis."""
    causes = _causes(critique)
    lines = _beginning(critique, bool(causes))
    for f in causes:
        lines += ["", _wrapped(sentence(f)), *format_changes(f, critique[f.shown].axis)]
    return "\n".join([*lines, *_end(critique)])


def _causes(critique: Critique) -> list[Finding]:
    """Findings with a cause, what changes most first."""
    return [f for f in critique.findings if f.cause != "unexplained"]


def _beginning(critique: Critique, found: bool) -> list[str]:
    """Warnings, and how many findings there are."""
    count = len(_causes(critique))
    head = f"{count} finding{'s' if count > 1 else ''}" if found else "nothing found"
    axes = "1 axis" if len(critique) == 1 else f"{len(critique)} axes"
    # Nothing of what was found may be of the kind that can be held out.
    gain = f", worth {nats(critique.gain)} on held-out data" if found and critique.gain else ""
    # Before all that is said of coefficients: whether they are any.
    warnings = (*critique.warnings, *unmeasured(critique))
    order = "; what changes most first" if count > 1 else ""
    return [
        *(_wrapped(f"warning: {text}") for text in warnings),
        f"{critique.name or 'recording'}: {head} in {axes}{gain}{order}",
    ]


def _end(critique: Critique, brief: bool = False) -> list[str]:
    """How well each axis is simulated now, which were not compared, and notes; `brief` for a screen."""
    shared = {name for f in critique.shared_findings for name in f.axes}
    lines = ["", *(_of_axis(axis, shared, brief) for axis in critique.results)]
    lines += [_wrapped(f"{dead.axis.name}: not compared: {dead.reason}") for dead in critique.dead]
    told = critique.notes[:_NOTES] if brief else critique.notes
    notes = [_wrapped(f"note: {note}") for note in told]
    if more := len(critique.notes) - len(told):
        notes.append(f"  and {more} more note{'s' if more > 1 else ''}: see `critique.details()`")
    return [*lines, *([""] if notes else []), *notes]


def unmeasured(critique: Critique) -> tuple[str, ...]:
    """Warnings about axes whose baseline is not a measurement of the sensor, and what to do about it."""
    found = []
    for axis in critique.results:
        if axis.misfit is None or not axis.misfit.excessive:
            continue
        left = next((d for d in axis.after if d.statistic == _KNOWN), None)
        off = left is not None and left.p_value < UNEXPLAINED and _is_far(left.size)
        then = (
            "what was found does not explain it, and the coefficients below are not the sensor's either; "
            "cut off what was not at rest (--start, --stop), or look at the pictures"
            if off
            else "coefficients after what was found are those to look at"
        )
        name = axis.axis.name
        found.append(f"{name}: the baseline is not a measurement of this sensor, {axis.misfit}; {then}")
    return tuple(found)


def _is_far(size: float) -> bool:
    """Whether a relative error, of either sign, is beyond what coefficients may have."""
    return not abs(np.log(max(1.0 + size, 1e-300))) < np.log(1.0 + LIMIT)


def sentence(finding: Finding) -> str:
    """Description of a finding with its axes, see `paragraph`."""
    return f"{', '.join(finding.axes)}: {paragraph(finding)}"


def paragraph(finding: Finding) -> str:
    """Description of a finding: what was wrong, the cause, how large it is, the remainder, gain, rivals."""
    if finding.cause == "unexplained":
        return f"unexplained: {'; '.join(describe(d) for d, _ in finding.discrepancies)}."
    cause = ", ".join([finding.named(finding.cause), *parameters(finding)])
    several = len(finding.axes) > 1 and finding.members
    if finding.members and finding.amplitudes:
        cause += f"; {amplitudes(finding)}"
    pair, gain = headline_discrepancy(finding), gain_of(finding)
    if pair is None:
        test = significance(finding)
        text = f"{cause}{f' ({test})' if test else ''}. {gain[0].upper()}{gain[1:]}."
    else:
        where = f"in {finding.shown}: " if several else ""
        text = f"{where}{describe(pair[0])}. Cause: {cause}. "
        text += f"After{f' in {finding.shown}' if several else ''}: {format_remainder(*pair)}; {gain}."
    if finding.rivals:
        rivals = ", ".join(f"{finding.named(r.cause)} (1 : {r.odds:,.2g})" for r in finding.rivals)
        text += f" Rivals: {rivals}."
    return text


def headline_discrepancy(finding: Finding) -> tuple[Discrepancy, Discrepancy] | None:
    """Discrepancy that the finding reduced most, before and after, if it was significant before."""
    # Of those whose log p-value has lost at least half of its size.
    pairs = [
        pair
        for pair in finding.discrepancies
        if pair[0].p_value < UNEXPLAINED and _mended(pair) > -0.5 * np.log(pair[0].p_value)
    ]
    if not pairs:
        return None
    best = max(pairs, key=_mended)
    known = next((pair for pair in pairs if pair[0].statistic == _KNOWN), best)
    return known if _CLEARER * _mended(known) >= _mended(best) else best


def _mended(pair: tuple[Discrepancy, Discrepancy]) -> float:
    """Increase of the log p-value from before to after."""
    before, after = (np.log(max(d.p_value, 1e-300)) for d in pair)
    return float(after - before)


def format_remainder(before: Discrepancy, after: Discrepancy) -> str:
    """Remainder of a discrepancy in words, e.g. "within 0.5 %"."""
    if before.statistic in _RATIOS and np.isfinite(after.size):
        if after.p_value < UNEXPLAINED:
            return factor_off(after.size)
        return f"within {percent(max(abs(after.size), 1e-3))}"
    return "gone" if after.p_value > UNEXPLAINED else f"still there ({p_value(after.p_value)})"


def format_changes(finding: Finding, axis: Axis) -> list[str]:
    """Changes by a finding as a paragraph, none if there are none."""
    text = "; ".join(changes(finding, axis))
    return [_wrapped(text, "    ", "    ")] if text else []


def changes(finding: Finding, axis: Axis) -> list[str]:
    """Changes of coefficients and drift by a finding, each in words."""
    found = [coefficient(c, axis) for c in finding.coefficients if _notable(c.before, c.after)]
    drift = finding.drift
    if drift is not None and _notable(drift.before, drift.after):
        measured, before, after = (plain(x, 3) for x in (drift.measured, drift.before, drift.after))
        found.append(
            f"drift over {duration(drift.horizon)}: measured {measured} {drift.unit}, "
            f"predicted {before} before and {after} after"
        )
    return found


def _of_axis(axis: AxisCritique, shared: set[str], brief: bool) -> str:
    """How well one axis is simulated, before and after what was found; in a line if it is to be `brief`."""
    name, count = axis.axis.name, len(axis.before)
    causes = [f for f in axis.findings if f.cause != "unexplained"]
    wrong = _wrong(axis.before)
    remains = _wrong(axis.after if causes else axis.before)
    # What axes have in common is told with the findings.
    remains = [d for d in remains if not (name in shared and d.statistic in _BETWEEN)]
    if not wrong and not causes:
        smallest = min((d.p_value for d in axis.before), default=1.0)
        return _wrapped(
            f"{name}: nothing found: the simulation is indistinguishable from the measurement "
            f"(smallest p-value {smallest:.2g} of {count} tests)"
        )
    if not causes:
        own = _unexplained(remains, brief) if remains else "nothing of its own; see what axes share"
        return _wrapped(f"{name}: {own}")
    headline = "no test by itself fails"
    if wrong:
        fail = "tests fail" if len(wrong) > 1 else "tests fails"
        headline = f"{len(wrong)} of {count} {fail}"
        if not (brief and remains):
            headline = f"{what(wrong[0])} ({p_value(wrong[0].p_value)}; {headline})"
    nothing = "none left" if brief else f"left: nothing, all {count} tests pass"
    left = _unexplained(remains, brief) if remains else nothing
    return _wrapped(f"{name}: {headline}; {left}")


def _wrong(found: Sequence[Discrepancy]) -> list[Discrepancy]:
    """Significant discrepancies, the Allan deviation first, then by p-value."""
    wrong = [d for d in found if d.p_value < UNEXPLAINED]
    return sorted(wrong, key=lambda d: (d.statistic != _KNOWN, d.p_value))


def _unexplained(remains: Sequence[Discrepancy], brief: bool) -> str:
    by_p, most = sorted(remains, key=lambda d: d.p_value), 1 if brief else _TOLD
    more = f"; and {len(by_p) - most} more" if len(by_p) > most else ""
    return f"unexplained: {'; '.join(describe(d) for d in by_p[:most])}{more}"


def _wrapped(text: str, first: str = "", rest: str = "  ") -> str:
    return wrap(text, _WIDTH, first, rest)


def _notable(before: float, after: float) -> bool:
    """Whether a value changed; that of a term which is in neither model did not."""
    known = np.isfinite([before, after])
    if not known.all():
        return bool(known.any())
    return abs(after - before) > _NOTABLE * max(abs(before), abs(after))


def critique_text(critique: Critique) -> str:
    """Story of a critique as standard output can show it, for `print`."""
    return printable(story(critique))


def finding_text(finding: Finding) -> str:
    """Description of a finding as standard output can show it, for `print`."""
    return printable(sentence(finding))


def finding_repr(finding: Finding) -> str:
    """Finding in one line: its cause, its parameters, its gain."""
    found = ", ".join([f"{finding.cause} in {' and '.join(finding.axes)}", *parameters(finding)])
    return f"<Finding {found}; {gain_of(finding)}>"
