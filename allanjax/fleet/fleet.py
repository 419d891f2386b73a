"""Many recordings at once, spread over a Dask cluster."""

from __future__ import annotations

import csv
import functools
import json
import logging
import os
import signal
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from multiprocessing import resource_tracker
from pathlib import Path
from typing import TYPE_CHECKING, Any

from allanjax.base.cache import enable_compilation_cache
from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError, AllanjaxWarning, MixedRatesError
from allanjax.base.late import presented
from allanjax.base.tables import Column, Tabled
from allanjax.base.wording import harmless
from allanjax.comparison.specification import SpecCheck, SpecLike, read_sheet, read_spec
from allanjax.estimate.as_json import fits_in, to_dict
from allanjax.estimate.fit import Objective
from allanjax.fleet.files import (
    Names,
    earlier,
    key_of,
    matching_files,
    names_by,
    recording_names,
    store,
    stored,
)
from allanjax.fleet.limits import checked, lines_of_limits, rows_of_limits, table_of_limits, verdict_of
from allanjax.fleet.options import FitOptions
from allanjax.fleet.stream import AllanAccumulator, accumulate
from allanjax.fleet.table import (
    ROWS,
    judged,
    left_out,
    lines_of,
    notes_on_units,
    rows_of,
    table_of,
    table_schema,
    tables,
    why_not_measured,
)
from allanjax.noise.notation import ModelLike, as_model
from allanjax.record.completion import rows_between
from allanjax.record.io import ReadOptions, read_recording
from allanjax.record.io.chunks import open_chunks

if TYPE_CHECKING:
    import pandas as pd
    from distributed import Client, Future
    from matplotlib.figure import Figure

Progress = Callable[[int, int, int], None]
"""Called with the numbers of recordings done, failed, and in total."""

Call = tuple[Callable[..., Any], Sequence[Any]]
"""A function that the workers can import, and its positional arguments; futures among them are waited for."""

SCHEMA_VERSION = 1
"""Version of the JSON, see `FleetResult.to_dict`."""

# Time in s for a scheduler to answer.
_CONNECT_SECONDS = 10
_RECORDINGS = "recordings"
_SHORTEST_PIECE = 100_000
# Bytes of a row of text, whose number of rows is unknown.
_ROW_BYTES = 40


@dataclass(frozen=True, eq=False, repr=False)
class FleetResult(ByValue, Tabled):
    """The coefficients of a fleet.

    Attributes:
        table: one row per recording, axis and coefficient, in usual units; see `fleet.table.table_schema`.
        errors: files and axes without a result: `file`, and a `message` that names the axis and the reason.
        files: the recordings; `resumed` of them have results from an earlier run.
        notes: remarks on the table: recordings of an earlier run that are left out; recordings with warnings;
            two groups that the units fall into, or groups that are too small to judge.
        checks: of each recording with a result, the check of its limits, if a specification was given.
    """

    table: pd.DataFrame
    errors: tuple[dict[str, str], ...]
    files: tuple[Path, ...]
    resumed: int
    notes: tuple[str, ...] = ()
    checks: tuple[SpecCheck, ...] = ()

    @property
    def outlying(self) -> pd.DataFrame:
        """The rows of outlying units, and of records that differ from the others of their unit."""
        return self.table[self.table["outlying"] | self.table["odd_record"]]

    def to_dataframe(self) -> pd.DataFrame:
        """Table of the coefficients, `table` itself."""
        return self.table

    def to_dict(self) -> dict[str, Any]:
        """The result in types of JSON: table, limits, errors and notes; null where a cell is empty."""
        return {
            "schema_version": SCHEMA_VERSION,
            "files": [harmless(str(path)) for path in self.files],
            "resumed": self.resumed,
            "table": json.loads(self.table.to_json(orient="records", double_precision=15)),
            "limits": [check.to_dict() for check in self.checks],
            "errors": [dict(error) for error in self.errors],
            "notes": self.lines(sys.maxsize),
        }

    @presented
    def plot(self, path: str | os.PathLike[str] | None = None) -> Figure:
        """Draw the distribution of each coefficient over the fleet; see `plot_fleet`."""
        raise NotImplementedError

    @presented
    def to_junit(self) -> str:
        """The checks of limits as JUnit XML: a test suite per recording, a case per axis and limit."""
        raise NotImplementedError

    @property
    def summary(self) -> str:
        """How many recordings there are, and how many of them failed."""
        failed = len({error["file"] for error in self.errors})
        return (
            f"{len(self.files)} recordings: {len(self.files) - failed} without errors, {failed} with errors; "
            f"{self.resumed} from an earlier run"
        )

    def _title(self) -> str:
        return "\n".join([self.summary, *([verdict_of(self.checks)] if self.checks else [])])

    def _tables(self) -> list[list[Column]]:
        return [*tables(self.table), *([table_of_limits(self.checks)] if self.checks else [])]

    def _notes(self) -> list[str]:
        return self.lines(ROWS)

    def lines(self, most: int) -> list[str]:
        """Outlying units and remarks, limits that are not met, and notes: of the first two so many lines."""
        of_limits = lines_of_limits(self.checks, most)
        return [*lines_of(self.table, most), *of_limits, *self.notes, *notes_on_units(self.table)]


