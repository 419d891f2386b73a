"""Changes of the variance: noise that is larger or smaller for a while."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.stats import multivariate_normal, norm

from allanjax.base.normal import ONE_SIDED_95
from allanjax.critic.bank import PARTS, any_of, extrapolated, owners
from allanjax.critic.effect import Candidate, Effect, View
from allanjax.critic.noise import NEARLY_ALL, WHITE
from allanjax.critic.policy import judged
from allanjax.noise.estimate import Estimate
from allanjax.record.completion import in_time

# Largest number of blocks that form the intervals.
_BLOCKS = 256
# Shortest interval as a share of the record; probability that it lasts to an end; log Occam factor.
_SHORTEST, _LASTING, _PRICE = (judged("variance_change", name) for name in ("shortest", "lasting", "price"))
# Draws from which the law of the largest score is extrapolated.
_DRAWS = 1000
# Smallest score that is examined more closely [nats].
_WORTH = 6.0
# Number of places in the record at which an end may be located.
_PLACES = 32 * _BLOCKS
# Neighbouring samples that are held out together.
_FOLD_BLOCK = 16
# Samples at each end of the record that are not used.
_ENDS = 16
# Least relative change of a noise's power, as some of it always remains.
_LEAST = -0.99
# Normal variates beyond this are too rare for the bivariate law to be computed.
_NORMAL = 5.0


class _Intervals(NamedTuple):
    """First and last edges of all intervals, and their log trials factors [nats].

    Intervals within the record, of which there are more, have a larger factor than those that last to an end
    of it: either kind is as likely a priori as its judgement says.
    """

    first: Int[np.ndarray, " k"]
    last: Int[np.ndarray, " k"]
    price: Float[np.ndarray, " k"]

    @classmethod
    @functools.lru_cache(maxsize=4)
    def between(cls, edges: int) -> _Intervals:
        """Intervals between any two of so many edges."""
        first, last = np.triu_indices(edges, 1)
        within = (first > 0) & (last < edges - 1)
        odds = within.sum() / np.sum(~within) * _LASTING / (1.0 - _LASTING)
        return cls(first, last, np.where(within, np.log(odds), 0.0))

    def gains(
        self, total: Float[np.ndarray, " edges"], edges: Float[np.ndarray, " edges"]
    ) -> Float[np.ndarray, " k"]:
        """Gain of each interval [nats], given the sums of squares up to the edges."""
        inner, count = (x[self.last] - x[self.first] for x in (total, edges))
        return _gain(inner, count, total[-1], edges[-1])


def _gain(
    inner: Float[np.ndarray, "*k"],
    count: Float[np.ndarray, "*k"],
    whole: float,
    n: float,
    shortest: float = _SHORTEST,
) -> Float[np.ndarray, "*k"]:
    """Gain in log-likelihood [nats] if `count` of n squares, with the sum `inner`, have their own mean."""
    rest, outer = n - count, whole - inner
    with np.errstate(divide="ignore", invalid="ignore"):
        gain = n * np.log(whole / n) - count * np.log(inner / count) - rest * np.log(outer / rest)
    return np.where((np.minimum(count, rest) > shortest * n) & np.isfinite(gain), 0.5 * gain, 0.0)


class _Kind:
    """Part of a view's noise that may change: "all" of it, or the "white" noise only.

    Attributes:
        share: share of this part in the expected squares of the coefficients.
        squares: squares, with mean 1, of the record after the filter √share, matched to a change of the part.
        worth: degrees of freedom for each of them, as neighbours are correlated.
        edges: edges of the blocks that form the intervals [samples].
    """

    def __init__(
        self, view: View, name: str, share: Float[np.ndarray, " n-1"] | float, filtered: np.ndarray
    ) -> None:
        self.name, self.share = name, share
        squares = filtered**2
        # Imputed samples have the right variance, but the ends of a filtered record do not, and quantization
        # noise at the ends differs from that of the mirrored record.
        known = np.flatnonzero(~view.imputed)
        first, last = max(known[0], _ENDS), min(known[-1], view.n - 1 - _ENDS)
        squares[:first] = squares[last + 1 :] = np.mean(squares[first : last + 1])
        self.squares = squares / squares.mean()
        self.worth = float(np.mean(share) ** 2 / np.mean(np.square(share)))
        blocks = min(_BLOCKS, view.n // 16)
        self.edges = np.rint(np.arange(blocks + 1) * view.n / blocks).astype(int)

    @functools.cached_property
    def total(self) -> Float[np.ndarray, " n+1"]:
        """Sums of the squares up to each sample."""
        return np.append(0.0, np.cumsum(self.squares))

    @functools.cached_property
    def scores(self) -> Float[np.ndarray, " k"]:
        """Gain in log-likelihood from another variance in each interval, less the log trials factor."""
        intervals = _Intervals.between(len(self.edges))
        return self.worth * intervals.gains(self.total[self.edges], self.edges) - intervals.price

    def levels(self, a: int, b: int) -> tuple[float, float]:
        """Mean squares inside and outside an interval."""
        n, inner = len(self.squares), float(self.total[b] - self.total[a])
        return inner / (b - a), (float(self.total[-1]) - inner) / (n - b + a)

    def excess(self, ratio: float) -> float:
        """Relative growth of this part of the noise if the squares have grown by a ratio."""
        return (ratio - 1.0) * float(np.mean(self.share) / np.mean(np.square(self.share)))


def _kinds(view: View) -> list[_Kind]:
    """Parts of a view's noise that may change."""
    kinds = [_Kind(view, "all", 1.0, view.whitened)]
    power = view.noise.power.get(WHITE)
    if power is not None:
        share = power * view.family.unit(WHITE, 0) / view.noise.variance
        if np.mean(share) < NEARLY_ALL:
            filtered = in_time(view.residual * np.sqrt(share / view.variance()))
            kinds.append(_Kind(view, "white", share, filtered))
    return kinds


