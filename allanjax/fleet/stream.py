"""Characterization of a recording while it is being made, or of one that does not fit into memory."""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Float

from allanjax.allan.deviation import AllanDeviation
from allanjax.allan.estimators import Pyramid
from allanjax.base.equality import equal
from allanjax.base.errors import AllanjaxError, FitError, RecordingError, expect
from allanjax.estimate.axis_fits import check_count, check_terms, fit_judged, fit_spectra, with_curve
from allanjax.estimate.deterministic import AxisSpectrum
from allanjax.estimate.fit import Objective, terms_to_fit, with_doubts
from allanjax.estimate.result import AxisFit, Fit
from allanjax.estimate.seen import with_what_was_seen
from allanjax.estimate.selection import Candidates, candidates_for, rank_terms
from allanjax.inspection import Ends, Inspection, Windows, look
from allanjax.noise.model import Model
from allanjax.noise.notation import ModelLike, as_model
from allanjax.record.columns import Axis, DeadAxis, axes_of, recognise, scales_of
from allanjax.record.io.chunks import ChunkedRecording
from allanjax.record.io.memory import real_numbers
from allanjax.record.units import Sensor
from allanjax.record.validation import Source
from allanjax.spectrum.cosine import SegmentedLevel, SegmentSpectra

# Samples that are processed at once: a call of a compiled program costs as much as many; more need memory.
_GATHERED = 1 << 17
# Version of the format of snapshots.
_FORMAT = 6

_FROM_RECORD = (
    "cannot be estimated from the averaged spectrum of a stream; leave it out, or read a part that fits into "
    "memory (start=, stop=) and fit that"
)

_T = TypeVar("_T")


