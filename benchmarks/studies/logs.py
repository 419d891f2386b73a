"""Are logs of all kinds read right, or refused with a remedy that leads to the right result?

Each seed draws a log as loggers, terminals, drivers and spreadsheets write them, with white noise that
differs from axis to axis (`benchmarks/common/logged_texts.py`). It is read without any option. Where it is
refused, the first remedy of the message that its owner can follow is followed, up to three in a row; owners
know units, rate and the order of columns. *Right*: all axes, the rate within 0.2 %, and the white noise, from
the differences of neighbours, within 3 % of that of the samples written; of a part of these, or with others
filled in, within 3 % and four standard errors. Seeds below 1000 served to develop the readers; of seeds from
1000 to 1779 four were refused and one was wrong (a torn row whose numbers were taken apart, since mended).
"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from remedies import Followed, follow

import allanjax as aj
from benchmarks.common.logged_texts import LAYOUTS, SIX, Log, drawn
from benchmarks.common.study import share, table

QUICK: dict[str, Any] = {"count": len(LAYOUTS)}
OUTCOMES = ("right", "right by its remedy", "refused", "wrong")
_RATE, _NOISE = 2e-3, 0.03


def run(*, seed: int = 2000, count: int = 400, show: bool = False) -> Iterator[str]:
    found: dict[str, Counter[str]] = {kind: Counter() for kind in LAYOUTS}
    examples = []
    with tempfile.TemporaryDirectory() as folder:
        for number in range(seed, seed + count):
            log = drawn(number)
            outcome, told = judged(log, Path(folder))
            found[log.kind][outcome] += 1
            if outcome in OUTCOMES[2:]:
                examples.append(f"- {number} ({log.kind}), {outcome}: {told}")
    rows = [[kind, *(counts[outcome] for outcome in OUTCOMES)] for kind, counts in found.items()]
    total: Counter[str] = sum(found.values(), Counter())
    right = sum(total[outcome] for outcome in OUTCOMES[:2])
    hits = np.arange(count) < right
    rows.append(["all", *(total[outcome] for outcome in OUTCOMES)])
    yield table(["log", *OUTCOMES], rows)
    yield f"Right in {share(hits)} of {count} logs, {total['wrong']} wrong."
    yield "\n".join(examples if show else examples[:40])


def judged(log: Log, folder: Path) -> tuple[str, str]:
    """What comes of a log, and why."""
    path = log.write(folder)
    known = {name: value for name, value in log.known.items() if value is not None}
    done = follow(lambda **options: aj.read(path, **options), known)
    if done.recording is None:
        return "refused", f"{[*done.steps]} {done.message.replace(str(path), log.name)[:300]}"
    why = difference(log, done)
    if why:
        return "wrong", f"{[*done.steps]} {why}"
    return ("right by its remedy" if done.steps else "right"), ""


def difference(log: Log, done: Followed) -> str:
    """What of a recording is not as it was written; "" if nothing."""
    recording = done.recording
    assert recording is not None
    names = SIX[: log.samples.shape[1]]
    if set(recording.names) != set(names):
        return f"axes {', '.join(recording.names)}"
    if abs(recording.rate / log.rate - 1.0) > _RATE:
        return f"{recording.rate:.6g} Hz, not {log.rate:g} Hz"
    got = np.array([density(recording[name].values, recording.rate)[0] for name in names])
    off = got / density(log.samples, log.rate) - 1.0
    # A part has other samples, and four standard errors of its noise.
    chance = 4.0 * np.sqrt(0.75 / recording.n) if recording.n != len(log.samples) else 0.0
    return "" if (abs(off) < _NOISE + chance).all() else f"noise off by {np.round(100 * off, 1).tolist()} %"


def density(values: np.ndarray, rate: float) -> np.ndarray:
    """White noise of each axis, from differences of neighbours."""
    return np.sqrt(np.mean(np.diff(values, axis=0) ** 2, axis=0) / 2.0 / rate)
