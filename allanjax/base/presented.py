"""Methods of results that draw, print or export: declared with the result, implemented in `report`.

A result is data, and the rooms that make results know nothing of pictures. So a result declares such a method
with its signature and docstring, and `report`, which knows all results, says by `present` which function of
its own that is. The function's module is imported when the method is called for the first time: drawing
libraries take long to load.
"""

import functools
import importlib
import warnings
from collections.abc import Callable, Mapping
from typing import Any, ParamSpec, TypeVar

_P = ParamSpec("_P")
_T = TypeVar("_T")

# Functions by the qualified names of the methods that they are.
_FUNCTIONS: dict[str, str] = {}


def presented(method: Callable[_P, _T]) -> Callable[_P, _T]:
    """Decorator of a method without a body: calls go to the function that `present` has registered for it."""

    @functools.wraps(method)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        return _function(method.__qualname__)(*args, **kwargs)

    return call


class _Text(str):
    """Text of a property that was a method: called as that, it warns and returns the text."""

    def __call__(self) -> str:
        warnings.warn("this text is a property now: leave out the ()", DeprecationWarning, stacklevel=2)
        return str(self)


class TextProperty:
    """Decorator of a method that returns a text: a property, which may still be called."""

    def __init__(self, method: Callable[[Any], str]) -> None:
        self._method, self.__doc__ = method, method.__doc__

    def __get__(self, of: Any, owner: type) -> Any:
        return self if of is None else _Text(self._method(of))


def present(functions: Mapping[str, str]) -> None:
    """Register functions as methods of results, e.g. {"Fit.plot": "package.module.function"}."""
    _FUNCTIONS.update(functions)


def _function(name: str) -> Callable[..., Any]:
    """Function registered for a method, its module imported."""
    module, _, function = _FUNCTIONS[name].rpartition(".")
    return getattr(importlib.import_module(module), function)
