"""All studies run to their end with small numbers, and the default tests with shapes of arrays checked."""

import subprocess
import sys

import pytest
from places import ROOT

from benchmarks.__main__ import main
from benchmarks.common.study import UnavailableError, names, perform, question, settings

pytestmark = pytest.mark.study


def test_all_studies_are_listed_with_their_questions(capsys):
    assert main(["--list"]) == 0
    listed = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in listed] == names()
    assert all(question(name).endswith("?") for name in names())


@pytest.mark.parametrize("name", names())
def test_a_study_runs(name, monkeypatch, tmp_path):
    monkeypatch.setattr(settings, "workers", 1)
    path = tmp_path / "results.md"
    try:
        text = perform(name, quick=True, results=path)
    except UnavailableError as reason:
        pytest.skip(str(reason))
    assert path.read_text(encoding="utf-8") == text
    assert text.startswith(f"# {question(name)}\n")


def test_options_are_the_keywords_of_a_study(capsys):
    with pytest.raises(SystemExit):
        main(["accuracy", "--rekords", "3"])
    assert "--rekords" in capsys.readouterr().err
    assert main(["mutants", "--count", "0", "--results", "/dev/null"]) == 0


SHAPES = "--jaxtyping-packages=allanjax,shape_checks.check_shapes"


def run_with_shapes(*words):
    command = [sys.executable, "-m", "pytest", SHAPES, "--exitfirst", *words]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


def test_the_default_tests_pass_with_shapes_checked():
    done = run_with_shapes()
    assert done.returncode == 0, done.stdout[-5000:]


def test_another_shape_is_noticed(tmp_path):
    """Of an argument and of a length that is computed, in a module of the package."""
    wrong = tmp_path / "test_wrong.py"
    wrong.write_text(
        "import numpy as np\nimport pytest\nfrom jaxtyping import TypeCheckError\n"
        "def test_it():\n"
        "    with pytest.raises(TypeCheckError):\n"
        "        from allanjax.base.linalg import whiten\n"
        "        whiten(np.eye(3), np.ones((4, 1)))\n"
    )
    done = run_with_shapes("--numprocesses=0", "-c", "pyproject.toml", str(wrong))
    assert done.returncode == 0, done.stdout[-5000:]
