"""Files of results: JSON after its schema with all numbers in both units, and CSV tables."""

import dataclasses
import json
import math

import bench
import jsonschema
import numpy as np
import pandas as pd
import pytest
from commands import run

import allanjax as aj

pytestmark = pytest.mark.usefixtures("elsewhere")
# SI to the usual units, by hand.
DEG = math.pi / 180
USUAL = {
    ("gyro", "quantization"): ("arcsec", DEG / 3600, "rad"),
    ("gyro", "angle_random_walk"): ("deg/√h", DEG / 60, "rad/√s"),
    ("gyro", "bias_instability"): ("deg/h", DEG / 3600, "rad/s"),
    ("gyro", "rate_random_walk"): ("deg/h/√h", DEG / 3600 / 60, "rad/s/√s"),
    ("gyro", "drift_ramp"): ("deg/h²", DEG / 3600**2, "rad/s²"),
    ("accel", "quantization"): ("m/s", 1.0, "m/s"),
    ("accel", "angle_random_walk"): ("m/s/√h", 1 / 60, "m/s/√s"),
    ("accel", "bias_instability"): ("µg", 9.80665e-6, "m/s²"),
    ("accel", "rate_random_walk"): ("m/s/h/√h", 1 / 3600 / 60, "m/s²/√s"),
    ("accel", "drift_ramp"): ("m/s/h²", 1 / 3600**2, "m/s³"),
}
NAMES = ["gyro_x", "gyro_y", "gyro_z", "accel_z"]


def schema(name):
    printed = json.loads(run("schema", name).stdout)
    jsonschema.Draft202012Validator.check_schema(printed)
    return jsonschema.Draft202012Validator(printed)


def failed():
    """The fit of "small", had its second axis not converged."""
    first, second, *others = bench.fit("small").results
    second = dataclasses.replace(second, converged=False, reason="the start was hopeless")
    return dataclasses.replace(bench.fit("small"), results=(first, second, *others))


def test_json_has_the_fits_numbers_in_both_units(tmp_path):
    fit = bench.fit("small")
    aj.write_json(fit, tmp_path / "fit.json")
    document = json.loads((tmp_path / "fit.json").read_text(encoding="utf-8"))
    schema("fit").validate(document)
    assert document["schema_version"] == 1
    assert document["recording"] == {"name": "small", "n": 16_384, "rate_hz": 100.0, "duration_s": 163.84}
    assert document["converged"] is True
    assert [axis["name"] for axis in document["axes"]] == NAMES
    assert [axis["unit"] for axis in document["axes"]] == ["deg/s", "deg/s", "deg/s", "g"]
    for axis, result in zip(document["axes"], fit.results, strict=True):
        numbers = ("chi2", "dof", "p_value", "discrepancy")
        assert [axis[name] for name in numbers] == [getattr(result, name) for name in numbers]
        assert axis["covariance"]["labels"] == list(result.coefficients)
        np.testing.assert_array_equal(axis["covariance"]["values"], result.covariance)
        si_units = [USUAL[axis["sensor"], label][2] for label in result.coefficients]
        assert axis["covariance"]["units"] == si_units
        for entry, c in zip(axis["coefficients"], result.coefficients.values(), strict=True):
            unit, scale, si_unit = USUAL[axis["sensor"], entry["label"]]
            assert (entry["unit"], entry["si"]["unit"]) == (unit, si_unit)
            assert entry["detected"] == c.detected
            own = {
                "value": c.value,
                "std": c.std,
                "interval_95": c.interval,
                "interval_68": c.interval_68,
                "upper_limit_95": c.upper_limit,
            }
            for name, value in own.items():
                np.testing.assert_array_equal(np.array(entry["si"][name], float), np.array(value, float))
                told = np.array(entry[name], float) * scale
                np.testing.assert_allclose(told, np.array(value, float), rtol=1e-12)
    assert {entry["detected"] for axis in document["axes"] for entry in axis["coefficients"]} == {True, False}
    assert aj.load(tmp_path / "fit.json").results[0].coefficients == fit.results[0].coefficients


