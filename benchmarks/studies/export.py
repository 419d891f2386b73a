"""Are the numbers that `export` writes for each target the ones with which it predicts the fitted model?

    python benchmarks/studies/export.py [--samples 400000] [--results PATH]

Two simulated sensors are fitted, one with random walks and one with Markov processes, and exported. What each
target does with its file is computed by tests/support/export_arithmetic.py, which shares no code with the
export.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import paths
from export_arithmetic import ONE_TIME, WITH_TIME, error_of
from export_sensors import RATE, markov, model_of, recording, walk, with_one_time

import allanjax as aj
from allanjax.report.export.table import TARGETS
from allanjax.report.export.targets import Target
from benchmarks.common.machine import describe
from benchmarks.common.report import publish, table

PACKAGES = ("numpy", "scipy", "ruamel.yaml", "allanjax")


def keys_of(target: Target) -> str:
    """Keys of a target without the levels above, each with its formula."""
    units: dict[tuple[str, str], list[str]] = {}
    for key in target.noise_keys:
        if key.sensor:
            name = key.called.replace("|", "\\|")
            units.setdefault((name, key.formula), []).append(key.unit)
    told = (
        f"`{name}` = {formula} [{' or '.join(dict.fromkeys(of))}]" for (name, formula), of in units.items()
    )
    return "; ".join(told)


def rows(samples: int) -> list[list[str]]:
    """Rows of the table: target, keys, errors of a walk and of a Markov process."""
    walking = aj.fit(recording(walk, n=samples), "N + K")
    wandering = aj.fit(recording(markov, n=samples), "N + markov")
    walks = model_of(walking)
    processes = model_of(wandering, "markov_amplitude", "markov_correlation_time")
    found = []
    for name, target in TARGETS.items():
        error = error_of(name, aj.export(walking, name), walks, RATE)
        other = "–"
        if name in WITH_TIME:
            model = with_one_time(processes) if name in ONE_TIME else processes
            other = f"{100.0 * error_of(name, aj.export(wandering, name), model, RATE):.2f}"
        found.append([target.title, keys_of(target), f"{100.0 * error:.2f}", other])
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--samples", type=int, default=400_000)
    parser.add_argument("--results", type=Path, default=paths.RESULTS / "export.md")
    args = parser.parse_args()
    found = rows(args.samples)
    largest = max(float(cell) for row in found for cell in row[2:] if cell != "–")
    report = f"""# Exports

Reproduce with `python benchmarks/studies/export.py --samples {args.samples}`.

{describe(PACKAGES)}

Two sensors of six axes, {args.samples} samples at {RATE:g} Hz, fitted and exported to {len(found)} targets.
What a target's own code does with its file in each step is repeated over 1 s, and the covariance of angle
(velocity) and bias compared with that of the fitted model, exactly integrated: the largest relative error of
its elements in percent, over all axes, the gyro without a walk with the 95 % limit of it. At most
{largest:.2f} %, of targets with steps of 10 and 12 ms, whose sums are of so many steps; of a target without a
bias it is that of the angle's variance alone. Markov processes: of targets that hold a correlation time.

{table(["target", "keys", "walks [%]", "Markov [%]"], found)}
"""
    publish(report, args.results, quick=args.samples < 400_000)


if __name__ == "__main__":
    main()
