"""Vendors' data sheets that come with the package."""

import math
from pathlib import Path

import pytest
from commands import run

import allanjax as aj
from allanjax.base.errors import AllanjaxError
from allanjax.noise.sheets import sheets

DEG = math.pi / 180.0
G0 = 9.80665
# Least Allan deviation of flicker noise over B, √(2 ln 2/π).
LEAST = 0.664283

# (N, B) of gyro and accelerometer in SI, from the figures as they are printed in the sheets.
BY_HAND = {
    # 0.66 °/√h and 14.5 °/h; 0.11 m/s/√h and 0.25 mg.
    "ADIS16448": {
        "gyro": (0.66 * DEG / 60.0, 14.5 * DEG / 3600.0 / LEAST),
        "accel": (0.11 / 60.0, 0.25e-3 * G0 / LEAST),
    },
    # 0.34 °/√h and 8 °/h; 0.037 m/s/√h and 13 µg.
    "ADIS16470": {
        "gyro": (0.34 * DEG / 60.0, 8.0 * DEG / 3600.0 / LEAST),
        "accel": (0.037 / 60.0, 13e-6 * G0 / LEAST),
    },
    # 0.014 °/s/√Hz and 190 µg/√Hz, one-sided.
    "BMI088": {
        "gyro": (0.014 * DEG / math.sqrt(2.0), None),
        "accel": (190e-6 * G0 / math.sqrt(2.0), None),
    },
    # 0.007 °/s/√Hz and 180 µg/√Hz, one-sided.
    "BMI160": {
        "gyro": (0.007 * DEG / math.sqrt(2.0), None),
        "accel": (180e-6 * G0 / math.sqrt(2.0), None),
    },
    # 0.04 °/√h and 0.25 °/h; 0.03 m/s/√h and 0.025 mg.
    "HG4930-CA51": {
        "gyro": (0.04 * DEG / 60.0, 0.25 * DEG / 3600.0 / LEAST),
        "accel": (0.03 / 60.0, 0.025e-3 * G0 / LEAST),
    },
    # 2.8 mdps/√Hz and 70 µg/√Hz, one-sided.
    "ICM-42688-P": {
        "gyro": (2.8e-3 * DEG / math.sqrt(2.0), None),
        "accel": (70e-6 * G0 / math.sqrt(2.0), None),
    },
    # 3.8 mdps/√Hz and 70 µg/√Hz, one-sided.
    "LSM6DSO": {
        "gyro": (3.8e-3 * DEG / math.sqrt(2.0), None),
        "accel": (70e-6 * G0 / math.sqrt(2.0), None),
    },
    # 0.01 °/s/√Hz, one-sided, and 10 °/h; 60 µg/√Hz, one-sided, and 15 µg.
    "MTi-300": {
        "gyro": (0.01 * DEG / math.sqrt(2.0), 10.0 * DEG / 3600.0 / LEAST),
        "accel": (60e-6 * G0 / math.sqrt(2.0), 15e-6 * G0 / LEAST),
    },
    # 0.15 °/√h and 0.3 °/h; 0.024 m/s/√h and 0.005 mg.
    "STIM300": {
        "gyro": (0.15 * DEG / 60.0, 0.3 * DEG / 3600.0 / LEAST),
        "accel": (0.024 / 60.0, 0.005e-3 * G0 / LEAST),
    },
    # 0.0035 °/s/√Hz, two-sided, and 10 °/h; 0.14 mg/√Hz, two-sided, and 0.04 mg.
    "VN-100": {
        "gyro": (0.0035 * DEG, 10.0 * DEG / 3600.0 / LEAST),
        "accel": (0.14e-3 * G0, 0.04e-3 * G0 / LEAST),
    },
}
MAKERS = {
    *("Analog Devices", "Bosch Sensortec", "Honeywell", "InvenSense", "Movella", "Sensonor"),
    *("STMicroelectronics", "TDK InvenSense", "VectorNav", "Xsens"),
}


def coefficient(model, name):
    return float(model.values[name]) if name in model.values else None


