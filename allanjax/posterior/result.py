"""The posterior of a fit's coefficients: credible intervals, upper limits and derived quantities."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError, AllanjaxWarning
from allanjax.base.late import TextProperty, presented
from allanjax.base.tables import Column, PerAxis
from allanjax.base.wording import duration, plain, record_size
from allanjax.estimate.result import AxisEstimates, Fit
from allanjax.estimate.tables import all_coefficients
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model
from allanjax.posterior.priors import Prior
from allanjax.record.recording import Axis
from allanjax.record.units import default_coefficient_unit

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from allanjax.allan.deviation import AllanDeviation

# Number of draws whose curves are evaluated at once, as terms without a closed form need memory.
_AT_ONCE = 16
# Number of draws from which curves and derived quantities are computed.
_DERIVED_DRAWS = 1000
# Number of cluster times at which the minimum of a curve is sought.
_MINIMUM_POINTS = 200
_INTEGRAL_UNIT = {"gyro": "deg", "accel": "m/s"}


def derived(
    label: str, axis: Axis, usual_unit: str, draws: Float[np.ndarray, " draws"], remark: str = ""
) -> Estimate:
    """Estimate of a derived quantity from its posterior draws [SI]: median, σ and intervals."""
    low, low_68, median, high_68, high = np.quantile(draws, [0.025, 0.16, 0.5, 0.84, 0.975]).tolist()
    # Draws that agree within rounding do not scatter.
    std = float(draws.std()) if high - low > 1e-12 * abs(median) else 0.0
    return Estimate(
        label=label,
        axis=axis,
        value=median,
        std=std,
        interval=(low, high),
        interval_68=(low_68, high_68),
        usual_unit=usual_unit,
        source="posterior",
        remark=remark,
    )


@dataclasses.dataclass(frozen=True, eq=False)
class BiasMinimum(ByValue):
    """Minimum of the Allan deviation.

    Attributes:
        deviation: the Allan deviation at the minimum.
        cluster_time: the cluster time of the minimum.
        at_start, at_end: share of the draws with the minimum at one sample, or at half the record.
    """

    deviation: Estimate
    cluster_time: Estimate
    at_start: float
    at_end: float

    def __str__(self) -> str:
        return f"{self.deviation.in_unit()}\n{self.cluster_time.in_unit()}"

    def __repr__(self) -> str:
        return f"<BiasMinimum {self}>"


def with_draw(
    template: Model,
    labels: tuple[str, ...],
    absent: tuple[str, ...],
    values: Float[Array, " sampled"] | list[float],
) -> Model:
    """The model with these values of the labelled parameters, without the absent terms."""
    return template.with_values(**dict(zip(labels, values, strict=True))).without(absent)


@eqx.filter_jit
def curves(
    template: Model,
    labels: tuple[str, ...],
    absent: tuple[str, ...],
    draws: Float[ArrayLike, "draws sampled"],
    at: Float[ArrayLike, " points"],
    rate: float,
    kind: Literal["deviation", "density"],
) -> Float[Array, "draws points"]:
    """Allan deviation at cluster times [s], or one-sided PSD at frequencies [Hz], of every draw's model."""

    def one(values: Float[Array, " sampled"]) -> Float[Array, " points"]:
        model = with_draw(template, labels, absent, values).sampled(rate)
        if kind == "deviation":
            return jnp.sqrt(model.allan_variance(at))
        return 2.0 * model.sampled_psd(at, rate)

    return jax.lax.map(one, draws, batch_size=_AT_ONCE)


def lowest_point(
    axis: Axis,
    cluster_time: Float[np.ndarray, " points"],
    deviation: Float[np.ndarray, "draws points"],
    deviation_unit: str,
) -> BiasMinimum:
    """Minimum of each draw's curve on this grid; its height and place are refined by a parabola in
    logarithms."""
    x, y = np.log(cluster_time), np.log(deviation)
    lowest = np.argmin(y, axis=1)
    last = len(x) - 1
    k = np.clip(lowest, 1, last - 1)
    row = np.arange(len(y))
    # Newton's parabola through the lowest point and its neighbours, which may be unevenly spaced.
    left, right = x[k - 1] - x[k], x[k + 1] - x[k]
    slope_left, slope_right = (y[row, k - 1] - y[row, k]) / left, (y[row, k + 1] - y[row, k]) / right
    curvature = (slope_right - slope_left) / (right - left)
    slope = slope_left - curvature * left
    inside = (lowest == k) & (curvature > 0.0)
    step = np.where(inside, -slope / np.where(inside, 2.0 * curvature, 1.0), 0.0)
    height = np.where(inside, y[row, k] + step * slope / 2.0, y[row, lowest])
    place = np.where(inside, x[k] + step, x[lowest])
    at_start, at_end = float(np.mean(lowest == 0)), float(np.mean(lowest == last))
    remark_height = remark_place = ""
    if at_end > 0.5:
        remark_height = "upper bound: the curve still falls at half the record"
        remark_place = "lower bound: the curve still falls at half the record"
    elif at_start > 0.5:
        remark_height = remark_place = "the curve rises from the first cluster time on"
    names = "bias-instability minimum", "cluster time of the minimum"
    return BiasMinimum(
        derived(names[0], axis, deviation_unit, np.exp(height), remark_height),
        derived(names[1], axis, "s", np.exp(place), remark_place),
        at_start,
        at_end,
    )


