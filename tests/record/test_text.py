"""Text: delimiters, headers, comments, encodings, messages, devices, damage, columns, and time stamps."""

import gzip
import itertools
import json

import numpy as np
import pandas as pd
import pytest
from imu_columns import DEG, G0, HEADER, SIX, UNITS, noted, refused, rows, write_text

import allanjax as aj

N, RATE = 50, 100.0
NOISE = np.random.default_rng(1).normal(size=(N, 6)) + 0.2
STEP = np.arange(N)
EPOCH = 1_700_000_000
# Nanoseconds since 1970.
NS = EPOCH * 10**9 + STEP * 10**7
SI = NOISE * [*3 * [DEG], *3 * [G0]]


def check(recording, rate=RATE, close=1e-9):
    assert recording.names == SIX
    assert recording.rate == pytest.approx(rate, rel=close)
    np.testing.assert_allclose(recording.own_values, NOISE, rtol=1e-14)
    np.testing.assert_allclose(recording.values, SI, rtol=1e-14)


def commented(lines):
    return ["# recorded in the lab", "", *lines[:9], "# paused", "", *lines[9:]]


def european(lines):
    return ["sep=;", lines[0].replace(",", ";"), *(x.replace(",", ";").replace(".", ",") for x in lines[1:])]


MARKS = [", ", ";", "\t", " ", "   "]
# What is done to the lines of a file.
LINES = {
    "as it is": lambda x: x,
    **{f"by {m!r}": lambda x, m=m: [line.replace(",", m) for line in commented(x)] for m in MARKS},
    "header in a comment": lambda x: ["# static test", f"# {x[0]}", *x[1:]],
    "header in per cents": lambda x: [f"% {x[0]}", *x[1:]],
    "a delimiter at the end": lambda x: [f"{line}," for line in x],
    "comments amid data": commented,
    "names and values first": lambda x: ["Device,X9", "Serial,7", "Range,300", *x],
    "quotes after spaces": lambda x: [", ".join(f'"{cell}"' for cell in line.split(",")) for line in x],
    "°": lambda x: [x[0].replace("deg/s", "°/s"), *x[1:]],
    "decimal commas": european,
    "decimal commas in quotes": lambda x: [
        ";".join(f'"{cell}"' for cell in line.split(";")) for line in european(x)[1:]
    ],
    "a bar": lambda x: [line.replace(",", " | ") for line in [x[0], "---+---+---+---+---+---", *x[1:]]],
    "units below": lambda x: [",".join(SIX), ",".join(3 * ["(deg/s)"] + 3 * ["g"]), *x[1:]],
    "sensors above axes": lambda x: [
        "gyroscope,,,accelerometer,,",
        "X,Y,Z,X,Y,Z",
        ",".join(3 * ["deg/s"] + 3 * ["g"]),
        *x[1:],
    ],
    "sections": lambda x: ["[Unit]", "Device=X9", "", "[Data]", *x, "[Events]", "0.25,button,1"],
    "between marks": lambda x: ["DATA_START", *x, "DATA_END", "checksum 8a7b"],
    "names beyond the cells": lambda x: [f"{x[0]},comment", *x[1:]],
    "names again": lambda x: [*x[:30], x[0], *x[30:]],
    "a logger that starts again": lambda x: [*x[:30], "Brownout detector was triggered", *x[30:]],
    "another table above": lambda x: ["lat,lon", *9 * ["48.1,11.2"], "", *x],
    "another table below": lambda x: [*x, "", "time,lat,lon", *30 * ["1.0,48.1,11.2"]],
    "zeros of a loss of power": lambda x: [*x, "0.5,0.2" + 5000 * "\0"],
    "names after any mark": lambda x: [f"; {x[0]}", *x[1:]],
    "exponents of Fortran": lambda x: [x[0], *(line.replace("e-", "D-") for line in x[1:])],
}


@pytest.mark.parametrize("how", LINES)
def test_lines(tmp_path, how):
    path = tmp_path / "imu.csv"
    content = "\r\n".join(LINES[how]([",".join(HEADER), *rows(NOISE)]))
    for encoding in ("utf-8", "utf-8-sig", "latin-1", "utf-16"):
        path.write_bytes(content.encode(encoding))
        check(aj.read(path, rate=RATE))
    path = tmp_path / "imu.csv.gz"
    path.write_bytes(gzip.compress(content.encode()))
    check(recording := aj.read(path, rate=RATE))
    assert recording.name == "imu"


