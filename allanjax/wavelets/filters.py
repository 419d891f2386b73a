"""Wavelet filters: their coefficients, their cascades to higher levels, and their gains."""

from __future__ import annotations

import dataclasses
import functools
from types import ModuleType

import numpy as np
from jaxtyping import Float

from allanjax.base.errors import AllanjaxError

_HAAR = (1.0, 1.0)


def pywavelets() -> ModuleType:
    """PyWavelets' module; AllanjaxError with the remedy if it is not installed."""
    try:
        import pywt
    except ImportError as error:
        raise AllanjaxError('this needs PyWavelets: pip install "allanjax[wavelets]"') from error
    return pywt


@dataclasses.dataclass(frozen=True)
class WaveletFilter:
    """Filters of the maximal overlap transform (MODWT), those of an orthogonal wavelet over √2.

    Attributes:
        name: the wavelet's name in PyWavelets, e.g. "haar" or "sym4".
        low: scaling filter, of sum 1.
        high: wavelet filter, of sum 0; square sums of both are 1/2.
        vanishing_moments: degrees of polynomials, from 0 on, that the wavelet filter takes to zero.
    """

    name: str
    low: tuple[float, ...]
    high: tuple[float, ...]
    vanishing_moments: int

    @classmethod
    def of(cls, name: str) -> WaveletFilter:
        """Filters of the wavelet of this name.

        Raises:
            AllanjaxError: no such wavelet, one that is not orthogonal, or PyWavelets is not installed, which
                "haar" does without.
        """
        if name == "haar":
            half = np.array(_HAAR) / 2.0
            return cls(name, tuple(half), (half[0], -half[1]), 1)
        pywt = pywavelets()
        if name not in pywt.wavelist(kind="discrete") or not pywt.Wavelet(name).orthogonal:
            raise AllanjaxError(
                f"no orthogonal wavelet {name!r}: give a name of PyWavelets, such as haar, db2, db4, sym4, "
                "coif1"
            )
        found = pywt.Wavelet(name)
        low, high = (tuple(np.array(f) / np.sqrt(2.0)) for f in (found.dec_lo, found.dec_hi))
        return cls(name, low, high, found.vanishing_moments_psi)

    def length(self, level: int) -> int:
        """Samples that a coefficient at this level depends on, (2^level − 1)(L − 1) + 1."""
        return (2**level - 1) * (len(self.low) - 1) + 1

    def most_levels(self, n: int) -> int:
        """Highest level with a coefficient that n samples determine without an assumption on what is beyond.

        Raises:
            AllanjaxError: there is none.
        """
        levels = int(np.log2(max((n - 1) / (len(self.low) - 1) + 1.0, 1.0)) + 1e-9)
        if levels < 1:
            raise AllanjaxError(f"{n} samples are too few for {self.name}: it needs {self.length(1)}")
        return levels

    def impulse(self, level: int) -> Float[np.ndarray, " length"]:
        """Equivalent wavelet filter of a level: its coefficients are these sums of samples."""
        found = _spread(self.high, level - 1)
        for k in range(level - 1):
            found = np.convolve(found, _spread(self.low, k))
        return found

    def gain(
        self, levels: int, frequency: Float[np.ndarray, "octaves points"], resolved: int
    ) -> Float[np.ndarray, "levels octaves points"]:
        """Squared gains of the wavelet filters of levels 1 … `levels`, at frequencies [cycles per sample].

        Points are in octaves, the highest first: of octave k, which ends at 2^−(k+1), the filters of the
        steps up to k + `resolved` of the cascade vary slowly from point to point. Those beyond vary so fast
        that their mean is taken, which is the energy of the rest of the cascade.
        """
        octave = np.arange(len(frequency))[:, None]
        passed, gains = np.ones_like(frequency), []
        for k in range(levels):
            slow = k <= octave + resolved
            gains.append(np.where(slow, passed * self._step(self.high, 2**k * frequency), passed / 2.0))
            passed = np.where(slow, passed * self._step(self.low, 2**k * frequency), passed / 2.0)
        return np.stack(gains)

    @staticmethod
    def _step(
        coefficients: tuple[float, ...], frequency: Float[np.ndarray, "octaves points"]
    ) -> Float[np.ndarray, "octaves points"]:
        """Squared gain of a filter, from its autocorrelation."""
        r = np.correlate(coefficients, coefficients, "full")[len(coefficients) - 1 :]
        cosines = np.cos(2.0 * np.pi * np.arange(1, len(r))[:, None, None] * frequency)
        return np.maximum(r[0] + 2.0 * np.tensordot(r[1:], cosines, 1), 0.0)


def _spread(coefficients: tuple[float, ...], step: int) -> Float[np.ndarray, " length"]:
    """Coefficients with 2^step − 1 zeros between neighbours."""
    found = np.zeros(2**step * (len(coefficients) - 1) + 1)
    found[:: 2**step] = coefficients
    return found


@functools.cache
def wavelet_filter(name: str) -> WaveletFilter:
    """Filters of the wavelet of this name, as `WaveletFilter.of` finds them."""
    return WaveletFilter.of(name)