class VarianceChange(Effect):
    """A time span, as likely to an end of the record as within, of another variance of (white) noise."""

    name = "variance_change"
    is_event = True

    def p_value(self, view: View) -> float:
        return _p_value(_kinds(view))

    def detect(self, view: View) -> Candidate | None:
        kinds = _kinds(view)
        kind = max(kinds, key=lambda kind: kind.scores.max())
        if kind.scores.max() < _WORTH:
            return None
        # The mean over those that last to an end, of which each counts fully, and the others together.
        lasting = np.count_nonzero(_Intervals.between(len(kind.edges)).price == 0.0)
        every = np.logaddexp.reduce(np.concatenate([kind.scores for kind in kinds]))
        gain = float(every - np.log(len(kinds) * lasting / _LASTING)) - _PRICE
        if gain <= 0.0:
            return None
        start, end = _ends(kind)
        a, b = start[0], end[0]
        inside, outside = kind.levels(a, b)
        # If a record begins or ends with another level, the louder part is taken to be the change.
        if inside < outside and (a == 0 or b == view.n):
            start, end = (end, (view.n, 0.0)) if a == 0 else ((0, 0.0), start)
            a, b = start[0], end[0]
            inside, outside = outside, inside
        ratio = inside / outside
        found = kind.excess(ratio)
        # The ratio of the squares has the relative scatter √(2/m₁ + 2/m₂).
        m = kind.worth * np.array([b - a, view.n - b + a])
        scatter = kind.excess(1.0 + ratio * float(np.sqrt(np.sum(2.0 / m))))
        growth = 1.0 + max(found, _LEAST) * kind.share
        whitened = view.whitened.copy()
        if isinstance(growth, float):
            whitened[a:b] /= np.sqrt(growth)
        else:
            whitened[a:b] = in_time(view.residual / np.sqrt(view.variance() * growth))[a:b]
        return Candidate(
            self.name,
            [
                view.time_estimate("start", *start),
                view.time_estimate("end", *end),
                _ratio(view, found, scatter),
            ],
            gain,
            _p_value(kinds),
            view.recoloured(whitened),
            lambda: _held_out(kind),
            (a / view.rate, b / view.rate),
            details={"noise": kind.name},
            doubt=_doubt(kind),
        )


