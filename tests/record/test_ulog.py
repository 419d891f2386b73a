"""PX4's logs give what was written into them, in rad/s and m/s², at the times of sampling."""

import sys

import numpy as np
import pytest
from flight_logs import structured, write_ulog
from places import DATA

from allanjax.base.errors import RecordingError
from allanjax.record.io import read

N = 300
GYROS, ACCELS = ("gyro_x", "gyro_y", "gyro_z"), ("accel_x", "accel_y", "accel_z")


@pytest.fixture(scope="module")
def samples():
    return np.random.default_rng(4).normal(size=(N, 6)).astype("f4")


def stamps(n=N, interval=4000, start=5_000_000):
    """Times [µs]."""
    return (start + interval * np.arange(n)).astype("u8")


def sensor(values, times, late=900):
    x, y, z = values.T
    # The message is written somewhat after the sample is taken.
    return structured(
        timestamp=(times + np.uint64(late)),
        timestamp_sample=times,
        x=x,
        y=y,
        z=z,
        temperature=np.full(len(values), 40.0, "f4"),
    )


def combined(values, times):
    return structured(
        timestamp=times,
        gyro_rad=values[:, :3],
        gyro_integral_dt=np.full(len(values), 4000, "u4"),
        accelerometer_timestamp_relative=np.zeros(len(values), "i4"),
        accelerometer_m_s2=values[:, 3:],
    )


def fifo(values, interval, batch=8, lost=()):
    """Messages of `batch` samples in arrays of 32, at an interval [µs], of values in counts."""
    rows = []
    for k in range(0, len(values), batch):
        padded = np.zeros((32, 3), "i2")
        padded[:batch] = values[k : k + batch]
        end = np.uint64(1_000_000 + round((k + batch - 1) * interval))
        rows.append((end + np.uint64(50), end, 125.0, 0.25, batch, *padded.T))
    fields = [
        ("timestamp", "u8"),
        ("timestamp_sample", "u8"),
        ("dt", "f4"),
        ("scale", "f4"),
        ("samples", "u1"),
    ]
    fields += [(axis, "i2", 32) for axis in "xyz"]
    return np.delete(np.array(rows, fields), list(lost))


def refused(path, *said, **options):
    with pytest.raises(RecordingError) as caught:
        read(path, **options)
    for text in (str(path), *said):
        assert text in str(caught.value)


def test_sensor_combined(tmp_path, samples):
    path = write_ulog(tmp_path / "log.ulg", {("sensor_combined", 0): combined(samples, stamps())}, [30, 12])
    recording = read(path)
    assert recording.names == GYROS + ACCELS
    np.testing.assert_array_equal(recording.values, samples.astype(float))
    assert recording.rate == pytest.approx(250.0, rel=1e-12)
    notes = " ".join(recording.notes)
    assert "2 dropouts of the log, of 42 ms in all" in notes
    assert "averaged and corrected" in notes


def test_accelerations_without_a_time(tmp_path, samples):
    rows = combined(samples, stamps())
    rows["accelerometer_timestamp_relative"][7] = 0x7FFFFFFF
    refused(write_ulog(tmp_path / "log.ulg", {("sensor_combined", 0): rows}), "accel_x", "row 7", "nan")


def test_gyros_and_accelerometers_of_their_own(tmp_path, samples):
    messages = {}
    for instance in (0, 1):
        values = samples * (1 + instance)
        messages["sensor_gyro", instance] = sensor(values[:, :3], stamps())
        messages["sensor_accel", instance] = sensor(values[:, 3:], stamps() + np.uint64(300), late=10)
    messages["sensor_combined", 0] = combined(samples[:50], stamps(50, 24_000))
    path = write_ulog(tmp_path / "log.ulg", messages)
    recording = read(path)
    np.testing.assert_array_equal(recording.values, samples.astype(float))
    np.testing.assert_array_equal(recording.auxiliary["temperature"], 40.0)
    assert "sensor_gyro 0 at 250 Hz and sensor_accel 0 at 250 Hz; topic= and instance=" in recording.notes[0]
    np.testing.assert_array_equal(read(path, instance=1).values, 2.0 * samples)
    assert read(path, topic="sensor_gyro").names == GYROS
    assert read(path, topic="sensor_accel,sensor_gyro", instance=1).names == GYROS + ACCELS
    assert read(path, topic="sensor_combined").n == 50
    refused(path, "no instance 4; choose one of 0, 1", instance=4)
    refused(path, "topic 'vehicle_imu'", "sensor_gyro 1", topic="vehicle_imu")
    refused(path, "topic 'sensor_gyro,sensor_combined'", topic="sensor_gyro,sensor_combined")


