"""Coefficients from the figures of data sheets, by hand; sheets and presets that come with the package."""

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from commands import run, schema
from noise_terms import finite
from refusals import refuses

import allanjax as aj

DEG, HOUR, G0 = math.pi / 180.0, 3600.0, 9.80665
ARCSEC = DEG / HOUR
# Least Allan deviation of flicker noise over B, √(2 ln 2/π).
LEAST = 0.664283
# The front page of the ADIS16470's data sheet.
ADIS16470 = """
name = "ADIS16470"
source = "Analog Devices, front page"
[gyro]
noise_density = "0.008 °/sec/√Hz rms"
sided = "one"
in_run_bias_instability = "8 °/hr"
reading = "minimum"
[accel]
in_run_bias_instability = "13 μg"
reading = "minimum"
"""
WALK, BIAS = "angle_random_walk", "bias_instability"
RMS_NOISE = {"rms_noise": "0.05 deg/s rms", "bandwidth": "30 Hz"}
FIGURES = [
    ({"random_walk": "0.34 deg/√h"}, {WALK: 0.34 * DEG / 60}),
    ({"noise_density": "0.1 deg/s/√Hz", "sided": "one"}, {WALK: 0.1 * DEG / math.sqrt(2)}),
    ({"noise_density": "0.1 deg/s/√Hz rms", "sided": "two"}, {WALK: 0.1 * DEG}),
    ({"in_run_bias_instability": "8 deg/h", "reading": "minimum"}, {BIAS: 8 * DEG / HOUR / LEAST}),
    ({"in_run_bias_instability": "8 deg/h", "reading": "B"}, {BIAS: 8 * DEG / HOUR}),
    ({"rate_random_walk": "2 deg/h/√h"}, {"rate_random_walk": 2 * DEG / HOUR / 60}),
    ({"lsb": "0.1 arcsec"}, {"quantization": 0.1 * ARCSEC / math.sqrt(12)}),
    # The integral of the two-sided density N² times the filter's power response.
    (RMS_NOISE | {"bandwidth_is": "first-order"}, {WALK: 0.05 * DEG / math.sqrt(math.pi * 30.0)}),
    (RMS_NOISE | {"bandwidth_is": "noise"}, {WALK: 0.05 * DEG / math.sqrt(60.0)}),
    # Steps q of a rate f are white noise of the variance q²/12, N²·f.
    *(
        ({"lsb": step, "rate": "0.2 kHz"}, {WALK: 0.02 * DEG / math.sqrt(12 * 200)})
        for step in ("0.02 deg/s", "20 mdps/LSB", "50 LSB/(deg/s)", "50 LSB/dps")
    ),
]  # fmt: skip


def test_figures_are_converted_with_assumptions_and_differences_stated():
    for figures, expected in FIGURES:
        assert finite(aj.datasheet({"gyro": figures})["gyro"]) == pytest.approx(expected, rel=1e-5)
    figures = {"random_walk": "0.34 deg/√h", "noise_density": "0.008 deg/s/√Hz", "sided": "two"}
    figures |= {"lsb": "0.1 deg/s", "rate": "2000 Hz", "conditions": "at 25 °C"}
    found = aj.datasheet({"gyro": figures})
    assert finite(found["gyro"])[WALK] == pytest.approx(0.34 * DEG / 60)
    told = "\n".join(found.statements)
    # 0.008·60/0.34, and the share of the steps' power in N².
    share = (0.1 / math.sqrt(12 * 2000) * 60 / 0.34) ** 2
    for words in ("gyro: at 25 °C", f"density would give {0.008 * 60 / 0.34:.2f} ", f"{100 * share:.2g} %"):
        assert words in told
    rms = aj.datasheet({"gyro": RMS_NOISE | {"bandwidth_is": "first-order"}})
    assert f"{30 * math.pi / 2:.4g} Hz" in rms.statements[0]