def _doubt(kind: _Kind) -> str:
    """Why a change of the level is hardly one from one value to another: it varies in another way."""
    blocks, size = len(kind.edges) - 1, np.diff(kind.edges)
    # Log levels of blocks of m degrees of freedom have the variance 2/m.
    y = np.log(np.maximum(np.diff(kind.total[kind.edges]) / size, 1.0 + _LEAST))
    y -= y.mean()
    # Waves of ½, 1, 1½ … periods of any phase; the first one is nearly a trend as well.
    angle = np.pi * np.outer(np.arange(1, blocks // 2 + 1), (np.arange(blocks) + 0.5) / blocks)
    waves = np.stack([np.cos(angle), np.sin(angle)])
    waves -= waves.mean(axis=-1, keepdims=True)
    wave = np.sum((waves @ y) ** 2 / np.sum(waves**2, axis=-1), axis=0).max()
    first, last, _ = _Intervals.between(blocks + 1)
    weight = (last - first) * (blocks - last + first) / blocks
    total, possible = np.append(0.0, np.cumsum(y)), weight > _SHORTEST * (1.0 - _SHORTEST) * blocks
    change = ((total[last] - total[first])[possible] ** 2 / weight[possible]).max()
    gain = 0.25 * kind.worth * size.mean() * (wave - change)
    return "the level varies in another way" if gain > judged("variance_change", "clearly") else ""


def _ratio(view: View, excess: float, scatter: float) -> Estimate:
    """Ratio of the noise's deviations, from the growth of its power; an upper limit if it nearly vanished."""
    if excess < max(_LEAST, 2.0 * scatter - 1.0):
        largest = np.sqrt(1.0 + max(excess + ONE_SIDED_95 * scatter, _LEAST))
        return view.estimate("ratio", largest, np.nan, "1", "below")
    ratio = np.sqrt(1.0 + excess)
    # d ratio = d excess / (2 ratio).
    return view.estimate("ratio", ratio, scatter / (2.0 * ratio), "1")


def _p_value(kinds: Sequence[_Kind]) -> float:
    """p-value of the largest score of some kinds.

    Sums of the squares after the two filters, 1 and √share, are correlated by √worth.
    """
    u = float(np.sqrt(2.0 * max(kind.scores.max() for kind in kinds)))
    p = extrapolated(_null(len(kinds[0].edges) - 1), u)
    if len(kinds) == 1:
        return p
    r = float(np.sqrt(kinds[1].worth))
    both = multivariate_normal([0.0, 0.0], [[1.0, r], [r, 1.0]])
    # With two kinds, the largest of many exceeds u more often by the same factor as a single normal variate.
    below = both.cdf([u, u], lower_limit=[-u, -u])
    times = min((1.0 - below) / (2.0 * norm.sf(u)), 2.0) if u < _NORMAL else 2.0
    return any_of(p, times)


def _ends(kind: _Kind) -> tuple[tuple[int, float], tuple[int, float]]:
    """Ends of the best interval, relocated by up to one block, with their standard deviations [samples]."""
    n, total, best = len(kind.squares), kind.total, int(np.argmax(kind.scores))
    places = np.unique(np.rint(np.linspace(0.0, n, _PLACES + 1)).astype(int))

    def near(edge: int) -> Int[np.ndarray, " k"]:
        """Places near an edge; an end of the record stays."""
        return places[abs(places - edge) <= n / (len(kind.edges) - 1)] if 0 < edge < n else np.array([edge])

    def spread(own: int, other: int) -> float:
        """Standard deviation of an end given the other, for intervals of any length."""
        if own in (0, n):
            return 0.0
        side = places[(places - other) * (own - other) > 0]
        gains = kind.worth * _gain(abs(total[side] - total[other]), abs(side - other), total[-1], n, 0.0)
        weight = np.exp(gains - gains.max())
        return float(np.sqrt(weight @ (side - own) ** 2 / weight.sum() + (n / _PLACES) ** 2 / 12.0))

    first, last = (near(int(kind.edges[x[best]])) for x in _Intervals.between(len(kind.edges))[:2])
    gains = _gain(total[last] - total[first][:, None], last - first[:, None], total[-1], n)
    i, j = np.unravel_index(int(np.argmax(gains)), gains.shape)
    a, b = int(first[i]), int(last[j])
    return (a, spread(a, b)), (b, spread(b, a))


@functools.lru_cache(maxsize=4)
def _null(blocks: int) -> Float[np.ndarray, " draws"]:
    """Draws of the root of twice the largest score, without a change, for blocks of many samples."""
    rng, many, intervals = np.random.default_rng(0), 400, _Intervals.between(blocks + 1)
    edges = np.arange(blocks + 1.0) * many
    draws = (np.append(0.0, np.cumsum(rng.chisquare(many, blocks))) for _ in range(_DRAWS))
    return np.sqrt([2.0 * np.max(intervals.gains(total, edges) - intervals.price) for total in draws])


def _held_out(kind: _Kind) -> float:
    """Gain in log-likelihood [nats] on parts of the samples with the interval from the other parts."""
    blocks = len(kind.edges) - 1
    cell = np.repeat(np.arange(blocks), np.diff(kind.edges)) * PARTS + owners(len(kind.squares), _FOLD_BLOCK)
    # Sums and numbers of the squares in each block and part.
    cells = np.stack([np.bincount(cell, weights, blocks * PARTS) for weights in (kind.squares, None)])
    cells = cells.reshape(2, blocks, PARTS)
    intervals, gain = _Intervals.between(blocks + 1), 0.0
    for part in range(PARTS):
        own, others = cells[..., part], cells.sum(axis=-1) - cells[..., part]
        total = np.pad(np.cumsum(others, axis=1), ((0, 0), (1, 0)))
        best = int(np.argmax(kind.worth * intervals.gains(*total) - intervals.price))
        place = np.arange(blocks)
        inside = (place >= intervals.first[best]) & (place < intervals.last[best])
        whole = total[0, -1] / total[1, -1]
        for stretch in (inside, ~inside):
            (squares, size), (known, count) = (x[:, stretch].sum(axis=1) for x in (own, others))
            level = known / count
            gain += 0.5 * float(squares / whole - squares / level + size * np.log(whole / level))
    return kind.worth * gain
