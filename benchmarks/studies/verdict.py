"""Is a right model called incomplete, do intervals hold near what can be detected, is the p-value one?

Records of N, N + K, N + B and Q + N + K, N = 1, simulated independently of the package, of 2¹² to 2¹⁷
samples; the other coefficients are log-uniform between 0.3 and 3 times their detection limits (where their
square is three of its Cramér-Rao standard deviations), so that the fit may take them or not; an interval that
begins at zero may hold them in 97.5 %. The fit chooses its terms, but for the exact likelihood, which is
given the true ones, and a third as many records of 2¹⁴ samples at most. "Drift" is an accelerometer of N + K
as it is common: 298 s at 100 Hz, N 0.06 m/s/√h, K 10.8 m/s/h/√h.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.stats import kstest

from benchmarks.common.ours import columns_of, fit_all, model_of, recording_of
from benchmarks.common.study import run_tasks, share, table
from benchmarks.common.truth import Case, bound, simulate

QUICK: dict[str, Any] = {"records": 6, "drift": 6, "samples": (4096,), "lengths": (1024,)}
QUICK |= {"objectives": ("allan",)}
KINDS = ("N", "NK", "NB", "QNK")
LITTLE = {"Q": 1e-5, "K": 1e-4, "B": 1e-4}
RANGE = (0.3, 3.0)
#: Records together, and K over N of the common accelerometer [1/s].
CHUNK, DRIFT = 6, 10.8 / 0.06 / 3600.0
MOST_EXACT = 16384
TAILS = (0.001, 0.01, 0.05, 0.5)

Found = np.ndarray


def run(
    *,
    records: int = 300,
    drift: int = 60,
    samples: tuple[int, ...] = (4096, 8192, 16384, 32768, 65536, 131072),
    lengths: tuple[int, ...] = (1024, 4096, 32768, 262144, 1048576),
    objectives: tuple[str, ...] = ("allan", "whittle", "wavelet", "exact"),
    seed: int = 1,
) -> Iterator[str]:
    short = tuple(n for n in samples if n <= MOST_EXACT)
    sizes = {o: (short, max(records // 3, CHUNK)) if o == "exact" else (samples, records) for o in objectives}
    tasks = [(kind, *sizes[o], o, seed + k, "") for o in objectives for k, kind in enumerate(KINDS)]
    tasks += [("drift", (29800,), drift, o, seed + 10, "") for o in objectives if o != "exact"]
    yield "## Terms chosen by the fit (given to the exact likelihood)"
    found = dict(zip(tasks, run_tasks(outcomes, tasks), strict=True))
    yield summary({f"{task[3]}: {task[0]}": o for task, o in found.items()})
    yield summary(
        {f"{o}, all": np.concatenate([v for t, v in found.items() if t[3] == o]) for o in objectives}
    )
    given = [
        (kind, (n,), max(records * 4096 // max(n, 4096), 30), objective, seed + 20 + k, kind)
        for n in lengths
        for objective in objectives
        if objective != "exact" or n <= 4096
        for k, kind in enumerate(("N", "NK"))
    ]
    yield "## True terms given, at the upper end of the range"
    tried = dict(zip(given, run_tasks(outcomes, given), strict=True))
    yield summary({f"{t[3]}: {t[0]}, {t[1][0]:,} samples": o for t, o in tried.items()})
    yield summary({"all": np.concatenate(list(tried.values()))})


def outcomes(
    kind: str, samples: tuple[int, ...], records: int, objective: str, seed: int, given: str
) -> Found:
    """Of each record: p-value, "incomplete", N's interval and error in σ, others' intervals, detection."""
    rng, rows = np.random.default_rng(seed), []
    terms = given or (kind if objective == "exact" else "")
    for _ in range(0, records, CHUNK):
        n = int(rng.choice(samples))
        case = case_of(kind, n, rng, (3.0, 3.0) if given else RANGE)
        axes, _ = fit_all(
            recording_of(simulate(case, n, CHUNK, rng)), model_of(terms) if terms else None, objective
        )
        found, truth = columns_of(axes, case), np.stack(list(case.truth.values()), axis=1)
        held = (found["lower"] <= truth) & (truth <= found["upper"])
        error = (found["value"][:, 0] - 1.0) / found["std"][:, 0]
        both = np.stack([held, found["detected"]])[:, :, 1:]
        others = both.mean(axis=2) if both.size else np.full((2, CHUNK), np.nan)
        columns = [[np.nan if axis is None else axis.p_value for axis in axes], [*map(incomplete, axes)]]
        columns += [held[:, 0], error, *others]
        rows.append(np.stack(columns, axis=1))
    return np.concatenate(rows)[:records]


def incomplete(axis: Any) -> float:
    """Whether the fit of an axis is called so, or no measurement; NaN where there is no result."""
    if axis is None:
        return np.nan
    return float(axis.discrepancy > 0.0 or not axis.measured or "does not fit" in str(axis.verdict))


def case_of(kind: str, n: int, rng: np.random.Generator, factors: tuple[float, float]) -> Case:
    """The truth of the next records."""
    truth = {"N": np.ones(CHUNK)}
    if kind == "drift":
        return Case("", truth | {"K": np.full(CHUNK, DRIFT)})
    for symbol in kind.replace("N", ""):
        small = Case("", {"N": 1.0, symbol: LITTLE[symbol]})
        edge = np.sqrt(6.0 * LITTLE[symbol] * bound(small, n)[1])
        truth[symbol] = edge * np.exp(rng.uniform(*np.log(factors), CHUNK))
    return Case("", truth)


def summary(found: dict[str, Found]) -> str:
    rows = []
    for name, o in found.items():
        done = o[np.isfinite(o[:, 1])]
        p, others = done[:, 0], done[np.isfinite(done[:, 4])]
        cells = [name, len(o), len(o) - len(done), share(done[:, 1]), share(done[:, 2])]
        cells += [f"{np.median(np.abs(done[:, 3])):.2f}", share(others[:, 4]), share(others[:, 5])]
        cells += [f"{np.mean(p < tail):.4f}" for tail in TAILS]
        rows.append([*cells, f"{kstest(p, 'uniform').pvalue:.2g}"])
    head = ["records of", "records", "no result", "incomplete"]
    head += ["N's 95 % interval holds", "its median |error| [σ]"]
    head += ["other terms' intervals hold", "other terms detected", *(f"p < {tail:g}" for tail in TAILS)]
    return table([*head, "p of uniformity"], rows)
