"""The command `allanjax kalman`."""

import json

import numpy as np
import pandas as pd
import pytest
from commands import run

import allanjax as aj

pytestmark = pytest.mark.usefixtures("elsewhere")
MODEL = "N=0.1 deg/√h + K=1 deg/h/√h"


@pytest.fixture(scope="module")
def still(tmp_path_factory):
    """A gyro at rest, with a bias of 5 deg/h."""
    path = tmp_path_factory.mktemp("still") / "still.csv"
    hourly = np.pi / 180.0 / 3600.0
    recording = aj.simulate_recording({"gyro_x": MODEL}, 2000, 10.0, 1, bias={"gyro_x": 5.0 * hourly})
    table = {"time [s]": np.arange(2000) / 10.0, "gyro_x [rad/s]": recording.values[:, 0]}
    pd.DataFrame(table).to_csv(path, index=False)
    return path


def test_table_picture_and_csv_are_those_of_the_filter(still, tmp_path):
    files = tmp_path / "a.png", tmp_path / "a.csv"
    found = run("kalman", still, "--terms", MODEL, "--smooth", "--out", files[0], "--out", files[1])
    assert found.exit_code == 0, found.stderr
    expected = aj.kalman_filter(still, MODEL, smooth=True)
    told = [line.rstrip() for line in found.stdout.splitlines()]
    assert told[:-1] == [line.rstrip() for line in str(expected).splitlines()]
    assert files[0].stat().st_size > 1000
    table = pd.read_csv(files[1])
    np.testing.assert_allclose(table["bias"], expected["gyro_x"].bias, rtol=1e-12)


def test_the_model_may_be_that_of_a_fit(still, tmp_path):
    fit = aj.fit(still, "N + K", as_is=True)
    aj.write_json(fit, tmp_path / "fit.json")
    found = run("kalman", still, "--fit", tmp_path / "fit.json", "--json")
    (axis,) = json.loads(found.stdout)["axes"]
    expected = aj.kalman_filter(still, fit)["gyro_x"]
    assert axis["log_likelihood"] == pytest.approx(expected.log_likelihood, rel=1e-9)
    assert axis["nis"]["p_value"] == pytest.approx(expected.nis.p_value, rel=1e-6)
    assert axis["samples"] == 2000


def test_it_takes_one_model(still):
    found = run("kalman", still)
    assert found.exit_code == 1
    assert "give --fit RESULT.json or --terms" in found.stderr


def test_wavelet_variances_can_be_fitted(still):
    found = run("characterize", still, "--terms", "N + K", "--objective", "wavelet", "--as-is", "--json")
    assert found.exit_code == 0, found.stderr
    (fit,) = json.loads(found.stdout)["fits"]
    assert fit["objective"] == "wavelet"
    # Of 2,000 samples N is known to 2 %; in deg/√h.
    (N,) = (c for c in fit["axes"][0]["coefficients"] if c["label"] == "angle_random_walk")
    assert N["value"] == pytest.approx(0.1, rel=0.1)
