"""Bags of ROS 1 and ROS 2 give what was written into them, or say which topic to choose."""

import shutil
import sys

import numpy as np
import pytest
from bags import KINDS, Topic, write_bag
from places import DATA

from allanjax.base.errors import RecordingError
from allanjax.record.io import read, read_chunks

N, RATE = 400, 200.0
START = 1_700_000_000_123_456_789
NAMES = ("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z")


@pytest.fixture(scope="module")
def samples():
    return np.random.default_rng(8).normal([0, 0, 0, 0, 0, 9.81], 1, (N, 6))


def regular(n=N, rate=RATE, start=START):
    return start + np.round(np.arange(n) * 1e9 / rate).astype(np.int64)


def written(folder, kind, topics, **more):
    return write_bag(folder / ("imu.bag" if kind == "ros1" else "imu"), kind, topics, **more)


def refused(path, *said, **options):
    with pytest.raises(RecordingError) as caught:
        read(path, **options)
    for text in (str(path), *said):
        assert text in str(caught.value)


@pytest.mark.parametrize("kind", KINDS)
def test_what_was_written(tmp_path, samples, kind):
    path = written(tmp_path, kind, {"/imu": Topic(regular(), samples)}, other=True)
    recording = read(path)
    assert recording.names == NAMES
    assert [axis.unit for axis in recording.axes] == [*3 * ["rad/s"], *3 * ["m/s²"]]
    np.testing.assert_array_equal(recording.values, samples)
    assert recording.rate == pytest.approx(RATE, rel=1e-9)
    assert recording.name == "imu"
    assert any("400 messages of the frame 'imu_link'" in note for note in recording.notes)
    assert read(path, topic="/imu", start=0.5).n == N - 100


@pytest.mark.parametrize("kind", KINDS)
def test_compressed_bags(tmp_path, samples, kind):
    recording = read(written(tmp_path, kind, {"/imu": Topic(regular(), samples)}, small=True))
    np.testing.assert_array_equal(recording.values, samples)


def test_numbers_with_their_largest_byte_first(tmp_path, samples):
    topic = Topic(regular(), samples, frames=["", "a", "imu_link"])
    recording = read(written(tmp_path, "mcap", {"/imu": topic}, big=True))
    np.testing.assert_array_equal(recording.values, samples)


@pytest.mark.parametrize("kind", ["sqlite3", "mcap"])
def test_the_file_of_a_ros_2_bag_alone(tmp_path, samples, kind):
    folder = written(tmp_path, kind, {"/imu": Topic(regular(), samples)})
    (path,) = (path for path in folder.iterdir() if path.suffix in (".db3", ".mcap"))
    np.testing.assert_array_equal(read(path).values, samples)
    misnamed = shutil.copy(path, tmp_path / "imu.log")
    refused(misnamed, "rename it", path.suffix)


@pytest.mark.parametrize("kind", KINDS)
def test_frames_of_several_lengths(tmp_path, samples, kind):
    topic = Topic(regular(), samples, frames=[*"abcdefghi", "", "base_link", "imu"])
    np.testing.assert_array_equal(read(written(tmp_path, kind, {"/imu": topic})).values, samples)


@pytest.mark.parametrize("kind", KINDS)
def test_messages_out_of_order_are_sorted_by_their_stamps(tmp_path, samples, kind):
    late = regular() + np.random.default_rng(3).integers(0, 8_000_000, N)
    recording = read(written(tmp_path, kind, {"/imu": Topic(regular(), samples, late)}))
    np.testing.assert_array_equal(recording.values, samples)
    notes = " ".join(recording.notes)
    assert f"{np.count_nonzero(np.diff(np.argsort(late, kind='stable')) < 0)} messages out of order" in notes
    assert "jitter of header.stamp below 1 ns, of the bag's time" in notes


def test_stamps_of_zero(tmp_path, samples):
    path = written(tmp_path, "ros1", {"/imu": Topic(N * [0], samples, regular())})
    recording = read(path)
    assert recording.rate == pytest.approx(RATE, rel=1e-9)
    assert any("the bag's time is used" in note for note in recording.notes)


def test_a_single_message_is_too_short(tmp_path, samples):
    """Without a warning of NumPy about the jitter of none."""
    path = written(tmp_path, "ros1", {"/imu": Topic([5], samples[:1], [6])})
    with pytest.raises(RecordingError, match="too short: 1 samples"):
        read(path)


def test_several_topics_are_listed(tmp_path, samples):
    topics = {
        "/front/imu": Topic(regular(), samples),
        "/rear/imu": Topic(regular(100, 50.0), samples[:100], frames=["rear"]),
        "/spare/imu": Topic([], samples[:0]),
    }
    path = written(tmp_path, "mcap", topics)
    front, rear = "/front/imu (400 messages at 200 Hz, frame 'imu_link')", "/rear/imu (100 messages at 50 Hz"
    refused(path, "3 topics of sensor_msgs/Imu", "topic= (--topic)", front, rear, "frame 'rear'")
    refused(path, "'/imu' is not", front, topic="/imu")
    refused(path, "/front/imu and /rear/imu are not gyros", topic="/front/imu,/rear/imu")
    refused(path, "has no messages", topic="/spare/imu")
    assert read(path, topic="/rear/imu").rate == pytest.approx(50.0)


