"""Results of the critic: discrepancies, findings, and the extended model of every axis."""

from __future__ import annotations

import dataclasses
import functools
import html
import os
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, cast

import numpy as np
from jaxtyping import Bool, Float, PRNGKeyArray

from allanjax.base.equality import ByValue
from allanjax.base.late import presented
from allanjax.base.per_axis import PerAxis
from allanjax.critic.finding import Discrepancy, Finding
from allanjax.critic.merging import merged
from allanjax.critic.parameters import side_of_limit, values_of
from allanjax.estimate.result import Fit, Misfit
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
class Snapshot(ByValue):
    """One axis at one stage of the critique, for pictures and simulations.

    Attributes:
        x: samples from which earlier findings are subtracted [SI].
        variance: expected squared cosine coefficients of x [rate²].
        terms: names of the basic terms in the noise.
        powers: their squared coefficients (a ramp has none).
        shape: correlation time [s] or exponent of the term that has one, else nan.
        ramp: slope of a drift ramp [rate/s].
        drawn: samples that are not the sensor's, but drawn given the others.
    """

    x: Float[np.ndarray, " n"]
    variance: Float[np.ndarray, " n-1"]
    terms: tuple[str, ...]
    powers: Mapping[str, float]
    shape: float
    ramp: float
    drawn: Bool[np.ndarray, " n"]

    def __repr__(self) -> str:
        return f"<Snapshot: {len(self.x)} samples less what was found; noise {' + '.join(self.terms)}>"


