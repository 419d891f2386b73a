"""What users import is there under the name that they know, and hides no module."""

import importlib
import pkgutil
import subprocess
import sys

import pytest
from commands import run

import allanjax as aj

# Names that no other test uses: taking one of these away breaks the programs of others.
NAMES = "AxisPosterior BulkFit Effect ChunkedRecording Coefficient Inspection LogNormal SensorPreset"
NAMES += " TermSelection basic_terms"
MODULES = sorted(module.name for module in pkgutil.walk_packages(aj.__path__, f"{aj.__name__}."))


def test_public_names_stay_and_all_that_are_listed_exist():
    assert {*NAMES.split()} <= {*dir(aj)} == {*aj.__all__}
    for package in (aj, aj.terms, aj.critic):
        assert [name for name in package.__all__ if not hasattr(package, name)] == []
        assert len(set(package.__all__)) == len(package.__all__)
    # What an author of a cause needs.
    assert all(hasattr(aj.critic, n) for n in ("View", "Candidate", "Bank", "EFFECTS", "additive", "centred"))


def test_no_name_of_a_package_hides_a_module():
    """`allanjax.fit` is a function, so no module may be called so: its import would give the function."""
    for module in MODULES:
        package, _, name = module.rpartition(".")
        found = importlib.import_module(module)
        assert getattr(importlib.import_module(package), name) is found, module


# What a user waits for: the package itself, helps, and computations load no library that they do not use.
PROGRAM = """
import contextlib, io, sys
def loaded(names):
    return [name for name in names.split() if name in sys.modules]
import allanjax as aj
assert not loaded("cyclopts jax matplotlib numpy pandas rich scipy")
from allanjax.cli.app import app, run
commands = [command for command in app if command[0] != "-"]
assert len(commands) > 10
for command in ["", *commands]:
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        run([*command.split(), "--help"])
    assert f"Usage: allanjax {command}" in said.getvalue(), command
    assert not loaded("jax matplotlib numpy pandas pint scipy"), command
[getattr(aj, name) for name in aj.__all__]
slow = "matplotlib pandas scipy.signal scipy.stats"
assert not loaded(slow), loaded(slow)
import jax, numpy as np
assert jax.numpy.ones(1).dtype == np.float64
recording = aj.Recording.from_array(np.random.default_rng(0).standard_normal(5000), 50.0, gyro_unit="rad/s")
curve = aj.allan_deviation(recording)
curve.confidence_interval()
aj.power_spectrum(recording).random_walk("gyro")
assert not loaded(slow), loaded(slow)
assert "Fit.plot" in aj.Fit.plot.__qualname__ and curve.plot().axes
"""


def test_slow_libraries_are_imported_only_where_they_are_used():
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_the_version_and_names_that_there_are_not():
    assert aj.__version__ == run("--version").stdout.split()[-1]
    # Modules that stay within are no names of the package.
    for name in ("unheard_of", "numpy"):
        with pytest.raises(AttributeError, match=name):
            getattr(aj, name)
