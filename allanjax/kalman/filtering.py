"""Kalman filters and smoothers of a recording, driven by noise models, and their results."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from allanjax.base.chi_squared import upper_tail
from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError
from allanjax.base.late import presented
from allanjax.base.normal import TWO_SIDED_95
from allanjax.base.tables import Cell, Number, PerAxis
from allanjax.base.wording import duration, finite_or_none, format_with_error, plain
from allanjax.kalman.recursion import (
    Constant,
    FilterModel,
    in_blocks,
    log_densities,
    padded,
    run_filter,
    run_smoother,
)
from allanjax.noise.estimate import title_of
from allanjax.noise.model import Model
from allanjax.noise.notation import Modelling, model_of
from allanjax.record.io.given import RecordingLike, as_recording
from allanjax.record.recording import Axis, Recording
from allanjax.record.units import Sensor, default_coefficient_unit, unit_scale

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


# Lags of the portmanteau test: at most this number, and at most this share of the samples.
_LAGS, _SHARE = 40, 0.2
SCHEMA_VERSION = 1
_TESTS_EXPLAINED = (
    "whiteness p: Ljung–Box test of the innovations; NIS/n: normalized innovations squared per sample, 1 if "
    "their size is right; outlying and disturbed samples, which are not left out, increase it. A p below "
    "0.01 means that the model does not fit."
)


@dataclasses.dataclass(frozen=True)
class ChiSquared:
    """A statistic with a χ² law if the model is right.

    Attributes:
        statistic, dof: its value and its degrees of freedom.
        p_value: probability of a value as extreme: of a larger one (whiteness), or two-sided (size).
    """

    statistic: float
    dof: int
    p_value: float


def _p_value(test: ChiSquared) -> str:
    if not test.dof:
        return ""
    return f"{test.p_value:.3f}" if test.p_value >= 0.001 else "< 0.001"


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class BiasTrack(ByValue):
    """Bias of one axis over time, by one filter or several. Arrays are in SI, [samples].

    Attributes:
        axis: the axis.
        rate: sample rate [Hz].
        samples: the filtered samples.
        bias, bias_std: bias of each sample as the filter estimates it, and its standard deviation.
        log_likelihood: log-likelihood of the samples [nats].
    """

    axis: Axis
    rate: float
    samples: Float[np.ndarray, " n"]
    bias: Float[np.ndarray, " n"]
    bias_std: Float[np.ndarray, " n"]
    log_likelihood: float

    @property
    def time(self) -> Float[np.ndarray, " n"]:
        """Time of each sample in s from the first."""
        return np.arange(len(self.samples)) / self.rate

    @property
    def bias_interval(self) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Ends of the 95 % interval of the bias at each sample."""
        half = TWO_SIDED_95 * self.bias_std
        return self.bias - half, self.bias + half

    def to_dataframe(self) -> pd.DataFrame:
        """Table in SI with one row per sample: axis, time, sample, bias with std and interval, and more."""
        import pandas as pd

        return pd.DataFrame(self._columns())

    def _columns(self) -> dict[str, Any]:
        low, high = self.bias_interval
        return {
            "axis": self.axis.name,
            "time": self.time,
            "sample": self.samples,
            "bias": self.bias,
            "bias_std": self.bias_std,
            "bias_lower_95": low,
            "bias_upper_95": high,
        }

    def _last_bias(self) -> Number:
        """The bias in the last sample with its standard deviation, in the usual unit."""
        scale = unit_scale(default_coefficient_unit(self.axis.sensor, 0.0))
        return Number(float(self.bias[-1]) / scale, float(self.bias_std[-1]) / scale)

    def __repr__(self) -> str:
        bias, unit = self._last_bias(), default_coefficient_unit(self.axis.sensor, 0.0)
        at_end = format_with_error(bias.value, bias.error)
        return f"<{type(self).__name__} {self.axis.name}: bias at the end {at_end} {unit}>"


