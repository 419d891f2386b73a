"""What cannot be read or made: the error names file, column, line or option, and each remedy in it works."""

import gzip
import io
import os
import zipfile
from contextlib import suppress

import numpy as np
import pandas as pd
import pytest
from commands import run
from imu_columns import DEG, HEADER, SIX, UNITS, noted, refused, rows
from logs import Topic, structured, write_bag, write_dataflash, write_ulog
from raise_sites import places, reached
from remedies import commands, of_python, remedies, with_values

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


def in_turn(path):
    sensors = [(k, sensor, x) for k in range(N) for sensor, x in zip(("GYR", "ACC"), TRIADS[k], strict=True)]
    made = [f"{sensor},{10 * k},{','.join(map(str, x))}" for k, sensor, x in sensors]
    path.write_text("\n".join([*made, ""]), encoding="utf-8")


def of_two(path):
    made = [f"{k / 200},{k % 2}," + ",".join(map(str, x)) for k, x in enumerate(np.round(NOISE[:, :3], 4))]
    path.write_text("\n".join([",".join(["time [s]", "sensor_id", *HEADER[:3]]), *made, ""]))


def of_two_later(path):
    made = [f"{int(k > 30)}," + ",".join(map(str, x)) for k, x in enumerate(np.round(NOISE[:, :3], 4))]
    path.write_text("\n".join([",".join(["sensor_id", *HEADER[:3]]), *made, ""]))


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
    **{name: {"start": 0.1, "stop": 0.4} for name in ("cell cut off", "row too long", "no header")},
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
    "lost at random, rounded": (table(np.floor(LOST / 0.476) / 1e3), {}, {476.0}),
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
    "two sensors": (of_two, {}, {100.0}),
    "another sensor": (of_two, {"instance": 4}, {100.0}),
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
# What a user does to a file or a sensor, and not with an option.
DEEDS = ("repair it", "repair the file", "correct the header", "use a longer recording", "record it again")


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
    typed, called = commands(message), of_python(message)
    assert called.keys() - {"names"} == typed.keys(), message
    assert all(value in ("", called[key]) for key, value in typed.items() if called[key]), message
    assert not tried(path, options, rates, known, 3)


def refused_any(path, options):
    with pytest.raises(aj.AllanjaxError) as caught:
        aj.read(path, **options)
    return caught.value


VALUES = np.random.default_rng(8).normal((0.1, 0.2, 0.3, 1.0, 2.0, 9.81), 1.0, (64, 6)).astype("f4")
GYRO, ACCEL = VALUES * [1, 1, 1, 0, 0, 0], VALUES * [0, 0, 0, 1, 1, 1]


def nanos(n=64, rate=200.0):
    return 1_700_000_000_123_456_789 + np.round(np.arange(n) * 1e9 / rate).astype(np.int64)


def bag(**topics):
    """What writes a bag of these topics."""
    return lambda folder: write_bag(folder / "imu.bag", "ros1", {f"/{key}": x for key, x in topics.items()})


def ulog(folder):
    times = (5_000_000 + 5000 * np.arange(64)).astype("u8")
    messages = {}
    for k in (0, 1):
        for name, values in (("sensor_gyro", VALUES[:, :3]), ("sensor_accel", VALUES[:, 3:])):
            axes = dict(zip("xyz", values.T, strict=True))
            messages[name, k] = structured(timestamp=times, timestamp_sample=times, **axes)
    return write_ulog(folder / "log.ulg", messages)


def dataflash(interval=5000, **columns):
    """What writes a log of one kind of message, by default of all axes."""
    times = (5_000_000 + interval * np.arange(64)).astype("u8")
    names = [f"{sensor}{axis}" for sensor in ("Gyr", "Acc") for axis in "XYZ"]
    axes = columns or dict(zip(names, VALUES.T, strict=True))
    return lambda folder: write_dataflash(folder / "log.bin", {"IMU": structured(TimeUS=times, **axes)})


