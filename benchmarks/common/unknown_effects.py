"""Static records that hide an effect which no vocabulary of sensor errors has; from NumPy and SciPy alone.

The noise is that of a chain of filters: white noise, a sum of first-order processes at every octave, and a
random walk. An effect's multiple is its amplitude over that at which a detector that knows everything else
expects a log-likelihood ratio of 12.5 (see hidden_sensors).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from scipy.optimize import brentq
from scipy.signal import butter, freqz, lfilter, sosfilt, sosfreqz

from benchmarks.common.hidden_sensors import DETECTABLE_LLR, DETECTABLE_SNR, power_limit, solve

# Standard deviation of the white noise [rad/s], and seconds over which the filters settle.
_WHITE, _LEAD = 1e-3, 60.0


@dataclasses.dataclass(frozen=True)
class Unknown:
    """A record [rad/s] and what is hidden in it.

    Attributes:
        domain: where it shows: "time", "frequency", "level" over time, or "values".
        span: start and end [s or Hz]; the whole record if it has no place of its own.
        near: causes of the vocabulary that describe it rightly, if not completely.
    """

    values: np.ndarray
    rate: float
    kind: str
    domain: str
    span: tuple[float, float]
    near: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class Scene:
    """What effects are made from: noise in which they hide, its white part, and its spectrum."""

    rng: np.random.Generator
    n: int
    rate: float
    white: np.ndarray
    slow: np.ndarray
    power: np.ndarray
    multiple: float

    @property
    def t(self) -> np.ndarray:
        return np.arange(self.n) / self.rate

    @property
    def duration(self) -> float:
        return self.n / self.rate

    @property
    def noise(self) -> np.ndarray:
        return self.white + self.slow

    def path(self, shape: np.ndarray) -> np.ndarray:
        """A known path of the wanted size."""
        energy = 2.0 * np.sum(abs(np.fft.rfft(shape - shape.mean())[1:]) ** 2 / self.power) / self.n
        return self.multiple * DETECTABLE_SNR / np.sqrt(energy) * shape

    def amplitude(self, ratio: np.ndarray) -> float:
        """Amplitude of noise, or of a level, of which the power is so many times that of the rest."""
        return self.multiple * float(np.sqrt(power_limit(ratio, self.n / len(ratio))))

    def added(self, sos: np.ndarray) -> np.ndarray:
        """Filtered white noise of the wanted size."""
        frequency = np.fft.rfftfreq(self.n)[1:] * 2.0 * np.pi
        power = abs(sosfreqz(sos, frequency)[1]) ** 2
        lead = int(_LEAD * self.rate)
        noise = sosfilt(sos, self.rng.standard_normal(lead + self.n))[lead:]
        return self.amplitude(power / self.power) * noise

    def louder(self, log: np.ndarray) -> np.ndarray:
        """The noise with a white level that varies as exp(a·log)."""

        log = log - log.mean()
        a = self.multiple * solve(lambda a: 0.5 * np.sum(np.expm1(2.0 * a * log) - 2.0 * a * log))
        return self.slow + self.white * np.exp(a * log)

    def bent(self, curve: Callable[[np.ndarray, float], np.ndarray], known: float) -> np.ndarray:
        """The noise with white values bent by a curve; the LLR of a small bend a is known·a²·n."""
        x = curve(self.white / _WHITE, self.multiple * np.sqrt(DETECTABLE_LLR / (known * self.n)))
        return self.slow + _WHITE * (x - x.mean()) / x.std()


Made = tuple[np.ndarray, str, tuple[float, float], tuple[str, ...]]


def nothing(s: Scene) -> Made:
    return s.noise, "", (0.0, 0.0), ()


def ramped_step(s: Scene) -> Made:
    start, length = s.rng.uniform(0.2, 0.6) * s.duration, s.rng.uniform(0.1, 0.25) * s.duration
    shape = np.clip((s.t - start) / length, 0.0, 1.0)
    return s.noise + s.path(shape), "time", (start, start + length), ("bias_step",)


def chirp(s: Scene) -> Made:
    low, high = s.rng.uniform(2.0, 5.0), s.rng.uniform(10.0, 20.0)
    phase = 2.0 * np.pi * (low * s.t + 0.5 * (high - low) * s.t**2 / s.duration)
    return s.noise + s.path(np.sin(phase)), "frequency", (low, high), ()


def sawtooth(s: Scene) -> Made:
    period = s.duration / s.rng.uniform(8.0, 30.0)
    shape = (s.t / period + s.rng.random()) % 1.0
    return s.noise + s.path(shape), "time", (0.0, s.duration), ("sinusoid",)


def sigma_delta(s: Scene) -> Made:
    shaped = np.diff(s.rng.standard_normal(s.n + 2), 2)
    power = (2.0 * np.sin(np.pi * np.fft.rfftfreq(s.n)[1:])) ** 4
    return s.noise + s.amplitude(power / s.power) * shaped, "frequency", (0.2 * s.rate, 0.5 * s.rate), ()


def band_noise(s: Scene) -> Made:
    low = s.rng.uniform(5.0, 20.0)
    band = low, low * s.rng.uniform(1.2, 1.5)
    sos = butter(6, band, "bandpass", fs=s.rate, output="sos")
    return s.noise + s.added(sos), "frequency", band, ("resonance",)


def notch(s: Scene) -> Made:
    low = s.rng.uniform(8.0, 25.0)
    band = low, low * s.rng.uniform(1.15, 1.4)
    share = (band[1] - band[0]) / (0.5 * s.rate)
    # Of a band whose power is 1−d of what it was.
    depth = brentq(lambda d: -0.5 * share * s.n / 2.0 * (d + np.log1p(-d)) - DETECTABLE_LLR, 1e-6, 1.0 - 1e-9)
    ba = butter(4, band, "bandstop", fs=s.rate)
    mixed = min(1.0, s.multiple * depth)
    return s.noise + mixed * (lfilter(*ba, s.white) - s.white), "frequency", band, ()


def modulated_line(s: Scene) -> Made:
    f, period = s.rng.uniform(5.0, 30.0), s.rng.uniform(5.0, 30.0)
    level = 1.0 + np.sin(2.0 * np.pi * s.t / period + s.rng.uniform(0.0, 6.0))
    return (
        s.noise + s.path(level * np.sin(2.0 * np.pi * f * s.t)),
        "frequency",
        (f - 1.1 / period, f + 1.1 / period),
        ("sinusoid",),
    )


def breathing(s: Scene) -> Made:
    log = np.sin(2.0 * np.pi * (s.rng.uniform(3.0, 9.0) * s.t / s.duration + s.rng.random()))
    return s.louder(log), "level", (0.0, s.duration), ()


def skewed(s: Scene) -> Made:
    return s.bent(lambda x, a: x + a * (x**2 - 1.0), 3.0), "values", (0.0, s.duration), ()


def soft_clipping(s: Scene) -> Made:
    return (
        s.bent(lambda x, a: np.tanh(x * (k := np.sqrt(3.0 * a))) / k, 12.0),
        "values",
        (0.0, s.duration),
        ("saturation",),
    )


def bump(s: Scene) -> Made:
    middle, width = s.rng.uniform(0.25, 0.75) * s.duration, s.rng.uniform(0.03, 0.1) * s.duration
    shape = np.exp(-0.5 * ((s.t - middle) / width) ** 2)
    return s.noise + s.path(shape), "time", (middle - 2.0 * width, middle + 2.0 * width), ()


def relaxations(s: Scene) -> Made:
    shocks = (s.rng.random(s.n) < 8.0 / s.n) * s.rng.exponential(1.0, s.n)
    shocks[int(s.n * s.rng.uniform(0.1, 0.8))] += 2.0
    decay = np.exp(-1.0 / (s.rate * s.rng.uniform(5.0, 40.0)))
    return s.noise + s.path(lfilter([1.0], [1.0, -decay], shocks)), "time", (0.0, s.duration), ()


def tone_burst(s: Scene) -> Made:
    start, length, f = s.rng.uniform(0.1, 0.6) * s.duration, 0.3 * s.duration, s.rng.uniform(3.0, 40.0)
    inside = (s.t >= start) & (s.t < start + length)
    shape = inside * np.sin(2.0 * np.pi * f * s.t)
    return s.noise + s.path(shape), "frequency", (f - 0.1, f + 0.1), ("sinusoid", "disturbance")


def echo(s: Scene) -> Made:
    lag = int(s.rng.integers(4, 12))
    # The spectrum is multiplied by 1 + 2a·cos: an LLR of a²·n/2.
    a = min(s.multiple * np.sqrt(2.0 * DETECTABLE_LLR / s.n), 0.9)
    white = s.white + a * np.roll(s.white, lag)
    return s.slow + white / np.sqrt(1.0 + a * a), "frequency", (0.0, 0.5 * s.rate), ()


def shelf(s: Scene) -> Made:
    f = s.rng.uniform(4.0, 15.0)
    sos = butter(2, f, "highpass", fs=s.rate, output="sos")
    return s.noise + s.added(sos), "frequency", (0.5 * f, 2.0 * f), ()


def wandering_line(s: Scene) -> Made:
    f = s.rng.uniform(5.0, 30.0)
    decay = np.exp(-1.0 / (20.0 * s.rate))
    away = lfilter([np.sqrt(1.0 - decay**2)], [1.0, -decay], s.rng.standard_normal(s.n + 10**4))[10**4 :]
    phase = 2.0 * np.pi * np.cumsum(f + 0.3 * away) / s.rate
    return s.noise + s.path(np.sin(phase)), "frequency", (f - 0.6, f + 0.6), ("resonance", "sinusoid")


def gated(s: Scene) -> Made:
    period, on = s.rng.uniform(20.0, 60.0), s.rng.uniform(0.1, 0.3)
    log = ((s.t / period + s.rng.random()) % 1.0 < on).astype(float)
    return s.louder(log), "level", (0.0, s.duration), ()


def growing(s: Scene) -> Made:
    return s.louder(s.rng.choice([-1.0, 1.0]) * s.t / s.duration), "level", (0.0, s.duration), ()


def heavy_tails(s: Scene) -> Made:
    return s.bent(lambda x, a: x + a * (x**3 - 3.0 * x), 12.0), "values", (0.0, s.duration), ()


def crossover(s: Scene) -> Made:
    return s.bent(lambda x, a: x - a * np.sign(x) * np.exp(-abs(x)), 0.1), "values", (0.0, s.duration), ()


def square_wave(s: Scene) -> Made:
    wave = np.sign(np.sin(2.0 * np.pi * s.t * s.rng.uniform(10.0, 40.0) / s.duration))
    return s.noise + s.path(wave), "time", (0.0, s.duration), ("sinusoid",)


def broken_line(s: Scene) -> Made:
    f, jump = s.rng.uniform(3.0, 40.0), s.rng.uniform(0.3, 0.7) * s.duration
    shape = np.sin(2.0 * np.pi * f * s.t + np.where(s.t > jump, s.rng.uniform(1.5, 4.0), 0.0))
    return s.noise + s.path(shape), "frequency", (f - 0.1, f + 0.1), ("sinusoid",)


def fading_line(s: Scene) -> Made:
    f = s.rng.uniform(3.0, 40.0)
    shape = np.exp(-s.t / (s.rng.uniform(0.1, 0.4) * s.duration)) * np.sin(2.0 * np.pi * f * s.t)
    return s.noise + s.path(shape), "frequency", (f - 0.1, f + 0.1), ("sinusoid", "resonance")


def ring_downs(s: Scene) -> Made:
    f, quality = s.rng.uniform(5.0, 30.0), s.rng.uniform(10.0, 40.0)
    shocks = (s.rng.random(s.n) < 60.0 / s.n) * s.rng.standard_normal(s.n)
    pole = np.exp(2.0 * np.pi * f / s.rate * (1j - 0.5 / quality))
    shape = lfilter([1.0], [1.0, -2.0 * pole.real, abs(pole) ** 2], shocks)
    near = ("resonance", "sinusoid", "disturbance")
    return s.noise + s.path(shape), "frequency", (f * (1.0 - 1.0 / quality), f * (1.0 + 1.0 / quality)), near


def plateau(s: Scene) -> Made:
    low = s.rng.uniform(1.0, 4.0)
    band = low, s.rng.uniform(4.0, 8.0) * low
    sos = butter(2, band, "bandpass", fs=s.rate, output="sos")
    return s.noise + s.added(sos), "frequency", band, ("resonance",)


def settling_level(s: Scene) -> Made:
    log = np.exp(-s.t / (s.rng.uniform(0.1, 0.3) * s.duration))
    return s.louder(log), "level", (0.0, 0.6 * s.duration), ()


def wandering_level(s: Scene) -> Made:
    decay = np.exp(-1.0 / (s.rng.uniform(0.02, 0.1) * s.n))
    log = lfilter([1.0], [1.0, -decay], s.rng.standard_normal(4 * s.n))[3 * s.n :]
    return s.louder(log / log.std()), "level", (0.0, s.duration), ()


def switching_level(s: Scene) -> Made:
    switches = np.cumsum(s.rng.random(s.n) < s.rng.uniform(8.0, 30.0) / s.n) % 2
    return s.louder(switches.astype(float)), "level", (0.0, s.duration), ()


def one_sided(s: Scene) -> Made:
    return (
        s.bent(lambda x, a: x - a * np.maximum(x, 0.0) ** 2, 0.75),
        "values",
        (0.0, s.duration),
        ("saturation",),
    )


def light_tails(s: Scene) -> Made:
    return (
        s.bent(lambda x, a: np.arcsinh(x * (k := np.sqrt(6.0 * a))) / k, 12.0),
        "values",
        (0.0, s.duration),
        (),
    )


def staircase(s: Scene) -> Made:
    edges = np.sort(s.rng.uniform(0.05, 0.95, s.rng.integers(4, 9))) * s.duration
    return (
        s.noise + s.path(np.searchsorted(edges, s.t).astype(float)),
        "time",
        (0.0, s.duration),
        ("bias_step",),
    )


def s_shape(s: Scene) -> Made:
    middle, length = s.rng.uniform(0.35, 0.65) * s.duration, s.rng.uniform(0.03, 0.1) * s.duration
    shape = np.tanh((s.t - middle) / length)
    return s.noise + s.path(shape), "time", (middle - 2.0 * length, middle + 2.0 * length), ("bias_step",)


def pulse_train(s: Scene) -> Made:
    period, width = s.rng.uniform(40.0, 120.0), s.rng.uniform(2.0, 8.0)
    return s.noise + s.path(1.0 * (s.t % period < width)), "time", (0.0, s.duration), ("sinusoid",)


def doublet(s: Scene) -> Made:
    middle, length = s.rng.uniform(0.2, 0.8) * s.duration, s.rng.uniform(0.01, 0.05) * s.duration
    u = (s.t - middle) / length
    return s.noise + s.path(u * np.exp(-(u**2))), "time", (middle - 2.0 * length, middle + 2.0 * length), ()


def hopping_line(s: Scene) -> Made:
    f, hop = np.sort(s.rng.uniform(4.0, 40.0, 4)), s.rng.uniform(30.0, 120.0)
    which = s.rng.integers(0, 4, int(s.duration / hop) + 1)[(s.t / hop).astype(int)]
    shape = np.sin(2.0 * np.pi * np.cumsum(f[which]) / s.rate)
    return s.noise + s.path(shape), "frequency", (f[which].min(), f[which].max()), ("sinusoid", "resonance")


def repeating_noise(s: Scene) -> Made:
    period = int(s.rng.uniform(0.2, 2.0) * s.rate)
    shape = np.resize(s.rng.standard_normal(period), s.n)
    return s.noise + s.path(shape), "frequency", (s.rate / period, 0.5 * s.rate), ("sinusoid",)


def tilt(s: Scene) -> Made:
    # A chain of pairs of poles and zeros, an octave apart each: the spectrum rises or falls by a power.
    white, a = s.white, min(s.multiple * np.sqrt(DETECTABLE_LLR / s.n), 0.2) * s.rng.choice([-1.0, 1.0])
    for f in 0.4 * 2.0 ** -np.arange(1.0, 11.0):
        pole, zero = (np.exp(-2.0 * np.pi * f * 2.0 ** (side * a)) for side in (-0.5, 0.5))
        white = lfilter([1.0, -zero], [1.0, -pole], white)
    return s.slow + white, "frequency", (0.0, 0.5 * s.rate), ("power_law", "low_pass", "markov")


def bursts(s: Scene) -> Made:
    log, length = np.zeros(s.n), int(s.rng.uniform(1.0, 4.0) * s.rate)
    for start in s.rng.integers(0, s.n - length, 30):
        log[start : start + length] = 1.0
    return s.louder(log), "level", (0.0, s.duration), ()


def ramping_level(s: Scene) -> Made:
    return s.louder((s.t / s.duration * s.rng.uniform(1.5, 4.0)) % 1.0), "level", (0.0, s.duration), ()


def dead_zone(s: Scene) -> Made:
    return s.bent(lambda x, a: x - a * x * np.exp(-(x**2)), 0.16), "values", (0.0, s.duration), ()


def siren(s: Scene) -> Made:
    f, reach, period = s.rng.uniform(8.0, 35.0), s.rng.uniform(0.5, 3.0), s.rng.uniform(20.0, 60.0)
    phase = 2.0 * np.pi * f * s.t - reach * period * np.cos(2.0 * np.pi * s.t / period)
    near = ("sinusoid", "resonance")
    return s.noise + s.path(np.sin(phase)), "frequency", (f - reach, f + reach), near


def ticks(s: Scene) -> Made:
    period = int(s.rng.uniform(3.0, 20.0) * s.rate)
    near = ("outliers", "sinusoid")
    return s.noise + s.path(1.0 * (np.arange(s.n) % period == 0)), "values", (0.0, s.duration), near


def three_levels(s: Scene) -> Made:
    jumps = np.cumsum(s.rng.random(s.n) < s.rng.uniform(10.0, 25.0) / s.n)
    level = np.cumsum(np.append(0, s.rng.integers(1, 3, jumps[-1]))) % 3
    return s.noise + s.path(1.0 * level[jumps]), "time", (0.0, s.duration), ("bias_step",)


def rippled_codes(s: Scene) -> Made:
    return s.bent(lambda x, a: x + a * np.sin(3.0 * x), 2.5), "values", (0.0, s.duration), ()


def two_pieces(s: Scene) -> Made:
    # The mean explains a third of it.
    return s.bent(lambda x, a: x * (1.0 + a * np.sign(x)), 0.68), "values", (0.0, s.duration), ()


def kink(s: Scene) -> Made:
    start = s.rng.uniform(0.3, 0.8) * s.duration
    return s.noise + s.path(np.maximum(s.t - start, 0.0)), "time", (start, s.duration), ("drift_ramp",)


def damped_swing(s: Scene) -> Made:
    start, length = s.rng.uniform(0.1, 0.7) * s.duration, s.rng.uniform(0.02, 0.06) * s.duration
    u = np.maximum(s.t - start, 0.0) / length
    shape = np.exp(-u) * np.sin(2.0 * np.pi * u / 1.5)
    return s.noise + s.path(shape), "time", (start, start + 3.0 * length), ()


def swelling(s: Scene) -> Made:
    middle, width = s.rng.uniform(0.25, 0.75) * s.duration, s.rng.uniform(0.03, 0.1) * s.duration
    log = np.exp(-0.5 * ((s.t - middle) / width) ** 2)
    near = ("variance_change", "disturbance")
    return s.louder(log), "level", (middle - 2.0 * width, middle + 2.0 * width), near


def ac_coupled(s: Scene) -> Made:
    f = s.rng.uniform(2.0, 8.0)
    share = f / (0.5 * s.rate)
    # As of a notch: of the lowest band, whose power is 1−d of what it was.
    depth = brentq(lambda d: -0.5 * share * s.n / 2.0 * (d + np.log1p(-d)) - DETECTABLE_LLR, 1e-6, 1.0 - 1e-9)
    ba, mixed = butter(2, f, "highpass", fs=s.rate), min(1.0, s.multiple * depth)
    return s.noise + mixed * (lfilter(*ba, s.white) - s.white), "frequency", (0.0, f), ()


def keyed_line(s: Scene) -> Made:
    f = s.rng.uniform(3.0, 40.0)
    on = np.cumsum(s.rng.random(s.n) < s.rng.uniform(40.0, 200.0) / s.n) % 2
    near = ("sinusoid", "resonance")
    return s.noise + s.path(on * np.sin(2.0 * np.pi * f * s.t)), "frequency", (f - 0.2, f + 0.2), near


#: Kinds on which the critic's rules were made, and kinds kept for reports.
MADE_ON = (
    *(ramped_step, chirp, sawtooth, sigma_delta, band_noise, notch, modulated_line, breathing, skewed),
    *(soft_clipping, bump, relaxations, tone_burst, echo, shelf, wandering_line, gated, growing),
    *(heavy_tails, crossover, square_wave, broken_line, fading_line, ring_downs, plateau, settling_level),
    *(wandering_level, switching_level, one_sided, light_tails, staircase, s_shape, pulse_train, doublet),
    *(hopping_line, repeating_noise, tilt, bursts, ramping_level, dead_zone),
)
KEPT = (
    *(siren, ticks, three_levels, rippled_codes, two_pieces, kink, damped_swing, swelling, ac_coupled),
    keyed_line,
)
KINDS: dict[str, Callable[[Scene], Made]] = {f.__name__: f for f in (*MADE_ON, *KEPT, nothing)}


def draw(kind: str, seed: int, multiple: float, duration: float = 1200.0, rate: float = 100.0) -> Unknown:
    """A record with an effect of a kind; the same for the same arguments."""
    rng = np.random.default_rng([seed, list(KINDS).index(kind)])
    n, lead = int(duration * rate), int(_LEAD * rate)
    white = _WHITE * rng.standard_normal(n)
    angle = 2.0 * np.pi * np.fft.rfftfreq(n)[1:]
    slow, power = np.zeros(n), np.full(len(angle), _WHITE**2)
    # One over f, from octave to octave, and a random walk below it.
    level = _WHITE * 10.0 ** rng.uniform(-2.3, -1.5)
    for time in 2.0 ** np.arange(2.0, np.log2(n)):
        b, a = [level * np.sqrt(2.0 / time)], [1.0, -np.exp(-1.0 / time)]
        slow += lfilter(b, a, rng.standard_normal(n + lead))[lead:]
        power += abs(freqz(b, a, angle)[1]) ** 2
    walk = 2.0 * np.pi * _WHITE / (n * rng.uniform(0.02, 0.5))
    slow += walk * np.cumsum(rng.standard_normal(n))
    power += walk**2 / (2.0 * np.sin(0.5 * angle)) ** 2
    values, domain, span, near = KINDS[kind](Scene(rng, n, rate, white, slow, power, multiple))
    return Unknown(values, rate, kind, domain, span, near)
