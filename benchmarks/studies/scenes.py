"""Do everyday recordings, with a few random things wrong in each, give right intervals or reasons, and no traceback?

A scene has one, three or six axes of white noise, sometimes with Q, B and K, at 50–200 Hz, and up to four of
the kinds of `KINDS`. It is written as CSV or Parquet and goes through `characterize`, `check`, `export`, every
sixth through `critique`, and each block of scenes through `fleet`, all by their command lines in this process.
Anything but exit codes and errors of allanjax's own is a traceback.

N has a meaning on axes without clipping, held samples, a filter, and rounding by more than 1.4 σ, where σ is
the white noise from sample to sample. *Silently off*: N is off by more than 5 σ (its own) and 5 %, and neither
a warning about the axis nor its verdict says so. *Refused*: no result, or one that is "not a measurement".
The interval of N is the one of 95 %. `--scene SEED` shows one scene: what is in it and what the commands say.
"""

from __future__ import annotations

import dataclasses
import re
import tempfile
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import scipy.signal
from distributed import LocalCluster
from typer.testing import CliRunner

import allanjax as aj
from allanjax.cli.app import app
from benchmarks.common.hidden_sensors import coloured_noise, log_uniform
from benchmarks.common.study import WrongError, run_tasks, share, table

QUICK: dict[str, Any] = {"scenes": 6, "block": 6}
COMMANDS, CRITICIZED = ("characterize", "check", "export", "critique", "fleet"), 6
UNITS, NOISE = {"gyro": "rad/s", "accel": "m/s^2"}, {"gyro": 1e-4, "accel": 1e-3}
TARGETS = ("kalibr", "vins-mono", "lio-sam", "gz-sim", "px4", "ros-imu")
#: A worker's error that is not allanjax's own, as a fleet reports it: with the name of its class.
FOREIGN = re.compile(r"^error: .*: \w*(Error|Exception): ", re.MULTILINE)
WHITE, STATUS = "angle_random_walk", ("done", "refused", "traceback")
HEAD = ("axes", "interval holds", "silently off", "refused")


