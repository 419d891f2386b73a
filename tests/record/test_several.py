"""Files of several sensors, in rows or in cells: each is told apart, and none is taken for another."""

import numpy as np
import pandas as pd
import pytest
from imu_columns import noted, refused

import allanjax as aj

N, NOISE = 1500, 0.1
AXES = ["gx_dps", "gy_dps", "gz_dps"]


def samples(seed, n=N):
    return np.round(np.random.default_rng(seed).normal([0.1, -0.2, 0.3], NOISE, (n, 3)), 5)


def two(name, kinds, late=0.0, after=0.0, **more):
    """Rows of two sensors at 100 Hz, one later than the other, in the order of time or of sensors."""
    tables = []
    for k, kind in enumerate(kinds):
        times = np.arange(N) / 100.0 + late * k
        table = pd.DataFrame(samples(k), columns=AXES).assign(**{name: kind}, order=times + after * k)
        tables.append(table.assign(time=times))
    rows = pd.concat(tables).sort_values(["order", name], kind="stable")
    return rows.rename(columns={"time": "time [s]"})[["time [s]", name, *AXES]]


@pytest.mark.parametrize(
    ("name", "kinds", "late", "after"),
    [
        ("sensor_id", (0, 1), 0.0, 0.0),
        ("sensor", ("imu_left", "imu_right"), 4e-4, 0.0),
        ("I", (0, 1), 1.2e-5, 0.0),
        ("device", ("A", "B"), 0.005, 0.0),
        # One below the other, and a name that tells nothing of rows whose times do.
        ("imu", (3, 7), 0.0, 1e3),
        ("where", ("left", "right"), 0.002, 0.0),
    ],
)
def test_a_column_names_the_sensor_of_each_row(written, name, kinds, late, after):
    path = written(two(name, kinds, late, after))
    for options in ({}, {"gaps": "segments"}, {"gaps": "fill"}, {"time": "none", "rate": 100.0}):
        if name == "where" and "rate" in options:
            continue
        refused(
            lambda o=options: aj.read(path, **o), f"{name!r}|2 sensors: {kinds[0]}, {kinds[1]}|--instance"
        )
    for k, kind in enumerate(kinds):
        recording = aj.read(path, instance=kind)
        assert (recording.n, recording.rate) == (N, pytest.approx(100.0, rel=1e-6))
        np.testing.assert_allclose(recording.own_values, samples(k), rtol=1e-9)
        assert noted(recording, f"1,500 of 3,000 rows are of sensor {kind}")
    refused(lambda: aj.read(path, instance="none of them"), f"{kinds[1]}, and not none of them")


def test_a_sensor_further_down_is_not_read_on_in_chunks(written):
    path = written(two("sensor_id", (0, 1), after=1e3))
    refused(lambda: list(aj.read_chunks(path, chunk=500, time="none", rate=100.0)), "0 and 1 among|instance=")
    refused(lambda: aj.read_chunks(path, chunk=2000), "2 sensors: 0, 1|instance=")


@pytest.mark.parametrize("name", ["sensor_id", "I", "status", "id"])
def test_a_column_that_does_not_tell_sensors_apart_does_no_harm(written, name):
    """One sensor alone, a mode that changes while the times go on, and a number that counts up."""
    one = pd.DataFrame(samples(0), columns=AXES)
    one.insert(0, "time [s]", np.arange(N) / 100.0)
    values = {"status": np.arange(N) // 500 % 2, "id": np.arange(N)}.get(name, 0)
    path = written(one.assign(**{name: values}))
    recording = aj.read(path)
    np.testing.assert_allclose(recording.own_values, samples(0), rtol=1e-9)
    assert list(aj.read_chunks(path, chunk=500))
    refused(lambda: aj.read(path, instance=0), "no column names several sensors|omit instance=")


GYRO, ACCEL = samples(3), samples(4) + np.array([0.0, 0.0, 9.5])
TIME, UNITS = np.round(np.arange(N) / 100.0, 2), {"gyro_unit": "rad/s", "accel_unit": "m/s^2"}


def is_both(recording):
    assert recording.rate == pytest.approx(100.0, rel=1e-6)
    names = [f"{sensor}_{axis}" for sensor in ("gyro", "accel") for axis in "xyz"]
    own = dict(zip(recording.names, recording.values.T, strict=True))
    np.testing.assert_allclose([own[name] for name in names], np.hstack([GYRO, ACCEL]).T, rtol=1e-9)


def structured(path):
    fields = [("stamp [s]", "f8"), ("w", "f8", 3), ("acc", "f8", 3)]
    np.save(path, np.array([*zip(TIME, GYRO, ACCEL, strict=True)], fields))


def of_lists(path):
    frame = pd.DataFrame({"t [s]": TIME, "gyro": [*GYRO.tolist()], "accel": [*ACCEL.tolist()]})
    frame.to_parquet(path)


def of_cells(form):
    def write(path):
        cells = [[form.format(*row) for row in x.tolist()] for x in (GYRO, ACCEL)]
        rows = [",".join(map(str, row)) for row in zip(TIME.tolist(), *cells, strict=True)]
        path.write_text("\n".join(["timestamp,gyro,accel", *rows, ""]))

    return write


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("imu.npy", structured),
        ("imu.parquet", of_lists),
        ("quoted.csv", of_cells('"[{}, {}, {}]"')),
        ("bare.csv", of_cells("[{},{},{}]")),
        ("numpy.csv", of_cells("[{} {} {}]")),
        ("tuple.csv", of_cells('"({}, {}, {})"')),
    ],
)
def test_cells_of_three_numbers_are_three_axes(tmp_path, name, write):
    write(tmp_path / name)
    is_both(aj.read(tmp_path / name, **UNITS))


