"""What cannot be read or made: the class of the error, and the file, column, line or option that it names."""

import gzip
import io
import zipfile

import numpy as np
import pandas as pd
import pytest
from imu_columns import HEADER, SIX, UNITS, refused, rows

import allanjax as aj

N = 50
NOISE = np.random.default_rng(2).normal(size=(N, 6)) + 0.3
BAD = np.where((np.arange(N)[:, None] == 7) & (np.arange(6) == 4), np.nan, NOISE)
STEPS = np.arange(N)
TIMES, TURNS = STEPS / 100.0, (-1) ** STEPS
RATE = {"rate": 100}
DEG_S = {**RATE, "gyro_unit": "deg/s"}


def text(header=HEADER[:3], cells=(), lines=N, times=None, label="time [s]", edit=lambda lines: lines):
    """What writes a file of text: cells are replaced by (line, column), lines count from 1."""

    def write(path):
        names, columns = ([label, *header], [times]) if times is not None else (header, [])
        made = [",".join(names), *rows(*columns, NOISE[:lines, : len(header)])]
        for (number, column), cell in dict(cells).items():
            fields = made[number - 1].split(",")
            made[number - 1] = ",".join([*fields[:column], cell, *fields[column + 1 :]])
        path.write_text("\n".join([*edit(made), ""]), encoding="utf-8")

    return write


def line(number, content):
    return text(edit=lambda lines: [*lines[: number - 1], content, *lines[number:]])


def cell(content, **more):
    return text(cells={(23, 1): content}, **more)


def headless(lines):
    return lines[1:]


def moved(**changes):
    """Times at which samples from a row on are later."""
    return TIMES + sum(by * (int(row[1:]) <= STEPS) for row, by in changes.items())