_T = TypeVar("_T", bound=BiasTrack)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class BiasTracks(ByValue, PerAxis[_T]):
    """Bias of every axis of a recording over time.

    Attributes:
        name: the recording's name.
        results: one per axis.
    """

    name: str
    results: tuple[_T, ...]

    @presented
    def plot(
        self, axes: Sequence[str] | str | None = None, path: str | os.PathLike[str] | None = None
    ) -> Figure:
        """Draw the bias with its 95 % band over the samples, and innovations or models below.

        See `plot_bias_tracks`.
        """
        raise NotImplementedError

    def _heads(self, sensor: Sensor) -> tuple[str, ...]:
        return "axis", f"bias at the end ± 1σ ({default_coefficient_unit(sensor, 0.0)})"


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class FilteredAxis(BiasTrack):
    """Result of a Kalman filter for one axis. Arrays are in SI, [samples] or [samples, states].

    Attributes:
        axis, rate, samples: see `BiasTrack`.
        bias, bias_std: the constant plus the sum of the slow terms (`slow`), and its standard deviation.
        log_likelihood: exact; with an unknown constant, that of the samples' differences.
        model: the noise model.
        missing: samples that the filter did not use.
        constant, constant_std: the constant after all samples (for a walk, where it began).
        states, state_stds: states of the noise model.
        names, units: names and units of the states.
        slow: labels of the terms that are drift.
        innovation, innovation_std: samples less their predictions from earlier ones, and their standard
            deviation; NaN where a sample is missing, and at the first if the constant is unknown.
        smoothed: whether bias and states are estimated from all samples, not only from those up to each.
    """

    model: Model
    missing: Bool[np.ndarray, " n"]
    constant: float
    constant_std: float
    states: Float[np.ndarray, "n states"]
    state_stds: Float[np.ndarray, "n states"]
    names: tuple[str, ...]
    units: tuple[str, ...]
    slow: tuple[str, ...]
    innovation: Float[np.ndarray, " n"]
    innovation_std: Float[np.ndarray, " n"]
    smoothed: bool = False

    @property
    def standardized(self) -> Float[np.ndarray, " n"]:
        """Innovations over their standard deviations: unit white noise if the model is right."""
        return self.innovation / self.innovation_std

    @property
    def log_density(self) -> Float[np.ndarray, " n"]:
        """Logarithms of the innovations' densities; zero for samples without an innovation."""
        return np.nan_to_num(log_densities(self.innovation, self.innovation_std**2))

    @property
    def whiteness(self) -> ChiSquared:
        """Portmanteau test of Ljung and Box (1978, Biometrika 65:297) that innovations are white.

        Q = n(n + 2) Σ r_d²/(n − d) over lags d up to 40, n − d being the number of existing pairs.
        """
        u, there = np.nan_to_num(self.standardized), np.isfinite(self.standardized).astype(float)
        n, power = int(there.sum()), float(u @ u)
        lags = min(_LAGS, int(_SHARE * n))
        if lags < 1:
            return ChiSquared(math.nan, 0, math.nan)
        total = 0.0
        for d in range(1, lags + 1):
            pairs = max(float(there[d:] @ there[:-d]), 1.0)
            total += (float(u[d:] @ u[:-d]) / power) ** 2 / pairs
        statistic = n * (n + 2.0) * total
        return ChiSquared(statistic, lags, float(upper_tail(statistic, lags)))

    @property
    def nis(self) -> ChiSquared:
        """Two-sided test that innovations are as large as the filter predicts: normalized squares Σ e²/s.

        χ² with one degree of freedom per sample.
        """
        u = self.standardized[np.isfinite(self.standardized)]
        statistic = float(u @ u)
        above = float(upper_tail(statistic, len(u)))
        return ChiSquared(statistic, len(u), min(2.0 * min(above, 1.0 - above), 1.0))

    def _columns(self) -> dict[str, Any]:
        own = {
            "sample": np.where(self.missing, np.nan, self.samples),
            "innovation": self.innovation,
            "innovation_std": self.innovation_std,
        }
        for name, x, std in zip(self.names, self.states.T, self.state_stds.T, strict=True):
            own |= {name: x, f"{name}_std": std}
        return super()._columns() | own

    def rows(self) -> list[tuple[Cell, ...]]:
        """The row of the printed table: bias at the end, tests, log-likelihood, missing samples."""
        size, lost = self.nis, int(self.missing.sum())
        tests = (_p_value(self.whiteness), f"{size.statistic / max(size.dof, 1):.3f}", _p_value(size))
        others = (f"{self.log_likelihood:,.0f}", f"{lost:,}" if lost else "")
        return [(self.axis.name, self._last_bias(), *tests, *others)]

    def to_dict(self) -> dict[str, Any]:
        """Bias in the last sample and tests as plain dictionaries, in SI; None for undefined numbers."""
        tests = {"whiteness": self.whiteness, "nis": self.nis}
        return {
            "axis": self.axis.name,
            "smoothed": self.smoothed,
            "bias": float(self.bias[-1]),
            "bias_std": finite_or_none(self.bias_std[-1]),
            "drift": list(self.slow),
            **{name: {k: finite_or_none(x) for k, x in vars(of).items()} for name, of in tests.items()},
            "log_likelihood": self.log_likelihood,
            "missing": int(self.missing.sum()),
            "samples": len(self.samples),
        }


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Filtered(BiasTracks[FilteredAxis]):
    """Results of a Kalman filter for every axis of a recording."""

    @property
    def log_likelihood(self) -> float:
        """Log-likelihood [nats] of all axes, taken as independent."""
        return sum(result.log_likelihood for result in self.results)

    def to_dict(self) -> dict[str, Any]:
        """The result of each axis as plain dictionaries, in SI."""
        axes = [result.to_dict() for result in self.results]
        known = {"name": self.name, "rate_hz": self.results[0].rate}
        return {"schema_version": SCHEMA_VERSION, **known, "axes": axes}

    def _heads(self, sensor: Sensor) -> tuple[str, ...]:
        tests = ("whiteness p", "NIS/n", "NIS p")
        return *super()._heads(sensor), *tests, "log-likelihood (nats)", "missing samples"

    def _title(self) -> str:
        first = self.results[0]
        length = duration(len(first.samples) / first.rate)
        kind = "smoother" if first.smoothed else "filter"
        return f"Kalman {kind}, {length} at {first.rate:g} Hz"

    def _notes(self) -> list[str]:
        drifts: dict[str, list[str]] = {}
        for result in self.results:
            terms = title_of(" + ".join(["constant", *result.slow]), result.axis.sensor)
            drifts.setdefault(terms, []).append(result.axis.name)
        bias = "; ".join(f"{terms} ({', '.join(axes)})" for terms, axes in drifts.items())
        return [f"model of the bias: {bias}", _TESTS_EXPLAINED]


