"""Random telegraph noise: a bias that jumps between two levels."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import chi2

from allanjax.critic.bank import Bank, folds
from allanjax.critic.effect import TIMES, Effect
from allanjax.critic.noise import centred
from allanjax.critic.parameters import Limit
from allanjax.critic.policy import judged
from allanjax.critic.view import Candidate, View
from allanjax.critic.waveform import additive, shape_parameter
from allanjax.noise import terms
from allanjax.noise.estimate import Estimate
from allanjax.record.completion import in_time

# Largest number of blocks over which samples are averaged.
_BLOCKS = 2048
_LEAST_JUMPS = judged("telegraph", "jumps")
# Blocks over which the first levels are smoothed; rounds in which the levels are adjusted.
_SMOOTH, _ROUNDS = (8, 32, 128), 10
# Fewest dwell times whose scatter is judged, draws of it, and the p-value below which they are too regular.
_FEW, _DRAWS, _REGULAR = 6, 2000, judged("telegraph", "regular")
# The noise of blocks is measured between 1/32 and 1/4 of their frequencies.
_WHITE = (32, 4)
# Shortest dwell time [blocks], and number of those compared, logarithmic up to twice the record: three jumps
# are compatible with one as long as the record.
_SHORTEST, _DWELLS = 4.0, 14


class Telegraph(Effect):
    """A bias that jumps between two levels; the likelihood sums over all paths (hidden Markov model)."""

    name = "telegraph"
    sensible: ClassVar = {"dwell_time": TIMES}

    def detect(self, view: View) -> Candidate | None:
        edges = np.rint(np.linspace(0.0, view.n, min(_BLOCKS, view.n // 8) + 1)).astype(int)
        size = np.diff(edges)
        means = np.add.reduceat(view.samples, edges[:-1]) / size
        sigma = _noise(means)
        if sigma == 0.0:
            return None
        found = two_levels(means, sigma)
        path = (found.upper > 0.5).astype(float)
        jumps = int(np.sum(np.diff(path) != 0.0))
        if jumps < _LEAST_JUMPS:
            return None
        whole = np.repeat(path, size)
        dwell = found.dwell * view.duration / len(size)

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
            log_trials=found.log_trials_factor(means, path),
            term=lambda k, a: terms.Telegraph(abs(a), dwell),
        )
        if candidate is None:
            return None
        # A missing basic term is preferred if it explains as much.
        gain = candidate.gain + view.log_evidence - view.log_evidence_all_terms
        bound = float(np.exp(-max(gain, 0.0)))
        held_out = lambda: _held_out(view, candidate.after, means, sigma)  # noqa: E731
        return dataclasses.replace(
            candidate,
            gain=gain,
            p_value=None,
            bound=bound,
            held_out=held_out,
            doubt=_doubt(view, path),
        )


def _doubt(view: View, path: Float[np.ndarray, " blocks"]) -> str:
    """Why a path is hardly a random telegraph's."""
    if Telegraph.name in view.found:
        return "it has more than two levels"
    dwell = np.diff(np.flatnonzero(np.diff(path)))
    if len(dwell) < _FEW:
        return ""
    # Times between jumps at random are exponential.
    drawn = np.random.default_rng(0).exponential(size=(_DRAWS, len(dwell)))
    by_chance = float(np.mean(_scatter(drawn) <= _scatter(dwell)))
    return "its jumps are too regular to be random" if by_chance < _REGULAR else ""


def _scatter(dwell: Float[np.ndarray, "*draws jumps"]) -> Float[np.ndarray, "*draws"]:
    """Relative variance of the times between jumps; those at either level may last differently long."""
    each = (dwell[..., k::2] for k in range(2))
    return np.mean([np.var(own, axis=-1) / np.mean(own, axis=-1) ** 2 for own in each], axis=0)


@dataclasses.dataclass(frozen=True, eq=False)
class TwoStateFit:
    """Two levels fitted to blocks, and the posterior of the path between them.

    Attributes:
        sigma: standard deviation of the blocks' noise.
        upper: probability that a block is at the second level.
        dwell: mean time between jumps [blocks], or a limit of it.
        log_dwell_std: standard deviation of its logarithm.
        log_likelihood: averaged over paths and dwell times, relative to blocks exactly at their level [nats].
    """

    sigma: float
    upper: Float[np.ndarray, " blocks"]
    dwell: float
    log_dwell_std: float
    log_likelihood: float
    limit: Limit

    def log_trials_factor(
        self, means: Float[np.ndarray, " blocks"], path: Float[np.ndarray, " blocks"]
    ) -> float:
        """Log trials factor of the path [nats]: its likelihood at its best levels over that of all paths."""
        upper = path > 0.5
        left = np.where(upper, means - means[upper].mean(), means - means[~upper].mean())
        return -0.5 * float(np.sum((left / self.sigma) ** 2)) - self.log_likelihood