IMU, SLOW = Topic(nanos(), VALUES), Topic(nanos(40, 63.0), ACCEL[:40])
APART = Topic(nanos(128)[20:84], ACCEL)
# Logs of several sensors, options, and what a user chooses.
LOGS = {
    "two topics": (bag(front=IMU, rear=Topic(nanos(), 2.0 * VALUES)), {}, {"topic": "/front"}),
    "another topic": (bag(imu=IMU), {"topic": "/camera"}, {"topic": "/imu"}),
    "no messages": (bag(imu=IMU, spare=Topic([], VALUES[:0])), {"topic": "/spare"}, {"topic": "/imu"}),
    "not halves": (bag(imu=IMU, rear=IMU), {"topic": "/imu,/rear"}, {"topic": "/imu"}),
    "two rates": (bag(accel=SLOW, gyro=Topic(nanos(), GYRO)), {}, {"topic": "/gyro"}),
    "apart": (bag(accel=APART, gyro=Topic(nanos(), GYRO)), {}, {"topic": "/gyro"}),
    "instance of PX4": (ulog, {"instance": 4}, {"instance": 1}),
    "topic of PX4": (ulog, {"topic": "vehicle_imu"}, {"topic": "sensor_gyro"}),
    "topic of ArduPilot": (dataflash(), {"topic": "GYR,IMU"}, {"topic": "IMU"}),
}
# Logs that have no samples, and what their messages tell to do.
EMPTY = [
    (bag(imu=Topic(nanos(), 0.0 * VALUES)), "record it while"),
    (bag(), "record the IMU"),
    (dataflash(Roll=np.ones(64, "f4")), "IMU lacks"),
]


@pytest.mark.parametrize(
    "name", ["lost at random", "two rates", "wrong unit, with gravity", "pause", "steps"]
)
def test_remedies_as_commands(tmp_path, name):
    """`check` with the options that its own error names tells of the recording, and no error."""
    make, *_ = REMEDIES[name]
    make(path := tmp_path / "imu.csv")
    done = run("check", path)
    assert done.exit_code == 1
    told = done.output
    chosen = [with_values(remedy, KNOWN) for remedy in remedies(told)]
    words = [f"--{key.replace('_', '-')}={value}" for key, value in chosen[0].items()]
    followed = run("check", path, *words)
    assert "error" not in followed.stderr, followed.output
    assert told not in followed.output


@pytest.mark.parametrize("name", LOGS)
def test_what_to_choose_of_a_log_is_listed(tmp_path, name):
    write, options, known = LOGS[name]
    path = write(tmp_path)
    refused_any(path, options)
    assert not tried(path, options, {200.0}, KNOWN | known, 3)


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
    ({"values": NOISE[:, :3]}, "3 columns|gyro_unit=|accel_unit=|names="),
    ({"names": ["gyro_x"]}, "1 names for 6|names="),
    ({"names": [1, 2, 3, 4, 5, 6]}, "names=|'gyro_x'|not 1"),
    ({"values": 1e-31 * NOISE}, "'gyro_x'|constant"),
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
    (lambda f: aj.fit(NOISE, rate=50.0), "gyro_unit=|accel_unit=", aj.AllanjaxError),
    (lambda f: aj.fit(NOISE, **UNITS), "rate=", aj.AllanjaxError),
    (lambda f: aj.fit(["a", "b"], rate=1.0, **UNITS), "allanjax.read", aj.AllanjaxError),
    (lambda f: aj.Recording.from_dataframe(7), "columns by name"),
    (lambda f: aj.fit(pd.DataFrame({"gyro [deg/s]": [[1.0], [2.0, 3.0]]})), "'gyro [deg/s]'|column per axis"),
    (lambda f: made(NOISE * [1, 1, 1, 1, 1, 0], 50.0, **UNITS).select("accel_z"), "accel_z was left out"),
    (lambda f: aj.allan_deviation(RECORDING)["mag"], "mag|gyro_x", aj.AllanjaxError),
    (lambda f: aj.read(f / "none.csv"), "no such file"),
    (lambda f: [lines("tau,gyro_x [deg/s]", *20 * ["1,2"])(f / "c.csv"), aj.read(f / "c.csv")], "read_curve"),
    (lambda f: [lines("")(f / "e.csv"), aj.read(f / "e.csv")], "empty"),
    (lambda f: [write(f / "e.parquet", FRAME[:0]), aj.read_chunks(f / "e.parquet", **RATE)], "no rows"),
    (
        lambda f: [(f / "z.csv").write_bytes(b"a" * 600 + bytes(40) * 3), aj.read(f / "z.csv")],
        "row of numbers",
    ),
    (lambda f: [(f / "z.dat").write_bytes(b"a\1\0\2" * 300), aj.read(f / "z.dat")], "CSV"),
    (lambda f: [lines("gx [deg/s]", *20 * ["0.1", "what"])(f / "w.csv"), aj.read(f / "w.csv")], "awk"),
    (
        lambda f: [write(f / "n.npz", {"gyro": np.ones((50, 3, 2))}), aj.read(f / "n.npz")],
        "[samples, columns]",
    ),
    (lambda f: [write(f / "v.npy", np.zeros(9, [("a", "c16")])), aj.read(f / "v.npy")], "dtype"),
    (lambda f: [(f / "d.npz").write_bytes(b"PK\3\4" + bytes(99)), aj.read(f / "d.npz")], "save it again"),
    (lambda f: [in_turn(f / "k.csv"), aj.read_chunks(f / "k.csv", columns="gyro")], "several sensors"),
    (
        lambda f: [of_two_later(f / "s.csv"), list(aj.read_chunks(f / "s.csv", chunk=30, **RATE))],
        "0 and 1 among|instance=",
    ),
    (lambda f: aj.convert(1.0, "what", "deg/h"), "deg/h", aj.UnitError),
    (lambda f: aj.convert(1.0, "deg/s", "s"), "deg/h", aj.UnitError),
    (lambda f: aj.convert(1.0, "m/s^2", "deg/h", "gyro"), "for an accelerometer", aj.UnitError),
]
# Messages that no case here makes, by file and words, and why.
UNREACHED = {
    "columns.py: no gyro or accelerometer column; name": "tables without axes are refused before",
    "arrays.py: claim": "test_binary makes archives and files that claim too much",
    "table.py: the file claims": "test_binary makes archives and files that claim too much",
    "table.py: requires {package}": "test_binary hides the packages",
    "arrays.py: channel.name": "benchmarks damage LabVIEW's files",
    "chunks.py: leaves out rows that repeat": "test_binary reads sensors in turn in chunks",
    "chunks.py: at first, but": "test_binary changes the rate within a file",
    "chunks.py: absent.notes": "test_absent reads markers in chunks",
    "flight_logs.py: no samples of an IMU": "test_logs makes logs of other messages",
    "flight_logs.py: batches": "test_logs makes batches",
    "flight_logs.py: other": "test_logs cuts logs",
    "kinds.py: export one of them": "test_loggers reads a long table of two series",
    "ros.py: is damaged": "test_logs damages bags",
    "ros.py: does not end in": "test_logs renames bags",
}


