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

# Units by the dimension of what they measure, with their factors to SI worked out by hand; SI's own first,
# then the one for people.
AMPLITUDES = {
    ("gyro", 1.0): {"rad": 1.0, "arcsec": DEG / H, "deg": DEG, "mrad": 1e-3},
    ("gyro", 0.5): {"rad/√s": 1.0, "deg/√h": DEG / 60, "deg/sqrt(h)": DEG / 60, "deg/h/√Hz": DEG / H},
    ("gyro", 0.25): {"rad/s^0.75": 1.0, "deg/s^0.75": DEG},
    ("gyro", 0.0): {"rad/s": 1.0, "deg/h": DEG / H, "°/h": DEG / H, "mdeg/s": 1e-3 * DEG},
    ("gyro", -0.5): {"rad/s/√s": 1.0, "deg/h/√h": DEG / H / 60, "deg/s/√s": DEG, "rad/s²/√Hz": 1.0},
    ("gyro", -1.0): {"rad/s²": 1.0, "deg/h²": DEG / H**2, "deg/h/s": DEG / H},
    ("accel", 1.0): {"m/s": 1.0, "mm/s": 1e-3, "ft/s": 0.3048},
    ("accel", 0.5): {"m/s/√s": 1.0, "m/s/√h": 1 / 60, "µg/√Hz": 1e-6 * G0, "m/s²/√Hz": 1.0},
    ("accel", 0.25): {"m/s^1.75": 1.0, "m/h^1.75": H**-1.75},
    ("accel", 0.0): {"m/s²": 1.0, "µg": 1e-6 * G0, "m/s/h": 1 / H, "Gal": 1e-2},
    ("accel", -0.5): {"m/s²/√s": 1.0, "m/s/h/√h": 1 / H / 60, "µg/√h": 1e-6 * G0 / 60},
    ("accel", -1.0): {"m/s³": 1.0, "m/s/h²": H**-2, "µg/h": 1e-6 * G0 / H},
}
SHAPES = {
    "time": {"s": 1.0, "ms": 1e-3, "min": 60.0, "h": H},
    "frequency": {"Hz": 1.0, "kHz": 1e3, "1/s": 1.0, "1/h": 1 / H},
    "number": {"1": 1.0},
}
SHAPES["line"] = SHAPES["frequency"]
AXES = {"gyro": aj.Axis("gyro_x", "gyro", "deg/s"), "accel": aj.Axis("accel_z", "accel", "g")}
OWN = dataclasses.replace(aj.AngleRandomWalk.parameters()[0], time_exponent=0.25)
EVERY = [(term.name(), p) for term in (TERMS | TRANSIENT).values() for p in term.parameters()]
PARAMETERS = {f"{name}_{p.name}": p for name, p in EVERY} | {"own": OWN}
N = PARAMETERS["angle_random_walk_coefficient"]
T_C = PARAMETERS["markov_correlation_time"]
F0 = PARAMETERS["sinusoid_frequency"]


def units_of(parameter, sensor):
    if parameter.is_amplitude:
        return AMPLITUDES[sensor, float(parameter.time_exponent)]
    return SHAPES[parameter.kind]


def estimate(parameter=N, sensor="gyro", **changes):
    """Of skewed intervals, in SI."""
    numbers = {"value": 3.0, "std": 0.1, "interval": (2.7, 3.25), "interval_68": (2.85, 3.12)}
    numbers |= {"upper_limit": 3.17} | changes
    return aj.Estimate(axis=AXES[sensor], label="angle_random_walk", parameter=parameter, **numbers)


def numbers_of(e):
    return np.array([e.value, e.std, *e.interval, *e.interval_68, e.upper_limit, e.lower_limit, e.excess])


