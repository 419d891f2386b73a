"""Reading recordings: formats, headers, columns, time stamps, increments, and writing them again."""

import gzip
import math

import numpy as np
import pandas as pd
import pytest
from imu_columns import HEADER, SIX, UNITS
from places import DATA
from scipy.io import savemat

from allanjax.record.columns import recognise
from allanjax.record.io import read, write
from allanjax.record.recording import Recording

DEG = math.pi / 180
G0 = 9.80665
RATE = 100.0


@pytest.fixture(scope="module")
def noise():
    return np.random.default_rng(1).normal(size=(50, 6))


def _text(path, columns, header=None, delimiter=",", before=""):
    rows = [delimiter.join(repr(value.item()) for value in row) for row in zip(*columns, strict=True)]
    lines = rows if header is None else [delimiter.join(header), *rows]
    path.write_text(before + "\n".join(lines) + "\n", encoding="utf-8")
    return path


def _check(recording, noise, names=SIX):
    assert recording.names == names
    assert recording.rate == pytest.approx(RATE, rel=1e-9)
    np.testing.assert_allclose(recording.own_values, noise, rtol=1e-14)
    np.testing.assert_allclose(recording["gyro_x"].values[:, 0], noise[:, 0] * DEG, rtol=1e-14)


@pytest.mark.parametrize("delimiter", [",", ", ", ";", "\t", " ", "   "])
@pytest.mark.parametrize("header", [None, HEADER])
@pytest.mark.parametrize("before", ["", "# recorded in the lab\n% static\n\n"])
def test_text(tmp_path, noise, delimiter, header, before):
    path = _text(tmp_path / "imu.txt", noise.T, header, delimiter, before)
    recording = read(path, rate=RATE, **({} if header else UNITS))
    _check(recording, noise)
    assert recording.name == "imu"
    assert any("column order taken as gyro_x" in note for note in recording.notes) == (header is None)


def test_header_in_a_comment(tmp_path, noise):
    path = tmp_path / "imu.csv"
    np.savetxt(path, noise, delimiter=",", header="static test\n" + ",".join(HEADER))
    _check(read(path, rate=RATE), noise)


def test_comments_blank_lines_and_trailing_delimiters_amid_the_data(tmp_path, noise):
    lines = _text(tmp_path / "a.csv", noise.T, HEADER).read_text().splitlines()
    lines = [line + "," for line in lines]
    lines.insert(10, "# paused")
    lines.insert(20, "")
    path = tmp_path / "imu.csv"
    path.write_text("\r\n".join(lines))
    _check(read(path, rate=RATE), noise)


def test_preamble_of_names_and_values(tmp_path, noise):
    path = _text(tmp_path / "imu.csv", noise.T, HEADER, before="Device,X9\nSerial,7\nRange,300\n")
    recording = read(path, rate=RATE)
    _check(recording, noise)
    assert "3 lines before the data skipped, the first 'Device,X9'" in recording.notes


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "latin-1"])
def test_encodings(tmp_path, noise, encoding):
    header = ",".join(HEADER).replace("deg/s", "°/s")
    rows = "\n".join(",".join(map(repr, row)) for row in noise.tolist())
    path = tmp_path / "imu.csv"
    path.write_bytes((header + "\n" + rows).encode(encoding))
    _check(read(path, rate=RATE), noise)


def test_gzip(tmp_path, noise):
    path = tmp_path / "imu.csv.gz"
    path.write_bytes(gzip.compress(_text(tmp_path / "a.csv", noise.T, HEADER).read_bytes()))
    recording = read(path, rate=RATE)
    _check(recording, noise)
    assert recording.name == "imu"


def test_parquet_by_content_whatever_the_suffix(tmp_path, noise):
    path = tmp_path / "imu.csv"
    pd.DataFrame(noise.astype(np.float64), columns=list(SIX)).to_parquet(path)
    _check(read(path, rate=RATE, **UNITS), noise)


def test_npy(tmp_path, noise):
    path = tmp_path / "imu.npy"
    np.save(path, noise)
    _check(read(path, rate=RATE, **UNITS), noise)
    np.save(path, noise[:, 0])
    assert read(path, rate=RATE, gyro_unit="deg/s").names == ("gyro",)
    np.save(path, noise[:, :3])
    assert read(path, rate=RATE, accel_unit="g").names == ("accel_x", "accel_y", "accel_z")
    np.save(path, np.rec.fromarrays(noise.T, names=list(SIX)))
    _check(read(path, rate=RATE, **UNITS), noise)