def test_a_file_without_a_header_or_cut_within_a_line(tmp_path):
    """A last line that is whole is read; one that is short though it ended is an error."""
    path, lines = tmp_path / "imu.txt", [",".join(HEADER), *rows(NOISE)]
    for mark, before in itertools.product([",", *MARKS], ([], ["# recorded in the lab", "% static", ""])):
        path.write_text("\n".join([*before, *rows(NOISE, mark=mark), ""]))
        check(aj.read(path, rate=RATE, **UNITS))
    for end in ("1.0,2.0", "1.0,2.", "1"):
        path.write_text("\n".join([*lines, end]))
        check(recording := aj.read(path, rate=RATE))
        assert noted(recording, repr(end))
        assert np.array_equal(np.concatenate([*aj.read_chunks(path, rate=RATE, chunk=N)]), recording.values)
        path.write_text("\n".join([*lines, end, ""]))
        refused(path, f"line {N + 2}", rate=RATE)


# Labels, the axis that each is, its unit and factor to SI.
AXES = {
    "gyro_x gyrox GyroX Gyr_X gx wx omega_x xgyro angular_velocity.x angular_rate_x": ("gyro_x", "deg/s"),
    "angular_velocity.y .angular_velocity.y w_RS_S_y gyroscope_y imu0_gyro_y": ("gyro_y", "deg/s"),
    "accel_z acc_z AccZ az linear_acceleration.z zacc a_RS_S_z specific_force_z": ("accel_z", "g"),
    "gyro_x_dps gyro_x[dps] gyro_x(deg/s)": ("gyro_x", "deg/s"),
    "gyro_x_radps gyro_x[rad/s]": ("gyro_x", "rad/s"),
    "accel_x_mg": ("accel_x", "mg"),
    "accel_x_ms2 accel_x_mps2": ("accel_x", "m/s²"),
    "dtheta_z delta_angle_z delta_theta_z": ("gyro_z", "deg"),
    "dv_z delta_velocity_z dvel_z delta_v_z": ("accel_z", "m/s"),
}
NO_AXES = "mag_x temp_gyro hAcc gyro_bias_x gyro_temp temperature max quat_x p gyro/bias/omega_y std_accel_z"
NO_AXES += " Sigma.AccX cov_gyro_1 angular_velocity_covariance[0] linear_acceleration_covariance_0"


def test_axes_are_recognised_by_their_labels(tmp_path):
    stated = ("dps", "s]", "s)", "radps", "mg", "ms2", "mps2")
    for labels, (name, unit) in AXES.items():
        for label in labels.split():
            path = write_text(tmp_path / "imu.csv", [label], NOISE[:, 0])
            given = {} if label.endswith(stated) else {f"{name.split('_')[0]}_unit": unit}
            recording = aj.read(path, rate=RATE, **given)
            assert (recording.names, recording.axes[0].unit) == ((name,), unit), label
    labels = NO_AXES.split()
    others = np.random.default_rng(4).normal(size=(N, len(labels)))
    path = write_text(tmp_path / "imu.csv", ["gx [deg/s]", *labels], NOISE[:, 0], others)
    recording = aj.read(path, rate=RATE)
    assert (recording.names, [*recording.auxiliary]) == (("gyro_x",), labels)
    np.testing.assert_array_equal(np.column_stack([*recording.auxiliary.values()]), others)


def test_stretches_columns_and_increments(tmp_path):
    path, six = tmp_path / "imu.csv", [*HEADER, "temp [degC]"]
    for columns, header in (([], six), ([9.0 + STEP / RATE], ["time [s]", *six])):
        # The sample at the stop is not in it; what is between two samples begins at the later one.
        write_text(path, header, *columns, NOISE, 20.0 + STEP)
        recording = aj.read(path, rate=RATE, start=0.1, stop=0.4)
        np.testing.assert_allclose(recording.own_values, NOISE[10:40])
        np.testing.assert_array_equal(recording.auxiliary["temp"], 20.0 + STEP[10:40])
        assert noted(recording, "10 to 39 of 50")
        between = aj.read(path, rate=RATE, start=0.101, stop=0.4001)
        np.testing.assert_allclose(between.own_values, NOISE[11:41])
    # By name, and by position.
    for choice in ("gyro_z,accel_x", ["gyro_z [deg/s]", "accel_x"], "GYRO_Z,ACCEL_X"):
        recording = aj.read(path, columns=choice)
        assert (recording.names, recording.rate) == (("gyro_z", "accel_x"), pytest.approx(RATE))
        np.testing.assert_allclose(recording.own_values, NOISE[:, [2, 3]])
    path.write_text("\n".join(rows(STEP / RATE, NOISE)))
    recording = aj.read(path, columns="time [s],gyro_z [deg/s],-,_,ax,-,temp", accel_unit="g")
    assert recording.names == ("gyro_z", "accel_x")
    np.testing.assert_allclose(recording.own_values, NOISE[:, [0, 3]])
    np.testing.assert_array_equal(recording.auxiliary["temp"], NOISE[:, 5])
    # The unit of a column that gets a name is that of its header, not of the one beside it.
    write_text(path, ["c0 [ms]", "p [deg/s]", "q [rad/s]", *"rstu"], STEP, NOISE)
    recording = aj.read(path, columns="-,gx,gy,-,-,-,-", rate=RATE)
    np.testing.assert_allclose(recording.values, NOISE[:, :2] * [DEG, 1.0], rtol=1e-14)
    # Increments are multiplied by the rate.
    header = [f"delta_angle_{a} [µrad]" for a in "xyz"] + [f"delta_velocity_{a} [mm/s]" for a in "xyz"]
    recording = aj.read(write_text(path, header, NOISE), rate=80.0)
    np.testing.assert_allclose(recording[SIX].values, NOISE * [*3 * [8e-5], *3 * [0.08]], rtol=1e-14)
    assert noted(recording, "gyro_x", "increments")


