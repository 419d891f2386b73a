"""NumPy, MATLAB, Parquet, HDF5 and TDMS; and files of all kinds in chunks, as `read` gives them at once."""

import sys
import zipfile

import h5py
import nptdms
import numpy as np
import pandas as pd
import pytest
from imu_columns import DEG, G0, HEADER, SIX, UNITS, noted, refused
from scipy.io import savemat

import allanjax as aj
from benchmarks.common.damaged_files import WRITERS, outcome

RATE, ROWS = 100.0, 3007
NOISE = np.random.default_rng(1).normal(size=(ROWS, 6)) + 0.5
TIMES = 5.0 + np.arange(ROWS) / RATE
SI = NOISE * [*3 * [DEG], *3 * [G0]]
FRAME = pd.DataFrame(NOISE, columns=list(HEADER))
FRAME.insert(0, "time [s]", TIMES)
FRAME["temperature"] = np.sin(TIMES)


def check(path, stated=RATE, **options):
    recording = aj.read(path, **options)
    assert {*recording.names} == {*SIX}
    assert recording.rate == pytest.approx(stated, rel=1e-9)
    np.testing.assert_allclose(recording[SIX].values, SI, rtol=1e-14)
    return recording


def test_npy(tmp_path):
    path = tmp_path / "imu.npy"
    for array in (NOISE, np.rec.fromarrays(NOISE.T, names=list(SIX))):
        np.save(path, array)
        check(path, rate=RATE, **UNITS)
    for columns, sensor in ((NOISE[:, 0], "gyro"), (NOISE[None, :, 0], "gyro"), (NOISE[:, :3], "accel")):
        np.save(path, columns)
        recording = aj.read(path, rate=RATE, **{f"{sensor}_unit": UNITS[f"{sensor}_unit"]})
        assert recording.names == (("gyro",) if sensor == "gyro" else SIX[3:])
        np.testing.assert_allclose(recording.own_values, columns.reshape(ROWS, -1), rtol=1e-14)


# Named arrays: a rate, or stamps, are stated in several ways.
ARRAYS = [
    {"gyro": NOISE[:, :3], "accel": NOISE[:, 3:], "rate": RATE},
    {"omega": NOISE[:, :3], "acc": NOISE[:, 3:], "dt": 0.01},
    {"gyro": NOISE[:, :3], "accel": NOISE[:, 3:], "time": TIMES},
    dict(zip(SIX, NOISE.T, strict=True)) | {"fs": np.array([RATE])},
    {"data": NOISE, "sample_rate": RATE},
]


def test_named_arrays(tmp_path):
    for arrays in ARRAYS:
        np.savez(tmp_path / "imu.npz", **arrays)
        savemat(tmp_path / "imu.mat", arrays)
        savemat(tmp_path / "old.mat", arrays, format="4")
        for path in tmp_path.iterdir():
            assert (check(path, **UNITS).jitter is None) == ("time" not in arrays)
    path = tmp_path / "imu.mat"
    savemat(path, {"imu": ARRAYS[0] | {"serial": "A7"}, "note": "static"})
    assert noted(check(path, **UNITS), "imu.serial")
    # Kinds and sizes that would end the program, at their places in the file.
    wrong = [(176, 8, "kind 8"), (144, 6 | 0x800, "without its numbers"), (132, 10**9, "1000000000 bytes")]
    savemat(path, {"gyro": NOISE[:50, :3]})
    whole = path.read_bytes()
    for place, value, word in [*wrong, (128, 6, "kind 6")]:
        content = bytearray(whole)
        content[place : place + 4] = value.to_bytes(4, "little")
        path.write_bytes(content)
        refused(path, word, rate=RATE, **UNITS)


def test_hdf5_and_matlab_7_3(tmp_path):
    """MATLAB's columns are rows, its vectors either way, and its text numbers."""
    path = tmp_path / "imu.h5"
    with h5py.File(path, "w") as file:
        file["imu/gyro [deg/s]"], file["imu/accel [g]"] = NOISE[:, :3], NOISE[:, 3:]
        file["imu/fs"], file["operator"] = RATE, "A. N. Other"
    check(path)
    same_in_chunks(path, 1000)
    for shape in ((1, ROWS), (ROWS, 1)):
        arrays = {"gyro": NOISE[:, :3].T, "accel": NOISE[:, 3:].T, "t": TIMES.reshape(shape)}
        arrays["title"] = np.frombuffer(b"t\0e\0s\0t\0", np.uint16)[:, None]
        with h5py.File(path, "w", userblock_size=512) as file:
            for name, values in arrays.items():
                file[name] = values
                file[name].attrs["MATLAB_class"] = np.bytes_("char" if name == "title" else "double")
        with path.open("r+b") as stream:
            stream.write(b"MATLAB 7.3 MAT-file")
        check(path, time_unit="s", **UNITS)
        same_in_chunks(path, 1000, time_unit="s", **UNITS)


