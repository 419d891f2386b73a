"""Recordings in memory, as data frames and files that give them again, and in units of every spelling."""

import dataclasses

import numpy as np
import pandas as pd
import pytest
from imu_columns import DEG, G0, HEADER, SIX, UNITS, refused, write_text
from IPython.core.formatters import HTMLFormatter

import allanjax as aj

N = 2000
NOISE = np.random.default_rng(0).normal((0.1, 0.2, 0.3, 0.4, 0.5, 9.8), size=(N, 6))


@pytest.fixture(scope="module")
def recording():
    """Six axes, of which one is dead; numbers of three decimals, and a rate that no stamps give exactly."""
    values = np.round(NOISE * 3.0, 3)
    values[:, 4] = 7.0
    auxiliary = {"temperature": np.linspace(20.0, 30.0, N), "time": np.arange(N), "count": np.arange(N)}
    units = {"gyro_unit": "deg/s", "accel_unit": "mg"}
    return aj.Recording.from_array(values, 123.4567, **units, auxiliary=auxiliary, name="unit 1")


def test_columns_are_gyro_then_accel():
    made = aj.Recording.from_array(NOISE, 50.0, **UNITS, name="unit")
    assert (made.names, made.name, made.rate) == (SIX, "unit", 50.0)
    assert [axis.sensor for axis in made.axes] == 3 * ["gyro"] + 3 * ["accel"]
    assert [axis.unit for axis in made.axes] == 3 * ["deg/s"] + 3 * ["g"]
    np.testing.assert_allclose(made.values, NOISE * [*3 * [DEG], *3 * [G0]], rtol=1e-14)
    np.testing.assert_allclose(made.own_values, NOISE, rtol=1e-14)
    np.testing.assert_array_equal(made.own_values * made.own_scales, made.values)
    assert (made.n, made.duration) == (N, N / 50.0)
    np.testing.assert_allclose(made.time[[0, 1, -1]], [0.0, 0.02, (N - 1) / 50.0])
    assert made.jitter is made.missing is None
    for count, unit, names in ((3, "gyro", SIX[:3]), (3, "accel", SIX[3:]), (1, "accel", ("accel",))):
        made = aj.Recording.from_array(NOISE[:, :count], 1.0, **{f"{unit}_unit": UNITS[f"{unit}_unit"]})
        assert made.names == names
        assert names[0] in made.notes[0]
    vector = aj.Recording.from_array(NOISE[:, 0], 1.0, gyro_unit="rad/s")
    np.testing.assert_array_equal(vector.values, NOISE[:, :1])


def test_axes_are_chosen_by_name_or_sensor(recording):
    chosen = recording["accel_z", "gyro", "gyro_x"]
    assert chosen.names == ("accel_z", "gyro_x", "gyro_y", "gyro_z")
    np.testing.assert_array_equal(chosen.values, recording.values[:, [4, 0, 1, 2]])
    assert chosen.auxiliary.keys() == recording.auxiliary.keys()
    assert [d.axis.name for d in recording["accel"].dead] == ["accel_y"]
    refused(lambda: recording["accel_y"], "accel_y was left out")
    # In notebooks a table tells their means and deviations.
    own = recording.own_values[:, 3]
    table = HTMLFormatter()(recording)
    assert all(cell in table for cell in (f">{own.mean():.6g}<", f">{own.std():.6g}<", ">mg<"))


def test_a_dead_axis_is_left_out_and_reported():
    x = NOISE.copy()
    x[:, 0], x[:, 4] = np.nan, -0.25
    made = aj.Recording.from_array(x, 50.0, **UNITS)
    assert made.names == ("gyro_y", "gyro_z", "accel_x", "accel_z")
    assert [d.axis.name for d in made.dead] == ["gyro_x", "accel_y"]
    assert "number" in made.dead[0].reason
    assert "-0.25 g" in made.dead[1].reason
    np.testing.assert_allclose(made.own_values, x[:, [1, 2, 3, 5]], rtol=1e-14)
    # Dead in a part alone.
    x[:, 0] = x[:, 4] = NOISE[:, 0]
    x[:100, 2] = 1.5
    part = aj.Recording.from_array(x, 50.0, **UNITS).between(stop=2.0)
    assert [(d.axis.name, "1.5 deg/s" in d.reason) for d in part.dead] == [("gyro_z", True)]


def test_a_part_has_its_first_sample_and_not_the_one_at_its_end(recording):
    part = recording.between(500 / recording.rate, 1500 / recording.rate)
    np.testing.assert_array_equal(part.values, recording.values[500:1500])
    np.testing.assert_array_equal(part.auxiliary["count"], np.arange(500, 1500))
    assert "500 to 1,499 of 2,000" in part.notes[-1]
    between = recording.between(500.4 / recording.rate, 1500.4 / recording.rate)
    np.testing.assert_array_equal(between.auxiliary["count"], np.arange(501, 1501))
    assert recording.between(stop=8.0).n == np.ceil(8.0 * 123.4567)
    assert recording.between(-3.0, 1e9).n == N


