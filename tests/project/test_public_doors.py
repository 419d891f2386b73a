"""Tests go through public doors: names that `allanjax` or a package's `__all__` offers, and attributes."""

import ast
import re
from importlib import import_module

from places import ROOT

import allanjax as aj

# What commands start is public, too: pyproject.toml names it.
ALLOWED = {"allanjax.cli.app.app", "allanjax.cli.app.main", "allanjax.cli.app.run"}
#: Most inner names in all files of tests together, each for a law that nothing public shows: a test of an
#: inner function dies with it.
MOST = 8


def is_public(name: str) -> bool:
    """Whether a dotted name of the package is offered by `allanjax` itself or by a package's `__all__`."""
    module, _, last = name.rpartition(".")
    if name in ALLOWED or (module == "allanjax" and last in dir(aj)):
        return True
    offered = import_module(module) if module.count(".") < 2 else None
    # Or the same object under its public name.
    same = last in dir(aj) and getattr(import_module(module), last, None) is getattr(aj, last)
    return last in getattr(offered, "__all__", ()) or same


def inner_names(text: str) -> set[str]:
    """Inner names that a file imports, says as a text (to replace them), or takes of an object."""
    named, private = set(), set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom):
            named |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            named |= {alias.name for alias in node.names}
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            named.add(node.value)
        elif isinstance(node, ast.Attribute) and re.match("_[^_]", node.attr):
            private.add(ast.unparse(node))
    named = {name for name in named if re.fullmatch(r"allanjax(\.\w+)+", name) and not is_public(name)}
    return named | {name for name in private if not name.startswith("self.")}


def behind_doors() -> list[tuple[str, str]]:
    """All inner names, with the file that uses them."""
    paths = sorted((ROOT / "tests").rglob("*.py"))
    return [(path.name, name) for path in paths for name in inner_names(path.read_text(encoding="utf-8"))]


def test_tests_use_public_names():
    assert len(behind_doors()) <= MOST, behind_doors()
