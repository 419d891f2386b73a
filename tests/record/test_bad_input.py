"""Bad files: the message names the file, the column, the line and the remedy."""

import gzip

import numpy as np
import pandas as pd
import pytest
from scipy.io import savemat

from allanjax.base.errors import AllanjaxError, RecordingError, UnitError
from allanjax.record.io import read, read_chunks, write
from allanjax.record.recording import Recording

HEADER = ["gyro_x [deg/s]", "gyro_y [deg/s]", "gyro_z [deg/s]"]
SIX = ["gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z"]
UNITS = {"gyro_unit": "deg/s", "accel_unit": "g"}
N = 50


@pytest.fixture(scope="module")
def noise():
    return np.random.default_rng(2).normal(size=(N, 6))


def _lines(noise, header=HEADER):
    return [",".join(header), *(",".join(map(repr, row)) for row in noise[:, : len(header)].tolist())]


def _timed(noise, times, label="time [s]"):
    rows = np.column_stack([times, noise[: len(times), :3]]).tolist()
    return [",".join([label, *HEADER]), *(",".join(map(repr, row)) for row in rows)]


def _fails(path, *said, error=RecordingError, **options):
    with pytest.raises(AllanjaxError) as caught:
        read(path, **options)
    message = str(caught.value)
    assert isinstance(caught.value, error), message
    assert str(path) in message
    for text in said:
        assert text in message
    return message


@pytest.fixture
def text(tmp_path):
    def make(lines, name="imu.csv"):
        path = tmp_path / name
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return path

    return make


def _cell(lines, line, column, cell):
    """Replace a cell; `line` counts from 1."""
    fields = lines[line - 1].split(",")
    fields[column] = cell
    lines[line - 1] = ",".join(fields)


@pytest.mark.parametrize("cell", ["nan", "inf", "-inf", "", "abc", "1.2.3", "0x", "NA", '"1,5"'])
def test_bad_cells(text, noise, cell):
    lines = _lines(noise)
    _cell(lines, 23, 1, cell)
    _cell(lines, 35, 1, cell)
    # Comments and blank lines count as lines of the file.
    lines[5:5] = ["# a comment", ""]
    shown = cell.strip('"') or "empty"
    shown = "nan" if cell == "NA" else shown
    said = ("'gyro_y [deg/s]'", "2 values", "line 25:", shown, "start=", "--stop")
    _fails(text(["# from the lab", "", *lines]), *said[:2], "line 27:", *said[3:], rate=100)
    _fails(text(lines), *said, rate=100)
    # The stretch before the bad line is usable, and one after it is named by its own line.
    assert read(text(lines), rate=100, stop=0.21).n == 21
    _fails(text(lines), "1 value is", "line 37", rate=100, start=0.22, stop=0.4)


def test_bad_first_row(text, noise):
    lines = _lines(noise)
    lines[1] = "abc,def,ghi"
    _fails(text(lines), "'gyro_x [deg/s]'", "line 2: 'abc'", rate=100)


def test_empty_last_cell_of_the_first_row(text, noise):
    lines = _lines(noise)
    lines[1] = "0.1,0.2,"
    _fails(text(lines), "'gyro_z [deg/s]'", "line 2: nan, an empty cell", rate=100)


def test_bad_cell_without_header(text, noise):
    lines = _lines(noise)[1:]
    _cell(lines, 4, 2, "oops")
    _fails(text(lines), "'gyro_z'", "line 4: 'oops'", rate=100, gyro_unit="deg/s")


@pytest.mark.parametrize(
    ("row", "said"),
    [("0.1,0.2,0.3,0.4", "line 9 has 4 columns where 3"), ("0.1,0.2", "'gyro_z [deg/s]'")],
)
def test_ragged_rows(text, noise, row, said):
    lines = _lines(noise)
    lines[8] = row
    _fails(text(lines), said, "line 9", "repair", rate=100)


