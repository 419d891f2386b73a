"""Kalman filter and smoother of a recording, driven by a noise model."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from allanjax.base.errors import AllanjaxError
from allanjax.base.wording import duration, plain
from allanjax.kalman.likelihood import Constant
from allanjax.kalman.recursion import (
    FilterModel,
    Rows,
    in_blocks,
    padded,
    room_for,
    run_bank,
    run_filter,
    run_smoother,
    stacked,
)
from allanjax.kalman.result import BiasTrack, BiasTracks, Filtered, FilteredAxis
from allanjax.noise.model import Model
from allanjax.noise.notation import ModelLike, as_model
from allanjax.record.io.given import RecordingLike, as_recording
from allanjax.record.recording import Axis, Recording

#: A model for all axes; or one for each by its name, as a fit and `critique.models` have them.
ModelsLike: TypeAlias = ModelLike | Mapping[str, Any]


def kalman_filter(
    recording: RecordingLike,
    models: ModelsLike,
    *,
    smooth: bool = False,
    constant_std: float | None = None,
    missing: Bool[np.ndarray, "samples axes"] | Bool[np.ndarray, " samples"] | None = None,
    rate: float | None = None,
    gyro_unit: str | None = None,
    accel_unit: str | None = None,
) -> Filtered:
    """Filter every axis of a recording by the state space of its noise model (Hou 2004, 3.1–3.17).

    The state x_{k+1} = A x_k + w_k (3.1) and the sample z_k = H x_k + v_k + b (3.2), with w and v white and
    normal (3.3, 3.4), are those of `Model.state_space`; b is a constant. The a priori errors and covariances
    (3.5–3.8) follow from (3.13) x⁻ = A x and (3.14) P⁻ = A P Aᵀ + Q, the a posteriori ones from the gain
    (3.10, 3.15) K = P⁻Hᵀ(H P⁻Hᵀ + R)⁻¹, x = x⁻ + K(z − H x⁻ − b) (3.9, 3.16) and P = (I − K H)P⁻ (3.17), here
    by factors of P (see `recursion`). There is no control input (B u). As R → 0 the gain trusts the samples
    (3.11), as P⁻ → 0 the prediction (3.12).

    Exact for a Gaussian process; gains that change slowly are interpolated to 10⁻⁶ (see `recursion`), which
    changes the likelihood of 200,000 samples by less than 10⁻⁸ nats. Bias instability and power laws are sums
    of Gauss–Markov processes within 3 %.

    Args:
        recording: what `read` returns; or samples [samples, axes], a data frame, or a file's path. Samples
            that are `Recording.missing` are not seen by the filter.
        models: a model with all its values, for all axes, or as text; a fit; or a mapping from axes to
            either.
        smooth: whether bias and states are estimated from all samples (Rauch, Tung & Striebel 1965).
        constant_std: standard deviation of the constant b about zero [rad/s or m/s²] before the first
            sample; None if nothing is known of it, 0 if there is none.
        missing: further samples that the filter is not to see.
        rate, gyro_unit, accel_unit: of an array, as for `fit`.

    Raises:
        AllanjaxError: an axis without a model, a parameter without a value, a model that leaves no noise in a
            sample, a term without a state space (see `Model.state_space`); a mask of another shape.
    """
    recording = as_recording(recording, rate, gyro_unit, accel_unit)
    if constant_std is not None and not 0.0 <= constant_std < np.inf:
        raise AllanjaxError(
            f"constant_std must be finite and not negative, or None if unknown; got {constant_std}"
        )
    lost = missing_of(recording, missing)
    axes = enumerate(recording.axes)
    results = (
        _filtered(recording, k, model_of(models, axis), lost[:, k], smooth, constant_std) for k, axis in axes
    )
    return Filtered(recording.name, tuple(results))


def model_of(models: ModelsLike, axis: Axis) -> Model:
    """The model of an axis, from one for all, or of its own; the fitted one of a fit.

    Raises:
        AllanjaxError: there is none for this axis; a parameter without a value.
    """
    found: Any = models
    if isinstance(models, Mapping):
        if axis.name not in models:
            raise AllanjaxError(f"there is no model for {axis.name}, only for {', '.join(models)}")
        found = models[axis.name]
    # A fit of an axis has its model.
    fitted = getattr(found, "model", None)
    model = as_model(fitted if isinstance(fitted, Model) else found, [axis])
    model.check_complete()
    return model


def missing_of(
    recording: Recording, missing: Bool[np.ndarray, "samples axes"] | Bool[np.ndarray, " samples"] | None
) -> Bool[np.ndarray, "samples axes"]:
    """Samples that a filter does not see: those of the recording, and others. Not all of an axis."""
    shape = recording.values.shape
    found = np.zeros(shape, bool) if recording.missing is None else recording.missing
    given = np.zeros(shape[:1], bool) if missing is None else np.asarray(missing, bool)
    given = given[:, None] if given.ndim == 1 else given
    if given.shape not in (shape, (shape[0], 1)):
        raise AllanjaxError(f"missing must have the shape {shape} or ({shape[0]},), not {given.shape}")
    found = found | given
    for name, lost in zip(recording.names, found.T, strict=True):
        if lost.all():
            raise AllanjaxError(f"{name}: all samples are missing, there is nothing to filter")
    return found


def check_noise(std: Float[np.ndarray, "*models n"], there: Bool[np.ndarray, " n"], model: Model) -> None:
    """Raise AllanjaxError if a sample has no scatter under the model."""
    if not np.all(std[..., there] > 0.0):
        raise AllanjaxError(
            f"{model!r} leaves nothing random in a sample: add a noise term, AngleRandomWalk(…)"
        )


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
    room, size = room_for([of_axis.space]), of_axis.space.size
    # All states, so that programs are those of their room.
    rows = np.concatenate([np.eye(room, size), of_axis.drift[None]])
    system, offset = padded(of_axis.space, rows, room), float(z[there].mean())
    record = in_blocks(z - offset, missing)
    innovations, told, states = run_filter(system, record)
    e, std = (np.asarray(x)[:n] for x in innovations)
    check_noise(std, there, model)
    constant = Constant.of(e, std, there, constant_std, offset)
    value, variance = constant.value, constant.variance
    if smooth:
        told = run_smoother(system, states, record)
        value, variance = np.full(n, value[-1]), np.full(n, variance[-1])
    told = jax.tree.map(lambda x: np.asarray(x)[:n], told)
    states_found, state_stds = with_constant(told, value, variance, 0.0)
    drift, drift_std = (x[:, -1] for x in with_constant(told, value, variance, 1.0))
    return FilteredAxis(
        axis=axis,
        rate=rate,
        model=model,
        samples=z,
        missing=missing,
        bias=drift + offset,
        bias_std=drift_std,
        constant=float(constant.value[-1]) + offset,
        constant_std=float(np.sqrt(constant.variance[-1])),
        states=states_found[:, :size],
        state_stds=state_stds[:, :size],
        names=of_axis.space.names,
        units=of_axis.space.units,
        slow=of_axis.slow,
        innovation=constant.innovation,
        innovation_std=constant.innovation_std,
        log_likelihood=constant.log_likelihood,
        smoothed=smooth,
    )


def with_constant(
    rows: Rows, value: Float[np.ndarray, " n"], variance: Float[np.ndarray, " n"], share: float
) -> tuple[Float[np.ndarray, "n rows"], Float[np.ndarray, "n rows"]]:
    """Rows, with a share of the constant in them, and their standard deviations, for an unknown constant."""
    moved = share - np.asarray(rows.value[:, :, 1])
    known = np.isfinite(variance)[:, None]
    added = np.where(moved == 0.0, 0.0, moved**2 * np.where(known, variance[:, None], np.inf))
    return rows.value[:, :, 0] + moved * value[:, None], np.sqrt(np.asarray(rows.std) ** 2 + added)


# Adaptive bank of Kalman filters (Magill 1965; Hou 2004, 3.4.4): models weighed by their innovations.
#
# Every model has a filter of its own. Before a sample the models have weights; the density of the
# innovation of each, times its weight, is its weight after the sample: the weights are the models'
# probabilities. As Magill and the thesis have it the true model is one for all the time, and the weights of
# others go to zero for good; here it may change, with a stated probability per second, so that a model can
# come back. The models are then the states of a Markov chain, whose probabilities by all samples say when
# it changed. (A filter does not know of the change: after one it needs as long as its own memory.)


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
    """What a bank of filters says of one axis. All is in SI.

    Attributes:
        axis, rate, samples: see `BiasTrack`.
        bias, bias_std: the filters' biases, blended by the weights, and their spread: that of each, and
            between them.
        log_likelihood: under the bank.
        labels: of the models.
        weights: probability of each model by the samples up to each, [samples, models].
        probability: the same by all samples.
        switching: probability of a change per second.
    """

    labels: tuple[str, ...]
    weights: Float[np.ndarray, "n models"]
    probability: Float[np.ndarray, "n models"]
    switching: float

    @property
    def changes(self) -> tuple[Change, ...]:
        """Changes of the most probable model, by all samples."""
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

    def _told(self) -> list[tuple[str, str]]:
        last = sorted(zip(self.weights[-1], self.labels, strict=True), reverse=True)
        changed = [f"{c.before} → {c.after} at {duration(c.time)}" for c in self.changes]
        return [
            ("bias at the end", self._last_bias()),
            ("weights at the end", ", ".join(f"{label} {plain(w, 3)}" for w, label in last)),
            ("changes", "; ".join(changed) or f"none: {last[0][1]} throughout"),
        ]

    def __repr__(self) -> str:
        return f"<AdaptedAxis {self.axis.name}: {self._told()[2][1]}>"


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Adapted(BiasTracks[AdaptedAxis]):
    """What a bank of filters says of every axis of a recording."""

    CALLED: ClassVar[str] = "the adaptive filter"

    def _title(self) -> str:
        first = self.results[0]
        models = f"{len(first.labels)} models, changes at {first.switching:g} per second"
        return f"{self.name or 'recording'}: adaptive filter, {models}"


def adaptive_filter(
    recording: RecordingLike,
    models: Mapping[str, ModelsLike] | Sequence[ModelsLike],
    *,
    switching: float = 1e-3,
    constant_std: float | None = None,
    missing: Bool[np.ndarray, "samples axes"] | Bool[np.ndarray, " samples"] | None = None,
    rate: float | None = None,
    gyro_unit: str | None = None,
    accel_unit: str | None = None,
) -> Adapted:
    """Filter every axis by several models, weighed by how well they predict it (Magill; Hou 2004, 3.4.4).

    Args:
        recording, constant_std, missing, rate, gyro_unit, accel_unit: as for `kalman_filter`.
        models: models by their labels, each as `kalman_filter` takes it; or a sequence of them, called
            "model 1", ….
        switching: probability per second that the true model changes to any other; 0 for Magill's bank, in
            which it never does.

    Raises:
        AllanjaxError: fewer than two models, or one that `kalman_filter` would refuse; a probability that is
            negative, or not below one a sample.
    """
    recording = as_recording(recording, rate, gyro_unit, accel_unit)
    if not isinstance(models, Mapping):
        models = {f"model {k + 1}": model for k, model in enumerate(models)}
    if len(models) < 2:
        raise AllanjaxError("an adaptive filter weighs at least two models; kalman_filter takes one")
    if not 0.0 <= switching / recording.rate < 0.5:
        raise AllanjaxError(
            f"the probability of a change, {switching} per second, must be at least 0 and below half a "
            f"sample's, {recording.rate / 2:g}"
        )
    lost = missing_of(recording, missing)
    results = (
        _adapted(recording, k, models, lost[:, k], switching, constant_std)
        for k in range(len(recording.axes))
    )
    return Adapted(recording.name, tuple(results))


def _adapted(
    recording: Recording,
    k: int,
    models: Mapping[str, ModelsLike],
    missing: Bool[np.ndarray, " n"],
    switching: float,
    constant_std: float | None,
) -> AdaptedAxis:
    """Result of one axis."""
    axis, z, rate = recording.axes[k], recording.values[:, k], recording.rate
    n, there = len(z), ~missing
    offset = float(z[there].mean())
    own = [model_of(model, axis) for model in models.values()]
    of_axis = [FilterModel.of(model, rate, n / rate, axis.sensor) for model in own]
    room = room_for([m.space for m in of_axis])
    systems = stacked([padded(m.space, m.drift[None], room) for m in of_axis])
    innovations, rows = jax.device_get(run_bank(systems, in_blocks(z - offset, missing)))
    density, bias, variance = (np.zeros((n, len(own))) for _ in range(3))
    for j, model in enumerate(own):
        e, std = innovations.value[j, :n], innovations.std[j, :n]
        check_noise(std, there, model)
        constant = Constant.of(e, std, there, constant_std, offset)
        u, s = constant.innovation, constant.innovation_std
        seen = np.isfinite(s)
        density[seen, j] = -0.5 * (np.log(2.0 * math.pi * s[seen] ** 2) + (u[seen] / s[seen]) ** 2)
        told = Rows(rows.value[j, :n], rows.std[j, :n])
        found = with_constant(told, constant.value, constant.variance, 1.0)
        bias[:, j], variance[:, j] = found[0][:, 0], found[1][:, 0] ** 2
    weights, probability, total = (np.asarray(x) for x in _weighed(density, np.asarray(switching / rate)))
    blended = np.sum(weights * bias, axis=1)
    spread = np.sum(weights * (variance + (bias - blended[:, None]) ** 2), axis=1)
    return AdaptedAxis(
        axis=axis,
        rate=rate,
        samples=z,
        labels=tuple(models),
        weights=weights,
        probability=probability,
        bias=blended + offset,
        bias_std=np.sqrt(spread),
        log_likelihood=float(total),
        switching=switching,
    )


@eqx.filter_jit
def _weighed(
    density: Float[np.ndarray, "n models"], change: Float[np.ndarray, ""]
) -> tuple[Float[Array, "n models"], Float[Array, "n models"], Float[Array, ""]]:
    """Probabilities of the models by the samples up to each and by all, and the likelihood of all.

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
