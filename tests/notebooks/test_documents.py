"""The notebooks and the README run, and what they show and claim is so."""

import ast
import difflib
import inspect
import re
import shlex

import nbformat
import pytest
from commands import run
from nbclient import NotebookClient
from places import DATA, ROOT

import allanjax as aj

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


def outputs(notebook):
    return [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]


def pictures(notebook):
    return [output for output in outputs(notebook) if "image/png" in output.get("data", {})]


def with_checks(notebook):
    """The notebook with a hidden cell after each text that claims something."""
    # Claims are in a cell's metadata: pieces of its text, each with an expression of the notebook's variables
    # at that place that must be true.
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


@pytest.mark.notebook
def test_there_are_notebooks():
    assert NOTEBOOKS


@pytest.mark.notebook
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


README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)
PYTHON = [text for language, text in BLOCKS if language == "python"]


def commands(*languages):
    """Words of the allanjax commands in blocks, without comments, prompts and output."""
    text = "\n".join(text for language, text in BLOCKS if language in languages).replace("\\\n", " ")
    found = re.findall(r"^(?:\$ )?allanjax (\w.*)", text, re.MULTILINE)
    return [shlex.split(words, comments=True) for words in found]


def test_options_of_its_commands_exist():
    assert len(commands("bash", "text")) > 4
    for command, *words in commands("bash", "text"):
        shown = run(command, "--help")
        assert shown.exit_code == 0, command
        assert {word for word in words if word[:2] == "--"} <= {*re.findall(r"--[\w-]+", shown.output)}, words


def test_names_and_keywords_of_its_code_exist():
    tree = ast.parse("\n".join(PYTHON))
    used = [n for n in ast.walk(tree) if isinstance(n, ast.Attribute) and ast.unparse(n.value) == "aj"]
    assert len(used) > 10
    assert all(hasattr(aj, name.attr) for name in used)
    for call in (n for n in ast.walk(tree) if isinstance(n, ast.Call) and n.func in used):
        taken = inspect.signature(getattr(aj, call.func.attr)).parameters
        assert {word.arg for word in call.keywords} <= set(taken), ast.unparse(call)


@pytest.fixture
def folder(elsewhere, tmp_path):
    # As long as the record whose critique is shown, for the compiled programs; with a line to find as well.
    terms = "N=0.1 deg/sqrt(h) + B=2 deg/h + sinusoid(amplitude=20 deg/h, frequency=1.4 Hz)"
    recording = aj.simulate_recording({"gyro_x": terms}, 45_000, 100.0, 0)
    for name in ("imu.csv", "week.parquet"):
        aj.write(recording, name)
    return tmp_path


@pytest.mark.notebook
def test_python_blocks_run_in_order(folder, capsys):
    given = {}
    for text in PYTHON:
        exec(compile(text, "README.md", "exec"), given)
    assert {"allan.png", "corner.png", "pictures"} <= {path.name for path in folder.iterdir()}
    assert given["accumulator"].n == 45_000
    assert "noise terms by evidence" in capsys.readouterr().out


@pytest.mark.notebook
def test_commands_run(folder):
    assert run("characterize", "imu.csv", "--out", "results").exit_code == 0
    for command, *words in commands("bash"):
        # Of files that are not there, and of a cluster, only that the command line is right.
        there = words[0].startswith("-") or (folder / words[0]).exists()
        shown = run(command, *words) if there else run(command, *words, "--help")
        assert shown.exit_code == 0, shown.output
    written = re.search(r"prints a table and writes (.*?)\.\n", README, re.DOTALL)[1]
    assert {path.name for path in (folder / "results").iterdir()} == {*re.findall(r"`(imu[\w.]+)`", written)}


@pytest.mark.notebook
def test_the_critique_says_what_the_readme_shows(folder):
    results = [run(*words) for words in commands("text")]
    assert [result.exit_code for result in results] == [0] * len(results)
    (shown,) = (text for _, text in BLOCKS if "allanjax critique bench.csv\n" in text)
    # Digits beyond these may differ from one machine to the next.
    printed, shown = (
        re.sub(r"\d+\.?\d*", lambda number: f"{float(number[0]):.1g}", re.sub("p = [^;)]*", "", text)).split()
        for text in (results[-1].stdout, shown.split("allanjax critique bench.csv\n")[1])
    )
    assert printed[: len(shown)] == shown
