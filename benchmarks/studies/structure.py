"""Does `fit` find the filter, the resonances and the lines of a sensor, and are its numbers right then?

Sensors are drawn by seed and simulated by NumPy and SciPy alone: 2^16.5 to 2^19 samples at 100, 200 or 400 Hz
of white noise N, flicker noise (a sum of first-order processes) and in half of them a random walk, before a
filter of 6 to 35 % of the sample rate or none; up to four damped oscillators, read at the samples, before or
after the filter, of quality 4 to 80 and peaks of 3 to 30 times the white level; a line in half of them; white
noise after the filter in 60 % of those with one. Resonances and line are a factor of 1.4 apart.

*Structure*: a filter where there is one and none elsewhere, and as many resonances and lines, each within 5 %
of its frequency. *N*: within 5 %, or two of its standard deviations. *N covered*: by its 95 % interval.
*Allan deviation*: at all octaves up to a hundredth of the record within 5 % of the true one (of the analytic
spectrum, by quadrature) or two standard deviations of an estimate from such a record. *Slow*: a Markov
process or random walk that is not there.

Known filters: no resonance, no line; in half of the records the integral is rounded to 0.5 to 2 standard
deviations of its steps. *Told*: of those not rounded, quantization is detected; *found*: of those rounded, it
is, and Q is within 10 % or two standard deviations. A record without a result has nothing right.
"""

from __future__ import annotations

import time
import traceback
from collections.abc import Iterator
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
from scipy.signal import butter, freqz, lfilter

import allanjax as aj
from allanjax.estimate.spectral import fit as joint
from allanjax.estimate.spectral import model as search
from benchmarks.common.composite_scene import oscillator as biquad
from benchmarks.common.hidden_sensors import log_uniform
from benchmarks.common.study import run_tasks, share, table

QUICK: dict[str, Any] = {"axes": 1, "known": 0}
KINDS = ("none", "one pole", "two poles", "Butterworth 2", "Butterworth 3", "Butterworth 4", "moving average")
KNOWN = ("moving average", "one pole", "two poles", "Butterworth 2", "biquad")
#: Distance of frequencies in ln; samples before a record begins; frequencies of the quadrature.
APART, SETTLING, GRID = 0.35, 5000, 1 << 19
NEAR, NEAR_ROUNDING, WANTED = 0.05, 0.10, ("≥ 0.90", "≥ 0.97", "0.93 … 0.97", "≥ 0.95", "≤ 0.02")

Section = tuple[np.ndarray, np.ndarray]
PASSED: Section = np.ones(1), np.ones(1)


class Part(NamedTuple):
    """White noise of variance `power` behind a section; its first value is `start` times as large."""

    power: float
    section: Section = PASSED
    start: float = 1.0


