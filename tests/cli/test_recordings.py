"""Commands that read recordings: options reach what reads and fits; the numbers are those of functions."""

import json
import subprocess
import sys
from pathlib import Path

import bench
import numpy as np
import pandas as pd
import pytest
from commands import run

import allanjax as aj

pytestmark = pytest.mark.usefixtures("elsewhere")
# What reads a table without stamps or units whose middle is a golden record.
READING = ("--rate", 100, "--gyro-unit", "deg/h", "--accel-unit", "mg", "--start", 1.5, "--stop", 165.34)


def write_odd(name):
    """A golden record in deg/h and mg between rows of other numbers, with a column that is no axis."""
    recording = bench.recording(name)
    units = {"gyro": np.pi / 180.0 / 3600.0, "accel": 9.80665e-3}
    values = recording.values / [units[axis.sensor] for axis in recording.axes]
    around = 100.0 * values.std(axis=0)
    table = pd.DataFrame(np.concatenate([values[:150] + around, values, values[-70:] - around]))
    table.insert(1, "none", np.arange(len(table)) % 5)
    table.add_prefix("channel ").to_csv("odd.csv", index=False)
    first, *others = recording.names
    return ("odd.csv", *READING, "--columns", ",".join([first, "-", *others]))


def check_fit(document, fit):
    assert document["recording"]["n"] == fit.curve.n
    assert [axis["name"] for axis in document["axes"]] == list(fit)
    for axis in document["axes"]:
        for told, c in zip(axis["coefficients"], fit[axis["name"]].coefficients.values(), strict=True):
            assert (told["label"], told["detected"]) == (c.label, c.detected)
            if c.detected:
                ends = [told["si"]["value"], told["si"]["std"], *told["si"]["interval_95"]]
                np.testing.assert_allclose(ends, [c.value, c.std, *c.interval], rtol=1e-5)


def fitted(*words, given=None, code=0):
    done = run("characterize", *words, "--json", given=given)
    assert done.exit_code == code, done.stderr
    (document,) = json.loads(done.stdout)["fits"]
    return document


def test_characterize_prints_the_table_and_writes_the_results():
    done = run("characterize", *write_odd("small"), "--out", "there")
    assert (done.exit_code, done.stderr) == (0, "")
    endings = [".json", "_allan.csv", "_allan.png", "_coefficients.csv", "_psd.png"]
    assert sorted(path.name for path in Path("there").iterdir()) == [f"odd{end}" for end in endings]
    document = json.loads(Path("there/odd.json").read_text(encoding="utf-8"))
    check_fit(document, bench.fit("small"))
    assert [axis["unit"] for axis in document["axes"]] == ["deg/h"] * 3 + ["mg"]
    assert document["check"]["verdict"] in done.stdout.splitlines()[0]
    assert bench.fit("small")["gyro_x"]["N"].in_unit().describe() in done.stdout
    assert all(str(Path("there") / f"odd{end}") in done.stdout for end in endings)


def test_critique_tells_the_story_and_writes_the_results():
    done = run("critique", *write_odd("steps"), "--out", "there")
    assert done.exit_code == 0, done.stderr
    document = json.loads(Path("there/odd_critique.json").read_text(encoding="utf-8"))
    expected = bench.critique("steps")
    assert document["recording"] == {"name": "odd", "n": 16_384, "rate_hz": 100.0, "duration_s": 163.84}
    for told, finding in zip(document["findings"], expected.findings, strict=True):
        assert (told["cause"], told["axes"]) == (finding.cause, list(finding.axes))
        assert told["gain_nats"] == pytest.approx(finding.gain, rel=1e-3)
    written = [path.name for path in Path("there").iterdir()]
    assert len(written) == 1 + len(expected.plot())
    assert all(str(Path("there") / word) in done.stdout for word in written)
    assert "bias step" in done.stdout


