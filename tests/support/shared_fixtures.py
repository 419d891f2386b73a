"""Small recordings and their fits, made once; an empty folder for commands; figures that are closed."""

import contextlib
import ctypes
import dataclasses
import functools
import gc
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jaxtyping
import numpy as np
import pytest

import allanjax as aj
from allanjax.base.cache import release_programs
from allanjax.noise.notation import parse_model

# Least and most memory [bytes] at which a process forgets its compiled programs: to trace them again takes
# seconds each, so that of a large machine half is used.
_LEAST, _MOST = 800_000_000, 3_000_000_000
_kept = [0]


@pytest.fixture(autouse=True)
def bounded_memory() -> Iterator[None]:
    """Keep the processes that run tests within the machine's memory: JAX holds every program it compiles."""
    yield
    release_programs(0.75)
    allowed = _allowed()
    if _memory() > max(allowed, _kept[0] + allowed // 4):
        jax.clear_caches()
        gc.collect()
        _give_back()
        _kept[0] = _memory()


@functools.cache
def _allowed() -> int:
    """Memory at which this process forgets its programs: half of the machine's is shared out to all."""
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else 0
    limit = Path("/sys/fs/cgroup/memory.max")
    if limit.exists() and (text := limit.read_text().strip()).isdigit():
        total = min(total, int(text))
    return min(max(total // 2 // workers, _LEAST), _MOST)


def _give_back() -> None:
    """Give memory that is free back to the system; the C library of Linux would keep it."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").malloc_trim(0)


def _memory() -> int:
    """Memory of this process [bytes]; 0 where the system does not tell."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return 0
    return pages * 4096


@pytest.fixture(scope="session")
def small_recording() -> aj.Recording:
    """Three gyros in deg/s and an accelerometer in g, 200 s at 100 Hz."""
    gyro = parse_model("N=0.2 deg/√h + B=20 deg/h", "gyro")
    accel = parse_model("N=0.05 m/s/√h + K=200 m/s/h/√h", "accel")
    models = {"gyro_x": gyro, "gyro_y": gyro, "gyro_z": gyro, "accel_z": accel}
    return aj.simulate_recording(
        models, 20_000, 100.0, 1, bias={"accel_z": 9.8}, accel_unit="g", name="small"
    )


@pytest.fixture(scope="session")
def small_fit(small_recording: aj.Recording) -> aj.Fit:
    """Its fit with the five basic terms."""
    return aj.fit(small_recording)


@pytest.fixture(scope="session")
def half_failed_fit(small_fit: aj.Fit) -> aj.Fit:
    """The same, had the second axis not converged."""
    first, second, *others = small_fit.results
    failed = dataclasses.replace(second, converged=False, reason="the start was hopeless")
    return dataclasses.replace(small_fit, results=(first, failed, *others))


@pytest.fixture(scope="session")
def small_posterior(small_fit: aj.Fit) -> aj.Posterior:
    """The posterior of one of its axes, from a short run of the sampler."""
    return aj.sample(small_fit, ["gyro_x"], max_steps=400, min_length=5.0, absent_draws=64)


@pytest.fixture(scope="session")
def small_critique() -> aj.Critique:
    """What is found in an axis of white noise and a line when only lines are looked for."""
    noise = np.random.default_rng(4).normal(size=2048)
    line = 0.7 * np.sin(2.0 * np.pi * 7.3 * np.arange(2048) / 100.0)
    recording = aj.Recording.from_array(noise + line, 100.0, gyro_unit="deg/s", name="bench")
    causes = [cause for cause in aj.critic.CAUSES if cause.name == "sinusoid"]
    return aj.critique(recording, aj.fit(recording, aj.AngleRandomWalk()), causes=causes)


@pytest.fixture
def unchecked_shapes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing but the package itself says what is wrong with the shape of an array, as for a user."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands run in an empty folder, and leave the user's cache alone."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ALLANJAX_CACHE", "off")
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setenv("MPLBACKEND", "agg")


@pytest.fixture(scope="session", autouse=True)
def pictures_are_not_rendered() -> Iterator[None]:
    """Figures are saved as the signature of a PNG: tests look at artists, and to render takes seconds."""
    from matplotlib.figure import Figure

    original = Figure.savefig

    def saved(figure: Figure, path: str | os.PathLike[str], **options: Any) -> None:
        Path(path).write_bytes(b"\x89PNG\r\n\x1a\n")

    saved.original = original  # type: ignore[attr-defined]
    Figure.savefig = saved  # type: ignore[method-assign, assignment]
    yield
    Figure.savefig = original  # type: ignore[method-assign]


@pytest.fixture
def no_windows() -> Iterator[None]:
    """Figures that pyplot shows nowhere, and forgets after the test."""
    import matplotlib
    from matplotlib import pyplot as plt

    matplotlib.use("Agg")
    yield
    plt.close("all")
