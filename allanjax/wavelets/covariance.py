"""Expectation and covariance of wavelet variances under a noise model.

A coefficient W_j at level j is a sum of samples whose weights h_j sum to zero, that is, of phases whose
weights annihilate a constant and a trend: its covariance follows from the phase covariance G, or from the
spectrum S of the samples, which is the cosine sum of −δ²G (`noise.process`). With H_j the transfer function
of h_j, frequencies in cycles per sample and R the sample rate,

    E V_j = 2R ∫₀^½ |H_j|² S df,    Σ_s C_jk(s)² = 2R² ∫₀^½ |H_j|² |H_k|² S² df,

where V_j is the mean of W_j² over the M_j coefficients that no end of the record has touched, and C_jk(s)
the covariance of W_j and W_k at lag s. For many coefficients cov(V_j, V_k) is 2 Σ_s C_jk(s)²/max(M_j, M_k)
(Percival & Walden 2000, section 8.3). At the highest levels they are few: there it is multiplied by the
ratio of the exact sum over pairs of coefficients to this one under white noise, which all noise resembles
within the octave of a level.

S is smooth: it enters by its values at a few frequencies an octave, whose weights are integrals of the gains
times Lagrange polynomials. They are data, so that one program serves records of any length and rate. The Haar
wavelet has another formula, which is exact: its variance is half the Allan variance (`allan.covariance`).
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from allanjax.allan.covariance import AllanCovariance
from allanjax.noise.process import Process
from allanjax.wavelets.filters import WaveletFilter

# Octaves of frequency with nodes, so many nodes each, and the points at which their weights are integrated.
_OCTAVES, _NODES, _POINTS = 32, 8, 2048
# Steps of the cascade beyond a point's octave whose gains these points resolve.
_RESOLVED = 6
# Highest levels for which the pairs of coefficients are counted one by one, on a record thinned to these.
_COUNTED = 8


class WaveletCovariance(AllanCovariance):
    """Quadrature for the covariance of wavelet variance estimates: all of it that no model enters.

    What `AllanCovariance` has for lags, this has for frequencies [Hz], the same for all pairs of levels.

    Attributes:
        gains: weights of the spectrum at the frequencies in the expectation of each level.
    """

    gains: Float[np.ndarray, "lags m"]

    @classmethod
    def of_levels(
        cls, n: int, rate: float, wavelet: WaveletFilter, levels: Int[np.ndarray, " m"], capacity: int = 0
    ) -> WaveletCovariance:
        """Quadrature for estimates at these levels, 1 and up, of n rate samples at `rate` [Hz].

        `capacity`: number of levels that arrays are padded to, if there are fewer.
        """
        m, size = len(levels), max(capacity, len(levels))
        i, j = np.triu_indices(m)
        count = n - np.array([wavelet.length(k) for k in levels]) + 1
        nodes, points, basis = _quadrature()
        gain = wavelet.gain(int(levels[-1]), points, _RESOLVED)[levels - 1].swapaxes(0, 1)
        # Widths of the points' cells, octave by octave.
        width = 0.5 ** np.arange(2, _OCTAVES + 2)[:, None, None] / _POINTS
        gains = 2.0 * rate * width * (basis @ gain.swapaxes(1, 2))
        squares = np.stack([(gain * polynomial) @ gain.swapaxes(1, 2) for polynomial in basis], axis=1)
        products = 2.0 * rate**2 * width * squares[..., i, j]
        few = _few_coefficients(count, wavelet, levels)[i, j]
        weights = (2.0 * few / np.maximum(count[i], count[j]) * products).reshape(-1, len(i))
        place = np.full((size, size), len(i))
        place[i, j] = place[j, i] = np.arange(len(i))
        pairs = size * (size + 1) // 2
        more = ((0, 0), (0, pairs - len(i)))
        return cls(
            np.asarray(1.0 / rate),
            np.asarray(n / rate),
            np.asarray(m),
            np.pad(2.0 ** (levels - 1), (0, size - m), constant_values=1.0),
            np.pad(np.stack([i, j]), more),
            place,
            np.repeat(rate * nodes.reshape(-1, 1), pairs, axis=1),
            np.pad(weights, more),
            np.pad(gains.reshape(-1, m), ((0, 0), (0, size - m))),
        )

    def kernel(self, term: Process) -> Float[Array, "lags pairs"]:
        """Spectrum of one noise term at the quadrature's frequencies, the same for all pairs."""
        return jnp.broadcast_to(self._density(term)[:, None], self.lags.shape)

    def mean(self, term: Process) -> Float[Array, " m"]:
        """Expected wavelet variances of one term [rate²]; zero where there is no estimate."""
        return self._density(term) @ self.gains

    def _density(self, term: Process) -> Float[Array, " lags"]:
        rate: Any = 1.0 / jnp.asarray(self.sample_interval)
        return jnp.asarray(term.sampled_psd(jnp.asarray(self.lags)[:, 0], rate))


def _quadrature() -> tuple[
    Float[np.ndarray, "octaves nodes"], Float[np.ndarray, "octaves points"], Float[np.ndarray, "nodes points"]
]:
    """Nodes and points [cycles per sample] in every octave, the highest first, and Lagrange polynomials."""
    x = (1.0 - np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)) / 2.0
    t = (np.arange(_POINTS) + 0.5) / _POINTS
    basis = np.ones((_NODES, _POINTS))
    for k in range(_NODES):
        for other in np.delete(x, k):
            basis[k] *= (t - other) / (x[k] - other)
    low = 0.5 ** np.arange(2, _OCTAVES + 2)[:, None]
    return low * (1.0 + x), low * (1.0 + t), basis


def _few_coefficients(
    count: Int[np.ndarray, " m"], wavelet: WaveletFilter, levels: Int[np.ndarray, " m"]
) -> Float[np.ndarray, "m m"]:
    """Factor of the covariance where coefficients are few, exact under white noise; 1 at lower levels.

    With r the cross-correlation of two filters, it is Σ_s w(s) r(s)²/(M_j M_k) over Σ_s r(s)²/max(M_j, M_k),
    w(s) being the number of pairs of coefficients at lag s.
    """
    found = np.ones((len(levels), len(levels)))
    thin = max(int(levels[-1]) - _COUNTED, 0)
    counted = np.flatnonzero(levels > thin)
    impulses = [wavelet.impulse(int(levels[k]) - thin) for k in counted]
    size = 1 << (2 * len(impulses[-1])).bit_length()
    transforms = [np.fft.rfft(h, size) for h in impulses]
    lag = np.rint(np.fft.fftfreq(size) * size)
    for a, (k, H) in enumerate(zip(counted, transforms, strict=True)):
        for other, G in zip(counted[a:], transforms[a:], strict=True):
            squares = np.fft.irfft(H * G.conj(), size) ** 2
            Mh, Mg = count[[k, other]] / 2**thin
            pairs = np.clip(np.minimum(Mh + lag, Mg) - np.maximum(lag, 0), 0.0, None)
            exact = (pairs * squares).sum() / (Mh * Mg)
            found[k, other] = found[other, k] = exact / squares.sum() * max(Mh, Mg)
    return found
