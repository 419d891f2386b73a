"""What cannot be read or made: the error names file, column, line or option, and each remedy in it works."""

import gzip
import io
import os
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from imu_columns import DEG, HEADER, SIX, UNITS, noted, refused, rows
from remedies import remedies, with_values

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
    "text": (text(cells={(23, 1): "abc", (35, 1): "x"}), RATE, "gyro_y|line 23 has|abc|--stop"),
    "nan": (cell("nan"), RATE, "gyro_y|line 23 has|gaps"),
    "empty": (cell(""), RATE, "gyro_y|line 23 has|gaps"),
    "too large": (cell("1.01e30"), RATE, "gyro_y|line 23 has|1.01e+30"),
    "cell cut off": (line(2, "0.1,0.2,"), RATE, "gyro_z|line 2 has"),
    "no header": (text(cells={(4, 2): "x"}, edit=headless), DEG_S, "gyro_z|line 3 has 'x'"),
    "after a stretch": (text(cells={(35, 1): "x"}), {**RATE, "start": 0.22, "stop": 0.4}, "gyro_y|line 35 "),
    "comments count": (cell("x", edit=lambda x: ["# lab", "", *x[:9], "# stop", *x[9:]]), RATE, "line 26 "),
    "row too long": (line(9, "1,2,3,4"), RATE, "gyro_x|line 9, '1,2,3,4', has|gaps='fill'"),
    # Lengths, rates, stretches.
    "15 samples": (text(lines=15), RATE, "15 samples|16"),
    "15 of a stretch": (text(), {**RATE, "start": 0.1, "stop": 0.25}, "15 samples|--start"),
    "constant": (text(edit=lambda x: [x[0], *len(x[1:]) * ["1,2,3"]]), RATE, "gyro_x|constant (1 |line 2"),
    "no rate": (text(), {}, "rate=|--rate"),
    **{f"rate {r}": (text(), {"rate": r}, "rate=|positive") for r in (0, np.nan, np.inf)},
    "start after stop": (text(), {**RATE, "start": 0.3, "stop": 0.3}, "start=|stop="),
    "start nan": (text(), {**RATE, "start": np.nan}, "start="),
    # Units.
    "no accel unit": (text(SIX), DEG_S, "accel_x|accel_unit=|--accel-unit", aj.UnitError),
    # Columns.
    "no axis": (text(["p", "q", "r"]), RATE, "p, q, r|--columns"),
    "unknown column": (text(), {**RATE, "columns": "gyro_x,gyro_q"}, "--columns|gyro_q|gyro_z [deg/s]"),
    "column twice": (text(), {**RATE, "columns": "gyro_x,gyro_x,-"}, "columns=|gyro_x"),
    "too few entries": (text(SIX), {**RATE, "columns": "a,-"}, "columns|a"),
    "ambiguous": (text(["gx [deg/s]", "gx [rad/s]"]), {"columns": "gx"}, "columns=|gx [rad/s]"),
    "3 unnamed": (text(SIX[:3], edit=headless), {**RATE, **UNITS}, "3 columns|--columns"),
    "6 of one unit": (text(SIX, edit=headless), DEG_S, "6 columns|--columns"),
    # Times.
    "same throughout": (text(times=0 * TIMES), {}, "time [s]|--time none"),
    "a gap": (text(times=moved(r10=0.35, r35=0.05)), {}, "time [s]|0.36 s (36 intervals)|line 12|start="),
    "an interval of 1.56": (text(times=moved(r20=0.0056)), {}, "0.0156 s|line 22"),
    "repeats": (text(times=np.where(STEPS == 10, 0.09, TIMES)), {}, "time [s]|repeats|line 12|--rate"),
    "no such time": (text(times=TIMES), {"time": "clock"}, "clock|time [s]|time="),
    "time in words": (text(times=TIMES, cells={(7, 0): "soon"}), {}, "time [s]|line 8"),
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
    (cell("0.99e30"), RATE, N),
    (cell("x"), {**RATE, "stop": 0.21}, 21),
    (text(times=TIMES), {"rate": 99.1}, N),
    (text(times=TIMES + 0.00095 * TURNS), {}, N),
    # An interval of 1.44, and late stamps after which all is as before.
    (text(times=moved(r20=0.0044)), {}, N),
    (text(times=TIMES + np.isin(STEPS, [10, 45]) * 0.006), {}, N),
    (text(times=0 * TIMES), {**RATE, "time": False}, N),
    # Uneven stamps that leave no room for a missing sample: rounded ones, and a fifth of an interval off.
    (text(times=np.floor(TIMES * 50.01) / 50), {}, N),
    (text(times=TIMES + 0.00105 * TURNS), {}, N),
]


