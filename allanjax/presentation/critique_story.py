"""What a critique says, for people: what the sensor is and what happened, in tables and in full.

Each finding is told by what it alone changes, and not by an order in which things were found.
"""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from allanjax.base.tables import Column, as_text, columns_from, printable, wrapped
from allanjax.base.wording import (
    format_p_value,
    format_with_error,
    percent,
    plain,
    without_error,
)
from allanjax.critic.comparison import DOMAINS
from allanjax.critic.finding import (
    NOTABLE,
    TELLING,
    UNEXPLAINED,
    Detail,
    Discrepancy,
    Finding,
    numbers_in,
    side_of_limit,
    values_of,
)
from allanjax.critic.result import AxisCritique, Critique
from allanjax.estimate.misfit import LIMIT
from allanjax.noise.estimate import Estimate

# Statistics in words. Of those with `off`, the two values compare as a ratio.
_STATISTICS = {
    "allan_deviation": "simulated Allan deviation is {off} at τ = {place}",
    "drift": "simulated drift is {off} over {place}",
    "psd": "simulated PSD is {off} at {place}",
    "window_variance": "simulated noise power is {off} around {place}",
    "psd_line": "spectral line of {measured} at {place} ({simulated} in simulations)",
    "autocorrelation": "residuals that are {place} apart are correlated ({measured})",
    "skewness": "residuals are not distributed symmetrically (skewness {measured})",
    "tails": "residuals have {more} large values than normal noise (excess kurtosis {measured})",
    "largest_residual": "largest residual of {measured} at {place} ({simulated} in simulations)",
    "lattice": "all samples are multiples of one step",
    "repeated_values": "{measured} of the samples repeat the previous one ({simulated} in simulations)",
    "window_mean": "the mean of the residuals is {measured} around {place}",
    "cross_correlation": "residuals are correlated with those of {channel} ({measured})",
    "auxiliary_correlation": "{measured} rms of the samples follow {channel} ({simulated} by chance)",
}
# Values of a list that are shown; length from which on none is; and details that are never shown.
_SHOWN, _LONGEST, _OMITTED = 3, 20, frozenset({"axes", "sizes"})
# Details that are words, and what stands before these.
_LABELS = {"seen_as": "detected as", "noise": "affected noise:"}
# Errors below this share of a value are not shown: they are those of arithmetic, or of a file's digits.
_EXACT = 1e-5
# Parameters that are whole numbers.
_COUNTS = frozenset({"count", "jumps", "order", "longest"})
# Parameters that are values of samples, and are given in the samples' unit.
_AS_RECORDED = frozenset({"step", "upper_level", "lower_level"})
# Words before a limit, if not its side.
_BEYOND = {
    **{label: {"below": "at or before", "above": "at or after"} for label in ("start", "end", "time")},
    **{label: {"below": "at most", "above": "at least"} for label in _COUNTS},
}
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

# --- Numbers and statistics in words ------------------------------------------------------------------------


def parameters(finding: Finding) -> list[str]:
    """Parameters and details in words, e.g. "frequency 0.55200 ± 0.00010 Hz"."""
    texts = [f"{name.replace('_', ' ')} {amount(e)}" for name, e in finding.parameters.items()]
    for name, detail in finding.details.items():
        # The axes stand before the finding, and of a long list the count is among the parameters.
        if name not in _OMITTED and len(values_of(detail)[0]) <= _LONGEST:
            label, text = _LABELS.get(name, name.replace("_", " ")), several(detail)
            texts.append(f"{label} {text.replace('_', ' ') if name in _LABELS else text}")
    return texts


def significance(finding: Finding) -> str:
    """How improbable a finding is by chance: a p-value where there is a test, else the odds."""
    if finding.p_value is not None:
        return format_p_value(finding.p_value)
    if (odds := finding.odds) is None:
        measured = any(f.gain is not None for f in (finding, *finding.members))
        return "" if measured else "visible directly in the samples"
    # Larger odds overflow.
    return f"odds {plain(odds, 2) if odds < np.exp(700.0) else 'above 10³⁰⁰'} : 1"


