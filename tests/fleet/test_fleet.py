"""Fleets: many recordings on a Dask cluster, what a later run takes from an earlier one, and their table."""

import io
import json
import os
import re
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest
from commands import run, schema
from fleets import ARW, axis, coefficient
from imu_columns import refused

import allanjax as aj

COLUMNS = {
    "recording file unit_name group axis sensor coefficient unit terms remarks warnings": "str",
    "value std lower_95 upper_95 upper_limit_95 p_value ratio record_ratio start_s stop_s": "float64",
    "detected measured outlying odd_record": "bool",
}


def test_the_table_holds_what_fits_find(characterized, logs):
    out, result = characterized
    pd.testing.assert_frame_equal(pd.read_parquet(out / "fleet.parquet"), result.table)
    kinds = {name: kind for names, kind in COLUMNS.items() for name in names.split()}
    assert {*result.table} == {*kinds}
    for name, kind in kinds.items():
        assert result.table[name].dtype in (kind, "object" if kind == "str" else kind)
    assert list(result.table["recording"].unique()) == [f"unit_{k}" for k in range(5)]
    for name in ("unit_1", "unit_4"):
        fit = aj.fit(aj.read(logs / f"{name}.parquet"), "N + K", plain=True)
        rows = result.table[result.table["recording"] == name].set_index(["axis", "coefficient"])
        assert len(rows) == 4
        assert {*rows["file"]} == {str(logs / f"{name}.parquet")}
        assert {*rows["terms"]} == {f"{ARW} + rate_random_walk"}
        for (axis_name, label), row in rows.iterrows():
            found = fit[axis_name]
            own = found.coefficients[label].in_unit(row["unit"])
            # The same program on the same samples: rounding.
            numbers = [own.value, own.std, *own.interval, own.upper_limit, found.p_value]
            columns = ["value", "std", "lower_95", "upper_95", "upper_limit_95", "p_value"]
            assert row[columns].tolist() == pytest.approx(numbers, rel=1e-6, nan_ok=True)
            assert (row["detected"], row["measured"], row["sensor"]) == (own.detected, True, axis_name[:-2])
    # The odd unit is marked and a corrupt one is reported.
    odd = result.outlying[["recording", "axis", "coefficient"]]
    assert odd.values.tolist() == [["unit_3", "gyro_x", ARW]]
    (error,) = result.errors
    assert (error["file"], "Parquet" in error["message"]) == (str(logs / "corrupt.parquet"), True)
    assert pd.read_csv(out / "errors.csv").to_dict("records") == [error]
    assert "6 recordings: 5 without errors, 1 with errors; 0 from" in str(result)
    lines = (out / "notes.txt").read_text(encoding="utf-8").splitlines()
    assert lines[0].startswith("unit_3: outlying")
    assert lines[-1] == f"{error['file']}: {error['message']}"
    assert {*result.notes} < {*lines}
    assert (out / "fleet.png").exists()
    assert result.files == tuple(sorted(logs.iterdir()))


@pytest.mark.parametrize("stretch", [{}, {"start": 100.003, "stop": 1_400.0}])
def test_a_long_recording_is_divided_and_put_together(cluster, tmp_path, stretch):
    rng, path = np.random.default_rng(3), tmp_path / "long.npy"
    x = rng.standard_normal((150_000, 1)) + np.cumsum(rng.standard_normal((150_000, 1)), axis=0) * 1e-3
    np.save(path, x := 1e-4 * x)
    options = {"rate": 100.0, "gyro_unit": "rad/s", "columns": "gyro_x", "piece": 100_000, **stretch}
    result = aj.characterize_fleet(path, tmp_path / "out", "N + K", scheduler=cluster, **options)
    accumulator = aj.AllanAccumulator(100.0, ["gyro_x"])
    accumulator.update(x[10_001:140_000] if stretch else x)
    whole = accumulator.fit("N + K")["gyro_x"].coefficients
    for label, c in whole.items():
        (row,) = result.table[result.table["coefficient"] == label].to_dict("records")
        own = c.in_unit(row["unit"])
        assert row["value"] == pytest.approx(own.value, rel=1e-9)
        assert row["std"] == pytest.approx(own.std, rel=1e-6)


