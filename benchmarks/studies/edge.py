"""Do 95 % intervals and limits hold where terms are at the edge of detection, and N behind filters?

Sensors are simulated by NumPy and SciPy alone, three axes each, of four kinds, half an hour at 200 Hz and
three hours at 100 Hz: white noise N with a bias instability B (a sum of Gauss–Markov processes, an octave
apart), a random walk K or quantization Q that a fit detects in some of the records only. Each is fitted as a
recording and as a stream. *Holds*: the interval of a coefficient that is detected, or the limit of one that
is not, contains the true value. *Outside*: of axes whose verdict is "fits", those whose model's Allan
deviation leaves the 99.9 % band of the measured one, by its degrees of freedom at each cluster time.

Filters: white noise behind a Butterworth filter of order 1 or 2 with a corner of 15 to 40 of 50 Hz, and up
to three oscillators, read at the samples' instants, of quality factors 6 to 40.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from scipy import signal

import allanjax as aj
from allanjax.base.chi_squared import chi_squared_factors
from benchmarks.common.study import run_tasks, share, table

QUICK: dict[str, Any] = {"records": 1, "filters": 1, "kinds": ("N + K",), "lengths": ("30 min",)}
#: Rate [Hz] and duration [s], and Q [arcsec], N [deg/√h], B [deg/h], K [deg/h/√h] of each kind.
LENGTHS = {"30 min": (200.0, 1800), "3 h": (100.0, 10800)}
KINDS = {
    "N + B + K": {"30 min": (0.0, 0.25, 5.0, 40.0), "3 h": (0.0, 0.25, 3.5, 12.0)},
    "N + K": {"30 min": (0.0, 0.25, 0.0, 35.0), "3 h": (0.0, 0.25, 0.0, 10.0)},
    "N + B": {"30 min": (0.0, 0.25, 5.0, 0.0), "3 h": (0.0, 0.25, 2.5, 0.0)},
    "Q + N + K": {"30 min": (0.10, 0.25, 0.0, 35.0), "3 h": (0.15, 0.25, 0.0, 10.0)},
}
SYMBOLS, DEG = "QNBK", np.pi / 180.0
SI = (DEG / 3600.0, DEG / 60.0, DEG / 3600.0, DEG / 3600.0 / 60.0)
#: Axes of a record; samples, rate [Hz] and N [rad/√s] of the records behind filters.
AXES, SAMPLES, RATE, WHITE = 3, 200_000, 100.0, 1e-3
BAND = 0.999


def flicker(rng: np.random.Generator, n: int, rate: float, B: float) -> np.ndarray:
    """Bias instability of S(f) = B²/(2πf): processes of correlation times an octave apart."""
    found, variance = np.zeros(n), B**2 * np.log(2.0) / np.pi
    for power in range(int(np.floor(np.log2(0.2 / rate))), int(np.ceil(np.log2(30.0 * n / rate)))):
        kept = np.exp(-1.0 / (rate * 2.0**power))
        drive = np.sqrt(variance * (1.0 - kept**2)) * rng.standard_normal(n)
        drive[0] = np.sqrt(variance) * rng.standard_normal()
        found += signal.lfilter([1.0], [1.0, -kept], drive)
    return found


def drawn(kind: str, length: str, seed: int) -> tuple[aj.Recording, dict[str, float]]:
    """Record of three gyros, and the coefficients that they have [SI]."""
    (rate, duration), rng = LENGTHS[length], np.random.default_rng((seed, len(kind), len(length)))
    Q, N, B, K = (value * unit for value, unit in zip(KINDS[kind][length], SI, strict=True))
    n, axes = int(rate * duration), []
    for _ in range(AXES):
        x = N * np.sqrt(rate) * rng.standard_normal(n) + Q * rate * np.diff(rng.standard_normal(n + 1))
        x += K / np.sqrt(rate) * np.cumsum(rng.standard_normal(n))
        axes.append(x + (flicker(rng, n, rate, B) if B else 0.0))
    return aj.Recording.from_array(np.array(axes).T, rate, gyro_unit="rad/s"), dict(
        zip(SYMBOLS, (Q, N, B, K), strict=True)
    )


def outcomes(kind: str, length: str, seed: int) -> list[tuple[str, str, bool, bool]]:
    """Of each fit, axis and coefficient: the fit, symbol, whether it is detected, whether it holds."""
    aj.enable_compilation_cache()
    recording, truth = drawn(kind, length, seed)
    stream, found = aj.AllanAccumulator(recording.rate, recording.axes), []
    stream.update(recording.values)
    for name, fit in (("fit", aj.fit(recording)), ("stream", stream.fit())):
        for axis in fit.results:
            if not axis.measured:
                # A stream cannot leave out what it takes for a disturbance.
                found.append((name, "refused", False, False))
                continue
            for symbol, true in truth.items():
                c = axis[symbol]
                low, high = c.interval if c.detected else (0.0, c.upper_limit)
                # A coefficient that is not there can only be detected wrongly.
                found.append((name, symbol, c.detected, bool(low <= true <= high)))
            if name == "fit" and axis.word == "fits":
                found.append(("fit", "outside", True, leaves_band(axis, fit)))
    return found


def leaves_band(axis: aj.AxisFit, fit: aj.Fit) -> bool:
    """Whether the model's Allan deviation leaves the measured one's band somewhere."""
    k = fit.curve.names.index(axis.axis.name)
    low, high = chi_squared_factors(fit.curve.edf[:, k], BAND)
    model = fit.model_deviation(axis.axis.name, fit.curve.cluster_time)
    ratio = model**2 / fit.curve.variance[:, k]
    return bool(np.any((ratio < low) | (ratio > high)))


def behind_filter(resonances: int, seed: int) -> tuple[bool, float, float]:
    """Whether the interval holds N behind a filter, its relative error, and σ of N, relative."""
    aj.enable_compilation_cache()
    rng = np.random.default_rng((seed, resonances))
    x = signal.sosfilt(
        signal.butter(int(rng.integers(1, 3)), rng.uniform(15.0, 40.0), fs=RATE, output="sos"),
        WHITE * np.sqrt(RATE) * rng.standard_normal(SAMPLES + 4096),
    )[-SAMPLES:]
    for _ in range(resonances):
        x = x + oscillator(rng, WHITE * np.sqrt(RATE) * 10.0 ** rng.uniform(-0.8, -0.1))
    recording = aj.Recording.from_array(x[:, None], RATE, gyro_unit="rad/s", names=["gyro_x"])
    N = aj.fit(recording)["gyro_x"]["N"]
    if not N.detected:
        return N.upper_limit >= WHITE, np.nan, np.nan
    low, high = N.interval
    return bool(low <= WHITE <= high), N.value / WHITE - 1.0, N.std / WHITE


def oscillator(rng: np.random.Generator, amplitude: float) -> np.ndarray:
    """Samples of a damped oscillator driven by white noise, of this standard deviation."""
    w, quality = 2.0 * np.pi * rng.uniform(3.0, 45.0), 10.0 ** rng.uniform(0.8, 1.6)
    damping = w / (2.0 * quality)
    turn, kept = np.sqrt(w**2 - damping**2) / RATE, np.exp(-damping / RATE)
    # Autocovariances at lags 0 to 2, and an autoregression of second order that obeys them.
    once = kept * (np.cos(turn) + damping / (turn * RATE) * np.sin(turn))
    first, second = -2.0 * kept * np.cos(turn), kept**2
    lags = np.array([1.0, once, -first * once - second])
    # Its drive is a moving average over two samples, of these autocovariances.
    moved = lags[1] + first * lags[0] + second * lags[1]
    power = lags[0] + first * lags[1] + second * lags[2] + first * moved
    b = np.sqrt((power + np.sqrt(power**2 - 4.0 * moved**2)) / 2.0)
    drive = rng.standard_normal(SAMPLES + 4096)
    return amplitude * signal.lfilter([b, moved / b], [1.0, first, second], drive)[-SAMPLES:]


def run(
    *,
    records: int = 100,
    filters: int = 100,
    kinds: Sequence[str] = tuple(KINDS),
    lengths: Sequence[str] = tuple(LENGTHS),
    seed: int = 59_100,
) -> Iterator[str]:
    """Records of each kind and length, of three axes, and of each number of resonances."""
    rows, outside = [], []
    for length in lengths:
        for kind in kinds:
            tasks = [(kind, length, seed + k) for k in range(records)]
            found = list(itertools.chain(*run_tasks(outcomes, tasks)))
            outside += [left for _, symbol, _, left in found if symbol == "outside"]
            rows += list(coverage(kind, length, found))
    head = ["", "length", "by", "axes", "refused", *(f"{s}: detected, holds" for s in SYMBOLS)]
    yield f"## Coverage, seeds from {seed} on\n\n{table(head, rows)}"
    yield f'Outside: {sum(outside)} of {len(outside)} axes whose verdict is "fits".'
    behind = []
    for resonances in (0, 1, 3):
        tasks = [(resonances, seed + k) for k in range(filters)]
        held, error, std = zip(*run_tasks(behind_filter, tasks), strict=True)
        bias = f"{100.0 * np.nanmean(error):+.2f} ± {100.0 * np.nanstd(error):.2f}"
        behind.append([resonances, len(held), share(held), bias, f"{100.0 * np.nanmedian(std):.2f}"])
    head = ["resonances", "records", "N holds", "error [%]", "median σ [%]"]
    yield f"## N behind a filter\n\n{table(head, behind)}"


def coverage(kind: str, length: str, found: Sequence[tuple[str, str, bool, bool]]) -> Iterator[list[Any]]:
    """Rows of a kind of sensor: by fit and stream, which share is detected and which share holds."""
    for name in ("fit", "stream"):
        counts = (sum(o[:2] == (name, which) for o in found) for which in ("N", "refused"))
        row: list[Any] = [kind, length, name, *counts]
        for symbol in SYMBOLS:
            own = [(detected, holds) for by, s, detected, holds in found if (by, s) == (name, symbol)]
            detected, holds = zip(*own, strict=True)
            row.append(f"{np.mean(detected):.2f}, {share(holds)}")
        yield row