@pytest.mark.parametrize("groups", [("imu", "imu"), ("gyros", "accels")])
def test_tdms(tmp_path, groups, capsys):
    path = tmp_path / "imu.tdms"
    about = [{"unit_string": unit, "wf_increment": 0.005} for unit in ("deg/s", "g")]
    with nptdms.TdmsWriter(path) as writer:
        channels = zip(np.repeat(groups, 3), SIX, NOISE.T, np.repeat(about, 3), strict=True)
        writer.write_segment([nptdms.ChannelObject(*channel) for channel in channels])
    check(path, 200.0)
    path.write_bytes(path.read_bytes()[: -3 * 8 * ROWS])
    cut = aj.read(path)
    np.testing.assert_allclose(cut.own_values, NOISE[:, :3], rtol=1e-14)
    assert "damaged" in cut.notes[0]
    assert not any(capsys.readouterr())


def test_packages_that_are_not_there_are_named(tmp_path, monkeypatch):
    for head, package, extra in ((b"\x89HDF\r\n\x1a\n", "h5py", "hdf5"), (b"TDSm", "nptdms", "tdms")):
        (tmp_path / "imu.bin").write_bytes(head + bytes(600))
        monkeypatch.setitem(sys.modules, package, None)
        refused(tmp_path / "imu.bin", f"allanjax[{extra}]")


# Formats of few digits: the unit in which these files have the samples, and half of the last digit.
DIGITS = {"VectorNav": (1.0, 5.1e-6), "ULog, FIFO": (0.1, 5.1e-5)}


@pytest.mark.parametrize("name", WRITERS)
def test_files_of_every_format_are_read_and_damaged_ones_are_refused_by_name(tmp_path, name):
    sample = WRITERS[name](tmp_path)
    whole, x = aj.read(sample.path, **sample.options), sample.part.read_bytes()
    assert whole.rate == pytest.approx(100.0, rel=1e-9)
    truth, (scale, digit) = np.load(WRITERS[".npy"](tmp_path).path), DIGITS.get(name, (1.0, 0.0))
    np.testing.assert_allclose(whole[SIX].values, scale * truth, rtol=1e-15, atol=digit)
    assert outcome(sample, whole) == "as before"
    half = len(x) // 2
    for damaged in (x[:-half], b"\x00\x01" + x[2:], x[:half] + bytes(100) + x[half + 100 :], x + x[half:]):
        sample.part.write_bytes(damaged)
        assert outcome(sample, whole) in ("as before", "otherwise", "refused")


def test_what_claims_to_be_large_takes_no_memory(tmp_path):
    with h5py.File(tmp_path / "imu.h5", "w") as file:
        file.create_dataset("gyro", shape=(10**12, 3), dtype="f8", chunks=(1000, 3))
    refused(tmp_path / "imu.h5", "24000000000000", rate=RATE, **UNITS)
    # Some 2 GB in 7 MB, which a file of constant numbers could hold.
    with h5py.File(tmp_path / "imu.h5", "w") as file:
        file.create_dataset("gyro", shape=(10**8, 3), dtype="f8", chunks=(1000, 3))
        file["accel"] = np.random.default_rng(0).random(900_000)
    refused(tmp_path / "imu.h5", "2407200000|equal", rate=RATE, **UNITS)
    path = tmp_path / "imu.npz"
    np.savez_compressed(path, gyro=NOISE[:50, :3])
    with zipfile.ZipFile(path) as archive:
        content = archive.read("gyro.npy").replace(b"(50, 3), }", b"(50000000000, 3), }")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("gyro.npy", content.replace(b" " * 9, b"", 1))
    refused(path, "50000000000", rate=RATE, **UNITS)
    np.savez_compressed(path, gyro=np.tile(NOISE[:50, :3], (4000, 1)), accel=np.zeros((200_000, 3)))
    assert aj.read(path, rate=RATE, **UNITS).n == 200_000


def save(frame, path):
    if path.suffix == ".txt":
        path.write_text("# " + "\t".join(frame) + "\n" + frame.to_csv(sep="\t", header=False, index=False))
    elif path.suffix == ".parquet":
        frame.to_parquet(path, row_group_size=700)
    elif path.suffix == ".npy":
        np.save(path, frame.to_records(index=False))
    elif path.suffix == ".h5":
        with h5py.File(path, "w") as file:
            for name in frame:
                file[name] = frame[name].to_numpy()
    else:
        frame.to_csv(path, index=False)
    return path


def same_in_chunks(path, chunk, **options):
    """Chunks that are together what `read` gives, twice; the recording in chunks."""
    whole, chunks = aj.read(path, **options), aj.read_chunks(path, chunk=chunk, **options)
    for _ in range(2):
        parts = list(chunks)
        assert max(map(len, parts)) <= chunk
        # The rate of increments is that of the first chunk.
        np.testing.assert_allclose(np.concatenate(parts), whole.values, rtol=1e-9)
    assert chunks.rate == pytest.approx(whole.rate, rel=1e-9)
    np.testing.assert_allclose(chunks.own_scales, whole.own_scales, rtol=1e-9)
    assert (chunks.axes, chunks.names, chunks.name) == (whole.axes, whole.names, whole.name)
    assert chunks.n in (None, whole.n)
    return chunks


