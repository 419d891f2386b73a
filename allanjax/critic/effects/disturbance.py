"""Disturbances: the unit was bumped or handled, and moved for a while."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.fft import dct
from scipy.special import gammaincc

from allanjax.base.normal import bulk_std
from allanjax.critic.bank import folds
from allanjax.critic.effect import Candidate, Effect, View
from allanjax.critic.imputation import impute_gaussian
from allanjax.critic.policy import judged
from allanjax.record.completion import in_time

_SHORTEST, _LONGEST, _SMOOTH, _LOUD, _QUIET = (
    judged("disturbance", name) for name in ("shortest", "longest", "smooth", "loud", "quiet")
)
# Smallest gain of a window that is examined more closely [nats].
_WORTH = 12.0
# Bands of the spectrum, each twice as wide as the one below; log Occam factor of the level of each [nats].
_BANDS, _PER_BAND = 6, 2.5
# Blocks in which a fading beginning or end is sought; share of a disturbance hidden by noise at each.
_FADING, _UNSEEN = 10, 0.1


class _Stretch(NamedTuple):
    """First sample of a stretch and that after it, and the number of stretches searched."""

    start: int
    end: int
    windows: float


class Disturbance(Effect):
    """A time span whose residuals are correlated and much larger than the noise."""

    name = "disturbance"
    is_event = True

    def detect(self, view: View) -> Candidate | None:
        block = max(int(np.rint(_SHORTEST * view.rate)), 4)
        ends = ((round(place.start * view.rate), round(place.end * view.rate)) for place in self.places)
        known = [_Stretch(start, end, 1.0) for start, end in ends]
        found = [self._within(view, block, stretch) for stretch in known or (None,)]
        return max((c for c in found if c is not None), key=lambda c: c.gain, default=None)

    def _within(self, view: View, block: int, known: _Stretch | None) -> Candidate | None:
        """Disturbance in a known stretch, or in the one that is most likely louder."""
        quiet = view
        # The first noise was estimated with the motion in it and contains part of it: repeated without.
        for _ in range(2):
            v = view.variance(quiet.noise)
            e = view.whitened if quiet is view else in_time(view.residual / np.sqrt(v))
            e = e / bulk_std(e)
            # Imputed samples are not part of a disturbance.
            squares = np.where(view.imputed, 1.0, e**2)
            if (stretch := known or _searched(e, squares, block)) is None:
                return None
            start, end, windows = stretch
            excess = _bands(e[start:end])
            power = excess[:, 0] * (excess[:, 1] - 1.0)
            if np.sum(power[:-2]) < _SMOOTH * np.sum(power) or np.max(excess[:, 1]) < _LOUD:
                return None
            missing = np.zeros(view.n, bool)
            missing[max(start - block, 0) : end + block] = True
            quiet = impute_gaussian(view, missing)
        m, level = end - start, float(np.mean(squares[start:end]))
        tested = np.array([m, level])
        if known:
            # That it is slow is known, too.
            excess = np.stack([_merged(excess[:-2]), _merged(excess[-2:])])
            tested = excess[0]
        coloured = 0.5 * float(np.sum(excess[:, 0] * (excess[:, 1] - 1.0 - np.log(excess[:, 1]))))
        white = 0.5 * m * (level - 1.0 - np.log(level)) if level > 1.0 else 0.0
        levels = _PER_BAND * len(excess)
        if coloured - levels < white:
            return None
        # At a known place it has not been searched for.
        gain = coloured - levels - (0.0 if known else 2.0 * np.log(len(squares) / block))
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
            float(min(windows * gammaincc(tested[0] / 2.0, tested.prod() / 2.0), 1.0)),
            quiet,
            lambda: _held_out(e[start:end], excess),
            (start / view.rate, end / view.rate),
            bound=float(np.exp(-max(gain, 0.0))),
            is_shared=bool(known),
        )


def _searched(e: Float[np.ndarray, " n"], squares: Float[np.ndarray, " n"], block: int) -> _Stretch | None:
    """Stretch that is most likely louder, with its ends where it fades into the noise."""
    loudest = _loudest(squares, block)
    if loudest is None:
        return None
    start, end = _grown(squares, loudest.start, loudest.end, block)
    # As far as it is loud at low frequencies, since motion is slow and fades out.
    count = len(e) // block
    means = e[: count * block].reshape(count, block).mean(axis=1) * np.sqrt(block)
    first, last = _grown(means**2, start // block, -(-end // block), _FADING)
    return _Stretch(min(first * block, start), max(min(last * block, len(e)), end), loudest.windows)


def _loudest(squares: Float[np.ndarray, " n"], block: int) -> _Stretch | None:
    """Window most likely to be louder."""
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
    return None if best[0] < _WORTH else _Stretch(best[1], best[2], windows)


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


def _bands(e: Float[np.ndarray, " m"]) -> Float[np.ndarray, "bands 2"]:
    """Number of coefficients and mean square in bands, each twice as wide as the one below."""
    c = dct(e, norm="ortho")
    edges = np.unique(np.rint(len(e) / 2.0 ** np.arange(_BANDS, -1, -1))).astype(int)
    edges = np.unique(np.append(0, edges[edges > 0]))
    size = np.diff(edges)
    return np.column_stack([size, np.maximum(np.add.reduceat(c**2, edges[:-1]) / size, 1e-12)])


def _merged(bands: Float[np.ndarray, "bands 2"]) -> Float[np.ndarray, " 2"]:
    """Number of coefficients and mean square of several bands together."""
    size = bands[:, 0].sum()
    return np.array([size, bands[:, 0] @ bands[:, 1] / size])


def _held_out(e: Float[np.ndarray, " m"], bands: Float[np.ndarray, "bands 2"]) -> float:
    """Gain in log-likelihood [nats] on parts of the coefficients with the levels of bands from the others."""
    squares = dct(e, norm="ortho") ** 2
    band = np.repeat(np.arange(len(bands)), bands[:, 0].astype(int))
    gain = 0.0
    for part in folds(len(e), 1):
        others = ~part
        # A band of few coefficients has the level of noise if no others are left.
        sums, count = (np.bincount(band[others], x, len(bands)) for x in (squares[others], None))
        level = ((sums + 1.0) / (count + 1.0))[band[part]]
        gain += 0.5 * float(np.sum(squares[part] * (1.0 - 1.0 / level) - np.log(level)))
    return gain
