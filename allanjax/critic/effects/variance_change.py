"""Changes of the variance: noise that is larger or smaller for a while."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import multivariate_normal, norm

from allanjax.base.normal import ONE_SIDED_95
from allanjax.critic.bank import PARTS, any_of, extrapolated, folds
from allanjax.critic.effect import Effect
from allanjax.critic.noise import NEARLY_ALL, WHITE
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
    edges: Float[np.ndarray, " k"]

    @classmethod
    def of(cls, view: View, name: str, share: Float[np.ndarray, " n-1"] | float) -> _Kind:
        """Part of a view's noise with this share."""
        u = (
            view.whitened
            if isinstance(share, float)
            else in_time(np.sqrt(share) * view.residual / np.sqrt(view.variance()))
        )
        squares = u**2
        # Imputed samples have the right variance, but the ends of a filtered record do not, and quantization
        # noise at the ends differs from that of the mirrored record.
        known = np.flatnonzero(~view.imputed)
        first, last = max(known[0], _ENDS), min(known[-1], view.n - 1 - _ENDS)
        squares[:first] = squares[last + 1 :] = np.mean(squares[first : last + 1])
        worth = float(np.mean(share) ** 2 / np.mean(np.square(share)))
        blocks = min(_BLOCKS, view.n // 16)
        edges = np.rint(np.arange(blocks + 1) * view.n / blocks)
        return cls(name, share, squares / squares.mean(), worth, edges)

    def scores(self) -> Float[np.ndarray, "k k"]:
        """Gain in log-likelihood from another variance between any two edges, less the log trials factor."""
        return self.worth * interval_gains(self.squares, self.edges) - _log_trials_factor(len(self.edges))

    def excess(self, ratio: float) -> float:
        """Relative growth of this part of the noise if the squares have grown by a ratio."""
        return (ratio - 1.0) * float(np.mean(self.share) / np.mean(np.square(self.share)))


def _kinds(view: View) -> list[_Kind]:
    """Parts of a view's noise that may change."""
    kinds = [_Kind.of(view, "all", 1.0)]
    power = view.noise.power.get(WHITE)
    if power is not None:
        share = power * view.family.unit(WHITE, 0) / view.noise.variance
        if np.mean(share) < NEARLY_ALL:
            kinds.append(_Kind.of(view, "white", share))
    return kinds


class VarianceChange(Effect):
    """A time span in which the noise, or its white part, has another variance.

    A priori it is as likely to reach an end of the record as to begin and end within it.
    """

    name = "variance_change"

    def p_value(self, view: View) -> float:
        kinds = _kinds(view)
        return _p_value(float(max(kind.scores().max() for kind in kinds)), kinds)

    def detect(self, view: View) -> Candidate | None:
        kinds = _kinds(view)
        scores = [kind.scores() for kind in kinds]
        best = int(np.argmax([score.max() for score in scores]))
        kind, score = kinds[best], scores[best]
        if score.max() < _WORTH:
            return None
        # The mean over those that last to an end, of which each counts fully, and the others together.
        count = len(kinds) * np.sum(_lasting(len(score))) / _LASTING
        each = np.concatenate([s[_intervals(len(s))] for s in scores])
        gain = float(np.logaddexp.reduce(each) - np.log(count)) - _PRICE
        if gain <= 0.0:
            return None
        i, j = np.unravel_index(int(np.argmax(score)), score.shape)
        a, b = _located(kind.squares, kind.edges[i], kind.edges[j], view.n / (len(kind.edges) - 1))
        inside = (np.arange(view.n) >= a) & (np.arange(view.n) < b)
        louder = kind.squares[inside].mean() > kind.squares[~inside].mean()
        # If a record begins or ends with another level, the louder part is taken to be the change.
        if not louder and (a == 0 or b == view.n):
            a, b = (b, view.n) if a == 0 else (0, a)
            inside = ~inside
        spreads = _spreads(kind, score, a, b)
        m = kind.worth * np.array([inside.sum(), (~inside).sum()], float)
        level = np.array([kind.squares[inside].mean(), kind.squares[~inside].mean()])
        found = kind.excess(float(level[0] / level[1]))
        excess = max(found, _LEAST)
        # The ratio of the squares has the relative scatter √(2/m₁ + 2/m₂).
        scatter = kind.excess(1.0 + float(level[0] / level[1] * np.sqrt(2.0 * np.sum(1.0 / m))))
        quieter = in_time(view.residual / np.sqrt(view.variance() * (1.0 + excess * kind.share)))
        after = view.with_samples(view.recoloured(np.where(inside, quieter, view.whitened)))
        return Candidate(
            self.name,
            [
                view.time_estimate("start", a, spreads[0]),
                view.time_estimate("end", b, spreads[1]),
                _ratio(view, found, scatter),
            ],
            gain,
            _p_value(float(score.max()), kinds),
            after,
            lambda: _held_out(kind),
            (a / view.rate, b / view.rate),
            details={"noise": kind.name},
            doubt=_doubt(kind),
        )


def _doubt(kind: _Kind) -> str:
    """Why a change of the level is hardly one from one value to another: it varies in another way."""
    sums = np.add.reduceat(kind.squares, kind.edges[:-1].astype(int))
    size, t = np.diff(kind.edges), (np.arange(len(sums)) + 0.5) / len(sums)
    angle = np.pi * np.arange(1, len(sums) // 2 + 1)[:, None] * t
    # A trend, and waves of ½, 1, 1½ … periods of any phase.
    trend = np.stack([t - 0.5, np.zeros(len(t))])
    courses = np.concatenate([trend[None], np.stack([np.cos(angle), np.sin(angle)], axis=1)])
    best = _course_gain(courses - courses.mean(axis=2, keepdims=True), sums, size)
    own = interval_gains(kind.squares, kind.edges).max()
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


def _p_value(score: float, kinds: Sequence[_Kind]) -> float:
    """p-value of the largest score of all kinds.

    Sums of the squares after the two filters, 1 and √share, are correlated by √worth.
    """
    u = float(np.sqrt(2.0 * score))
    p = extrapolated(_null(len(kinds[0].edges) - 1), u)
    if len(kinds) == 1:
        return p
    r = float(np.sqrt(kinds[1].worth))
    both = multivariate_normal([0.0, 0.0], [[1.0, r], [r, 1.0]])
    # With two kinds, the largest of many exceeds u more often by the same factor as a single normal variate.
    below = both.cdf([u, u], lower_limit=[-u, -u])
    times = min((1.0 - below) / (2.0 * norm.sf(u)), 2.0) if u < _NORMAL else 2.0
    return any_of(p, times)


def _intervals(edges: int) -> Bool[np.ndarray, "k k"]:
    """Whether two edges are in order, so that they form an interval."""
    return np.triu(np.ones((edges, edges), bool), 1)


def _lasting(edges: int) -> Bool[np.ndarray, "k k"]:
    """Whether the interval between two edges lasts to an end of the record."""
    lasting = _intervals(edges)
    lasting[1:, :-1] = False
    return lasting


@functools.lru_cache(maxsize=4)
def _log_trials_factor(edges: int) -> Float[np.ndarray, "k k"]:
    """Log trials factor of each interval [nats], larger within the record, where there are more of them."""
    lasting = _lasting(edges)
    others = _intervals(edges) & ~lasting
    return np.where(others, np.log(others.sum() / lasting.sum() * _LASTING / (1.0 - _LASTING)), 0.0)


def interval_gains(
    squares: Float[np.ndarray, " n"], edges: Float[np.ndarray, " k"]
) -> Float[np.ndarray, "k k"]:
    """Gain in log-likelihood from another variance between any two edges [nats]."""
    return _gains(np.concatenate([[0.0], np.cumsum(squares)])[edges.astype(int)], edges)


def _gains(total: Float[np.ndarray, " k"], edges: Float[np.ndarray, " k"]) -> Float[np.ndarray, "k k"]:
    """Gain in log-likelihood of each interval, given the sums of squares up to the edges [nats]."""
    count = edges[None, :] - edges[:, None]
    shortest, n = _SHORTEST * edges[-1], edges[-1]
    i, j = np.nonzero((count > shortest) & (n - count > shortest))
    count, inner = count[i, j], total[j] - total[i]
    rest, outer = n - count, total[-1] - inner
    with np.errstate(divide="ignore", invalid="ignore"):
        each = n * np.log(total[-1] / n) - count * np.log(inner / count) - rest * np.log(outer / rest)
    gains = np.zeros((len(edges), len(edges)))
    gains[i, j] = np.where(np.isfinite(each), 0.5 * each, 0.0)
    return gains


def _located(squares: Float[np.ndarray, " n"], a: float, b: float, length: float) -> tuple[int, int]:
    """Interval with its ends relocated by up to one block."""
    n = len(squares)
    near = [
        np.unique(np.rint(np.linspace(max(e - length, 0), min(e + length, n), 2 * _FINER + 1)))
        if 0 < e < n
        else np.array([e])
        for e in (a, b)
    ]
    edges = np.unique(np.concatenate([[0.0], *near, [float(n)]]))
    gains = interval_gains(squares, edges)
    rows, columns = np.isin(edges, near[0]), np.isin(edges, near[1])
    gains = np.where(rows[:, None] & columns[None, :], gains, -np.inf)
    i, j = np.unravel_index(int(np.argmax(gains)), gains.shape)
    return int(edges[i]), int(edges[j])


def _spreads(kind: _Kind, gains: Float[np.ndarray, "k k"], a: int, b: int) -> tuple[float, float]:
    """Standard deviation of each end of the interval, given the other [samples]."""
    inside = np.zeros(len(kind.squares), bool)
    inside[a:b] = True
    step = kind.squares[inside].mean() / kind.squares[~inside].mean()
    # Within the number of samples in which a change of this size becomes visible.
    block = kind.edges[1] / np.sqrt(12.0)
    fine = min(4.0 / max((step - 1.0 - np.log(step)) * kind.worth, 1e-6), block)
    i, j = (int(np.argmin(abs(kind.edges - x))) for x in (a, b))
    found = []
    for along, x in ((gains[:, j], a), (gains[i], b)):
        weight = np.exp(along - along.max())
        found.append(float(np.hypot(fine, np.sqrt(weight @ (kind.edges - x) ** 2 / weight.sum()))))
    return found[0], found[1]


@functools.lru_cache(maxsize=4)
def _null(blocks: int) -> Float[np.ndarray, " draws"]:
    """Draws of the root of twice the largest score, without a change, for blocks of many samples."""
    rng = np.random.default_rng(0)
    many = 400
    edges = np.arange(blocks + 1.0) * many
    found = []
    for _ in range(_DRAWS):
        total = np.concatenate([[0.0], np.cumsum(rng.chisquare(many, blocks))])
        found.append(np.sqrt(2.0 * np.max(_gains(total, edges) - _log_trials_factor(len(edges)))))
    return np.array(found)


def _held_out(kind: _Kind) -> float:
    """Gain in log-likelihood [nats] on parts of the samples with the interval from the other parts."""
    edges, place = kind.edges.astype(int), np.arange(len(kind.squares))
    # Sums and numbers of the squares in each block and part.
    owner = np.argmax(folds(len(place), _FOLD_BLOCK), axis=0)
    cell = np.repeat(np.arange(len(edges) - 1), np.diff(edges)) * PARTS + owner
    shape = len(edges) - 1, PARTS
    sums = np.bincount(cell, kind.squares, minlength=shape[0] * PARTS).reshape(shape)
    counts = np.bincount(cell, minlength=shape[0] * PARTS).reshape(shape)
    gain = 0.0
    for part in range(PARTS):
        others = np.arange(PARTS) != part
        total, count = (np.append(0.0, np.cumsum(x[:, others].sum(axis=1))) for x in (sums, counts))
        gains = kind.worth * _gains(total, count) - _log_trials_factor(len(edges))
        i, j = np.unravel_index(int(np.argmax(gains)), gains.shape)
        inside = (np.arange(shape[0]) >= i) & (np.arange(shape[0]) < j)
        whole = total[-1] / count[-1]
        for stretch in (inside, ~inside):
            level = sums[stretch][:, others].sum() / counts[stretch][:, others].sum()
            rest, size = sums[stretch, part].sum(), counts[stretch, part].sum()
            gain += 0.5 * float(rest / whole - rest / level + size * np.log(whole / level))
    return kind.worth * gain