def test_what_is_just_right_is_read(tmp_path):
    path = tmp_path / "imu.csv"
    for write, options, n in RIGHT:
        write(path)
        assert aj.read(path, **options).n == n, options


# Times of samples some of which are late, lost or rounded; and six axes in turn.
LATE = TIMES + 0.02 * (STEPS % 3)
BOTH, ROWS = ["gx [deg/s]", "gy [deg/s]", "ax [g]", "ay [g]"], range(1, N)
IN_TURN = {(n + 2, k): repr(float(NOISE[n - 1, k - 1])) for n in ROWS for k in ((1, 2), (3, 4))[n % 2]}
MANY = np.arange(4000)
LOST = np.flatnonzero(np.random.default_rng(5).random(4000) > 0.08)
MOSTLY_LOST = np.flatnonzero(np.random.default_rng(5).random(4000) > 0.6)
TWO_RATES = np.concatenate([MANY[:3000] / 100.0, 30.0 + MANY[:1000] / 160.0])
# Stamps in ms of 952 Hz, of which some are lost: it cannot be told which.
OPEN = np.floor(MANY[np.random.default_rng(6).random(4000) > 0.01] / 0.952) / 1e3
GRAVITY = NOISE[:, 3:] * 0.01 + [0.0, 0.0, 9.81]
SQUARED = ["ax [rad/s^2]", "ay [rad/s^2]", "az [rad/s^2]"]


def table(times, header=HEADER[:3], label="time [s]", scale=1.0, values=None):
    """What writes a table of this many rows of noise."""

    def write(path):
        x = np.random.default_rng(7).normal(size=(len(times), len(header))) * scale
        x = x if values is None else values
        path.write_text("\n".join([",".join([label, *header]), *rows(times, x), ""]), encoding="utf-8")

    return write


def lines(*content):
    def write(path):
        path.write_text("\n".join([*content, ""]), encoding="utf-8")

    return write


def marked(path):
    """A counter of 16 bits shows -32768 where there is no sample."""
    x = np.round(300.0 * np.random.default_rng(3).normal(size=(200, 3)))
    x[::40] = -32768
    path.write_text("\n".join(["gx [mdeg/s],gy [mdeg/s],gz [mdeg/s]", *rows(x), ""]), encoding="utf-8")


def in_turn(path):
    made = [f"{s},{10 * k},{x},{y},{z}" for k in range(N) for s, (x, y, z) in zip(("GYR", "ACC"), TRIADS[k])]
    path.write_text("\n".join([*made, ""]), encoding="utf-8")


