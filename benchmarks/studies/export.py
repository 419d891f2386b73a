"""Do the numbers that `export` writes predict the fitted model in each target's own arithmetic?

Two simulated sensors of six axes are fitted, one with random walks and one with Markov processes, and
exported. What each target's own code does with its file in each step is repeated over 1 s (export_arithmetic,
which shares no code with the export), and the covariance of angle (velocity) and bias compared with that of
the fitted model, exactly integrated: the largest relative error of its elements over all axes, the gyro
without a walk with the 95 % limit of it; of a target without a bias it is that of the angle's variance alone.
Markov processes: of targets that hold a correlation time.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from export_arithmetic import ONE_TIME, WITH_TIME, error_of

import allanjax as aj
from allanjax.report.export.targets import TARGETS, Target
from benchmarks.common.export_sensors import RATE, markov, model_of, recording, walk, with_one_time
from benchmarks.common.study import table

PACKAGES = ("ruamel.yaml",)
QUICK: dict[str, Any] = {"samples": 16_384}


def run(*, samples: int = 400_000) -> Iterator[str]:
    walking = aj.fit(recording(walk, n=samples), "N + K")
    wandering = aj.fit(recording(markov, n=samples), "N + markov")
    walks = model_of(walking)
    processes = model_of(wandering, "markov_amplitude", "markov_correlation_time")
    rows, largest = [], 0.0
    for name, target in TARGETS.items():
        errors = [error_of(name, aj.export(walking, name), walks, RATE)]
        if name in WITH_TIME:
            model = with_one_time(processes) if name in ONE_TIME else processes
            errors.append(error_of(name, aj.export(wandering, name), model, RATE))
        largest = max(largest, *errors, 0.0)
        cells = [f"{100.0 * error:.2f}" for error in errors]
        rows.append([target.title, keys_of(target), *cells, *["–"] * (2 - len(cells))])
    yield f"{samples:,} samples at {RATE:g} Hz, {len(rows)} targets; at most {100.0 * largest:.2f} %."
    yield table(["target", "keys", "walks [%]", "Markov [%]"], rows)


def keys_of(target: Target) -> str:
    """Keys of a target without the levels above, each with its formula."""
    units: dict[tuple[str, str], list[str]] = {}
    for key in target.noise_keys:
        if key.sensor:
            units.setdefault((key.called.replace("|", "\\|"), key.formula), []).append(key.unit)
    each = {key: " or ".join(dict.fromkeys(of)) for key, of in units.items()}
    return "; ".join(f"`{name}` = {formula} [{unit}]" for (name, formula), unit in each.items())
