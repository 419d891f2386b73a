"""Files of results: JSON after its schema with all numbers in both units, and CSV tables."""

import dataclasses
import json
import math

import bench
import numpy as np
import pandas as pd
import pytest
from altered_fits import without_result
from commands import schema

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


def test_json_has_the_fits_numbers_in_both_units_and_csv_in_usual_ones(tmp_path):
    fit = bench.fit("small")
    aj.write_json(fit, tmp_path / "fit.json")
    document = json.loads((tmp_path / "fit.json").read_text(encoding="utf-8"))
    schema("fit").validate(document)
    about = {"name": "small", "n": 16_384, "rate_hz": 100.0, "duration_s": 163.84}
    assert document["recording"] == about
    assert (document["schema_version"], document["converged"]) == (1, True)
    assert [axis["name"] for axis in document["axes"]] == NAMES
    assert [axis["unit"] for axis in document["axes"]] == ["deg/s", "deg/s", "deg/s", "g"]
    aj.write_coefficients_csv(fit, "c.csv")
    table = pd.read_csv("c.csv").set_index(["axis", "coefficient"])
    for axis, result in zip(document["axes"], fit.results, strict=True):
        for name in ("chi2", "dof", "p_value", "discrepancy"):
            assert axis[name] == getattr(result, name)
        covariance = axis["covariance"]
        assert covariance["labels"] == list(result.coefficients)
        assert covariance["units"] == [USUAL[axis["sensor"], name][2] for name in result.coefficients]
        np.testing.assert_array_equal(covariance["values"], result.covariance)
        for entry, c in zip(axis["coefficients"], result.coefficients.values(), strict=True):
            (unit, scale, si_unit), row = USUAL[axis["sensor"], c.label], table.loc[axis["name"], c.label]
            assert (entry["label"], entry["si"]["unit"]) == (c.label, si_unit)
            assert (entry["unit"], entry["detected"]) == (row.unit, row.detected) == (unit, c.detected)
            assert (row.held, row.measured) == (False, True)
            limit = math.nan if c.upper_limit is None else c.upper_limit
            own = [c.value, c.std, *c.interval, limit]
            for told, factor in ((entry, scale), (entry["si"], 1.0)):
                ends = [*told["interval_95"], told["upper_limit_95"], *told["interval_68"]]
                numbers = np.array([told["value"], told["std"], *ends], float) * factor
                np.testing.assert_allclose(numbers, [*own, *c.interval_68], rtol=1e-12)
            written = row[["value", "std", "lower_95", "upper_95", "upper_limit_95"]].to_numpy(float)
            np.testing.assert_allclose(written * scale, own, rtol=1e-12)
    assert {entry["detected"] for axis in document["axes"] for entry in axis["coefficients"]} == {True, False}
    assert aj.load(tmp_path / "fit.json").results[0].coefficients == fit.results[0].coefficients


def test_an_axis_without_result_has_nulls_and_a_reason():
    failed = without_result(bench.fit("small"), "gyro_y")
    document = json.loads(json.dumps(aj.to_dict(failed), allow_nan=False))
    schema("fit").validate(document)
    axis = document["axes"][1]
    assert document["converged"] is False
    assert (axis["reason"], axis["coefficients"]) == ("the start was hopeless", [])
    assert axis["chi2"] is axis["p_value"] is axis["discrepancy"] is None
    # The end of an interval that is infinite is left empty in a table.
    first, *others = failed.results
    N = dataclasses.replace(first["N"], interval=(0.0, math.inf))
    endless = dataclasses.replace(first, _coefficients={**first.coefficients, "angle_random_walk": N})
    aj.write_coefficients_csv(dataclasses.replace(failed, results=(endless, *others)), "failed.csv")
    written = pd.read_csv("failed.csv").set_index("axis")
    assert written.loc["gyro_y", "reason"] == "the start was hopeless"
    assert math.isnan(written.loc["gyro_y", "value"])
    assert written.coefficient[written.upper_95.isna()].iloc[0] == "angle_random_walk"
    assert len(written) == 16


@pytest.mark.parametrize("name", ["fit", "critique", "horizon"])
def test_schemas_take_what_is_written_and_nothing_else(name):
    makes = {"fit": lambda fit: fit, "horizon": lambda fit: aj.horizon(fit, 10.0)}
    result = makes[name](bench.fit("small")) if name in makes else bench.critique("lines")
    document, validator = json.loads(json.dumps(result.to_dict(), allow_nan=False)), schema(name)
    validator.validate(document)
    axis = document["axes"][0]
    assert not validator.is_valid(document | {"schema_version": 2, "colour": "red"})
    axis.pop({"fit": "covariance", "critique": "findings", "horizon": "white"}[name])
    assert not validator.is_valid(document)


def test_the_curve_is_in_the_recordings_own_units():
    fit = bench.fit("small")
    aj.write_curve_csv(fit, "curve.csv")
    table = pd.read_csv("curve.csv")
    axes = (*((name, "deg/s", DEG) for name in NAMES[:3]), ("accel_z", "g", 9.80665))
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
    first, *others = without_result(fit, "gyro_y").results
    increments = dataclasses.replace(first, axis=dataclasses.replace(first.axis, unit="arcsec"))
    aj.write_curve_csv(dataclasses.replace(fit, results=(increments, *others)), "failed.csv")
    table = pd.read_csv("failed.csv")
    assert table["gyro_y model [deg/s]"].isna().all()
    assert table.drop(columns="gyro_y model [deg/s]").notna().all(axis=None)
    np.testing.assert_allclose(table["gyro_x deviation [rad/s]"], curve.deviation[:, 0], rtol=1e-12)


def test_a_critique_prints_its_findings_and_a_line_for_each_axis():
    critique = bench.critique("lines")
    brief, details = str(critique), critique.details()
    (finding,) = critique.findings
    (row,) = [line for line in brief.splitlines() if "spectral line" in line]
    assert f"{finding.parameters['frequency'].value:.4g} Hz" in row
    assert row.endswith(f" {finding.gain:,.0f}")
    assert finding.parameters["frequency"].in_unit().describe()[:5] in details
    for text in (brief, details):
        assert max(map(len, text.splitlines())) <= 100
        assert f"{critique.gain:,.0f} nats" in text
        assert [*critique] == [line.split(":")[0] for line in text.splitlines() if " in all 13 tests" in line]
    assert "no findings" in str(bench.critique("clean_1"))