# Labels, stamps, and options; the rate is 100 Hz unless the options say another.
STAMPS = {
    "time [s]": (STEP / RATE, {}),
    "time_us": (STEP * 10_000, {}),
    "t": (STEP * 10.0, {"time_unit": "ms"}),
    "Time": (STEP * 10, {"rate": 100.4}),
    "time": (3.0 + STEP / RATE, {}),
    "timestamp": (EPOCH + STEP / RATE, {}),
    "time_stamp": (EPOCH * 1000 + STEP * 10, {}),
    "%time": (NS, {}),
    "field.header.stamp": (NS + 123, {}),
    "clock": (STEP / RATE, {"time": "clock", "time_unit": "s"}),
    **dict.fromkeys(("stamp.secs|stamp.nsecs", "sec|nanosec"), (np.stack(divmod(NS, 10**9), axis=1), {})),
}


def test_units_of_stamps(tmp_path):
    for label, (stamps, options) in STAMPS.items():
        path = write_text(tmp_path / "imu.csv", [*label.split("|"), *HEADER], stamps, NOISE)
        recording = aj.read(path, **options)
        # Seconds since 1970 as floats are 0.24 µs apart, of 0.49 s.
        check(recording, options.get("rate", RATE), 1e-6 if label == "timestamp" else 1e-9)
        assert not recording.auxiliary
        assert recording.jitter == pytest.approx(0.0, abs=1e-7)
        # Stamps that begin near zero tell no date.
        is_date = np.ravel(stamps)[0] >= EPOCH
        assert recording.begun == (pytest.approx(EPOCH, abs=1e-6) if is_date else None)
    # The seconds 0.1 and later.
    stamps, _ = STAMPS["sec|nanosec"]
    path = write_text(tmp_path / "imu.csv", ["stamp.secs", "stamp.nsecs", *HEADER], stamps, NOISE)
    assert aj.read(path, start=0.1).begun == pytest.approx(EPOCH + 0.1, abs=1e-6)


def test_the_rate_is_that_of_all_intervals_and_the_jitter_their_scatter(tmp_path):
    """Nanoseconds keep their digits: floats of this size are 256 ns apart, and the intervals alternate."""
    stamps = NS + np.where(STEP % 2, 50, -50)
    recording = aj.read(write_text(tmp_path / "imu.csv", ["timestamp_ns", *HEADER], stamps, NOISE))
    assert recording.jitter == pytest.approx(np.std(np.diff(stamps)) * 1e-9, rel=1e-6)
    assert recording.rate == pytest.approx(49e9 / (stamps[-1] - stamps[0]), rel=1e-12)
    # A counter that starts again is continued.
    for bits, unit, per_second in ((16, "ms", 1e3), (32, "us", 1e6), (24, "us", 1e6)):
        counts = np.round(np.arange(9000) / RATE * per_second).astype(int) + 2**bits - 12_345
        header = [f"time [{unit}]", "gx [deg/s]"]
        recording = aj.read(write_text(tmp_path / "imu.csv", header, counts % 2**bits, np.sin(counts)))
        assert recording.rate == pytest.approx(RATE, rel=1e-9)
        assert noted(recording, "starts again")