def test_rates_that_differ(tmp_path, samples):
    messages = {
        ("sensor_gyro", 0): sensor(samples[:, :3], stamps()),
        ("sensor_accel", 0): sensor(samples[:, 3:], stamps(interval=8000)),
    }
    path = write_ulog(tmp_path / "log.ulg", messages)
    refused(path, "sensor_gyro are at 250 Hz", "sensor_accel at 125 Hz", "topic= (--topic)")
    assert read(path, topic="sensor_accel").rate == pytest.approx(125.0)


def test_increments_are_divided_by_their_time(tmp_path, samples):
    intervals = np.resize([4000, 4100, 3900], N).astype("u4")
    times = stamps()
    rows = structured(
        timestamp=times,
        timestamp_sample=times,
        delta_angle=(samples[:, :3] * 1e-6 * intervals[:, None]).astype("f4"),
        delta_velocity=(samples[:, 3:] * 1e-6 * intervals[:, None]).astype("f4"),
        delta_angle_dt=intervals,
        delta_velocity_dt=intervals,
    )
    path = write_ulog(tmp_path / "log.ulg", {("vehicle_imu", 2): rows})
    np.testing.assert_allclose(read(path).values, samples, rtol=1e-6)
    rows["delta_velocity_dt"][9] = 0
    refused(write_ulog(path, {("vehicle_imu", 0): rows}), "accel_x", "row 9")


def test_fifo(tmp_path):
    counts = np.random.default_rng(1).integers(-999, 999, (800, 3))
    # The sensor's clock is faster than it tells by 2 %.
    messages = {
        ("sensor_gyro_fifo", 0): fifo(counts, 122.5),
        ("sensor_accel_fifo", 0): fifo(counts[::-1], 122.5),
        ("sensor_combined", 0): combined(np.ones((20, 6), "f4"), stamps(20)),
    }
    path = write_ulog(tmp_path / "log.ulg", messages)
    recording = read(path)
    np.testing.assert_array_equal(recording.values[:, :3], 0.25 * counts)
    np.testing.assert_array_equal(recording.values[:, 3:], 0.25 * counts[::-1])
    assert recording.rate == pytest.approx(1e6 / 122.5, rel=3e-4)
    # A message that was lost leaves a gap.
    messages["sensor_gyro_fifo", 0] = fifo(counts, 122.5, lost=[40])
    refused(write_ulog(path, messages), "a gap of 0.00", "row 320", topic="sensor_gyro_fifo")


def test_logs_that_can_not_be_read(tmp_path, samples, monkeypatch):
    rows = combined(samples, stamps())
    path = write_ulog(tmp_path / "log.ulg", {("vehicle_status", 0): rows})
    refused(path, "no samples of an IMU", "SDLOG_PROFILE")
    refused(write_ulog(path, {("sensor_gyro", 0): rows}), "sensor_gyro has no field 'x'")
    path.write_bytes(path.read_bytes()[:12])
    refused(path, "can not be read as a ULog file", "copy it again")
    monkeypatch.setitem(sys.modules, "pyulog", None)
    refused(path, 'pip install "allanjax[px4]"')


def test_a_log_that_is_damaged_in_the_midst(tmp_path, samples):
    path = write_ulog(tmp_path / "log.ulg", {("sensor_combined", 0): combined(samples, stamps())})
    content = bytearray(path.read_bytes())
    # A message has 3 bytes of header, 2 of its number and 40 of data.
    content[-45 * 100 : -45 * 99] = bytes(45)
    path.write_bytes(content)
    # There is no mark of synchronization after it, by which to go on.
    recording = read(path)
    assert recording.n == N - 100
    assert "damaged parts of the log are left out" in recording.notes


@pytest.mark.skipif(not (DATA / "px4_small.ulg").is_file(), reason="the folder of ALLANJAX_DATA is absent")
def test_real_log():
    path = DATA / "px4_small.ulg"
    refused(path, "a gap of 0.161303 s", "the only gap", "start=0.162, stop=6.496")
    recording = read(path, start=0.162, stop=6.496)
    assert recording.rate == pytest.approx(204.6, abs=0.1)
    assert np.linalg.norm(recording.values[:, 3:].mean(axis=0)) == pytest.approx(9.8, abs=0.2)
