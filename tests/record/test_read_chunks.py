"""Reading in chunks: the same as reading at once, in flat memory, with errors that name the place."""

import gzip
import tracemalloc

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from imu_columns import HEADER, SIX, UNITS

import allanjax as aj
from allanjax.record.io import read, read_chunks
from allanjax.record.io.table import Table
from allanjax.record.validation import Source

h5py = pytest.importorskip("h5py")

RATE, ROWS = 100.0, 3007
SIZES = (1000, 999, 3006, 10**6)


@pytest.fixture(scope="module")
def noise():
    return np.random.default_rng(1).normal(size=(ROWS, 6)) + 0.5


@pytest.fixture(scope="module")
def frame(noise):
    table = pd.DataFrame(noise, columns=list(HEADER))
    table.insert(0, "time [s]", 1e4 + np.arange(ROWS) / RATE)
    return table.assign(temperature=20.0)


def save(frame, path):
    """The frame in the format of the suffix."""
    if path.name.endswith(".csv.gz"):
        path.write_bytes(gzip.compress(frame.to_csv(index=False).encode()))
    elif path.suffix == ".csv":
        frame.to_csv(path, index=False)
    elif path.suffix == ".txt":
        path.write_text("# " + "\t".join(frame) + "\n" + frame.to_csv(sep="\t", header=False, index=False))
    elif path.suffix == ".parquet":
        frame.to_parquet(path, row_group_size=700)
    elif path.suffix == ".npy":
        np.save(path, frame.to_records(index=False))
    elif path.suffix == ".h5":
        with h5py.File(path, "w") as file:
            for name in frame:
                file[name] = frame[name].to_numpy()
    return path


SUFFIXES = (".csv", ".csv.gz", ".txt", ".parquet", ".npy", ".h5")


def check(path, chunk, **options):
    """Chunks that are together what `read` gives; the recording in chunks."""
    whole = read(path, **options)
    chunks = read_chunks(path, chunk=chunk, **options)
    for _ in range(2):
        parts = list(chunks)
        assert max(len(part) for part in parts) <= chunk
        assert min(len(part) for part in parts) > 0
        # The rate of increments is that of the first chunk.
        np.testing.assert_allclose(np.concatenate(parts), whole.values, rtol=1e-9)
    assert chunks.rate == pytest.approx(whole.rate, rel=1e-9)
    np.testing.assert_allclose(chunks.own_scales, whole.own_scales, rtol=1e-9)
    assert (chunks.axes, chunks.names, chunks.name) == (whole.axes, whole.names, whole.name)
    assert chunks.n in (None, whole.n)
    return chunks


# --- The same as reading at once ----------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("stretch", [{}, {"start": 3.005, "stop": 17.3}, {"start": 29.5}, {"stop": 0.5}])
def test_chunks_are_what_read_gives(tmp_path, frame, suffix, stretch):
    path = save(frame, tmp_path / f"imu{suffix}")
    for chunk in SIZES:
        chunks = check(path, chunk, **stretch)
        assert "not read: temperature" in chunks.notes
        assert any(note.startswith("sample rate 100 Hz from column 'time [s]'") for note in chunks.notes)
        assert (chunks.n is None) == (bool(stretch) or ".csv" in suffix or suffix == ".txt")


@pytest.mark.parametrize("stretch", [{}, {"start": 3.005, "stop": 17.3}])
def test_plain_arrays_without_stamps(tmp_path, noise, stretch):
    np.save(tmp_path / "imu.npy", noise)
    np.savetxt(tmp_path / "imu.csv", noise, delimiter=",")
    with h5py.File(tmp_path / "imu.h5", "w") as file:
        file.create_dataset("data", data=noise, chunks=(100, 6), compression="gzip")
    for name, known in (("imu.npy", True), ("imu.csv", False), ("imu.h5", True)):
        for chunk in SIZES:
            chunks = check(tmp_path / name, chunk, rate=RATE, **UNITS, **stretch)
            assert (chunks.n is not None) == known
            assert (
                chunks.notes[: 1 + known]
                == read(tmp_path / name, rate=RATE, **UNITS, **stretch).notes[: 1 + known]
            )


