"""Are coefficients of filtered sensors right, and their intervals, when `fit` corrects for what it finds?

    python benchmarks/studies/corrected_fits.py [--first-seed 6000000] [--count 200] [--workers 2]

Records of one gyro, made by NumPy and SciPy alone: white noise with a walk, flicker or a Gauss–Markov process
behind a filter of one of five kinds, with up to two resonances and a line. `fit` is told nothing. Beside it
the plain fit, which is what other tools do.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import paths
from scipy.signal import bessel, butter, lfilter, sosfilt

from benchmarks.common.machine import describe
from benchmarks.common.report import publish, run_tasks, table

RATE, SETTLED = 100.0, 4000
LENGTHS = (60_000, 200_000)
FILTERS = ("none", "one pole", "two poles", "Butterworth 3", "Bessel 2", "mean of 3")
SLOW = ("nothing", "random walk", "flicker", "Markov")
ABOUT = """# Fits that are corrected for filters, resonances and lines

{count} records of 60,000 or 200,000 samples at {rate:g} Hz from seed {seed} on, made without allanjax: white
noise with a slow process behind a filter, up to two resonances, and a line in every third. Coverage is the
share of 95 % intervals with the truth; in brackets how many had an interval. N is the density of the samples
at low frequencies, T_c is told where a Gauss–Markov process was put in and found. "Allan deviation" is the
share of records in which the fitted model's is within 5 % of the measured one at every cluster time with a
thousand clusters. The moving average and the digital filter of two poles became responses of allanjax after
results of this generator, from seed 5000000 on, had shown that they were missing; the seeds here were drawn
afterwards. "unmeasured" are those whose fit says that it is no measurement. Reproduce with
`{command}`.

{machine}

{summary}

