"""What a second run of a fleet takes from the first, what it computes anew, and what it says of the rest."""

import json
from contextlib import nullcontext
from dataclasses import fields, replace
from pathlib import Path

import pandas as pd
import pytest

from allanjax import AngleRandomWalk, LowPass, Markov
from allanjax.fleet import fleet
from allanjax.fleet import store as fleet_store
from allanjax.fleet.fleet import characterize_fleet
from allanjax.fleet.options import FitOptions
from allanjax.fleet.store import key_of
from allanjax.noise.model import Model
from allanjax.noise.notation import parse_model
from allanjax.record.io import ReadOptions

READING = {
    "gaps": "fill",
    "rate": 200.0,
    "gyro_unit": "deg/h",
    "accel_unit": "mg",
    "columns": "gyro_x",
    "time": "clock",
    "time_unit": "ms",
    "start": 1.0,
    "stop": 9.0,
    "topic": "/imu",
    "instance": 1,
}
OTHER = {
    "model": parse_model("N + B"),
    "objective": "whittle",
    "regressors": ("temperature",),
}
MODELS = {
    "held": Model((Markov(correlation_time=10.0).hold("correlation_time"),)),
    "free": Model((Markov(correlation_time=10.0),)),
    "started elsewhere": Model((Markov(correlation_time=10.000000001),)),
    "first order": Model((LowPass(bandwidth=3.0),)),
    "second order": Model((LowPass(bandwidth=3.0, order=2),)),
    "two of them": Model((AngleRandomWalk(), AngleRandomWalk())),
    "a held amplitude": parse_model("N=1 deg/sqrt(h) held + B"),
    "none": None,
}


@pytest.fixture
def files(tmp_path):
    """Three recordings, of which nothing but their size and time is looked at."""
    paths = [tmp_path / "logs" / name for name in ("a.csv", "b.csv", "c.csv")]
    paths[0].parent.mkdir()
    for path in paths:
        path.write_text("0\n", encoding="utf-8")
    return paths


@pytest.fixture
def run(files, tmp_path, monkeypatch):
    """Runs a fleet whose fits are made up; gives the result, and the names of what was computed."""
    computed = []

    def outcomes(client, calls):
        computed.extend(calls)
        for name in calls:
            yield name, made_up(name)

    monkeypatch.setattr(fleet, "connected", lambda *arguments: nullcontext())
    monkeypatch.setattr(fleet, "outcomes", outcomes)
    monkeypatch.setattr(fleet.FleetResult, "plot", lambda *arguments: None)

    def called(*paths, **options):
        computed.clear()
        result = characterize_fleet(list(paths) or files, tmp_path / "out", **options)
        return result, sorted(computed)

    return called


def made_up(name, *, failed=False):
    """A fit of one gyro with or without a second axis that has no result, as `export.to_dict` gives it."""
    coefficient = {"label": "angle_random_walk", "term": "angle_random_walk", "value": 1.0, "std": 0.1}
    coefficient |= {"interval_95": [0.8, 1.2], "unit": "deg/√h", "detected": True, "upper_limit_95": None}
    coefficient |= {"measured": True}
    axis = {"name": "gyro_x", "sensor": "gyro", "converged": True, "reason": "", "p_value": 0.5}
    axis |= {"coefficients": [coefficient], "selection": None, "extension": None}
    bad = {**axis, "name": "gyro_y", "converged": False, "reason": "constant", "coefficients": []}
    axes = [axis, bad] if failed else [axis]
    return {"axes": axes, "name": name, "warnings": [], "stretch_s": None}


@pytest.mark.parametrize("field", [option.name for option in fields(ReadOptions)])
def test_each_option_of_reading_is_part_of_a_results_key(files, field):
    other = FitOptions(replace(ReadOptions(), **{field: READING[field]}))
    assert key_of(files[0], other) != key_of(files[0], FitOptions())
    assert key_of(files[0], other) == key_of(files[0], replace(other))


@pytest.mark.parametrize("field", [option.name for option in fields(FitOptions) if option.name != "reading"])
def test_each_option_of_fitting_is_part_of_a_results_key(files, field):
    default = getattr(FitOptions(), field)
    value = OTHER.get(field, not default if isinstance(default, bool) else None)
    assert value != default, f"give another {field} in OTHER"
    assert key_of(files[0], replace(FitOptions(), **{field: value})) != key_of(files[0], FitOptions())


