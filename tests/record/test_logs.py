"""Bags of ROS, PX4's and ArduPilot's logs give what was written into them, or say what to choose."""

import struct
import sys

import numpy as np
import pytest
from bags import KINDS, Topic, write_bag
from flight_logs import structured, write_dataflash, write_ulog
from imu_columns import SIX
from places import DATA

import allanjax as aj

N = 400
SAMPLES = np.random.default_rng(8).normal((0.1, 0.2, 0.3, 1.0, 2.0, 9.81), 1.0, (N, 6)).astype("f4")
VALUES = SAMPLES.astype(float)
GYRO, ACCEL = VALUES * [1, 1, 1, 0, 0, 0], VALUES * [0, 0, 0, 1, 1, 1]


def refused(path, words, **options):
    with pytest.raises(aj.RecordingError) as caught:
        aj.read(path, **options)
    for word in (str(path), *words.split("|")):
        assert word in str(caught.value)


def noted(recording, *words):
    """Whether a note has all these words."""
    return any(all(word in note for word in words) for note in recording.notes)


def check(recording, values=VALUES, rate=200.0, names=SIX):
    assert recording.names == names
    np.testing.assert_array_equal(recording.values, values)
    assert recording.rate == pytest.approx(rate, rel=1e-9)
    return recording


# --- Bags ---------------------------------------------------------------------------------------------------


def stamps(n=N, rate=200.0):
    """Times [ns]."""
    return 1_700_000_000_123_456_789 + np.round(np.arange(n) * 1e9 / rate).astype(np.int64)


def bag(folder, kind, topics, **more):
    folder.mkdir(exist_ok=True)
    return write_bag(folder / ("imu.bag" if kind == "ros1" else "imu"), kind, topics, **more)


@pytest.mark.parametrize("kind", KINDS)
def test_bags(tmp_path, kind):
    """Also compressed, with frames of several lengths, and messages out of order."""
    late = stamps() + np.random.default_rng(3).integers(0, 8_000_000, N)
    frames = [*"abcdefghi", "", "base_link", "imu"]
    plain = bag(tmp_path / "a", kind, {"/imu": Topic(stamps(), VALUES)}, other=True)
    recording = check(aj.read(plain))
    assert [axis.unit for axis in recording.axes] == [*3 * ["rad/s"], *3 * ["m/s²"]]
    assert recording.name == "imu"
    assert noted(recording, "400 messages", "'imu_link'")
    check(aj.read(plain, topic="/imu", start=0.5), VALUES[100:])
    check(aj.read(bag(tmp_path / "b", kind, {"/imu": Topic(stamps(), VALUES, frames=frames)}, small=True)))
    recording = check(aj.read(bag(tmp_path / "c", kind, {"/imu": Topic(stamps(), VALUES, late)})))
    count = np.count_nonzero(np.diff(np.argsort(late, kind="stable")) < 0)
    assert noted(recording, f"{count} messages out of order", "header.stamp")
    # Stamps that are all the same are none: the times in the bag are used.
    check(aj.read(bag(tmp_path / "d", kind, {"/imu": Topic(N * [0], VALUES, stamps())})))
    if kind != "ros1":
        (path,) = (path for path in plain.iterdir() if path.suffix in (".db3", ".mcap"))
        check(aj.read(path))
        refused(path.rename(tmp_path / "imu.log"), f"rename|{path.suffix}")


def test_numbers_with_their_largest_byte_first(tmp_path):
    topic = Topic(stamps(), VALUES, frames=["", "a", "imu_link"])
    check(aj.read(bag(tmp_path, "mcap", {"/imu": topic}, big=True)))


def test_several_topics_are_listed(tmp_path):
    rear = Topic(stamps(100, 50.0), VALUES[:100], frames=["rear"])
    topics = {"/front/imu": Topic(stamps(), VALUES), "/rear/imu": rear, "/spare/imu": Topic([], VALUES[:0])}
    path = bag(tmp_path, "mcap", topics)
    front = "/front/imu (400 messages at 200 Hz, frame 'imu_link')"
    refused(path, f"3 topics|--topic|{front}|/rear/imu (100 messages at 50 Hz, frame 'rear')")
    refused(path, f"'/imu'|{front}", topic="/imu")
    refused(path, "/front/imu and /rear/imu|--topic", topic="/front/imu,/rear/imu")
    refused(path, "/spare/imu|no messages", topic="/spare/imu")
    check(aj.read(path, topic="/rear/imu"), VALUES[:100], 50.0)


