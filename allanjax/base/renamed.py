"""Attributes that still work under their former names."""

import warnings
from typing import Any


class renamed:  # noqa: N801
    """Former name of the attribute `new`: reading it warns and returns that attribute."""

    def __init__(self, new: str) -> None:
        self._new = new

    def __get__(self, of: Any, owner: type) -> Any:
        if of is None:
            return self
        warnings.warn(f"this attribute is now called {self._new}", DeprecationWarning, stacklevel=2)
        return getattr(of, self._new)
