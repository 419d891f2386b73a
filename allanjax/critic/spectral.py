"""Likelihood of the spectrum in fine bins, for effects that change the spectrum."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize_scalar, nnls

from allanjax.critic.noise import FIXED, MARKOV, POWER_LAW, Noise, NoiseFamily, density
from allanjax.critic.view import View
from allanjax.noise.terms import Markov, NoiseTerm, PowerLaw

#: Name of the free shape in the result of `relative_errors`.
SHAPE = "shape"

# Bins in an octave.
_PER_OCTAVE = 64
# Scoring of powers: most rounds, the gain [nats] below which it ends, bins averaged for a first guess; and
# the step of numerical derivatives.
_SCORINGS, _SETTLED, _SMOOTH, _STEP = 8, 1e-4, 9, 0.02


class FineBins:
    """Bins of the coefficients 1 … n−1 of a family, 64 an octave.

    Attributes:
        size, frequency: number of coefficients in each bin and their mean frequency [Hz].
        columns: levels of the terms without a free shape, of unit amplitude.
    """

    def __init__(self, family: NoiseFamily) -> None:
        edges = (
            np.rint(2.0 ** (np.arange(0.0, np.log2(family.n) * _PER_OCTAVE) / _PER_OCTAVE)).astype(int) - 1
        )
        self._first = np.unique(edges[edges < family.n - 1])
        self.size = np.diff(self._first, append=family.n - 1).astype(float)
        self.frequency = self.sums(family.frequency) / self.size
        self.columns = {
            name: self.sums(spectrum) / self.size
            for name, spectrum in zip(FIXED, family.spectra, strict=True)
        }

    def sums(self, values: Float[np.ndarray, " n-1"]) -> Float[np.ndarray, " bins"]:
        """Sums of values over bins."""
        return np.add.reduceat(values, self._first)


@functools.lru_cache(maxsize=2)
def fine_bins(family: NoiseFamily) -> FineBins:
    """Bins of a family, which its axes share."""
    return FineBins(family)


def non_negative(
    columns: Float[np.ndarray, "terms bins"],
    level: Float[np.ndarray, " bins"],
    weight: Float[np.ndarray, " bins"],
) -> Float[np.ndarray, " terms"]:
    """Powers p ≥ 0 that minimize |weight·(p·columns − level)|."""
    # A QR decomposition reduces the equations to the number of terms.
    Q, R = np.linalg.qr((columns * weight).T)
    return nnls(R, (level * weight) @ Q)[0]


class FineLevels:
    """Spectrum in fine bins, and the likelihood of a shape with all powers fitted to it.

    Attributes:
        size, squares, frequency: number of coefficients in each bin, the sum of their squares divided by the
            factor of earlier findings, and their mean frequency [Hz].
        rate: sample rate [Hz].
        columns: levels of the allowed basic terms, except the Markov process, at unit amplitude.
        smooth: mean squares over a few neighbouring bins.
    """

    def __init__(self, view: View) -> None:
        bins = fine_bins(view.family)
        self.size, self.frequency, self.rate = bins.size, bins.frequency, view.rate
        squares = view.coefficients**2
        self.squares = bins.sums(squares if view.factor is None else squares / view.factor)
        self.columns = np.stack([bins.columns[name] for name in FIXED if name in view.allowed])
        near = np.ones(_SMOOTH)
        level = np.convolve(self.squares, near, "same") / np.convolve(self.size, near, "same")
        self.smooth = np.maximum(level, 1e-300)

    def log_likelihood(self, extra: Float[np.ndarray, " bins"]) -> float:
        """Largest log-likelihood [nats] over the powers of the basic terms and one extra term."""
        columns, level = np.vstack([self.columns, extra]), self.squares / self.size
        model, best = self.smooth, -np.inf
        for _ in range(_SCORINGS):
            power = non_negative(columns, level, np.sqrt(self.size) / model)
            model = np.maximum(power @ columns, 1e-300)
            value = -0.5 * float(np.sum(self.size * np.log(model) + self.squares / model))
            gained, best = value - best, max(value, best)
            if gained < _SETTLED:
                break
        return best

    def shape_of(self, law: Callable[[float], NoiseTerm], bounds: tuple[float, float]) -> tuple[float, float]:
        """Most likely shape of one extra term of unit amplitude, and its standard deviation by the curvature.

        `limited` says whether it is at a bound.
        """

        def loss(u: float) -> float:
            return -self.log_likelihood(self.rate * density(law(u), self.frequency, self.rate))

        found = minimize_scalar(loss, bounds=bounds, method="bounded", options={"xatol": 1e-3})
        u = float(found.x)
        curvature = (loss(u + _STEP) + loss(u - _STEP) - 2.0 * found.fun) / _STEP**2
        return u, float(1.0 / np.sqrt(max(curvature, 1e-2)))


def relative_errors(view: View, noise: Noise) -> dict[str, float]:
    """Relative errors of all powers from their Fisher information, and the error of the `SHAPE`.

    The latter is the logarithm of a Markov process's correlation time, or a power law's exponent.
    """
    bins = fine_bins(view.family)

    def spectrum(name: str, change: float = 0.0) -> Float[np.ndarray, " bins"]:
        if name == MARKOV:
            return view.rate * density(Markov(1.0, noise.shape * np.exp(change)), bins.frequency, view.rate)
        if name == POWER_LAW:
            return view.rate * density(PowerLaw(1.0, noise.shape + change), bins.frequency, view.rate)
        return bins.columns[name]

    level = sum(power * spectrum(name) for name, power in noise.power.items())
    rows = {}
    for name, power in noise.power.items():
        rows[name] = power * spectrum(name)
        if name not in FIXED:
            rows[SHAPE] = power * (spectrum(name, _STEP) - spectrum(name, -_STEP)) / (2.0 * _STEP)
    relative = np.stack(list(rows.values())) / level
    covariance = np.linalg.pinv(0.5 * (bins.size * relative) @ relative.T)
    return dict(zip(rows, np.sqrt(np.diag(covariance)).tolist(), strict=True))