TRIADS = [(row[:3], row[3:]) for row in np.round(NOISE, 4).tolist()]
# What a user knows who is asked.
KNOWN = {"rate": 100.0, "gyro_unit": "deg/s", "accel_unit": "g", "time_unit": "ms", "time": "time [s]"}
KNOWN |= {
    "columns": "gyro_x,gyro_y,gyro_z",
    "names": ["gyro_x", "gyro_y", "gyro_z"],
    "start": 0.0,
    "stop": 0.2,
}
# What else a user knows of a file of `OF_TEXT`.
ELSE = {
    **dict.fromkeys(("cell cut off", "row too long", "no header"), {"start": 0.1, "stop": 0.4}),
    "3 unnamed": {"columns": "accel_x,accel_y,accel_z"},
    "6 of one unit": {"columns": ",".join(SIX)},
}
# What writes a file, options of reading, whose errors name remedies, and the rates that these may give.
REMEDIES = {
    **{name: (*case[:2], {100.0}, ELSE.get(name, {})) for name, case in OF_TEXT.items()},
    "late": (text(times=LATE), {}, {100.0, 1.0 / np.polyfit(STEPS, LATE, 1)[0]}),
    "set back": (text(times=moved(r30=-0.2)), {}, {100.0}),
    "lost": (text(times=moved(r20=0.1)), {}, {100.0}),
    "pause": (text(times=moved(r10=0.35)), {}, {100.0}),
    "lost at random": (table(LOST / 100.0), {}, {100.0}),
    "uniform though lost": (table(LOST / 100.0), {"time": "uniform"}, {100.0, 92.0}),
    "mostly lost": (table(MOSTLY_LOST / 100.0), {}, {100.0}),
    "mostly lost, to be filled": (table(MOSTLY_LOST / 100.0), {"gaps": "fill"}, {100.0}),
    "two rates": (table(TWO_RATES), {}, {100.0, 160.0}),
    "uniform though of two rates": (table(TWO_RATES), {"time": "uniform"}, {100.0, 160.0, 106.2}),
    "open": (table(OPEN), {}, {100.0}),
    "open, to be filled": (table(OPEN), {"gaps": "fill"}, {100.0}),
    "do not increase": (text(times=0.0 * TIMES), {"time": "uniform"}, {100.0}),
    "counts": (text(["gx [LSB]"], times=TIMES), {}, {100.0}),
    "no units": (text(["gx", "ax"], times=TIMES), {}, {100.0}),
    "wrong unit": (text(["ax [rad/s^2]"], times=TIMES), {}, {100.0}),
    "wrong unit, with gravity": (table(TIMES, SQUARED, values=GRAVITY), {}, {100.0}),
    "increments": (text(["dv_x [g]"], times=TIMES), {}, {100.0}),
    "time in m": (text(times=TIMES, label="time [m]"), {}, {1e5}),
    "steps": (text(times=STEPS, label="time"), {}, {100.0, 1000.0}),
    "same names": (
        text(["gx", "gx", "gy"], times=TIMES),
        {},
        {100.0},
        {"columns": "time [s],gx [deg/s],-,gy"},
    ),
    "in turn": (text(BOTH, cells=IN_TURN, times=TIMES), {}, {50.0}),
    "kinds": (in_turn, {}, {100.0}),
    "no such time": (text(times=TIMES), {"time": "clock"}, {100.0}),
    "no time in a row": (text(times=TIMES, cells={(7, 0): "nan"}), {}, {100.0}),
    "no clock in a row": (
        lines(
            "time,gx [deg/s]",
            *(f"10:00:{k},{x}" for k, x in zip((10, "x", *range(12, 40)), NOISE[:30, 0], strict=False)),
        ),
        {"rate": 100.0},
        {100.0},
    ),
    "outside": (text(), {**RATE, "start": 9.0}, {100.0}),
    "position": (text(), {**RATE, "columns": "gyro_x,-"}, {100.0}),
    "a unit of nothing": (
        text(),
        {**RATE, "accel_unit": "g"},
        {100.0},
        {"columns": "accel_x,accel_y,accel_z"},
    ),
    "a unit of no times": (text(), {**RATE, "time_unit": "ms"}, {100.0}),
    "all missing": (
        text(cells={(n, 1): "nan" for n in range(2, N) if n % 2}),
        {**RATE, "gaps": "fill"},
        {100.0},
    ),
}
# Messages whose remedy is a deed: a word of it, and what a user does to the file.
DEEDS: dict[str, Callable[[Path], aj.Recording]] = {}


def deed(words):
    def register(do):
        DEEDS[words] = do
        return do

    return register


def again(path, **options):
    """Read the file once what is wrong with it has been repaired."""
    text(times=TIMES)(path)
    return aj.read(path, **options)


for words in (
    "repair it",
    "repair the file",
    "correct the header",
    "use a longer recording",
    "write it in the header",
    "record it again",
):
    DEEDS[words] = again


def tried(path, options, rates, known, steps, seen=()):
    """Why no chain of remedies leads from these options to a result; [] if one does, and all are truthful."""
    try:
        recording = aj.read(path, **options)
    except aj.AllanjaxError as error:
        message = str(error)
    else:
        wrong = (
            [] if any(abs(recording.rate / rate - 1.0) < 0.01 for rate in rates) else [f"{recording.rate} Hz"]
        )
        return [f"{options}: {wrong[0]}"] if wrong else []
    if message in seen:
        return [f"{options}: again {message}"]
    offered = remedies(message)
    chosen = [with_values(remedy, known) for remedy in offered]
    if None in chosen or (steps == 0):
        return [f"{options}: {message}"]
    failed = [tried(path, options | more, rates, known, steps - 1, (*seen, message)) for more in chosen]
    # The first message's remedies work all; in those that follow, one does.
    if not seen:
        return [why for whys in failed for why in whys]
    return [] if [] in failed or any(words in message for words in DEEDS) else [f"{options}: {message}"]


@pytest.mark.parametrize("name", REMEDIES)
def test_every_remedy_that_an_error_names_leads_to_a_result(tmp_path, name):
    """At once, or by a refusal whose remedy does."""
    write, options, rates, *more = REMEDIES[name]
    known = KNOWN | dict(*more)
    write(path := tmp_path / "imu.csv")
    message = str(refused_any(path, options))
    assert remedies(message) or any(words in message for words in DEEDS), message
    assert not tried(path, options, rates, known, 3)


