"""Adaptive bank of Kalman filters (Magill 1965; Hou 2004, 3.4.4): models weighed by their innovations.

Every model has a filter of its own. Before a sample the models have weights; the density of the innovation
of each, times its weight, is its weight after the sample: the weights are the models' probabilities. As
Magill and the thesis have it the true model is one for all the time, and the weights of others go to zero
for good; here it may change, with a stated probability per second, so that a model can come back. The models
are then the states of a Markov chain, whose probabilities by all samples say when it changed. (A filter does
not know of the change: after one it needs as long as its own memory.)
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from allanjax.base.errors import AllanjaxError
from allanjax.base.wording import duration, plain
from allanjax.kalman.filtering import ModelsLike, check_noise, missing_of, model_of, with_constant
from allanjax.kalman.likelihood import Constant
from allanjax.kalman.recursion import FilterModel, Rows, in_blocks, padded, room_for, run_bank, stacked
from allanjax.kalman.result import BiasTrack, BiasTracks
from allanjax.record.io.given import RecordingLike, as_recording
from allanjax.record.recording import Recording


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
