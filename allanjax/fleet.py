"""Many recordings at once, spread over a Dask cluster."""

from __future__ import annotations

import csv
import json
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import CancelledError
from dataclasses import dataclass, replace
from functools import reduce
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from allanjax.accumulator import AllanAccumulator, accumulate
from allanjax.equality import ByValue
from allanjax.errors import AllanjaxError
from allanjax.export import to_dict
from allanjax.fit import Objective
from allanjax.fleet_cluster import Call, connected, outcomes, submitted
from allanjax.fleet_files import matching_files, recording_names
from allanjax.fleet_table import fleet_table, rows_of, write_table
from allanjax.io import ReadOptions, read_recording
from allanjax.io.chunks import open_chunks
from allanjax.notation import ModelLike, as_model
from allanjax.options import FitOptions
from allanjax.recording import Axis, rows_between
from allanjax.result import Fit, title_of
from allanjax.text_table import html_table, text_table

if TYPE_CHECKING:
    import pandas as pd
    from distributed import Client
    from matplotlib.figure import Figure

Progress = Callable[[int, int, int], None]
"""Told how many recordings are done, how many of those failed, and how many there are."""

_RECORDINGS = "recordings"
_HEADINGS = ("axis", "coefficient", "detected", "median", "5 … 95 %", "outlying")
_NAMED_UNITS = 5
_SHORTEST_PIECE = 100_000
# Of text, which does not say how many rows it has.
_ROW_BYTES = 40


@dataclass(frozen=True, eq=False)
class FleetResult(ByValue):
    """The coefficients of a fleet.

    Attributes:
        table: one row a recording, axis and coefficient, in the usual units; see `fleet_table.table_schema`.
        errors: what has no result and why: `file`, and a `message` that names the axis unless it is all.
        files: the recordings; `resumed` of them have results from an earlier run.
    """

    table: pd.DataFrame
    errors: tuple[dict[str, str], ...]
    files: tuple[Path, ...]
    resumed: int

    @property
    def outlying(self) -> pd.DataFrame:
        """The rows of values that are unlike those of the other units."""
        return self.table[self.table["outlying"]]

    def to_dataframe(self) -> pd.DataFrame:
        """The table, as the other results give theirs."""
        return self.table

    def plot(self, path: str | os.PathLike[str] | None = None) -> Figure:
        """Draw the distribution of each coefficient over the fleet; see `plot_fleet`."""
        from allanjax.plot_fleet import plot_fleet

        return plot_fleet(self.table, path)

    def _title(self) -> str:
        failed = len({error["file"] for error in self.errors})
        return (
            f"{len(self.files)} recordings: {len(self.files) - failed} without an error, {failed} with; "
            f"{self.resumed} taken from an earlier run"
        )

    def _cells(self) -> list[tuple[str, ...]]:
        """Rows of the printed table, one an axis and coefficient; quantiles are without outlying units."""
        cells: list[tuple[str, ...]] = []
        for _, of in self.table.groupby(["axis", "coefficient"], sort=False):
            axis, sensor, coefficient, unit = of[["axis", "sensor", "coefficient", "unit"]].iloc[0]
            found = of[of["detected"]]
            usual = found.loc[~found["outlying"], "value"]
            median = span = ""
            if len(usual):
                median = f"{usual.median():.4g}{'' if unit == '1' else f' {unit}'}"
                span = " … ".join(f"{usual.quantile(q):.4g}" for q in (0.05, 0.95))
            units = list(of.loc[of["outlying"], "recording"])
            named = ", ".join(units[:_NAMED_UNITS])
            if len(units) > _NAMED_UNITS:
                named += f" and {len(units) - _NAMED_UNITS} more"
            title = title_of(coefficient, Axis(axis, sensor, unit))
            cells.append((axis, title, f"{len(found)} of {len(of)}", median, span, named))
        return cells

    def __str__(self) -> str:
        # As its title the line would be broken at a narrow table's width.
        return f"{self._title()}\n{text_table('', _HEADINGS, self._cells())}"

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return html_table(self._title(), _HEADINGS, self._cells())