def characterize_fleet(
    files: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    out: str | os.PathLike[str],
    model: ModelLike | None = None,
    objective: Objective = "allan",
    *,
    regressors: Sequence[str] = (),
    as_is: bool = False,
    vibrating: bool = False,
    plain: bool = False,
    group: Names | None = None,
    unit: Names | None = None,
    spec: SpecLike | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    piece: int = 20_000_000,
    progress: Progress | None = None,
    figure_format: str = "png",
    **reading: Any,
) -> FleetResult:
    """Estimate the noise coefficients of many recordings on a Dask cluster, with one task per recording.

    A recording longer than `piece` is read in pieces of that many samples in parallel, so that it is never in
    memory as a whole; its coefficients are those of an `AllanAccumulator`. Sensors of one recording that have
    different rates are fitted separately.

    Writes `fleet.parquet` (the table), `fleet.png` (distribution of each coefficient over the fleet),
    `errors.csv` (file, message) and `notes.txt` (outlying units, remarks and errors, one per line) to
    `out`, and the fit of each recording to `out/recordings` as soon as it is done. If a recording fails
    or a worker dies, the others go on; another worker takes the recording of a dead one.

    A later run with the same `out` computes only recordings that failed, are new, or whose file (path, size,
    time of the last change), options or version of allanjax changed. The table covers only the files given;
    a note names recordings of an earlier run that are not among them.

    The workers of a local cluster are processes that import the calling script; in a script, call this below
    `if __name__ == "__main__":`.

    Args:
        files: paths and patterns such as `logs/**/*.parquet`; for a cluster of several machines, paths that
            are valid on all of them. Files below `out` are left out.
        out: folder for the results.
        model, objective, regressors, as_is, vibrating, plain: as for `fit`; long recordings always plain.
        group: units to be compared: a regular expression, e.g. `logs/(\\w+)/`, a CSV file with the columns
            file and group, a mapping, or a function of the path; see `fleet.files.names_by`. These groups
            are not divided.
        unit: which unit each recording is of, likewise, e.g. `(U\\d+)_`; by default each is of another one.
        spec: limits that each recording is checked against, see `check_spec`; writes `fleet_spec.csv` (one
            row per recording, axis and limit) and `fleet_spec.xml` (JUnit XML).
        workers: processes of a local cluster that exists during this call; by default one per core.
        scheduler: address of a cluster to use instead, e.g. `tcp://host:8786`; its workers need allanjax.
        piece: number of samples beyond which a recording is divided.
        figure_format: png, svg or pdf.
        progress: called with the numbers of recordings done, failed, and in total.
        **reading: as for `read`: rate, gyro_unit, accel_unit, columns, time, ...

    Returns:
        The table and the errors. Units that differ from the others of their group are marked as outlying
        (see `fleet.comparison`), by their records together, and records that differ from the others of their
        unit as odd. Without `group`, units that clearly fall into two groups are compared within these.

    Raises:
        AllanjaxError: a pattern matches no file; a recording has no group or unit; Dask is not installed; the
            scheduler does not answer; `workers` below one or with `scheduler`; a `piece` below 10⁵ samples.
    """
    if piece < _SHORTEST_PIECE:
        raise AllanjaxError(f"piece= (--piece) must be at least {_SHORTEST_PIECE} samples, not {piece}")
    if workers is not None and workers < 1:
        raise AllanjaxError(f"workers= (--workers) must be at least 1, not {workers}")
    if workers is not None and scheduler is not None:
        raise AllanjaxError(
            "workers= (--workers) is for a local cluster, but the cluster at scheduler= (--scheduler) has "
            "its own workers; leave out one of the two"
        )
    sheet = None if spec is None else read_sheet(spec)
    if spec is not None:
        # A wrong file ends the call before recordings are read.
        read_spec(spec)
    out = Path(out)
    paths = matching_files(files, out)
    model = None if model is None else as_model(model)
    options = FitOptions(ReadOptions(**reading), model, objective, tuple(regressors), as_is, vibrating, plain)
    recordings = dict(zip(recording_names(paths), paths, strict=True))
    units = {name: name for name in recordings} if unit is None else names_by(unit, recordings, "unit")
    groups = dict.fromkeys(recordings, "") if group is None else names_by(group, recordings, "group")
    done = _Done(recordings, units, groups)
    folder = out / _RECORDINGS
    folder.mkdir(parents=True, exist_ok=True)
    keys = {name: key_of(path, options, piece) for name, path in recordings.items()}
    known, others = earlier(folder, recordings, keys)
    resumed = [name for name in known if done.takes_stored(name, folder)]
    report = progress or (lambda done, failed, total: None)
    report(*done.counts, len(paths))
    todo = [name for name in recordings if name not in resumed]
    if todo or sheet is not None:
        parts = {name: _pieces(recordings[name].absolute(), options, piece) for name in todo}
        tasks = sum(max(len(pieces), 1) for pieces in parts.values()) or len(resumed)
        with _connected(scheduler, workers, tasks) as client:
            calls = {
                name: _call_for(client, recordings[name].absolute(), options, parts[name]) for name in todo
            }
            for name, outcome in _outcomes(client, calls):
                if not isinstance(outcome, Exception):
                    store(folder, name, keys[name], outcome)
                done.take(name, outcome)
                report(*done.counts, len(paths))
            if sheet is not None:
                fits = {name: fits_in(folder / f"{name}.json") for name in recordings if name in done.rows}
                checks = {name: (checked, (of, name, sheet)) for name, of in fits.items()}
                for name, outcome in _outcomes(client, checks):
                    done.take_check(name, outcome)
    return _written(done, len(resumed), (left_out(others, folder),) if others else (), out, figure_format)


