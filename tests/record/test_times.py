"""What stamps tell: even samples, missing ones, pieces of other rates, clocks; truth is what made them."""

import json
import re

import numpy as np
import pandas as pd
import pytest
from commands import run
from imu_columns import noted, refused

import allanjax as aj

# White noise of 0.3 deg/√h, which a wrong rate would change.
DENSITY, N = 0.005, 8000


def samples(rate, n=N, seed=1):
    return np.random.default_rng(seed).normal(0.0, DENSITY * np.sqrt(rate), (n, 3))


def frame(times, x, label="time [s]", **more):
    axes = {f"gyro_{axis} [deg/s]": column for axis, column in zip("xyz", x.T, strict=True)}
    return pd.DataFrame({label: times, **more, **axes})


@pytest.fixture
def read(tmp_path):
    def read(table, **options):
        table.to_parquet(path := tmp_path / "imu.parquet")
        return aj.read(path, **options)

    return read


def density(recording):
    """White noise [deg/s/√Hz] from the differences of neighbours."""
    return np.sqrt(np.mean(np.diff(recording.values, axis=0) ** 2) / 2.0 / recording.rate) * 180.0 / np.pi


def is_right(recording, rate, n=N):
    """The rate to a thousandth, and the noise within 3 %, four standard errors of 16,000 differences."""
    assert (recording.n, recording.rate) == (n, pytest.approx(rate, rel=1e-3))
    assert density(recording) == pytest.approx(DENSITY, rel=0.03)


@pytest.mark.parametrize("rate", [476.0, 800.0, 980.0, 1600.0, 2000.0])
def test_stamps_rounded_to_a_millisecond_are_even(read, rate):
    """Whether neighbours have equal stamps or not; filling in has nothing to do."""
    table = frame(np.floor(1e6 + 1e3 * np.arange(N) / rate).astype(int), samples(rate), "timestamp_ms")
    for options in ({}, {"gaps": "fill"}, {"gaps": "segments"}, {"time": "uniform"}):
        recording = read(table, **options)
        is_right(recording, rate)
        assert recording.missing is None
    assert noted(read(table), "rounded to 1 ms")


@pytest.mark.parametrize("step", [0.0, 1e-3])
@pytest.mark.parametrize(("rate", "share"), [(200.0, 0.1), (476.0, 0.04), (800.0, 0.2)])
def test_a_link_that_loses_samples_at_random(read, rate, share, step):
    """Stamps of the sensor that jitter, or are rounded to 0.2 to 0.8 of the interval."""
    rng = np.random.default_rng(3)
    kept = np.sort(rng.permutation(np.arange(1, N))[: int((1.0 - share) * N)])
    times = (
        np.floor(kept / rate / step) * step if step else kept / rate + rng.normal(0.0, 0.02 / rate, len(kept))
    )
    table = frame(times, samples(rate)[kept])
    lost = int(kept[-1] - kept[0]) + 1 - len(kept)
    refused(lambda: read(table), f"{lost:,} |gaps='fill'|gaps='segments'")
    refused(lambda: read(table, time="uniform"), "not evenly spaced|missing|--force")
    is_right(read(table, gaps="fill"), rate, int(kept[-1] - kept[0]) + 1)
    assert read(table, time="uniform", force=True).rate < (1.0 - 0.8 * share) * rate


