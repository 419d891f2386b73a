"""Outlying units axis by axis, the scatter known from the fleet alone: a rule to compare with."""

from __future__ import annotations

import numpy as np
from scipy.optimize import brentq
from scipy.stats import t


def outlying(x: np.ndarray, s: np.ndarray, probability: float) -> np.ndarray:
    """Which of the values x with standard errors s are unlike the others, by Rosner's test.

    Suspects are beyond three robust standard deviations of the median, a third of all at most. From the least
    extreme on, each is compared with the values that are no more extreme, by their mean and scatter (Paule
    and Mandel, J. Res. NBS 87, 1982) and the critical value of the largest deviate; once one exceeds it, it
    is marked with all beyond (Technometrics 25, 1983).
    """
    centre = np.median(x)
    distance = abs(x - centre)
    width = _root(lambda w: np.median(distance / np.hypot(w, s)) - 0.6745, 4.0 * distance.max())
    distance = distance / np.hypot(width, s)
    order = np.argsort(-distance)
    suspects = order[distance[order] > 3.0][: len(x) // 3]
    marked = np.zeros(len(x), bool)
    for k in range(len(suspects), 0, -1):
        last = suspects[k - 1]
        rest = np.setdiff1d(np.arange(len(x)), suspects[: k - 1])
        m = len(rest)
        if m < 3:
            continue
        mean, width = _normal_law(x[rest], s[rest])
        quantile = t.isf(probability / (2 * m), m - 2)
        critical = (m - 1) * quantile / np.sqrt((m - 2 + quantile**2) * m)
        if abs(x[last] - mean) / np.hypot(width, s[last]) > critical:
            marked[suspects[:k]] = True
            break
    return marked


def _normal_law(x: np.ndarray, s: np.ndarray) -> tuple[float, float]:
    def mean(width: float) -> float:
        return float(np.average(x, weights=1.0 / (width**2 + s**2)))

    width = _root(lambda w: np.sum((x - mean(w)) ** 2 / (w**2 + s**2)) - (len(x) - 1), 2.0 * float(np.ptp(x)))
    return mean(width), width


def _root(excess: object, most: float) -> float:
    return 0.0 if excess(0.0) <= 0.0 else float(brentq(excess, 0.0, most))  # type: ignore[operator]