def test_a_second_run_computes_only_what_is_not_there(characterized, logs, cluster):
    out, first = characterized

    def times():
        return {path.stem: path.stat().st_mtime_ns for path in (out / "recordings").iterdir()}

    before, counts = times(), []

    def again(files):
        counts.clear()
        options = {"plain": True, "scheduler": cluster, "progress": lambda *told: counts.append(told)}
        return aj.characterize_fleet(files, out, "N + K", **options)

    second = again(logs / "*.parquet")
    # The corrupt one is tried again.
    assert (second.resumed, counts) == (5, [(5, 0, 6), (6, 1, 6)])
    assert times() == before
    pd.testing.assert_frame_equal(second.table, first.table)
    os.utime(logs / "unit_2.parquet")
    (out / "recordings" / "unit_4.json").write_text('{"key": ', encoding="utf-8")
    third = again(logs / "unit_*.parquet")
    assert {name for name, time in times().items() if time != before[name]} == {"unit_2", "unit_4"}
    assert (third.resumed, third.errors) == (3, ())
    pd.testing.assert_frame_equal(third.table, first.table)


ONE = [axis("gyro_x", [coefficient(ARW, 1.0, 0.1)])]


@pytest.fixture
def three(fleet):
    for name in "abc":
        fleet.store(name, ONE)
    fleet.files = [fleet.file(name) for name in "abc"]
    return fleet


# Each option, and another value than the default.
OPTIONS = {"rate": 200.0, "gyro_unit": "deg/h", "accel_unit": "mg", "columns": "gyro_x", "time": "clock"}
OPTIONS |= {"time_unit": "ms", "start": 1.0, "stop": 9.0, "topic": "/imu", "instance": 1, "gaps": "fill"}
OPTIONS |= {"objective": "whittle", "regressors": ["temperature"], "as_is": True, "vibrating": True}
OPTIONS |= {"plain": True}


@pytest.mark.usefixtures("elsewhere")
@pytest.mark.parametrize("name", OPTIONS)
def test_each_option_is_part_of_a_results_key(three, cluster, name):
    value = OPTIONS[name]
    words = [f"--{name.replace('_', '-')}", *([] if value is True else np.atleast_1d(value))]
    assert three.run(three.files).resumed == 3
    assert three.run(three.files, scheduler=cluster, **{name: value}).resumed == 0
    of = three.key["options"] if name in three.key["options"] else three.key["options"]["reading"]
    of[name] = str(float(value)) if type(value) in (int, float) else value
    three.store("a", ONE)
    assert three.run(three.files[:1], **{name: value}).resumed == 1
    outcome = run("fleet", three.files[0], "--out", three.out, *words)
    assert (outcome.exit_code, "1 from an earlier run" in outcome.stdout) == (0, True)


# Held, free, started elsewhere; of the first and the second order; with an amplitude held and free; chosen.
MODELS = ["N=1 deg/sqrt(h) held + B", "N + B", None, aj.Markov(correlation_time=10.0)]
MODELS += [aj.Markov(correlation_time=10.000000001), MODELS[-1].hold("correlation_time")]
MODELS += [aj.LowPass(bandwidth=3.0), aj.LowPass(bandwidth=3.0, order=2)]


def test_models_that_differ_in_anything_have_keys_that_differ(fleet, cluster):
    """Of a recording without a quiet part, so that nothing is fitted: without result is a result, too."""
    x, t = np.random.default_rng(7).standard_normal(30_000), np.arange(30_000) / 100.0
    for k in range(50):
        x += 300.0 * np.exp(-abs(t - 3.0 - 6.0 * k) / 0.1) * np.sin(200.0 * t)
    recording = aj.Recording.from_array(x * 1e-3, 100.0, gyro_unit="rad/s", names=["gyro_x"])
    aj.write(recording, path := fleet.folder / "knocks.parquet")
    for model in MODELS:
        for resumed in (0, 1):
            result = fleet.run([path], model=model, scheduler=cluster)
            assert result.resumed == resumed
            assert result.errors[0]["message"].startswith("gyro_x: no result")


