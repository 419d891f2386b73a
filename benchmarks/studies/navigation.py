"""Do a resting navigator's errors grow as told, do the intervals hold, and which sample rate is needed?

    python benchmarks/studies/navigation.py [--quick] [--craft 300] [--records 40] [--results PATH]

The strapdown mechanization is written here, in NumPy: rotation matrices, the specific force resolved and
integrated. It shares no code with the package, which makes its noise.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
import paths

import allanjax as aj
from benchmarks.common.machine import describe
from benchmarks.common.report import publish, share, table

RATE, CALIBRATION, TIMES = 50.0, 100.0, (1.0, 10.0, 100.0)
SEED = 434_955_521
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


def growth(craft: int) -> tuple[list[list[str]], list[float]]:
    """Rows of measured over told standard deviations, and all of these ratios."""
    before, n = round(CALIBRATION * RATE), round(TIMES[-1] * RATE)
    at = [round(t * RATE) for t in TIMES]
    rows, ratios = [], []
    for j, (name, (gyro, accel)) in enumerate(SENSORS.items()):
        models = {f"{s}_{x}": m for s, m in (("gyro", gyro), ("accel", accel)) for x in "xyz"}
        z = np.empty((craft, before + n, 6))
        for k in range(craft):
            recording = aj.simulate_recording(models, before + n, RATE, SEED + 10_000 * j + k)
            z[k] = recording.values
        z = z[:, before:] - z[:, :before].mean(axis=1, keepdims=True)
        errors = strapdown(z[..., :3], z[..., 3:], 1.0 / RATE, at)
        told = aj.navigate(models, TIMES, rate=RATE, calibration=CALIBRATION, gravity=GRAVITY)
        for quantity in QUANTITIES:
            ratio = np.sqrt((errors[quantity] ** 2).mean(axis=1)).T / told[quantity].error
            ratios += list(ratio.ravel())
            for c, channel in enumerate(told[quantity].channels):
                largest = told[quantity].largest(channel)[-1]
                rows.append([name, f"{quantity} {channel}", *(f"{x:.3f}" for x in ratio[c]), largest])
    return rows, ratios


TRUTH = {"gyro": "N=0.1 deg/√h + K=2 deg/h/√h", "accel": "N=0.03 m/s/√h + K=0.3 m/s/h/√h"}
RATES = ("100 Hz", "40 Hz", "20 Hz", "10 Hz", "4 Hz")
LATER = (1.0, 10.0, 100.0, 1000.0)


def coverage(records: int) -> tuple[list[list[str]], list[list[str]]]:
    """Shares of 95 % intervals that hold the truth, of errors and of the alignment."""
    models = {f"{s}_{x}": m for s, m in TRUTH.items() for x in "xyz"}
    truth = aj.navigate(models, LATER, rate=10.0, calibration=300.0)
    best = aj.align(models, 51.0, rate=10.0)["gyro_x"].best
    level = aj.align(models, 51.0, 1.5 * best, rate=10.0)
    rows, aligned = [], []
    for label, terms in (("terms given", "N + K"), ("terms chosen by the fit", None)):
        hits: dict[str, list[np.ndarray]] = {name: [] for name in QUANTITIES}
        told: dict[str, list[bool]] = {"best": [], "needed": []}
        for k in range(records):
            recording = aj.simulate_recording(models, 72_000, 10.0, SEED + 50_000 + k)
            fit = aj.fit(recording, terms, as_is=True)
            found = aj.navigate(fit, LATER, calibration=300.0)
            for quantity in QUANTITIES:
                own, true = found[quantity], truth[quantity].error
                if own.error.shape == true.shape:
                    hits[quantity].append((own.lower <= true) & (true <= own.upper))
            for axis in ("gyro_x", "gyro_y"):
                result = aj.align(fit, 51.0, 1.5 * best)[axis]
                for name in told:
                    low, high = getattr(result, f"{name}_interval")
                    told[name].append(low <= getattr(level[axis], name) <= high)
        for quantity in QUANTITIES:
            cells = [share(np.concatenate([h[:, j] for h in hits[quantity]])) for j in range(len(LATER))]
            rows.append([label, quantity, *cells])
        aligned.append([label, *(share(np.array(told[name])) for name in told)])
    return rows, aligned


FILTERS = {
    "one pole": aj.LowPass1(10.0) * (aj.AngleRandomWalk(1e-4) + aj.RateRandomWalk(1e-6)),
    "Butterworth": aj.Butterworth(10.0) * (aj.AngleRandomWalk(1e-4) + aj.RateRandomWalk(1e-6)),
    "one pole, quantized": aj.LowPass1(10.0) * aj.AngleRandomWalk(1e-4) + aj.Quantization(1e-6),
}


def rates(records: int) -> list[list[str]]:
    """Rows of bandwidths, coverage, and aliased shares by rate."""
    rows = []
    for j, (name, model) in enumerate(FILTERS.items()):
        results = [
            aj.sample_rates(model, rate=200.0, duration=900.0, seed=SEED + 90_000 + 100 * j + k)["gyro"]
            for k in range(records)
        ]
        known = [r.bandwidth for r in results if r.bandwidth is not None]
        hits = np.array([b.interval[0] <= 10.0 <= b.interval[1] for b in known])
        aliased = np.mean([r.aliased for r in results], axis=0)
        rows.append(
            [
                name,
                f"{len(known)} of {records}",
                f"{np.mean([b.value for b in known]):.2f} Hz",
                share(hits),
                *(f"{100.0 * x:.1f} %" for x in aliased[1:]),
            ]
        )
    return rows


def report(craft: int, records: int) -> str:
    grown, ratios = growth(craft)
    held, aligned = coverage(records)
    sampled = rates(max(records // 2, 2))
    scatter = 1.0 / math.sqrt(2.0 * craft)
    off = (np.array(ratios) - 1.0) / scatter
    kinds = "; ".join(f"*{k}*: gyros {g}, accelerometers {a}" for k, (g, a) in SENSORS.items())
    return f"""# What noise does to a navigator

