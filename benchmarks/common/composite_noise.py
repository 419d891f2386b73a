"""Noise of composite sensors in the time domain, and its spectrum: filters, slow noise, resonances.

NumPy and SciPy alone. Everything before the samples lives at an internal rate, OVERSAMPLING times that of the
samples, of which every eighth is kept: aliases are there as they are in a sensor. Spectra are those of the
samples, as a variance: their mean over the frequencies from 0 to half the rate is the variance of a sample,
and that of white noise of density N² [rate²/Hz, two-sided] is N² times the rate.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.fft import dct, idct
from scipy.optimize import nnls
from scipy.signal import bessel, butter, lfilter, sosfilt, sosfreqz, tf2sos

OVERSAMPLING = 8
#: Filters of the electronics, at the internal rate; others are of the processor, at that of the samples.
ANALOG = ("one pole", "two poles", "Butterworth", "Bessel")
_GRID = 8192


# --- Filters -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Filter:
    """A filter that noise passes before it is sampled, 1 at frequency zero.

    `cutoff` in Hz is where the power is halved (of a moving average nearly, `order` is its length there);
    `quality` is that of two poles.
    """

    kind: str
    cutoff: float
    order: int
    rate: float
    quality: float = 0.0

    @property
    def analog(self) -> bool:
        return self.kind in ANALOG

    @property
    def own_rate(self) -> float:
        """The rate that it runs at [Hz]."""
        return self.rate * (OVERSAMPLING if self.analog else 1)

    @property
    def sections(self) -> np.ndarray:
        if self.kind == "moving average":
            return tf2sos(np.full(self.order, 1.0 / self.order), [1.0])
        if self.kind == "two poles":
            return tf2sos(*oscillator(self.cutoff, self.quality, self.own_rate))
        design = bessel if self.kind == "Bessel" else butter
        options = {"norm": "mag"} if self.kind == "Bessel" else {}
        return design(self.order, self.cutoff, fs=self.own_rate, output="sos", **options)

    def power(self, frequency: np.ndarray) -> np.ndarray:
        """Power response at frequencies [Hz] up to half the internal rate."""
        _, H = sosfreqz(self.sections, worN=2.0 * np.pi * frequency / self.own_rate)
        return np.abs(H) ** 2

    def run(self, x: np.ndarray) -> np.ndarray:
        return sosfilt(self.sections, x)

    @property
    def settling(self) -> int:
        """Samples until it has forgotten its start."""
        return int(10.0 * self.rate / self.cutoff) + 8 * self.order

    def white(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """White noise of density 1 behind the filter, n samples."""
        step = OVERSAMPLING if self.analog else 1
        x = rng.standard_normal((n + self.settling) * step)
        return np.sqrt(self.own_rate) * self.run(x)[self.settling * step :: step]

    def white_spectrum(self, frequency: np.ndarray) -> np.ndarray:
        """Spectrum of `white`, with its aliases."""
        grid = np.linspace(0.0, self.rate / 2.0, _GRID)
        power = sum(map(self.power, images(grid, self.rate))) if self.analog else self.power(grid)
        return self.rate * np.interp(frequency, grid, power)

    def slow(self, x: np.ndarray) -> np.ndarray:
        """Noise that has no aliases to speak of, behind the filter: by the magnitude of its response."""
        grid = np.linspace(0.0, self.rate / 2.0, _GRID)
        f = frequencies(len(x), self.rate)
        return idct(dct(x, norm="ortho") * np.interp(f, grid, np.sqrt(self.power(grid))), norm="ortho")


def frequencies(n: int, rate: float) -> np.ndarray:
    """Those of the discrete cosine transform of n samples [Hz]."""
    return np.arange(n) * rate / (2.0 * n)


def images(frequency: np.ndarray, rate: float) -> list[np.ndarray]:
    """The frequencies at the internal rate that look like these among the samples."""
    half = OVERSAMPLING // 2
    folded = [m * rate + sign * frequency for m in range(half + 1) for sign in (1.0, -1.0)]
    return [np.abs(f) for f in folded[:1] + folded[2:-2] + folded[-1:]]


# --- Resonances --------------------------------------------------------------------------------------------


def oscillator(f0: float, quality: float, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Recursion of ω0²/(s² + s·ω0/Q + ω0²) by the bilinear transform that keeps f0 in its place."""
    t = np.tan(np.pi * f0 / rate)
    a = np.array([1.0 + t / quality + t * t, 2.0 * (t * t - 1.0), 1.0 - t / quality + t * t])
    return t * t / a[0] * np.array([1.0, 2.0, 1.0]), a / a[0]


def oscillator_power(frequency: np.ndarray, f0: float, quality: float, rate: float) -> np.ndarray:
    """Power response of `oscillator` at frequencies up to half its rate."""
    with np.errstate(over="ignore"):
        x2 = (np.tan(np.pi * frequency / rate) / np.tan(np.pi * f0 / rate)) ** 2
        return 1.0 / ((1.0 - x2) ** 2 + x2 / quality**2)