def test_another_version_and_another_file_are_computed_anew(three, cluster):
    os.utime(three.files[0])
    three.files[1].write_text("00\n")
    version, three.key["allanjax_version"] = three.key["allanjax_version"], "99.0"
    three.store("c", ONE)
    assert three.run(three.files, scheduler=cluster).resumed == 0
    three.key["allanjax_version"] = version
    for name, text in (("a", "{"), ("b", "[1]"), ("c", '{"key": 1, "fit": {}}'), ("note", '"x"')):
        (three.out / "recordings" / f"{name}.json").write_text(text, encoding="utf-8")
    result = three.run(three.files, scheduler=cluster)
    assert (result.resumed, len(result.table)) == (0, 0)
    full = three.judged(("gyro", ARW, np.ones((3, 1)), 0.1))
    assert (full.resumed, dict(result.table.dtypes)) == (3, dict(full.table.dtypes))


def test_rows_of_a_stored_fit(three):
    """Not of an axis without result, nor of terms for which it was corrected; chosen terms are named."""
    three.store("b", [*ONE, axis("gyro_y", [], converged=False, reason="constant", p_value=None)])
    result = three.run(three.files)
    assert result.errors == ({"file": str(three.files[1]), "message": "gyro_y: no result, constant"},)
    assert len(result.table) == 3
    both = [coefficient(ARW, 1.0, 0.1), coefficient("sinusoid", 2.0, 0.1, unit="Hz")]
    sets = [{"chosen": False, "terms": ["ramp"]}, {"chosen": True, "terms": [ARW, "flicker"]}]
    extension = {"further": ["sinusoid"], "model": [{"term": "sinusoid"}]}
    corrected = {"extension": extension, "selection": sets}
    cases = (corrected, [ARW], "flicker", "corrected for line 2 Hz"), ({}, [ARW, "sinusoid"], "sinusoid", "")
    for more, labels, last, remark in cases:
        three.store("b", [axis("gyro_x", both, **more)])
        result = three.run(three.files[1:2])
        table = result.table
        found = table["coefficient"].tolist(), {*table["terms"]}, {*table["remarks"]}
        assert found == (labels, {f"{ARW} + {last}"}, {remark})
        assert ("b: gyro_x: corrected for line 2 Hz" in str(result)) == bool(remark)


@pytest.mark.usefixtures("no_windows")
def test_what_was_corrected_left_out_or_is_wrong_is_said(cluster, tmp_path):
    """A unit with a line on one axis, one that clips, one that was knocked, and two without a remark."""
    n, rng, about = 2048, np.random.default_rng(5), {"gyro_unit": "rad/s", "names": ["gyro_x", "gyro_y"]}
    units = {unit: 1e-3 * rng.standard_normal((n, 2)) for unit in ("calm", "line", "clips", "knock", "still")}
    units["line"][:, 1] += 1e-3 * np.sin(2.0 * np.pi * 7.3 * np.arange(n) / 100.0)
    units["clips"][:, 0] = np.minimum(np.round(units["clips"][:, 0], 5), 5e-4)
    units["knock"][500:540] += 0.3 * rng.standard_normal((40, 2))
    for unit, x in units.items():
        aj.write(aj.Recording.from_array(x, 100.0, **about), tmp_path / f"{unit}.parquet")
    told = aj.characterize_fleet(tmp_path / "*", tmp_path / "out", "N + K", plain=True, scheduler=cluster)
    found = told.table.groupby(["recording", "axis"])["remarks"].unique().map(", ".join).to_dict()
    used = sum(stop - start for start, stop in aj.inspect(aj.read(tmp_path / "knock.parquet")).parts)
    expected = dict.fromkeys(found, "length 20 s")
    expected["line", "gyro_y"] = "does not fit, line 7.3 Hz, length 20 s"
    # 5e-4 is half a standard deviation, above which 31 % are.
    expected["clips", "gyro_x"] = "not a measurement, saturation 31 %, length 20 s"
    expected |= {("knock", f"gyro_{k}"): f"cut {20.48 - used:.2g} s, length {used:.2g} s" for k in "xy"}
    assert found == expected
    (error,) = told.errors
    assert error["file"] == str(tmp_path / "clips.parquet")
    assert error["message"] == "gyro_x: not a measurement of this sensor: its range was exceeded"
    wrong = ("clips: gyro_x: not a measurement, ", "; gyro_y: does not fit, ")
    assert all(words in str(told) for words in ("of 4", *wrong))
    # One unit's crosses, and hollow circles of all units, which are short.
    (panel, *_) = told.plot().axes
    assert sum(len(line.get_xdata()) for line in panel.lines if line.get_marker() == "x") == 1
    hollow = [line for line in panel.lines if line.get_markerfacecolor() == "#ffffff"]
    assert sum(len(line.get_xdata()) for line in hollow) == 9


