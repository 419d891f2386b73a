"""The command line."""

import json
import os
import subprocess
import sys
from importlib.resources import files
from pathlib import Path

import jsonschema
import numpy as np
import pandas as pd
import pytest
from commands import run

from allanjax.base.cache import enable_compilation_cache
from allanjax.record.io import read, write

pytestmark = pytest.mark.usefixtures("elsewhere")


@pytest.fixture
def recorded(small_recording, tmp_path):
    path = tmp_path / "small.csv"
    write(small_recording, path)
    return path


def names(folder):
    return sorted(path.name for path in Path(folder).iterdir())


RESULTS = ["small.json", "small_allan.csv", "small_allan.png", "small_coefficients.csv", "small_psd.png"]


def test_characterize_prints_the_table_and_writes_the_results(recorded, small_fit):
    result = run("characterize", recorded)
    assert result.exit_code == 0, result.stderr
    assert names("allanjax-results") == RESULTS
    written = json.loads(Path("allanjax-results/small.json").read_text(encoding="utf-8"))
    for axis in written["axes"]:
        for c in axis["coefficients"]:
            expected = small_fit[axis["name"]][c["label"]]
            assert c["detected"] == expected.detected
            if c["detected"]:
                assert c["si"]["value"] == pytest.approx(expected.value, rel=1e-5)
    walk = small_fit["gyro_x"]["angle_random_walk"].in_unit().describe()
    assert walk in result.stdout
    assert result.stdout.startswith("check: look: ")
    assert str(Path("allanjax-results") / "small_allan.png") in result.stdout
    assert result.stderr == ""


def test_the_spectrum_is_fitted_with_an_auxiliary_channel_taken_out(tmp_path):
    rng = np.random.default_rng(3)
    temperature = 25.0 + np.cumsum(rng.standard_normal(4000)) * 0.01
    values = 0.1 * rng.standard_normal(4000) + 0.05 * temperature
    table = {"gyro_x [rad/s]": values, "temperature": temperature}
    pd.DataFrame(table).to_csv(tmp_path / "warm.csv", index=False)
    options = ("--rate", "100", "--terms", "N", "--objective", "whittle", "--json")
    result = run("characterize", tmp_path / "warm.csv", *options, "--regressors", "temperature")
    assert result.exit_code == 0, result.stderr
    (fit,) = json.loads(result.stdout)["fits"]
    found = fit["axes"][0]["regression"]["temperature"]
    assert fit["objective"] == "whittle"
    # Four standard deviations, which white noise of 0.1 rad/s and the channel's own scatter determine.
    assert found["std"] == pytest.approx(0.1 / np.sqrt(4000) / temperature.std(), rel=0.1)
    assert abs(found["value"] - 0.05) < 4.0 * found["std"]
    refused = run("characterize", tmp_path / "warm.csv", *options, "--regressors", "pressure")
    assert refused.exit_code == 1
    assert "no auxiliary channel 'pressure'; it has temperature" in refused.stderr


def test_json_is_all_of_stdout_and_the_other_files_go_on(recorded):
    result = run("characterize", "missing.csv", recorded, "--json", "--stop", "200")
    document = json.loads(result.stdout)
    assert result.exit_code == 1
    assert document["schema_version"] == 1
    assert [entry["file"] for entry in document["fits"]] == [str(recorded)]
    assert [entry["file"] for entry in document["errors"]] == ["missing.csv"]
    assert "no such file" in document["errors"][0]["message"]
    assert "error: missing.csv: no such file" in result.stderr
    assert "1 of 2 files failed: missing.csv" in result.stderr
    assert not Path("allanjax-results").exists()
    schema = json.loads(files("allanjax.report").joinpath("fit.schema.json").read_text("utf-8"))
    fit = {key: value for key, value in document["fits"][0].items() if key != "file"}
    jsonschema.validate(fit, schema)


def test_files_of_one_name_do_not_overwrite_each_other(recorded, small_recording, tmp_path):
    (tmp_path / "other").mkdir()
    write(small_recording, tmp_path / "other" / "Small.npz")
    result = run("characterize", recorded, tmp_path / "other" / "Small.npz", "--out", "both")
    assert result.exit_code == 0, result.stderr
    assert {"small.json", "Small-2.json"} <= set(names("both"))
    assert str(Path("both") / "Small-2.json") in result.stdout


