"""Results of a fit: coefficients with their intervals for each axis, corrections, verdict and curve."""

from __future__ import annotations

import copy
import dataclasses
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias

import numpy as np
from jaxtyping import ArrayLike, Float

from allanjax.allan.deviation import AllanDeviation
from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError, FitError
from allanjax.base.late import presented
from allanjax.base.tables import Column, PerAxis, as_text, column, columns_from, tables_of
from allanjax.base.wording import (
    chi_squared,
    clauses,
    duration,
    format_with_error,
    plain,
    record_size,
    significant,
)
from allanjax.estimate.likely_models import Statement, exact_model
from allanjax.estimate.misfit import Misfit, deviation
from allanjax.inspection.facts import Fact, listed, warnings_of, why_no_measurement
from allanjax.noise.estimate import SYMBOLS, Estimate, called, title_of
from allanjax.noise.model import Model
from allanjax.noise.terms import AngleRandomWalk, Markov, Resonance, Sinusoid, basic_terms
from allanjax.record.recording import Axis, DeadAxis
from allanjax.record.units import SENSORS, rate_unit_of

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from allanjax.estimate.deterministic import AxisSpectrum
    from allanjax.estimate.selection import TermSelection

# Share of a term in the power at a place that it feels; and characters of a line.
_FELT, _LINE = 0.1, 98
# A limit of the bandwidth within this ratio of its value is reported, and so many places, the strongest ones.
_NEAR, _NAMED = 3.0, 3
# Least share of N that counts as white noise.
_LITTLE = 1e-6
_Coefficients: TypeAlias = Mapping[str, Estimate]
_Covariance: TypeAlias = Float[np.ndarray, "params params"]


class AxisEstimates:
    """Base of the fit and of the posterior of one axis: estimates by name, as a table, and as text.

    `COLUMNS` names the columns of the table; `ERROR` is the exception raised for an unknown coefficient.
    """

    COLUMNS: ClassVar[tuple[str, ...]] = ()
    ERROR: ClassVar[type[AllanjaxError]] = AllanjaxError

    axis: Axis
    coefficients: _Coefficients
    #: Whether the estimates can be trusted, in one line.
    verdict: Any

    def __getitem__(self, name: str) -> Estimate:
        """A coefficient by its label, its symbol or another usual name, e.g. "N" or "ARW" (`called`)."""
        label = called(name, self.coefficients)
        if label is None:
            raise self.ERROR(
                f"{self.axis.name} has no coefficient {name!r}; it has {', '.join(self.coefficients)}"
            )
        return self.coefficients[label]

    def to_dataframe(self) -> pd.DataFrame:
        """One row per coefficient, in its usual unit."""
        import pandas as pd

        rows = [c.row() for c in self.coefficients.values()]
        return pd.DataFrame(rows, columns=list(self.COLUMNS)).astype({"upper_limit_95": float})

    def __repr__(self) -> str:
        of = self.coefficients.values()
        found = ", ".join(f"{c.title} {c.in_unit().describe()}" for c in of if c.detected)
        absent = ", ".join(c.title for c in of if not c.detected)
        shown = (found or "nothing detected") + (f"; not detected: {absent}" if absent else "")
        return f"<{type(self).__name__} {self.axis.name}: {shown};\n {self.verdict}>"


def fitted_model(template: Model, coefficients: _Coefficients, inactive: Sequence[str] = ()) -> Model:
    """The template with these values, without the terms that are inactive or whose amplitude is zero."""
    values = {label: c.value for label, c in coefficients.items() if np.isfinite(c.value)}
    amplitudes = [p for p in template.parameters if p.parameter.is_amplitude]
    absent = [p.term_label for p in amplitudes if values.get(p.label, 0.0) == 0.0]
    return template.with_values(**values).without([*absent, *inactive])


def extended_model(template: Model, coefficients: _Coefficients, inactive: Sequence[str] = ()) -> Model:
    """The model of an extension; its white noise excludes the part of wide resonances and short processes."""
    N, left = coefficients["angle_random_walk"], template.values["angle_random_walk"] or 0.0
    # The term stays if it is detected.
    own = dataclasses.replace(N, value=max(float(left), _LITTLE * N.value))
    return fitted_model(template, {**coefficients, N.label: own}, inactive)