@pytest.mark.parametrize("kind", KINDS)
def test_two_halves_are_one_recording(tmp_path, kind):
    """Each lacks a few samples at its ends that the other has."""
    topics = {"/accel": Topic(stamps()[3:] + 400_000, ACCEL[3:]), "/gyro": Topic(stamps()[:-2], GYRO[:-2])}
    path = bag(tmp_path, kind, topics)
    for chosen in (None, "/accel,/gyro", "/gyro, /accel"):
        check(aj.read(path, topic=chosen), VALUES[3:-2])
    assert noted(check(aj.read(path, topic="/gyro"), VALUES[:-2, :3], names=SIX[:3]), "zero")
    refused(path, "/gyro (398 messages at 200 Hz, frame 'imu_link', gyros alone)", topic="/camera")


def test_halves_that_do_not_fit(tmp_path):
    path = bag(
        tmp_path / "a",
        "ros1",
        {"/accel": Topic(stamps(100, 63.0), ACCEL[:100]), "/gyro": Topic(stamps(), GYRO)},
    )
    refused(path, "/gyro are at 200 Hz|/accel at 63 Hz|--topic")
    assert aj.read(path, topic="/accel").rate == pytest.approx(63.0)
    kept = np.delete(np.arange(N), 200)
    lost = {"/accel": Topic(stamps()[kept], ACCEL[kept]), "/gyro": Topic(stamps(), GYRO)}
    refused(bag(tmp_path / "b", "ros1", lost), "0.01 s|row 200")
    # A sample in ten may be without a partner, and no more.
    for name, late, matched in (("c", 39, True), ("d", 41, False)):
        apart = {"/accel": Topic(stamps(2 * N)[late:][:N], ACCEL), "/gyro": Topic(stamps(), GYRO)}
        path = bag(tmp_path / name, "ros1", apart)
        if matched:
            check(aj.read(path), np.hstack([VALUES[late:, :3], VALUES[:-late, 3:]]))
        else:
            refused(path, "359 of 400|/gyro|/accel|--topic")


