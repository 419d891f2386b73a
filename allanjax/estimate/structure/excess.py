"""Where a spectrum has more than a fit, or differs from it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from allanjax.estimate.structure.structure import LOWEST, Fitted, Spectrum

# Narrowest window [coefficients], and the least gain of one [nats].
_NARROWEST, _WORTH = 8, 4.0


def middles(spectrum: Spectrum) -> Float[np.ndarray, " m"]:
    """Index of the coefficient in the middle of each bin."""
    edges = spectrum.bins.edges
    return 0.5 * (edges[:-1] + edges[1:] - 1)


def at_all(spectrum: Spectrum, fitted: Fitted) -> Float[np.ndarray, " n-1"]:
    """Expected squares of all coefficients, interpolated between the bins."""
    middle = np.log(middles(spectrum))
    mean = np.log(fitted.mean[: len(middle)])
    return np.exp(np.interp(np.log(np.arange(1.0, spectrum.n)), middle, mean))


def smoothed_scores(spectrum: Spectrum, fitted: Fitted) -> float:
    """Largest deviation of levels, averaged over a fifth of an octave or more, in standard deviations."""
    k = np.asarray(spectrum.levels.shape)
    ratio = np.asarray(spectrum.levels.level) / fitted.mean - 1.0
    best = 0.0
    for width in (6, 12, 24, 48):
        window = np.ones(width)
        total, weight = np.convolve(k * ratio, window, "valid"), np.convolve(k, window, "valid")
        best = max(best, float(np.max(abs(total) / np.sqrt(np.maximum(weight, 1.0)))))
    return best


def windows(ratio: Float[np.ndarray, " n-1"], most: int) -> list[tuple[float, float, float]]:
    """Windows with most excess: middle and width [coefficients] and gain [nats], no two of which overlap."""
    total = np.concatenate([[0.0], np.cumsum(ratio)])
    found: list[tuple[float, float, float]] = []
    width = _NARROWEST
    while width <= (len(ratio) - LOWEST) // 4:
        step = max(width // 4, 1)
        excess = (total[LOWEST + width :: step] - total[LOWEST : len(total) - width : step]) / width
        for k in np.argsort(-excess)[: 4 * most]:
            level = float(excess[k])
            if level <= 1.0:
                break
            gain = 0.5 * width * (level - 1.0 - np.log(level)) - np.log(len(ratio) / width)
            found.append((gain, LOWEST + k * step + width / 2.0 + 1.0, float(width)))
        width *= 2
    chosen: list[tuple[float, float, float]] = []
    for gain, middle, wide in sorted(found, reverse=True):
        if gain < _WORTH or len(chosen) == most:
            break
        if all(abs(middle - other) > 0.5 * (wide + w) for other, w, _ in chosen):
            chosen.append((middle, wide, gain))
    return chosen
