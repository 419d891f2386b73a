"""Commands that read recordings: options reach what reads and fits; the numbers are those of functions."""

import json
from pathlib import Path

import bench
import numpy as np
import pandas as pd
import pytest
from commands import run

import allanjax as aj

pytestmark = pytest.mark.usefixtures("elsewhere")
DEG, G = np.pi / 180.0, 9.80665
# A table without stamps or units whose middle is a golden record, its columns and the rows around it.
READING = ("--rate", 100, "--gyro-unit", "deg/h", "--accel-unit", "mg", "--start", 1.5, "--stop", 165.34)


def write_odd(name, path="odd.csv"):
    """A golden record in deg/h and mg between rows of other numbers, with a column that is no axis."""
    recording = bench.recording(name)
    scales = [DEG / 3600.0 if axis.sensor == "gyro" else 1e-3 * G for axis in recording.axes]
    values = recording.values / scales
    around = 100.0 * values.std(axis=0)
    rows = np.concatenate([values[:150] + around, values, values[-70:] - around])
    table = pd.DataFrame(rows, columns=[f"channel {k}" for k in range(rows.shape[1])])
    table.insert(1, "none", np.arange(len(table)) % 5)
    table.to_csv(path, index=False)
    first, *others = recording.names
    return (path, *READING, "--columns", ",".join([first, "-", *others]))


def check_fit(document, fit, rtol=1e-5):
    """Every number of the coefficients in a document, and what was fitted."""
    assert document["recording"]["n"] == fit.curve.n
    assert [axis["name"] for axis in document["axes"]] == list(fit)
    for axis in document["axes"]:
        own = fit[axis["name"]]
        assert [c["label"] for c in axis["coefficients"]] == list(own.coefficients)
        for told in axis["coefficients"]:
            c = own[told["label"]]
            assert told["detected"] == c.detected
            if c.detected:
                ends = [told["si"]["value"], told["si"]["std"], *told["si"]["interval_95"]]
                np.testing.assert_allclose(ends, [c.value, c.std, *c.interval], rtol=rtol)


def test_characterize_prints_the_table_and_writes_the_results():
    done = run("characterize", *write_odd("small"), "--out", "there")
    assert done.exit_code == 0, done.stderr
    endings = [".json", "_allan.csv", "_allan.png", "_coefficients.csv", "_psd.png"]
    assert sorted(path.name for path in Path("there").iterdir()) == [f"odd{end}" for end in endings]
    document = json.loads(Path("there/odd.json").read_text(encoding="utf-8"))
    check_fit(document, bench.fit("small"))
    assert [axis["unit"] for axis in document["axes"]] == ["deg/h"] * 3 + ["mg"]
    assert document["check"]["verdict"] in done.stdout.splitlines()[0]
    assert bench.fit("small")["gyro_x"]["N"].in_unit().describe() in done.stdout
    assert all(str(Path("there") / f"odd{end}") in done.stdout for end in endings)
    assert done.stderr == ""


def test_critique_tells_the_story_and_writes_the_results():
    """The one critique of this file: the same findings as those of the record itself, and as many figures."""
    done = run("critique", *write_odd("steps"), "--out", "there")
    assert done.exit_code == 0, done.stderr
    document = json.loads(Path("there/odd_critique.json").read_text(encoding="utf-8"))
    expected = bench.critique("steps")
    assert document["recording"] == {"name": "odd", "n": 16_384, "rate_hz": 100.0, "duration_s": 163.84}
    assert [f["cause"] for f in document["findings"]] == [f.cause for f in expected.findings]
    for told, finding in zip(document["findings"], expected.findings, strict=True):
        assert told["axes"] == list(finding.axes)
        time = finding.parameters["time"]
        assert told["parameters"]["time"]["value"] == pytest.approx(time.value, abs=0.02 * time.std)
        assert told["gain_nats"] == pytest.approx(finding.gain, rel=1e-3)
    written = sorted(path.name for path in Path("there").iterdir())
    assert len(written) == 1 + len(expected.plot())
    assert all(str(Path("there") / name) in done.stdout for name in written)
    assert "bias step" in done.stdout


