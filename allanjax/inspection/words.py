"""Text of an inspection: events, motion and refusals in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from allanjax.base.wording import plain
from allanjax.inspection.motion import Motion
from allanjax.inspection.quiet import Event
from allanjax.record.recording import Axis
from allanjax.record.units import rate_unit_of

# So many events of a kind are listed; further ones are counted.
_NAMED = 3
# End of a refusal: ways to get coefficients nevertheless.
_REMEDY = (
    "choose a stretch by --start and --stop (start=, stop=, .between), use all by --as-is (as_is=True), or "
    "see what allanjax critique finds"
)


def grid(duration: float) -> float:
    """Rounding of times [s] in a recording this long: a power of ten, 1 s for 300 to 3000 s."""
    return float(10.0 ** np.floor(np.log10(duration / 300.0)))


def seconds(time: float, step: float) -> str:
    """Time in s, rounded to a multiple of this step."""
    digits = max(0, -int(np.floor(np.log10(step))))
    return f"{round(time / step) * step:.{digits}f}"


def span(first: float, last: float, step: float) -> str:
    """Start and end of a time span, e.g. "6–596 s"."""
    return f"{seconds(first, step)}–{seconds(last, step)} s"


def _around(e: Event, rate: float, step: float) -> str:
    """Time span of an event, rounded; outwards if the rounded ends were the same."""
    first, last = e.first / rate / step, e.last / rate / step
    if round(first) == round(last):
        first, last = np.floor(first), np.ceil(last)
    return span(step * first, step * last, step)


def said_of_events(events: Sequence[Event], axes: Sequence[Axis], rate: float, duration: float) -> str:
    """Events as text, e.g. "0–5 s is 170 times noisier than the rest, a step of 1 deg/s at 9 s (gyro_x)"."""
    kinds = ("noisier", "quieter", "silent", "warm-up", "step", "shift", "knock", "spike")
    by_kind = {kind: [e for e in events if e.kind == kind] for kind in kinds}
    clauses = (_clause(kind, of, axes, rate, grid(duration)) for kind, of in by_kind.items() if of)
    return ", ".join(clauses)


def _clause(kind: str, events: Sequence[Event], axes: Sequence[Axis], rate: float, step: float) -> str:
    """Clause about all events of one kind."""
    spans = [_around(e, rate, step) for e in events]
    largest = max(events, key=lambda e: abs(e.size))
    axis = axes[largest.axis]
    size = amount(abs(largest.size), axis)
    spans_, are = listed(spans), "is" if len(spans) == 1 else "are"
    if kind in ("noisier", "quieter"):
        # Two digits, or three where it is near one.
        ratio = plain(largest.size, 2 if largest.size >= 2.0 else 3)
        return f"{spans_} {are} {ratio} times {kind} than the rest"
    if kind == "silent":
        return f"{axis.name} does not change at all in {spans_}"
    if kind == "warm-up":
        until = spans[-1].split("–")[1]
        return f"a warm-up until {until}, {axis.name} {size} off at first"
    if kind == "shift":
        if len(events) == 1:
            return f"{axis.name} moves by {size} in {spans_}"
        return f"the mean moves by up to {size} ({axis.name}) in {spans_}"
    middles = listed([f"{seconds(0.5 * (e.first + e.last) / rate, step)} s" for e in events])
    noun, off = ("single value", " off") if kind == "spike" else (kind, "")
    if len(events) > 1:
        return f"{len(events)} {noun}s of up to {size}{off} at {middles} (largest: {axis.name})"
    of = "" if kind == "spike" else "of "
    return f"a {noun} {of}{size}{off} at {middles} ({axis.name})"


def said_of_motion(moving: Sequence[Motion], axes: Sequence[Axis], disturbed: bool) -> str:
    """Warning that this is no static recording, with the numbers that show it.

    `disturbed` says whether there would be no coefficients for another reason, if it were meant to move.
    """
    reasons, say = [], "--vibrating (vibrating=True)"
    if disturbed:
        say = "--vibrating --as-is (vibrating=True, as_is=True)"
    # The strongest of each sensor, which is the last.
    for m in {axes[m.axis].sensor: m for m in moving}.values():
        axis = axes[m.axis]
        value, limit = amount(m.value, axis), amount(m.limit, axis)
        how = {
            "changes": f"changes by {value} (rms) from one {m.time:.2g} s to the next",
            "wanders": f"wanders over {value}",
            "shakes": f"shakes by {value} (rms)",
        }
        reasons.append(f"{axis.name} {how[m.kind]}, at rest by {limit} at most")
    return (
        f"this does not look like a static recording: {'; '.join(reasons)}. The coefficients are of the "
        "motion, not of the sensor: record it at rest, or choose a stretch at rest by --start and --stop; if "
        f"its platform vibrates and is to, say so by {say}"
    )


def refused(said: str, where: str, share: float) -> str:
    """Refusal because of events that leave too little of the recording; `where` is the longest part left."""
    return (
        f"{said}; no part without it is as long as {100.0 * share:.0f} % of the recording, the longest is "
        f"{where}: {_REMEDY}"
    )


def unclear(said: str) -> str:
    """Refusal because the sensor may have been moved for most of the time."""
    return f"{said}: which of the two is the sensor at rest cannot be told; {_REMEDY}"


def cannot_cut(said: str, where: str, stretch: tuple[float, float]) -> str:
    """Refusal because of events in accumulated samples, which cannot be cut any more."""
    start, stop = (f"{time:.6g}" for time in stretch)
    return (
        f"{said}, and what has been accumulated cannot be taken out again; {where} would do: read again with "
        f"start={start}, stop={stop} (--start {start} --stop {stop}), or use all by as_is=True (--as-is)"
    )


def amount(value: float, axis: Axis, digits: int = 2) -> str:
    """Rate in the recording's unit, e.g. "0.21 deg/s"."""
    unit, scale = rate_unit_of(axis.unit, axis.sensor)
    return f"{plain(value / scale, digits)} {unit}"


def listed(words: Sequence[str], most: int = _NAMED) -> str:
    """Words as a list, e.g. "a, b and c" or "a, b, c and 4 more"."""
    if len(words) > most:
        return f"{', '.join(words[:most])} and {len(words) - most} more"
    return " and ".join(part for part in (", ".join(words[:-1]), *words[-1:]) if part)