def refused_any(path, options):
    with pytest.raises(aj.AllanjaxError) as caught:
        aj.read(path, **options)
    return caught.value


def header(*lines):
    return text(edit=lambda x: [*lines, *x[1:]])


# What writes a file, what a person states, the rate, a note, the first axis's factor to SI, and the axes.
UNIT = "_z read in {} as requested, although labelled deg/s"
STATED = [
    (text(times=TIMES), {"rate": 101.1}, 101.1, "101.1 Hz as given, not 100 Hz"),
    (text(times=TIMES, label="time"), {"rate": 200.0}, 200.0, "in s the rate is 100 Hz"),
    (text(times=TIMES), {"time_unit": "ms"}, 1e5, "in ms as requested, although labelled s"),
    (text(times=STEPS + 3, label="PacketCounter"), {"rate": 80.0}, 80.0, "counts of 0.0125 s each"),
    (text(times=STEPS * 100, label="SampleTimeFine"), {}, 100.0, "from column 'SampleTimeFine'"),
    (text(), {**RATE, "gyro_unit": "rad/s"}, 100.0, UNIT.format("rad/s"), 1.0),
    (text(), {**RATE, "gyro_unit": "deg"}, 100.0, UNIT.format("deg"), 100.0 * DEG),
    (text(["gx [rad/s]"]), {**RATE, "columns": "gx [deg/s]"}, 100.0, "although labelled rad/s", DEG, SIX[:1]),
    (text(HEADER[:2]), RATE, 100.0, "no column for gyro_z", DEG, SIX[:2]),
    (text(["gyro1_x [deg/s]", "gyro2_x [deg/s]"]), RATE, 100.0, "", DEG, ("gyro1_x", "gyro2_x")),
    (text(["p [deg/s]", "q [deg/s]"]), RATE, 100.0, "", DEG, ("p", "q")),
    (text(["gyro_rad[0]", "gyro_rad[1]"]), RATE, 100.0, "no column for gyro_z", 1.0, SIX[:2]),
    (text(edit=lambda x: ["// Update Rate: 80.0Hz", *x]), {}, 80.0, "80 Hz from the line"),
    (header("gx,gy,gz", "CAL,CAL,CAL", "deg/s,deg/s,deg/s"), RATE, 100.0, "gyro_x from 'gx [deg/s]'"),
    (text(edit=lambda x: ['"sep=|"', *(y.replace(",", "|") for y in x)]), RATE, 100.0, ""),
]


@pytest.mark.parametrize("row", range(len(STATED)))
def test_what_a_person_states_wins_over_the_file(tmp_path, row):
    write, options, rate, note, *others = STATED[row]
    scale, names = (*others, *(DEG, SIX[:3])[len(others) :])
    write(path := tmp_path / "imu.csv")
    recording = aj.read(path, **options)
    assert (recording.names, recording.rate) == (names, pytest.approx(rate, rel=1e-9))
    np.testing.assert_allclose(recording.values[:, 0], NOISE[:, 0] * scale, rtol=1e-12)
    assert not note or noted(recording, note)
    np.testing.assert_array_equal(np.concatenate([*aj.read_chunks(path, **options)]), recording.values)


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
    "objects": ("imu.npy", NOISE.astype(object), RATE, "cannot be read"),
    "lengths in npz": ("imu.npz", SHORT, RATE, "gyro_x 50|accel_x 30"),
    "transposed in npz": ("imu.npz", {"gyro": NOISE[:, :3].T}, RATE, "'gyro'|(3, 50)"),
    "no samples in npz": ("imu.npz", {"rate": 100.0}, {}, "no array"),
    "rate of npz": ("imu.npz", {**HALVES, "rate": -5.0}, {}, "positive"),
    "spreadsheet": ("imu.xlsx", workbook.getvalue(), RATE, "CSV"),
    "magic of MATLAB": ("imu.bin", b"MATLAB 5.0 damaged", RATE, "-v7"),
    "magic of -v7.3": ("imu.bin", b"MATLAB 7.3 MAT-file".ljust(512) + HDF5, RATE, "-v7"),
    "magic of nothing": ("imu.bin", b"\x00\x01\x02" * 100, RATE, "CSV"),
    "cut gzip": ("imu.csv.gz", ZIPPED[:9], RATE, "cannot be read"),
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
    ({"values": BAD}, "'accel_y'|row 7|has"),
    ({"values": np.where(np.isnan(BAD), np.inf, NOISE)}, "'accel_y'|row 7|inf"),
    ({"values": 0.0 * NOISE}, "'gyro_x'|constant"),
    ({"values": NOISE[:15]}, "15 samples|16"),
    ({"values": NOISE.T}, "(6, 50)|values.T"),
    ({"values": NOISE[None]}, "(1, 50, 6)"),
    ({"values": NOISE[:, :4]}, "4 columns|names="),
    ({"values": NOISE[:, :3]}, "3 columns|gyro_unit= and accel_unit=|names="),
    ({"names": ["gyro_x"]}, "1 names for 6|names="),
    ({"names": [1, 2, 3, 4, 5, 6]}, "names=|'gyro_x'|not 1"),
    ({"values": 1e-31 * NOISE}, "'gyro_x'|1e-30|unit"),
    ({"values": np.ma.masked_less(NOISE, -1.0)}, "gyro_x|has nan|gaps="),
    ({"names": ["gx", "gy", "gz", "ax", "ay", "mag"]}, "'mag'|auxiliary="),
    ({"names": ["gx", "gx", "gz", "ax", "ay", "az"]}, "'gx'"),
    ({"auxiliary": {"temperature": np.ones(3)}}, "'temperature'|(3,)|(50,)"),
    *(({"rate": x}, "rate=") for x in (0, np.nan, np.inf, None, "100", 1j, np.ones(1))),
]