def test_lists_of_a_data_frame_and_of_other_lengths(tmp_path):
    is_both(aj.Recording.from_dataframe({"time [s]": TIME, "gyro": GYRO, "accel": ACCEL}, **UNITS))
    frame = pd.DataFrame({"time [s]": TIME, "gyro": [*GYRO.tolist()], "accel": [*ACCEL.tolist()]})
    is_both(aj.Recording.from_dataframe(frame, **UNITS))
    two = frame.assign(gyro=[x[: 2 + k % 2] for k, x in enumerate(GYRO.tolist())])
    refused(lambda: aj.Recording.from_dataframe(two, **UNITS), "'gyro'|different lengths")
    two.to_parquet(tmp_path / "two.parquet")
    refused(tmp_path / "two.parquet", "Parquet|write it again", **UNITS)
    # Names that fit no number are not taken for those of others.
    rows = [f'{t},"[{a}, {b}, {c}]",{d}' for t, (a, b, c), (d, _, _) in zip(TIME, GYRO, ACCEL, strict=True)]
    (tmp_path / "odd.csv").write_text("\n".join(["timestamp,gyro", *rows, ""]))
    refused(tmp_path / "odd.csv", "columns=", **UNITS, rate=100.0)


def test_omega_and_f_are_a_gyro_and_an_accelerometer(tmp_path):
    """As matrices, or as columns; f alone may be anything."""
    np.savez(tmp_path / "imu.npz", omega=GYRO, f=ACCEL, t=TIME)
    labels = ["wx", "wy", "wz", "fx", "fy", "fz"]
    columns = dict(zip(labels, np.hstack([GYRO, ACCEL]).T, strict=True))
    pd.DataFrame({"t [s]": TIME, **columns}).to_csv(tmp_path / "imu.csv", index=False)
    for name in ("imu.npz", "imu.csv"):
        is_both(aj.read(tmp_path / name, **UNITS))
        refused(tmp_path / name, "accel_unit=", kind=aj.UnitError, gyro_unit="rad/s")
    np.savez(tmp_path / "force.npz", f=ACCEL, other=TIME, t=TIME)
    refused(tmp_path / "force.npz", "no gyro or accelerometer column")


def test_sensors_of_two_rates_in_one_row_with_empty_cells(tmp_path):
    """They are told apart whatever is asked for about gaps, and each is read at its own rate."""
    slow = np.arange(N) % 4 == 1
    table = pd.DataFrame({"t [s]": np.arange(N) / 200.0})
    for name, unit, x in (("g", "deg/s", GYRO), ("a", "m/s^2", ACCEL)):
        table = table.assign(**{f"{name}{axis} [{unit}]": x[:, k] for k, axis in enumerate("xyz")})
    table.iloc[~slow, 4:] = np.nan
    table.to_csv(path := tmp_path / "imu.csv", index=False)
    for gaps in (None, "segments", "fill"):
        rates = r"gyro at 200.1 Hz and accel at 50.03 Hz.*columns='gyro'.*columns='accel'"
        with pytest.raises(aj.RecordingError, match=rates):
            aj.read(path, gaps=gaps)
        recording = aj.read(path, columns="accel", gaps=gaps)
        assert recording.rate == pytest.approx(50.0, rel=1e-6)
        np.testing.assert_allclose(recording.values, ACCEL[slow], rtol=1e-9)
        assert recording.missing is None
        assert aj.read(path, columns="gyro", gaps=gaps).rate == pytest.approx(200.0, rel=1e-6)
    # The first row may have a sample.
    table[1:].to_csv(path, index=False)
    np.testing.assert_allclose(aj.read(path, columns="accel").values, ACCEL[slow], rtol=1e-9)
