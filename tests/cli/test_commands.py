"""Commands: options reach what reads and fits; the numbers are those of functions."""

import functools
import json
import math
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import bench
import numpy as np
import pandas as pd
import pytest
from commands import run, schema, without_progress
from turned_sensors import at_rest

import allanjax as aj
from allanjax.cli.app import app

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


def ran(*words):
    done = run(*words)
    assert done.exit_code == 0, done.stderr
    return done.stdout


def check_fit(document, fit):
    assert document["recording"]["n"] == fit.curve.n
    assert [axis["name"] for axis in document["axes"]] == list(fit)
    for axis in document["axes"]:
        for entry, c in zip(axis["coefficients"], fit[axis["name"]].coefficients.values(), strict=True):
            assert (entry["label"], entry["detected"]) == (c.label, c.detected)
            if c.detected:
                ends = [entry["si"]["value"], entry["si"]["std"], *entry["si"]["interval_95"]]
                np.testing.assert_allclose(ends, [c.value, c.std, *c.interval], rtol=1e-5)


def fitted(*words, given=None, code=0):
    done = run("characterize", *words, "--json", given=given)
    assert done.exit_code == code, done.stderr
    (document,) = json.loads(done.stdout)["fits"]
    return document


#: Options whose names are not those of the functions' parameters, by command.
RENAMED = {
    "check": "--json",
    "characterize": "--format --json",
    "critique": "--format --json",
    "report": "-o",
    "compare": "-o --json",
    "spec": "-o --json",
    "fleet": "--format",
    "repeat": "--format --json",
    "export": "--from --list -o",
    "horizon": "--horizon --json",
    "navigate": "--for -o --json",
    "statespace": "--format -o",
    "kalman": "-o --json",
    "calibrate": "--format --json",
    "simulate": "--list",
    "convert": "--list --json",
}


def options_in(text):
    return set(re.findall(r"(?<![\w-])--?[a-z][a-z-]*", text))


def test_every_option_of_every_command_is_described_under_its_name():
    """An example is help that nothing derives from a function, so what it uses must be listed above."""
    names = [name for name in app if name[0] != "-"]
    assert {*RENAMED} < {*names}
    for name in names:
        with app.app_stack([name]):
            found = app[name].assemble_argument_collection(parse_docstring=True)
        arguments = [argument for argument in found if not argument.children]
        assert [argument.name for argument in arguments if not argument.parameter.help] == [], name
        options = {option for argument in arguments for option in argument.names if option[0] == "-"}
        assert not any(option.startswith(("--no-", "--empty-")) for option in options), name
        printed = run(name, "--help").stdout.replace("\\\n", "")
        text, _, table = printed.partition("╭")
        assert options <= options_in(table), name
        used = (line.partition(f"allanjax {name} ")[2] for line in text.splitlines())
        needed = options_in(RENAMED.get(name, "")).union(*map(options_in, used))
        assert needed <= options, name


def test_commands_need_no_docstrings():
    words = [sys.executable, "-OO", "-m", "allanjax", "export", "--help"]
    done = subprocess.run(words, capture_output=True, text=True, env=os.environ | {"COLUMNS": "130"})
    assert done.returncode == 0
    assert {"--from", "--list", "-o"} <= options_in(done.stdout)


def test_words_come_in_any_order_and_the_last_value_counts():
    files = ["a.csv", "b.csv", "-c.csv"]
    table = pd.DataFrame({"gyro_x [rad/s]": np.random.default_rng(8).standard_normal(1000)})
    for name in files:
        table.to_csv(name, index=False)
    done = run("check", "a.csv", "--rate", 10, "--json", "b.csv", "--rate=100", "--vibrating", "--", "-c.csv")
    checks = json.loads(done.stdout)["checks"]
    assert [entry["file"] for entry in checks] == files
    assert [entry["recording"]["rate_hz"] for entry in checks] == [100.0] * 3
    refused = run("check", "a.csv", "--columns", "-,gyro_x,-")
    assert (refused.exit_code, "columns= (--columns) has 3 entries" in refused.stderr) == (1, True)
    converted = ran("convert", -180, "deg/s", "--to", "m", "--to", "rad/s")
    assert converted == "-180 deg/s = -3.14159 rad/s\n"
    # The root of a density of power, which is (0.316 µg)²/Hz.
    assert ran("convert", 1e-13, "g^2/Hz", "--to", "ug/√Hz") == "1e-13 g^2/Hz = 0.316228 ug/√Hz\n"
    two_sided = ran("convert", 1e-6, "(deg/s)^2/Hz", "--to", "deg/√h", "--sided", "two")
    assert two_sided == "1e-06 (deg/s)^2/Hz = 0.06 deg/√h (two-sided density)\n"


