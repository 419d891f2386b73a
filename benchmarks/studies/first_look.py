"""What does `inspect` see before a fit: false alarms in clean records, what is left of touched ones?

Thresholds were set on clean seeds below 800 and touched seeds below 100; results are of seeds from a million
on. Clean records are of the critic's generator, one axis or three with an effect that is noise, or six axes
at rest with something in all of them by chance, 60 to 3,600 s at 50 to 400 Hz.

Touched records: the largest factor, over octaves of cluster time and six axes, between the Allan deviation of
the touched record and that of the same record untouched; before: of all of it, after: of the stretch that
coefficients are of. σ: of the white noise, from sample to sample. An estimate's own scatter at the longest
cluster times makes factors of 1.1 to 1.3.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
import scipy.signal

import allanjax as aj
from benchmarks.common.hidden_effects import SETTLING, Scene, draw, low_pass, resonance
from benchmarks.common.hidden_sensors import GRADES, coloured_noise, draw_sensor, log_uniform, white_std
from benchmarks.common.study import run_tasks, table

QUICK: dict[str, Any] = {"clean": 4, "touched": 1, "kinds": 1, "presets": False}
Array, Generator = np.ndarray, np.random.Generator
NOISY = (
    *(None, "sinusoid", "resonance", "telegraph", "markov", "low_pass", "rounding", "common_mode"),
    *("power_law", "drift_ramp", "bias_instability", "rate_random_walk", "quantization", "angle_random_walk"),
)
EXTRAS = ("nothing", "line", "slow line", "two lines", "resonance", "rounding", "low pass", "telegraph")
UNITS = {"gyro_unit": "rad/s", "accel_unit": "m/s²"}


class Drawn(NamedTuple):
    """Samples [n, axes] in SI, the white deviation of each axis, and what is in them."""

    values: np.ndarray
    rate: float
    names: list[str]
    white: np.ndarray
    label: str

    def recording(self, values: np.ndarray) -> aj.Recording:
        return aj.Recording.from_array(values, self.rate, names=self.names, **UNITS)


# --- Clean records -----------------------------------------------------------------------------------------


def size(rng: Generator) -> tuple[int, float]:
    duration = log_uniform(rng, 60.0, 3600.0)
    rate = log_uniform(rng, 50.0, min(400.0, 300_000 / duration))
    return round(duration * rate), rate


def single(seed: int) -> Drawn:
    """One axis, or three, of the critic's generator, with an effect that is noise."""
    cause = NOISY[seed % len(NOISY)]
    n, rate = size(np.random.default_rng([seed, 5]))
    hidden = draw(seed, cause, duration=n / rate, rate=rate)
    values = hidden.values
    if hidden.sensor["kind"] == "accel" and values.shape[1] == 3:
        # The generator's biases are no gravity: three axes must have some, or none.
        values = values - values.mean(axis=0) + [0.05, -0.05, 9.81]
    white = np.full(values.shape[1], white_std(hidden.sensor, rate))
    return Drawn(values, rate, list(hidden.names), white, cause or "basic terms")


def six(seed: int) -> Drawn:
    """Six axes of one grade, at rest, with something in all of them by chance."""
    rng = np.random.default_rng([seed, 77])
    n, rate = size(rng)
    grade = ("navigation", "tactical", "consumer")[rng.integers(3)]
    columns, white = [], []
    for kind in ("gyro", "accel"):
        drawn = draw_sensor(rng, n / rate, rate)
        while (drawn["kind"], drawn["grade"]) != (kind, grade):
            drawn = draw_sensor(rng, n / rate, rate)
        for axis in "xyz":
            each = {k: v * rng.uniform(0.8, 1.25) if k in "NQBKMR" else v for k, v in drawn.items()}
            x = each["N"] * np.sqrt(rate) * rng.standard_normal(n)
            x += coloured_noise(each, n, rate, rng) + each.get("R", 0.0) * np.arange(n) / rate
            bias = GRADES[kind, grade][1] * rng.uniform(-1.0, 1.0)
            x += bias if kind == "gyro" else 0.001 * bias + 9.81 * (axis == "z")
            columns.append(x)
            white.append(white_std(each, rate))
    label = EXTRAS[rng.integers(len(EXTRAS))]
    values = with_extra(np.stack(columns, 1), label, np.array(white), rate, rng)
    keep = np.ptp(values, axis=0) > 0.0
    names = [f"{kind}_{axis}" for kind in ("gyro", "accel") for axis in "xyz"]
    return Drawn(values[:, keep], rate, list(np.array(names)[keep]), np.array(white)[keep], label)