@pytest.mark.parametrize("si", [False, True])
def test_a_recording_comes_back_from_its_frame(recording, si, tmp_path):
    frame = recording.to_dataframe(si=si)
    units = ("rad/s", "m/s²") if si else ("deg/s", "mg")
    axes = [*(f"gyro_{k} [{units[0]}]" for k in "xyz"), *(f"accel_{k} [{units[1]}]" for k in "xz")]
    assert [*frame.columns[:6]] == ["time [s]", *axes]
    np.testing.assert_array_equal(frame["time [s]"], recording.time)
    frame.drop(columns="time").to_parquet(tmp_path / "imu.parquet")
    for each in (frame.drop(columns="time"), pd.read_parquet(tmp_path / "imu.parquet")):
        back = aj.Recording.from_dataframe(each)
        assert (back.names, back.rate) == (recording.names, pytest.approx(recording.rate, rel=1e-9))
        np.testing.assert_allclose(back.values, recording.values, rtol=1e-14)
    refused(lambda: aj.Recording.from_dataframe(frame.drop(index=range(500, 600))), "gap")
    # Columns without units, and some of them.
    made = aj.Recording.from_dataframe(pd.DataFrame(NOISE[:, 0], columns=["gx"]), 50.0, gyro_unit="deg/s")
    np.testing.assert_allclose(made.values, np.deg2rad(NOISE[:, :1]), rtol=1e-14)
    chosen = aj.Recording.from_dataframe(recording.to_dataframe(), names=["time [s]", "gyro_z"])
    assert (chosen.names, chosen.rate) == (("gyro_z",), pytest.approx(123.4567))


def test_the_name_of_an_axis_wins_over_that_of_a_sensor():
    made = aj.Recording.from_array(NOISE[:, :2], 50.0, gyro_unit="deg/s", names=["gyro", "gyro_1"])
    assert made["gyro"].names == ("gyro",)
    assert made["gyro_1"].names == ("gyro_1",)


def test_a_recording_is_made_of_its_parts_in_their_order():
    """Later fields come after those that users may give by position."""
    made = aj.Recording.from_array(NOISE[:, :1], 50.0, gyro_unit="deg/s")
    again = aj.Recording(made.values, 50.0, made.axes, {}, "unit 7", ("simulated",))
    assert (again.name, again.notes, again.auxiliary_units) == ("unit 7", ("simulated",), {})


def test_a_written_recording_is_read_without_arguments(tmp_path):
    units = {"gyro_unit": "arcsec", "accel_unit": "µg", "names": ["gyro_x", "gyro_1", "accel_z"]}
    units["auxiliary"] = {"temperature": NOISE[:, 5]}
    made = aj.Recording.from_array(NOISE[:, [0, 2, 3]], 100.0 / 3.0, **units)
    made = dataclasses.replace(made, auxiliary_units={"temperature": "degC"})
    for suffix in ("csv", "parquet", "npz"):
        aj.write(made, tmp_path / f"imu.{suffix}")
        again = aj.read(tmp_path / f"imu.{suffix}")
        assert again.axes == made.axes
        assert again.rate == pytest.approx(made.rate, rel=1e-12)
        np.testing.assert_allclose(again.values, made.values, rtol=1e-12)
        np.testing.assert_array_equal(again.auxiliary["temperature"], NOISE[:, 5])
        assert again.auxiliary_units == {"temperature": "degC"}
    # Numbers of a file are those of its frame.
    numbers = np.round(NOISE[:, :3], 2)
    read = aj.read(write_text(tmp_path / "imu.csv", HEADER[:3], numbers), rate=100)
    np.testing.assert_allclose(read.to_dataframe()[[*HEADER[:3]]], numbers, rtol=3e-16, atol=0.0)