def test_one_bad_file_does_not_stop_the_others():
    own, twin = "ü[bold]<b>&_1.csv", "other/Ü[bold]<b>&_1.npz"
    for name in (own, twin, "unit_2.parquet", "both/unit_3.csv"):
        Path(name).parent.mkdir(exist_ok=True)
        aj.write(bench.recording("white"), name)
    words = ("**/unit_*", own, twin, "unit_2.parquet", "odd*.csv", "none.csv")
    done = run("characterize", *words, "--terms", "N", "--json", "--out", "both")
    document = json.loads(done.stdout)
    assert (done.exit_code, document["schema_version"]) == (1, 1)
    assert [entry["file"] for entry in document["fits"]] == ["unit_2.parquet", own, twin]
    assert [entry["file"] for entry in document["errors"]] == ["odd*.csv", "none.csv"]
    check_fit(document["fits"][2], bench.fit("white", "N"))
    assert done.stderr.count("error: ") == 2
    written = {path.name for path in Path("both").glob("*.json")}
    assert written == {"unit_2.json", "ü[bold]<b>&_1.json", "Ü[bold]<b>&_1-2.json"}


def test_standard_input_and_an_axis_without_result():
    aj.write(bench.recording("white"), "a.parquet")
    fit = fitted("-", "--terms", "N", given=Path("a.parquet").read_bytes())
    assert fit["file"] == "stdin"
    check_fit(fit, bench.fit("white", "N"))
    done = run("critique", "-", given=b"")
    assert (done.exit_code, done.stderr.startswith("error: stdin: ")) == (1, True)
    table = bench.recording("white").to_dataframe().assign(**{"accel_z [g]": 0.0})
    table.to_csv("half.csv", index=False)
    done = run("characterize", "half.csv", "--terms", "N", "--json", "--out", "there")
    document = json.loads(done.stdout)
    (error,), (fit,) = document["errors"], document["fits"]
    assert (done.exit_code, error["message"].startswith("accel_z: ")) == (1, True)
    assert "error: half.csv: accel_z: " in done.stderr
    assert [axis["dead"] for axis in fit["axes"]] == [False, True]
    check_fit({**fit, "axes": fit["axes"][:1]}, bench.fit("white", "N"))
    assert Path("there/half.json").exists()


def test_options_of_a_fit_reach_it():
    """A channel taken out: 4 σ, of white noise and its own scatter; and all of a record, as it is."""
    rng, n = np.random.default_rng(3), 16_384
    temperature = 25.0 + np.cumsum(rng.standard_normal(n)) * 0.01
    values = 1e-4 * rng.standard_normal(n) + 5e-5 * temperature
    pd.DataFrame({"gyro_x [rad/s]": values, "temperature": temperature}).to_csv("warm.csv", index=False)
    options = ("warm.csv", "--rate", "100", "--terms", "N", "--objective", "whittle", "--regressors")
    fit = fitted(*options, "temperature")
    found = fit["axes"][0]["regression"]["temperature"]
    assert fit["objective"] == "whittle"
    assert found["std"] == pytest.approx(1e-4 / np.sqrt(n) / temperature.std(), rel=0.1)
    assert abs(found["value"] - 5e-5) < 4.0 * found["std"]
    refused = run("characterize", *options, "pressure")
    assert (refused.exit_code, "temperature" in refused.stderr) == (1, True)
    aj.write(handled := bench.recording("handled"), "a.parquet")
    assert aj.inspect(handled).stretch is not None
    # Far off: no measurement of the sensor.
    of_all = fitted("a.parquet", "--terms", "N + K", "--as-is", code=1)
    check_fit(of_all, aj.fit(handled, "N + K", as_is=True))