def test_an_axis_without_result_is_an_error_and_the_results_are_written(
    recorded, half_failed_fit, monkeypatch
):
    monkeypatch.setattr(
        sys.modules["allanjax.fleet.options"], "fit_inspected", lambda *args, **options: half_failed_fit
    )
    result = run("characterize", recorded)
    assert result.exit_code == 1
    assert f"error: {recorded}: gyro_y: no result, the start was hopeless" in result.stderr
    assert "no result: the start was hopeless" in result.stdout
    assert names("allanjax-results") == RESULTS
    result = run("characterize", recorded, "--json")
    document = json.loads(result.stdout)
    assert result.exit_code == 1
    assert document["fits"][0]["converged"] is False
    assert document["errors"] == [
        {"file": str(recorded), "message": "gyro_y: no result, the start was hopeless"}
    ]


@pytest.mark.parametrize(
    ("content", "options", "message"),
    [
        ("", [], "the file is empty"),
        ("gyro_x\n" + "1\n2\n" * 50, [], "--rate"),
        ("gyro_x\n" + "1\n2\n" * 50, ["--rate", "100"], "--gyro-unit"),
        ("gyro_x\n" + "1\n2\n" * 50, ["--rate", "100", "--gyro-unit", "parsec"], "unknown unit 'parsec'"),
        ("gyro_x\n" + "1\n2\n" * 50, ["--rate", "-1", "--gyro-unit", "deg/s"], "rate"),
        ("gyro_x\n" + "1\nnan\n" * 50, ["--rate", "100", "--gyro-unit", "deg/s"], "bad.csv"),
        ("gyro_x\n" + "1\n2\n" * 10, ["--rate", "100", "--gyro-unit", "deg/s", "--stop", "0.03"], "samples"),
    ],
)
def test_bad_input_exits_with_1_and_says_why(content, options, message):
    Path("bad.csv").write_text(content)
    result = run("characterize", "bad.csv", *options)
    assert result.exit_code == 1
    assert result.stderr.startswith("error: ")
    assert message in result.stderr
    assert "Traceback" not in result.output
    assert result.stdout == ""
    assert not Path("allanjax-results").exists()


def test_a_folder_of_results_that_cannot_be_made_is_an_error(recorded, half_failed_fit, monkeypatch):
    monkeypatch.setattr(
        sys.modules["allanjax.fleet.options"], "fit_inspected", lambda *args, **options: half_failed_fit
    )
    result = run("characterize", recorded, "--out", recorded / "inside")
    assert result.exit_code == 1
    assert str(recorded) in result.stderr


def test_a_bug_is_not_dressed_up_as_bad_input(recorded, monkeypatch):
    def broken(*args, **options):
        raise KeyError("bug")

    monkeypatch.setattr(sys.modules["allanjax.fleet.options"], "fit_inspected", broken)
    with pytest.raises(KeyError):
        run("characterize", recorded)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["characterize"], "Missing argument"),
        (["characterize", "a.csv", "--rate", "fast"], "--rate"),
        (["characterize", "a.csv", "--terms", "N + X"], "no term 'X'"),
        (["characterize", "a.csv", "--terms", "N=1 deg/√h"], "leave out its value"),
        (["characterise", "a.csv"], "No such command"),
        (["simulate", "--out", "a.csv"], "either a sensor or --terms"),
        (["simulate", "hg1700", "--terms", "N=1 deg/√h", "--out", "a.csv"], "either a sensor or --terms"),
        (["simulate", "hg1701", "--out", "a.csv"], "there are cimu, hg1700"),
        (["simulate", "hg1700"], "--out"),
        (["simulate", "--sensor", "accel", "--terms", "N=1 deg/√h", "--out", "a.csv"], "unit of a gyro"),
    ],
)
def test_a_wrong_command_line_exits_with_2(arguments, message):
    result = run(*arguments)
    assert result.exit_code == 2
    assert message in " ".join(result.stderr.replace("│", " ").split())


def test_terms_are_fitted_as_asked(recorded):
    result = run("characterize", recorded, "--terms", "N + markov(correlation_time=20 s held)", "--json")
    assert result.exit_code == 0, result.stderr
    for axis in json.loads(result.stdout)["fits"][0]["axes"]:
        found = {c["label"]: c for c in axis["coefficients"]}
        assert set(found) == {"angle_random_walk", "markov_amplitude", "markov_correlation_time"}
        assert (found["markov_correlation_time"]["held"], found["markov_correlation_time"]["value"]) == (
            True,
            20.0,
        )