def with_extra(x: np.ndarray, label: str, white: np.ndarray, rate: float, rng: Generator) -> Array:
    n = len(x)
    t, duration = np.arange(n) / rate, n / rate

    def line(f: float) -> Array:
        return np.sin(2.0 * np.pi * f * t + rng.uniform(0.0, 6.0))

    match label:
        case "line":
            return x + np.outer(line(log_uniform(rng, 1.0, 0.45 * rate)), white) * log_uniform(rng, 0.03, 1.0)
        case "slow line":
            slow = line(log_uniform(rng, 5.0 / duration, 1.0))
            return x + np.outer(slow, white) * log_uniform(rng, 0.01, 0.2)
        case "two lines":
            f = log_uniform(rng, 1.0, 0.4 * rate)
            beat = line(f) + line(f + log_uniform(rng, 3.0 / duration, 0.1))
            return x + np.outer(beat, white) * log_uniform(rng, 0.03, 1.0)
        case "resonance":
            scene = Scene({"N": 1.0}, n, rate, rng, 1.0, np.zeros(1))
            noise = resonance(scene)[0]
            on = rng.random(len(white)) < 0.6
            return x + np.outer(noise / np.std(noise), on * white) * log_uniform(rng, 0.05, 3.0)
        case "rounding":
            steps = white * rng.uniform(0.2, 4.0, len(white))
            return steps * np.round(x / steps)
        case "low pass":
            filtering, _ = low_pass(rate, rng)
            return (scipy.signal.lfilter(*filtering, x - x[0], axis=0) + x[0])[SETTLING:]
        case "telegraph":
            for k, sigma in enumerate(white):
                switches = np.cumsum(rng.exponential(duration / rng.uniform(8.0, 60.0), 400))
                x[:, k] += np.searchsorted(switches, t) % 2 * sigma * log_uniform(rng, 0.01, 0.3)
    return x


# --- Touched records ---------------------------------------------------------------------------------------


def motion(n: int, axes: int, rate: float, rng: Generator) -> Array:
    """Handling, of mean square one: below 8 Hz, and something faster."""
    band = scipy.signal.butter(2, (0.3, min(8.0, 0.4 * rate)), "bandpass", fs=rate, output="sos")
    x = scipy.signal.sosfilt(band, rng.standard_normal((n + round(5 * rate), axes)), axis=0)[-n:]
    return x / np.std(x, axis=0) + 0.3 * rng.standard_normal((n, axes))


def at_ends(x: Array, white: Array, rate: float, rng: Generator, strength: float) -> Array:
    x, which = x.copy(), rng.integers(3)
    for place in ([slice(None)], [slice(None, None, -1)], [slice(None), slice(None, None, -1)])[which]:
        count = round(log_uniform(rng, 1.0, min(20.0, 0.15 * len(x) / rate)) * rate)
        x[place][:count] += white * strength * motion(count, len(white), rate, rng)
    return x


Touch = Callable[[Array, Array, float, Generator], Array]


