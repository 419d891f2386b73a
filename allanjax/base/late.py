"""Late loading: public names of a package (PEP 562), and methods of results that `report` implements.

A stub `__init__.pyi` lists where each public name is defined. Type checkers and editors read it, and the
running program does, too (Scientific Python's SPEC 1), so that there is one list. Importing a package loads
nothing that is not used.
"""

import ast
import functools
import importlib
from collections.abc import Callable, Iterator, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, ParamSpec, TypeVar


class LateNames:
    """Public names of a package with the modules that define them.

    Args:
        package: name of the package, e.g. "allanjax".
        stub: its stub, with a line `from package.module import name as public` for each name; and lines
            `from package.module import *` for modules whose `__all__` lists public names.
    """

    def __init__(self, package: str, stub: Path) -> None:
        lines = ast.parse(stub.read_text(encoding="utf-8")).body
        imports = [line for line in lines if isinstance(line, ast.ImportFrom) and line.module]
        taken = [(alias, str(line.module)) for line in imports for alias in line.names]
        self._package = package
        self._starred = [module for alias, module in taken if alias.name == "*"]
        self._sources = {
            alias.asname or alias.name: (module, alias.name) for alias, module in taken if alias.name != "*"
        }

    def load(self, name: str) -> Any:
        """Object with this name, e.g. "fit"; "__all__" is the list of all names.

        Raises:
            AttributeError: there is no such name.
        """
        if name == "__all__":
            return self.all()
        if name in self._sources:
            module, own = self._sources[name]
            defined = vars(import_module(module))
            return defined[own] if own in defined else import_module(f"{module}.{own}")
        if not name.startswith("_"):
            for module, names in self._lists():
                if name in names:
                    return getattr(import_module(module), name)
        raise AttributeError(f"module {self._package!r} has no attribute {name!r}")

    def all(self) -> list[str]:
        """All names: constants, then classes, then lower-case names, each in alphabetical order."""
        names = {*self._sources, *(name for _, names in self._lists() for name in names)}
        return sorted(names, key=lambda name: (not name.isupper(), name[0].islower(), name))

    def _lists(self) -> Iterator[tuple[str, list[str]]]:
        """Modules of which all public names are imported, with these names."""
        for module in self._starred:
            yield module, import_module(module).__all__


# Methods of results that draw, print or export: declared with the result, implemented in `report`.
#
# A result is data, and the rooms that make results know nothing about figures. So a result declares such a
# method with its signature and docstring, and `report` registers with `present` the function that implements
# it. The function's module is imported at the first call, since drawing libraries take long to load.

_P = ParamSpec("_P")
_T = TypeVar("_T")

# Functions by the qualified names of the methods that they implement.
_FUNCTIONS: dict[str, str] = {}


def presented(method: Callable[_P, _T]) -> Callable[_P, _T]:
    """Decorator of a method without a body: calls go to the function that `present` has registered for it."""

    @functools.wraps(method)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        return _function(method, args[:1])(*args, **kwargs)

    return call


def present(functions: Mapping[str, str]) -> None:
    """Register functions as methods of results, e.g. {"Fit.plot": "package.module.function"}."""
    _FUNCTIONS.update(functions)


def _function(method: Callable[..., Any], of: tuple[Any, ...]) -> Callable[..., Any]:
    """Function registered for a method, or, if classes share the method, for the class of the result."""
    own = (f"{owner.__name__}.{method.__name__}" for result in of for owner in type(result).__mro__)
    name = next(name for name in (method.__qualname__, *own) if name in _FUNCTIONS)
    module, _, function = _FUNCTIONS[name].rpartition(".")
    return getattr(importlib.import_module(module), function)
