"""The sensor's bandwidth, or an anti-alias filter: noise falls off at high frequencies (thesis Fig. 5.10)."""

from __future__ import annotations

import dataclasses
import functools
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.fft import dct, dst
from scipy.ndimage import uniform_filter1d

from allanjax.critic.causes.spectral import SHARES, FineLevels, limited
from allanjax.critic.noise import MARKOV, Noise, density
from allanjax.critic.parameters import Limit
from allanjax.critic.view import EVERYTHING, Candidate, Cause, View, in_time
from allanjax.noise import terms
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model

# Smallest gain in log-likelihood [nats]: a judgement.
_WORTH = 6.0
# Bandwidths that are compared.
_GRID = 40
# Kinds of filters that are so much less likely [nats] than the best one are left out: a judgement.
_RIVALS = 10.0
# Log Occam factor of quantization [nats], about the mean of that of a term in `evidence`: a judgement.
_PRICE = 4.0
# Points of the response, and the share of the Nyquist frequency up to which half power is looked for.
_RESPONSE, _REACHED = 4097, 0.8
# Correlation time [samples] below which a Markov process without white noise is filtered white noise.
_SHORT = 20.0
# Response below which the record's ends are modelled; coefficients that a local mean is taken over.
_DEEP, _LOCAL = 0.01, 401
# Fewest coefficients of a bin that shows how low the spectrum falls.
_COUNTED = 100
# Least ratio of a level to the power that the ends add to it, for the level to say anything: a judgement.
_ABOVE = 10.0
# Share of the record at each end that is drawn anew.
_ENDS = 0.02
# Kinds of filters: order, and whether it is a digital one made by the bilinear transformation.
_FILTERS = ((1, False), (2, False), (1, True), (2, True), (3, True), (4, True))


class LowPass(Cause):
    """A Butterworth filter that all noise passes.

    Its bandwidth is the frequency at which the samples' spectrum has fallen by half, or, where aliases keep
    it from falling so far, the −3 dB frequency of the analog filter.
    """

    name = "low_pass"
    refit = "at once"

    def detect(self, view: View) -> Candidate | None:
        if self.name in view.found:
            return None
        noise = view.noise
        # A basic term that the model lacks is preferred if it explains as much.
        every, instead = [*EVERYTHING, *view.allowed], view.allowed
        basic = view.model_evidence.best(every)
        if "angle_random_walk" not in basic.terms and basic.shape * view.rate < _SHORT:
            # The same spectrum by another name: as white noise that is filtered it says where it ends.
            basic = view.model_evidence.best([t for t in every if t != MARKOV])
            instead = [t for t in view.allowed if t != MARKOV]
        screen = _Screen(view)
        gains = screen.gains
        if gains.max() < _WORTH:
            return None
        filter_, bandwidth, told = screen.best(view)
        response = screen.response(view, filter_, bandwidth)
        visible = _visible(view, response)
        after = view.with_factor(visible)
        # The evidence is that of the samples as they are, before their ends are replaced.
        filtered = after.noise.log_evidence
        deep = visible < _DEEP
        if deep.any():
            stationary = response.passed + response.floor / after.noise.variance
            after = _without_ends(after, deep, np.minimum(stationary / visible, 1.0))
            # What is below the response now is what was added, no longer the ends.
            visible = _visible(view.with_samples(after.samples), response)
            after = dataclasses.replace(after, factor=view.combined(visible))
        after = dataclasses.replace(after, filter_response=visible)
        gain = filtered - basic.log_evidence
        # Odds among the bandwidths and orders: flat.
        gain -= float(gains.max() - np.logaddexp.reduce(gains.ravel()) + np.log(gains.size))
        if filtered < noise.log_evidence - 4.0:
            return None
        # Steeper filters than the steepest one that is looked for look like it.
        steepest = filter_[0] == max(order for order, _ in _FILTERS)
        return Candidate(
            self.name,
            [told, view.estimate("order", filter_[0], 0.0, "1", "above" if steepest else "")],
            gain,
            float(np.exp(-max(gain, 0.0))),
            after,
            lambda: _held_out(view) - view.cv_log_likelihood_with(instead),
            (bandwidth, view.rate / 2.0),
            "frequency",
            lambda model: _filtered(model, bandwidth, min(filter_[0], 2)),
        )


