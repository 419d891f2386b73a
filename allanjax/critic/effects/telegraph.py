"""Random telegraph noise: a bias that jumps between two levels."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from typing import ClassVar, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.signal import lfilter
from scipy.special import expit, logit
from scipy.stats import chi2

from allanjax.critic.bank import Bank, additive, folds, sampled_bank, shape_parameter
from allanjax.critic.effect import TIMES, Candidate, Effect, View
from allanjax.critic.finding import Limit
from allanjax.critic.noise import Noise, centred
from allanjax.critic.policy import judged
from allanjax.noise import terms
from allanjax.noise.estimate import Estimate
from allanjax.record.completion import in_time

# Largest number of blocks over which samples are averaged.
_BLOCKS = 2048
_LEAST_JUMPS, _CLEARLY = judged("telegraph", "jumps"), judged("telegraph", "clearly")
# Blocks over which the first levels are smoothed; rounds in which the levels are adjusted.
_SMOOTH, _ROUNDS = (8, 32, 128), 10
# Fewest dwell times whose scatter is judged, draws of it, and the p-value below which they are too regular.
_FEW, _DRAWS, _REGULAR = 6, 2000, judged("telegraph", "regular")
# The noise of blocks is measured between 1/32 and 1/4 of their frequencies.
_WHITE = (32, 4)
# Shortest dwell time [blocks], and number of those compared, logarithmic up to twice the record: three jumps
# are compatible with one as long as the record.
_SHORTEST, _DWELLS = 4.0, 14
# Log-likelihood ratio of a block from which on only one of the levels is possible.
_SURE = 500.0


class Telegraph(Effect):
    """A bias that jumps between two levels; the likelihood sums over all paths (hidden Markov model)."""

    name = "telegraph"
    sensible: ClassVar = {"dwell_time": TIMES}

    def detect(self, view: View) -> Candidate | None:
        edges = np.rint(np.linspace(0.0, view.n, min(_BLOCKS, view.n // 8) + 1)).astype(int)
        size = np.diff(edges)
        means = np.add.reduceat(view.samples, edges[:-1]) / size
        # The deviation from white noise, between telegraph's and quantization's frequencies.
        first, last = (max(len(means) // part, 1) for part in _WHITE)
        sigma = float(np.sqrt(np.median(centred(means)[first:last] ** 2) / chi2.median(1)))
        if sigma == 0.0:
            return None
        found = _two_levels(means, sigma)
        path = (found.upper > 0.5).astype(float)
        jumps = int(np.count_nonzero(np.diff(path)))
        if jumps < _LEAST_JUMPS:
            return None
        # Trials factor of the path: its likelihood at its best levels over that of all paths.
        left = np.where(path > 0.5, means - means[path > 0.5].mean(), means - means[path < 0.5].mean())
        whole = np.repeat(path, size)
        dwell = float(np.exp(found.log_dwell)) * view.duration / len(size)

        def parameters(k: int, a: float, std: float, likelihood: np.ndarray) -> list[Estimate]:
            return [
                view.amplitude_estimate("amplitude", abs(a), std),
                view.log_estimate("dwell_time", np.log(dwell), found.log_dwell_std, found.limit, "s"),
                view.estimate("jumps", jumps, 0.0, "1"),
            ]

        shape = Bank(centred(whole)[None, : 4 * _BLOCKS])
        candidate = additive(
            view,
            self.name,
            shape,
            lambda k: whole,
            parameters,
            log_trials=-0.5 * float(np.sum((left / sigma) ** 2)) - found.log_likelihood,
            term=lambda k, a: terms.Telegraph(abs(a), dwell),
        )
        if candidate is None:
            return None
        # A missing basic term is preferred if it explains as much.
        gain = candidate.gain + view.log_evidence - view.log_evidence_all_terms
        return dataclasses.replace(
            candidate,
            gain=gain,
            p_value=None,
            bound=float(np.exp(-max(gain, 0.0))),
            held_out=functools.partial(_held_out, view, candidate.after, means, sigma),
            doubt=_doubt(view, candidate.after.noise, path),
        )


def _doubt(view: View, noise: Noise, path: Float[np.ndarray, " blocks"]) -> str:
    """Why a path is hardly a random telegraph's."""
    if Telegraph.name in view.found:
        return "it has more than two levels"
    if _decays(view, noise, path):
        return "its level decays after a jump"
    dwell = np.diff(np.flatnonzero(np.diff(path)))
    if len(dwell) < _FEW:
        return ""
    # Times between jumps at random are exponential.
    drawn = np.random.default_rng(0).exponential(size=(_DRAWS, len(dwell)))
    by_chance = float(np.mean(_scatter(drawn) <= _scatter(dwell)))
    return "its jumps are too regular to be random" if by_chance < _REGULAR else ""