class PosteriorWarning(AllanjaxWarning):
    """Warning about a posterior whose chain has not converged."""


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class AxisPosterior(ByValue, AxisEstimates):
    """The posterior of one axis.

    Attributes:
        axis: the axis.
        labels: labels of the sampled parameters.
        draws: nearly independent draws of these [draws, params], SI.
        chain: all steps after the burn-in [steps, walkers, params], SI.
        log_probability: ln of the posterior density (per SI unit of every parameter, not normalized) along
            the chain [steps, walkers].
        coefficients: by label, the marginal posterior of every free parameter of the model, sampled or not,
            and the held parameters.
        priors: the prior of every free parameter, by label.
        converged: whether the chain is long enough, τ has settled and R̂ is close to 1.
        tau: integrated autocorrelation time of each parameter [steps].
        r_hat: rank-normalized split R̂ of each parameter over the walkers.
        acceptance: share of accepted proposals.
        steps: steps of every walker after the warm-up, including the burn-in.
        rate: sample rate of the recording [Hz].
        duration: length of the recording [s].
    """

    COLUMNS: ClassVar[tuple[str, ...]] = (
        "axis",
        "coefficient",
        "median",
        "std",
        "lower_68",
        "upper_68",
        "lower_95",
        "upper_95",
        "unit",
        "detected",
        "upper_limit_95",
    )

    axis: Axis
    labels: tuple[str, ...]
    draws: Float[np.ndarray, "draws params"]
    chain: Float[np.ndarray, "steps walkers params"]
    log_probability: Float[np.ndarray, "steps walkers"]
    coefficients: Mapping[str, Estimate]
    priors: Mapping[str, Prior]
    converged: bool
    tau: Float[np.ndarray, " params"]
    r_hat: Float[np.ndarray, " params"]
    acceptance: float
    steps: int
    rate: float
    duration: float
    _template: Model

    @property
    def correlation(self) -> pd.DataFrame:
        """Correlations of the sampled parameters, by label."""
        import pandas as pd

        matrix = np.corrcoef(self.draws.T).reshape(2 * (len(self.labels),))
        return pd.DataFrame(matrix, index=self.labels, columns=self.labels)

    @TextProperty
    def verdict(self) -> str:
        """Convergence of the chain in one line."""
        state = "converged" if self.converged else "NOT CONVERGED"
        text = (
            f"{state}: {self.chain.shape[1]} × {self.steps:,} steps, τ ≤ {plain(self.tau.max(), 3)}, "
            f"R̂ ≤ {self.r_hat.max():.4f}"
        )
        # Curves and drift are those of the sampled terms, which may not be all terms.
        wanted = [c.title for c in self.coefficients.values() if c.detected and not c.sampled and not c.held]
        if wanted:
            text += (
                f"; the data also call for {' and '.join(wanted)}, which was not sampled; add it to the model"
            )
        return text

    # ------------------------------------------------------------------ models and curves
    @property
    def _absent(self) -> tuple[str, ...]:
        """Names of the terms that were not sampled; held ones stay in the model."""
        return tuple(
            p.term_label
            for p in self._template.parameters
            if p.parameter.is_amplitude and p.free and p.label not in self.labels
        )

    def _some_draws(self, count: int) -> Float[np.ndarray, "count params"]:
        """An evenly spaced selection of draws; some repeat if there are fewer."""
        return self.draws[np.linspace(0, len(self.draws) - 1, count).round().astype(int)]

    def models(self, count: int = 100) -> list[Model]:
        """Models of `count` evenly spaced draws, without the terms that were not sampled."""
        draws = self._some_draws(count).tolist()
        return [with_draw(self._template, self.labels, self._absent, x) for x in draws]

    def deviation_curves(
        self, cluster_time: ArrayLike, count: int = 300
    ) -> Float[np.ndarray, "count points"]:
        """Allan deviations [rad/s or m/s²] of the models of `count` draws at cluster times [s]."""
        return self._curves(cluster_time, count, "deviation")

    def density_curves(self, frequency: ArrayLike, count: int = 300) -> Float[np.ndarray, "count points"]:
        """One-sided PSDs with aliases, (rad/s)²/Hz or (m/s²)²/Hz, of `count` draws at frequencies [Hz]."""
        return self._curves(frequency, count, "density")

    def _curves(self, at: ArrayLike, count: int, kind: Any) -> Float[np.ndarray, "count points"]:
        points = np.atleast_1d(np.asarray(at, float))
        draws = self._some_draws(count)
        return np.asarray(curves(self._template, self.labels, self._absent, draws, points, self.rate, kind))

    # ------------------------------------------------------------------ derived quantities
    def bias_instability_minimum(self) -> BiasMinimum:
        """Minimum of the model's Allan deviation between one sample and half the record, and its place.

        If the curve still falls at half the record in most draws, the minimum is marked as an upper bound.
        """
        largest = max(self.duration * self.rate / 2.0, 3.0)
        sizes = np.unique(np.rint(np.geomspace(1.0, np.floor(largest), _MINIMUM_POINTS)))
        time = sizes / self.rate
        unit = default_coefficient_unit(self.axis.sensor, 0.0)
        return lowest_point(self.axis, time, self.deviation_curves(time, _DERIVED_DRAWS), unit)

    def predicted_drift(self, times: Sequence[float] = (60.0, 600.0, 3600.0)) -> dict[float, Estimate]:
        """1-σ error of the integrated rate (angle or velocity) after each time t [s].

        The bias is the mean rate over an equally long time before. The error is then the second difference of
        the integrated rate, with a standard deviation of exactly √2·t·σ_A(t). Beyond half the record it is
        marked as an extrapolation by the model.

        Raises:
            AllanjaxError: a time is not positive and finite.
        """
        t = np.atleast_1d(np.asarray(times, float))
        if not (np.all(np.isfinite(t)) and np.all(t > 0.0)):
            raise AllanjaxError(f"times must be positive and finite, not {times!r}")
        errors = np.sqrt(2.0) * t * self.deviation_curves(t, _DERIVED_DRAWS)
        unit = _INTEGRAL_UNIT[self.axis.sensor]
        word = "angle" if self.axis.sensor == "gyro" else "velocity"
        return {
            float(time): derived(
                f"{word} error after {duration(float(time))}",
                self.axis,
                unit,
                error,
                "extrapolated beyond the record" if 2.0 * time > self.duration else "",
            )
            for time, error in zip(t, errors.T, strict=True)
        }

    # ------------------------------------------------------------------ other programs and pictures
    def to_arviz(self) -> Any:
        """Convert the chain to ArviZ's InferenceData (DataTree since ArviZ 1.0), one chain per walker, in SI.

        `sample_stats` holds `lp`, the log-posterior density, and `log_likelihood_total`.

        Raises:
            AllanjaxError: ArviZ is not installed.
        """
        try:
            import arviz
        except ImportError as error:
            raise AllanjaxError(
                'ArviZ is not installed; install it with pip install "allanjax[arviz]"'
            ) from error
        prior = sum(
            np.asarray(self.priors[label].log_density(self.chain[:, :, i]))
            for i, label in enumerate(self.labels)
        )
        groups = {
            "posterior": {label: self.chain[:, :, i].T for i, label in enumerate(self.labels)},
            "sample_stats": {
                "lp": self.log_probability.T,
                "log_likelihood_total": (self.log_probability - prior).T,
            },
        }
        if int(arviz.__version__.split(".")[0]) >= 1:
            return arviz.from_dict(groups)
        return arviz.from_dict(**groups)

    @presented
    def plot_corner(self, path: str | os.PathLike[str] | None = None) -> Figure:
        """Draw the marginal and joint posteriors; see `report.posterior_figure.plot_corner`."""
        raise NotImplementedError


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Posterior(ByValue, PerAxis[AxisPosterior]):
    """The posteriors of a fit's axes; a mapping from axis names to `AxisPosterior`.

    Attributes:
        fit: the sampled fit.
        results: one posterior per axis.
    """

    fit: Fit
    results: tuple[AxisPosterior, ...]

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings of the fit."""
        return self.fit.warnings

    @property
    def converged(self) -> bool:
        """Whether the chains of every axis have converged."""
        return all(result.converged for result in self.results)

    def to_arviz(self) -> dict[str, Any]:
        """`AxisPosterior.to_arviz` of every axis by name. Raises AllanjaxError if ArviZ is not installed."""
        return {axis: result.to_arviz() for axis, result in self.items()}

    @presented
    def plot(
        self,
        curve: AllanDeviation | Fit | None = None,
        axes: Sequence[str] | str | None = None,
        path: str | os.PathLike[str] | None = None,
        spectrum: Any = None,
    ) -> Figure:
        """Draw Allan deviation and PSD with bands; see `report.posterior_figure.plot_posterior`."""
        raise NotImplementedError

    def _title(self) -> str:
        name, curve = self.fit.name, self.fit.curve
        return f"{name}{': ' if name else ''}posterior from {record_size(curve.n, curve.rate)}"

    def _tables(self) -> list[list[Column]]:
        return all_coefficients(self.results, "median")

    def _notes(self) -> list[str]:
        return [f"{name}: {axis.verdict}" for name, axis in self.items()]
