"""Changes of the variance: noise that is larger or smaller for a while."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.stats import multivariate_normal, norm

from allanjax.base.normal import ONE_SIDED_95
from allanjax.critic.bank import PARTS, any_of, extrapolated, owners
from allanjax.critic.effect import Effect
from allanjax.critic.noise import FIXED, NEARLY_ALL, WHITE
from allanjax.critic.policy import judged
from allanjax.critic.view import Candidate, View
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
# Number of places within a block on either side of an end at which it may be located.
_FINER = 32
# Newton steps to the largest likelihood of a course of the level.
_ROUNDS = 8
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
    inner: Float[np.ndarray, "*k"], count: Float[np.ndarray, "*k"], whole: float, n: float
) -> Float[np.ndarray, "*k"]:
    """Gain in log-likelihood [nats] if `count` of n squares, with the sum `inner`, have their own mean."""
    rest, outer = n - count, whole - inner
    with np.errstate(divide="ignore", invalid="ignore"):
        gain = n * np.log(whole / n) - count * np.log(inner / count) - rest * np.log(outer / rest)
    return np.where((np.minimum(count, rest) > _SHORTEST * n) & np.isfinite(gain), 0.5 * gain, 0.0)


@dataclasses.dataclass(frozen=True, eq=False)
class _Kind:
    """Part of the noise that may change: "all" of it, or the "white" noise only.

    Attributes:
        share: share of this part in the expected squares of the coefficients.
        squares: squares, with mean 1, of the record after the filter √share, matched to a change of the part.
        worth: degrees of freedom for each of them, as neighbours are correlated.
        edges: edges of the blocks that form the intervals [samples].
    """

    name: str
    share: Float[np.ndarray, " n-1"] | float
    squares: Float[np.ndarray, " n"]
    worth: float
    edges: Int[np.ndarray, " k"]

    @classmethod
    def of(
        cls,
        view: View,
        name: str,
        share: Float[np.ndarray, " n-1"] | float,
        filtered: Float[np.ndarray, " n"],
    ) -> _Kind:
        """Part of a view's noise with this share, given the `filtered` record."""
        squares = filtered**2
        # Imputed samples have the right variance, but the ends of a filtered record do not, and quantization
        # noise at the ends differs from that of the mirrored record.
        known = np.flatnonzero(~view.imputed)
        first, last = max(known[0], _ENDS), min(known[-1], view.n - 1 - _ENDS)
        squares[:first] = squares[last + 1 :] = np.mean(squares[first : last + 1])
        worth = float(np.mean(share) ** 2 / np.mean(np.square(share)))
        blocks = min(_BLOCKS, view.n // 16)
        edges = np.rint(np.arange(blocks + 1) * view.n / blocks).astype(int)
        return cls(name, share, squares / squares.mean(), worth, edges)

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
    kinds = [_Kind.of(view, "all", 1.0, view.whitened)]
    power = view.noise.power.get(WHITE)
    if power is not None:
        share = power * view.family.spectra[FIXED.index(WHITE)] / view.noise.variance
        if np.mean(share) < NEARLY_ALL:
            filtered = in_time(view.residual * np.sqrt(share / view.variance()))
            kinds.append(_Kind.of(view, "white", share, filtered))
    return kinds


class VarianceChange(Effect):
    """A time span in which the noise, or its white part, has another variance.

    A priori it is as likely to reach an end of the record as to begin and end within it.
    """

    name = "variance_change"

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
        a, b = _located(kind)
        inside, outside = kind.levels(a, b)
        # If a record begins or ends with another level, the louder part is taken to be the change.
        if inside < outside and (a == 0 or b == view.n):
            a, b = (b, view.n) if a == 0 else (0, a)
            inside, outside = outside, inside
        ratio = inside / outside
        found = kind.excess(ratio)
        # The ratio of the squares has the relative scatter √(2/m₁ + 2/m₂).
        m = kind.worth * np.array([b - a, view.n - b + a])
        scatter = kind.excess(1.0 + ratio * float(np.sqrt(np.sum(2.0 / m))))
        variance = view.variance() * (1.0 + max(found, _LEAST) * kind.share)
        whitened = view.whitened.copy()
        whitened[a:b] = in_time(view.residual / np.sqrt(variance))[a:b]
        start_std, end_std = _spreads(kind, a, b)
        return Candidate(
            self.name,
            [
                view.time_estimate("start", a, start_std),
                view.time_estimate("end", b, end_std),
                _ratio(view, found, scatter),
            ],
            gain,
            _p_value(kinds),
            view.with_samples(view.recoloured(whitened)),
            lambda: _held_out(kind),
            (a / view.rate, b / view.rate),
            details={"noise": kind.name},
            doubt=_doubt(kind),
        )


def _doubt(kind: _Kind) -> str:
    """Why a change of the level is hardly one from one value to another: it varies in another way."""
    sums, size = np.diff(kind.total[kind.edges]), np.diff(kind.edges)
    t = (np.arange(len(sums)) + 0.5) / len(sums)
    angle = np.pi * np.arange(1, len(sums) // 2 + 1)[:, None] * t
    # A trend, and waves of ½, 1, 1½ … periods of any phase.
    trend = np.stack([t - 0.5, np.zeros(len(t))])
    courses = np.concatenate([trend[None], np.stack([np.cos(angle), np.sin(angle)], axis=1)])
    best = _course_gain(courses - courses.mean(axis=2, keepdims=True), sums, size)
    own = _Intervals.between(len(kind.edges)).gains(kind.total[kind.edges], kind.edges).max()
    clearly = kind.worth * (best - own) > judged("variance_change", "clearly")
    return "the level varies in another way" if clearly else ""


def _course_gain(
    courses: Float[np.ndarray, "courses 2 k"], sums: Float[np.ndarray, " k"], size: Float[np.ndarray, " k"]
) -> float:
    """Largest gain in log-likelihood if the log level of squares follows a sum of two courses [nats]."""
    weights, mean = np.zeros(courses.shape[:2]), sums.sum() / size.sum()
    for _ in range(_ROUNDS):
        level = mean * np.exp(np.einsum("cpk,cp->ck", courses, weights))
        gradient = np.einsum("cpk,ck->cp", courses, 0.5 * (sums / level - size))
        curvature = np.einsum("cpk,cqk,ck->cpq", courses, courses, 0.5 * sums / level)
        curvature += 1e-9 * size.sum() * np.eye(2)
        move = np.linalg.solve(curvature, gradient[..., None])[..., 0]
        weights += np.clip(move, -1.0, 1.0)
    level = mean * np.exp(np.einsum("cpk,cp->ck", courses, weights))
    loss = 0.5 * np.sum(sums / level + size * np.log(level / mean), axis=1)
    return float(np.max(0.5 * size.sum() - loss))


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


def _located(kind: _Kind) -> tuple[int, int]:
    """Interval with the largest score, with its ends relocated by up to one block."""
    n, intervals, best = len(kind.squares), _Intervals.between(len(kind.edges)), int(np.argmax(kind.scores))
    length = n / (len(kind.edges) - 1)

    def near(edge: int) -> Int[np.ndarray, " places"]:
        if edge in (0, n):
            return np.array([edge])
        places = np.linspace(max(edge - length, 0.0), min(edge + length, n), 2 * _FINER + 1)
        return np.unique(np.rint(places).astype(int))

    first, last = near(kind.edges[intervals.first[best]]), near(kind.edges[intervals.last[best]])
    inner = kind.total[last] - kind.total[first][:, None]
    gains = _gain(inner, last - first[:, None], float(kind.total[-1]), n)
    i, j = np.unravel_index(int(np.argmax(gains)), gains.shape)
    return int(first[i]), int(last[j])


def _spreads(kind: _Kind, a: int, b: int) -> tuple[float, float]:
    """Standard deviation of each end of the interval, given the other [samples]."""
    inside, outside = kind.levels(a, b)
    step = inside / outside
    # Within the number of samples in which a change of this size becomes visible.
    block = kind.edges[1] / np.sqrt(12.0)
    fine = min(4.0 / max((step - 1.0 - np.log(step)) * kind.worth, 1e-6), block)
    first, last, _ = _Intervals.between(len(kind.edges))

    def spread(own: Int[np.ndarray, " k"], x: int, other: Int[np.ndarray, " k"], y: int) -> float:
        some = other == np.argmin(abs(kind.edges - y))
        weight = np.exp(kind.scores[some] - kind.scores[some].max())
        return float(np.hypot(fine, np.sqrt(weight @ (kind.edges[own[some]] - x) ** 2 / weight.sum())))

    return spread(first, a, last, b), spread(last, b, first, a)


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