OPEN = [
    ({"noise_density": "1 deg/s/√Hz"}, "sided"), ({"noise_density": "1 deg/s/√Hz", "sided": "both"}, "both"),
    ({"noise_density": "1 deg/√h", "sided": "one"}, "random_walk"),
    ({"random_walk": "1 deg/s/√Hz"}, "noise_density"), ({"in_run_bias_instability": "1 deg/h"}, "reading"),
    ({"rms_noise": "1 deg/s"}, "bandwidth"), ({"rms_noise": "1 deg/s", "bandwidth": "9 Hz"}, "bandwidth_is"),
    ({"lsb": "0.1 deg/s"}, "rate"), ({"random_walk": 0.1}, "random_walk"),
    ({"random_walk": "-1 deg/√h"}, "positive"), ({"random_walk": "12"}, "with its unit"),
    ({"random_walk": "0 deg/√h"}, "positive"),
    ({"arw": "0.1 deg/√h"}, "arw"), ({}, "no figure"), ("0.1 deg/√h", "not a table"),
]  # fmt: skip
WRONG_UNITS = [
    ({"random_walk": "0.1 deg/h"}, "deg/h"), ({"random_walk": "0.1 m/s/√h"}, "accelerometer"),
    ({"lsb": "0.1 mg"}, "mg"), ({"noise_density": "0.1 foo", "sided": "one"}, "foo"),
]  # fmt: skip


def test_what_is_left_open_is_asked_for():
    for error, table in ((aj.AllanjaxError, OPEN), (aj.UnitError, WRONG_UNITS)):
        for figures, word in table:
            with pytest.raises(error, match=word) as caught:
                aj.datasheet({"gyro": figures})
            assert "[gyro]" in str(caught.value)


