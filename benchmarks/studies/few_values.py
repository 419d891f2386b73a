"""Do the intervals of `random_effects` cover where a few values happen to lie close?

Values of a common value of zero, with known errors (all 1; or from 0.5 to 2, geometric; or gamma errors of
skewness 1.5) and a normal scatter, in units of the mean error. Lower half: the draws whose Q at the true
scatter is below its median, which seem more certain than they are. Given are the shares of draws whose 95 %
interval holds the common value, in all draws and in that half; in that half also by Hartung & Knapp's factor,
and by the same never below one (Röver, Knapp & Friede 2015), both with Student's t; then the median length of
the interval over that of the best possible one, which knows the scatter; and the share of the lower half in
which the scatter is below its 95 % limit. For equal errors, and for two values, the interval is a function of
Q and the mean alone; it is computed for 300 values of Q.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

import allanjax as aj
from benchmarks.common.study import run_tasks, table

QUICK: dict[str, Any] = {"draws": 2000, "counts": (2, 3), "scatters": (0.0,), "kinds": ("equal",)}
SKEWNESS, PARTS = 1.5, 20


class Found(NamedTuple):
    """Ends of the interval less the weighted mean, limit of the scatter, τ, and the error of the mean."""

    low: Any
    high: Any
    limit: Any
    scatter: Any
    std: Any


def run(
    *,
    draws: int = 20_000,
    counts: tuple[int, ...] = (2, 3, 4, 10),
    scatters: tuple[float, ...] = (0.0, 1.0, 3.0, 30.0),
    kinds: tuple[str, ...] = ("equal", "unequal", "skewed"),
    seed: int = 1,
) -> Iterator[str]:
    head = ["values", "scatter", "covered", "in the lower half", "Hartung & Knapp", "never below one"]
    head += ["length", "scatter below its limit"]
    for kind in kinds:
        rows = [
            [k, f"{tau:g}", *covered(kind, k, tau, draws, np.random.default_rng([seed, k, int(10 * tau)]))]
            for k in counts
            for tau in scatters
        ]
        yield f"{kind.capitalize()} errors:\n\n" + table(head, rows)


def covered(kind: str, k: int, tau: float, draws: int, rng: np.random.Generator) -> list[str]:
    """Cells of a row."""
    s = np.geomspace(0.5, 2.0, k) if kind == "unequal" else np.ones(k)
    x = errors(kind, (draws, k), rng) * s + tau * rng.standard_normal((draws, k))
    mean, q = weighted(x, s, 0.0)
    at_true = weighted(x, s, tau)[1]
    lower = at_true < np.median(at_true)
    if k == 2 or kind != "unequal":
        found = interpolated(kind, x, s, q)
    else:
        parts = np.array_split(x, PARTS)
        found = Found(*np.concatenate(run_tasks(several, [(part, s) for part in parts])).T)
    is_in = (mean + found.low < 0.0) & (mean + found.high > 0.0)
    w = 1.0 / (s**2 + found.scatter[:, None] ** 2)
    by_tau = (w * x).sum(axis=1) / w.sum(axis=1)
    factor = np.sqrt(np.where(found.scatter > 0.0, 1.0, q / (k - 1)))
    t = stats.t.ppf(0.975, k - 1)
    plain, modified = (abs(by_tau) < t * found.std * f for f in (factor, np.maximum(factor, 1.0)))
    best = 2.0 * stats.norm.ppf(0.975) / np.sqrt(np.sum(1.0 / (s**2 + tau**2)))
    shares = [is_in, is_in[lower], plain[lower], modified[lower]]
    length = f"{np.median(found.high - found.low) / best:.2f}"
    return [*(f"{np.mean(hits):.3f}" for hits in shares), length, f"{np.mean(found.limit[lower] >= tau):.3f}"]


def errors(kind: str, size: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Errors of unit variance."""
    if kind != "skewed":
        return rng.standard_normal(size)
    shape = 4.0 / SKEWNESS**2
    return (rng.standard_gamma(shape, size) - shape) / np.sqrt(shape)


def weighted(x: np.ndarray, s: np.ndarray, tau: float) -> tuple[np.ndarray, np.ndarray]:
    """Weighted means of values, and Q."""
    w = 1.0 / (s**2 + tau**2)
    mean = x @ w / w.sum()
    return mean, (x - mean[:, None]) ** 2 @ w


def several(x: np.ndarray, s: np.ndarray) -> np.ndarray:
    """What is found for each set of values, in rows."""
    return np.array([one(each, s) for each in x])


def one(x: np.ndarray, s: np.ndarray, kind: str = "") -> Found:
    found = aj.random_effects(x, s, skewness=SKEWNESS if kind == "skewed" else None)
    mean = weighted(x[None], s, 0.0)[0][0]
    low, high = found.interval
    return Found(low - mean, high - mean, found.scatter_limit, found.scatter, found.std)


def interpolated(kind: str, x: np.ndarray, s: np.ndarray, q: np.ndarray) -> Found:
    """The same where it depends on the mean and Q alone; of two values the sign matters, too."""
    along = np.arange(len(s)) - np.average(np.arange(len(s)), weights=s**-2.0)
    unit = along / np.sqrt(np.sum((along / s) ** 2))
    grid = np.geomspace(max(q.min(), 1e-9), q.max(), 300)
    at = np.array([one(np.sqrt(each) * unit, s, kind) for each in grid]).T
    low, high, *rest = (np.interp(np.log(q), np.log(grid), each) for each in at)
    turned = (x[:, 1] < x[:, 0]) & (kind == "unequal")
    return Found(np.where(turned, -high, low), np.where(turned, -low, high), *rest)
