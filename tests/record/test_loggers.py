"""Text as spreadsheets of other countries, phones, terminals and databases write it, and the same samples."""

import json
import re
import subprocess

import numpy as np
import pytest
from imu_columns import DEG, G0, SIX, noted, refused

import allanjax as aj

N, RATE = 400, 100.0
GYRO = np.random.default_rng(3).normal([0.1, -0.2, 0.05], 0.08, (N, 3)).round(5)
ACCEL = np.random.default_rng(4).normal([0.01, -0.02, 1.003], 0.002, (N, 3)).round(5)
STEP = np.arange(N)
GERMAN = [f"Gyro {axis} [°/s]" for axis in "XYZ"]


def clock(k, start=43_200.0, digits=3):
    """Time of the day of a sample."""
    s = start + k / RATE
    return f"{int(s // 3600) % 24:02d}:{int(s // 60) % 60:02d}:{s % 60:0{3 + digits}.{digits}f}"


@pytest.fixture
def read(tmp_path):
    def read(lines, name="log.csv", **options):
        path = tmp_path / name
        path.write_text("\n".join([*lines, ""]), encoding="utf-8")
        return aj.read(path, **options)

    return read


def is_right(recording, accel=None, rate=RATE, n=N):
    """All samples of the gyros in deg/s, and of the accelerometers in g if there are any; and the rate."""
    assert (recording.n, recording.rate) == (n, pytest.approx(rate, rel=1e-6))
    truth = GYRO * DEG if accel is None else np.hstack([GYRO * DEG, accel * G0])
    np.testing.assert_allclose(recording.values, truth[:n], rtol=1e-12)
    assert recording.names == SIX[: truth.shape[1]]
    return recording


def cells(mark, names, first, values, last=None, quote=""):
    """Lines of names and of cells with decimal commas between marks, with a cell before and one behind."""
    lines = [names, *([first(k), *map(str, row), *([] if last is None else [last])] for k, row in values)]
    return [mark.join(quote + re.sub(r"\.(?=\d+$)", ",", cell) + quote for cell in line) for line in lines]


SAMPLES = list(enumerate(GYRO.tolist()))
# What the first cell of a line is, and the name of its column.
FIRST = {
    "Uhrzeit": lambda k: clock(k, 86_398.0),
    "Datum": lambda k: f"01.03.2024 {clock(k)}",
    "Zeitstempel": lambda k: f"2024-03-01 {clock(k)}",
    "Horodatage": lambda k: f"01/03/2024 {clock(k)}",
    "zeit": lambda k: f"{k / RATE:.3f}",
    "tiempo": lambda k: f"{k / RATE:.3f}",
    "Temps [ms]": lambda k: str(10 * k),
}


@pytest.mark.parametrize("mark", [";", "\t"])
@pytest.mark.parametrize("name", FIRST)
def test_decimal_commas_beside_dates_and_words(read, name, mark):
    for last in ([], ["OK"]):
        lines = cells(mark, [name, *GERMAN, *last], FIRST[name], SAMPLES, *last)
        assert noted(is_right(read(lines)), "decimal commas")
    is_right(read(cells(mark, [name, *GERMAN], FIRST[name], SAMPLES, quote='"')))


def test_decimal_commas_in_quotes_between_commas(read):
    is_right(read(cells(",", ["zeit", *GERMAN], FIRST["zeit"], SAMPLES, quote='"')))


def test_a_clock_in_seconds_beside_its_milliseconds(read):
    """The finer column tells the times."""
    is_right(
        read(cells(";", ["Uhrzeit", "ms", *GERMAN], lambda k: f"{clock(k)[:8]};{10 * k % 1000}", SAMPLES))
    )


def test_times_under_any_name_and_units_behind_names(read):
    """Text that is a date and a time, unless it is always the same; `in deg/s` and `, deg/s`."""
    names = [f"gyro_{axis} in °/s" for axis in "xyz"]
    lines = [",".join(["saved", "logged", *names])]
    lines += [f"2024-03-01 10:00:00,2024-03-01 {clock(k)},{x},{y},{z}" for k, (x, y, z) in SAMPLES]
    is_right(read(lines))
    # A rate that is given wins.
    is_right(read(lines, rate=50.0), rate=50.0)
    quoted = ",".join(f'"{name}"' for name in ("Time, s", *(f"Gyro {axis}, deg/s" for axis in "XYZ")))
    is_right(read([quoted, *(f"{k / RATE},{x},{y},{z}" for k, (x, y, z) in SAMPLES)]))


