"""Do everyday recordings with a few random faults end in right intervals or reasons, and not in tracebacks?

A scene has one, three or six axes of white noise, sometimes with Q, B and K, at 50–200 Hz, and up to four of
the kinds of `KINDS`. As CSV or Parquet it goes through `characterize`, `check`, `export`, every sixth through
`critique`, and each block of scenes through `fleet`, all by their command lines in this process. A traceback
is any exception that is not allanjax's own.

N has a meaning on axes without clipping, held samples, a filter, and rounding by more than 1.4 σ, where σ is
the white noise from sample to sample. *Silently off*: by more than 5 σ (of the fit) and 5 %, and neither a
warning about the axis nor its verdict says so. *Refused*: no result, or one that is "not a measurement".
Intervals are those of 95 %. `--scene SEED` shows what the commands print for one scene.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
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

import allanjax as aj
from allanjax.cli.app import run as run_command
from benchmarks.common.hidden_sensors import coloured_noise, log_uniform
from benchmarks.common.study import WrongError, run_tasks, share, table

QUICK: dict[str, Any] = {"scenes": 6, "block": 6}
COMMANDS, CRITICIZED = ("characterize", "check", "export", "critique", "fleet"), 6
UNITS, NOISE = {"gyro": "rad/s", "accel": "m/s^2"}, {"gyro": 1e-4, "accel": 1e-3}
TARGETS = ("kalibr", "vins-mono", "lio-sam", "gz-sim", "px4", "ros-imu")
#: A worker's error that is not allanjax's own, as a fleet reports it: with the name of its class.
FOREIGN = re.compile(r"^error: .*: \w*(Error|Exception): ", re.MULTILINE)
STATUS, HEAD = ("done", "refused", "traceback"), ("axes", "interval holds", "silently off", "refused")


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
        """Samples of so many seconds, but no more than a tenth of the record."""
        n = len(self.time)
        count = min(max(round(log_uniform(self.rng, low, high) * self.rate), 1), n // 10)
        first = self.rng.integers(n - count)
        return slice(first, first + count)

    def spoil(self, of: np.ndarray | bool) -> None:
        """Note that N of these axes has no meaning."""
        self.void |= set(np.array(self.names)[np.broadcast_to(of, len(self.names))].tolist())


# --- What may be in a scene, in the order in which it comes about ------------------------------------------


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
    reach[reach == 0.0] = np.inf
    s.values = np.clip(s.values, middle - reach, middle + reach)
    s.spoil(np.isfinite(reach))


def rounding(s: Scene) -> None:
    sensors = np.array([name.split("_")[0] for name in s.names])
    same = (sensors[:, None] == sensors).astype(float)
    steps = log_uniform(s.rng, 0.1, 5.0) * (same @ s.sigma) / same.sum(axis=1)
    s.values = steps * np.round(s.values / steps)
    s.spoil(steps > 1.4 * s.sigma)


def held(s: Scene) -> None:
    new = s.rng.random(len(s.time)) > s.rng.uniform(0.05, 0.5)
    s.values = s.values[np.maximum.accumulate(np.where(new, np.arange(len(new)), 0))]
    s.spoil(True)


def dead(s: Scene) -> None:
    k = s.rng.integers(len(s.names))
    s.values[:, k] = s.rng.choice([0.0, s.values[0, k]])
    s.spoil(np.arange(len(s.names)) == k)


def mixed_rates(s: Scene) -> None:
    """Six axes: accelerometers are slower, and each row repeats the last samples of the other sensor."""
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


EARLY = (warm_up, step, line, burst, spikes, low_pass)
LATE = (clipping, rounding, held, dead, mixed_rates, gaps)
KINDS: dict[str, Callable[[Scene], None]] = {f.__name__.replace("_", " "): f for f in (*EARLY, *LATE)}


def drawn(seed: int) -> Scene:
    """A random scene."""
    rng = np.random.default_rng([seed, 36])
    n, rate = round(log_uniform(rng, 700.0, 30_000.0)), float(rng.choice([50.0, 100.0, 125.0, 200.0]))
    sensors = [["gyro"], ["accel"], ["gyro", "accel"]][rng.integers(3)]
    names = [f"{sensor}_{axis}" for sensor in sensors for axis in "xyz"]
    if len(names) == 3 and rng.random() < 0.5:
        names = [names[rng.integers(3)]]
    # Q, B and K over N, and N of each axis.
    sizes = {"Q": np.sqrt(5.0 / rate / 3.0), "B": np.sqrt(20.0 * rate / n), "K": 6.8 * rate / n}
    present = [c for c in sizes if rng.random() < 0.25]
    N = np.array([NOISE[name.split("_")[0]] * log_uniform(rng, 0.5, 2.0) for name in names])
    columns = []
    for name, white in zip(names, N, strict=True):
        noise = coloured_noise({c: white * sizes[c] for c in present}, n, rate, rng)
        columns.append(white * np.sqrt(rate) * rng.standard_normal(n) + noise + 9.81 * (name == "accel_z"))
    possible = [kind for kind in KINDS if len(names) == 6 or kind != "mixed rates"]
    chosen = rng.choice(possible, rng.integers(0, 5), replace=False)
    kinds = tuple(kind for kind in KINDS if kind in chosen)
    found = Scene(seed, rng, rate, np.arange(n) / rate, names, np.stack(columns, 1), N, (*present, *kinds))
    for kind in kinds:
        KINDS[kind](found)
    return found


# --- What comes of it --------------------------------------------------------------------------------------


class Outcome(NamedTuple):
    """Of each command its status and what it printed; of axes what became of N, and its error in σ."""

    seed: int
    kinds: tuple[str, ...]
    commands: dict[str, tuple[str, str]]
    axes: dict[str, tuple[str, float]]


def outcomes(first: int, count: int) -> list[Outcome]:
    """What comes of a block of scenes."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        found = [outcome(drawn(seed), folder) for seed in range(first, first + count)]
        files = [str(folder / f"*.{x}") for x in ("csv", "parquet") if list(folder.glob(f"*.{x}"))]
        with LocalCluster(1, processes=False, dashboard_address=None, silence_logs=50) as cluster:
            where = ("--out", folder / "fleet", "--scheduler", cluster.scheduler_address)
            status, text = called("fleet", *files, "--gaps", "fill", *where)
    found[0].commands["fleet"] = "traceback" if FOREIGN.search(text) else status, text
    return found


