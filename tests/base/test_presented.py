"""Methods that results declare and `report` writes: each is declared, registered and written alike."""

import ast
import importlib
import inspect
import subprocess
import sys

import pytest
from places import ROOT

from allanjax.base import presented
from allanjax.base.presented import _FUNCTIONS


def declarations() -> dict[str, str]:
    """The modules of all methods that are declared with `@presented`, by "Class.method"."""
    found = {}
    for path in (ROOT / "allanjax").rglob("*.py"):
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                methods = [method for method in node.body if isinstance(method, ast.FunctionDef)]
                names = [m.name for m in methods if "presented" in map(ast.unparse, m.decorator_list)]
                found |= {f"{node.name}.{name}": module for name in names}
    return found


DECLARED = declarations()


def test_what_is_declared_is_registered_and_the_other_way_round():
    assert set(DECLARED) == set(_FUNCTIONS)


@pytest.mark.parametrize("name", sorted(_FUNCTIONS))
def test_the_function_takes_what_the_method_says(name):
    """In the same order, by the same names; what a function takes besides has a keyword and a default."""
    owner, _, method = name.partition(".")
    declared = inspect.signature(getattr(getattr(importlib.import_module(DECLARED[name]), owner), method))
    module, _, function = _FUNCTIONS[name].rpartition(".")
    written = inspect.signature(getattr(importlib.import_module(module), function))
    (_, *said), (_, *taken) = declared.parameters.values(), written.parameters.values()
    names = {p.name for p in said}
    besides = [p for p in taken if p.name not in names]
    assert [(p.name, p.kind, p.default) for p in said] == [
        (p.name, p.kind, p.default) for p in taken if p.name in names
    ]
    assert all(p.kind is p.KEYWORD_ONLY and p.default is not p.empty for p in besides)


def test_a_call_goes_to_the_function_that_was_registered(monkeypatch):
    monkeypatch.setattr(presented, "_FUNCTIONS", {})

    class Number(int):
        @presented.presented
        def times(self, other: int) -> int:
            """The product."""
            raise NotImplementedError

    presented.present({Number.times.__qualname__: "operator.mul"})
    assert Number(3).times(4) == 12
    assert Number.times.__doc__ == "The product."


def test_results_have_their_methods_wherever_they_are_imported_from():
    program = "from allanjax.base.presented import _FUNCTIONS; assert 'Fit.plot' in _FUNCTIONS"
    subprocess.run([sys.executable, "-c", program], check=True)
