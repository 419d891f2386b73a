"""Are Kalman filter, its innovations and the exact likelihood right, how good is the fit by it, and how fast?

    python benchmarks/studies/kalman.py [--first-seed 8400000] [--recordings 34] [--workers 2]

Records are made by NumPy alone; the bound is of the dense covariance of their differences.
"""

from __future__ import annotations

import argparse
import math
import os
import time
from pathlib import Path

import numpy as np
import paths
from scipy.optimize import minimize
from scipy.signal import lfilter
from scipy.stats import kstest

from benchmarks.common.machine import describe
from benchmarks.common.report import publish, run_tasks, share, table

RATE, N_SAMPLES, AXES = 10.0, 1500, 3
WHITE, WALK = 1e-3, 1e-4
# A Markov process of 5 s, whose density at low frequencies is 25 times that of the white noise.
TIME, AMPLITUDE = 5.0, 1e-3
MODELS = {"N + K": (WHITE, WALK), "N + markov": (WHITE, AMPLITUDE, TIME)}
LABELS = {"N + K": ("N", "K"), "N + markov": ("N", "markov_amplitude", "markov_correlation_time")}
WAYS = ("exact", "whittle", "steady-state filter")
LONG = 1_000_000
ABOUT = """# Kalman filter and exact likelihood

## Fits of short records

{count} records of each model (in recordings of {axes} gyros), {n} samples at {rate:g} Hz, from seed
{seed} on, drawn after the code was frozen: N = {white:g} rad/√s with K = {walk:g} rad/s/√s, or with a Markov
process of
q_c = {amplitude:g} rad/s/√s and T_c = {time:g} s. "Cover" is the share of 95 %
intervals with the truth (of a limit where there is no interval), "low" and "high" the shares of those that
lie above and below it; RMSE is of the logarithm of the estimate (of detected ones), over the
Cramér–Rao bound of the exact likelihood. "Not detected" counts amplitudes whose interval includes zero. The
steady-state filter is maximum likelihood with the constant gain of each pair of N and K from the first sample
on, and intervals by its curvature in the logarithms.

{fits}

## Innovations under the true model

Of the same records, filtered by the true model: p-values of the tests, which should be uniform. Kolmogorov's
test of that, and the shares of p-values below 0.05.

{innovations}

## Speed

{speed_about}

{speed}

Reproduce with `{command}`.

{machine}
"""


def record(seed: int, model: str) -> np.ndarray:
    """Samples [n, axes], means over the sample interval, with a constant of any size."""
    rng, h, shape = np.random.default_rng(seed), 1.0 / RATE, (N_SAMPLES, AXES)
    white = WHITE / math.sqrt(h) * rng.standard_normal(shape)
    if model == "N + K":
        steps, bridge = rng.standard_normal(shape), rng.standard_normal(shape)
        drift = WALK * math.sqrt(h) * (np.cumsum(steps, axis=0) - steps / 2.0 + bridge / math.sqrt(12.0))
    else:
        # Means over 50 parts of each interval, which lack a share of 1e-7 of the process's power.
        parts, decay = 50, math.exp(-h / 50.0 / TIME)
        noise = rng.standard_normal((parts * (N_SAMPLES + 1), AXES)) * math.sqrt(1.0 - decay**2)
        noise[0] /= math.sqrt(1.0 - decay**2)
        path = AMPLITUDE * math.sqrt(TIME / 2.0) * lfilter([1.0], [1.0, -decay], noise, axis=0)
        inner = (path[:-1] + path[1:]) / 2.0
        drift = inner[: parts * N_SAMPLES].reshape(N_SAMPLES, parts, AXES).mean(axis=1)
    return white + drift + rng.normal(0.0, 0.01, AXES)


def covariance(model: str, values: tuple[float, ...]) -> np.ndarray:
    """Covariance of the differences of successive samples, from the autocovariance of each term."""
    h, n = 1.0 / RATE, N_SAMPLES - 1
    c = np.zeros(n + 2)
    white = values[0] ** 2 / h
    c[0] += 2.0 * white
    c[1] -= white
    if model == "N + K":
        c[0] += values[1] ** 2 * h * 2.0 / 3.0
        c[1] += values[1] ** 2 * h / 6.0
    else:
        _, q, T = values
        x, lag = h / T, np.arange(n + 3)
        r = np.exp(-x * (lag - 1.0)) * (np.expm1(-x) / x) ** 2
        r[0] = 2.0 * (x + np.expm1(-x)) / x**2
        r = q**2 * T / 2.0 * r
        c += 2.0 * r[: n + 2] - r[1 : n + 3] - r[abs(np.arange(n + 2) - 1)]
    index = np.arange(n)
    return c[abs(index[:, None] - index)]


