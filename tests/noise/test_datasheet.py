"""Coefficients from the figures of data sheets."""

import json
import math

import numpy as np
import pytest
import scipy.integrate
import scipy.signal
from commands import run

import allanjax as aj
from allanjax.base.errors import AllanjaxError, UnitError
from allanjax.noise.datasheet import MINIMUM, datasheet

DEG = math.pi / 180.0
G0 = 9.80665
# The front page of the ADIS16470's data sheet; that a minimum of the Allan deviation is meant, and that the
# density is a one-sided one, is how Analog Devices explain such figures.
ADIS16470 = """
name = "ADIS16470"
source = "Analog Devices, data sheet ADIS16470, front page"

[gyro]
noise_density = "0.008 °/sec/√Hz rms"
sided = "one"
in_run_bias_instability = "8 °/hr"
reading = "minimum"

[accel]
in_run_bias_instability = "13 μg"
reading = "minimum"
"""


@pytest.fixture
def sheet(tmp_path):
    path = tmp_path / "adis16470.toml"
    path.write_text(ADIS16470, encoding="utf-8")
    return path


def gyro(**figures):
    return datasheet({"gyro": figures})["gyro"]


def test_a_sheet_from_a_file(sheet):
    found = aj.datasheet(sheet)
    assert (found.name, *found.models) == ("ADIS16470", "gyro", "accel")
    values = {label: float(value) for label, value in found["gyro"].values.items() if "cutoff" not in label}
    assert values == pytest.approx(
        {
            "angle_random_walk": 0.008 * DEG / math.sqrt(2.0),
            "bias_instability": 8.0 * DEG / 3600.0 / 0.66428,
        },
        rel=1e-5,
    )
    B = float(found["accel"].values["bias_instability"])
    assert pytest.approx(13e-6 * G0 / 0.66428, rel=1e-5) == B
    text = str(found)
    assert "0.339 deg/√h" in text
    assert "note: gyro: noise_density is taken as one-sided, √2·N" in text
    assert any("B is at most this" in line for line in found.statements)
    with pytest.raises(AllanjaxError, match="no 'mag'; it has gyro, accel"):
        found["mag"]


def test_one_sided_densities_are_those_of_a_spectrum_analyser():
    """Welch's estimate of SciPy is one-sided; its mean over 8000 levels is known to about 2 %."""
    model = gyro(noise_density="0.1 deg/s/√Hz", sided="one")
    x = np.asarray(aj.simulate(model, 100_000, 100.0, 1))
    f, density = scipy.signal.welch(x, 100.0, nperseg=1000)
    inside = (f > 1.0) & (f < 49.0)
    assert math.sqrt(density[inside].mean()) / DEG == pytest.approx(0.1, rel=0.03)
    two = gyro(noise_density="0.1 deg/s/√Hz", sided="two")
    assert float(two.values["angle_random_walk"]) == pytest.approx(0.1 * DEG)


@pytest.mark.parametrize("kind", ["first-order", "noise"])
def test_rms_noise_is_the_integral_of_the_density(kind):
    """Of the two-sided density N² times the filter's response, over all frequencies."""
    N = float(
        gyro(rms_noise="0.05 deg/s rms", bandwidth="30 Hz", bandwidth_is=kind).values["angle_random_walk"]
    )

    def response(f):
        return 1.0 / (1.0 + (f / 30.0) ** 2) if kind == "first-order" else float(abs(f) < 30.0)

    whole = 2.0 * sum(
        scipy.integrate.quad(response, *ends)[0] for ends in ((0.0, 30.0), (30.0, 1e3), (1e3, np.inf))
    )
    assert N * math.sqrt(whole) == pytest.approx(0.05 * DEG, rel=1e-5)


@pytest.mark.parametrize("reading", ["minimum", "B"])
def test_bias_instability_by_its_reading(reading):
    """The least Allan deviation of flicker noise without a cutoff is where clusters are long."""
    model = gyro(in_run_bias_instability="8 deg/h", reading=reading)
    time = np.geomspace(1.0, 1e6, 30)
    least = float(np.sqrt(np.asarray(model.sampled(1000.0).allan_variance(time))).min())
    expected = 8.0 if reading == "minimum" else 8.0 * 0.66428
    assert least / DEG * 3600.0 == pytest.approx(expected, rel=1e-4)
    assert pytest.approx(0.664, abs=5e-4) == MINIMUM


