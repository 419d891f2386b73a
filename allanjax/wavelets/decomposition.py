"""Multi-resolution decomposition of recordings by wavelets: Hou (2004) section 3.3.2.

The discrete wavelet transform splits a record into details, each an octave of frequencies, and a slower
remainder, the approximation. All are in the time domain: the details and the last approximation add up to
the record.
"""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError
from allanjax.base.late import presented
from allanjax.base.tables import PerAxis
from allanjax.base.wording import plain, significant
from allanjax.noise.model import Model
from allanjax.noise.notation import Modelling, model_of
from allanjax.noise.terms import AngleRandomWalk, Quantization
from allanjax.record.io.given import RecordingLike, as_recording
from allanjax.record.recording import Axis, Recording
from allanjax.record.units import Sensor
from allanjax.spectrum.autocorrelation import square_unit
from allanjax.wavelets.variance import WaveletFilter, bands, moments, pywavelets

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class WaveletDecomposition(ByValue):
    """Decomposition of every axis of a recording into octaves.

    The record is extended by its reflection: near its ends approximations are uncertain over about the length
    of the level's filter.

    Attributes:
        recording: the decomposed recording.
        wavelet: name of the wavelet in PyWavelets.
        levels: number of levels.
    """

    recording: Recording
    wavelet: str
    levels: int

    @property
    def band(self) -> Float[np.ndarray, "levels 2"]:
        """Nominal lowest and highest frequency of the details of each level [Hz]."""
        return bands(np.arange(1, self.levels + 1), self.recording.rate)

    def approximation(self, level: int) -> Recording:
        """The part below the details of levels 1 to `level`: nominally below rate/2^(level+1).

        At the recording's own rate, including the mean; level 0 is the recording.

        Raises:
            AllanjaxError: there is no such level.
        """
        self._check(level, 0)
        kept = range(self.levels - level + 1)
        highest = plain(self.recording.rate / 2.0 ** (level + 1), 3)
        return self._with(kept, f"approximation at level {level} of {self.wavelet}, below {highest} Hz")

    def details(self, level: int) -> Recording:
        """Details of a level in the time domain, at the recording's own rate; see `band`.

        Raises:
            AllanjaxError: there is no such level.
        """
        self._check(level, 1)
        low, high = (plain(float(f), 3) for f in self.band[level - 1])
        note = f"details at level {level} of {self.wavelet}, {low} to {high} Hz"
        return self._with([self.levels - level + 1], note)

    def to_dataframe(self) -> pd.DataFrame:
        """Table with one row per level: band, and each axis's mean and mean square of the details.

        The thesis chooses its level by the mean of the details (figures 3.4 and 3.5).
        """
        import pandas as pd

        details = [self.details(k).values for k in range(1, self.levels + 1)]
        columns = {"level": np.arange(1, self.levels + 1)}
        columns |= {f"{end} [Hz]": f for end, f in zip(("from", "to"), self.band.T, strict=True)}
        for k, axis in enumerate(self.recording.axes):
            unit, scale = square_unit(axis)
            root = unit.removesuffix("²").strip("()")
            means = np.array([d[:, k].mean() for d in details])
            columns[f"{axis.name} mean [{root}]"] = means / np.sqrt(scale)
            columns[f"{axis.name} mean square [{unit}]"] = np.mean([d[:, k] ** 2 for d in details], 1) / scale
        return pd.DataFrame(columns)

    @presented
    def plot(
        self,
        axis: str | None = None,
        levels: Sequence[int] | None = None,
        path: str | os.PathLike[str] | None = None,
    ) -> Figure:
        """Draw an axis, its details and its approximation, one below the other; see `plot_decomposition`."""
        raise NotImplementedError

    @functools.cached_property
    def _coefficients(self) -> list[Float[np.ndarray, "k axes"]]:
        """Coefficients of the last approximation, then of the details from the last level to the first."""
        values = self.recording.values
        return pywavelets().wavedec(values, self.wavelet, "symmetric", self.levels, axis=0)

    def _check(self, level: int, lowest: int) -> None:
        """Raise AllanjaxError if there is no such level."""
        if not lowest <= level <= self.levels:
            raise AllanjaxError(f"no level {level}: this decomposition has levels {lowest} to {self.levels}")

    def _with(self, kept: Sequence[int], note: str) -> Recording:
        """The recording made of these coefficients alone, with a note."""
        only = [c if k in kept else np.zeros_like(c) for k, c in enumerate(self._coefficients)]
        values = pywavelets().waverec(only, self.wavelet, "symmetric", axis=0)[: self.recording.n]
        return replace(self.recording, values=values, others=(), notes=(*self.recording.notes, note))

    def __repr__(self) -> str:
        low, high = (plain(float(f), 3) for f in (self.band[-1, 0], self.band[0, 1]))
        return (
            f"WaveletDecomposition({self.wavelet}; {self.levels} levels of details from {low} Hz to "
            f"{high} Hz; {self.recording!r})"
        )


