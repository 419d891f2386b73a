"""Text of an inspection: events, motion and refusals in words."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

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
    step = grid(duration)
    ordered = sorted(events, key=lambda e: e.kind)
    by_kind = {k: list(g) for k, g in itertools.groupby(ordered, key=lambda e: e.kind)}
    return ", ".join(
        _clause(kind, by_kind[kind], axes, rate, step)
        for kind in ("noisier", "quieter", "silent", "warm-up", "step", "shift", "knock", "spike")
        if kind in by_kind
    )


def _clause(kind: str, events: Sequence[Event], axes: Sequence[Axis], rate: float, step: float) -> str:
    """Clause about all events of one kind."""
    spans = [_around(e, rate, step) for e in events]
    largest = max(events, key=lambda e: abs(e.size))
    axis = axes[largest.axis]
    size = amount(abs(largest.size), axis)
    listed, are = _listed(spans), "is" if len(spans) == 1 else "are"
    if kind in ("noisier", "quieter"):
        return f"{listed} {are} {_ratio(largest.size)} times {kind} than the rest"
    if kind == "silent":
        return f"{axis.name} does not change at all in {listed}"
    if kind == "warm-up":
        until = spans[-1].split("–")[1]
        return f"a warm-up until {until}, {axis.name} {size} off at first"
    if kind == "shift":
        if len(events) == 1:
            return f"{axis.name} moves by {size} in {listed}"
        return f"the mean moves by up to {size} ({axis.name}) in {listed}"
    middles = [f"{seconds(0.5 * (e.first + e.last) / rate, step)} s" for e in events]
    noun = {"step": "step", "knock": "knock", "spike": "single value"}[kind]
    off = " off" if kind == "spike" else ""
    if len(events) == 1:
        of = f"a {noun} {size}{off}" if kind == "spike" else f"a {noun} of {size}"
        return f"{of} at {middles[0]} ({axis.name})"
    of = f"up to {size}{off}"
    return f"{len(events)} {noun}s of {of} at {_listed(middles)} (largest: {axis.name})"


def said_of_motion(moving: Sequence[Motion], axes: Sequence[Axis]) -> str:
    """Warning that this is no static recording, with the numbers that show it."""
    reasons = []
    for m in {axes[m.axis].sensor: m for m in moving}.values():
        axis = axes[m.axis]
        value, limit = amount(m.value, axis), amount(m.limit, axis)
        reasons.append(
            {
                "changes": f"{axis.name} changes by {value} (rms) from one {m.time:.2g} s to the next",
                "wanders": f"{axis.name} wanders over {value}",
                "shakes": f"{axis.name} shakes by {value} (rms)",
            }[m.kind]
            + f", at rest by {limit} at most"
        )
    return (
        f"this does not look like a static recording: {'; '.join(reasons)}. The coefficients are of the "
        "motion, not of the sensor: record it at rest, or choose a stretch at rest by --start and --stop; if "
        "its platform vibrates and is to, say so by --vibrating (vibrating=True)"
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


def amount(value: float, axis: Axis) -> str:
    """Rate in the recording's unit, e.g. "0.21 deg/s"."""
    unit, scale = rate_unit_of(axis.unit, axis.sensor)
    return f"{two_digits(value / scale)} {unit}"


def _ratio(size: float) -> str:
    """Ratio to two digits, or three where it is near one."""
    return two_digits(size) if size >= 2.0 else f"{size:.3g}"


def two_digits(value: float) -> str:
    """Number to two significant digits, e.g. "0.0072", "170"."""
    rounded = float(f"{value:.2g}")
    return f"{rounded:,.0f}" if rounded >= 1e4 else f"{rounded:g}"


def _listed(words: Sequence[str]) -> str:
    """Words as a list, e.g. "a, b and c" or "a, b, c and 4 more"."""
    if len(words) > _NAMED:
        return f"{', '.join(words[:_NAMED])} and {len(words) - _NAMED} more"
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
