"""The default tests pass with the shapes of arrays checked against all annotations."""

import subprocess
import sys

import pytest
from places import ROOT

SHAPES = "--jaxtyping-packages=allanjax,shape_checks.check_shapes"


def run_with_shapes(*words):
    command = [sys.executable, "-m", "pytest", SHAPES, "--exitfirst", *words]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


@pytest.mark.study
def test_the_default_tests_pass_with_shapes_checked():
    done = run_with_shapes()
    assert done.returncode == 0, done.stdout[-5000:]


@pytest.mark.study
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
