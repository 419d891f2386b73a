"""Recordings from data frames, exactly as `Recording.to_dataframe` took them apart."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from allanjax.base.errors import RecordingError
from allanjax.record.axes import Axis, DeadAxis, scales_of
from allanjax.record.gaps import gaps_within
from allanjax.record.io.given import as_recording
from allanjax.record.recording import ATTRIBUTE, Recording
from allanjax.record.validation import MIN_SAMPLES, Source, check_values

if TYPE_CHECKING:
    import pandas as pd

# Difference [samples] of the times from those of the rate that is stated, up to which they confirm it.
_CONFIRMED = 1e-3


def from_dataframe(
    frame: "pd.DataFrame",
    rate: float | None = None,
    *,
    gyro_unit: str | None = None,
    accel_unit: str | None = None,
    names: Sequence[str] | None = None,
) -> Recording:
    """Make a recording from a data frame; see `Recording.from_dataframe`."""
    stated = getattr(frame, "attrs", {}).get(ATTRIBUTE)
    told = not rate is gyro_unit is accel_unit is names is None
    if not told and stated is not None and (found := _taken(frame, stated)) is not None:
        return found
    return as_recording(frame, rate, gyro_unit, accel_unit, names)


def _taken(frame: "pd.DataFrame", stated: Mapping[str, Any]) -> Recording | None:
    """Recording that the frame was made of, or what is left of it; None if columns or rows are other ones."""
    axes = {label: Axis(*stated["axes"][label]) for label in stated["axes"] if label in frame.columns}
    auxiliary = {name for name in stated["auxiliary"] if name in frame.columns}
    if not axes or {*frame.columns} != {"time [s]", *axes, *auxiliary} or len(frame) < MIN_SAMPLES:
        return None
    rate = float(stated["rate_hz"])
    time = frame["time [s]"].to_numpy(float)
    # Rows that were thinned out, or columns joined to others, are another recording.
    if not (abs((time - time[0]) * rate - np.arange(len(time))) < _CONFIRMED).all():
        return None
    values = frame[list(axes)].to_numpy(float)
    try:
        living = check_values(values, list(axes), Source("data frame")).all()
    except RecordingError:
        return None
    if not living:
        return None
    own = tuple(axes.values())
    begin = round(float(time[0]) * rate)
    missing = np.zeros(values.shape, bool)
    for k, label in enumerate(axes):
        edges = [*stated.get("missing", {}).get(label, []), len(frame)]
        for first, end in zip(edges[::2], edges[1::2], strict=False):
            missing[max(first - begin, 0) : max(end - begin, 0), k] = True
    return Recording(
        values if stated["si"] else values * scales_of(own, rate),
        rate,
        own,
        MappingProxyType({name: frame[name].to_numpy() for name in stated["auxiliary"] if name in auxiliary}),
        stated["name"],
        tuple(stated["notes"]),
        tuple(DeadAxis(Axis(*axis), reason) for *axis, reason in stated["dead"]),
        stated["jitter_s"],
        missing if missing.any() else None,
        gaps=gaps_within(stated.get("gaps"), begin, begin + len(frame)),
    )