{table}
"""


class Truth(NamedTuple):
    """What was put into a record."""

    n: int
    white: float
    slow: str
    coefficient: float
    time: float
    filter: str
    bandwidth: float
    resonances: int
    line: bool


def flicker(rng: np.random.Generator, n: int) -> np.ndarray:
    """Flicker noise of two-sided density 1/(2πf), by its spectrum."""
    f = np.fft.rfftfreq(2 * n, 1.0 / RATE)
    f[0] = np.inf
    z = (rng.standard_normal(len(f)) + 1j * rng.standard_normal(len(f))) / np.sqrt(2.0)
    return np.fft.irfft(z * np.sqrt(1.0 / (2.0 * np.pi * f) * RATE * 2 * n), 2 * n)[:n]


def record(seed: int) -> tuple[np.ndarray, Truth]:
    """One record."""
    rng, h = np.random.default_rng(seed), 1.0 / RATE
    n = int(rng.choice(LENGTHS))
    white = 10.0 ** rng.uniform(-4.0, -3.0)
    kind, slow = str(rng.choice(FILTERS)), str(rng.choice(SLOW))
    # Where the slow process is as strong as the white noise.
    corner = 10.0 ** rng.uniform(-1.7, -0.5)
    total, T = n + SETTLED, 0.0
    x, coefficient = white / np.sqrt(h) * rng.standard_normal(total), 0.0
    if slow == "random walk":
        coefficient = white * 2.0 * np.pi * corner
        x += coefficient * np.sqrt(h) * np.cumsum(rng.standard_normal(total))
    elif slow == "flicker":
        coefficient = white * np.sqrt(2.0 * np.pi * corner)
        x += coefficient * flicker(rng, total)
    elif slow == "Markov":
        T = float(10.0 ** rng.uniform(0.5, 1.5))
        # q_c: at frequency zero ten times the white noise's density.
        coefficient = white * np.sqrt(10.0) / T
        a = np.exp(-h / T)
        drive = coefficient * np.sqrt(T / 2.0 * (1.0 - a**2)) * rng.standard_normal(total)
        x += lfilter([1.0], [1.0, -a], drive)
    bandwidth = float(rng.uniform(12.0, 35.0))
    if kind == "one pole":
        w = np.exp(-2.0 * np.pi * bandwidth * h)
        x = lfilter([1.0 - w], [1.0, -w], x)
    elif kind == "two poles":
        w, Q = 2.0 * np.pi * bandwidth * h, rng.uniform(0.55, 1.2)
        pole = np.exp(-w / (2.0 * Q) + 1j * w * np.sqrt(complex(1.0 - 0.25 / Q**2)).real)
        a = np.poly([pole, pole.conj()]).real
        x = lfilter([a.sum()], a, x)
    elif kind == "Butterworth 3":
        x = sosfilt(butter(3, bandwidth, fs=RATE, output="sos"), x)
    elif kind == "Bessel 2":
        x = sosfilt(bessel(2, bandwidth, fs=RATE, output="sos", norm="mag"), x)
    elif kind == "mean of 3":
        x = lfilter(np.full(3, 1.0 / 3.0), [1.0], x)
    x = x[SETTLED:]
    resonances = int(rng.choice(3))
    for _ in range(resonances):
        f, Q = float(rng.uniform(3.0, 30.0)), float(10.0 ** rng.uniform(0.6, 2.0))
        w = 2.0 * np.pi * f * h
        pole = np.exp(-w / (2.0 * Q) + 1j * w * np.sqrt(1.0 - 0.25 / Q**2))
        y = lfilter([1.0], np.poly([pole, pole.conj()]).real, rng.standard_normal(total))[SETTLED:]
        # Its peak is 2 to 30 times the white noise's density N²: σ²·2Q/(π f) two-sided, halved.
        peak = white**2 * 10.0 ** rng.uniform(0.3, 1.5)
        x += y / y.std() * np.sqrt(peak * np.pi * f / Q)
    line = bool(rng.random() < 1.0 / 3.0)
    if line:
        amplitude = white / np.sqrt(h) * 10.0 ** rng.uniform(-1.3, -0.3)
        t = np.arange(n) * h
        x += amplitude * np.cos(2.0 * np.pi * rng.uniform(0.5, 45.0) * t + rng.uniform(0.0, 6.0))
    return x, Truth(n, white, slow, coefficient, T, kind, bandwidth, resonances, line)


def of_record(seed: int) -> dict[str, object]:
    """What `fit` makes of one record, beside the plain fit."""
    import allanjax as aj

    x, truth = record(seed)
    recording = aj.Recording.from_array(x[:, None], RATE, gyro_unit="rad/s", names=["gyro_x"])
    begin = time.perf_counter()
    fit = aj.fit(recording, as_is=True)
    seconds = time.perf_counter() - begin
    result = fit["gyro_x"]
    plain = result if result.plain is None else result.plain

    def inside(of: object, label: str, value: float) -> float:
        c = of.coefficients.get(label)  # type: ignore[attr-defined]
        known = c is not None and c.detected and np.isfinite(c.std)
        return float(c.interval[0] <= value <= c.interval[1]) if known else np.nan

    label = {"random walk": "rate_random_walk", "flicker": "bias_instability", "Markov": "markov_amplitude"}
    found = {"truth": truth, "seconds": seconds, "extended": result.own_template is not None}
    for name, of in (("fit", result), ("plain", plain)):
        if not of.converged:
            nothing = dict.fromkeys(("N", "N inside", "slow inside", "T inside"), np.nan)
            found[name] = {**nothing, "measured": False, "Allan": False}
            continue
        N = of["angle_random_walk"]
        time_, curve = fit.curve.cluster_time, fit.curve
        model = np.sqrt(np.asarray(of.model.sampled(RATE).allan_variance(time_)))
        many = curve.n // curve.cluster_size >= 1000
        found[name] = {
            "measured": of.measured,
            "N": N.value / truth.white - 1.0,
            "N inside": inside(of, "angle_random_walk", truth.white),
            "slow inside": inside(of, label.get(truth.slow, ""), truth.coefficient),
            "T inside": inside(of, "markov_correlation_time", truth.time)
            if truth.slow == "Markov"
            else np.nan,
            "Allan": bool(np.all(abs(curve.deviation[:, 0] / model - 1.0)[many] < 0.05)),
        }
    return found


def share(values: list[float]) -> str:
    known = np.array([v for v in values if np.isfinite(v)])
    return f"{known.mean():.2f} ({len(known)})" if len(known) else "—"


def row(name: str, rows: list[dict], which: str) -> list[str]:
    each = [r[which] for r in rows]
    error = np.array([e["N"] for e in each if np.isfinite(e["N"])])
    return [
        name,
        which,
        str(len(rows)),
        share([e["N inside"] for e in each]),
        f"{100.0 * np.median(abs(error)):.2f} %",
        f"{100.0 * np.quantile(abs(error), 0.95):.1f} %",
        share([e["slow inside"] for e in each]),
        share([e["T inside"] for e in each]),
        f"{np.mean([e['Allan'] for e in each]):.2f}",
        str(sum(not e["measured"] for e in each)),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--first-seed", type=int, default=6_000_000)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--results", type=Path, default=paths.RESULTS / "corrected_fits.md")
    options = parser.parse_args()
    rows = []
    seeds = range(options.first_seed, options.first_seed + options.count)
    for task, found, _ in run_tasks(of_record, [(seed,) for seed in seeds], options.workers):
        rows.append(found)
        f = found["fit"]
        print(task[0], found["truth"].filter, found["truth"].slow, f, file=sys.stderr, flush=True)
    lines = []
    groups = [("all", rows)]
    groups += [(f"filter: {name}", [r for r in rows if r["truth"].filter == name]) for name in FILTERS]
    groups += [(f"slow: {name}", [r for r in rows if r["truth"].slow == name]) for name in SLOW]
    for name, some in groups:
        if some:
            lines += [row(name, some, which) for which in ("fit", "plain")]
    head = [
        "records",
        "",
        "number",
        "N covered",
        "median error of N",
        "95 %",
        "slow covered",
        "T_c covered",
        "Allan deviation",
        "unmeasured",
    ]
    extended = sum(r["extended"] for r in rows)
    nothing = [
        r for r in rows if r["truth"].filter == "none" and not r["truth"].resonances and not r["truth"].line
    ]
    false = sum(r["extended"] for r in nothing)
    summary = (
        f"{extended} of {len(rows)} fits are extended; "
        f"of {len(nothing)} records with plain terms only, {false}. "
        f"{np.median([r['seconds'] for r in rows]):.1f} s a record (median)."
    )
    text = ABOUT.format(
        count=len(rows),
        rate=RATE,
        seed=options.first_seed,
        machine=describe(),
        summary=summary,
        command="python " + " ".join(sys.argv),
        table=table(head, lines),
    )
    publish(text, options.results)


if __name__ == "__main__":
    main()
