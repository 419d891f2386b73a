"""What is seen in recordings before a fit: false alarms in clean ones, coefficients of touched ones.

python benchmarks/studies/first_look.py [--clean 1000] [--touched 20] [--fits 4] [--results PATH]
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import paths
import scipy.signal

import allanjax as aj
from allanjax.cli.demo_sensor import demo_recording
from allanjax.record.recording import Recording
from benchmarks.common.hidden_effects import SETTLING, Scene, draw, low_pass, resonance
from benchmarks.common.hidden_sensors import GRADES, coloured_noise, draw_sensor, log_uniform, white_std
from benchmarks.common.machine import describe
from benchmarks.common.report import publish, table

#: Thresholds were set on clean seeds below 800 and touched seeds below 100.
FRESH = 1_000_000
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

    def recording(self, values: np.ndarray | None = None) -> Recording:
        return Recording.from_array(
            self.values if values is None else values, self.rate, names=self.names, **UNITS
        )


# --- Clean records -----------------------------------------------------------------------------------------


def size(rng: np.random.Generator) -> tuple[int, float]:
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
    return Drawn(
        values[:, keep],
        rate,
        [m for m, k in zip(names, keep, strict=True) if k],
        np.array(white)[keep],
        label,
    )


def with_extra(
    x: np.ndarray, label: str, white: np.ndarray, rate: float, rng: np.random.Generator
) -> np.ndarray:
    n = len(x)
    t, duration = np.arange(n) / rate, n / rate

    def line(f: float) -> np.ndarray:
        return np.sin(2.0 * np.pi * f * t + rng.uniform(0.0, 6.0))

    match label:
        case "line":
            return x + np.outer(line(log_uniform(rng, 1.0, 0.45 * rate)), white) * log_uniform(rng, 0.03, 1.0)
        case "slow line":
            return x + np.outer(line(log_uniform(rng, 5.0 / duration, 1.0)), white) * log_uniform(
                rng, 0.01, 0.2
            )
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


def clean(seed: int) -> Drawn:
    return six(seed) if seed % 2 else single(seed // 2)


def presets() -> list[tuple[str, Recording]]:
    """The demo, and each tested unit, whose coefficients say nothing of gravity."""
    found = [("demo", demo_recording())]
    for name, preset in aj.SENSORS.items():
        for seed in range(4):
            found += [(name, part) for part in preset.simulate(300.0 * (seed + 1), FRESH + seed)]
    return found


# --- Touched records ---------------------------------------------------------------------------------------


def motion(n: int, axes: int, rate: float, rng: np.random.Generator) -> np.ndarray:
    """Handling, of mean square one: below 8 Hz, and something faster."""
    band = scipy.signal.butter(2, (0.3, min(8.0, 0.4 * rate)), "bandpass", fs=rate, output="sos")
    x = scipy.signal.sosfilt(band, rng.standard_normal((n + round(5 * rate), axes)), axis=0)[-n:]
    return x / np.std(x, axis=0) + 0.3 * rng.standard_normal((n, axes))


def at_ends(
    x: np.ndarray, white: np.ndarray, rate: float, rng: np.random.Generator, strength: float
) -> np.ndarray:
    x, which = x.copy(), rng.integers(3)
    for place in ([slice(None)], [slice(None, None, -1)], [slice(None), slice(None, None, -1)])[which]:
        count = round(log_uniform(rng, 1.0, min(20.0, 0.15 * len(x) / rate)) * rate)
        x[place][:count] += white * strength * motion(count, len(white), rate, rng)
    return x


Touch = Callable[[np.ndarray, np.ndarray, float, np.random.Generator], np.ndarray]


def knock(x: np.ndarray, white: np.ndarray, rate: float, rng: np.random.Generator) -> np.ndarray:
    x, count = x.copy(), max(round(log_uniform(rng, 0.2, 5.0) * rate), 4)
    first = rng.integers(len(x) // 10, 9 * len(x) // 10 - count)
    x[first : first + count] += white * log_uniform(rng, 5.0, 1000.0) * motion(count, len(white), rate, rng)
    return x


def oscillation(x: np.ndarray, white: np.ndarray, rate: float, rng: np.random.Generator) -> np.ndarray:
    u = np.arange(len(x)) / rate - rng.uniform(0.1, 0.9) * len(x) / rate
    f, decay = log_uniform(rng, 2.0, 0.4 * rate), log_uniform(rng, 0.1, 3.0)
    path = np.where(u >= 0.0, np.exp(-np.maximum(u, 0.0) / decay) * np.sin(2.0 * np.pi * f * u), 0.0)
    return x + np.outer(path, white * log_uniform(rng, 10.0, 1000.0) * rng.uniform(0.2, 1.0, len(white)))


def spikes(x: np.ndarray, white: np.ndarray, rate: float, rng: np.random.Generator) -> np.ndarray:
    x, strength = x.copy(), log_uniform(rng, 50.0, 1e5)
    for _ in range(rng.integers(1, 4)):
        k = rng.integers(len(white))
        x[rng.integers(len(x)), k] += strength * white[k]
    return x


def moved(path: np.ndarray, x: np.ndarray, white: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return x + np.outer(path, white * log_uniform(rng, 0.3, 300.0) * rng.standard_normal(len(white)))


def step(x: np.ndarray, white: np.ndarray, rate: float, rng: np.random.Generator) -> np.ndarray:
    return moved(np.arange(len(x)) >= len(x) * rng.uniform(0.1, 0.9), x, white, rng)


def tilt(x: np.ndarray, white: np.ndarray, rate: float, rng: np.random.Generator) -> np.ndarray:
    first, length = rng.uniform(0.2, 0.6), log_uniform(rng, 0.01, 0.2)
    return moved(np.clip((np.arange(len(x)) / len(x) - first) / length, 0.0, 1.0), x, white, rng)


def warm_up(x: np.ndarray, white: np.ndarray, rate: float, rng: np.random.Generator) -> np.ndarray:
    t = np.arange(len(x)) / rate
    return moved(np.exp(-t / log_uniform(rng, 2.0, t[-1] / 5.0)), x, white, rng)


def off(x: np.ndarray, white: np.ndarray, rate: float, rng: np.random.Generator) -> np.ndarray:
    return np.where((np.arange(len(x)) < len(x) * rng.uniform(0.7, 0.97))[:, None], x, 0.0)


def louder(x: np.ndarray, white: np.ndarray, rate: float, rng: np.random.Generator) -> np.ndarray:
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


def allan(x: np.ndarray) -> np.ndarray:
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


# --- The report --------------------------------------------------------------------------------------------


def false_alarms(first: int, count: int) -> str:
    alarms: dict[str, list[str]] = defaultdict(list)
    counts: dict[str, int] = defaultdict(int)
    begun = time.perf_counter()
    spent = 0.0
    for seed in range(first, first + count):
        drawn = clean(seed)
        label = f"{'six axes' if seed % 2 else 'one axis'}, {drawn.label}"
        counts[label] += 1
        recording = drawn.recording()
        begun = time.perf_counter()
        seen = aj.inspect(recording)
        spent += time.perf_counter() - begun
        if seen.said:
            alarms[label].append(f"{seen.said} ({seed})")
        elif not seen.at_rest:
            alarms[label].append(f"not static ({seed})")
        elif any(word in " ".join(seen.warnings) for word in ("-unit", "--rate")):
            alarms[label].append(f"unit ({seed})")
    rows = [[k, str(counts[k]), str(len(alarms[k])), "; ".join(alarms[k])] for k in sorted(counts)]
    total = sum(map(len, alarms.values()))
    head = f"{total} of {count} clean records ({100.0 * total / count:.1f} %)"
    return (
        f"{head}, {1e3 * spent / count:.0f} ms each."
        + "\n\n"
        + table(["record", "records", "alarms", "which"], rows)
    )


def after_touching(first: int, each: int) -> str:
    rows = []
    for k, (name, touch) in enumerate(TOUCHES.items()):
        before, after, refused, cut = [], [], 0, 0
        for seed in range(first, first + each):
            drawn = six(2 * (seed * len(TOUCHES) + k) + 1)
            x = touch(drawn.values, drawn.white, drawn.rate, np.random.default_rng([seed, k]))
            reference = allan(drawn.values)
            seen = aj.inspect(drawn.recording(x))
            before.append(off_by(x, reference))
            if seen.refusal:
                refused += 1
                continue
            cut += seen.stretch is not None
            after.append(off_by(seen.quiet(drawn.recording(x)).values, reference))
        quantiles = [f"{q:.3g}" for q in np.quantile(before, [0.5, 0.9])]
        quantiles += [f"{q:.3g}" for q in np.quantile(after, [0.5, 0.9, 1.0])]
        rows.append([name, str(each), str(cut), str(refused), *quantiles])
    head = ["touched", "records", "cut", "refused", "before: median", "90 %"]
    return table([*head, "after: median", "90 %", "worst"], rows)


def coefficients(first: int, each: int, n: int = 1 << 15, rate: float = 100.0) -> str:
    """N and K of two axes, of all of a touched record and of the stretch that is chosen."""
    rows = []
    for k, (name, touch) in enumerate(TOUCHES.items()):
        ratios: dict[str, list[float]] = defaultdict(list)
        covered: dict[str, list[bool]] = defaultdict(list)
        for seed in range(first, first + each):
            rng = np.random.default_rng([seed, k, 3])
            truth = {"angle_random_walk": 1e-4 * log_uniform(rng, 0.3, 3.0) * np.array([1.0, 20.0])}
            truth["rate_random_walk"] = truth["angle_random_walk"] / log_uniform(rng, 10.0, 60.0)
            white = truth["angle_random_walk"] * np.sqrt(rate)
            walk = np.cumsum(rng.standard_normal((n, 2)), axis=0) / np.sqrt(rate)
            x = white * rng.standard_normal((n, 2)) + truth["rate_random_walk"] * walk
            names = ["gyro_x", "accel_x"]
            touched = Recording.from_array(touch(x, white, rate, rng), rate, names=names, **UNITS)
            seen = aj.inspect(touched)
            kept = seen.quiet(touched)
            # Of few lengths: each costs a compilation.
            whole = kept.n // 4096 * 4096
            kept = dataclasses.replace(kept, values=kept.values[-whole:])
            for which, record in (("before", touched), ("after", kept)):
                if which == "after" and seen.refusal:
                    continue
                fit = aj.fit(record, "N + K", as_is=True)
                for j, axis in enumerate(names):
                    if not fit[axis].converged:
                        continue
                    for label, values in truth.items():
                        c = fit[axis][label]
                        ratios[f"{which} {label}"].append(c.value / values[j])
                        limit = np.inf if c.upper_limit is None else c.upper_limit
                        inside = c.interval[0] <= values[j] <= c.interval[1]
                        covered[f"{which} {label}"].append(inside if c.detected else values[j] <= limit)
        row = [name, str(each)]
        for which in ("before", "after"):
            for label in ("angle_random_walk", "rate_random_walk"):
                key = f"{which} {label}"
                worst = max(ratios[key], key=lambda r: abs(np.log(max(r, 1e-3))))
                row += [f"{np.median(ratios[key]):.2f}, {worst:.3g}", f"{np.mean(covered[key]):.2f}"]
        rows.append(row)
    head = ["touched", "records"]
    for which in ("before", "after"):
        head += [f"{which}: N/true, median, worst", "covers", "K/true", "covers"]
    return table(head, rows)


def preset_text() -> str:
    found = [(name, aj.inspect(recording)) for name, recording in presets()]
    alarms = [f"{name}: {seen}" for name, seen in found if seen.said or not seen.at_rest]
    units = [f"{name}: {w}" for name, seen in found for w in seen.warnings if "unit" in w]
    said = f"alarms {alarms or 'none'}, units {units or 'none'}"
    return f"{len(found)} records of the presets and the demo: {said}."


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--first", type=int, default=FRESH, help="first seed")
    parser.add_argument("--clean", type=int, default=1000)
    parser.add_argument("--touched", type=int, default=20, help="records of each kind, inspected only")
    parser.add_argument("--fits", type=int, default=4, help="records of each kind, fitted twice")
    parser.add_argument("--results", type=Path, default=paths.RESULTS / "first_look.md")
    options = parser.parse_args()
    parts = [
        "# First look",
        "What `inspect` sees in recordings, before a fit (`benchmarks/studies/first_look.py`).",
        describe(),
        f"Thresholds were set on seeds below 800; these are seeds from {options.first} on, drawn once.",
        "## False alarms",
        false_alarms(options.first, options.clean),
        preset_text(),
        "## Touched records",
        "Largest factor, over octaves of cluster time and six axes, between the Allan deviation of the "
        "touched record and that of the same record untouched; before: of all of it, after: of the stretch "
        "that coefficients are of. σ: of the white noise, from sample to sample. An estimate's own scatter "
        "at the longest cluster times makes factors of 1.1 to 1.3. What is touched is added after rounding, "
        "which no sensor does.",
        after_touching(options.first, options.touched),
        "## Coefficients",
        "N and K of a gyro and an accelerometer, 32,768 samples at 100 Hz: estimate over truth, and the "
        "share of 95 % intervals (or limits) that hold it; before: `as_is=True`.",
        coefficients(options.first, options.fits),
    ]
    text = "\n\n".join(parts) + "\n"
    publish(text, options.results)


if __name__ == "__main__":
    main()