def characterize_fleet(
    files: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    out: str | os.PathLike[str],
    model: ModelLike | None = None,
    objective: Objective = "allan",
    *,
    regressors: Sequence[str] = (),
    workers: int | None = None,
    scheduler: str | None = None,
    piece: int = 20_000_000,
    progress: Progress | None = None,
    **reading: Any,
) -> FleetResult:
    """Estimate the noise coefficients of many recordings on a Dask cluster, one task a recording.

    A recording that is longer than `piece` is read in pieces of that many samples, side by side, and never
    in memory as a whole: its coefficients are those of an `AllanAccumulator`.

    Writes `fleet.parquet` (the table), `fleet.png` (each coefficient's distribution over the fleet) and
    `errors.csv` (file, message) to `out`, and each recording's fit to `out/recordings` as soon as it is
    done. A recording that fails does not stop the others; neither does a worker that dies, whose recording
    another one takes. A later run with the same `out` computes only what is not there yet: recordings whose
    file (path, size, time of its last change), options or version of allanjax are others, and those that
    failed.

    The local cluster's workers are processes that import the calling script: in a script, call this below
    `if __name__ == "__main__":`.

    Args:
        files: paths and patterns such as `logs/**/*.parquet`; on a cluster of several machines, in a place
            that all see under the same path. Files below `out` are left out.
        out: folder for the results.
        model, objective, regressors: as for `fit`.
        workers: processes of a local cluster that lives as long as this call; one a core by default.
        scheduler: address of a cluster to use instead, e.g. `tcp://host:8786`; its workers need allanjax.
        piece: samples; longer recordings are divided.
        progress: called with the numbers of recordings done, failed, and in all.
        **reading: as for `read`: rate, gyro_unit, accel_unit, columns, time, time_unit, start, stop.

    Returns:
        The table, with outlying units marked, and the errors.

    Raises:
        AllanjaxError: a pattern matches no file; Dask is not installed; the scheduler does not answer;
            `workers` is less than one or given with `scheduler`; a `piece` of less than 10⁵ samples.
    """
    _check_workers(workers, scheduler)
    if piece < _SHORTEST_PIECE:
        raise AllanjaxError(f"piece= (--piece) must be at least {_SHORTEST_PIECE} samples, not {piece}")
    out = Path(out)
    paths = matching_files(files, out)
    added = None if model is None else as_model(model)
    options = FitOptions(ReadOptions(**reading), added, objective, tuple(regressors))
    folder = out / _RECORDINGS
    folder.mkdir(parents=True, exist_ok=True)
    recordings = dict(zip(recording_names(paths), paths, strict=True))
    keys = {name: _key(path, options) for name, path in recordings.items()}
    fits = {name: _stored(folder, name, key) for name, key in keys.items()}
    todo = {name: path.absolute() for name, path in recordings.items() if fits[name] is None}
    rows = {name: rows_of(fit, name, str(recordings[name])) for name, fit in fits.items() if fit is not None}
    errors = {name: _axes_without_result(fit) for name, fit in fits.items() if fit is not None}
    resumed = len(rows)
    tell = progress or (lambda done, failed, total: None)
    tell(len(rows), sum(map(bool, errors.values())), len(paths))
    if todo:
        with connected(scheduler, workers, len(todo)) as client:
            calls = {name: _call_for(client, path, options, piece) for name, path in todo.items()}
            for name, outcome in outcomes(client, calls):
                if isinstance(outcome, Exception):
                    errors[name] = [_reason(recordings[name], outcome)]
                else:
                    _store(folder, name, {"key": keys[name], "fit": outcome})
                    rows[name] = rows_of(outcome, name, str(recordings[name]))
                    errors[name] = _axes_without_result(outcome)
                tell(len(errors), sum(map(bool, errors.values())), len(paths))
    return _written(out, recordings, rows, errors, resumed)


def characterize_recording(path: str | os.PathLike[str], options: FitOptions) -> Fit:
    """Read and fit one recording of a fleet.

    Raises:
        AllanjaxError: as `read` and `fit` do.
    """
    return options.fit(read_recording(path, options.reading))


def _check_workers(workers: int | None, scheduler: str | None) -> None:
    if workers is not None and workers < 1:
        raise AllanjaxError(f"workers= (--workers) must be at least 1, not {workers}")
    if workers is not None and scheduler is not None:
        raise AllanjaxError(
            "workers= (--workers) are those of a local cluster, and the one at scheduler= (--scheduler) "
            "has its own: leave out one of the two"
        )


def _characterize(path: Path, options: FitOptions) -> dict[str, Any]:
    """What a worker does with a recording."""
    return to_dict(characterize_recording(path, options))


def _call_for(client: Client, path: Path, options: FitOptions, piece: int) -> Call:
    """What to call for a recording: one function, or that which puts the pieces of a long one together."""
    stretches = _pieces(path, options, piece)
    if not stretches:
        return _characterize, (path, options)
    pieces = [submitted(client, (_accumulate, (path, reading, first))) for first, reading in stretches]
    return _characterize_pieces, (pieces, options)