def kalman_filter(
    recording: RecordingLike,
    models: Modelling,
    *,
    smooth: bool = False,
    constant_std: float | None = None,
    missing: Bool[np.ndarray, "samples axes"] | Bool[np.ndarray, " samples"] | None = None,
    rate: float | None = None,
    gyro_unit: str | None = None,
    accel_unit: str | None = None,
) -> Filtered:
    """Filter every axis of a recording with the state space of its noise model (Hou 2004, 3.1–3.17).

    The state x_{k+1} = A x_k + w_k (3.1) and the sample z_k = H x_k + v_k + b (3.2), with w and v white and
    normal (3.3, 3.4), are those of `Model.state_space`; b is a constant. The a priori errors and covariances
    (3.5–3.8) follow from (3.13) x⁻ = A x and (3.14) P⁻ = A P Aᵀ + Q, the a posteriori ones from the gain
    (3.10, 3.15) K = P⁻Hᵀ(H P⁻Hᵀ + R)⁻¹, x = x⁻ + K(z − H x⁻ − b) (3.9, 3.16) and P = (I − K H)P⁻ (3.17).
    There is no control input (B u). As R → 0 the gain trusts the samples
    (3.11), as P⁻ → 0 the prediction (3.12).

    Exact for a Gaussian process. Bias instability and power laws are sums of Gauss–Markov processes within
    3 %.

    Args:
        recording: what `read` returns; or samples [samples, axes], a data frame, or a file's path. Samples
            in `Recording.missing` are not used.
        models: a model with all its values, or its text, for all axes; models by the names of axes; or a fit.
        smooth: whether bias and states are estimated from all samples (Rauch, Tung & Striebel 1965).
        constant_std: prior standard deviation of the constant b about zero [rad/s or m/s²]; None if nothing
            is known about it, 0 if there is no constant.
        missing: further samples that the filter must not use.
        rate, gyro_unit, accel_unit: rate and units of an array, as for `fit`.

    Raises:
        AllanjaxError: an axis without a model, a parameter without a value, a model that leaves no noise in a
            sample, a term without a state space (see `Model.state_space`); a mask of another shape, or of
            all samples of an axis.
    """
    used, lost = _prepared(recording, constant_std, missing, rate, gyro_unit, accel_unit)
    results = (
        _filtered(used, k, model_of(models, axis), lost[:, k], smooth, constant_std)
        for k, axis in enumerate(used.axes)
    )
    return Filtered(used.name, tuple(results))