@dataclass(frozen=True)
class _Done:
    """Progress of a fleet by the recordings' names: rows of the table, and errors."""

    recordings: Mapping[str, Path]
    units: Mapping[str, str]
    groups: Mapping[str, str]
    rows: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    errors: dict[str, list[str]] = field(default_factory=dict)
    checks: dict[str, SpecCheck] = field(default_factory=dict)

    def take(self, name: str, outcome: Sequence[Mapping[str, Any]] | Exception) -> None:
        """Add the fits of a recording, or the error that prevented them."""
        if isinstance(outcome, Exception):
            self.errors[name] = [_reason(self.recordings[name], outcome)]
            return
        about = harmless(str(self.recordings[name])), self.units[name], self.groups[name]
        rows = [row for fit in outcome for row in rows_of(fit, name, *about)]
        errors = [text for fit in outcome for text in _axes_without_result(fit)]
        self.rows[name], self.errors[name] = rows, errors

    def takes_stored(self, name: str, folder: Path) -> bool:
        """Add the stored fits of a recording; false if they are not whole, as when someone changed them."""
        try:
            self.take(name, stored(folder, name))
        except (LookupError, TypeError, ValueError, AttributeError):
            return False
        return True

    def take_check(self, name: str, outcome: SpecCheck | Exception) -> None:
        """Add the check of a recording's limits, or the error that prevented it."""
        if isinstance(outcome, Exception):
            self.errors[name].append(f"limits: {_reason(self.recordings[name], outcome)}")
        else:
            self.checks[name] = outcome

    @property
    def counts(self) -> tuple[int, int]:
        """How many recordings are done, and how many of these failed."""
        return len(self.errors), sum(map(bool, self.errors.values()))


def _characterize(path: Path, options: FitOptions) -> list[dict[str, Any]]:
    """Task of a worker: the fit of one recording, or one fit per sensor if their rates differ."""
    try:
        return [to_dict(options.fit(read_recording(path, options.reading)))]
    except MixedRatesError as mixed:
        readings = [options.reading.of_sensor(sensor) for sensor in mixed.sensors]
        return [to_dict(options.fit(read_recording(path, reading))) for reading in readings]


