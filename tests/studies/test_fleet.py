"""Deaths of workers, and memory of streams; the study `fleet` has false marks by many draws."""

import os
import signal
import tracemalloc

import numpy as np
import pandas as pd
import pytest

import allanjax as aj

pytestmark = pytest.mark.study


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