@dataclass(frozen=True)
class Resonance:
    """A damped oscillator driven by white noise, of rms 1 before the filter that it may pass."""

    f0: float
    quality: float
    rate: float
    inside: Filter | None = None

    @property
    def _variance(self) -> float:
        """Of the oscillator that white noise of variance 1 drives at the internal rate."""
        fast = OVERSAMPLING * self.rate
        near = self.f0 * (1.0 + np.sinh(np.linspace(-8.0, 8.0, 40001)) / np.sinh(8.0))
        f = np.concatenate([near[near > 0.0], np.linspace(2.0 * self.f0, fast / 2.0, 20001)[1:]])
        return float(np.trapezoid(oscillator_power(f, self.f0, self.quality, fast), f) / (fast / 2.0))

    def draw(self, rng: np.random.Generator, n: int) -> np.ndarray:
        before = int(20.0 * self.quality * self.rate / self.f0) + 1
        if self.inside:
            before += self.inside.settling
        x = rng.standard_normal((n + before) * OVERSAMPLING) / np.sqrt(self._variance)
        x = lfilter(*oscillator(self.f0, self.quality, OVERSAMPLING * self.rate), x)
        if self.inside and self.inside.analog:
            x = self.inside.run(x)
        x = x[::OVERSAMPLING]
        if self.inside and not self.inside.analog:
            x = self.inside.run(x)
        return x[before:]

    def spectrum(self, frequency: np.ndarray, filtered: bool = True) -> np.ndarray:
        """Of the samples; as if it did not pass the filter, if asked for."""
        grid = np.linspace(0.0, self.rate / 2.0, _GRID)
        total = np.zeros_like(frequency)
        for f, g in zip(images(frequency, self.rate), images(grid, self.rate), strict=True):
            part = oscillator_power(f, self.f0, self.quality, OVERSAMPLING * self.rate)
            if filtered and self.inside:
                part *= np.interp(frequency, grid, self.inside.power(g))
            total += part
        return total / (OVERSAMPLING * self._variance)


# --- Slow noise --------------------------------------------------------------------------------------------


def exponential(rng: np.random.Generator, n: int, interval: float) -> np.ndarray:
    """Stationary Gauss-Markov noise of variance 1, sampled every `interval` correlation times."""
    drive = np.sqrt(-np.expm1(-2.0 * interval)) * rng.standard_normal(n)
    drive[0] = rng.standard_normal()
    return lfilter([1.0], [1.0, -np.exp(-interval)], drive)


def exponential_spectrum(frequency: np.ndarray, rate: float, interval: float) -> np.ndarray:
    s = 4.0 * np.exp(-interval) * np.sin(np.pi * frequency / rate) ** 2
    return -np.expm1(-2.0 * interval) / (np.expm1(-interval) ** 2 + s)


def walk(rng: np.random.Generator, n: int, rate: float) -> np.ndarray:
    """Random walk of coefficient 1."""
    return np.cumsum(rng.standard_normal(n)) / np.sqrt(rate)


def walk_spectrum(frequency: np.ndarray, rate: float) -> np.ndarray:
    return 1.0 / (rate * 4.0 * np.sin(np.pi * np.maximum(frequency, 1e-12) / rate) ** 2)


def flicker_theory(frequency: np.ndarray, rate: float) -> np.ndarray:
    """Spectrum of the means over the sample intervals of noise with the two-sided density 1/|f|, f in Hz."""
    m = np.arange(-30, 31)
    f = np.asarray(frequency)[:, None] + m * rate
    return rate * np.sum(np.sinc(f / rate) ** 2 / np.abs(f), axis=1)


@lru_cache(maxsize=8)
def flicker_parts(n: int, rate: float) -> tuple[tuple[float, float], ...]:
    """Intervals, in correlation times, and variances of the Gauss-Markov processes that add up to 1/f.

    Three a decade, from a fifth of a sample interval to a thousand records; their variances follow from
    non-negative least squares of the relative error, from a fifteenth of the lowest frequency on.
    """
    interval = np.geomspace(5.0, 1e-3 / n, int(3.0 * np.log10(5e3 * n)))
    f = np.geomspace(rate / n / 30.0, rate / 2.0, 600)
    aim = flicker_theory(f, rate)
    parts = np.stack([exponential_spectrum(f, rate, x) / aim for x in interval], axis=1)
    size = parts.max(axis=0)
    variance = nnls(parts / size, np.ones(len(f)))[0] / size
    return tuple((float(x), float(v)) for x, v in zip(interval, variance, strict=True) if v > 0.0)


def flicker(rng: np.random.Generator, n: int, rate: float) -> np.ndarray:
    """Noise with the spectrum of `flicker_theory`.

    What the sum of processes lacks, up to 8 % near half the rate, is mended by a filter.
    """
    x = sum((np.sqrt(v) * exponential(rng, n, x) for x, v in flicker_parts(n, rate)), np.zeros(n))
    f = np.append(np.geomspace(rate / n / 2.0, rate / 2.0, 2000), rate / 2.0)
    mend = np.sqrt(flicker_theory(f, rate) / _flicker_sum(f, n, rate))
    return idct(dct(x, norm="ortho") * np.interp(frequencies(n, rate), f, mend), norm="ortho")


def _flicker_sum(frequency: np.ndarray, n: int, rate: float) -> np.ndarray:
    """Spectrum of the processes that `flicker` adds up."""
    parts = flicker_parts(n, rate)
    return sum((v * exponential_spectrum(frequency, rate, x) for x, v in parts), np.zeros_like(frequency))


def flicker_spectrum(frequency: np.ndarray, rate: float) -> np.ndarray:
    """`flicker_theory` at the frequencies of a cosine transform, by interpolation; not at zero."""
    f = np.geomspace(max(frequency[1], 1e-9), rate / 2.0, 4000)
    y = np.interp(np.log(np.maximum(frequency, f[0])), np.log(f), np.log(f * flicker_theory(f, rate)))
    return np.exp(y) / np.maximum(frequency, f[0])