def bound(model: str) -> np.ndarray:
    """Cramér–Rao bound of the standard deviation of each logarithm."""
    truth, C = MODELS[model], covariance(model, MODELS[model])
    parts = []
    for k in range(len(truth)):
        ends = []
        for sign in (1.0, -1.0):
            values = list(truth)
            values[k] *= math.exp(sign * 1e-4)
            ends.append(covariance(model, tuple(values)))
        parts.append(np.linalg.solve(C, (ends[0] - ends[1]) / 2e-4))
    information = 0.5 * np.array([[np.sum(a * b.T) for a in parts] for b in parts])
    return np.sqrt(np.diag(np.linalg.inv(information)))


def steady_state(x: np.ndarray) -> list[tuple[float, tuple[float, float]]]:
    """N and K with intervals by a constant gain: differences are a moving average of order one."""
    d = np.diff(x)

    def cost(logs: np.ndarray) -> float:
        white, walk = np.exp(2.0 * logs) * np.array([RATE, 1.0 / RATE])
        zero, one = 2.0 * white + 2.0 / 3.0 * walk, -white + walk / 6.0
        rho = one / zero
        theta = (1.0 - math.sqrt(1.0 - 4.0 * rho**2)) / (2.0 * rho)
        s = zero / (1.0 + theta**2)
        e = lfilter([1.0], [1.0, theta], d)
        return 0.5 * len(d) * math.log(s) + 0.5 * float(e @ e) / s

    best = minimize(
        cost, np.log([WHITE, WALK]), method="Nelder-Mead", options={"xatol": 1e-5, "fatol": 1e-7}
    ).x
    h, hessian = 0.02, np.zeros((2, 2))
    for i in range(2):
        for j in range(2):
            a, b = h * np.eye(2)[i], h * np.eye(2)[j]
            corners = cost(best + a + b) - cost(best + a - b) - cost(best - a + b) + cost(best - a - b)
            hessian[i, j] = corners / (4.0 * h**2)
    std = np.sqrt(np.abs(np.diag(np.linalg.pinv(hessian))))
    return [
        (math.exp(m), (math.exp(m - 1.96 * s), math.exp(m + 1.96 * s)))
        for m, s in zip(best, std, strict=True)
    ]


def outcomes(seed: int, model: str) -> tuple[list[tuple], list[tuple[float, float]]]:
    """Every (way, label, estimate, interval, detected) of the axes; and the p-values of the innovations."""
    import allanjax as aj

    x = record(seed, model)
    recording = aj.Recording.from_array(x, RATE, gyro_unit="rad/s")
    found: list[tuple] = []
    for way in ("exact", "whittle"):
        for result in aj.fit(recording, model, way, as_is=True).results:
            for label in LABELS[model]:
                c = result[label]
                known = math.isfinite(c.interval[0])
                interval = c.interval if known else (0.0, c.upper_limit or math.inf)
                found.append((way, label, c.value, interval, c.detected))
    if model == "N + K":
        for column in x.T:
            for label, (value, interval) in zip(LABELS[model], steady_state(column), strict=True):
                found.append(("steady-state filter", label, value, interval, True))
    values = MODELS[model]
    noise = aj.AngleRandomWalk(values[0]) + (
        aj.RateRandomWalk(values[1]) if model == "N + K" else aj.Markov(values[1], values[2])
    )
    filtered = aj.kalman_filter(recording, noise)
    return found, [(r.whiteness.p_value, r.nis.p_value) for r in filtered.results]


def fits_table(outcomes_of: dict[str, list[tuple]]) -> str:
    rows = []
    for model, found in outcomes_of.items():
        for label, truth, limit in zip(LABELS[model], MODELS[model], bound(model), strict=True):
            for way in WAYS:
                mine = [f for f in found if f[:2] == (way, label)]
                if not mine:
                    continue
                value = np.array([f[2] for f in mine])
                low, high = np.array([f[3] for f in mine]).T
                seen = np.array([f[4] for f in mine])
                error = np.log(value[seen] / truth)
                rows.append(
                    [
                        model,
                        label,
                        way,
                        share((low <= truth) & (truth <= high)),
                        f"{np.mean(low > truth):.3f}",
                        f"{np.mean(high < truth):.3f}",
                        f"{np.mean(error):+.3f}",
                        f"{np.sqrt(np.mean(error**2)) / limit:.2f}",
                        f"{np.mean(~seen):.3f}",
                    ]
                )
    head = [
        "model",
        "coefficient",
        "way",
        "cover",
        "low",
        "high",
        "mean log error",
        "RMSE / bound",
        "not detected",
    ]
    return table(head, rows)