def _noise(means: Float[np.ndarray, " blocks"]) -> float:
    """Standard deviation of blocks from white noise, between telegraph's and quantization's frequencies."""
    first, last = (max(len(means) // part, 1) for part in _WHITE)
    return float(np.sqrt(np.median(centred(means)[first:last] ** 2) / chi2.median(1)))


def two_levels(
    means: Float[np.ndarray, " blocks"], sigma: float, known: Bool[np.ndarray, " blocks"] | None = None
) -> TwoStateFit:
    """Most likely levels of blocks, adjusted iteratively to the probable path (Baum & Welch).

    Blocks that are not `known` are bridged.
    """
    weight = np.ones(len(means)) if known is None else known.astype(float)
    y = means[weight > 0.0]
    dwells = np.geomspace(_SHORTEST, 2.0 * len(means), _DWELLS)

    def likelihoods(values: Float[np.ndarray, "starts 2"]) -> Float[np.ndarray, "starts blocks 2"]:
        return -0.5 * ((means[:, None] - values[:, None, :]) / sigma) ** 2 * weight[:, None]

    smooth = [np.convolve(y - y.mean(), np.ones(width) / width, "valid") + y.mean() for width in _SMOOTH]
    values = np.stack([np.quantile(x, [0.2, 0.8]) for x in smooth])
    for _ in range(_ROUNDS):
        total, upper = _chain(likelihoods(values), dwells[_DWELLS // 2 :][:1])
        share = np.stack([1.0 - upper, upper], axis=1) * weight
        values = share @ means / np.maximum(share.sum(axis=-1), 1e-9)
    total, upper = _chain(likelihoods(values[[int(np.argmax(total))]]), dwells)
    probable = np.exp(total - np.logaddexp.reduce(total))
    log, spread, limit = shape_parameter(np.log(dwells), probable)
    log_likelihood = float(np.logaddexp.reduce(total) - np.log(_DWELLS))
    return TwoStateFit(sigma, probable @ upper, float(np.exp(log)), spread, log_likelihood, limit)


def _chain(
    log_likelihood: Float[np.ndarray, "#chains blocks 2"], dwells: Float[np.ndarray, "#chains"]
) -> tuple[Float[np.ndarray, " chains"], Float[np.ndarray, "chains blocks"]]:
    """Forward-backward pass of two-state Markov chains with these mean dwell times [blocks].

    `log_likelihood` and `dwells` broadcast against each other.

    Returns:
        The log-likelihood over all paths, and the probability of the second state in each block.
    """
    largest = log_likelihood.max(axis=-1)
    jump = -0.5 * np.expm1(-2.0 / dwells)[:, None]
    step = np.stack([1.0 - jump, jump, jump, 1.0 - jump]).reshape(2, 2, -1, 1)
    links = step * np.moveaxis(np.exp(log_likelihood - largest[..., None]), -1, 0)
    forward, scale = _products(links)
    # Backwards, a link's likelihood is on the other side of its transition.
    backward, _ = _products(np.swapaxes(links, 0, 1)[..., ::-1])
    ahead = 0.5 * forward.sum(axis=0)
    behind = np.ones_like(ahead)
    behind[..., :-1] = backward[..., ::-1].sum(axis=0)[..., 1:]
    both = ahead * behind
    total = np.log(ahead[..., -1].sum(axis=0)) + scale[:, -1] + largest.sum(axis=-1)
    return total, both[1] / both.sum(axis=0)


def _products(
    links: Float[np.ndarray, "2 2 chains blocks"],
) -> tuple[Float[np.ndarray, "2 2 chains blocks"], Float[np.ndarray, "chains blocks"]]:
    """Products of the first one, two, … matrices by doubling, scaled, and the logarithms of the scales."""
    found = links.copy()
    scale = np.zeros(links.shape[2:])
    reach = 1
    while reach < links.shape[-1]:
        # Written out: NumPy multiplies stacks of small matrices one by one.
        one, other = found[..., :-reach], found[..., reach:]
        found[..., reach:] = one[:, :1] * other[:1] + one[:, 1:] * other[1:]
        scale[:, reach:] = scale[:, :-reach] + scale[:, reach:]
        size = found.max(axis=(0, 1))
        found /= size
        scale += np.log(size)
        reach *= 2
    return found, scale


def _held_out(view: View, after: View, means: Float[np.ndarray, " blocks"], sigma: float) -> float:
    """Gain in log-likelihood [nats] on some blocks with the path from the others."""
    kept, c = 0.0, centred(means)
    root = np.sqrt(after.variance()[: len(c)] * len(means) / view.n)

    def path(known: Bool[np.ndarray, " blocks"] | None) -> Float[np.ndarray, " blocks"]:
        return in_time(centred(two_levels(means, sigma, known).upper) / root)

    e = in_time(c / root)
    for rest in folds(len(means), 2):
        fold = ~rest
        h = path(fold)
        a = float(h[fold] @ e[fold] / (h[fold] @ h[fold]))
        kept += a * float(h[rest] @ e[rest]) - 0.5 * a**2 * float(h[rest] @ h[rest])
    h = path(None)
    return view.held_out_gain(after, 0.5 * float(h @ e) ** 2 / float(h @ h), kept)