def test_what_ros_exports(tmp_path):
    columns = {"%time": NS + 300_000 * (STEP % 3), "field.header.seq": STEP, "field.header.stamp": NS}
    columns |= {"field.header.frame_id": "imu_link", "field.orientation.w": 1.0}
    columns |= {f"field.angular_velocity.{a}": NOISE[:, i] for i, a in enumerate("xyz")}
    columns |= {"field.angular_velocity_covariance0": 0.0}
    columns |= {f"field.linear_acceleration.{a}": NOISE[:, 3 + i] for i, a in enumerate("xyz")}
    pd.DataFrame(columns).to_csv(tmp_path / "imu.csv", index=False)
    check(recording := aj.read(tmp_path / "imu.csv", **UNITS))
    assert recording.jitter < 1e-9
    others = ("header.seq", "orientation.w", "angular_velocity_covariance0")
    assert [*recording.auxiliary] == [f"field.{name}" for name in others]
    assert noted(recording, "field.header.stamp", "%time")
    assert noted(recording, "field.header.frame_id", "imu_link", "line 2")
    # Dates.
    frame = pd.DataFrame({"when": pd.to_datetime(NS)} | dict(zip(HEADER, NOISE.T, strict=True)))
    frame.to_csv(tmp_path / "imu.csv", index=False)
    for path in (tmp_path / "imu.csv", tmp_path / "imu.parquet"):
        frame.to_parquet(tmp_path / "imu.parquet")
        check(recording := aj.read(path, time="when"))
        assert recording.begun == EPOCH


EUROC = ",".join(f"{x}_RS_S_{a} [{u} s^-{k}]" for x, u, k in (("w", "rad", 1), ("a", "m", 2)) for a in "xyz")
EUROC = f"#timestamp [ns],{EUROC}"


def test_euroc(tmp_path):
    for header, mark in ((EUROC, ","), (EUROC.replace("#", ""), ","), (EUROC.replace(",", " "), " ")):
        path, times = tmp_path / "imu.csv", 1_403_715_273_262_142_976 + 5_000_000 * STEP
        path.write_text("\n".join([header, *rows(times, NOISE, mark=mark), ""]))
        recording = aj.read(path)
        assert (recording.names, recording.rate) == (SIX, pytest.approx(200.0, rel=1e-12))
        np.testing.assert_array_equal(recording.values, NOISE)
        assert [axis.unit for axis in recording.axes] == [*3 * ["rad/s"], *3 * ["m/s²"]]


def vectornav(kind, before=(), after=()):
    """Lines of a message with fields about the samples, and their check sums."""
    lines = []
    for row in NOISE.round(6):
        body = ",".join([kind, *(f"{x:+.6f}" for x in (*before, *row[3:], *row[:3], *after))])
        lines.append(f"${body}*{np.bitwise_xor.reduce(np.frombuffer(body.encode(), np.uint8)):02X}")
    return lines


# Messages, and how many fields they have before the samples and after.
VECTORNAV = {"VNYMR": (6, 0), "VNQMR": (7, 0), "VNMAR": (3, 0), "VNIMU": (3, 2), "VNDTV": (1, 0)}


@pytest.mark.parametrize("kind", VECTORNAV)
def test_vectornav(tmp_path, kind):
    before, after = (k + np.arange(count) for k, count in zip((7.0, 31.0), VECTORNAV[kind], strict=True))
    lines = vectornav(kind, before, after)
    lines = [lines[0][30:], *(text for x in lines for text in (x, "$VNRRG,05,+1.0*00", "# a comment", ""))]
    (tmp_path / "imu.csv").write_text("\r\n".join(lines) + "\r\n")
    recording = aj.read(tmp_path / "imu.csv", rate=40.0)
    # Increments of angles [deg] come first.
    increments = ([*3 * [40.0 * DEG], *3 * [40.0]], [3, 4, 5, 0, 1, 2])
    scale, order = increments if kind == "VNDTV" else (1.0, slice(None))
    np.testing.assert_allclose(recording[SIX].values, NOISE.round(6)[:, order] * scale, rtol=1e-12)
    assert [x[0] for x in recording.auxiliary.values()] == [*before, *after]
    assert noted(recording, f"messages such as '${kind},")
    assert noted(recording, f"format of ${kind}")


def test_a_damaged_line_of_vectornav(tmp_path):
    path, lines = tmp_path / "imu.csv", vectornav("VNMAR", (1.0, 2.0, 3.0))
    whole = lines[40]
    digit = whole.replace(whole[20], "9" if whole[20] != "9" else "8", 1)
    for damaged in (digit, whole[:30], whole[15:], "x"):
        path.write_text("\n".join([*lines[:40], damaged, *lines[41:], ""]))
        refused(path, "line 41|start=", rate=40.0)
        assert aj.read(path, rate=40.0, stop=1.0).n == 40


def xor(body):
    return np.bitwise_xor.reduce(np.frombuffer(body.encode(), np.uint8))


STAMP = "2024-05-01 10:22:33.123"


def spelled(row, after=": ", mark=" ", units=("", "")):
    names = zip(("gx", "gy", "gz", "ax", "ay", "az"), row, np.repeat(units, 3), strict=True)
    return mark.join(f"{name}{after}{x!r}{unit}" for name, x, unit in names)