made = aj.Recording.from_array
RECORDING = made(NOISE, 50.0, **UNITS, name="unit 7")
# Other calls in a folder, what the error names, and its class unless it is RecordingError.
CALLS = [
    (lambda f: RECORDING["mag"], "mag|gyro_x"),
    (lambda f: made(NOISE, 1.0, **UNITS, gaps="drop"), "gaps=|drop"),
    (lambda f: RECORDING.select(), "gyro_x"),
    (lambda f: RECORDING.between(0.7), "unit 7|15 samples|longer"),
    (lambda f: aj.write(RECORDING, f / "imu.mat"), "imu.mat|.parquet"),
    (lambda f: aj.write(RECORDING, f / "a" / "imu.csv"), "imu.csv|folder"),
    (lambda f: aj.write(RECORDING, f), "folder"),
    (lambda f: aj.read(f / "imu.csv"), "imu.csv|no such file"),
    (lambda f: made(NOISE, 1.0, names=SIX, gyro_unit="deg/s"), "accel_x|accel_unit=", aj.UnitError),
    (lambda f: aj.allan_deviation(NOISE.T, 1.0), "(6, 50)|values.T"),
    (lambda f: aj.Recording.from_dataframe(FRAME, 50.0), "gyro_x|gyro_unit=", aj.UnitError),
    (lambda f: aj.fit(RECORDING, gaps="fill"), "gaps", aj.AllanjaxError),
    (lambda f: aj.fit(7.0, rate=1.0), "allanjax.read", aj.AllanjaxError),
    (lambda f: [np.save(f / "imu.npy", NOISE), aj.read_chunks(f / "imu.npy", chunk=0)], "chunk|1 row"),
    (lambda f: aj.read_chunks(f / "imu.npy", gaps="fill"), "gaps="),
    (lambda f: aj.read(f / "imu.npy", columns=[1, 2, 3]), "columns=|'gyro_x'|not 1"),
    (lambda f: aj.fit(1j * NOISE, rate=50.0, **UNITS), "complex"),
    (lambda f: aj.fit({"time": np.arange(50.0), "gyro_x [deg/s]": 1j * NOISE[:, 0]}), "gyro_x|complex"),
    (lambda f: [os.mkfifo(f / "pipe"), aj.read(f / "pipe")], "pipe|copy it to a file"),
    (lambda f: [os.symlink(f / "a.csv", f / "a.csv"), aj.read(f / "a.csv")], "a.csv|symbolic links"),
    (lambda f: [write(f / "imu.npz", HALVES), aj.read_chunks(f / "imu.npz")], "npz|read()"),
]


@pytest.mark.usefixtures("unchecked_shapes")
def test_arrays_and_calls(tmp_path):
    for change, words in ARRAYS:
        arguments = {"values": NOISE, "rate": 50.0, "name": "unit 7", **UNITS, **change}
        refused(made, f"unit 7: |{words}", **arguments)
    for call, *words in CALLS:
        refused(lambda call=call: call(tmp_path), *words)
