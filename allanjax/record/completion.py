"""Completion of records with missing samples, by draws from what their own spectrum says of them.

Missing samples are drawn from their distribution given all samples that are there, for a Gaussian process
with the spectrum of the record itself: with that spectrum, completed records are distributed as if nothing
had been lost, and what is estimated from one has the expectation that it would have had. (Zeros, a line
between the neighbours, or closing the gap leave other spectra: less noise at high frequencies, or steps.)

The spectrum is that of the completed record, so the two are found in turn: data augmentation, M. A. Tanner
and W. H. Wong, J. Am. Stat. Assoc. 82, 528 (1987), with a single draw at the end. The draw is one of all
samples, plus the conditional mean of what it misses the others by: Y. Hoffman and E. Ribak, Astrophys. J.
Lett. 380, L5 (1991).
"""

from __future__ import annotations

from collections.abc import Sequence
from zlib import crc32

import numpy as np
from jaxtyping import Bool, Float
from scipy.fft import dct, idct, rfft

from allanjax.base.errors import RecordingError
from allanjax.base.wording import duration, plain

# Largest share of an axis's samples that is completed.
_MOST_MISSING = 0.3
# Spectrum and samples in turn: what a turn leaves of an error is about the share of missing samples.
_TURNS = 3
# Frequencies that the spectrum is averaged over, on either side: so many, and this share of the frequency.
_FEWEST, _SHARE = 4, 0.03
# Conjugate gradients: most steps, and the part of d'C⁻¹d that does not matter beside that of one draw.
_STEPS, _EXACT = 100, 1e-4


def widening(missing: Bool[np.ndarray, "samples axes"]) -> Float[np.ndarray, " axes"]:
    """Factor of each axis on the standard deviations that a complete record would have.

    With a share f missing, n(1 − f) samples determine a level of noise; the draws, which are made at that
    level, add the scatter of n·f samples: √(1/(1 − f) + f). That is exact for white noise, and an upper bound
    for terms of times longer than the gaps, of which the missing samples hold less.
    """
    share = missing.mean(axis=0)
    return np.sqrt(1.0 / (1.0 - share) + share)


def completed(
    values: Float[np.ndarray, "samples axes"], missing: Bool[np.ndarray, "samples axes"]
) -> Float[np.ndarray, "samples axes"]:
    """Samples in which the missing ones have been drawn given the others; these are as they were.

    The same record is completed in the same way.

    Args:
        values: samples, of any value where they are missing.
        missing: which are; at most 30 % of an axis.

    Raises RecordingError if more are missing.
    """
    full = values.copy()
    n = len(values)
    for k in np.flatnonzero(missing.any(axis=0)):
        lost = np.flatnonzero(missing[:, k])
        if len(lost) > _MOST_MISSING * n:
            raise RecordingError(
                f"{len(lost) / n:.0%} of the samples are missing, and at most {_MOST_MISSING:.0%} are drawn; "
                "take the longest stretch without gaps by gaps='segments' (--gaps segments)"
            )
        x = bridged(full[:, k], missing[:, k])
        # Other samples, other draws.
        rng = np.random.default_rng(crc32(x.tobytes()))
        for _ in range(_TURNS):
            v = _spectrum(x)
            draw = in_time(np.sqrt(v) * rng.standard_normal(n - 1)) + x.mean()
            x[lost] = draw[lost] + predicted(x - draw, missing[:, k], v)[lost]
        full[:, k] = x
    return full


