"""What do real records, which have no truth, say of their fits?

Four ADIS16405 (six axes, 10⁶ samples at 100 Hz each), an MPU-6050 (11 min), a flight controller (56 s) and an
Xsens MTi (51 s, counts scaled so that gravity is right). Each is fitted as a whole, and its halves.

*Halves*: σ of N of the whole record [%]; by how much N of the halves differs [%], and in joint standard
deviations; the same for B where both halves detect it. *Prediction*: log-likelihood of the second half's
cosine spectrum under the fit of the first, in millinats per sample, above that of the fit without filter,
resonances and lines (`plain`), and above that of allan-variance's coefficients. The lowest ten coefficients,
and four on either side of a line, do not count. *Verdict*: how well the model of the whole record fits.
*Mates*: of four units of one type, the scatter of N, and the bandwidths that the fits found.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

import allanjax as aj
from benchmarks.common.study import data, table

PACKAGES = ("allanjax", "jax", "numpy", "scipy", "allan-variance")
QUICK: dict[str, Any] = {"units": 0, "others": ("xsens",)}
RATE = 100.0
NAMES = tuple(f"{sensor}_{axis}" for sensor in ("gyro", "accel") for axis in "xyz")
# Coefficients that do not count: the lowest, and those on either side of a line.
LOWEST, BESIDE = 10, 4


def run(*, units: int = 4, others: tuple[str, ...] = ("mpu6050", "controller", "xsens")) -> Iterator[str]:
    aj.enable_compilation_cache()
    rows, fits = [], {}
    for name, read in recordings(units, others).items():
        recording = read()
        begun = time.perf_counter()
        whole = aj.fit(recording)
        seconds = time.perf_counter() - begun
        fits[name] = whole
        middle = recording.duration / 2.0
        halves = [recording.between(0.0, middle), recording.between(middle)]
        for result in whole.results:
            rows.append([name, *row(result, halves), f"{seconds:.1f}"])
    head = ["record", "axis", "σ of N [%]", "N₁/N₂ − 1 [%]", "z of N", "z of B"]
    head += ["above plain", "above allan-variance", "verdict", "seconds"]
    yield "## Halves and prediction\n\n" + table(head, rows)
    yield "## Together\n\n" + "\n".join(summary(rows))
    mates = [fits[name] for name in fits if name.startswith("ADIS")]
    if len(mates) > 1:
        yield "## Mates\n\n" + table(
            ["axis", "N of the units", "scatter [%]", "bandwidths [Hz]"], [*alike(mates)]
        )


def recordings(units: int, others: tuple[str, ...]) -> dict[str, Callable[[], aj.Recording]]:
    """How to read each record, by its name."""
    import pandas as pd

    def unit(k: int) -> aj.Recording:
        path = data(f"adis16405_unit{k}.parquet")
        return aj.read(path, rate=RATE, gyro_unit="deg/s", accel_unit="g")

    def mpu() -> aj.Recording:
        # Its stamps are arrival times in bursts.
        samples = pd.read_parquet(data("mpu6050_10min.parquet")).iloc[:, 1:7].to_numpy(float)
        units = {"gyro_unit": "deg/s", "accel_unit": "g"}
        return aj.Recording.from_array(samples, 99.32, names=list(NAMES), **units)

    def xsens() -> aj.Recording:
        counts = pd.read_parquet(data("xsens_mti_counts_52s.parquet")).iloc[:, 1:].to_numpy(float) - 32768.0
        gravity = np.linalg.norm(counts[:, 3:].mean(axis=0))
        samples = counts * np.repeat([2e-4, 9.80665 / gravity], 3)
        units = {"gyro_unit": "rad/s", "accel_unit": "m/s^2"}
        return aj.Recording.from_array(samples, RATE, names=list(NAMES), **units)

    further = {
        "mpu6050": mpu,
        "controller": lambda: aj.read(data("px4_auavx21_56s.parquet"), gaps="segments"),
        "xsens": xsens,
    }
    every = {f"ADIS16405 unit {k}": lambda k=k: unit(k) for k in range(1, units + 1)}
    return every | {name: further[name] for name in others}


def row(result: aj.AxisFit, halves: list[aj.Recording]) -> list[str]:
    """Numbers of one axis."""
    name = result.axis.name
    alone = [half.select(name) for half in halves]
    found = [aj.fit(half)[name] for half in alone]
    if not (result.measured and all(half.measured for half in found)):
        return [name, *["–"] * 6, result.word]
    N = result["N"]
    apart, z = difference(found, "N")
    _, z_of_B = difference(found, "B")
    plain = aj.fit(alone[0], plain=True)[name]
    models = [found[0].model, plain.model, peer(alone[0])]
    lines = [term.frequency for term in found[0].model.terms if isinstance(term, aj.Sinusoid)]
    own, of_plain, of_peer = (likelihood(alone[1], model, lines) for model in models)
    gains = [f"{1e3 * (own - other):+.2f}" for other in (of_plain, of_peer)]
    numbers = [100.0 * N.std / N.value, 100.0 * np.expm1(apart)]
    return [name, *(f"{x:.2f}" for x in numbers), f"{z:+.2f}", f"{z_of_B:+.2f}", *gains, result.word]


def difference(halves: list[aj.AxisFit], symbol: str) -> tuple[float, float]:
    """Difference of a coefficient's logarithms, and the same in standard deviations; nan if undetected."""
    one, two = (half[symbol] for half in halves)
    if not (one.detected and two.detected):
        return np.nan, np.nan
    apart = np.log(one.value / two.value)
    # Each has the error of its logarithm on the side of the other.
    error = np.hypot(one.log_errors[int(apart < 0.0)], two.log_errors[int(apart > 0.0)])
    return float(apart), float(apart / error)


