"""De-noising at the level at which, by a fitted model, white noise falls below the drift.

The thesis chooses the level by eye (figures 3.4 and 3.5): that from which on the mean of the details is not
zero. A fitted model says how much of each octave is noise without memory, white noise and quantization, and
how much is drift, all other random terms.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from jaxtyping import Float

from allanjax.base.equality import ByValue
from allanjax.base.per_axis import PerAxis
from allanjax.base.wording import plain, significant
from allanjax.noise.model import Model
from allanjax.noise.notation import Modelling, models_of
from allanjax.noise.terms import AngleRandomWalk, Quantization
from allanjax.record.io.given import RecordingLike, as_recording
from allanjax.record.recording import Axis, Recording
from allanjax.spectrum.autocorrelation import square_unit
from allanjax.wavelets.decomposition import wavelet_decomposition
from allanjax.wavelets.filters import WaveletFilter
from allanjax.wavelets.variance import moments

if TYPE_CHECKING:
    import pandas as pd

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
