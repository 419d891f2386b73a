"""Windows of a whitened spectrum with more power than noise has."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import gammaincc

from allanjax.critic.bank import any_of
from allanjax.estimate.structure.structure import LOWEST

# Narrowest window [coefficients].
_NARROWEST = 8
# Independent windows for each width, and how many more for each e-fold of a smaller p-value; number of the
# widest windows that show nothing new. Measured on simulated spectra.
_INDEPENDENT, _WIDE = (1.9, 0.11), 3.0


class Window(NamedTuple):
    """Window with most excess: its middle and width [coefficients], and the p-value of the search for it."""

    middle: float
    width: float
    p_value: float


def conspicuous(ratio: Float[np.ndarray, " n-1"]) -> Window:
    """Most conspicuous window of squared whitened coefficients.

    Windows a quarter of a width apart count as two to four independent ones for each width, the more the
    smaller the p-value (`_INDEPENDENT`).
    """
    total = np.concatenate([[0.0], np.cumsum(ratio)])
    best = (-np.inf, 0.0, 0.0)
    width, widths = _NARROWEST, 0.0
    least = 1.0
    while width <= (len(ratio) - LOWEST) // 4:
        step = max(width // 4, 1)
        excess = total[LOWEST + width :: step] - total[LOWEST : len(total) - width : step]
        k = int(np.argmax(excess))
        level = float(excess[k]) / width
        windows = len(ratio) / width
        gain = 0.5 * width * (level - 1.0 - np.log(level)) if level > 1.0 else 0.0
        tail = min(max(float(gammaincc(width / 2.0, level * width / 2.0)), 1e-300), 1.0 - 1e-12)
        independent = min(_INDEPENDENT[0] - _INDEPENDENT[1] * np.log(tail), 4.0)
        least, widths = min(least, any_of(tail, independent * windows)), widths + 1.0
        best = max(best, (gain - np.log(windows), LOWEST + k * step + width / 2.0 + 1.0, float(width)))
        width *= 2
    # Every width is a search of its own, but that the widest ones see what narrower ones have seen.
    return Window(best[1], best[2], any_of(least, max(widths - _WIDE, 1.0)))
