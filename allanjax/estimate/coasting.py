"""Errors of a filter that knows white noise and one process of its bias only, while it coasts.

The filter has seen the sensor at rest for long, and has an estimate of the bias by a steady-state Kalman
filter for samples z_k = b_k + v_k with b_{k+1} = φ b_k + w_k, variances R = N²·rate and Q. The bias is a
random walk, φ = 1 and Q = K²/rate, or a first-order Gauss–Markov process of correlation time T driven by
noise of density K², φ = e^{−1/(T·rate)} and Q = K²T/2·(1 − φ²):

    P = φ²PR/(P + R) + Q,    g = P/(P + R),    b̂_k = φ b̂_{k−1} + g(z_k − φ b̂_{k−1}).

Then it integrates for n samples of h seconds, less φ^j b̂. It predicts for the integral the variance

    h²[s_n² PR/(P + R) + Q Σ_{k≤n} (s_k/φ)² + nR],    s_k = φ + … + φ^k,

which is right if the noise is as it believes. What it is for any other noise follows from the states of the
noise and b̂ together (Gelb, Applied Optimal Estimation, 1974, 7.2: the suboptimal filter's true covariance).

A Gauss–Markov process returns to zero. To its filter the bias is counted from its mean over the record of
length D, which is known; about it a random walk has the variance K²D/6.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from allanjax.noise.model import Model
from allanjax.noise.state_space import Block, StateSpace, filtered_block, settled
from allanjax.noise.terms import DriftRamp, Sinusoid


class Filters(NamedTuple):
    """Filters of white noise and a process of the bias.

    Attributes:
        memory: N/K [s], over which a filter without mean reversion averages.
        correlation_time: that of the Gauss–Markov process [s], infinite of a walk.
        rate: sample rate [Hz].
    """

    memory: Float[np.ndarray, " g"]
    correlation_time: Float[np.ndarray, " g"]
    rate: float

    @classmethod
    def of_walk(cls, memory: Float[np.ndarray, " g"], rate: float) -> Filters:
        """Filters of a random walk."""
        return cls(memory, np.full(len(memory), np.inf), rate)

    @classmethod
    def of_markov(
        cls, memory: Float[np.ndarray, " m"], correlation_time: Float[np.ndarray, " c"], rate: float
    ) -> Filters:
        """Filters of every pair of a memory and a correlation time."""
        pairs = np.meshgrid(memory, correlation_time, indexing="ij")
        return cls(pairs[0].ravel(), pairs[1].ravel(), rate)

    @property
    def kept(self) -> Float[np.ndarray, " g"]:
        """φ, what is left of a bias after a sample."""
        return np.exp(-1.0 / (self.correlation_time * self.rate))

    @property
    def drive(self) -> Float[np.ndarray, " g"]:
        """Q/R, the variance of the bias's noise over that of a sample."""
        walk = (1.0 / (self.memory * self.rate)) ** 2
        x = 2.0 / (self.correlation_time * self.rate)
        return walk * np.where(x > 0.0, -np.expm1(-x) / np.where(x > 0.0, x, 1.0), 1.0)

    @property
    def gain(self) -> Float[np.ndarray, " g"]:
        """The gain g."""
        half = (self.drive + np.expm1(-2.0 / (self.correlation_time * self.rate))) / 2.0
        root = np.sqrt(half**2 + self.drive)
        # Of two forms the one without cancellation.
        P = np.where(half > 0.0, half + root, self.drive / (root - np.minimum(half, 0.0)))
        return P / (P + 1.0)

    def sums(
        self, steps: Float[np.ndarray, " t"]
    ) -> tuple[Float[np.ndarray, "g t"], Float[np.ndarray, "g t"]]:
        """s_n, and Σ_{k≤n} (s_k/φ)², after so many samples."""
        count, at = int(steps[-1]), steps.astype(int) - 1
        unique, which = np.unique(self.correlation_time, return_inverse=True)
        shares, squares = np.empty((2, len(unique), len(steps)))
        for k, time in enumerate(unique):
            kept = np.exp(-np.arange(count) / (time * self.rate))
            one = np.cumsum(kept)
            shares[k] = one[at] * np.exp(-1.0 / (time * self.rate))
            squares[k] = np.cumsum(one**2)[at]
        return shares[which], squares[which]


def predicted(filters: Filters, steps: Float[np.ndarray, " t"]) -> Float[np.ndarray, "g t"]:
    """Variance of the integral that filters of N = 1 predict after so many samples."""
    share, squares = filters.sums(steps)
    # The variance of b̂ after its update is PR/(P + R) = gR.
    own = share**2 * filters.gain[:, None] + filters.drive[:, None] * squares + steps
    return own / filters.rate


def actual(
    model: Model,
    filters: Filters,
    steps: Float[np.ndarray, " t"],
    duration: float,
    known: dict[str, np.ndarray] | None = None,
) -> Float[np.ndarray, "terms g t"]:
    """Variance of the integral's error [rad² or (m/s)²] after so many samples, of each term by itself.

    Args:
        model: the noise that there is.
        filters: whose error it is.
        steps: how many samples they integrate, in rising order.
        duration: how long the noise has gone on [s], for bias instability and the mean that is known.
        known: variances of terms that other sets have, too, for the same filters and times; it is added to.

    Raises:
        AllanjaxError: a term that has no state space.
    """
    labels = model.term_labels
    known = {} if known is None else known
    # One term at a time, and what it becomes after the response.
    alone = [model.without([*labels[:k], *labels[k + 1 :]]) for k in range(len(labels))]
    for one in alone:
        if repr(one) not in known:
            known[repr(one)] = _of_term(one, filters, steps, duration)
    return np.stack([known[repr(one)] for one in alone])


