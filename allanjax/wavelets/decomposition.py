"""Multi-resolution decomposition of recordings by wavelets: Hou (2004) section 3.3.2.

The discrete wavelet transform splits a record into details, an octave of frequencies each, and what is
slower, the approximation. Each is given in the time domain, so that all details and the last approximation
add up to the record.
"""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from jaxtyping import Float

from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError
from allanjax.base.late import presented
from allanjax.base.per_axis import PerAxis
from allanjax.base.wording import plain, significant
from allanjax.noise.model import Model
from allanjax.noise.notation import Modelling, models_of
from allanjax.noise.terms import AngleRandomWalk, Quantization
from allanjax.record.io.given import RecordingLike, as_recording
from allanjax.record.recording import Axis, Recording
from allanjax.spectrum.autocorrelation import square_unit
from allanjax.wavelets.variance import WaveletFilter, bands, moments, pywavelets

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class WaveletDecomposition(ByValue):
    """Decomposition of every axis of a recording into octaves.

    Beyond its ends the record is continued by its reflection: approximations are uncertain there over about
    the length of the level's filter.

    Attributes:
        recording: what was decomposed.
        wavelet: its name in PyWavelets.
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
        """What is slower than the details of levels 1 to `level`: below rate/2^(level+1) nominally.

        At the recording's own rate, with the mean in it; level 0 is the recording.

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
        told = f"details at level {level} of {self.wavelet}, {low} to {high} Hz"
        return self._with([self.levels - level + 1], told)

    def to_dataframe(self) -> pd.DataFrame:
        """Table with one row a level: band, and each axis's mean and mean square of the details.

        The mean of the details is what the thesis chooses its level by (figures 3.4 and 3.5).
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
            raise AllanjaxError(f"no level {level}: this decomposition has {lowest} to {self.levels}")

    def _with(self, kept: Sequence[int], told: str) -> Recording:
        """The recording of what these coefficients alone make, with a note on it."""
        only = [c if k in kept else np.zeros_like(c) for k, c in enumerate(self._coefficients)]
        values = pywavelets().waverec(only, self.wavelet, "symmetric", axis=0)[: self.recording.n]
        return replace(self.recording, values=values, others=(), notes=(*self.recording.notes, told))

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
    """Decompose every axis of a recording into octaves: multi-resolution analysis by PyWavelets.

    Args:
        data: what `read` returns; or samples [samples, axes], a data frame, or a file's path.
        rate: sample rate [Hz], for an array only: a recording has its own.
        wavelet: a discrete wavelet by its name in PyWavelets, such as "haar", "db4" or "sym8".
        levels: number of levels; by default as many as the record has a coefficient for that its ends do not
            reach.
        gyro_unit, accel_unit, names: of an array, as `Recording.from_array` takes them.

    Raises:
        AllanjaxError: PyWavelets is not installed; an unknown wavelet; too many levels.
    """
    pywt = pywavelets()
    recording = as_recording(data, rate, gyro_unit, accel_unit, names)
    if wavelet not in pywt.wavelist(kind="discrete"):
        raise AllanjaxError(
            f"unknown wavelet {wavelet!r}: give a discrete one of PyWavelets, e.g. haar, db4, sym8"
        )
    most = pywt.dwt_max_level(recording.n, pywt.Wavelet(wavelet).dec_len)
    if not 1 <= (most if levels is None else levels) <= most:
        told = f"not {levels}" if levels is not None else "too few"
        raise AllanjaxError(f"{recording.n} samples have at most {most} levels of {wavelet}, {told}")
    return WaveletDecomposition(recording, wavelet, levels or most)


# De-noising at the level at which, by a fitted model, white noise falls below the drift.
#
# The thesis chooses the level by eye (figures 3.4 and 3.5): that from which on the mean of the details is not
# zero. A fitted model says how much of each octave is noise without memory, white noise and quantization, and
# how much is drift, all other random terms.

# The terms without memory; all other random ones are drift.
_WHITE = (AngleRandomWalk, Quantization)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class AxisDenoising(ByValue):
    """Level at which an axis was de-noised, and the variances that it follows from.

    Attributes:
        axis: whose it is.
        level: details up to this level were taken out; 0 if none.
        cutoff: highest frequency that is left, nominally, rate/2^(level+1) [Hz].
        white: [levels] wavelet variance of white noise and quantization at levels 1, 2, … under the model
            [rate²].
        drift: [levels] the same of all other random terms.
        reason: why this level, in words.
    """

    axis: Axis
    level: int
    cutoff: float
    white: Float[np.ndarray, " levels"]
    drift: Float[np.ndarray, " levels"]
    reason: str

    def to_dataframe(self) -> pd.DataFrame:
        """Table with one row a level: variances of noise and drift, and whether it was taken out."""
        import pandas as pd

        unit, scale = square_unit(self.axis)
        level = np.arange(1, len(self.white) + 1)
        columns = {"axis": self.axis.name, "level": level, "taken out": level <= self.level}
        return pd.DataFrame(
            columns | {f"white noise [{unit}]": self.white / scale, f"drift [{unit}]": self.drift / scale}
        )

    def __repr__(self) -> str:
        return f"<AxisDenoising {self.axis.name}: level {self.level}, below {self.cutoff:.3g} Hz>"


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Denoised(ByValue, PerAxis[AxisDenoising]):
    """A recording of which white noise was taken out, and at which level of each axis.

    Attributes:
        recording: the approximations, each axis at its own level.
        wavelet: the wavelet's name in PyWavelets.
        results: one an axis.
    """

    CALLED: ClassVar[str] = "the de-noised recording"
    HEADINGS: ClassVar[tuple[str, ...]] = ("axis", "level", "what is left", "why")
    RIGHT: ClassVar[tuple[str, ...]] = ("level",)

    recording: Recording
    wavelet: str
    results: tuple[AxisDenoising, ...]

    def _title(self) -> str:
        name = f"{self.recording.name}: " if self.recording.name else ""
        return f"{name}de-noised with {self.wavelet} at the level that the model gives"

    def _cells(self) -> list[tuple[str, str, str, str]]:
        return [
            (r.axis.name, str(r.level), f"below {plain(r.cutoff, 3)} Hz" if r.level else "all", r.reason)
            for r in self.results
        ]


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
    """Take out of every axis the octaves in which, by its model, white noise is more than drift.

    The level is the highest whose wavelet variance is more that of white noise and quantization than that of
    all other random terms; lines and ramps count for neither. Beyond it drift prevails.

    Args:
        data: what `read` returns; or samples [samples, axes], a data frame, or a file's path.
        model: a fit of the recording, or a noise model with values for all axes.
        rate: sample rate [Hz], for an array only: a recording has its own.
        wavelet: an orthogonal wavelet by its name in PyWavelets.
        gyro_unit, accel_unit, names: of an array, as `Recording.from_array` takes them.

    Raises:
        AllanjaxError: a fit without a result for an axis, a model without a value, an unknown wavelet;
            PyWavelets is not installed.
    """
    recording = as_recording(data, rate, gyro_unit, accel_unit, names)
    found = WaveletFilter.of(wavelet)
    decomposition = wavelet_decomposition(recording, wavelet=wavelet)
    models = models_of(model, [axis.name for axis in recording.axes])
    # One model may be that of all axes.
    levels, known = decomposition.levels, {}
    for of_axis in models:
        if repr(of_axis) not in known:
            known[repr(of_axis)] = _variances(of_axis, found, levels, recording)
    results = []
    for axis, of_axis in zip(recording.axes, models, strict=True):
        white, drift = known[repr(of_axis)]
        prevails = np.flatnonzero(white > drift)
        level = int(prevails[-1]) + 1 if prevails.size else 0
        cutoff = recording.rate / 2.0 ** (level + 1)
        reason = _reason(axis, level, white, drift)
        results.append(AxisDenoising(axis, level, cutoff, white, drift, reason))
    told = ", ".join(f"{r.axis.name} at level {r.level}" for r in results)
    notes = (*recording.notes, f"de-noised with {wavelet}: {told}")
    at = {r.level: decomposition.approximation(r.level).values for r in results}
    values = np.stack([at[r.level][:, k] for k, r in enumerate(results)], axis=1)
    left = dataclasses.replace(recording, values=values, others=(), notes=notes)
    return Denoised(left, wavelet, tuple(results))


def _variances(
    model: Model, wavelet: WaveletFilter, levels: int, recording: Recording
) -> tuple[Float[np.ndarray, " levels"], Float[np.ndarray, " levels"]]:
    """Wavelet variances of white noise and of drift under a model."""
    random = model.without(
        [label for label, t in zip(model.term_labels, model.terms, strict=True) if t.deterministic]
    )
    labels, terms = random.term_labels, random.terms
    of_kind = []
    for is_white in (True, False):
        others = [b for b, t in zip(labels, terms, strict=True) if isinstance(t, _WHITE) is not is_white]
        part = random.without(others)
        level, of_record = np.arange(1, levels + 1), (recording.n, recording.rate)
        of_kind.append(moments(part, wavelet, level, *of_record)[0] if len(part) else np.zeros(levels))
    return of_kind[0], of_kind[1]


def _reason(
    axis: Axis, level: int, white: Float[np.ndarray, " levels"], drift: Float[np.ndarray, " levels"]
) -> str:
    """Why this level, with the variances there and at the next."""
    unit, scale = square_unit(axis)

    def at(k: int) -> str:
        noise, slow = (significant(float(x[k - 1]) / scale) for x in (white, drift))
        return f"white noise {noise} and drift {slow} {unit} at level {k}"

    if level == len(white):
        return f"{at(level)}, the last: drift prevails nowhere in this record"
    return f"{at(level)}, {at(level + 1)}" if level else f"drift prevails from the start: {at(1)}"
