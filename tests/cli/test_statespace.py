"""The command `allanjax statespace`."""

import numpy as np
import pytest
from commands import run

import allanjax as aj

pytestmark = pytest.mark.usefixtures("elsewhere")


@pytest.fixture
def saved(small_fit, tmp_path):
    path = tmp_path / "small.json"
    aj.write_json(small_fit, path)
    return path


def test_the_matrices_are_those_of_the_fitted_model(saved, small_fit, tmp_path):
    found = run("statespace", saved, "--axis", "gyro_x", "-o", tmp_path / "x.npz")
    assert found.exit_code == 0, found.stderr
    assert "bias_instability_mean" in found.stdout
    with np.load(tmp_path / "x.npz") as file:
        # The mean of white noise of density N² over a sample interval.
        N = small_fit["gyro_x"]["N"].value
        assert file["R"][0, 0] == pytest.approx(N**2 * 100.0, rel=0.02)
        assert file["rate"] == 100.0


@pytest.mark.parametrize(("form", "begin"), [("matlab", "% x[k+1]"), ("c", "/* x[k+1]")])
def test_other_formats_rates_and_durations(saved, tmp_path, form, begin):
    out = tmp_path / "file"
    options = ("--rate", 20, "--duration", 50, "--format", form)
    found = run("statespace", saved, "--axis", "accel_z", *options, "-o", out)
    assert found.exit_code == 0, found.stderr
    assert out.read_text(encoding="utf-8").startswith(begin)
    assert "at 20 Hz" in found.stdout
    assert "m/s²" in found.stdout


def test_an_axis_that_there_is_not_is_an_error(saved, tmp_path):
    found = run("statespace", saved, "--axis", "gyro_w", "-o", tmp_path / "x.npz")
    assert found.exit_code == 1
    assert "no axis 'gyro_w'" in found.stderr