def _passed(
    frequency: Float[np.ndarray, " k"], rate: float, bandwidth: float, filter_: tuple[int, bool]
) -> Float[np.ndarray, " k"]:
    """Power response of a filter, with the aliases of an analog one."""
    order, digital = filter_
    if digital:
        ratio = np.tan(np.pi * frequency / rate) / np.tan(np.pi * bandwidth / rate)
        return 1.0 / (1.0 + ratio ** (2 * order))
    term = terms.LowPass(1.0, bandwidth, order=order).sampled(rate)
    return density(term, frequency, rate)


@functools.lru_cache(maxsize=4 * _GRID * len(_FILTERS))
def _ends(rate: float, bandwidth: float, filter_: tuple[int, bool]) -> Float[np.ndarray, " fine"]:
    """Power that a record's two ends add to the response, times the number of samples.

    Cosines see the record continued by its mirror image, which has kinks at its ends. With the autocovariance
    r the squares of coefficients are expected to be Σ (2 − 2k/n)·r_k cos(ak) − r_0 − 2/(n sin a)·Σ r_k
    sin(ak); the ends' part is −(2/n)·[Σ k·r_k cos(ak) + Σ r_k sin(ak)/sin a].
    """
    m = _RESPONSE - 1
    response = _passed(_fine(rate), rate, bandwidth, filter_)
    r = dct(np.concatenate([response[:1], response, response[-1:]]), type=1) / (2.0 * m)
    lag = np.arange(m + 1.0)
    cosines = 0.5 * dct(lag * r, type=1)[1:-1] + 0.5 * m * r[-1] * (-1.0) ** lag[1:-1]
    sines = 0.5 * dst(r[1:-1], type=1) / np.sin(np.pi * lag[1:-1] / m)
    return np.maximum(-2.0 * (cosines + sines), 0.0)


def _fine(rate: float) -> Float[np.ndarray, " fine"]:
    """Frequencies between zero and the Nyquist frequency."""
    return np.arange(1, _RESPONSE - 1) * rate / (2.0 * (_RESPONSE - 1))


