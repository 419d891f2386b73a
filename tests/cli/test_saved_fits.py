"""Commands that need no recording, or a fit that was saved: their numbers are those of the functions."""

import json
import math
from pathlib import Path

import bench
import numpy as np
import pandas as pd
import pytest
from commands import run, schema
from turned_sensors import at_rest

import allanjax as aj

pytestmark = pytest.mark.usefixtures("elsewhere")
DEG = np.pi / 180.0


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "small.json"
    aj.write_json(bench.fit("small"), path)
    return path


def ran(*words):
    done = run(*words)
    assert done.exit_code == 0, done.stderr
    return done.stdout


def plain(document):
    return json.loads(json.dumps(document))


def lines_of(text):
    return [line.rstrip() for line in str(text).strip().splitlines()]


@pytest.mark.parametrize("process", ["walk", "markov"])
def test_horizon(saved, process):
    words = f"horizon {saved} --horizon 10 --axis accel_z --probability 0.9 --process {process}".split()
    expected = aj.horizon(aj.load(saved), 10.0, axes="accel_z", process=process, probability=0.9)
    assert lines_of(ran(*words)) == lines_of(expected)
    document = json.loads(ran(*words, "--json"))
    schema("horizon").validate(document)
    (axis,), result = document["axes"], expected["accel_z"]
    assert (document["process"], document["horizon_s"], document["probability"]) == (process, 10.0, 0.9)
    for c, told in ((result.white, axis["white"]["si"]), (result.walk, axis["walk"]["si"])):
        numbers = [told["value"], told["std"], *told["interval_95"]]
        np.testing.assert_allclose(numbers, [c.value, c.std, *c.interval])
    # 1 m/s/√h is 1/60 m/s/√s.
    assert axis["white"]["unit"] == "m/s/√h"
    assert axis["white"]["value"] == pytest.approx(60.0 * result.white.value)
    assert (axis["correlation_time"] is None) == (process == "walk")
    assert axis["curves_si"]["error"] == result.error.tolist()


def test_navigate(saved):
    words = ("navigate", saved, "--latitude", 51, "--azimuth", "0.1deg", "--time", 1, "--time", 10)
    words += ("--calibration", 50, "--gyro-bias", "2 deg/h", "--accel-bias", "1 mg")
    biases = {"gyro_bias": "2 deg/h", "accel_bias": "1 mg"}
    fit = aj.load(saved)
    tables = [aj.navigate(fit, [1, 10], calibration=50, **biases), aj.align(fit, 51, "0.1 deg", **biases)]
    assert lines_of(ran(*words, "--out", "a.png"))[:-1] == lines_of("\n".join(map(str, tables)))
    assert Path("a.png").exists()
    document = json.loads(ran(*words, "--json", "--schuler"))
    expected = aj.navigate(fit, [1, 10], calibration=50, schuler=True, **biases)
    assert document["navigation"] == plain(expected.to_dict())
    assert document["alignment"] == plain(tables[1].to_dict())


def test_statespace(saved):
    words = f"statespace {saved} --axis gyro_y --rate 20 --duration 50 -o file --format".split()
    expected = aj.load(saved)["gyro_y"].model.state_space(20.0, duration=50.0)
    for form, text in (("matlab", expected.to_matlab()), ("c", expected.to_c_header())):
        assert "at 20 Hz" in ran(*words, form)
        assert Path("file").read_text(encoding="utf-8") == text
    ran(*words, "npz")
    with np.load("file") as file:
        for name in ("A", "Q", "H", "R", "P0"):
            np.testing.assert_allclose(file[name], getattr(expected, name))


def test_kalman_with_a_fit_and_files(saved):
    recording, fit = bench.recording("small").between(0.0, 20.48), aj.load(saved)
    aj.write(recording, "a.parquet")
    told = ran("kalman", "a.parquet", "--fit", saved, "--smooth", "--out", "a.png", "--out", "a.csv")
    expected = aj.kalman_filter(recording, fit, smooth=True)
    assert lines_of(told)[1:-1] == lines_of(expected)[1:]
    assert Path("a.png").exists()
    for name, rows in pd.read_csv("a.csv").groupby("axis"):
        np.testing.assert_allclose(rows["bias"], expected[name].bias, rtol=1e-9)
    (axis, *_) = json.loads(ran("kalman", "a.parquet", "--fit", saved, "--json"))["axes"]
    filtered = aj.kalman_filter(recording, fit)["gyro_x"]
    assert axis["log_likelihood"] == pytest.approx(filtered.log_likelihood, rel=1e-9)
    assert axis["nis"]["p_value"] == pytest.approx(filtered.nis.p_value, rel=1e-6)


