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


@pytest.fixture
def written(tmp_path):
    def write(table):
        table.to_csv(tmp_path / "imu.csv", index=False)
        return tmp_path / "imu.csv"

    return write


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
