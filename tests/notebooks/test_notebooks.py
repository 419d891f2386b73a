"""The notebooks run, their saved outputs are those of a run, and what their text claims is so.

A cell of text has its claims in its metadata: pieces of the text, each with an expression of the notebook's
variables at that place that must be true.
"""

import difflib
import re

import nbformat
import pytest
from nbclient import NotebookClient
from places import DATA, ROOT

NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
# The real recordings that some of the notebooks read.
UNITS = ("adis16405_unit1.parquet", "adis16405_unit2.parquet")
RECORDINGS = {"03_uncertainty": UNITS, "04_what_the_simulation_gets_wrong": UNITS}
NUMBER = re.compile(r"-?\d[\d,]*\.?\d*(?:e[-+]?\d+)?")
# Shares of the words and numbers of a saved output that another machine must have, too: the last digits of
# some numbers differ, and with them the widths of tables.
WORDS, NUMBERS = 0.98, 0.9
CHECK = """
for text, expression in {claims!r}.items():
    assert eval(expression), f"not so: {{text!r}}, that is {{expression}}"
"""


pytestmark = pytest.mark.notebook


def outputs(notebook):
    return [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]


def pictures(notebook):
    return [output for output in outputs(notebook) if "image/png" in output.get("data", {})]


def with_checks(notebook):
    """The notebook with a hidden cell after each text that claims something."""
    cells = []
    for cell in notebook.cells:
        cells.append(cell)
        if claims := cell.metadata.get("claims"):
            assert all(text in cell.source for text in claims), cell.id
            check = CHECK.format(claims=dict(claims))
            cells.append(nbformat.v4.new_code_cell(check, id=f"{cell.id}-claims"))
    return nbformat.from_dict({**notebook, "cells": cells})


def words_and_numbers(notebook):
    """Words of all outputs with # for numbers, and the numbers; lines of tables are neither."""
    shown = [each.get("text", "") or each.get("data", {}).get("text/plain", "") for each in outputs(notebook)]
    text = re.sub(r"[─-╿│…]+", " ", "\n".join(shown))
    return NUMBER.sub("#", text).split(), [float(x.replace(",", "")) for x in NUMBER.findall(text)]


def test_there_are_notebooks():
    assert NOTEBOOKS


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook(path, tmp_path, monkeypatch):
    for name in RECORDINGS.get(path.stem, ()):
        if not (DATA / name).exists():
            pytest.skip(f"{path.stem} reads {name}, which is not in the folder that ALLANJAX_DATA names")
    monkeypatch.setenv("ALLANJAX_DATA", str(DATA))
    # The command line, tried in this process before, sets one that shows no pictures.
    monkeypatch.delenv("MPLBACKEND", raising=False)
    saved = nbformat.read(path, as_version=4)
    # nbclient fills in the outputs of the notebook that it is given, and raises where a cell does.
    executed = with_checks(nbformat.read(path, as_version=4))
    resources = {"metadata": {"path": str(tmp_path)}}
    NotebookClient(executed, timeout=300, kernel_name="python3", resources=resources).execute()
    assert len(pictures(executed)) == len(pictures(saved)) > 0
    assert not [output for output in outputs(executed) if output.get("name") == "stderr"]
    (words, numbers), (now, numbers_now) = map(words_and_numbers, (saved, executed))
    assert difflib.SequenceMatcher(None, words, now, autojunk=False).ratio() > WORDS, "execute it again"
    same = [abs(a - b) <= 0.01 * abs(a) for a, b in zip(numbers, numbers_now, strict=False)]
    assert sum(same) >= NUMBERS * len(same), "execute it again"