@pytest.mark.parametrize("suffix", [".csv", ".csv.gz", ".txt", ".parquet", ".npy", ".h5"])
def test_chunks_are_what_read_gives(tmp_path, suffix):
    path = save(FRAME, tmp_path / f"imu{suffix}")
    for stretch in ({}, {"start": 3.005, "stop": 17.3}, {"start": 29.5}, {"stop": 0.5}):
        for chunk in (1000, 3006):
            chunks = same_in_chunks(path, chunk, **stretch)
            assert (chunks.n is None) == (bool(stretch) or suffix in (".csv", ".csv.gz", ".txt"))
    assert any("temperature" in note for note in chunks.notes)
    save(FRAME.assign(**{"accel_y [g]": FRAME["accel_y [g]"].where(FRAME.index != 2345)}), path)
    # A line of header comes first, and lines are counted from 1.
    place = "row 2345" if suffix in (".parquet", ".npy", ".h5") else "line 2347"
    for start in (None, 20.5):
        refused(lambda start=start: list(aj.read_chunks(path, chunk=1000, start=start)), f"accel_y|{place}")
    assert sum(map(len, aj.read_chunks(path, chunk=1000, stop=23.0))) == 2300


def test_chunks_of_other_tables(tmp_path):
    k, axes = np.arange(ROWS), pd.DataFrame(NOISE, columns=list(SIX))
    np.save(tmp_path / "plain.npy", NOISE)
    np.savetxt(tmp_path / "plain.csv", NOISE, delimiter=",")
    names = [f"dtheta_{a} [rad]" for a in "xyz"] + [f"dv_{a} [m/s]" for a in "xyz"]
    increments = axes.set_axis(names, axis=1).assign(timestamp_ns=1_700_000_000_000_000_000 + 10_000_000 * k)
    save(increments, tmp_path / "increments.parquet")
    halves = axes.assign(stamp_secs=1_700_000_000 + k // 100, stamp_nsecs=k % 100 * 10_000_000)
    save(halves, tmp_path / "halves.parquet")
    dates = axes.assign(time=pd.Timestamp("2024-03-01") + pd.to_timedelta(10 * k, "ms"))
    save(dates, tmp_path / "dates.parquet")
    for path in tmp_path.iterdir():
        options = {"increments": {}, "plain": UNITS | {"rate": RATE}}.get(path.stem, UNITS)
        for stretch in ({}, {"start": 9.99, "stop": 20.02}):
            same_in_chunks(path, 1000, **options, **stretch)


def test_what_goes_wrong_in_a_later_chunk(tmp_path):
    """The rate is that of the first chunk, with which later stamps must agree within 1 %."""
    k, path = np.arange(ROWS), tmp_path / "imu.parquet"

    def chunks(**options):
        return sum(map(len, aj.read_chunks(path, chunk=1000, **options)))

    # Gaps in a chunk and between two; both stretches that are offered can be read.
    for row in (20, 2000, 2345):
        save(FRAME.assign(**{"time [s]": TIMES + 0.5 * (k >= row)}), path)
        stop, start = (row - 1) / RATE, row / RATE + 0.5
        refused(chunks, f"0.51 s|row {row} |stop={stop:.3f}|start={start:.3f}")
        counts = [chunks(stop=stop), chunks(start=start), chunks(time=False, rate=RATE)]
        assert counts == [row - 1, ROWS - row, ROWS]
        save(FRAME.drop(index=row), path)
        refused(chunks, f"0.02 s (2 intervals)|row {row} ")
    again, slower = np.where(k == 2000, 19.99, k / RATE), np.where(k < 2000, k / RATE, 20 + (k - 2000) / 90)
    for times, words in ((again, "repeats|row 2000"), (slower, "100 Hz until")):
        save(FRAME.assign(**{"time [s]": times}), path)
        refused(chunks, words)
    slower = k / RATE * (1.0 + 1e-7 * k)
    save(FRAME.assign(**{"time [s]": slower}), path)
    assert aj.read_chunks(path, chunk=1000).rate == pytest.approx(999 / slower[999], rel=1e-12)
    assert chunks() == ROWS
    # An axis may be constant for a chunk, or dead; if all are, that is an error.
    for part in (k < 1500, k >= ROWS - 1500):
        same_in_chunks(save(FRAME.assign(**{HEADER[1]: FRAME[HEADER[1]].where(part, 0.25)}), path), 1000)
    dead = aj.read_chunks(save(FRAME.assign(**{HEADER[1]: np.nan}), path), chunk=1000)
    assert np.isnan(np.concatenate([*dead])[:, 1]).all()
    save(FRAME.assign(**dict.fromkeys(HEADER, 0.25)), path)
    refused(chunks, "gyro_x|constant (0.25 from row 0")
