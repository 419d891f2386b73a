"""Stories of critiques, in sentences for people."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from allanjax.base.plain import printable
from allanjax.base.wording import duration, plain
from allanjax.critic.finding import Discrepancy, Finding
from allanjax.critic.result import AxisCritique, Critique
from allanjax.estimate.result import LIMIT
from allanjax.record.recording import Axis
from allanjax.report.critique_summary import MOST, amplitudes, coefficient, in_one_line
from allanjax.report.critique_words import (
    describe,
    factor_off,
    gain_of,
    nats,
    p_value,
    parameters,
    percent,
    significance,
    what,
    wrap,
)

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
