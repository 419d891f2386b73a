"""ArduPilot's logs give what was written into them, or say why they cannot."""

import struct

import numpy as np
import pytest
from flight_logs import structured, write_dataflash
from places import DATA

from allanjax.base.errors import RecordingError
from allanjax.record.io import read

N = 300
NAMES = ("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z")


@pytest.fixture(scope="module")
def samples():
    return np.random.default_rng(5).normal(size=(N, 6)).astype("f4")


def stamps(n=N, interval=2500, start=1_000_000):
    """Times [µs]."""
    return (start + interval * np.arange(n)).astype("u8")


def columns(values, *names):
    return {
        f"{name}{axis}": values[:, 3 * k + i] for k, name in enumerate(names) for i, axis in enumerate("XYZ")
    }


def imu(values, times, **more):
    return structured(
        TimeUS=times, **more, **columns(values, "Gyr", "Acc"), T=np.full(len(values), 31.5, "f4")
    )


def refused(path, *said, **options):
    with pytest.raises(RecordingError) as caught:
        read(path, **options)
    for text in (str(path), *said):
        assert text in str(caught.value)


@pytest.mark.parametrize("junk", [b"", b"\xa3\x95", b"\xa3\x95\x82 torn"])
def test_imu(tmp_path, samples, junk):
    messages = {"IMU": imu(samples, stamps()), "ATT": structured(TimeUS=stamps(), Roll=np.ones(N, "f4"))}
    path = write_dataflash(tmp_path / "log.bin", messages, junk)
    recording = read(path)
    assert recording.names == NAMES
    np.testing.assert_array_equal(recording.values, samples.astype(float))
    np.testing.assert_array_equal(recording.auxiliary["temperature"], 31.5)
    assert recording.rate == pytest.approx(400.0, rel=1e-12)
    # What is before the junk is not known to be whole: a message of another type.
    assert any("bytes are no whole messages" in note for note in recording.notes) == bool(junk)


def test_the_bytes_of_a_head_within_messages(tmp_path, samples):
    values = samples.copy()
    head = struct.unpack("<f", b"\xa3\x95\x82\x00")[0]
    values[::3, 1] = head
    values[::7, 5] = head
    path = write_dataflash(tmp_path / "log.bin", {"IMU": imu(values, stamps())})
    np.testing.assert_array_equal(read(path).values, values.astype(float))


@pytest.mark.parametrize("how", ["by a field", "by names"])
def test_instances(tmp_path, samples, how):
    if how == "by a field":
        numbers = np.tile([0, 2], N).astype("u1")
        values = np.repeat(samples, 2, axis=0) * (1.0 + numbers[:, None]).astype("f4")
        messages = {"IMU": imu(values, np.repeat(stamps(), 2), I=numbers)}
    else:
        messages = {"IMU": imu(samples, stamps()), "IMU3": imu(3 * samples, stamps())}
    path = write_dataflash(tmp_path / "log.bin", messages)
    np.testing.assert_array_equal(read(path).values, samples)
    np.testing.assert_array_equal(read(path, instance=2).values, (3 * samples).astype(float))
    assert any("IMU 2 at 400 Hz" in note for note in read(path).notes)
    refused(path, "no instance 1; choose one of 0, 2", instance=1)


def test_raw_gyros_and_accelerometers(tmp_path, samples):
    """They are faster than IMU, and their time is that of the sample."""
    late = stamps() + np.random.default_rng(0).integers(0, 5000, N).astype("u8")
    messages = {
        "IMU": imu(samples[:50], stamps(50, 15_000)),
        "GYR1": structured(TimeUS=late, SampleUS=stamps(), **columns(samples[:, :3], "Gyr")),
        "ACC1": structured(TimeUS=late, SampleUS=stamps(start=1_000_200), **columns(samples[:, 3:], "Acc")),
    }
    path = write_dataflash(tmp_path / "log.bin", messages)
    recording = read(path)
    np.testing.assert_array_equal(recording.values, samples)
    assert recording.rate == pytest.approx(400.0)
    assert read(path, topic="IMU").n == 50
    assert read(path, topic="ACC").names == NAMES[3:]
    refused(path, "topic 'GYR,IMU'", "ACC 0, GYR 0, IMU 0", topic="GYR,IMU")


def test_batches_are_refused(tmp_path, samples):
    batch = structured(N=np.zeros(20, "u2"), seqno=np.arange(20).astype("u2"), x=np.ones((20, 32), "i2"))
    path = write_dataflash(tmp_path / "log.bin", {"ISBD": batch})
    refused(path, "batches of samples with pauses between", "no Allan deviation", "LOG_BITMASK")
    path = write_dataflash(path, {"ISBD": batch, "IMU": imu(samples, stamps())})
    refused(path, "batches of samples", topic="ISBD")
    assert any("ISBD) left out" in note for note in read(path).notes)


def test_logs_without_samples(tmp_path, samples):
    path = write_dataflash(tmp_path / "log.bin", {"ATT": structured(TimeUS=stamps(), Roll=np.ones(N, "f4"))})
    refused(path, "no samples of an IMU", "LOG_DISARMED")
    path = write_dataflash(path, {"IMU": structured(TimeUS=stamps(), GyrX=np.ones(N, "f4"))})
    refused(path, "the message IMU has neither times nor samples, but TimeUS, GyrX")
    path.write_bytes(bytes(500))
    refused(path, "can not be read as a DataFlash log", "CSV")


def test_a_lost_message_is_a_gap(tmp_path, samples):
    kept = np.delete(np.arange(N), 100)
    path = write_dataflash(tmp_path / "log.bin", {"IMU": imu(samples[kept], stamps()[kept])})
    refused(path, "a gap of 0.005 s", "row 100", "stop=")


@pytest.mark.skipif(
    not (DATA / "ardupilot_test.bin").is_file(), reason="the folder of ALLANJAX_DATA is absent"
)
def test_real_log():
    path = DATA / "ardupilot_test.bin"
    # A tenth of the few messages in it are lost.
    refused(path, "irregular", "9% of the intervals are gaps")
    content = path.read_bytes()
    for instance, kind in ((0, b"\xa3\x95\x85"), (1, b"\xa3\x95\x8a")):
        parts = content.split(kind)[1:]
        expected = [struct.unpack("<6f", part[8:32]) for part in parts]
        recording = read(path, instance=instance, time="none", rate=50)
        np.testing.assert_array_equal(recording.values, expected)
