"""LabVIEW's TDMS files give what was written into them."""

import sys

import numpy as np
import pytest

from allanjax.base.errors import RecordingError
from allanjax.record.io import read

nptdms = pytest.importorskip("nptdms")
N = 100


@pytest.fixture(scope="module")
def samples():
    return np.random.default_rng(7).normal(size=(N, 6))


def written(folder, samples, groups=("imu", "imu"), **properties):
    path = folder / "imu.tdms"
    with nptdms.TdmsWriter(path) as writer:
        channels = []
        for sensor, unit, group, part in zip(("gyro", "accel"), ("deg/s", "g"), groups, (0, 3), strict=True):
            more = {"unit_string": unit, **properties}
            channels += [
                nptdms.ChannelObject(group, f"{sensor}_{axis}", samples[:, part + k], more)
                for k, axis in enumerate("xyz")
            ]
        writer.write_segment(channels)
    return path


@pytest.mark.parametrize("groups", [("imu", "imu"), ("gyros", "accels")])
def test_what_was_written(tmp_path, samples, groups):
    recording = read(written(tmp_path, samples, groups, wf_increment=0.005))
    assert recording.rate == pytest.approx(200.0)
    both = recording[["gyro", "accel"]]
    assert [axis.unit for axis in both.axes] == [*3 * ["deg/s"], *3 * ["g"]]
    np.testing.assert_allclose(both.own_values, samples, rtol=1e-12)


def test_without_an_interval(tmp_path, samples):
    path = written(tmp_path, samples)
    assert read(path, rate=50.0).rate == 50.0
    with pytest.raises(RecordingError, match="no sample rate"):
        read(path)


def test_a_file_cut_short(tmp_path, samples, capsys):
    path = written(tmp_path, samples, wf_increment=0.005)
    path.write_bytes(path.read_bytes()[:-2400])
    recording = read(path)
    # The channels are one after the other.
    assert recording.names == ("gyro_x", "gyro_y", "gyro_z")
    assert "the file is damaged: " in recording.notes[0]
    assert not any(capsys.readouterr())


def test_nptdms_is_not_there(tmp_path, samples, monkeypatch):
    path = written(tmp_path, samples)
    monkeypatch.setitem(sys.modules, "nptdms", None)
    with pytest.raises(RecordingError, match=r'pip install "allanjax\[tdms\]"'):
        read(path)