RATE = 50.0
SAMPLES = np.random.default_rng(0).normal(size=40) + 0.2
# Spellings, of which the first is shown, and the factor to SI; then the same of increments.
SPELLINGS = {
    "gyro": {
        "deg/h, deg/hr, °/h, °/hr, deg/hour, Deg/h, deg h^-1, deg per hour, dph": DEG / 3600,
        "deg/s, dps, °/s, DEG/S, deg / s, deg/sec, degrees/second, deg·s⁻¹, deg s^-1": DEG,
        "rad/s, Rad/s, rad s-1, rad.s-1, rad*s^-1, rad·s⁻¹": 1.0,
    }
    | {"mdeg/s, mdps": DEG / 1000, "mrad/s": 1e-3, "rad/h, rad/hr": 1 / 3600}
    | {"arcsec/s": DEG / 3600, "rpm, rev/min": 2 * np.pi / 60},
    "accel": {
        "m/s², m/s^2, m/s2, m/s**2, m s-2, m s^-2, m·s⁻², m/s/s, m.s-2": 1.0,
        "m/s/h, m/s/hr, (m/s)/h": 1 / 3600,
    }
    | {"g, g's, G's": G0, "mg": 1e-3 * G0, "µg, μg, ug": 1e-6 * G0, "ft/s², ft/s^2": 0.3048}
    | {"cm/s²": 1e-2, "mm/s²": 1e-3, "Gal, gal": 1e-2, "mGal, mgal": 1e-5},
}
INCREMENTS = {"accel": {"m/s": 1.0, "mm/s": 1e-3, "cm/s": 1e-2, "ft/s": 0.3048}}
INCREMENTS["gyro"] = {"rad": 1.0, "mrad": 1e-3, "µrad, μrad, urad": 1e-6, "deg, °": DEG}
INCREMENTS["gyro"] |= {'arcsec, ", ″': DEG / 3600, "arcmin": DEG / 60}
OTHERS = {"gyro": ["m/s²", "mg", "m/s"], "accel": ["deg/s", "rpm", "arcsec"]}
UNKNOWN = ["furlong", "LSB", "deg/", "/s", "((", "deg//s", "G", "MG", "rads", "-2*deg/s", "2", "nan", "g^400"]
UNKNOWN += ["", "0 deg/s"]


@pytest.mark.parametrize("sensor", SPELLINGS)
def test_units_of_samples(sensor):
    """Increments over a sample interval are multiplied by the rate; a refusal names what is known."""

    def read_as(text):
        return aj.Recording.from_array(SAMPLES, RATE, names=[f"{sensor}_x"], **{f"{sensor}_unit": text})

    known = []
    for table, rate in ((SPELLINGS[sensor], 1.0), (INCREMENTS[sensor], RATE)):
        for texts, scale in table.items():
            known.append(texts.split(", ")[0])
            for text in texts.split(", "):
                recording = read_as(text)
                np.testing.assert_allclose(recording.values[:, 0], SAMPLES * scale * rate, rtol=1e-14)
                np.testing.assert_allclose(recording.own_values[:, 0], SAMPLES, rtol=1e-14)
                assert recording.axes[0].unit == known[-1]
    for text in UNKNOWN + OTHERS[sensor]:
        refused(lambda text=text: read_as(text), "|".join([repr(text), *known]), aj.UnitError)


# Spellings of units of coefficients, the SI unit and the factor to it.
COEFFICIENTS = [
    ("deg/√h, deg/sqrt(h), deg/√hr, deg/√(h), deg/h^0.5, °/√h, deg/h^(1/2), deg·h^-0.5", "rad/√s", DEG / 60),
    ("deg/rt(h), deg/rthr, deg/root-h", "rad/s^0.5", DEG / 60),
    ("deg/h/√h, (deg/h)/√h, deg/h^1.5, deg/hr/sqrt(hr)", "rad/s/√s", DEG / 3600 / 60),
    ("rad/s/√Hz", "rad/√s", 1.0), ("deg/s/√Hz, dps/sqrt(Hz)", "rad/s/√Hz", DEG),
    ("arcsec", "rad", DEG / 3600), ("µg/√Hz, ug/rtHz", "m/s²/√Hz", 1e-6 * G0),
    ("m/s/√h", "m/s/√s", 1 / 60), ("m/s/h²", "m/s³", 1 / 3600**2),
    ("h, hour", "s", 3600.0), ("ppm", "1", 1e-6), ("%, percent", "1", 1e-2),
    ("(deg/h)²/Hz", "rad²/s", (DEG / 3600) ** 2), ("deg/h/[temperature]", "rad/s/[temperature]", DEG / 3600),
]  # fmt: skip
# What is not converted: units, the sensor, and what is named.
NOT_CONVERTED = [
    ("deg/h", "deg/√h", "gyro", "deg/s"), ("deg/h", "furlong", "gyro", "furlong"),
    ("g", "m/s²", "gyro", "accelerometer"), ("deg/h/[temperature]", "deg/h/[current]", None, "current"),
]  # fmt: skip


def test_units_of_coefficients():
    for texts, si, scale in COEFFICIENTS:
        for text in texts.split(", "):
            assert aj.convert(1.0, text, si) == pytest.approx(scale, rel=1e-14), text
            made = aj.convert(np.array([3.0, -2.0]), si, text, "gyro" if "rad" in si else "accel")
            np.testing.assert_allclose(made, [3 / scale, -2 / scale], rtol=1e-14)
    for source, target, sensor, word in NOT_CONVERTED:
        refused(lambda a=source, b=target, s=sensor: aj.convert(1.0, a, b, s), word, aj.UnitError)
