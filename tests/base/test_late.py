"""Public names are loaded one by one, from where a stub says that they come."""

import importlib
import sys

import pytest

from allanjax.base.late import LateNames

MODULES = {
    "__init__.py": "",
    "__init__.pyi": "from shop.tools import saw as saw\n"
    "from shop.tools import _file as rasp\n"
    "from shop import paint as paint\n"
    "from shop.nails import *\n"
    "\nsign: str\n",
    "tools.py": "saw, _file, LAST = 'saw', 'file', 'last'\n",
    "paint.py": "",
    "nails.py": "__all__ = ['Nail', 'PIN']\nNail, PIN, hook = 1, 2, 3\n",
}


@pytest.fixture
def names(tmp_path, monkeypatch):
    """Names of a package in a folder; none of its modules stays loaded."""
    folder = tmp_path / "shop"
    folder.mkdir()
    for name, text in MODULES.items():
        (folder / name).write_text(text, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    importlib.invalidate_caches()
    yield LateNames("shop", folder / "__init__.pyi")
    for module in [name for name in sys.modules if name.partition(".")[0] == "shop"]:
        del sys.modules[module]


def test_a_name_loads_its_own_module_only(names):
    assert "shop" not in sys.modules
    assert names.load("saw") == "saw"
    assert "shop.tools" in sys.modules
    assert sys.modules.keys() & {"shop.paint", "shop.nails"} == set()


def test_a_name_may_be_another_one_a_module_or_part_of_a_list(names):
    assert names.load("rasp") == "file"
    assert names.load("paint") is sys.modules["shop.paint"]
    assert (names.load("Nail"), names.load("PIN")) == (1, 2)


def test_the_list_has_constants_first_and_then_classes(names):
    assert names.all() == names.load("__all__") == ["PIN", "Nail", "paint", "rasp", "saw"]


@pytest.mark.parametrize("name", ["LAST", "hook", "_file", "sign", "__path__"])
def test_what_is_not_listed_is_not_there(names, name):
    with pytest.raises(AttributeError, match=f"module 'shop' has no attribute '{name}'"):
        names.load(name)
