"""What causes that change the spectrum have in common: a likelihood of the whitened levels in fine bins."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, TypeAlias

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import minimize_scalar, nnls

from allanjax.critic.noise import FIXED, MARKOV, POWER_LAW, Noise, density
from allanjax.critic.view import ONE_SIDED, View
from allanjax.noise.terms import Markov, PowerLaw

Limit: TypeAlias = Literal["", "above", "below"]
# A maximum this near to a bound is at it, absolutely and in its deviations.
_AT_BOUND, _NEAR_BOUND = 2e-2, 1.0
#: The free shape among the powers of `relative_errors`.
SHAPE = "shape"

_PER_OCTAVE = 64
_NEAR = 400
#: Gauss's quadrature: a response may fall by much within a bin.
NODES, SHARES = np.polynomial.legendre.leggauss(4) * np.array([[1.0], [0.5]])
# Of the powers: rounds of scoring, nats that end it, bins that a first guess is the mean of; and a step for
# curvatures.
_SCORINGS, _SETTLED, _SMOOTH, _STEP = 8, 1e-4, 9, 0.02


def fine_bins(n: int, centre: float | None = None, width: float = 1.0) -> np.ndarray:
    """First indices (of coefficients 1 … n−1, from 0) of bins: 64 an octave, finer around a place."""
    log = np.unique(np.rint(2.0 ** (np.arange(0.0, np.log2(n) * _PER_OCTAVE) / _PER_OCTAVE)))
    edges = log
    if centre is not None:
        step = max(width / 16.0, 1.0)
        near = centre + step * np.arange(-_NEAR, _NEAR + 1)
        edges = np.concatenate([log[(log < near[0]) | (log > near[-1])], np.rint(near)])
    edges = np.unique(edges.astype(int) - 1)
    return edges[(edges >= 0) & (edges < n - 1)]


def sums(values: Float[np.ndarray, " n-1"], first: np.ndarray) -> Float[np.ndarray, " bins"]:
    """Over bins."""
    return np.add.reduceat(values, first)


def log_likelihood(
    squares: Float[np.ndarray, " bins"], size: Float[np.ndarray, " bins"], ratio: Float[np.ndarray, " bins"]
) -> float:
    """Of sums of whitened squares whose expectation is `ratio` times their number."""
    return float(-0.5 * np.sum(size * np.log(ratio) + squares / ratio))


def non_negative(
    columns: Float[np.ndarray, "terms bins"],
    level: Float[np.ndarray, " bins"],
    weight: Float[np.ndarray, " bins"],
) -> Float[np.ndarray, " terms"]:
    """Powers p ≥ 0 that minimize |weight·(p·columns − level)|."""
    # Of a triangle as wide as there are terms the same are asked for as of all bins.
    Q, R = np.linalg.qr((columns * weight).T)
    return nnls(R, (level * weight) @ Q)[0]


class FineLevels:
    """The spectrum in fine bins: the likelihood of a shape, all powers being adjusted to it.

    Attributes:
        size, squares, frequency: coefficients in each bin, the sum of their squares without what was found
            before, and their mean frequency [Hz].
        within: frequencies in each bin of which the `SHARES` of a function's values are nearly its mean [Hz].
        columns: levels of the allowed basic terms but the Markov process, unit amplitude.
        smooth: mean squares of a few neighbouring bins together.
    """

    def __init__(self, view: View, fold: Bool[np.ndarray, " n-1"] | None = None) -> None:
        self._first = fine_bins(view.n)
        self._used = np.ones(view.n - 1) if fold is None else fold.astype(float)
        size = sums(self._used, self._first)
        self._real = size > 0
        self.size = size[self._real]
        self.squares = self.size * self.mean(view.squares)
        self.frequency = self.mean(view.family.frequency)
        last = np.append(self._first[1:], view.n - 1)
        middle, half = 0.5 * (self._first + last + 1), 0.5 * (last - self._first)
        places = middle[:, None] + half[:, None] * NODES
        self.within = places[self._real] * view.rate / (2.0 * view.n)
        spectra = [view.family.spectra[FIXED.index(t)] for t in FIXED if t in view.allowed]
        self.columns = np.stack([self.mean(spectrum) for spectrum in spectra])
        near = np.ones(_SMOOTH)
        level = np.convolve(self.squares, near, "same") / np.convolve(self.size, near, "same")
        self.smooth = np.maximum(level, 1e-300)

    def keep(self, count: int) -> None:
        """Leave out all but so many of the lowest bins."""
        self._real[np.flatnonzero(self._real)[count:]] = False
        self.size, self.squares, self.frequency, self.within = (
            x[:count] for x in (self.size, self.squares, self.frequency, self.within)
        )
        self.columns, self.smooth = self.columns[:, :count], self.smooth[:count]

    def mean(self, values: Float[np.ndarray, " n-1"]) -> Float[np.ndarray, " bins"]:
        """In each bin, of the coefficients in the fold."""
        return sums(self._used * values, self._first)[self._real] / self.size

    def log_likelihood(
        self,
        factor: Float[np.ndarray, " bins"] | float = 1.0,
        extra: Float[np.ndarray, " bins"] | None = None,
    ) -> float:
        """Of the best powers of the basic terms and an extra one, behind a factor [nats]."""
        return self.scored(factor, extra)[0]

    def scored(
        self,
        factor: Float[np.ndarray, " bins"] | float = 1.0,
        extra: Float[np.ndarray, " bins"] | None = None,
    ) -> tuple[float, Float[np.ndarray, " terms"]]:
        """The same and these powers, that of the extra one last."""
        columns = factor * (self.columns if extra is None else np.vstack([self.columns, extra]))
        level = self.squares / self.size
        model, best, found = self.smooth, -np.inf, np.zeros(len(columns))
        for _ in range(_SCORINGS):
            power = non_negative(columns, level, np.sqrt(self.size) / model)
            model = np.maximum(power @ columns, 1e-300)
            value = log_likelihood(self.squares, self.size, model)
            gained = value - best
            if gained > 0.0:
                best, found = value, power
            if gained < _SETTLED:
                break
        return best, found

    def shape_of(
        self, likelihood: Callable[[float], float], bounds: tuple[float, float]
    ) -> tuple[float, float, float]:
        """Where a likelihood is largest, its standard deviation there by the curvature, and the maximum.

        `limited` says whether that is at a bound.
        """
        found = minimize_scalar(
            lambda u: -likelihood(u), bounds=bounds, method="bounded", options={"xatol": 1e-3}
        )
        u = float(found.x)
        sides = [likelihood(u + _STEP), likelihood(u - _STEP)]
        curvature = (-2.0 * found.fun - sum(sides)) / _STEP**2
        return u, float(1.0 / np.sqrt(max(curvature, 1e-2))), -float(found.fun)


def limited(u: float, std: float, bounds: tuple[float, float]) -> tuple[float, float, Limit]:
    """An estimate and its deviation, or where it is at a bound the 95 % limit on this side of it."""
    if u > bounds[1] - max(_AT_BOUND, _NEAR_BOUND * std):
        return min(u, bounds[1]) - ONE_SIDED * std, float("nan"), "above"
    if u < bounds[0] + max(_AT_BOUND, _NEAR_BOUND * std):
        return max(u, bounds[0]) + ONE_SIDED * std, float("nan"), "below"
    return u, std, ""


def relative_errors(view: View, noise: Noise) -> dict[str, float]:
    """Relative errors of all powers by their Fisher information, and the error of the `SHAPE`.

    That is of the logarithm of a Markov process's correlation time, or of a power law's exponent.
    """

    first = fine_bins(view.n)
    size = sums(np.ones(view.n - 1), first)
    frequency, level = (sums(x, first) / size for x in (view.family.frequency, noise.variance))

    def spectrum(name: str, change: float = 0.0) -> Float[np.ndarray, " bins"]:
        if name == MARKOV:
            return view.rate * density(Markov(1.0, noise.shape * np.exp(change)), frequency, view.rate)
        if name == POWER_LAW:
            return view.rate * density(PowerLaw(1.0, noise.shape + change), frequency, view.rate)
        return sums(view.family.spectra[FIXED.index(name)], first) / size

    rows = {}
    for name, power in noise.power.items():
        rows[name] = power * spectrum(name)
        if name not in FIXED:
            rows[SHAPE] = power * (spectrum(name, _STEP) - spectrum(name, -_STEP)) / (2.0 * _STEP)
    relative = np.stack(list(rows.values())) / level
    covariance = np.linalg.pinv(0.5 * (size * relative) @ relative.T)
    return dict(zip(rows, np.sqrt(np.diag(covariance)).tolist(), strict=True))
