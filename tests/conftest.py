"""One cache of compiled programs for a run of the tests, and the fixtures that all share."""

import os
import shutil
import subprocess
import sys
import tempfile

pytest_plugins = ["shared_fixtures"]

# Before JAX is imported. The processes that pytest, the notebooks and the commands start inherit it: half of
# the tests' time would go into compiling the same programs again.
_CACHE = "JAX_COMPILATION_CACHE_DIR"
_OWN = _CACHE not in os.environ
if _OWN:
    os.environ[_CACHE] = tempfile.mkdtemp(prefix="allanjax-tests-")
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.2"
# Fusion emitters make programs no faster here and their compilation half as long again. A jaxlib that does
# not know the option aborts, hence a process of its own tries it.
_FASTER = "--xla_cpu_use_fusion_emitters=false"
if "XLA_FLAGS" not in os.environ:
    _trial = subprocess.run(
        [sys.executable, "-c", "import jax; jax.devices()"],
        env=os.environ | {"XLA_FLAGS": _FASTER},
        capture_output=True,
        check=False,
    )
    os.environ["XLA_FLAGS"] = _FASTER if _trial.returncode == 0 else ""


def pytest_xdist_auto_num_workers() -> int:
    """One more than there are cores: compiling, which takes half of the time, leaves them idle at times."""
    return (os.cpu_count() or 1) + 1


def pytest_unconfigure() -> None:
    if _OWN:
        shutil.rmtree(os.environ[_CACHE], ignore_errors=True)
