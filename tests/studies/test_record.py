"""Files damaged at random, and memory of chunks: studies of the readers."""

import tracemalloc

import numpy as np
import pandas as pd
import pytest
from imu_columns import HEADER

import allanjax as aj
from benchmarks.common.damaged_files import WRITERS, damaged, outcome, sample_files

pytestmark = pytest.mark.study
#: Damaged files of each format; the benchmark reads a hundred thousand.
COUNT = 100


@pytest.fixture(scope="module")
def samples(tmp_path_factory):
    return sample_files(tmp_path_factory.mktemp("whole"))


@pytest.mark.parametrize("name", WRITERS)
def test_damaged_files_are_read_right_or_refused(samples, name):
    sample = samples[name]
    content = sample.part.read_bytes()
    whole = aj.read(sample.path, **sample.options)
    assert outcome(sample, whole) == "as before"
    for seed in range(COUNT):
        sample.part.write_bytes(damaged(content, np.random.default_rng([seed, 1])))
        told = outcome(sample, whole)
        assert told in ("as before", "otherwise", "refused"), f"seed {seed}: {told}"
    sample.part.write_bytes(content)


def test_a_log_in_which_pyulog_would_go_back_for_ever(samples, tmp_path):
    """The last of its definitions claims more bytes than there are."""
    path = tmp_path / "log.ulg"
    path.write_bytes(damaged(samples["ULog"].part.read_bytes(), np.random.default_rng(5_001_447)))
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