def test_increments_are_multiplied_by_the_rate(tmp_path, noise):
    frame = pd.DataFrame(noise[:, :3], columns=[f"delta_angle_{axis} [rad]" for axis in "xyz"])
    frame["timestamp_ns"] = 1_700_000_000_000_000_000 + 10_000_000 * np.arange(ROWS)
    chunks = check(save(frame, tmp_path / "imu.parquet"), 1000)
    assert "increments multiplied by the rate: gyro_x, gyro_y, gyro_z" in chunks.notes


@pytest.mark.parametrize(
    "stamps",
    [
        lambda k: pd.DataFrame({"stamp_secs": 1_700_000_000 + k // 100, "stamp_nsecs": k % 100 * 10_000_000}),
        lambda k: pd.DataFrame({"timestamp": 1_700_000_000_000 + 10 * k}),
        lambda k: pd.DataFrame({"time": pd.Timestamp("2024-03-01") + pd.to_timedelta(10 * k, "ms")}),
    ],
)
@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_stamps_of_all_kinds(tmp_path, noise, stamps, suffix):
    frame = pd.concat([stamps(np.arange(ROWS)), pd.DataFrame(noise, columns=list(SIX))], axis=1)
    path = save(frame, tmp_path / f"imu{suffix}")
    check(path, 1000, **UNITS)
    check(path, 1000, **UNITS, start=9.99, stop=10.02 + 10.0)


def test_rate_is_that_of_the_first_chunk(tmp_path, frame):
    drifting = frame.assign(**{"time [s]": np.arange(ROWS) / RATE * (1.0 + 1e-7 * np.arange(ROWS))})
    chunks = read_chunks(save(drifting, tmp_path / "imu.parquet"), chunk=1000)
    assert chunks.rate == pytest.approx(999 / drifting["time [s]"][999], rel=1e-12)
    assert any("of the first 1000 samples" in note for note in chunks.notes)
    assert sum(map(len, chunks)) == ROWS


def test_a_table_in_more_pieces_than_asked_for_is_put_together(noise):
    """As of a Parquet file with more text than Arrow puts into one array."""
    pieces = (noise[:7], noise[7:2000], noise[2000:])
    table = Table(lambda chunk: (tuple(piece.T) for piece in pieces), None, Source("pieces"))
    np.testing.assert_array_equal(np.column_stack(table.columns()), noise)
    with pytest.raises(aj.RecordingError, match="no rows"):
        Table(lambda chunk: iter(()), None, Source("nothing")).columns()


# --- HDF5 ---------------------------------------------------------------------------------------------------


def test_hdf5_of_matrices_groups_and_scalars(tmp_path, noise):
    path = tmp_path / "imu.h5"
    with h5py.File(path, "w") as file:
        file["imu/gyro [deg/s]"] = noise[:, :3]
        file["imu/accel [g]"] = noise[:, 3:]
        file["imu/fs"] = RATE
        file["operator"] = "A. N. Other"
    recording = read(path)
    assert set(recording.names) == set(SIX)
    np.testing.assert_allclose(recording[SIX].own_values, noise, rtol=1e-14)
    assert "sample rate 100 Hz from 'imu.fs'" in recording.notes
    check(path, 1000)


@pytest.mark.parametrize("shape", [(1, ROWS), (ROWS, 1)])
def test_matlab_7_3_is_transposed(tmp_path, noise, shape):
    """As MATLAB writes it: columns are rows, vectors either way, text as numbers, a header of 512 bytes."""
    path = tmp_path / "imu.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in (
            ("gyro", noise[:, :3].T),
            ("accel", noise[:, 3:].T),
            ("t", np.arange(ROWS).reshape(shape) / RATE),
        ):
            file[name] = values
            file[name].attrs["MATLAB_class"] = np.bytes_("double")
        file["title"] = np.frombuffer(b"t\0e\0s\0t\0", np.uint16)[:, None]
        file["title"].attrs["MATLAB_class"] = np.bytes_("char")
    with path.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file")
    recording = read(path, time_unit="s", **UNITS)
    np.testing.assert_allclose(recording[SIX].own_values, noise, rtol=1e-14)
    check(path, 1000, time_unit="s", **UNITS)


def test_without_h5py(tmp_path, frame, monkeypatch):
    path = save(frame, tmp_path / "imu.h5")
    monkeypatch.setitem(__import__("sys").modules, "h5py", None)
    for reader in (read, read_chunks):
        with pytest.raises(aj.RecordingError, match=r"imu\.h5.*pip install \"allanjax\[hdf5\]\".*'-v7'"):
            reader(path)


# --- Memory -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".npy", ".h5"])
def test_memory_is_that_of_a_chunk(tmp_path, suffix):
    """A file of three times the rows takes no more: the peak is within a few chunks of the same."""

    def peak(rows):
        noise = np.random.default_rng(2).normal(size=(rows, 3))
        path = save(pd.DataFrame(noise, columns=list(HEADER[:3])), tmp_path / f"imu{suffix}")
        chunks = read_chunks(path, rate=RATE, chunk=1000)
        next(iter(chunks))
        tracemalloc.start()
        assert sum(map(len, chunks)) == rows
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return peak

    assert peak(60_000) < peak(20_000) + 10 * 1000 * 3 * 8


# --- Errors -------------------------------------------------------------------------------------------------


def fails(path, *said, **options):
    """Reading all chunks of a thousand raises an error that says all this, and names the file."""
    with pytest.raises(aj.RecordingError) as caught:
        list(read_chunks(path, chunk=1000, **options))
    message = str(caught.value)
    for words in (path.name, *said):
        assert words in message, message


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_bad_value_in_the_third_chunk(tmp_path, frame, suffix):
    broken = frame.copy()
    broken.loc[2345, "accel_y [g]"] = np.nan
    path = save(broken, tmp_path / f"imu{suffix}")
    # A line of header comes first, and lines are counted from 1.
    place = "line 2347" if suffix in (".csv", ".csv.gz", ".txt") else "row 2345"
    fails(path, "'accel_y [g]'", place, "repair the file")
    assert sum(map(len, read_chunks(path, chunk=1000, stop=23.0))) == 2300
    fails(path, place, start=12.0)


@pytest.mark.parametrize("suffix", [".csv", ".npy"])
def test_bad_value_without_stamps(tmp_path, frame, suffix):
    broken = frame.copy()
    broken.loc[2345, "accel_y [g]"] = np.inf
    path = save(broken, tmp_path / f"imu{suffix}")
    place = "line 2347" if suffix == ".csv" else "row 2345"
    fails(path, "'accel_y [g]'", place, "inf", time=False, rate=RATE, start=5.0)


def test_text_and_ragged_rows(tmp_path, frame):
    lines = frame.to_csv(index=False).splitlines()
    path = tmp_path / "imu.csv"
    path.write_text(
        "\n".join([*lines[:2500], lines[2500].replace(lines[2500].split(",")[3], "n/k"), *lines[2501:]])
    )
    fails(path, "line 2501", "'n/k'", "'gyro_z [deg/s]'")
    path.write_text("\n".join([*lines[:2500], lines[2500] + ",1,2", *lines[2501:]]))
    fails(path, "line 2501 has 10 columns where 8 are expected")
    path.with_suffix(".csv.gz").write_bytes(gzip.compress("\n".join(lines).encode())[:-5000])
    fails(path.with_suffix(".csv.gz"), "can not be read", "compress it again")


@pytest.mark.parametrize("row", [500, 2000, 2345])
def test_gap_of_the_stamps(tmp_path, frame, row):
    """In a chunk and between two; both stretches that are offered can be read."""
    times = frame["time [s]"] + np.where(np.arange(ROWS) < row, 0.0, 0.5)
    path = save(frame.assign(**{"time [s]": times}), tmp_path / "imu.parquet")
    stop, start = (row - 1) / RATE, row / RATE + 0.5
    fails(path, "gap of 0.51 s", f"row {row} ", f"stop={stop:.3f}", f"start={start:.3f}", "time='none'")
    assert sum(map(len, read_chunks(path, chunk=1000, stop=stop))) == row - 1
    assert sum(map(len, read_chunks(path, chunk=1000, start=start))) == ROWS - row
    assert sum(map(len, read_chunks(path, chunk=1000, time=False, rate=RATE))) == ROWS


def test_one_lost_sample_is_a_gap(tmp_path, frame):
    """In the first chunk and in a later one."""
    for row in (20, 2020):
        path = save(frame.drop(index=row), tmp_path / "imu.parquet")
        fails(path, "gap of 0.02 s (2 intervals)", f"row {row} ")


def test_stamps_that_go_wrong(tmp_path, frame):
    k = np.arange(ROWS)
    path = tmp_path / "imu.parquet"
    save(frame.assign(**{"time [s]": np.where(k == 2000, 19.99, k / RATE)}), path)
    fails(path, "'time [s]' repeats the time before it at row 2000")
    save(frame.assign(**{"time [s]": np.where(k < 2000, k / RATE, 20.0 + (k - 2000) / 90.0)}), path)
    fails(path, "rate 100 Hz contradicts column 'time [s]'")
    save(frame.assign(**{"time [s]": np.where(k == 2345, np.nan, k / RATE)}), path)
    fails(path, "'time [s]' has no time at row 2345")
    save(frame, path)
    fails(path, "rate 50 Hz contradicts", rate=50.0)


def test_axis_that_never_changes(tmp_path, frame):
    path = save(frame.assign(**dict.fromkeys(HEADER, 0.25)), tmp_path / "imu.parquet")
    fails(path, "'gyro_x [deg/s]' is constant (0.25 from row 0", "leave it out")
    # For a chunk it may be.
    for part in (np.arange(ROWS) < 1500, np.arange(ROWS) >= ROWS - 1500):
        still = {name: np.where(part, 0.25, frame[name]) for name in HEADER}
        check(save(frame.assign(**{"gyro_y [deg/s]": still["gyro_y [deg/s]"]}), path), 1000)
        check(save(frame.assign(**still), path), 1000)


def test_files_that_are_none(tmp_path, frame, noise):
    fails(tmp_path / "absent.csv", "no such file")
    np.savez(tmp_path / "imu.npz", gyro=noise[:, :3])
    fails(tmp_path / "imu.npz", "in chunks", "Parquet", "read()")
    (tmp_path / "imu.h5").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    fails(tmp_path / "imu.h5", "can not be read as HDF5")
    pq.write_table(pq.read_table(save(frame, tmp_path / "imu.parquet")).slice(0, 0), tmp_path / "no.parquet")
    fails(tmp_path / "no.parquet", "no rows")
    short = save(frame.iloc[:10], tmp_path / "short.csv")
    fails(short, "too short: 10 samples")
    fails(short, "too short: 10 samples", time=False, rate=RATE)
    path = save(frame, tmp_path / "imu.csv")
    fails(path, "no sample rate", time=False)
    fails(path, "too short: 0 samples", start=1e3)
    with pytest.raises(aj.RecordingError, match="chunk must be at least 1"):
        read_chunks(path, chunk=0)
    with pytest.raises(aj.UnitError, match="gyro_unit"):
        read_chunks(path, gyro_unit="rad/s")