def test_one_bad_file_does_not_stop_the_others():
    """Files by patterns, each once, but for those among results. JSON is all of stdout."""
    white = bench.recording("white")
    for name in ("unit_1.csv", "unit_2.parquet", "allanjax-results/unit_3.csv"):
        Path(name).parent.mkdir(exist_ok=True)
        aj.write(white, name)
    words = ("**/unit_*", "unit_1.csv", "odd*.csv", "none.csv", "--terms", "N")
    done = run("characterize", *words, "--json")
    document = json.loads(done.stdout)
    assert done.exit_code == 1
    assert document["schema_version"] == 1
    assert [entry["file"] for entry in document["fits"]] == ["unit_1.csv", "unit_2.parquet"]
    assert [entry["file"] for entry in document["errors"]] == ["odd*.csv", "none.csv"]
    for fit in document["fits"]:
        check_fit(fit, bench.fit("white", "N"))
    assert done.stderr.count("error: ") == 2
    assert not list(Path("allanjax-results").glob("*.json"))


def test_files_of_one_name_do_not_overwrite_each_other():
    Path("other").mkdir()
    for name in ("grün[bold]<b>&x.csv", "other/Grün[bold]<b>&x.npz"):
        aj.write(bench.recording("white"), name)
    files = ("grün[bold]<b>&x.csv", "other/Grün[bold]<b>&x.npz")
    done = run("characterize", *files, "--terms", "N", "--out", "both")
    assert done.exit_code == 0, done.stderr
    written = {path.name for path in Path("both").glob("*.json")}
    assert written == {"grün[bold]<b>&x.json", "Grün[bold]<b>&x-2.json"}
    assert str(Path("both") / "Grün[bold]<b>&x-2.json") in done.stdout


def test_standard_input():
    aj.write(bench.recording("white"), "a.parquet")
    content = Path("a.parquet").read_bytes()
    done = run("characterize", "-", "--terms", "N", "--json", given=content)
    assert done.exit_code == 0, done.output
    (fit,) = json.loads(done.stdout)["fits"]
    assert fit["file"] == "stdin"
    check_fit(fit, bench.fit("white", "N"))
    done = run("critique", "-", given=b"")
    assert (done.exit_code, done.stderr.startswith("error: stdin: ")) == (1, True)


def test_an_axis_without_result_is_an_error_and_the_results_are_written():
    """A dead axis, beside one that is alive."""
    white = bench.recording("white").values[:, 0]
    table = {"time [s]": np.arange(16_384) / 100.0, "gyro_x [rad/s]": white, "accel_z [g]": 0.0}
    pd.DataFrame(table).to_csv("half.csv", index=False)
    done = run("characterize", "half.csv", "--terms", "N", "--json", "--out", "there")
    document = json.loads(done.stdout)
    assert done.exit_code == 1
    (error,) = document["errors"]
    assert error["message"].startswith("accel_z: ")
    assert "error: half.csv: accel_z: " in done.stderr
    check_fit({**document["fits"][0], "axes": document["fits"][0]["axes"][:1]}, bench.fit("white", "N"))
    assert (Path("there") / "half.json").exists()


def test_the_spectrum_is_fitted_with_an_auxiliary_channel_taken_out():
    """Four standard deviations, which white noise and the channel's own scatter determine."""
    rng, n = np.random.default_rng(3), 16_384
    temperature = 25.0 + np.cumsum(rng.standard_normal(n)) * 0.01
    values = 0.1 * rng.standard_normal(n) + 0.05 * temperature
    pd.DataFrame({"gyro_x [rad/s]": values, "temperature": temperature}).to_csv("warm.csv", index=False)
    options = ("--rate", "100", "--terms", "N", "--objective", "whittle", "--json")
    done = run("characterize", "warm.csv", *options, "--regressors", "temperature")
    assert done.exit_code == 0, done.stderr
    (fit,) = json.loads(done.stdout)["fits"]
    found = fit["axes"][0]["regression"]["temperature"]
    assert fit["objective"] == "whittle"
    assert found["std"] == pytest.approx(0.1 / np.sqrt(n) / temperature.std(), rel=0.1)
    assert abs(found["value"] - 0.05) < 4.0 * found["std"]
    refused = run("characterize", "warm.csv", *options, "--regressors", "pressure")
    assert (refused.exit_code, "temperature" in refused.stderr) == (1, True)


