"""The numbers of a dozen recordings, to be compared before and after a change that must change none.

    python benchmarks/studies/same_numbers.py write FILE [--data FOLDER] [--only fit,critique]
    python benchmarks/studies/same_numbers.py compare BEFORE AFTER

`write` puts into a JSON file what the public interface says of simulated recordings, and of real ones if
their folder is given or named by ALLANJAX_DATA: fits by both objectives, the choice of terms, spectra,
posteriors, streams, fits in bulk, critiques of hidden effects, a fleet. `compare` tells where two such files
differ by more than 1e-10, relative to the larger number, and exits with 1 if they do. The files are of one
machine and its libraries: they are not kept.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import paths
from hidden_effects import draw
from hidden_verdict import recording_of

import allanjax as aj

TOLERANCE = 1e-10
OBJECTIVES = ("allan", "whittle")
MODELS = (None, "N + B + K")
GYROS = ["gyro_x", "gyro_y", "gyro_z"]
HIDDEN = (
    *("sinusoid", "resonance", "low_pass", "bias_step", "telegraph", "warm_up", "temperature"),
    *("outliers", "variance_change", "rounding", "saturation", "common_mode"),
)
# Of the folder of real recordings: Parquet files, and what reading them takes.
REAL_UNITS = ("adis16405_unit1", "adis16405_unit2")
REAL: dict[str, Any] = {"rate": 100.0, "gyro_unit": "deg/s", "accel_unit": "g"}
# Differences that are printed.
SHOWN = 40


# --- What is computed --------------------------------------------------------------------------------------


def cases(data: Path | None) -> dict[str, Callable[[], Any]]:
    """Each case's name, and what computes its numbers."""
    recordings: dict[str, Callable[[], aj.Recording]] = {
        "white": partial(simulated, 1),
        "walk": partial(simulated, 2, walk=2e-5),
        "handled": partial(handled, 3),
    }
    if data is not None:
        recordings |= {name: partial(aj.read, data / f"{name}.parquet", **REAL) for name in REAL_UNITS}
    walk = recordings["walk"]
    found: dict[str, Callable[[], Any]] = {}
    for name, recording in recordings.items():
        found[f"spectrum/{name}"] = partial(spectrum, recording)
        found[f"stream/{name}"] = partial(stream, recording)
        for objective in OBJECTIVES:
            found[f"fit/{name}/{objective}"] = partial(fitted, recording, objective)
    for model in MODELS:
        found[f"posterior/{model or 'terms chosen'}"] = partial(posterior, walk, model)
    found |= {f"preset/{name}": partial(preset, name) for name in aj.SENSORS}
    found |= {"select": partial(selected, walk), "bulk": partial(bulk, walk), "simulate": every_term}
    found |= {f"critique/{cause}": partial(hidden, cause) for cause in HIDDEN}
    if data is not None:
        found |= {f"critique/{name}": partial(criticized, recordings[name]) for name in REAL_UNITS[:1]}
    return found | {"fleet": fleet}


def simulated(seed: int, n: int = 60_000, rate: float = 100.0, walk: float = 0.0) -> aj.Recording:
    """White noise and a random walk of three gyros, by NumPy alone."""
    rng = np.random.default_rng(seed)
    x = 1e-3 * rng.standard_normal((n, 3)) + np.cumsum(walk * rng.standard_normal((n, 3)), axis=0)
    return aj.Recording.from_array(x, rate, gyro_unit="rad/s", names=GYROS)


def handled(seed: int) -> aj.Recording:
    """Handled at its begin and end."""
    recording = simulated(seed, walk=2e-5)
    x = recording.values.copy()
    x[:500] *= 100.0
    x[-300:] *= 50.0
    return aj.Recording.from_array(x, recording.rate, gyro_unit="rad/s", names=GYROS)


def fitted(recording: Callable[[], aj.Recording], objective: str) -> Any:
    return aj.to_dict(aj.fit(recording(), objective=objective))


def spectrum(recording: Callable[[], aj.Recording]) -> Any:
    return columns(aj.power_spectrum(recording()).averaged().to_dataframe())


def stream(recording: Callable[[], aj.Recording]) -> Any:
    """In pieces of unequal length."""
    whole = recording()
    accumulator = aj.AllanAccumulator(whole.rate, whole.names)
    for piece in np.split(whole.values, [1, 1000, 33_333]):
        accumulator.update(piece)
    return aj.to_dict(accumulator.fit())


def preset(name: str) -> Any:
    return [aj.to_dict(aj.fit(part)) for part in aj.SENSORS[name].simulate(600.0, 5)]


def posterior(recording: Callable[[], aj.Recording], model: str | None) -> Any:
    found = aj.sample(aj.fit(recording(), model, "whittle"), axes=["gyro_x"], seed=11, progress=False)
    drifts = [str(axis.predicted_drift()) for axis in found.results]
    return {"marginals": columns(found.to_dataframe()), "drifts": drifts}


