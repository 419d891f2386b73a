"""The critic's story on a page: each finding with its evidence, before and after."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from math import isfinite
from typing import Any

from allanjax.base.wording import duration, plain
from allanjax.critic.finding import UNEXPLAINED, Finding
from allanjax.critic.profiles import Curve, summaries
from allanjax.critic.result import AxisCritique, Critique
from allanjax.critic.stage import Stage
from allanjax.estimate.result import Fit
from allanjax.noise.estimate import title_of
from allanjax.presentation import critique_story as story
from allanjax.presentation.page.blocks import Block, Cell, Chart, Fold, Table, Text, Trace, View
from allanjax.presentation.page.charts import allan, line, over, psd, thinned
from allanjax.record.units import Sensor, unit_scale

# Blocks of the record in the evidence of a finding, and most findings that are open at first.
_BLOCKS, _OPEN = 300, 1
# Causes that disturb a record; others, such as filters, are properties of the sensor.
_DISTURBANCES = (
    *("sinusoid", "bias_step", "outliers", "event", "disturbance", "saturation", "variance_change"),
    *("slow_change", "warm_up", "temperature", "telegraph", "common_mode"),
)


def in_words(critique: Critique, fit: Fit) -> tuple[list[str], list[str]]:
    """Disturbances that were found, and properties of the sensor, such as filters, in words."""
    told = [
        (f.cause in _DISTURBANCES, _told(f, critique, fit))
        for f in critique.findings
        if f.cause != UNEXPLAINED
    ]
    disturbed, also = ([text for is_one, text in told if is_one is wanted] for wanted in (True, False))
    return disturbed, also


def _told(finding: Finding, critique: Critique, fit: Fit) -> str:
    """A finding as a customer reads it, e.g. "a bias step of 2.04 mg at 600 s on accel_y"."""
    own, frequency = finding.amplitudes.get(finding.shown), finding.parameters.get("frequency")
    axes = "all axes" if len(finding.axes) == len(critique) > 2 else story.names_of(finding.axes)
    if finding.cause == "sinusoid" and own and frequency and fit[finding.shown].converged:
        amplitude = own.value * unit_scale(own.unit, own.axis.sensor)
        return line(frequency.value, axes, amplitude, fit[finding.shown])
    name, size = finding.named(finding.cause), story.size(finding)
    place = story.place(finding).partition(", ")[0]
    article = "an " if name[0] in "aeiou" else "a "
    if name.endswith(("s", "noise")):
        article = ""
    of = "" if size == story.NONE else f" of {size}"
    at = f" at {place}" if place[0].isdigit() else f" ({place})"
    return f"{article}{name}{of}{at} on {axes}"


def findings_in_full(critique: Critique) -> Iterator[Block]:
    """The table of findings, each finding with its evidence, and what is left in each axis."""
    if causes := story.causes_of(critique.findings):
        columns = [c for c in story.findings_columns(critique, causes) if c.head != "nats"]
        yield Table.of(columns, "Findings, those that change most first")
    for k, finding in enumerate(critique.findings):
        name = "unexplained" if finding.cause == UNEXPLAINED else finding.named(finding.cause)
        title = f"{k + 1}. {name}: {', '.join(finding.axes)}"
        rows = [*_changed(finding, critique[finding.shown].axis.sensor)]
        tables = [Table([*map(Cell, ("", "before", "after"))], rows)] if rows else []
        blocks: list[Block] = [Text(story.sentence(finding)), *tables, *_evidence(critique, finding)]
        yield Fold(title, blocks, is_open=k < _OPEN)
    yield from (Text(line, "note") for line in story.axis_lines(critique, brief=False))


def _changed(finding: Finding, sensor: Sensor) -> Iterator[list[Cell]]:
    """Coefficients and the drift of simulations before and after a finding, if these differ."""
    changes: dict[str, Any] = {title_of(c.label, sensor): c for c in finding.coefficients}
    if (drift := finding.drift) is not None:
        changes[f"simulated drift over {duration(drift.horizon)}"] = drift
    for title, c in changes.items():
        if story.notable(c.before, c.after):
            texts = [f"{plain(x, 3)} {c.unit}" if isfinite(x) else "none" for x in (c.before, c.after)]
            yield [*map(Cell, (title, *texts))]


def _evidence(critique: Critique, finding: Finding) -> Iterator[Chart]:
    """Record and simulations before and after a finding, in the axis in which it matters most."""
    axis = critique[finding.shown]
    own = next((f for f in (finding, finding.strongest) if f in axis.findings), None)
    if own is None:
        return
    before, after = (axis.stages[k % len(axis.stages)] for k in own.stages)
    pairs = [("before", before), ("after", after)] if before is not after else [("record", before)]
    groups = [name for name, _ in pairs]
    found = [summaries(stage) for _, stage in pairs]
    for _, stage in pairs:
        stage.forget()
    kinds = enumerate((allan(axis.axis), psd(axis.axis)))
    views = [_compared(groups, [of[k] for of in found], labels) for k, labels in kinds]
    if finding.domain == "frequency":
        views.reverse()
    elif before is not after:
        views.insert(0, _effect(axis, before, after))
    yield Chart(f"{axis.axis.name}: record and 95 % of simulations", views)


def _compared(groups: Sequence[str], found: Sequence[Curve], labels: Mapping[str, Any]) -> View:
    """Measured curves over the bands of their simulations."""
    traces = []
    for group, c in enumerate(found):
        traces.append(Trace(group, "simulated", c.place, c.median, c.low, c.high, look="line"))
        look = "rings" if group < len(found) - 1 else "dots"
        traces.append(Trace(group, "measured", c.place, c.measured, look=look))
    return View(groups=groups, traces=traces, interval="95 % of simulations", **labels)


def _effect(axis: AxisCritique, before: Stage, after: Stage) -> View:
    """The record over time and what the finding subtracts from it."""
    traces = []
    for group, x in enumerate((before.x, before.x - after.x)):
        s = thinned(x, before.rate, _BLOCKS)
        low, high = (s.low, s.high) if group == 0 else (None, None)
        traces.append(Trace(group, "mean of blocks", s.time, s.mean, low, high, look="line"))
    more = over(axis.axis, "Over time") | {"log": "", "interval": "least … largest"}
    return View(groups=["record", "effect"], traces=traces, **more)
