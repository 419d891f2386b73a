"""A file that was damaged at random, as others are in the study `fuzz`, memory of chunks, real sensors."""

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
