"""The critic's story on a page: each finding with its evidence, with it and without it."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from allanjax.critic.finding import UNEXPLAINED, Finding
from allanjax.critic.profiles import Curve, summaries
from allanjax.critic.result import AxisCritique, Critique
from allanjax.critic.stage import Stage
from allanjax.estimate.result import Fit
from allanjax.presentation import critique_story as story
from allanjax.presentation.page.blocks import Block, Chart, Fold, Table, Text, Trace, View, texts
from allanjax.presentation.page.charts import allan, line, over, psd, thinned
from allanjax.record.units import unit_scale

# Blocks of the record in the evidence of a finding, and most findings that are open at first.
_BLOCKS, _OPEN = 300, 1
# Causes from outside the sensor that disturb a whole record.
_OUTSIDE = ("sinusoid", "saturation", "temperature", "telegraph", "common_mode")


def in_words(critique: Critique, fit: Fit) -> tuple[list[str], list[str]]:
    """Disturbances that were found, and properties of the sensor, such as filters, in words."""
    disturbed, also = list[str](), list[str]()
    for f in critique.findings:
        if f.cause != UNEXPLAINED and not f.is_weak:
            is_disturbance = f.is_event or f.cause in _OUTSIDE
            (disturbed if is_disturbance else also).append(_told(f, critique, fit))
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
    told = story.lists(critique)
    weak = told.pop("")
    for heading, findings in told.items():
        if findings:
            yield Table.of(story.findings_columns(critique, findings), heading)
    if weak:
        yield Text(story.weaker(weak))
    for k, finding in enumerate(critique.findings):
        name = "unexplained" if finding.cause == UNEXPLAINED else finding.named(finding.cause)
        title = f"{k + 1}. {name}: {', '.join(finding.axes)}"
        blocks: list[Block] = [Text(story.sentence(finding)), *_evidence(critique, finding)]
        yield Fold(title, blocks, is_open=k < _OPEN)
    yield from texts(story.axis_lines(critique, brief=False), "note")


def _evidence(critique: Critique, finding: Finding) -> Iterator[Chart]:
    """Record and simulations without a finding and with all, in the axis in which it matters most."""
    axis = critique[finding.shown]
    own = next((f for f in (finding, finding.strongest) if f in axis.findings), None)
    if own is None:
        return
    after = axis.stages[-1]
    before, stages = after, {"record": after}
    if own.stage >= 0:
        before = axis.stages[own.stage]
        stages = {"without it": before, "with all findings": after}
    found = [summaries(stage) for stage in stages.values()]
    for stage in stages.values():
        stage.forget()
    labels = allan(axis.axis), psd(axis.axis)
    views = [_compared([*stages], *kind) for kind in zip(zip(*found, strict=True), labels, strict=True)]
    if finding.domain == "frequency":
        views.reverse()
    elif not before.same_record(after):
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