@pytest.mark.parametrize(
    "arrays",
    [
        lambda x, t: {"gyro": x[:, :3], "accel": x[:, 3:], "rate": RATE},
        lambda x, t: {"omega": x[:, :3], "acc": x[:, 3:], "dt": 0.01},
        lambda x, t: {"gyro": x[:, :3], "accel": x[:, 3:], "time": t},
        lambda x, t: dict(zip(SIX, x.T, strict=True)) | {"fs": np.array([RATE])},
        lambda x, t: {"data": x, "sample_rate": RATE},
    ],
)
@pytest.mark.parametrize("suffix", [".npz", ".mat"])
def test_npz_and_mat(tmp_path, noise, arrays, suffix):
    path = tmp_path / f"imu{suffix}"
    contents = arrays(noise, 5.0 + np.arange(50) / RATE)
    if suffix == ".npz":
        np.savez(path, **contents)
    else:
        savemat(path, contents)
    recording = read(path, **UNITS)
    _check(recording, noise)
    assert any("sample rate 100 Hz from" in note for note in recording.notes)


def test_mat_struct(tmp_path, noise):
    path = tmp_path / "imu.mat"
    savemat(path, {"imu": {"gyro": noise[:, :3], "accel": noise[:, 3:], "fs": RATE, "serial": "A7"}})
    recording = read(path, **UNITS)
    _check(recording, noise)
    assert "'imu.serial' skipped: not numeric" in recording.notes


STEP = np.arange(50)
EPOCH = 1_700_000_000


@pytest.mark.parametrize(
    ("label", "stamps", "options"),
    [
        ("time [s]", STEP / RATE, {}),
        ("time (ms)", STEP * 10 + 7, {}),
        ("time_us", STEP * 10_000, {}),
        ("timestamp_ns", STEP * 10_000_000, {}),
        ("t", STEP / RATE, {"time_unit": "s"}),
        ("t", STEP * 10.0, {"time_unit": "ms"}),
        ("stamp", STEP * 10_000, {"time_unit": "µs"}),
        ("Time", STEP * 10, {"rate": 100.4}),
        ("time", 3.0 + STEP / RATE, {}),
        ("timestamp", EPOCH + STEP / RATE, {}),
        ("timestamp", EPOCH * 1000 + STEP * 10, {}),
        ("%time", EPOCH * 10**9 + STEP * 10**7, {}),
        ("field.header.stamp", EPOCH * 10**9 + STEP * 10**7 + 123, {}),
        ("clock", STEP / RATE, {"time": "clock", "time_unit": "s"}),
        ("clock [ms]", STEP * 10, {"time": "clock"}),
    ],
)
def test_time_stamps(tmp_path, noise, label, stamps, options):
    path = _text(tmp_path / "imu.csv", [stamps, *noise.T], [label, *HEADER])
    recording = read(path, **options)
    assert recording.rate == pytest.approx(options.get("rate", RATE), rel=1e-6)
    assert recording.names == SIX
    assert not recording.auxiliary
    assert any(f"from column '{label}', jitter" in note for note in recording.notes)


def test_nanosecond_stamps_keep_their_digits(tmp_path, noise):
    jitter = np.where(STEP % 2, 50, -50)
    stamps = EPOCH * 10**9 + STEP * 10**7 + jitter
    path = _text(tmp_path / "imu.csv", [stamps, *noise.T], ["timestamp_ns", *HEADER])
    # Floats of this size are 256 ns apart; the intervals alternate by ±100 ns.
    notes = read(path).notes
    assert any("jitter 0.1 µs rms" in note for note in notes)