def test_check_says_look_or_stop_and_the_lengths():
    aj.write(bench.recording("small"), "small.csv")
    table = pd.read_csv("small.csv")
    table.loc[9000:, "time [s]"] += 1.0
    table.to_csv("gap.csv", index=False)
    done = run("check", "small.csv", "gap.csv", "none.csv", "--json")
    document, expected = json.loads(done.stdout), aj.check(bench.recording("small"))
    assert [entry["verdict"] for entry in document["checks"]] == [expected.verdict, "stop"]
    assert done.exit_code == len(document["errors"]) == 1
    told = document["checks"][0]["lengths"]
    assert len(told) == len(expected.lengths) > 0
    assert {entry["detected"] for entry in told} == {True, False}


# What happens while a command runs, and what of it is printed.
WARNED = [
    ('warnings.warn("divide by zero", RuntimeWarning)', ""),
    ('warnings.warn_explicit("no default style", UserWarning, "/lib/openpyxl/style.py", 237)', ""),
    ('logging.getLogger("jax._src.xla_bridge").warning("no GPU")', ""),
    (
        'warnings.warn("a cache that is full", allanjax.base.errors.AllanjaxWarning)',
        "warning: a cache that is full\n",
    ),
]


@pytest.mark.parametrize(("happens", "printed"), WARNED)
def test_warnings_of_libraries_do_not_reach_a_user(happens, printed):
    """In a process of its own, as pytest takes warnings for itself."""
    code = "import logging, sys, warnings, allanjax.base.errors, allanjax.cli.schema as s\n"
    code += "from allanjax.cli.app import main\n"
    code += f"s.print_json = lambda _: {happens}\nsys.argv[1:] = ['schema', 'fleet']\nmain()"
    done = subprocess.run([sys.executable, "-W", "always", "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, printed)


def test_reading_options_are_those_of_read():
    n, rng = 600, np.random.default_rng(5)
    table = {"clock": 20.0 * np.arange(n), "gyro_x": rng.standard_normal(n), "note": 1.0 * (np.arange(n) % 3)}
    pd.DataFrame(table).drop(index=range(400, 404)).to_csv("stamped.csv", index=False)
    options = {"columns": "clock,gyro_x,-", "gyro_unit": "deg/h", "time": "clock", "time_unit": "ms"}
    options |= {"gaps": "fill", "start": 1.0, "stop": 11.0}
    model = "N=0.3 deg/√h + K=3 deg/h/√h"
    words = [x for name, value in options.items() for x in (f"--{name.replace('_', '-')}", value)]
    done = run("kalman", "stamped.csv", *words, "--terms", model, "--json")
    assert done.exit_code == 0, done.stderr
    (told,) = json.loads(done.stdout)["axes"]
    recording = aj.read("stamped.csv", **options)
    assert (told["samples"], recording.rate) == (500, pytest.approx(50.0))
    expected = aj.kalman_filter(recording, model)["gyro_x"].log_likelihood
    assert told["log_likelihood"] == pytest.approx(expected, rel=1e-9)


UNIT = "a.csv --rate 100 --gyro-unit deg/s"


@pytest.mark.parametrize(
    ("words", "code", "word"),
    [
        ("characterize empty.csv", 1, "empty"),
        ("characterize a.csv", 1, "--rate"),
        (f"characterize {UNIT} --start 9 --stop 5", 2, "9 s"),
        (f"characterize {UNIT} --start 300", 1, "--start"),
        ("characterize .", 1, "folder"),
        (f"critique {UNIT} --out a.csv/inside", 1, "--out"),
        ("characterize a.csv --terms N=1deg/√h", 2, "leave out"),
        ("characterize", 2, "FILE"),
        (f"kalman {UNIT}", 1, "--terms"),
    ],
)
def test_what_is_wrong_is_said(words, code, word):
    Path("a.csv").write_text("gyro_x\n" + "1\n2\n" * 50)
    Path("empty.csv").write_text("")
    done = run(*words.split())
    assert done.exit_code == code
    assert word in " ".join(done.stderr.replace("│", " ").split())
    assert code == 2 or "error: " in done.stderr
    assert "Traceback" not in done.output
    assert not Path("allanjax-results").exists()
