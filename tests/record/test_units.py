"""Units: every spelling that people use, against hand-computed factors."""

import math

import numpy as np
import pytest

from allanjax.base.errors import AllanjaxError, UnitError
from allanjax.record.units import (
    SAMPLE_UNITS,
    convert,
    default_coefficient_unit,
    parse_sample_unit,
    unit_scale,
)

DEG = math.pi / 180
G0 = 9.80665

GYRO = [
    (
        ("deg/h", "deg/hr", "°/h", "°/hr", "deg/hour", "Deg/h", "deg h^-1", "deg per hour"),
        DEG / 3600,
        "deg/h",
    ),
    (("deg/s", "dps", "°/s", "DEG/S", "deg / s", "deg/sec", "degrees/second", "deg·s⁻¹"), DEG, "deg/s"),
    (("mdeg/s", "mdps"), DEG / 1000, "mdeg/s"),
    (("rad/s", "Rad/s", "rad s-1", "rad.s-1", "rad*s^-1"), 1.0, "rad/s"),
    (("mrad/s",), 1e-3, "mrad/s"),
    (("rad/h", "rad/hr"), 1 / 3600, "rad/h"),
    (("arcsec/s",), DEG / 3600, "arcsec/s"),
    (("rpm", "rev/min"), 2 * math.pi / 60, "rpm"),
]
GYRO_INCREMENTS = [
    (("rad",), 1.0, "rad"),
    (("mrad",), 1e-3, "mrad"),
    (("µrad", "μrad", "urad"), 1e-6, "µrad"),
    (("deg", "°"), DEG, "deg"),
    (("arcsec", '"', "″"), DEG / 3600, "arcsec"),
    (("arcmin",), DEG / 60, "arcmin"),
]
ACCEL = [
    (("m/s²", "m/s^2", "m/s2", "m/s**2", "m s-2", "m s^-2", "m·s⁻²", "m/s/s", "m.s-2"), 1.0, "m/s²"),
    (("g",), G0, "g"),
    (("mg",), 1e-3 * G0, "mg"),
    (("µg", "μg", "ug"), 1e-6 * G0, "µg"),
    (("cm/s²",), 1e-2, "cm/s²"),
    (("mm/s²",), 1e-3, "mm/s²"),
    (("Gal", "gal"), 1e-2, "Gal"),
    (("mGal", "mgal"), 1e-5, "mGal"),
    (("ft/s²", "ft/s^2"), 0.3048, "ft/s²"),
    (("m/s/h", "m/s/hr", "(m/s)/h"), 1 / 3600, "m/s/h"),
]
ACCEL_INCREMENTS = [
    (("m/s",), 1.0, "m/s"),
    (("mm/s",), 1e-3, "mm/s"),
    (("cm/s",), 1e-2, "cm/s"),
    (("ft/s",), 0.3048, "ft/s"),
]
SPELLINGS = [
    (sensor, quantity, text, scale, name)
    for sensor, quantity, table in (
        ("gyro", "rate", GYRO),
        ("gyro", "increment", GYRO_INCREMENTS),
        ("accel", "rate", ACCEL),
        ("accel", "increment", ACCEL_INCREMENTS),
    )
    for texts, scale, name in table
    for text in texts
]


@pytest.mark.parametrize(("sensor", "quantity", "text", "scale", "name"), SPELLINGS)
def test_sample_unit(sensor, quantity, text, scale, name):
    unit = parse_sample_unit(text, sensor)
    assert unit.scale == pytest.approx(scale, rel=1e-14)
    assert (unit.quantity, unit.name) == (quantity, name)


def test_every_accepted_unit_has_its_own_name_and_quantity():
    for sensor, quantities in SAMPLE_UNITS.items():
        for quantity, names in quantities.items():
            for name in names:
                assert parse_sample_unit(name, sensor).name == name
                assert parse_sample_unit(name, sensor).quantity == quantity


@pytest.mark.parametrize("sensor", ["gyro", "accel"])
@pytest.mark.parametrize(
    "text",
    [
        "",
        "furlong",
        "LSB",
        "deg/",
        "/s",
        "((",
        "deg//s",
        "G",
        "MG",
        "Mg",
        "rads",
        "degs",
        "gs",
        "2*deg/s",
        "1",
        "nan",
        "rad nan^-1",
        "g^400",
    ],
)
def test_unknown_and_ambiguous_units_are_refused(sensor, text):
    with pytest.raises(UnitError) as caught:
        parse_sample_unit(text, sensor)
    message = str(caught.value)
    assert repr(text) in message
    assert ("gyro" if sensor == "gyro" else "accelerometer") in message
    assert all(name in message for names in SAMPLE_UNITS[sensor].values() for name in names)
    assert isinstance(caught.value, AllanjaxError)
    assert isinstance(caught.value, ValueError)


