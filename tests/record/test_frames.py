"""Recordings to data frames and back."""

import dataclasses

import numpy as np
import pandas as pd
import pytest

from allanjax.base.errors import RecordingError, UnitError
from allanjax.record.io import read
from allanjax.record.recording import Recording

UNITS = {"gyro_unit": "deg/s", "accel_unit": "mg"}
NAMES = ("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z")


def made(gyro_unit: str = "deg/s", accel_unit: str = "mg", decimals: int = 3, n: int = 2000) -> Recording:
    """Numbers with so many decimals, as files hold them, and a rate that no time stamps give exactly."""
    rng = np.random.default_rng(3)
    values = np.round(rng.normal(0.0, 3.0, (n, 6)), decimals)
    values[:, 4] = 7.0
    return Recording.from_array(
        values,
        123.4567,
        gyro_unit=gyro_unit,
        accel_unit=accel_unit,
        auxiliary={"temperature": np.linspace(20.0, 30.0, n), "time": np.arange(n), "count": np.arange(n)},
        name="unit 1",
    )


@pytest.mark.parametrize(
    ("gyro_unit", "accel_unit"), [("deg/s", "mg"), ("rad/s", "m/s²"), ("arcsec", "ft/s"), ("deg/h", "µg")]
)
@pytest.mark.parametrize("si", [False, True])
def test_a_recording_comes_back_from_its_frame(gyro_unit: str, accel_unit: str, si: bool) -> None:
    """Values, rate, axes with their units, other columns, name, notes and dead axes, to the last digit."""
    recording = made(gyro_unit, accel_unit)
    frame = recording.to_dataframe(si=si)
    units = ("rad/s", "m/s²") if si else (recording.axes[0].unit, recording.axes[3].unit)
    assert [*frame.columns[1:4]] == [f"gyro_{k} [{units[0]}]" for k in "xyz"]
    assert [*frame.columns[4:6]] == [f"accel_{k} [{units[1]}]" for k in "xz"]
    back = Recording.from_dataframe(frame)
    np.testing.assert_array_equal(back.values, recording.values)
    assert back == recording
    assert (back.name, back.dead[0].axis.name) == ("unit 1", "accel_y")


def test_samples_come_back_in_si_to_the_last_digit_wherever_they_come_from() -> None:
    """Of samples that are no multiples of their unit, its numbers round once more; SI ones do not."""
    values = np.random.default_rng(0).normal(size=(20_000, 3))
    recording = dataclasses.replace(made(n=20_000)["gyro"], values=values)
    exact = Recording.from_dataframe(recording.to_dataframe(si=True))
    assert exact == recording
    assert {axis.unit for axis in exact.axes} == {"deg/s"}
    rounded = Recording.from_dataframe(recording.to_dataframe()).values
    assert (abs(rounded - values) <= np.spacing(abs(values))).all()
    assert (rounded != values).any()


def test_numbers_of_a_file_are_those_of_the_frame(tmp_path) -> None:
    numbers = pd.DataFrame(np.round(np.random.default_rng(1).normal(0, 3, (500, 3)), 2))
    numbers.columns = [f"gyro_{k} [deg/s]" for k in "xyz"]
    numbers.to_csv(tmp_path / "imu.csv", index=False)
    recording = read(tmp_path / "imu.csv", rate=100)
    frame = recording.to_dataframe()[[*numbers.columns]]
    np.testing.assert_allclose(frame, numbers, rtol=3e-16, atol=0.0)
    assert Recording.from_dataframe(recording.to_dataframe()) == recording


def test_a_frame_keeps_what_it_says_in_parquet(tmp_path) -> None:
    recording = made()
    recording.to_dataframe().to_parquet(tmp_path / "imu.parquet")
    assert Recording.from_dataframe(pd.read_parquet(tmp_path / "imu.parquet")) == recording


def test_rows_at_the_ends_and_columns_may_be_left_out() -> None:
    recording = made()
    frame = recording.to_dataframe()
    part = Recording.from_dataframe(frame[100:1100].drop(columns=["count", "gyro_y [deg/s]"]))
    np.testing.assert_array_equal(part.values, recording.values[100:1100, [0, 2, 3, 4]])
    assert (part.rate, part.names) == (123.4567, ("gyro_x", "gyro_z", "accel_x", "accel_z"))
    assert [*part.auxiliary] == ["temperature", "time"]


def test_a_frame_that_was_changed_is_read_by_its_columns() -> None:
    """Thinned out, renamed or joined, what was stated of it does not hold."""
    frame = made()["gyro"].to_dataframe().drop(columns="time")
    thin = Recording.from_dataframe(frame[::2])
    assert thin.rate == pytest.approx(123.4567 / 2.0, rel=1e-9)
    assert (thin.name, thin.dead) == ("", ())
    renamed = frame.rename(columns={f"gyro_{k} [deg/s]": f"gyro_{k} [rad/s]" for k in "xyz"})
    turned = Recording.from_dataframe(renamed)
    np.testing.assert_array_equal(turned.values[:, 0], frame["gyro_x [deg/s]"])
    with pytest.raises(RecordingError, match="gap"):
        Recording.from_dataframe(frame.drop(index=range(500, 600)))
    frame.loc[5, "gyro_x [deg/s]"] = np.nan
    with pytest.raises(RecordingError, match=r"gyro_x.*1 value is not a finite number"):
        Recording.from_dataframe(frame)


def test_a_frame_of_the_users_own() -> None:
    values = np.random.default_rng(0).normal(size=(100, 3))
    frame = pd.DataFrame(values, columns=list(NAMES[:3]))
    recording = Recording.from_dataframe(frame, 50.0, gyro_unit="deg/s")
    np.testing.assert_allclose(recording.values, np.deg2rad(values))
    with pytest.raises(UnitError, match="'gyro_x' has no unit"):
        Recording.from_dataframe(frame, 50.0)
    # An option counts, also of a frame that states its own.
    chosen = Recording.from_dataframe(
        made()["gyro"].to_dataframe().drop(columns="time"), names=["time", "gyro_z"]
    )
    assert chosen.names == ("gyro_z",)
