"""Values where a sensor has no sample: markers, failed reads, held values, wraps; with known truth."""

import numpy as np
import pandas as pd
import pytest
from imu_columns import SIX, noted, refused

import allanjax as aj

RATE, N = 200.0, 20_000
UNITS = {"gyro_unit": "deg/s/131", "accel_unit": "g/16384"}


@pytest.fixture(scope="module")
def counts():
    """Counts of a consumer sensor at rest."""
    rng = np.random.default_rng(6)
    gyro = rng.normal([20.0, -35.0, 12.0], 9.3, (N, 3))
    accel = rng.normal([0.0, 0.0, 16384.0], 23.0, (N, 3))
    return np.rint(np.hstack([gyro, accel])).astype(int)


@pytest.fixture
def read(tmp_path):
    def read(x, stream=False, **options):
        times = {"time_ms": 5 * np.arange(len(x))}
        pd.DataFrame(times | dict(zip(SIX, x.T, strict=True))).to_parquet(path := tmp_path / "imu.parquet")
        if stream:
            return np.concatenate([*aj.read_chunks(path, **UNITS | options)])
        return aj.read(path, **UNITS | options)

    return read


def agrees(recording, truth, lost):
    """Samples that were not lost are those that were written, and lost ones are filled in as noise is."""
    np.testing.assert_array_equal(recording.missing.T, np.broadcast_to(lost, truth.T.shape))
    own = np.rint(recording.own_values)
    np.testing.assert_array_equal(own[~recording.missing], truth[~recording.missing])
    rms = [np.std(np.diff(x, axis=0), axis=0) for x in (recording.own_values, truth)]
    # Some 1 % of the samples are drawn anew, so that the rms changes by far less.
    np.testing.assert_allclose(rms[0], rms[1], rtol=0.02)


def test_failed_reads_are_left_out_on_all_axes(counts, read):
    """Zero is far from gravity only, but stands on all axes at once."""
    x, lost = counts.copy(), np.zeros(N, bool)
    for first in np.random.default_rng(7).choice(N - 10, 30, replace=False):
        lost[first : first + 3] = True
    x[lost] = 0
    recording = read(x)
    agrees(recording, counts, lost)
    assert noted(recording, "failed reads")
    refused(lambda: read(x, stream=True), "accel_z|failed reads|without --stream")


def test_a_marker_concerns_its_sensor_alone(counts, read):
    x, lost = counts.copy(), np.zeros(N, bool)
    lost[np.random.default_rng(8).choice(np.arange(10, N - 10), 150, replace=False)] = True
    x[lost, :3] = -32768
    recording = read(x)
    agrees(recording, counts, (np.arange(6)[:, None] < 3) & lost)
    assert noted(recording, "150 samples are exactly -32768")


def test_ends_without_samples_are_cut(counts, read):
    """A marker until a sensor has started, and zeros after a logger has stopped."""
    x = counts.copy()
    x[:40, :3] = -32768
    x[-500:] = 0
    recording = read(x)
    np.testing.assert_array_equal(np.rint(recording.own_values), counts[40:-500])
    assert recording.missing is None
    assert noted(recording, "540 rows at the ends")


def test_a_sensor_at_half_the_rate_of_its_rows(counts, read):
    x = counts.copy()
    x[1::2, :3] = -32768
    with pytest.raises(aj.RecordingError, match=r"gyro at 100 Hz and accel at 200 Hz.*--columns gyro"):
        read(x)
    gyro = read(x, columns="gyro", accel_unit=None)
    assert gyro.rate == pytest.approx(100.0)
    np.testing.assert_array_equal(np.rint(gyro.own_values), counts[::2, :3])


def test_numbers_that_have_wrapped_are_shifted_back(counts, read):
    """Signed counts that were read as unsigned ones of 16 bits; half of the samples are below zero."""
    x = counts.copy()
    x[:, 0] -= 20
    wrapped = x % 65_536
    recording = read(wrapped)
    np.testing.assert_array_equal(np.rint(recording.own_values), x)
    assert noted(recording, "wrapped at 16 bits")


def test_counts_without_their_sign_have_none_on_any_axis(counts, read):
    """An axis far from zero does not wrap itself, and is known by the others of the file."""
    x = counts.copy()
    x[:, 4] -= 279
    wrapped = x % 65_536
    assert wrapped[:, 4].min() > 65_000
    recording = read(wrapped)
    np.testing.assert_array_equal(np.rint(recording.own_values), x)
    assert noted(recording, "accel: ", "wrapped at 16 bits")
    refused(lambda: read(wrapped, accel_unit=None), "accel_unit='g/16384'", aj.UnitError)
    # Without an axis that wraps, or beside numbers that are no counts, nothing tells of a sign.
    large = counts + np.array([100, 100, 100, 500, 40_000, 500])
    for other in (large, np.hstack([wrapped[:, :3], large[:, 3:] + 0.5])):
        np.testing.assert_allclose(read(other).own_values[:, 4], other[:, 4], rtol=1e-9)


def test_what_is_constant_at_an_end_is_no_record(counts, read):
    """Whatever the constant is: zeros near the mean of gyros, or the last sample again and again."""
    for constant in (0, counts[-301, :3]):
        x = counts[:, :3].copy()
        x[-300:] = constant
        recording = read(np.hstack([x, counts[:, 3:]]))["gyro"]
        # The first of the constant values may be a sample.
        assert recording.n in (N - 300, N - 301)
        np.testing.assert_array_equal(np.rint(recording.own_values), counts[: recording.n, :3])


def test_a_value_that_is_held_for_seconds_is_no_sample(counts, read):
    x = counts.copy()
    x[5000:5600] = x[4999]
    recording = read(x)
    held = (np.arange(N) >= 5000) & (np.arange(N) < 5600)
    np.testing.assert_array_equal(recording.missing, np.broadcast_to(held[:, None], (N, 6)))
    assert noted(recording, "600 samples repeat")


def test_what_only_looks_like_it_is_kept(counts, read):
    """A sensor turned over, a knock, saturation, coarse output: none of these is a marker or a wrap."""
    rng = np.random.default_rng(9)
    turned = counts.copy()
    turned[N // 2 :, 5] *= -1
    knocked = counts + np.rint(3000.0 * np.exp(-(((np.arange(N) - 9000) / 8.0) ** 2))).astype(int)[:, None]
    saturated = np.minimum(counts, [10**6, 10**6, 20, 10**6, 10**6, 16400])
    coarse = np.rint(counts / [40, 40, 40, 100, 100, 100]).astype(int)
    coarse[rng.choice(N, 5, replace=False), 0] += 1
    for x in (turned, knocked, saturated, coarse):
        recording = read(x)
        assert recording.missing is None
        np.testing.assert_array_equal(np.rint(recording.own_values), x)
