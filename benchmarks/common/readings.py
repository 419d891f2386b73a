"""Coefficients read off the Allan deviation by lines of fixed slope, as Hou (2004) did it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from allanjax.allan.deviation import AllanDeviation
from allanjax.noise.terms import (
    AngleRandomWalk,
    BiasInstability,
    DriftRamp,
    NoiseTerm,
    Quantization,
    RateRandomWalk,
)

# Slope of each term in the plot, and the cluster time [s] at which its line has the coefficient's value.
SLOPES: dict[type[NoiseTerm], tuple[float, float]] = {
    Quantization: (-1.0, math.sqrt(3.0)),
    AngleRandomWalk: (-0.5, 1.0),
    BiasInstability: (0.0, 1.0),
    RateRandomWalk: (0.5, 3.0),
    DriftRamp: (1.0, math.sqrt(2.0)),
}
# A point belongs to a term's region if the curve's slope there is this close to the term's.
SLOPE_TOLERANCE = 0.15
# The thesis reads up to clusters whose error by (4.66) is a third.
LARGEST_ERROR = 1.0 / 3.0


@dataclass(frozen=True)
class Reading:
    """A coefficient read off the plot, and its standard error by (4.66); both in SI."""

    value: float
    error: float


def read_slope(curve: AllanDeviation, column: int, term: type[NoiseTerm]) -> Reading:
    """Fit a line of the term's slope to the longest run of points that have about this slope.

    Where no point has it, the one that comes nearest is taken. The error is that of the run's longest
    clusters. The flat part of a curve with bias instability stands at √(2 ln 2/π) B (4.51).
    """
    slope, unit_time = SLOPES[term]
    usable = curve.thesis_relative_error <= LARGEST_ERROR
    T, deviation = np.log(curve.cluster_time[usable]), np.log(curve.deviation[usable, column])
    misfit = np.abs(np.gradient(deviation, T) - slope)
    run = longest_run(misfit <= max(SLOPE_TOLERANCE, misfit.min()))
    level = float(np.exp(np.mean(deviation[run] - slope * (T[run] - math.log(unit_time)))))
    value = level / math.sqrt(2.0 * math.log(2.0) / math.pi) if term is BiasInstability else level
    return Reading(value, value * float(curve.thesis_relative_error[usable][run][-1]))


def longest_run(belongs: Float[np.ndarray, " m"]) -> slice:
    """The longest stretch of consecutive True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], belongs, [False]]).astype(int)))
    starts, stops = edges[::2], edges[1::2]
    longest = int(np.argmax(stops - starts))
    return slice(int(starts[longest]), int(stops[longest]))
