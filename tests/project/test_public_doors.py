"""Tests go through public doors: names that `allanjax` or a room's `__all__` offers, and results' attributes.

A test of an inner function dies with it, and says nothing of what a user gets.
"""

import ast
import functools
from importlib import import_module
from pathlib import Path

from places import ROOT

import allanjax as aj

TESTS = ROOT / "tests"
# What commands start is public, too: pyproject.toml names it.
ALLOWED = {"allanjax.cli.app.app", "allanjax.cli.app.main"}
#: Test functions that may use an inner name, most of them for a law that nothing public shows.
MOST = 30


@functools.cache
def is_public(name: str) -> bool:
    """Whether a dotted name of the package is offered by `allanjax` itself or in the `__all__` of a room."""
    module, _, last = name.rpartition(".")
    rooms = (
        "allanjax",
        *(f"allanjax.{path.name}" for path in (ROOT / "allanjax").iterdir() if path.is_dir()),
    )
    if name in ALLOWED or name == "allanjax" or (module == "allanjax" and last in dir(aj)):
        return True
    if module in rooms:
        return last in getattr(import_module(module), "__all__", ())
    # The same object under its public name.
    return last in dir(aj) and getattr(import_module(module), last, None) is getattr(aj, last, 0)


def imported(tree: ast.Module) -> dict[str, str]:
    """Dotted name of everything that a module imports, by the name that it has there."""
    names = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            names |= {a.asname or a.name: f"{node.module}.{a.name}" for a in node.names}
        elif isinstance(node, ast.Import):
            names |= {
                a.asname or a.name.split(".")[0]: a.name if a.asname else a.name.split(".")[0]
                for a in node.names
            }
    return names


@functools.cache
def inner_names(path: Path) -> dict[str, frozenset[str]]:
    """Inner names that each function, class and value of a file uses, directly or through another of them."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    names = imported(tree)
    uses: dict[str, set[str]] = {}
    calls: dict[str, set[str]] = {}
    for node in tree.body:
        defined = [node.name] if isinstance(node, ast.FunctionDef | ast.ClassDef) else []
        if isinstance(node, ast.Assign):
            defined = [t.id for t in node.targets if isinstance(t, ast.Name)]
        inner, called = set(), set()
        for part in ast.walk(node):
            if isinstance(part, ast.Name | ast.arg):
                called.add(part.id if isinstance(part, ast.Name) else part.arg)
            elif isinstance(part, ast.Attribute):
                dotted = ast.unparse(part)
                first = dotted.partition(".")[0]
                origin = names.get(first, "")
                if origin.startswith("allanjax.") and not is_public(origin):
                    inner.add(origin)
                if part.attr.startswith("_") and not part.attr.startswith("__") and first != "self":
                    inner.add(dotted)
            elif isinstance(part, ast.Constant) and isinstance(part.value, str):
                # A module that is imported, or a name that is replaced, by its dotted name.
                module = part.value
                if module.startswith("allanjax.") and module.replace(".", "").replace("_", "").isalnum():
                    inner |= set() if is_public(module) else {module}
        for each in defined:
            uses[each], calls[each] = inner, called
    for each, origin in names.items():
        module, _, last = origin.partition(".")
        support = next((f for f in TESTS.glob(f"*/{module}.py") if f != path), None)
        if origin.startswith("allanjax"):
            uses[each], calls[each] = set() if is_public(origin) else {origin}, set()
        elif support is not None and not support.name.startswith("test_"):
            theirs = inner_names(support)
            uses[each] = set(theirs.get(last, set()) if last else set().union(*theirs.values(), set()))
            calls[each] = set()
    changed = True
    while changed:
        changed = False
        for each, called in calls.items():
            more = set().union(*(uses.get(c, set()) for c in called), uses[each])
            changed |= more != uses[each]
            uses[each] = more
    return {each: frozenset(found) for each, found in uses.items()}


def behind_doors(folder: Path = TESTS) -> dict[str, frozenset[str]]:
    """Test functions that use inner names, with these names."""
    return {
        f"{path.relative_to(TESTS)}::{name}": inner
        for path in sorted(folder.rglob("test_*.py"))
        for name, inner in inner_names(path).items()
        if name.startswith("test_") and inner
    }


def test_tests_use_public_names():
    found = behind_doors()
    assert len(found) <= MOST, "\n".join(
        f"{test}: {', '.join(sorted(names))}" for test, names in found.items()
    )


def test_an_inner_name_is_seen_wherever_it_hides(tmp_path):
    """Imported, under another name, through a helper of the file, by a string, as a private attribute."""
    path = tmp_path / "test_doors.py"
    path.write_text(
        "import allanjax as aj\n"
        "from allanjax.base import linalg as algebra\n"
        "def helper():\n    return algebra.solve\n"
        "def test_through_a_helper():\n    helper()\n"
        "def test_by_a_string(monkeypatch):\n    monkeypatch.setattr('allanjax.estimate.gls.solve', None)\n"
        "def test_private(fit):\n    fit._model\n"
        "def test_public():\n    aj.fit([1.0]).results\n"
    )
    found = {name for name, inner in inner_names(path).items() if name.startswith("test_") and inner}
    assert found == {"test_through_a_helper", "test_by_a_string", "test_private"}