def test_characterize_prints_the_table_and_writes_the_results():
    printed = ran("characterize", *write_odd("small"), "--out", "there", "--format", "svg")
    endings = [".json", "_allan.csv", "_allan.svg", "_coefficients.csv", "_psd.svg"]
    assert sorted(path.name for path in Path("there").iterdir()) == [f"odd{end}" for end in endings]
    document = json.loads(Path("there/odd.json").read_text(encoding="utf-8"))
    check_fit(document, bench.fit("small"))
    assert [axis["unit"] for axis in document["axes"]] == ["deg/h"] * 3 + ["mg"]
    assert document["check"]["verdict"] in printed.splitlines()[0]
    assert bench.fit("small")["gyro_x"]["N"].in_unit().describe().removesuffix(" deg/√h") in printed
    assert all(f"odd{end}" in printed.splitlines()[-1] for end in endings)


def test_critique_prints_a_summary_and_writes_the_results():
    printed = ran("critique", *write_odd("steps"), "--out", "there")
    document = json.loads(Path("there/odd_critique.json").read_text(encoding="utf-8"))
    expected = bench.critique("steps")
    assert document["recording"] == {"name": "odd", "n": 16_384, "rate_hz": 100.0, "duration_s": 163.84}
    for entry, finding in zip(document["findings"], expected.findings, strict=True):
        assert (entry["cause"], entry["axes"]) == (finding.cause, list(finding.axes))
        assert entry["gain_nats"] == pytest.approx(finding.gain, rel=1e-3)
    written = [path.name for path in Path("there").iterdir()]
    assert [Path(name).suffix for name in written].count(".png") == len(written) - 1 == len(expected.plot())
    assert all(word in printed.splitlines()[-1] for word in written)
    assert "bias step" in printed


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
    assert aj.inspect(handled).longest_part is not None
    # Far off: no measurement of the sensor.
    of_all = fitted("a.parquet", "--terms", "N + K", "--as-is", code=1)
    check_fit(of_all, aj.fit(handled, "N + K", as_is=True))


def test_check_reports_look_or_stop_and_the_lengths():
    aj.write(bench.recording("small"), "small.csv")
    table = pd.read_csv("small.csv")
    table.loc[9000:, "time [s]"] += 1.0
    table.to_csv("gap.csv", index=False)
    done = run("check", "small.csv", "gap.csv", "none.csv", "--json")
    document, expected = json.loads(done.stdout), aj.check(bench.recording("small"))
    assert [entry["verdict"] for entry in document["checks"]] == [expected.verdict, "stop"]
    assert done.exit_code == len(document["errors"]) == 1
    lengths = document["checks"][0]["lengths"]
    assert len(lengths) == len(expected.lengths) > 0
    assert {entry["detected"] for entry in lengths} == {True, False}


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGINT for one process")
def test_a_slow_command_reports_progress_and_can_be_interrupted():
    words = ("simulate", "--terms", "N=1 deg/√h + B=1 deg/h", "--duration", "200000", "--out", "long.npz")
    # A shell that runs the tests in the background has its children ignore the signal.
    heed = functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    started = [sys.executable, "-m", "allanjax", *words]
    slow = subprocess.Popen(started, stderr=subprocess.PIPE, text=True, preexec_fn=heed)
    assert any(line.startswith("simulating, ") for line in slow.stderr)
    slow.send_signal(signal.SIGINT)
    assert (without_progress(slow.communicate()[1]), slow.returncode) == ("interrupted\n", 130)


WARNING = """
import logging, sys, warnings, allanjax.cli.results as results
from allanjax.base.errors import AllanjaxWarning
from allanjax.cli.app import main
def warn(_):
    warnings.warn("divide by zero", RuntimeWarning)
    warnings.warn_explicit("no default style", UserWarning, "/lib/openpyxl/style.py", 237)
    logging.getLogger("jax._src.xla_bridge").warning("no GPU")
    warnings.warn("a cache that is full", AllanjaxWarning)
results.print_json, sys.argv[1:] = warn, ["schema", "fleet"]
main()
"""


