"""Bags of ROS, PX4's and ArduPilot's logs give what was written into them, or say what to choose."""

import struct
import sys

import numpy as np
import pytest
from imu_columns import SIX, noted, refused
from logs import KINDS, Topic, structured, write_bag, write_dataflash, write_ulog
from places import DATA

import allanjax as aj

N = 400
SAMPLES = np.random.default_rng(8).normal((0.1, 0.2, 0.3, 1.0, 2.0, 9.81), 1.0, (N, 6)).astype("f4")
VALUES = SAMPLES.astype(float)
GYRO, ACCEL = VALUES * [1, 1, 1, 0, 0, 0], VALUES * [0, 0, 0, 1, 1, 1]
# All samples but one.
KEPT = np.delete(np.arange(N), 100)


def check(recording, values=VALUES, rate=200.0, names=SIX):
    assert recording.names == names
    np.testing.assert_array_equal(recording.values, values)
    assert recording.rate == pytest.approx(rate, rel=1e-9)
    return recording


def stamps(n=N, rate=200.0):
    return 1_700_000_000_123_456_789 + np.round(np.arange(n) * 1e9 / rate).astype(np.int64)


@pytest.fixture
def bag(tmp_path):
    def write(kind, topics=None, **more):
        folder = tmp_path / str(len([*tmp_path.iterdir()]))
        folder.mkdir()
        topics = {"/imu": Topic(stamps(), VALUES)} if topics is None else topics
        return write_bag(folder / ("imu.bag" if kind == "ros1" else "imu"), kind, topics, **more)

    return write


@pytest.mark.parametrize("kind", KINDS)
def test_bags(tmp_path, bag, kind):
    late = stamps() + np.random.default_rng(3).integers(0, 8_000_000, N)
    frames = [*"abcdefghi", "", "base_link", "imu"]
    plain = bag(kind, other=True)
    recording = check(aj.read(plain))
    assert [axis.unit for axis in recording.axes] == [*3 * ["rad/s"], *3 * ["m/s²"]]
    assert noted(recording, "400 messages", "'imu_link'") == (recording.name == "imu")
    check(aj.read(plain, topic="/imu", start=0.5), VALUES[100:])
    check(aj.read(bag(kind, {"/imu": Topic(stamps(), VALUES, frames=frames)}, small=True)))
    recording = check(aj.read(bag(kind, {"/imu": Topic(stamps(), VALUES, late)})))
    count = np.count_nonzero(np.diff(np.argsort(late, kind="stable")) < 0)
    assert noted(recording, f"{count} messages out of order", "header.stamp")
    # Stamps that are all the same are none: the times in the bag are used.
    check(aj.read(bag(kind, {"/imu": Topic(N * [0], VALUES, stamps())})))
    if kind != "ros1":
        (path,) = (path for path in plain.iterdir() if path.suffix in (".db3", ".mcap"))
        check(aj.read(path))
        refused(path.rename(tmp_path / "imu.log"), f"rename|{path.suffix}")


@pytest.mark.parametrize("kind", KINDS)
def test_two_halves_are_one_recording(bag, kind):
    topics = {"/accel": Topic(stamps()[3:] + 400_000, ACCEL[3:]), "/gyro": Topic(stamps()[:-2], GYRO[:-2])}
    path = bag(kind, topics)
    for chosen in (None, "/gyro, /accel"):
        check(aj.read(path, topic=chosen), VALUES[3:-2])
    assert noted(check(aj.read(path, topic="/gyro"), VALUES[:-2, :3], names=SIX[:3]), "zero")
    refused(path, "/gyro (398 messages at 200 Hz, frame 'imu_link', gyros only)", topic="/camera")


def test_topics_that_do_not_fit(bag):
    """A sample in ten may be without a partner, and no more."""
    rear = Topic(stamps(100, 50.0), VALUES[:100], frames=["rear"])
    topics = {"/front/imu": Topic(stamps(), VALUES), "/rear/imu": rear, "/spare/imu": Topic([], VALUES[:0])}
    path = bag("mcap", topics)
    front = "/front/imu (400 messages at 200 Hz, frame 'imu_link')"
    refused(path, f"3 topics|--topic|{front}|/rear/imu (100 messages at 50 Hz, frame 'rear')")
    refused(path, "/front/imu and /rear/imu|--topic", topic="/front/imu,/rear/imu")
    refused(path, "/spare/imu|no messages", topic="/spare/imu")
    refused(path, "/front/imu,/rear/imu,/spare/imu", topic="/front/imu,/rear/imu,/spare/imu")
    check(aj.read(path, topic="/rear/imu"), VALUES[:100], 50.0)
    gyro = Topic(stamps(), GYRO)
    path = bag("ros1", {"/accel": Topic(stamps(100, 63.0), ACCEL[:100]), "/gyro": gyro})
    refused(path, "/gyro are at 200 Hz|/accel at 63 Hz|--topic")
    refused(bag("ros1", {"/accel": Topic(stamps()[KEPT], ACCEL[KEPT]), "/gyro": gyro}), "0.01 s|row 100")
    apart = [bag("ros1", {"/accel": Topic(stamps(2 * N)[k:][:N], ACCEL), "/gyro": gyro}) for k in (39, 41)]
    check(aj.read(apart[0]), np.hstack([VALUES[39:, :3], VALUES[:-39, 3:]]))
    refused(apart[1], "359 of 400|/gyro|/accel|--topic")