def _call_for(
    client: Client, path: Path, options: FitOptions, parts: Sequence[tuple[int, ReadOptions]]
) -> Call:
    """Task for a recording: one function, or the one that puts the pieces of a long recording together."""
    if not parts:
        return _characterize, (path, options)
    pieces = [_submitted(client, (_accumulate, (path, reading, first))) for first, reading in parts]
    return _characterize_pieces, (pieces, options)


def _pieces(path: Path, options: FitOptions, piece: int) -> list[tuple[int, ReadOptions]]:
    """First sample, and how to read it, of each piece of a long recording; none of another."""
    try:
        size = path.stat().st_size
        # A sample takes at least one byte.
        if size < piece or options.regressors:
            return []
        recording = open_chunks(path, options.reading)
    except (AllanjaxError, OSError):
        # The worker that reads it as a whole reports the error.
        return []
    # With its own time stamps, each piece would have a slightly different rate.
    reading = replace(options.reading, rate=recording.rate)
    if recording.n is None:
        return [(0, reading)] if size > _ROW_BYTES * piece else []
    if recording.n <= piece:
        return []
    begin, end = reading.start, reading.stop
    firsts = range(0, recording.n, piece)
    origin = rows_between(sys.maxsize, recording.rate, begin, None).start
    # Half-way between two samples, since time stamps need not be exact.
    times = [(origin + first - 0.5) / recording.rate for first in firsts[1:]]
    parts = zip(firsts, [begin, *times], [*times, end], strict=True)
    return [(first, replace(reading, start=start, stop=stop)) for first, start, stop in parts]


def _accumulate(path: Path, reading: ReadOptions, first: int) -> AllanAccumulator:
    """Task of a worker: one piece of a recording."""
    return accumulate(open_chunks(path, reading), start=first)


def _characterize_pieces(pieces: Sequence[AllanAccumulator], options: FitOptions) -> list[dict[str, Any]]:
    """Task of a worker: all pieces of a recording together."""
    whole, how = functools.reduce(AllanAccumulator.merge, pieces), (options.model, options.objective)
    return [to_dict(whole.fit(*how, as_is=options.as_is, vibrating=options.vibrating))]


def _axes_without_result(fit: Mapping[str, Any]) -> list[str]:
    """Reasons why axes have no result or no measurement of the sensor, as `characterize` reports them."""
    missing = [axis for axis in fit["axes"] if not axis["converged"]]
    wrong = [axis for axis in fit["axes"] if axis["converged"] and not axis["measured"]]
    return [
        *(f"{axis['name']}: no result, {axis['reason']}" for axis in missing),
        *(f"{axis['name']}: not a measurement of this sensor: {why_not_measured(axis)}" for axis in wrong),
    ]


def _reason(path: Path, error: Exception) -> str:
    from distributed import KilledWorker

    if isinstance(error, KilledWorker):
        return (
            "all workers that tried it died, probably for lack of memory; use fewer workers= (--workers), or "
            "part of the recording with start= and stop= (--start, --stop)"
        )
    if isinstance(error, CancelledError):
        return "the scheduler was lost; restart it and run again: finished results are kept"
    # Messages of a reader or a fit begin with the path that the worker was given.
    text = str(error).removeprefix(f"{harmless(str(path.absolute()))}: ")
    return text if isinstance(error, AllanjaxError | OSError) else f"{type(error).__name__}: {text}"