def test_warnings_of_libraries_do_not_reach_a_user():
    """In a process of its own, as pytest handles warnings itself."""
    done = subprocess.run([sys.executable, "-W", "always", "-c", WARNING], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "warning: a cache that is full\n")


def test_reading_options_are_those_of_read():
    n, rng = 600, np.random.default_rng(5)
    table = {"clock": 20.0 * np.arange(n), "gyro_x": rng.standard_normal(n), "note": 1.0 * (np.arange(n) % 3)}
    pd.DataFrame(table).drop(index=range(400, 404)).to_csv("stamped.csv", index=False)
    options = {"columns": "clock,gyro_x,-", "gyro_unit": "deg/h", "time": "clock", "time_unit": "ms"}
    options |= {"gaps": "fill", "start": 1.0, "stop": 11.0}
    model = "N=0.3 deg/√h + K=3 deg/h/√h"
    words = [x for name, value in options.items() for x in (f"--{name.replace('_', '-')}", value)]
    (axis,) = json.loads(ran("kalman", "stamped.csv", *words, "--terms", model, "--json"))["axes"]
    recording = aj.read("stamped.csv", **options)
    assert (axis["samples"], recording.rate) == (500, pytest.approx(50.0))
    expected = aj.kalman_filter(recording, model)["gyro_x"].log_likelihood
    assert axis["log_likelihood"] == pytest.approx(expected, rel=1e-9)


DEG = np.pi / 180.0


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "small.json"
    aj.write_json(bench.fit("small"), path)
    return path


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
    for c, entry in ((result.white, axis["white"]["si"]), (result.walk, axis["walk"]["si"])):
        numbers = [entry["value"], entry["std"], *entry["interval_95"]]
        np.testing.assert_allclose(numbers, [c.value, c.std, *c.interval])
    # 1 m/s/√h is 1/60 m/s/√s.
    assert axis["white"]["unit"] == "m/s/√h"
    assert axis["white"]["value"] == pytest.approx(60.0 * result.white.value)
    assert (axis["correlation_time"] is None) == (process == "walk")
    assert document == plain(expected.to_dict())


def test_navigate(saved):
    words = ("navigate", saved, "--latitude", 51, "--azimuth", "0.1deg", "--time", 1, "--time", 10)
    words += ("--at-rest", 50, "--gyro-bias", "2 deg/h", "--accel-bias", "1 mg")
    biases = {"gyro_bias": "2 deg/h", "accel_bias": "1 mg"}
    fit = aj.load(saved)
    tables = [aj.navigate(fit, [1, 10], at_rest=50, **biases), aj.align(fit, 51, "0.1 deg", **biases)]
    assert lines_of(ran(*words, "--out", "a.png"))[:-1] == lines_of("\n".join(map(str, tables)))
    assert Path("a.png").exists()
    document = json.loads(ran(*words, "--json", "--schuler"))
    expected = aj.navigate(fit, [1, 10], at_rest=50, schuler=True, **biases)
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
    printed = ran("kalman", "a.parquet", "--fit", saved, "--smooth", "--out", "a.png", "--out", "a.csv")
    expected = aj.kalman_filter(recording, fit, smooth=True)
    assert lines_of(printed)[1:-1] == lines_of(expected)[1:]
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
    assert "misalignment" in ran("calibrate", "up.csv", "down.csv", *common, "--out", "out")
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
    for entry, own in zip(document["parameters"], plain(expected)["parameters"], strict=True):
        assert entry == pytest.approx(own, nan_ok=True)
    assert [p["start_s"] for p in document["positions"]] == [0.0, 100.0]
    assert document["gravity_m_s2"] == expected["gravity_m_s2"]