@pytest.mark.parametrize("lsb", ["0.02 deg/s", "20 mdps/LSB", "50 LSB/(deg/s)", "50 LSB/dps"])
def test_steps_of_rates_are_white_noise(lsb):
    """Rounding of noise that exceeds the step: its error is that of the model's N, to its own scatter."""
    model = gyro(lsb=lsb, rate="100 Hz")
    N = float(model.values["angle_random_walk"])
    x = np.random.default_rng(0).normal(0.0, 0.05, 100_000)
    error = (np.round(x / 0.02) * 0.02 - x) * DEG
    # σ/√(2n) = 0.2 % for a normal law, and less for a uniform one.
    assert N * math.sqrt(100.0) == pytest.approx(error.std(), rel=0.01)


def test_steps_of_increments_are_quantization_noise():
    model = gyro(lsb="0.1 arcsec", random_walk="0.01 deg/√h")
    assert float(model.values["quantization"]) == pytest.approx(0.1 * DEG / 3600.0 / math.sqrt(12.0))
    assert float(model.values["angle_random_walk"]) == pytest.approx(0.01 * DEG / 60.0)
    K = gyro(rate_random_walk="2 deg/h/√h").values["rate_random_walk"]
    assert float(K) == pytest.approx(2.0 * DEG / 3600.0 / 60.0)


def test_a_notebook_shows_source_and_assumptions():
    figures = {"noise_density": "0.007 deg/s/√Hz", "sided": "one"}
    told = datasheet({"source": "page <5>", "gyro": figures})._repr_html_()
    assert "source: page &lt;5&gt;" in told
    assert "taken as one-sided" in told


def test_what_figures_contradict_is_stated():
    found = datasheet(
        {
            "gyro": {
                "random_walk": "0.34 deg/√h",
                "noise_density": "0.008 deg/s/√Hz",
                "sided": "two",
                "lsb": "0.1 deg/s",
                "rate": "2000 Hz",
            }
        }
    )
    assert float(found["gyro"].values["angle_random_walk"]) == pytest.approx(0.34 * DEG / 60.0)
    assert "gyro: N is that of random_walk; noise_density gives 1.41 times as much" in found.statements
    share = (0.1 / math.sqrt(12.0 * 2000.0) * 60.0 / 0.34) ** 2
    said = f"gyro: steps make {100.0 * share:.2g} % of the power of N, and are not added to it"
    assert said in found.statements


@pytest.mark.parametrize(
    ("figures", "said"),
    [
        ({"noise_density": "1 deg/s/√Hz"}, 'noise_density needs sided = "one" or "two"'),
        ({"noise_density": "1 deg/s/√Hz", "sided": "both"}, "or \"two\", not 'both'"),
        ({"noise_density": "1 deg/√h", "sided": "one"}, "is not per √Hz"),
        ({"random_walk": "1 deg/s/√Hz"}, "is per √Hz: give it as noise_density"),
        ({"in_run_bias_instability": "1 deg/h"}, 'needs reading = "minimum" or "B"'),
        ({"rms_noise": "1 deg/s"}, 'needs bandwidth = e.g. "100 Hz"'),
        ({"rms_noise": "1 deg/s", "bandwidth": "9 Hz"}, 'needs bandwidth_is = "first-order" or "noise"'),
        ({"lsb": "0.1 deg/s"}, "lsb needs rate"),
        ({"random_walk": 0.1}, 'must be a positive number with its unit, as in "0.1 deg/s", not 0.1'),
        ({"random_walk": "-1 deg/√h"}, "must be a positive number"),
        ({"arw": "0.1 deg/√h"}, "unknown key 'arw'; there may be random_walk, noise_density"),
        ({}, "no figure"),
    ],
)
def test_what_is_left_open_is_asked_for(figures, said):
    with pytest.raises(AllanjaxError) as error:
        datasheet({"gyro": figures})
    assert str(error.value).startswith("data sheet: [gyro]")
    assert said in str(error.value)