def test_recordings_that_are_left_out_are_told(three):
    result = three.run(three.files[2:])
    assert (result.resumed, list(result.table["recording"])) == (1, ["c"])
    assert all(word in result.notes[0] for word in ("2 recordings", *map(str, three.files[:2])))
    # Named again they are there again, and nothing is said.
    whole = three.run(three.files)
    assert whole.resumed == 3
    assert not any("left out" in note for note in whole.notes)


def test_names_tell_recordings_apart_and_may_change_from_run_to_run(fleet):
    paths = ["x/a/imu.csv", "y/a/imu.csv", "y/b/imu.csv.gz", "y/b/imu.npz", "z/gyro.1.csv"]
    files = [fleet.folder / path for path in paths]
    for k, path in enumerate(files):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        fleet.store(f"stored_{k}", ONE, path)
    result, alone = fleet.run(files), fleet.run(files[1:2])
    assert (result.resumed, alone.resumed, list(alone.table["recording"])) == (5, 1, ["imu"])
    assert list(result.table["recording"]) == ["x_a_imu", "y_a_imu", "imu.csv.gz", "imu.npz", "gyro.1"]
    stored = {path.name for path in (fleet.out / "recordings").iterdir()}
    assert stored == {"imu.json", "x_a_imu.json", "imu.csv.gz.json", "imu.npz.json", "gyro.1.json"}


def test_patterns_find_each_file_once_and_no_results(fleet, cluster, monkeypatch):
    monkeypatch.chdir(fleet.folder)
    there = "b/imu.csv a/imu.csv log[1].csv out/x.csv a/deeper/x.csv one/metadata.yaml one/0.mcap"
    for name in there.split():
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).touch()
    every = "b/imu.csv a/deeper/x.csv a/imu.csv log[1].csv gone.csv"
    several = ["b/*.csv", "**/*.csv", "log[1].csv", "gone.csv"]
    for patterns, found in ((several, every), ("*", "log[1].csv one"), ("**/*.mcap", "one/0.mcap")):
        result = aj.characterize_fleet(patterns, "out", scheduler=cluster)
        assert [path.as_posix() for path in result.files] == found.split()
        assert len(result.errors) == len(result.files)
    # A bag is another one when a file in it has changed.
    status = [path.stat() for path in Path("one").iterdir()]
    fleet.store("one", ONE, Path("one"))
    stored = Path("out/recordings/one.json")
    document, newest = json.loads(stored.read_text()), max(s.st_mtime_ns for s in status)
    document["key"] |= {"size": sum(s.st_size for s in status), "modified_ns": newest}
    stored.write_text(json.dumps(document))
    assert aj.characterize_fleet("one", "out").resumed == 1
    Path("one/0.mcap").write_text("more")
    assert aj.characterize_fleet("one", "out", scheduler=cluster).resumed == 0


GROUPED = {"mems_a": "logs/mems/a", "b": "logs/mems/b", "fog_a": "logs/fog/a"}
# What divides them, and the content of a file of groups, or None.
GROUPS = [
    (r"logs/(\w+)/", None),
    ("mems|fog", None),
    ("^([a-z]+)_|/(mems)/", None),
    ({"logs/mems/a.csv": "mems", "b.csv": "mems", "fog_a": "fog", "other.csv": "x"}, None),
    (lambda path: path.parent.name, None),
    ("groups.csv", "file,group\nlogs/mems/a.csv,mems\nb.csv,mems\nlogs/fog/a.csv,fog\nunused.csv,x\n"),
    ("groups.csv", "\ufeffgroup, recording\nmems, mems_a\nmems, b\nfog, fog_a\n"),
    ("groups.csv", "id,file,group\n1,logs/mems/a.csv,mems\n2,logs/mems/b.csv,mems\n3,logs/fog/a.csv,fog\n"),
]
# What does not, and what the error names.
NO_GROUPS = [
    ("logs/(mems)/", "1 of 3|logs/fog/a.csv|logs/(mems)/", None),
    ("logs/(", "group=|--group", None),
    ("gone/groups.csv", "gone/groups.csv", None),
    ({"mems_a": "x", "logs/mems/a.csv": "y"}, "logs/mems/a.csv|'x' and 'y'", None),
    ({"a.csv": "x", "b.csv": "x"}, "2 of 3|group=", None),
    (lambda path: "", "3 of 3|group=", None),
    ("groups.csv", "group|name, grade", "name,grade\na,x\n"),
    ("groups.csv", "group|nothing", ""),
]