def test_files_and_names(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("sheet.toml").write_text(ADIS16470, encoding="utf-8")
    Path("bad.toml").write_text("[gyro\n")
    Path("mine").write_text("[gyro]\nrandom_walk = '0.1 deg/√h'\n", encoding="utf-8")
    found = aj.datasheet("sheet.toml")
    named = ("ADIS16470", "Analog Devices, front page", "gyro", "accel")
    assert (found.name, found.source, *found.models) == named
    assert finite(found["accel"]) == pytest.approx({"bias_instability": 13e-6 * G0 / LEAST}, rel=1e-5)
    assert list(aj.datasheet("mine").models) == ["gyro"]
    for text in ("ICM-42688-P", "icm42688p", "ICM 42688-P"):
        assert aj.datasheet(text).name == "ICM-42688-P"
    refused = {"bad.toml": "TOML", "none.toml": "none.toml", "bmi088.toml": "TOML", "BMI88": "BMI088"}
    refused |= {"xyz": "xyz", Path("BMI088"): "TOML"}
    for name, word in [*refused.items(), ({"gyros": {}}, "gyros"), ({}, "no sensor")]:
        refuses(word, aj.datasheet, name)
    with pytest.raises(aj.AllanjaxError, match="mag"):
        found["mag"]


# N and B of gyro and accelerometer as printed: a walk in deg/√h, or a one- or two-sided density in deg/s/√Hz,
# and deg/h; m/s/√h, or g/√Hz, and g.
SHEETS = {
    "ADIS16448": ((0.66, "w", 14.5), (0.11, "w", 0.25e-3)),
    "ADIS16470": ((0.34, "w", 8.0), (0.037, "w", 13e-6)), "BMI088": ((0.014, "1", None), (190e-6, "1", None)),
    "BMI160": ((0.007, "1", None), (180e-6, "1", None)),
    "HG4930-CA51": ((0.04, "w", 0.25), (0.03, "w", 0.025e-3)),
    "ICM-42688-P": ((2.8e-3, "1", None), (70e-6, "1", None)),
    "LSM6DSO": ((3.8e-3, "1", None), (70e-6, "1", None)), "MTi-300": ((0.01, "1", 10.0), (60e-6, "1", 15e-6)),
    "STIM300": ((0.15, "w", 0.3), (0.024, "w", 0.005e-3)),
    "VN-100": ((0.0035, "2", 10.0), (0.14e-3, "2", 0.04e-3)),
}  # fmt: skip
# Their N that follows from the rms noise printed beside it, in a bandwidth of 80 and 100 Hz, 2N² times that:
# a two-sided density would differ by 41 %, figures of one digit do by some per cent.
RMS = {("BMI270", "accel"): 1.51e-3 * G0 / math.sqrt(160), ("ICM-20602", "gyro"): 0.04 * DEG / math.sqrt(200)}


def test_sheets_are_those_by_hand_and_have_a_source():
    scales = {"w": (DEG / 60, 1 / 60), "1": (DEG / math.sqrt(2), G0 / math.sqrt(2)), "2": (DEG, G0)}
    for name, printed in SHEETS.items():
        for k, (N, kind, B) in enumerate(printed):
            expected = {WALK: N * scales[kind][k]}
            if B is not None:
                expected[BIAS] = B * (DEG / HOUR, G0)[k] / LEAST
            found = aj.datasheet(name)[("gyro", "accel")[k]]
            assert finite(found) == pytest.approx(expected, rel=1e-5), name
    for (name, sensor), N in RMS.items():
        assert finite(aj.datasheet(name)[sensor])[WALK] == pytest.approx(N, rel=0.06)
    assert list(aj.datasheets()) == sorted(aj.datasheets(), key=str.casefold)
    for found in map(aj.datasheet, aj.datasheets()):
        assert found.source
        assert {s.partition(":")[0] for s in found.statements} == set(found.models)


def test_convert_units_and_sheets(tmp_path):
    one, two = run("convert", 0.003, "deg/s/√Hz", "--to", "deg/√h").stdout.splitlines()
    assert f"= {0.18 / math.sqrt(2.0):.6g} deg/√h" in one
    assert "= 0.18 deg/√h" in two
    assert "3600 deg/h = 1 deg/s" in run("convert", 3600, "deg/h", "--to", "deg/s").stdout
    two_sided = run("convert", 200, "µg/√Hz", "--to", "m/s/√h", "--sided", "two").stdout
    assert f"= {200e-6 * G0 * 60.0:.6g} m/s/√h" in two_sided
    one_sided = run("convert", 0.18, "deg/rt-hr", "--to", "dps/sqrt(Hz)", "--sided", "one").stdout
    assert f"= {0.003 * math.sqrt(2.0):.6g} dps/sqrt(Hz)" in one_sided
    squares = run("convert", 2, "(deg/h)²/Hz", "--to", "deg²/h", "--sided", "one").stdout
    assert f"= {1.0 / 3600.0:.6g} deg²/h" in squares
    sheet = tmp_path / "adis16470.toml"
    sheet.write_text(ADIS16470, encoding="utf-8")
    walk = json.loads(run("convert", "--sheet", sheet, "--json").stdout)["coefficients"][0]
    assert (walk["sensor"], walk["coefficient"], walk["unit"]) == ("gyro", WALK, "deg/√h")
    assert [walk["value"], walk["si"]] == pytest.approx([0.008 * x / math.sqrt(2.0) for x in (60.0, DEG)])
    assert re.search(r"deg/√h.*\n─+\ngyro +0\.150 ", run("convert", "--sheet", "stim300").stdout)
    for words in ((3, "mdps/√Hz", "--to", "µg"), (3, "foo", "--to", "g"), ("--sheet", "BMI88")):
        assert run("convert", *words).exit_code == 1
    for words in ([], [3], [3, "g"], ["--sheet", "a.toml", "--to", "g"], [3, "g", "--json"]):
        assert run("convert", *words).exit_code == 2


def test_a_sheet_goes_where_a_fit_goes(elsewhere):
    """Of white noise, with a bias averaged over C: √(N²·t·(1 + t/C)), Allan deviation N/√T, rms N·√rate."""
    sheet = aj.datasheet("BMI088")
    N = {"gyro": 0.014 * DEG / math.sqrt(2), "accel": 190e-6 * G0 / math.sqrt(2)}
    words = ("export", "--sheet", "bmi088", "--to", "kalibr")
    text, done = aj.export(sheet, "kalibr"), run(*words)
    assert done.stdout == text
    assert "K of the gyro is not given" in done.stderr
    values = [float(value) for value in re.findall(r"^\w+_noise_density: (.*)$", text, re.M)]
    assert values == pytest.approx([*N.values()], rel=1e-5)
    assert "update_rate: 200" in run(*words, "--rate", 200).stdout
    grown = aj.navigate(sheet, [100.0], at_rest=600.0)
    assert grown["attitude"].of("down")[0] == pytest.approx(N["gyro"] * math.sqrt(100 + 100**2 / 600))
    found, samples = aj.horizon(sheet, 10.0), aj.simulate_recording(sheet, 20_000, 100.0, 0)
    assert "K not given" in str(found)
    assert set(grown["position"].bounds) == {"north", "east", "down"}
    # N alone bounds no error and has no drift, so that there is no K for a filter.
    assert np.isnan([found["gyro"].walk.value, found["gyro"].bounding_white, found["gyro"].raw_walk]).all()
    assert re.search(r"equal +0\.59\d +not given +≥ ", str(found))
    document = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    schema("horizon").validate(document)
    assert [axis["not_given"] for axis in document["axes"]] == [["B", "K"]] * 2
    aligned = aj.align(sheet, 51.0)["gyro"]
    assert aligned.is_bound
    assert np.isnan(aligned.best_time)
    assert "still falls" not in aligned.verdict
    figure = aj.plot_allan(sheet)
    for sensor, panel in zip(N, (ax for ax in figure.axes if ax.get_title("left")), strict=True):
        assert found[sensor].error[-1] == pytest.approx(N[sensor] * math.sqrt(10.0), rel=0.01)
        assert np.std(samples[f"{sensor}_z"].values) == pytest.approx(10.0 * N[sensor], rel=0.025)
        line = next(line for line in panel.get_lines() if line.get_label() == "model")
        scale = {"gyro": DEG / HOUR, "accel": 1e-6 * G0}[sensor]
        assert line.get_linestyle() == ":"
        assert line.get_ydata() == pytest.approx(N[sensor] / scale / np.sqrt(line.get_xdata()))
    Path("own.toml").write_text(ADIS16470, encoding="utf-8")
    commands = ["export own.toml --to vins-mono --rate 200", "horizon own.toml --horizon 10"]
    commands += ["navigate own.toml --latitude 51", "simulate --sheet BMI088 --duration 1 --out a.csv"]
    done = [run(*words.split()) for words in commands]
    assert [one.exit_code for one in done] == [0, 0, 0, 0]
    assert "gyro: without B and K, not given by the data sheet" in done[3].stderr
    for name, near in (("BMI", "BMI088 or BMI160"), ("ADIS16495", "ADIS16495-1?")):
        refuses(re.escape(f"did you mean {near}"), aj.datasheet, name)


UNITS = {"arcsec": ARCSEC, "deg/√h": DEG / 60, "deg/h": DEG / HOUR, "m/s/√h": 1 / 60}
UNITS |= {"m/h": 1 / HOUR, "m/s/h": 1 / HOUR, "m/s/h/√h": 1 / HOUR / 60, "m/s/h²": 1 / HOUR**2}
# Sensor and its rate, coefficient and its unit; the values of x, y and z, and their errors.
TABLES = """
cimu gyro 200 quantization arcsec 0.9732 0.5174 0.5770 0.0738 0.0197 0.0155
cimu gyro 200 angle_random_walk deg/√h 0.0015 0.0019 0.0018 0.0005 0.0006 0.0006
cimu accel 200 quantization m/h 1.6801 1.2980 0.8785 0.1275 0.0985 0.0666
cimu accel 200 drift_ramp m/s/h² 2.6364 0.8915 0.3915 0.8795 0.2974 0.1309
hg1700 gyro 100 quantization arcsec 5.1154 1.2742 1.2316 0.0683 0.0032 0.0028
hg1700 gyro 100 angle_random_walk deg/√h 0.0936 0.0883 0.0753 0.0312 0.0295 0.0251
hg1700 accel 100 quantization m/h 2.1188 2.1988 2.1845 0.0673 0.1176 0.0583
hg1700 accel 100 rate_random_walk m/s/h/√h 0.7637 1.1572 3.3514 0.2548 0.3860 1.1180
motionpak2 gyro 100 angle_random_walk deg/√h 0.5121 0.4859 0.4891 0.0068 0.0065 0.0065
motionpak2 gyro 100 bias_instability deg/h 13.58 11.69 16.79 1.36 1.17 1.68
motionpak2 accel 1000 angle_random_walk m/s/√h 0.01664 0.01593 0.01612 3e-5 3e-5 3e-5
motionpak2 accel 1000 bias_instability m/s/h 4.36 4.09 4.36 0.04 0.08 0.08
"""


def test_presets_are_the_tables():
    seen = set()
    for name, sensor, rate, label, unit, *numbers in map(str.split, TABLES.strip().splitlines()):
        for axis, value, error in zip("xyz", numbers[:3], numbers[3:], strict=True):
            own = f"{sensor}_{axis}"
            preset = aj.SENSORS[name][own]
            assert preset.rate == float(rate)
            printed = {term.name(): found for term, found in preset.coefficients.items()}[label]
            assert (printed.unit, printed.error) == (unit, float(error))
            in_si = finite(preset.model)[label]
            assert in_si == pytest.approx(float(value) * UNITS[unit], rel=1e-12)
            seen.add((name, own, label))
    every = [(name, axis.name, axis.model) for name, p in aj.SENSORS.items() for axis in p.axes]
    assert seen == {(name, axis, label) for name, axis, model in every for label in finite(model)}