def outcome(s: Scene, folder: Path) -> Outcome:
    path, results = folder / f"{s.seed}.{('csv', 'parquet')[s.seed % 2]}", folder / "results"
    columns = [f"{name} [{UNITS[name.split('_')[0]]}]" for name in s.names]
    frame = pd.DataFrame(np.column_stack([s.time, s.values]), columns=["time [s]", *columns])
    if path.suffix == ".csv":
        frame.to_csv(path, index=False, float_format="%.9g")
    else:
        frame.to_parquet(path)
    how, fitted = ("--gaps", ("fill", "segments")[s.seed // 2 % 2]), results / f"{s.seed}.json"
    said = {"characterize": called("characterize", path, *how, "--out", results)}
    said["check"] = called("check", path, *how)
    if s.seed % CRITICIZED == 0:
        said["critique"] = called("critique", path, *how, "--out", folder / "critiques")
    fit = None
    if fitted.exists():
        target = TARGETS[s.seed % len(TARGETS)]
        said["export"], fit = called("export", fitted, "--to", target, "-o", folder / "it"), aj.load(fitted)
    truth = {name: N for name, N in zip(s.names, s.N, strict=True) if name not in s.void}
    return Outcome(s.seed, s.kinds, said, {name: judged(fit, name, N) for name, N in truth.items()})


def called(*words: object) -> tuple[str, str]:
    """Status of a command line, and what it printed."""
    said, status = io.StringIO(), "done"
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        try:
            run_command([str(word) for word in words])
        except SystemExit as end:
            status = "refused" if end.code else "done"
        except Exception:
            status = "traceback"
            traceback.print_exc()
    return status, f"$ allanjax {' '.join(map(str, words))}\n{said.getvalue()}"


def judged(fit: aj.Fit | None, name: str, truth: float) -> tuple[str, float]:
    """What became of N of an axis."""
    if fit is None or name in fit.without_result or name in fit.not_measured:
        return "refused", np.nan
    found = fit[name].coefficients.get("angle_random_walk")
    if found is None or not found.detected:
        return "held" if found is not None and truth <= found.upper_limit else "missed", np.nan
    off = (found.value - truth) / found.std
    if found.interval[0] <= truth <= found.interval[1]:
        return "held", off
    warned = any(
        fact.kind != "length" and name in fact.axes and fact.text in fit.warnings for fact in fit.facts
    )
    far = abs(off) > 5.0 and abs(found.value / truth - 1.0) > 0.05
    return (
        "silently off" if far and not warned and "does not fit" not in fit[name].verdict else "missed"
    ), off


def run(*, scenes: int = 300, block: int = 25, seed: int = 1_000_000, scene: int = -1) -> Iterator[str]:
    """Scenes of the seeds from `seed` on; a fleet has as many of them as a block."""
    if scene >= 0:
        scenes, seed = 1, scene
    tasks = [(first, min(block, seed + scenes - first)) for first in range(seed, seed + scenes, block)]
    found = [outcome for each in run_tasks(outcomes, tasks) for outcome in each]
    if scene >= 0:
        yield "\n".join(text for _, text in found[0].commands.values())
    by_command = {name: [o.commands[name][0] for o in found if name in o.commands] for name in COMMANDS}
    rows = [[name, len(own), *map(own.count, STATUS)] for name, own in by_command.items()]
    yield table(["command", "runs", *STATUS], rows)
    groups = {"all": found, "nothing": [o for o in found if not o.kinds]}
    groups |= {kind: [o for o in found if kind in o.kinds] for kind in (*"QBK", *KINDS)}
    yield table(
        ["scenes with", "scenes", *HEAD], [[kind, len(of), *counts(of)] for kind, of in groups.items()]
    )
    yield "\n".join(text for o in found for text in wrong_in(o)) or "No interval missed."
    if bad := [o.seed for o in found if any(status == "traceback" for status, _ in o.commands.values())]:
        raise WrongError(f"tracebacks in scenes {', '.join(map(str, bad))}")


def counts(found: list[Outcome]) -> list[object]:
    """Axes whose N has a meaning, the share of measured ones whose interval holds, and others."""
    said = [status for o in found for status, _ in o.axes.values()]
    measured = [status == "held" for status in said if status != "refused"]
    return [len(said), share(measured), said.count("silently off"), said.count("refused")]


def wrong_in(o: Outcome) -> Iterator[str]:
    """What went wrong in a scene, a line each."""
    head = f"- {o.seed} ({', '.join(o.kinds) or 'nothing'})"
    missed = [f"{name} {s} by {off:.1f} σ" for name, (s, off) in o.axes.items() if s in (HEAD[2], "missed")]
    if missed:
        yield f"{head}: {', '.join(missed)}"
    for name, (status, text) in o.commands.items():
        if status == "traceback":
            yield f"{head}: `{name}`: {text.strip().splitlines()[-1]}"
