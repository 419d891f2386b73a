"""Multi-resolution decomposition of recordings by wavelets: Hou (2004) section 3.3.2.

The discrete wavelet transform splits a record into details, an octave of frequencies each, and what is
slower, the approximation. Each is given in the time domain, so that all details and the last approximation
add up to the record.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError
from allanjax.base.presented import presented
from allanjax.base.wording import plain
from allanjax.record.io.given import RecordingLike, as_recording
from allanjax.record.recording import Recording
from allanjax.spectrum.autocorrelation import square_unit
from allanjax.wavelets.filters import pywavelets
from allanjax.wavelets.variance import bands

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