def gain_of(finding: Finding) -> str:
    """Gain of a finding in words, e.g. "gain of 1,234 nats on held-out data"."""
    if finding.gain is not None:
        return f"gain of {nats(finding.gain)} on held-out data"
    if any(member.gain is not None for member in finding.members):
        return "gain included in that of the other outliers of its axes"
    return "no gain: it cannot be tested on held-out data"


def nats(gain: float) -> str:
    """Gain with its unit, e.g. "1,234 nats"."""
    return f"{gain:,.0f} nats" if abs(gain) >= 10.0 else f"{gain:.1f} nats"


def amount(e: Estimate) -> str:
    """Value, error and unit of a finding's parameter; counts are whole, shares in per cent."""
    limit, (value, std, unit) = side_of_limit(e), _suited(e)
    if e.label in _COUNTS and np.isfinite(value):
        text = f"{round(value):,}"
    elif limit or e.label == "fraction":
        text = plain(value, 3)
    elif std > _EXACT * abs(value):
        text = format_with_error(value, std)
    else:
        text = plain(value, 6 if std > 0.0 else 4)
    words = _BEYOND.get(e.label, {}).get(limit, limit)
    return f"{words} {_with(unit, text)}".lstrip()


def _suited(e: Estimate) -> tuple[float, float, str]:
    """Value and error in the unit in which they are shown, and that: of values of samples the record's."""
    unit, factor = (e.unit, 1.0) if e.label in _AS_RECORDED else suited(e.unit, e.value)
    if e.label == "fraction":
        unit, factor = "%", 100.0
    return factor * e.value, factor * e.std, unit


def _with(unit: str, number: str) -> str:
    """Number with its unit; a ratio has none."""
    return number if unit in ("", "1") else f"{number} {unit}"


def several(detail: Detail) -> str:
    """Words or a list of numbers with their unit, cut short."""
    values, _, unit = values_of(detail)
    numbers = [v for v in values if not isinstance(v, str)]
    unit, factor = suited(unit, max(numbers, key=abs, default=0.0))
    shown = [v if isinstance(v, str) else plain(factor * v, 4) for v in values[:_SHOWN]]
    more = f", … ({len(values)} in all)" if len(values) > _SHOWN else ""
    return _with(unit, ", ".join(shown)) + more


def suited(unit: str, value: float) -> tuple[str, float]:
    """Unit in which a small value is easy to read, and the factor to it."""
    # Without what it is per: a unit of a channel, or a root.
    base = re.split(r"/[\[√]", unit)[0]
    name, factor = base, 1.0
    for finer, times in _FINER.get(base, ()):
        if not 0.0 < factor * abs(value) < _SMALL:
            break
        name, factor = finer, times
    return name + unit[len(base) :], factor


def describe(d: Discrepancy) -> str:
    """Discrepancy in words, e.g. "simulated Allan deviation is 38 % low at τ = 0.7 s (p = 1×10⁻³⁰)"."""
    return f"{what(d)} ({format_p_value(d.p_value)})"


def what(d: Discrepancy) -> str:
    """Discrepancy in words, without its p-value."""
    unit, factor = suited(d.unit, d.measured)
    if d.statistic == "repeated_values":
        unit, factor = "%", 100.0
    measured, simulated = (_with(unit, plain(factor * x, 2)) for x in (d.measured, d.simulated))
    words = {"measured": measured, "simulated": simulated, "off": factor_off(d.size), "channel": d.channel}
    more = "more" if d.measured > 0.0 else "fewer"
    place = _with(d.where_unit, plain(d.where, 3))
    return _STATISTICS[d.statistic].format(**words, place=place, more=more)


def factor_off(size: float) -> str:
    """Relative error in words, e.g. "38 % low"; a large one as a factor."""
    if not np.isfinite(size):
        return "wrong"
    if size > 2.0:
        return f"{plain(1.0 + size, 2)} times too high"
    if size < -0.95:
        return f"{plain(1.0 / max(1.0 + size, 1e-300), 2)} times too low"
    return f"{percent(abs(size))} {'low' if size < 0.0 else 'high'}"


# --- The table of findings ----------------------------------------------------------------------------------

