"""Files as programs export them, with unusual times and tables, against what made them."""

import gzip
import subprocess
import warnings

import numpy as np
import pandas as pd
import pytest
from imu_columns import DEG, G0, SIX, noted, refused

import allanjax as aj

N, RATE = 400, 100.0
GYRO = np.random.default_rng(3).normal([0.1, -0.2, 0.05], 0.08, (N, 3)).round(5)
ACCEL = np.random.default_rng(4).normal([0.01, -0.02, 1.003], 0.002, (N, 3)).round(5)
HEADER = "gyro_x [deg/s],gyro_y [deg/s],gyro_z [deg/s]"


@pytest.fixture
def written(tmp_path):
    def written(lines, name="log.csv"):
        (tmp_path / name).write_text("\n".join([*lines, ""]), encoding="utf-8")
        return tmp_path / name

    return written


def is_right(recording, truth=GYRO * DEG, names=SIX[:3], rate=RATE):
    """All samples and names, and the rate."""
    assert (recording.names, recording.rate) == (tuple(names), pytest.approx(rate, rel=1e-6))
    np.testing.assert_allclose(recording.values, truth, rtol=1e-12)
    return recording


def clock(milliseconds, marks="::."):
    """A time of the day from 10:59:58 on, with these marks after hours, minutes and seconds."""
    seconds, parts = divmod(milliseconds, 1000)
    minutes = 659 + (58 + seconds) // 60
    times = (minutes // 60, minutes % 60, (58 + seconds) % 60)
    hour, minute, second = (f"{part:02d}" for part in times)
    return f"{hour}{marks[0]}{minute}{marks[1]}{second}{marks[2]}{parts:03d}"


CLOCKS = {
    "a colon before the milliseconds": lambda t: clock(t, ":::"),
    "a date before it": lambda t: f"2024-03-05 {clock(t, ':::')}",
    "dots in place of colons": lambda t: f"2024-03-05T{clock(t, '...')}",
    "no hours": lambda t: clock(t)[3:],
}


@pytest.mark.parametrize("written_as", CLOCKS.values(), ids=CLOCKS)
@pytest.mark.parametrize("gap", [0, 3000, 2500])
def test_a_clock_is_one_time_however_it_is_written(written, written_as, gap):
    """A gap of whole seconds is one, where only milliseconds would show none; the clock passes an hour."""
    times = 10 * np.arange(N) + gap * (np.arange(N) >= 150)
    rows = [f"{written_as(int(t))},{x},{y},{z}" for t, (x, y, z) in zip(times, GYRO, strict=True)]
    path = written([f"time,{HEADER}", *rows])
    if not gap:
        is_right(aj.read(path))
        return
    refused(path, f"'time' has a gap of {(gap + 10) / 1000} s ({gap / 10 + 1:.0f} intervals) before line 152")
    longest = aj.read(path, gaps="segments")
    is_right(longest, GYRO[150:] * DEG)
    assert [found.samples for found in longest.gaps] == [gap // 10]


def test_coarse_times_that_go_back_do_not_warn(written):
    """Most of these times repeat, so that the usual interval is none."""
    times = np.repeat(np.arange(N // 4), 4)
    times[200] -= 2
    path = written(
        [f"time [s],{HEADER}", *(f"{t},{x},{y},{z}" for t, (x, y, z) in zip(times, GYRO, strict=True))]
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        refused(path, "'time [s]' goes back by 1 s at line 202")


@pytest.mark.parametrize("orient", ["split", "columns", "index", "records", "table"])
@pytest.mark.parametrize("is_indexed", [False, True])
def test_data_frames_as_json(tmp_path, orient, is_indexed):
    """All layouts keep the names; an index of times is a column that can be named."""
    frame = pd.DataFrame({"t_s": np.arange(N) / RATE} | dict(zip(HEADER.split(","), GYRO.T, strict=True)))
    options = {}
    if is_indexed and orient != "records":
        frame, options = frame.set_index("t_s"), {"time": "t_s" if orient == "table" else "index"}
    frame.to_json(path := tmp_path / "frame.json", orient=orient, double_precision=15)
    is_right(aj.read(path, **options))


def of_database(is_bordered):
    """Lines that psql, or mysql with its borders, prints of rows."""
    names = ["ts", "gyro_x_rad_s", "gyro_y_rad_s", "gyro_z_rad_s"]
    rows = [[f"2024-03-05 12:00:{k / RATE:06.3f}", *map(str, row)] for k, row in enumerate(GYRO)]
    lines = [f" {' | '.join(f'{cell:>25}' for cell in cells)} " for cells in (names, *rows)]
    rule = "+".join(["-" * 27] * len(names))
    if is_bordered:
        rule, lines = f"+{rule}+", [f"|{line}|" for line in lines]
        return [rule, lines[0], rule, *lines[1:], rule, f"{N} rows in set (0.03 sec)"]
    return [lines[0], rule, *lines[1:], f"({N} rows)", ""]


@pytest.mark.parametrize("is_bordered", [False, True])
def test_tables_that_databases_print(written, is_bordered):
    """Rules, borders and the number of rows are no rows; a word in a cell is the only one and found."""
    lines = of_database(is_bordered)
    is_right(aj.read(written(lines, "out.txt")), GYRO)
    place = 102 + 2 * is_bordered - 1
    lines[place] = lines[place].replace(f"{GYRO[place - 2 - is_bordered][0]}", "broken")
    error = refused(written(lines, "torn.txt"), f"line {place + 1} has 'broken'")
    assert "more" not in str(error)


@pytest.mark.parametrize("rate", [476.0, 800.0, 980.0])
def test_gaps_between_stamps_rounded_to_a_millisecond(written, rate):
    """Steps that rounding makes are no gaps, which lie between parts of known lengths."""
    n, sizes = 20_000, [4000, 8000, 5000, 3000]
    firsts, lost = np.cumsum(sizes)[:-1], np.array([160, 800, 401])
    places = np.arange(n) + (np.arange(n)[:, None] >= firsts) @ lost
    x = np.random.default_rng(5).normal(0.0, 0.1, (n, 3)).round(5)
    stamps = np.floor(1234 + 1e3 * places / rate).astype(int)
    rows = [f"{t},{','.join(map(str, row))}" for t, row in zip(stamps, x.tolist(), strict=True)]
    path = written([f"millis,{HEADER}", *rows])
    if rate < 900.0:
        refused(path, f"whole multiples of {1e3 / rate:.3g} ms, so that 1,361 of 21,361 samples")
    recording = aj.read(path, gaps="segments")
    np.testing.assert_allclose(recording.values, x[4000:12_000] * DEG, rtol=1e-12)
    assert recording.rate == pytest.approx(rate, rel=1e-4)
    # A gap begins and ends at rounded times.
    assert [gap.samples for gap in recording.gaps] == pytest.approx(lost, abs=1.0)


def test_rows_of_sensors_that_comments_name(written):
    """Rows of GnssLogger begin with the name of a sensor, or of others with more or fewer columns."""
    lines = ["# Version: v3.0.6.4", "# ", "# Raw,utcTimeMillis,TimeNanos,LeapSecond", "# "]
    units = {"Accel": ("Mps2", "Bias"), "Gyro": ("RadPerSec", "Drift")}
    for sensor, (unit, offset) in units.items():
        names = [f"{name}{axis}{unit}" for name in (f"Uncal{sensor}", offset) for axis in "XYZ"]
        lines.append(",".join([f"# Uncal{sensor},utcTimeMillis,elapsedRealtimeNanos", *names]))
    for k, rows in enumerate(zip(ACCEL.tolist(), GYRO.tolist(), strict=True)):
        t = f"{1709640000000 + 10 * k},{98765432100 + 10_000_000 * k}"
        lines += [
            f"Uncal{sensor},{t},{str(row)[1:-1]},0.1,0.2,0.0" for sensor, row in zip(units, rows, strict=True)
        ]
        lines += [f"Raw,{1709640000000 + 10 * k},12345,18", f"Raw,{t},1,2,3,4,5,6,7,8"] * (k % 5 == 0)
    path = written(lines, "gnss_log.txt")
    with pytest.raises(aj.RecordingError, match=r"rows of gyro and accel alternate.*columns='gyro'"):
        aj.read(path)
    is_right(aj.read(path, columns="gyro"), GYRO)
    recording = is_right(aj.read(path, columns="accel"), ACCEL, SIX[3:])
    assert noted(recording, "left out: 160 lines of other messages")


def test_decoded_frames_of_a_bus(written):
    """Names, values and units behind a frame are read, whose bytes vary; other messages are left out."""
    lines = []
    for k, (x, y, z) in enumerate(GYRO.tolist()):
        frame = f" ({1709640000 + k / RATE:.6f})  can0  174   [8]  00 8{k % 10} A{k % 7} 80 00 00 00 00 :: "
        lines += [f"{frame}IMU_GYRO(GyroX: {x} deg/s, GyroY: {y} deg/s, GyroZ: {z} deg/s)"]
        lines += [f"{frame.replace('174', '178')}STATE(Volt: {12 + k % 3} V)"]
    recording = is_right(aj.read(written(lines, "candump.log")))
    assert noted(recording, "left out: 400 lines of other messages")


@pytest.mark.parametrize("name", ["stacked.csv", "stacked.csv.gz"])
def test_a_table_below_another_is_named_with_what_reads_it(tmp_path, name):
    """Each sensor has a table of its own; the command in the note writes the second one."""
    lines = []
    for sensor, unit, samples in (("A", "g", ACCEL), ("G", "deg/s", GYRO)):
        lines += [f"[{sensor}]", ",".join(["Time [us]", *(f"{sensor}_{axis} [{unit}]" for axis in "XYZ")])]
        lines += [f"{10_000 * k},{str(row)[1:-1]}" for k, row in enumerate(samples.tolist())]
    content = "\n".join([*lines, ""]).encode()
    path = tmp_path / name
    path.write_bytes(gzip.compress(content) if name.endswith("gz") else content)
    recording = is_right(aj.read(path), ACCEL * G0, SIX[3:])
    (note,) = (note for note in recording.notes if "another table" in note)
    assert "from line 404 on, 'Time [us],G_X [deg/s]," in note
    subprocess.run(note.partition("run ")[2], shell=True, check=True, cwd=tmp_path)
    is_right(aj.read(tmp_path / "table-404.csv"))


def test_sensors_side_by_side_with_times_of_their_own(written):
    """Names that the message proposes read each sensor up to its last row, where the other one goes on."""
    names = [
        f"X [s],IM 1: {sensor}.{axis} 1 [{unit}]"
        for sensor, unit in (("Acc", "g"), ("Gyro", "deg/s"))
        for axis in "XYZ"
    ]
    lines = [",".join(names)]
    for k in range(N):
        cells = [f"{k / RATE},{x}" for x in ACCEL[k]]
        lines.append(
            ",".join([*cells, *([f"{2 * k / RATE},{x}" for x in GYRO[k]] if k < 200 else [","] * 3)])
        )
    path = written(lines)
    accel, gyro = "time,accel_x,-,accel_y,-,accel_z,-,-,-,-,-,-", "-,-,-,-,-,-,time,gyro_x,-,gyro_y,-,gyro_z"
    refused(path, f"several columns are called 'X [s]'|columns='{accel}'|columns='{gyro}'")
    is_right(aj.read(path, columns=accel), ACCEL * G0, SIX[3:])
    is_right(aj.read(path, columns=gyro), GYRO[:200] * DEG, rate=RATE / 2)
