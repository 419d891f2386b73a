"""Files of a fit."""

import dataclasses
import json
import math
from importlib.resources import files

import jsonschema
import numpy as np
import pandas as pd
import pytest

from allanjax.estimate.as_json import to_dict
from allanjax.record.recording import Recording
from allanjax.record.units import unit_scale
from allanjax.report.files import write_coefficients_csv, write_curve_csv, write_json, write_results
from allanjax.spectrum.psd import power_spectrum

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


@pytest.fixture(scope="module")
def schema():
    return json.loads(files("allanjax.report").joinpath("fit.schema.json").read_text(encoding="utf-8"))


def test_json_has_the_fits_numbers_in_both_units(small_fit, schema, tmp_path):
    write_json(small_fit, tmp_path / "fit.json")
    document = json.loads((tmp_path / "fit.json").read_text(encoding="utf-8"))
    jsonschema.validate(document, schema)
    assert document["schema_version"] == 1
    assert document["recording"] == {"name": "small", "n": 20_000, "rate_hz": 100.0, "duration_s": 200.0}
    assert document["converged"] is True
    assert [axis["name"] for axis in document["axes"]] == ["gyro_x", "gyro_y", "gyro_z", "accel_z"]
    assert [axis["unit"] for axis in document["axes"]] == ["deg/s", "deg/s", "deg/s", "g"]
    for axis, result in zip(document["axes"], small_fit.results, strict=True):
        assert axis["chi2"] == result.chi2
        assert axis["dof"] == result.dof
        assert axis["covariance"]["labels"] == list(result.coefficients)
        np.testing.assert_array_equal(axis["covariance"]["values"], result.covariance)
        si_units = [USUAL[axis["sensor"], label][2] for label in result.coefficients]
        assert axis["covariance"]["units"] == si_units
        for entry, c in zip(axis["coefficients"], result.coefficients.values(), strict=True):
            unit, scale, si_unit = USUAL[axis["sensor"], entry["label"]]
            assert (entry["unit"], entry["si"]["unit"]) == (unit, si_unit)
            assert entry["detected"] == c.detected
            assert entry["si"]["value"] == c.value
            assert entry["si"]["interval_95"] == list(c.interval)
            np.testing.assert_allclose(entry["value"] * scale, c.value, rtol=1e-12)
            np.testing.assert_allclose(entry["std"] * scale, c.std, rtol=1e-12)
            np.testing.assert_allclose(np.array(entry["interval_95"]) * scale, c.interval, rtol=1e-12)
            np.testing.assert_allclose(entry["upper_limit_95"] * scale, c.upper_limit, rtol=1e-12)
    assert {entry["detected"] for axis in document["axes"] for entry in axis["coefficients"]} == {True, False}


def test_the_si_units_are_si():
    for (sensor, _), (_, _, si_unit) in USUAL.items():
        assert unit_scale(si_unit, sensor) == 1.0


def test_an_axis_without_result_has_nulls_and_a_reason(half_failed_fit, schema):
    document = to_dict(half_failed_fit)
    jsonschema.validate(document, schema)
    json.dumps(document, allow_nan=False)
    failed = document["axes"][1]
    assert document["converged"] is False
    assert failed["reason"] == "the start was hopeless"
    assert failed["coefficients"] == []
    assert failed["chi2"] is failed["p_value"] is failed["discrepancy"] is None


@pytest.mark.parametrize("change", ["schema_version", "missing", "nan"])
def test_the_schema_refuses_what_it_does_not_describe(small_fit, schema, change):
    document = to_dict(small_fit)
    if change == "schema_version":
        document["schema_version"] = 2
    elif change == "missing":
        del document["axes"][0]["coefficients"][0]["si"]
    else:
        document["axes"][0]["coefficients"][0]["value"] = "NaN"
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(document, schema)


def test_curve_in_the_recordings_own_units(small_fit, half_failed_fit, tmp_path):
    write_curve_csv(small_fit, tmp_path / "curve.csv")
    table = pd.read_csv(tmp_path / "curve.csv")
    kinds = ("deviation", "lower_68", "upper_68", "model")
    axes = (("gyro_x", "deg/s"), ("gyro_y", "deg/s"), ("gyro_z", "deg/s"), ("accel_z", "g"))
    assert list(table) == [
        "cluster_time [s]",
        *(f"{a} {kind} [{unit}]" for a, unit in axes for kind in kinds),
    ]
    curve = small_fit.curve
    np.testing.assert_array_equal(table["cluster_time [s]"], curve.cluster_time)
    np.testing.assert_allclose(table["gyro_y deviation [deg/s]"] * DEG, curve.deviation[:, 1], rtol=1e-12)
    np.testing.assert_allclose(table["accel_z deviation [g]"] * 9.80665, curve.deviation[:, 3], rtol=1e-12)
    upper = curve.confidence_interval(0.68)[1]
    np.testing.assert_allclose(table["gyro_x upper_68 [deg/s]"] * DEG, upper[:, 0], rtol=1e-12)
    model = small_fit.model_deviation("accel_z", curve.cluster_time)
    np.testing.assert_allclose(table["accel_z model [g]"] * 9.80665, model, rtol=1e-12)

    write_curve_csv(half_failed_fit, tmp_path / "failed.csv")
    table = pd.read_csv(tmp_path / "failed.csv")
    assert table["gyro_y model [deg/s]"].isna().all()
    assert table.drop(columns="gyro_y model [deg/s]").notna().all(axis=None)


def test_curve_of_increments_is_in_si_rates(small_fit, tmp_path):
    values = np.random.default_rng(0).normal(size=100)
    axis = Recording.from_array(values, 10.0, gyro_unit="arcsec", names=["gyro_x"]).axes[0]
    first = dataclasses.replace(small_fit.results[0], axis=axis)
    fit = dataclasses.replace(small_fit, results=(first, *small_fit.results[1:]))
    write_curve_csv(fit, tmp_path / "curve.csv")
    table = pd.read_csv(tmp_path / "curve.csv")
    np.testing.assert_allclose(table["gyro_x deviation [rad/s]"], fit.curve.deviation[:, 0], rtol=1e-12)


def test_coefficients_are_the_table(small_fit, half_failed_fit, tmp_path):
    write_coefficients_csv(small_fit, tmp_path / "c.csv")
    written, table = pd.read_csv(tmp_path / "c.csv"), small_fit.to_dataframe()
    for column in table:
        if table[column].dtype == float:
            np.testing.assert_allclose(written[column], table[column].to_numpy(float), rtol=1e-12)
        else:
            assert list(written[column]) == list(table[column])
    write_coefficients_csv(half_failed_fit, tmp_path / "failed.csv")
    written = pd.read_csv(tmp_path / "failed.csv").set_index("axis")
    assert written.loc["gyro_y", "reason"] == "the start was hopeless"
    assert math.isnan(written.loc["gyro_y", "value"])
    assert len(written) == 16


def test_all_results(small_fit, small_recording, tmp_path):
    paths = write_results(small_fit, power_spectrum(small_recording), tmp_path / "a" / "b", "unit 1")
    assert [path.name for path in paths] == [
        "unit 1.json",
        "unit 1_allan.csv",
        "unit 1_coefficients.csv",
        "unit 1_allan.png",
        "unit 1_psd.png",
    ]
    assert all(path.stat().st_size > 500 for path in paths)