def test_groups(fleet, monkeypatch):
    monkeypatch.chdir(fleet.folder)
    paths = {name: fleet.file(path).relative_to(fleet.folder) for name, path in GROUPED.items()}
    for name, path in paths.items():
        fleet.store(name, ONE, path)

    def grouped(group, content):
        Path("groups.csv").write_text(content or "", encoding="utf-8")
        return fleet.run([*paths.values()], group=group).table

    expected = {"logs/mems/a.csv": "mems", "logs/mems/b.csv": "mems", "logs/fog/a.csv": "fog"}
    for group, content in GROUPS:
        table = grouped(group, content)
        assert dict(zip(table["file"], table["group"], strict=True)) == expected, group
        # Units are named in the same way.
        if content is None:
            units = fleet.run([*paths.values()], unit=group).table
            assert dict(zip(units["file"], units["unit_name"], strict=True)) == expected, group
    assert {*grouped(None, None)["group"]} == {""}
    one = {"files": [*paths.values()], "unit": "logs/(mems)/"}
    refused(fleet.run, "unit=|--unit|fog/a.csv", aj.AllanjaxError, **one)
    for group, words, content in NO_GROUPS:
        refused(lambda a=group, b=content: grouped(a, b), words, aj.AllanjaxError)


# Arguments of `characterize_fleet`, and what the error names.
WRONG = [
    ({"files": "none*.csv"}, "none*.csv"),
    ({"files": []}, "files"),
    ({"workers": 0}, "workers=|0"),
    ({"workers": 1, "scheduler": "tcp://127.0.0.1:1"}, "workers=|scheduler="),
    ({"scheduler": "nonsense://"}, "nonsense|--scheduler"),
    ({"piece": 99_999}, "piece=|100000"),
    ({"gaps": "drop"}, "gaps=", aj.RecordingError),
]


def test_wrong_arguments_and_dask_that_is_not_there_are_named(tmp_path, monkeypatch):
    (tmp_path / "a.csv").write_text("0\n")
    arguments = {"files": tmp_path / "a.csv", "out": tmp_path / "out"}
    for change, words, *error in WRONG:
        refused(aj.characterize_fleet, words, *(error or [aj.AllanjaxError]), **arguments | change)
    monkeypatch.setitem(sys.modules, "distributed", None)
    refused(aj.characterize_fleet, "allanjax[fleet]", aj.AllanjaxError, **arguments)


@pytest.mark.usefixtures("elsewhere")
def test_the_command_runs_a_cluster_of_its_own(characterized, logs):
    """The one test with processes; a recording that fails stops no others, and the exit code tells."""
    words = ["--terms", "N + K", "--plain", "--workers", 1, "--out", "out"]
    outcome = run("fleet", logs / "unit_0.parquet", "missing.csv", *words)
    assert (outcome.exit_code, "missing.csv" in outcome.stderr) == (1, True)
    assert "2 recordings: 1 without errors, 1 with errors; 0 from" in outcome.stdout
    expected = characterized[1].table.query("recording == 'unit_0'")["value"]
    np.testing.assert_allclose(pd.read_parquet("out/fleet.parquet")["value"], expected, rtol=1e-8)
    nothing = run("fleet", "*.parquet")
    assert (nothing.exit_code, "*.parquet" in nothing.stderr) == (1, True)


