"""Draws of samples that were rounded, clipped or missing, given what is known of them.

Between the limits set by the resolution or range of the output, a sample is Gaussian around the slow part of
the record. Drawing it restores the normal law on which everything else relies. Missing samples are simulated
given all others.
"""

from __future__ import annotations

import itertools

import numpy as np
from jaxtyping import Bool, Float
from scipy.fft import dct
from scipy.ndimage import uniform_filter1d
from scipy.special import ndtr, ndtri

from allanjax.critic.effect import View
from allanjax.critic.noise import centred
from allanjax.record.completion import in_time, predicted

# Most and fewest sweeps, and the change of the deviation, in standard errors, below which they end.
_SWEEPS, _FEWEST, _CHANCE = 12, 6, 1.0
# Number of samples in a local mean.
_WINDOW = 200
# Smallest tail probability from which samples are drawn.
_DEEP = 1e-12


def local_mean(x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Mean of the samples around each one."""
    return uniform_filter1d(x, _width(x), mode="reflect")


def local_deviation(x: Float[np.ndarray, " n"]) -> float:
    """Standard deviation of samples about their local mean."""
    width = _width(x)
    return float(np.sqrt(np.mean((x - local_mean(x)) ** 2) * width / (width - 1.0)))


def _width(x: Float[np.ndarray, " n"]) -> int:
    return min(_WINDOW, len(x) // 8)


def draw_between(
    x: Float[np.ndarray, " n"], lower: Float[np.ndarray, " n"], upper: Float[np.ndarray, " n"], seed: int
) -> tuple[Float[np.ndarray, " n"], float]:
    """Draw of samples between `lower` and `upper` (equal for exact samples), and their local deviation."""
    rng = np.random.default_rng(seed)
    open_, y = upper > lower, x.astype(float)
    lower, upper = lower[open_], upper[open_]
    centre, sigma = local_mean(y), float(np.std(np.diff(y)) / np.sqrt(2.0))
    for k in range(_SWEEPS):
        slow = centre[open_]
        a, b = ((limit - slow) / max(sigma, 1e-300) for limit in (lower, upper))
        # In the tail of both limits, the smaller probability has the digits.
        flip = a > 0.0
        a, b = np.where(flip, -b, a), np.where(flip, -a, b)
        low, high = ndtr(a), ndtr(b)
        u = low + (high - low) * rng.random(len(a))
        z = ndtri(np.clip(u, _DEEP, 1.0 - _DEEP))
        y[open_] = slow + sigma * np.where(flip, -z, z)
        centre = local_mean(y)
        before, sigma = sigma, local_deviation(y)
        if k + 1 >= _FEWEST and abs(sigma - before) < _CHANCE * sigma / np.sqrt(2.0 * len(y)):
            break
    return y, sigma


# Lags of the errors of rounding; harmonics of their law; the share of their least density that stays; and
# the number of coefficients over which a spectrum is averaged.
_LAGS, _HARMONICS, _KEPT, _SMOOTH = 200, 20, 0.9, 200
# Points at which the law is tabulated; least share of their variance at a frequency.
_GRID, _LOWEST = 2000, 0.1


def draw_unrounded(x: Float[np.ndarray, " n"], step: float, seed: int) -> Float[np.ndarray, " n"] | None:
    """Draw of samples before they were rounded to multiples of a step, of at most twice their deviation.

    None if errors of rounding are nowhere most of the spectrum, as they are where a filter has fallen.

    The errors are then nearly independent of the samples (Widrow 1961), so that a coefficient has a normal
    law given the rounded one, if the spectra of both are known. That of the samples is the record's own less
    that of the errors; most of the least density of these stays, as a filter leaves little else at places.
    """
    c = centred(x)
    own = uniform_filter1d(c**2, min(_SMOOTH, len(c)), mode="nearest")
    error = _errors_of_rounding(x, step)
    white = _KEPT * float(error.min())
    if np.min(own - error) >= white:
        return None
    error = error - white
    v = np.maximum(own - error, 0.5 * white)
    kept = v / (v + error)
    draw = kept * c + np.sqrt(kept * error) * np.random.default_rng(seed).standard_normal(len(c))
    return x.mean() + in_time(draw)


def _errors_of_rounding(x: Float[np.ndarray, " n"], step: float) -> Float[np.ndarray, " n-1"]:
    """Expected squared cosine coefficients of the errors of rounding Gaussian samples.

    Their covariance is step²/(2π²) Σ exp(−2π²m²D/step²)/m² at a lag where the samples differ by √D (Bennett
    1948, Widrow). The mean square difference of rounded samples exceeds D by twice what errors lack of it.
    """
    lags = np.arange(1, min(_LAGS, len(x) // 2) + 1)
    measured = np.array([np.mean((x[lag:] - x[:-lag]) ** 2) for lag in lags]) / step**2
    m, D = np.arange(1.0, _HARMONICS + 1.0)[:, None], np.append(0.0, np.geomspace(1e-6, 1e6, _GRID))
    variance = 1.0 / 12.0
    covariance = np.sum(np.exp(-2.0 * (np.pi * m) ** 2 * D) / (2.0 * (np.pi * m) ** 2), axis=0)
    both = np.zeros(len(x) + 1)
    both[0] = variance
    both[lags] = np.interp(measured, D + 2.0 * (variance - covariance), covariance)
    return step**2 * np.maximum(dct(both, type=1)[1:-1], _LOWEST * variance)


# Most draws, and the change of the log spectrum between two draws below which they end.
_DRAWS, _SETTLED = 12, 0.1
# Bins of the record's own spectrum: most per octave, fewest coefficients per bin, and the number of standard
# deviations up to which a difference from the model is chance.
_PARTS, _LEAST, _BY_CHANCE = 32, 64, 3.0


def impute_gaussian(view: View, missing: Bool[np.ndarray, " n"]) -> View:
    """View in which these samples are redrawn, given all others and the record's spectrum.

    A simulated record is corrected by the best prediction of its difference from this one (conditional
    simulation). That is repeated until the spectrum, to which interpolated samples contribute at first, is
    that of the other samples. Samples that were imputed before start from their values.
    """
    rng = np.random.default_rng([int(missing.sum()), int(np.argmax(missing))])
    fresh, known = np.flatnonzero(missing & ~view.imputed), np.flatnonzero(~missing)
    x = view.samples.copy()
    x[fresh] = np.interp(fresh, known, x[known])
    first = view.with_samples(x, missing)
    c, model = first.coefficients, first.variance()
    v, changed = _own_variance(c, model), np.inf
    for _ in range(_DRAWS):
        draw = in_time(np.sqrt(v) * rng.standard_normal(view.n - 1)) + x.mean()
        x = np.where(missing, draw + predicted(x - draw, missing, v), x)
        c = centred(x)
        before, v = v, _own_variance(c, model)
        last, changed = changed, float(np.max(abs(np.log(v / before))))
        # A change no smaller than the last one is chance, e.g. from redrawing a long gap.
        if changed < _SETTLED or changed > last:
            break
    return view.with_samples(x, missing, c)


def _own_variance(c: Float[np.ndarray, " n-1"], v: Float[np.ndarray, " n-1"]) -> Float[np.ndarray, " n-1"]:
    """Expected squared coefficients: a model's, or the record's own in bins where it differs beyond chance.

    This allows for effects that have not been found yet, such as a filter.
    """
    n = len(c) + 1
    octaves = np.append(2 ** np.arange(int(np.log2(n - 1)) + 1) - 1, n - 1)
    parts = [
        np.linspace(low, high, int(np.clip((high - low) // _LEAST, 1, _PARTS)) + 1)
        for low, high in itertools.pairwise(octaves)
    ]
    first = np.unique(np.concatenate(parts).astype(int))
    count = np.diff(first)
    level = np.log(np.maximum(np.add.reduceat(c**2 / v, first[:-1]), 1e-300) / count)
    # Gradually, as bins at the edge of chance would otherwise switch from draw to draw.
    level *= np.clip(abs(level) / np.sqrt(2.0 / count) - _BY_CHANCE, 0.0, 1.0)
    middle = 0.5 * (first[:-1] + first[1:] - 1)
    return v * np.exp(np.interp(np.arange(n - 1), middle, level))
