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


SIX_AXES = np.hstack([GYRO, ACCEL])
# Names without units of three rates, and of three accelerations beside them if these are needed.
UNITLESS = {
    "Linux": (["in_anglvel_x_raw", "in_anglvel_y_raw", "in_anglvel_z_raw"], "in_accel_{}_raw"),
    "short Linux": (["anglvel_x", "anglvel_y", "anglvel_z"], "accel_{}"),
    "body rates": (["p", "q", "r"], "a{}"),
    "body rates alone": (["p", "q", "r"], ""),
    "of angles": (["roll_rate", "pitch_rate", "yaw_rate"], "f{}"),
    "in one word": (["rollRate", "pitchRate", "yawRate"], ""),
    "derivatives": (["droll", "dpitch", "dyaw"], "acc_{}"),
    "rates": (["rate_x", "rate_y", "rate_z"], "acc_{}"),
    "Spanish": ([f"velocidad angular {axis}" for axis in "xyz"], "aceleración_{}"),
    "French": ([f"vitesse_angulaire_{axis}" for axis in "xyz"], "accélération_{}"),
    "Italian": ([f"Velocità angolare {axis}" for axis in "XYZ"], "Accelerazione {}"),
    "German": ([f"Winkelgeschwindigkeit {axis}" for axis in "XYZ"], "Beschleunigung {}"),
    "Chinese": ([f"角速度{axis}" for axis in "XYZ"], "加速度{}"),
}


@pytest.mark.parametrize("how", UNITLESS)
def test_names_that_tell_the_sensor_without_a_unit(tmp_path, read, how):
    """A rate by its name is never an auxiliary channel: its unit is asked for."""
    names, other = UNITLESS[how]
    header = ["time [s]", *names, *(other.format(axis) for axis in "xyz" if other)]
    lines = [",".join(header), *(",".join(map(str, row[: len(header)])) for row in timed(SIX_AXES))]
    (tmp_path / "log.csv").write_text("\n".join(lines), encoding="utf-8")
    units = {"gyro_unit": "deg/s", **({"accel_unit": "g"} if other else {})}
    refused(tmp_path / "log.csv", f"{names[0]}|gyro_unit=", aj.UnitError)
    is_right(read(lines, **units), ACCEL if other else None)
    is_right(read(lines, columns="gyro", gyro_unit="deg/s"))


def timed(values):
    return [(k / RATE, *row) for k, row in enumerate(values.tolist())]


@pytest.mark.parametrize(
    "name",
    [
        *(f"gyro_{{}}_{unit}" for unit in ("degs", "degps", "degpersec", "deg_per_s", "dps")),
        *("gyr{}_degs", "GyroX_DegPerSec".replace("X", "{}"), "ω{}_degps"),
        *(f"gyro_{{}}_{unit}" for unit in ("rads", "radps", "radpersec", "rad_per_sec", "rps", "rad_s")),
    ],
)
def test_units_at_the_end_of_names(read, name):
    """A gyro whose unit is not told apart from its name would be no axis beside accelerometers."""
    in_rad = "rad" in name or "rps" in name
    values = np.hstack([GYRO * DEG if in_rad else GYRO, ACCEL])
    header = ["t_s", *(name.format(axis) for axis in "xyz"), *(f"acc_{axis}_g" for axis in "xyz")]
    is_right(read([",".join(header), *(",".join(map(str, row)) for row in timed(values))]), ACCEL)


def test_angles_with_units_at_the_end_of_names_are_no_rates(read):
    header = [*("t_s", "gyro_x_dps", "gyro_y_dps", "gyro_z_dps"), *("roll_rads", "pitch_rads", "yaw_rads")]
    lines = [",".join(header), *(",".join(map(str, row)) for row in timed(SIX_AXES))]
    assert [*is_right(read(lines)).auxiliary] == header[4:]


ACCEL_G, GYRO_DEG = [f"a{axis} [g]" for axis in "xyz"], [f"g{axis} [deg/s]" for axis in "xyz"]
# Names of three columns beside accelerometers or a gyro that do not tell what these are, and some that do.
UNTOLD = [
    *(["foo_x", "foo_y", "foo_z"], ["foo[0]", "foo[1]", "foo[2]"], ["u0 [LSB]", "u1 [LSB]", "u2 [LSB]"]),
    *(["gyro_roll", "gyro_pitch", "gyro_yaw"], ["x", "y", "z"], ["xrot", "yrot", "zrot"]),
]
TOLD = [
    *(["mx", "my", "mz"], ["mag_x", "mag_y", "mag_z"], ["u_x [uT]", "u_y [uT]", "u_z [uT]"]),
    *(["roll", "pitch", "yaw"], ["q_x", "q_y", "q_z"], ["euler_x", "euler_y", "euler_z"]),
    *(["gravity_x", "gravity_y", "gravity_z"], ["temp0", "temp1", "temp2"], ["one", "two", "three"]),
    *(["pos.x", "pos.y", "pos.z"], ["vel_x", "vel_y", "vel_z"], ["gyro_temp", "gyro_status", "gyro_id"]),
]


