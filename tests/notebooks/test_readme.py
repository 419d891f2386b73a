"""The README's code uses names and options that exist, and runs as it stands there, from first to last."""

import ast
import inspect
import re
import shlex

import pytest
from commands import run
from places import ROOT

import allanjax as aj

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
