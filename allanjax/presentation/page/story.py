"""The critic's story on a page: each finding with its evidence, before and after."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from allanjax.allan.deviation import rate_unit
from allanjax.critic.finding import UNEXPLAINED, Finding
from allanjax.critic.profiles import Curve, summaries
from allanjax.critic.result import AxisCritique, Critique
from allanjax.critic.stage import Stage
from allanjax.presentation import critique_story as story
from allanjax.presentation.page.blocks import Block, Chart, Fold, Table, Text, Trace, View
from allanjax.presentation.page.charts import thinned
from allanjax.record.units import SI, rate_unit_of
from allanjax.spectrum.psd import density_unit

# Blocks of the record in the evidence of a finding, and most findings that are open at first.
_BLOCKS, _OPEN = 300, 1


def headline(critique: Critique) -> Text:
    """How many findings there are, and what they gain."""
    return Text(f"Critic: {story.headline(critique)}.", "note")


def findings_in_full(critique: Critique) -> Iterator[Block]:
    """The table of findings, each finding with its evidence, and what is left in each axis."""
    if causes := story.causes_of(critique.findings):
        yield Table.of(story.findings_columns(critique, causes), "Findings, those that change most first")
    for k, finding in enumerate(critique.findings):
        name = "unexplained" if finding.cause == UNEXPLAINED else finding.named(finding.cause)
        title = f"{k + 1}. {name}: {', '.join(finding.axes)}"
        texts = [Text(story.sentence(finding))]
        if changes := "; ".join(story.changes(finding, critique[finding.shown].axis)):
            texts.append(Text(f"Changes: {changes}."))
        yield Fold(title, [*texts, *_evidence(critique, finding)], is_open=k < _OPEN)
    yield from (Text(line, "note") for line in story.axis_lines(critique, brief=False))


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
    unit = SI[axis.axis.sensor]["rate"]
    kinds = (
        (("Allan deviation σ(τ)", "cluster time τ", "s", "σ"), (rate_unit(axis.axis), (unit, 1.0))),
        (("PSD S(f)", "frequency f", "Hz", "S"), (density_unit(axis.axis), (f"({unit})²/Hz", 1.0))),
    )
    views = [
        _compared(labels, units, groups, [of[k] for of in found]) for k, (labels, units) in enumerate(kinds)
    ]
    if finding.domain == "frequency":
        views.reverse()
    elif before is not after:
        views.insert(0, _effect(axis, before, after))
    yield Chart(f"{axis.axis.name}: record and 95 % of simulations", views)


def _compared(
    labels: tuple[str, str, str, str],
    units: Sequence[tuple[str, float]],
    groups: Sequence[str],
    found: Sequence[Curve],
) -> View:
    """Measured curves over the bands of their simulations."""
    traces = []
    for group, c in enumerate(found):
        traces.append(Trace(group, "simulated", c.place, c.median, c.low, c.high, look="line"))
        traces.append(Trace(group, "measured", c.place, c.measured))
    return View(*labels, units=units, groups=groups, traces=traces, interval="95 % of simulations")


def _effect(axis: AxisCritique, before: Stage, after: Stage) -> View:
    """The record over time and what the finding subtracts from it."""
    traces = []
    for group, x in enumerate((before.x, before.x - after.x)):
        s = thinned(x, before.rate, _BLOCKS)
        low, high = (s.low, s.high) if group == 0 else (None, None)
        traces.append(Trace(group, "mean of blocks", s.time, s.mean, low, high, look="line"))
    units = (rate_unit_of(axis.axis.unit, axis.axis.sensor), (SI[axis.axis.sensor]["rate"], 1.0))
    labels = ("Over time", "time", "s", "samples − mean")
    return View(
        *labels, units=units, groups=["record", "effect"], traces=traces, log="", interval="least … largest"
    )
