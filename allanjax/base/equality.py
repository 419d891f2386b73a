"""Equality of results by value, including arrays and NaN, so that a result equals its pickled copy."""

import copyreg
import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, cast

import numpy as np


class ByValue:
    """Mixin for `@dataclass(frozen=True, eq=False)`: equality by the values of the fields.

    The equality that `dataclass` generates fails for arrays and treats two NaN as different. Fields with
    `compare=False` are ignored. The hash uses only texts, integers and flags, as hashing arrays is slow.
    """

    def __eq__(self, other: object) -> bool:
        return _same_fields(self, other) if type(other) is type(self) else NotImplemented

    def __hash__(self) -> int:
        values = (getattr(self, field.name) for field in dataclasses.fields(cast(Any, self)) if field.compare)
        return hash((type(self), *(v for v in values if isinstance(v, str | int))))


def equal(a: Any, b: Any) -> bool:
    """Whether two values are equal: numbers, arrays, tables, containers or dataclasses; NaN equals NaN."""
    if a is b:
        return True
    if hasattr(a, "__array__") and not hasattr(a, "columns"):
        one, other = np.asarray(a), np.asarray(b)
        floats = one.dtype.kind in "fc" and other.dtype.kind in "fc"
        return hasattr(b, "__array__") and np.array_equal(one, other, equal_nan=floats)
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


def _same_fields(a: Any, b: Any) -> bool:
    """Whether all fields of two dataclasses of one class are equal."""
    names = [field.name for field in dataclasses.fields(a) if field.compare]
    return all(equal(getattr(a, name), getattr(b, name)) for name in names)


def _read_only(items: dict) -> MappingProxyType:
    """Read-only view of a dictionary, as restored from a pickle."""
    return MappingProxyType(items)


# Recordings and sensors contain read-only views of dictionaries, which Python cannot pickle by itself.
copyreg.pickle(MappingProxyType, lambda view: (_read_only, (dict(view),)))
