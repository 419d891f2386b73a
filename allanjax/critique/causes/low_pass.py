"""The sensor's bandwidth, or an anti-alias filter: noise falls off at high frequencies (thesis Fig. 5.10)."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float
from scipy.ndimage import uniform_filter1d
from scipy.optimize import minimize_scalar, nnls

from allanjax import terms
from allanjax.critique.causes.spectral import (
    baseline_predictive,
    coefficient_folds,
    fine_bins,
    log_likelihood,
    predictive,
    sums,
)
from allanjax.critique.noise import FIXED, MARKOV, density
from allanjax.critique.view import Candidate, Cause, Quantity, View
from allanjax.model import Model

_WORTH = 6.0
_GRID = 40
_STEPS = 8
# A Markov process this short [samples] without white noise is white noise behind a filter.
_SHORT = 20.0
# Below this response the record's ends are reckoned with; coefficients that a local mean is taken over.
_DEEP, _LOCAL = 0.01, 401
# Share of the record at each end that these make loud.
_ENDS = 0.02
# Order, and whether the filter is a digital one made by the bilinear transformation.
_FILTERS = ((1, False), (2, False), (1, True), (2, True), (3, True), (4, True))


class LowPass(Cause):
    """All noise behind a Butterworth filter of order 1 or 2."""

    name = "low_pass"

    def detect(self, view: View) -> Candidate | None:
        if self.name in view.found:
            return None
        noise = view.noise
        steady = noise
        if "angle_random_walk" not in noise.terms and noise.shape * view.rate < _SHORT:
            # The same spectrum by another name: as white noise that is filtered it says where it ends.
            steady = view.weighing.best([t for t in view.allowed if t != MARKOV])
        screen = _Screen(view)
        filter_, bandwidth, gains = screen.best()
        if gains.max() < _WORTH:
            return None
        after = _without_ends(view.with_x(view.x, _visible(view, bandwidth, filter_)))
        gain = after.noise.log_evidence - steady.log_evidence
        # Odds among the bandwidths and orders: flat.
        gain -= float(gains.max() - np.logaddexp.reduce(gains.ravel()) + np.log(gains.size))
        if after.noise.log_evidence < noise.log_evidence - 4.0:
            return None
        std = screen.deviation(filter_, bandwidth)
        return Candidate(
            self.name,
            {
                "bandwidth": Quantity(bandwidth, std, "Hz"),
                "order": Quantity(float(filter_[0]), 0.0, "1"),
            },
            gain,
            float(np.exp(-max(gain, 0.0))),
            after,
            lambda: _held_out(view),
            (bandwidth, view.rate / 2.0),
            "frequency",
            lambda model: _filtered(model, bandwidth, min(filter_[0], 2)),
        )


def _factor(
    frequency: Float[np.ndarray, " k"], rate: float, bandwidth: float, filter_: tuple[int, bool], n: int
) -> Float[np.ndarray, " k"]:
    """Ratio of the filtered to the unfiltered spectrum of n samples.

    The mirrored record that cosines see has kinks at its two ends, of the slopes there: in what the filter
    stops they have a power of (4/n)·E ẋ²/(2 sin(a/2))⁴, which is all that is left there.
    """
    passed = _passed(frequency, rate, bandwidth, filter_)
    grid = (np.arange(_GRID * 16) + 0.5) * rate / (32.0 * _GRID)
    slopes = np.mean(4.0 * np.sin(np.pi * grid / rate) ** 2 * _passed(grid, rate, bandwidth, filter_))
    kinks = 4.0 / n * slopes / (2.0 * np.sin(np.pi * frequency / rate)) ** 4
    return np.where(passed < _DEEP, passed + kinks, passed)


def _passed(
    frequency: Float[np.ndarray, " k"], rate: float, bandwidth: float, filter_: tuple[int, bool]
) -> Float[np.ndarray, " k"]:
    """The filter's power response, aliases of an analog one included."""
    order, digital = filter_
    if digital:
        ratio = np.tan(np.pi * frequency / rate) / np.tan(np.pi * bandwidth / rate)
        return 1.0 / (1.0 + ratio ** (2 * order))
    term = terms.LowPass(1.0, bandwidth, order=order).sampled(rate)
    return density(term, frequency, rate)