#: Most findings that a table of a printed critique lists.
MOST = 10
_HEADINGS = ("#", "what", "axes", "where", "size", "of the Allan variance", "nats")
# An empty cell of the table, and the place of what has no other.
NONE, _EVERYWHERE = "–", "whole record"
# Parameters that are the place of an effect, the first that a finding has, and what stands around each.
_WHERE = {
    **dict.fromkeys(("frequency", "bandwidth", "time"), "{}"),
    "time_constant": "T = {}",
    "count": "{} samples",
    "exponent": "α = {}",
    "correlation_time": "T = {}",
    "dwell_time": "T = {}",
}
# Signs of a parameter of which only a limit is known.
_LIMIT = {"above": "> ", "below": "< ", "": ""}


def findings_columns(critique: Critique, findings: Sequence[Finding]) -> list[Column]:
    """Table with a row for each of these findings, numbered as in the critique."""
    number = {id(f): str(k) for k, f in enumerate(critique.findings, 1)}
    return columns_from(_HEADINGS, [(number[id(f)], *_row(f, critique)) for f in findings])


def lists(critique: Critique) -> dict[str, list[Finding]]:
    """Findings by the heading of their table; those under "" are weak and share one line."""
    causes = causes_of(critique.findings)
    weak = [f for f in causes if f.is_weak]
    # One line is no shorter than another.
    weak = weak if len(weak) > 1 else []
    told = [f for f in causes if not any(f is other for other in weak)]
    return {
        "What the sensor is": [f for f in told if not f.is_event],
        "What happened": [f for f in told if f.is_event],
        "": weak,
    }


def weaker(findings: Sequence[Finding]) -> str:
    """Weak findings in a line, e.g. "and 2 weaker resonances: each below 2 % …"; "" for none."""
    if not findings:
        return ""
    count = Counter(f.named(f.cause) for f in findings)
    names = ", ".join(f"{k} {name}{'s' if k > 1 and name[-1] != 's' else ''}" for name, k in count.items())
    least = f"less than {percent(NOTABLE)} of the Allan variance and {TELLING:.0f} nats each"
    return f"and {names}, {least}: details()"


def _row(finding: Finding, critique: Critique) -> tuple[str, ...]:
    """Cells of a finding in the table, but for its number."""
    like = _likeness(finding)
    return (
        f"unexplained ({like[0]}?)" if like else finding.named(finding.cause),
        "all" if len(finding.axes) == len(critique) > 2 else names_of(finding.axes),
        place(finding),
        size(finding),
        share(finding),
        NONE if finding.gain is None else nats(finding.gain).removesuffix(" nats"),
    )


def place(finding: Finding) -> str:
    """Where a finding is, in time or frequency, e.g. "7.3 Hz, × 2, × 3" or "12.5 … 14 s"."""
    if ends := _ends(finding):
        return ends
    if isinstance(channel := finding.details.get("channel"), str):
        return channel
    e = next((finding.parameters[label] for label in _WHERE if label in finding.parameters), None)
    if e is None:
        return _EVERYWHERE
    text = _with(e.unit, plain(e.value, 6 if e.label == "count" else 4))
    places = [_LIMIT[side_of_limit(e)] + _WHERE[e.label].format(text)]
    for name, sign in (("harmonics", "× "), ("further_frequencies", "")):
        places += [f"{sign}{plain(x, 4)}" for x in numbers_in(finding.details, name)]
    return ", ".join([*places[:_SHOWN], "…"] if len(places) > _SHOWN else places)


def _ends(finding: Finding) -> str:
    """Part of the record or of the spectrum that a finding is in; "" if it has no ends."""
    for names in (("start", "end"), ("lowest", "highest")):
        ends = [finding.parameters[name] for name in names if name in finding.parameters]
        if len(ends) == 2:
            return f"{plain(ends[0].value, 4)} … {plain(ends[1].value, 4)} {ends[0].unit}"
    return ""


def size(finding: Finding) -> str:
    """How large a finding is in the most affected axis, with the digits that its error bears."""
    if (r := finding.parameters.get("correlation")) is not None:
        return f"r = {_short(r)}"
    e = finding.amplitudes.get(finding.shown)
    # The bandwidth of a filter is its place.
    return NONE if e is None or e.label == "bandwidth" else re.sub(r"/\[.*\]", " per unit", _short(e))