def test_models_that_differ_in_anything_have_keys_that_differ(files):
    keys = {name: json.dumps(key_of(files[0], FitOptions(model=model))) for name, model in MODELS.items()}
    assert len(set(keys.values())) == len(MODELS)
    again = FitOptions(model=Model((LowPass(bandwidth=3.0, order=2),)))
    assert json.dumps(key_of(files[0], again)) == keys["second order"]


@pytest.mark.parametrize(
    "change",
    [
        {"objective": "whittle"},
        {"regressors": ["temperature"]},
        {"model": MODELS["held"]},
        {"model": MODELS["free"]},
        {"stop": 5.0},
    ],
    ids=str,
)
def test_a_run_with_another_option_computes_all_anew(run, change):
    assert run()[1] == ["a", "b", "c"]
    assert run()[1] == []
    result, computed = run(**change)
    assert (computed, result.resumed) == (["a", "b", "c"], 0)
    assert run(**change)[0].resumed == 3


def test_a_run_of_another_version_computes_all_anew(run, monkeypatch):
    run()
    monkeypatch.setattr(fleet_store, "version", lambda package: "99.0")
    assert run()[1] == ["a", "b", "c"]


def test_an_axis_without_result_is_an_error_again_when_resumed(run, files, monkeypatch, tmp_path):
    monkeypatch.setattr(fleet, "outcomes", lambda _, calls: [(n, made_up(n, failed=n == "b")) for n in calls])
    error = {"file": str(files[1]), "message": "gyro_y: no result, constant"}
    for resumed in (0, 3):
        result, _ = run()
        assert result.resumed == resumed
        assert result.errors == (error,)
        assert pd.read_csv(tmp_path / "out" / "errors.csv").to_dict("records") == [error]
        assert "2 without an error, 1 with" in str(result)
        assert len(result.table) == 3


def test_recordings_that_are_left_out_are_told(run, files, tmp_path):
    run()
    result, computed = run(files[2])
    assert (computed, result.resumed) == ([], 1)
    assert list(result.table["recording"]) == ["c"]
    (note, *_) = result.notes
    assert note.startswith("2 recordings of an earlier run are not among these files and are left out of ")
    assert f"fleet.parquet: {files[0]}, {files[1]}. What was computed stays in " in note
    assert note in str(result)
    assert note in result._repr_html_()
    assert (tmp_path / "out" / "notes.txt").read_text(encoding="utf-8").splitlines() == list(result.notes)
    # Named again they are there again, and nothing is said.
    whole, computed = run()
    assert (computed, whole.resumed) == ([], 3)
    assert not any("left out" in note for note in whole.notes)


def test_names_of_recordings_may_change_from_run_to_run(run, tmp_path):
    """Of two files of one name each is told by its folder; of one alone it is not."""
    paths = [tmp_path / folder / "imu.csv" for folder in ("x", "y")]
    for path in paths:
        path.parent.mkdir()
        path.write_text("0\n", encoding="utf-8")
    assert run(paths[0])[1] == ["imu"]
    assert run(paths[1])[1] == ["imu"]
    both, computed = run(*paths)
    assert (computed, both.resumed) == ([], 2)
    assert list(both.table["recording"]) == ["x_imu", "y_imu"]
    alone, computed = run(paths[1])
    assert (computed, list(alone.table["recording"])) == ([], ["imu"])
    assert "1 recording of an earlier run is not among these files" in alone.notes[0]
    stored = {path.name for path in (tmp_path / "out" / "recordings").iterdir()}
    assert stored == {"imu.json", "x_imu.json"}


def test_what_is_no_result_is_passed_over(run, tmp_path):
    folder = tmp_path / "out" / "recordings"
    folder.mkdir(parents=True)
    for name, text in (("a", "{"), ("b", "[1]"), ("c", '{"key": 1, "fit": {}}'), ("note", '"x"')):
        (folder / f"{name}.json").write_text(text, encoding="utf-8")
    result, computed = run()
    assert computed == ["a", "b", "c"]
    assert not any("left out" in note for note in result.notes)


def test_options_in_json_are_plain(files):
    options = FitOptions(ReadOptions(**READING), parse_model("N + markov(correlation_time=100 s held)"))
    text = json.dumps(options.to_dict(), allow_nan=False)
    assert json.loads(text) == options.to_dict()
    assert key_of(Path("gone.csv"), options) is None