def test_header_of_another_length(text, noise):
    lines = _lines(noise)
    lines[0] = "gyro_x [deg/s],gyro_y [deg/s]"
    path = text(lines)
    _fails(path, "no sample rate", gyro_unit="deg/s")
    recording = read(path, rate=100, gyro_unit="deg/s")
    assert any("1 lines before the data skipped" in note for note in recording.notes)


@pytest.mark.parametrize("delimiter", [";", "\t", " "])
def test_decimal_commas(text, noise, delimiter):
    rows = [delimiter.join(repr(value).replace(".", ",") for value in row) for row in noise[:, :3].tolist()]
    recording = read(text([delimiter.join(SIX[:3]), *rows]), rate=100, gyro_unit="deg/s")
    np.testing.assert_allclose(recording.own_values, noise[:, :3], rtol=1e-12)
    assert "numbers with decimal commas" in recording.notes


def test_decimal_commas_beside_whole_numbers_and_what_excel_writes_first(text, noise):
    rows = [f"{10 * k};{x!r}".replace(".", ",") for k, x in enumerate(noise[:, 0].tolist())]
    recording = read(text(["sep=;", "time [ms];gyro_x [deg/s]", *rows]))
    assert recording.rate == pytest.approx(100.0)
    np.testing.assert_allclose(recording.own_values[:, 0], noise[:, 0], rtol=1e-12)


@pytest.mark.parametrize("end", ["1.0,2.0", "1.0,2.", "1"])
def test_a_file_that_ends_within_a_line(text, noise, end):
    lines = _lines(noise)
    whole = read(text(lines), rate=100)
    path = text(lines)
    path.write_text("\n".join([*lines, end]))
    recording = read(path, rate=100)
    assert np.array_equal(recording.values, whole.values)
    assert any(f"the file ends within a line, {end!r}: left out" in note for note in recording.notes)
    assert np.array_equal(np.concatenate([*read_chunks(path, rate=100, chunk=N)]), whole.values)
    # A line that is whole is read, and one that is short though it ended is an error.
    path.write_text("\n".join(lines))
    assert read(path, rate=100).n == whole.n
    path.write_text("\n".join([*lines, end, ""]))
    with pytest.raises(RecordingError, match=f"line {len(lines) + 1}"):
        read(path, rate=100)


def test_a_header_that_comes_again(text, noise):
    lines = _lines(noise)
    _fails(text([*lines[:9], lines[0], *lines[9:]]), "line 10", "the header once more", rate=100)


def test_stamps_that_are_all_the_same(text, noise):
    path = text(_timed(noise, np.zeros(N)))
    _fails(path, "is the same throughout", "no times were recorded", "--time none")
    assert read(path, time="none", rate=100).n == N


def test_a_workbook_is_refused_with_the_remedy(tmp_path):
    path = tmp_path / "imu.xlsx"
    path.write_bytes(b"PK\x03\x04" + bytes(100))
    _fails(path, "save a workbook as CSV")


def test_too_short(text, noise):
    _fails(text(_lines(noise[:15])), "too short: 15 samples", "16", "longer", rate=100)
    _fails(text(_lines(noise)), "too short: 10 samples", "--start", rate=100, start=0.1, stop=0.2)
    _fails(text(_timed(noise, np.arange(N) / 100)), "too short: 10 samples", start=0.4)


def test_constant_column(text, noise):
    path = text(_lines(noise * [0, 0, 0, 1, 1, 1]))
    _fails(path, "'gyro_x [deg/s]'", "constant", "line 2", "columns=", rate=100)


def test_no_rate(text, noise):
    _fails(text(_lines(noise)), "no sample rate", "rate=", "--rate", "time")


@pytest.mark.parametrize("rate", [0, -100, float("nan"), float("inf")])
def test_bad_rate(text, noise, rate):
    _fails(text(_lines(noise)), "positive", "rate=", rate=rate)


def test_no_unit(text, noise):
    path = text(_lines(noise, SIX))
    said = "'accel_x'", "no unit", "accel_unit=", "--accel-unit", "accel_x [m/s^2]"
    _fails(path, *said, error=UnitError, rate=100, gyro_unit="deg/s")
    _fails(path, "'gyro_x'", "--gyro-unit", "gyro_x [deg/s]", error=UnitError, rate=100, accel_unit="g")


