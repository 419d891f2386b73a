"""Imports go only down the list of packages, in the order in which a recording passes through them."""

import ast
from graphlib import TopologicalSorter

from places import ROOT

PACKAGES = (
    *("base", "record", "inspection", "noise", "allan", "spectrum", "wavelets", "kalman", "estimate"),
    *("posterior", "critic", "calibration", "navigation", "comparison", "fleet", "presentation", "cli"),
)
ALLANJAX = ROOT / "allanjax"


def imports() -> dict[str, set[str]]:
    """The package's modules that each of its modules imports, be it in a function or under TYPE_CHECKING."""
    dotted = {path: path.relative_to(ROOT).with_suffix("").as_posix() for path in ALLANJAX.rglob("*.py")}
    modules = {name.replace("/", ".").removesuffix(".__init__"): path for path, name in dotted.items()}
    found = {}
    for module, path in modules.items():
        names = set()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0, f"{module}: an import that is relative"
                # What is taken from a package may be one of its modules or a name in it.
                within = {f"{node.module}.{alias.name}" for alias in node.names}
                names |= {name if name in modules else node.module for name in within}
        found[module] = names & modules.keys() - {module}
    return found


def level(module: str) -> int:
    """The place of a module's package in the list; allanjax itself and its command are above all others."""
    _, *names = module.split(".")
    return len(PACKAGES) if names in ([], ["__main__"]) else PACKAGES.index(names[0])


def test_every_folder_is_a_package_and_imports_go_down_and_in_no_circle():
    folders = {path.name for path in ALLANJAX.iterdir() if path.is_dir()} - {"__pycache__"}
    assert folders == set(PACKAGES)
    found = imports()
    assert len(found) > 100
    for one, others in found.items():
        assert [other for other in others if level(one) < level(other)] == [], one
    # Raises where modules import each other in a circle.
    TopologicalSorter(found).prepare()


def test_no_module_is_longer_than_800_lines():
    for folder in ("allanjax", "tests", "benchmarks"):
        for path in (ROOT / folder).rglob("*.py"):
            assert len(path.read_text(encoding="utf-8").splitlines()) <= 800, path