def selected(recording: Callable[[], aj.Recording]) -> Any:
    return columns(aj.select_terms(recording()).to_dataframe())


def bulk(recording: Callable[[], aj.Recording]) -> Any:
    curves = aj.allan_deviation(recording().values, 100.0)
    return columns(aj.fit_many(curves, "N + B + K").to_dataframe())


def every_term() -> list[float]:
    """A simulation of the random terms at once."""
    model = aj.Quantization(1e-6) + aj.AngleRandomWalk(1e-4) + aj.BiasInstability(2e-5)
    model = model + aj.RateRandomWalk(1e-6) + aj.Markov(3e-5, 20.0) + aj.PowerLaw(1e-5, 0.5)
    model = model + aj.Telegraph(1e-4, 10.0) + aj.LowPass(1e-4, 10.0)
    return np.asarray(aj.simulate(model, 4096, 50.0, 7)).tolist()


def hidden(cause: str) -> Any:
    return aj.critique(recording_of(draw(3, cause, 4.0, duration=600.0, rate=50.0))).to_dict()


def criticized(recording: Callable[[], aj.Recording]) -> Any:
    """A quarter of an hour of it."""
    return aj.critique(recording().between(3000.0, 3900.0)).to_dict()


def fleet() -> dict[str, list[Any]]:
    """Six units, of which one is three times as loud."""
    with tempfile.TemporaryDirectory() as folder:
        for k in range(6):
            x = simulated(100 + k, n=12_000, walk=1e-5).values * (3.0 if k == 4 else 1.0)
            unit = aj.Recording.from_array(x, 100.0, gyro_unit="rad/s", names=GYROS)
            aj.write(unit, Path(folder) / f"unit{k}.csv")
        result = aj.characterize_fleet(f"{folder}/*.csv", f"{folder}/results", rate=100.0)
        return columns(result.to_dataframe().drop(columns="file"))


def columns(frame: pd.DataFrame) -> dict[str, list[Any]]:
    return {str(name): values.tolist() for name, values in frame.reset_index().items()}


# --- Writing and comparing ---------------------------------------------------------------------------------


def write(path: Path, data: Path | None, only: list[str]) -> None:
    """What cannot be computed is written as its error: it is to stay the same, too."""
    found = {}
    for name, compute in cases(data).items():
        if only and not any(name.startswith(start) for start in only):
            continue
        begun = time.perf_counter()
        try:
            found[name] = compute()
        except aj.AllanjaxError as error:
            found[name] = {"error": str(error)}
        print(f"{time.perf_counter() - begun:6.1f} s  {name}", file=sys.stderr, flush=True)
    path.write_text(json.dumps(found, indent=0, default=plain), encoding="utf-8")


def plain(value: Any) -> Any:
    """For JSON: NumPy's numbers and arrays, and whatever else as text."""
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else str(value)


def differences(before: Any, after: Any, place: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Every place at which two files differ, and what they have there."""
    match before, after:
        case dict(), dict():
            for key in sorted(before.keys() | after.keys()):
                yield from differences(before.get(key), after.get(key), f"{place}/{key}")
        case list(), list() if len(before) == len(after):
            for k, pair in enumerate(zip(before, after, strict=True)):
                yield from differences(*pair, f"{place}/{k}")
        case float() | int(), float() | int():
            both_nan = math.isnan(before) and math.isnan(after)
            if not both_nan and not math.isclose(before, after, rel_tol=TOLERANCE):
                yield place, before, after
        case _:
            if before != after:
                yield place, before, after


def compare(before: Path, after: Path) -> int:
    """Tells the differences; their number."""
    found = list(differences(*(json.loads(path.read_text(encoding="utf-8")) for path in (before, after))))
    for place, was, now in found[:SHOWN]:
        print(f"{place}: {str(was)[:100]} → {str(now)[:100]}")
    print(f"{len(found)} differences beyond {TOLERANCE:g}" if found else "the same numbers")
    return len(found)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    writing = commands.add_parser("write", help="compute the numbers and write them to a file")
    writing.add_argument("file", type=Path)
    writing.add_argument("--data", type=Path, default=paths.DATA, help="by default $ALLANJAX_DATA")
    writing.add_argument("--only", default="", help="cases whose names begin so, e.g. fit,critique/sinusoid")
    comparing = commands.add_parser("compare", help="tell where two files differ")
    comparing.add_argument("before", type=Path)
    comparing.add_argument("after", type=Path)
    options = parser.parse_args()
    if options.command == "write":
        write(options.file, options.data, [name for name in options.only.split(",") if name])
    elif compare(options.before, options.after):
        sys.exit(1)


if __name__ == "__main__":
    main()