@pytest.mark.parametrize("name", BY_HAND)
def test_coefficients_are_those_by_hand(name):
    found = aj.datasheet(name)
    assert set(found.models) == set(BY_HAND[name])
    for sensor, (N, B) in BY_HAND[name].items():
        assert coefficient(found[sensor], "angle_random_walk") == pytest.approx(N, rel=1e-5)
        assert coefficient(found[sensor], "bias_instability") == (B and pytest.approx(B, rel=1e-5))


@pytest.mark.parametrize("name", aj.datasheets())
def test_every_sheet_has_source_and_conditions(name):
    found = aj.datasheet(name)
    assert found.name == name
    maker, _, document = found.source.partition(", ")
    assert maker in MAKERS
    assert document
    for sensor in found.models:
        assert f"{sensor}: {sheets()[name][sensor]['conditions']}" in found.statements


# What the sheets print as rms noise beside the density: number in SI, and its bandwidth in Hz.
RMS = [
    ("BMI088", "gyro", 0.1 * DEG, 47.0),
    ("BMI270", "accel", 1.51e-3 * G0, 80.0),
    ("ICM-20602", "gyro", 0.04 * DEG, 100.0),
    ("ICM-20602", "accel", 1.0e-3 * G0, 100.0),
    ("ICM-42688-P", "gyro", 0.028 * DEG, 100.0),
    ("ICM-42688-P", "accel", 0.70e-3 * G0, 100.0),
    ("MPU-6050", "gyro", 0.05 * DEG, 100.0),
    ("MPU-9250", "gyro", 0.1 * DEG, 92.0),
]


@pytest.mark.parametrize(("name", "sensor", "rms", "bandwidth"), RMS)
def test_densities_are_one_sided_by_the_rms_of_the_sheet(name, sensor, rms, bandwidth):
    """White noise of two-sided density N² has 2N² times the bandwidth.

    Were the densities two-sided, these would differ by 41 %; figures of one digit do by some per cent.
    """
    N = coefficient(aj.datasheet(name)[sensor], "angle_random_walk")
    assert N * math.sqrt(2.0 * bandwidth) == pytest.approx(rms, rel=0.06)


@pytest.mark.parametrize("name", ["ADIS16470", "ISM330DHCX"])
def test_densities_are_one_sided_by_the_random_walk_of_the_sheet(name):
    gyro = dict(sheets()[name]["gyro"])
    walk = coefficient(aj.datasheet({"gyro": gyro})["gyro"], "angle_random_walk")
    del gyro["random_walk"]
    density = coefficient(aj.datasheet({"gyro": gyro})["gyro"], "angle_random_walk")
    assert density == pytest.approx(walk, rel=0.02)


def test_names_are_found_however_they_are_written():
    for text in ("ICM-42688-P", "icm42688p", "ICM 42688-P"):
        assert aj.datasheet(text).name == "ICM-42688-P"
    assert list(aj.datasheets()) == sorted(aj.datasheets(), key=str.casefold)


def test_unknown_names_and_files(tmp_path, monkeypatch):
    with pytest.raises(AllanjaxError, match=r"did you mean BMI088\? there are ADIS16448, .*, VN-100"):
        aj.datasheet("BMI88")
    with pytest.raises(AllanjaxError, match=r"no known data sheet and no file: there are ADIS16448"):
        aj.datasheet("xyz")
    # A path is a file, and a name with a suffix is that of one.
    monkeypatch.chdir(tmp_path)
    with pytest.raises(AllanjaxError, match="give a file of TOML"):
        aj.datasheet(Path("BMI088"))
    with pytest.raises(AllanjaxError, match="give a file of TOML"):
        aj.datasheet("bmi088.toml")
    Path("mine").write_text("[gyro]\nrandom_walk = '0.1 deg/√h'\n", encoding="utf-8")
    assert list(aj.datasheet("mine").models) == ["gyro"]


def test_convert_has_the_sheets():
    done = run("convert", "--sheet", "stim300")
    assert done.exit_code == 0, done.stderr
    assert "0.150 deg/√h" in done.stdout
    assert "source: Sensonor, STIM300 data sheet" in done.stdout
    listed = run("convert", "--list").stdout.splitlines()
    assert [line.split()[0] for line in listed] == list(aj.datasheets())
    unknown = run("convert", "--sheet", "BMI88")
    assert unknown.exit_code == 1
    assert "did you mean BMI088?" in unknown.stderr
