"""Results of the critic: discrepancies, findings, and the extended model of every axis."""

from __future__ import annotations

import dataclasses
import functools
import html
import os
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from jaxtyping import Float, PRNGKeyArray

from allanjax.base.equality import ByValue
from allanjax.base.late import presented
from allanjax.base.tables import PerAxis
from allanjax.critic.finding import Detail, Discrepancy, Finding, merged, written
from allanjax.critic.stage import Stage
from allanjax.estimate.misfit import Misfit
from allanjax.estimate.result import Fit
from allanjax.inspection import inspect
from allanjax.inspection.facts import ordered, warnings_of
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model
from allanjax.noise.simulate import simulate_recording
from allanjax.noise.terms import BiasStep, DriftRamp, WarmUp
from allanjax.record.recording import Axis, DeadAxis, Recording

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


@dataclasses.dataclass(frozen=True, eq=False)
class AxisCritique(ByValue):
    """Critique of one axis.

    Attributes:
        axis: the axis.
        findings: what was found, each as it changes the final model alone.
        before, after: discrepancies of simulations of the baseline and of the extended model.
        tests: p-value of every cause's best candidate in the record before any finding.
        stages: the axis without any finding, without each of them in turn, and with all of them.
        baseline: the model from which the critique started.
        model: the extended model: noise terms and deterministic terms with their values.
        misfit: how far the baseline's curve is off, if it does not fit the data.
        left_out: causes that no model term describes, such as outliers.
        given: sum of the lines and other waveforms of a given model, which the stages are without [SI]; None
            if it has none.
    """

    axis: Axis
    findings: tuple[Finding, ...]
    before: tuple[Discrepancy, ...]
    after: tuple[Discrepancy, ...]
    tests: Mapping[str, float]
    stages: tuple[Stage, ...]
    baseline: Model
    model: Model
    misfit: Misfit | None = None
    left_out: tuple[str, ...] = ()
    given: Float[np.ndarray, " n"] | None = None

    def bias(self, rate: float) -> float:
        """Constant to add to samples of the extended model at `rate` [Hz] [SI]."""
        x = self.stages[0].x
        time = (np.arange(len(x)) + 0.5) / rate
        # Lines have no mean, and the effect of a channel is relative to its mean in the record.
        shifts = (
            getattr(term, term.amplitude_parameter().name) * float(np.mean(term.column(time)))
            for term in self.model.terms
            if isinstance(term, BiasStep | WarmUp | DriftRamp)
        )
        return float(np.mean(x)) - sum(shifts)

    def to_dataframe(self) -> pd.DataFrame:
        """The rows of `Critique.to_dataframe` for this axis."""
        return _table(self.findings)

    def __repr__(self) -> str:
        causes = ", ".join(f.cause for f in self.findings) or "no findings"
        terms = " + ".join(self.model.term_labels)
        return f"<AxisCritique {self.axis.name}: {causes};\n extended model {terms}>"


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Critique(ByValue, PerAxis[AxisCritique]):
    """Critique of a recording: the errors of its simulation, their causes, and the gain of a correction.

    Attributes:
        name: the recording's name.
        rate: its sample rate [Hz].
        fit: the baseline.
        results: critiques of the axes.
        shared_findings: findings of noise that several axes share.
        notes: notes for the user.
        dead: axes that could not be compared, and why.
    """

    name: str
    rate: float
    fit: Fit
    results: tuple[AxisCritique, ...]
    shared_findings: tuple[Finding, ...]
    notes: tuple[str, ...] = ()
    dead: tuple[DeadAxis, ...] = ()

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about the recording as a whole, the gravest first."""
        # Lines are among the findings.
        return warnings_of(fact for fact in self.fit.facts if fact.kind != "lines")

    @functools.cached_property
    def findings(self) -> tuple[Finding, ...]:
        """Findings of the recording, each cause once: what the sensor is, then what happened.

        Those that change most come first; see `Finding.members`.

        The `AxisCritique` of an axis has all its findings singly.
        """
        own = [f for axis in self.results for f in axis.findings]
        return merged(own, self.shared_findings, self.duration)

    @property
    def duration(self) -> float:
        """Length of the recording [s]."""
        return self.results[0].stages[0].n / self.rate if self.results else 0.0

    @property
    def models(self) -> dict[str, Model]:
        """The extended model of each axis."""
        return {a.axis.name: a.model for a in self.results}

    def simulate(
        self,
        key: PRNGKeyArray | int,
        *,
        n: int | None = None,
        auxiliary: Mapping[str, Float[np.ndarray, " n"]] | None = None,
    ) -> Recording:
        """Simulate the extended models with axes, rate, units, bias and phases of lines as recorded.

        Effects without a model term (outliers, rounding, noise that axes share) are left out, and so are
        effects of channels that are not given; the `notes` of the simulated recording list them.

        Args:
            key: a JAX random key, or an integer from which to make one.
            n: number of samples, by default that of the recording.
            auxiliary: channels of n samples by name, e.g. the recording's own `auxiliary`.

        Raises:
            AllanjaxError, RecordingError: see `simulate_recording`.
        """
        units = {a.axis.sensor: a.axis.unit for a in self.results}
        simulated = simulate_recording(
            self.models,
            self.results[0].stages[0].n if n is None else n,
            self.rate,
            key,
            bias={a.axis.name: a.bias(self.rate) for a in self.results},
            auxiliary=auxiliary,
            gyro_unit=units.get("gyro", "deg/s"),
            accel_unit=units.get("accel", "m/s²"),
            name=self.name,
        )
        lacking = [(", ".join(a.left_out), a.axis.name) for a in self.results if a.left_out]
        lacking += [(f.cause, ", ".join(f.axes)) for f in self.shared_findings]
        notes = (f"{axes}: not simulated: {causes.replace('_', ' ')}" for causes, axes in lacking)
        return dataclasses.replace(simulated, notes=(*simulated.notes, *notes))

    def recording(self, stage: int = 0) -> Recording:
        """The recording that was criticized, or with stage −1 the same less the findings."""
        stages = [(a.stages[stage], a.given) for a in self.results]
        values = np.column_stack([s.x if given is None else s.x + given for s, given in stages])
        drawn, axes = np.column_stack([s.drawn for s, _ in stages]), tuple(a.axis for a in self.results)
        missing = drawn if drawn.any() else None
        return Recording(values, self.rate, axes, name=self.name, dead=self.dead, missing=missing)

    def refit(self) -> Fit:
        """Fit the samples less the findings: coefficients with intervals, see `fit`.

        The model is the one given to the critique, whose own lines and steps stay in the samples; otherwise
        its terms are chosen again. Outliers, steps, lines and rounding that were found are removed, and a
        filter and resonances are fitted jointly with the terms. The intervals are widened for samples that
        were filled in. It takes as long as a `fit`.
        """
        from allanjax.estimate.fit import fit_inspected

        recording = self.recording(-1)
        # The facts are those of the original recording, except for lines, which may have been removed.
        seen = inspect(recording, as_is=True, may_move=True)
        lines = [fact for fact in seen.facts if fact.kind == "lines"]
        facts = ordered([*(fact for fact in self.fit.facts if fact.kind != "lines"), *lines])
        seen = dataclasses.replace(seen, facts=facts)
        model, objective = (None, "allan") if self.fit.chosen else (self.fit.template, self.fit.objective)
        return fit_inspected(recording, seen, model, cast(Any, objective), as_is=True)

    @property
    def gain(self) -> float:
        """Total gain in log-likelihood on held-out data by all findings that can be tested on them [nats]."""
        own = [f for axis in self.results for f in axis.findings]
        return float(sum(f.gain for f in (*own, *self.shared_findings) if f.gain is not None))

    @presented
    def details(self) -> str:
        """The critique in full; `print` shows at most ten findings, one per line."""
        raise NotImplementedError

    @presented
    def to_dict(self) -> dict[str, Any]:
        """The critique as plain data for JSON; see `allanjax schema critique`."""
        raise NotImplementedError

    def to_dataframe(self) -> pd.DataFrame:
        """Table with one row per finding and parameter; `gain` is in nats, on held-out data.

        If `limit` is "below" or "above", the value is a 95 % limit and has no standard deviation.
        A finding without parameters has one row without name and numbers.
        """
        return _table(self.findings)

    @presented
    def plot(
        self, path: str | os.PathLike[str] | None = None, findings: Collection[Finding] | None = None
    ) -> tuple[Figure, ...]:
        """Draw a figure per axis, or for each of some findings; saved in folder `path`.

        A finding in several axes is drawn in the most affected one, `Finding.shown`; see
        `presentation.critique_figure`.
        """
        raise NotImplementedError

    @presented
    def __str__(self) -> str:
        raise NotImplementedError

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(self.details())}</pre>"


def _table(findings: Sequence[Finding]) -> pd.DataFrame:
    """Table with one row per finding and parameter, and the size in each axis of a shared finding."""
    import pandas as pd

    columns = ["axes", "cause", "parameter", "value", "std", "unit", "limit", "p_value", "gain"]
    rows = []
    for f in findings:
        whole = ", ".join(f.axes)
        found: list[tuple[str, str, Estimate | Detail]]
        found = [(whole, name, x) for name, x in {**f.parameters, **f.details}.items()]
        if f.members:
            found += [(axis, e.label, e) for axis, e in f.amplitudes.items()]
            # Lists, such as the times of outliers, are in the findings of single axes.
            found += [
                (m.axes[0], k, x) for m in f.members for k, x in m.details.items() if k not in f.details
            ]
        each: list[tuple[Any, ...]] = [(axes, f.cause, name, *written(x)) for axes, name, x in found]
        numbers = [np.nan if x is None else x for x in (f.p_value, f.gain)]
        rows += [(*row, *numbers) for row in each or [(whole, f.cause, "", np.nan, np.nan, "", "")]]
    return pd.DataFrame(rows, columns=columns)
