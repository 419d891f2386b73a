"""Errors of a filter that knows white noise and a random walk only, while it coasts.

The filter has seen the sensor at rest for long, and has an estimate of the bias by a steady-state Kalman
filter for samples z_k = b_k + v_k with b_{k+1} = b_k + w_k, variances R = N²·rate and Q = K²/rate:

    P = Q/2 + √(Q²/4 + QR),    g = P/(P + R),    b̂_k = b̂_{k−1} + g(z_k − b̂_{k−1}).

Then it integrates for n samples of h seconds, less the last b̂. It predicts for the integral the variance

    h²[n² PR/(P + R) + Q n(n + 1)(2n + 1)/6 + nR],

which is right if the noise is as it believes. What it is for any other noise follows from the states of the
noise and b̂ together (Gelb, Applied Optimal Estimation, 1974, 7.2: the suboptimal filter's true covariance).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from allanjax.noise.model import Model
from allanjax.noise.state_block import Block, filtered_block, settled
from allanjax.noise.state_space import StateSpace
from allanjax.noise.terms import DriftRamp, Sinusoid


def gains(memory: Float[np.ndarray, " g"], rate: float) -> Float[np.ndarray, " g"]:
    """Gains of the filter with N/K = `memory` [s], over which it averages, at `rate` [Hz]."""
    ratio = (1.0 / (memory * rate)) ** 2
    P = ratio / 2.0 + np.sqrt(ratio**2 / 4.0 + ratio)
    return P / (P + 1.0)


def predicted(
    memory: Float[np.ndarray, " g"], steps: Float[np.ndarray, " t"], rate: float
) -> Float[np.ndarray, "g t"]:
    """Variance of the integral that filters of N = 1 and K = 1/memory predict after so many samples."""
    Q, n = (1.0 / memory**2 / rate)[:, None], steps[None, :]
    P = gains(memory, rate)[:, None] * rate
    # P is the variance of b̂ after its update: PR/(P + R) = gR.
    return (n**2 * P + Q * n * (n + 1.0) * (2.0 * n + 1.0) / 6.0 + n * rate) / rate**2


def actual(
    model: Model,
    memory: Float[np.ndarray, " g"],
    steps: Float[np.ndarray, " t"],
    rate: float,
    duration: float,
    known: dict[str, np.ndarray] | None = None,
) -> Float[np.ndarray, "terms g t"]:
    """Variance of the integral's error [rad² or (m/s)²] after so many samples, of each term by itself.

    Args:
        model: the noise that there is.
        memory: N/K of the filters [s].
        steps: how many samples they integrate.
        rate: sample rate [Hz].
        duration: how long the noise has gone on [s], for bias instability.
        known: variances of terms that other sets have, too, for the same filters and times; it is added to.

    Raises:
        AllanjaxError: a term that has no state space.
    """
    gain, labels = gains(memory, rate), model.term_labels
    known = {} if known is None else known
    # One term at a time, and what it becomes after the response.
    alone = [model.without([*labels[:k], *labels[k + 1 :]]) for k in range(len(labels))]
    for one in alone:
        if repr(one) not in known:
            known[repr(one)] = _of_term(one, gain, steps, rate, duration)
    return np.stack([known[repr(one)] for one in alone])


def _of_term(
    model: Model, gain: Float[np.ndarray, " g"], steps: Float[np.ndarray, " t"], rate: float, duration: float
) -> Float[np.ndarray, "g t"]:
    """Variance of the integral's error for a model of one term."""
    (term,) = model.terms
    if isinstance(term, Sinusoid):
        return term.amplitude**2 / 2.0 * _line(term.frequency / rate, gain, steps) / rate**2
    if isinstance(term, DriftRamp):
        # The estimate of a drifting bias lags behind by 1/g samples.
        slope = steps * (steps - 1.0) / 2.0 + steps / gain[:, None]
        return (term.coefficient / rate**2 * slope) ** 2
    return _of_block(model.state_block(rate, duration), gain, steps, rate)


def _line(
    cycles: float, gain: Float[np.ndarray, " g"], steps: Float[np.ndarray, " t"]
) -> Float[np.ndarray, "g t"]:
    """Squared response of the integral, in samples, to a line of so many cycles a sample."""
    z = np.exp(2j * np.pi * cycles)
    estimate = gain / z / (1.0 - (1.0 - gain) / z)
    return np.abs((z**steps - 1.0) / (z - 1.0) - steps * estimate[:, None]) ** 2


def _of_block(
    block: Block, gain: Float[np.ndarray, " g"], steps: Float[np.ndarray, " t"], rate: float
) -> Float[np.ndarray, "g t"]:
    """Variance of the integral's error for noise of these states."""
    space = StateSpace.of(block, rate, "gyro", "")
    sums = [space.sum_covariance(int(n)) for n in steps]
    seen = np.stack([transition[-1, :-1] for transition, _ in sums])
    added = np.array([noise[-1, -1] for _, noise in sums])
    A, n = block.transition, block.size
    found = []
    for g in gain:
        joint = filtered_block(block, np.array([g]), np.array([1.0, g - 1.0]), "estimate")
        P = settled(joint.transition, joint.noise, joint.level)
        states = A @ P[:n, :n] @ A.T + block.noise
        shared = A @ P[:n, n]
        found.append(
            np.einsum("ti,ij,tj->t", seen, states, seen)
            - 2.0 * steps * (seen @ shared)
            + steps**2 * P[n, n]
            + added
        )
    return np.stack(found) / rate**2


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
