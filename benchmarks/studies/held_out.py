"""Do the gains that findings have on held-out data come true on another record of the same sensor?

`critique(recording)` of a record with a hidden effect (benchmarks/common/hidden_effects.py) tells what its
findings gain on data that they were not estimated from. Another record has the same sensor and the same
effect, with the same course in time, but its own noise. Its log-likelihood under the extended model of the
first record, less that under the first one's baseline, both as they are, is what is gained there. Records
with several findings count with the sum.

The log-likelihood is that of the cosine coefficients c of the other record, less what the findings subtract
from the first one, under the expected squares v of the first one's stages: −½ Σ (ln v + c²/v). Where a filter
leaves less than a hundredth of the noise, the ends of a record dominate, and coefficients do not count.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.fft import dct
from scipy.stats import theilslopes

import allanjax as aj
from benchmarks.common.hidden_effects import draw
from benchmarks.common.hidden_verdict import recording_of
from benchmarks.common.study import run_tasks, table

QUICK: dict[str, Any] = {"records": 1, "causes": ("low_pass",), "duration": 160.0, "rate": 50.0}
CAUSES = (
    "bias_step",
    "warm_up",
    "telegraph",
    "temperature",
    "resonance",
    "low_pass",
    "power_law",
    "sinusoid",
)
DEEP = 0.01

Row = dict[str, Any]


def run(
    *,
    records: int = 16,
    causes: tuple[str, ...] = CAUSES,
    duration: float = 600.0,
    rate: float = 50.0,
    seed: int = 0,
) -> Iterator[str]:
    tasks = [(c, seed + k, duration, rate) for c in causes for k in range(records)]
    rows = [row for row in run_tasks(examine, tasks) if row["findings"]]
    lines = [line(cause, [r for r in rows if r["cause"] == cause]) for cause in causes]
    head = ["hidden", "records with findings", "told, nats", "come true, nats", "median ratio", "slope"]
    yield "Medians; slope: of what comes true by what is told (Theil–Sen)."
    yield table(head, [*lines, line("all", rows)])


def examine(cause: str, seed: int, duration: float, rate: float) -> Row:
    """Gain told for a record, and the gain on another one."""
    size = {"duration": duration, "rate": rate}
    first, other = (draw(seed, cause, (2.0, 8.0), noise=k, **size) for k in (1, 2))
    found = aj.critique(recording_of(first))
    axis = found.results[0]
    before, after = axis.stages[0], axis.stages[-1]
    path = before.x - after.x
    passed = True if after.factor is None else after.factor >= DEEP
    y = other.values[:, 0]
    gain = float(np.sum(likelihood(y - path, after) - likelihood(y, before), where=passed))
    return {"cause": cause, "findings": len(found.findings), "told": found.gain, "true": gain}


def likelihood(x: np.ndarray, stage: Any) -> np.ndarray:
    """Log-likelihood of each coefficient of a record under the noise of a stage, its ramp included."""
    c = dct(x - x.mean(), norm="ortho")[1:]
    if stage.ramp:
        t = np.arange(len(x)) / stage.rate
        c -= stage.ramp * dct(t - t.mean(), norm="ortho")[1:]
    return -0.5 * (np.log(stage.variance) + c**2 / stage.variance)


def line(cause: str, rows: list[Row]) -> list[Any]:
    """What is told of an effect and comes true."""
    told, true = (np.array([r[name] for r in rows]) for name in ("told", "true"))
    if len(rows) < 2:
        return [cause, len(rows), *["–"] * 4]
    ratio, slope = np.median(true / told), theilslopes(true, told).slope
    middle = (f"{np.median(x):.1f}" for x in (told, true))
    return [cause, len(rows), *middle, f"{ratio:.2f}", f"{slope:.2f}"]