# What writes the file, options of reading, what the error names, and its class unless it is RecordingError.
OF_TEXT = {
    # Cells, whose lines are those of the file.
    "text": (text(cells={(23, 1): "abc", (35, 1): "x"}), RATE, "gyro_y|line 23:|abc|--stop"),
    "nan": (cell("nan"), RATE, "gyro_y|line 23:|gaps"),
    "empty": (cell(""), RATE, "gyro_y|line 23:|gaps"),
    "too large": (cell("1.01e100"), RATE, "gyro_y|line 23:|1.01e+100"),
    "cell cut off": (line(2, "0.1,0.2,"), RATE, "gyro_z|line 2:"),
    "no header": (text(cells={(4, 2): "x"}, edit=headless), DEG_S, "gyro_z|line 3: 'x'"),
    "after a stretch": (text(cells={(35, 1): "x"}), {**RATE, "start": 0.22, "stop": 0.4}, "gyro_y|line 35:"),
    "comments count": (cell("x", edit=lambda x: ["# lab", "", *x[:9], "# stop", *x[9:]]), RATE, "line 26:"),
    "row too long": (line(9, "1,2,3,4"), RATE, "line 9 has 4 columns where 3"),
    "header again": (text(edit=lambda x: [*x[:9], x[0], *x[9:]]), RATE, "line 10|header"),
    # Lengths, rates, stretches.
    "15 samples": (text(lines=15), RATE, "15 samples|16"),
    "15 of a stretch": (text(), {**RATE, "start": 0.1, "stop": 0.25}, "15 samples|--start"),
    "constant": (text(edit=lambda x: [x[0], *len(x[1:]) * ["1,2,3"]]), RATE, "gyro_x|constant (1 |line 2"),
    "no rate": (text(), {}, "rate=|--rate"),
    **{f"rate {r}": (text(), {"rate": r}, "rate=|positive") for r in (0, np.nan, np.inf)},
    "rate above stamps": (text(times=TIMES), {"rate": 101.1}, "rate 101.1 Hz|'time [s]'|100 Hz"),
    "rate below stamps": (text(times=TIMES), {"rate": 98.9}, "rate 98.9 Hz|'time [s]'|100 Hz"),
    "start after stop": (text(), {**RATE, "start": 0.3, "stop": 0.3}, "start=|stop="),
    "start nan": (text(), {**RATE, "start": np.nan}, "start="),
    # Units.
    "no accel unit": (text(SIX), DEG_S, "accel_x|accel_unit=|--accel-unit", aj.UnitError),
    "unknown unit": (text(["gyro_x [furlong]"]), RATE, "gyro_x|furlong|deg/h", aj.UnitError),
    "other sensor": (text(["gyro_x [m/s^2]"]), RATE, "gyro_x|accelerometer", aj.UnitError),
    "unit twice": (text(), {**RATE, "gyro_unit": "rad/s"}, "deg/s|gyro_unit=|rad/s", aj.UnitError),
    "rate or increment": (text(), {**RATE, "gyro_unit": "deg"}, "deg/s|gyro_unit=", aj.UnitError),
    "increments": (text(["delta_angle_x [deg/s]"]), RATE, "delta_angle_x|deg/s", aj.UnitError),
    # Columns.
    "missing axis": (text(["gyro_x [deg/s]", "gyro_z [deg/s]"]), RATE, "no gyro_y|columns="),
    "no axis": (text(["p", "q", "r"]), RATE, "p, q, r|--columns"),
    "same name": (text(["gx", "gx", "gz"]), RATE, "'gx'|columns="),
    "same axis": (text(["gx", "gyro_x"]), RATE, "'gx' and 'gyro_x'|gyro_x|columns="),
    "unknown column": (text(), {**RATE, "columns": "gyro_x,gyro_q"}, "--columns|gyro_q|gyro_z [deg/s]"),
    "column twice": (text(), {**RATE, "columns": "gyro_x,gyro_x,-"}, "columns=|gyro_x"),
    "too few entries": (text(SIX), {**RATE, "columns": "a,-"}, "columns|a"),
    "ambiguous": (text(["gx [deg/s]", "gx [rad/s]"]), {"columns": "gx"}, "columns=|gx [rad/s]"),
    "3 unnamed": (text(SIX[:3], edit=headless), {**RATE, **UNITS}, "3 columns|--columns"),
    "6 of one unit": (text(SIX, edit=headless), DEG_S, "6 columns|--columns"),
    # Times.
    "same throughout": (text(times=0 * TIMES), {}, "time [s]|--time none"),
    "a gap": (text(times=moved(r10=0.35, r35=0.05)), {}, "time [s]|0.36 s (36 intervals)|line 12|start="),
    "a gap, rate given": (text(times=moved(r10=0.35)), RATE, "0.36 s (36 intervals)"),
    "one lost sample": (text(times=moved(r20=0.01)), {}, "0.02 s (2 intervals)|line 22"),
    "an interval of 1.56": (text(times=moved(r20=0.0056)), {}, "0.0156 s|line 22"),
    "repeats": (text(times=np.where(STEPS == 10, 0.09, TIMES)), {}, "time [s]|repeats|line 12|--rate"),
    "earlier": (text(times=np.where(STEPS == 10, 0.02, TIMES)), {}, "time [s]|by 0.07 s|line 12"),
    "jitter of 21 %": (text(times=TIMES + 0.00105 * TURNS), {}, "irregular|jitter 0.0021|--rate"),
    "unit of steps": (text(times=STEPS, label="time"), {}, "'time'|time_unit=|--time-unit"),
    "no unit of time": (text(times=TIMES, label="time [m]"), {}, "'m'|us", aj.UnitError),
    "time unit twice": (text(times=TIMES), {"time_unit": "ms"}, "in s|time_unit=|ms", aj.UnitError),
    "no such time": (text(times=TIMES), {"time": "clock"}, "clock|time [s]|time="),
    "time in words": (text(times=TIMES, cells={(7, 0): "soon"}), {}, "time [s]|line 7"),
    "gaps": (text(), {**RATE, "gaps": "interpolate"}, "gaps=|--gaps|interpolate"),
    "topic": (text(), {**RATE, "topic": "/imu"}, "topic=|--topic"),
    "instance": (text(), {**RATE, "instance": 1}, "instance=|--instance"),
}


@pytest.mark.parametrize("name", OF_TEXT)
def test_text(tmp_path, name):
    """As a whole, and in chunks of 30 samples."""
    write, options, words, *kind = OF_TEXT[name]
    write(path := tmp_path / "imu.csv")
    # Errors of options alone do not name the file.
    words += "" if name in ("start after stop", "start nan", "gaps") else f"|{path}"
    refused(lambda: aj.read(path, **options), words, *kind)
    refused(lambda: list(aj.read_chunks(path, chunk=30, **options)), words, *kind)


