"""Recordings of a fleet against the limits of a specification: tables, lines, and rows of a file."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from allanjax.base.tables import Column, columns_from
from allanjax.comparison.specification import (
    NO_AXIS,
    LimitCheck,
    SpecCheck,
    SpecLike,
    check_spec,
    would_decide,
)
from allanjax.estimate.result import Fit
from allanjax.fleet.table import ROWS


def checked(fits: Sequence[Fit], name: str, sheet: SpecLike) -> SpecCheck:
    """Check of a recording of this name, of which there is one fit, or one for each sensor."""
    each = [check_spec(fit, sheet) for fit in fits]
    every = [r for check in each for r in check.results]
    there = {r.limit.section for r in every if r.reason != NO_AXIS}
    # What one fit has no axis of, another may have.
    missing = [r for r in each[0].results if r.limit.section not in there]
    found = [r for r in every if r.reason != NO_AXIS]
    return dataclasses.replace(each[0], name=name, results=(*found, *missing))


def verdict_of(checks: Sequence[SpecCheck]) -> str:
    """How many recordings pass, fail and are undecided."""
    found = [check.verdict for check in checks]
    counts = (f"{found.count(x)} {x}" for x in ("pass", "fail", "undecided") if x in found)
    return f"against {checks[0].sheet}: {', '.join(counts)}"


def table_of_limits(checks: Sequence[SpecCheck]) -> list[Column]:
    """One row per recording: of each limit the verdict and the margin of the worst axis.

    Of many recordings, those that pass are left out.
    """
    shown = [c for c in checks if len(checks) <= ROWS or c.verdict != "pass"][:ROWS]
    titles = dict.fromkeys(_title(r) for check in checks for r in check.results)
    rows = []
    for check in shown:
        worst = {title: _worst([r for r in check.results if _title(r) == title]) for title in titles}
        rows.append((check.name, *worst.values(), check.verdict))
    return columns_from(("recording", *titles, "verdict"), rows)


def lines_of_limits(checks: Sequence[SpecCheck], most: int) -> list[str]:
    """A line for each limit that a recording does not meet, or that is undecided, with margins or reasons."""
    texts = []
    for check in checks:
        parts: dict[tuple[str, str], list[LimitCheck]] = {}
        for r in check.results:
            parts.setdefault((_title(r), r.verdict), []).append(r)
        for (title, verdict), of in parts.items():
            if verdict == "fail":
                margins = "; ".join(f"{r.axis}, margin {r.margin}" for r in of)
                texts.append(f"{check.name}: {title} is not met: {margins}")
            elif verdict == "undecided":
                texts.append(f"{check.name}: {title} is undecided: {_why(of)}")
    more = len(texts) - most
    return texts[:most] + [f"{more} more limits not met or undecided: see fleet_spec.csv"] * (more > 0)


def _why(results: Sequence[LimitCheck]) -> str:
    """Why a limit is undecided on some axes; if a longer record would decide, the length for all of them."""
    seconds = [r.seconds for r in results if r.seconds is not None]
    if len(seconds) == len(results):
        return f"{', '.join(r.axis for r in results)}, {would_decide(max(seconds))}"
    reasons: dict[str, list[str]] = {}
    for r in results:
        reasons.setdefault(r.reason, []).append(r.axis)
    return "; ".join(f"{', '.join(axes)}, {reason}" for reason, axes in reasons.items())


def rows_of_limits(checks: Sequence[SpecCheck], units: Mapping[str, str]) -> Iterator[dict[str, Any]]:
    """Rows of the file: one per recording, axis and limit; sizes in the limit's unit."""
    for check in checks:
        for r in check.results:
            of = r.to_dict()
            estimate = of["estimate"] or {}
            low, high = estimate.get("interval_95") or (None, None)
            keys = ("axis", "figure", "meaning", "limit", "unit")
            yield {
                "recording": check.name,
                "unit_name": units[check.name],
                **{key: of[key] for key in keys},
                "estimate": estimate.get("value"),
                "lower_95": low,
                "upper_95": high,
                "upper_limit_95": estimate.get("upper_limit_95"),
                "margin": r.margin,
                "least_probability": of["probability"][0],
                "verdict": r.verdict,
                "needed_s": of["needed_s"],
                "reason": r.reason,
            }


def _title(r: LimitCheck) -> str:
    """A limit by sensor, or axis, and key."""
    return f"{r.limit.section} {r.limit.title}"


def _worst(results: Sequence[LimitCheck]) -> str:
    """Verdict and margin of the axis that is nearest to failing; "" without any."""
    if not results:
        return ""
    order = ("fail", "undecided", "pass", "typical")
    worst = min(results, key=lambda r: (order.index(r.verdict), r.probability[0]))
    margin = worst.margin.partition(" (")[0]
    return f"{worst.verdict} {margin}".strip()
