"""Disturbances: the unit was bumped or handled, and moved for a while."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.fft import dct
from scipy.special import gammaincc

from allanjax.critic.bank import folds
from allanjax.critic.effect import Effect
from allanjax.critic.gap_filling import impute_gaussian
from allanjax.critic.policy import judged
from allanjax.critic.view import Candidate, View
from allanjax.record.completion import in_time

_SHORTEST, _LONGEST, _SMOOTH, _LOUD, _QUIET = (
    judged("disturbance", name) for name in ("shortest", "longest", "smooth", "loud", "quiet")
)
# Smallest gain of a window that is examined more closely [nats].
_WORTH = 12.0
# Bands of the spectrum, each twice as wide as the one below.
_BANDS = 6
# Blocks in which a fading beginning or end is sought; share of a disturbance hidden by noise at each.
_FADING, _UNSEEN = 10, 0.1
# Neighbouring samples that are held out together.
_FOLD_BLOCK = 16


class Disturbance(Effect):
    """A time span whose residuals are correlated and much larger than the noise."""

    name = "disturbance"

    def detect(self, view: View) -> Candidate | None:
        block = max(int(np.rint(_SHORTEST * view.rate)), 4)
        quiet = view
        # The first noise was estimated with the motion in it and contains part of it: repeated without.
        for _ in range(2):
            e = in_time(view.coefficients / np.sqrt(view.variance(quiet.noise)))
            e /= 1.4826 * float(np.median(abs(e)))
            # Imputed samples are not part of a disturbance.
            squares = np.where(view.imputed, 1.0, e**2)
            loudest = _loudest(squares, block)
            if loudest is None:
                return None
            start, end = _grown(squares, loudest[0], loudest[1], block)
            start, end = _faded(e, start, end, block)
            excess = _bands(e[start:end])
            power = excess[:, 0] * (excess[:, 1] - 1.0)
            if np.sum(power[:-2]) < _SMOOTH * np.sum(power) or np.max(excess[:, 1]) < _LOUD:
                return None
            missing = np.zeros(view.n, bool)
            missing[max(start - block, 0) : end + block] = True
            quiet = impute_gaussian(view, missing)
        assert loudest is not None
        windows = loudest[2]
        m, level = end - start, float(np.mean(squares[start:end]))
        coloured = 0.5 * float(np.sum(excess[:, 0] * (excess[:, 1] - 1.0 - np.log(excess[:, 1]))))
        white = 0.5 * m * (level - 1.0 - np.log(level))
        price = 2.0 * np.log(len(squares) / block) + 2.5 * len(excess)
        gain = coloured - price
        if coloured - 2.5 * len(excess) < white:
            return None
        p_value = float(min(windows * gammaincc(m / 2.0, m * level / 2.0), 1.0))
        # It begins and ends below the noise, so a share of it is hidden.
        std = float(np.hypot(_FADING * block / np.sqrt(12.0), _UNSEEN * m))
        peak = float(np.max(abs(view.samples[start:end] - np.median(view.samples))))
        return Candidate(
            self.name,
            [
                view.time_estimate("start", start, std),
                view.time_estimate("end", end, std),
                view.amplitude_estimate("peak", peak, view.loo_residuals[1]),
            ],
            gain,
            p_value,
            quiet,
            lambda: _held_out(squares, start, end),
            (start / view.rate, end / view.rate),
        )


def _loudest(squares: Float[np.ndarray, " n"], block: int) -> tuple[int, int, float] | None:
    """Window most likely to be louder, and the number of windows searched."""
    total = np.concatenate([[0.0], np.cumsum(squares)])
    best, windows, width = (0.0, 0, 0), 0.0, block
    while width <= _LONGEST * len(squares):
        first = np.arange(0, len(squares) - width + 1, max(width // 4, 1))
        level = (total[first + width] - total[first]) / width
        gain = np.where(level > 1.0, 0.5 * width * (level - 1.0 - np.log(np.maximum(level, 1e-12))), 0.0)
        k = int(np.argmax(gain))
        if gain[k] > best[0]:
            best = (float(gain[k]), int(first[k]), int(first[k] + width))
        windows += len(first)
        width *= 2
    return None if best[0] < _WORTH else (best[1], best[2], windows)


def _grown(squares: Float[np.ndarray, " n"], start: int, end: int, block: int) -> tuple[int, int]:
    """Window with its ends moved outwards while it is loud there, and inwards while it is not."""
    limit = 1.0 + _QUIET * np.sqrt(2.0 / block)

    def loud(at: int) -> bool:
        return at >= 0 and at + block <= len(squares) and float(np.mean(squares[at : at + block])) > limit

    while loud(start - block):
        start -= block
    while loud(end):
        end += block
    while end - start > 2 * block and not loud(start):
        start += block
    while end - start > 2 * block and not loud(end - block):
        end -= block
    return start, end


def _faded(e: Float[np.ndarray, " n"], start: int, end: int, block: int) -> tuple[int, int]:
    """Stretch extended as far as it is loud at low frequencies, since motion is slow and fades out."""
    count = len(e) // block
    means = e[: count * block].reshape(count, block).mean(axis=1) * np.sqrt(block)
    first, last = _grown(means**2, start // block, -(-end // block), _FADING)
    return min(first * block, start), max(min(last * block, len(e)), end)


def _bands(e: Float[np.ndarray, " m"]) -> Float[np.ndarray, "bands 2"]:
    """Number of coefficients and mean square in bands, each twice as wide as the one below."""
    c = dct(e, norm="ortho")
    edges = np.unique(np.rint(len(e) / 2.0 ** np.arange(_BANDS, -1, -1))).astype(int)
    edges = np.unique(np.append(0, edges[edges > 0]))
    size = np.diff(edges)
    return np.column_stack([size, np.maximum(np.add.reduceat(c**2, edges[:-1]) / size, 1e-12)])


def _held_out(squares: Float[np.ndarray, " n"], start: int, end: int) -> float:
    """Gain in log-likelihood [nats] on parts of the stretch with the level from the other parts."""
    gain, inside = 0.0, squares[start:end]
    for part in folds(len(inside), max(min(_FOLD_BLOCK, len(inside) // 16), 1)):
        level, rest = inside[~part].mean(), inside[part]
        gain += 0.5 * float(np.sum(rest - rest / level) - len(rest) * np.log(level))
    return gain