UNUSUAL = "2024-03-01 12-00-{:02d}_{:03d}"


@pytest.mark.parametrize("unusual", [UNUSUAL, "2024-03-01 12:00:{:02d}:{:03d}"])
def test_an_unusual_date_beside_named_columns_is_text(read, unusual):
    names = ["GYROSCOPE X (deg/s)", "GYROSCOPE Y (deg/s)", "GYROSCOPE Z (deg/s)"]
    lines = ["sep=;", ";".join([*names, "Time since start in ms ", "YYYY-MO-DD HH-MI-SS_SSS"])]
    lines += [f"{x};{y};{z};{10 * k};{unusual.format(*divmod(10 * k, 1000))}" for k, (x, y, z) in SAMPLES]
    assert noted(is_right(read(lines)), "not numeric", unusual.format(0, 0))


def test_rows_that_differ_in_digits_of_words_are_not_left_out(tmp_path):
    """Without a header each would be a message of another kind."""
    path = tmp_path / "log.csv"
    rows = [f"{x};{y};{z};{10 * k};{UNUSUAL.format(0, 10 * (k % 20))}" for k, (x, y, z) in SAMPLES]
    path.write_text("\n".join(rows))
    refused(path, "no rows of 6 numbers", columns="gyro_x,gyro_y,gyro_z,time [ms],-,-", gyro_unit="deg/s")


@pytest.mark.parametrize("mark", [",", " "])
def test_markers_of_missing_values(tmp_path, mark):
    """All are told in the first message, as values that can be filled in."""
    path, markers = tmp_path / "log.csv", ["--", "-", "n/a", "none", "nil", "*", "NaN", "#N/A", "null"]
    lines = [mark.join([f"{k / RATE:.2f}", *map(str, row)]) for k, row in SAMPLES]
    places = 30 * np.arange(1, len(markers) + 1)
    for place, marker in zip(places, markers, strict=True):
        lines[place] = mark.join([f"{place / RATE:.2f}", marker, *map(str, GYRO[place, 1:])])
    path.write_text("\n".join([mark.join(["time[s]", *(f"gyro_{axis}[deg/s]" for axis in "xyz")]), *lines]))
    refused(path, "line 32|and 8 more|a marker such as --|gaps='fill'")
    recording = aj.read(path, gaps="fill")
    assert np.flatnonzero(recording.missing[:, 0]).tolist() == places.tolist()
    np.testing.assert_allclose(recording.values[:, 1:], GYRO[:, 1:] * DEG, rtol=1e-12)


def test_commas_between_thousands(read):
    """In quotes; they are no decimal commas with three digits behind each, and digits but zeros in front."""
    milli = (1000.0 * ACCEL).round(2)
    header = ",".join(
        ["time (ms)", *(f"g{axis} (dps)" for axis in "xyz"), *(f"a{axis} (mg)" for axis in "xyz")]
    )
    for times in (10 * STEP, 10 * STEP + 4_990_000):
        lines = [header]
        for k, (rates, forces) in enumerate(zip(GYRO.tolist(), milli.tolist(), strict=True)):
            texts = [f"{times[k]:,}", *map(str, rates), *(f"{x:,.2f}" for x in forces)]
            lines.append(",".join(f'"{text}"' if "," in text else text for text in texts))
        recording = is_right(read(lines), milli / 1000.0)
        assert noted(recording, "thousands")


def test_a_command_that_leaves_lines_out_does_so(tmp_path):
    """It writes to another file than it reads; where it would not help, there is none."""
    rows = [f"imu {k} ({x}) [{y}] <{z}>" for k, (x, y, z) in SAMPLES]
    words = ["".join(chr(97 + int(digit)) for digit in str(k)) for k in STEP]
    for name, begin, helps in (("rows.txt", "what is", True), ("log.txt", "imu", False)):
        path = tmp_path / name
        path.write_text("\n".join([f"{begin} {words[k]}" if k % 9 == 4 else rows[k] for k in STEP]))
        message = str(refused(path, "no rows of 4 numbers", columns="-,gyro_x,gyro_y,gyro_z"))
        found = re.search(r"run (grep .*? '?/\S+?'?) > (\S+)$", message)
        assert (found is not None) == helps
        if found:
            assert found[2] != name
            done = subprocess.run(found[1], shell=True, capture_output=True, text=True, check=True)
            path.write_text(done.stdout)
            recording = aj.read(path, columns="-,gyro_x,gyro_y,gyro_z", gyro_unit="deg/s", rate=RATE)
            assert recording.n == len([k for k in STEP if k % 9 != 4])


