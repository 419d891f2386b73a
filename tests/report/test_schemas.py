"""Every JSON that a command writes follows the schema that `allanjax schema` prints."""

import importlib
import json
import sys
from pathlib import Path

import jsonschema
import numpy as np
import pandas as pd
import pytest
from commands import run

import allanjax as aj
from allanjax.fleet import store as fleet_store
from allanjax.fleet.options import FitOptions
from allanjax.record.io import write

pytestmark = pytest.mark.usefixtures("elsewhere")


def validator(name):
    printed = json.loads(run("schema", name).stdout)
    jsonschema.Draft202012Validator.check_schema(printed)
    return jsonschema.Draft202012Validator(printed)


@pytest.fixture
def recorded(small_recording, half_failed_fit, monkeypatch):
    """A file whose fit has an axis without result."""
    write(small_recording, "small.csv")
    monkeypatch.setattr("allanjax.report.allan_figure.plot_allan", lambda fit, path: None)
    monkeypatch.setattr("allanjax.report.spectrum_figure.plot_psd", lambda spectrum, fit, path: None)
    monkeypatch.setattr(
        sys.modules["allanjax.fleet.options"], "fit_inspected", lambda *args, **options: half_failed_fit
    )
    return Path("small.csv")


def test_of_characterize(recorded):
    of_fit = validator("fit")
    for words in ([recorded], [recorded, "none.csv"], ["none.csv"]):
        done = run("characterize", *words, "--json", "--out", "there")
        bundle = json.loads(done.stdout)
        of_fit.validate(bundle)
        assert len(bundle["errors"]) == len(words)
    written = json.loads(Path("there/small.json").read_text("utf-8"))
    of_fit.validate(written)
    assert written["check"]["recording"]["n"] == 20_000
    # The entries of a bundle are closed: their file is named, and nothing else is in them.
    bundle = json.loads(run("characterize", recorded, "--json").stdout)
    (entry,) = bundle["fits"]
    for wrong in (written, {**entry, "colour": "red"}, {**entry, "schema_version": 0}):
        assert not of_fit.is_valid({**bundle, "fits": [wrong]})
    assert not of_fit.is_valid(entry)
    assert not of_fit.is_valid({**bundle, "errors": [{"file": "a.csv"}]})


def test_of_check(recorded):
    of_check = validator("check")
    table = pd.read_csv(recorded)
    table.loc[9000:, "time [s]"] += 1.0
    table.to_csv("gap.csv", index=False)
    done = run("check", recorded, "gap.csv", "none.csv", "--json")
    bundle = json.loads(done.stdout)
    of_check.validate(bundle)
    assert [entry["verdict"] for entry in bundle["checks"]] == ["look", "stop"]
    assert done.exit_code == len(bundle["errors"]) == 1
    (first, _) = bundle["checks"]
    assert {entry["detected"] for entry in first["lengths"]} == {True, False}
    assert not of_check.is_valid({**bundle, "checks": [{**first, "verdict": "good"}]})


def test_of_a_dead_axis(small_recording):
    values = np.column_stack([small_recording.values, np.zeros(small_recording.n)])
    names = [*small_recording.names, "accel"]
    recording = aj.Recording.from_array(values, 100.0, names=names, gyro_unit="rad/s", accel_unit="m/s^2")
    document = json.loads(json.dumps(aj.to_dict(aj.fit(recording, aj.AngleRandomWalk()))))
    assert [axis["dead"] for axis in document["axes"]] == [False] * 4 + [True]
    validator("fit").validate(document)


def test_of_critique(monkeypatch):
    values = np.random.default_rng(0).normal(size=(2048, 1))
    recording = aj.Recording.from_array(values, 10.0, gyro_unit="deg/s", names=["gyro_x"])
    for name in ("a.csv", "b.csv"):
        write(recording, name)
    found = aj.critique(recording)
    package = importlib.import_module("allanjax.critic.critique")
    monkeypatch.setattr(package, "critique", lambda recording, **options: found)
    pictures = importlib.import_module("allanjax.report.critique_figure")
    monkeypatch.setattr(pictures, "plot_critique", lambda critique, folder: None)
    of_critique = validator("critique")
    for words in (["a.csv"], ["a.csv", "b.csv"], ["none.csv"], ["a.csv", "none.csv"]):
        done = run("critique", *words, "--json", "--out", "there")
        document = json.loads(done.stdout)
        of_critique.validate(document)
        assert len(document["errors"]) == ("none.csv" in words)
        assert ("critiques" in document) == (words != ["a.csv"])
    of_critique.validate(json.loads(Path("there/a_critique.json").read_text("utf-8")))


def test_of_a_fleets_recordings(recorded, half_failed_fit):
    options = FitOptions(model=aj.Model((aj.Markov(correlation_time=3.0),)))
    key = fleet_store.key_of(recorded, options)
    fleet_store.store(Path(), "small", {"key": key, "fit": aj.to_dict(half_failed_fit)})
    document = json.loads(Path("small.json").read_text("utf-8"))
    of_fleet = validator("fleet")
    of_fleet.validate(document)
    assert not of_fleet.is_valid({**document, "key": {**key, "options": {}}})
    assert not of_fleet.is_valid({"key": key, "fit": {}})


def test_another_schema_is_a_wrong_command_line():
    assert run("schema", "colours").exit_code == 2
