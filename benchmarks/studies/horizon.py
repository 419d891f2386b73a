"""Do the N and K of `horizon`, or its Gauss–Markov process, predict the errors of a coasting filter?

A filter of white noise N and a random walk K knows the bias from the sensor at rest, and integrates 1, 10 or
100 s less that bias; it runs on what the fit has not seen. Cells: the mean square of its error over what it
predicts: 1 is right, above 1 it believes too much. *Raw* has the fitted N and K (a filter without K averages
the bias over the record); *N\\*, K\\** is `horizon`, and *where fitted* the same in the record that was
fitted, less its first fifth; *bound* is the pair of 95 % probability, meant for all times from a hundredth of
the horizon on; *Allan bound* the tightest N and K whose Allan variance is above the 95 % limits of the
measured one up to the horizon, after the idea of Navigation 70(3), navi.563 (our reading of it, not its
code); *width* its predicted standard deviation over that of our bound.

A filter whose bias is a Gauss–Markov process knows *T\\** as well. The bias returns to zero, which is its
mean over the length of the fitted record: what is tested is cut into stretches of that length, each less its
own mean, and begins after a fifth of them. The filters here share no code with the package. Simulated sensors
are fitted to one hour at 50 Hz and tested on the ten hours that follow; real ones to the first half (where
ALLANJAX_DATA has them), whose errors of 100 s are some fifty, so that their mean square scatters by a fifth.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.signal import lfilter
from scipy.stats import chi2

import allanjax as aj
from benchmarks.common.study import UnavailableError, data, run_tasks, table

QUICK: dict[str, Any] = {"records": 1, "kinds": 1, "fitted": 400.0, "tested": 1200.0, "real": False}
RATE, HORIZONS = 50.0, (1.0, 10.0, 100.0)
WANTED, SETTLED = (0.8, 1.25), 0.2
KINDS = {
    "white and walk": aj.AngleRandomWalk(4.4e-5) + aj.RateRandomWalk(3.0e-6),
    "white and flicker": aj.AngleRandomWalk(4.4e-5) + aj.BiasInstability(5.0e-5),
    "quantized": aj.Quantization(2.0e-5) + aj.AngleRandomWalk(1.0e-5) + aj.RateRandomWalk(1.0e-6),
    "Gauss–Markov": aj.AngleRandomWalk(4.4e-5) + aj.Markov(2.5e-5, 40.0),
    "filtered, with a line": aj.LowPass1(5.0) * (aj.AngleRandomWalk(4.4e-5) + aj.BiasInstability(3.0e-5))
    + aj.Sinusoid(3.0e-5, 0.31)
    + aj.Resonance(2.0e-4, 11.0, 12.0),
}
COLUMNS = ("raw", "N*, K*", "where fitted", "bound", "Allan bound", "width")
MARKOV = ("N*, K*, T*", "where fitted (Markov)", "bound (Markov)")

Row = dict[str, Any]


def run(
    *,
    records: int = 4,
    kinds: int = len(KINDS),
    fitted: float = 3600.0,
    tested: float = 36000.0,
    real: bool = True,
    seed: int = 90210,
) -> Iterator[str]:
    seeds = [(name, seed + 100 * k + j) for k, name in enumerate(KINDS) for j in range(records) if k < kinds]
    tasks = [(*each, fitted, tested) for each in seeds]
    yield "## Simulated sensors\n\n" + told([row for rows in run_tasks(simulated, tasks) for row in rows])
    try:
        units = [(f"adis16405_unit{k}",) for k in (1, 2) if real and data(f"adis16405_unit{k}.parquet")]
    except UnavailableError as reason:
        yield f"No real recordings: {reason}."
        return
    if units:
        yield "## Real recordings\n\n" + told([row for rows in run_tasks(measured, units) for row in rows])


def simulated(name: str, seed: int, fitted: float, tested: float) -> list[Row]:
    first = round(fitted * RATE)
    z = np.asarray(aj.simulate(KINDS[name], first + round(tested * RATE), RATE, seed))
    recording = aj.Recording.from_array(z[:first, None], RATE, gyro_unit="rad/s", names=["gyro_x"])
    fit = aj.fit(recording, as_is=True, vibrating=True)
    return judged(name, fit, "gyro_x", z, first) if fit["gyro_x"].measured else []


def measured(unit: str) -> list[Row]:
    recording = aj.read(data(f"{unit}.parquet"), rate=100, gyro_unit="deg/s", accel_unit="g")
    half = recording.n // 2
    fit = aj.fit(recording.between(0.0, half / recording.rate))
    rows = []
    for k, axis in enumerate(recording.names):
        if fit[axis].measured:
            rows += judged(f"{unit[10:]} {axis}", fit, axis, recording.values[:, k], half)
    return rows


def judged(case: str, fit: aj.Fit, axis: str, z: np.ndarray, first: int) -> list[Row]:
    """Rows of an axis: fitted before sample `first`, tested from there on."""
    rows, rate = [], fit.curve.rate
    longest = fit.curve.n / rate
    for seconds in HORIZONS:
        found = aj.horizon(fit, seconds, axes=axis)[axis]
        pairs = {
            "raw": (found.raw_white, found.raw_walk),
            "N*, K*": (found.white.value, found.walk.value),
            "bound": (found.bounding_white, found.bounding_walk),
            "Allan bound": overbound(fit, axis, seconds, found.probability),
        }
        row: Row = {"case": case, "horizon": seconds}
        predicted = {}
        for name, (N, K) in pairs.items():
            squared, predicted[name] = errors(z, first, N, K, seconds, rate, longest)
            row[name], row["errors"] = float(squared.mean() / predicted[name]), len(squared)
        own, expected = errors(z[:first], round(SETTLED * first), *pairs["N*, K*"], seconds, rate, longest)
        row["where fitted"] = float(own.mean() / expected)
        row["width"] = float(np.sqrt(predicted["Allan bound"] / predicted["bound"]))
        markov = aj.horizon(fit, seconds, process="markov", axes=axis)[axis]
        own_three = markov.white.value, markov.walk.value, markov.correlation_time.value
        bounding = markov.bounding_white, markov.bounding_walk, markov.bounding_time
        sides = ((z[first:], own_three), (z[:first], own_three), (z[first:], bounding))
        for name, (samples, three) in zip(MARKOV, sides, strict=True):
            squared, variance = markov_errors(samples, first, *three, seconds, rate)
            row[name] = float(squared.mean() / variance) if len(squared) else np.nan
        rows.append(row | {"T*": own_three[2]})
    return rows


def errors(
    z: np.ndarray, first: int, N: float, K: float, seconds: float, rate: float, longest: float
) -> tuple[np.ndarray, float]:
    """Squared errors of the integral from sample `first` on, and the variance that N and K predict."""
    memory = N / K if K > 0.0 else longest
    ratio = 1.0 / (memory * rate) ** 2
    P = ratio / 2.0 + np.sqrt(ratio**2 / 4.0 + ratio)
    g, n = P / (P + 1.0), round(seconds * rate)
    start = z[: min(len(z), max(round(memory * rate), 1))].mean()
    bias = lfilter([g], [1.0, g - 1.0], z - start)[:-1] + start
    total = np.concatenate([[0.0], np.cumsum(z)]) / rate
    at = np.arange(first, len(z) - n, max(n // 2, 1))
    e = total[at + n] - total[at] - seconds * bias[at - 1]
    white = N if N > 0.0 else K * memory
    walk = (white / memory) ** 2 / rate * n * (n + 1.0) * (2.0 * n + 1.0) / 6.0
    return e**2, (n**2 * g * white**2 * rate + walk + n * white**2 * rate) / rate**2


def markov_errors(
    z: np.ndarray, record: int, N: float, K: float, T: float, seconds: float, rate: float
) -> tuple[np.ndarray, float]:
    """Squared errors of the integral with a Gauss–Markov bias, and the variance that is predicted."""
    kept, n, R = np.exp(-1.0 / (T * rate)), round(seconds * rate), N**2 * rate
    Q = K**2 * T / 2.0 * (1.0 - kept**2)
    # The steady state of P = φ²PR/(P + R) + Q.
    half = (Q - R * (1.0 - kept**2)) / 2.0
    P = half + np.sqrt(half**2 + Q * R)
    g = P / (P + R)
    sums = np.concatenate([[0.0], np.cumsum(kept ** np.arange(n))])
    # A disturbance of the bias at step i of n is part of n − i + 1 samples, one before them of all, decayed.
    predicted = (g * R * (kept * sums[n]) ** 2 + Q * (sums[1:] ** 2).sum() + n * R) / rate**2
    found = []
    for begin in range(0, len(z) - record + 1, record):
        x = z[begin : begin + record] - z[begin : begin + record].mean()
        bias = lfilter([g], [1.0, -kept * (1.0 - g)], x)
        total = np.concatenate([[0.0], np.cumsum(x)]) / rate
        at = np.arange(max(round(SETTLED * record), 1), record - n, max(n // 2, 1))
        found.append((total[at + n] - total[at] - kept * sums[n] / rate * bias[at - 1]) ** 2)
    return np.concatenate(found), float(predicted)


def overbound(fit: aj.Fit, axis: str, seconds: float, probability: float) -> tuple[float, float]:
    """The tightest N and K whose Allan variance is above the measured one's limit up to the horizon."""
    column, curve = fit.axes.index(axis), fit.curve
    use = (curve.cluster_time >= seconds / 100.0) & (curve.cluster_time <= seconds)
    T, edf = curve.cluster_time[use], curve.edf[use, column]
    limit = curve.deviation[use, column] ** 2 * edf / chi2.ppf(1 - probability, edf)
    memory = np.geomspace(2.0 / curve.rate, curve.n / curve.rate, 400)[:, None]
    unit = 1.0 / T + T / 3.0 / memory**2
    scale = (limit / unit).max(axis=1)
    best = np.argmin(np.log(scale) + np.log(unit).mean(axis=1))
    return float(np.sqrt(scale[best])), float(np.sqrt(scale[best]) / memory[best, 0])