def test_an_axis_without_result_has_nulls_and_a_reason(tmp_path):
    document = json.loads(json.dumps(aj.to_dict(failed()), allow_nan=False))
    schema("fit").validate(document)
    axis = document["axes"][1]
    assert document["converged"] is False
    assert (axis["reason"], axis["coefficients"]) == ("the start was hopeless", [])
    assert axis["chi2"] is axis["p_value"] is axis["discrepancy"] is None
    aj.write_coefficients_csv(failed(), tmp_path / "failed.csv")
    written = pd.read_csv(tmp_path / "failed.csv").set_index("axis")
    assert written.loc["gyro_y", "reason"] == "the start was hopeless"
    assert math.isnan(written.loc["gyro_y", "value"])
    assert len(written) == 16


def test_a_dead_axis_is_told():
    dead = np.column_stack([bench.recording("white").values, np.zeros(16_384)])
    names = ["gyro_x", "gyro_y"]
    recording = aj.Recording.from_array(dead, 100.0, names=names, gyro_unit="rad/s")
    document = json.loads(json.dumps(aj.to_dict(aj.fit(recording, "N"))))
    assert [axis["dead"] for axis in document["axes"]] == [False, True]
    schema("fit").validate(document)


def _less(document, *keys):
    for key in keys[:-1]:
        document = document[key]
    del document[keys[-1]]


DOCUMENTS = {
    "fit": lambda: aj.to_dict(bench.fit("small")),
    "critique": lambda: bench.critique("lines").to_dict(),
    "horizon": lambda: aj.horizon(bench.fit("small"), 10.0).to_dict(),
}
SPOILT = {
    "fit": [
        lambda d: d.update(schema_version=2),
        lambda d: _less(d, "axes", 0, "coefficients", 0, "si"),
        lambda d: d["axes"][0]["coefficients"][0].update(value="NaN"),
    ],
    "critique": [
        lambda d: d.update(schema_version=2),
        lambda d: _less(d, "axes", 0, "findings"),
        lambda d: d["findings"][0].update(gain_nats="NaN"),
    ],
    "horizon": [lambda d: d.update(colour="red"), lambda d: _less(d, "axes", 0, "white", "si")],
}


@pytest.mark.parametrize("name", DOCUMENTS)
def test_schemas_take_what_is_written_and_nothing_else(name):
    document = json.loads(json.dumps(DOCUMENTS[name](), allow_nan=False))
    validator = schema(name)
    validator.validate(document)
    for spoil in SPOILT[name]:
        other = json.loads(json.dumps(document))
        spoil(other)
        assert not validator.is_valid(other)


def test_the_curve_is_in_the_recordings_own_units(tmp_path):
    fit = bench.fit("small")
    aj.write_curve_csv(fit, tmp_path / "curve.csv")
    table = pd.read_csv(tmp_path / "curve.csv")
    axes = (
        ("gyro_x", "deg/s", DEG),
        ("gyro_y", "deg/s", DEG),
        ("gyro_z", "deg/s", DEG),
        ("accel_z", "g", 9.80665),
    )
    curve = fit.curve
    np.testing.assert_array_equal(table["cluster_time [s]"], curve.cluster_time)
    lower, upper = curve.confidence_interval(0.68)
    for k, (name, unit, scale) in enumerate(axes):
        expected = {"deviation": curve.deviation[:, k], "lower_68": lower[:, k], "upper_68": upper[:, k]}
        expected["model"] = fit.model_deviation(name, curve.cluster_time)
        for kind, values in expected.items():
            np.testing.assert_allclose(table[f"{name} {kind} [{unit}]"] * scale, values, rtol=1e-12)
    assert len(table.columns) == 17
    # An axis without result has no model; one of increments is in SI rates.
    first, *others = failed().results
    increments = dataclasses.replace(first.axis, unit="arcsec")
    other = dataclasses.replace(failed(), results=(dataclasses.replace(first, axis=increments), *others))
    aj.write_curve_csv(other, tmp_path / "failed.csv")
    table = pd.read_csv(tmp_path / "failed.csv")
    assert table["gyro_y model [deg/s]"].isna().all()
    assert table.drop(columns="gyro_y model [deg/s]").notna().all(axis=None)
    np.testing.assert_allclose(table["gyro_x deviation [rad/s]"], curve.deviation[:, 0], rtol=1e-12)