class AllanAccumulator:
    """Allan deviation and spectrum of samples that arrive in pieces, in constant memory.

    `update` takes samples in chunks of any size, `merge` joins the accumulators of adjacent pieces, and
    `result` and `fit` evaluate all samples; up to rounding, the result does not depend on the chunks.
    `snapshot` and `restore` carry an accumulator over a restart.

        accumulator = AllanAccumulator(1000.0, ["gyro_x", "gyro_y", "gyro_z"])
        for samples in rig:                      # [n, 3], rad/s
            accumulator.update(samples)
        accumulator.result().plot()
        print(accumulator.fit())
    """

    def __init__(
        self,
        rate: float,
        axes: Sequence[Axis | str] = ("gyro",),
        *,
        start: int = 0,
        name: str = "",
        given: Mapping[Sensor, float] = MappingProxyType({}),
    ) -> None:
        """Make an accumulator of no samples.

        Args:
            rate: sample rate [Hz].
            axes: axes of the samples, in order: names such as `gyro_x` or `accel`, or axes of a recording.
            start: number of samples before the first one, for a piece that is merged later.
            name: name for display.
            given: sensors whose unit was given, as in `Recording`.

        Raises:
            AllanjaxError: a rate that is not positive, or a negative start.
            RecordingError: no axes, or an unknown name.
        """
        if not 0.0 < rate < np.inf:
            raise AllanjaxError(f"the sample rate must be positive and finite, not {rate} Hz")
        if start < 0:
            raise AllanjaxError(f"start must not be negative, not {start}")
        self.rate, self.start, self.name = float(rate), start, name
        self.axes, self.given = _axes(axes), dict(given)
        empty = np.zeros((0, len(self.axes)))
        self._pyramid = Pyramid.of(empty, start)
        self._spectra = SegmentSpectra.of(empty, self.rate, start)
        self._windows = Windows.of(empty)
        self._ends = Ends.of(empty)
        # Axes that have not had a number so far; there are zeros for them in what follows.
        self._silent = np.ones(len(self.axes), bool)
        self._gathered: list[Float[np.ndarray, "n axes"]] = []

    @property
    def n(self) -> int:
        """Number of samples so far."""
        return self._pyramid.n + sum(map(len, self._gathered))

    def update(self, samples: Float[np.ndarray, "n axes"] | Float[np.ndarray, " n"]) -> None:
        """Add the next samples, in SI: rad/s or m/s².

        An axis that has only had nan so far may go on with nan; it is dead and has no result.

        Raises:
            AllanjaxError: another number of axes, or values that are not finite; no sample is added then.
        """
        # A copy: a rig fills the same buffer again.
        values = np.array(real_numbers(samples, Source("samples")))
        values = values[:, None] if values.ndim == 1 else values
        if values.ndim != 2 or values.shape[1] != len(self.axes):
            raise AllanjaxError(
                f"samples of {len(self.axes)} axes need the shape [n, {len(self.axes)}], not {values.shape}"
            )
        silent = self._silent & np.isnan(values).all(axis=0)
        bad = ~np.isfinite(values)
        if not silent.all():
            bad[:, silent] = False
        if self.n:
            # What has a number now had none before.
            bad[:1] |= self._silent & ~silent
        if bad.any():
            row, axis = np.argwhere(bad)[0]
            raise AllanjaxError(
                f"sample {self.start + self.n + row} of {self.axes[axis].name} or an earlier one is "
                "not finite; end the piece before it, and begin a new one after it"
            )
        if len(values):
            self._silent = silent
            values[:, silent] = 0.0
        self._gathered.append(values)
        if sum(map(len, self._gathered)) >= _GATHERED:
            self._flush()

    def merge(self, right: AllanAccumulator) -> AllanAccumulator:
        """Accumulator of this piece and the next one; both stay unchanged.

        Raises:
            AllanjaxError: `right` does not begin where this one ends, or has another rate or other axes.
        """
        if (self.rate, self.axes) != (right.rate, right.axes):
            raise AllanjaxError(
                f"{_described(self)} cannot be merged with {_described(right)}: not one recording"
            )
        if self.n and right.n and (self._silent != right._silent).any():
            name = self.axes[int(np.argmax(self._silent != right._silent))].name
            raise AllanjaxError(
                f"{name} has values in only one of the pieces, so they cannot be merged; leave the axis out, "
                "or select a part in which it has values"
            )
        for piece in (self, right):
            piece._flush()
        merged = AllanAccumulator(self.rate, self.axes, start=self.start, name=self.name, given=self.given)
        merged._pyramid = self._pyramid.merge(right._pyramid)
        merged._spectra = self._spectra.merge(right._spectra)
        merged._windows = self._windows.merge(right._windows)
        merged._ends = self._ends.merge(right._ends)
        merged._silent = self._silent & right._silent
        return merged

    @property
    def dead(self) -> tuple[DeadAxis, ...]:
        """Axes without a result: constant so far, or without any value."""
        self._flush()
        if self.n < 2:
            return ()
        still = np.flatnonzero(self._pyramid.variance()[0] == 0.0)
        values = self._pyramid.tail[0, :, -1] / scales_of(self.axes, self.rate)
        return tuple(
            DeadAxis.of(self.axes[k], np.nan if self._silent[k] else float(values[k])) for k in still
        )

    def _living(self) -> AllanAccumulator:
        """Accumulator of the axes that are not dead.

        Raises:
            FitError: all axes are dead.
        """
        dead = self.dead
        if not dead:
            return self
        axes = {d.axis for d in dead}
        keep = np.array([axis not in axes for axis in self.axes])
        if not keep.any():
            raise FitError(f"{self.name or 'the stream'}: {dead[0].axis.name} is {dead[0].reason}")
        living = AllanAccumulator(
            self.rate,
            list(itertools.compress(self.axes, keep)),
            start=self.start,
            name=self.name,
            given=self.given,
        )
        living._pyramid, living._spectra = self._pyramid.of_axes(keep), self._spectra.of_axes(keep)
        living._windows, living._ends = self._windows.of_axes(keep), self._ends.of_axes(keep)
        return living

    def result(self) -> AllanDeviation:
        """Allan deviations of all samples so far, as with `estimator="pyramid"`.

        Raises:
            AllanjaxError: fewer than two samples, or only dead axes.
        """
        living = self._living()
        pyramid, axes = living._pyramid, living.axes
        of = np.sqrt(pyramid.variance()), pyramid.cluster_size, pyramid.n, self.rate
        curve = AllanDeviation.under_white_noise(*of, axes=axes, estimator="pyramid")
        # How many differences there are depends on where in the recording the stream begins.
        return dataclasses.replace(curve, count=pyramid.count)

    def inspect(self, *, as_is: bool = False, vibrating: bool = False) -> Inspection:
        """Inspection of the samples so far, as `allanjax.inspect` does for a recording.

        Its `longest_part` is the undisturbed part. Single outlying samples, lines and interpolated samples
        cannot be detected without the samples themselves, which a fact reports.

        Raises:
            AllanjaxError: there are no samples yet.
        """
        if not self.n:
            raise AllanjaxError(f"{self.name or 'the stream'} has no samples yet; add some with update()")
        living = self._living()
        return look(living, living._windows, living._ends, self.dead, as_is=as_is, vibrating=vibrating)

    def fit(
        self,
        model: ModelLike | None = None,
        objective: Objective = "allan",
        *,
        as_is: bool = False,
        vibrating: bool = False,
    ) -> Fit:
        """Estimate the coefficients of a noise model, as `allanjax.fit` does for a recording.

        Without a model, the terms are chosen by their evidence in the averaged spectra. "allan" fits the
        Allan variances of the pyramid with their covariance, or the spectra of axes where these disagree;
        "whittle" fits the averaged spectra.

        Disturbed parts cannot be removed afterwards. There is then no result unless `as_is`; the reason gives
        the part to read (`start=`, `stop=` of `read_chunks`). `vibrating` as in `fit`.

        Raises:
            FitError: too few samples; only dead axes; a line, resonance or transient, which needs the record
                itself.
        """
        terms = None if model is None else as_model(model, self.axes)
        return self.fit_inspected(self.inspect(as_is=as_is, vibrating=vibrating).uncut(), terms, objective)

    def fit_inspected(self, inspection: Inspection, model: Model | None, objective: Objective) -> Fit:
        """Fit of these samples, given their inspection; see `fit`."""
        if objective in ("wavelet", "exact"):
            raise FitError(f'objective="{objective}" needs the samples themselves; use "allan" or "whittle"')
        living, dead = self._living(), self.dead
        curve, axes, statistics = living.result(), living.axes, living._spectra.statistics()
        selection = None
        if model is None and not inspection.refusal:
            candidates = Candidates.of(candidates_for(curve.n), statistics[0])
            selection = rank_terms(candidates, statistics[1], axes, self.name)
        template, active = terms_to_fit(model, selection, axes, objective)
        check_terms(template, _FROM_RECORD)
        check_count(len(curve.cluster_size), "Allan variances", curve.n, template, self.name)
        notes = selection.ambiguities() if selection else ()
        results = tuple(AxisFit(axis, False, inspection.refusal) for axis in axes)
        if not inspection.refusal:
            spectra = AxisSpectrum.of_axes(*statistics, template)
            if objective == "allan":
                results = fit_judged(curve, spectra, axes, template, active)
            else:
                results = fit_spectra(template, axes, spectra, active)
        results, curve = with_curve(curve, template, results)
        if selection is not None:
            results = tuple(map(with_doubts, results, selection.results))
        fit = Fit(self.name, template, curve, results, notes, objective, selection, dead)
        return with_what_was_seen(fit, inspection)

    def snapshot(self, path: str | os.PathLike[str]) -> None:
        """Write the state to a file, completely or not at all; `restore` continues from it.

        Raises:
            OSError: the file cannot be written.
        """
        self._flush()
        header = {
            "format": _FORMAT,
            "rate": self.rate,
            "start": self.start,
            "name": self.name,
            "axes": [dataclasses.asdict(axis) for axis in self.axes],
            "silent": self._silent.tolist(),
            "given": self.given,
        }
        arrays = {"header": np.array(json.dumps(header))}
        arrays |= _packed(self._pyramid, "pyramid") | _packed(self._spectra, "spectra")
        arrays |= _packed(self._windows, "windows") | _packed(self._ends, "ends")
        path = Path(path)
        temporary = path.with_name(f".{path.name}.{os.getpid()}")
        try:
            with temporary.open("wb") as stream:
                np.savez(stream, **arrays)  # type: ignore[arg-type]
                stream.flush()
                os.fsync(stream.fileno())
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)

    @classmethod
    def restore(cls, path: str | os.PathLike[str]) -> AllanAccumulator:
        """Accumulator of a snapshot.

        Raises:
            RecordingError: the file is not a snapshot, is damaged, or has another version.
        """
        try:
            with np.load(path, allow_pickle=False) as arrays:
                header = json.loads(str(arrays["header"]))
                if header["format"] != _FORMAT:
                    raise RecordingError(
                        f"{path}: a snapshot of format {header['format']}, but this version reads {_FORMAT}; "
                        "restore it with the version of allanjax that wrote it"
                    )
                axes = [Axis(**axis) for axis in header["axes"]]
                more = {key: header[key] for key in ("start", "name", "given")}
                found = cls(header["rate"], axes, **more)
                found._silent = np.array(header.get("silent", [False] * len(axes)), bool)
                found._pyramid = _unpacked(Pyramid, arrays, "pyramid")
                found._spectra = _unpacked(SegmentSpectra, arrays, "spectra")
                found._windows = _unpacked(Windows, arrays, "windows")
                found._ends = _unpacked(Ends, arrays, "ends")
        except FileNotFoundError as error:
            raise RecordingError(f"{path}: no such file; check the path") from error
        except (OSError, ValueError, KeyError, TypeError, EOFError, BadZipFile) as error:
            raise RecordingError(f"{path}: not a snapshot of an accumulator, or damaged: {error}") from error
        return found

    def _flush(self) -> None:
        """Merge the buffered samples into the statistics."""
        if not self._gathered:
            return
        gathered = self._gathered[0] if len(self._gathered) == 1 else np.concatenate(self._gathered)
        for first in range(0, len(gathered), _GATHERED):
            values, start = gathered[first : first + _GATHERED], self.start + self._pyramid.n
            self._pyramid = self._pyramid.merge(Pyramid.of(values, start))
            self._spectra = self._spectra.merge(SegmentSpectra.of(values, self.rate, start))
            self._windows = self._windows.updated(values)
            self._ends = self._ends.merge(Ends.of(values))
        self._gathered = []

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, AllanAccumulator):
            return NotImplemented
        for each in (self, other):
            each._flush()
        return equal(vars(self), vars(other))

    __hash__ = None  # type: ignore[assignment]  # It grows.

    def __repr__(self) -> str:
        title = f" {self.name!r}" if self.name else ""
        start = f" from sample {self.start}" if self.start else ""
        return f"<AllanAccumulator{title}: {_described(self)}; {self.n} samples{start}>"


