"""The command `allanjax horizon`."""

import json

import jsonschema
import pytest
from commands import run

import allanjax as aj

pytestmark = pytest.mark.usefixtures("elsewhere")


def test_the_table_is_that_of_the_fit(small_fit, tmp_path):
    path = tmp_path / "small.json"
    aj.write_json(small_fit, path)
    found = run("horizon", path, "--horizon", 10, "--axis", "gyro_x", "--probability", 0.9)
    assert found.exit_code == 0, found.stderr
    assert (
        found.stdout.strip() == str(aj.horizon(aj.load(path), 10.0, axes="gyro_x", probability=0.9)).strip()
    )


@pytest.mark.parametrize("process", ["walk", "markov"])
def test_json_follows_the_schema_and_has_the_numbers(small_fit, tmp_path, process):
    path = tmp_path / "small.json"
    aj.write_json(small_fit, path)
    found = run("horizon", path, "--horizon", 10, "--axis", "accel_z", "--process", process, "--json")
    assert found.exit_code == 0, found.stderr
    document = json.loads(found.stdout)
    jsonschema.Draft202012Validator(json.loads(run("schema", "horizon").stdout)).validate(document)
    (axis,) = document["axes"]
    result = aj.horizon(aj.load(path), 10.0, axes="accel_z", process=process)["accel_z"]
    assert document["process"] == process
    assert axis["white"]["unit"] == "m/s/√h"
    assert axis["white"]["si"]["value"] == pytest.approx(result.white.value)
    # 1 m/s/√h is 1/60 m/s/√s.
    assert axis["white"]["value"] == pytest.approx(60.0 * result.white.value)
    assert (axis["correlation_time"] is None) == (process == "walk")
    assert axis["curves_si"]["error"] == result.error.tolist()


def test_a_file_that_there_is_not_is_an_error(tmp_path):
    found = run("horizon", tmp_path / "none.json", "--horizon", 10)
    assert found.exit_code == 1
    assert "no such file" in found.stderr
