"""Imports go only down the list of rooms, in which a recording walks through the package."""

import ast
import shutil
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from places import ROOT

ROOMS = (
    *("base", "record", "inspection", "noise", "allan", "spectrum", "wavelets", "kalman", "estimate"),
    *("posterior", "critic", "fleet", "calibration", "navigation", "report", "cli"),
)
PACKAGE = "allanjax"


def imports(folder: Path) -> dict[str, set[str]]:
    """The package's modules that each of its modules imports, be it in a function or under TYPE_CHECKING."""
    paths = {
        ".".join(path.relative_to(folder.parent).with_suffix("").parts).removesuffix(".__init__"): path
        for path in folder.rglob("*.py")
    }
    found = {}
    for module, path in paths.items():
        names = set()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0, f"{module}: an import that is relative"
                # What is taken from a package may be one of its modules or a name in it.
                within = {f"{node.module}.{alias.name}" for alias in node.names}
                names |= {name if name in paths else node.module for name in within}
        found[module] = {name for name in names if name in paths} - {module}
    return found


def room(module: str) -> int:
    """The place of a module's room in the list; those for users, the package and its command, are above."""
    _, *names = module.split(".")
    return len(ROOMS) if names in ([], ["__main__"]) else ROOMS.index(names[0])


def upward(found: dict[str, set[str]]) -> set[tuple[str, str]]:
    """Pairs of a module and one that it imports from a later room."""
    return {(one, other) for one, others in found.items() for other in others if room(one) < room(other)}


def cycle(found: dict[str, set[str]]) -> list[str]:
    """Modules that import each other in a circle; empty if there are none."""
    try:
        TopologicalSorter(found).prepare()
    except CycleError as error:
        return error.args[1]
    return []


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """The package, to be spoilt."""
    return Path(shutil.copytree(ROOT / PACKAGE, tmp_path / PACKAGE, ignore=lambda *_: ["__pycache__"]))


def test_every_folder_is_a_room():
    folders = {path.name for path in (ROOT / PACKAGE).iterdir() if path.is_dir()} - {"__pycache__"}
    assert folders == set(ROOMS)


def test_imports_go_down_and_in_no_circle():
    found = imports(ROOT / PACKAGE)
    assert upward(found) == set()
    assert cycle(found) == []


@pytest.mark.parametrize(
    "line",
    [
        "from allanjax.fleet.fleet import characterize_fleet\n",
        "def late():\n    from allanjax.fleet import fleet\n",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import allanjax.fleet.fleet\n",
    ],
    ids=["of a module", "in a function", "for types"],
)
def test_an_import_upward_is_noticed(copy, line):
    path = copy / "noise" / "sensors.py"
    path.write_text(path.read_text(encoding="utf-8") + line, encoding="utf-8")
    assert upward(imports(copy)) == {("allanjax.noise.sensors", "allanjax.fleet.fleet")}


def test_an_import_of_the_whole_package_is_noticed(copy):
    path = copy / "noise" / "sensors.py"
    path.write_text(path.read_text(encoding="utf-8") + "from allanjax import fit\n", encoding="utf-8")
    assert upward(imports(copy)) == {("allanjax.noise.sensors", "allanjax")}


def test_a_circle_within_a_room_is_noticed(copy):
    for one, other in (("one", "other"), ("other", "one")):
        (copy / "base" / f"{one}.py").write_text(f"from allanjax.base import {other}\n", encoding="utf-8")
    assert set(cycle(imports(copy))) == {"allanjax.base.one", "allanjax.base.other"}
    assert upward(imports(copy)) == set()
