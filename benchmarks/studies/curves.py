"""Do fits of an Allan curve without its record agree with those of the record, and do their intervals cover?

Records of N + B + K (164 s at 100 Hz, and 11 min) and of Q + N + K. Each is fitted from its samples, by the
true terms, and from a table of its overlapping Allan deviations at octaves with six digits, as other
programs write them, given rate and length. Bias and scatter are relative to the truth; apart is the rms
difference of the two fits over the standard error; covered the share of 95 % intervals that hold the truth.
Then the three curves of real sensors, which are published without their records.
"""

from __future__ import annotations

import io
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import allanjax as aj
from benchmarks.common.study import UnavailableError, data, run_tasks, share, table

QUICK: dict[str, Any] = {"records": 1, "lengths": (16_384,)}
N = 0.15 * np.pi / 180.0 / 60.0
CASES = {
    "N + B + K": {"angle_random_walk": N, "bias_instability": 1.2 * N, "rate_random_walk": N * 3**0.5 / 12.0},
    "Q + N + K": {"quantization": N / 3.0, "angle_random_walk": N, "rate_random_walk": N * 3**0.5 / 12.0},
}
RATE, AXES = 100.0, 9
# The published curves: rate [Hz], samples, units of gyros and accelerometers.
REAL = {"adis": (100.0, 1_000_000, "deg/s", "g"), "ln200": (400.0, 8_640_000, "rad/s", "m/s²")}
REAL["imar"] = (400.0, 5_760_000, "rad/s", "m/s²")


def run(*, records: int = 16, lengths: tuple[int, ...] = (16_384, 65_536), seed: int = 8) -> Iterator[str]:
    cases = [(terms, n) for terms in CASES for n in lengths]
    tasks = [(*case, 1000 * seed + k) for case in cases for k in range(records)]
    found, rows = run_tasks(both, tasks), []
    for case in cases:
        own = [x for task, xs in zip(tasks, found, strict=True) if task[:2] == case for x in xs]
        for label in CASES[case[0]]:
            of = np.array([x[1:] for x in own if x[0] == label])
            told = [f"{100 * np.mean(of[:, k]):+.1f} ± {100 * np.std(of[:, k]):.1f} %" for k in (0, 1)]
            apart = f"{np.sqrt(np.nanmean(of[:, 2] ** 2)):.2f}"
            rows.append([*case, label.replace("_", " "), *told, apart, share(of[:, 3]), share(of[:, 4])])
    head = ["terms", "samples", "coefficient", "from samples", "from the curve", "apart"]
    yield table([*head, "covered (samples)", "covered (curve)"], rows)
    for name, (rate, n, gyro, accel) in REAL.items():
        try:
            path = data(f"allan_curves/{name}.csv")
        except UnavailableError as error:
            yield f"{name}: {error}."
            continue
        curve = aj.read_curve(path, rate, n / rate, gyro_unit=gyro, accel_unit=accel)
        yield f"```text\n{aj.fit(curve)}\n```"


def both(terms: str, n: int, seed: int) -> list[tuple[Any, ...]]:
    """Of each axis and coefficient the errors of both fits, their distance, and whether they cover."""
    import jax

    truth, rng = CASES[terms], np.random.default_rng([seed, n, len(terms)])
    units = {"Q": aj.Quantization(), "N": aj.AngleRandomWalk(), "B": aj.BiasInstability()}
    units["K"] = aj.RateRandomWalk()
    model = aj.Model(tuple(units[letter] for letter in terms.split(" + "))).with_values(**truth)
    keys = [jax.random.key(int(rng.integers(2**31))) for _ in range(AXES)]
    samples = np.stack([np.asarray(aj.simulate(model, n, RATE, key)) for key in keys], axis=1)
    names = [f"gyro_{k + 1}" for k in range(AXES)]
    recording = aj.Recording.from_array(samples, RATE, gyro_unit="rad/s", names=names)
    fits = aj.fit(recording, terms, as_is=True, plain=True), aj.fit(tabled(recording), terms)
    rows = []
    for name in names:
        for label, true in truth.items():
            one, two = (f[name].coefficients[label] for f in fits)
            covers = [bool(c.interval[0] <= true <= c.interval[1]) for c in (one, two)]
            apart = (two.value - one.value) / one.std if one.std > 0.0 else np.nan
            rows.append((label, one.value / true - 1.0, two.value / true - 1.0, apart, *covers))
    return rows


def tabled(recording: aj.Recording) -> aj.AllanDeviation:
    """The curve of a recording, from a file of six digits."""
    curve = aj.allan_deviation(recording)
    head = ["tau [s]", *(f"{name} [deg/h]" for name in curve.names)]
    columns = np.column_stack([curve.cluster_time, curve.deviation * np.degrees(3600.0)])
    text = io.StringIO()
    np.savetxt(text, columns, "%.6g", ",", header=",".join(head), comments="")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "curve.csv"
        path.write_text(text.getvalue(), encoding="utf-8")
        return aj.read_curve(path, recording.rate, recording.n / recording.rate)
