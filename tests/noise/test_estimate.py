"""A value and its unit are one thing: whatever the parameter and the unit; widened, unmeasured, told."""

import dataclasses
import math
import re

import numpy as np
import pytest
from noise_terms import TERMS, TRANSIENT
from numpy.testing import assert_allclose

import allanjax as aj

DEG, H, G0 = math.pi / 180.0, 3600.0, 9.80665

# By sensor and power of time of an amplitude, or by the kind of a parameter: SI's unit, the one for people
# and others, with their factors to SI worked out by hand.
AMPLITUDES = {
    ("gyro", 1.0): {"rad": 1.0, "arcsec": DEG / H}, ("gyro", 0.5): {"rad/√s": 1.0, "deg/√h": DEG / 60},
    ("gyro", 0.25): {"rad/s^0.75": 1.0, "deg/s^0.75": DEG}, ("gyro", 0.0): {"rad/s": 1.0, "deg/h": DEG / H},
    ("gyro", -0.5): {"rad/s/√s": 1.0, "deg/h/√h": DEG / H / 60, "rad/s²/√Hz": 1.0},
    ("gyro", -1.0): {"rad/s²": 1.0, "deg/h²": DEG / H**2}, ("accel", 1.0): {"m/s": 1.0, "mm/s": 1e-3},
    ("accel", 0.5): {"m/s/√s": 1.0, "m/s/√h": 1 / 60, "µg/√Hz": 1e-6 * G0},
    ("accel", 0.25): {"m/s^1.75": 1.0, "m/h^1.75": H**-1.75}, ("accel", 0.0): {"m/s²": 1.0, "µg": 1e-6 * G0},
    ("accel", -0.5): {"m/s²/√s": 1.0, "m/s/h/√h": H**-1.5}, ("accel", -1.0): {"m/s³": 1.0, "m/s/h²": H**-2},
}  # fmt: skip
SHAPES = {"time": {"s": 1.0, "min": 60.0}, "frequency": {"Hz": 1.0, "1/h": 1 / H}, "number": {"1": 1.0}}
SHAPES["line"] = SHAPES["frequency"]
AXES = {"gyro": aj.Axis("gyro_x", "gyro", "deg/s"), "accel": aj.Axis("accel_z", "accel", "g")}
EVERY = [(term.name(), p) for term in (TERMS | TRANSIENT).values() for p in term.parameters()]
PARAMETERS = {f"{name}_{p.name}": p for name, p in EVERY}
N, T_C = PARAMETERS["angle_random_walk_coefficient"], PARAMETERS["markov_correlation_time"]
PARAMETERS["own"] = dataclasses.replace(N, time_exponent=0.25)


def units_of(p, sensor):
    return AMPLITUDES[sensor, float(p.time_exponent)] if p.is_amplitude else SHAPES[p.kind]


def estimate(parameter=N, sensor="gyro", **changes):
    """Of skewed intervals, in SI."""
    numbers = {"value": 3.0, "std": 0.1, "interval": (2.7, 3.25), "interval_68": (2.85, 3.12)}
    numbers |= {"upper_limit": 3.17} | changes
    return aj.Estimate(axis=AXES[sensor], label="angle_random_walk", parameter=parameter, **numbers)


def numbers_of(e):
    return np.array([e.value, e.std, *e.interval, *e.interval_68, e.upper_limit, e.lower_limit, e.excess])


@pytest.mark.parametrize("sensor", AXES)
def test_every_number_is_in_the_unit(sensor):
    every = {unit for units in (*AMPLITUDES.values(), *SHAPES.values()) for unit in units}
    for label, p in PARAMETERS.items():
        units, e = units_of(p, sensor), estimate(p, sensor, lower_limit=2.6, excess=0.03)
        assert (e.unit, e.si_unit, e.kind, e.symbol) == (*[next(iter(units))] * 2, p.kind, p.symbol), label
        for unit, factor in units.items():
            shown = e.in_unit(unit)
            assert (shown.unit, shown.in_unit(unit)) == (unit, shown)
            assert_allclose(numbers_of(shown) * factor, numbers_of(e), rtol=1e-12)
            assert_allclose(numbers_of(shown.in_unit(e.unit)), numbers_of(e), rtol=1e-12)
        for unit in {"furlong", *every} - set(units):
            with pytest.raises(aj.UnitError):
                e.in_unit(unit)


