"""Equality of results by their values, arrays and NaN included: a pickle of one equals it."""

import copyreg
import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, cast

import numpy as np


class ByValue:
    """Equality of a dataclass by its fields' values, for `@dataclass(frozen=True, eq=False)`.

    The generated equality fails on arrays, and takes two NaN for different. Fields with `compare=False`
    do not count. The hash is that of the texts, integers and flags among the fields: hashing arrays would
    take long.
    """

    def __eq__(self, other: object) -> bool:
        return _same_fields(self, other) if type(other) is type(self) else NotImplemented

    def __hash__(self) -> int:
        values = (getattr(self, field.name) for field in dataclasses.fields(cast(Any, self)) if field.compare)
        return hash((type(self), *(v for v in values if isinstance(v, str | int))))


def equal(a: Any, b: Any) -> bool:
    """Whether two values are the same: numbers or both NaN, arrays, tables, containers, dataclasses."""
    if a is b:
        return True
    if hasattr(a, "__array__") and not hasattr(a, "columns"):
        return hasattr(b, "__array__") and _same_array(np.asarray(a), np.asarray(b))
    if isinstance(a, Mapping):
        return isinstance(b, Mapping) and a.keys() == b.keys() and all(equal(a[key], b[key]) for key in a)
    if type(a) is not type(b) and not (isinstance(a, float) and isinstance(b, float)):
        return False
    if isinstance(a, tuple | list):
        return len(a) == len(b) and all(map(equal, a, b))
    if dataclasses.is_dataclass(a):
        return _same_fields(a, b)
    if hasattr(a, "equals"):  # pandas
        return bool(a.equals(b))
    return bool(a == b) or (a != a and b != b)


def _same_array(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two arrays are equal, NaN being equal to NaN."""
    return np.array_equal(a, b, equal_nan=a.dtype.kind in "fc" and b.dtype.kind in "fc")


def _same_fields(a: Any, b: Any) -> bool:
    """Whether all fields of two dataclasses of one class are equal."""
    names = [field.name for field in dataclasses.fields(a) if field.compare]
    return all(equal(getattr(a, name), getattr(b, name)) for name in names)


def _read_only(items: dict) -> MappingProxyType:
    """Read-only view of a dictionary: what a pickle of such a view is made anew by."""
    return MappingProxyType(items)


# Python does not pickle a read-only view of a dictionary, which recordings and sensors have.
copyreg.pickle(MappingProxyType, lambda view: (_read_only, (dict(view),)))