def _prepared(
    given: RecordingLike,
    constant_std: float | None,
    missing: Bool[np.ndarray, "samples axes"] | Bool[np.ndarray, " samples"] | None,
    *options: Any,
) -> tuple[Recording, Bool[np.ndarray, "samples axes"]]:
    """Recording, and samples that a filter does not use: those missing in it, and others that are given."""
    recording = as_recording(given, *options)
    if constant_std is not None and not 0.0 <= constant_std < np.inf:
        raise AllanjaxError(f"constant_std must be None, or finite and at least 0, not {constant_std}")
    shape = recording.values.shape
    lost = np.zeros(shape, bool) if recording.missing is None else recording.missing
    further = np.zeros(shape[:1], bool) if missing is None else np.asarray(missing, bool)
    further = further[:, None] if further.ndim == 1 else further
    if further.shape not in (shape, (shape[0], 1)):
        raise AllanjaxError(f"missing must have the shape {shape} or ({shape[0]},), not {further.shape}")
    lost = lost | further
    for name, of_axis in zip(recording.names, lost.T, strict=True):
        if of_axis.all():
            raise AllanjaxError(f"{name}: all samples are missing, so there is nothing to filter")
    return recording, lost


def _filtered(
    recording: Recording,
    k: int,
    model: Model,
    missing: Bool[np.ndarray, " n"],
    smooth: bool,
    constant_std: float | None,
) -> FilteredAxis:
    """Result of one axis."""
    axis, z, rate = recording.axes[k], recording.values[:, k], recording.rate
    n, there = len(z), ~missing
    of_axis = FilterModel.of(model, rate, n / rate, axis.sensor)
    size, offset = of_axis.space.size, float(z[there].mean())
    system = padded(of_axis.space, of_axis.drift)
    record = in_blocks(z - offset, missing)
    innovations, estimates, states = run_filter(system, record)
    e, std = (np.asarray(x)[:n] for x in innovations)
    if not np.all(std[there] > 0.0):
        raise AllanjaxError(
            f"the samples are not random under {model!r}: add a noise term, e.g. AngleRandomWalk(…)"
        )
    constant = Constant.of(e, std, there, constant_std, offset)
    if smooth:
        estimates = run_smoother(system, states, record)
    values, stds = constant.added_to(estimates, smooth)
    return FilteredAxis(
        axis=axis,
        rate=rate,
        model=model,
        samples=z,
        missing=missing,
        bias=values[:, -1] + offset,
        bias_std=stds[:, -1],
        constant=float(constant.value[-1]) + offset,
        constant_std=float(np.sqrt(constant.variance[-1])),
        states=values[:, :size],
        state_stds=stds[:, :size],
        names=of_axis.space.names,
        units=of_axis.space.units,
        slow=of_axis.slow,
        innovation=constant.innovation,
        innovation_std=constant.innovation_std,
        log_likelihood=float(np.nansum(log_densities(constant.innovation, constant.innovation_std**2))),
        smoothed=smooth,
    )