@pytest.mark.parametrize(
    ("figures", "said"),
    [
        ({"random_walk": "0.1 deg/h"}, "[gyro] random_walk: cannot convert 'deg/h'"),
        ({"random_walk": "0.1 m/s/√h"}, "looks like a unit of an accelerometer"),
        ({"lsb": "0.1 mg"}, "'mg' is a unit of an accelerometer"),
        ({"noise_density": "0.1 foo", "sided": "one"}, "noise_density: unknown unit 'foo'"),
    ],
)
def test_units_that_do_not_fit(figures, said):
    with pytest.raises(UnitError) as error:
        datasheet({"gyro": figures})
    assert said in str(error.value)


def test_files_that_are_no_data_sheets(tmp_path):
    (tmp_path / "bad.toml").write_text("[gyro\n")
    with pytest.raises(AllanjaxError, match=r"bad.toml: .*; give a file of TOML"):
        datasheet(tmp_path / "bad.toml")
    with pytest.raises(AllanjaxError, match=r"none.toml: No such file"):
        datasheet(tmp_path / "none.toml")
    with pytest.raises(AllanjaxError, match=r"unknown key 'gyros'; there may be name, source, \[gyro\]"):
        datasheet({"gyros": {}})
    with pytest.raises(AllanjaxError, match="no sensor"):
        datasheet({"name": "x"})
    with pytest.raises(AllanjaxError, match="is no table"):
        datasheet({"gyro": "0.1 deg/√h"})


def test_convert_tells_both_densities():
    one, two = run("convert", 0.003, "deg/s/√Hz", "--to", "deg/√h").stdout.splitlines()
    assert one.startswith(f"0.003 deg/s/√Hz = {0.18 / math.sqrt(2.0):.6g} deg/√h if the density is one-sided")
    assert two.startswith("0.003 deg/s/√Hz = 0.18 deg/√h if it is two-sided")
    back = run("convert", 0.18, "deg/rt-hr", "--to", "dps/sqrt(Hz)", "--sided", "one").stdout
    assert back == f"0.18 deg/rt-hr = {0.003 * math.sqrt(2.0):.6g} dps/sqrt(Hz) (one-sided density)\n"
    squares = run("convert", 2, "(deg/h)²/Hz", "--to", "deg²/h", "--sided", "one").stdout
    assert squares.startswith(f"2 (deg/h)²/Hz = {1.0 / 3600.0:.6g} deg²/h")


@pytest.mark.parametrize(
    ("value", "unit", "to", "expected"),
    [
        (3.0, "mdps/√Hz", "deg/h/√Hz", 10.8),
        (3.0, "mdps/rt-Hz", "deg/s/root-Hz", 0.003),
        (150.0, "ug/sqrt(Hz)", "m/s²/√Hz", 150e-6 * G0),
        (2.0, "dph", "deg/s", 2.0 / 3600.0),
        (1.0, "m/s/√h", "µg·√s", 1e6 / 60.0 / G0),
    ],
)
def test_convert_by_units_alone(value, unit, to, expected):
    done = run("convert", value, unit, "--to", to)
    assert done.exit_code == 0, done.stderr
    assert done.stdout == f"{value:g} {unit} = {expected:.6g} {to}\n"


def test_convert_says_what_is_possible():
    done = run("convert", 3, "mdps/√Hz", "--to", "µg")
    assert done.exit_code == 1
    assert "possible are deg/√h, deg/s/√Hz, deg/h/√Hz, rad/√s" in done.stderr
    assert run("convert", 3, "foo", "--to", "g").exit_code == 1
    for words in ([], [3], [3, "g"], ["--sheet", "a.toml", "--to", "g"], [3, "g", "--to", "mg", "--json"]):
        assert run("convert", *words).exit_code == 2


def test_convert_a_sheet(sheet):
    done = run("convert", "--sheet", sheet)
    assert done.exit_code == 0, done.stderr
    assert "N angle random walk" in done.stdout
    document = json.loads(run("convert", "--sheet", sheet, "--json").stdout)
    walk = document["coefficients"][0]
    assert (walk["sensor"], walk["coefficient"], walk["unit"]) == ("gyro", "angle_random_walk", "deg/√h")
    assert walk["value"] == pytest.approx(0.008 * 60.0 / math.sqrt(2.0))
    sheet.write_text("[gyro]\nnoise_density = '1 deg/s/√Hz'\n", encoding="utf-8")
    refused = run("convert", "--sheet", sheet)
    assert refused.exit_code == 1
    assert "needs sided" in refused.stderr
