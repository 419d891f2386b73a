"""The command `allanjax navigate`."""

import json

import pytest
from commands import run

import allanjax as aj

pytestmark = pytest.mark.usefixtures("elsewhere")
OPTIONS = ("--latitude", 51, "--azimuth", "0.1deg", "--time", 1, "--time", 10, "--calibration", 50)


@pytest.fixture
def saved(small_fit, tmp_path):
    path = tmp_path / "small.json"
    aj.write_json(small_fit, path)
    return path


def test_tables_and_picture_are_those_of_the_fit(saved, tmp_path):
    found = run("navigate", saved, *OPTIONS, "--out", tmp_path / "a.png", "--gyro-bias", "2 deg/h")
    assert found.exit_code == 0, found.stderr
    fit, bias = aj.load(saved), {"gyro_bias": "2 deg/h"}
    tables = [aj.navigate(fit, [1, 10], calibration=50, **bias), aj.align(fit, 51, "0.1 deg", **bias)]
    told = found.stdout.splitlines()
    expected = "\n".join(map(str, tables)).splitlines()
    assert [line.rstrip() for line in told[:-1]] == [line.rstrip() for line in expected]
    assert (tmp_path / "a.png").stat().st_size > 1000


def test_json_has_both_results(saved):
    found = run("navigate", saved, *OPTIONS, "--json", "--schuler")
    document = json.loads(found.stdout)
    assert document["navigation"]["time_s"] == [1.0, 10.0]
    assert document["navigation"]["schuler"]
    assert document["alignment"]["axes"][0]["wanted"] == pytest.approx(0.1 * 3.14159265 / 180.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--latitude", 90), "no horizontal part"),
        (("--latitude", 51, "--gyro-bias", "2"), "a number and a unit"),
    ],
)
def test_what_is_wrong_is_said(saved, options, message):
    found = run("navigate", saved, *options)
    assert found.exit_code == 1
    assert message in found.stderr
