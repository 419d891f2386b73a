"""A damaged file, killed workers, memory of chunks and streams, real sensors; more by `fuzz` and `fleet`."""

import os
import signal
import tracemalloc

import numpy as np
import pandas as pd
import pytest
from imu_columns import HEADER
from places import DATA

import allanjax as aj
from benchmarks.common.damaged_files import damaged, sample_files

pytestmark = pytest.mark.study


def test_a_log_in_which_pyulog_would_go_back_for_ever(tmp_path):
    """The last of its definitions claims more bytes than there are."""
    whole, path = sample_files(tmp_path)["ULog"].part.read_bytes(), tmp_path / "log.ulg"
    path.write_bytes(damaged(whole, np.random.default_rng(5_001_447)))
    with pytest.raises(aj.RecordingError, match="does not end"):
        aj.read(path)


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".npy"])
def test_memory_is_that_of_a_chunk(tmp_path, suffix):
    """A file of three times the rows takes no more: the peak is within a few chunks of the same."""

    def peak(rows):
        frame = pd.DataFrame(np.random.default_rng(2).normal(size=(rows, 3)), columns=list(HEADER[:3]))
        path = tmp_path / f"imu{suffix}"
        if suffix == ".csv":
            frame.to_csv(path, index=False)
        elif suffix == ".parquet":
            frame.to_parquet(path, row_group_size=700)
        else:
            np.save(path, frame.to_records(index=False))
        chunks = aj.read_chunks(path, rate=100.0, chunk=1000)
        next(iter(chunks))
        tracemalloc.start()
        assert sum(map(len, chunks)) == rows
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return most

    assert peak(60_000) < peak(20_000) + 10 * 1000 * 3 * 8


@pytest.mark.parametrize("unit", [1, 2])
def test_real_sensors_are_not_stopped(unit):
    path = DATA / f"adis16405_unit{unit}.parquet"
    if not path.exists():
        pytest.skip(f"the recordings of real sensors are not here: {path}")
    found = aj.check(aj.read(path, rate=100, gyro_unit="deg/s", accel_unit="g"))
    assert {line.verdict for line in found.lines} == {"fine", "look"}
    # A count is 3.33 mg, as in the data sheet.
    assert "0.00333 g" in found["resolution"].reason
    assert found["saturation"].verdict == found["repeated samples"].verdict == "fine"


@pytest.fixture
def logs(tmp_path):
    rng = np.random.default_rng(1)
    for k in range(10):
        x = 0.1 * rng.standard_normal(5000)
        recording = aj.Recording.from_array(x, 100.0, gyro_unit="deg/s", names=["gyro_x"])
        aj.write(recording, tmp_path / f"unit_{k}.parquet")
    return tmp_path


def test_a_worker_killed_half_way_loses_nothing(logs, tmp_path):
    from distributed import Client, LocalCluster

    killed = []
    with (
        LocalCluster(n_workers=2, threads_per_worker=1, processes=True) as cluster,
        Client(cluster) as client,
    ):

        def kill(done, failed, total):
            if done and not killed:
                busy = {address for address, tasks in client.processing().items() if tasks}
                address, pid = next((a, p) for a, p in client.run(os.getpid).items() if a in busy)
                os.kill(pid, signal.SIGKILL)
                killed.append(address)

        options = {"scheduler": cluster.scheduler_address}
        first = aj.characterize_fleet(logs / "*.parquet", tmp_path / "a", "N + B", progress=kill, **options)
        second = aj.characterize_fleet(logs / "*.parquet", tmp_path / "b", "N + B", **options)
    assert len(killed) == 1
    assert first.errors == ()
    pd.testing.assert_frame_equal(first.table, second.table)


def test_memory_does_not_grow_with_the_stream():
    """18 million more samples are 144 MB; a hundredth of that is to spare."""

    def peak(millions):
        accumulator, rng = aj.AllanAccumulator(200.0, ["gyro_x"]), np.random.default_rng(0)
        tracemalloc.start()
        for _ in range(millions):
            accumulator.update(rng.standard_normal(1_000_000))
        accumulator.result()
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return most

    peak(1)
    assert peak(20) - peak(2) < 1_440_000