def yaml(row, k, ends="---"):
    parts = dict(zip(("angular_velocity", "linear_acceleration"), (row[:3], row[3:]), strict=True))
    lines = ["header:", "  stamp:", f"    sec: {NS[k] // 10**9}", f"    nanosec: {NS[k] % 10**9}"]
    lines += ["  frame_id: imu_link", "orientation:", *(f"  {x}: {float(x == 'w')}" for x in "xyzw")]
    for name, values in ({"orientation": ()} | parts).items():
        lines += [f"{name}:", *(f"  {a}: {x!r}" for a, x in zip("xyz", values, strict=False))]
        lines += [f"{name}_covariance:", *9 * ["- 0.0"]]
    return [*(x for x in lines if x != "orientation:" or lines.index(x) == 5), ends]


def imu_csv(row, k):
    return [
        *divmod(int(NS[k]), 10**9),
        "imu",
        0,
        0,
        0,
        1,
        *9 * [0.0],
        *row[:3],
        *9 * [0.0],
        *row[3:],
        *9 * [0.0],
    ]


def listed(row, brackets="[]", mark=", "):
    return brackets[0] + mark.join(map(repr, row)) + brackets[1]


def joined(values):
    return ",".join(map(repr, values))


# What a line holds for a sample of three rates and three accelerations, and its number.
MESSAGES = {
    "colons": lambda x, k: spelled(x),
    "equal signs and tabs": lambda x, k: spelled(x, after="=", mark="\t"),
    "commas and units": lambda x, k: spelled(x, mark=", ", units=(" deg/s", " g")),
    "clock and arrow": lambda x, k: f"10:22:{33 + k / 100:06.3f} -> {spelled(x)}",
    "level": lambda x, k: f"[INFO] [{EPOCH + k / 100:.3f}]: {spelled(x, after='=')}",
    "date": lambda x, k: f"{STAMP} INFO node - gyro={listed(x[:3], '()')} accel={listed(x[3:], '()')}",
    "units in brackets": lambda x, k: f"gyro [dps]: {listed(x[:3])} acc [g]: {listed(x[3:])}",
    "without marks": lambda x, k: (
        f"{k / 100} gyro {listed(x[:3], mark=' ')} accel {listed(x[3:], mark='  ')}"
    ),
    "structures": lambda x, k: f"I {{ g: 1, {spelled(x, mark=', ')} }}",
    "three after a name": lambda x, k: (
        f"Gyro X: {x[0]}, Y: {x[1]}, Z: {x[2]} deg/s | Accel X: {x[3]}, Y: {x[4]}, Z: {x[5]} g"
    ),
    "JSON": lambda x, k: json.dumps({"t": k / 100, "state": "OK" * (k % 3), "gyro": x[:3], "acc": x[3:]}),
    "flat JSON": lambda x, k: json.dumps({"time_ms": 10 * k, **dict(zip(SIX, x, strict=True))}),
    "nested JSON": lambda x, k: json.dumps(
        {"imu": {s: dict(zip("xyz", v, strict=True)) for s, v in (("gyro", x[:3]), ("accel", x[3:]))}}
    ),
    "JSON of lines": lambda x, k: json.dumps(dict(zip(SIX, x, strict=True)), indent=2),
    "kinds": lambda x, k: [
        f"IMU,{joined(x)}",
        *([f"GPS,48.1,11.2,{k}"] if k % 5 == 2 else []),
        *(["MAG 0.1 0.2"] if k % 7 == 1 else []),
    ],
    "lines of a sample": lambda x, k: [
        f"Gyro X: {x[0]}, Y: {x[1]}, Z: {x[2]} deg/s",
        f"Accel X: {x[3]}, Y: {x[4]}, Z: {x[5]} g",
        "",
    ],
    "sums": lambda x, k: f"$IMU,{joined(x)}*{xor(f'IMU,{joined(x)}'):02X}",
    "ros2 topic echo": yaml,
    "ros2 topic echo --csv": lambda x, k: joined(imu_csv(x, k)).replace("'", ""),
    "without a header": lambda x, k: joined(imu_csv(x, k)[3:]),
}


@pytest.mark.parametrize("how", MESSAGES)
def test_messages(tmp_path, how):
    """A header tells the names that messages lack; a boot message before them is skipped."""
    lines = ["# IMU,gx,gy,gz,ax,ay,az", "rst:0x1 (POWERON_RESET),boot:0x13"]
    for k, row in enumerate(NOISE.tolist()):
        made = MESSAGES[how](row, k)
        lines += [made] if isinstance(made, str) else made
    for end in ("\n", "\r\n"):
        (tmp_path / "imu.txt").write_text(end.join([*lines, ""]), newline="")
        check(aj.read(tmp_path / "imu.txt", rate=RATE, time=False, **UNITS))
        parts = aj.read_chunks(tmp_path / "imu.txt", rate=RATE, time=False, chunk=20, **UNITS)
        np.testing.assert_allclose(np.concatenate([*parts]), SI, rtol=1e-14)


