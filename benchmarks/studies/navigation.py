"""Do a resting navigator's errors grow as told, do the intervals hold, and is the bandwidth found?

Growth: navigators at rest of three grades, from a strapdown mechanization that is written here in NumPy
(rotation matrices, the specific force resolved and integrated), on samples that the package simulates at 50
Hz, less their means over 100 s before the start. Cells: the root mean square of the error over the standard
deviation that `navigate` tells.

Intervals: recordings of two hours at 10 Hz with three gyros and accelerometers of N + K: the share of 95 %
intervals that hold the true standard deviation of the error; of the best azimuth, and of the time needed for
1.5 times the best, of two gyros a recording.

Sample rate: records of 15 min at 200 Hz behind filters of 10 Hz: bandwidths that were found, and the mean
share of the level that is aliased when samples are picked at lower rates.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

import allanjax as aj
from allanjax.base.wording import percent
from benchmarks.common.study import run_tasks, share, table

QUICK: dict[str, Any] = {"craft": 4, "records": 1, "grades": ("consumer",), "hours": 0.5, "minutes": 2.0}
RATE, CALIBRATION, TIMES = 50.0, 100.0, (1.0, 10.0, 100.0)
GRAVITY = 9.80665
SENSORS = {
    "navigation": ("N=0.002 deg/√h + B=0.003 deg/h", "N=0.005 m/s/√h + B=5 µg + Q=0.0001 m/s"),
    "tactical": (
        "N=0.1 deg/√h + B=0.5 deg/h + K=1 deg/h/√h + sinusoid(amplitude=20 deg/h, frequency=0.31 Hz)",
        "N=0.03 m/s/√h + markov(amplitude=1e-5 m/s²/√s, correlation_time=40 s)",
    ),
    "consumer": (
        "low_pass1(bandwidth=5 Hz) * (N=0.5 deg/√h + B=10 deg/h)",
        "low_pass1(bandwidth=5 Hz) * (N=0.1 m/s/√h + B=50 µg) + R=0.01 m/s/h²",
    ),
}
QUANTITIES = ("attitude", "velocity", "position")


def run(
    *,
    craft: int = 300,
    records: int = 40,
    grades: tuple[str, ...] = tuple(SENSORS),
    hours: float = 2.0,
    minutes: float = 15.0,
    seed: int = 434_955_521,
) -> Iterator[str]:
    parts = run_tasks(growth, [(g, craft, seed + 10_000 * k) for k, g in enumerate(grades)])
    rows = [row for part in parts for row in part]
    scatter = 1.0 / np.sqrt(2.0 * craft)
    ratios = np.array([[float(x) for x in row[2:5]] for row in rows])
    yield f"## Growth of errors, {craft} craft of each grade\n\nBy chance ratios scatter by {scatter:.3f}."
    yield table(["sensor", "error", "1 s", "10 s", "100 s", "mostly from, at 100 s"], rows)
    within = percent(float(np.mean(abs(ratios - 1.0) < 2.0 * scatter)))
    yield (
        f"Of the {ratios.size} ratios, {within} are within two standard errors; mean {ratios.mean():.4f}, "
        f"from {ratios.min():.3f} to {ratios.max():.3f}."
    )
    rows, aligned = [], []
    for label in FITS:
        found = run_tasks(held, [(label, hours, seed + 50_000 + k) for k in range(records)])
        for quantity in QUANTITIES:
            hits = np.concatenate([h[quantity] for h, _ in found if quantity in h])
            rows.append([label, quantity, *map(share, hits.T)])
        each = np.array([axis for _, told in found for axis in told])
        aligned.append([label, share(each[:, 0]), share(each[:, 1])])
    yield f"## Intervals, {records} recordings"
    yield table(["fit", "error", *(f"{t:g} s" for t in LATER)], rows)
    yield table(["fit", "best azimuth", "time for 1.5 times that"], aligned)
    rows, count = [], max(records // 2, 1)
    for j, name in enumerate(FILTERS):
        results = run_tasks(bandwidth, [(name, minutes, seed + 90_000 + 100 * j + k) for k in range(count)])
        known = [r.bandwidth for r in results if r.bandwidth is not None]
        hits = [b.interval[0] <= 10.0 <= b.interval[1] for b in known]
        mean = f"{np.mean([b.value for b in known]):.2f} Hz" if known else "–"
        aliased = (f"{100.0 * x:.1f} %" for x in np.mean([r.aliased for r in results], axis=0)[1:])
        rows.append([name, f"{len(known)} of {count}", mean, share(hits), *aliased])
    told = [f"aliased at {rate:g} Hz" for rate in RATES[1:]]
    yield f"## Sample rate, {count} records"
    yield table(["filter", "found", "bandwidth", "95 % interval holds 10 Hz", *told], rows)


def rotation(angle: np.ndarray) -> np.ndarray:
    """Rotation matrices of rotation vectors, by Rodrigues' formula."""
    x, y, z = np.moveaxis(angle, -1, 0)
    zero = np.zeros_like(x)
    K = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)
    size = np.linalg.norm(angle, axis=-1)[:, None, None]
    return np.eye(3) + np.sinc(size / np.pi) * K + 0.5 * np.sinc(size / (2.0 * np.pi)) ** 2 * K @ K


