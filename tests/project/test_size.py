"""Modules and functions are short enough to be read at once."""

import ast
from pathlib import Path

import pytest
from places import ROOT

PACKAGE = ROOT / "allanjax"
MODULE_LINES, FUNCTION_LINES = 400, 80


def long_modules(folder: Path) -> set[str]:
    return {
        path.relative_to(folder).as_posix()
        for path in folder.rglob("*.py")
        if len(path.read_text(encoding="utf-8").splitlines()) > MODULE_LINES
    }


def long_functions(folder: Path) -> set[str]:
    return {
        f"{path.relative_to(folder).as_posix()}::{node.name}"
        for path in folder.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and node.end_lineno - node.lineno >= FUNCTION_LINES
    }


def test_no_module_is_long():
    assert long_modules(PACKAGE) == set()


def test_no_function_is_long():
    assert long_functions(PACKAGE) == set()


@pytest.mark.parametrize(("lines", "is_long"), [(80, False), (81, True)])
def test_a_long_function_is_noticed_wherever_it_is(tmp_path, lines, is_long):
    """A method of so many lines, and a module of five times as many."""
    method = ["    def method(self):", *(lines - 1) * ["        pass"]]
    (tmp_path / "one.py").write_text("\n".join(["class One:", *method]), encoding="utf-8")
    (tmp_path / "other.py").write_text(5 * lines * "\n", encoding="utf-8")
    assert long_functions(tmp_path) == ({"one.py::method"} if is_long else set())
    assert long_modules(tmp_path) == ({"other.py"} if is_long else set())