# Adaptive bank of Kalman filters (Magill 1965; Hou 2004, 3.4.4): models weighted by their innovations.
#
# Every model has its own filter. A model's weight after a sample is proportional to its weight before, times
# the density of its innovation: the weights are the models' probabilities. In Magill's bank and the thesis
# the true model never changes, and the weights of the others go to zero for good; here it may change, with a
# stated probability per second, so that a model can return. The models are then the states of a Markov chain,
# whose probabilities given all samples show when it changed. (A filter does not know about the change and
# takes as long as its own memory to adapt.)


@dataclasses.dataclass(frozen=True)
class Change:
    """A change of the most probable model.

    Attributes:
        time: when [s from the first sample].
        before, after: labels of the models.
    """

    time: float
    before: str
    after: str


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class AdaptedAxis(BiasTrack):
    """Result of a bank of filters for one axis. Arrays are in SI.

    Attributes:
        axis, rate, samples: see `BiasTrack`.
        bias, bias_std: weighted average of the filters' biases, and its standard deviation, from that of
            each filter and the spread between them.
        log_likelihood: log-likelihood under the bank [nats].
        labels: names of the models.
        weights: probability of each model given the samples up to each, [samples, models].
        probability: probability of each model given all samples, [samples, models].
        switching: probability of a change per second.
    """

    labels: tuple[str, ...]
    weights: Float[np.ndarray, "n models"]
    probability: Float[np.ndarray, "n models"]
    switching: float

    @property
    def changes(self) -> tuple[Change, ...]:
        """Changes of the most probable model, given all samples."""
        best = np.argmax(self.probability, axis=1)
        places = np.flatnonzero(np.diff(best)) + 1
        return tuple(
            Change(float(k / self.rate), self.labels[best[k - 1]], self.labels[best[k]]) for k in places
        )

    def _columns(self) -> dict[str, Any]:
        own: dict[str, Any] = {}
        for k, label in enumerate(self.labels):
            own |= {f"weight_{label}": self.weights[:, k], f"probability_{label}": self.probability[:, k]}
        return super()._columns() | own

    def rows(self) -> list[tuple[Cell, ...]]:
        """The row of the printed table: bias, most probable model and its weight, number of changes."""
        best = int(np.argmax(self.weights[-1]))
        weight = f"{self.weights[-1, best]:.3f}"
        return [(self.axis.name, self._last_bias(), self.labels[best], weight, str(len(self.changes)))]


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Adapted(BiasTracks[AdaptedAxis]):
    """Results of a bank of filters for every axis of a recording."""

    def _heads(self, sensor: Sensor) -> tuple[str, ...]:
        return *super()._heads(sensor), "most probable model", "its weight", "changes"

    def _title(self) -> str:
        first = self.results[0]
        models = f"{len(first.labels)} models, changes at {plain(first.switching)} per second"
        return f"adaptive filter, {models}"

    def _notes(self) -> list[str]:
        changes = ((r.axis.name, c) for r in self.results for c in r.changes)
        return [f"{name}: {c.before} → {c.after} at {duration(c.time)}" for name, c in changes]


