"""Fit of a bump of the spectrum in fine bins, and of the powers of the noise conditional on it."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from allanjax.base.linalg import solve
from allanjax.critic.causes.spectral import fine_bins, non_negative, sums
from allanjax.critic.noise import Noise, density
from allanjax.critic.view import View
from allanjax.noise import terms

# Smallest quality factor during the fit; it may be lower than that of a bump that is accepted.
_LEAST_Q = 0.6
#: Coefficients below this one have drift in them; a bump narrower than this many is a line.
LOWEST, LINE = 16, 4.0
# Scoring of a bump: most steps, the change of likelihood [nats] that ends it, the damping that gives it up.
_STEPS, _CONVERGED, _STUCK = 60, 1e-3, 1e6
# Numbers of bins are rounded up to multiples of this, so that few programs are compiled.
_PADDED = 512
# Steps of scoring for the powers of the noise.
_SCORINGS = 4


class Spectrum:
    """Spectrum of a view in bins that are finer about a bump.

    A bump and the noise are estimated in turn, many times: here without any work on all coefficients.

    Args:
        view: view of the axis.
        start: logarithms of the approximate frequency [Hz] and quality factor of the bump.
        width: width of the window that shows it [coefficients].
        fold: coefficients that count; all of them by default.
    """

    def __init__(
        self,
        view: View,
        start: Float[np.ndarray, " 2"],
        width: float,
        fold: Bool[np.ndarray, " n-1"] | None = None,
    ) -> None:
        n, family = view.n, view.family
        self._view, self._spacing = view, view.rate / (2.0 * n)
        own = family.bins.edges[:-1] - 1
        place = float(np.exp(start[0])) / self._spacing
        # Each bin of the family consists of whole ones.
        self._first = np.union1d(fine_bins(n, place, max(width, 2.0)), own)
        self._own = np.searchsorted(self._first, own)
        self._used = np.ones(n - 1) if fold is None else fold.astype(float)
        self._size = sums(self._used, self._first)
        factor = view.combined(np.ones(n - 1))
        self._factor, self._frequency = self._mean(factor), self._mean(family.frequency)
        self._filter_response = 1.0 if view.filter_response is None else self._mean(view.filter_response)
        weight = self._used / factor
        products = (
            weight * view.coefficients**2,
            weight * family.ramp * view.coefficients,
            weight * family.ramp**2,
        )
        self._statistics = tuple(sums(z, self._first) for z in products)
        self._units: dict[tuple[str, int], Float[np.ndarray, " bins"]] = {}

    def _mean(self, values: Float[np.ndarray, " n-1"]) -> Float[np.ndarray, " bins"]:
        """Mean of values over each bin; 1 where nothing counts."""
        total = sums(self._used * values, self._first)
        return np.where(self._size > 0.0, total / np.maximum(self._size, 1.0), 1.0)

    def _level(self, noise: Noise) -> Float[np.ndarray, " bins"]:
        """Expected squares of the basic terms in the bins."""
        for name in noise.power:
            if (name, noise.index) not in self._units:
                self._units[name, noise.index] = self._mean(noise.family.unit(name, noise.index)[1])
        return np.sum([p * self._units[name, noise.index] for name, p in noise.power.items()], axis=0)

    def noise_given(self, theta: Float[np.ndarray, " 3"], noise: Noise) -> Noise:
        """Noise with its powers estimated conditional on a bump, whose size is relative to `noise`."""
        view, f0, Q, amplitude = self._view, *(float(x) for x in np.exp(theta))
        bump = density(terms.Resonance(amplitude, f0, Q).sampled(view.rate), self._frequency, view.rate)
        factor = 1.0 + view.rate * bump * self._filter_response / (self._level(noise) * self._factor)
        squares, cross, gram = (np.add.reduceat(z / factor, self._own) for z in self._statistics)
        size = np.maximum(np.add.reduceat(self._size, self._own), 1e-9)
        columns = np.stack([view.family.unit(name, noise.index)[0] for name in noise.power])
        power = np.array(list(noise.power.values()))
        for _ in range(_SCORINGS):
            mean = np.maximum(power @ columns, 1e-300)
            slope = np.sum(cross / mean) / np.sum(gram / mean) if noise.ramp else 0.0
            level = (squares - 2.0 * slope * cross + slope**2 * gram) / size
            power = non_negative(columns, level, np.sqrt(size) / mean)
        left = {name: p for name, p in zip(noise.power, power.tolist(), strict=True) if p > 0.0}
        return dataclasses.replace(noise, power=left)

    def fitted(
        self, noise: Noise, start: Float[np.ndarray, " 2"]
    ) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "3 3"]]:
        """Maximum-likelihood logarithms of frequency, quality factor and amplitude, and their covariance."""
        level, f0 = self._level(noise), float(np.exp(start[0]))
        # Compiled once for all bumps of records about as long.
        pad = -len(level) % _PADDED
        bins = _Bins(
            np.append(self._frequency, np.full(pad, self._frequency[-1])),
            np.append(self._size, np.zeros(pad)),
            np.append(self._statistics[0] / level, np.zeros(pad)),
            np.append(level * self._factor / self._filter_response, np.ones(pad)),
        )
        near = abs(np.log(bins.frequency / f0)) < max(1.5 / np.exp(start[1]), 4.0 * self._spacing / f0)
        rate = self._view.rate
        limits = np.array([LOWEST * self._spacing, rate / 2.0, LINE * self._spacing])
        found, information = (np.asarray(x) for x in _maximum(start, bins, near, limits, rate))
        if not np.isfinite(information).all():
            return found, np.full((3, 3), np.nan)
        values, vectors = np.linalg.eigh(information)
        return found, vectors @ np.diag(1.0 / np.maximum(values, 1e-4)) @ vectors.T


class _Bins(NamedTuple):
    """Whitened squares in fine bins: frequency, number, sum, and the level that whitened them."""

    frequency: Any
    size: Any
    squares: Any
    level: Any


# State of the scoring: steps done, θ, its loss, the damping, and the expected gain of a further step.
_Scoring = tuple[Array, Array, Array, Array, Array]


@eqx.filter_jit
def _maximum(
    start: Float[ArrayLike, " 2"],
    bins: _Bins,
    near: Bool[ArrayLike, " bins"],
    limits: Float[ArrayLike, " 3"],
    rate: float,
) -> tuple[Float[Array, " 3"], Float[Array, "3 3"]]:
    """Most likely logarithms of frequency, quality factor and amplitude, and their observed information.

    By Fisher's scoring, damped (Levenberg & Marquardt). The first amplitude explains the excess in bins
    `near`.
    """
    bins = _Bins(*map(jnp.asarray, bins))
    limits = jnp.asarray(limits)

    def shape(theta: Array) -> Array:
        term = terms.Resonance(1.0, jnp.exp(theta[0]), jnp.exp(theta[1])).sampled(rate)
        return rate * term.sampled_psd(bins.frequency, rate) / bins.level

    def log_ratio(theta: Array) -> Array:
        return jnp.log1p(jnp.exp(2.0 * theta[2]) * shape(theta))

    def loss(theta: Array) -> Array:
        u = log_ratio(theta)
        f, Q = jnp.exp(theta[0]), jnp.exp(theta[1])
        inside = (limits[0] < f) & (f < limits[1]) & (Q > _LEAST_Q) & (limits[2] * Q < f)
        return jnp.where(inside, 0.5 * jnp.sum(bins.size * u + bins.squares * jnp.exp(-u)), jnp.inf)

    def step(state: _Scoring) -> _Scoring:
        k, theta, value, damping, _ = state
        J = jax.jacfwd(log_ratio)(theta)
        gradient = 0.5 * (bins.size - bins.squares * jnp.exp(-log_ratio(theta))) @ J
        information = 0.5 * (J.T * bins.size) @ J
        damped = information + damping * jnp.diag(jnp.diag(information)) + 1e-9 * jnp.eye(3)
        change = solve(damped, gradient)
        tried = loss(theta - change)
        better = tried < value
        promise = jnp.where(better, value - tried, jnp.where(damping > _STUCK, 0.0, jnp.inf))
        return (
            k + 1,
            jnp.where(better, theta - change, theta),
            jnp.where(better, tried, value),
            damping * jnp.where(better, 0.2, 5.0),
            promise,
        )

    excess = jnp.sum(jnp.where(near, bins.squares - bins.size, 0.0))
    unit = jnp.sum(jnp.where(near, bins.size * shape(jnp.append(start, 0.0)), 0.0))
    first = jnp.append(start, 0.5 * jnp.log(jnp.maximum(excess, 1.0) / unit))
    state = (jnp.asarray(0), first, loss(first), jnp.asarray(1e-2), jnp.asarray(jnp.inf))
    _, theta, _, _, _ = jax.lax.while_loop(lambda s: (s[0] < _STEPS) & (s[4] > _CONVERGED), step, state)
    return theta, jax.hessian(loss)(theta)