def test_unknown_and_conflicting_units(text, noise):
    path = text(_lines(noise, ["gyro_x [furlong]"]))
    _fails(path, "'gyro_x [furlong]'", "unknown unit 'furlong'", "deg/h", error=UnitError, rate=100)
    path = text(_lines(noise, ["gyro_x [m/s^2]"]))
    _fails(path, "for a gyro", "accelerometer", error=UnitError, rate=100)
    path = text(_lines(noise))
    said = "deg/s by its header", "gyro_unit= (--gyro-unit) says rad/s", "leave out"
    _fails(path, *said, error=UnitError, rate=100, gyro_unit="rad/s")
    assert read(path, rate=100, gyro_unit="°/s").n == N
    path = text(_lines(noise, ["delta_angle_x [deg/s]"]))
    _fails(path, "increments", "deg/s", error=UnitError, rate=100)


def test_missing_axis_of_a_triad(text, noise):
    path = text(_lines(noise, ["gyro_x [deg/s]", "gyro_z [deg/s]"]))
    _fails(path, "gyro_x and gyro_z but no gyro_y", "columns=", "--columns", rate=100)
    assert read(path, rate=100, columns="gyro_x,gyro_z").names == ("gyro_x", "gyro_z")


def test_no_axis_and_repeated_axes(text, noise):
    _fails(
        text(_lines(noise, ["p", "q", "r"])),
        "no gyro or accelerometer column among p, q, r",
        "--columns",
        rate=100,
    )
    _fails(text(_lines(noise, ["gx", "gx", "gz"])), "'gx'", "more than once", "columns=", rate=100)
    _fails(
        text(_lines(noise, ["gx", "gyro_x"])),
        "'gx' and 'gyro_x' are both gyro_x",
        "columns=",
        rate=100,
        **UNITS,
    )


@pytest.mark.parametrize(
    ("count", "units"), [(2, UNITS), (3, UNITS), (3, {}), (6, {"gyro_unit": "deg/s"}), (4, UNITS)]
)
def test_columns_without_names_that_can_not_be_told(text, noise, count, units):
    path = text(_lines(noise, SIX[:count])[1:])
    _fails(path, f"{count} columns without names", "columns=", "--columns", rate=100, **units)


@pytest.mark.parametrize(
    ("columns", "said"),
    [
        (
            "gyro_x,gyro_q",
            "columns= (--columns) asks for gyro_q, and the file has gyro_x [deg/s], gyro_y",
        ),
        ("gyro_x,gyro_x,-", "gyro_x more than once"),
        ("-,-,mag", "no gyro or accelerometer column among mag"),
    ],
)
def test_bad_columns(text, noise, columns, said):
    _fails(text(_lines(noise)), said, rate=100, columns=columns)


def test_gap(text, noise):
    times = 50.0 + np.arange(N) / 100
    times[10:] += 0.35
    times[35:] += 0.05
    path = text(_timed(noise, times))
    message = _fails(
        path,
        "'time [s]'",
        "gap of 0.36 s (36 intervals)",
        "line 12",
        "first of 2 gaps",
        "start=0.450",
        "stop=0.690",
    )
    assert "time='none'" in message
    assert read(path, start=0.450, stop=0.690).n == 24
    assert read(path, time="none", rate=100).n == N
    _fails(path, "gap of 0.36 s", rate=100)


def test_one_lost_sample_is_a_gap(text, noise):
    """It makes an interval twice as long; a late stamp that makes one 1.4 times as long does not."""
    times = np.arange(N) / 100
    lost = text(_timed(np.delete(noise, 20, axis=0), np.delete(times, 20)))
    _fails(lost, "gap of 0.02 s (2 intervals)", "line 22", "the only gap")
    late = text(_timed(noise, times + np.where(np.arange(N) < 20, 0.0, 0.004)))
    assert read(late).n == N