@pytest.mark.parametrize("names", UNTOLD)
@pytest.mark.parametrize("recognised", [ACCEL_G, GYRO_DEG])
def test_three_columns_beside_one_sensor_are_never_left_out_in_silence(tmp_path, names, recognised):
    """The message names both ways: they are the other sensor, or the one that is recognised is read alone."""
    is_accel = recognised is ACCEL_G
    if not is_accel and names[0].startswith("gyro"):
        names = [name.replace("gyro", "foo") for name in names]
    header = ["time [s]", *recognised, *names, "temp"]
    values = np.hstack([ACCEL, GYRO, GYRO[:, :1]] if is_accel else [GYRO, ACCEL, GYRO[:, :1]])
    path = tmp_path / "log.csv"
    path.write_text("\n".join([",".join(header), *(",".join(map(str, row)) for row in timed(values))]))
    other = SIX[:3] if is_accel else SIX[3:]
    both = ",".join([*header[:4], *other, "-"])
    alone = "accel" if is_accel else "gyro"
    told = f"{names[0]}|columns='{both}'|(--columns '{both}')|columns='{alone}'|(--columns {alone})"
    refused(path, told)
    recording = aj.read(path, columns=both, gyro_unit="deg/s", accel_unit="g")
    np.testing.assert_allclose(recording["gyro"].values, GYRO * DEG, rtol=1e-12)
    np.testing.assert_allclose(recording["accel"].values, ACCEL * G0, rtol=1e-12)
    assert aj.read(path, columns=alone).names == (SIX[3:] if is_accel else SIX[:3])
    # What never changes has no samples of a sensor.
    path.write_text(
        "\n".join([",".join(header), *(",".join(map(str, [*row[:4], 0, 0, 0, 1])) for row in timed(values))])
    )
    assert [*aj.read(path).auxiliary] == [*(name.partition(" ")[0] for name in names), "temp"]


@pytest.mark.parametrize("names", TOLD)
def test_what_names_or_units_say_is_read_beside_one_sensor(read, names):
    header = ["time [s]", *ACCEL_G, *names]
    rows = [",".join(map(str, row)) for row in timed(np.hstack([ACCEL, GYRO]))]
    recording = read([",".join(header), *rows])
    assert recording.names == SIX[3:]
    assert [*recording.auxiliary] == [name.partition(" ")[0] for name in names]


def test_a_name_that_begins_with_gyro_beside_a_gyro_is_noted(read):
    header = ["time [s]", *GYRO_DEG, "gyro_total"]
    lines = [",".join(header), *(",".join(map(str, row[:5])) for row in timed(SIX_AXES))]
    assert noted(is_right(read(lines)), "'gyro_total' read beside the axes")


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


MPU = np.random.default_rng(5).normal([150, -90, 16_400, 37, -39, 20], 30.0, (N, 6)).round().astype(int)


@pytest.mark.parametrize("names", ["a/g", "a/g/m"])
@pytest.mark.parametrize("stamp", [lambda k: "", lambda k: f"{clock(k)} -> "])
def test_counts_of_the_examples_for_mpu6050(tmp_path, read, names, stamp):
    """Accelerometers, gyros and a magnetometer without units, of which g is none."""
    other = "\t7\t8\t9" if names.endswith("m") else ""
    tail = ["\t".join(map(str, row)) for row in MPU.tolist()]
    lines = ["Initializing I2C devices...", "MPU6050 connection successful"]
    lines += [f"{stamp(k)}{names}:\t{row}{other}" for k, row in enumerate(tail)]
    (tmp_path / "mpu.log").write_text("\n".join(lines))
    refused(tmp_path / "mpu.log", "accel_unit='g/16384'|gyro_unit=|'deg/s/131'", aj.UnitError)
    rate = {} if stamp(0) else {"rate": RATE}
    recording = read(lines, "mpu.log", accel_unit="g/16384", gyro_unit="deg/s/131", **rate)
    assert (recording.names, recording.rate) == (SIX[3:] + SIX[:3], pytest.approx(RATE))
    np.testing.assert_allclose(recording["accel"].values, MPU[:, :3] * G0 / 16384, rtol=1e-12)
    np.testing.assert_allclose(recording["gyro"].values, MPU[:, 3:] * DEG / 131, rtol=1e-12)


