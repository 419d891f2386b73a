"""Do `fit` and `critique` recognize steep filters, whatever the rounding and the length of a record?

Sensors are drawn by seed and simulated by NumPy and SciPy alone: white noise N, in half of them also a
random walk, behind `scipy.signal.butter` of order 1 to 8 with a bandwidth of 0.2 to 0.8 of half the sample
rate, or behind a cascade of 1 to 4 equal moving averages over 2 to 8 samples, as in converters. The samples
are rounded to 0, 0.2 or 1 of their standard deviation.

*N*: within 5 %, or two of its standard deviations. *Fits*: the fit takes its model for a measurement. *Told*:
the critique tells the filter with its bandwidth within 10 %, and the rounding to one standard deviation, and
nothing else. *Tests*: median number of tests of the simulation that fail after that.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy import signal

import allanjax as aj
from benchmarks.common.study import run_tasks, share, table

QUICK: dict[str, Any] = {"records": 1, "orders": (6,), "lengths": (14,)}
#: Samples before a record begins; distance of N and of the bandwidth; frequencies where a mean is evaluated.
SETTLING, NEAR, BANDWIDTH, GRID = 4096, 0.05, 0.1, 1 << 14
#: p-value below which a test of the simulation fails.
FAILS = 1e-3
ORDERS = {"butterworth": 8, "moving_average": 4}
ROUNDING = (0.0, 0.2, 1.0)
WANTED = ("≥ 0.95", "≥ 0.95")


class Outcome(NamedTuple):
    """What became of one record."""

    near: bool
    fits: bool
    told: bool
    failing: float
    seconds: float
    text: str


def drawn(kind: str, order: int, rounding: float, n: int, seed: int) -> tuple[np.ndarray, dict[str, float]]:
    """Samples, and the truth: rate, N, bandwidth [Hz]."""
    rng = np.random.default_rng((seed, order, round(10 * rounding), n, len(kind)))
    rate, N = float(rng.choice([50.0, 100.0, 200.0, 400.0])), 10.0 ** rng.uniform(-4.5, -3.0)
    K = N * 10.0 ** rng.uniform(-2.5, -1.5) * (rng.random() < 0.5)
    white, steps = rng.standard_normal((2, SETTLING + n))
    x = N * np.sqrt(rate) * white + K / np.sqrt(rate) * np.cumsum(steps)
    if kind == "butterworth":
        bandwidth = rng.uniform(0.2, 0.8) * rate / 2.0
        x = signal.sosfilt(signal.butter(order, bandwidth, fs=rate, output="sos"), x)
    else:
        mean = np.ones(samples := int(rng.integers(2, 9))) / samples
        for _ in range(order):
            x = signal.lfilter(mean, 1.0, x)
        f, response = signal.freqz(mean, worN=GRID, fs=rate)
        bandwidth = f[np.argmax(abs(response) ** (2 * order) < 0.5)]
    x = x[SETTLING:]
    step = rounding * x.std()
    x = step * np.round(x / step) if step else x
    return x, {"rate": rate, "N": N, "bandwidth": bandwidth}


def outcome(kind: str, order: int, rounding: float, power: int, seed: int) -> Outcome:
    """Fit and critique of one record; an exception counts as nothing right."""
    aj.enable_compilation_cache()
    x, truth = drawn(kind, order, rounding, 2**power, seed)
    recording = aj.Recording.from_array(x[:, None], truth["rate"], gyro_unit="rad/s", names=["gyro_x"])
    begun = time.perf_counter()
    try:
        axis, critique = aj.fit(recording)["gyro_x"], aj.critique(recording)["gyro_x"]
    except Exception as error:
        return Outcome(False, False, False, np.nan, np.nan, f"{type(error).__name__}: {error}")
    N = axis["angle_random_walk"]
    near = abs(N.value - truth["N"]) < max(NEAR * truth["N"], 2.0 * N.std)
    causes = {finding.cause: finding for finding in critique.findings}
    wanted, told = {"low_pass", *["rounding"] * (rounding == 1.0)}, False
    if causes.keys() == wanted and len(critique.findings) == len(wanted):
        found = causes["low_pass"].parameters["bandwidth"]
        told = abs(found.value / truth["bandwidth"] - 1.0) < max(BANDWIDTH, 2.0 * found.std / found.value)
    failing = float(sum(d.p_value < FAILS for d in critique.after))
    text = (
        f"N {N.value / truth['N']:.3f} ± {N.std / truth['N']:.3f} {axis.model.response}; {', '.join(causes)}"
    )
    return Outcome(near, axis.measured, told, failing, time.perf_counter() - begun, text)


def run(
    *,
    records: int = 2,
    orders: Sequence[int] = (1, 2, 3, 4, 5, 6, 7, 8),
    lengths: Sequence[int] = (14, 16, 18),
    seed: int = 59_000,
) -> Iterator[str]:
    """Records of each filter, rounding and length; lengths are powers of two."""
    tasks = [
        (kind, order, rounding, length, seed + k)
        for kind, most in ORDERS.items()
        for order in orders
        for rounding in ROUNDING
        for length in lengths
        for k in range(records)
        if order <= most
    ]
    found = list(zip(tasks, run_tasks(outcome, tasks), strict=True))
    rows: list[list[Any]] = [["wanted", "", WANTED[0], "", WANTED[1], "", ""]]
    for name, own in _groups(found, orders, lengths):
        if not own:
            continue
        near, fits, told, failing, seconds, _ = zip(*own, strict=True)
        rows.append(
            [
                name,
                len(own),
                share(near),
                share(fits),
                share(told),
                round(np.nanmean(failing), 1),
                round(np.nanmedian(seconds), 1),
            ]
        )
    head = ["", "records", "N", "fits", "told", "tests that fail", "seconds"]
    yield f"## All records, seeds from {seed} on\n\n{table(head, rows)}"
    wrong = [(*task, r.text) for task, r in found if not (r.near and r.fits and r.told)]
    head = ["filter", "order", "rounding", "length", "seed", "N of the true one; findings"]
    yield f"## Records with an error\n\n{table(head, wrong)}" if wrong else ""


def _groups(
    found: Sequence[tuple[tuple[Any, ...], Outcome]], orders: Sequence[int], lengths: Sequence[int]
) -> Iterator[tuple[str, list[Outcome]]]:
    """Outcomes of all records, and of those of each filter and order, rounding, and length."""
    yield "all", [own for _, own in found]
    for kind in ORDERS:
        for order in orders:
            yield f"{kind}, order {order}", [r for task, r in found if task[:2] == (kind, order)]
    for rounding in ROUNDING:
        yield f"rounding to {rounding:g} σ", [r for task, r in found if task[2] == rounding]
    for length in lengths:
        yield f"2^{length} samples", [r for task, r in found if task[3] == length]