def _visible(
    view: View, bandwidth: float, filter_: tuple[int, bool], fold: np.ndarray | None = None
) -> Float[np.ndarray, " n-1"]:
    """The ratio where it can be seen.

    Where the record's ends count more than what the filter passes, the level is the record's own, and nothing
    is said.
    """
    factor = _factor(view.family.frequency, view.rate, bandwidth, filter_, view.n)
    stopped = factor < 2.0 * (factor - _passed(view.family.frequency, view.rate, bandwidth, filter_))
    if not stopped.any():
        return factor
    whole = view.combined(factor)
    noise = view.family.of(view.c, whole, fold).best(view.allowed)
    used = np.ones(view.n - 1) if fold is None else fold.astype(float)
    ratio = uniform_filter1d(used * view.c**2 / (noise.variance * whole), _LOCAL, mode="nearest")
    ratio /= np.maximum(uniform_filter1d(used, _LOCAL, mode="nearest"), 1.0 / _LOCAL)
    return np.where(stopped, factor * np.maximum(ratio, 1e-9), factor)


def _without_ends(view: View) -> View:
    """What was stopped and is amplified now has the record's ends in it, and is loud there."""
    k = np.arange(view.n)
    ends = np.minimum(k, view.n - 1 - k) < _ENDS * view.n
    return dataclasses.replace(view, restored=view.restored | ends)


def _filtered(model: Model, bandwidth: float, order: int) -> Model:
    """The model with its white noise behind the filter; slower noise passes."""
    white = "angle_random_walk"
    if white not in model.term_labels:
        return model
    N = model.values[white]
    return model.without([white]) + terms.LowPass(N, bandwidth, order=order)


class _Screen:
    """Likelihoods of many filters, the powers of the basic terms being adjusted to each."""

    def __init__(self, view: View, fold: np.ndarray | None = None) -> None:
        self.n, self.rate = view.n, view.rate
        first = fine_bins(self.n)
        used = np.ones(self.n - 1) if fold is None else fold.astype(float)
        size = sums(used, first)
        real = size > 0
        self.size, self.squares = size[real], sums(used * view.squares, first)[real]
        self.frequency = sums(used * view.family.frequency, first)[real] / self.size
        columns = [view.family.spectra[FIXED.index(t)] for t in FIXED if t in view.allowed]
        self.columns = np.stack([sums(used * column, first)[real] / self.size for column in columns])
        self.plain = self.fitted(np.ones(len(self.size)))

    def fitted(self, factor: Float[np.ndarray, " bins"]) -> float:
        """Log-likelihood of the best powers behind this factor."""
        level = self.squares / self.size / factor
        smooth = np.convolve(level * self.size, np.ones(9), "same") / np.convolve(
            self.size, np.ones(9), "same"
        )
        model = np.maximum(smooth, 1e-300)
        best = -np.inf
        for _ in range(_STEPS):
            weight = np.sqrt(self.size) / model
            power, _ = nnls((self.columns * weight).T, level * weight)
            model = np.maximum(power @ self.columns, 1e-300)
            value = log_likelihood(self.squares / factor / model, self.size, np.ones_like(model))
            value -= 0.5 * float(self.size @ (np.log(model) + np.log(factor)))
            best = max(best, value)
        return best

    def gain(self, filter_: tuple[int, bool], bandwidth: float) -> float:
        """Of a filter."""
        return self.fitted(_factor(self.frequency, self.rate, bandwidth, filter_, self.n)) - self.plain

    def best(self) -> tuple[tuple[int, bool], float, Float[np.ndarray, "filters grid"]]:
        """The best filter and its bandwidth, and the gains of all."""
        grid = np.geomspace(0.005 * self.rate, 0.98 * self.rate / 2.0, _GRID)
        gains = np.array([[self.gain(filter_, f) for f in grid] for filter_ in _FILTERS])
        i, k = (int(x) for x in np.unravel_index(int(np.argmax(gains)), gains.shape))
        bounds = (np.log(grid[max(k - 1, 0)]), np.log(grid[min(k + 1, _GRID - 1)]))
        found = minimize_scalar(
            lambda u: -self.gain(_FILTERS[i], float(np.exp(u))),
            bounds=bounds,
            method="bounded",
            options={"xatol": 1e-4},
        )
        return _FILTERS[i], float(np.exp(found.x)), gains

    def deviation(self, filter_: tuple[int, bool], bandwidth: float) -> float:
        """Standard deviation of the bandwidth, from the curvature."""
        h = 0.01
        values = [self.gain(filter_, bandwidth * np.exp(s * h)) for s in (-1.0, 0.0, 1.0)]
        curvature = -(values[0] - 2.0 * values[1] + values[2]) / h**2
        return float(bandwidth / np.sqrt(max(curvature, 1e-2)))


def _held_out(view: View) -> float:
    gain = 0.0
    for fold in coefficient_folds(view.n):
        filter_, bandwidth, _ = _Screen(view, fold).best()
        factor = _visible(view, bandwidth, filter_, fold)
        whole = view.combined(factor)
        noise = view.family.of(view.c, whole, fold).best(view.allowed)
        gain += predictive(view.c, noise.variance * whole, ~fold) - baseline_predictive(view, fold)
    return gain
