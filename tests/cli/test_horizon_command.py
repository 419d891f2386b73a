"""The command `allanjax horizon`."""

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


def test_a_file_that_there_is_not_is_an_error(tmp_path):
    found = run("horizon", tmp_path / "none.json", "--horizon", 10)
    assert found.exit_code == 1
    assert "no such file" in found.stderr
