"""What a benchmark ran on."""

from __future__ import annotations

import datetime
import os
import platform
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version

PACKAGES = ("jax", "numpy", "scipy", "allanjax", "allantools", "allan-variance", "avar")


def describe(packages: Sequence[str] = PACKAGES) -> str:
    """A Markdown list: processor, cores, memory, operating system, Python and package versions, date."""
    found = []
    for package in packages:
        try:
            found.append(f"{package} {version(package)}")
        except PackageNotFoundError:
            found.append(f"{package} not installed")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    lines = (
        f"{_processor()}, {cores} cores available, {_memory()} memory",
        f"{platform.system()} {platform.release()} ({platform.machine()})",
        f"Python {platform.python_version()}; {', '.join(found)}",
        f"{datetime.date.today():%Y-%m-%d}",
    )
    return "\n".join(f"- {line}" for line in lines)


def _processor() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            names = [line.split(":", 1)[1].strip() for line in file if line.startswith("model name")]
        return names[0]
    except (OSError, IndexError):
        return platform.processor() or "unknown processor"


def _memory() -> str:
    try:
        size = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):
        return "unknown"
    return f"{size / 2**30:.0f} GiB"


if __name__ == "__main__":
    print(describe())
