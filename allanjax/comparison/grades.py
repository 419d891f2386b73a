"""Grades of inertial sensors by published limits."""

from __future__ import annotations

import functools
import tomllib
from collections.abc import Iterable, Mapping
from importlib.resources import files

from allanjax.noise.estimate import Estimate
from allanjax.record.units import Sensor, parse_quantity, unit_scale

#: Grade of what is beyond the limits of all others.
LAST = "consumer"


@functools.cache
def grades() -> tuple[Mapping[str, Mapping[tuple[str, str], float]], str]:
    """Limits [SI] of each grade by sensor and coefficient, the best grade first, and their source."""
    tables = tomllib.loads(files(__package__).joinpath("grades.toml").read_text(encoding="utf-8"))
    source, found = str(tables.pop("source")), {}
    for name, of_sensor in tables.items():
        limits = {}
        for sensor, quantities in of_sensor.items():
            for label, text in quantities.items():
                value, unit = parse_quantity(text) or (float("nan"), "")
                limits[sensor, label] = float(value) * unit_scale(unit, sensor)
        found[name] = limits
    return found, source


def grade(estimates: Iterable[Estimate], sensor: Sensor, label: str) -> str:
    """Grade of a sensor by the largest of its axes, e.g. "tactical" or "navigation to tactical".

    It is the first whose limit is not exceeded, at both ends of the 95 % interval; "" without a limit.
    """
    known = [e for e in estimates if e.detected or e.held or e.upper_limit is not None]
    limits = [(name, of[sensor, label]) for name, of in grades()[0].items() if (sensor, label) in of]
    if not known or not limits:
        return ""

    def first(size: float) -> str:
        return next((name for name, limit in limits if size <= limit), LAST)

    high = max((e.interval[1] if e.detected else e.upper_limit or e.value) for e in known)
    low = max((e.interval[0] if e.detected else 0.0) for e in known)
    best, worst = first(low), first(high)
    return best if best == worst else f"{best} to {worst}"