@pytest.mark.parametrize("offset", [" +0100", "+01:00", "Z"])
def test_an_offset_after_a_blank(read, offset):
    lines = ["time," + ",".join(f"gyro_{axis} [deg/s]" for axis in "xyz")]
    lines += [f"2024-03-01T{clock(k)}{offset},{x},{y},{z}" for k, (x, y, z) in SAMPLES]
    assert is_right(read(lines)).begun == 1_709_294_400 - 3600 * ("1" in offset)


def of_influx(times, series=("gyro_x", "gyro_y", "gyro_z")):
    """Annotated CSV of InfluxDB: one row per value, one field after another."""
    lines = [
        "#datatype,string,long,dateTime:RFC3339,double,string",
        "#default,_result,,,,",
        ",result,table,_time,_value,_field",
    ]
    for place, name in enumerate(series):
        values = GYRO[:, "xyz".index(name[-1])].tolist()
        lines += [f",,{place},2024-03-01T{t}Z,{x},{name}" for t, x in zip(times, values, strict=True)]
    return lines


def test_a_long_table_of_a_database(read, tmp_path):
    """Times in their order, also where a whole second has no decimals; one value of a field at a time."""
    times = [clock(k).removesuffix(".000") for k in STEP]
    recording = is_right(read(of_influx(times), gyro_unit="deg/s"))
    assert noted(recording, "long table: 1,200 rows", "gyro_x, gyro_y, gyro_z")
    path = tmp_path / "two.csv"
    path.write_text("\n".join(of_influx(times, ("gyro_x", "gyro_y", "gyro_y"))))
    refused(path, "'gyro_y' at 2024-03-01T12:00:00Z|line 804|export one", gyro_unit="deg/s")


def test_what_has_to_be_converted_first_is_named(tmp_path):
    path = tmp_path / "log.txt"
    for frame in ("0F1#0011FFF0000900F4", " 0F1   [8]  00 11 FF F0 00 09 00 F4"):
        path.write_text("\n".join(f"(1709290800.{k:06d}) vcan0 {frame}" for k in STEP))
        refused(path, "raw frames of a CAN bus|DBC")
    counts = np.rint(GYRO * 131.0).astype(int)
    path.write_text("\n".join(" ".join(f"0x{x % 65536:04X}" for x in row) for row in counts.tolist()))
    message = str(refused(path, "hexadecimal"))
    command = re.search(r"perl .*(?= > decimal.txt$)", message)
    assert command is not None
    done = subprocess.run(command[0], shell=True, capture_output=True, text=True, check=True)
    path.write_text(done.stdout)
    recording = aj.read(path, gyro_unit="deg/s/131", rate=RATE)
    np.testing.assert_allclose(recording.values, counts * DEG / 131.0, rtol=1e-12)


# Names of three rates and three accelerations, which are told by them alone or by their units.
NAMED = {
    "Arduino": ["GyX", "GyY", "GyZ", "AcX", "AcY", "AcZ"],
    "a unit": ["imu0_gx", "imu0_gy", "imu0_gz", "imu0_ax", "imu0_ay", "imu0_az"],
    "axes first": ["X Gyro", "Y Gyro", "Z Gyro", "X Accel", "Y Accel", "Z Accel"],
    "German": [f"{name} {axis}" for name in ("Drehrate", "Beschleunigung") for axis in "XYZ"],
    "rates": ["Rollrate", "Pitchrate", "Yawrate", "LongAcc", "LatAcc", "VertAcc"],
    "letters": ["p", "q", "r", "Fx", "Fy", "Fz"],
}


@pytest.mark.parametrize("how", NAMED)
def test_axes_of_any_names_are_x_y_and_z(read, how):
    """So that gravity verifies the unit."""
    rows = [
        f"{k / RATE},{','.join(map(str, row))}" for k, row in enumerate(np.hstack([GYRO, ACCEL]).tolist())
    ]
    units = np.repeat(["deg/s", "g"], 3)
    lines = [",".join(["time [s]", *(f"{x} [{u}]" for x, u in zip(NAMED[how], units, strict=True))]), *rows]
    recording = is_right(read(lines), ACCEL)
    assert noted(recording, f"gyro_x from '{NAMED[how][0]}", f"accel_z from '{NAMED[how][5]}")