@pytest.mark.parametrize("prefix", ["header.stamp.", ""])
@pytest.mark.parametrize("names", [("secs", "nsecs"), ("sec", "nanosec")])
def test_ros_seconds_and_nanoseconds(tmp_path, noise, prefix, names):
    stamps = 990_000_000 + STEP * 10**7
    columns = [EPOCH + stamps // 10**9, stamps % 10**9, *noise.T]
    ros = [f"angular_velocity.{a}" for a in "xyz"] + [f"linear_acceleration.{a}" for a in "xyz"]
    path = _text(tmp_path / "imu.csv", columns, [prefix + names[0], prefix + names[1], *ros])
    _check(read(path, **UNITS), noise)


def test_ros_topic_export(tmp_path, noise):
    frame = pd.DataFrame(
        {
            "%time": EPOCH * 10**9 + STEP * 10**7 + 300_000,
            "field.header.seq": STEP,
            "field.header.stamp": EPOCH * 10**9 + STEP * 10**7,
            "field.header.frame_id": "imu_link",
            "field.orientation.w": 1.0,
            "field.orientation_covariance0": 0.0,
        }
        | {f"field.angular_velocity.{a}": noise[:, i] for i, a in enumerate("xyz")}
        | {"field.angular_velocity_covariance0": 0.0}
        | {f"field.linear_acceleration.{a}": noise[:, 3 + i] for i, a in enumerate("xyz")}
    )
    frame.to_csv(tmp_path / "imu.csv", index=False)
    recording = read(tmp_path / "imu.csv", **UNITS)
    _check(recording, noise)
    assert set(recording.auxiliary) == {
        "field.header.seq",
        "field.orientation.w",
        "field.orientation_covariance0",
        "field.angular_velocity_covariance0",
    }
    notes = "\n".join(recording.notes)
    assert "time from field.header.stamp; %time ignored" in notes
    assert "'field.header.frame_id' skipped: not numeric, 'imu_link' at line 2" in notes


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_dates(tmp_path, noise, suffix):
    dates = pd.to_datetime(EPOCH * 10**9 + STEP * 10**7)
    frame = pd.DataFrame({"when": dates} | dict(zip(HEADER, noise.T, strict=True)))
    if suffix == ".csv":
        frame.to_csv(tmp_path / "imu.csv", index=False)
        _check(read(tmp_path / "imu.csv", time="when"), noise)
    else:
        frame.to_parquet(tmp_path / "imu.parquet")
        _check(read(tmp_path / "imu.parquet"), noise)


def test_time_is_ignored_on_request(tmp_path, noise):
    path = _text(tmp_path / "imu.csv", [STEP / 7.0, *noise.T], ["time [s]", *HEADER])
    for choice in ("none", False):
        recording = read(path, rate=RATE, time=choice)
        _check(recording, noise)


@pytest.mark.parametrize("with_time", [True, False])
def test_start_and_stop(tmp_path, noise, with_time):
    columns, header = ([9.0 + STEP / RATE], ["time [s]"]) if with_time else ([], [])
    path = _text(tmp_path / "imu.csv", [*columns, *noise.T, 20.0 + STEP], [*header, *HEADER, "temperature"])
    recording = read(path, rate=RATE, start=0.1, stop=0.4)
    np.testing.assert_allclose(recording.own_values, noise[10:40])
    np.testing.assert_array_equal(recording.auxiliary["temperature"], 20.0 + STEP[10:40])
    assert "samples 10 to 39 of 50 taken" in recording.notes
    assert "taken" not in " ".join(read(path, rate=RATE).notes)


@pytest.mark.parametrize(
    ("label", "name"),
    [
        *(
            (label, "gyro_x")
            for label in ("gyro_x", "gyrox", "GyroX", "Gyr_X", "gx", "wx", "omega_x", "xgyro", "Gyro X")
        ),
        *(
            (label, "gyro_y")
            for label in ("angular_velocity.y", ".angular_velocity.y", "field.angular_velocity.y")
        ),
        *(
            (label, "accel_z")
            for label in ("accel_z", "acc_z", "AccZ", "az", "linear_acceleration.z", "zacc")
        ),
        *((label, "gyro_z") for label in ("dtheta_z", "delta_angle_z", "delta_theta_z")),
        *((label, "accel_z") for label in ("dv_z", "delta_velocity_z", "dvel_z", "delta_v_z")),
        *(
            (label, None)
            for label in ("mag_x", "gyro_bias_x", "gyro_temp", "temperature", "max", "quat_x", "p")
        ),
        *(
            (label, None)
            for label in ("bias_gyro_x", "gyro/bias/omega_y", "std_accel_z", "Sigma.AccX", "cov_gyro_1")
        ),
        *((label, None) for label in ("angular_velocity_covariance[0]", "linear_acceleration_covariance_0")),
    ],
)
def test_recognition(label, name):
    column = recognise(label)
    assert (column.name if column.role == "axis" else None) == name


@pytest.mark.parametrize(
    ("label", "unit"),
    [
        ("gyro_x [deg/s]", "deg/s"),
        ("gyro_x (rad/s)", "rad/s"),
        ("gyro_x[rad/s]", "rad/s"),
        ("gyro_x_dps", "deg/s"),
        ("accel_x_mg", "mg"),
        ("temperature [degC]", "degC"),
        ("gyro[0]", None),
    ],
)
def test_units_in_labels(label, unit):
    assert recognise(label).unit == unit


def test_quoted_names_after_a_space(tmp_path, noise):
    rows = "\n".join(", ".join(f'"{x!r}"' for x in row) for row in noise.tolist())
    path = tmp_path / "imu.csv"
    path.write_text(", ".join(f'"{name}"' for name in HEADER) + "\n" + rows + "\n", encoding="utf-8")
    np.testing.assert_allclose(read(path, rate=RATE).own_values, noise, rtol=1e-12)


def test_increments(tmp_path, noise):
    header = [f"delta_angle_{a} [µrad]" for a in "xyz"] + [f"delta_velocity_{a} [mm/s]" for a in "xyz"]
    recording = read(_text(tmp_path / "imu.csv", noise.T, header), rate=RATE)
    assert recording.names == SIX
    np.testing.assert_allclose(recording.values[:, :3], noise[:, :3] * 1e-6 * RATE)
    np.testing.assert_allclose(recording.values[:, 3:], noise[:, 3:] * 1e-3 * RATE)
    assert any(note.startswith("increments multiplied by the rate: gyro_x") for note in recording.notes)


def test_auxiliary(tmp_path, noise):
    temperature = 20.0 + STEP
    path = _text(tmp_path / "imu.csv", [*noise.T, temperature], [*HEADER, "temperature [degC]"])
    recording = read(path, rate=RATE)
    np.testing.assert_array_equal(recording.auxiliary["temperature"], temperature)
    assert "auxiliary: temperature [degC]" in recording.notes


def test_columns_choose_from_the_header(tmp_path, noise):
    path = _text(tmp_path / "imu.csv", [STEP / RATE, *noise.T], ["time [s]", *HEADER])
    for choice in ("gyro_z,accel_x", ["gyro_z [deg/s]", "accel_x"]):
        recording = read(path, columns=choice)
        assert recording.names == ("gyro_z", "accel_x")
        assert recording.rate == pytest.approx(RATE)
        np.testing.assert_allclose(recording.own_values, noise[:, [2, 3]])


def test_columns_name_by_position(tmp_path, noise):
    columns = [STEP / RATE, *noise.T]
    without = _text(tmp_path / "a.csv", columns)
    recording = read(without, columns="time [s],gyro_z [deg/s],-,_,ax,-,temp", accel_unit="g")
    assert recording.names == ("gyro_z", "accel_x")
    np.testing.assert_allclose(recording.own_values, noise[:, [0, 3]])
    np.testing.assert_array_equal(recording.auxiliary["temp"], noise[:, 5])
    with_header = _text(tmp_path / "b.csv", columns, ["c0 [ms]", "p [deg/s]", "q", "r", "c4", "c5", "c6"])
    recording = read(with_header, columns="-,gx,-,-,-,-,-", rate=RATE)
    np.testing.assert_allclose(recording.values[:, 0], noise[:, 0] * DEG)


def test_one_axis(tmp_path, noise):
    recording = read(_text(tmp_path / "imu.csv", [noise[:, 0]], ["gyro_z [deg/h]"]), rate=RATE)
    assert recording.names == ("gyro_z",)
    np.testing.assert_allclose(recording.values[:, 0], noise[:, 0] * DEG / 3600)


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".npz"])
def test_written_recordings_read_back_without_arguments(tmp_path, noise, suffix):
    recording = Recording.from_array(
        noise[:, [0, 2, 3]],
        RATE / 3,
        names=["gyro_x", "gyro_1", "accel_z"],
        gyro_unit="arcsec",
        accel_unit="µg",
        auxiliary={"temperature": noise[:, 5]},
    )
    path = tmp_path / f"imu{suffix}"
    write(recording, path)
    again = read(path)
    assert again.axes == recording.axes
    assert again.rate == pytest.approx(recording.rate, rel=1e-12)
    np.testing.assert_allclose(again.values, recording.values, rtol=1e-12)
    np.testing.assert_array_equal(again.auxiliary["temperature"], noise[:, 5])


@pytest.mark.skipif(not DATA.is_dir(), reason="the real recordings are not here")
def test_real_recording():
    recording = read(DATA / "adis16405_unit1.parquet", rate=100, **UNITS)
    assert recording.names == SIX
    assert recording.n == 1_000_000
    # One count is 0.05 deg/s.
    counts = recording["gyro"].own_values / 0.05
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-6)