# The other side of each limit, and the remedies that messages name: what is read, and its length.
RIGHT = [
    (text(lines=16), RATE, 16),
    (text(), {**RATE, "start": 0.1, "stop": 0.26}, 16),
    (cell("0.99e100"), RATE, N),
    (cell("x"), {**RATE, "stop": 0.21}, 21),
    (text(times=TIMES), {"rate": 100.9}, N),
    (text(times=TIMES), {"rate": 99.1}, N),
    (text(times=TIMES + 0.00095 * TURNS), {}, N),
    # An interval of 1.44, and late stamps after which all is as before.
    (text(times=moved(r20=0.0044)), {}, N),
    (text(times=TIMES + np.isin(STEPS, [10, 45]) * 0.006), {}, N),
    (text(times=moved(r10=0.35, r35=0.05)), {"start": 0.450, "stop": 0.690}, 24),
    (text(times=moved(r10=0.35)), {**RATE, "time": "none"}, N),
    (text(times=0 * TIMES), {**RATE, "time": False}, N),
    (text(["gyro_x [deg/s]", "gyro_z [deg/s]"]), {**RATE, "columns": "gyro_x,gyro_z"}, N),
]


def test_what_is_just_right_is_read(tmp_path):
    path = tmp_path / "imu.csv"
    for write, options, n in RIGHT:
        write(path)
        assert aj.read(path, **options).n == n, options
    text(times=TIMES)(path)
    assert aj.read(path, rate=100.5).rate == 100.5
    # Of gaps the longest stretch is named, and what each choice makes of them.
    text(times=moved(r10=0.35, r35=0.05))(path)
    told = f"first of 2 gaps|start=0.450|stop=0.690|40 missing|{N} others|--gaps fill"
    assert refused(path, told).about == "gaps"


def write(path, content):
    """Write what suffix and content say; a folder, if it is empty."""
    if isinstance(content, dict):
        np.savez(path, **content) if content else path.mkdir()
    elif isinstance(content, bytes):
        path.write_bytes(content)
    elif isinstance(content, pd.DataFrame):
        content.to_parquet(path)
    else:
        np.save(path, content, allow_pickle=True)


with zipfile.ZipFile(workbook := io.BytesIO(), "w") as archive:
    archive.writestr("xl/workbook.xml", "<workbook/>")
FRAME = pd.DataFrame(NOISE, columns=list(SIX))
WORDS = FRAME.assign(gyro_y=["bad" if k == 3 else str(x) for k, x in enumerate(NOISE[:, 1])])
ZIPPED = gzip.compress("\n".join([",".join(HEADER), *rows(np.tile(NOISE, (200, 1)))]).encode())
HALVES = {"gyro": NOISE[:, :3], "accel": NOISE[:, 3:]}
SHORT = {"gyro": NOISE[:, :3], "accel": NOISE[:30, 3:]}
HDF5 = b"\x89HDF\r\n\x1a\n"
# A file, its content, options beside units, and what the RecordingError names.
BINARY = {
    "nan in npy": ("imu.npy", BAD, RATE, "accel_y|row 7"),
    "nan in parquet": ("imu.parquet", FRAME.where(~np.isnan(BAD)), RATE, "accel_y|row 7"),
    "text in parquet": ("imu.parquet", WORDS, RATE, "gyro_y|row 3|'bad'"),
    "no rows": ("imu.parquet", FRAME[:0], RATE, "no rows"),
    "transposed": ("imu.npy", NOISE.T, RATE, "(6, 50)|array.T"),
    "complex": ("imu.npy", NOISE.astype(complex), RATE, "complex128"),
    "objects": ("imu.npy", NOISE.astype(object), RATE, "can not be read"),
    "lengths in npz": ("imu.npz", SHORT, RATE, "gyro_x 50|accel_x 30"),
    "transposed in npz": ("imu.npz", {"gyro": NOISE[:, :3].T}, RATE, "'gyro'|(3, 50)"),
    "no samples in npz": ("imu.npz", {"rate": 100.0}, {}, "no array"),
    "rate of npz": ("imu.npz", {**HALVES, "rate": -5.0}, {}, "positive"),
    "rate against npz": ("imu.npz", {**HALVES, "fs": 100.0}, {"rate": 101.1}, "rate 101.1 Hz|100 Hz|--rate"),
    "spreadsheet": ("imu.xlsx", workbook.getvalue(), RATE, "CSV"),
    "magic of Parquet": ("imu.bin", b"PAR1 damaged", RATE, "Parquet"),
    "magic of npy": ("imu.bin", b"\x93NUMPY damaged", RATE, ".npy"),
    "magic of MATLAB": ("imu.bin", b"MATLAB 5.0 damaged", RATE, "-v7"),
    "magic of -v7.3": ("imu.bin", b"MATLAB 7.3 MAT-file".ljust(512) + HDF5, RATE, "-v7"),
    "magic of nothing": ("imu.bin", b"\x00\x01\x02" * 100, RATE, "CSV"),
    "cut gzip": ("imu.csv.gz", ZIPPED[:-500], RATE, "can not be read"),
    "empty": ("imu.csv", b"", {}, "empty"),
    "a header alone": ("imu.csv", b"gyro_x [deg/s]\n# nothing\n", {}, "row of numbers"),
    "a folder": ("imu.csv", {}, {}, "folder"),
}