def test_two_units_in_a_table_keep_their_names(read):
    names = [f"imu{unit}_g{axis}_dps" for unit in (0, 1) for axis in "xyz"]
    lines = [",".join(["t_s", *names])]
    lines += [f"{k / RATE},{x},{y},{z},{z},{x},{y}" for k, (x, y, z) in SAMPLES]
    assert read(lines).names == tuple(names)
    is_right(read(lines, columns=",".join(names[:3])))


def test_columns_that_are_proposed_are_those_that_were_named(tmp_path):
    """The names that tell x, y and z, and what they may be; times first where that makes threes."""
    path = tmp_path / "log.csv"
    names = ["k", "Ax1", "fx", "fy", "fz", "hx", "hy", "hz", "level"]
    path.write_text(
        "\n".join([",".join(names), *(f"{k},1,{x},{y},{z},{x},{y},{z},1" for k, (x, y, z) in SAMPLES)])
    )
    proposed = "-,-,accel_x,accel_y,accel_z,gyro_x,gyro_y,gyro_z,-"
    refused(path, f"columns='{proposed}'|if fx, fy, fz, hx, hy, hz are these")
    recording = aj.read(path, columns=proposed, accel_unit="g", gyro_unit="deg/s", rate=RATE)
    np.testing.assert_allclose(recording["gyro"].values, GYRO * DEG, rtol=1e-12)
    np.save(tmp_path / "log.npy", np.column_stack([STEP / RATE, GYRO]))
    refused(tmp_path / "log.npy", "e.g. time,gyro_x,gyro_y,gyro_z")


TIMED = [f"{10 * k},{x},{y},{z}" for k, (x, y, z) in SAMPLES]


def esp(k, row, colour=("", "")):
    """A line of ESP-IDF's log."""
    x, y, z = row
    return f"{colour[0]}I ({330 + 10 * k}) IMU: gx={x} gy={y} gz={z} dps{colour[1]}"


def test_logs_of_esp_idf(read):
    """With their times, with or without colours; the unit behind the last axis is that of all."""
    boot = ["ESP-ROM:esp32s3-20210327", "I (24) boot: ESP-IDF v5.1.2 2nd stage bootloader"]
    for colour in (("", ""), ("\x1b[0;32m", "\x1b[0m")):
        is_right(read([*boot, *(esp(k, row, colour) for k, row in SAMPLES)]))


def test_units_that_were_decoded_twice(read):
    names = [
        f"{sensor} {axis} [{unit}]" for sensor, unit in (("Gyro", "Â°/s"), ("Acc", "m/sÂ²")) for axis in "XYZ"
    ]
    values = np.hstack([GYRO, (ACCEL * G0).round(5)])
    lines = [
        ",".join(["Time [s]", *names]),
        *(f"{k / RATE},{','.join(map(str, x))}" for k, x in enumerate(values)),
    ]
    recording = read(lines)
    np.testing.assert_allclose(recording.values, values * [*3 * [DEG], 1, 1, 1], rtol=1e-12)


# Comments before a table without units in its header, and the size of the unit of the gyros [deg/s].
COMMENTS = {
    "# gyro sensitivity: 131 LSB/(deg/s)": 1.0 / 131.0,
    "% gyro in mrad/s, acc in m/s/s": 1e-3 / DEG,
    "// acc in g and gyr in deg/s": 1.0,
    "# gyro_unit = dps": 1.0,
}


@pytest.mark.parametrize("comment", COMMENTS)
def test_units_in_comments(read, comment):
    lines = ["# bench log", comment, "t_ms,gx,gy,gz", *TIMED]
    recording = read(lines)
    np.testing.assert_allclose(recording.values, GYRO * DEG * COMMENTS[comment], rtol=1e-12)
    assert noted(recording, "gyros in", "where columns state none")
    labelled = [line.replace("gx,gy,gz", "gx_dps,gy_dps,gz_dps") for line in lines]
    is_right(read(labelled))


