"""Do the intervals of a six-position calibration hold the truth, the noise being fitted to other records?

Each simulated unit has three accelerometers with errors of their own (2.23). It lies still for four hours,
and then for ten minutes in each of six positions, 20 s apart. The noise model is that fitted to the four
hours, or to the first of the positions alone. Beside it: ordinary least squares of the six means (NumPy),
with intervals from white noise alone, whose N is known, and from the residuals by Student's law, as textbooks
have it. Sensors are simulated in NumPy without the package. `calibrate` itself only reads and inspects the
recordings beside what is run here, and takes the mean powers of a fit's likely models for its best one. N is
5e-4 m/s/√s; the random walk has K = 4e-6 m/s²/√s, flicker noise B = 1e-4 m/s². The terms are given to the
fits. The truth of a bias is its average over the calibration.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import t as student

import allanjax as aj
from allanjax.calibration.result import Position, as_orientation
from allanjax.calibration.sensor_errors import Setting, World, errors_of, parts_of_model
from allanjax.record.columns import Axis
from benchmarks.common.hidden_sensors import term_noise
from benchmarks.common.ours import TERM_LABELS, true_model
from benchmarks.common.study import rms, run_tasks, share, table

QUICK: dict[str, Any] = {"calibrations": 2}
RATE, LONG, T, PAUSE, G = 5.0, 14400.0, 600.0, 20.0, 9.8118
N = 5e-4
# Units that are fitted together.
BLOCK = 4
TERMS = {"random walk": "N + K", "flicker noise": "N + B"}
UPS = {f"{a} {way}": s * np.eye(3)["xyz".index(a)] for a in "xyz" for way, s in (("up", 1), ("down", -1))}
KINDS = ("bias", "scale factor", "misalignment")
METHODS = (
    *("calibrate, fit of 4 h", "calibrate, fit of the longest position"),
    *("least squares, white noise alone", "least squares, from its residuals"),
)


def run(*, calibrations: int = 400, seed: int = 261_125) -> Iterator[str]:
    rows, checks = [], []
    for kind in TERMS:
        tasks = [(kind, seed, k, min(BLOCK, calibrations - k)) for k in range(0, calibrations, BLOCK)]
        ratios, errors, p = (np.concatenate(part) for part in zip(*run_tasks(calibrated, tasks), strict=True))
        best = [rms(by_kind(errors[:, 0], k)) for k in range(3)]
        for m, method in enumerate(METHODS):
            cells = [share(np.abs(by_kind(ratios[:, m], k)) < 1.96) for k in range(3)]
            rmse = [rms(by_kind(errors[:, m], k)) / best[k] for k in range(3)]
            rows.append([kind, method, *cells, " / ".join(f"{x:.2f}" for x in rmse)])
        checks.append([kind, share(p[:, 0] < 0.05), share(p[:, 1] < 0.05)])
    yield f"Share of 95 % intervals that hold the truth, {calibrations} calibrations for each kind of noise:"
    yield table(["noise besides N", "intervals", *KINDS, "RMSE over the first, alike"], rows)
    yield "Share of the calibrations whose p-value is below 0.05:"
    yield table(["noise besides N", "fit of 4 h", "fit of the longest position"], checks)


def drift(kind: str, rng: np.random.Generator, n: int) -> np.ndarray:
    """Slow noise of three axes [m/s²], n samples."""
    if kind == "random walk":
        return np.cumsum(4e-6 / np.sqrt(RATE) * rng.standard_normal((n, 3)), axis=0)
    # From a line spectrum of some five times the record, of which a part is taken.
    return 1e-4 * np.stack([term_noise("B", 5 * n // 2, RATE, rng)[n : 2 * n] for _ in range(3)], axis=1)


class Unit(NamedTuple):
    """What is recorded of a unit, and the truth: bias and row of S + N of each axis."""

    long: np.ndarray
    first: np.ndarray
    means: np.ndarray
    truth: np.ndarray


def unit_of(kind: str, seed: int, index: int) -> Unit:
    """A unit with errors of its own, simulated."""
    rng = np.random.default_rng([seed, list(TERMS).index(kind), index])
    SN, b = 1e-3 * rng.standard_normal((3, 3)), 0.03 * rng.standard_normal(3)
    still, count, step = round(LONG * RATE), round(T * RATE), round((T + PAUSE) * RATE)
    n = still + 5 * step + count
    slow = drift(kind, rng, n)
    noise = slow + N * np.sqrt(RATE) * rng.standard_normal((n, 3))
    each = (noise[still + k * step :][:count] for k in range(6))
    positions = [G * up + b + SN @ (G * up) + own for up, own in zip(UPS.values(), each, strict=True)]
    level = b + slow[still:].mean(axis=0)
    means = np.stack([samples.mean(axis=0) for samples in positions])
    return Unit(noise[:still], positions[0], means, np.concatenate([level[:, None], SN], axis=1))


def model_of(labels: Sequence[str], values: np.ndarray) -> aj.Model:
    """The model with these fitted values, without the terms that were not found."""
    found = dict(zip(labels, np.nan_to_num(values), strict=True))
    return true_model({c: found[label] for c, label in TERM_LABELS.items() if found.get(label)})


def calibrated(kind: str, seed: int, first: int, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors over their standard deviations, and errors, by unit, method, axis and parameter; p-values."""
    units = [unit_of(kind, seed, first + k) for k in range(count)]
    ratios, errors, p = [], [], []
    axes = tuple(Axis(f"accel_{a}", "accel", "m/s²") for a in "xyz")
    places = [Position(name, as_orientation(name), k * (T + PAUSE), T, G) for k, name in enumerate(UPS)]
    for lacks_drift, records in enumerate(([u.long for u in units], [u.first for u in units])):
        setting = Setting(axes, tuple(places), World(G, 0.0, None), lacks_drift=bool(lacks_drift))
        fits = aj.fit_many(aj.allan_deviation(np.concatenate(records, axis=1), RATE), TERMS[kind])
        for k, unit in enumerate(units):
            models = [model_of(fits.coefficients, v) for v in fits.value[3 * k : 3 * k + 3]]
            noise = [parts_of_model(m, RATE) for m in models]
            found, misfit = errors_of(setting, unit.means, noise)
            value, std = np.empty((3, 4)), np.empty((3, 4))
            for i, result in enumerate(found):
                for label, c in result.coefficients.items():
                    place = {"bias": 0, "scale_factor": 1 + i}.get(label)
                    place = 1 + "xyz".index(label[-1]) if place is None else place
                    # So that 1.96 is the limit for all.
                    value[i, place], std[i, place] = c.value, np.diff(c.interval)[0] / 2.0 / 1.96
            errors.append(value - unit.truth)
            ratios.append(errors[-1] / std)
            p.append(misfit.p_value)
    X = np.concatenate([np.ones((6, 1)), G * np.stack(list(UPS.values()))], axis=1)
    size = np.sqrt(np.diag(np.linalg.inv(X.T @ X)))
    for limit in ("white noise", "residuals"):
        for unit in units:
            y = unit.means - G * np.stack(list(UPS.values()))
            plain, left = np.linalg.lstsq(X, y, rcond=None)[:2]
            std = N / np.sqrt(T) * size * np.ones((3, 1))
            if limit == "residuals":
                # Two degrees of freedom.
                std = np.sqrt(left / 2.0)[:, None] * size * student.ppf(0.975, 2) / 1.96
            errors.append(plain.T - unit.truth)
            ratios.append(errors[-1] / std)
    shape = (4, len(units), 3, 4)
    by_unit = [np.moveaxis(np.reshape(x, shape), 0, 1) for x in (ratios, errors)]
    return by_unit[0], by_unit[1], np.reshape(p, (2, len(units))).T


def by_kind(values: np.ndarray, k: int) -> np.ndarray:
    """Of (…, axis, parameter), those of a kind of parameter, in one list."""
    own = np.eye(3, dtype=bool)
    if k == 0:
        return values[..., 0].ravel()
    return values[..., 1:][..., own if k == 1 else ~own].ravel()