Reproduce with `python benchmarks/studies/navigation.py`.

{describe()}

## Growth of errors

{craft} navigators at rest of each of three grades, from a mechanization in NumPy (rotation matrices,
specific force resolved, integrated) on simulated samples at {RATE:g} Hz, less their means over
{CALIBRATION:g} s before the start. The columns are the root mean square of the error over the standard
deviation that `navigate` tells, after 1, 10 and 100 s; by chance it scatters by {scatter:.3f}.
{kinds}.

{table(["sensor", "error", "1 s", "10 s", "100 s", "mostly from, at 100 s"], grown)}

Of the {len(ratios)} ratios, {np.mean(np.abs(off) < 2.0):.0%} are within two of these standard errors; mean
{np.mean(ratios):.4f}, from {min(ratios):.3f} to {max(ratios):.3f}. They are not independent of each other:
the times and directions of a craft share their noise.

## Intervals

{records} records of two hours at 10 Hz with three gyros ({TRUTH["gyro"]}) and three accelerometers
({TRUTH["accel"]}): the share of 95 % intervals that hold the true standard deviation of the error.

{table(["fit", "error", "1 s", "10 s", "100 s", "1,000 s"], held)}

Best azimuth, and the time needed for 1.5 times the best, of two gyros a record:

{table(["fit", "best azimuth", "time for 1.5 times that"], aligned)}

## Sample rate

{max(records // 2, 2)} records of 15 min at 200 Hz behind filters of 10 Hz: bandwidths that were found,
their mean, the share of 95 % intervals that hold 10 Hz, and the mean share of the level that is aliased when
samples are picked at lower rates.

{table(["filter", "found", "bandwidth", "95 % interval holds", *RATES], sampled)}
"""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="few records of each")
    parser.add_argument("--craft", type=int, default=300)
    parser.add_argument("--records", type=int, default=40)
    parser.add_argument("--results", type=Path, default=paths.RESULTS / "navigation.md")
    options = parser.parse_args()
    craft, records = (20, 2) if options.quick else (options.craft, options.records)
    publish(report(craft, records), options.results, options.quick)


if __name__ == "__main__":
    main()
