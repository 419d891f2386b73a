"""Units of samples and of coefficients in every spelling, against factors computed by hand."""

import math

import numpy as np
import pytest

import allanjax as aj

DEG = math.pi / 180
G0 = 9.80665
RATE = 50.0
SAMPLES = np.random.default_rng(0).normal(size=40) + 0.2

# Spellings, the factor to SI, and the name under which it is shown.
RATES = {
    "gyro": [
        ("deg/h, deg/hr, °/h, °/hr, deg/hour, Deg/h, deg h^-1, deg per hour, dph", DEG / 3600, "deg/h"),
        ("deg/s, dps, °/s, DEG/S, deg / s, deg/sec, degrees/second, deg·s⁻¹, deg s^-1", DEG, "deg/s"),
        ("mdeg/s, mdps", DEG / 1000, "mdeg/s"),
        ("rad/s, Rad/s, rad s-1, rad.s-1, rad*s^-1, rad·s⁻¹", 1.0, "rad/s"),
        ("mrad/s", 1e-3, "mrad/s"),
        ("rad/h, rad/hr", 1 / 3600, "rad/h"),
        ("arcsec/s", DEG / 3600, "arcsec/s"),
        ("rpm, rev/min", 2 * math.pi / 60, "rpm"),
    ],
    "accel": [
        ("m/s², m/s^2, m/s2, m/s**2, m s-2, m s^-2, m·s⁻², m/s/s, m.s-2", 1.0, "m/s²"),
        ("g, g's, G's", G0, "g"),
        ("mg", 1e-3 * G0, "mg"),
        ("µg, μg, ug", 1e-6 * G0, "µg"),
        ("cm/s²", 1e-2, "cm/s²"),
        ("mm/s²", 1e-3, "mm/s²"),
        ("Gal, gal", 1e-2, "Gal"),
        ("mGal, mgal", 1e-5, "mGal"),
        ("ft/s², ft/s^2", 0.3048, "ft/s²"),
        ("m/s/h, m/s/hr, (m/s)/h", 1 / 3600, "m/s/h"),
    ],
}
INCREMENTS = {
    "gyro": [
        ("rad", 1.0, "rad"),
        ("mrad", 1e-3, "mrad"),
        ("µrad, μrad, urad", 1e-6, "µrad"),
        ("deg, °", DEG, "deg"),
        ('arcsec, ", ″', DEG / 3600, "arcsec"),
        ("arcmin", DEG / 60, "arcmin"),
    ],
    "accel": [
        ("m/s", 1.0, "m/s"),
        ("mm/s", 1e-3, "mm/s"),
        ("cm/s", 1e-2, "cm/s"),
        ("ft/s", 0.3048, "ft/s"),
    ],
}


def read_as(unit, sensor):
    """A recording of samples in this unit."""
    return aj.Recording.from_array(SAMPLES, RATE, names=[f"{sensor}_x"], **{f"{sensor}_unit": unit})


@pytest.mark.parametrize("sensor", ["gyro", "accel"])
def test_units_of_samples(sensor):
    """Increments over a sample interval are multiplied by the rate."""
    for table, rate in ((RATES[sensor], 1.0), (INCREMENTS[sensor], RATE)):
        for texts, scale, name in table:
            for text in texts.split(", "):
                recording = read_as(text, sensor)
                np.testing.assert_allclose(recording.values[:, 0], SAMPLES * scale * rate, rtol=1e-14)
                np.testing.assert_allclose(recording.own_values[:, 0], SAMPLES, rtol=1e-14)
                assert recording.axes[0].unit == name


@pytest.mark.parametrize("sensor", ["gyro", "accel"])
def test_unknown_and_ambiguous_units_of_samples_are_refused(sensor):
    unknown = ("furlong", "LSB", "deg/", "/s", "((", "deg//s", "G", "MG", "rads", "2*deg/s", "nan", "g^400")
    other = {"gyro": ["m/s²", "mg", "m/s"], "accel": ["deg/s", "rpm", "arcsec"]}[sensor]
    for text in ["", *unknown, *other]:
        with pytest.raises(aj.UnitError) as caught:
            read_as(text, sensor)
        assert repr(text) in str(caught.value)
        assert all(name in str(caught.value) for _, _, name in (*RATES[sensor], *INCREMENTS[sensor]))
        assert isinstance(caught.value, ValueError)


# Spellings of units of coefficients, the SI unit and the factor to it.
COEFFICIENTS = [
    ("deg/√h, deg/sqrt(h), deg/√hr, deg/√(h), deg/h^0.5, °/√h, deg/h^(1/2), deg·h^-0.5", "rad/√s", DEG / 60),
    ("deg/rt(h), deg/rthr, deg/root-h", "rad/s^0.5", DEG / 60),
    ("deg/h/√h, (deg/h)/√h, deg/h^1.5, deg/hr/sqrt(hr)", "rad/s/√s", DEG / 3600 / 60),
    ("deg/h², deg/h^2", "rad/s²", DEG / 3600**2),
    ("rad/s/√Hz", "rad/√s", 1.0),
    ("deg/s/√Hz, dps/sqrt(Hz)", "rad/s/√Hz", DEG),
    ("arcsec", "rad", DEG / 3600),
    ("µg", "m/s²", 1e-6 * G0),
    ("µg/√Hz, ug/rtHz", "m/s²/√Hz", 1e-6 * G0),
    ("m/s/√h", "m/s/√s", 1 / 60),
    ("m/h", "m/s", 1 / 3600),
    ("m/s/h/√h", "m/s²/√s", 1 / 3600 / 60),
    ("m/s/h²", "m/s³", 1 / 3600**2),
    ("h, hour", "s", 3600.0),
    ("ppm", "1", 1e-6),
    ("%, percent", "1", 1e-2),
    ("(deg/h)²/Hz", "rad²/s", (DEG / 3600) ** 2),
    ("deg/h/[temperature]", "rad/s/[temperature]", DEG / 3600),
]


@pytest.mark.parametrize(("texts", "si", "scale"), COEFFICIENTS)
def test_units_of_coefficients(texts, si, scale):
    for text in texts.split(", "):
        assert aj.convert(1.0, text, si) == pytest.approx(scale, rel=1e-14)
        assert aj.convert(scale, si, text) == pytest.approx(1.0, rel=1e-14)
    sensor = "gyro" if "rad" in si else "accel"
    np.testing.assert_allclose(aj.convert(np.array([3.0, -2.0]), text, si, sensor), [3 * scale, -2 * scale])


def test_units_of_other_dimensions_and_sensors_are_not_converted():
    for source, target, sensor, word in (
        ("deg/h", "deg/√h", "gyro", "deg/s"),
        ("g", "m/s", "accel", "m/s²"),
        ("deg/h", "furlong", "gyro", "furlong"),
        ("g", "m/s²", "gyro", "accelerometer"),
        ("deg/h", "deg/s", "accel", "gyro"),
        ("deg/h/[temperature]", "deg/h/[current]", None, "current"),
    ):
        with pytest.raises(aj.UnitError) as caught:
            aj.convert(1.0, source, target, sensor)
        assert word in str(caught.value)
