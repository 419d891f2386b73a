"""One cache of compiled programs for a run of the tests; small recordings and their fits, made once."""

import dataclasses
import os
import shutil
import tempfile
from collections.abc import Callable

import pytest

# Before JAX is imported. The processes that pytest, the notebooks and the commands start inherit it: half of
# the tests' time would go into compiling the same programs again.
_CACHE = "JAX_COMPILATION_CACHE_DIR"
_OWN = _CACHE not in os.environ
if _OWN:
    os.environ[_CACHE] = tempfile.mkdtemp(prefix="allanjax-tests-")
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.2"

from gamma_levels import with_likelihood  # noqa: E402

from allanjax.estimate.fit import fit  # noqa: E402
from allanjax.estimate.result import Fit  # noqa: E402
from allanjax.noise.notation import parse_model  # noqa: E402
from allanjax.noise.simulate import simulate_recording  # noqa: E402
from allanjax.record.recording import Recording  # noqa: E402


def pytest_xdist_auto_num_workers() -> int:
    """One more than there are cores: compiling, which takes half of the time, leaves them idle at times."""
    return (os.cpu_count() or 1) + 1


def pytest_unconfigure() -> None:
    if _OWN:
        shutil.rmtree(os.environ[_CACHE], ignore_errors=True)


@pytest.fixture(scope="session")
def small_recording() -> Recording:
    """Three gyros in deg/s and an accelerometer in g, 200 s at 100 Hz."""
    gyro = parse_model("N=0.2 deg/√h + B=20 deg/h", "gyro")
    accel = parse_model("N=0.05 m/s/√h + K=200 m/s/h/√h", "accel")
    models = {"gyro_x": gyro, "gyro_y": gyro, "gyro_z": gyro, "accel_z": accel}
    return simulate_recording(models, 20_000, 100.0, 1, bias={"accel_z": 9.8}, accel_unit="g", name="small")


@pytest.fixture(scope="session")
def small_fit(small_recording: Recording) -> Fit:
    """Its fit with the five basic terms."""
    return fit(small_recording)


@pytest.fixture(scope="session")
def half_failed_fit(small_fit: Fit) -> Fit:
    """The same, had the second axis not converged."""
    first, second, *others = small_fit.results
    failed = dataclasses.replace(second, converged=False, reason="the start was hopeless")
    return dataclasses.replace(small_fit, results=(first, failed, *others))


@pytest.fixture
def two_terms(small_fit: Fit, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Fit]:
    """What makes a fit of angle and rate random walk with a likelihood of one's own."""
    return lambda likelihood, chosen=True: with_likelihood(monkeypatch, small_fit, likelihood, chosen)
