"""NumPy, MATLAB, Parquet, HDF5 and TDMS; and files of all kinds in chunks, as `read` gives them at once."""

import sys
import zipfile

import h5py
import nptdms
import numpy as np
import pandas as pd
import pytest
from imu_columns import DEG, G0, HEADER, SIX, UNITS
from places import DATA
from scipy.io import savemat

import allanjax as aj

RATE, ROWS = 100.0, 3007
NOISE = np.random.default_rng(1).normal(size=(ROWS, 6)) + 0.5
TIMES = 5.0 + np.arange(ROWS) / RATE
SI = NOISE * [*3 * [DEG], *3 * [G0]]
FRAME = pd.DataFrame(NOISE, columns=list(HEADER))
FRAME.insert(0, "time [s]", TIMES)
FRAME["temperature"] = np.sin(TIMES)


def check(path, stated=RATE, **options):
    """The file has the noise, at this rate; the recording."""
    recording = aj.read(path, **options)
    assert {*recording.names} == {*SIX}
    assert recording.rate == pytest.approx(stated, rel=1e-9)
    np.testing.assert_allclose(recording[SIX].values, SI, rtol=1e-14)
    return recording


def test_npy(tmp_path):
    path = tmp_path / "imu.npy"
    np.save(path, NOISE)
    check(path, rate=RATE, **UNITS)
    np.save(path, np.rec.fromarrays(NOISE.T, names=list(SIX)))
    check(path, rate=RATE, **UNITS)
    for columns, unit, names in (
        (NOISE[:, 0], {"gyro_unit": "deg/s"}, ("gyro",)),
        (NOISE[None, :, 0], {"gyro_unit": "deg/s"}, ("gyro",)),
        (NOISE[:, :3], {"accel_unit": "g"}, SIX[3:]),
    ):
        np.save(path, columns)
        recording = aj.read(path, rate=RATE, **unit)
        assert recording.names == names
        np.testing.assert_allclose(recording.own_values, columns.reshape(ROWS, -1), rtol=1e-14)


# Named arrays, and whether there are stamps: a rate is said in several ways.
ARRAYS = {
    "rate": {"gyro": NOISE[:, :3], "accel": NOISE[:, 3:], "rate": RATE},
    "dt": {"omega": NOISE[:, :3], "acc": NOISE[:, 3:], "dt": 0.01},
    "time": {"gyro": NOISE[:, :3], "accel": NOISE[:, 3:], "time": TIMES},
    "fs": dict(zip(SIX, NOISE.T, strict=True)) | {"fs": np.array([RATE])},
    "one matrix": {"data": NOISE, "sample_rate": RATE},
}


@pytest.mark.parametrize("name", ARRAYS)
def test_named_arrays(tmp_path, name):
    arrays = ARRAYS[name]
    np.savez(tmp_path / "imu.npz", **arrays)
    np.savez_compressed(tmp_path / "small.npz", **arrays)
    savemat(tmp_path / "imu.mat", arrays)
    savemat(tmp_path / "small.mat", arrays, do_compression=True)
    savemat(tmp_path / "old.mat", arrays, format="4")
    for path in tmp_path.iterdir():
        recording = check(path, **UNITS)
        assert (recording.jitter is None) == (name != "time")


def test_structs_of_matlab(tmp_path):
    """Text in it is left out, and told."""
    struct = {"gyro": NOISE[:, :3], "accel": NOISE[:, 3:], "fs": RATE, "serial": "A7"}
    savemat(tmp_path / "imu.mat", {"imu": struct, "note": "static"})
    recording = check(tmp_path / "imu.mat", **UNITS)
    assert any("imu.serial" in note for note in recording.notes)


def test_hdf5_of_matrices_groups_and_scalars(tmp_path):
    with h5py.File(tmp_path / "imu.h5", "w") as file:
        file["imu/gyro [deg/s]"] = NOISE[:, :3]
        file["imu/accel [g]"] = NOISE[:, 3:]
        file["imu/fs"] = RATE
        file["operator"] = "A. N. Other"
    check(tmp_path / "imu.h5")
    same_in_chunks(tmp_path / "imu.h5", 1000)