def _written(done: _Done, resumed: int, notes: tuple[str, ...], out: Path, figure_format: str) -> FleetResult:
    """Write table, errors, notes and figure to `out`, and return the result; these notes come first."""
    import pyarrow.parquet

    # In the order of the recordings, whatever the order they ended in.
    rows = [row for name in done.recordings for row in done.rows.get(name, ())]
    table, more = judged(table_of(rows))
    errors = tuple(
        {"file": harmless(str(path)), "message": message}
        for name, path in done.recordings.items()
        for message in done.errors.get(name, ())
    )
    checks = tuple(done.checks[name] for name in done.recordings if name in done.checks)
    result = FleetResult(table, errors, tuple(done.recordings.values()), resumed, (*notes, *more), checks)
    columns = pyarrow.Table.from_pandas(table, table_schema(), preserve_index=False)
    pyarrow.parquet.write_table(columns, out / "fleet.parquet")
    with (out / "errors.csv").open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, ["file", "message"])
        writer.writeheader()
        writer.writerows({name: _cell(text) for name, text in error.items()} for error in result.errors)
    failed = [f"{error['file']}: {error['message']}" for error in errors]
    lines = [*result.lines(sys.maxsize), *failed]
    (out / "notes.txt").write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
    result.plot(out / f"fleet.{figure_format}")
    if checks:
        import pandas as pd

        limits = pd.DataFrame(rows_of_limits(checks, done.units))
        names = limits[["recording", "unit_name"]].map(_cell)
        limits.assign(**names).to_csv(out / "fleet_spec.csv", index=False)
        (out / "fleet_spec.xml").write_text(result.to_junit(), encoding="utf-8")
    return result


def _cell(text: str) -> str:
    """Text of a cell that no spreadsheet takes for a formula."""
    return f"'{text}" if text[:1] in ("=", "+", "-", "@") else text


@contextmanager
def _connected(scheduler: str | None, workers: int | None, tasks: int) -> Iterator[Client]:
    """Client of the cluster at the address `scheduler`, or of a local one that is closed after the tasks.

    By default the local cluster has one worker per core, but no more than tasks.
    """
    try:
        from dask.system import CPU_COUNT
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise AllanjaxError('a fleet needs Dask: pip install "allanjax[fleet]"') from error
    if scheduler is not None:
        try:
            client = Client(scheduler, timeout=_CONNECT_SECONDS, set_as_default=False)
        except (OSError, ValueError) as error:
            raise AllanjaxError(
                f"no Dask scheduler answers at {scheduler!r}; check that it runs, and the address in "
                "scheduler= (--scheduler), e.g. tcp://host:8786"
            ) from error
        with client:
            try:
                client.wait_for_workers(1, timeout=_CONNECT_SECONDS)
            except TimeoutError:
                text = f"the scheduler at {scheduler} has no workers; start one: dask worker {scheduler}"
                warnings.warn(text, AllanjaxWarning, stacklevel=2)
            yield client
        return
    with _interrupts_blocked():
        cluster = LocalCluster(
            n_workers=min(workers or CPU_COUNT, tasks),
            threads_per_worker=1,
            processes=True,
            dashboard_address="localhost:0",
            # A worker that dies is reported with its recording, or does no harm.
            silence_logs=logging.CRITICAL,
        )
    with cluster, Client(cluster, set_as_default=False) as client:
        yield client


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Make processes that are started now ignore Ctrl-C, which they would answer with a traceback each."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    # Started with the first process, the tracker would unblock the signal.
    resource_tracker.ensure_running()
    earlier = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, earlier)


def _submitted(client: Client, call: Call) -> Future:
    """Future of a call on the cluster."""
    return client.submit(_call, *call, pure=False)


def _outcomes(client: Client, calls: Mapping[str, Call]) -> Iterator[tuple[str, Any]]:
    """Make calls on the cluster; yield the name and result of each as they end, or the exception it raised.

    The exception is `distributed.KilledWorker` if several workers died over the call.
    """
    from distributed import KilledWorker, as_completed

    names = {_submitted(client, call): name for name, call in calls.items()}
    blamed = []
    for future in as_completed(list(names), loop=client.loop):
        name = names.pop(future)
        outcome = _result_of(future)
        if isinstance(outcome, KilledWorker):
            blamed.append(name)
        else:
            yield name, outcome
    # If a worker dies, all its tasks are blamed. Tried again one by one, only the guilty task fails.
    for name in blamed:
        yield name, _result_of(_submitted(client, calls[name]))


def _result_of(future: Any) -> Any:
    """Result of a future, or the exception that it raised."""
    try:
        return future.result()
    except Exception as error:
        return error


def _call(function: Callable[..., Any], arguments: Sequence[Any]) -> Any:
    """Make a call in a worker process, which shares compiled programs and has JAX use its own cores only."""
    from distributed import get_worker

    # Number of threads of XLA, which reads it when it first computes, after this.
    os.environ.setdefault("NPROC", str(get_worker().state.nthreads))
    enable_compilation_cache()
    return function(*arguments)