def test_limits_of_every_recording_in_one_table_and_one_file(characterized, logs, cluster):
    """As `check_spec` has them for each; unit_3's gyro is ten times the others'."""
    out, before = characterized
    limit = 2.0 * before.table.query("coefficient == @ARW and axis == 'gyro_x'")["value"].median()
    accel = before.table.query("coefficient == @ARW and axis == 'accel_z'")["value"].median()
    sheet = {
        "name": "acceptance",
        "gyro": {"meaning": "maximum", "random_walk": f"{limit} deg/√h"},
        "accel": {"meaning": "maximum", "random_walk": f"{accel} m/s/√h", "N": "9 m/s/√h"},
    }
    options = {"plain": True, "scheduler": cluster, "spec": sheet}
    result = aj.characterize_fleet(logs / "unit_*.parquet", out, "N + K", **options)
    names = [f"unit_{k}" for k in range(5)]
    assert [check.name for check in result.checks] == names
    expected = {}
    for name in names:
        for r in aj.check_spec(aj.load(out / "recordings" / f"{name}.json"), sheet).results:
            expected[name, r.axis, r.limit.figure] = r
    assert {name for (name, *_), r in expected.items() if r.verdict == "fail"} >= {"unit_3"}
    table = pd.read_csv(out / "fleet_spec.csv", dtype={"unit_name": str}).set_index(
        ["recording", "axis", "figure"]
    )
    assert {*table.index} == {*expected}
    assert len(table) == 5 * 3
    for key, r in expected.items():
        row = table.loc[key]
        assert (row["verdict"], row["margin"]) == (r.verdict, r.margin)
        assert row["estimate"] == pytest.approx(r.estimate.in_unit(row["unit"]).value, rel=1e-9)
    root = ElementTree.parse(out / "fleet_spec.xml").getroot()
    cases = {(case.get("classname"), case.get("name")): case for case in root.iter("testcase")}
    assert len(cases) == int(root.get("tests")) == len(expected)
    marks = {"pass": None, "fail": "failure", "undecided": "skipped"}
    for (name, axis_name, figure), r in expected.items():
        case = cases[f"{name}.{axis_name}", f"{figure.replace('_', ' ')} (maximum)"]
        found = [child.tag for child in case if child.tag != "system-out"]
        assert found == [marks[r.verdict]] * (r.verdict != "pass")
    text, notes = str(result), (out / "notes.txt").read_text(encoding="utf-8")
    assert "unit_3: gyro random walk is not met: gyro_x, margin -" in text
    assert "unit_3: gyro random walk is not met: gyro_x, margin -" in notes
    assert ("is undecided: accel_z, a record of " in text) == ("undecided" in {*table["verdict"]})
    assert "against acceptance: " in text


@pytest.mark.usefixtures("elsewhere")
def test_the_command_ends_with_the_code_of_the_limits(logs, cluster):
    words = ["--terms", "N + K", "--plain", "--scheduler", cluster, "--out", "out"]
    for limit, code in (("3 deg/√h", 1), ("9 deg/√h", 0)):
        Path("limits.yaml").write_text(f"gyro: {{meaning: maximum, N: {limit}}}", encoding="utf-8")
        done = run("fleet", logs / "unit_2.parquet", logs / "unit_3.parquet", *words, "--spec", "limits.yaml")
        assert (done.exit_code, "fleet_spec.xml" in done.stdout) == (code, True)
    printed = run("fleet", logs / "unit_2.parquet", "none.csv", *words, "--spec", "limits.yaml", "--json")
    document = json.loads(printed.stdout)
    schema("fleet").validate(document)
    assert not schema("fleet").is_valid(document | {"colour": "red"})
    assert (document["resumed"], [check["verdict"] for check in document["limits"]]) == (1, ["pass"])
    assert [error["file"] for error in document["errors"]] == ["none.csv"]
    Path("limits.yaml").write_text("gyro: {arw: 1}", encoding="utf-8")
    wrong = run("fleet", logs / "unit_2.parquet", *words, "--spec", "limits.yaml")
    assert (wrong.exit_code, "limits.yaml: gyro" in wrong.stderr) == (1, True)


