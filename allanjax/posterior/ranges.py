"""Where the sampling of a posterior starts, and ranges that contain all reasonable values."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from allanjax.estimate.deterministic import LINE_REACH
from allanjax.estimate.result import AxisFit, Fit
from allanjax.noise.model import ModelParameter

# Largest distance of a resonance's frequency from its fit, in ln.
_LINE_RANGE = 0.3


def start_of(result: AxisFit, parameters: tuple[ModelParameter, ...]) -> Float[np.ndarray, " params"]:
    """Values of the fit; shapes of absent terms have some value in their range."""
    values = np.array([result[p.label].value for p in parameters])
    return np.where(np.isfinite(values), values, [p.parameter.lower + 1.0 for p in parameters])


def ranges_of(
    parameters: tuple[ModelParameter, ...], result: AxisFit, fit: Fit, ceiling: Float[np.ndarray, " params"]
) -> tuple[Float[np.ndarray, " params"], Float[np.ndarray, " params"]]:
    """Lower and upper ends of the parameters' ranges, given those of the amplitudes."""
    n, rate = fit.curve.n, fit.curve.rate
    lower, upper = np.zeros(len(parameters)), ceiling.copy()
    seen = {"time": (2.0 / rate, n / rate), "frequency": (rate / n, rate / 2.0)}
    for k, p in enumerate(parameters):
        if p.parameter.kind in seen:
            lower[k], upper[k] = seen[p.parameter.kind]
        elif p.parameter.kind == "number":
            lowest = p.parameter.lower
            lower[k], upper[k] = lowest + 1e-2, min(lowest + 1e4, p.parameter.upper - 1e-2)
        elif p.parameter.kind == "line":
            f = result[p.label].value
            if fit.template.terms[p.term].deterministic:
                reach = LINE_REACH / 2.0 * rate / (2.0 * n)
                lower[k], upper[k] = max(f - reach, 0.1 * rate / n), min(f + reach, rate / 2.0)
            else:
                lower[k], upper[k] = f * np.exp(-_LINE_RANGE), min(f * np.exp(_LINE_RANGE), rate / 2.0)
    return lower, upper