def _causes(result: AxisFit) -> Iterator[str]:
    """What an axis's own model corrects the plain terms for, in words."""
    if (response := result.model.response) is not None:
        bandwidth, value = result[f"{response.name()}_bandwidth"], response.half_power
        sign, limit = bandwidth.limit
        if np.isfinite(bandwidth.std) or bandwidth.held:
            yield f"a {plain(value, 3)} Hz bandwidth"
        elif limit and 1.0 / _NEAR < limit / value < _NEAR:
            yield f"a bandwidth {'below' if sign == '<' else 'above'} {plain(limit, 3)} Hz"
        else:
            # A limit far from the value says nothing.
            yield "a filter of undetermined bandwidth"
    for kind, name in ((Resonance, "resonance"), (Sinusoid, "spectral line")):
        terms: list[Any] = [term for term in result.model.terms if isinstance(term, kind)]
        if terms:
            strongest = sorted(terms, key=lambda term: -term.amplitude)[:_NAMED]
            places = listed([plain(f, 3) for f in sorted(term.frequency for term in strongest)])
            more = f" ({len(terms)} in all)" if len(terms) > _NAMED else ""
            yield f"{'a ' + name if len(terms) == 1 else name + 's'} at {places} Hz{more}"


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class AxisFit(ByValue, AxisEstimates):
    """The fit of one axis.

    Without a result, `coefficients`, `covariance`, `model` and what follows from these raise FitError.

    Attributes:
        axis: the axis.
        converged, reason: whether there is a result, and the reason if there is none.
        chi2, dof, p_value: χ² of the spectrum's levels about the model (for "exact", about the maximum of
            Whittle's likelihood). If only the curve is known, χ² of the Allan variances; it has no p-value,
            as it does not follow a χ² law at long cluster times.
        discrepancy: relative error of the model's Allan deviation (or root PSD, with Whittle's likelihood)
            that brings χ² down to `dof`, or the rms of `misfit` if that is larger; 0 if the model fits.
            Standard deviations and intervals include it.
        misfit: how far the fitted curve is off and where; None if the model fits.
        other_misfit: the same for the other curve, the Allan deviations or the root PSD, if it is off, too.
        regression: amplitude of each regressor and its standard deviation, in SI per the regressor's unit.
        spectrum: with Whittle's likelihood, the statistics that were fitted; neither saved nor compared.
        mean, rms: mean of the samples [rad/s or m/s²], and their rms about the mean.
        not_measured: kinds of the facts (`Fit.facts`) because of which the coefficients are not a measurement
            of the sensor, e.g. "at rest" or "saturation".
        own_template: the model that was fitted by Whittle's likelihood, with filter, resonances and lines,
            where that of the other axes does not fit this one. N is then the density at low frequencies,
            including resonances with Q < 2.5 and processes of less than 20 samples; its interval allows for
            other filters, and other places of resonances, that fit nearly as well.
        plain: the fit without these.
        widening: ratio of standard deviations to those of a complete record (`completion.widening`).
    """

    COLUMNS: ClassVar[tuple[str, ...]] = (
        *("axis", "coefficient", "value", "std", "lower_95", "upper_95"),
        *("unit", "detected", "upper_limit_95", "measured"),
    )
    ERROR: ClassVar[type[AllanjaxError]] = FitError

    axis: Axis
    converged: bool
    reason: str
    chi2: float = np.nan
    dof: int = 0
    p_value: float = np.nan
    discrepancy: float = np.nan
    _coefficients: _Coefficients = dataclasses.field(default_factory=dict)
    _covariance: _Covariance = dataclasses.field(default_factory=lambda: np.zeros((0, 0)))
    _model: Model = dataclasses.field(default_factory=lambda: Model(()))
    regression: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    misfit: Misfit | None = None
    other_misfit: Misfit | None = None
    spectrum: AxisSpectrum | None = dataclasses.field(default=None, compare=False)
    mean: float = np.nan
    rms: float = np.nan
    not_measured: tuple[str, ...] = ()
    own_template: Model | None = None
    plain: AxisFit | None = None
    widening: float = 1.0
    # The fit of which it is a part; the figure needs its curve.
    _fit: ClassVar[Fit | None] = None

    def __post_init__(self) -> None:
        if not self.converged:
            # The numbers are meaningless, and no file contains them.
            nothing = vars(AxisFit(self.axis, True, ""))
            for name in ("chi2", "p_value", "discrepancy", "_coefficients", "_covariance", "_model"):
                object.__setattr__(self, name, nothing[name])

    def _known(self) -> AxisFit:
        if not self.converged:
            raise FitError(f"{self.axis.name}: no result, {self.reason}")
        return self

    @property
    def coefficients(self) -> _Coefficients:  # type: ignore[override]  # others have it as a field
        """The coefficients by label, detected or not."""
        return self._known()._coefficients

    @property
    def covariance(self) -> _Covariance:
        """Covariance (SI) of the coefficients in their order; zero for what was not estimated."""
        return self._known()._covariance

    @property
    def model(self) -> Model:
        """The fitted model."""
        return self._known()._model

    @property
    def term_labels(self) -> tuple[str, ...]:
        """Labels of the terms of `model` in the template, where one of two equal terms keeps its number."""
        amplitudes = (c for c in self.coefficients.values() if c.is_amplitude)
        there = [c.term for c in amplitudes if np.isfinite(c.value) and c.value]
        # N is the sum of all terms that are white at low frequencies; none need be white noise itself.
        white = AngleRandomWalk.name()
        return tuple(label for label in there if label != white or white in self.model.term_labels)

    @property
    def lacking(self) -> tuple[str, ...]:
        """B and K where only white noise and quantization were fitted, which tell nothing of a drift."""
        return () if {c.symbol for c in self.coefficients.values()} - {"N", "Q"} else ("B", "K")

    @property
    def measured(self) -> bool:
        """Whether the coefficients are a measurement of the sensor, according to the facts and the misfit."""
        return self.converged and not self.not_measured and not self.is_far_off

    @property
    def moving(self) -> bool:
        """Whether the sensor was not at rest."""
        return "at rest" in self.not_measured

    @property
    def worst(self) -> Misfit | None:
        """The larger of the misfits; None if the model fits."""
        known = [misfit for misfit in (self.misfit, self.other_misfit) if misfit]
        return max(known, key=lambda misfit: misfit.sure, default=None)

    @property
    def fits(self) -> bool:
        """Whether the model follows the data, at least within a tenth."""
        return self.converged and not self.is_far_off and not (self.worst and self.worst.matters)

    @property
    def is_far_off(self) -> bool:
        """Whether the fitted curve is too far from the measured one."""
        return self.discrepancy > 0.0 and self.misfit is not None and self.misfit.excessive

    def unmeasured(self, **why: Any) -> AxisFit:
        """A copy without standard deviations, intervals and limits; `why` are fields with the reason."""
        coefficients = {label: c.unmeasured() for label, c in self.coefficients.items()}
        nothing = np.full_like(self.covariance, np.nan)
        return dataclasses.replace(self, _coefficients=coefficients, _covariance=nothing, **why)

    def without_intervals(self) -> AxisFit:
        """A copy with values only, from a curve whose record's length is unknown."""
        coefficients = {label: c.without_interval() for label, c in self.coefficients.items()}
        return dataclasses.replace(self.unmeasured(), _coefficients=coefficients)

    def with_estimates(self, found: _Coefficients, **more: Any) -> AxisFit:
        """A copy with these estimates, and a covariance rescaled to their standard deviations."""
        pairs = [(c.std, self._coefficients[label].std) for label, c in found.items()]
        by = np.array([new / old if old > 0.0 and np.isfinite(new) else 1.0 for new, old in pairs])
        covariance = self._covariance * np.outer(by, by)
        return dataclasses.replace(self, _coefficients=found, _covariance=covariance, **more)

    def widened(self, factor: float) -> AxisFit:
        """A copy whose standard deviations are larger by a factor, with intervals and limits to match."""
        return self._scaled(lambda c: factor, factor)

    def _scaled(self, factor: Callable[[Estimate], float], widening: float = 1.0) -> AxisFit:
        return self.with_estimates(
            {label: c.widened(factor(c)) for label, c in self._coefficients.items()},
            plain=self.plain and self.plain._scaled(factor, widening),
            widening=self.widening * widening,
        )

    def allowing(self, share: float, foreign: float) -> AxisFit:
        """A copy with intervals widened for a relative error of every amplitude, and `foreign` white noise.

        That is its density [rad/√s or m/s/√s]; it may be in N but not from the sensor.
        """

        def factor(c: Estimate) -> float:
            if not c.is_amplitude or not c.detected or not c.std > 0.0:
                return 1.0
            white = c.term == AngleRandomWalk.name()
            more = c.value - np.sqrt(max(c.value**2 - foreign**2, 0.0)) if white else 0.0
            return float(np.sqrt(1.0 + ((share * c.value) ** 2 + more**2) / c.std**2))

        return self if share == foreign == 0.0 else self._scaled(factor)

    @property
    def further(self) -> tuple[str, ...]:
        """Labels of the filter, the resonances and the lines for which the plain terms were corrected."""
        if (own := self.own_template) is None:
            return ()
        kinds = {type(term) for term in basic_terms()} | {Markov}
        terms = zip(own.term_labels, own.terms, strict=True)
        response = () if own.response is None else (own.response.name(),)
        return (*(label for label, term in terms if type(term) not in kinds), *response)

    @property
    def correction(self) -> str:
        """What the plain terms were corrected for, and by how much; "" without a correction.

        E.g. "corrected for a 28 Hz bandwidth and a resonance at 20 Hz: N 2.41 → 2.27 deg/√h".
        """
        if self.own_template is None or not self.converged:
            return ""
        several = sum(isinstance(term, Markov) for term in self.own_template.terms) > 1
        process = "Markov processes of several correlation times" if several else "a Markov process"
        text = f"corrected for {listed(list(_causes(self)) or [process])}"
        if self.plain is None or not self.plain.converged:
            return text
        old, new = (fit["angle_random_walk"].in_unit() for fit in (self.plain, self))
        if not (old.value > 0.0 and new.value > 0.0):
            return text
        return f"{text}: N {significant(old.value, 3)} → {significant(new.value, 3)} {new.unit}"

    @property
    def level(self) -> str:
        """Mean and rms of the samples, e.g. "mean 9.807 m/s², rms 0.012 m/s²"; "" if unknown."""
        if not np.isfinite(self.mean):
            return ""
        unit, scale = rate_unit_of(self.axis.unit, self.axis.sensor)
        mean, rms = significant(self.mean / scale, 4), significant(self.rms / scale, 2)
        return f"mean {mean} {unit}, rms {rms} {unit}"

    def with_misfits_felt(self, rate: float) -> AxisFit:
        """A copy whose misfits tell which of N, B and K have a share there, at a sample rate [Hz]."""
        likely = exact_model(self.model.sampled(rate))

        def felt(misfit: Misfit | None) -> Misfit | None:
            if misfit is None:
                return None
            at, power = np.array([misfit.at]), {}
            for label, term, (square,) in zip(likely.labels, likely.terms, likely.power.T, strict=True):
                sampled = term.sampled(rate)
                if not (misfit.unit == "Hz" and term.terms[0].deterministic):
                    is_allan = misfit.unit == "s"
                    unit = sampled.allan_variance(at) if is_allan else sampled.sampled_psd(at, rate)
                    power[label] = square * float(np.asarray(unit)[0])
            least = _FELT * sum(power.values())
            own = [SYMBOLS[x] for x in MAIN if power.get(x, 0.0) > least and self.coefficients[x].detected]
            return dataclasses.replace(misfit, felt=tuple(own))

        return dataclasses.replace(self, misfit=felt(self.misfit), other_misfit=felt(self.other_misfit))

    @property
    def word(self) -> str:
        """The verdict in a few words, e.g. "fits within 2.7 %" or "does not fit: ×4.3 at 779 s"."""
        if not self.converged:
            return "no result"
        if not self.measured:
            return "not a measurement"
        if self.worst is None:
            return "fits"
        if self.fits:
            return f"fits within {deviation(self.worst.sure)}"
        return f"does not fit: {self.worst.size} at {plain(self.worst.at, 3)} {self.worst.unit}"

    @property
    def verdict(self) -> str:
        """How well the model fits, in one line: how far it is off, where, and whether N, B or K feel it."""
        if not self.converged:
            return f"no result: {self.reason}"
        if self.is_far_off:
            return f"not a measurement of this sensor: the model does not fit, {self.worst}"
        if self.not_measured:
            return f"not a measurement of this sensor: {why_no_measurement(self.not_measured)}"
        if self.worst is None:
            return "fits"
        head = self.word if self.fits else "does not fit"
        return f"{head}: {self.worst}"

    @property
    def story(self) -> str:
        """Verdict with χ², how N, B and K vary, corrections and level, in one line."""
        known = [] if not self.converged else [chi_squared(self.chi2, self.dof, self.p_value)]
        for c in self._coefficients.values():
            varies = "" if c.variation is None else str(c.variation)
            known += [f"{c.symbol} {varies}"] if varies else []
        return clauses(self.verdict, *known, self.correction, self.level)

    def plot(self, path: str | os.PathLike[str] | None = None, *, ax: Axes | None = None) -> Figure:
        """Draw the axis's Allan deviations, the model and its terms; see `plot_allan`."""
        if self._fit is None:
            raise FitError(
                f"{self.axis.name}: a figure needs the curve of a fit; use a result taken from one"
            )
        return self._fit.plot(self.axis.name, path, ax=ax)

    def details(self) -> str:
        """All coefficients with their 95 % intervals and limits, and χ², as text."""
        return details("", [self])

    __str__ = details

    def __repr__(self) -> str:
        return super().__repr__() if self.measured else f"<AxisFit {self.axis.name}: {self.verdict}>"


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Fit(ByValue, PerAxis[AxisFit]):
    """The fit of a model to every axis of a recording.

    Attributes:
        name: the recording's name.
        template: the model that was asked for, or the five basic terms.
        curve: the Allan deviations, with degrees of freedom under the fitted models.
        results: one per axis.
        notes: remarks of the reader and the fit.
        objective: "allan", "whittle", "wavelet" or "exact".
        selection: the ranking of terms, if the fit chose them.
        dead: axes of the recording that have no noise to fit, and why.
        facts: what the inspection of the recording detected, the gravest first.
        parts: the parts of the recording that were used, in s from its first sample; empty for all of it.
    """

    ERROR: ClassVar[type[AllanjaxError]] = FitError

    name: str
    template: Model
    curve: AllanDeviation
    results: tuple[AxisFit, ...]
    notes: tuple[str, ...] = ()
    objective: str = "allan"
    selection: TermSelection | None = None
    dead: tuple[DeadAxis, ...] = ()
    facts: tuple[Fact, ...] = ()
    parts: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        for result in self.results:
            object.__setattr__(result, "_fit", self)

    def __getitem__(self, axis: str) -> AxisFit:
        """The fit of one axis, e.g. `fit["gyro_x"]`."""
        if reason := next((dead.reason for dead in self.dead if dead.axis.name == axis), None):
            raise FitError(f"{axis}: no result, {reason}")
        return super().__getitem__(axis)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about the coefficients, the gravest first."""
        names = ", ".join(result.axis.name for result in self.results if result.is_far_off)
        far_off = (
            f"{names}: not a measurement of this sensor, as the model does not fit: see the figure; --terms "
            "selects other terms"
        )
        if not self.of_curve:
            far_off += ", --start and --stop the part at rest, and `allanjax critique FILE` shows the cause"
        return (*warnings_of(self.facts), *([far_off] if names else []))

    @property
    def of_curve(self) -> bool:
        """Whether a curve was fitted without its recording, so that no mean is known."""
        return all(np.isnan(result.mean) for result in self.results)

    @property
    def longest_part(self) -> tuple[float, float] | None:
        """The longest part of the recording that was used, in s from its first sample; None: all of it."""
        return max(self.parts, key=lambda part: part[1] - part[0], default=None)

    @property
    def chosen(self) -> bool:
        """Whether the fit chose the terms."""
        return self.selection is not None

    @property
    def converged(self) -> bool:
        """Whether every axis has a result."""
        return not self.without_result

    @property
    def without_result(self) -> dict[str, str]:
        """Reason for each axis without a result, by its name."""
        failed = {result.axis.name: result.reason for result in self.results if not result.converged}
        return failed | {dead.axis.name: dead.reason for dead in self.dead}

    @property
    def not_measured(self) -> dict[str, str]:
        """Why the coefficients of an axis are not a measurement of the sensor, by the axis's name."""
        return {r.axis.name: r.verdict for r in self.results if r.converged and not r.measured}

    @property
    def coefficients(self) -> dict[str, _Coefficients]:
        """Coefficients by axis and label. Raises FitError if an axis did not converge."""
        return {result.axis.name: result.coefficients for result in self.results}

    def as_for(self, axis: str) -> Fit:
        """The fit for one axis: with the axis's own model and objective if it has them."""
        if (own := self[axis].own_template) is None:
            return self
        results = tuple(map(copy.copy, self.results))
        return dataclasses.replace(self, template=own, objective="whittle", results=results)

    def without_extensions(self) -> Fit:
        """The fit in which axes with a model of their own have the fit of the plain terms."""
        results = tuple(
            dataclasses.replace(r.plain or r, mean=r.mean, rms=r.rms, not_measured=r.not_measured)
            for r in self.results
        )
        return dataclasses.replace(self, results=results)

    def stated(self, axis: str) -> Statement:
        """Likely models of an axis and their curves."""
        ranking = None if self.selection is None else self.selection[axis]
        return Statement(self[axis], ranking, self.curve, self.axes.index(axis))

    def model_deviation(self, axis: str, cluster_time: ArrayLike) -> Float[np.ndarray, ...]:
        """Allan deviation [rad/s or m/s²] that the fit states at cluster times [s].

        It is that of the detected terms; where sets of terms are undecided, it is their average. Where the
        model fits, it stays within the measured curve's 95 % interval.
        """
        return self.model_curve(axis, cluster_time)[0]

    def model_curve(self, axis: str, cluster_time: ArrayLike) -> Float[np.ndarray, "3 ..."]:
        """Allan deviation that the fit states, see `model_deviation`, and the ends of its 95 % interval."""
        at = np.asarray(cluster_time, float)
        return self.stated(axis).deviation(np.atleast_1d(at)).reshape(3, *at.shape)

    @presented
    def plot(
        self,
        axes: Sequence[str] | str | None = None,
        path: str | os.PathLike[str] | None = None,
        *,
        ax: Axes | None = None,
    ) -> Figure:
        """Draw the Allan deviations, the model and its terms; see `plot_allan`."""
        raise NotImplementedError

    @presented
    def to_dict(self) -> dict[str, Any]:
        """The fit as plain dictionaries, lists, numbers and strings, as `write_json` writes it."""
        raise NotImplementedError

    def details(self) -> str:
        """All coefficients with their 95 % intervals and limits, and χ² of every axis, as text."""
        notes = () if self.selection is None else self.selection.ambiguities()
        return details(self._heading(), self.results, notes)

    def _tables(self) -> list[list[Column]]:
        """Tables, one per sensor, with one row per axis."""
        rows = [(r.axis, r if r.converged else None) for r in self.results]
        if self.dead:
            rows = sorted(rows + [(dead.axis, None) for dead in self.dead], key=lambda row: row[0].name)
        tables: list[list[Column]] = []
        for sensor in SENSORS:
            if own := [row for row in rows if row[0].sensor == sensor]:
                axes, results = zip(*own, strict=True)
                unit, scale = rate_unit_of(axes[0].unit, sensor)
                means = [math.nan if r is None else float(r.mean / scale) for r in results]
                tables += tables_of(
                    [Column("axis", [axis.name for axis in axes])],
                    *_coefficient_columns(results),
                    [
                        column("mean", unit, means, 4),
                        Column("verdict", ["no result" if r is None else r.word for r in results]),
                    ],
                )
        return tables

    def _notes(self) -> Iterator[str]:
        """Lines below the tables: corrections, misfits, axes without a result, and notes."""
        known = [result for result in self.results if result.converged]
        yield from (f"{r.axis.name} {r.correction}" for r in known if r.correction)
        yield from (f"{r.axis.name} {r.verdict}" for r in known if r.measured and r.worst)
        for name, reason in self.without_result.items():
            if not any(reason in warning for warning in self.warnings):
                yield f"{name}: no result, {reason}"
        undecided = {} if self.selection is None else self.selection.undecided()
        longer = () if self.selection is None else self.selection.ambiguities()
        yield from (f"note: {note}" for note in self.notes if note not in longer)
        questions = []
        for (question, _), of in undecided.items():
            names = [name for name, *_ in of]
            where = names[0] if len(names) == 1 else f"{len(names)} axes"
            or_none = "" if " or " in question else " or none"
            questions.append(f"{_in_symbols(question)}{or_none} ({where})")
        if questions:
            yield _in_one_line("the data do not tell (more with --verbose): ", questions)

    def _title(self) -> str:
        if not self.curve.determined:
            first, last = (duration(float(self.curve.cluster_time[k])) for k in (0, -1))
            return f"Allan curve from {first} to {last}"
        return record_size(self.curve.n, self.curve.rate) + self.curve.describe_others()


