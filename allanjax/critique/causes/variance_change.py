"""The noise is louder, or quieter, for a while."""

from __future__ import annotations

import functools

import numpy as np
from jaxtyping import Float

from allanjax.critique.bank import extrapolated, folds
from allanjax.critique.view import Candidate, Cause, Quantity, View

_BLOCKS = 256
# Share of the record that an interval has at least: what is shorter is an event.
_SHORTEST = 0.01
_DRAWS = 1000
_WORTH = 6.0
_FINER = 32
_FOLD_BLOCK = 16


class VarianceChange(Cause):
    """One interval whose whitened residuals have another variance."""

    name = "variance_change"

    def p_value(self, view: View) -> float:
        squares, edges = _blocks(view)
        return scan_p_value(float(interval_gains(squares, edges).max()), len(edges) - 1)

    def detect(self, view: View) -> Candidate | None:
        squares, edges = _blocks(view)
        blocks = len(edges) - 1
        length = view.n / blocks
        gains = interval_gains(squares, edges)
        i, j = np.unravel_index(int(np.argmax(gains)), gains.shape)
        if gains[i, j] < _WORTH:
            return None
        flat = gains[np.triu_indices(blocks + 1, 1)]
        search = float(flat.max() - np.logaddexp.reduce(flat) + np.log(len(flat)))
        a, b = _located(squares, edges[i], edges[j], length)
        inside = (np.arange(view.n) >= a) & (np.arange(view.n) < b)
        louder = squares[inside].mean() > squares[~inside].mean()
        # A record that begins or ends with another level: the louder part is what changed.
        if not louder and (a == 0 or b == view.n):
            a, b = (b, view.n) if a == 0 else (0, a)
            inside = ~inside
        m = np.array([inside.sum(), (~inside).sum()], float)
        level = np.array([squares[inside].mean(), squares[~inside].mean()])
        ratio = float(np.sqrt(level[0] / level[1]))
        std = ratio * float(np.sqrt(0.5 * np.sum(1.0 / m)))
        after = view.with_x(view.recoloured(np.where(inside, view.e / ratio, view.e)))
        gain = float(gains[i, j]) - search - 3.0
        # Where the level changes is known to within what a step of this size stands out in.
        edge = 4.0 / max((level[0] / level[1] - 1.0 - np.log(level[0] / level[1])), 1e-6)
        edge_std = float(min(edge, view.n / 4.0)) / view.rate
        return Candidate(
            self.name,
            {
                "start": Quantity(a / view.rate, edge_std if a > 0 else 0.0, "s"),
                "end": Quantity(b / view.rate, edge_std if b < view.n else 0.0, "s"),
                "ratio": Quantity(ratio, std, "1"),
            },
            gain,
            scan_p_value(float(gains[i, j]), blocks),
            after,
            lambda: _held_out(squares, edges),
            (a / view.rate, b / view.rate),
            "time",
        )


def _blocks(view: View) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " k"]]:
    """Squared residuals, and the edges of the blocks that intervals are made of."""
    blocks = min(_BLOCKS, view.n // 16)
    squares = np.where(view.restored, np.mean(view.e**2), view.e**2)
    return squares, np.rint(np.arange(blocks + 1) * view.n / blocks)


def interval_gains(
    squares: Float[np.ndarray, " n"], edges: Float[np.ndarray, " k"]
) -> Float[np.ndarray, "k k"]:
    """Log-likelihood gained by another variance between any two edges."""
    return _gains(np.concatenate([[0.0], np.cumsum(squares)])[edges.astype(int)], edges)


def _gains(total: Float[np.ndarray, " k"], edges: Float[np.ndarray, " k"]) -> Float[np.ndarray, "k k"]:
    """The same from the sum of squares up to each edge."""
    inner, count = total[None, :] - total[:, None], edges[None, :] - edges[:, None]
    outer, rest = total[-1] - inner, edges[-1] - count
    shortest = _SHORTEST * edges[-1]
    valid = (count > shortest) & (rest > shortest)
    with np.errstate(divide="ignore", invalid="ignore"):
        gains = 0.5 * (
            edges[-1] * np.log(total[-1] / edges[-1])
            - count * np.log(inner / count)
            - rest * np.log(outer / rest)
        )
    return np.where(valid & np.isfinite(gains), gains, 0.0)


def _located(squares: Float[np.ndarray, " n"], a: float, b: float, length: float) -> tuple[int, int]:
    """The interval, its ends moved about within a block of where they were found."""
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


@functools.lru_cache(maxsize=4)
def _null(blocks: int) -> Float[np.ndarray, " draws"]:
    """Largest root of twice the gain in draws of blocks of many samples, which are normal."""
    rng = np.random.default_rng(0)
    many = 400
    edges = np.arange(blocks + 1.0) * many
    found = []
    for _ in range(_DRAWS):
        total = np.concatenate([[0.0], np.cumsum(rng.chisquare(many, blocks))])
        found.append(np.sqrt(2.0 * np.max(_gains(total, edges))))
    return np.array(found)


def scan_p_value(gain: float, blocks: int) -> float:
    """Probability that equal noise has so large a gain in some interval."""
    return extrapolated(_null(blocks), float(np.sqrt(2.0 * gain)))


def _held_out(squares: Float[np.ndarray, " n"], edges: Float[np.ndarray, " k"]) -> float:
    """Gain on parts of the samples by the interval and the levels that the others show."""
    gain, place = 0.0, np.arange(len(squares))
    for part in folds(len(squares), _FOLD_BLOCK):
        fold = ~part
        counted = np.concatenate([[0.0], np.cumsum(fold)])[edges.astype(int)]
        gains = interval_gains(squares[fold], counted)
        i, j = np.unravel_index(int(np.argmax(gains)), gains.shape)
        inside = (place >= edges[i]) & (place < edges[j])
        whole = squares[fold].mean()
        for stretch in (inside, ~inside):
            level = squares[fold & stretch].mean()
            rest = squares[part & stretch]
            gain += 0.5 * float(np.sum(rest / whole - rest / level) + len(rest) * np.log(whole / level))
    return gain