def test_late_stamps_are_no_gaps(text, noise):
    """The stamps after them are where those before let expect; where they are not, there is a gap."""
    times = np.arange(N) / 100
    late = np.isin(np.arange(N), [10, 45]) * 0.006
    assert read(text(_timed(noise, times + late))).n == N
    times[32:] += 0.01
    _fails(text(_timed(noise, times + late)), "gap of 0.02 s (2 intervals)", "line 34", "the only gap")


@pytest.mark.parametrize(("time", "said"), [(0.09, "repeats"), (0.02, "is earlier than")])
def test_stamps_that_do_not_increase(text, noise, time, said):
    times = np.arange(N) / 100
    times[10] = time
    _fails(text(_timed(noise, times)), "'time [s]'", said, "line 12", "1 such", "time='none'", "--rate")


def test_jitter(text, noise):
    times = np.arange(N) / 100 + np.where(np.arange(N) % 2, 0.0012, -0.0012)
    _fails(text(_timed(noise, times)), "'time [s]'", "irregular", "jitter 0.0024", "time='none'", "--rate")


def test_bursts_are_irregular_not_gaps(text, noise):
    times = (np.arange(N) // 5) * 0.05 + (np.arange(N) % 5) * 0.001
    _fails(text(_timed(noise, times)), "'time [s]'", "irregular")


def test_conflicting_rate(text, noise):
    path = text(_timed(noise, np.arange(N) / 100))
    _fails(path, "rate 200 Hz contradicts", "'time [s]'", "give 100 Hz", "--time none", rate=200)
    assert read(path, rate=100.5).rate == 100.5
    path = path.with_suffix(".npz")
    np.savez(path, gyro=noise[:, :3], fs=100.0)
    _fails(path, "rate 200 Hz contradicts", "states 100 Hz", "--rate", rate=200, **UNITS)
    assert read(path, rate=100.5, **UNITS).rate == 100.5


@pytest.mark.parametrize(
    "times", [np.arange(N), np.arange(N) * 10, np.arange(N) * 0.1, 1e6 + np.arange(N) * 10_000]
)
def test_time_unit_that_can_not_be_told(text, noise, times):
    _fails(text(_timed(noise, times, "time")), "'time'", "no unit", "time_unit=", "--time-unit", "time [s]")


def test_bad_time_units(text, noise):
    times = np.arange(N) / 100
    _fails(text(_timed(noise, times, "time [m]")), "'m' is not a unit of time", "us", error=UnitError)
    _fails(
        text(_timed(noise, times)), "in s by its header", "ms", "leave out", error=UnitError, time_unit="ms"
    )
    _fails(text(_timed(noise, times)), "no time column 'clock' among time [s]", "--time", time="clock")


@pytest.mark.parametrize("cell", ["", "soon", "nan"])
def test_bad_time_cell(text, noise, cell):
    lines = _timed(noise, np.arange(N) / 100)
    _cell(lines, 7, 0, cell)
    _fails(text(lines), "'time [s]'", "line 7", "repair")


def test_files_that_are_none(tmp_path, noise):
    _fails(tmp_path / "absent.csv", "no such file")
    _fails(tmp_path, "folder")
    path = tmp_path / "imu.csv"
    path.write_bytes(b"")
    _fails(path, "empty")
    path.write_text("\n\n")
    _fails(path, "empty")
    path.write_text("gyro_x [deg/s]\n# nothing\n")
    _fails(path, "no row of numbers")
    path.write_bytes(b"\x00\x01\x02" * 100)
    _fails(path, "neither text nor", "CSV")


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"PAR1 damaged", "Parquet"),
        (b"\x93NUMPY damaged", ".npy"),
        (b"PK\x03\x04 damaged", "damaged"),
        (b"MATLAB 5.0 damaged", "-v7"),
        (b"\x89HDF\r\n\x1a\n" + bytes(100), "save("),
        (b"MATLAB 7.3 MAT-file".ljust(512) + b"\x89HDF\r\n\x1a\n", "'-v7'"),
        (b"\x1f\x8b damaged", "can not be read"),
    ],
)
def test_damaged_and_unsupported_files(tmp_path, content, said):
    path = tmp_path / "imu.bin"
    path.write_bytes(content)
    _fails(path, said, rate=100)