@pytest.mark.parametrize("name", BINARY)
def test_binary(tmp_path, name):
    file, content, options, words = BINARY[name]
    write(tmp_path / file, content)
    refused(tmp_path / file, words, **UNITS, **options)


# Changes to the arguments of `from_array`, and what its RecordingError names.
ARRAYS = [
    ({"values": BAD}, "'accel_y'|1 value|row 7"),
    ({"values": np.where(np.isnan(BAD), np.inf, NOISE)}, "'accel_y'|row 7|inf"),
    ({"values": 0.0 * NOISE}, "'gyro_x'|constant"),
    ({"values": NOISE[:15]}, "15 samples|16"),
    ({"values": NOISE.T}, "(6, 50)|values.T"),
    ({"values": NOISE[None]}, "(1, 50, 6)"),
    ({"values": NOISE[:, :4]}, "4 columns|names="),
    ({"values": NOISE[:, :3]}, "3 columns|gyro_unit= and accel_unit=|names="),
    ({"names": ["gyro_x"]}, "1 names for 6|names="),
    ({"names": ["gx", "gy", "gz", "ax", "ay", "mag"]}, "'mag'|auxiliary="),
    ({"names": ["gx", "gyro_x", "gz", "ax", "ay", "az"]}, "'gx' and 'gyro_x'"),
    ({"auxiliary": {"temperature": np.ones(3)}}, "'temperature'|(3,)|(50,)"),
    ({"gaps": "drop"}, "gaps=|drop"),
    *(({"rate": x}, "rate=") for x in (0, np.nan, np.inf, None, "100", 1j, np.ones(1))),
]


@pytest.mark.usefixtures("unchecked_shapes")
def test_arrays():
    for change, words in ARRAYS:
        arguments = {"values": NOISE, "rate": 50.0, "name": "unit 7", **UNITS, **change}
        refused(made, f"unit 7: |{words}", **arguments)


made = aj.Recording.from_array
RECORDING = made(NOISE, 50.0, **UNITS, name="unit 7")
# Other calls in a folder, what the error names, and its class unless it is RecordingError.
CALLS = [
    (lambda f: RECORDING["mag"], "mag|gyro_x"),
    (lambda f: RECORDING.select(), "gyro_x"),
    (lambda f: RECORDING.between(0.7), "unit 7|15 samples|start="),
    (lambda f: aj.write(RECORDING, f / "imu.mat"), "imu.mat|.parquet"),
    (lambda f: aj.write(RECORDING, f / "a" / "imu.csv"), "imu.csv|folder"),
    (lambda f: aj.write(RECORDING, f), "folder"),
    (lambda f: aj.read(f / "imu.csv"), "imu.csv|no such file"),
    (lambda f: made(NOISE, 1.0, names=SIX, gyro_unit="deg/s"), "accel_x|accel_unit=", aj.UnitError),
    (lambda f: made(NOISE[:, 0], 1.0, names=["dv_x"], accel_unit="g"), "dv_x|g", aj.UnitError),
    (lambda f: aj.Recording.from_dataframe(FRAME, 50.0), "gyro_x|gyro_unit=", aj.UnitError),
    (lambda f: aj.fit(RECORDING, gaps="fill"), "gaps", aj.AllanjaxError),
    (lambda f: aj.fit(7.0, rate=1.0), "allanjax.read", aj.AllanjaxError),
    (lambda f: aj.read_chunks(f / "imu.npy", chunk=0), "chunk|1 row"),
    (lambda f: aj.read_chunks(f / "imu.npy", gaps="fill"), "gaps="),
    (lambda f: [write(f / "imu.npz", HALVES), aj.read_chunks(f / "imu.npz")], "npz|read()"),
]


def test_calls(tmp_path):
    for call, *told in CALLS:
        refused(lambda call=call: call(tmp_path), *told)