def innovations_table(p_of: dict[str, np.ndarray]) -> str:
    rows = []
    for model, p in p_of.items():
        for k, test in enumerate(("whiteness (Ljung–Box, 40 lags)", "size (NIS)")):
            rows.append([model, test, f"{kstest(p[:, k], 'uniform').pvalue:.2g}", share(p[:, k] < 0.05)])
    return table(["model", "test", "Kolmogorov's p", "p < 0.05"], rows)


def speed_table(repeats: int) -> str:
    """Seconds of a filter over a long record, compiled before."""
    import jax

    from allanjax import AngleRandomWalk, Markov, Quantization, RateRandomWalk
    from allanjax.kalman.recursion import Record, State, run_filter, run_smoother
    from allanjax.kalman.system import FilterModel, in_blocks, padded

    model = Quantization(1e-6) + AngleRandomWalk(1e-3) + RateRandomWalk(1e-5) + Markov(1e-4, 100.0)
    z = np.random.default_rng(1).standard_normal(LONG) * 1e-2
    own = FilterModel.of(model, 100.0, LONG / 100.0, "gyro")
    system = padded(own.space, np.concatenate([np.eye(8, 6), own.drift[None]]))
    gaps = np.zeros(LONG, bool)
    gaps[np.random.default_rng(2).integers(0, LONG, LONG // 1000)] = True
    short = slice(0, LONG // 10)
    runs = (
        ("filter", "10⁶ samples", z, None),
        ("filter", "10⁵ samples, one in a thousand missing anywhere", z[short], gaps[short]),
        ("smoother", "10⁵ samples", z[short], None),
        ("smoother", "10⁶ samples", z, None),
    )
    rows = []
    for what, name, samples, missing in runs:
        record = in_blocks(samples, missing)

        states = run_filter(system, record)[2]

        def call(what: str = what, record: Record = record, states: State = states) -> object:
            return run_filter(system, record) if what == "filter" else run_smoother(system, states, record)

        jax.block_until_ready(call())
        times = []
        for _ in range(repeats):
            begun, used = time.perf_counter(), time.process_time()
            jax.block_until_ready(call())
            times.append((time.perf_counter() - begun, time.process_time() - used))
        wall, cpu = (min(t) for t in zip(*times, strict=True))
        rows.append([what, name, f"{wall:.2f} s", f"{cpu:.2f} s"])
    rows.append(["(average load of the machine)", "", f"{os.getloadavg()[0]:.1f}", ""])
    return table(["program", "record", "wall time", "processor time"], rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--first-seed", type=int, default=8_400_000)
    parser.add_argument("--recordings", type=int, default=34, help="recordings of three gyros, of each model")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument("--repeats", type=int, default=5, help="timings, of which the shortest is told")
    parser.add_argument("--quick", action="store_true", help="few records, to see that all of it runs")
    parser.add_argument("--results", type=Path, default=paths.RESULTS / "kalman.md")
    options = parser.parse_args()
    if options.quick:
        options.recordings, options.repeats = 2, 1
    seeds = range(options.first_seed, options.first_seed + options.recordings)
    tasks = [(seed, model) for model in MODELS for seed in seeds]
    found: dict[str, list[tuple]] = {model: [] for model in MODELS}
    p: dict[str, list[tuple[float, float]]] = {model: [] for model in MODELS}
    for (_, model), (estimates, p_values), _ in run_tasks(outcomes, tasks, options.workers):
        found[model] += estimates
        p[model] += p_values
    text = ABOUT.format(
        count=options.recordings * AXES,
        axes=AXES,
        n=N_SAMPLES,
        rate=RATE,
        seed=options.first_seed,
        white=WHITE,
        walk=WALK,
        amplitude=AMPLITUDE,
        time=TIME,
        fits=fits_table(found),
        innovations=innovations_table({model: np.array(values) for model, values in p.items()}),
        speed_about=f"Records under Q + N + K + Markov, six states, compiled before; the shortest of "
        f"{options.repeats} runs. All states are told at every sample, with their standard deviations.",
        speed=speed_table(options.repeats),
        command=f"python benchmarks/studies/kalman.py --first-seed {options.first_seed} "
        f"--recordings {options.recordings}",
        machine=describe(),
    )
    publish(text, options.results, options.quick)


if __name__ == "__main__":
    main()
