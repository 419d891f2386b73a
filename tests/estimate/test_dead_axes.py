"""An axis without noise, constant or without a number, is named; the others are characterized."""

import json

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

import allanjax as aj
from allanjax.base.errors import AllanjaxError, FitError, RecordingError
from allanjax.cli.app import app
from allanjax.estimate.as_json import to_dict
from allanjax.fleet import fleet
from allanjax.fleet.options import FitOptions
from allanjax.noise.terms import AngleRandomWalk
from allanjax.record.io import read, read_chunks

NAN = float("nan")
RATE = 100.0
LIVING = ("gyro_x", "gyro_y", "gyro_z", "accel_z")
DEAD = {
    "accel_x": "constant, 0.25 g throughout, as of a sensor that is stuck or not connected",
    "accel_y": "not a single number in it, as of a sensor that is not connected",
}


@pytest.fixture
def whole(small_recording):
    """All six axes in their own units: those of the small recording, a stuck one, and one without numbers."""
    columns = dict(zip(LIVING, small_recording.own_values.T, strict=True))
    columns |= {"accel_x": np.full(small_recording.n, 0.25), "accel_y": np.full(small_recording.n, NAN)}
    names = [f"{sensor}_{axis}" for sensor in ("gyro", "accel") for axis in "xyz"]
    return pd.DataFrame({name: columns[name] for name in names})


@pytest.fixture
def path(whole, tmp_path):
    """A file of it."""
    stamped = whole.rename(columns=lambda name: f"{name} [{'deg/s' if 'gyro' in name else 'g'}]")
    stamped.insert(0, "time [s]", np.arange(len(whole)) / RATE)
    stamped.to_csv(tmp_path / "imu.csv", index=False)
    return tmp_path / "imu.csv"


def made(table):
    return aj.Recording.from_array(
        table.to_numpy(), RATE, names=list(table), gyro_unit="deg/s", accel_unit="g"
    )


def reasons(dead):
    return {d.axis.name: d.reason for d in dead}


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_read_keeps_the_others(small_recording, path, suffix):
    if suffix == ".parquet":
        # As a logger that had nothing to write: cells without a value, not NaN.
        table = pd.read_csv(path).astype({"accel_y [g]": object})
        path = path.with_suffix(suffix)
        table.where(table.notna(), None).to_parquet(path)
    for recording in (read(path), read(path, start=5.0, stop=20.0)):
        assert recording.names == LIVING
        assert reasons(recording.dead) == DEAD
        assert {"accel_x left out: constant", "accel_y left out: not a single number in it"} < set(
            recording.notes
        )
        assert "without accel_x, accel_y" in repr(recording)
    np.testing.assert_allclose(read(path).values, small_recording.values, rtol=1e-12)


def test_of_what_is_chosen(whole):
    recording = made(whole)
    assert recording["accel"].names == ("accel_z",)
    assert reasons(recording["accel"].dead) == DEAD
    assert recording["gyro"].dead == recording["accel_z"].dead == ()
    with pytest.raises(RecordingError, match="accel_x was left out: constant"):
        recording["accel_x"]


def test_an_axis_may_be_dead_in_a_stretch(whole):
    whole.loc[:4999, "gyro_y"] = 0.5
    recording = made(whole)
    assert "gyro_y" not in reasons(recording.dead)
    assert set(reasons(recording.between(10.0, 40.0).dead)) == {*DEAD, "gyro_y"}
    assert recording.between(40.0, 60.0).dead == recording.dead


@pytest.mark.parametrize("rows", [slice(1, None), slice(0, 9999), slice(10_000, None)])
def test_a_part_without_numbers_is_an_error_still(whole, tmp_path, rows):
    whole.loc[rows, "gyro_y"] = NAN
    with pytest.raises(RecordingError, match=r"'gyro_y'.* not finite numbers"):
        made(whole)
    np.save(tmp_path / "imu.npy", whole.to_numpy())
    chunks = read_chunks(
        tmp_path / "imu.npy", rate=RATE, chunk=1000, columns=list(whole), gyro_unit="deg/s", accel_unit="g"
    )
    with pytest.raises(RecordingError, match=r"'gyro_y'.* not finite numbers.* at row "):
        list(chunks)