def share(finding: Finding) -> str:
    """Largest share of the Allan variance, e.g. "48 % at 1 s"; a filter takes some off: "−43 % at 0.01 s"."""
    change = finding.change
    if change is None:
        return NONE
    if change.size < NOTABLE:
        return f"< {percent(NOTABLE)}"
    sign = "−" if change.share < 0.0 else ""
    return f"{sign}{percent(change.size)} at {plain(change.time, 2)} s"


def names_of(axes: Iterable[str]) -> str:
    """Names of axes, those of one sensor together, e.g. "accel_xyz"."""
    words: list[str] = []
    for sensor, group in itertools.groupby(axes, lambda axis: axis.rpartition("_")[0]):
        same = [*group]
        own = [axis.removeprefix(f"{sensor}_") for axis in same]
        words += [f"{sensor}_{''.join(own)}"] if sensor and {*map(len, own)} == {1} else same
    return ", ".join(words)


def _short(e: Estimate) -> str:
    """Value of a parameter with the digits that its error bears, four at most, but without the error."""
    value, std, unit = _suited(e)
    known = std > _EXACT * abs(value)
    text = without_error(value, max(std, 0.01 * abs(value))) if known else plain(value, 3)
    return f"{_LIMIT[side_of_limit(e)]}{'× ' if e.label == 'ratio' else ''}{_with(unit, text)}"


# --- A line for each axis -----------------------------------------------------------------------------------

#: Largest p-value of a discrepancy that is reported: of some fourteen per axis, a few are small by chance. A
#: judgement.
SIGNIFICANT = 1e-4
# The best-known statistic.
_KNOWN = "allan_deviation"
_BETWEEN = DOMAINS["channels"]
# Most failed tests of an axis that are described in full.
_MOST_TESTS = 3


def story(critique: Critique) -> str:
    """Tables of what the sensor is and of what happened, a line for each axis, warnings and notes."""
    lines, told = [wrapped(headline(critique))], lists(critique)
    weak = told.pop("")
    for heading, findings in told.items():
        if findings:
            table = as_text("", [findings_columns(critique, findings[:MOST])])
            lines += ["", heading, table]
        if len(findings) > MOST:
            lines.append(f"and {len(findings) - MOST} more: details()")
    if weak:
        lines += ["", wrapped(weaker(weak))]
    if any(told.values()):
        lines += ["", wrapped(_about(critique))]
    return printable("\n".join([*lines, "", *_end(critique, brief=True)]))


def _about(critique: Critique) -> str:
    """What the columns of the tables are."""
    about = (
        "of the Allan variance: largest share that it alone adds, or takes off (−), the rest held; nats: "
        f"log-likelihood gained on held-out data; {NONE}: not applicable"
    )
    return f"size: of the most affected axis; {about}" if len(critique) > 1 else about


def details(critique: Critique) -> str:
    """A paragraph for each finding, one for each axis, all warnings and notes."""
    lines = [wrapped(headline(critique))]
    for k, finding in enumerate(critique.findings, 1):
        lines += ["", wrapped(f"{k}. {sentence(finding)}")]
    return "\n".join([*lines, "", *_end(critique, brief=False)])


def causes_of(findings: Iterable[Finding]) -> list[Finding]:
    """Findings with a cause, and those without one that the extended model describes."""
    return [f for f in findings if f.cause != UNEXPLAINED or _likeness(f)]


def _likeness(finding: Finding) -> list[str]:
    """Usual names of the causes that an unexplained finding resembles."""
    causes = finding.details.get("resembles", ())
    return [finding.named(cause) for cause in causes if isinstance(cause, str)]


def headline(critique: Critique) -> str:
    """How many findings there are, and what they gain together."""
    causes = causes_of(critique.findings)
    count = f"{len(causes) or 'no'} finding{'' if len(causes) == 1 else 's'}"
    left = len(critique.findings) - len(causes)
    axes = "1 axis" if len(critique) == 1 else f"{len(critique)} axes"
    # Nothing of what was found may be of the kind that can be held out.
    gain = f"; total gain {nats(critique.gain)} on held-out data" if causes and critique.gain else ""
    more = f"; {left} discrepanc{'y' if left == 1 else 'ies'} unexplained" if left else ""
    return f"{critique.name or 'recording'}: {count} in {axes}{gain}{more}"