@pytest.mark.usefixtures("elsewhere")
def test_sensors_of_two_rates_in_one_table_have_results_of_their_own(cluster):
    """Each row repeats the last values of the other sensor; N holds within 4 σ of so many samples."""
    rng, clocks, N = np.random.default_rng(8), {"gyro": 100.0, "accel": 62.5}, 1e-3
    time = {name: np.arange(40.0 * rate) / rate + 1e-3 * (name == "accel") for name, rate in clocks.items()}
    stamps, table = np.union1d(*time.values()), {}
    for (name, rate), unit in zip(clocks.items(), ("rad/s", "m/s^2"), strict=True):
        rows = np.maximum(np.searchsorted(time[name], stamps, "right") - 1, 0)
        own = N * np.sqrt(rate) * rng.standard_normal((len(time[name]), 3))
        table |= {f"{name}_{k} [{unit}]": x for k, x in zip("xyz", own[rows].T, strict=True)}
    pd.DataFrame({"time [s]": stamps, **table}).to_csv("both.csv", index=False)
    assert run("characterize", "both.csv", "--out", "there").exit_code == 0
    for _ in range(2):
        result = aj.characterize_fleet("both.csv", "out", scheduler=cluster)
    assert (result.resumed, {*result.table["recording"]}, len({*result.table["axis"]})) == (1, {"both"}, 6)
    of_unit = aj.load("out/recordings/both.json")
    for name, rate in clocks.items():
        fit = aj.load(f"there/both_{name}.json")
        assert fit.curve.rate == of_unit[f"both ({name})"].curve.rate == pytest.approx(rate, rel=1e-3)
        assert list(fit) == [f"{name}_{k}" for k in "xyz"]
        assert all(abs(fit[axis]["N"].value - N) < 4.0 * N / np.sqrt(2 * 40.0 * rate) for axis in fit)
    schema("fleet").validate(json.loads(Path("out/recordings/both.json").read_text(encoding="utf-8")))
    (one, two) = json.loads(run("check", "both.csv", "--json").stdout)["checks"]
    assert (one["file"], two["file"]) == ("both.csv (gyro)", "both.csv (accel)")


def test_the_printed_table_has_medians_scatter_counts_and_outlying_units(fleet):
    values = np.array([[1.0], [1.06], [0.94], [1.03], [0.97], [9.0]])
    limits = np.array([[np.nan], *5 * [[20_000.0]]])
    few = ("gyro", "bias_instability", 12_347.0 * np.ones((6, 1)), 0.05)
    lines = str(fleet.judged(("gyro", ARW, values, 0.05), (*few, limits))).splitlines()
    assert all(word in lines[1] for word in ("N (deg/√h)", "B (deg/√h)", "detected", "outlying"))
    # Their standard deviation is 0.0474, and 9 is nine times the median.
    cells = ("gyro_x", "1.000 ± 0.047", "12,350 ± 620", "N 6, B 1 of 6", "unit_5")
    assert all(cell in lines[3] for cell in cells)
    ranges = [["axis", "N 5…95 % (deg/√h)"], ["gyro_x", "0.946 … 1.054"]]
    assert [line.split(maxsplit=1) for line in lines[5:8:2]] == ranges
    # The median of all six is 1.015.
    assert lines[8] == "unit_5: outlying against the median of its group: gyro_x N ×8.87"
    # Coefficients that no unit has need no room: the table stays one.
    labels = ("drift_ramp", "quantization", "markov_amplitude", "markov_correlation_time", "rate_random_walk")
    absent = [("gyro", label, np.full((6, 1), np.nan), 0.05) for label in labels]
    shown = str(fleet.judged(("gyro", ARW, values, 0.05), (*few, limits), *absent))
    assert len(shown.splitlines()) == len(lines)
    # Where the others have limits alone, these are the median.
    *_, row, unit = str(fleet.judged((*few, limits / 1e4))).splitlines()[:5]
    assert row.split()[-1] == "unit_0"
    assert unit == "unit_0: outlying against the median of its group: gyro_x B ×6,170"


