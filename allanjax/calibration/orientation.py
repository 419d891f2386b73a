"""Orientations of a sensor at rest: which of its axes point up, and which north."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from jaxtyping import ArrayLike, Float

from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError

_AXES = "xyz"
# An axis and where it points, as in `x up` or `imu_x-down_2`; bare `up` and `down` are those of z.
_UP = re.compile(r"(?<![a-z])(?:([xyz])[\s_-]*)?(up|down)(?![a-z])")
_NORTH = re.compile(r"(?<![a-z])([xyz])[\s_-]*(north|south|east|west)(?![a-z])")
_SIGNED = re.compile(r"([+-])([xyz])|([xyz])([+-])")
# How far a given matrix may be from a rotation, and a given direction from a unit vector.
_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class Orientation(ByValue):
    """Orientation of a sensor's frame.

    Attributes:
        name: for display, e.g. "x up".
        up: unit vector that points up, by its components along the sensor's axes.
        north: unit vector that points north, alike; None where the heading is not known.
    """

    name: str
    up: Float[np.ndarray, 3]
    north: Float[np.ndarray, 3] | None = None


#: An orientation as functions take it: its name, the upward direction, or a rotation matrix.
OrientationLike: TypeAlias = Orientation | str | ArrayLike | Sequence


def as_orientation(given: OrientationLike) -> Orientation:
    """Orientation from what a user gives.

    Args:
        given: a name, "x up", "z down", "+x" or "x-" (the axis that points up or down), perhaps with a
            heading, "x up, y north"; the direction that points up, three components along the sensor's
            axes; or the matrix [3, 3] that turns such components into those along east, north and up.

    Raises:
        AllanjaxError: none of these.
    """
    if isinstance(given, Orientation):
        return given
    if isinstance(given, str):
        found = orientation_in(given) or _signed(given)
        if found is None:
            raise AllanjaxError(
                f"{given!r} names no orientation: write 'x up', 'z down', '+x' or, with a heading, "
                "'x up, y north'; or give a direction or a matrix"
            )
        return found
    try:
        values = np.asarray(given, dtype=float)
    except (TypeError, ValueError):
        values = np.zeros(0)
    if values.shape == (3,) and abs(np.linalg.norm(values) - 1.0) < _TOLERANCE:
        up = values / np.linalg.norm(values)
        return Orientation("up " + _written(up), up)
    if values.shape == (3, 3) and _is_rotation(values):
        return Orientation(f"up {_written(values[2])}, north {_written(values[1])}", values[2], values[1])
    raise AllanjaxError(
        "an orientation is a name such as 'x up', a unit vector (the components of up along x, y, z), or a "
        "rotation matrix [3, 3] from the sensor's frame to east, north, up"
    )


def orientation_in(text: str) -> Orientation | None:
    """Orientation that a text such as "x up, y north" or "imu_x_up" names; None if it names none.

    Raises:
        AllanjaxError: an axis that points in two directions.
    """
    words = text.lower()
    found = _UP.search(words)
    if found is None:
        return None
    letter, way = found[1] or "z", found[2]
    up = _unit(letter) if way == "up" else 0.0 - _unit(letter)
    name, north = f"{letter} {way}", None
    heading = _NORTH.search(words)
    if heading is not None:
        if heading[1] == letter:
            raise AllanjaxError(f"{text!r}: {letter} points {way}, and cannot point {heading[2]}, too")
        pointing, where = _unit(heading[1]), heading[2]
        # North is up × east.
        north = np.cross(up, pointing) if where in ("east", "west") else pointing
        north = north if where in ("north", "east") else 0.0 - north
        name = f"{name}, {heading[1]} {where}"
    return Orientation(name, up, north)


def six_positions(with_heading: bool) -> tuple[Orientation, ...]:
    """Orientations with an axis up or down; with a heading, each with another axis north, south, too."""
    if not with_heading:
        return tuple(as_orientation(f"{a} {way}") for a, way in itertools.product(_AXES, ("up", "down")))
    every = itertools.product(itertools.permutations(_AXES, 2), ("up", "down"), ("north", "south"))
    return tuple(as_orientation(f"{a} {way}, {b} {where}") for (a, b), way, where in every)


def _signed(text: str) -> Orientation | None:
    found = _SIGNED.fullmatch(text.strip().lower())
    if found is None:
        return None
    sign, letter = found[1] or found[4], found[2] or found[3]
    return as_orientation(f"{letter} {'up' if sign == '+' else 'down'}")


def _is_rotation(C: Float[np.ndarray, "3 3"]) -> bool:
    return np.abs(C @ C.T - np.eye(3)).max() < _TOLERANCE and np.linalg.det(C) > 0.0


def _unit(letter: str) -> Float[np.ndarray, 3]:
    return np.eye(3)[_AXES.index(letter)]


def _written(vector: Float[np.ndarray, 3]) -> str:
    return "(" + ", ".join(f"{x + 0.0:.3g}" for x in vector) + ")"