def test_usual_units_are_those_of_people():
    for (sensor, exponent), units in AMPLITUDES.items():
        if exponent != 0.25:
            usual = [*units][sensor == "gyro" or exponent != 1.0]
            assert estimate(dataclasses.replace(N, time_exponent=exponent), sensor).usual_unit == usual
    for kind, unit in (("time", "s"), ("frequency", "Hz"), ("line", "Hz"), ("number", "1")):
        assert estimate(next(p for p in PARAMETERS.values() if p.kind == kind)).in_unit().unit == unit
    tilt = estimate(None, "accel", usual_unit="deg")
    assert (tilt.unit, tilt.in_unit().value) == ("rad", pytest.approx(3.0 / DEG))
    assert (tilt.symbol, tilt.kind, tilt.is_amplitude) == ("", "", False)
    with pytest.raises(aj.UnitError, match="usual_unit"):
        estimate(None)


def test_widened_and_unmeasured():
    """Ends of positive values in proportion, about the value otherwise; zero stays an end."""
    e = estimate(lower_limit=2.6, excess=0.03)
    ends = [3.0 * (x / 3.0) ** 1.5 for x in (2.7, 3.25, 2.85, 3.12)]
    assert_allclose(numbers_of(e.widened(1.5)), [3.0, 0.15, *ends, 3.17 * 1.5, 2.6 / 1.5, 0.03])
    assert estimate(upper_limit=None).widened(1.5).upper_limit is None
    ends = {(0.0, 0.0, 0.8): (0.0, 1.6), (1.0, 0.0, 2.0): (0.0, 4.0), (1.0, -2.0, 4.0): (-5.0, 16.0)}
    for (value, *given), expected in ends.items():
        assert estimate(value=value, interval=given).widened(2.0).interval == pytest.approx(expected)
    assert e.widened(1.0) == e
    found = estimate().unmeasured()
    assert (found.value, found.upper_limit, found.detected, found.measured) == (3.0, None, False, False)
    assert np.isnan([found.std, *found.interval, *found.interval_68]).all()
    assert estimate(held=True).unmeasured().measured


# What is told of each state: numbers, two digits of an error, three of a limit, up to six of what is held.
TOLD = [
    (N, {}, ["3.00", "0.10"]), (N, {"detected": False}, ["3.17"]),
    (N, {"detected": False, "upper_limit": None}, []), (N, {"held": True, "value": 0.125}, ["0.125"]),
    (N, {"measured": False, "detected": False}, ["3.00"]), (T_C, {"upper_limit": None}, ["3.00", "0.10"]),
    (T_C, {}, ["3.17"]), (T_C, {"lower_limit": 2.6, "upper_limit": None}, ["2.60"]),
    (T_C, {"std": math.nan, "upper_limit": None}, []),
]  # fmt: skip


def test_what_is_printed_is_what_is_held():
    for parameter, changes, expected in TOLD:
        unit = "deg/√h" if parameter is N else "s"
        told = estimate(parameter, unit=unit, usual_unit=unit, **changes).describe()
        assert re.findall(r"\d+\.\d+", told) == expected, told
        assert not expected or unit in told
    value, std = 0.512 * DEG / 60, 0.007 * DEG / 60
    e = estimate(value=value, std=std, interval=(value - 2.0 * std, value + 2.0 * std))
    assert e.describe("deg/√h") == e.in_unit().describe() == "0.5120 ± 0.0070 deg/√h"
    assert e.median == e.value