CHINESE = ["时间", *(f"角速度{x}(°/s)" for x in "XYZ"), *(f"加速度{x}(g)" for x in "XYZ"), "温度(℃)"]


def test_chinese_names_in_their_encoding(tmp_path):
    """With a line before them; the same text in UTF-8 is read alike, without a note."""
    path = tmp_path / "维特.txt"
    rows = ["\t".join(map(str, [f"2024-03-05 {clock(k)}", *x, 25.0])) for k, x in enumerate(SIX_AXES)]
    text = "\n".join(["开始时间： 2024-03-05 12:00:00", "\t".join(CHINESE), *rows, ""])
    for encoding in ("gb18030", "utf-8"):
        path.write_bytes(text.encode(encoding))
        recording = is_right(aj.read(path), ACCEL)
        assert noted(recording, "GB18030") == (encoding == "gb18030")
        assert [*recording.auxiliary] == ["温度"]


@pytest.mark.parametrize(
    ("encoding", "first", "unit"),
    [("latin-1", "Température", "°/s"), ("latin-1", "Größe µT", "°/s"), ("cp1251", "Гироскоп", "deg/s")],
)
def test_other_encodings_are_not_chinese(tmp_path, encoding, first, unit):
    path = tmp_path / "log.csv"
    header = [first, "time [s]", *(f"Gyro {axis} [{unit}]" for axis in "XYZ")]
    rows = [",".join(map(str, [k % 7, *x])) for k, x in enumerate(timed(GYRO))]
    path.write_bytes("\n".join([",".join(header), *rows]).encode(encoding))
    recording = is_right(aj.read(path))
    assert not noted(recording, "GB18030")
    assert [*recording.auxiliary] == [first.encode(encoding).decode("latin-1")]


@pytest.mark.parametrize("mark", ["%", "#"])
@pytest.mark.parametrize("letter", ["", "gyro_"])
def test_names_and_units_in_comments_above_the_data(read, mark, letter):
    """In two lines of a head of several, as a program for fibre-optic gyros writes them."""
    names = [letter + x for x in ("pqr" if not letter else "xyz")]
    lines = ["FOG IMU static test, serial 0042", f"week TOW {' '.join(names)} fx fy fz temp"]
    lines += [f"[-]  [s]  {'[deg/h] ' * 3} {'[ug] ' * 3} [-]", "end of the head"]
    rows = np.hstack([GYRO * 3600.0, ACCEL * 1e6]).tolist()
    data = [f"2304 {302_400 + k / RATE:.2f} {' '.join(map(str, row))} 25" for k, row in enumerate(rows)]
    recording = read([*(f"{mark} {line}" for line in lines), *data], "log.dat")
    assert [axis.unit for axis in recording.axes] == [*["deg/h"] * 3, *["µg"] * 3]
    is_right(recording, ACCEL)


def test_proposed_columns_name_one_clock_and_the_axes_by_their_letters(read):
    """As Sensor Logger writes a file of one sensor: two clocks, and z, y, x."""
    rows = [
        f"{1_690_000_000_000_000_000 + 10_000_000 * k},{k / RATE},{z},{y},{x}" for k, (x, y, z) in SAMPLES
    ]
    lines = ["time,seconds_elapsed,z,y,x", *rows]
    with pytest.raises(aj.RecordingError, match="gyro_z,gyro_y,gyro_x") as error:
        read(lines)
    columns = re.search(r"columns='(.*?)'", str(error.value))[1]
    assert columns.split(",").count("time") == 1
    found = read(lines, columns=columns, gyro_unit="deg/s")
    is_right(found.select(*SIX[:3]))


@pytest.mark.parametrize("names", ["sec,ms", "Sec,Ms"])
def test_seconds_and_milliseconds_are_one_clock(read, names):
    """Also if seconds begin again each minute; of four seconds one is missing."""
    kept = [(k + 5_900, row) for k, row in SAMPLES if not 150 <= k < 250]
    rows = [f"{k // 100 % 60},{k % 100 * 10},{','.join(map(str, row))}" for k, row in kept]
    lines = [f"{names},gx [deg/s],gy [deg/s],gz [deg/s]", *rows]
    with pytest.raises(aj.RecordingError, match="gap of 1"):
        read(lines)
    found = read(lines, gaps="fill")
    assert (found.n, found.rate) == (N, pytest.approx(RATE, rel=1e-6))