@pytest.mark.parametrize("kind", KINDS)
def test_two_halves_are_one_recording(tmp_path, samples, kind):
    accel, gyro = samples * [0, 0, 0, 1, 1, 1], samples * [1, 1, 1, 0, 0, 0]
    stamps = regular()
    # Each lacks a few samples at its ends that the other has.
    topics = {
        "/camera/accel": Topic(stamps[3:] + 400_000, accel[3:]),
        "/camera/gyro": Topic(stamps[:-2], gyro[:-2]),
    }
    path = written(tmp_path, kind, topics)
    for chosen in (None, "/camera/accel,/camera/gyro"):
        recording = read(path, topic=chosen)
        np.testing.assert_array_equal(recording.values, samples[3:-2])
        assert recording.names == NAMES
    refused(path, "/camera/gyro (398 messages at 200 Hz, frame 'imu_link', gyros alone)", topic="/camera")
    half = read(path, topic="/camera/gyro")
    assert half.names == NAMES[:3]
    assert any("accelerations are zero throughout" in note for note in half.notes)


def test_two_halves_of_different_rates(tmp_path, samples):
    accel, gyro = samples[:100] * [0, 0, 0, 1, 1, 1], samples * [1, 1, 1, 0, 0, 0]
    topics = {"/accel": Topic(regular(100, 63.0), accel), "/gyro": Topic(regular(), gyro)}
    path = written(tmp_path, "ros1", topics)
    refused(path, "/gyro are at 200 Hz", "/accel at 63 Hz", "choose one by topic= (--topic)")
    assert read(path, topic="/accel").rate == pytest.approx(63.0)


def test_a_lost_message_of_a_half_is_a_gap(tmp_path, samples):
    kept = np.delete(np.arange(N), 200)
    topics = {
        "/accel": Topic(regular()[kept], (samples * [0, 0, 0, 1, 1, 1])[kept]),
        "/gyro": Topic(regular(), samples * [1, 1, 1, 0, 0, 0]),
    }
    refused(written(tmp_path, "ros1", topics), "a gap of 0.01 s", "before row 200")


def test_other_units_than_the_definition_says(tmp_path, samples):
    path = written(tmp_path, "ros1", {"/imu": Topic(regular(), samples)})
    recording = read(path, accel_unit="g")
    np.testing.assert_allclose(recording.values[:, 3:], samples[:, 3:] * 9.80665)


def test_bags_without_imu(tmp_path, samples):
    path = written(tmp_path, "ros1", {}, other=True)
    refused(path, "no topic of sensor_msgs/Imu, but /words (std_msgs/msg/String)")
    (tmp_path / "zero").mkdir()
    refused(written(tmp_path / "zero", "mcap", {"/imu": Topic(regular(), 0 * samples)}), "nothing but zeros")


def test_damaged_bags(tmp_path, samples):
    path = written(tmp_path, "ros1", {"/imu": Topic(regular(), samples)})
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    refused(path, "can not be read as a ROS bag", "rosbag reindex")
    folder = written(tmp_path, "mcap", {"/imu": Topic(regular(), samples)})
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information: {version: 99}")
    refused(folder, "can not be read as a ROS bag", "version 99")
    (folder / "metadata.yaml").unlink()
    refused(folder, "a folder", "metadata.yaml")


def test_a_message_that_is_none(tmp_path, samples):
    path = written(tmp_path, "ros1", {"/imu": Topic(regular(), samples)})
    content = bytearray(path.read_bytes())
    # The length of a frame in the midst.
    place = content.find(b"imu_link", len(content) // 2)
    content[place - 4] = 200
    path.write_bytes(content)
    refused(path, "of the topic /imu", "damaged")


def test_rosbags_is_not_there(tmp_path, samples, monkeypatch):
    path = written(tmp_path, "ros1", {"/imu": Topic(regular(), samples)})
    monkeypatch.setitem(sys.modules, "rosbags.rosbag1", None)
    refused(path, 'pip install "allanjax[ros]"')


def test_options_that_a_file_does_not_have(tmp_path, samples):
    path = tmp_path / "imu.npy"
    np.save(path, samples)
    refused(path, "(npy) has no topics", "leave out topic= (--topic)", topic="/imu")
    bag = written(tmp_path, "ros1", {"/imu": Topic(regular(), samples)})
    refused(bag, "has no instances", "--instance", instance=1)
    with pytest.raises(RecordingError, match="can not be read in chunks"):
        read_chunks(bag)


@pytest.mark.skipif(not (DATA / "phidgets_imu.bag").is_file(), reason="the folder of ALLANJAX_DATA is absent")
def test_real_bags():
    razor = read(DATA / "sparkfun_razor.bag")
    assert (razor.n, razor.names) == (2144, NAMES)
    assert razor.rate == pytest.approx(69.0, abs=0.1)
    # A tenth of a thousand messages are lost in the other one, which its stamps tell.
    refused(DATA / "phidgets_imu.bag", "a gap of 0.00757", "98 gaps", "start=43.190, stop=52.711")
    still = read(DATA / "phidgets_imu.bag", start=43.190, stop=52.711)
    assert still.rate == pytest.approx(250.0, rel=1e-3)
    assert np.linalg.norm(still.values.mean(axis=0)[3:]) == pytest.approx(9.8, abs=0.2)