@pytest.mark.parametrize(
    ("words", "options"),
    [
        (("--terms", "N + K", "--as-is"), {"model": "N + K", "as_is": True}),
        (("--terms", "N", "--objective", "wavelet"), {"model": "N", "objective": "wavelet"}),
    ],
)
def test_options_of_a_fit_reach_it(words, options):
    """Of a recording that was handled at its ends, where it matters whether all of it is used."""
    name = "handled" if "--as-is" in words else "white"
    recording = bench.recording(name)
    aj.write(recording, "a.parquet")
    done = run("characterize", "a.parquet", *words, "--json")
    assert done.exit_code == 0, done.stderr
    (document,) = json.loads(done.stdout)["fits"]
    check_fit(document, aj.fit(recording, **options))
    if "--as-is" in words:
        assert document["recording"]["n"] == recording.n
        assert aj.inspect(recording).stretch is not None


def test_a_stream_is_read_chunk_by_chunk():
    words = write_odd("small")
    done = run("characterize", *words, "--stream", "--terms", "N + B", "--json")
    assert done.exit_code == 0, done.stderr
    (document,) = json.loads(done.stdout)["fits"]
    # The pyramid has fewer cluster times than the whole record's fit.
    for axis in document["axes"][:3]:
        N = next(c for c in axis["coefficients"] if c["label"] == "angle_random_walk")
        expected = bench.fit("small")[axis["name"]]["N"]
        assert abs(N["si"]["value"] - expected.value) < 0.5 * expected.std


def test_check_says_look_or_stop_and_the_lengths():
    recording = bench.recording("small")
    aj.write(recording, "small.csv")
    table = pd.read_csv("small.csv")
    table.loc[9000:, "time [s]"] += 1.0
    table.to_csv("gap.csv", index=False)
    done = run("check", "small.csv", "gap.csv", "none.csv", "--json")
    document, expected = json.loads(done.stdout), aj.check(recording)
    assert [entry["verdict"] for entry in document["checks"]] == [expected.verdict, "stop"]
    assert done.exit_code == len(document["errors"]) == 1
    told = document["checks"][0]["lengths"]
    assert len(told) == len(expected.lengths) > 0
    assert {entry["detected"] for entry in told} == {True, False}


# ------------------------------------------------------------------------------------------------- reading
@pytest.fixture
def stamped():
    """Stamps in ms in a column of another name, the first of two sensors in another unit, and a gap."""
    n, rng = 600, np.random.default_rng(5)
    table = {"clock": 20.0 * np.arange(n), "gyro_x": rng.standard_normal(n), "note": 1.0 * (np.arange(n) % 3)}
    pd.DataFrame(table).drop(index=range(400, 404)).to_csv("stamped.csv", index=False)
    return {
        "gyro_unit": "deg/h",
        "time": "clock",
        "time_unit": "ms",
        "gaps": "fill",
        "start": 1.0,
        "stop": 11.0,
    }


def test_reading_options_are_those_of_read(stamped):
    """By a filter, whose likelihood every sample, unit, rate and time is in."""
    model = "N=0.3 deg/√h + K=3 deg/h/√h"
    words = [x for name, value in stamped.items() for x in (f"--{name.replace('_', '-')}", value)]
    columns = ("--columns", "clock,gyro_x,-")
    done = run("kalman", "stamped.csv", *words, *columns, "--terms", model, "--json")
    assert done.exit_code == 0, done.stderr
    (axis,) = json.loads(done.stdout)["axes"]
    recording = aj.read("stamped.csv", columns="clock,gyro_x,-", **stamped)
    assert (recording.n, recording.rate) == (500, pytest.approx(50.0))
    expected = aj.kalman_filter(recording, model)["gyro_x"]
    assert axis["samples"] == 500
    assert axis["log_likelihood"] == pytest.approx(expected.log_likelihood, rel=1e-9)
    for name, other in (("gyro_unit", "deg/s"), ("start", 2.0), ("stop", 9.0)):
        words = [
            x
            for key, value in (stamped | {name: other}).items()
            for x in (f"--{key.replace('_', '-')}", value)
        ]
        done = run("kalman", "stamped.csv", *words, *columns, "--terms", model, "--json")
        (axis,) = json.loads(done.stdout)["axes"]
        assert axis["log_likelihood"] != pytest.approx(expected.log_likelihood, rel=1e-3)