def test_from_a_calibration_at_two_places_to_navigation():
    """A scale factor of 1 %, which two gravities tell, for one second of 8 m/s²."""
    for name, g in (("calgary", 9.8082), ("quito", 9.7726)):
        values = at_rest([1.01 * g - 0.1], 64, 20.0, axes="z").values[:, 0]
        pd.DataFrame({"accel_z [m/s^2]": values}).to_csv(f"{name}.csv", index=False)
    aj.write_json(bench.fit("small"), "noise.json")
    words = ("--position", "z+=calgary.csv", "--position", "z up=quito.csv", "--gravity", "9.8082,9.7726")
    ran("calibrate", *words, "--rate", 20, "--as-is", "--fit", "noise.json", "--out", "out")
    scale = aj.load_calibration("out/calibration.json")["accel_z"]["scale_factor"]
    assert scale.value == pytest.approx(0.01, abs=1e-6)
    moving = ("--acceleration", "0,0,8 m/s^2", "--for", "1 s", "--turn-rate", "5 deg/s", "--uncorrected")
    moving += ("--calibration", "out/calibration.json", "--at-rest", 50, "--time", 1)
    found = json.loads(ran("navigate", "noise.json", "--latitude", 51, *moving, "--json"))["navigation"]
    down = found["errors"]["velocity"]["channels"]["down"]["causes"]["accel_z scale factor"]
    assert down[0] == pytest.approx(8.0 * np.hypot(scale.value, scale.std), rel=1e-6)
    assert found["profile"]["turn_rate_rad_s"] == pytest.approx([0.0, 0.0, 5.0 * DEG])
    assert "sensors" in ran("navigate", "noise.json", "--latitude", 51, *moving)


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


def test_documents_of_data_sheets_and_schemas():
    name = aj.datasheets()[0]
    assert name in ran("convert", "--list")
    document = json.loads(ran("convert", "--sheet", name, "--json"))
    assert document == plain(aj.datasheet(name).to_dict())
    for name in ("check", "fit", "critique", "fleet", "horizon"):
        schema(name)


@pytest.mark.notebook
def test_the_demo_estimates_the_true_coefficients():
    printed = ran("demo")
    names = {path.name.removeprefix("demo").lstrip("_") for path in Path("allanjax-demo").iterdir()}
    assert names == {".csv", ".json", "allan.csv", "allan.png", "coefficients.csv", "psd.png"}
    assert printed.count("inside") >= 26
    assert printed.count("inside") + printed.count("OUTSIDE") == 30
    means = aj.read("allanjax-demo/demo.csv").values.mean(axis=0)
    np.testing.assert_allclose(means, [0.0, 0.0, 0.0, 0.0, 0.0, 9.80665], atol=0.1)
    found = json.loads(Path("allanjax-demo/demo.json").read_text(encoding="utf-8"))
    walks = [c["value"] for axis in found["axes"] for c in axis["coefficients"] if c["symbol"] == "N"]
    np.testing.assert_allclose(walks, [0.20, 0.25, 0.15, 0.05, 0.06, 0.08], rtol=0.02)


UNIT = "a.csv --rate 100 --gyro-unit deg/s"


@pytest.mark.parametrize(
    ("words", "code", "word"),
    [
        ("characterize a.csv", 1, "--gyro-unit"),
        (f"characterize {UNIT} --start 9 --stop 5", 2, "9 s"),
        (f"characterize {UNIT} --start 300", 1, "--start"),
        (f"critique {UNIT} --out a.csv/inside", 1, "--out"),
        ("characterize a.csv --terms N=1deg/√h", 2, "leave out"),
        ("characterize", 2, "FILE"),
        (f"kalman {UNIT}", 1, "--terms"),
        ("horizon none.json --horizon 10", 1, "none.json"),
        ("calibrate", 2, "recordings"),
        ("calibrate up.csv down.csv --gravity 9.81;9.80", 1, "--gravity"),
        ("calibrate --position file.csv", 1, "orientation"),
        ("simulate --out a.csv", 2, "--terms"),
        ("simulate hg1701 --out a.csv", 2, "hg1700"),
        ("simulate --sensor accel --terms N=1deg/√h --out a.csv", 2, "gyro"),
        ("simulate --terms N=1deg/√h --out a.csv --duration nan", 2, "--duration"),
        ("convert 1 deg/h", 2, "--to"),
        ("", 2, ""),
        ("chek a.csv", 2, "check"),
        ("check a.csv --nonsense", 2, "--nonsense"),
        ("check a.csv --no-json", 2, "--no-json"),
        ("check a.csv --rate none", 2, "--rate"),
        ("check a.csv --gaps none", 2, "segments"),
        ("check a.csv --instance left", 1, "--instance"),
        ("fleet a.csv --workers 0", 2, "--workers"),
    ],
)
def test_errors_name_what_is_wrong(saved, words, code, word):
    Path("a.csv").write_text("gyro_x\n" + "1\n2\n" * 50)
    done = run(*words.split())
    assert done.exit_code == code
    assert word in " ".join(done.stderr.replace("│", " ").split())
    assert code == 2 or "error: " in done.stderr
    assert "Traceback" not in done.output
    assert not Path("allanjax-results").exists()