def _pieces(path: Path, options: FitOptions, piece: int) -> list[tuple[int, ReadOptions]]:
    """First sample, and how to read it, of each piece of a long recording; none of another."""
    try:
        size = path.stat().st_size
        # A sample takes a byte at least.
        if size < piece or options.regressors:
            return []
        recording = open_chunks(path, options.reading)
    except (AllanjaxError, OSError):
        # The worker that reads it as a whole will say what is wrong.
        return []
    # Time stamps would give each piece a rate of its own.
    reading = replace(options.reading, rate=recording.rate)
    if recording.n is None:
        return [(0, reading)] if size > _ROW_BYTES * piece else []
    if recording.n <= piece:
        return []
    begin, end = reading.start, reading.stop
    firsts = range(0, recording.n, piece)
    origin = rows_between(sys.maxsize, recording.rate, begin, None).start
    # Half-way between two samples: time stamps need not be exact.
    times = [(origin + first - 0.5) / recording.rate for first in firsts[1:]]
    stretches = zip(firsts, [begin, *times], [*times, end], strict=True)
    return [(first, replace(reading, start=start, stop=stop)) for first, start, stop in stretches]


def _accumulate(path: Path, reading: ReadOptions, first: int) -> AllanAccumulator:
    """What a worker does with a piece of a recording."""
    return accumulate(open_chunks(path, reading), start=first)


def _characterize_pieces(pieces: Sequence[AllanAccumulator], options: FitOptions) -> dict[str, Any]:
    """What a worker does with all pieces of a recording."""
    return to_dict(options.fit_accumulated(reduce(AllanAccumulator.merge, pieces)))


def _key(path: Path, options: FitOptions) -> dict[str, Any] | None:
    """What a result depends on; None if there is no such file."""
    try:
        status = path.stat()
    except OSError:
        return None
    key = {
        "path": str(path.resolve()),
        "size": status.st_size,
        "modified_ns": status.st_mtime_ns,
        "options": options.to_dict(),
        "allanjax_version": version("allanjax"),
    }
    # As it is after a round trip through a file: tuples become lists.
    return json.loads(json.dumps(key, default=str))


def _stored(folder: Path, name: str, key: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """The fit that an earlier run left under this key."""
    try:
        document = json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return document["fit"] if key is not None and document.get("key") == key else None


def _store(folder: Path, name: str, document: Mapping[str, Any]) -> None:
    """Written beside and renamed: whatever happens, a result is there as a whole or not at all."""
    path, draft = folder / f"{name}.json", folder / f".{name}.{os.getpid()}"
    draft.write_text(json.dumps(document, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8")
    draft.replace(path)


def _axes_without_result(fit: Mapping[str, Any]) -> list[str]:
    return [f"{axis['name']}: no result, {axis['reason']}" for axis in fit["axes"] if not axis["converged"]]


def _reason(path: Path, error: Exception) -> str:
    from distributed import KilledWorker

    if isinstance(error, KilledWorker):
        return (
            "each worker that took it died, most likely for want of memory; use fewer workers= (--workers), "
            "or a stretch of the recording by start= and stop= (--start, --stop)"
        )
    if isinstance(error, CancelledError):
        return "the scheduler was lost before it was done; start it, and run again: what is done is kept"
    # What a reader or a fit says begins with the file that the worker was given.
    text = str(error).removeprefix(f"{path.absolute()}: ")
    return text if isinstance(error, AllanjaxError | OSError) else f"{type(error).__name__}: {text}"


def _written(
    out: Path,
    recordings: Mapping[str, Path],
    rows: Mapping[str, Sequence[Mapping[str, Any]]],
    errors: Mapping[str, Sequence[str]],
    resumed: int,
) -> FleetResult:
    """The fleet's result, in the order of the recordings whatever the order they ended in."""
    from matplotlib import pyplot as plt

    table = fleet_table([row for name in recordings for row in rows.get(name, ())])
    failures = tuple(
        {"file": str(path), "message": message}
        for name, path in recordings.items()
        for message in errors.get(name, ())
    )
    result = FleetResult(table, failures, tuple(recordings.values()), resumed)
    write_table(table, out / "fleet.parquet")
    with (out / "errors.csv").open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, ["file", "message"])
        writer.writeheader()
        writer.writerows(failures)
    plt.close(result.plot(out / "fleet.png"))
    return result
