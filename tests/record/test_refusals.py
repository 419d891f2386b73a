"""What cannot be read or made: the class of the error, and the file, column, line or option that it names."""

import functools
import gzip
import zipfile

import numpy as np
import pandas as pd
import pytest
from imu_columns import HEADER, SIX, UNITS, rows
from scipy.io import savemat

import allanjax as aj

N = 50
NOISE = np.random.default_rng(2).normal(size=(N, 6)) + 0.3
TIMES, TURNS = np.arange(N) / 100.0, (-1) ** np.arange(N)
RATE = {"rate": 100}
DEG_S = {**RATE, "gyro_unit": "deg/s"}
GYROS = HEADER[:3]


def text(header=GYROS, cells=(), lines=None, times=None, label="time [s]", edit=lambda lines: lines):
    """What writes a file of text: cells are replaced by (line, column), lines count from 1."""

    def write(path):
        columns = NOISE[:, : len(header)] if lines is None else NOISE[:lines, : len(header)]
        head, body = [",".join(header)], rows(columns)
        if times is not None:
            head, body = [f"{label},{head[0]}"], rows(np.asarray(times), columns[: len(times)])
        made = head + body
        for (line, column), cell in dict(cells).items():
            fields = made[line - 1].split(",")
            fields[column] = cell
            made[line - 1] = ",".join(fields)
        path.write_text("\n".join([*edit(made), ""]), encoding="utf-8")

    return write


def line(number, content):
    """What replaces a line."""
    return lambda lines: [*lines[: number - 1], content, *lines[number:]]


def commented(lines):
    """Lines with comments and a blank one among them."""
    return ["# lab", "", *lines[:9], "# stop", *lines[9:]]


def moved(**changes):
    """Times at which samples from a row on are later."""
    times = TIMES.copy()
    for row, by in changes.items():
        times[int(row[1:]) :] += by
    return times


def bare(count):
    """What writes columns without names."""
    return text(SIX[:count], edit=lambda lines: lines[1:])


def at(row, time):
    """Times of which one is another."""
    return np.where(np.arange(N) == row, time, TIMES)


def refused(call, words, kind=aj.RecordingError):
    """An error of this class that names these words."""
    with pytest.raises(aj.AllanjaxError) as caught:
        call()
    assert type(caught.value) is kind, caught.value
    for word in words.split("|"):
        assert word in str(caught.value)


