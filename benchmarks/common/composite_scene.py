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
from scipy.fft import dct
from scipy.optimize import brentq

from benchmarks.common.composite_noise import (
    Filter,
    Resonance,
    exponential,
    exponential_spectrum,
    flicker,
    flicker_spectrum,
    frequencies,
    walk,
    walk_spectrum,
)
from benchmarks.common.hidden_sensors import log_uniform

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
    if a.K:
        slow += a.K**2 * walk_spectrum(f, rate)
    if a.flicker_corner:
        slow += a.N**2 * a.flicker_corner * flicker_spectrum(f, rate)
    if a.T_c:
        slow += a.q_c**2 * a.T_c / 2.0 * exponential_spectrum(f, rate, 1.0 / (rate * a.T_c))
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
    if a.K:
        slow += a.K * walk(rng, n, rate)
    if a.flicker_corner:
        slow += a.N * np.sqrt(a.flicker_corner) * flicker(rng, n, rate)
    if a.T_c:
        slow += a.q_c * np.sqrt(a.T_c / 2.0) * exponential(rng, n, 1.0 / (rate * a.T_c))
    if f_of and (a.K or a.flicker_corner or a.T_c):
        slow = f_of.slow(slow)
    return slow + (white if envelope is None else white * envelope)