@pytest.mark.parametrize("shape", [(1, ROWS), (ROWS, 1)])
def test_matlab_7_3_is_transposed(tmp_path, shape):
    """As MATLAB writes it: columns are rows, vectors either way, text as numbers, a header of 512 bytes."""
    path = tmp_path / "imu.mat"
    arrays = {"gyro": NOISE[:, :3].T, "accel": NOISE[:, 3:].T, "t": TIMES.reshape(shape)}
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in arrays.items():
            file[name] = values
            file[name].attrs["MATLAB_class"] = np.bytes_("double")
        file["title"] = np.frombuffer(b"t\0e\0s\0t\0", np.uint16)[:, None]
        file["title"].attrs["MATLAB_class"] = np.bytes_("char")
    with path.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file")
    check(path, time_unit="s", **UNITS)
    same_in_chunks(path, 1000, time_unit="s", **UNITS)


@pytest.mark.parametrize("groups", [("imu", "imu"), ("gyros", "accels")])
def test_tdms(tmp_path, groups, capsys):
    """Units and the interval are properties; a file cut short has the channels before the cut."""
    path = tmp_path / "imu.tdms"
    channels = [
        nptdms.ChannelObject(
            groups[k // 3], name, NOISE[:, k], {"unit_string": ("deg/s", "g")[k // 3], "wf_increment": 0.005}
        )
        for k, name in enumerate(SIX)
    ]
    with nptdms.TdmsWriter(path) as writer:
        writer.write_segment(channels)
    check(path, 200.0)
    path.write_bytes(path.read_bytes()[: -3 * 8 * ROWS])
    cut = aj.read(path)
    np.testing.assert_allclose(cut.own_values, NOISE[:, :3], rtol=1e-14)
    assert "damaged" in cut.notes[0]
    assert not any(capsys.readouterr())


@pytest.mark.parametrize(
    ("name", "package", "extra"), [("imu.h5", "h5py", "hdf5"), ("imu.tdms", "nptdms", "tdms")]
)
def test_a_package_that_is_not_there_is_named(tmp_path, monkeypatch, name, package, extra):
    path = tmp_path / name
    path.write_bytes({"imu.h5": b"\x89HDF\r\n\x1a\n", "imu.tdms": b"TDSm"}[name] + bytes(600))
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(aj.RecordingError, match=rf"allanjax\[{extra}\]"):
        aj.read(path)


# --- Damage -------------------------------------------------------------------------------------------------


def _members(path):
    """An .npz file whose array claims to be large."""
    with path.open("wb") as stream:
        np.savez_compressed(stream, gyro=NOISE[:50, :3])
    with zipfile.ZipFile(path) as archive:
        content = archive.read("gyro.npy")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(
            "gyro.npy", content.replace(b"(50, 3), }", b"(50000000000, 3), }").replace(b" " * 9, b"", 1)
        )


def _claims(path):
    """An HDF5 file with a dataset of which nothing is there."""
    with h5py.File(path, "w") as file:
        file.create_dataset("gyro", shape=(10**12, 3), dtype="f8", chunks=(1000, 3))


# Writers of files, and damages of their content; all must be refused by name, or read as what is left.
WHOLE = {
    ".csv": lambda path: FRAME[:200].to_csv(path, index=False),
    ".csv.gz": lambda path: FRAME[:200].to_csv(path, index=False),
    ".npy": lambda path: np.save(path, FRAME[:200].to_records(index=False)),
    ".npz": lambda path: np.savez(path, **FRAME[:200]),
    ".mat": lambda path: savemat(path, {"gyro": NOISE[:200, :3], "fs": RATE}),
    ".parquet": lambda path: FRAME[:200].to_parquet(path),
    ".h5": lambda path: h5py.File(path, "w").create_dataset("gyro", data=NOISE[:200, :3]).file.close(),
}
DAMAGES = {
    "cut": lambda x: x[: len(x) * 2 // 3],
    "another beginning": lambda x: b"\x00\x01" + x[2:],
    "zeros": lambda x: x[: len(x) // 2] + bytes(100) + x[len(x) // 2 + 100 :],
    "doubled": lambda x: x + x[len(x) // 2 :],
}


@pytest.mark.parametrize("suffix", WHOLE)
def test_damaged_files_are_read_or_refused_by_name(tmp_path, suffix):
    path = tmp_path / f"imu{suffix}"
    WHOLE[suffix](path)
    content = path.read_bytes()
    for damage in DAMAGES.values():
        path.write_bytes(damage(content))
        told = ""
        try:
            recording = aj.read(path, gyro_unit="deg/s", rate=RATE)
            assert np.isfinite(recording.values).all()
        except aj.AllanjaxError as error:
            told = str(error)
        assert told.startswith(f"{path}: ") or not told


@pytest.mark.parametrize(("write", "claim"), [(_members, "50000000000"), (_claims, "24000000000000")])
def test_what_claims_to_be_large_takes_no_memory(tmp_path, write, claim):
    path = tmp_path / "imu.bin"
    write(path)
    with pytest.raises(aj.RecordingError, match=claim):
        aj.read(path, rate=RATE, **UNITS)


def test_what_is_compressed_as_far_as_it_can_be_is_read(tmp_path):
    np.savez_compressed(
        tmp_path / "imu.npz", gyro=np.tile(NOISE[:50, :3], (4000, 1)), accel=np.zeros((200_000, 3))
    )
    assert aj.read(tmp_path / "imu.npz", rate=RATE, **UNITS).n == 200_000


def test_elements_of_matlab_that_would_end_the_program(tmp_path):
    """Kinds and sizes that an array can not have, at their places in the file."""
    path = tmp_path / "imu.mat"
    for place, value, word in (
        (176, 8, "kind 8"),
        (144, 6 | 0x800, "without its numbers"),
        (132, 10**9, "1000000000 bytes"),
        (128, 6, "kind 6"),
    ):
        savemat(path, {"gyro": NOISE[:50, :3]})
        content = bytearray(path.read_bytes())
        content[place : place + 4] = value.to_bytes(4, "little")
        path.write_bytes(content)
        with pytest.raises(aj.RecordingError, match=word):
            aj.read(path, rate=RATE, **UNITS)


# --- In chunks ----------------------------------------------------------------------------------------------


def save(frame, path):
    """Write the frame in the format of the suffix."""
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


SUFFIXES = (".csv", ".csv.gz", ".txt", ".parquet", ".npy", ".h5")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_chunks_are_what_read_gives(tmp_path, suffix):
    """Of stretches that begin and end between samples and chunks, too; a bad value is found where it is."""
    path = save(FRAME, tmp_path / f"imu{suffix}")
    for stretch in ({}, {"start": 3.005, "stop": 17.3}, {"start": 29.5}, {"stop": 0.5}):
        for chunk in (1000, 3006, 10**6):
            chunks = same_in_chunks(path, chunk, **stretch)
            assert (chunks.n is None) == (bool(stretch) or suffix in (".csv", ".csv.gz", ".txt"))
    assert any("temperature" in note for note in chunks.notes)
    save(FRAME.assign(**{"accel_y [g]": FRAME["accel_y [g]"].where(FRAME.index != 2345)}), path)
    # A line of header comes first, and lines are counted from 1.
    place = "row 2345" if suffix in (".parquet", ".npy", ".h5") else "line 2347"
    for start in (None, 12.0):
        with pytest.raises(aj.RecordingError, match=f"accel_y.*{place}"):
            list(aj.read_chunks(path, chunk=1000, start=start))
    assert sum(map(len, aj.read_chunks(path, chunk=1000, stop=23.0))) == 2300


@pytest.mark.parametrize("kind", ["npy", "csv", "increments", "halves", "dates"])
def test_chunks_of_other_tables(tmp_path, kind):
    """Plain arrays without stamps, increments, stamps in two columns, dates."""
    k, axes = np.arange(ROWS), pd.DataFrame(NOISE, columns=list(SIX))
    path, options = tmp_path / "imu.parquet", dict(UNITS)
    if kind in ("npy", "csv"):
        path, options = path.with_suffix(f".{kind}"), {**UNITS, "rate": RATE}
        np.save(path, NOISE) if kind == "npy" else np.savetxt(path, NOISE, delimiter=",")
    elif kind == "increments":
        axes.columns = [f"dtheta_{a} [rad]" for a in "xyz"] + [f"dv_{a} [m/s]" for a in "xyz"]
        save(axes.assign(timestamp_ns=1_700_000_000_000_000_000 + 10_000_000 * k), path)
        options = {}
    elif kind == "halves":
        save(axes.assign(stamp_secs=1_700_000_000 + k // 100, stamp_nsecs=k % 100 * 10_000_000), path)
    else:
        save(axes.assign(time=pd.Timestamp("2024-03-01") + pd.to_timedelta(10 * k, "ms")), path)
    for stretch in ({}, {"start": 9.99, "stop": 20.02}):
        same_in_chunks(path, 1000, **options, **stretch)


@pytest.mark.parametrize("row", [20, 2000, 2345])
def test_gaps_in_a_chunk_and_between_two(tmp_path, row):
    """Both stretches that are offered can be read; one lost sample is a gap, too."""
    path, late = tmp_path / "imu.parquet", np.where(np.arange(ROWS) < row, 0.0, 0.5)
    save(FRAME.assign(**{"time [s]": TIMES + late}), path)
    stop, start = (row - 1) / RATE, row / RATE + 0.5
    with pytest.raises(aj.RecordingError, match=rf"0.51 s.*row {row} .*stop={stop:.3f}.*start={start:.3f}"):
        list(aj.read_chunks(path, chunk=1000))
    assert sum(map(len, aj.read_chunks(path, chunk=1000, stop=stop))) == row - 1
    assert sum(map(len, aj.read_chunks(path, chunk=1000, start=start))) == ROWS - row
    assert sum(map(len, aj.read_chunks(path, chunk=1000, time=False, rate=RATE))) == ROWS
    save(FRAME.drop(index=row), path)
    with pytest.raises(aj.RecordingError, match=rf"0.02 s \(2 intervals\).*row {row} "):
        list(aj.read_chunks(path, chunk=1000))


def test_stamps_that_go_wrong_in_a_later_chunk(tmp_path):
    """The rate is that of the first chunk, with which later stamps must agree within 1 %."""
    k, path = np.arange(ROWS), tmp_path / "imu.parquet"
    for times, word in (
        (np.where(k == 2000, 19.99, k / RATE), "repeats.*row 2000"),
        (np.where(k < 2000, k / RATE, 20.0 + (k - 2000) / 90.0), "rate 100 Hz"),
        (np.where(k == 2345, np.nan, k / RATE), "row 2345"),
    ):
        save(FRAME.assign(**{"time [s]": times}), path)
        with pytest.raises(aj.RecordingError, match=word):
            list(aj.read_chunks(path, chunk=1000))
    slower = k / RATE * (1.0 + 1e-7 * k)
    chunks = aj.read_chunks(save(FRAME.assign(**{"time [s]": slower}), path), chunk=1000)
    assert chunks.rate == pytest.approx(999 / slower[999], rel=1e-12)
    assert sum(map(len, chunks)) == ROWS


def test_dead_axes_in_chunks(tmp_path):
    """An axis may be constant for a chunk, or dead; if all are, that is an error."""
    path = tmp_path / "imu.parquet"
    for part in (np.arange(ROWS) < 1500, np.arange(ROWS) >= ROWS - 1500):
        same_in_chunks(save(FRAME.assign(**{HEADER[1]: FRAME[HEADER[1]].where(part, 0.25)}), path), 1000)
    chunks = aj.read_chunks(save(FRAME.assign(**{HEADER[1]: np.nan}), path), chunk=1000)
    assert np.isnan(np.concatenate([*chunks])[:, 1]).all()
    with pytest.raises(aj.RecordingError, match=r"gyro_x.*constant \(0.25 from row 0"):
        list(aj.read_chunks(save(FRAME.assign(**dict.fromkeys(HEADER, 0.25)), path), chunk=1000))


@pytest.mark.skipif(not DATA.is_dir(), reason="the real recordings are not here")
def test_real_recording():
    recording = aj.read(DATA / "adis16405_unit1.parquet", rate=100, **UNITS)
    assert (recording.names, recording.n) == (SIX, 1_000_000)
    # One count is 0.05 deg/s.
    counts = recording["gyro"].own_values / 0.05
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-6)
