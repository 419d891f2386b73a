"""Calibrations from their JSON files."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from allanjax.base.errors import AllanjaxError
from allanjax.calibration.result import (
    SCHEMA_VERSION,
    AxisCalibration,
    Calibration,
    Misfit,
    Orientation,
    Position,
)
from allanjax.calibration.sensor_errors import estimate
from allanjax.estimate.as_json import document_in
from allanjax.record.recording import Axis
from allanjax.record.units import convert

_WANTED = "a calibration.json of allanjax calibrate"


def load_calibration(path: str | os.PathLike[str]) -> Calibration:
    """Load a calibration from the JSON file that `allanjax calibrate` writes, or prints with `--json`.

    Raises:
        AllanjaxError: the file does not exist, holds no calibration, is damaged or of another version.
    """
    document = document_in(path, _WANTED)
    try:
        if document["schema_version"] != SCHEMA_VERSION or "positions" not in document:
            raise AllanjaxError(f"{path}: not a calibration of this version of allanjax; give {_WANTED}")
        return Calibration(
            results=tuple(_axis(axis, document["parameters"]) for axis in document["axes"]),
            positions=tuple(map(_position, document["positions"])),
            misfit={sensor: _misfit(of) for sensor, of in document["sensors"].items()},
            gravity=float(document["gravity_m_s2"]),
            gravity_std=float(document["gravity_std_m_s2"]),
            latitude=document["latitude_deg"],
            noise=str(document["noise"]),
            notes=tuple(document["notes"]),
        )
    except AllanjaxError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise AllanjaxError(
            f"{path}: not a calibration, damaged, or of an earlier allanjax ({error!r}); give {_WANTED}"
        ) from error


def _axis(of: Mapping[str, Any], rows: list[Mapping[str, Any]]) -> AxisCalibration:
    axis = Axis(of["name"], of["sensor"], of["unit"])
    own = {row["parameter"]: row for row in rows if row["axis"] == axis.name}
    found = {label: _parameter(axis, label, row) for label, row in own.items()}
    widening = {label: _number(row["over_white_noise"]) for label, row in own.items()}
    return AxisCalibration(axis, found, widening, np.array(of["covariance_si"], float))


def _parameter(axis: Axis, label: str, row: Mapping[str, Any]) -> Any:
    """A parameter in SI, from the numbers in its usual unit."""
    scale = convert(1.0, row["unit"], estimate(axis, label, 0.0, 0.0, "").unit)
    value, std, *ends = (
        scale * _number(row[key]) for key in ("value", "std", "lower_95", "upper_95", "lower_68", "upper_68")
    )
    return estimate(axis, label, value, std, row["remark"], ((ends[0], ends[1]), (ends[2], ends[3])))


def _position(of: Mapping[str, Any]) -> Position:
    orientation = None
    if of["up"] is not None:
        north = None if of["north"] is None else np.array(of["north"], float)
        orientation = Orientation(of["orientation"], np.array(of["up"], float), north)
    return Position(of["name"], orientation, of["start_s"], of["duration_s"], of["gravity_m_s2"])


def _misfit(of: Mapping[str, Any]) -> Misfit:
    return Misfit(
        tuple(of["names"]),
        np.array(of["residuals_si"], float),
        np.array(of["residual_std_si"], float),
        of["chi2"],
        of["dof"],
        _number(of["p_value"]),
        tuple(of["suspects"]),
        of["wider"],
    )


def _number(x: float | None) -> float:
    return math.nan if x is None else float(x)