@pytest.mark.parametrize(
    ("text", "sensor", "hint"),
    [
        ("m/s²", "gyro", "'m/s²' is a unit of an accelerometer"),
        ("deg/s", "accel", "'deg/s' is a unit of a gyro"),
    ],
)
def test_unit_of_the_other_sensor_is_hinted(text, sensor, hint):
    with pytest.raises(UnitError, match="unknown unit") as caught:
        parse_sample_unit(text, sensor)
    assert hint in str(caught.value)


@pytest.mark.parametrize(
    ("unit", "sensor", "scale"),
    [
        *(
            (text, "gyro", DEG / 60)
            for text in ("deg/√h", "deg/sqrt(h)", "deg/√hr", "deg/√(h)", "deg/h^0.5", "°/√h")
        ),
        *((text, "gyro", DEG / 60) for text in ("deg/h^(1/2)", "deg·h^-0.5", "deg/rt(h)", "deg/rthr")),
        *(
            (text, "gyro", DEG / 3600 / 60)
            for text in ("deg/h/√h", "(deg/h)/√h", "deg/h^1.5", "deg/hr/sqrt(hr)")
        ),
        ("deg/h²", "gyro", DEG / 3600**2),
        ("deg/h^2", "gyro", DEG / 3600**2),
        ("rad/s/√Hz", "gyro", 1.0),
        ("deg/s/√Hz", "gyro", DEG),
        ("dps/sqrt(Hz)", "gyro", DEG),
        ("arcsec", "gyro", DEG / 3600),
        ("µg", "accel", 1e-6 * G0),
        ("µg/√Hz", "accel", 1e-6 * G0),
        ("ug/rtHz", "accel", 1e-6 * G0),
        ("m/s²/√Hz", "accel", 1.0),
        ("m/s/√h", "accel", 1 / 60),
        ("m/s", "accel", 1.0),
        ("m/h", "accel", 1 / 3600),
        ("m/s/h", "accel", 1 / 3600),
        ("m/s/h/√h", "accel", 1 / 3600 / 60),
        ("m/s/h²", "accel", 1 / 3600**2),
        ("s", None, 1.0),
        ("h", None, 3600.0),
        ("Hz", None, 1.0),
        ("1", None, 1.0),
        ("(deg/h)²/Hz", None, (DEG / 3600) ** 2),
    ],
)
def test_unit_scale(unit, sensor, scale):
    assert unit_scale(unit, sensor) == pytest.approx(scale, rel=1e-14)
    assert unit_scale(unit, None) == unit_scale(unit, sensor)


@pytest.mark.parametrize(
    ("sensor", "labels"),
    [
        ("gyro", ("arcsec", "deg/√h", "deg/h", "deg/h/√h", "deg/h²")),
        ("accel", ("m/s", "m/s/√h", "µg", "m/s/h/√h", "m/s/h²")),
    ],
)
def test_default_coefficient_units(sensor, labels):
    rate = "rad/s" if sensor == "gyro" else "m/s²"
    for exponent, label in zip((1.0, 0.5, 0.0, -0.5, -1.0), labels, strict=True):
        assert default_coefficient_unit(sensor, exponent) == label
        # The dimension is that of rate·s^exponent.
        convert(1.0, label, f"{rate}·s^{exponent}", sensor)


@pytest.mark.parametrize("exponent", [-1.5, -0.25, 0.25, 1.25, 1.5, 2.0, 2.5, 3.0])
@pytest.mark.parametrize(("sensor", "rate"), [("gyro", "rad/s"), ("accel", "m/s²")])
def test_other_exponents_get_an_si_label(sensor, rate, exponent):
    label = default_coefficient_unit(sensor, exponent)
    assert convert(1.0, label, f"{rate}·s^{exponent}", sensor) == 1.0


def test_convert():
    assert convert(1.0, "deg/√h", "rad/s/√Hz", "gyro") == pytest.approx(DEG / 60)
    assert convert(1.0, "µg", "m/s²", "accel") == pytest.approx(1e-6 * G0)
    np.testing.assert_allclose(convert(np.array([1.0, 2.0]), "deg/s", "deg/h", "gyro"), [3600.0, 7200.0])


@pytest.mark.parametrize(
    ("source", "target", "sensor", "said"),
    [
        ("deg/h", "deg/√h", "gyro", "dimension"),
        ("g", "m/s", "accel", "dimension"),
        ("deg/h", "furlong", "gyro", "furlong"),
        ("g", "m/s²", "gyro", "accelerometer"),
        ("deg/h", "deg/s", "accel", "gyro"),
    ],
)
def test_convert_refuses(source, target, sensor, said):
    with pytest.raises(UnitError, match=said):
        convert(1.0, source, target, sensor)
