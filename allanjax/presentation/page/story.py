"""The critic's story on a page: each finding with its evidence, before and after."""

from __future__ import annotations

import dataclasses
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
from allanjax.presentation.page.blocks import Block, Chart, Fold, Table, Text, Trace, View, texts
from allanjax.presentation.page.charts import allan, line, over, psd, thinned
from allanjax.record.units import Sensor, unit_scale

# Blocks of the record in the evidence of a finding, and most findings that are open at first.
_BLOCKS, _OPEN = 300, 1
# Causes that disturb a record; others, such as filters, are properties of the sensor.
_DISTURBANCES = (
    "sinusoid",
    "bias_step",
    "outliers",
    "event",
    "disturbance",
    "saturation",
    "variance_change",
    "slow_change",
    "warm_up",
    "temperature",
    "telegraph",
    "common_mode",
)


def in_words(critique: Critique, fit: Fit) -> tuple[list[str], list[str]]:
    """Disturbances that were found, and properties of the sensor, such as filters, in words."""
    disturbed, also = list[str](), list[str]()
    for f in critique.findings:
        if f.cause != UNEXPLAINED:
            (disturbed if f.cause in _DISTURBANCES else also).append(_told(f, critique, fit))
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
    causes = story.causes_of(critique.findings)
    if causes:
        columns = [c for c in story.findings_columns(critique, causes) if c.head != "nats"]
        yield Table.of(columns, "Findings, those that change most first")
    for k, finding in enumerate(critique.findings):
        name = "unexplained" if finding.cause == UNEXPLAINED else finding.named(finding.cause)
        title = f"{k + 1}. {name}: {', '.join(finding.axes)}"
        blocks: list[Block] = [Text(story.sentence(finding))]
        rows = [*_changed(finding, critique[finding.shown].axis.sensor)]
        if rows:
            blocks.append(Table.of_texts(("", "before", "after"), rows))
        yield Fold(title, [*blocks, *_evidence(critique, finding)], is_open=k < _OPEN)
    yield from texts(story.axis_lines(critique, brief=False), "note")


def _changed(finding: Finding, sensor: Sensor) -> Iterator[list[str]]:
    """Coefficients and the drift of simulations before and after a finding, if these differ."""
    changes: dict[str, Any] = {title_of(c.label, sensor): c for c in finding.coefficients}
    if finding.drift is not None:
        changes[f"simulated drift over {duration(finding.drift.horizon)}"] = finding.drift
    for title, c in changes.items():
        if story.notable(c.before, c.after):
            values = (c.before, c.after)
            yield [title, *(f"{plain(x, 3)} {c.unit}" if isfinite(x) else "none" for x in values)]


def _evidence(critique: Critique, finding: Finding) -> Iterator[Chart]:
    """Record and simulations before and after a finding, in the axis in which it matters most."""
    axis = critique[finding.shown]
    own = next((f for f in (finding, finding.strongest) if f in axis.findings), None)
    if own is None:
        return
    before, after = (axis.stages[k % len(axis.stages)] for k in own.stages)
    stages = {"before": before, "after": after} if before is not after else {"record": before}
    found = [summaries(stage) for stage in stages.values()]
    for stage in stages.values():
        stage.forget()
    labels = allan(axis.axis), psd(axis.axis)
    views = [_compared([*stages], *kind) for kind in zip(zip(*found, strict=True), labels, strict=True)]
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
    record = thinned(0, before.x, before.rate, _BLOCKS)
    effect = thinned(1, before.x - after.x, before.rate, _BLOCKS)
    traces = [record, dataclasses.replace(effect, low=None, high=None)]
    return View(groups=["record", "effect"], traces=traces, **over(axis.axis, "Over time"))