def test_stamps_of_arrival_scatter_about_even_times(read):
    """In bursts of eight, as a buffer is read; and each late by a random time, none before the one before."""
    even, rng = np.arange(N) / 200.0, np.random.default_rng(4)
    bursts = np.ceil((np.arange(N) + 1) / 8.0) * 0.04 + np.repeat(0.002 * rng.random(N // 8), 8)
    late = np.maximum.accumulate(even + rng.exponential(0.006, N))
    for times in (bursts, late):
        is_right(read(frame(times, samples(200.0))), 200.0)


def test_intervals_are_no_times(read):
    """As a column of the time since the last sample."""
    intervals = 0.01 + 1e-5 * np.random.default_rng(5).standard_normal(N)
    intervals[-1] = intervals.max()
    refused(lambda: read(frame(intervals, samples(100.0))), "time='none'")


def test_a_clock_may_wander_while_samples_arrive_in_bursts(read):
    """By 0.6 ‰ of the record; a pause of 2 % may be one in which samples were lost, and is not closed up."""
    number, rng = np.arange(N), np.random.default_rng(4)
    bursts = np.ceil((number + 1) / 8.0) * 0.04 + np.repeat(0.002 * rng.random(N // 8), 8)
    wander = 3e-4 * N / 200.0 * np.sin(2.0 * np.pi * number / N)
    is_right(read(frame(bursts + wander, samples(200.0))), 200.0)
    paused = bursts + 0.02 * N / 200.0 * (number > N // 2)
    refused(lambda: read(frame(paused, samples(200.0))), "")


@pytest.mark.parametrize("after", [100.0, 160.0, 250.0])
def test_pieces_of_different_rates_are_named_and_can_be_read(read, after):
    first = 3000
    times = np.append(np.arange(first) / 200.0, (first - 1) / 200.0 + np.arange(1, N - first + 1) / after)
    table = frame(times, np.concatenate([samples(200.0, first), samples(after, N - first)]))
    for options in ({}, {"gaps": "fill"}, {"time": "uniform"}):
        message = str(refused(lambda o=options: read(table, **o), f"200 Hz until|then {after:g} Hz"))
        cut = {name: float(time) for name, time in re.findall(r"(start|stop)=([\d.]+)", message)}
        (edge,) = cut.values()
        assert edge == pytest.approx(times[first - 1], abs=0.1)
        assert density(read(table, **cut)) == pytest.approx(DENSITY, rel=0.03)


def test_clocks_over_midnight_and_at_the_end_of_summer_time(read):
    x, k = samples(50.0), np.arange(N)
    start, steps = pd.Timestamp("2024-10-26 23:59:00"), pd.to_timedelta(20 * k, "ms")
    clock = (start + steps).strftime("%H:%M:%S.%f").str[:-3]
    twelve = (start + steps).strftime("%I:%M:%S.%f %p")
    comma = (start + steps).strftime("%d.%m.%Y %H:%M:%S,%f").str.replace(",", ".")
    # At three o'clock the clock is set back to two.
    turned = pd.Timestamp("2024-10-27 02:59:00") + steps - pd.to_timedelta(1 * (k >= 3000), "h")
    forward = pd.Timestamp("2024-03-31 01:59:00") + steps + pd.to_timedelta(1 * (k >= 3000), "h")
    local = [times.strftime("%Y-%m-%d %H:%M:%S.%f") for times in (turned, forward)]
    for times, words in (
        (clock, "midnight"),
        (twelve, "midnight"),
        (comma, ""),
        *((z, "summer") for z in local),
    ):
        recording = read(frame(times.to_numpy(dtype=object), x, "time"))
        is_right(recording, 50.0)
        assert not words or noted(recording, words)
    # With a zone an hour is an hour.
    zoned = turned.strftime("%Y-%m-%dT%H:%M:%S.%fZ").to_numpy(dtype=object)
    refused(lambda: read(frame(zoned, x, "time")), "goes back by 3599")
    broken = clock.to_numpy(dtype=object).copy()
    broken[77] = "soon"
    refused(lambda: read(frame(broken, x, "time")), "'time'|'soon'|row 77")


def test_of_two_clocks_the_even_one_is_taken(read):
    """Whatever their order; numbers whose unit only one rate of a sensor allows need none."""
    boot = 578_933_434_000_000 + 5_000_000 * np.arange(N)
    unix = 1_737_985_622_323 + 40 * np.ceil((np.arange(N) + 1) / 8.0).astype(np.int64)
    x = samples(200.0)
    recordings = [
        read(frame(boot, x, "t_Android", t_unix=unix)),
        read(frame(unix, x, "t_unix", t_Android=boot)),
        read(frame(unix, x, "t_unix", t_Android=boot), time="t_unix, uniform"),
    ]
    for recording in recordings:
        is_right(recording, 200.0)
    assert noted(recordings[1], "times from t_Android")
    assert noted(recordings[2], "t_unix")


@pytest.mark.parametrize(
    ("label", "step", "rate"),
    [("tow [s]", 0.01, 100.0), ("millis", 1, 1000.0), ("micros", 5000, 200.0), ("elapsed [ms]", 4, 250.0)],
)
def test_a_column_that_counts_time_is_a_clock_whatever_its_name(read, label, step, rate):
    is_right(read(frame(step * np.arange(N), samples(rate), label)), rate)
    # A duration beside samples does not increase.
    refused(lambda: read(frame(step + 0 * np.arange(N), samples(rate), label)), "no sample rate|--rate")


@pytest.mark.parametrize(
    ("header", "kinds"),
    [
        ("time [s],sensor,x,y,z", ("gyro", "accel")),
        ("time [s],type,x,y,z", ("GYR", "ACC")),
        ("", ("GYR", "ACC")),
    ],
)
def test_rows_of_several_sensors_are_read_sensor_by_sensor(tmp_path, header, kinds):
    """With or without names, both sensors at their own times; the command reads both."""
    gyro, accel = samples(100.0), samples(100.0, seed=2) + np.array([0.0, 0.0, 9.8])
    lines = [header] if header else []
    for k in range(N):
        for kind, late, x in ((kinds[0], 0.0, gyro[k]), (kinds[1], 2e-4, accel[k])):
            lines.append(f"{k / 100.0 + late:.4f},{kind}," + ",".join(map(str, x.tolist())))
    path = tmp_path / "imu.csv"
    path.write_text("\n".join([*lines, ""]))
    with pytest.raises(aj.RecordingError, match="rows of gyro and accel alternate"):
        aj.read(path)
    recording = aj.read(path, columns="gyro", gyro_unit="deg/s")
    is_right(recording, 100.0)
    np.testing.assert_allclose(recording.own_values, gyro, rtol=1e-12)
    recording = aj.read(path, columns="accel", accel_unit="m/s^2")
    assert recording.names == ("accel_x", "accel_y", "accel_z")
    np.testing.assert_allclose(recording.values, accel, rtol=1e-12)
    units = ("--gyro-unit", "deg/s", "--accel-unit", "m/s^2")
    checks = json.loads(run("check", path, *units, "--json").stdout)["checks"]
    assert len(checks) == 2


def test_columns_without_names_may_begin_with_times(tmp_path):
    """If units are given for the others; else the message shows the first row, and names that fit."""
    path = tmp_path / "imu.csv"
    np.savetxt(path, np.c_[5 * np.arange(N), samples(200.0)], delimiter=",")
    is_right(aj.read(path, gyro_unit="deg/s"), 200.0)
    message = str(refused(lambda: aj.read(path), "4 columns without names|first row is 0.0,"))
    (names,) = re.findall(r"e\.g\. (\S+)", message)
    assert len(names.split(",")) == 4
    assert aj.read(path, columns="time,gyro_x,gyro_y,gyro_z", gyro_unit="deg/s").names[0] == "gyro_x"


def test_what_is_given_is_used_or_refused(read):
    """A unit of a sensor that is not there, a unit of times without any."""
    table = frame(np.arange(N) / 100.0, samples(100.0))
    refused(lambda: read(table, accel_unit="g"), "accel_unit=|no accelerometer among time [s]")
    bare = table.drop(columns="time [s]")
    refused(lambda: read(bare, rate=100.0, time_unit="ms"), "time_unit=|--time")
    # Columns that are called x, y and z are those of the one sensor whose unit is given.
    named = table.set_axis(["time [s]", "x", "y", "z"], axis=1)
    assert read(named, gyro_unit="deg/s").names == ("gyro_x", "gyro_y", "gyro_z")


@pytest.mark.parametrize(
    ("labels", "size"),
    [
        (("sec", "usec"), 1e-6),
        (("tv_sec", "tv_usec"), 1e-6),
        (("time_s", "time_ms"), 1e-3),
        (("seconds", "microseconds"), 1e-6),
        (("header.stamp.secs", "header.stamp.nsecs"), 1e-9),
    ],
)
def test_seconds_and_parts_of_them_are_one_clock(read, labels, size):
    """A pause of whole seconds shows in the seconds only; times that are complete are no pair."""
    ticks = np.rint((0.123 + np.arange(N) / 250.0) / size).astype(np.int64)
    whole, parts = np.divmod(ticks, round(1.0 / size))
    x = samples(250.0)
    recording = read(frame(1_709_290_800 + whole, x, labels[0], **{labels[1]: parts}))
    is_right(recording, 250.0)
    assert noted(recording, f"{labels[0]} + {labels[1]}")
    paused = whole + 7 * (np.arange(N) >= 3000)
    refused(lambda: read(frame(paused, x, labels[0], **{labels[1]: parts})), "gap of 7.004 s")
    if labels[0] == "time_s":
        is_right(read(frame(ticks * size, x, labels[0], **{labels[1]: ticks})), 250.0)


def test_a_rate_that_no_sensor_has_puts_the_clock_in_doubt_and_no_unit(tmp_path):
    path = tmp_path / "imu.csv"
    frame(4000.0 * np.arange(N), samples(200.0)).to_csv(path, index=False)
    checks = {c["name"]: c for c in json.loads(run("check", path, "--json").stdout)["checks"][0]["lines"]}
    assert checks["rate"]["verdict"] == "look"
    assert "0.00025 Hz" in checks["rate"]["reason"]
    assert "--time-unit" in checks["rate"]["reason"]
    assert "cannot be checked" in checks["gyro unit"]["reason"]


def test_rows_out_of_order_are_sorted_by_even_times(read):
    """A few places off, as packets are; with a missing sample; not where stamps are those of arrival."""
    order, x = np.arange(N), samples(100.0)
    for first in range(50, N - 50, 400):
        order[first : first + 3] = order[first : first + 3][[2, 0, 1]]
    recording = read(frame(order / 100.0, x[order]))
    is_right(recording, 100.0)
    np.testing.assert_allclose(recording.own_values, x, rtol=1e-9)
    assert noted(recording, "rows that are out of order are sorted")
    kept = np.delete(order, 3000)
    refused(lambda: read(frame(kept / 100.0, x[kept])), "gap of 0.02 s|gaps='fill'")
    late = np.arange(N) / 100.0 + np.random.default_rng(5).exponential(0.01, N)
    assert not noted(read(frame(late, x)), "out of order")


def test_a_clock_that_was_set_back_is_no_counter_that_overflows(read):
    """Both go on; one is at any time, the other near zero."""
    k, x = np.arange(N), samples(100.0)
    unix = read(frame(1_709_290_800.0 + k / 100.0 - 3600.0 * (k >= 3000), x, "unix_time"))
    is_right(unix, 100.0)
    assert noted(unix, "is set back once, by 3,600 s")
    micros = read(frame((2**32 - 10_000_000 + 10_000 * k) % 2**32, x, "micros"))
    is_right(micros, 100.0)
    assert noted(micros, "starts again once, like a counter that overflows")


def test_a_check_shows_what_reading_found(read, tmp_path):
    table = frame(np.arange(N) / 100.0, samples(100.0))
    table.iloc[np.arange(100, 6000, 150), 1:] = 0.0
    recording = read(table)
    assert recording.missing.sum() == 3 * 40
    words = "gyro: 40 samples are exactly 0 on all axes: failed reads"
    assert noted(recording, words)
    assert words in " ".join(str(aj.check(recording)).split())
    (document,) = json.loads(run("check", tmp_path / "imu.parquet", "--json").stdout)["checks"]
    assert document["notes"] == list(recording.notes)
    # Coarse numbers are often zero on all axes.
    coarse = frame(np.arange(N) / 100.0, np.round(samples(100.0) / DENSITY / 10.0))
    assert read(coarse).missing is None
    refused(lambda: read(table[:1], rate=100.0, time="none"), "too short: 1 sample, but")