def peer(half: aj.Recording) -> aj.Model:
    """Model of allan-variance's coefficients, computed as they come."""
    from allan_variance import compute_avar, estimate_parameters

    tau, variance = compute_avar(half.values[:, 0], 1.0 / half.rate)
    found, _ = estimate_parameters(tau, variance)
    N, B, K = (max(float(found[key]), 1e-12) for key in ("white", "flicker", "walk"))
    return aj.Model((aj.AngleRandomWalk(N), aj.BiasInstability(B), aj.RateRandomWalk(K)))


def likelihood(half: aj.Recording, model: aj.Model, lines: list[Any]) -> float:
    """Log-likelihood per sample of an axis's cosine coefficients under a model, but for a constant."""
    from scipy.fft import dct

    n, rate = half.n, half.rate
    c = dct(half.values[:, 0] - half.values[:, 0].mean(), norm="ortho")[1:]
    frequency = np.arange(1, n) * rate / (2.0 * n)
    counts = np.arange(1, n) > LOWEST
    for line in lines:
        counts &= abs(frequency - float(line)) > BESIDE * rate / (2.0 * n)
    level = rate * np.asarray(model.sampled(rate).sampled_psd(frequency, rate))
    each = -0.5 * (c**2 / level + np.log(level))
    return float(each[counts].sum() / n)


def summary(rows: list[list[str]]) -> Iterator[str]:
    """What all axes say together."""
    measured = [r for r in rows if r[2] != "–"]
    sigma = np.array([float(r[2]) for r in measured])
    yield f"- relative σ of N: median {np.median(sigma):.2f} %, largest {sigma.max():.2f} %"
    close = [float(r[2]) > 5.0 and abs(float(r[3])) < 5.0 for r in measured]
    yield f"- axes above 5 % whose halves agree within 5 %: {sum(close)} of {len(measured)}"
    for symbol, k in (("N", 4), ("B", 5)):
        z = np.array([float(r[k]) for r in measured])
        known = z[np.isfinite(z)]
        yield f"- |z| of {symbol} below 2: {np.sum(abs(known) < 2.0)} of {len(known)}"
    for other, k in (("plain", 6), ("allan-variance", 7)):
        better = [float(r[k]) >= 0.0 for r in measured]
        yield f"- predicts the other half at least as well as {other}: {sum(better)} of {len(measured)}"
    off = [r for r in rows if r[8].startswith("does not fit")]
    yield f"- axes that do not fit: {len(off)} of {len(rows)}"


def alike(fits: list[aj.Fit]) -> Iterator[list[str]]:
    """Units of one type side by side."""
    for name in NAMES:
        own = [fit[name] for fit in fits if fit[name].measured]
        values = np.array([r["N"].in_unit().value for r in own])
        widths = [r.model.response.half_power for r in own if r.model.response is not None]
        scatter = 100.0 * np.std(np.log(values), ddof=1)
        shown = ", ".join(f"{x:.3g}" for x in values)
        yield [
            name,
            f"{shown} {own[0]['N'].in_unit().unit}",
            f"{scatter:.1f}",
            ", ".join(f"{w:.3g}" for w in widths),
        ]
