"""Text as EuRoC, TUM VI, x-io and VectorNav write it."""

from functools import reduce

import numpy as np
import pytest
from places import DATA

from allanjax.base.errors import RecordingError
from allanjax.record.io import read

N = 100
NAMES = ("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z")
EUROC = "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1]"
EUROC += ",a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"


@pytest.fixture(scope="module")
def samples():
    return np.random.default_rng(6).normal(size=(N, 6)).round(6)


def written(folder, lines):
    path = folder / "imu.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def refused(path, *said, **options):
    with pytest.raises(RecordingError) as caught:
        read(path, **options)
    for text in (str(path), *said):
        assert text in str(caught.value)


@pytest.mark.parametrize(
    "header", [EUROC, EUROC.replace("#", ""), EUROC.replace(",", " "), EUROC.replace("rad s^-1", "rad/s")]
)
def test_euroc(tmp_path, samples, header):
    mark = "," if "," in header else " "
    times = 1_403_715_273_262_142_976 + 5_000_000 * np.arange(N)
    rows = (mark.join([str(t), *map(str, row)]) for t, row in zip(times, samples.tolist(), strict=True))
    recording = read(written(tmp_path, [header, *rows]))
    assert recording.names == NAMES
    assert recording.rate == pytest.approx(200.0, rel=1e-12)
    np.testing.assert_array_equal(recording.values, samples)
    assert [axis.unit for axis in recording.axes] == [*3 * ["rad/s"], *3 * ["m/s²"]]


@pytest.mark.parametrize(
    ("gyro", "accel", "scales"),
    [
        ("°/s", "g's", (np.pi / 180, 9.80665)),
        ("dps", "G's", (np.pi / 180, 9.80665)),
        ("deg s^-1", "m s^-2", (np.pi / 180, 1.0)),
        ("rad s-1", "m/s/s", (1.0, 1.0)),
        ("rad·s⁻¹", "mg", (1.0, 9.80665e-3)),
    ],
)
def test_units_of_headers(tmp_path, samples, gyro, accel, scales):
    header = [*(f"Gyro {axis} ({gyro})" for axis in "XYZ"), *(f"Accel {axis} ({accel})" for axis in "XYZ")]
    path = written(tmp_path, [",".join(header), *(",".join(map(str, row)) for row in samples.tolist())])
    np.testing.assert_allclose(read(path, rate=100).values, samples * np.repeat(scales, 3), rtol=1e-12)


def message(kind, values):
    body = ",".join([kind, *(f"{value:+.6f}" for value in values)])
    return f"${body}*{reduce(lambda a, b: a ^ b, body.encode()):02X}"


def vectornav(kind, samples, before=()):
    gyros_last = np.concatenate([samples[:, 3:], samples[:, :3]], axis=1)
    return [message(kind, [*before, *row]) for row in gyros_last]


@pytest.mark.parametrize(("kind", "before"), [("VNYMR", range(6)), ("VNQMR", range(7)), ("VNMAR", range(3))])
def test_vectornav(tmp_path, samples, kind, before):
    path = written(tmp_path, vectornav(kind, samples, before))
    recording = read(path, rate=40.0)
    order = [recording.names.index(name) for name in NAMES]
    np.testing.assert_array_equal(recording.values[:, order], samples)
    assert f"{N} lines of ${kind}" in recording.notes
    refused(path, "no sample rate", "--rate")


def test_vectornav_with_a_first_line_cut_short_and_other_messages(tmp_path, samples):
    lines = vectornav("VNYMR", samples, range(6))
    lines = [
        lines[0][30:],
        *(text for line in lines for text in (line, "$VNRRG,05,+1.0*00", "# a comment", "")),
    ]
    recording = read(written(tmp_path, lines), rate=40.0)
    assert recording.n == N
    assert f"{2 * N + 1} other lines skipped" in recording.notes


def test_increments_of_vectornav(tmp_path, samples):
    rows = np.column_stack([np.full(N, 0.02), samples])
    path = written(tmp_path, [message("VNDTV", row) for row in rows])
    recording = read(path, rate=50.0)
    scales = np.repeat([50.0 * np.pi / 180, 50.0], 3)
    np.testing.assert_allclose(recording.values, samples * scales, rtol=1e-12)


@pytest.mark.parametrize("damage", ["a digit", "a field", "the beginning", "the number"])
def test_a_damaged_line_of_vectornav(tmp_path, samples, damage):
    lines = vectornav("VNMAR", samples, range(3))
    line = lines[40]
    if damage == "a digit":
        lines[40] = line.replace(line[20], "9" if line[20] != "9" else "8", 1)
    elif damage == "a field":
        lines[40] = line[:30] + "*" + line[-2:]
    elif damage == "the beginning":
        lines[40] = line[15:]
    else:
        lines[40] = message("VNMAR", range(9)).replace("+4.0", "+4.x").partition("*")[0]
    path = written(tmp_path, lines)
    refused(path, "line 41", "start=", rate=40.0)
    assert read(path, rate=40.0, stop=1.0).n == 40


def test_vectornav_without_samples(tmp_path):
    refused(written(tmp_path, N * ["$VNYPR,+1,+2,+3*65"]), "no message with samples, but $VNYPR", "$VNIMU")


@pytest.mark.skipif(not (DATA / "euroc_slice.csv").is_file(), reason="the folder of ALLANJAX_DATA is absent")
def test_real_text():
    recording = read(DATA / "euroc_slice.csv")
    assert recording.names == NAMES
    assert recording.rate == pytest.approx(200.0, rel=1e-6)
    assert np.linalg.norm(recording.values[:, 3:].mean(axis=0)) == pytest.approx(9.8, abs=0.5)
    path = DATA / "xio_sensor_data.csv"
    refused(path, "the first of 10 gaps", "start=90.978, stop=116.188")
    still = read(path, start=90.978, stop=116.188)
    assert [axis.unit for axis in still.axes] == [*3 * ["deg/s"], *3 * ["g"]]
    assert still.rate == pytest.approx(100.0, abs=0.1)
