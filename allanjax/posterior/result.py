"""The posterior of a fit's coefficients: credible intervals, upper limits and derived quantities."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float
from scipy.interpolate import CubicSpline

from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError, AllanjaxWarning
from allanjax.base.late import presented
from allanjax.base.tables import Column, PerAxis
from allanjax.base.wording import duration, plain, record_size
from allanjax.estimate.result import AxisEstimates, Fit, all_coefficients
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model
from allanjax.posterior.priors import Prior
from allanjax.record.recording import Axis
from allanjax.record.units import default_coefficient_unit

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from allanjax.allan.deviation import AllanDeviation

# Draws whose curves are evaluated at once, as terms without a closed form need memory; draws from which
# derived quantities are computed; cluster times at which the minimum of a curve and of its spline is sought.
_AT_ONCE, _DERIVED_DRAWS, _MINIMUM_POINTS, _DENSE = 16, 1000, 200, 4001
# Usual unit and name of the integrated rate.
_INTEGRAL = {"gyro": ("deg", "angle"), "accel": ("m/s", "velocity")}
# Probabilities of the median, the central 68 and 95 %, and the lowest 68 and 95 %.
_QUANTILES = (0.5, 0.16, 0.84, 0.025, 0.975, 0.68, 0.95)


def spaced(draws: Float[np.ndarray, "draws params"], count: int) -> Float[np.ndarray, "count params"]:
    """Evenly spaced draws; some repeat if there are fewer."""
    return draws[np.linspace(0, len(draws) - 1, count).round().astype(int)]


def summary(draws: Float[np.ndarray, " draws"], from_zero: bool = False) -> dict[str, Any]:
    """Median, σ and intervals (perhaps from zero) of posterior draws [SI], as fields of an `Estimate`."""
    median, low_68, high_68, low, high, below_68, below = np.quantile(draws, _QUANTILES).tolist()
    return {
        "source": "posterior",
        "value": median,
        # Draws that agree within rounding do not scatter.
        "std": float(draws.std()) if high - low > 1e-12 * abs(median) else 0.0,
        "interval": (0.0, below) if from_zero else (low, high),
        "interval_68": (0.0, below_68) if from_zero else (low_68, high_68),
    }


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


@eqx.filter_jit
def _curves(models: Model, at: ArrayLike, rate: float, is_psd: bool) -> Float[Array, "draws points"]:
    """Allan deviation at cluster times [s], or one-sided PSD at frequencies [Hz], of models of draws."""
    drawn, others = eqx.partition(models, eqx.is_array)

    def one(values: Model) -> Float[Array, " points"]:
        model = eqx.combine(values, others).sampled(rate)
        return 2.0 * model.sampled_psd(at, rate) if is_psd else jnp.sqrt(model.allan_variance(at))

    return jax.lax.map(one, drawn, batch_size=_AT_ONCE)


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
        *("axis", "coefficient", "median", "std", "lower_68", "upper_68", "lower_95", "upper_95"),
        *("unit", "detected", "upper_limit_95"),
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

    @property
    def verdict(self) -> str:
        """Convergence of the chain in one line."""
        state = "converged" if self.converged else "NOT CONVERGED"
        walkers, tau, r_hat = self.chain.shape[1], plain(self.tau.max(), 3), self.r_hat.max()
        text = f"{state}: {walkers} × {self.steps:,} steps, τ ≤ {tau}, R̂ ≤ {r_hat:.4f}"
        # Curves and drift are those of the sampled terms, which may not be all terms.
        wanted = [c.title for c in self.coefficients.values() if c.detected and not c.sampled and not c.held]
        lack = f"the data also call for {' and '.join(wanted)}, which was not sampled; add it to the model"
        return f"{text}; {lack}" if wanted else text

    def _model_of(self, values: Sequence[Any] | Array) -> Model:
        """Model of a draw, or of many: terms that were not sampled are left out, held ones stay."""
        free = [p for p in self._template.parameters if p.parameter.is_amplitude and p.free]
        model = self._template.with_values(**dict(zip(self.labels, values, strict=True)))
        return model.without([p.term_label for p in free if p.label not in self.labels])

    def _curves(self, at: ArrayLike, count: int, is_psd: bool) -> Float[np.ndarray, "count points"]:
        models = self._model_of(jnp.asarray(spaced(self.draws, count).T))
        return np.asarray(_curves(models, np.atleast_1d(np.asarray(at, float)), self.rate, is_psd))

    def models(self, count: int = 100) -> list[Model]:
        """Models of `count` evenly spaced draws, without the terms that were not sampled."""
        return [self._model_of(draw) for draw in spaced(self.draws, count).tolist()]

    def deviation_curves(
        self, cluster_time: ArrayLike, count: int = 300
    ) -> Float[np.ndarray, "draws points"]:
        """Allan deviations [rad/s or m/s²] of the models of `count` draws at cluster times [s]."""
        return self._curves(cluster_time, count, is_psd=False)

    def density_curves(self, frequency: ArrayLike, count: int = 300) -> Float[np.ndarray, "draws points"]:
        """One-sided PSDs with aliases, (rad/s)²/Hz or (m/s²)²/Hz, of `count` draws at frequencies [Hz]."""
        return self._curves(frequency, count, is_psd=True)

    def bias_instability_minimum(self) -> BiasMinimum:
        """Minimum of the model's Allan deviation between one sample and half the record, and its place.

        If the curve still falls at half the record in most draws, the minimum is marked as an upper bound.
        """
        largest = np.floor(max(self.duration * self.rate / 2.0, 3.0))
        time = np.unique(np.rint(np.geomspace(1.0, largest, _MINIMUM_POINTS))) / self.rate
        curves = CubicSpline(np.log(time), np.log(self.deviation_curves(time, _DERIVED_DRAWS)), axis=1)
        dense = np.linspace(np.log(time[0]), np.log(time[-1]), _DENSE)
        logs = curves(dense)
        lowest = np.argmin(logs, axis=1)
        at_start, at_end = float(np.mean(lowest == 0)), float(np.mean(lowest == _DENSE - 1))
        remark = "the curve rises from the first cluster time on" if at_start > 0.5 else ""
        still = "bound: the curve still falls at half the record"
        remarks = (f"upper {still}", f"lower {still}") if at_end > 0.5 else (remark, remark)
        unit = default_coefficient_unit(self.axis.sensor, 0.0)
        height, place = np.exp(logs.min(axis=1)), np.exp(dense[lowest])
        lowest_one = self._derived("bias-instability minimum", unit, height, remarks[0])
        its_time = self._derived("cluster time of the minimum", "s", place, remarks[1])
        return BiasMinimum(lowest_one, its_time, at_start, at_end)

    def _derived(self, label: str, unit: str, draws: Float[np.ndarray, " draws"], remark: str) -> Estimate:
        return Estimate(axis=self.axis, label=label, usual_unit=unit, remark=remark, **summary(draws))

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
        unit, word = _INTEGRAL[self.axis.sensor]
        drift = {}
        for time, error in zip(t.tolist(), errors.T, strict=True):
            remark = "extrapolated beyond the record" if 2.0 * time > self.duration else ""
            drift[time] = self._derived(f"{word} error after {duration(time)}", unit, error, remark)
        return drift

    def to_arviz(self) -> Any:
        """Convert the chain to ArviZ's InferenceData (DataTree since ArviZ 1.0), one chain per walker, in SI.

        `sample_stats` holds `lp`, the log-posterior density, and `log_likelihood_total`.

        Raises:
            AllanjaxError: ArviZ is not installed.
        """
        try:
            import arviz
        except ImportError as error:
            install = 'install it with pip install "allanjax[arviz]"'
            raise AllanjaxError(f"ArviZ is not installed; {install}") from error
        columns = {label: self.chain[:, :, i] for i, label in enumerate(self.labels)}
        prior = np.sum([self.priors[label].log_density(x) for label, x in columns.items()], axis=0)
        stats = {"lp": self.log_probability, "log_likelihood_total": self.log_probability - prior}
        groups = {"posterior": columns, "sample_stats": stats}
        groups = {name: {label: x.T for label, x in of.items()} for name, of in groups.items()}
        takes_groups = int(arviz.__version__.split(".")[0]) >= 1
        return arviz.from_dict(groups) if takes_groups else arviz.from_dict(**groups)

    @presented
    def plot_corner(self, path: str | os.PathLike[str] | None = None) -> Figure:
        """Draw the marginal and joint posteriors; see `presentation.posterior_figure.plot_corner`."""
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
        """Draw Allan deviation and PSD with bands; see `presentation.posterior_figure.plot_posterior`."""
        raise NotImplementedError

    def _title(self) -> str:
        name, curve = self.fit.name, self.fit.curve
        return f"{name}{': ' if name else ''}posterior from {record_size(curve.n, curve.rate)}"

    def _tables(self) -> list[list[Column]]:
        return all_coefficients(self.results, "median")

    def _notes(self) -> list[str]:
        return [f"{name}: {axis.verdict}" for name, axis in self.items()]