def test_the_table_of_coefficients_has_their_numbers(tmp_path):
    fit = bench.fit("small")
    aj.write_coefficients_csv(fit, tmp_path / "c.csv")
    written = pd.read_csv(tmp_path / "c.csv").set_index(["axis", "coefficient"])
    for result in fit.results:
        for label, c in result.coefficients.items():
            row, (unit, scale, _) = written.loc[result.axis.name, label], USUAL[result.axis.sensor, label]
            assert (row["unit"], row["detected"], row["held"], row["measured"]) == (
                unit,
                c.detected,
                False,
                True,
            )
            numbers = row[["value", "std", "lower_95", "upper_95", "upper_limit_95"]].to_numpy(float) * scale
            limit = math.nan if c.upper_limit is None else c.upper_limit
            np.testing.assert_allclose(numbers, [c.value, c.std, *c.interval, limit], rtol=1e-12)


# Critiques.


def test_a_critiques_document_has_the_numbers_of_its_findings():
    critique = bench.critique("lines")
    document = json.loads(json.dumps(critique.to_dict(), allow_nan=False))
    assert document["recording"] == {"name": "lines", "n": 16_384, "rate_hz": 100.0, "duration_s": 163.84}
    assert document["gain_nats"] == critique.gain
    assert len(document["findings"]) == len(critique.findings)
    for told, finding in zip(document["findings"], critique.findings, strict=True):
        assert (told["cause"], tuple(told["axes"])) == (finding.cause, finding.axes)
        for key, value in (
            ("p_value", finding.p_value),
            ("evidence_nats", finding.evidence),
            ("gain_nats", finding.gain),
        ):
            assert told[key] == value
        for name, e in finding.parameters.items():
            own = told["parameters"][name]
            assert (own["value"], own["std"], own["unit"]) == (e.value, e.std, e.unit)
        for name, e in finding.amplitudes.items():
            assert (told["amplitudes"][name]["value"], told["amplitudes"][name]["unit"]) == (e.value, e.unit)
        assert told["rivals"] == [{"cause": r.cause, "odds": r.odds} for r in finding.rivals]
    for told, axis in zip(document["axes"], critique.results, strict=True):
        assert told["axis"] == axis.axis.name
        N = told["extended"]["parameters"]["angle_random_walk"]
        unit, scale, _ = USUAL[axis.axis.sensor, "angle_random_walk"]
        assert N["unit"] == unit
        assert N["value"] * scale == pytest.approx(axis.model.values["angle_random_walk"])
        # Beside the truth, to 3 %.
        assert N["value"] * scale == pytest.approx(
            bench.truth("lines").truth[axis.axis.name]["angle_random_walk"], rel=0.03
        )
        for d, one in zip(told["discrepancies"], axis.before, strict=True):
            assert (d["statistic"], d["p_value"], d["measured"]) == (one.statistic, one.p_value, one.measured)


def test_a_story_tells_what_was_found_and_where():
    """Cause, axes, frequency and gain; its lines are short."""
    critique = bench.critique("lines")
    told, details = str(critique), critique.details()
    finding = max((f for f in critique.findings if f.cause == "sinusoid"), key=lambda f: f.gain)
    frequency = finding.parameters["frequency"]
    for text in (told, details):
        assert all(axis in text for axis in finding.axes)
        assert "sinusoid" in text
        assert max(len(line) for line in text.splitlines()) <= 108
        assert " nan" not in text
    assert f"{critique.gain:,.0f} nats" in " ".join(told.split())
    assert frequency.in_unit().describe().split(" ")[0][:5] in " ".join(details.split())
    clean = str(bench.critique("clean_1"))
    assert "nothing found" in clean