@pytest.mark.parametrize("sensor", AXES)
def test_every_number_is_in_the_unit(sensor):
    """Of each parameter of each term, there and back, and from each unit to each other."""
    for label, p in PARAMETERS.items():
        units = units_of(p, sensor)
        e = estimate(p, sensor, lower_limit=2.6, excess=0.03)
        si = next(iter(units))
        assert (e.unit, e.si_unit, e.kind, e.symbol) == (si, si, p.kind, p.symbol), label
        assert units[e.usual_unit] == units_of(p, sensor)[e.in_unit().unit]
        for unit, factor in units.items():
            shown = e.in_unit(unit)
            assert shown.unit == unit
            assert_allclose(numbers_of(shown) * factor, numbers_of(e), rtol=1e-12)
            assert shown.in_unit(unit) == shown
            for other, into in units.items():
                assert_allclose(numbers_of(shown.in_unit(other)) * into, numbers_of(e), rtol=1e-12)


def test_usual_units_are_those_of_people():
    for (sensor, exponent), units in AMPLITUDES.items():
        if exponent != 0.25:
            usual = {"accel": {1.0: "m/s", 0.0: "µg"}}.get(sensor, {}).get(exponent, list(units)[1])
            assert estimate(dataclasses.replace(N, time_exponent=exponent), sensor).usual_unit == usual
    assert (estimate(T_C).usual_unit, estimate(F0).usual_unit) == ("s", "Hz")
    tilt = estimate(None, "accel", usual_unit="deg")
    assert (tilt.unit, tilt.in_unit().value) == ("rad", pytest.approx(3.0 / DEG))
    assert (tilt.symbol, tilt.kind, tilt.is_amplitude) == ("", "", False)
    with pytest.raises(aj.UnitError, match="usual_unit"):
        estimate(None)


@pytest.mark.parametrize("sensor", AXES)
def test_a_unit_of_something_else_is_refused(sensor):
    others = [AMPLITUDES[sensor, 0.5], *SHAPES.values(), AMPLITUDES["gyro", 0.0], AMPLITUDES["accel", 0.0]]
    for p in (N, T_C, F0, PARAMETERS["resonance_quality_factor"]):
        for unit in {"furlong"}.union(*others) - set(units_of(p, sensor)):
            with pytest.raises(aj.UnitError):
                estimate(p, sensor).in_unit(unit)


def test_widened():
    """Ends of positive values in proportion, about the value otherwise; zero stays an end."""
    e = estimate(lower_limit=2.6)
    wide = e.widened(1.5)
    assert (wide.value, wide.std) == (3.0, pytest.approx(0.15))
    assert wide.interval == pytest.approx([3.0 * (x / 3.0) ** 1.5 for x in (2.7, 3.25)])
    assert wide.interval_68 == pytest.approx([3.0 * (x / 3.0) ** 1.5 for x in (2.85, 3.12)])
    assert (wide.upper_limit, wide.lower_limit) == (pytest.approx(3.17 * 1.5), pytest.approx(2.6 / 1.5))
    absent = estimate(value=0.0, interval=(0.0, 0.8), interval_68=(0.0, 0.4), upper_limit=None).widened(1.5)
    assert absent.interval == pytest.approx((0.0, 1.2))
    assert absent.interval_68 == pytest.approx((0.0, 0.6))
    assert absent.upper_limit is None
    at_zero = estimate(value=1.0, interval=(0.0, 2.0)).widened(2.0)
    assert at_zero.interval == pytest.approx((0.0, 4.0))
    signed = estimate(value=1.0, interval=(-2.0, 4.0)).widened(2.0)
    assert signed.interval == pytest.approx((-5.0, 16.0))
    assert e.widened(1.0) == e


def test_unmeasured():
    found = estimate().unmeasured()
    assert (found.value, found.upper_limit, found.detected, found.measured) == (3.0, None, False, False)
    assert np.isnan([found.std, *found.interval, *found.interval_68]).all()
    held = estimate(held=True)
    assert held.unmeasured() is held


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
    assert "markov" in estimate(detected=False, rivals=("markov",)).describe()
    e = estimate(value=0.512 * DEG / 60, std=0.007 * DEG / 60, interval=(0.498 * DEG / 60, 0.526 * DEG / 60))
    assert e.describe("deg/√h") == e.in_unit().describe() == "0.5120 ± 0.0070 deg/√h"
    assert e.in_unit().describe_interval() == "0.4980 … 0.5260"
    assert e.median == e.value