def test_calibrate_by_names_of_files_and_by_options():
    for way, x in (("up", 0.05 + 1.001 * 9.81), ("down", 0.05 - 1.001 * 9.81)):
        values = at_rest([x], 64, 20.0, axes="z").values[:, 0]
        pd.DataFrame({"accel_z [m/s^2]": values}).to_csv(f"{way}.csv", index=False)
    aj.write_json(bench.fit("small"), "noise.json")
    common = ("--rate", 20, "--as-is", "--gravity", 9.81, "--fit", "noise.json")
    assert "scale factor" in ran("calibrate", "up.csv", "down.csv", *common, "--out", "out")
    sensor = json.loads(Path("out/calibration.json").read_text(encoding="utf-8"))["sensors"]["accel"]
    assert sensor["M"][2][2] == pytest.approx(1.001, abs=1e-6)
    assert sensor["b"][2] == pytest.approx(0.05, abs=1e-5)
    assert Path("out/calibration.png").exists()
    positions = ("--position", "z+=up.csv", "--position", "z down=down.csv", "--starts", "0,100", "--json")
    more = ("--latitude", 51, "--height", 100, "--orientation-error", 0.1, "--fit", "noise.json")
    document = json.loads(ran("calibrate", *positions, "--rate", 20, "--as-is", *more))
    options = {"latitude": 51.0, "height": 100.0, "starts": [0.0, 100.0], "orientation_error": 0.1 * DEG}
    files = {"z up": "up.csv", "z down": "down.csv"}
    expected = aj.calibrate(files, rate=20.0, as_is=True, fit=aj.load("noise.json"), **options).to_dict()
    for told, own in zip(document["parameters"], plain(expected)["parameters"], strict=True):
        assert told == pytest.approx(own, nan_ok=True)
    assert [p["start_s"] for p in document["positions"]] == [0.0, 100.0]
    assert document["gravity_m_s2"] == expected["gravity_m_s2"]


def test_simulate_terms_and_sensors():
    """0.3 deg/√h at 40 Hz: 2,048 samples scatter by 1.6 %; faster accelerometers have their own file."""
    words = ("simulate", "--rate", 40, "--duration", 51.2, "--seed", 7)
    assert "a.csv: gyro; 2,048 samples at 40 Hz" in ran(*words, "--terms", "N=0.3 deg/√h", "--out", "a.csv")
    recording = aj.read("a.csv")
    expected = aj.simulate_recording({"gyro": "N=0.3 deg/√h"}, 2048, 40.0, 7)
    np.testing.assert_allclose(recording.values, expected.values, rtol=1e-9)
    assert recording.values.std() == pytest.approx(0.3 * DEG / 60.0 * math.sqrt(40.0), rel=0.065)
    ran(*words, "--sensor", "accel", "--terms", "N=0.3 m/s/√h", "--out", "b.parquet")
    assert aj.read("b.parquet").names == ("accel",)
    assert "100 Hz, 1000 Hz" in ran("simulate", "--list")
    ran("simulate", "motionpak2", "--duration", "1", "--out", "m.npz")
    assert aj.read("m_1000Hz.npz").names == ("accel_x", "accel_y", "accel_z")
    assert aj.read("m_100Hz.npz").n == 100


CONVERTED = {"3600 deg/h --to deg/s": 1.0, "0.01 deg/s/√Hz --to deg/√h --sided two": 0.6}
CONVERTED["150 µg/√Hz --to m/s/√h"] = 150e-6 * 9.80665 * 60.0 / math.sqrt(2.0)


@pytest.mark.parametrize("words", CONVERTED)
def test_convert(words):
    source, target, *_ = ran("convert", *words.split()).replace("√", "").split(" = ")
    assert source.split()[0].replace(",", "") == words.split()[0]
    assert float(target.split()[0]) == pytest.approx(CONVERTED[words], rel=1e-5)


def test_documents_of_data_sheets_and_schemas():
    name = aj.datasheets()[0]
    assert name in ran("convert", "--list")
    document = json.loads(ran("convert", "--sheet", name, "--json"))
    assert document == plain(aj.datasheet(name).to_dict())
    for name in ("check", "fit", "critique", "fleet", "horizon"):
        schema(name)


@pytest.mark.notebook
def test_the_demo_finds_what_was_put_in():
    told = ran("demo")
    names = {path.name.removeprefix("demo").lstrip("_") for path in Path("allanjax-demo").iterdir()}
    assert names == {".csv", ".json", "allan.csv", "allan.png", "coefficients.csv", "psd.png"}
    assert told.count("inside") >= 26
    assert told.count("inside") + told.count("OUTSIDE") == 30
    means = aj.read("allanjax-demo/demo.csv").values.mean(axis=0)
    np.testing.assert_allclose(means, [0.0, 0.0, 0.0, 0.0, 0.0, 9.80665], atol=0.1)
    found = json.loads(Path("allanjax-demo/demo.json").read_text(encoding="utf-8"))
    walks = [c["value"] for axis in found["axes"] for c in axis["coefficients"] if c["symbol"] == "N"]
    np.testing.assert_allclose(walks, [0.20, 0.25, 0.15, 0.05, 0.06, 0.08], rtol=0.02)


@pytest.mark.parametrize(
    ("words", "code", "word"),
    [
        ("horizon none.json --horizon 10", 1, "none.json"),
        ("horizon small.json --horizon 10 --axis gyro_w", 1, "gyro_w"),
        ("navigate small.json --latitude 51 --gyro-bias 2", 1, "unit"),
        ("calibrate", 2, "recordings"),
        ("calibrate --position file.csv", 1, "orientation"),
        ("simulate --out a.csv", 2, "--terms"),
        ("simulate hg1701 --out a.csv", 2, "hg1700"),
        ("simulate --sensor accel --terms N=1deg/√h --out a.csv", 2, "gyro"),
        ("simulate --terms N=1deg/√h --out a.csv --duration nan", 2, "--duration"),
        ("convert 1 deg/h", 2, "--to"),
    ],
)
def test_what_is_wrong_is_said(saved, words, code, word):
    done = run(*words.split())
    assert done.exit_code == code
    assert word in " ".join(done.stderr.replace("│", " ").split())