def wavelet_decomposition(
    data: RecordingLike,
    rate: float | None = None,
    *,
    wavelet: str = "db4",
    levels: int | None = None,
    gyro_unit: str | None = None,
    accel_unit: str | None = None,
    names: Sequence[str] | None = None,
) -> WaveletDecomposition:
    """Decompose every axis of a recording into octaves: multi-resolution analysis with PyWavelets.

    Args:
        data: what `read` returns; or samples [samples, axes], a data frame, or a file's path.
        rate: sample rate [Hz], for an array only: a recording has its own.
        wavelet: a discrete wavelet by its name in PyWavelets, such as "haar", "db4" or "sym8".
        levels: number of levels; by default all levels with a coefficient that the record's ends do not
            affect.
        gyro_unit, accel_unit, names: units and names of an array, as for `Recording.from_array`.

    Raises:
        AllanjaxError: PyWavelets is not installed; an unknown wavelet; too many levels.
    """
    pywt = pywavelets()
    recording = as_recording(data, rate, gyro_unit, accel_unit, names)
    if wavelet not in pywt.wavelist(kind="discrete"):
        raise AllanjaxError(
            f"unknown wavelet {wavelet!r}: use a discrete wavelet of PyWavelets, e.g. haar, db4, sym8"
        )
    most = pywt.dwt_max_level(recording.n, pywt.Wavelet(wavelet).dec_len)
    if not 1 <= (most if levels is None else levels) <= most:
        asked = "" if levels is None else f", not {levels}"
        raise AllanjaxError(f"{recording.n} samples allow at most {most} levels of {wavelet}{asked}")
    return WaveletDecomposition(recording, wavelet, levels or most)


# De-noising at the level at which, by a fitted model, white noise falls below the drift.
#
# The thesis chooses the level by eye (figures 3.4 and 3.5): the first at which the mean of the details is not
# zero. A fitted model determines how much of each octave is noise without memory (white noise and
# quantization) and how much is drift (all other random terms).

# The terms without memory; all other random ones are drift.
_WHITE = (AngleRandomWalk, Quantization)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class AxisDenoising(ByValue):
    """Level up to which an axis was de-noised, and the variances from which it follows.

    Attributes:
        axis: the axis.
        level: details up to this level were removed; 0 if none were.
        cutoff: nominal highest frequency that is left, rate/2^(level+1) [Hz].
        white: [levels] wavelet variance of white noise and quantization at levels 1, 2, … under the model
            [rate²].
        drift: [levels] the same of all other random terms.
        reason: reason for this level, in words.
    """

    axis: Axis
    level: int
    cutoff: float
    white: Float[np.ndarray, " levels"]
    drift: Float[np.ndarray, " levels"]
    reason: str

    def rows(self) -> list[tuple[str, ...]]:
        """The row of the printed table: level, band that is left, variances at the level and the next."""
        scale = square_unit(self.axis)[1]
        pairs = [
            [significant(float(x[k]) / scale) if 0 <= k < len(x) else "" for x in (self.white, self.drift)]
            for k in (self.level - 1, self.level)
        ]
        band = f"0 … {plain(self.cutoff, 3)}" if self.level else "all"
        return [(self.axis.name, str(self.level), band, *pairs[0], *pairs[1])]

    def to_dataframe(self) -> pd.DataFrame:
        """Table with one row per level: variances of noise and drift, and whether it was removed."""
        import pandas as pd

        unit, scale = square_unit(self.axis)
        level = np.arange(1, len(self.white) + 1)
        columns = {"axis": self.axis.name, "level": level, "taken out": level <= self.level}
        return pd.DataFrame(
            columns | {f"white noise [{unit}]": self.white / scale, f"drift [{unit}]": self.drift / scale}
        )

    def __repr__(self) -> str:
        return f"<AxisDenoising {self.axis.name}: level {self.level}, below {plain(self.cutoff, 3)} Hz>"


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Denoised(ByValue, PerAxis[AxisDenoising]):
    """A recording without white noise, and the level of each axis up to which it was removed.

    Attributes:
        recording: the approximations, each axis at its own level.
        wavelet: name of the wavelet in PyWavelets.
        results: one per axis.
    """

    recording: Recording
    wavelet: str
    results: tuple[AxisDenoising, ...]

    def _title(self) -> str:
        name = f"{self.recording.name}: " if self.recording.name else ""
        return f"{name}de-noised with {self.wavelet} up to the last level at which white noise prevails"

    def _heads(self, sensor: Sensor) -> list[str]:
        unit = next(square_unit(r.axis)[0] for r in self.results if r.axis.sensor == sensor)
        places = ("level", "next level")
        kinds = (f"{kind}\nat {at} ({unit})" for at in places for kind in ("white noise", "drift"))
        return ["axis", "level", "band left (Hz)", *kinds]