@dataclasses.dataclass(frozen=True, eq=False)
class AxisCritique(ByValue):
    """Critique of one axis.

    Attributes:
        axis: the axis.
        findings: in the order in which they were made.
        before, after: discrepancies of the baseline's and of the extended model's simulations.
        tests: p-value of every cause's best candidate on the record as it came.
        stages: the axis before the first finding and after each.
        baseline: model that the critique started from.
        model: extended model: noise terms and deterministic ones, with their values.
        misfit: how far the baseline's curve is off, if it does not suffice.
        left_out: causes that change samples as no term of a model does, such as outliers.
    """

    axis: Axis
    findings: tuple[Finding, ...]
    before: tuple[Discrepancy, ...]
    after: tuple[Discrepancy, ...]
    tests: Mapping[str, float]
    stages: tuple[Snapshot, ...]
    baseline: Model
    model: Model
    misfit: Misfit | None = None
    left_out: tuple[str, ...] = ()

    def bias(self, rate: float) -> float:
        """Constant rate that the extended model's samples at `rate` [Hz] are added to [SI]."""
        x = self.stages[0].x
        time = (np.arange(len(x)) + 0.5) / rate
        # Lines have no mean, and the effect of a channel counts from that in the record.
        shifts = (
            getattr(term, term.amplitude_parameter().name) * float(np.mean(term.column(time)))
            for term in self.model.terms
            if isinstance(term, BiasStep | WarmUp | DriftRamp)
        )
        return float(np.mean(x)) - sum(shifts)

    def to_dataframe(self) -> pd.DataFrame:
        """The axis's rows of `Critique.to_dataframe`."""
        return _table(self.findings)

    def __repr__(self) -> str:
        causes = ", ".join(f.cause for f in self.findings) or "nothing found"
        terms = " + ".join(self.model.term_labels)
        return f"<AxisCritique {self.axis.name}: {causes};\n extended model {terms}>"


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Critique(ByValue, PerAxis[AxisCritique]):
    """Critique of a recording: what its simulation gets wrong, why, and what correcting it gains.

    Attributes:
        name: the recording's name.
        rate: its sample rate [Hz].
        fit: the baseline.
        results: critiques of the axes.
        shared_findings: findings that concern several axes.
        notes: remarks for the user.
        dead: axes of the recording that have no noise to compare, and why.
    """

    CALLED: ClassVar[str] = "the critique"

    name: str
    rate: float
    fit: Fit
    results: tuple[AxisCritique, ...]
    shared_findings: tuple[Finding, ...]
    notes: tuple[str, ...] = ()
    dead: tuple[DeadAxis, ...] = ()

    @property
    def warnings(self) -> tuple[str, ...]:
        """What a user of the critique should know of the recording as a whole, the gravest first."""
        # Lines are among the findings.
        return warnings_of(fact for fact in self.fit.facts if fact.kind != "lines")

    @functools.cached_property
    def findings(self) -> tuple[Finding, ...]:
        """What was found in the recording, each cause once, what changes most first; see `Finding.members`.

        The findings of an axis as they were made are those of its `AxisCritique`.
        """
        own = [f for axis in self.results for f in axis.findings]
        return merged(own, self.shared_findings, self.duration)

    @property
    def duration(self) -> float:
        """Length of the recording [s]."""
        return len(self.results[0].stages[0].x) / self.rate if self.results else 0.0

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
        """Simulated recording of the extended models: axes, rate, units, bias and lines' phases as recorded.

        What a model has no term for (outliers, rounding, noise that axes share) is left out, and so is the
        effect of a channel that is not given: the recording's `notes` say which.

        Args:
            key: a JAX random key, or an integer to make one of.
            n: number of samples, by default as many as were recorded.
            auxiliary: channels of n samples by name, e.g. the recording's own `auxiliary`.

        Raises:
            AllanjaxError, RecordingError: as `simulate_recording`.
        """
        units = {a.axis.sensor: a.axis.unit for a in self.results}
        simulated = simulate_recording(
            self.models,
            len(self.results[0].stages[0].x) if n is None else n,
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

    def refit(self) -> Fit:
        """Coefficients with intervals, of the samples less what was found in time: see `fit`.

        The model is the one that the critique was given, or else chosen anew. Outliers, steps, lines and what
        is rounded are taken out, filter and resonances fitted jointly with the terms; intervals are wider for
        samples that were drawn. It takes as long as a `fit` of the recording.
        """
        from allanjax.estimate.fit import fit_inspected

        last, axes = [a.stages[-1] for a in self.results], tuple(a.axis for a in self.results)
        values, drawn = (np.column_stack(of) for of in zip(*((s.x, s.drawn) for s in last), strict=True))
        missing = drawn if drawn.any() else None
        recording = Recording(values, self.rate, axes, name=self.name, dead=self.dead, missing=missing)
        # The facts are those of the recording as it came, but for lines, which may have been taken out.
        seen = inspect(recording, as_is=True, may_move=True)
        lines = [fact for fact in seen.facts if fact.kind == "lines"]
        facts = ordered([*(fact for fact in self.fit.facts if fact.kind != "lines"), *lines])
        seen = dataclasses.replace(seen, facts=facts)
        model, objective = (None, "allan") if self.fit.chosen else (self.fit.template, self.fit.objective)
        return fit_inspected(recording, seen, model, cast(Any, objective), as_is=True)

    @property
    def gain(self) -> float:
        """Held-out log-likelihood gained by all findings that can be held out [nats]."""
        own = [f for axis in self.results for f in axis.findings]
        return float(sum(f.gain for f in (*own, *self.shared_findings) if f.gain is not None))

    @presented
    def details(self) -> str:
        """The story at length; `print` tells findings in a line each, and no more than ten."""
        raise NotImplementedError

    @presented
    def to_dict(self) -> dict[str, Any]:
        """The critique as plain data for JSON; see `critique.schema.json`."""
        raise NotImplementedError

    def to_dataframe(self) -> pd.DataFrame:
        """Table with a row for each finding and parameter; `gain` is in nats, on held-out data.

        Where `limit` is "below" or "above" the value is a 95 % limit, and has no standard deviation.
        An unexplained finding has no parameters: one row, without name and numbers.
        """
        return _table(self.findings)

    @presented
    def plot(
        self, path: str | os.PathLike[str] | None = None, findings: Collection[Finding] | None = None
    ) -> tuple[Figure, ...]:
        """A figure for every finding, or for some, and one for each axis without; saved in the folder `path`.

        That of a finding in several axes shows the one in which it matters most, `Finding.shown`.

        See `report.critique_figure`.
        """
        raise NotImplementedError

    @presented
    def __str__(self) -> str:
        raise NotImplementedError

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(self.details())}</pre>"


def _table(findings: Sequence[Finding]) -> pd.DataFrame:
    """Table with a row for each finding and parameter; how large it is in each of several axes, too."""
    import pandas as pd

    columns = ["axes", "cause", "parameter", "value", "std", "unit", "limit", "p_value", "gain"]
    rows = []
    for f in findings:
        whole = ", ".join(f.axes)
        found = [(whole, *_row(e)) for e in f.parameters.values()]
        found += [(whole, name, *values_of(detail), "") for name, detail in f.details.items()]
        if f.members:
            found += [(axis, *_row(e)) for axis, e in f.amplitudes.items()]
            # Lists, such as the times of outliers, are those of the axes.
            lists = [(m, {k: d for k, d in m.details.items() if k not in f.details}) for m in f.members]
            found += [(m.axes[0], name, *values_of(d), "") for m, own in lists for name, d in own.items()]
        numbers = [float("nan") if x is None else x for x in (f.p_value, f.gain)]
        for axes, *parameter in found or [(whole, "", float("nan"), float("nan"), "", "")]:
            rows.append((axes, f.cause, *parameter, *numbers))
    return pd.DataFrame(rows, columns=columns)


def _row(e: Estimate) -> tuple[Any, ...]:
    """Label, value, standard deviation and unit of a parameter, and the side of its limit."""
    return e.label, e.value, e.std, e.unit, side_of_limit(e)