def axis_lines(critique: Critique, brief: bool) -> list[str]:
    """How well each axis is simulated now, and axes that were not compared."""
    shared = {name for f in critique.shared_findings for name in f.axes}
    lines = [_verdict(axis, shared, brief) for axis in critique.results]
    return lines + [f"{dead.axis.name}: not compared: {dead.reason}" for dead in critique.dead]


def _end(critique: Critique, brief: bool) -> list[str]:
    """Lines of the axes, warnings and notes."""
    remarks = [f"warning: {text}" for text in (*critique.warnings, *unmeasured(critique))]
    notes = critique.notes[:1] if brief else critique.notes
    remarks += [f"note: {note}" for note in notes]
    if more := len(critique.notes) - len(notes):
        remarks.append(f"and {more} more note{'s' if more > 1 else ''}: see details() or the JSON file")
    lines = axis_lines(critique, brief)
    return [*map(wrapped, lines), *([""] if remarks else []), *map(wrapped, remarks)]


def _verdict(axis: AxisCritique, shared: set[str], brief: bool) -> str:
    """Which tests of an axis fail with all that was found in it, and how."""
    name, count = axis.axis.name, len(axis.before)
    causes, before = causes_of(axis.findings), _failed(axis.before)
    after = _failed(axis.after) if causes else before
    # What axes have in common is among the findings.
    own = [d for d in after if not (name in shared and d.statistic in _BETWEEN)]
    if after and not own:
        return f"{name}: the simulation reproduces the record except for the noise that axes share"
    if not own:
        smallest = min((d.p_value for d in axis.before), default=1.0)
        then = f"after the findings ({len(before) or 'none'} failed before)"
        then = then if causes else f"(smallest p-value {plain(smallest, 2)})"
        return f"{name}: the simulation reproduces the record in all {count} tests {then}"
    tests = f"{len(own)} of {count} tests {'fails' if len(own) == 1 else 'fail'}"
    then = f"after the findings{'' if brief else f' ({len(before)} before)'}"
    shown = own[: 1 if brief else _MOST_TESTS]
    words = "; ".join(map(what if brief else describe, shown))
    bare = [f for f in axis.findings if f not in causes]
    if brief and bare:
        worst, rest = min(((f, f.rest) for f in bare if f.rest), key=lambda pair: pair[1].p_value)
        words = f"{_where(worst)}: {what(rest)}"
    more = f"; and {len(own) - len(shown)} more" if len(own) > len(shown) else ""
    return f"{name}: {tests} {then if causes else 'and no cause was found'}: {words}{more}"


def _failed(tests: Iterable[Discrepancy]) -> list[Discrepancy]:
    """Significant discrepancies, the least probable one first."""
    return sorted((d for d in tests if d.p_value < SIGNIFICANT), key=lambda d: d.p_value)


def unmeasured(critique: Critique) -> tuple[str, ...]:
    """Warnings about axes whose plain model does not fit and whose findings leave something, and a remedy."""
    warnings = []
    for axis in (axis for axis in critique.results if axis.misfit is not None and axis.misfit.excessive):
        if not _failed(axis.after):
            continue
        left = [d.size for d in axis.after if d.statistic == _KNOWN and d.p_value < SIGNIFICANT]
        # Whether what is left is beyond what coefficients may have, in either direction.
        far = any(not abs(np.log(max(1.0 + x, 1e-300))) < np.log(1.0 + LIMIT) for x in left)
        then = (
            "the findings do not explain why, so that no coefficients describe the sensor; leave out what "
            "was not at rest (--start, --stop), or see the figures"
            if far
            else "use the coefficients of critique.refit() (--refit)"
        )
        warnings.append(f"{axis.axis.name}: the plain model does not fit the data: {axis.misfit}; {then}")
    return tuple(warnings)


# Where an unexplained discrepancy shows, and what to look at next.
_DOMAINS = {
    "spectrum": (
        "in the spectrum",
        "Compare the spectra of other axes and units there: interference, a filter or a mount.",
    ),
    "level": ("in the level of the noise over time", "Compare it with temperature, supply and motion."),
    "values": (
        "in the distribution of the values",
        "See the histogram of the samples: nonlinearity or missing codes of the converter.",
    ),
    "bias": ("in the bias over time", "See the record there, and repeat the recording."),
    "channels": ("in common with another channel", "See both channels: a coupling, or a common cause."),
}
# The same if the values are outliers of some kind.
_OF_OUTLIERS = "See the record at these times: shocks or interference."