def _at(
    frequency: Float[np.ndarray, " k"], rate: float, bandwidth: float, filter_: tuple[int, bool]
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Power response of a filter, and the power that the ends add to it times the number of samples."""
    ends = np.interp(frequency, _fine(rate), _ends(rate, bandwidth, filter_))
    return _passed(frequency, rate, bandwidth, filter_), ends


@functools.lru_cache(maxsize=4 * _GRID * len(_FILTERS))
def _response(
    within: bytes, rate: float, bandwidth: float, filter_: tuple[int, bool]
) -> tuple[Float[np.ndarray, " bins"], Float[np.ndarray, " bins"]]:
    """Means in bins of the response and of the ends' power; cached, since all axes share the filters."""
    found = _at(np.frombuffer(within), rate, bandwidth, filter_)
    passed, ends = (x.reshape(-1, len(SHARES)) @ SHARES for x in found)
    return passed, ends


class _Response(NamedTuple):
    """Visible response of a filter, coefficient by coefficient.

    Attributes:
        passed: power response.
        ends: power that the record's two ends add to it.
        floor: power of noise that is added after the filter and hides its deepest response.
        told: highest frequency at which the filter determines the spectrum [Hz].
    """

    passed: Float[np.ndarray, " n-1"]
    ends: Float[np.ndarray, " n-1"]
    floor: float
    told: float


def _visible(view: View, response: _Response, fold: np.ndarray | None = None) -> Float[np.ndarray, " n-1"]:
    """Ratio of the filtered to the unfiltered spectrum.

    Where the record's ends or the noise added after the filter exceed what it passes, the ratio is the
    record's own, so that these coefficients carry no information.
    """
    passed, ends, floor, limit = response
    deep, used = passed < _DEEP, np.ones(view.n - 1) if fold is None else fold.astype(float)
    if not deep.any():
        return passed
    clear = ~deep & (used > 0.0)
    level = float(np.mean(view.squares[clear] / passed[clear]))
    factor = passed + np.where(deep, ends + floor / level, 0.0)
    noise = view.model_evidence_of(fold, factor).best(view.allowed)
    added = np.where(deep, ends + floor / noise.variance, 0.0)
    ratio = uniform_filter1d(used * view.squares / noise.variance, _LOCAL, mode="nearest")
    ratio /= np.maximum(uniform_filter1d(used, _LOCAL, mode="nearest"), 1.0 / _LOCAL)
    told = (added <= passed) & (view.family.frequency <= limit)
    return np.where(told, passed + added, np.maximum(ratio, 1e-9 * factor))


def _without_ends(view: View, deep: Bool[np.ndarray, " n-1"], share: Float[np.ndarray, " n-1"]) -> View:
    """View whose ends are drawn anew in the filter's stop band; the ends count as imputed.

    Whitening amplifies the stop band, and with it the kinks of the mirrored record.

    Args:
        view: view with the filter.
        deep: whether a coefficient is in the stop band.
        share: share of the expected squares that is not due to the kinks.
    """
    k = np.arange(view.n)
    # Gradually: an edge would be a sample that stands out.
    near = np.clip(1.0 - np.minimum(k, view.n - 1 - k) / (_ENDS * view.n), 0.0, 1.0)
    root = np.sqrt(view.variance())
    drawn = np.sqrt(share) * np.random.default_rng(0).standard_normal(view.n - 1)
    change = np.sin(0.5 * np.pi * near) ** 2 * in_time(np.where(deep, drawn - view.residual / root, 0.0))
    mended = view.samples + in_time(np.where(deep, root * dct(change, norm="ortho")[1:], 0.0))
    return view.with_samples(mended, near > 0.0)


def _filtered(model: Model, bandwidth: float, order: int) -> Model:
    """Model whose white noise is filtered; slower noise passes the filter."""
    white = "angle_random_walk"
    if white not in model.term_labels:
        return model
    N = model.values[white]
    return model.without([white]) + terms.LowPass(N, bandwidth, order=order)


class _Screen(FineLevels):
    """Likelihoods of a grid of filters, all powers being fitted to each."""

    def __init__(self, view: View, fold: np.ndarray | None = None) -> None:
        super().__init__(view, fold)
        self.rate = view.rate
        self.n, self.plain = view.n, self.log_likelihood()
        self.quantized = {"quantization", "angle_random_walk"} <= set(view.allowed)
        level = self.squares / self.size
        self.least = float(np.min(level[self.size >= _COUNTED], initial=np.inf))
        self.grid = np.geomspace(0.005 * self.rate, 0.98 * self.rate / 2.0, _GRID)
        self.gains = np.full((len(_FILTERS), _GRID), -np.inf)
        for some in (slice(0, None, 2), slice(1, None, 2)):
            self.gains[:, some] = [[self.gain(filter_, f) for f in self.grid[some]] for filter_ in _FILTERS]
            # Half as far from the best bandwidth as its neighbours are, these gain not much more than they.
            if self.gains.max() < 0.5 * _WORTH:
                break

    def response(self, view: View, filter_: tuple[int, bool], bandwidth: float) -> _Response:
        """Visible response of a filter, with the fitted power of the noise that is added after it.

        That noise may be outliers too small to be seen, or the digits of the samples.
        """
        passed, ends = _at(view.family.frequency, self.rate, bandwidth, filter_)
        floor = self._fitted(filter_, bandwidth)[1]
        return _Response(passed, ends / view.n, floor, float(self.frequency[-1]))

    def gain(self, filter_: tuple[int, bool], bandwidth: float) -> float:
        """Gain in log-likelihood by a filter [nats]."""
        return self._fitted(filter_, bandwidth)[0] - self.plain

    def _hidden(self, bandwidth: float) -> bool:
        """Whether the spectrum falls so far that noise added after the filter may be seen."""
        return bool(self.least < _DEEP * np.interp(bandwidth, self.frequency, self.smooth))

    def _fitted(self, filter_: tuple[int, bool], bandwidth: float) -> tuple[float, float]:
        """Log-likelihood under a filter with the best powers, and the power of the noise added after it."""
        passed, ends = _response(self.within.tobytes(), self.rate, bandwidth, filter_)
        deep = passed < _DEEP
        passed = np.where(deep, passed + ends / self.n, passed)
        if not (deep.any() and self._hidden(bandwidth)):
            return self.log_likelihood(passed), 0.0
        value, powers = self.scored(passed, deep / passed)
        return value, float(powers[-1])

    def best(self, view: View) -> tuple[tuple[int, bool], float, Estimate]:
        """Best filter, its bandwidth [Hz], and its half-power frequency, averaged over plausible filters.

        The average is also over noise with and without quantization, which rises where a filter falls.
        """
        self._leave_ends_out()
        likely = np.flatnonzero(self.gains.max(axis=1) > self.gains.max() - _RIVALS)
        noises = (
            [(self.columns, _PRICE), (self.columns[1:], 0.0)] if self.quantized else [(self.columns, 0.0)]
        )
        found: list[_Maximum] = []
        for columns, price in noises:
            self.columns = columns
            found += [self._maximum(int(i), price) for i in likely]
        best = max(found, key=lambda one: one.gain)
        self.columns = best.columns
        weight = np.exp([one.gain - best.gain for one in found])
        off = [one.std**2 + (one.half_power - best.half_power) ** 2 for one in found]
        std = np.sqrt(weight @ off / weight.sum())
        told = view.estimate("bandwidth", best.half_power, std, "Hz", best.limit)
        return best.filter_, best.bandwidth, told

    def _leave_ends_out(self) -> None:
        """Leave out the highest frequencies, where only the ends are left.

        They are two random values that all coefficients there share, and would outvote all others.
        """
        i, k = np.unravel_index(np.argmax(self.gains), self.gains.shape)
        passed, ends = _response(self.within.tobytes(), self.rate, float(self.grid[k]), _FILTERS[i])
        level = float(np.median((self.smooth / passed)[passed > 0.5 * passed.max()]))
        told = np.flatnonzero(self.squares / self.size > _ABOVE * level * ends / self.n)
        if len(told):
            self.keep(int(told[-1]) + 1)
            self.plain = self.log_likelihood()

    def _maximum(self, i: int, price: float) -> _Maximum:
        """Best bandwidth of one kind of filter."""
        k, filter_ = int(np.argmax(self.gains[i])), _FILTERS[i]
        bounds = (np.log(self.grid[max(k - 1, 0)]), np.log(self.grid[min(k + 1, _GRID - 1)]))
        u, std, gain = self.shape_of(lambda u: self.gain(filter_, float(np.exp(u))), bounds)
        bandwidth = float(np.exp(u))
        u, std, limit = limited(u, std, (np.log(self.grid[0]), np.log(self.grid[-1])))
        if limit:
            told = float(np.exp(u))
            told = _half_power(self.rate, told, filter_) or told
            return _Maximum(filter_, bandwidth, told, 0.0, gain - price, self.columns, limit)
        half, above = (_half_power(self.rate, float(np.exp(x)), filter_) for x in (u, u + std))
        std = bandwidth * std if half is None else abs((above or self.rate / 2.0) - half)
        return _Maximum(filter_, bandwidth, half or bandwidth, std, gain - price, self.columns, "")


class _Maximum(NamedTuple):
    """Best bandwidth of one kind of filter [Hz], its half-power frequency or a limit, the noise terms."""

    filter_: tuple[int, bool]
    bandwidth: float
    half_power: float
    std: float
    gain: float
    columns: Float[np.ndarray, "terms bins"]
    limit: Limit


def _half_power(rate: float, bandwidth: float, filter_: tuple[int, bool]) -> float | None:
    """Frequency [Hz] at which the samples' spectrum has fallen by half.

    Aliases put it above an analog filter's −3 dB; None where they keep the spectrum from falling so far below
    the Nyquist frequency.
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
    """Log-likelihood of each half of the coefficients under the filter and noise of the other half."""

    def fitted(fold: Bool[np.ndarray, " n-1"]) -> tuple[Noise, Float[np.ndarray, " n-1"]]:
        screen = _Screen(view, fold)
        filter_, bandwidth, *_ = screen.best(view)
        factor = _visible(view, screen.response(view, filter_, bandwidth), fold)
        return view.model_evidence_of(fold, factor).best(view.allowed), factor

    return view.cross_validated(fitted)