@dataclasses.dataclass
class Scene:
    """Samples [n, axes] in SI at times [s], N of each axis, and the axes of which N has no meaning."""

    seed: int
    rng: np.random.Generator
    rate: float
    time: np.ndarray
    names: list[str]
    values: np.ndarray
    N: np.ndarray
    kinds: tuple[str, ...] = ()
    void: set[str] = dataclasses.field(default_factory=set)

    @property
    def sigma(self) -> np.ndarray:
        return self.N * np.sqrt(self.rate)

    def some(self, low: float, high: float) -> np.ndarray:
        """A size of so many σ for some of the axes, 0 for the others."""
        on = self.rng.random(len(self.names)) < self.rng.choice([0.3, 1.0])
        on[self.rng.integers(len(on))] = True
        return on * self.sigma * log_uniform(self.rng, low, high)

    def stretch(self, low: float, high: float) -> slice:
        """Some samples, of so many seconds but no more than a tenth of the record."""
        n = len(self.time)
        count = min(max(round(log_uniform(self.rng, low, high) * self.rate), 1), n // 10)
        first = self.rng.integers(n - count)
        return slice(first, first + count)

    def spoil(self, of: np.ndarray | bool) -> None:
        """Note that N of these axes has no meaning."""
        self.void |= set(np.array(self.names)[np.broadcast_to(of, len(self.names))].tolist())


# --- What may be in a scene, in the order in which it comes about --------------------------------------------


def warm_up(s: Scene) -> None:
    settling = np.exp(-s.time / (log_uniform(s.rng, 0.02, 0.3) * s.time[-1]))
    s.values += np.outer(settling, s.some(1.0, 100.0))


def step(s: Scene) -> None:
    s.values += np.outer(s.time > s.rng.uniform(0.05, 0.95) * s.time[-1], s.some(0.3, 30.0))


def line(s: Scene) -> None:
    """A line that is steady or wanders by up to a few percent."""
    wander = s.rng.choice([0.0, 0.03]) * np.cumsum(s.rng.standard_normal(len(s.time))) / np.sqrt(len(s.time))
    phase = np.cumsum(log_uniform(s.rng, 1.0, 0.45 * s.rate) * (1.0 + wander)) / s.rate
    s.values += np.outer(np.sin(2.0 * np.pi * phase), s.some(0.1, 20.0))


def burst(s: Scene) -> None:
    where = s.stretch(0.2, 5.0)
    s.values[where] += s.rng.standard_normal(s.values[where].shape) * s.some(3.0, 100.0)


def spikes(s: Scene) -> None:
    k, rows = s.rng.integers(len(s.names)), s.rng.integers(len(s.time), size=s.rng.integers(1, 61))
    s.values[rows, k] += s.sigma[k] * log_uniform(s.rng, 10.0, 1000.0) * s.rng.choice([-1.0, 1.0], len(rows))


def low_pass(s: Scene) -> None:
    b, a = scipy.signal.butter(s.rng.integers(1, 3), s.rng.uniform(0.1, 0.8))
    first = s.values[:1]
    s.values = scipy.signal.lfilter(b, a, s.values - first, axis=0) + first
    s.spoil(True)


def clipping(s: Scene) -> None:
    reach, middle = s.some(1.0, 4.0), np.median(s.values, axis=0)
    clipped = np.clip(s.values, middle - reach, middle + reach)
    s.values = np.where(reach > 0.0, clipped, s.values)
    s.spoil(reach > 0.0)


def rounding(s: Scene) -> None:
    steps = log_uniform(s.rng, 0.1, 5.0) * of_sensor(s) * np.sqrt(s.rate)
    s.values = steps * np.round(s.values / steps)
    s.spoil(steps > 1.4 * s.sigma)


def of_sensor(s: Scene) -> np.ndarray:
    """The mean N of the axes of the same sensor."""
    sensors = np.array([name.split("_")[0] for name in s.names])
    return np.array([s.N[sensors == sensor].mean() for sensor in sensors])


def held(s: Scene) -> None:
    new = s.rng.random(len(s.time)) > s.rng.uniform(0.05, 0.5)
    s.values = s.values[np.maximum.accumulate(np.where(new, np.arange(len(new)), 0))]
    s.spoil(True)


def dead(s: Scene) -> None:
    k = s.rng.integers(len(s.names))
    s.values[:, k] = s.rng.choice([0.0, s.values[0, k]])
    s.spoil(np.arange(len(s.names)) == k)


def mixed_rates(s: Scene) -> None:
    """Accelerometers are slower, and each row repeats the last samples of the other sensor."""
    slow = s.rate * s.rng.uniform(0.3, 0.9)
    stamps = np.arange(int(s.time[-1] * slow)) / slow + 0.3 / s.rate
    time = np.union1d(s.time, stamps)
    rows = [np.maximum(np.searchsorted(own, time, "right") - 1, 0) for own in (s.time, stamps)]
    s.values = np.hstack([s.values[rows[0], :3], s.values[rows[1], 3:]])
    s.time, s.N = time, s.N * np.repeat([1.0, np.sqrt(s.rate / slow)], 3)


def gaps(s: Scene) -> None:
    """Stretches whose rows are lost, or whose samples are not numbers, perhaps those of one sensor."""
    lost, keep = s.rng.random() < 0.5, np.ones(len(s.time), bool)
    first = s.rng.choice([0, len(s.names) // 2])
    for where in (s.stretch(0.02, 10.0) for _ in range(s.rng.integers(1, 5))):
        keep[where] = False
        if not lost:
            s.values[where, first:] = np.nan
    if lost:
        s.time, s.values = s.time[keep], s.values[keep]


KINDS: dict[str, Callable[[Scene], None]] = {
    f.__name__.replace("_", " "): f
    for f in (
        *(warm_up, step, line, burst, spikes, low_pass, clipping, rounding, held, dead, mixed_rates, gaps),
    )
}


def drawn(seed: int) -> Scene:
    """A random scene."""
    rng = np.random.default_rng([seed, 36])
    n, rate = round(log_uniform(rng, 700.0, 30_000.0)), float(rng.choice([50.0, 100.0, 125.0, 200.0]))
    sensors = [["gyro"], ["accel"], ["gyro", "accel"]][rng.integers(3)]
    names = [f"{sensor}_{axis}" for sensor in sensors for axis in "xyz"]
    if len(names) == 3 and rng.random() < 0.5:
        names = [names[rng.integers(3)]]
    crossing = {"Q": 5.0 / rate, "B": n / rate / 20.0, "K": n / rate / 4.0}
    present = [c for c in crossing if rng.random() < 0.25]
    N = np.array([NOISE[name.split("_")[0]] * log_uniform(rng, 0.5, 2.0) for name in names])
    columns = []
    for name, white in zip(names, N, strict=True):
        sizes = {"Q": np.sqrt(crossing["Q"] / 3.0), "B": crossing["B"] ** -0.5, "K": 1.7 / crossing["K"]}
        noise = coloured_noise({c: white * sizes[c] for c in present}, n, rate, rng)
        columns.append(white * np.sqrt(rate) * rng.standard_normal(n) + noise + 9.81 * (name == "accel_z"))
    possible = [kind for kind in KINDS if len(names) == 6 or kind != "mixed rates"]
    chosen = rng.choice(possible, rng.integers(0, 5), replace=False).tolist()
    found = Scene(seed, rng, rate, np.arange(n) / rate, names, np.stack(columns, 1), N)
    for kind in (kind for kind in KINDS if kind in chosen):
        KINDS[kind](found)
    found.kinds = (*present, *(kind for kind in KINDS if kind in chosen))
    return found


# --- What comes of it ----------------------------------------------------------------------------------------


class Axis(NamedTuple):
    """What `characterize` says of an N that has a meaning; `off`: its error in its own σ."""

    name: str
    told: str
    off: float = np.nan


class Said(NamedTuple):
    """What a command came to ("done", "refused" or "traceback"), and what it printed."""

    status: str
    text: str


class Outcome(NamedTuple):
    """What came of a scene, by command and by axis."""

    seed: int
    kinds: tuple[str, ...]
    commands: dict[str, Said]
    axes: list[Axis]


def outcomes(first: int, count: int) -> list[Outcome]:
    """What comes of a block of scenes."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        found = [outcome(drawn(seed), folder) for seed in range(first, first + count)]
        found[0].commands["fleet"] = fleet(folder)
    return found


def outcome(s: Scene, folder: Path) -> Outcome:
    path, results = folder / f"{s.seed}.{('csv', 'parquet')[s.seed % 2]}", folder / "results"
    columns = [f"{name} [{UNITS[name.split('_')[0]]}]" for name in s.names]
    frame = pd.DataFrame(np.column_stack([s.time, s.values]), columns=["time [s]", *columns])
    if path.suffix == ".csv":
        frame.to_csv(path, index=False, float_format="%.9g")
    else:
        frame.to_parquet(path)
    gaps, fitted = ("--gaps", ("fill", "segments")[s.seed // 2 % 2]), results / f"{s.seed}.json"
    commands = {
        "characterize": call("characterize", path, *gaps, "--out", results),
        "check": call("check", path, *gaps),
    }
    if fitted.exists():
        target = TARGETS[s.seed % len(TARGETS)]
        commands["export"] = call("export", fitted, "--to", target, "-o", folder / "exported")
    if s.seed % CRITICIZED == 0:
        commands["critique"] = call("critique", path, *gaps, "--out", folder / "critiques")
    fit = aj.load(fitted) if fitted.exists() else None
    truth = {name: N for name, N in zip(s.names, s.N, strict=True) if name not in s.void}
    return Outcome(s.seed, s.kinds, commands, [axis_of(fit, name, N) for name, N in truth.items()])


def call(*words: object) -> Said:
    """What comes of a command line, in this process."""
    result = CliRunner().invoke(app, [str(word) for word in words])
    text = f"$ allanjax {' '.join(map(str, words))}\n{result.output}"
    if result.exception is None or isinstance(result.exception, SystemExit):
        return Said("refused" if result.exit_code else "done", text)
    return Said("traceback", text + "".join(traceback.format_exception(result.exception)))


def fleet(folder: Path) -> Said:
    """What comes of a fleet of a folder's files, worked on in this process."""
    files = [str(folder / f"*.{suffix}") for suffix in ("csv", "parquet") if list(folder.glob(f"*.{suffix}"))]
    with LocalCluster(
        1, threads_per_worker=1, processes=False, dashboard_address=None, silence_logs=50
    ) as cluster:
        where = ("--out", folder / "fleet", "--scheduler", cluster.scheduler_address)
        said = call("fleet", *files, "--gaps", "fill", *where)
    return Said("traceback", said.text) if FOREIGN.search(said.text) else said


def axis_of(fit: aj.Fit | None, name: str, truth: float) -> Axis:
    """What a fit says of N of an axis."""
    if fit is None or name in fit.without_result or name in fit.not_measured:
        return Axis(name, "refused")
    found = fit[name].coefficients.get(WHITE)
    if found is None:
        return Axis(name, "missed")
    off = (found.value - truth) / found.std
    if found.interval[0] <= truth <= found.interval[1]:
        return Axis(name, "held", off)
    warned = any(name in fact.axes and fact.text in fit.warnings for fact in fit.facts)
    excused = warned or "incomplete" in fit[name].verdict
    far = abs(off) > 5.0 and abs(found.value / truth - 1.0) > 0.05
    return Axis(name, "silently off" if far and not excused else "missed", off)


def run(*, scenes: int = 300, block: int = 25, seed: int = 1_000_000, scene: int = -1) -> Iterator[str]:
    """Scenes of the seeds from `seed` on; a fleet has as many of them as a block."""
    if scene >= 0:
        scenes, block, seed = 1, 1, scene
    tasks = [(first, min(block, seed + scenes - first)) for first in range(seed, seed + scenes, block)]
    found = [outcome for each in run_tasks(outcomes, tasks) for outcome in each]
    if scene >= 0:
        yield "\n".join(said.text for said in found[0].commands.values())
    said = {name: [o.commands[name].status for o in found if name in o.commands] for name in COMMANDS}
    rows = [[name, len(own), *map(own.count, STATUS)] for name, own in said.items()]
    yield table(["command", "runs", *STATUS], rows)
    groups = {"all": found, "nothing": [o for o in found if not o.kinds]}
    groups |= {kind: [o for o in found if kind in o.kinds] for kind in (*KINDS, *"QBK")}
    yield table(
        ["scenes with", "scenes", *HEAD],
        [row for kind, own in groups.items() if (row := [kind, len(own), *counts(own)])],
    )
    yield "\n".join(line for o in found for line in lines(o)) or "No interval missed."
    wrong = [o.seed for o in found if any(said.status == "traceback" for said in o.commands.values())]
    if wrong:
        raise WrongError(f"tracebacks in scenes {', '.join(map(str, wrong))}")


def counts(found: list[Outcome]) -> list[object]:
    """Axes whose N has a meaning, the share of measured ones whose interval holds, and how many of others."""
    told = [axis.told for o in found for axis in o.axes]
    measured = [each == "held" for each in told if each != "refused"]
    return [len(told), share(measured), told.count("silently off"), told.count("refused")]


def lines(o: Outcome) -> Iterator[str]:
    """What went wrong in a scene."""
    kinds = ", ".join(o.kinds) or "nothing"
    missed = [f"{a.name} {a.told} by {a.off:.1f} σ" for a in o.axes if a.told in ("missed", "silently off")]
    if missed:
        yield f"- {o.seed} ({kinds}): {', '.join(missed)}"
    for name, said in o.commands.items():
        if said.status == "traceback":
            yield f"- {o.seed} ({kinds}): `{name}`: {said.text.strip().splitlines()[-1]}"
