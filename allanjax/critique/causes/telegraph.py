"""The bias jumps to and fro between two levels."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from allanjax import terms
from allanjax.critique.bank import Bank, folds
from allanjax.critique.causes.additive import additive
from allanjax.critique.noise import centred
from allanjax.critique.view import Candidate, Cause, Quantity, View, in_time

_BLOCKS = 2048
_LEAST_JUMPS = 3
_SWEEPS = 6


class Telegraph(Cause):
    """Two levels, the path between them found by dynamic programming."""

    name = "telegraph"

    def detect(self, view: View) -> Candidate | None:
        blocks = min(_BLOCKS, view.n // 8)
        length = view.n // blocks
        means = view.x[: blocks * length].reshape(blocks, length).mean(axis=1)
        found = two_levels(means)
        if found is None:
            return None
        path, amplitude, sigma = found
        jumps = int(np.sum(np.diff(path) != 0.0))
        whole = np.concatenate([np.repeat(path, length), np.full(view.n - blocks * length, path[-1])])
        dwell = view.duration / (jumps + 1.0)
        # Each jump might have been anywhere within a dwell time; the data leave it some blocks.
        left = max(1.0, 4.0 * (sigma / amplitude) ** 2)
        price = jumps * np.log(max(blocks / (jumps + 1.0) / left, 1.0)) + np.log(blocks)

        def parameters(k: int, a: float, std: float, likelihood: np.ndarray) -> Mapping[str, Quantity]:
            return {
                "amplitude": view.own(abs(a), std),
                "dwell_time": Quantity(dwell, dwell / np.sqrt(jumps + 1.0), "s"),
                "jumps": Quantity(float(jumps), 0.0, "1"),
            }

        shape = Bank(centred(whole)[None, : 4 * _BLOCKS])
        candidate = additive(
            view,
            self.name,
            shape,
            lambda k: whole,
            parameters,
            lambda k: (0.0, view.duration),
            float(price),
            lambda k, a: terms.Telegraph(abs(a), dwell),
        )
        if candidate is None:
            return None
        p_value = float(np.exp(-max(candidate.gain, 0.0)))
        held_out = lambda: _held_out(view, candidate.after, means)  # noqa: E731
        return Candidate(**{**vars(candidate), "p_value": p_value, "held_out": held_out})


def two_levels(
    means: Float[np.ndarray, " blocks"], known: np.ndarray | None = None
) -> tuple[Float[np.ndarray, " blocks"], float, float] | None:
    """The path between two levels, 0 and 1, that fits best, their difference, and the blocks' noise.

    Blocks that are not `known` are bridged. None if there are too few jumps.
    """
    weight = np.ones(len(means)) if known is None else known.astype(float)
    y = means[weight > 0.0]
    sigma = 1.4826 * float(np.median(abs(np.diff(y)))) / np.sqrt(2.0)
    if sigma == 0.0:
        return None
    price = 3.0 * np.log(len(y))
    # Levels to start from: those of the record smoothed more and more.
    best: tuple[float, np.ndarray, np.ndarray] | None = None
    for width in (8, 32, 128):
        smooth = np.convolve(y - y.mean(), np.ones(width) / width, "same") + y.mean()
        levels = np.quantile(smooth, [0.2, 0.8])
        for _ in range(_SWEEPS):
            state = _path((means[:, None] - levels) ** 2 / sigma**2 * weight[:, None], price)
            members = [means[(state == s) & (weight > 0.0)] for s in (0, 1)]
            if min(len(m) for m in members) == 0:
                break
            levels = np.array([m.mean() for m in members])
        else:
            cost = float(np.sum(weight * (means - levels[state]) ** 2) / sigma**2)
            cost += price * np.sum(np.diff(state) != 0)
            if best is None or cost < best[0]:
                best = cost, state, levels
    if best is None or np.sum(np.diff(best[1]) != 0) < _LEAST_JUMPS:
        return None
    return best[1].astype(float), float(abs(best[2][1] - best[2][0])), sigma


def _path(cost: Float[np.ndarray, "blocks 2"], price: float) -> np.ndarray:
    """The cheapest sequence of two states (Viterbi)."""
    came = np.zeros((len(cost), 2), int)
    a, b = cost[0]
    for k in range(1, len(cost)):
        came[k] = a > b + price, not b > a + price
        a, b = min(a, b + price) + cost[k, 0], min(b, a + price) + cost[k, 1]
    state = np.empty(len(cost), int)
    state[-1] = int(b < a)
    for k in range(len(cost) - 1, 0, -1):
        state[k - 1] = came[k, state[k]]
    return state


def _held_out(view: View, after: View, means: Float[np.ndarray, " blocks"]) -> float:
    """Gain on some blocks by the path that the others show."""
    gain, length = 0.0, view.n // len(means)
    c = centred(means)
    root = np.sqrt(after.variance()[: len(c)] / length)
    for rest in folds(len(means), 2):
        fold = ~rest
        found = two_levels(means, fold)
        if found is None:
            continue
        h, e = (in_time(z / root) for z in (centred(found[0]), c))
        a = float(h[fold] @ e[fold] / (h[fold] @ h[fold]))
        gain += a * float(h[rest] @ e[rest]) - 0.5 * a**2 * float(h[rest] @ h[rest])
    return gain