def _described(accumulator: AllanAccumulator) -> str:
    """Axes and rate of an accumulator, for messages."""
    names = ", ".join(axis.name for axis in accumulator.axes)
    return f"{names} at {accumulator.rate:.9g} Hz"


def accumulate(
    recording: ChunkedRecording, *, start: int = 0, progress: Callable[[int, int | None], None] | None = None
) -> AllanAccumulator:
    """Read a recording chunk by chunk into an accumulator.

    Args:
        recording: a result of `read_chunks`.
        start: number of its first sample, for a piece that is merged later.
        progress: called with the number of samples read and, if known, in total.

    Raises:
        RecordingError: the file has bad values, gaps or damaged rows; the message gives the place.
    """
    expect(recording, ChunkedRecording, "accumulate takes what read_chunks returns")
    accumulator = AllanAccumulator(
        recording.rate, recording.axes, start=start, name=recording.name, given=recording.given
    )
    for samples in recording:
        accumulator.update(samples)
        if progress is not None:
            progress(accumulator.n, recording.n)
    return accumulator


def _axes(given: Sequence[Axis | str]) -> tuple[Axis, ...]:
    """Axes of these names, in SI."""
    if isinstance(given, str):
        raise AllanjaxError(f"axes= takes a list of names: [{given!r}]")
    columns = [recognise(axis if isinstance(axis, str) else axis.name) for axis in given]
    named, _ = axes_of(columns, {"gyro": "rad/s", "accel": "m/s²"}, Source("axes="))
    return tuple(a if isinstance(a, Axis) else b for a, b in zip(given, named, strict=True))


def _packed(part: Any, name: str) -> dict[str, np.ndarray]:
    """Fields of a statistic as arrays; those of a tuple of statistics one after the other."""
    arrays = {}
    for field in dataclasses.fields(part):
        key, value = f"{name}.{field.name}", getattr(part, field.name)
        arrays[key] = np.asarray(len(value) if isinstance(value, tuple) else value)
        for k, level in enumerate(value if isinstance(value, tuple) else ()):
            arrays |= _packed(level, f"{key}.{k}")
    return arrays


def _unpacked(kind: type[_T], arrays: Mapping[str, np.ndarray], name: str) -> _T:
    """Statistic whose fields `_packed` has made arrays of."""
    values: dict[str, Any] = {}
    for field in dataclasses.fields(kind):  # type: ignore[arg-type]
        key = f"{name}.{field.name}"
        value = arrays[key]
        if kind is SegmentSpectra and field.name == "segmented":
            values[field.name] = tuple(
                _unpacked(SegmentedLevel, arrays, f"{key}.{k}") for k in range(int(value))
            )
        else:
            values[field.name] = value if value.ndim else value.item()
    return kind(**values)
