"""What users import is there under the name that they know, and hides no module."""

import importlib
import pkgutil
import subprocess
import sys

import pytest
from commands import run

import allanjax as aj

# Taking one of these away breaks the programs of others.
NAMES = """
    AllanAccumulator AllanDeviation AllanjaxError AngleRandomWalk Axis AxisFit AxisPosterior
    AxisSelection BiasInstability BiasStep BulkFit Cause ChunkedRecording Estimate Coefficient Critique
    DriftRamp Finding Fit FitError FleetResult Inspection LogNormal LogUniform LowPass Markov Model
    ModifiedLogUniform NoiseTerm Posterior PosteriorWarning PowerLaw PowerSpectrum Quantization
    RateRandomWalk Recording RecordingError Resonance SENSORS SensorPreset Sinusoid Telegraph
    TermSelection TermSet Uniform UnitError WanderingResonance WarmUp accumulate allan_deviation basic_terms
    characterize_fleet convert critic critique enable_compilation_cache export fit fit_many inspect load
    parameter plot_allan plot_psd power_spectrum read read_chunks sample select_terms simulate
    simulate_recording to_dict write write_coefficients_csv write_curve_csv write_json
"""
MODULES = sorted(module.name for module in pkgutil.walk_packages(aj.__path__, f"{aj.__name__}."))


def test_public_names_stay_and_all_that_are_listed_exist():
    assert set(NAMES.split()) - set(dir(aj)) == set()
    for package in (aj, aj.terms, aj.critic):
        assert [name for name in package.__all__ if not hasattr(package, name)] == []
        assert len(set(package.__all__)) == len(package.__all__)
    # What an author of a cause needs.
    for name in ("View", "Candidate", "Bank", "CAUSES", "additive", "centred"):
        assert getattr(aj.critic, name) is not None


def test_no_name_of_a_package_hides_a_module():
    """`allanjax.fit` is a function, so no module may be called so: its import would give the function."""
    hidden = []
    for module in MODULES:
        found = importlib.import_module(module)
        package, _, name = module.rpartition(".")
        if getattr(importlib.import_module(package), name) is not found:
            hidden.append(module)
    assert hidden == []


# Each takes a good part of the time that `import jax` takes.
SLOW = ("matplotlib", "pandas", "scipy.signal", "scipy.stats")
PROGRAM = f"""
import sys
def slow():
    return [name for name in {SLOW} if name in sys.modules]
import allanjax as aj
assert "allanjax.record.recording" not in sys.modules, "a room that works"
aj.Recording
assert "allanjax.record.recording" in sys.modules
[getattr(aj, name) for name in aj.__all__]
assert not slow(), slow()
import numpy as np
recording = aj.Recording.from_array(np.random.default_rng(0).standard_normal(5000), 50.0, gyro_unit="rad/s")
curve = aj.allan_deviation(recording)
curve.confidence_interval()
aj.power_spectrum(recording).random_walk("gyro")
assert not slow(), slow()
assert "Fit.plot" in aj.Fit.plot.__qualname__ and curve.plot().axes
"""


def test_slow_libraries_are_imported_where_they_are_used_only():
    """In a process of its own: names load what they need, intervals no statistics."""
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_the_version_and_names_that_there_are_not():
    assert aj.__version__ == run("--version").stdout.split()[-1]
    with pytest.raises(AttributeError, match="unheard_of"):
        aj.unheard_of  # noqa: B018
    # Modules that stay within are no names of the package.
    with pytest.raises(AttributeError, match="numpy"):
        aj.numpy  # noqa: B018
