"""The sensor's bandwidth, or an anti-alias filter: noise falls off at high frequencies (thesis Fig. 5.10)."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
from jaxtyping import Float
from scipy.ndimage import uniform_filter1d

from allanjax import terms
from allanjax.critique.causes.spectral import FineLevels
from allanjax.critique.noise import MARKOV, density
from allanjax.critique.view import EVERYTHING, Candidate, Cause, Quantity, View, coefficient_folds
from allanjax.model import Model

_WORTH = 6.0
_GRID = 40
# Kinds of filters that are so much less likely [nats] are out of the question.
_RIVALS = 10.0
# Of the response: points, and up to which share of the Nyquist frequency.
_RESPONSE, _REACHED = 4097, 0.8
# A Markov process this short [samples] without white noise is white noise behind a filter.
_SHORT = 20.0
# Below this response the record's ends are reckoned with; coefficients that a local mean is taken over.
_DEEP, _LOCAL = 0.01, 401
# Coefficients of a bin that says how little noise there is anywhere.
_COUNTED = 100
# Share of the record at each end that these make loud.
_ENDS = 0.02
# Order, and whether the filter is a digital one made by the bilinear transformation.
_FILTERS = ((1, False), (2, False), (1, True), (2, True), (3, True), (4, True))


class LowPass(Cause):
    """All noise behind a Butterworth filter.

    The bandwidth found is where the samples' spectrum has fallen by half, or, where aliases keep it from
    falling so far, the −3 dB frequency of the analog filter.
    """

    name = "low_pass"
    joint = "at once"

    def detect(self, view: View) -> Candidate | None:
        if self.name in view.found:
            return None
        noise = view.noise
        # A basic term that the model lacks and that explains as much is the better word.
        basic, instead = view.basic, view.allowed
        if "angle_random_walk" not in basic.terms and basic.shape * view.rate < _SHORT:
            # The same spectrum by another name: as white noise that is filtered it says where it ends.
            basic = view.weighing.best([t for t in (*EVERYTHING, *view.allowed) if t != MARKOV])
            instead = [t for t in view.allowed if t != MARKOV]
        screen = _Screen(view)
        gains = screen.gains
        if gains.max() < _WORTH:
            return None
        filter_, bandwidth, half_power, std = screen.best()
        visible = _visible(view, screen, bandwidth, filter_)
        after = dataclasses.replace(_without_ends(view.behind(visible)), passes=visible)
        gain = after.noise.log_evidence - basic.log_evidence
        # Odds among the bandwidths and orders: flat.
        gain -= float(gains.max() - np.logaddexp.reduce(gains.ravel()) + np.log(gains.size))
        if after.noise.log_evidence < noise.log_evidence - 4.0:
            return None
        return Candidate(
            self.name,
            {
                "bandwidth": Quantity(half_power, std, "Hz"),
                "order": Quantity(float(filter_[0]), 0.0, "1"),
            },
            gain,
            float(np.exp(-max(gain, 0.0))),
            after,
            lambda: _held_out(view) - view.foretold_by(instead),
            (bandwidth, view.rate / 2.0),
            "frequency",
            lambda model: _filtered(model, bandwidth, min(filter_[0], 2)),
        )


def _ends(view: View) -> Float[np.ndarray, " n-1"]:
    """Power of the record's ends in its coefficients: all that is left where a filter stops the noise.

    The mirrored record that cosines see has kinks at its two ends, of the slopes there, with a power of
    (4/n)·E ẋ²/(2 sin(a/2))⁴.
    """
    slopes = float(np.mean(np.diff(view.x) ** 2))
    return 4.0 / view.n * slopes / (2.0 * np.sin(np.pi * view.family.frequency / view.rate)) ** 4


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


@functools.lru_cache(maxsize=4 * _GRID * len(_FILTERS))
def _response(
    frequency: bytes, rate: float, bandwidth: float, filter_: tuple[int, bool]
) -> Float[np.ndarray, " k"]:
    """The same, kept: all axes at all stages are looked through for the same filters."""
    return _passed(np.frombuffer(frequency), rate, bandwidth, filter_)


def _visible(
    view: View, screen: _Screen, bandwidth: float, filter_: tuple[int, bool], fold: np.ndarray | None = None
) -> Float[np.ndarray, " n-1"]:
    """Ratio of the filtered to the unfiltered spectrum, where it can be seen.

    Where the record's ends count more than what the filter passes, the level is the record's own, and nothing
    is said.
    """
    passed = _passed(view.family.frequency, view.rate, bandwidth, filter_)
    deep, used = passed < _DEEP, np.ones(view.n - 1) if fold is None else fold.astype(float)
    if not deep.any():
        return passed
    clear = ~deep & (used > 0.0)
    ends = np.maximum(_ends(view), view.combined(np.full(view.n - 1, screen.floor(bandwidth))))
    level = float(np.mean(view.squares[clear] / passed[clear]))
    factor = passed + np.where(deep, ends / level, 0.0)
    whole = view.combined(factor)
    noise = view.family.of(view.c, whole, fold).best(view.allowed)
    kinks = np.where(deep, ends / view.combined(noise.variance), 0.0)
    ratio = uniform_filter1d(used * view.c**2 / view.combined(noise.variance), _LOCAL, mode="nearest")
    ratio /= np.maximum(uniform_filter1d(used, _LOCAL, mode="nearest"), 1.0 / _LOCAL)
    return np.where(kinks > passed, np.maximum(ratio, 1e-9 * factor), passed + kinks)


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


class _Screen(FineLevels):
    """Likelihoods of many filters."""

    def __init__(self, view: View, fold: np.ndarray | None = None) -> None:
        super().__init__(view, fold)
        self.rate = view.rate
        self.plain = self.log_likelihood()
        ends = _ends(view) if view.factor is None else _ends(view) / view.factor
        self.ends = self.mean(ends)
        level = self.squares / self.size
        self.least = float(np.min(level[self.size >= _COUNTED], initial=np.inf))
        self.grid = np.geomspace(0.005 * self.rate, 0.98 * self.rate / 2.0, _GRID)
        self.gains = np.array([[self.gain(filter_, f) for f in self.grid] for filter_ in _FILTERS])

    def floor(self, bandwidth: float) -> float:
        """Power of what is added behind the filter and hides its deepest response, 0 if nothing does.

        Outliers too small to be seen, the digits of the samples: what is least anywhere in the spectrum.
        """
        passed = float(np.interp(bandwidth, self.frequency, self.smooth))
        return self.least if self.least < _DEEP * passed else 0.0

    def gain(self, filter_: tuple[int, bool], bandwidth: float) -> float:
        """Of a filter."""
        passed = _response(self.frequency.tobytes(), self.rate, bandwidth, filter_)
        added = np.maximum(self.ends, self.floor(bandwidth))
        return self.log_likelihood(passed, np.where(passed < _DEEP, added, 0.0)) - self.plain

    def best(self) -> tuple[tuple[int, bool], float, float, float]:
        """The best filter, its bandwidth, its half-power frequency, and how well that is known [Hz].

        Other filters being possible.
        """
        likely = np.flatnonzero(self.gains.max(axis=1) > self.gains.max() - _RIVALS)
        found = [self._maximum(int(i)) for i in likely]
        bandwidth, half, std, gain = (np.array(x) for x in zip(*found, strict=True))
        k = int(np.argmax(gain))
        weight = np.exp(gain - gain[k])
        variance = float(weight @ (std**2 + (half - half[k]) ** 2) / weight.sum())
        return _FILTERS[likely[k]], float(bandwidth[k]), float(half[k]), float(np.sqrt(variance))

    def _maximum(self, i: int) -> tuple[float, float, float, float]:
        """Bandwidth of one kind of filter, half-power frequency, its deviation, and gain."""
        k = int(np.argmax(self.gains[i]))
        bounds = (np.log(self.grid[max(k - 1, 0)]), np.log(self.grid[min(k + 1, _GRID - 1)]))
        u, std, gain = self.shape_of(lambda u: self.gain(_FILTERS[i], float(np.exp(u))), bounds)
        bandwidth = float(np.exp(u))
        half, above = (_half_power(self.rate, float(np.exp(x)), _FILTERS[i]) for x in (u, u + std))
        if half is None:
            return bandwidth, bandwidth, bandwidth * std, gain
        return bandwidth, half, abs((above or self.rate / 2.0) - half), gain


def _half_power(rate: float, bandwidth: float, filter_: tuple[int, bool]) -> float | None:
    """Where the samples' spectrum has fallen by half, which aliases put above an analog filter's −3 dB.

    None where they keep it from falling so far before the Nyquist frequency is near: then the bandwidth of
    the analog filter is what can be said.
    """
    frequency = np.linspace(0.0, _REACHED * rate / 2.0, _RESPONSE)[1:]
    passed = _passed(frequency, rate, bandwidth, filter_)
    below = np.flatnonzero(passed < 0.5 * passed[0])
    if len(below) == 0 or below[0] == 0:
        return None
    k = below[0]
    share = (passed[k - 1] - 0.5 * passed[0]) / (passed[k - 1] - passed[k])
    return float(frequency[k - 1] + share * (frequency[k] - frequency[k - 1]))


def _held_out(view: View) -> float:
    """Log-likelihood of half of the coefficients under the filter and the noise of the others, both ways."""
    gain = 0.0
    for fold in coefficient_folds(view.n):
        screen = _Screen(view, fold)
        filter_, bandwidth, *_ = screen.best()
        factor = _visible(view, screen, bandwidth, filter_, fold)
        whole = view.combined(factor)
        noise = view.family.of(view.c, whole, fold).best(view.allowed)
        gain += view.log_likelihood(noise, ~fold, factor)
    return gain
