"""Calibrations from their JSON files."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from allanjax.base.errors import AllanjaxError
from allanjax.calibration.result import AxisCalibration, Calibration, Misfit, Orientation, Position
from allanjax.calibration.sensor_errors import estimate
from allanjax.estimate.as_json import document_in, read
from allanjax.record.recording import Axis
from allanjax.record.units import unit_scale

_WANTED = "a calibration.json of allanjax calibrate"


def load_calibration(path: str | os.PathLike[str]) -> Calibration:
    """Load a calibration from the JSON file that `allanjax calibrate` writes, or prints with `--json`.

    Raises:
        AllanjaxError: the file does not exist, holds no calibration, or is damaged or older than these files.
    """
    document = document_in(path, _WANTED)
    try:
        return read(
            Calibration,
            document,
            results=tuple(_axis(axis, document["parameters"]) for axis in document["axes"]),
            positions=tuple(map(_position, document["positions"])),
            misfit={sensor: read(Misfit, of) for sensor, of in document["sensors"].items()},
            gravity=document["gravity_m_s2"],
            gravity_std=document["gravity_std_m_s2"],
            latitude=document["latitude_deg"],
        )
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise AllanjaxError(
            f"{path}: not a calibration, damaged, or of an earlier allanjax ({error!r}); give {_WANTED}"
        ) from error


def _axis(of: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> AxisCalibration:
    axis, found, widening = read(Axis, of), {}, {}
    for row in (row for row in rows if row["axis"] == axis.name):
        label, numbers = row["parameter"], np.array([row[key] for key in _NUMBERS], float)
        value, std, *ends = (unit_scale(row["unit"]) * numbers).tolist()
        intervals = (ends[0], ends[1]), (ends[2], ends[3])
        found[label] = estimate(axis, label, value, std, row["remark"], intervals)
        widening[label] = float(np.array(row["over_white_noise"], float))
    return AxisCalibration(axis, found, widening, np.array(of["covariance_si"], float))


_NUMBERS = ("value", "std", "lower_95", "upper_95", "lower_68", "upper_68")


def _position(of: Mapping[str, Any]) -> Position:
    up, north = (None if of[key] is None else np.array(of[key], float) for key in ("up", "north"))
    orientation = None if up is None else Orientation(of["orientation"], up, north)
    return Position(of["name"], orientation, of["start_s"], of["duration_s"], of["gravity_m_s2"])
