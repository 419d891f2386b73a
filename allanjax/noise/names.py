"""Usual names of coefficients, such as ARW and VRW."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TYPE_CHECKING

from allanjax.record.units import SENSORS, Sensor

if TYPE_CHECKING:
    from allanjax.noise.estimate import Estimate

# Usual names of the basic terms, besides their own and their symbols.
_CALLED: dict[str, dict[Sensor, str]] = {
    "angle_random_walk": {"gyro": "arw", "accel": "vrw velocity_random_walk"},
    "rate_random_walk": {"gyro": "rrw", "accel": "rrw acceleration_random_walk"},
    "bias_instability": dict.fromkeys(SENSORS, "bi flicker flicker_noise"),
    "quantization": dict.fromkeys(SENSORS, "qn quantization_noise"),
    "drift_ramp": dict.fromkeys(SENSORS, "ramp rate_ramp"),
}


def called(name: str, coefficients: Mapping[str, Estimate]) -> str | None:
    """Label of the coefficient with this usual name; None if there is none, or several.

    Labels themselves, in any case and with spaces; symbols such as "N"; abbreviations such as "ARW" of a gyro
    and "VRW" of an accelerometer (whose "ARW" is the angle random walk for some, the acceleration random
    walk for others, and therefore nothing here).
    """
    if name in coefficients:
        return name
    by_symbol = [label for label, c in coefficients.items() if c.symbol == name]
    if len(by_symbol) == 1:
        return by_symbol[0]
    spelt = re.sub(r"[\s-]+", "_", name.strip().lower())
    for label, c in coefficients.items():
        if spelt in (label, *_CALLED.get(label, {}).get(c.axis.sensor, "").split()):
            return label
    return None