def of_sensor(name, k, values, **more):
    return {"sensor": name, "time": int(NS[k]), **dict(zip("zyx", values[::-1], strict=True)), **more}


def records(make):
    return [make(k, row) for k, row in enumerate(NOISE.tolist())]


def three(x):
    return dict(zip("xyz", x, strict=True))


FLAT = records(lambda k, x: {"t": k / RATE, **dict(zip(SIX, x, strict=True))})
DOCUMENTS = {
    "an array in a line": json.dumps(FLAT),
    "an array in lines": "[\n" + ",\n".join(map(json.dumps, FLAT)) + "\n]",
    "indented": json.dumps(FLAT, indent=2),
    "numbers in quotes": json.dumps([{name: str(x) for name, x in record.items()} for record in FLAT]),
    "within an object": json.dumps({"device": "X9", "samples": FLAT}),
    "nested": json.dumps(
        records(lambda k, x: {"t": k / RATE, "gyro": x[:3], "imu": {"accel": three(x[3:])}})
    ),
    "arrays by name": json.dumps(
        {"rate": RATE, **{name: list(x) for name, x in zip(SIX, NOISE.T, strict=True)}}
    ),
    "matrices": json.dumps({"rate": RATE, "gyro": NOISE[:, :3].tolist(), "accel": NOISE[:, 3:].tolist()}),
}


@pytest.mark.parametrize("how", DOCUMENTS)
def test_json_documents(tmp_path, how):
    path = tmp_path / "imu.json"
    path.write_text(DOCUMENTS[how])
    check(aj.read(path, **UNITS))
    parts = aj.read_chunks(path, chunk=20, **UNITS)
    np.testing.assert_allclose(np.concatenate([*parts]), SI, rtol=1e-14)
    # What is cut off is no document; its lines are read as text.
    path.write_text(DOCUMENTS["an array in lines"][:-90])
    assert aj.read(path, **UNITS).n == N - 1


def test_json_of_phones_names_its_sensors(tmp_path):
    """Of two sensors one is read; with the values in an object of their own, too."""
    path = tmp_path / "imu.json"
    both = [
        of_sensor(name, k, x[k0:][:3])
        for k, x in enumerate(NOISE.tolist())
        for name, k0 in (("Gyroscope", 0), ("Accelerometer", 3))
    ]
    path.write_text(json.dumps(both))
    with pytest.raises(aj.RecordingError, match=r"gyro and accel.*columns='gyro'"):
        aj.read(path)
    recording = aj.read(path, columns="accel", accel_unit="g")
    np.testing.assert_allclose(recording[SIX[3:]].values, SI[:, 3:], rtol=1e-14)
    inner = [
        {"name": "gyroscope", "time": int(NS[k]), "values": three(x[:3])}
        for k, x in enumerate(NOISE.tolist())
    ]
    path.write_text("\n".join(map(json.dumps, inner)))
    recording = aj.read(path, gyro_unit="deg/s")
    assert (recording.names, recording.rate) == (SIX[:3], pytest.approx(RATE))
    np.testing.assert_allclose(recording.values, SI[:, :3], rtol=1e-14)


TRIAD = ["x", "y", "z"]
# A header of an app, what is before it, and the factor to SI of its columns behind the time.
APPS = {
    "phyphox": (["Time (s)", *(f"Gyroscope {a} (rad/s)" for a in TRIAD), "Absolute (rad/s)"], [], [1, 1, 1]),
    "Physics Toolbox": (["time", "gFx", "gFy", "gFz", "wx", "wy", "wz"], [], [*3 * [G0], 1, 1, 1]),
    "SensorLog": (["t (s)", *(f"accelerometerAcceleration{a}(G)" for a in "XYZ")], [], 3 * [G0]),
    "Movella DOT": (
        ["PacketCounter", "SampleTimeFine", *(f"Gyr_{a}" for a in "XYZ"), *(f"Acc_{a}" for a in "XYZ")],
        ["DeviceTag: DOT", "OutputRate: 100Hz"],
        [*3 * [DEG], 1, 1, 1],
    ),
    "increments of Movella DOT": (
        ["SampleTimeFine", "dv[1]", "dv[2]", "dv[3]"],
        ["Measurement Mode: Rate quantities"],
        3 * [RATE],
    ),
}


