"""A composite sensor that is being made: its noise, its spectrum, and how strong effects are in it.

An effect's strength is the gain in log-likelihood [nats] that somebody expects of it who knows everything
else, the spectra included:

- a known waveform w (line, knock, step, temperature, outliers): ½ Σ w_k²/P_k over the cosine transform;
- a filter or a resonance, against the same without it and a level of one's own choice: n/2 (ln mean ρ −
  mean ln ρ) with the ratio ρ of the two spectra;
- other noise of spectrum r·P on top (a wandering line, an event): ½ Σ (r − ln(1 + r));
- another variance on a share p: the same as of a filter, with the ratio in time;
- repeated samples: Poisson likelihood of their number over that of chance;
- rounding: infinite, since samples lie on a lattice (behind a matrix, on one of three dimensions).

An axis is asked for if its gain is ASKED or more.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.fft import dct, idct
from scipy.optimize import brentq
from scipy.signal import bessel, butter, lfilter, sosfilt, sosfreqz, tf2sos

from benchmarks.common.hidden_sensors import log_uniform, term_noise, term_variances

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


ASKED = 25.0
NAMES = tuple(f"{sensor}_{axis}" for sensor in ("gyro", "accel") for axis in "xyz")
#: Ranges of the strength on the axis that shows most [nats].
STRENGTH = {"resonance": (10.0, 1e5), "step": (10.0, 1e3)}
USUAL_STRENGTH = (10.0, 1e4)
#: Largest amplitudes over a sample's deviation.
LARGEST = {"resonance": 3.0}
USUAL_LARGEST = 300.0
#: Share of its median below which a spectrum does not fall for a waveform, which leaks into a filter's zeros.
FLOOR = 1e-3


@dataclass(frozen=True)
class Effect:
    """What was put in: parameters in Hz and s, strength and amplitude (over a sample's deviation) by axis."""

    kind: str
    parameters: dict[str, float | str]
    gain: dict[str, float]
    amplitude: dict[str, float] = field(default_factory=dict)
    span: tuple[float, float] | None = None

    @property
    def axes(self) -> tuple[str, ...]:
        return tuple(self.gain)

    @property
    def asked(self) -> tuple[str, ...]:
        """The axes on which it is strong enough."""
        return tuple(axis for axis, gain in self.gain.items() if gain >= ASKED)


@dataclass
class AxisTruth:
    """Coefficients in SI, 0 for none: N as the samples show it at low frequencies, aliases included.

    `one_level` says whether there is one such N: not with another variance in a stretch, nor with rounding,
    whose own noise may be counted or not.
    """

    N: float
    K: float = 0.0
    q_c: float = 0.0
    T_c: float = 0.0
    flicker_corner: float = 0.0
    one_level: bool = True

    @property
    def slow(self) -> dict[str, float]:
        """Coefficients of the slow terms that are there, by the letters of `hidden_sensors`."""
        B = self.N * np.sqrt(2.0 * np.pi * self.flicker_corner)
        return {letter: c for letter, c in {"K": self.K, "B": B, "M": self.q_c}.items() if c}


@dataclass
class Scene:
    """A recording that is being made; `spectrum` is that of each axis's stationary noise."""

    rng: np.random.Generator
    n: int
    rate: float
    truth: list[AxisTruth]
    filters: dict[str, Filter] = field(default_factory=dict)
    resonances: list[tuple[Resonance, dict[int, float]]] = field(default_factory=list)
    effects: list[Effect] = field(default_factory=list)
    spectrum: np.ndarray = field(init=False)
    std: np.ndarray = field(init=False)
    x: np.ndarray = field(init=False)
    auxiliary: dict[str, np.ndarray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.f = frequencies(self.n, self.rate)
        self.t = np.arange(self.n) / self.rate

    def filter_of(self, k: int) -> Filter | None:
        return self.filters.get(NAMES[k].split("_")[0])

    def log_uniform(self, low: float, high: float) -> float:
        return log_uniform(self.rng, low, high)

    def some_axes(self, low: int, high: int) -> np.ndarray:
        """So many axes; up to three are of one sensor."""
        count = int(self.rng.integers(low, high + 1))
        pool = np.arange(6) if count > 3 else np.arange(3) + 3 * int(self.rng.integers(2))
        return np.sort(self.rng.choice(pool, count, replace=False))

    def gains_of(self, axes: np.ndarray) -> np.ndarray:
        """Amplitudes of an effect relative to each axis's noise; the largest is 1."""
        g = np.exp(self.rng.uniform(np.log(0.2), 0.0, len(axes)))
        return g / g.max()

    def scale(self, kind: str, strongest: Callable[[float], float]) -> float:
        """The amplitude at which the axis that shows most has a strength drawn for this kind."""
        aim = self.log_uniform(*STRENGTH.get(kind, USUAL_STRENGTH))
        most = LARGEST.get(kind, USUAL_LARGEST)
        if strongest(most) <= aim:
            return most
        miss: Callable[[float], float] = lambda log: np.log(max(strongest(np.exp(log)), 1e-30) / aim)  # noqa: E731
        return float(np.exp(brentq(miss, -14.0, np.log(most), xtol=1e-3)))

    def of_waveform(self, w: np.ndarray, k: int) -> float:
        """½ Σ w²/P of a waveform."""
        return 0.5 * float(np.sum(dct(w, norm="ortho")[1:] ** 2 / self.floored(k)))

    def floored(self, k: int) -> np.ndarray:
        """An axis's spectrum but at frequency zero, where a waveform cannot leak into a filter's zeros."""
        P = self.spectrum[k, 1:]
        return np.maximum(P, FLOOR * np.median(P))

    def tell(
        self, kind: str, axes: np.ndarray, gain: np.ndarray, over_noise: np.ndarray, **more: object
    ) -> None:
        span = more.pop("span", None)
        names = [NAMES[k] for k in axes]
        self.effects.append(
            Effect(
                kind,
                more,  # type: ignore[arg-type]
                dict(zip(names, map(float, gain), strict=True)),
                dict(zip(names, map(float, over_noise), strict=True)),
                span,  # type: ignore[arg-type]
            )
        )


def level_free(ratio: np.ndarray) -> float:
    """Expected gain over spectra of this ratio to the true one, times the best factor."""
    return 0.5 * len(ratio) * float(np.log(np.mean(ratio)) - np.mean(np.log(ratio)))


# --- The sensor --------------------------------------------------------------------------------------------

#: Densities of gyros [rad/s/√Hz] and accelerometers [m/s²/√Hz], worst and best.
GRADES = {
    "consumer": ((3e-4, 8e-5), (4e-3, 1.2e-3)),
    "industrial": ((8e-5, 2e-5), (1.2e-3, 4e-4)),
    "tactical": ((2e-5, 2e-6), (4e-4, 1e-4)),
}


def drawn_truth(rng: np.random.Generator, grade: str, duration: float) -> list[AxisTruth]:
    """White noise on all axes; walk, flicker and Gauss-Markov noise each with a chance of 0.5, 0.4, 0.3.

    Amplitudes by the frequency at which the white noise is as strong, 1e-4 to 0.02 Hz of a walk and 0.001 to
    0.2 Hz of flicker; Gauss-Markov noise has 3 to 100 times its density, and a T_c of 3 s to 1/20 record.
    """

    between, truth = functools.partial(log_uniform, rng), []
    for worst, best in GRADES[grade]:
        typical = between(best, worst)
        for _ in range(3):
            a = AxisTruth(N=typical * between(0.8, 1.25))
            if rng.random() < 0.5:
                a.K = 2.0 * np.pi * between(1e-4, 0.02) * a.N
            if rng.random() < 0.4:
                a.flicker_corner = between(1e-3, 0.2)
            if rng.random() < 0.3:
                a.T_c = between(3.0, max(duration / 20.0, 6.0))
                a.q_c = a.N * np.sqrt(between(3.0, 100.0)) / a.T_c
            truth.append(a)
    return truth


def spectrum(scene: Scene, k: int, filtered: bool = True, without: int | None = None) -> np.ndarray:
    """Of an axis's stationary noise; as if there were no filter, or without one of the resonances."""
    a, f, rate = scene.truth[k], scene.f, scene.rate
    f_of = scene.filter_of(k) if filtered else None
    slow = np.zeros_like(f)
    for letter, c in a.slow.items():
        slow[1:] += c**2 * term_variances(letter, scene.n, rate, a.T_c)
    if f_of:
        grid = np.linspace(0.0, rate / 2.0, 4096)
        slow *= np.interp(f, grid, f_of.power(grid))
    total = slow + a.N**2 * (f_of.white_spectrum(f) if f_of else rate)
    for i, (resonance, rms) in enumerate(scene.resonances):
        if k in rms and i != without:
            total += rms[k] ** 2 * resonance.spectrum(f, filtered)
    return total


def noise(scene: Scene, k: int, envelope: np.ndarray | None) -> np.ndarray:
    """White and slow noise of an axis; the white one times an envelope."""
    a, n, rate, rng = scene.truth[k], scene.n, scene.rate, scene.rng
    f_of = scene.filter_of(k)
    white = a.N * (f_of.white(rng, n) if f_of else np.sqrt(rate) * rng.standard_normal(n))
    slow = np.zeros(n)
    for letter, c in a.slow.items():
        slow += c * term_noise(letter, n, rate, rng, a.T_c)
    if f_of and a.slow:
        slow = f_of.slow(slow)
    return slow + (white if envelope is None else white * envelope)