def bridged(x: Float[np.ndarray, " n"], missing: Bool[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Samples with straight lines across gaps; as they are if none or all are missing."""
    if not missing.any() or missing.all():
        return x
    there = np.flatnonzero(~missing)
    return np.interp(np.arange(len(x)), there, x[there])


def told(missing: Bool[np.ndarray, "samples axes"], rate: float, names: Sequence[str]) -> tuple[str, ...]:
    """How much is missing, in gaps of what length, and what was done about it, in notes."""
    groups: dict[bytes, list[int]] = {}
    for k in np.flatnonzero(missing.any(axis=0)):
        groups.setdefault(missing[:, k].tobytes(), []).append(int(k))
    notes = []
    for axes in groups.values():
        lost = missing[:, axes[0]]
        first, end = np.flatnonzero(np.diff(lost, prepend=False, append=False)).reshape(-1, 2).T
        count = f"{len(first)} gaps of at most" if len(first) > 1 else "a gap of"
        wider = 100.0 * (widening(missing)[axes[0]] - 1.0)
        notes.append(
            f"{', '.join(names[k] for k in axes)}: {lost.sum()} of {len(lost)} samples "
            f"({plain(100.0 * lost.mean(), 2)} %) are missing, in {count} "
            f"{duration(float((end - first).max()) / rate)}: drawn given the others, which makes the fit's "
            f"intervals {plain(wider, 2)} % wider"
        )
    return tuple(notes)


def in_time(coefficients: Float[np.ndarray, " n-1"]) -> Float[np.ndarray, " n"]:
    """Samples of zero mean with these cosine coefficients."""
    return idct(np.concatenate([[0.0], coefficients]), norm="ortho", workers=-1)


def predicted(
    d: Float[np.ndarray, " n"], missing: Bool[np.ndarray, " n"], v: Float[np.ndarray, " n-1"]
) -> Float[np.ndarray, " n"]:
    """Best prediction of the missing samples of d given the others, which minimizes d'C⁻¹d.

    By conjugate gradients. The covariance of the missing samples is the inverse of their precision but for
    the ends of the gaps, which leave nothing of what is slower than the longest gap: without that it is the
    preconditioner.

    Args:
        d: samples, of any value where they are missing.
        missing: which are.
        v: expected squared cosine coefficients, the spectrum; that of the mean is infinite.
    """
    gaps, full = np.flatnonzero(missing), np.zeros(len(d))
    there = np.flatnonzero(~missing)
    longest = int(np.diff(np.concatenate([[-1], there, [len(d)]])).max()) - 1
    slowest = min(2 * len(d) // longest, len(v) - 1)
    weight, within = 1.0 / v, np.concatenate([np.full(slowest, v[slowest]), v[slowest:]])

    def filtered(by: Float[np.ndarray, " n-1"]) -> Float[np.ndarray, " gaps"]:
        return in_time(dct(full, norm="ortho", workers=-1)[1:] * by)[gaps]

    full[:] = np.interp(np.arange(len(d)), there, d[there])
    y = full.copy()
    residual = -filtered(weight)
    full[:] = 0.0
    direction, square = np.zeros(len(gaps)), np.inf
    for _ in range(_STEPS):
        full[gaps] = residual
        conditioned = filtered(within)
        square, old = float(residual @ conditioned), square
        if square <= _EXACT:
            break
        direction = conditioned + square / old * direction
        full[gaps] = direction
        image = filtered(weight)
        a = square / float(direction @ image)
        y[gaps] += a * direction
        residual -= a * image
    return y


def _spectrum(x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n-1"]:
    """Smooth spectrum of a record, as the expected squares of its cosine coefficients.

    With Hann's window lines and slow changes stay where they are.
    """
    n = len(x)
    window = 1.0 - np.cos(2.0 * np.pi * (np.arange(n) + 0.5) / n)
    power = np.abs(rfft((x - x.mean()) * window, workers=-1)) ** 2 / (1.5 * n)
    power[0] = power[1]
    k = np.arange(len(power))
    # Below the fewest, as many on either side as there are.
    half = np.minimum(np.maximum(_FEWEST, (_SHARE * k).astype(int)), np.maximum(k, 1))
    sums = np.concatenate([[0.0], np.cumsum(power)])
    first, last = np.maximum(k - half, 0), np.minimum(k + half + 1, len(power))
    smooth = (sums[last] - sums[first]) / (last - first)
    return np.interp(0.5 * np.arange(1, n), k, np.maximum(smooth, 1e-12 * smooth.max()))
