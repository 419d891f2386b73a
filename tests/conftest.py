"""A run of the tests: one cache of compiled programs, one folder of shared results, a budget of programs."""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
# Generators of test data that benchmarks use, too, are theirs. Last, so that the installed package is tested.
sys.path.append(str(ROOT))

#: Most programs that a run of the default tests may compile: each costs its process about a second. It is as
#: many as the package needs while every length and every kind of fit has programs of its own; 80 is the aim.
PROGRAMS = 320


def _faster() -> str:
    """Flags with which XLA compiles faster: its fusion emitters take half as long again and gain nothing."""
    # A jaxlib that does not know the option aborts, hence a process of its own tries it, once per version.
    flags = "--xla_cpu_use_fusion_emitters=false"
    tried = ROOT / ".pytest_cache" / f"jaxlib-{version('jaxlib')}"
    if not tried.exists():
        environment = os.environ | {"XLA_FLAGS": flags}
        trial = [sys.executable, "-c", "import jax; jax.devices()"]
        known = subprocess.run(trial, env=environment, capture_output=True, check=False).returncode == 0
        tried.parent.mkdir(exist_ok=True)
        tried.write_text(flags if known else "")
    return tried.read_text()


# Set before JAX is imported. Workers, and the processes that tests start, inherit all of it.
_RUN, _CACHE = "ALLANJAX_TEST_RUN", "JAX_COMPILATION_CACHE_DIR"
_FIRST = _RUN not in os.environ
if _FIRST:
    os.environ[_RUN] = tempfile.mkdtemp(prefix="allanjax-tests-")
    os.environ.setdefault(_CACHE, str(ROOT / ".pytest_cache" / "programs"))
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    os.environ["JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES"] = "-1"
    os.environ["MPLBACKEND"] = "agg"
    # Workers whose linear algebra has threads of its own wait for each other most of the time.
    for library in ("OMP", "OPENBLAS", "MKL"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    os.environ.setdefault("XLA_FLAGS", _faster())

pytest_plugins = ["shared_fixtures"]

_approx = pytest.approx


def _as_told(expected: Any, rel: float | None = None, abs: float | None = None, nan_ok: bool = False) -> Any:
    """What `pytest.approx` returns, without 1e-12 beside a relative tolerance: SI variances are smaller."""
    return _approx(expected, rel, 0.0 if abs is None and rel is not None else abs, nan_ok)


pytest.approx = _as_told


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Keep the tests of a file on one worker, where they share their fixtures, unless they name a group."""
    for item in items:
        if item.get_closest_marker("xdist_group") is None:
            item.add_marker(pytest.mark.xdist_group(str(item.path.relative_to(ROOT))))


def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    """Each process that ran tests leaves its numbers; the first one judges them."""
    # `sys.modules`: what merely collects tests has not imported JAX.
    if counted := sys.modules.get("compilations"):
        worker = os.environ.get("PYTEST_XDIST_WORKER", "main")
        (Path(os.environ[_RUN]) / f"programs-{worker}.json").write_text(json.dumps(counted.totals))
    limited = "not study" in session.config.getoption("markexpr", "")
    if _FIRST and limited and exitstatus == 0 and _programs()["new"] > PROGRAMS:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Tell how many programs the run compiled."""
    if not _FIRST:
        return
    total = _programs()
    over = f"; AT MOST {PROGRAMS} ARE ALLOWED" if total["new"] > PROGRAMS else f" of at most {PROGRAMS}"
    terminalreporter.write_line(
        f"compiled {total['new']:.0f} programs{over}; loaded {total['requests'] - total['new']:.0f} more; "
        f"{total['seconds']:.0f} s for both in all processes"
    )


def _programs() -> dict[str, float]:
    """Numbers of all processes of the run, added up."""
    found = [json.loads(path.read_text()) for path in Path(os.environ[_RUN]).glob("programs-*.json")]
    return {key: sum(each[key] for each in found) for key in ("new", "requests", "seconds")}


def pytest_unconfigure() -> None:
    """Remove the shared results; compiled programs stay in pytest's cache for the next run."""
    if _FIRST:
        shutil.rmtree(os.environ[_RUN], ignore_errors=True)
        os.environ.pop(_RUN)


@pytest.fixture(scope="session", autouse=True)
def _counting() -> None:
    """Count from the first test on."""
    import compilations  # noqa: F401 - counts since it is imported
