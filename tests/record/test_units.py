"""Units of samples and of coefficients in every spelling, against factors computed by hand."""

import numpy as np
import pytest
from imu_columns import DEG, G0, refused

import allanjax as aj

RATE = 50.0
SAMPLES = np.random.default_rng(0).normal(size=40) + 0.2
# Spellings, of which the first is shown, and the factor to SI; then the same of increments.
UNITS = {
    "gyro": {
        "deg/h, deg/hr, °/h, °/hr, deg/hour, Deg/h, deg h^-1, deg per hour, dph": DEG / 3600,
        "deg/s, dps, °/s, DEG/S, deg / s, deg/sec, degrees/second, deg·s⁻¹, deg s^-1": DEG,
        "rad/s, Rad/s, rad s-1, rad.s-1, rad*s^-1, rad·s⁻¹": 1.0,
    }
    | {"mdeg/s, mdps": DEG / 1000, "mrad/s": 1e-3, "rad/h, rad/hr": 1 / 3600}
    | {"arcsec/s": DEG / 3600, "rpm, rev/min": 2 * np.pi / 60},
    "accel": {
        "m/s², m/s^2, m/s2, m/s**2, m s-2, m s^-2, m·s⁻², m/s/s, m.s-2": 1.0,
        "m/s/h, m/s/hr, (m/s)/h": 1 / 3600,
    }
    | {"g, g's, G's": G0, "mg": 1e-3 * G0, "µg, μg, ug": 1e-6 * G0, "ft/s², ft/s^2": 0.3048}
    | {"cm/s²": 1e-2, "mm/s²": 1e-3, "Gal, gal": 1e-2, "mGal, mgal": 1e-5},
}
INCREMENTS = {"accel": {"m/s": 1.0, "mm/s": 1e-3, "cm/s": 1e-2, "ft/s": 0.3048}}
INCREMENTS["gyro"] = {"rad": 1.0, "mrad": 1e-3, "µrad, μrad, urad": 1e-6, "deg, °": DEG}
INCREMENTS["gyro"] |= {'arcsec, ", ″': DEG / 3600, "arcmin": DEG / 60}
OTHERS = {"gyro": ["m/s²", "mg", "m/s"], "accel": ["deg/s", "rpm", "arcsec"]}
UNKNOWN = ["furlong", "LSB", "deg/", "/s", "((", "deg//s", "G", "MG", "rads", "-2*deg/s", "2", "nan", "g^400"]
UNKNOWN += ["", "0 deg/s"]


@pytest.mark.parametrize("sensor", UNITS)
def test_units_of_samples(sensor):
    """Increments over a sample interval are multiplied by the rate; a refusal names what is known."""

    def read_as(text):
        return aj.Recording.from_array(SAMPLES, RATE, names=[f"{sensor}_x"], **{f"{sensor}_unit": text})

    known = []
    for table, rate in ((UNITS[sensor], 1.0), (INCREMENTS[sensor], RATE)):
        for texts, scale in table.items():
            known.append(texts.split(", ")[0])
            for text in texts.split(", "):
                recording = read_as(text)
                np.testing.assert_allclose(recording.values[:, 0], SAMPLES * scale * rate, rtol=1e-14)
                np.testing.assert_allclose(recording.own_values[:, 0], SAMPLES, rtol=1e-14)
                assert recording.axes[0].unit == known[-1]
    for text in UNKNOWN + OTHERS[sensor]:
        refused(lambda text=text: read_as(text), "|".join([repr(text), *known]), aj.UnitError)


# Spellings of units of coefficients, the SI unit and the factor to it.
COEFFICIENTS = [
    ("deg/√h, deg/sqrt(h), deg/√hr, deg/√(h), deg/h^0.5, °/√h, deg/h^(1/2), deg·h^-0.5", "rad/√s", DEG / 60),
    ("deg/rt(h), deg/rthr, deg/root-h", "rad/s^0.5", DEG / 60),
    ("deg/h/√h, (deg/h)/√h, deg/h^1.5, deg/hr/sqrt(hr)", "rad/s/√s", DEG / 3600 / 60),
    ("rad/s/√Hz", "rad/√s", 1.0),
    ("deg/s/√Hz, dps/sqrt(Hz)", "rad/s/√Hz", DEG),
    ("arcsec", "rad", DEG / 3600),
    ("µg/√Hz, ug/rtHz", "m/s²/√Hz", 1e-6 * G0),
    ("m/s/√h", "m/s/√s", 1 / 60),
    ("m/s/h/√h", "m/s²/√s", 1 / 3600 / 60),
    ("m/s/h²", "m/s³", 1 / 3600**2),
    ("h, hour", "s", 3600.0),
    ("ppm", "1", 1e-6),
    ("%, percent", "1", 1e-2),
    ("(deg/h)²/Hz", "rad²/s", (DEG / 3600) ** 2),
    ("deg/h/[temperature]", "rad/s/[temperature]", DEG / 3600),
]
# What is not converted: units, the sensor, and what is named.
NOT_CONVERTED = [
    ("deg/h", "deg/√h", "gyro", "deg/s"),
    ("g", "m/s", "accel", "m/s²"),
    ("deg/h", "furlong", "gyro", "furlong"),
    ("g", "m/s²", "gyro", "accelerometer"),
    ("deg/h", "deg/s", "accel", "gyro"),
    ("deg/h/[temperature]", "deg/h/[current]", None, "current"),
]


def test_units_of_coefficients():
    for texts, si, scale in COEFFICIENTS:
        for text in texts.split(", "):
            assert aj.convert(1.0, text, si) == pytest.approx(scale, rel=1e-14), text
            made = aj.convert(np.array([3.0, -2.0]), si, text, "gyro" if "rad" in si else "accel")
            np.testing.assert_allclose(made, [3 / scale, -2 / scale], rtol=1e-14)
    for source, target, sensor, word in NOT_CONVERTED:
        refused(lambda a=source, b=target, s=sensor: aj.convert(1.0, a, b, s), word, aj.UnitError)