def test_characterize(path, small_fit, monkeypatch):
    monkeypatch.chdir(path.parent)
    monkeypatch.setenv("ALLANJAX_CACHE", "off")
    result = CliRunner().invoke(app, ["characterize", str(path), "--json", "--out", "results"])
    assert result.exit_code == 1
    messages = [f"{name}: no result, {reason}" for name, reason in DEAD.items()]
    for message in messages:
        assert f"error: {path}: {message}" in result.stderr
    document = json.loads(result.stdout)
    assert document["errors"] == [{"file": str(path), "message": message} for message in messages]
    (fit,) = document["fits"]
    assert {axis["name"]: axis["dead"] for axis in fit["axes"]} == {
        **dict.fromkeys(LIVING, False),
        **dict.fromkeys(DEAD, True),
    }
    assert not fit["converged"]
    for axis, expected in zip(fit["axes"], small_fit.results, strict=False):
        values = [c["si"]["value"] for c in axis["coefficients"]]
        # A file has 15 digits.
        assert values == pytest.approx([c.value for c in expected.coefficients.values()], rel=1e-5)
    table = pd.read_csv("results/imu_coefficients.csv").set_index("axis")
    assert table.loc[list(DEAD), "reason"].to_dict() == DEAD


def test_the_fit_tells_it(whole):
    fit = aj.fit(made(whole), AngleRandomWalk())
    assert fit.axes == LIVING
    assert fit.without_result == DEAD
    (row,) = [line for line in str(fit).splitlines() if "accel_x" in line]
    assert "no result: constant, 0.25 g throughout" in row
    assert "accel_x" in fit._repr_html_()
    assert not fit.converged
    with pytest.raises(FitError, match="accel_x: no result, constant"):
        fit["accel_x"]


def test_streams(small_recording, path):
    accumulator = aj.accumulate(read_chunks(path, chunk=3000))
    assert reasons(accumulator.dead) == DEAD
    alone = aj.AllanAccumulator(RATE, small_recording.axes)
    alone.update(small_recording.values)
    np.testing.assert_allclose(accumulator.result().deviation, alone.result().deviation, rtol=1e-9)
    accumulator.snapshot(path.parent / "state.npz")
    restored = aj.AllanAccumulator.restore(path.parent / "state.npz")
    assert restored.dead == accumulator.dead
    fit, expected = (a.fit(AngleRandomWalk()) for a in (restored, alone))
    assert fit.without_result == DEAD
    for axis in fit.results:
        walk = expected[axis.axis.name]["angle_random_walk"]
        assert axis["angle_random_walk"].value == pytest.approx(walk.value, rel=1e-6)


def test_pieces_of_which_one_has_numbers(small_recording):
    def piece(first, value):
        samples = small_recording.values[first : first + 1000].copy()
        samples[:, 1] = value
        accumulator = aj.AllanAccumulator(RATE, small_recording.axes, start=first)
        accumulator.update(samples)
        return accumulator

    assert reasons(piece(0, NAN).merge(piece(1000, NAN)).dead) == {"gyro_y": DEAD["accel_y"]}
    assert piece(0, 0.0).merge(piece(1000, 1.0)).dead == ()
    with pytest.raises(AllanjaxError, match="gyro_y has no number in one of the pieces"):
        piece(0, NAN).merge(piece(1000, 1.0))
    with pytest.raises(AllanjaxError, match="sample 1000 of gyro_y is not finite"):
        piece(0, NAN).update(small_recording.values[:10])
    with pytest.raises(AllanjaxError, match="sample 0 of gyro_x is not finite"):
        aj.AllanAccumulator(RATE, ["gyro_x"]).update(np.array([NAN, NAN]))
    still = aj.AllanAccumulator(RATE, ["gyro_x"])
    still.update(np.zeros(100))
    with pytest.raises(FitError, match="gyro_x is constant, 0 rad/s throughout"):
        still.fit()


def test_a_fleet_reports_it(path):
    fit = fleet.characterize_recording(path, FitOptions(model=aj.Model((AngleRandomWalk(),))))
    assert fleet._axes_without_result(to_dict(fit)) == [f"{n}: no result, {DEAD[n]}" for n in DEAD]
