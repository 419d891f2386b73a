"""Public names of a package that are loaded when they are asked for (PEP 562), as its stub lists them.

A stub `__init__.pyi` says to type checkers and editors where each name comes from. It is read while the
program runs, too, as Scientific Python's SPEC 1 has it, so that there is one list. Importing a package takes
no longer than what is used of it.
"""

import ast
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any


class LateNames:
    """Names of a package by the modules that they come from.

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
        self._wholes = [module for alias, module in taken if alias.name == "*"]
        self._homes = {
            alias.asname or alias.name: (module, alias.name) for alias, module in taken if alias.name != "*"
        }

    def load(self, name: str) -> Any:
        """What has this name, e.g. "fit"; "__all__" is the list of all of them.

        Raises:
            AttributeError: nothing has this name.
        """
        if name == "__all__":
            return self.all()
        if name in self._homes:
            module, own = self._homes[name]
            found = vars(import_module(module))
            return found[own] if own in found else import_module(f"{module}.{own}")
        if not name.startswith("_"):
            for module, names in self._lists():
                if name in names:
                    return getattr(import_module(module), name)
        raise AttributeError(f"module {self._package!r} has no attribute {name!r}")

    def all(self) -> list[str]:
        """The names: constants, then classes, then what has a small letter, each by the alphabet."""
        names = {*self._homes, *(name for _, names in self._lists() for name in names)}
        return sorted(names, key=lambda name: (not name.isupper(), name[0].islower(), name))

    def _lists(self) -> Iterator[tuple[str, list[str]]]:
        """Modules that are taken as a whole, and what they list."""
        for module in self._wholes:
            yield module, import_module(module).__all__