@pytest.mark.usefixtures("no_windows")
def test_the_picture_has_a_panel_per_coefficient_and_names_units(fleet, monkeypatch):
    monkeypatch.undo()
    values = np.column_stack([1.0 + 0.02 * np.arange(9), 2.0 + 0.02 * np.arange(9)])
    values[8, 1] = 30.0
    limits = np.where(np.arange(9) < 5, np.nan, 3.0 + np.arange(9))[:, None]
    parts = [("gyro", ARW, values, 0.05), ("accel", ARW, values[:, :1], 0.05)]
    fleet.out.mkdir()
    result = fleet.judged(*parts, ("gyro", "bias_instability", 1.0 + values[:, :1], 0.05, limits))
    walk, _, instability = result.plot().axes
    # Without what all names begin with.
    assert [text.get_text() for text in walk.texts] == ["8 ×14.4"]
    assert [label.get_text() for label in walk.get_xticklabels()] == ["gyro_x", "gyro_y"]
    assert [label.get_text() for label in walk.get_xticklabels(minor=True)] == [*"012345678"] * 2
    (marks,) = [line for line in instability.lines if line.get_marker() == "v"]
    np.testing.assert_allclose(marks.get_ydata(), limits[5:, 0])
    (panel,) = fleet.judged(("gyro", ARW, values[:8], 0.05), group=["a"] * 3 + ["b"] * 5).plot().axes
    points = [c for c in panel.containers if len(c.lines[0].get_xdata())]
    expected = [values[:3, 0], values[3:8, 0], values[:3, 1], values[3:8, 1]]
    for found, y in zip(points, expected, strict=True):
        np.testing.assert_allclose(found.lines[0].get_ydata(), y)
        bars = np.array(found.lines[2][0].get_segments())[:, :, 1]
        np.testing.assert_allclose(bars, np.outer(y, np.exp([-0.098, 0.098])), rtol=1e-9)
    medians = [line.get_ydata()[0] for line in panel.lines if line.get_linewidth() == 1.4]
    np.testing.assert_allclose(medians, [np.median(y) for y in expected])
    bare = aj.FleetResult(result.table.drop(columns="outlying"), (), (), 0)
    refused(bare.plot, "outlying", aj.AllanjaxError)


@pytest.mark.skipif(sys.platform == "win32", reason="names and files of POSIX")
def test_no_file_ends_a_fleet(cluster, tmp_path):
    """Names that are no text, too long, or that programs obey; a pipe, a loop of links, damaged results."""
    folder, out = tmp_path / "logs", tmp_path / "out"
    folder.mkdir()
    x = np.random.default_rng(0).standard_normal((2048, 1))
    content = io.BytesIO()
    np.save(content, x)
    names = [b"unit.npy", b"bad\xff.npy", b"\x1b[31mred.npy", b"x" * 240 + b".npy"]
    for name in names:
        Path(os.fsdecode(os.path.join(os.fsencode(folder), name))).write_bytes(content.getvalue())
    (folder / "=broken.npy").write_bytes(b"\x93NUMPY")
    os.mkfifo(folder / "pipe.npy")
    os.symlink(folder / "loop.npy", folder / "loop.npy")
    files = [*folder.iterdir()]
    options = {"scheduler": cluster, "plain": True, "rate": 100.0, "gyro_unit": "deg/s", "columns": "gyro_x"}
    first = aj.characterize_fleet(files, out, "N", **options)
    failed = {error["file"].rpartition("/")[2]: error["message"] for error in first.errors}
    assert sorted(failed) == ["=broken.npy", "loop.npy", "pipe.npy"]
    assert (len(first.table), first.resumed) == (len(names), 0)
    assert not re.search("[\x00-\x1f\udc00-\udfff]", "".join(first.table["recording"]))
    assert first.table["recording"].str.len().max() < 210
    written = (out / "errors.csv").read_text()
    assert not re.search(r"^[=+@-]", written, flags=re.MULTILINE)
    assert json.loads(json.dumps(first.to_dict()))["table"][0]["coefficient"] == ARW
    # Someone empties a stored fit, and takes the coefficients out of another one.
    stored = sorted((out / "recordings").iterdir())
    stored[0].write_text("[" * 100_000)
    document = json.loads(stored[1].read_text())
    del document["fit"]["axes"][0]["coefficients"]
    stored[1].write_text(json.dumps(document))
    again = aj.characterize_fleet(files, out, "N", **options)
    assert again.resumed == len(names) - 2
    pd.testing.assert_frame_equal(again.table, first.table)
    # Another size of pieces is another way to a result.
    assert aj.characterize_fleet(files, out, "N", piece=200_000, **options).resumed == 0