@pytest.mark.usefixtures("unchecked_shapes")
def test_every_place_that_makes_an_error_is_reached(tmp_path):
    """By the cases of this file, in whole and in chunks; the others are listed with the reason."""

    def attempt(call):
        with suppress(aj.AllanjaxError):
            call()

    with reached() as there:
        path = tmp_path / "imu.csv"
        for make, options, *_ in REMEDIES.values():
            make(path)
            attempt(lambda options=options: aj.read(path, **options))
            attempt(lambda options=options: list(aj.read_chunks(path, chunk=30, **options)))
        for k, (make, options, *_) in enumerate([*LOGS.values(), *((make, {}) for make, _ in EMPTY)]):
            (folder := tmp_path / str(k)).mkdir()
            attempt(lambda: aj.read(make(folder), **options))  # noqa: B023
        for name, (file, content, options, _) in BINARY.items():
            (folder := tmp_path / name).mkdir()
            write(folder / file, content)
            attempt(lambda: aj.read(folder / file, **UNITS, **options))  # noqa: B023
        for change, _ in ARRAYS:
            attempt(lambda: made(**{"values": NOISE, "rate": 50.0, **UNITS, **change}))  # noqa: B023
        for call, *_ in CALLS:
            attempt(lambda: call(tmp_path))  # noqa: B023
    missed = []
    for (file, first, last), source in places("record").items():
        is_listed = any(
            key.partition(": ")[0] in file and key.partition(": ")[2] in source for key in UNREACHED
        )
        if not is_listed and not any(at == file and first <= n <= last for at, n in there):
            missed.append(f"{file}:{first} {source}")
    assert not missed


def test_logs_without_samples_say_what_to_do(tmp_path):
    for k, (make, words) in enumerate(EMPTY):
        (folder := tmp_path / str(k)).mkdir()
        refused(make(folder), words)


@pytest.mark.usefixtures("unchecked_shapes")
def test_arrays_and_calls(tmp_path):
    for change, words in ARRAYS:
        arguments = {"values": NOISE, "rate": 50.0, "name": "unit 7", **UNITS, **change}
        refused(made, f"unit 7: |{words}", **arguments)
    for call, *words in CALLS:
        refused(lambda call=call: call(tmp_path), *words)
