"""How long the critic takes: six axes × 10⁶ samples, cold and warm.

    python benchmarks/studies/critic_speed.py [FILE ...] [--files-only] [--before CHECKOUT] [--results PATH]

Each run is a process of its own: cold with an empty compilation cache, warm with that of the run before. The
recordings: noise alone, noise with five effects, and any FILE (Parquet, gyros in deg/s, accelerometers in
g, 100 Hz), cut to 10⁶ samples and to 36,600. Beside it, in the same process, ten passes of NumPy's FFT over
it. With a checkout of an earlier version each run is done by that, too. Processor seconds are those of all
threads: they do not depend on what else the machine does.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import paths

from benchmarks.common.machine import describe
from benchmarks.common.report import publish, table

SAMPLES, SHORT, RATE = 1_000_000, 36_600, 100.0
AXES = [f"{sensor}_{axis}" for sensor in ("gyro", "accel") for axis in "xyz"]
CLEAN, EFFECTS = "noise alone", "five effects"


def simulated(effects: bool) -> np.ndarray:
    """White noise and random walk, by NumPy alone; with lines, a louder stretch, outliers and a step."""
    rng = np.random.default_rng(3)
    t = np.arange(SAMPLES) / RATE
    x = 1e-3 * rng.standard_normal((SAMPLES, len(AXES)))
    x += 3e-7 * np.cumsum(rng.standard_normal(x.shape), axis=0)
    if effects:
        x[:, 0] += 2e-5 * np.sin(2.0 * np.pi * 7.3 * t)
        x[:, 1] += 3e-4 * (t > 4000.0)
        x[100_000:160_000, 3] *= 1.1
        x[:, 4] += 3e-5 * np.sin(2.0 * np.pi * 20.0 * t + 1.0) + 2e-5 * np.sin(2.0 * np.pi * 0.8 * t)
        x[rng.integers(0, SAMPLES, 15), 5] += 0.03 * rng.standard_normal(15)
    return x


def one(name: str, samples: int) -> None:
    """Criticize in this process, and print what it took."""
    import allanjax as aj

    aj.enable_compilation_cache()
    if name in (CLEAN, EFFECTS):
        recording = aj.Recording.from_array(
            simulated(name == EFFECTS), RATE, names=AXES, gyro_unit="rad/s", accel_unit="m/s^2"
        )
    else:
        whole = aj.read(name, rate=RATE, gyro_unit="deg/s", accel_unit="g")
        recording = whole.between(0.0, samples / RATE)
    begun = time.perf_counter()
    for _ in range(10):
        np.fft.rfft(recording.values, axis=0)
    transforms = time.perf_counter() - begun
    begun, worked = time.perf_counter(), time.process_time()
    critique = aj.critique(recording)
    row = {
        "seconds": time.perf_counter() - begun,
        "processor": time.process_time() - worked,
        "transforms": transforms,
        "findings": len(critique.findings),
        "gigabytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    }
    print(json.dumps(row))


def run(name: str, samples: int, cache: str, checkout: Path) -> dict[str, float]:
    command = [sys.executable, __file__, "--one", name, "--samples", str(samples)]
    environment = {**os.environ, "ALLANJAX_CACHE": cache, "PYTHONPATH": str(checkout)}
    done = subprocess.run(command, check=True, capture_output=True, text=True, env=environment)
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", nargs="*", type=Path)
    parser.add_argument("--before", type=Path, help="checkout of an earlier version, to be compared with")
    parser.add_argument("--results", type=Path, default=paths.RESULTS / "critic_speed.md")
    parser.add_argument("--files-only", action="store_true", help="without the simulated recordings")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    parser.add_argument("--samples", type=int, default=SAMPLES, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        one(options.one, options.samples)
        return
    sides = {"": paths.ROOT} | ({"before: ": options.before.resolve()} if options.before else {})
    lines = []
    simulated_ones = [] if options.files_only else [(CLEAN, SAMPLES), (EFFECTS, SAMPLES)]
    for name, samples in [*simulated_ones, *((f, n) for f in options.files for n in (SAMPLES, SHORT))]:
        called = name if isinstance(name, str) else name.stem
        for side, checkout in sides.items():
            with tempfile.TemporaryDirectory() as cache:
                cold, warm = (run(str(name), samples, cache, checkout) for _ in range(2))
            lines.append(
                [
                    f"{side}{called}, {samples:,}",
                    str(warm["findings"]),
                    f"{cold['seconds']:.0f}",
                    f"{warm['seconds']:.0f}",
                    f"{warm['processor']:.0f}",
                    f"{warm['seconds'] / warm['transforms']:.0f}",
                    f"{warm['gigabytes']:.1f}",
                ]
            )
    head = [
        *("recording", "findings", "cold, s", "warm, s", "warm, processor s"),
        *("warm, in ten FFTs", "peak memory, GB"),
    ]
    text = f"""# How long the critic takes

Six axes, so many samples, `aj.critique(recording)`, wall-clock; cold: all programs compiled anew; warm:
with the compilation cache of the run before. In ten FFTs: in the time of ten passes of NumPy's FFT over the
recording, in the same process. Reproduce with `python benchmarks/studies/critic_speed.py`.

{table(head, lines)}

{describe()}
"""
    publish(text, options.results)


if __name__ == "__main__":
    main()
