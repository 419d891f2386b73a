"""Powers and shape of the noise from the spectrum in fine bins: errors, and the most likely shape of a term.

The shape of a term is the logarithm of a Markov process's correlation time, or a power law's exponent.
"""

from __future__ import annotations

import functools

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize_scalar

from allanjax.critic.noise import FIXED, MARKOV, Noise, NoiseFamily, term_of
from allanjax.critic.view import View
from allanjax.estimate.evidence import information, power_fits
from allanjax.estimate.spectral.components import columns_of
from allanjax.spectrum.cosine import Bins, smoothed

#: Name of the free shape in the result of `relative_errors`.
SHAPE = "shape"

# Bins in an octave, and the step of numerical derivatives.
_PER_OCTAVE, _STEP = 64, 0.02


@functools.lru_cache(maxsize=2)
def _bins(family: NoiseFamily) -> Bins:
    return Bins.of(family.n, family.rate, (), _PER_OCTAVE)


@functools.lru_cache(maxsize=32)
def _unit(family: NoiseFamily, name: str, shape: float = 0.0) -> Float[np.ndarray, " bins"]:
    """Levels of a term of unit amplitude and this shape."""
    term = term_of(name, 1.0, np.exp(shape) if name == MARKOV else shape)
    return columns_of([term], _bins(family))[0].mean(axis=0)


def likely_shape(view: View, name: str, bounds: tuple[float, float]) -> tuple[float, float]:
    """Most likely shape of a term beside all allowed terms, and its standard deviation by the curvature.

    All powers are fitted for each shape. `limited` says whether it is at a bound.
    """
    bins, squares = _bins(view.family), view.coefficients**2
    size, total = bins.size, bins.sums(squares if view.factor is None else squares / view.factor)
    level, rough = total / size, smoothed(total, size)
    columns = [_unit(view.family, term) for term in FIXED if term in view.allowed]

    def loss(u: float) -> float:
        unit = np.stack([*columns, _unit(view.family, name, float(u))])
        return float(power_fits(level, 0.5 * size, rough, unit[None])[1][0])

    found = minimize_scalar(loss, bounds=bounds, method="bounded", options={"xatol": 1e-3})
    u = float(found.x)
    curvature = (loss(u + _STEP) + loss(u - _STEP) - 2.0 * found.fun) / _STEP**2
    return u, float(1.0 / np.sqrt(max(curvature, 1e-2)))


def relative_errors(view: View, noise: Noise) -> dict[str, float]:
    """Relative errors of all powers from their Fisher information, and the error of the `SHAPE`."""
    rows, family = {}, view.family
    for name, power in noise.power.items():
        shape = np.log(noise.shape) if name == MARKOV else noise.shape
        if name in FIXED:
            rows[name] = power * _unit(family, name)
            continue
        below, rows[name], above = (
            power * _unit(family, name, float(shape + step)) for step in (-_STEP, 0.0, _STEP)
        )
        rows[SHAPE] = (above - below) / (2.0 * _STEP)
    level = np.sum([row for name, row in rows.items() if name != SHAPE], axis=0)
    covariance = np.linalg.pinv(information(np.stack([*rows.values()]), level, 0.5 * _bins(family).size))
    return dict(zip(rows, np.sqrt(np.diag(covariance)).tolist(), strict=True))
