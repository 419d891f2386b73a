"""Are coefficients of filtered sensors right, and their intervals, when `fit` is told nothing?

Records of one gyro, made by NumPy and SciPy alone: white noise with a walk, flicker or a Gauss–Markov process
behind a filter of one of five kinds, with up to two resonances, and a line in every third. Beside `fit` its
plain terms, which are what other tools have. Coverage is the share of 95 % intervals with the truth; in
brackets how many had an interval. N is the density of the samples at low frequencies. "Allan deviation" is
the share of records in which the fitted model's is within 5 % of the measured one at every cluster time with
a thousand clusters. "Unmeasured" are those whose fit says that it is no measurement.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from scipy.signal import bessel, butter, lfilter, sosfilt

import allanjax as aj
from benchmarks.common.study import run_tasks, table

QUICK: dict[str, Any] = {"records": 2, "samples": (16384,)}
RATE, SETTLED = 100.0, 4000
FILTERS = ("none", "one pole", "two poles", "Butterworth 3", "Bessel 2", "mean of 3")
SLOW = {
    "nothing": "",
    "random walk": "rate_random_walk",
    "flicker": "bias_instability",
    "Markov": "markov_amplitude",
}


class Truth(NamedTuple):
    """What was put into a record."""

    white: float
    slow: str
    coefficient: float
    time: float
    filter: str
    resonances: int
    line: bool


def run(
    *, records: int = 200, samples: tuple[int, ...] = (60_000, 200_000), seed: int = 6_000_000
) -> Iterator[str]:
    rows = run_tasks(of_record, [(seed + k, samples) for k in range(records)])
    groups = [("all", rows)]
    groups += [(f"filter: {name}", [r for r in rows if r["truth"].filter == name]) for name in FILTERS]
    groups += [(f"slow: {name}", [r for r in rows if r["truth"].slow == name]) for name in SLOW]
    head = ["records", "", "number", "N covered", "median error of N", "95 %", "slow covered", "T_c covered"]
    lines = [row(name, some, which) for name, some in groups if some for which in ("fit", "plain")]
    yield table([*head, "Allan deviation", "unmeasured"], lines)
    plain = [t for r in rows if (t := r["truth"]).filter == "none" and not t.resonances and not t.line]
    false = sum(r["extended"] for r in rows if r["truth"] in plain)
    yield (
        f"{sum(r['extended'] for r in rows)} of {len(rows)} fits are extended; of {len(plain)} records "
        f"with plain terms only, {false}. {np.median([r['seconds'] for r in rows]):.1f} s a record (median)."
    )


def slow_noise(
    rng: np.random.Generator, kind: str, white: float, total: int
) -> tuple[np.ndarray, float, float]:
    """A slow process as strong as the white noise at 0.02 to 0.3 Hz, its coefficient and its time."""
    h, corner = 1.0 / RATE, 10.0 ** rng.uniform(-1.7, -0.5)
    if kind == "random walk":
        coefficient = white * 2.0 * np.pi * corner
        return coefficient * np.sqrt(h) * np.cumsum(rng.standard_normal(total)), coefficient, 0.0
    if kind == "flicker":
        # Of two-sided density 1/(2πf), by its spectrum.
        coefficient, f = white * np.sqrt(2.0 * np.pi * corner), np.fft.rfftfreq(2 * total, h)
        f[0] = np.inf
        z = (rng.standard_normal(len(f)) + 1j * rng.standard_normal(len(f))) / np.sqrt(2.0)
        noise = np.fft.irfft(z * np.sqrt(1.0 / (2.0 * np.pi * f) * RATE * 2 * total), 2 * total)[:total]
        return coefficient * noise, coefficient, 0.0
    if kind == "Markov":
        # At frequency zero ten times the white noise's density.
        T = float(10.0 ** rng.uniform(0.5, 1.5))
        coefficient, a = white * np.sqrt(10.0) / T, np.exp(-h / T)
        drive = coefficient * np.sqrt(T / 2.0 * (1.0 - a**2)) * rng.standard_normal(total)
        return lfilter([1.0], [1.0, -a], drive), coefficient, T
    return np.zeros(total), 0.0, 0.0


def oscillator(f: float, Q: float) -> np.ndarray:
    """The recursion of a damped oscillator, its poles sampled."""
    w = 2.0 * np.pi * f / RATE
    pole = np.exp(-w / (2.0 * Q) + 1j * w * np.sqrt(complex(1.0 - 0.25 / Q**2)).real)
    return np.poly([pole, pole.conj()]).real


def filtered(rng: np.random.Generator, kind: str, x: np.ndarray) -> np.ndarray:
    bandwidth = float(rng.uniform(12.0, 35.0))
    if kind == "one pole":
        w = np.exp(-2.0 * np.pi * bandwidth / RATE)
        return lfilter([1.0 - w], [1.0, -w], x)
    if kind == "two poles":
        a = oscillator(bandwidth, rng.uniform(0.55, 1.2))
        return lfilter([a.sum()], a, x)
    if kind == "Butterworth 3":
        return sosfilt(butter(3, bandwidth, fs=RATE, output="sos"), x)
    if kind == "Bessel 2":
        return sosfilt(bessel(2, bandwidth, fs=RATE, output="sos", norm="mag"), x)
    return lfilter(np.full(3, 1.0 / 3.0), [1.0], x) if kind == "mean of 3" else x


def record(seed: int, lengths: tuple[int, ...]) -> tuple[np.ndarray, Truth]:
    rng = np.random.default_rng(seed)
    n, white = int(rng.choice(lengths)), 10.0 ** rng.uniform(-4.0, -3.0)
    kind, slow = str(rng.choice(FILTERS)), str(rng.choice(list(SLOW)))
    total = n + SETTLED
    x, coefficient, T = slow_noise(rng, slow, white, total)
    x = filtered(rng, kind, x + white * np.sqrt(RATE) * rng.standard_normal(total))[SETTLED:]
    resonances = int(rng.choice(3))
    for _ in range(resonances):
        f, Q = float(rng.uniform(3.0, 30.0)), float(10.0 ** rng.uniform(0.6, 2.0))
        y = lfilter([1.0], oscillator(f, Q), rng.standard_normal(total))[SETTLED:]
        # Its peak is 2 to 30 times the white noise's density N²: σ²·2Q/(π f) two-sided, halved.
        peak = white**2 * 10.0 ** rng.uniform(0.3, 1.5)
        x += y / y.std() * np.sqrt(peak * np.pi * f / Q)
    line = bool(rng.random() < 1.0 / 3.0)
    if line:
        amplitude, f = white * np.sqrt(RATE) * 10.0 ** rng.uniform(-1.3, -0.3), rng.uniform(0.5, 45.0)
        x += amplitude * np.cos(2.0 * np.pi * f / RATE * np.arange(n) + rng.uniform(0.0, 6.0))
    return x, Truth(white, slow, coefficient, T, kind, resonances, line)


def of_record(seed: int, lengths: tuple[int, ...]) -> dict[str, Any]:
    """What `fit` makes of one record, beside its plain terms."""
    x, truth = record(seed, lengths)
    recording = aj.Recording.from_array(x[:, None], RATE, gyro_unit="rad/s", names=["gyro_x"])
    begun = time.perf_counter()
    fit = aj.fit(recording, as_is=True)
    result, seconds = fit["gyro_x"], time.perf_counter() - begun
    found: dict[str, Any] = {"truth": truth, "seconds": seconds, "extended": result.own_template is not None}
    for name, of in (("fit", result), ("plain", result.plain or result)):
        if not of.converged:
            nothing = dict.fromkeys(("N", "N inside", "slow inside", "T inside"), np.nan)
            found[name] = {**nothing, "measured": False, "Allan": False}
            continue
        curve = fit.curve
        model = np.sqrt(np.asarray(of.model.sampled(RATE).allan_variance(curve.cluster_time)))
        many = curve.n // curve.cluster_size >= 1000
        found[name] = {
            "measured": of.measured,
            "N": of["angle_random_walk"].value / truth.white - 1.0,
            "N inside": inside(of, "angle_random_walk", truth.white),
            "slow inside": inside(of, SLOW[truth.slow], truth.coefficient),
            "T inside": inside(of, "markov_correlation_time", truth.time) if truth.time else np.nan,
            "Allan": bool(np.all(abs(curve.deviation[:, 0] / model - 1.0)[many] < 0.05)),
        }
    return found


def inside(of: Any, label: str, value: float) -> float:
    c = of.coefficients.get(label)
    known = c is not None and c.detected and np.isfinite(c.std)
    return float(c.interval[0] <= value <= c.interval[1]) if known else np.nan


def row(name: str, rows: list[dict], which: str) -> list[str]:
    each = [r[which] for r in rows]
    error = np.array([abs(e["N"]) for e in each if np.isfinite(e["N"])])
    told = ["–", "–"]
    if len(error):
        told = [f"{100.0 * np.median(error):.2f} %", f"{100.0 * np.quantile(error, 0.95):.1f} %"]

    def held(key: str) -> str:
        known = np.array([e[key] for e in each if np.isfinite(e[key])])
        return f"{known.mean():.2f} ({len(known)})" if len(known) else "–"

    allan, unmeasured = f"{np.mean([e['Allan'] for e in each]):.2f}", sum(not e["measured"] for e in each)
    return [
        name,
        which,
        str(len(rows)),
        held("N inside"),
        *told,
        held("slow inside"),
        held("T inside"),
        allan,
        str(unmeasured),
    ]