def test_bags_that_can_not_be_read(tmp_path, monkeypatch):
    refused(bag(tmp_path / "a", "ros1", {}, other=True), "/words (std_msgs/msg/String)")
    refused(bag(tmp_path / "b", "mcap", {"/imu": Topic(stamps(), 0 * VALUES)}), "/imu|zeros")
    refused(bag(tmp_path / "c", "ros1", {"/imu": Topic([5], VALUES[:1], [6])}), "1 samples")
    whole = bag(tmp_path / "d", "ros1", {"/imu": Topic(stamps(), VALUES)})
    np.testing.assert_allclose(aj.read(whole, accel_unit="g").values[:, 3:], VALUES[:, 3:] * 9.80665)
    refused(whole, "instance=|--instance", instance=1)
    content = bytearray(whole.read_bytes())
    # The length of a frame in the midst.
    content[content.find(b"imu_link", len(content) // 2) - 4] = 200
    (tmp_path / "e.bag").write_bytes(content)
    refused(tmp_path / "e.bag", "/imu|damaged")
    (tmp_path / "f.bag").write_bytes(content[: len(content) // 2])
    refused(tmp_path / "f.bag", "reindex")
    folder = bag(tmp_path / "g", "mcap", {"/imu": Topic(stamps(), VALUES)})
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information: {version: 99}")
    refused(folder, "version 99")
    (folder / "metadata.yaml").unlink()
    refused(folder, "metadata.yaml")
    with pytest.raises(aj.RecordingError, match="chunks"):
        aj.read_chunks(whole)
    monkeypatch.setitem(sys.modules, "rosbags.rosbag1", None)
    refused(whole, "allanjax[ros]")


# --- PX4 ----------------------------------------------------------------------------------------------------


def micros(n=N, interval=5000, start=5_000_000):
    """Times [µs]."""
    return (start + interval * np.arange(n)).astype("u8")


def sensor(values, times, late=900):
    """Messages that are written somewhat after the sample is taken."""
    axes = dict(zip("xyz", values.T, strict=True))
    warm = np.full(len(values), 40.0, "f4")
    return structured(timestamp=times + np.uint64(late), timestamp_sample=times, **axes, temperature=warm)


def combined(values, times, relative=0):
    return structured(
        timestamp=times,
        gyro_rad=values[:, :3],
        gyro_integral_dt=np.full(len(values), 5000, "u4"),
        accelerometer_timestamp_relative=np.full(len(values), relative, "i4"),
        accelerometer_m_s2=values[:, 3:],
    )


def fifo(values, interval, batch=8, lost=()):
    """Messages of `batch` samples in arrays of 32, at an interval [µs], of values in counts."""
    fields = [
        ("timestamp", "u8"),
        ("timestamp_sample", "u8"),
        ("dt", "f4"),
        ("scale", "f4"),
        ("samples", "u1"),
    ]
    rows = []
    for k in range(0, len(values), batch):
        padded = np.zeros((32, 3), "i2")
        padded[:batch] = values[k : k + batch]
        end = np.uint64(1_000_000 + round((k + batch - 1) * interval))
        rows.append((end + np.uint64(50), end, 125.0, 0.25, batch, *padded.T))
    return np.delete(np.array(rows, [*fields, *((axis, "i2", 32) for axis in "xyz")]), list(lost))


def test_gyros_and_accelerometers_of_px4(tmp_path):
    """Several of each, beside what the autopilot has averaged; the time is that of the sample."""
    messages = {}
    for number in (0, 1):
        messages["sensor_gyro", number] = sensor(SAMPLES[:, :3] * (1 + number), micros())
        messages["sensor_accel", number] = sensor(
            SAMPLES[:, 3:] * (1 + number), micros() + np.uint64(300), late=10
        )
    messages["sensor_combined", 0] = combined(SAMPLES[:50], micros(50, 24_000))
    path = write_ulog(tmp_path / "log.ulg", messages)
    recording = check(aj.read(path))
    np.testing.assert_array_equal(recording.auxiliary["temperature"], 40.0)
    assert noted(recording, "sensor_gyro 0 at 200 Hz", "sensor_accel 0 at 200 Hz", "topic=", "instance=")
    check(aj.read(path, instance=1), 2.0 * VALUES)
    check(aj.read(path, topic="sensor_accel,sensor_gyro", instance=1), 2.0 * VALUES)
    check(aj.read(path, topic="sensor_gyro"), VALUES[:, :3], names=SIX[:3])
    check(aj.read(path, topic="sensor_combined"), VALUES[:50], 1e6 / 24_000)
    refused(path, "instance 4|0, 1|--instance", instance=4)
    refused(path, "vehicle_imu|sensor_gyro 1", topic="vehicle_imu")
    refused(path, "sensor_gyro,sensor_combined", topic="sensor_gyro,sensor_combined")
    messages["sensor_accel", 0] = sensor(SAMPLES[:, 3:], micros(interval=8000))
    refused(write_ulog(path, messages), "sensor_gyro are at 200 Hz|sensor_accel at 125 Hz|--topic")


def test_combined_samples_and_dropouts(tmp_path):
    rows = combined(SAMPLES, micros())
    recording = check(aj.read(write_ulog(tmp_path / "log.ulg", {("sensor_combined", 0): rows}, [30, 12])))
    assert noted(recording, "2 dropouts", "42 ms")
    assert noted(recording, "sensor_combined", "SDLOG_PROFILE")
    # What stands for a time that there is not.
    rows["accelerometer_timestamp_relative"][7] = 0x7FFFFFFF
    refused(write_ulog(tmp_path / "log.ulg", {("sensor_combined", 0): rows}), "accel_x|row 7")


def test_increments_are_divided_by_their_time(tmp_path):
    intervals = np.resize([5000, 5100, 4900], N).astype("u4")
    increments = (SAMPLES * 1e-6 * intervals[:, None]).astype("f4")
    rows = structured(
        timestamp=micros(),
        timestamp_sample=micros(),
        delta_angle=increments[:, :3],
        delta_velocity=increments[:, 3:],
        delta_angle_dt=intervals,
        delta_velocity_dt=intervals,
    )
    path = write_ulog(tmp_path / "log.ulg", {("vehicle_imu", 2): rows})
    np.testing.assert_allclose(aj.read(path).values, VALUES, rtol=1e-6)
    rows["delta_velocity_dt"][9] = 0
    refused(write_ulog(path, {("vehicle_imu", 0): rows}), "accel_x|row 9")


def test_batches_of_px4(tmp_path):
    """Each message has several samples, and the sensor's clock is 2 % faster than it tells."""
    counts = np.random.default_rng(1).integers(-999, 999, (800, 3))
    messages = {
        ("sensor_gyro_fifo", 0): fifo(counts, 122.5),
        ("sensor_accel_fifo", 0): fifo(counts[::-1], 122.5),
    }
    messages["sensor_combined", 0] = combined(np.ones((20, 6), "f4"), micros(20))
    recording = aj.read(write_ulog(tmp_path / "log.ulg", messages))
    np.testing.assert_array_equal(recording.values, 0.25 * np.hstack([counts, counts[::-1]]))
    assert recording.rate == pytest.approx(1e6 / 122.5, rel=3e-4)
    messages["sensor_gyro_fifo", 0] = fifo(counts, 122.5, lost=[40])
    refused(write_ulog(tmp_path / "log.ulg", messages), "gap|row 320", topic="sensor_gyro_fifo")


def test_logs_of_px4_that_can_not_be_read(tmp_path, monkeypatch):
    rows = combined(SAMPLES, micros())
    path = write_ulog(tmp_path / "log.ulg", {("vehicle_status", 0): rows})
    refused(path, "SDLOG_PROFILE")
    refused(write_ulog(path, {("sensor_gyro", 0): rows}), "sensor_gyro|'x'")
    content = bytearray(write_ulog(path, {("sensor_combined", 0): rows}).read_bytes())
    # A message has 45 bytes; after it there is no mark by which to go on.
    content[-45 * 100 : -45 * 99] = bytes(45)
    path.write_bytes(content)
    assert noted(check(aj.read(path), VALUES[:-100]), "damaged")
    path.write_bytes(content[:12])
    refused(path, "ULog|copy")
    monkeypatch.setitem(sys.modules, "pyulog", None)
    refused(path, "allanjax[px4]")


# --- ArduPilot ----------------------------------------------------------------------------------------------


def columns(values, *names):
    """Columns of three axes each."""
    return {
        f"{name}{axis}": values[:, 3 * k + i] for k, name in enumerate(names) for i, axis in enumerate("XYZ")
    }


def imu(values, times, **more):
    warm = np.full(len(values), 31.5, "f4")
    return structured(TimeUS=times, **more, **columns(values, "Gyr", "Acc"), T=warm)


@pytest.mark.parametrize("junk", [b"", b"\xa3\x95", b"\xa3\x95\x82 torn"])
def test_messages_of_ardupilot(tmp_path, junk):
    """The two bytes with which one begins may be in its numbers, too, and in junk between."""
    values = SAMPLES.copy()
    values[::3, 1] = values[::7, 5] = struct.unpack("<f", b"\xa3\x95\x82\x00")[0]
    messages = {"IMU": imu(values, micros()), "ATT": structured(TimeUS=micros(), Roll=np.ones(N, "f4"))}
    recording = check(aj.read(write_dataflash(tmp_path / "log.bin", messages, junk)), values.astype(float))
    np.testing.assert_array_equal(recording.auxiliary["temperature"], 31.5)
    # What is before the junk is not known to be whole: a message of another type.
    assert noted(recording, "bytes") == bool(junk)


@pytest.mark.parametrize("how", ["by a field", "by names"])
def test_instances_of_ardupilot(tmp_path, how):
    messages = {"IMU": imu(SAMPLES, micros()), "IMU3": imu(3 * SAMPLES, micros())}
    if how == "by a field":
        numbers = np.tile([0, 2], N).astype("u1")
        values = np.repeat(SAMPLES, 2, axis=0) * (1.0 + numbers[:, None]).astype("f4")
        messages = {"IMU": imu(values, np.repeat(micros(), 2), I=numbers)}
    path = write_dataflash(tmp_path / "log.bin", messages)
    assert noted(check(aj.read(path)), "IMU 2 at 200 Hz")
    check(aj.read(path, instance=2), (3 * SAMPLES).astype(float))
    refused(path, "instance 1|0, 2", instance=1)


def test_raw_samples_of_ardupilot(tmp_path):
    """They are faster than IMU, and their time is that of the sample."""
    late = micros() + np.random.default_rng(0).integers(0, 5000, N).astype("u8")
    messages = {
        "IMU": imu(SAMPLES[:50], micros(50, 15_000)),
        "GYR1": structured(TimeUS=late, SampleUS=micros(), **columns(SAMPLES[:, :3], "Gyr")),
        "ACC1": structured(TimeUS=late, SampleUS=micros(start=5_000_200), **columns(SAMPLES[:, 3:], "Acc")),
    }
    path = write_dataflash(tmp_path / "log.bin", messages)
    check(aj.read(path))
    check(aj.read(path, topic="IMU"), VALUES[:50], 1e6 / 15_000)
    check(aj.read(path, topic="ACC"), VALUES[:, 3:], names=SIX[3:])
    # As older ones tell it.
    old = structured(TimeMS=(micros() // 1000).astype("u4"), **columns(SAMPLES, "Gyr", "Acc"))
    check(aj.read(write_dataflash(tmp_path / "old.bin", {"IMU": old})))
    refused(path, "GYR,IMU|ACC 0, GYR 0, IMU 0", topic="GYR,IMU")


def test_logs_of_ardupilot_that_can_not_be_read(tmp_path):
    batch = structured(N=np.zeros(20, "u2"), seqno=np.arange(20).astype("u2"), x=np.ones((20, 32), "i2"))
    path = write_dataflash(tmp_path / "log.bin", {"ISBD": batch})
    refused(path, "batches|LOG_BITMASK")
    path = write_dataflash(path, {"ISBD": batch, "IMU": imu(SAMPLES, micros())})
    refused(path, "batches", topic="ISBD")
    assert noted(check(aj.read(path)), "ISBD")
    attitude = structured(TimeUS=micros(), Roll=np.ones(N, "f4"))
    refused(write_dataflash(path, {"ATT": attitude}), "LOG_DISARMED")
    refused(
        write_dataflash(path, {"IMU": structured(TimeUS=micros(), GyrX=np.ones(N, "f4"))}), "IMU|TimeUS, GyrX"
    )
    kept = np.delete(np.arange(N), 100)
    refused(write_dataflash(path, {"IMU": imu(SAMPLES[kept], micros()[kept])}), "0.01 s|row 100")
    path.write_bytes(bytes(500))
    refused(path, "DataFlash|CSV")


@pytest.mark.skipif(not (DATA / "phidgets_imu.bag").is_file(), reason="the folder of ALLANJAX_DATA is absent")
def test_real_logs():
    """In two of them messages are lost, which their stamps tell."""
    razor = aj.read(DATA / "sparkfun_razor.bag")
    assert (razor.n, razor.names) == (2144, SIX)
    assert razor.rate == pytest.approx(69.0, abs=0.1)
    refused(DATA / "phidgets_imu.bag", "98 gaps|start=43.190, stop=52.711")
    refused(DATA / "px4_small.ulg", "0.161303 s|start=0.162, stop=6.496")
    for name, start, stop, rate in (
        ("phidgets_imu.bag", 43.190, 52.711, 250.0),
        ("px4_small.ulg", 0.162, 6.496, 204.6),
    ):
        still = aj.read(DATA / name, start=start, stop=stop)
        assert still.rate == pytest.approx(rate, rel=1e-3)
        assert np.linalg.norm(still.values[:, 3:].mean(axis=0)) == pytest.approx(9.8, abs=0.2)
    content = (DATA / "ardupilot_test.bin").read_bytes()
    for instance, kind in ((0, b"\xa3\x95\x85"), (1, b"\xa3\x95\x8a")):
        expected = [struct.unpack("<6f", part[8:32]) for part in content.split(kind)[1:]]
        found = aj.read(DATA / "ardupilot_test.bin", instance=instance, time="none", rate=50)
        np.testing.assert_array_equal(found.values, expected)