# --- A finding in full --------------------------------------------------------------------------------------


def sentence(finding: Finding) -> str:
    """A finding in words: axes, cause and parameters, what it alone changes, its gain, and its rivals."""
    axes = ", ".join(finding.axes)
    if finding.cause == UNEXPLAINED:
        return _without_a_cause(finding)
    cause = ", ".join([f"{axes}: {finding.named(finding.cause)}", *parameters(finding)])
    if finding.members and (sizes := finding.amplitudes):
        each = (f"{axis} {_short(e)}{f' ({e.remark})' if e.remark else ''}" for axis, e in sizes.items())
        cause += f"; {', '.join(each)}"
    test = significance(finding)
    text = f"{cause}{f' ({test})' if test else ''}; {gain_of(finding)}."
    changes = change_in_words(finding)
    if changes:
        where = f"In {finding.shown}, with the rest held," if len(finding.axes) > 1 else "With the rest held"
        text += f" {where} {changes}."
    if finding.rest is not None:
        text += f" Explained in part, as {describe(finding.rest)}."
    if finding.rivals:
        rivals = ", ".join(f"{finding.named(r.cause)} (odds 1 : {plain(r.odds, 2)})" for r in finding.rivals)
        text += f" Alternatives: {rivals}."
    return text


def change_in_words(finding: Finding) -> str:
    """What a finding alone changes, e.g. "it adds 48 % of the Allan variance at 1 s, 2 % or more …"."""
    change = finding.change
    if change is None:
        return ""
    least = percent(NOTABLE)
    text = f"it changes the Allan variance by less than {least}"
    if change.size >= NOTABLE:
        text = f"{_adds(change.share)} of the Allan variance at {plain(change.time, 2)} s"
        if change.last > change.first:
            text += f" ({least} or more from {plain(change.first, 2)} to {plain(change.last, 2)} s)"
    if finding.domain == "frequency" and abs(change.density) >= NOTABLE:
        joint = ", and " if change.size >= NOTABLE else "; "
        text += f"{joint}{_adds(change.density)} of the PSD around {plain(change.frequency, 3)} Hz"
    return text


def _adds(share: float) -> str:
    """A share that a finding adds, or takes off, in words."""
    return f"it {'adds' if share > 0.0 else 'takes off'} {percent(abs(share))}"


def _without_a_cause(finding: Finding) -> str:
    """What is known of something unexplained: where, how large, what it resembles, and where to look next."""
    amounts = f", {e.label} {amount(e)}" if (e := finding.size) else ""
    worst = finding.rest
    domain = str(finding.details["domain"])
    if worst is not None and worst.p_value < SIGNIFICANT:
        test = f": {f'in {finding.shown}, ' if finding.members else ''}{describe(worst)}"
    else:
        # A free level shows what windows of fixed lengths do not.
        test = f": it varies ({significance(finding)})" if domain == "level" else ""
    text = f"{', '.join(finding.axes)}: unexplained, {_where(finding, amounts)}{test}."
    if like := _likeness(finding):
        text += (
            f" The extended model describes it as {', '.join(like)} ({gain_of(finding)}), which is not "
            f"taken for its cause: {finding.details['reason']}."
        )
    return f"{text} {_OF_OUTLIERS if domain == 'values' and like else _DOMAINS[domain][1]}"


def _where(finding: Finding, more: str = "") -> str:
    """Where something unexplained shows, e.g. "in the spectrum (11 … 14 Hz)"."""
    return f"{_DOMAINS[str(finding.details['domain'])][0]} ({_ends(finding) or _EVERYWHERE}{more})"


def finding_text(finding: Finding) -> str:
    """The finding as standard output can show it, for `print`."""
    return printable(sentence(finding))


def finding_repr(finding: Finding) -> str:
    """Finding in one line: its cause, its parameters, its gain."""
    text = ", ".join([f"{finding.cause} in {' and '.join(finding.axes)}", *parameters(finding)])
    return f"<Finding {text}; {gain_of(finding)}>"