def knock(x: Array, white: Array, rate: float, rng: Generator) -> Array:
    x, count = x.copy(), max(round(log_uniform(rng, 0.2, 5.0) * rate), 4)
    first = rng.integers(len(x) // 10, 9 * len(x) // 10 - count)
    x[first : first + count] += white * log_uniform(rng, 5.0, 1000.0) * motion(count, len(white), rate, rng)
    return x


def oscillation(x: Array, white: Array, rate: float, rng: Generator) -> Array:
    u = np.arange(len(x)) / rate - rng.uniform(0.1, 0.9) * len(x) / rate
    f, decay = log_uniform(rng, 2.0, 0.4 * rate), log_uniform(rng, 0.1, 3.0)
    path = np.where(u >= 0.0, np.exp(-np.maximum(u, 0.0) / decay) * np.sin(2.0 * np.pi * f * u), 0.0)
    return x + np.outer(path, white * log_uniform(rng, 10.0, 1000.0) * rng.uniform(0.2, 1.0, len(white)))


def spikes(x: Array, white: Array, rate: float, rng: Generator) -> Array:
    x, strength = x.copy(), log_uniform(rng, 50.0, 1e5)
    for _ in range(rng.integers(1, 4)):
        k = rng.integers(len(white))
        x[rng.integers(len(x)), k] += strength * white[k]
    return x


def moved(path: Array, x: Array, white: Array, rng: Generator) -> Array:
    return x + np.outer(path, white * log_uniform(rng, 0.3, 300.0) * rng.standard_normal(len(white)))


def step(x: Array, white: Array, rate: float, rng: Generator) -> Array:
    return moved(np.arange(len(x)) >= len(x) * rng.uniform(0.1, 0.9), x, white, rng)


def tilt(x: Array, white: Array, rate: float, rng: Generator) -> Array:
    first, length = rng.uniform(0.2, 0.6), log_uniform(rng, 0.01, 0.2)
    return moved(np.clip((np.arange(len(x)) / len(x) - first) / length, 0.0, 1.0), x, white, rng)


def warm_up(x: Array, white: Array, rate: float, rng: Generator) -> Array:
    t = np.arange(len(x)) / rate
    return moved(np.exp(-t / log_uniform(rng, 2.0, t[-1] / 5.0)), x, white, rng)


def off(x: Array, white: Array, rate: float, rng: Generator) -> Array:
    return np.where((np.arange(len(x)) < len(x) * rng.uniform(0.7, 0.97))[:, None], x, 0.0)


def louder(x: Array, white: Array, rate: float, rng: Generator) -> Array:
    inside = (np.arange(len(x)) > len(x) * rng.uniform(0.6, 0.8))[:, None]
    return x + inside * rng.standard_normal(x.shape) * white * log_uniform(rng, 0.5, 20.0)


TOUCHES: dict[str, Touch] = {
    "ends, 20–1000 σ": lambda x, w, r, g: at_ends(x, w, r, g, log_uniform(g, 20.0, 1000.0)),
    "ends, 1.5–20 σ": lambda x, w, r, g: at_ends(x, w, r, g, log_uniform(g, 1.5, 20.0)),
    "knock, 5–1000 σ": knock,
    "ringing, 10–1000 σ": oscillation,
    "1–3 values, 50–100 000 σ": spikes,
    "step, 0.3–300 σ": step,
    "tilt, 0.3–300 σ": tilt,
    "warm-up, 0.3–300 σ": warm_up,
    "switched off": off,
    "louder for a third, 0.5–20 σ": louder,
}


def allan(x: np.ndarray) -> Array:
    """Haar Allan deviations [octaves, axes] without overlap, of 16 differences or more."""
    found = []
    while len(x) >= 32:
        even = x[: len(x) // 2 * 2]
        found.append(np.sqrt(np.mean((even[1::2] - even[::2]) ** 2, axis=0) / 2.0))
        x = 0.5 * (even[1::2] + even[::2])
    return np.array(found)


def off_by(x: np.ndarray, reference: np.ndarray) -> float:
    """Largest factor between two sets of Allan deviations."""
    found = allan(x)
    count = min(len(found), len(reference))
    return float(np.exp(np.max(abs(np.log(found[:count] / reference[:count])))))


# --- What is seen ------------------------------------------------------------------------------------------


def run(
    *,
    clean: int = 1000,
    touched: int = 20,
    kinds: int = len(TOUCHES),
    presets: bool = True,
    seed: int = 1_000_000,
) -> Iterator[str]:
    """Touched: records of each of so many kinds."""
    alarms: dict[str, list[str]] = defaultdict(list)
    for label, alarm in run_tasks(alarm_of, [(k,) for k in range(seed, seed + clean)]):
        alarms[label].append(alarm)
    rows = [[k, len(v), sum(map(bool, v)), "; ".join(filter(None, v))] for k, v in sorted(alarms.items())]
    total = sum(row[2] for row in rows)
    yield f"## False alarms: {total} of {clean} clean records"
    yield table(["record", "records", "alarms", "which"], rows)
    if presets:
        parts = [(name, part) for name, p in aj.SENSORS.items() for part in p.simulate(600.0, seed)]
        found = [(name, aj.inspect(part)) for name, part in parts]
        said = [f"{name}: {seen}" for name, seen in found if seen.left_out or not seen.at_rest]
        yield f"{len(found)} records of the presets: {'; '.join(said) or 'no alarm'}."
    names = list(TOUCHES)[:kinds]
    rows = [row for row in run_tasks(after_touching, [(name, seed, touched) for name in names]) if row]
    head = ["touched", "records", "cut", "refused", "before: median", "90 %"]
    head += ["after: median", "90 %", "worst"]
    yield "## Touched records\n\n" + table(head, rows)


def alarm_of(seed: int) -> tuple[str, str]:
    """What a clean record is, and what is said of it."""
    drawn = six(seed) if seed % 2 else single(seed // 2)
    seen, alarm = aj.inspect(drawn.recording(drawn.values)), ""
    if seen.left_out:
        alarm = f"{seen.left_out} ({seed})"
    elif not seen.at_rest:
        alarm = f"not static ({seed})"
    elif alone := seen.about("spikes"):
        alarm = f"{'; '.join(alone)} ({seed})"
    elif any(word in " ".join(seen.warnings) for word in ("-unit", "--rate")):
        alarm = f"unit ({seed})"
    return f"{'six axes' if seed % 2 else 'one axis'}, {drawn.label}", alarm


def after_touching(name: str, first: int, each: int) -> list[str]:
    k, before, after, refused, cut = list(TOUCHES).index(name), [], [np.nan], 0, 0
    for seed in range(first, first + each):
        drawn = six(2 * (seed * len(TOUCHES) + k) + 1)
        x = TOUCHES[name](drawn.values, drawn.white, drawn.rate, np.random.default_rng([seed, k]))
        reference, seen = allan(drawn.values), aj.inspect(drawn.recording(x))
        before.append(off_by(x, reference))
        if seen.refusal:
            refused += 1
            continue
        cut += seen.longest_part is not None
        after.append(off_by(seen.quiet(drawn.recording(x)).values, reference))
    quantiles = [*np.quantile(before, [0.5, 0.9]), *np.nanquantile(after, [0.5, 0.9, 1.0])]
    return [name, str(each), str(cut), str(refused), *(f"{q:.3g}" for q in quantiles)]
