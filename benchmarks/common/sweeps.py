"""Sweeps through the edge of detection: how large an effect must be to be found in half of the records."""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize
from scipy.stats import norm

#: Sizes, as multiples of the detection limit.
SWEEP = (0.6, 0.8, 1.0, 1.25, 1.5, 1.9, 2.4)
#: Seeds of one multiple of a sweep are apart from those of the next.
APART = 10_000


def half_detected(multiples: np.ndarray, hits: np.ndarray) -> tuple[float, float]:
    """The multiple that is detected in half of the records, and its standard error.

    Probit regression on the logarithm of the multiple.
    """
    x = np.log(multiples)

    def probability(theta: np.ndarray) -> np.ndarray:
        return np.clip(norm.cdf((x - theta[0]) / np.exp(theta[1])), 1e-9, 1.0 - 1e-9)

    def loss(theta: np.ndarray) -> float:
        p = probability(theta)
        return -float(np.sum(np.where(hits, np.log(p), np.log1p(-p))))

    # A detector whose threshold is sharper than this would need finer steps to be seen.
    bounds = [(x.min(), x.max()), (np.log(0.03), np.log(3.0))]
    middle, log_width = minimize(loss, [x.mean(), np.log(0.2)], bounds=bounds, method="L-BFGS-B").x
    p = probability(np.array([middle, log_width]))
    z = (x - middle) / np.exp(log_width)
    gradient = norm.pdf(z) * np.stack([np.ones_like(z), z]) / np.exp(log_width)
    information = (gradient / (p * (1.0 - p))) @ gradient.T
    return float(np.exp(middle)), float(np.exp(middle) * np.sqrt(np.linalg.pinv(information)[0, 0]))