def told(rows: list[Row]) -> str:
    """Tables by case and horizon, means over the records of a case; how many are in the range, and held."""
    lines = []
    for case, seconds in dict.fromkeys((r["case"], r["horizon"]) for r in rows):
        of = [r for r in rows if (r["case"], r["horizon"]) == (case, seconds)]
        means = [f"{np.mean([r[c] for r in of]):.2f}" for c in (*COLUMNS, *MARKOV)]
        times = np.median([r["T*"] for r in of])
        lines.append([case, f"{seconds:g} s", sum(r["errors"] for r in of), *means, f"{times:.3g} s"])
    counts = []
    for name in ("raw", "N*, K*", "where fitted", *MARKOV[:2]):
        by = [[WANTED[0] <= r[name] <= WANTED[1] for r in rows if r["horizon"] == s] for s in HORIZONS]
        counts.append([name, *(f"{sum(hits)} of {len(hits)}" for hits in by)])
    for name in ("bound", "Allan bound", MARKOV[2]):
        by = [[r[name] <= 1.0 for r in rows if r["horizon"] == s] for s in HORIZONS]
        counts.append([f"{name}: held", *(f"{sum(hits)} of {len(hits)}" for hits in by)])
    head = [f"in {WANTED[0]:g} … {WANTED[1]:g}, or held", *(f"{s:g} s" for s in HORIZONS)]
    first = table(["sensor", "horizon", "errors", *COLUMNS, *MARKOV, "T*"], lines)
    return first + "\n\nRecords (axes):\n\n" + table(head, counts)
