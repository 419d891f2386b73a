"""The table of equations in the theory notebook: what it names exists, and nothing is missing."""

import ast
import re
from operator import attrgetter

import nbformat
import pytest
from places import ROOT

import allanjax as aj

NOTEBOOK = ROOT / "notebooks" / "02_how_it_estimates.ipynb"
# Equations of chapters 2 to 5 as docstrings cite them: (4.29), (4.1)-(4.9), (4.59, 4.60), (thesis 4.3.2) not.
CITED = re.compile(r"\(([2-5]\.\d{1,2}(?:(?:, | and |[-–])[2-5]\.\d{1,2})*)\)|eqs?\. ([2-5]\.\d{1,2})\b")
NUMBER = re.compile(r"[2-5]\.\d{1,2}")


def rows():
    """Equations, function and remark of each row, from the cell's own text."""
    cells = {cell.id: cell.source for cell in nbformat.read(NOTEBOOK, as_version=4).cells}
    table = ast.parse(cells["equations"]).body[0].value.value
    lines = [[part.strip() for part in line.split("|")] for line in table.strip().splitlines()]
    assert {len(line) for line in lines} == {4}
    return [(line[0], line[2]) for line in lines]


ROWS = rows()


def as_pair(number):
    return tuple(int(part) for part in number.split("."))


def numbers_of(equations):
    """Chapter and number of the first and last equation of each range in a row; none of tables, figures."""
    if not NUMBER.match(equations):
        return []
    ends = [part.split("-") for part in equations.split(", ")]
    return [(as_pair(end[0]), as_pair(end[-1])) for end in ends]


RANGES = [pair for equations, _ in ROWS for pair in numbers_of(equations)]


def docstrings():
    for path in sorted((ROOT / "allanjax").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                yield path.relative_to(ROOT), ast.get_docstring(node) or ""


@pytest.mark.parametrize("name", sorted({name for _, name in ROWS}))
def test_what_the_table_names_exists(name):
    assert attrgetter(name)(aj) is not None


def test_no_equation_is_listed_twice():
    last = (0, 0)
    for first, end in (pair for pair in RANGES if pair != ((4, 25), (4, 25))):
        assert last < first <= end, f"{first} is listed twice, or out of order"
        last = end


def test_every_equation_that_a_docstring_cites_is_in_the_table():
    cited = {
        (as_pair(number), str(path))
        for path, text in docstrings()
        for found in CITED.finditer(text)
        for number in NUMBER.findall(found[0])
    }
    assert len(cited) > 20
    missing = {x for x in cited if not any(first <= x[0] <= last for first, last in RANGES)}
    assert not missing, "add a line to the table in notebooks/02_how_it_estimates.ipynb"
