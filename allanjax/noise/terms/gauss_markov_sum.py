"""Flicker noise and other power laws as sums of Gauss–Markov processes, for a Kalman filter.

Correlation times are equally far apart in the logarithm, and the variances fit the spectrum of the samples
and their Allan variance (Keshner 1982, Proc. IEEE 70:212, on how few processes a decade suffice).
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from jaxtyping import Float

from allanjax.base.errors import AllanjaxError
from allanjax.base.wording import percent
from allanjax.noise.model import NoiseTerm
from allanjax.noise.state_space import Block, block, together, white_block
from allanjax.noise.terms.markov import Markov

#: Largest relative error of the spectrum and of the Allan variance.
TOLERANCE = 0.03
# The error that the fit aims at, and processes a decade to try: few states make fast filters.
_AIM = 0.02
_DENSITIES = (0.8, 1.0, 1.25, 1.5, 2.0, 3.0)
# Correlation times, the longest in durations and the shortest in samples.
_LONGEST, _SHORTEST = 10.0, 0.1


def gauss_markov_sum(term: NoiseTerm, rate: float, duration: float | None) -> Block:
    """Block of Gauss–Markov processes, means over sample intervals, whose sum is a term with a power law.

    Raises:
        AllanjaxError: no duration [s]; or no such sum has its spectrum and its Allan variance within 3 %.
    """
    if duration is None:
        raise AllanjaxError(
            f"{term.name()} has a finite state space only for a limited time: give the duration in s, e.g. "
            "state_space(rate, duration=3600.0)"
        )
    samples = max(duration * rate, 16.0)
    frequency = rate * np.geomspace(1.0 / samples, 0.5, 160)
    time = np.unique(np.round(np.geomspace(1.0, samples / 2.0, 80))) / rate
    target = _seen(term, frequency, time, rate)
    worst = math.inf
    for density in _DENSITIES:
        processes = _processes(samples, density, rate)
        relative = np.stack([_seen(p, frequency, time, rate) / target for p in processes], axis=1)
        white = np.concatenate([np.ones(len(frequency)), 1.0 / time]) / target
        variance, white_density, worst = _fitted(relative, white)
        if worst <= _AIM:
            break
    if not worst <= TOLERANCE:
        raise AllanjaxError(
            f"no sum of Gauss–Markov processes approximates {term!r} to {percent(TOLERANCE)} (the best one "
            f"to {percent(worst)}); fit bias_instability, rate_random_walk or Markov() instead"
        )
    found = zip(processes, variance, strict=True)
    blocks = [p.replace(amplitude=math.sqrt(v)).state_block(rate, None) for p, v in found if v > 0.0]
    return together([_with_one_mean(blocks), white_block(white_density * rate)])


def _seen(
    term: NoiseTerm, frequency: Float[np.ndarray, " f"], time: Float[np.ndarray, " m"], rate: float
) -> Float[np.ndarray, " f+m"]:
    """Spectrum of the samples at frequencies [Hz], and Allan variance at cluster times [s]."""
    parts = (term.sampled_psd(frequency, rate), term.allan_variance(time))
    return np.concatenate([np.asarray(part, float) for part in parts])


def _processes(samples: float, density: float, rate: float) -> list[Markov]:
    """Processes of unit amplitude, this many a decade of correlation times."""
    longest, shortest = _LONGEST * samples / rate, _SHORTEST / rate
    count = math.ceil(density * math.log10(longest / shortest)) + 1
    return [Markov(1.0, float(time)) for time in np.geomspace(shortest, longest, count)]


def _fitted(
    relative: Float[np.ndarray, "rows n"], white: Float[np.ndarray, " rows"]
) -> tuple[Float[np.ndarray, " n"], float, float]:
    """Squared amplitudes of processes, density of white noise, and the largest error of their sum from 1."""
    from scipy.optimize import nnls

    columns = np.column_stack([relative, white])
    scale = np.linalg.norm(columns, axis=0)
    found = nnls(columns / scale, np.ones(len(columns)))[0] / scale
    return found[:-1], float(found[-1]), float(np.abs(columns @ found - 1.0).max())


def _with_one_mean(blocks: list[Block]) -> Block:
    """Sum of processes whose samples are means: one state for the sum of the means, one each for the ends."""
    joined = together(blocks)
    merge = np.zeros((len(blocks) + 1, joined.size))
    merge[0, ::2] = 1.0
    merge[np.arange(len(blocks)) + 1, 2 * np.arange(len(blocks)) + 1] = 1.0
    # No state depends on a mean.
    ends = merge @ joined.transition[:, 1::2]
    transition = np.column_stack([np.zeros(len(ends)), ends])
    names = ("mean", *(f"end_{k + 1}" for k in range(len(blocks))))
    merged = block(
        transition,
        [1.0, *(0.0,) * len(blocks)],
        merge @ joined.noise @ merge.T,
        merge @ joined.start @ merge.T,
        names,
    )
    return dataclasses.replace(merged, white=joined.white)