def test_truncated_gzip(tmp_path, noise):
    path = tmp_path / "imu.csv.gz"
    content = gzip.compress("\n".join(_lines(np.tile(noise, (4000, 1)))).encode())
    path.write_bytes(content[:-1000])
    _fails(path, "can not be read", rate=100)


def test_spreadsheet(tmp_path):
    import zipfile

    path = tmp_path / "imu.xlsx"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("xl/workbook.xml", "<workbook/>")
    _fails(path, "spreadsheet", "CSV", rate=100)


def test_bad_values_in_binary_files_name_the_row(tmp_path, noise):
    bad = noise.copy()
    bad[7, 4] = np.nan
    said = "'accel_y'", "row 7 (counting from 0)", "nan", "start="
    frame = pd.DataFrame(bad, columns=SIX)
    frame.to_parquet(tmp_path / "imu.parquet")
    _fails(tmp_path / "imu.parquet", *said, rate=100, **UNITS)
    np.save(tmp_path / "imu.npy", bad)
    _fails(tmp_path / "imu.npy", *said, rate=100, **UNITS)
    np.savez(tmp_path / "imu.npz", gyro=bad[:, :3], accel=bad[:, 3:], rate=100)
    _fails(tmp_path / "imu.npz", *said, **UNITS)
    savemat(tmp_path / "imu.mat", {"gyro": bad[:, :3], "accel": bad[:, 3:], "fs": 100.0})
    _fails(tmp_path / "imu.mat", *said, **UNITS)


@pytest.mark.parametrize(
    ("array", "said"),
    [
        (lambda x: x.T, "seemingly transposed"),
        (lambda x: x[None], "shape (1, 50, 6)"),
        (lambda x: x.astype(str), "dtype"),
        (lambda x: x.astype(complex), "real numbers"),
        (lambda x: x[0, 0], "()"),
        (lambda x: x.astype(object), "can not be read"),
    ],
)
def test_bad_arrays_in_npy(tmp_path, noise, array, said):
    path = tmp_path / "imu.npy"
    np.save(path, array(noise), allow_pickle=True)
    _fails(path, said, "save", rate=100, **UNITS)


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        (lambda x: {"gyro": x[:, :3], "accel": x[:30, 3:]}, "differ in length (gyro_x 50"),
        (lambda x: {"gyro": x[:, :3].T}, "'gyro' has the shape (3, 50), seemingly transposed"),
        (lambda x: {"rate": 100.0}, "no array of samples"),
        (lambda x: {"rate": -5.0, "gyro": x[:, :3]}, "positive"),
    ],
)
@pytest.mark.parametrize("suffix", [".npz", ".mat"])
def test_arrays_that_do_not_fit(tmp_path, noise, arrays, said, suffix):
    path = tmp_path / f"imu{suffix}"
    (np.savez if suffix == ".npz" else lambda path, **contents: savemat(path, contents))(
        path, **arrays(noise)
    )
    _fails(path, said, **UNITS)


def test_text_in_parquet_axis(tmp_path, noise):
    frame = pd.DataFrame(noise, columns=SIX).astype({"gyro_y": object})
    frame["gyro_y"] = frame["gyro_y"].astype(str)
    frame.loc[3, "gyro_y"] = "bad"
    frame.to_parquet(tmp_path / "imu.parquet")
    _fails(tmp_path / "imu.parquet", "'gyro_y'", "row 3", "'bad'", rate=100, **UNITS)


def test_write_refuses_other_suffixes(tmp_path, noise):
    recording = Recording.from_array(noise[:, 0], 100.0, gyro_unit="deg/s")
    with pytest.raises(RecordingError, match=r"imu\.mat.*\.parquet"):
        write(recording, tmp_path / "imu.mat")