@pytest.mark.parametrize("name", APPS)
def test_exports_of_apps_need_no_units(tmp_path, name):
    header, before, scales = APPS[name]
    path = tmp_path / "export.csv"
    micros = [[int(1e6 * k / RATE)] if "SampleTimeFine" in header else [k / RATE] for k in range(N)]
    counters = [[k] for k in range(N)] if "PacketCounter" in header else N * [[]]
    own = NOISE[:, : len(scales)]
    table = [[*count, *t, *x] for count, t, x in zip(counters, micros, own.tolist(), strict=True)]
    # A magnitude is no axis.
    more = [[1.0 + k % 2] if "Absolute (rad/s)" in header else [] for k in range(N)]
    lines = [";".join(map(repr, [*row, *end])) for row, end in zip(table, more, strict=True)]
    path.write_text("\n".join([*before, ";".join(header), *lines, ""]))
    recording = aj.read(path)
    assert recording.rate == pytest.approx(RATE)
    np.testing.assert_allclose(recording.values, own * scales, rtol=1e-12)


def test_a_file_of_noise_coefficients_is_named_as_one(tmp_path):
    path = tmp_path / "imu.yaml"
    path.write_text("Gyr:\n   avg-axis:\n      gyr_n: 1.7e-03\n")
    refused(path, f"no samples|allanjax export '{path}' --from imu_utils --to kalibr")


def test_times_in_messages(tmp_path):
    path = tmp_path / "imu.txt"
    for how, begun in {
        "level": EPOCH,
        "JSON": None,
        "flat JSON": None,
        "ros2 topic echo": EPOCH,
        "ros2 topic echo --csv": EPOCH,
    }.items():
        made = (MESSAGES[how](row, k) for k, row in enumerate(NOISE.tolist()))
        path.write_text("\n".join(x if isinstance(x, str) else "\n".join(x) for x in made) + "\n")
        recording = aj.read(path, **UNITS)
        check(recording, close=1e-6)
        assert recording.begun == (begun and pytest.approx(begun, abs=1e-6))


def test_a_damaged_message_is_a_missing_sample(tmp_path):
    """A gap, if the messages have times; lines of a wrong sum count as damaged."""
    path = tmp_path / "imu.txt"
    timed = [f"t={k / 100} {spelled(row)}" for k, row in enumerate(NOISE.tolist())]
    summed = [MESSAGES["sums"](row, k) for k, row in enumerate(NOISE.tolist())]
    path.write_text("\n".join([*timed[:20], timed[20][:60], *timed[21:], ""]))
    refused(path, "0.02 s|line 22", **UNITS)
    recording = aj.read(path, gaps="fill", **UNITS)
    kept = np.arange(N) != 20
    assert noted(recording, "left out: 1 line without", "line 21", "t=0.2 ")
    np.testing.assert_allclose(recording.own_values[kept], NOISE[kept], rtol=1e-14)
    path.write_text(
        "\n".join(["# gx,gy,gz,ax,ay,az", *summed[:20], summed[20].replace("0.", "1.", 1), *summed[21:], ""])
    )
    refused(path, "line 22, '$IMU,|gaps='fill'", rate=RATE, **UNITS)


def test_notes_on_later_chunks_come_with_them(tmp_path):
    path = tmp_path / "imu.csv"
    lines = [",".join(HEADER), *rows(np.tile(NOISE, (2000, 1)))]
    # Text is parsed in blocks of 4 MB.
    lines.insert(95_000, "wifi connected")
    path.write_text("\n".join([*lines, ""]))
    recording = aj.read_chunks(path, rate=RATE, chunk=1000)
    assert not noted(recording, "wifi")
    assert sum(map(len, recording)) == 2000 * N
    assert noted(recording, "line 95001, 'wifi connected'")


@pytest.mark.parametrize("place", [20, N - 1])
def test_numbers_of_a_torn_message_are_not_taken_apart(tmp_path, place):
    """Behind a clock, separated by blanks alone; a row with too few numbers is a missing sample."""
    path = tmp_path / "imu.txt"
    lines = [
        f"[10:22:{33 + k / 100:06.3f}] {' '.join(map(repr, row))}" for k, row in enumerate(NOISE.tolist())
    ]
    lines[place] = lines[place][:50]
    path.write_text("\n".join(lines))
    more = {"columns": f"time,{','.join(SIX)}", "gaps": "fill" if place < N - 1 else None}
    recording = aj.read(path, **more, **UNITS)
    kept = np.arange(recording.n) != place
    np.testing.assert_allclose(recording.own_values[kept], NOISE[: recording.n][kept], rtol=1e-14)


