"""Is the size of a variation of N told, and is the record's mean covered?

White noise whose amplitude varies over 50 minutes at 100 Hz, with a random walk beside it, simulated by NumPy
alone, three axes each: a random walk of the amplitude of 2 % (rms about its mean), a step of 5 %, a tenth of
the record 1.3 times as loud, a sinusoid of 3 %, and none. A louder tenth may be told as a burst, with its
share and what it adds; it counts as told if both together are the change of the record's amplitude.

*Told*: axes on which a variation or a louder burst is told. *Size*: median over axes of the size told over
the true one, by the standard deviation over the record, or for a louder tenth by what it adds to the mean.
*Covers*: the 95 % interval of N contains the root mean square of the amplitude over the record, for a louder
tenth that of the record or of the quiet part, as the fit says which it takes. *σ*: median standard deviation
of N, relative to it.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

import allanjax as aj
from benchmarks.common.study import run_tasks, share, table

QUICK: dict[str, Any] = {"records": 1}
RATE, SAMPLES, AXES, WHITE, WALK = 100.0, 300_000, 3, 1e-3, 1e-6
KINDS = ("walk of 2 %", "step of 5 %", "1.3 × for a tenth", "sinusoid of 3 %", "none")


def amplitude(kind: str, rng: np.random.Generator) -> np.ndarray:
    """Amplitude of the noise over the record, relative to about its mean."""
    place = (np.arange(SAMPLES) + 0.5) / SAMPLES
    if kind.startswith("walk"):
        walk = np.cumsum(rng.standard_normal(SAMPLES))
        return 1.0 + 0.02 * (walk - walk.mean()) / walk.std()
    if kind.startswith("step"):
        return np.where(place < rng.uniform(0.25, 0.75), 1.0, 1.05)
    if kind.startswith("1.3"):
        start = rng.uniform(0.0, 0.9)
        return np.where((place > start) & (place < start + 0.1), 1.3, 1.0)
    if kind.startswith("sinusoid"):
        return 1.0 + 0.03 * np.sin(2.0 * np.pi * (rng.uniform(3.0, 12.0) * place + rng.random()))
    return np.ones(SAMPLES)


def outcome(kind: str, seed: int) -> list[tuple[bool, float, bool, float]]:
    """For each axis: whether a variation is told, its size over the true one, coverage, and relative σ."""
    aj.enable_compilation_cache()
    rng = np.random.default_rng((seed, len(kind)))
    course, found = amplitude(kind, rng), []
    white, steps = rng.standard_normal((2, SAMPLES, AXES))
    x = WHITE * np.sqrt(RATE) * course[:, None] * white + WALK / np.sqrt(RATE) * np.cumsum(steps, axis=0)
    quiet, whole = WHITE, WHITE * np.sqrt(np.mean(course**2))
    louder = kind.startswith("1.3")
    for result in aj.fit(aj.Recording.from_array(x, RATE, gyro_unit="rad/s")).results:
        N = result["N"]
        low, high = N.interval
        v = N.variation
        told = v is not None and (v.size > 0.0 or v.louder > 0.0)
        size = np.nan
        if v is not None and louder and v.excess > 0.0:
            size = v.excess / (whole / quiet - 1.0)
        elif v is not None and v.size > 0.0:
            size = v.size / np.std(course)
        covers = low <= whole <= high or (louder and low <= quiet <= high)
        found.append((told, size, covers, N.std / N.value))
    return found


def run(*, records: int = 20, seed: int = 71_000) -> Iterator[str]:
    """Records of each kind."""
    tasks = [(kind, seed + k) for kind in KINDS for k in range(records)]
    results = dict(zip(tasks, run_tasks(outcome, tasks), strict=True))
    wanted = ["wanted", "", "", "0.9–1.1", "≥ 0.93", ""]
    rows: list[list[Any]] = [wanted]
    for kind in KINDS:
        own = [axis for task, found in results.items() if task[0] == kind for axis in found]
        told, size, covers, sigma = zip(*own, strict=True)
        known = np.array(size)[np.isfinite(size)]
        middle = (
            f"{np.median(known):.3f} ± {1.25 * np.std(known) / np.sqrt(len(known)):.3f}" if len(known) else ""
        )
        rows.append([kind, len(own), share(told), middle, share(covers), f"{100.0 * np.median(sigma):.2f} %"])
    head = ["amplitude", "axes", "told", "size", "covers", "σ"]
    yield f"## {records} records of each kind, seeds from {seed} on\n\n{table(head, rows)}"