def _decays(view: View, noise: Noise, path: Float[np.ndarray, " blocks"]) -> bool:
    """Whether a level that returns after each jump, or after those up or down, explains more than a path."""
    jumps = np.diff(path, prepend=path[0])
    some = jumps, np.maximum(jumps, 0.0), np.minimum(jumps, 0.0)
    kept = np.exp(-1.0 / np.geomspace(_SHORTEST, len(path) / _SHORTEST, _DWELLS))
    decays = np.stack([lfilter([1.0], [1.0, -k], each) for each in some for k in kept])
    decaying, staying = (sampled_bank(each, view.n).gain(view, noise) for each in (decays, path[None]))
    return decaying - staying > _CLEARLY


def _scatter(dwell: Float[np.ndarray, "*draws jumps"]) -> Float[np.ndarray, "*draws"]:
    """Relative variance of the times between jumps; those at either level may last differently long."""
    each = (dwell[..., k::2] for k in range(2))
    return np.mean([np.var(own, axis=-1) / np.mean(own, axis=-1) ** 2 for own in each], axis=0)


class _TwoLevels(NamedTuple):
    """Two levels fitted to blocks, and the posterior of the path between them.

    `upper` is the probability that a block is at the second level. The mean time between jumps [blocks] is
    known by its logarithm and the standard deviation of that, or by a limit. The log-likelihood is averaged
    over paths and dwell times, relative to blocks exactly at their level [nats].
    """

    upper: Float[np.ndarray, " blocks"]
    log_dwell: float
    log_dwell_std: float
    limit: Limit
    log_likelihood: float


def _two_levels(
    means: Float[np.ndarray, " blocks"], sigma: float, known: Bool[np.ndarray, " blocks"] | None = None
) -> _TwoLevels:
    """Most likely levels, by the probable path (Baum & Welch); blocks that are not `known` are bridged."""
    weight = np.ones(len(means)) if known is None else known.astype(float)
    y = means[weight > 0.0]
    dwells = np.geomspace(_SHORTEST, 2.0 * len(means), _DWELLS)

    def path(levels: Float[np.ndarray, " 2"], dwell: float) -> tuple[float, Float[np.ndarray, " blocks"]]:
        lower, upper = -0.5 * ((means - levels[:, None]) / sigma) ** 2 * weight
        total, probability = _path(upper - lower, dwell)
        return total + float(lower.sum()), probability

    fits = []
    for width in _SMOOTH:
        levels = np.quantile(np.convolve(y, np.full(width, 1.0 / width), "valid"), [0.2, 0.8])
        for _ in range(_ROUNDS):
            total, upper = path(levels, dwells[_DWELLS // 2])
            share = np.stack([1.0 - upper, upper]) * weight
            levels = share @ means / np.maximum(share.sum(axis=1), 1e-9)
        fits.append((total, levels))
    _, levels = max(fits, key=lambda fit: fit[0])
    totals, uppers = map(np.array, zip(*(path(levels, dwell) for dwell in dwells.tolist()), strict=True))
    sum_of_all = np.logaddexp.reduce(totals)
    probable = np.exp(totals - sum_of_all)
    log_dwell = shape_parameter(np.log(dwells), probable)
    return _TwoLevels(probable @ uppers, *log_dwell, float(sum_of_all - np.log(_DWELLS)))


def _path(
    log_ratio: Float[np.ndarray, " blocks"], dwell: float
) -> tuple[float, Float[np.ndarray, " blocks"]]:
    """Log-likelihood over all paths between two levels, and the probability of the second one in each block.

    `log_ratio` is that of the blocks' likelihoods at the two levels; the log-likelihood is relative to that
    of the first level.
    """
    kept, ratio = math.exp(-2.0 / dwell), np.exp(np.clip(log_ratio, -_SURE, _SURE))
    jump = 0.5 - 0.5 * kept

    def following(upper: float, own: float) -> float:
        likely = upper * own
        return jump + kept * likely / (likely + 1.0 - upper)

    def expected(ratios: Float[np.ndarray, " blocks"]) -> Float[np.ndarray, " blocks"]:
        """Probability of the second level in each block, given only those before it."""
        return np.array([*itertools.accumulate(ratios[:-1].tolist(), following, initial=0.5)])

    ahead, behind = expected(ratio), expected(ratio[::-1])[::-1]
    total = float(np.sum(np.logaddexp(np.log1p(-ahead), np.log(ahead) + log_ratio)))
    return total, expit(logit(ahead) + logit(behind) + log_ratio)


def _held_out(view: View, after: View, means: Float[np.ndarray, " blocks"], sigma: float) -> float:
    """Gain in log-likelihood [nats] on some blocks with the path from the others."""
    kept, c = 0.0, centred(means)
    root = np.sqrt(after.variance()[: len(c)] * len(means) / view.n)

    def path(known: Bool[np.ndarray, " blocks"] | None) -> Float[np.ndarray, " blocks"]:
        return in_time(centred(_two_levels(means, sigma, known).upper) / root)

    e = in_time(c / root)
    for rest in folds(len(means), 2):
        fold = ~rest
        h = path(fold)
        a = float(h[fold] @ e[fold] / (h[fold] @ h[fold]))
        kept += a * float(h[rest] @ e[rest]) - 0.5 * a**2 * float(h[rest] @ h[rest])
    h = path(None)
    return view.held_out_gain(after, 0.5 * float(h @ e) ** 2 / float(h @ h), kept)