class Sensor(NamedTuple):
    """What a sensor consists of; frequencies in Hz, a line with its amplitude, 0 if there is none."""

    kind: str
    rate: float
    n: int
    N: float
    K: float
    response: Section
    inside: list[Part]
    outside: list[Part]
    resonances: np.ndarray
    line: tuple[float, float]

    def samples(self, rng: np.random.Generator) -> np.ndarray:
        def drawn(parts: list[Part]) -> np.ndarray:
            white = rng.standard_normal((len(parts), SETTLING + self.n))
            white[:, 0] *= [part.start for part in parts]
            return sum(np.sqrt(p.power) * lfilter(*p.section, w) for p, w in zip(parts, white, strict=True))

        x = lfilter(*self.response, drawn(self.inside)) + drawn(self.outside)
        cycles = self.line[0] * np.arange(self.n) / self.rate + rng.random()
        return x[SETTLING:] + self.line[1] * np.cos(2.0 * np.pi * cycles)

    def allan(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Cluster sizes, Allan deviations, and the degrees of freedom of their estimates' squares."""
        w = np.pi * (np.arange(GRID) + 0.5) / GRID
        S = sum(p.power * power_of(p.section, w) for p in self.inside) * power_of(self.response, w)
        S += sum(p.power * power_of(p.section, w) for p in self.outside)
        sizes, squares, degrees = 2 ** np.arange((self.n // 100).bit_length()), [], []
        for m in sizes:
            angles = w / 2.0, np.pi * self.line[0] / self.rate
            gain, of_line = (np.sin(m * a) ** 4 / (m * np.sin(a)) ** 2 for a in angles)
            squares.append(2.0 * np.mean(S * gain) + self.line[1] ** 2 * of_line)
            degrees.append(self.n * np.mean(S * gain) ** 2 / np.mean((S * gain) ** 2))
        return sizes, np.sqrt(squares), np.array(degrees)


def power_of(section: Section, w: np.ndarray) -> np.ndarray:
    """Power response at frequencies [radians per sample]."""
    return np.abs(freqz(*section, worN=w)[1]) ** 2


def damped(w: float, quality: float) -> Section:
    """From white noise of variance 1 the samples of an oscillator of variance 1, by its autocovariance."""
    decay = w / (2.0 * quality)
    wd = np.sqrt(w * w - decay * decay)
    q, c = np.exp(-decay + 1j * wd), 1.0 - 1j * decay / wd
    a = np.poly([q, q.conjugate()]).real
    # The autocovariance of the numerator is b0² + b1² and b0·b1; that of the samples Re[c q^|d|].
    own, lags = np.convolve(a, a[::-1]), np.arange(-2, 3)
    zero, one = (float(np.sum(own * np.real(c * q ** np.abs(k - lags)))) for k in (0, 1))
    both, apart = np.sqrt(zero + 2.0 * one), np.sqrt(zero - 2.0 * one)
    return np.array([both + apart, both - apart]) / 2.0, a


def filter_of(kind: str, w: float, quality: float) -> Section:
    """Filter of a kind, 1 at frequency zero, of a bandwidth in radians per sample."""
    if kind == "one pole":
        return np.array([-np.expm1(-w)]), np.array([1.0, -np.exp(-w)])
    if kind == "two poles":
        b, a = damped(w, np.sqrt(0.5))
        return b * a.sum() / b.sum(), a
    if kind == "moving average":
        # Of two samples it is a Butterworth filter, and with quantization a shorter mean.
        m = max(3, round(0.443 * 2.0 * np.pi / w))
        return np.full(m, 1.0 / m), np.ones(1)
    if kind == "biquad":
        return biquad(w, quality, 2.0 * np.pi)
    return PASSED if kind == "none" else butter(int(kind[-1]), w / np.pi)


def basic_parts(rng: np.random.Generator, N: float, K: float, n: int, rate: float) -> list[Part]:
    """White noise, flicker noise B²/(2πf) of 0.015 to 0.15 N·√Hz, and a random walk."""
    parts = [Part(N * N * rate), Part(K * K / rate, (np.ones(1), np.array([1.0, -1.0])))]
    B, step = N * log_uniform(rng, 0.015, 0.15), 1.15
    for a in np.exp(-np.exp(-np.arange(step, np.log(n) + step, step))):
        # ∫ 2T/(1 + (2πfT)²) d ln T = 1/(2f): of so many processes of variance 1 it consists.
        section, rest = (np.ones(1), np.array([1.0, -a])), 1.0 - a * a
        parts.append(Part(B * B * step / np.pi * rest, section, 1.0 / np.sqrt(rest)))
    return parts


def drawn_sensor(rng: np.random.Generator, known: str = "") -> tuple[Sensor, np.ndarray]:
    """Any sensor, or one with a known filter, no resonance and no line; and its samples."""
    n, rate = int(2.0 ** rng.uniform(16.5, 19.0)), float(rng.choice([100.0, 200.0, 400.0]))
    N, kind = log_uniform(rng, 3e-5, 1e-3), known or str(rng.choice(KINDS))
    K = N * log_uniform(rng, 1e-3, 1e-2) * (rng.random() < 0.5)
    response = filter_of(kind, 2.0 * np.pi * rng.uniform(0.06, 0.35), log_uniform(rng, 0.55, 2.0))
    parts, f = (basic_parts(rng, N, K, n, rate), []), np.zeros(2)
    count, lines = (0, 0) if known else rng.integers([5, 2])
    while (np.diff(np.sort(f)) < APART).any():
        f = rng.uniform(np.log(0.0126), np.log(0.42), count + lines)
    f = rate * np.exp(f)
    for w in 2.0 * np.pi / rate * f[:count]:
        section = damped(w, log_uniform(rng, 4.0, 80.0))
        power = N * N * rate * log_uniform(rng, 3.0, 30.0) / power_of(section, np.array([w]))[0]
        parts[rng.integers(2)].append(Part(power, section))
    after = 0.0 if known or kind == "none" or rng.random() < 0.4 else N * log_uniform(rng, 0.01, 0.1)
    parts[1].append(Part(after**2 * rate))
    # A line's gain in likelihood [nats] is n·amplitude²/4 over the variance of white noise.
    amplitude = 2.0 * N * np.sqrt(rate * log_uniform(rng, 300.0, 3000.0) / n) * lines
    line = f[-1] if lines else rate / 4.0, amplitude
    sensor = Sensor(kind, rate, n, np.hypot(N, after), K, response, *parts, f[:count], line)
    return sensor, sensor.samples(rng)


def fitted(x: np.ndarray, rate: float) -> aj.AxisFit | None:
    """None where there is no result; an exception is printed."""
    aj.enable_compilation_cache()
    recording = aj.Recording.from_array(x[:, None], rate, gyro_unit="rad/s", names=["gyro_x"])
    try:
        axis = aj.fit(recording, as_is=True, vibrating=True)["gyro_x"]
    except Exception:
        return traceback.print_exc()
    return axis if axis.converged else None


def is_near(c: Any, truth: float, near: float) -> bool:
    return abs(c.value - truth) < max(near * truth, 2.0 * c.std)


def outcome(seed: int) -> tuple[str, list[float]]:
    """Kind of the filter; structure, N, its interval, Allan deviation, slow terms; seconds, joint fits."""
    sensor, x = drawn_sensor(np.random.default_rng(seed))
    begun, fits = time.process_time(), joint.maximize
    with patch.object(joint, "maximize", wraps=fits) as a, patch.object(search, "maximize", wraps=fits) as b:
        axis = fitted(x, sensor.rate)
    cost = [time.process_time() - begun, float(a.call_count + b.call_count)]
    if axis is None:
        return sensor.kind, [0.0, 0.0, 0.0, 0.0, 0.0, *cost]
    model = axis.model
    found = sorted((t.deterministic, float(t.frequency)) for t in model if hasattr(t, "frequency"))
    truth = [(False, f) for f in np.sort(sensor.resonances)] + [(True, sensor.line[0])] * bool(sensor.line[1])
    right = (model.response is None) == (sensor.kind == "none")
    right = right and len(found) == len(truth) and np.allclose(found, truth, rtol=NEAR)
    sizes, true, degrees = sensor.allan()
    deviation = np.sqrt(np.asarray(model.sampled(sensor.rate).allan_variance(sizes / sensor.rate)))
    off = np.abs(deviation / true - 1.0) < np.maximum(NEAR, np.sqrt(2.0 / degrees))
    absent = ("markov", "rate_random_walk")[: 1 if sensor.K else 2]
    slow = any(c.detected and c.label.startswith(absent) for c in axis.coefficients.values())
    N = axis["angle_random_walk"]
    covered = N.interval[0] <= sensor.N <= N.interval[1]
    shares = right, is_near(N, sensor.N, NEAR), covered, off.all(), slow
    return sensor.kind, [*map(float, shares), *cost]


def rounded_outcome(kind: str, rounded: bool, seed: int) -> bool:
    """Whether quantization is detected, and near its value if there is some."""
    rng = np.random.default_rng(seed)
    sensor, x = drawn_sensor(rng, kind)
    step = x.std() / sensor.rate * log_uniform(rng, 0.5, 2.0)
    if rounded:
        x = sensor.rate * np.diff(step * np.round(np.cumsum(x) / sensor.rate / step))
    if (axis := fitted(x, sensor.rate)) is None:
        return not rounded
    c = axis["quantization"]
    return bool(c.detected and (not rounded or is_near(c, step / np.sqrt(12.0), NEAR_ROUNDING)))


def run(*, axes: int = 64, known: int = 8, seed: int = 18_000) -> Iterator[str]:
    """Known: records of each known filter, rounded and not."""
    outcomes = run_tasks(outcome, [(seed + k,) for k in range(axes)])
    rows = [["wanted", "", *WANTED, "", ""]]
    for name in ("all", *KINDS):
        if len(of := np.array([numbers for kind, numbers in outcomes if name in ("all", kind)])):
            rows.append([name, len(of), *map(share, of[:, :5].T), *np.median(of[:, 5:], axis=0).round(1)])
    head = ["filter", "axes", "structure", "N", "N covered", "Allan deviation", "slow"]
    head += ["processor s", "joint fits"]
    yield f"## Drawn sensors, seeds from {seed} on\n\n{table(head, rows)}"
    tasks = [(kind, r, seed + k) for kind in KNOWN for r in (False, True) for k in range(known)]
    hits = list(zip(tasks, run_tasks(rounded_outcome, tasks), strict=True))
    rows = []
    for name in ("all", *KNOWN):
        of = [[h for t, h in hits if t[1] == r and name in ("all", t[0])] for r in (False, True)]
        rows.append([name, *map(share, of)])
    yield f"## Known filters, {known} records each\n\n" + table(["filter", "told", "found"], rows)