TABLE = "gyro_x\n" + "1\n2\n" * 50
UNIT = ("--rate", "100", "--gyro-unit", "deg/s")


@pytest.mark.parametrize("command", ["characterize", "critique", "check", "fleet", "kalman", "calibrate"])
def test_every_command_takes_every_option_of_reading(command):
    shown = run(command, "--help").output
    for name in (
        "rate",
        "gyro-unit",
        "accel-unit",
        "columns",
        "time",
        "time-unit",
        "start",
        "stop",
        "topic",
        "instance",
    ):
        assert f"--{name} " in shown
    assert "--gaps" in shown


@pytest.mark.parametrize(
    ("words", "content", "code", "word"),
    [
        (["characterize", "a.csv"], "", 1, "empty"),
        (["characterize", "a.csv"], TABLE, 1, "--rate"),
        (["characterize", "a.csv", "--rate", "100"], TABLE, 1, "--gyro-unit"),
        (["characterize", "a.csv", "--rate", "100", "--gyro-unit", "parsec"], TABLE, 1, "parsec"),
        (["characterize", "a.csv", "--rate", "-1", "--gyro-unit", "deg/s"], TABLE, 1, "rate"),
        (["characterize", "a.csv", *UNIT], "gyro_x\n" + "1\nnan\n" * 50, 1, "a.csv"),
        (["characterize", "a.csv", *UNIT, "--stop", "0.03"], TABLE, 1, "samples"),
        (["characterize", "a.csv", *UNIT, "--start", "9", "--stop", "5"], TABLE, 2, "9 s"),
        (["characterize", "a.csv", *UNIT, "--start", "nan"], TABLE, 2, "nan"),
        (["characterize", "a.csv", *UNIT, "--start", "300"], TABLE, 1, "--start"),
        (["characterize", "a.csv", *UNIT, "--topic", "/imu"], TABLE, 1, "topic"),
        (["characterize", "a.csv", *UNIT, "--instance", "1"], TABLE, 1, "instance"),
        (["characterize", "."], TABLE, 1, "folder"),
        (["characterize", "a.csv", *UNIT, "--out", "a.csv/inside"], TABLE, 1, "--out"),
        (["critique", "a.csv", *UNIT, "--out", "a.csv"], TABLE, 1, "--out"),
        (["fleet", "a.csv", *UNIT, "--out", "a.csv"], TABLE, 1, "--out"),
        (["demo", "--out", "a.csv"], TABLE, 1, "--out"),
        (["characterize", "a.csv", "--rate", "fast"], TABLE, 2, "--rate"),
        (["characterize", "a.csv", "--terms", "N + X"], TABLE, 2, "'X'"),
        (["characterize", "a.csv", "--terms", "N=1 deg/√h"], TABLE, 2, "leave out"),
        (["characterize"], TABLE, 2, "FILE"),
        (["characterise", "a.csv"], TABLE, 2, "characterise"),
        (["check", "a.csv"], TABLE, 1, "--rate"),
        (["kalman", "a.csv", *UNIT], TABLE, 1, "--terms"),
    ],
)
def test_what_is_wrong_is_said(words, content, code, word):
    Path("a.csv").write_text(content)
    done = run(*words)
    assert done.exit_code == code
    assert word in " ".join(done.stderr.replace("│", " ").split())
    assert code == 2 or "error: " in done.stderr
    assert "Traceback" not in done.output
    assert not Path("allanjax-results").exists()