def denoise(
    data: RecordingLike,
    model: Modelling,
    rate: float | None = None,
    *,
    wavelet: str = "db4",
    gyro_unit: str | None = None,
    accel_unit: str | None = None,
    names: Sequence[str] | None = None,
) -> Denoised:
    """Remove the octaves of every axis in which, under its model, white noise exceeds drift.

    Octaves are removed up to the highest level at which the wavelet variance of white noise and quantization
    exceeds that of all other random terms; lines and ramps do not count.

    Args:
        data: what `read` returns; or samples [samples, axes], a data frame, or a file's path.
        model: a fit of the recording, or a noise model with values for all axes.
        rate: sample rate [Hz], for an array only: a recording has its own.
        wavelet: an orthogonal wavelet by its name in PyWavelets.
        gyro_unit, accel_unit, names: units and names of an array, as for `Recording.from_array`.

    Raises:
        AllanjaxError: a fit without a result for an axis, a model without a value, an unknown wavelet;
            PyWavelets is not installed.
    """
    recording = as_recording(data, rate, gyro_unit, accel_unit, names)
    filters = WaveletFilter.of(wavelet)
    decomposition = wavelet_decomposition(recording, wavelet=wavelet)
    results = []
    for axis in recording.axes:
        white, drift = _variances(model_of(model, axis), filters, decomposition.levels, recording)
        prevails = np.flatnonzero(white > drift)
        level = int(prevails[-1]) + 1 if prevails.size else 0
        cutoff = recording.rate / 2.0 ** (level + 1)
        reason = _reason(axis, level, white, drift)
        results.append(AxisDenoising(axis, level, cutoff, white, drift, reason))
    done = ", ".join(f"{r.axis.name} at level {r.level}" for r in results)
    notes = (*recording.notes, f"de-noised with {wavelet}: {done}")
    at = {r.level: decomposition.approximation(r.level).values for r in results}
    values = np.stack([at[r.level][:, k] for k, r in enumerate(results)], axis=1)
    left = dataclasses.replace(recording, values=values, others=(), notes=notes)
    return Denoised(left, wavelet, tuple(results))


def _variances(
    model: Model, wavelet: WaveletFilter, levels: int, recording: Recording
) -> tuple[Float[np.ndarray, " levels"], Float[np.ndarray, " levels"]]:
    """Wavelet variances of white noise and of drift under a model."""
    level, terms = np.arange(1, levels + 1), list(zip(model.term_labels, model.terms, strict=True))

    def variances(is_white: bool) -> Float[np.ndarray, " levels"]:
        others = [b for b, t in terms if t.deterministic or isinstance(t, _WHITE) is not is_white]
        part = model.without(others)
        return moments(part, wavelet, level, recording.n, recording.rate)[0] if len(part) else 0.0 * level

    return variances(True), variances(False)


def _reason(
    axis: Axis, level: int, white: Float[np.ndarray, " levels"], drift: Float[np.ndarray, " levels"]
) -> str:
    """Reason for this level: the variances there and at the next."""
    unit, scale = square_unit(axis)

    def at(k: int) -> str:
        noise, slow = (significant(float(x[k - 1]) / scale) for x in (white, drift))
        return f"white noise {noise} and drift {slow} {unit} at level {k}"

    if level == len(white):
        return f"{at(level)}, the last one: drift prevails nowhere in this record"
    return f"{at(level)}, {at(level + 1)}" if level else f"drift prevails from the start: {at(1)}"