def _of_term(
    model: Model, filters: Filters, steps: Float[np.ndarray, " t"], duration: float
) -> Float[np.ndarray, "g t"]:
    """Variance of the integral's error for a model of one term."""
    (term,), rate = model.terms, filters.rate
    if isinstance(term, Sinusoid):
        return term.amplitude**2 / 2.0 * _line(term.frequency / rate, filters, steps) / rate**2
    if isinstance(term, DriftRamp):
        return (term.coefficient / rate**2) ** 2 * _ramp(filters, steps, duration)
    return _of_block(model.state_block(rate, duration), filters, steps, duration)


def _line(cycles: float, filters: Filters, steps: Float[np.ndarray, " t"]) -> Float[np.ndarray, "g t"]:
    """Squared response of the integral, in samples, to a line of so many cycles a sample."""
    z = np.exp(2j * np.pi * cycles)
    gain, share = filters.gain, filters.sums(steps)[0]
    estimate = gain / z / (1.0 - filters.kept * (1.0 - gain) / z)
    return np.abs((z**steps - 1.0) / (z - 1.0) - share * estimate[:, None]) ** 2


def _ramp(filters: Filters, steps: Float[np.ndarray, " t"], duration: float) -> Float[np.ndarray, "g t"]:
    """Mean square of the integral, in samples, of a ramp of one a sample about its mean over the record."""
    share, again = filters.sums(steps)[0], filters.kept * (1.0 - filters.gain)
    followed = (filters.gain / (1.0 - again))[:, None]
    # The estimate of a drifting bias lags behind.
    slope = steps * (steps + 1.0) / 2.0 + share * followed * (again / (1.0 - again))[:, None]
    # A walk's filter follows in full, but for rounding.
    missed = np.where(np.isinf(filters.correlation_time)[:, None], 0.0, steps - share * followed)
    return slope**2 + missed**2 * (duration * filters.rate) ** 2 / 12.0


def _of_block(
    block: Block, filters: Filters, steps: Float[np.ndarray, " t"], duration: float
) -> Float[np.ndarray, "g t"]:
    """Variance of the integral's error for noise of these states."""
    space = StateSpace.of(block, filters.rate, "gyro", "")
    sums = [space.sum_covariance(int(n)) for n in steps]
    seen = np.stack([transition[-1, :-1] for transition, _ in sums])
    added = np.array([noise[-1, -1] for _, noise in sums])
    A, n, found = block.transition, block.size, []
    # About its mean over the record a walk has the variance of a process that is forgotten in a third of it;
    # and so has, nearly, what is slower than the record.
    forgotten = np.append(np.full(n, np.exp(-3.0 / (duration * filters.rate))), 1.0)
    shares, again = filters.sums(steps)[0], filters.kept * (1.0 - filters.gain)
    for g, a, share, time in zip(filters.gain, again, shares, filters.correlation_time, strict=True):
        joint = filtered_block(block, np.array([g]), np.array([1.0, -a]), "estimate")
        if np.isinf(time):
            P = settled(joint.transition, joint.noise, joint.level)
        else:
            transition = joint.transition.copy()
            np.fill_diagonal(transition, np.diag(transition) * forgotten)
            P = settled(transition, joint.noise, np.zeros_like(joint.level))
        states = A @ P[:n, :n] @ A.T + block.noise
        shared = A @ P[:n, n]
        found.append(
            np.einsum("ti,ij,tj->t", seen, states, seen)
            - 2.0 * share * (seen @ shared)
            + share**2 * P[n, n]
            + added
        )
    return np.stack(found) / filters.rate**2


def equal_pair(truth: Float[np.ndarray, "g t"], unit: Float[np.ndarray, "g t"]) -> tuple[int, float, float]:
    """The filter whose prediction is closest to its true variance, its N, and the largest ratio of the two.

    At the last time they are equal; closest is in the largest ratio, either way, at the others. `unit` are
    the predictions for N = 1.
    """
    ratio = np.log(truth / unit)
    worst = np.abs(ratio - ratio[:, -1:]).max(axis=1)
    best = int(np.argmin(worst))
    return best, math.exp(ratio[best, -1] / 2.0), math.exp(worst[best])


def bounding_pair(truth: Float[np.ndarray, "g t"], unit: Float[np.ndarray, "g t"]) -> tuple[int, float]:
    """The filter whose prediction is nowhere below its true variance and least above it, and its N.

    Least in the mean of the logarithm over the times of their predicted variance.
    """
    scale = (truth / unit).max(axis=1)
    mean = np.log(scale) + np.log(unit).mean(axis=1)
    best = int(np.argmin(mean))
    return best, math.sqrt(float(scale[best]))


def coasting_steps(horizon: float, rate: float, count: int = 13) -> Float[np.ndarray, " t"]:
    """Numbers of samples from a hundredth of the horizon to the horizon [s], at least one."""
    last = max(round(horizon * rate), 1)
    return np.unique(np.round(np.geomspace(max(last / 100.0, 1.0), last, count)))


def memories(duration: float, rate: float, terms: Sequence[float] = (), count: int = 61) -> np.ndarray:
    """Times over which filters may average [s], from two samples to the record, and some given ones."""
    grid = np.geomspace(2.0 / rate, max(duration, 4.0 / rate), count)
    return np.unique(np.clip([*grid, *terms], grid[0], grid[-1]))
