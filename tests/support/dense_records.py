"""Short records of white noise and a random walk, whose covariances are written out."""

import functools

import critic_views
import numpy as np
from scipy.linalg import toeplitz

from allanjax.critic.noise import MARKOV
from allanjax.record.recording import Axis

AXIS = Axis("accel_x", "accel", "m/s²")
N, RATE = 128, 4.0
POWERS = {"angle_random_walk": 0.8**2, "rate_random_walk": 0.3**2}

view_of = functools.partial(critic_views.view_of, rate=RATE, axis=AXIS)


def generalized(G, n):
    """Covariance of means over intervals, −δ²G/h², right for filters that sum to zero."""
    g = np.array([G(abs(k) / RATE) for k in range(-1, n + 1)])
    return toeplitz(-(g[2:] - 2.0 * g[1:-1] + g[:-2]) * RATE**2)


def covariances(n, T_c=1.0):
    """In time, of terms of unit coefficient."""
    return {
        "quantization": RATE**2 * toeplitz([2.0, -1.0, *np.zeros(n - 2)]),
        "angle_random_walk": RATE * np.eye(n),
        "bias_instability": generalized(lambda t: t**2 * np.log(t or 1.0) / (2.0 * np.pi), n),
        "rate_random_walk": generalized(lambda t: t**3 / 12.0, n),
        MARKOV: generalized(lambda t: -(T_c**3) / 2.0 * (np.exp(-t / T_c) - 1.0 + t / T_c), n),
    }


def dense(n):
    """Covariance in time of white noise and a random walk."""
    return sum(POWERS[name] * covariances(n)[name] for name in POWERS)


def simulated(n, records, rng):
    """Records [records, n] of white noise and a random walk, means over intervals up to a shift."""
    fine = 8
    steps = rng.standard_normal((records, n * fine)) * np.sqrt(POWERS["rate_random_walk"] / RATE / fine)
    walk = np.cumsum(steps, axis=1).reshape(records, n, fine).mean(axis=2)
    return walk + np.sqrt(POWERS["angle_random_walk"] * RATE) * rng.standard_normal((records, n))