def test_simulate_terms():
    arguments = [
        "--terms",
        "N=0.3 deg/sqrt(h) + B=1 deg/h",
        "--rate",
        "50",
        "--duration",
        "100",
        "--seed",
        "7",
    ]
    result = run("simulate", *arguments, "--out", "a.csv")
    assert result.exit_code == 0, result.stderr
    assert "a.csv: gyro; 5,000 samples at 50 Hz" in result.stdout
    recording = read("a.csv")
    assert (recording.n, recording.rate, recording.names) == (5000, pytest.approx(50.0), ("gyro",))
    white = 0.3 * np.pi / 180 / 60 * np.sqrt(50)
    assert recording.values.std() == pytest.approx(white, rel=0.05)
    run("simulate", *arguments, "--out", "b.parquet")
    np.testing.assert_allclose(read("b.parquet").values, recording.values, rtol=1e-12)


def test_simulate_a_sensor_whose_accelerometers_are_faster():
    listed = run("simulate", "--list").stdout
    assert "motionpak2" in listed
    assert "100 Hz, 1000 Hz" in listed
    result = run("simulate", "motionpak2", "--duration", "4", "--out", "m.npz")
    assert result.exit_code == 0, result.stderr
    assert names(".") == ["m_1000Hz.npz", "m_100Hz.npz"]
    assert read("m_1000Hz.npz").names == ("accel_x", "accel_y", "accel_z")


def test_simulate_says_what_it_cannot_write():
    result = run("simulate", "--terms", "N=1 deg/√h", "--duration", "1", "--out", "a.xlsx")
    assert result.exit_code == 1
    assert result.stderr.startswith("error: a.xlsx: can not write .xlsx")


def test_the_demo_finds_what_was_put_in():
    result = run("demo")
    assert result.exit_code == 0, result.stderr
    expected = [
        "demo.csv",
        "demo.json",
        "demo_allan.csv",
        "demo_allan.png",
        "demo_coefficients.csv",
        "demo_psd.png",
    ]
    assert names("allanjax-demo") == expected
    assert result.stdout.count("inside") >= 26
    assert f"{result.stdout.count('inside')} of 30 intervals" in result.stdout
    assert result.stdout.count("inside") + result.stdout.count("OUTSIDE") == 30
    assert "allanjax characterize imu.csv --rate 100" in result.stdout
    # Upright, as the table of means will show.
    means = read("allanjax-demo/demo.csv").values.mean(axis=0)
    np.testing.assert_allclose(means, [0.0, 0.0, 0.0, 0.0, 0.0, 9.80665], atol=0.1)
    found = json.loads(Path("allanjax-demo/demo.json").read_text(encoding="utf-8"))
    walks = [c["value"] for axis in found["axes"] for c in axis["coefficients"] if c["symbol"] == "N"]
    np.testing.assert_allclose(walks, [0.20, 0.25, 0.15, 0.05, 0.06, 0.08], rtol=0.02)


def test_help_and_version():
    assert run("--version").stdout.startswith("allanjax 0.")
    for command in ("characterize", "simulate", "demo"):
        assert run(command, "--help").exit_code == 0
    shown = " ".join(run("characterize", "--help").stdout.replace("│", " ").split())
    for word in ("deg/s", "m/s^2", "Exit codes", "allanjax characterize imu.csv"):
        assert word in shown


def test_the_module_is_the_command():
    command = [sys.executable, "-m", "allanjax", "convert", "3600", "deg/h", "--to", "deg/s"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == "3600 deg/h = 1 deg/s\n"
    wrong = subprocess.run([*command, "--no-such"], capture_output=True, text=True, timeout=120)
    assert wrong.returncode == 2
    assert "--no-such" in wrong.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="XDG_CACHE_HOME is a convention of Linux")
def test_a_process_of_its_own_keeps_what_it_compiled(tmp_path):
    environment = {key: value for key, value in os.environ.items() if key != "ALLANJAX_CACHE"}
    environment["XDG_CACHE_HOME"] = str(tmp_path / "cache")
    script = "import sys; from allanjax.cli.app import main; sys.argv[0] = 'allanjax'; main()"
    arguments = ["simulate", "--terms", "N=1 deg/√h + K=1 deg/h/√h", "--duration", "60", "--out", "a.csv"]
    done = subprocess.run(
        [sys.executable, "-c", script, *arguments],
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert any((tmp_path / "cache" / "allanjax" / "jax").iterdir())


def test_a_cache_that_cannot_be_written_is_no_more_than_a_warning(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("ALLANJAX_CACHE", str(tmp_path / "file" / "cache"))
    with pytest.warns(UserWarning, match="ALLANJAX_CACHE"):
        assert enable_compilation_cache() is None
    monkeypatch.setenv("ALLANJAX_CACHE", "OFF")
    assert enable_compilation_cache() is None
