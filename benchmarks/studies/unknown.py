"""What does the critic say about an effect of which it knows nothing?

`critique(recording)` of 20 minutes of a 100 Hz gyro in which an effect outside the vocabulary is hidden
(benchmarks/common/unknown_effects.py), at multiples of the amplitude that a detector which knows everything
else just finds. On the first forty kinds the rules were made; the last ten were kept for this report.

*Wrong*: a named cause that is not there, unless it is said to explain its place in part. *Near*: a cause of
the vocabulary that describes the effect rightly, as a line does whose amplitude varies. *Placed*: something
unexplained, or a near cause, in the right domain and at the right place. *Silent*: nothing at all is said.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Any

import allanjax as aj
from benchmarks.common.study import percent, run_tasks, table
from benchmarks.common.unknown_effects import KEPT, MADE_ON, Unknown, draw

QUICK: dict[str, Any] = {"records": 1, "clean": 1, "multiples": (10.0,), "kinds": ("notch", "breathing")}
ALL = tuple(make.__name__ for make in (*MADE_ON, *KEPT))
#: Domains of `unexplained` findings in which an effect shows.
DOMAINS = {
    "time": ("bias", "spectrum"),
    "frequency": ("spectrum",),
    "level": ("level",),
    "values": ("values",),
}

Row = dict[str, Any]


def run(
    *,
    records: int = 5,
    clean: int = 100,
    kinds: tuple[str, ...] = ALL,
    multiples: tuple[float, ...] = (4.0, 10.0, 25.0),
    seed: int = 0,
) -> Iterator[str]:
    tasks = [(kind, seed + k, m) for kind in kinds for m in multiples for k in range(records)]
    rows = run_tasks(examine, [*tasks, *(("nothing", seed + k, 1.0) for k in range(clean))])
    for title, made in (("on which the rules were made", MADE_ON), ("that were kept for this report", KEPT)):
        names = [make.__name__ for make in made]
        if mine := [r for r in rows if r["kind"] in names]:
            yield f"## Kinds {title}\n\n{kinds_table(mine)}"
    alarms = [r for r in rows if r["kind"] == "nothing" and r["told"]]
    which = Counter(cause for r in alarms for cause in r["told"])
    yield f"## Nothing hidden\n\nAny finding in {len(alarms)} of {clean}{f' {dict(which)}' if which else ''}."


def examine(kind: str, seed: int, multiple: float) -> Row:
    """What the critic says about a record, and whether it is so."""
    hidden = draw(kind, seed, multiple)
    found = aj.critique(hidden.values, rate=hidden.rate, gyro_unit="rad/s", names=["gyro_x"])
    told = [f.cause for f in found.findings]
    wrong = [f.cause for f in found.findings if not (f.cause in ("unexplained", *hidden.near) or f.rest)]
    placed = any(is_placed(f, hidden) for f in found.findings)
    return {"kind": kind, "multiple": multiple, "told": told, "wrong": wrong, "placed": placed}


def is_placed(finding: aj.Finding, hidden: Unknown) -> bool:
    """Whether a finding tells the place of what is hidden, by a name that is near or without one."""
    beside = min(finding.span[1], hidden.span[1]) < max(finding.span[0], hidden.span[0])
    if finding.cause == "unexplained":
        domain = finding.details["domain"]
        return domain in DOMAINS[hidden.domain] and (domain == "values" or not beside)
    return finding.cause in hidden.near and not beside


def kinds_table(rows: list[Row]) -> str:
    lines = []
    pairs = dict.fromkeys((r["kind"], r["multiple"]) for r in rows)
    for kind, multiple in [*pairs, ("all", 0.0)]:
        mine = [r for r in rows if (r["kind"], r["multiple"]) == (kind, multiple) or kind == "all"]
        wrong = Counter(cause for r in mine for cause in r["wrong"])
        numbers = [percent(bool(r["wrong"]) for r in mine), percent(r["placed"] for r in mine)]
        numbers.append(percent(not r["told"] for r in mine))
        lines.append([kind, f"{multiple:g}" if multiple else "", len(mine), *numbers, ", ".join(wrong)])
    return table(["kind", "multiple", "records", "wrong, %", "placed, %", "silent, %", "wrong causes"], lines)