def test_too_many_other_lines_are_described_with_a_command(tmp_path):
    path = tmp_path / "imu.csv"
    torn = [line if k % 4 else line.replace(",", ";", 3) for k, line in enumerate(rows(NOISE))]
    path.write_text("\n".join([",".join(HEADER), *torn, ""]))
    refused(path, "12 of 50 lines are no rows of 6 numbers|line 2, |awk -F',' 'NF==6'", rate=RATE)
    path.write_text("\n".join(["can0 123#DEADBEEF", *30 * ["can0 124#CAFEBABE"], ""]))
    refused(path, "31 lines|line 16 is 'can0 124#CAFEBABE'|CAN bus|DBC", rate=RATE)
    path.write_text("\n".join(["nothing here", *30 * ["or there"], ""]))
    refused(path, "31 lines|line 16 is 'or there'|time [s],gyro_x [deg/s]", rate=RATE)


def test_a_compressed_file_that_is_cut_off_is_read_up_to_there(tmp_path):
    path, many = tmp_path / "imu.csv.gz", np.tile(NOISE, (200, 1))
    content = gzip.compress("\n".join([",".join(HEADER), *rows(many)]).encode())
    path.write_bytes(content[:-500])
    recording = aj.read(path, rate=RATE)
    assert 9_000 < recording.n < 10_000
    np.testing.assert_allclose(recording.own_values, many[: recording.n], rtol=1e-14)
    assert noted(recording, "cut off")
    assert noted(recording, "ends within a line")


# Names of a file, lines before its data, its columns for the rates [deg/s] and accelerations [g], and units.
OF = {
    "MT Manager": (
        "mt.txt",
        [
            "// MT Manager version: 2019.2",
            "PacketCounter\tSampleTimeFine\tAcc_X\tAcc_Y\tAcc_Z\tGyr_X\tGyr_Y\tGyr_Z",
        ],
        "\t",
        (STEP, 100 * STEP, NOISE[:, 3:], NOISE[:, :3]),
        (1.0, 1.0),
    ),
    "Movella DOT": (
        "dot.csv",
        ["DeviceTag:,X", "PacketCounter,SampleTimeFine,Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z"],
        ",",
        (STEP, 10_000 * STEP, NOISE[:, 3:], NOISE[:, :3]),
        (DEG, 1.0),
    ),
    "Kalibr": (
        "imu0.csv",
        ["timestamp,omega_x,omega_y,omega_z,alpha_x,alpha_y,alpha_z"],
        ",",
        (NS, NOISE),
        (1.0, 1.0),
    ),
    "Sensor Logger": (
        "Gyroscope.csv",
        ["time,seconds_elapsed,z,y,x"],
        ",",
        (NS, STEP / RATE, NOISE[:, 2::-1]),
        (1.0,),
    ),
    "OpenLog": (
        "a.csv",
        ["rtcDate,time [s],aX,aY,aZ,gX,gY,gZ,mX,mY,mZ,imu_degC,output_Hz"],
        ",",
        (np.zeros(N), STEP / RATE, NOISE[:, 3:], NOISE[:, :3], np.ones((N, 5))),
        (DEG, 1e-3 * G0),
    ),
}


@pytest.mark.parametrize("device", OF)
def test_units_of_devices(tmp_path, device):
    file, before, mark, columns, scales = OF[device]
    (tmp_path / file).write_text("\n".join([*before, *rows(*columns, mark=mark), ""]))
    recording = aj.read(tmp_path / file)
    assert (recording.rate, noted(recording, f"by the format of {device}") or noted(recording, device)) == (
        pytest.approx(RATE),
        True,
    )
    names = SIX[: 3 * len(scales)]
    np.testing.assert_allclose(
        recording[names].values, NOISE[:, : len(names)] * np.repeat(scales, 3), rtol=1e-14
    )


def test_counts_of_novatel(tmp_path):
    """The scale factors depend on the inertial unit, which the file does not tell."""
    path, counts = tmp_path / "imu.txt", np.round(1000 * NOISE).astype(int)
    lines = []
    for k, (x, y, z, u, v, w) in enumerate(counts.tolist()):
        time = 345_600 + k / RATE
        body = ",".join(map(str, (w, -v, u, z, -y, x)))
        lines.append(
            f"%RAWIMUSA,2105,{time:.3f};2105,{time:.9f},{77 + 2**31 * (k % 2):08x},{body}*{k * 77:08x}"
        )
    path.write_text("\n".join([*lines, ""]))
    error = refused(path, "'m/s/4194304' of a STIM300|accel_unit=", aj.UnitError)
    assert "NovAtel" in str(error)
    recording = aj.read(path, gyro_unit="deg/2097152", accel_unit="m/s/4194304")
    assert recording.rate == pytest.approx(RATE)
    signs = [1, -1, 1]
    scale = RATE * np.array([*3 * [DEG / 2**21], *3 * [2.0**-22]])
    np.testing.assert_allclose(recording[SIX].values, counts * scale * [*signs, *signs], rtol=1e-9)