def adaptive_filter(
    recording: RecordingLike,
    models: Mapping[str, Modelling] | Sequence[Modelling],
    *,
    switching: float = 1e-3,
    constant_std: float | None = None,
    missing: Bool[np.ndarray, "samples axes"] | Bool[np.ndarray, " samples"] | None = None,
    rate: float | None = None,
    gyro_unit: str | None = None,
    accel_unit: str | None = None,
) -> Adapted:
    """Filter every axis with several models, weighted by how well they predict it (Magill; Hou 2004, 3.4.4).

    Args:
        recording, constant_std, missing, rate, gyro_unit, accel_unit: as for `kalman_filter`.
        models: models by name, each as `kalman_filter` takes it; or a sequence of them, which are named
            "model 1", ….
        switching: probability per second that the true model changes to any other; 0 for Magill's bank, in
            which it never does.

    Raises:
        AllanjaxError: fewer than two models, or one that `kalman_filter` refuses; a probability that is
            negative or too large.
    """
    used, lost = _prepared(recording, constant_std, missing, rate, gyro_unit, accel_unit)
    if not isinstance(models, Mapping):
        models = {f"model {k + 1}": model for k, model in enumerate(models)}
    if len(models) < 2:
        raise AllanjaxError("an adaptive filter needs at least two models; for one, use kalman_filter")
    if not 0.0 <= switching / used.rate < 0.5:
        raise AllanjaxError(
            f"switching, the probability of a change per second, must be at least 0 and below half the "
            f"sample rate, {used.rate / 2:g}, not {switching}"
        )
    results = (_adapted(used, k, models, lost[:, k], switching, constant_std) for k in range(len(used.axes)))
    return Adapted(used.name, tuple(results))


def _adapted(
    recording: Recording,
    k: int,
    models: Mapping[str, Modelling],
    missing: Bool[np.ndarray, " n"],
    switching: float,
    constant_std: float | None,
) -> AdaptedAxis:
    """Result of one axis."""
    own = [model_of(model, recording.axes[k]) for model in models.values()]
    filters = [_filtered(recording, k, model, missing, False, constant_std) for model in own]
    bias, std, density = (
        np.stack([getattr(one, name) for one in filters], axis=1)
        for name in ("bias", "bias_std", "log_density")
    )
    change = np.asarray(switching / recording.rate)
    weights, probability, total = (np.asarray(x) for x in _weighed(density, change))
    blended = np.sum(weights * bias, axis=1)
    spread = np.sum(weights * (std**2 + (bias - blended[:, None]) ** 2), axis=1)
    return AdaptedAxis(
        axis=recording.axes[k],
        rate=recording.rate,
        samples=recording.values[:, k],
        labels=tuple(models),
        weights=weights,
        probability=probability,
        bias=blended,
        bias_std=np.sqrt(spread),
        log_likelihood=float(total),
        switching=switching,
    )


@eqx.filter_jit
def _weighed(
    density: Float[np.ndarray, "n models"], change: Float[np.ndarray, ""]
) -> tuple[Float[Array, "n models"], Float[Array, "n models"], Float[Array, ""]]:
    """Probabilities of the models given the samples up to each and given all, and the likelihood of all.

    Args:
        density: logarithms of each innovation's density.
        change: probability of a change between two samples.
    """
    log = jnp.asarray(density)
    count = log.shape[1]
    to_another = jnp.log(change / (count - 1))
    stays = jnp.log1p(-change * count / (count - 1))

    def mixed(weights: Array) -> Array:
        """Logarithms of weights after a chance of a change, from normalized ones."""
        return jnp.logaddexp(stays + weights, to_another)

    def forward(weights: Array, here: Array) -> tuple[Array, tuple[Array, Array]]:
        new = mixed(weights) + here
        total = jax.nn.logsumexp(new)
        return new - total, (new - total, total)

    def backward(later: Array, here: Array) -> tuple[Array, Array]:
        new = mixed(later + here - jax.nn.logsumexp(later + here))
        return new, later

    even = jnp.full(count, -jnp.log(float(count)))
    _, (weights, totals) = jax.lax.scan(forward, even, log)
    _, later = jax.lax.scan(backward, jnp.zeros(count), log, reverse=True)
    return jnp.exp(weights), jax.nn.softmax(weights + later, axis=1), jnp.sum(totals)