# What writes the file, options of reading, what the error names, and its class unless it is RecordingError.
OF_TEXT = {
    # Cells, whose lines are those of the file.
    "text": (text(cells={(23, 1): "abc", (35, 1): "x"}), RATE, "gyro_y|line 23:|abc|--stop"),
    "nan": (text(cells={(23, 1): "nan"}), RATE, "gyro_y|line 23:|gaps"),
    "empty": (text(cells={(23, 1): ""}), RATE, "gyro_y|line 23:|gaps"),
    "infinite": (text(cells={(23, 1): "-inf"}), RATE, "gyro_y|line 23:|-inf"),
    "comma": (text(cells={(23, 1): '"1,5"'}), RATE, "gyro_y|line 23:|1,5"),
    "too large": (text(cells={(23, 1): "1.01e100"}), RATE, "gyro_y|line 23:|1.01e+100"),
    "first row": (text(edit=line(2, "abc,def,ghi")), RATE, "gyro_x|line 2: 'abc'"),
    "cell cut off": (text(edit=line(2, "0.1,0.2,")), RATE, "gyro_z|line 2:"),
    "no header": (text(cells={(4, 2): "x"}, edit=lambda x: x[1:]), DEG_S, "gyro_z|line 3: 'x'"),
    "after a stretch": (text(cells={(35, 1): "x"}), {**RATE, "start": 0.22, "stop": 0.4}, "gyro_y|line 35:"),
    "comments count": (text(cells={(23, 1): "x"}, edit=commented), RATE, "line 26:"),
    "row too long": (text(edit=line(9, "1,2,3,4")), RATE, "line 9 has 4 columns where 3"),
    "row too short": (text(edit=line(9, "1,2")), RATE, "gyro_z|line 9"),
    "header again": (text(edit=lambda x: [*x[:9], x[0], *x[9:]]), RATE, "line 10|header"),
    # Lengths, rates, stretches.
    "15 samples": (text(lines=15), RATE, "15 samples|16"),
    "15 of a stretch": (text(), {**RATE, "start": 0.1, "stop": 0.25}, "15 samples|--start"),
    "15 by stamps": (text(times=TIMES), {"start": 0.35}, "15 samples"),
    "nothing left": (text(), {**RATE, "start": 0.5}, "start="),
    "constant": (text(edit=lambda x: [x[0], *len(x[1:]) * ["1,2,3"]]), RATE, "gyro_x|constant (1 |line 2"),
    "no rate": (text(), {}, "rate=|--rate"),
    **{f"rate {r}": (text(), {"rate": r}, "rate=|positive") for r in (0, -100, np.nan, np.inf)},
    "rate above stamps": (text(times=TIMES), {"rate": 101.1}, "rate 101.1 Hz|'time [s]'|100 Hz"),
    "rate below stamps": (text(times=TIMES), {"rate": 98.9}, "rate 98.9 Hz|'time [s]'|100 Hz"),
    "start after stop": (text(), {**RATE, "start": 0.3, "stop": 0.3}, "start=|stop="),
    "start nan": (text(), {**RATE, "start": np.nan}, "start="),
    # Units.
    "no accel unit": (text(SIX), DEG_S, "accel_x|accel_unit=|--accel-unit", aj.UnitError),
    "no gyro unit": (text(SIX), {**RATE, "accel_unit": "g"}, "gyro_x|gyro_unit=|--gyro-unit", aj.UnitError),
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
    "columns without axis": (text(), {**RATE, "columns": "-,-,mag"}, "mag"),
    "too few entries": (text(SIX), {**RATE, "columns": "a,-"}, "columns|a"),
    "ambiguous": (
        text(["gyro_x [deg/s]", "gyro_x [rad/s]"]),
        {"columns": "gyro_x"},
        "columns=|gyro_x [rad/s]",
    ),
    **{
        f"{count} unnamed of {len(units)}": (bare(count), {**RATE, **units}, f"{count} columns|--columns")
        for count, units in ((2, UNITS), (3, UNITS), (3, {}), (6, {"gyro_unit": "deg/s"}))
    },
    # Times.
    "same throughout": (text(times=0 * TIMES), {}, "time [s]|--time none"),
    "a gap": (text(times=moved(r10=0.35, r35=0.05)), {}, "time [s]|0.36 s (36 intervals)|line 12|start="),
    "a gap, rate given": (text(times=moved(r10=0.35)), RATE, "0.36 s (36 intervals)"),
    "one lost sample": (text(times=moved(r20=0.01)), {}, "0.02 s (2 intervals)|line 22"),
    "an interval of 1.56": (text(times=moved(r20=0.0056)), {}, "0.0156 s|line 22"),
    "repeats": (text(times=at(10, 0.09)), {}, "time [s]|repeats|line 12|--rate"),
    "earlier": (text(times=at(10, 0.02)), {}, "time [s]|by 0.07 s|line 12"),
    "jitter of 21 %": (text(times=TIMES + 0.00105 * TURNS), {}, "irregular|jitter 0.0021|--rate"),
    "bursts": (text(times=(np.arange(N) // 5) * 0.05 + (np.arange(N) % 5) * 0.001), {}, "irregular"),
    **{
        f"unit of {name}": (text(times=times, label="time"), {}, "'time'|time_unit=|--time-unit")
        for name, times in (
            ("a counter", np.arange(N)),
            ("tens", 10 * np.arange(N)),
            ("µs?", 1e-5 * np.arange(N)),
        )
    },
    "no unit of time": (text(times=TIMES, label="time [m]"), {}, "'m'|us", aj.UnitError),
    "time unit twice": (text(times=TIMES), {"time_unit": "ms"}, "in s|time_unit=|ms", aj.UnitError),
    "no such time": (text(times=TIMES), {"time": "clock"}, "clock|time [s]|time="),
    "empty time": (text(times=TIMES, cells={(7, 0): ""}), {}, "time [s]|line 7"),
    "time in words": (text(times=TIMES, cells={(7, 0): "soon"}), {}, "time [s]|line 7"),
    # Choices that there are not.
    "gaps": (text(), {**RATE, "gaps": "interpolate"}, "gaps=|--gaps|interpolate"),
    "topic": (text(), {**RATE, "topic": "/imu"}, "topic=|--topic"),
    "instance": (text(), {**RATE, "instance": 1}, "instance=|--instance"),
}


@pytest.mark.parametrize("name", OF_TEXT)
def test_text(tmp_path, name):
    """As a whole, and in chunks of 30 samples."""
    write, options, words, *kind = OF_TEXT[name]
    path = tmp_path / "imu.csv"
    write(path)
    # Errors of options alone do not name the file.
    words += "" if name in ("start after stop", "start nan", "gaps") else f"|{path}"
    refused(lambda: aj.read(path, **options), words, *kind)
    refused(lambda: list(aj.read_chunks(path, chunk=30, **options)), words, *kind)


def test_what_is_just_right_is_read(tmp_path):
    """The other side of each limit, and the remedies that messages name."""
    path = tmp_path / "imu.csv"
    late = np.isin(np.arange(N), [10, 45]) * 0.006
    for write, options, n in (
        (text(lines=16), RATE, 16),
        (text(), {**RATE, "start": 0.1, "stop": 0.26}, 16),
        (text(cells={(23, 1): "0.99e100"}), RATE, N),
        (text(cells={(23, 1): "x"}), {**RATE, "stop": 0.21}, 21),
        (text(times=TIMES), {"rate": 100.9}, N),
        (text(times=TIMES), {"rate": 99.1}, N),
        (text(times=TIMES + 0.00095 * TURNS), {}, N),
        # An interval of 1.44, and late stamps after which all is as before.
        (text(times=moved(r20=0.0044)), {}, N),
        (text(times=TIMES + late), {}, N),
        (text(times=moved(r10=0.35, r35=0.05)), {"start": 0.450, "stop": 0.690}, 24),
        (text(times=moved(r10=0.35)), {**RATE, "time": "none"}, N),
        (text(times=0 * TIMES), {**RATE, "time": False}, N),
        (text(["gyro_x [deg/s]", "gyro_z [deg/s]"]), {**RATE, "columns": "gyro_x,gyro_z"}, N),
        (text(), {**RATE, "gyro_unit": "°/s"}, N),
    ):
        write(path)
        assert aj.read(path, **options).n == n
    assert aj.read(path, **RATE).rate == 100.0
    text(times=TIMES)(path)
    assert aj.read(path, rate=100.5).rate == 100.5


def test_a_gap_names_the_longest_stretch_and_what_each_choice_makes_of_it(tmp_path):
    path = tmp_path / "imu.csv"
    text(times=moved(r10=0.35, r35=0.05))(path)
    with pytest.raises(aj.RecordingError) as caught:
        aj.read(path)
    for word in ("first of 2 gaps", "start=0.450", "stop=0.690", "40 missing", f"{N} others", "--gaps fill"):
        assert word in str(caught.value)
    assert caught.value.about == "gaps"


def _saved(name, save):
    """What saves something under a name in the folder of a path."""
    return lambda path: save(path.with_name(name))


def npy(array):
    return _saved("imu.npy", lambda path: np.save(path, array(NOISE), allow_pickle=True))


def npz(**arrays):
    return _saved("imu.npz", lambda path: np.savez(path, **arrays))


def mat(**arrays):
    return _saved("imu.mat", lambda path: savemat(path, arrays))


def raw(content, name="imu.bin"):
    return _saved(name, lambda path: path.write_bytes(content))


def _bad():
    bad = NOISE.copy()
    bad[7, 4] = np.nan
    return bad


def parquet(frame):
    return _saved("imu.parquet", frame.to_parquet)


def spreadsheet(path):
    with zipfile.ZipFile(path.with_name("imu.xlsx"), "w") as archive:
        archive.writestr("xl/workbook.xml", "<workbook/>")


FRAME = pd.DataFrame(NOISE, columns=list(SIX))
_WORDS = FRAME.assign(gyro_y=["bad" if k == 3 else str(x) for k, x in enumerate(NOISE[:, 1])])
_ZIPPED = gzip.compress("\n".join([",".join(HEADER), *rows(np.tile(NOISE, (200, 1)))]).encode())
HALVES = {"gyro": NOISE[:, :3], "accel": NOISE[:, 3:]}
_PLACE = "accel_y|row 7"
# What writes the file, options beside units, and what the RecordingError names.
BINARY = {
    "nan in npy": (npy(lambda x: _bad()), RATE, _PLACE),
    "nan in npz": (npz(gyro=_bad()[:, :3], accel=_bad()[:, 3:], rate=100), {}, _PLACE),
    "nan in mat": (mat(gyro=_bad()[:, :3], accel=_bad()[:, 3:], fs=100.0), {}, _PLACE),
    "nan in parquet": (parquet(pd.DataFrame(_bad(), columns=list(SIX))), RATE, _PLACE),
    "text in parquet": (parquet(_WORDS), RATE, "gyro_y|row 3|'bad'"),
    "no rows": (parquet(FRAME[:0]), RATE, "no rows"),
    "transposed": (npy(lambda x: x.T), RATE, "(6, 50)|array.T"),
    "three dimensions": (npy(lambda x: x[None]), RATE, "(1, 50, 6)"),
    "words": (npy(lambda x: x.astype(str)), RATE, "dtype"),
    "complex": (npy(lambda x: x.astype(complex)), RATE, "complex128"),
    "objects": (npy(lambda x: x.astype(object)), RATE, "can not be read"),
    "lengths in npz": (npz(gyro=NOISE[:, :3], accel=NOISE[:30, 3:]), RATE, "gyro_x 50|accel_x 30"),
    "lengths in mat": (mat(gyro=NOISE[:, :3], accel=NOISE[:30, 3:]), RATE, "gyro_x 50|accel_x 30"),
    "transposed in npz": (npz(gyro=NOISE[:, :3].T), RATE, "'gyro'|(3, 50)"),
    "no samples in npz": (npz(rate=100.0), {}, "no array"),
    "rate of npz": (npz(**HALVES, rate=-5.0), {}, "positive"),
    "rate against npz": (npz(**HALVES, fs=100.0), {"rate": 101.1}, "rate 101.1 Hz|100 Hz|--rate"),
    "spreadsheet": (spreadsheet, RATE, "imu.xlsx|CSV"),
    "no zip": (raw(b"PK\x03\x04" + bytes(100), "imu.xlsx"), RATE, "imu.xlsx|CSV"),
    "magic of Parquet": (raw(b"PAR1 damaged"), RATE, "Parquet"),
    "magic of npy": (raw(b"\x93NUMPY damaged"), RATE, ".npy"),
    "magic of MATLAB": (raw(b"MATLAB 5.0 damaged"), RATE, "-v7"),
    "magic of HDF5": (raw(b"\x89HDF\r\n\x1a\n" + bytes(100)), RATE, "HDF5|-v7"),
    "magic of -v7.3": (raw(b"MATLAB 7.3 MAT-file".ljust(512) + b"\x89HDF\r\n\x1a\n"), RATE, "-v7"),
    "magic of gzip": (raw(b"\x1f\x8b damaged"), RATE, "can not be read"),
    "magic of nothing": (raw(b"\x00\x01\x02" * 100), RATE, "CSV"),
    "cut gzip": (raw(_ZIPPED[:-500], "imu.csv.gz"), RATE, "imu.csv.gz|can not be read"),
    "empty": (raw(b"", "imu.csv"), {}, "empty"),
    "blank": (raw(b"\n\n", "imu.csv"), {}, "empty"),
    "a header alone": (raw(b"gyro_x [deg/s]\n# nothing\n", "imu.csv"), {}, "row of numbers"),
    "absent": (lambda path: None, {}, "imu.csv|no such file"),
    "a folder": (_saved("imu.csv", lambda path: path.mkdir()), {}, "imu.csv|folder"),
}


@pytest.mark.parametrize("name", BINARY)
def test_binary(tmp_path, name):
    write, options, words = BINARY[name]
    write(tmp_path / "imu")
    (path,) = tmp_path.iterdir() if any(tmp_path.iterdir()) else (tmp_path / "imu.csv",)
    refused(lambda: aj.read(path, **UNITS, **options), f"{path}|{words}")


# Changes to the arguments of `from_array`, and what its RecordingError names.
ARRAYS = {
    "nan": ({"values": _bad()}, "'accel_y'|1 value|row 7"),
    "infinite": ({"values": np.where(np.isnan(_bad()), np.inf, NOISE)}, "'accel_y'|row 7|inf"),
    "constant": ({"values": 0.0 * NOISE}, "'gyro_x'|constant"),
    "15 samples": ({"values": NOISE[:15]}, "15 samples|16"),
    "transposed": ({"values": NOISE.T}, "(6, 50)|values.T"),
    "three dimensions": ({"values": NOISE[None]}, "(1, 50, 6)"),
    "4 unnamed": ({"values": NOISE[:, :4]}, "4 columns|names="),
    "3 of two": ({"values": NOISE[:, :3]}, "3 columns|gyro_unit= and accel_unit=|names="),
    "1 name": ({"names": ["gyro_x"]}, "1 names for 6|names="),
    "no axis": ({"names": ["gx", "gy", "gz", "ax", "ay", "mag"]}, "'mag'|auxiliary="),
    "same axis": ({"names": ["gx", "gyro_x", "gz", "ax", "ay", "az"]}, "'gx' and 'gyro_x'"),
    "auxiliary": ({"auxiliary": {"temperature": np.ones(3)}}, "'temperature'|(3,)|(50,)"),
    "gaps": ({"gaps": "drop"}, "gaps=|drop"),
    **{f"rate {x}": ({"rate": x}, "rate=") for x in (0, -1.0, np.nan, np.inf, None, "100", 1j, np.ones(1))},
}


@pytest.mark.usefixtures("unchecked_shapes")
def test_arrays():
    for change, words in ARRAYS.values():
        arguments = {"values": NOISE, "rate": 50.0, "name": "unit 7", **UNITS, **change}
        refused(functools.partial(made, **arguments), f"unit 7: |{words}")


def chunks_of_npz(folder):
    np.savez(folder / "imu.npz", gyro=NOISE)
    aj.read_chunks(folder / "imu.npz")


made = aj.Recording.from_array
RECORDING = aj.Recording.from_array(NOISE, 50.0, **UNITS, name="unit 7")
# Other calls, what the error names, and its class unless it is RecordingError.
CALLS = {
    "no such axis": (lambda f: RECORDING["mag"], "mag|gyro_x"),
    "no axis": (lambda f: RECORDING.select(), "gyro_x"),
    "short part": (lambda f: RECORDING.between(0.7), "unit 7|15 samples|start="),
    "suffix": (lambda f: aj.write(RECORDING, f / "imu.mat"), "imu.mat|.parquet"),
    "no folder": (lambda f: aj.write(RECORDING, f / "a" / "imu.csv"), "imu.csv|folder"),
    "a folder": (lambda f: aj.write(RECORDING, f), "folder"),
    "array's unit": (
        lambda f: made(NOISE, 1.0, names=SIX, gyro_unit="deg/s"),
        "accel_x|accel_unit=",
        aj.UnitError,
    ),
    "array's increments": (
        lambda f: made(NOISE[:, 0], 1.0, names=["dv_x"], accel_unit="g"),
        "dv_x|g",
        aj.UnitError,
    ),
    "frame's unit": (lambda f: aj.Recording.from_dataframe(FRAME, 50.0), "gyro_x|gyro_unit=", aj.UnitError),
    "a recording's rate": (lambda f: aj.fit(RECORDING, rate=50.0), "rate", aj.AllanjaxError),
    "a recording's gaps": (lambda f: aj.fit(RECORDING, gaps="fill"), "gaps", aj.AllanjaxError),
    "array without rate": (lambda f: aj.fit(NOISE, gyro_unit="deg/s"), "rate", aj.AllanjaxError),
    "array without unit": (lambda f: aj.fit(NOISE, rate=1.0), "gyro_unit=|accel_unit=", aj.AllanjaxError),
    "no recording": (lambda f: aj.fit(7.0, rate=1.0), "allanjax.read", aj.AllanjaxError),
    "no chunk": (lambda f: aj.read_chunks(f / "imu.npy", chunk=0), "chunk|1 row"),
    "filled in chunks": (lambda f: aj.read_chunks(f / "imu.npy", gaps="fill"), "gaps="),
    "npz in chunks": (chunks_of_npz, "npz|read()"),
}


@pytest.mark.parametrize("name", CALLS)
def test_calls(tmp_path, name):
    call, *told = CALLS[name]
    refused(lambda: call(tmp_path), *told)