def test_a_range_in_a_comment_is_no_unit(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("\n".join(["# gyro range: 500 deg/s, gyro bias in deg/h", "t_ms,gx,gy,gz", *TIMED]))
    refused(path, "'gx' has no unit", aj.UnitError)


def test_units_beside_names_in_documents(tmp_path):
    """Keys of JSON: of a document, of objects in an array and of text in a message; arrays of NumPy."""
    columns = {f"gyro.{axis}": x.tolist() for axis, x in zip("xyz", GYRO.T, strict=True)}
    records = [{"t": k / RATE, "gyro": row, "gyro_unit": "dps"} for k, row in SAMPLES]
    payloads = [{"ts": 1_709_290_800_000 + 10 * k, "payload": json.dumps(x)} for k, x in enumerate(records)]
    texts = {
        "keys": json.dumps({"fs": RATE, "gyro_unit": "deg/s", **columns}),
        "an object": json.dumps({"fs": RATE, "units": {"gyro": "deg/s"}, **columns}),
        "records": json.dumps(records),
        "payloads": "\n".join(map(json.dumps, payloads)),
    }
    for name, text in texts.items():
        (path := tmp_path / f"{name}.json").write_text(text)
        is_right(aj.read(path, columns="ts,gyro" if name == "payloads" else None))
    np.savez(tmp_path / "log.npz", fs=RATE, gyro=GYRO, gyro_unit="deg/s")
    assert noted(is_right(aj.read(tmp_path / "log.npz")), "unit deg/s from 'gyro_unit'")


def test_attributes_of_hdf5(tmp_path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "log.h5", "w") as file:
        for name, values, key, unit in (("gyro", GYRO, "units", "deg/s"), ("time", STEP * 10, "unit", "ms")):
            file.create_dataset(f"run1/{name}", data=values).attrs[key] = unit
    is_right(aj.read(tmp_path / "log.h5"))
    np.testing.assert_allclose(np.concatenate([*aj.read_chunks(tmp_path / "log.h5", chunk=90)]), GYRO * DEG)


@pytest.mark.parametrize("timed", [True, False])
def test_labview(read, timed):
    """Units and interval are in the head; the times are there or not."""
    head = ["LabVIEW Measurement\t", "Separator\tTab", "***End_of_Header***\t", "\t", "Channels\t3\t\t\t\t"]
    head += ["Y_Unit_Label\tdeg/s\tdeg/s\tdeg/s\t", "Delta_X\t0.010000\t0.010000\t0.010000\t"]
    head += ["***End_of_Header***\t\t\t\t", "X_Value\tGyro X\tGyro Y\tGyro Z\tComment"]
    rows = ["\t".join([f"{k / RATE:.6f}" if timed else "", *map(str, row)]) for k, row in SAMPLES]
    assert noted(is_right(read([*head, *rows], "log.lvm")), "100 Hz from the line 'Delta_X")


def test_notes_count_in_plain_english(read):
    """What is left out or skipped, once and several times; a column without a name has its number."""
    header = ",gyro_x [deg/s],gyro_y [deg/s],gyro_z [deg/s]"
    for count, times, lines in ((1, "1 line", "'unit 7'"), (2, "2 lines", "the first is 'unit 7'")):
        rows = [*TIMED[:200], *[header] * count, *TIMED[200:300], *["torn line"] * count, *TIMED[300:]]
        recording = is_right(read([*["unit 7"] * count, header, *rows], rate=RATE))
        assert f"left out: {times} with the names again" in recording.notes
        assert f"skipped: {times} before the data, {lines}" in recording.notes
        assert noted(recording, f"left out: {times} without a row of numbers: line ", "'torn line'")
        assert "auxiliary: column 1" in recording.notes
    shown = [f"gx={x} gy={y} gz={z} deg/s" for _, (x, y, z) in SAMPLES]
    assert noted(read(shown, rate=RATE), "the rows are messages such as 'gx=")


def test_messages_with_the_same_axes_are_not_left_out(tmp_path):
    """A word that varies behind them makes them no other messages, which a log may have."""
    path = tmp_path / "log.txt"
    for states, others, words in (
        (["idle", "moving"], [], "line 2, 'gx=|is moving', has|and 198 more"),
        (["idle"], ["mag x=1"], ""),
    ):
        lines = []
        for k, (x, y, z) in SAMPLES:
            lines += [f"gx={x} gy={y} gz={z} is {states[k % len(states)]}", *others]
        path.write_text("\n".join(lines))
        if words:
            refused(path, words, gyro_unit="deg/s", rate=RATE)
        else:
            assert noted(is_right(aj.read(path, gyro_unit="deg/s", rate=RATE)), "400 lines of other messages")
