"""The command `allanjax calibrate`."""

import json

import numpy as np
import pytest
from commands import run

pytestmark = pytest.mark.usefixtures("elsewhere")


@pytest.fixture
def files(tmp_path):
    """Two recordings of an accelerometer, up and down: bias 0.05 m/s², scale 1.001."""
    rng, paths = np.random.default_rng(1), []
    for name, sign in (("up", 1.0), ("down", -1.0)):
        samples = 0.05 + sign * 1.001 * 9.81 + 1e-3 * rng.standard_normal(1000)
        paths.append(tmp_path / f"{name}.csv")
        paths[-1].write_text("accel_z [m/s^2]\n" + "\n".join(f"{x:.9f}" for x in samples) + "\n")
    return paths


def test_names_of_files_tell_orientations(files, tmp_path):
    found = run("calibrate", *files, "--rate", 20, "--gravity", 9.81, "--out", tmp_path / "out")
    assert found.exit_code == 0, found.stderr
    assert "scale factor" in found.stdout
    document = json.loads((tmp_path / "out" / "calibration.json").read_text(encoding="utf-8"))
    # 1e-3/√1000 m/s² a mean: 3e-5, of 9.81 m/s² 3 ppm.
    assert document["sensors"]["accel"]["M"][2][2] == pytest.approx(1.001, abs=2e-5)
    assert document["sensors"]["accel"]["b"][2] == pytest.approx(0.05, abs=2e-4)
    assert (tmp_path / "out" / "calibration.png").exists()


def test_positions_are_given_with_their_orientation(files, tmp_path):
    up, down = (path.rename(tmp_path / f"{k}.csv") for k, path in enumerate(files))
    words = ("--position", f"z+={up}", "--position", f"z down={down}", "--starts", "0,100", "--json")
    found = run("calibrate", *words, "--rate", 20, "--latitude", 51)
    assert found.exit_code == 0, found.stderr
    document = json.loads(found.stdout)
    assert [p["start_s"] for p in document["positions"]] == [0.0, 100.0]
    assert document["gravity_m_s2"] == pytest.approx(9.8116, abs=1e-4)
    assert not (tmp_path / "allanjax-results").exists()


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        ((), 2, "give recordings"),
        (("--position", "file.csv"), 1, "write an orientation and a file"),
        (("none_up.csv", "--gravity", 9.81), 1, "none_up.csv: no such file"),
    ],
)
def test_what_is_wrong_is_said(words, code, said):
    found = run("calibrate", *words)
    assert found.exit_code == code
    assert said in " ".join(found.stderr.replace("│", " ").split())