#: Terms whose column a table of coefficients has even where they are not detected: N, B and K.
MAIN = tuple(SYMBOLS)[:3]


def _coefficient_columns(results: Sequence[AxisFit | None]) -> tuple[list[Column], list[Column]]:
    """Columns of the main coefficients, and of others that some axis has."""
    found: list[dict[str, Estimate]] = []
    for r in results:
        plain_terms = () if r is None else (c for c in r.coefficients.values() if c.term not in r.further)
        found.append({c.label: c.in_unit() for c in plain_terms})
    main, others = list[Column](), list[Column]()
    labels = dict.fromkeys(label for of in found for label in of)
    for label in sorted(labels, key=lambda name: [*SYMBOLS, name].index(name)):
        known = [of[label] for of in found if label in of]
        if label in MAIN or any(c.held or (c.detected and c.measured) for c in known):
            numbers = [of[label].number if label in of else None for of in found]
            name = SYMBOLS.get(label, known[0].title)
            (main if label in MAIN else others).append(column(name, known[0].unit, numbers))
    return main, others


def _in_symbols(question: str) -> str:
    """An undecided question with the symbols of the basic terms, e.g. "K or B"."""
    for label, symbol in SYMBOLS.items():
        for sensor in SENSORS:
            question = question.replace(title_of(label, sensor), symbol)
    return question.replace("Markov process", "Markov")


