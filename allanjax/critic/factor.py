"""The structure of a spectrum as a factor of the basic terms' spectrum, and records behind steep filters.

The cosine transform continues a record by its mirror image, which has kinks at the ends. In a stop band they
may dominate.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.fft import dct, dst
from scipy.ndimage import uniform_filter1d

from allanjax.critic.noise import NoiseFamily
from allanjax.estimate.spectral.components import COLUMN, MARKOV
from allanjax.estimate.spectral.model import response_of
from allanjax.estimate.structure.structure import FURTHER, OUTSIDE, Structure, term_of
from allanjax.noise.response import Response

# Response below which the record's ends are modelled, and number of coefficients in a local mean.
_DEEP, _LOCAL = 0.01, 401
# Least share of the noise in the whole spectrum.
_LEAST = 1e-12
# Number of points of the response.
_POINTS = 4097


def spectrum_factor(
    structure: Structure, family: NoiseFamily, squares: Float[np.ndarray, " n-1"]
) -> Float[np.ndarray, " n-1"]:
    """Ratio of the whole spectrum to that of the slow terms, a power law and white noise before the response.

    Where the record's ends exceed the filtered noise, it follows the record's own squared coefficients, so
    that these carry no information.
    """
    f, rate = family.frequency, family.rate
    inside, after = np.zeros(len(f)), np.zeros(len(f))
    noise = np.zeros(len(f))
    for k, own in enumerate(structure.components):
        if own.kind != COLUMN:
            density = rate * np.asarray(term_of(structure, k, rate).sampled(rate).sampled_psd(f, rate))
        elif own.which == OUTSIDE:
            density = np.full(len(f), own.power * rate)
        elif own.which == FURTHER and structure.further is not None:
            density = own.power * family.spectrum(structure.further)
        else:
            density = own.power * family.spectra[own.which]
        part = inside if own.inside else after
        part += density
        noise += density if own.kind == MARKOV or (own.kind == COLUMN and own.which != OUTSIDE) else 0.0
    # There may be resonances only.
    noise = np.maximum(noise, _LEAST * (inside + after))
    response = response_of(structure, rate)
    if response is None:
        return (inside + after) / noise
    passed = np.asarray(response.power(f, rate))
    deep = passed * inside + after < _DEEP * noise
    factor = (inside * passed + after) / noise
    if deep.any():
        ends = inside * np.interp(f, _grid(rate), _ends(response, rate)) / (family.n * noise)
        own = uniform_filter1d(squares / noise, _LOCAL, mode="nearest")
        factor = np.where(deep & (ends > factor), np.maximum(own, 1e-9), factor + np.where(deep, ends, 0.0))
    return factor


def stop_band(
    structure: Structure, family: NoiseFamily, factor: Float[np.ndarray, " n-1"]
) -> tuple[Bool[np.ndarray, " n-1"], Float[np.ndarray, " n-1"]] | None:
    """Where the kinks at a record's ends matter, and the share of the spectrum without them; or None."""
    response = response_of(structure, family.rate)
    if response is None or not (factor < _DEEP).any():
        return None
    deep = factor < _DEEP
    f = family.frequency
    ends = np.interp(f, _grid(family.rate), _ends(response, family.rate)) / family.n
    return deep, np.clip(1.0 - ends / factor, 1e-9, 1.0)


def _grid(rate: float) -> Float[np.ndarray, " fine"]:
    """Frequencies between zero and half the sample rate."""
    return np.arange(1, _POINTS - 1) * rate / (2.0 * (_POINTS - 1))


def _ends(response: Response, rate: float) -> Float[np.ndarray, " fine"]:
    """Power that a record's two ends add to the response of white noise, times the number of samples.

    With the autocovariance r the squares of coefficients are expected to be Σ (2 − 2k/n)·r_k cos(ak) − r_0 −
    2/(n sin a)·Σ r_k sin(ak); the ends' part is −(2/n)·[Σ k·r_k cos(ak) + Σ r_k sin(ak)/sin a].
    """
    m = _POINTS - 1
    f = _grid(rate)
    power = np.asarray(response.power(np.concatenate([[0.0], f, [rate / 2.0]]), rate))
    r = dct(power, type=1) / (2.0 * m)
    lag = np.arange(m + 1.0)
    cosines = 0.5 * dct(lag * r, type=1)[1:-1] + 0.5 * m * r[-1] * (-1.0) ** lag[1:-1]
    sines = 0.5 * dst(r[1:-1], type=1) / np.sin(np.pi * lag[1:-1] / m)
    return np.maximum(-2.0 * (cosines + sines), 0.0)