def strapdown(gyro: np.ndarray, accel: np.ndarray, h: float, at: list[int]) -> dict[str, np.ndarray]:
    """Errors [times, craft, 3] after so many samples; samples are [craft, n, 3], axes north, east, down."""
    count, n, _ = gyro.shape
    C = np.broadcast_to(np.eye(3), (count, 3, 3)).copy()
    down = np.array([0.0, 0.0, GRAVITY])
    v, p = np.zeros((count, 3)), np.zeros((count, 3))
    found: dict[str, list[np.ndarray]] = {name: [] for name in QUANTITIES}
    for k in range(n):
        middle = C @ rotation(gyro[:, k] * h / 2.0)
        C = C @ rotation(gyro[:, k] * h)
        push = np.einsum("cij,cj->ci", middle, accel[:, k] - down) + down
        p += h * v + h**2 / 2.0 * push
        v += h * push
        if k + 1 in at:
            angles = (np.arctan2(C[:, 2, 1], C[:, 2, 2]), -np.arcsin(C[:, 2, 0]))
            found["attitude"].append(np.stack([*angles, np.arctan2(C[:, 1, 0], C[:, 0, 0])], axis=1))
            found["velocity"].append(v.copy())
            found["position"].append(p.copy())
    return {name: np.stack(errors) for name, errors in found.items()}


def growth(name: str, craft: int, seed: int) -> list[list[str]]:
    """Rows of a grade: measured over told standard deviations."""
    before, n = round(CALIBRATION * RATE), round(TIMES[-1] * RATE)
    models = {f"{s}_{x}": m for s, m in zip(("gyro", "accel"), SENSORS[name], strict=True) for x in "xyz"}
    z = np.stack([aj.simulate_recording(models, before + n, RATE, seed + k).values for k in range(craft)])
    z = z[:, before:] - z[:, :before].mean(axis=1, keepdims=True)
    errors = strapdown(z[..., :3], z[..., 3:], 1.0 / RATE, [round(t * RATE) for t in TIMES])
    told = aj.navigate(models, TIMES, rate=RATE, at_rest=CALIBRATION, gravity=GRAVITY)
    rows = []
    for quantity in QUANTITIES:
        ratio = np.sqrt((errors[quantity] ** 2).mean(axis=1)).T / told[quantity].error
        for c, channel in enumerate(told[quantity].channels):
            largest = told[quantity].largest(channel)[-1]
            rows.append([name, f"{quantity} {channel}", *(f"{x:.3f}" for x in ratio[c]), largest])
    return rows


TRUTH = {"gyro": "N=0.1 deg/√h + K=2 deg/h/√h", "accel": "N=0.03 m/s/√h + K=0.3 m/s/h/√h"}
RATES = (200.0, 100.0, 40.0, 20.0, 10.0)
LATER = (1.0, 10.0, 100.0, 1000.0)
FITS = {"terms given": "N + K", "terms chosen by the fit": None}


def held(label: str, hours: float, seed: int) -> tuple[dict[str, np.ndarray], list[tuple[bool, bool]]]:
    """Whether the intervals of a recording hold the truth: of errors, of best azimuth and needed time."""
    models = {f"{s}_{x}": m for s, m in TRUTH.items() for x in "xyz"}
    truth = aj.navigate(models, LATER, rate=10.0, at_rest=300.0)
    best = aj.align(models, 51.0, rate=10.0)["gyro_x"].best
    level = aj.align(models, 51.0, 1.5 * best, rate=10.0)
    fit = aj.fit(aj.simulate_recording(models, round(36_000 * hours), 10.0, seed), FITS[label], as_is=True)
    found, hits, told = aj.navigate(fit, LATER, at_rest=300.0), {}, []
    for quantity in QUANTITIES:
        own, true = found[quantity], truth[quantity].error
        if own.error.shape == true.shape:
            hits[quantity] = (own.lower <= true) & (true <= own.upper)
    for axis in ("gyro_x", "gyro_y"):
        result, true = aj.align(fit, 51.0, 1.5 * best)[axis], level[axis]
        ends = (result.best_interval, true.best), (result.needed_interval, true.needed)
        told.append(tuple(low <= value <= high for (low, high), value in ends))
    return hits, told


FILTERS = {
    "one pole": aj.LowPass1(10.0) * (aj.AngleRandomWalk(1e-4) + aj.RateRandomWalk(1e-6)),
    "Butterworth": aj.Butterworth(10.0) * (aj.AngleRandomWalk(1e-4) + aj.RateRandomWalk(1e-6)),
    "one pole, quantized": aj.LowPass1(10.0) * aj.AngleRandomWalk(1e-4) + aj.Quantization(1e-6),
}


def bandwidth(name: str, minutes: float, seed: int) -> Any:
    return aj.sample_rates(FILTERS[name], RATES, rate=200.0, duration=60.0 * minutes, seed=seed)["gyro"]
