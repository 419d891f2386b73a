"""Late loading: public names of a package (PEP 562), and methods of results that `report` implements.

A stub `__init__.pyi` lists where each public name is defined. Type checkers and editors read it, and the
running program does, too (Scientific Python's SPEC 1), so that there is one list. Importing a package loads
nothing that is not used.
"""

import ast
import functools
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, ParamSpec, TypeVar


def late_names(package: str, file: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """`__getattr__` and `__dir__` of a package, which load a public name at its first use.

    Args:
        package: name of the package, e.g. "allanjax".
        file: its `__init__.py`. The stub beside it has a line `from package.module import name as public`
            for each name; and lines `from package.module import *` for modules whose `__all__` lists public
            names.
    """
    lines = ast.parse(Path(file).with_suffix(".pyi").read_text(encoding="utf-8")).body
    imports = [line for line in lines if isinstance(line, ast.ImportFrom) and line.module]
    taken = [
        (alias.name, alias.asname or alias.name, str(line.module)) for line in imports for alias in line.names
    ]
    sources = {public: (module, name) for name, public, module in taken if name != "*"}

    def starred() -> dict[str, str]:
        """Modules by the names in their `__all__`."""
        modules = [module for name, _, module in taken if name == "*"]
        return {name: module for module in modules for name in import_module(module).__all__}

    def load(name: str) -> Any:
        """Object with this name, e.g. "fit"; "__all__" is the list of all names."""
        if name == "__all__":
            return names()
        if name in sources:
            module, own = sources[name]
            defined = vars(import_module(module))
            return defined[own] if own in defined else import_module(f"{module}.{own}")
        if not name.startswith("_") and (module := starred().get(name, "")):
            return getattr(import_module(module), name)
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    def names() -> list[str]:
        """All names: constants, then classes, then lower-case names, each in alphabetical order."""
        return sorted({*sources, *starred()}, key=lambda name: (not name.isupper(), name[0].islower(), name))

    return load, names


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
        # If classes share the method, it is that of the result's class.
        own = (f"{owner.__name__}.{method.__name__}" for of in args[:1] for owner in type(of).__mro__)
        name = next(name for name in (method.__qualname__, *own) if name in _FUNCTIONS)
        module, _, function = _FUNCTIONS[name].rpartition(".")
        return getattr(import_module(module), function)(*args, **kwargs)

    return call


def present(functions: Mapping[str, str]) -> None:
    """Register functions as methods of results, e.g. {"Fit.plot": "package.module.function"}."""
    _FUNCTIONS.update(functions)