def test_bags_that_can_not_be_read(tmp_path, bag, monkeypatch):
    refused(bag("ros1", {}, other=True), "/words (std_msgs/msg/String)")
    refused(bag("mcap", {"/imu": Topic(stamps(), 0 * VALUES)}), "/imu|zeros")
    refused(bag("ros1", {"/imu": Topic([5], VALUES[:1], [6])}), "1 sample,")
    # Numbers with their largest byte first.
    check(aj.read(bag("mcap", {"/imu": Topic(stamps(), VALUES, frames=["", "a", "imu_link"])}, big=True)))
    whole = bag("ros1")
    np.testing.assert_allclose(aj.read(whole, accel_unit="g").values[:, 3:], VALUES[:, 3:] * 9.80665)
    refused(whole, "instance=", instance=1)
    content = bytearray(whole.read_bytes())
    # The length of a frame in the midst.
    content[content.find(b"imu_link", len(content) // 2) - 4] = 200
    for length, words in ((None, "/imu|damaged"), (len(content) // 2, "reindex")):
        (tmp_path / "e.bag").write_bytes(content[:length])
        refused(tmp_path / "e.bag", words)
    folder = bag("mcap")
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information: {version: 99}")
    refused(folder, "version 99")
    (folder / "metadata.yaml").unlink()
    refused(folder, "metadata.yaml")
    refused(lambda: aj.read_chunks(whole), "chunks")
    monkeypatch.setitem(sys.modules, "rosbags.rosbag1", None)
    refused(whole, "allanjax[ros]")


def micros(n=N, interval=5000, start=5_000_000):
    return (start + interval * np.arange(n)).astype("u8")


def sensor(values, times, late=900):
    axes = dict(zip("xyz", values.T, strict=True)) | {"temperature": np.full(len(values), 40.0, "f4")}
    return structured(timestamp=times + np.uint64(late), timestamp_sample=times, **axes)


def combined(values=SAMPLES, times=None):
    n = len(values)
    gyros = {"gyro_rad": values[:, :3], "gyro_integral_dt": np.full(n, 5000, "u4")}
    accels = {"accelerometer_timestamp_relative": np.zeros(n, "i4"), "accelerometer_m_s2": values[:, 3:]}
    return structured(timestamp=micros(n) if times is None else times, **gyros, **accels)


def test_gyros_and_accelerometers_of_px4(tmp_path):
    messages = {}
    for k in (0, 1):
        messages["sensor_gyro", k] = sensor(SAMPLES[:, :3] * (1 + k), micros())
        messages["sensor_accel", k] = sensor(SAMPLES[:, 3:] * (1 + k), micros(start=5_000_300), late=10)
    messages["sensor_combined", 0] = combined(SAMPLES[:50], micros(50, 24_000))
    path = write_ulog(tmp_path / "log.ulg", messages)
    recording = check(aj.read(path))
    np.testing.assert_array_equal(recording.auxiliary["temperature"], 40.0)
    assert noted(recording, "sensor_gyro 0 at 200 Hz", "sensor_accel 0 at 200 Hz", "topic=", "instance=")
    check(aj.read(path, topic="sensor_accel,sensor_gyro", instance=1), 2.0 * VALUES)
    check(aj.read(path, topic="sensor_gyro"), VALUES[:, :3], names=SIX[:3])
    check(aj.read(path, topic="sensor_combined"), VALUES[:50], 1e6 / 24_000)
    refused(path, "instance 4|0, 1|--instance", instance=4)
    refused(path, "vehicle_imu|sensor_gyro 1", topic="vehicle_imu")
    refused(path, "sensor_gyro,sensor_combined", topic="sensor_gyro,sensor_combined")
    messages["sensor_accel", 0] = sensor(SAMPLES[:, 3:], micros(interval=8000))
    refused(write_ulog(path, messages), "sensor_gyro are at 200 Hz|sensor_accel at 125 Hz|--topic")


def test_what_px4_combines_and_integrates(tmp_path):
    path, rows = tmp_path / "log.ulg", combined()
    recording = check(aj.read(write_ulog(path, {("sensor_combined", 0): rows}, [30, 12])))
    assert noted(recording, "2 logging dropouts", "42 ms")
    assert noted(recording, "sensor_combined", "SDLOG_PROFILE")
    # Power that was lost within a message.
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    cut = aj.read(path)
    assert 0.3 * N < cut.n < 0.7 * N
    assert noted(cut, "ends within a message")
    # What stands for a time that there is not.
    rows["accelerometer_timestamp_relative"][7] = 0x7FFFFFFF
    refused(write_ulog(path, {("sensor_combined", 0): rows}), "accel_x|row 7")
    intervals = np.resize([5000, 5100, 4900], N).astype("u4")
    increments = (SAMPLES * 1e-6 * intervals[:, None]).astype("f4")
    halves = {"delta_angle": increments[:, :3], "delta_velocity": increments[:, 3:]}
    halves |= {f"{name}_dt": intervals for name in halves}
    rows = structured(timestamp=micros(), timestamp_sample=micros(), **halves)
    write_ulog(path, {("vehicle_imu", 2): rows})
    np.testing.assert_allclose(aj.read(path).values, VALUES, rtol=1e-6)
    rows["delta_velocity_dt"][9] = 0
    refused(write_ulog(path, {("vehicle_imu", 0): rows}), "accel_x|row 9")


def test_batches_of_px4(tmp_path):
    """Of eight samples in arrays of 32, at 122.5 µs where the clock tells 125; a lost batch is a gap."""
    counts, messages = np.random.default_rng(1).integers(-999, 999, (800, 3)), {}
    end = (1_000_000 + np.round((8 * np.arange(100) + 7) * 122.5)).astype("u8")
    about = {"samples": np.full(100, 8, "u1")}
    about |= {name: np.full(100, value, "f4") for name, value in (("dt", 125.0), ("scale", 0.25))}
    for name, values in (("gyro", counts), ("accel", counts[::-1])):
        padded = np.pad(values.reshape(100, 8, 3).astype("i2"), ((0, 0), (0, 24), (0, 0)))
        axes = {a: padded[:, :, k] for k, a in enumerate("xyz")}
        batches = structured(timestamp=end + np.uint64(50), timestamp_sample=end, **about, **axes)
        messages[f"sensor_{name}_fifo", 0] = batches
    messages["sensor_combined", 0] = combined(np.ones((20, 6), "f4"))
    recording = aj.read(path := write_ulog(tmp_path / "log.ulg", messages))
    np.testing.assert_array_equal(recording.values, 0.25 * np.hstack([counts, counts[::-1]]))
    assert recording.rate == pytest.approx(1e6 / 122.5, rel=3e-4)
    messages["sensor_gyro_fifo", 0] = np.delete(messages["sensor_gyro_fifo", 0], 40)
    refused(write_ulog(path, messages), "gap|row 320", topic="sensor_gyro_fifo")


def test_logs_of_px4_that_can_not_be_read(tmp_path, monkeypatch):
    path = write_ulog(tmp_path / "log.ulg", {("vehicle_status", 0): combined()})
    refused(path, "SDLOG_PROFILE")
    refused(write_ulog(path, {("sensor_gyro", 0): combined()}), "sensor_gyro|'x'")
    content = bytearray(write_ulog(path, {("sensor_combined", 0): combined()}).read_bytes())
    # A message has 45 bytes; after it there is no mark by which to go on.
    content[-45 * 100 : -45 * 99] = bytes(45)
    path.write_bytes(content)
    assert noted(check(aj.read(path), VALUES[:-100]), "damaged")
    path.write_bytes(content[:12])
    refused(path, "ULog|copy")
    monkeypatch.setitem(sys.modules, "pyulog", None)
    refused(path, "allanjax[px4]")


def columns(values, *names):
    labels = [f"{name}{axis}" for name in names for axis in "XYZ"]
    return dict(zip(labels, values.T, strict=True))


def imu(values=SAMPLES, times=None, **more):
    warm, times = np.full(len(values), 31.5, "f4"), micros(len(values)) if times is None else times
    return structured(TimeUS=times, **more, **columns(values, "Gyr", "Acc"), T=warm)


def test_messages_of_ardupilot(tmp_path):
    """The two bytes with which one begins may be in its numbers, too, and in junk between."""
    values = SAMPLES.copy()
    values[::3, 1] = values[::7, 5] = struct.unpack("<f", b"\xa3\x95\x82\x00")[0]
    messages = {"IMU": imu(values), "ATT": structured(TimeUS=micros(), Roll=np.ones(N, "f4"))}
    for junk in (b"", b"\xa3\x95", b"\xa3\x95\x82 torn"):
        path = write_dataflash(tmp_path / "log.bin", messages, junk)
        recording = check(aj.read(path), values.astype(float))
        np.testing.assert_array_equal(recording.auxiliary["temperature"], 31.5)
        # What is before the junk is not known to be whole: a message of another type.
        assert noted(recording, "bytes") == bool(junk)


def test_instances_and_raw_samples_of_ardupilot(tmp_path):
    """By a field or by names; raw samples are faster than IMU, and their time is that of the sample."""
    numbers = np.tile([0, 2], N).astype("u1")
    values = np.repeat(SAMPLES, 2, axis=0) * (1.0 + numbers[:, None]).astype("f4")
    by_field = {"IMU": imu(values, np.repeat(micros(), 2), I=numbers)}
    for messages in (by_field, {"IMU": imu(), "IMU3": imu(3 * SAMPLES)}):
        path = write_dataflash(tmp_path / "log.bin", messages)
        assert noted(check(aj.read(path)), "IMU 2 at 200 Hz")
        check(aj.read(path, instance=2), (3 * SAMPLES).astype(float))
        refused(path, "instance 1|0, 2", instance=1)
    late = micros() + np.random.default_rng(0).integers(0, 5000, N).astype("u8")
    messages = {"IMU": imu(SAMPLES[:50], micros(50, 15_000))}
    for name, k, start in (("Gyr", 0, 5_000_000), ("Acc", 3, 5_000_200)):
        raw = columns(SAMPLES[:, k : k + 3], name)
        messages[f"{name.upper()}1"] = structured(TimeUS=late, SampleUS=micros(start=start), **raw)
    check(aj.read(write_dataflash(path, messages)))
    check(aj.read(path, topic="IMU"), VALUES[:50], 1e6 / 15_000)
    check(aj.read(path, topic="ACC"), VALUES[:, 3:], names=SIX[3:])
    refused(path, "GYR,IMU|ACC 0, GYR 0, IMU 0", topic="GYR,IMU")
    # As older ones tell it.
    old = structured(TimeMS=(micros() // 1000).astype("u4"), **columns(SAMPLES, "Gyr", "Acc"))
    check(aj.read(write_dataflash(path, {"IMU": old})))


def test_logs_of_ardupilot_that_can_not_be_read(tmp_path):
    batch = structured(N=np.zeros(20, "u2"), seqno=np.arange(20).astype("u2"), x=np.ones((20, 32), "i2"))
    path = tmp_path / "log.bin"
    for messages, words in (
        ({"ISBD": batch}, "batches|LOG_BITMASK"),
        ({"ATT": structured(TimeUS=micros(), Roll=np.ones(N, "f4"))}, "LOG_DISARMED"),
        ({"IMU": structured(TimeUS=micros(), GyrX=np.ones(N, "f4"))}, "IMU|TimeUS, GyrX"),
        ({"IMU": imu(SAMPLES[KEPT], micros()[KEPT])}, "0.01 s|row 100"),
    ):
        refused(write_dataflash(path, messages), words)
    refused(write_dataflash(path, {"ISBD": batch, "IMU": imu()}), "batches", topic="ISBD")
    assert noted(check(aj.read(path)), "ISBD")
    path.write_bytes(bytes(500))
    refused(path, "DataFlash|CSV")


# Real files, the rate [Hz] to which tolerance, and what is read where samples are lost.
REAL = {
    "phidgets_imu.bag": (250.0, 0.25, {"start": 43.190, "stop": 52.711}),
    "px4_small.ulg": (204.6, 0.2, {"start": 0.162}),
    "euroc_slice.csv": (200.0, 2e-4, {}),
    "xio_sensor_data.csv": (100.0, 0.1, {"start": 90.978, "stop": 116.188}),
}


@pytest.mark.skipif(not (DATA / "phidgets_imu.bag").is_file(), reason="the folder of ALLANJAX_DATA is absent")
def test_real_files():
    assert aj.read(DATA / "sparkfun_razor.bag").n == 2144
    for name, (rate, close, stretch) in REAL.items():
        if stretch:
            part = " and ".join(f"{name}={time:.3f} (--{name} {time:.3f})" for name, time in stretch.items())
            refused(DATA / name, f"the longest with {part} or gaps='segments'")
        still = aj.read(DATA / name, **stretch)
        assert still.rate == pytest.approx(rate, abs=close)
        assert np.linalg.norm(still[SIX].values[:, 3:].mean(axis=0)) == pytest.approx(9.8, abs=0.3), name
    content = (DATA / "ardupilot_test.bin").read_bytes()
    for instance, kind in ((0, b"\xa3\x95\x85"), (1, b"\xa3\x95\x8a")):
        expected = [struct.unpack("<6f", part[8:32]) for part in content.split(kind)[1:]]
        found = aj.read(DATA / "ardupilot_test.bin", instance=instance, time="none", rate=50)
        np.testing.assert_array_equal(found.values, expected)