def _in_one_line(head: str, items: Sequence[str]) -> str:
    """As many items as fit a line behind a heading, and how many more there are."""
    line = head + items[0]
    for k, item in enumerate(items[1:], 1):
        more = f", and {len(items) - k} more"
        if len(line) + len(item) + len(more) > _LINE:
            return line + more
        line += f", {item}"
    return line


def details(title: str, results: Sequence[AxisFit], notes: Sequence[str] = ()) -> str:
    """Table of all coefficients with intervals and limits, a line below per axis, and these notes."""
    lines = [f"{r.axis.name}: {r.story}" for r in results]
    return as_text(title, all_coefficients([r for r in results if r.converged]), [*lines, *notes])


def all_coefficients(results: Sequence[Any], estimate: str = "estimate") -> list[list[Column]]:
    """Table of all coefficients of these axes, one row each, if there are any."""
    rows = [detail(c) for r in results for c in r.coefficients.values()]
    return [columns_from(("axis", "coefficient", f"{estimate} ± 1σ", "95 % interval"), rows)] if rows else []


def detail(estimate: Estimate, in_unit: str | None = None) -> tuple[str, str, str, str]:
    """Axis, title, value and interval of a coefficient; without an interval, the reason in its place."""
    c = estimate.in_unit(in_unit)
    number, reason = c.number, ""
    if c.held:
        text, reason = plain(c.value), "held"
    elif number is None:
        text, reason = "", "not determined"
    elif number.error > 0.0:
        text, reason = format_with_error(*number[:2]), c.describe_interval()
    else:
        text = f"{number.before}{significant(number.value)}{number.after}"
        if not c.detected and c.measured:
            reason = "not detected"
            if c.rivals:
                reason = f"may be {' or '.join(SYMBOLS.get(term, term) for term in c.rivals)}"
        elif c.source == "curve":
            reason = "no interval"
    unit = "" if c.unit == "1" or not text else f" {c.unit}"
    return c.axis.name, c.title, text + unit, clauses(reason, c.remark)
