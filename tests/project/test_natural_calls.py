"""What people have in hand is taken as it is: arrays, data frames, files, and models as a text."""

import bench
import numpy as np
import pandas as pd
import pytest
from refusals import refuses

import allanjax as aj

DEG = np.pi / 180.0


def gyro():
    return bench.recording("white")


def samples():
    return gyro().values[:, 0] / DEG


def test_samples_with_a_rate_and_a_unit_are_taken_as_their_recording_is():
    expected = aj.power_spectrum(gyro()).density
    for data in (samples()[:, None], samples(), samples().tolist(), pd.Series(samples())):
        spectrum = aj.power_spectrum(data, 100.0, gyro_unit="deg/s", names=["gyro_y"])
        assert [axis.name for axis in spectrum.axes] == ["gyro_y"]
        np.testing.assert_allclose(spectrum.density, expected, rtol=1e-9)
    without = aj.power_spectrum(samples(), 100.0)
    assert without.axes is None
    np.testing.assert_allclose(without.density * DEG**2, expected, rtol=1e-9)
    fit, (result,) = bench.fit("white", "N"), aj.fit(samples(), "N", rate=100, gyro_unit="deg/s").results
    # A model is a text as on the command line.
    assert fit.template == aj.Model((aj.AngleRandomWalk(),))
    numbers = [[c.value, c.std, *c.interval] for c in (result["N"], fit["gyro_x"]["N"])]
    np.testing.assert_allclose(*numbers, rtol=1e-6)


def test_a_data_frame_says_by_its_columns_what_it_is():
    recording = bench.recording("small")
    frame = recording.to_dataframe()
    without, times = frame.drop(columns="time [s]"), frame["time [s]"].to_numpy()
    dates = pd.Index(pd.Timestamp("2026-03-01") + pd.to_timedelta(times, unit="s"))
    expected = aj.power_spectrum(recording).density
    for data in (frame, frame.set_index("time [s]"), without.set_index(dates), without):
        found = aj.power_spectrum(data, 100.0 if data is without else None)
        assert (found.axes, found.rate) == (recording.axes, pytest.approx(100.0, rel=1e-9))
        np.testing.assert_allclose(found.density, expected, rtol=1e-9)


def test_a_mapping_a_file_and_a_stream_are_taken_by_their_columns(tmp_path):
    columns = {"gyro_x": samples(), "temperature": np.linspace(20.0, 25.0, gyro().n)}
    found = aj.power_spectrum(columns, 100.0, gyro_unit="deg/s")
    assert [axis.name for axis in found.axes] == ["gyro_x"]
    aj.write(small := bench.recording("small"), path := tmp_path / "imu.parquet")
    for file in (path, str(path)):
        found = aj.power_spectrum(file, names=["time [s]", "accel_z [g]"])
        assert [axis.name for axis in found.axes] == ["accel_z"]
        np.testing.assert_allclose(found.density[:, 0], aj.power_spectrum(small).density[:, 3])
    refuses("accumulate", aj.fit, aj.read_chunks(path))


TABLE = np.random.default_rng(0).normal(size=(64, 3))


@pytest.mark.parametrize(
    ("call", "word"),
    [
        (lambda: aj.fit(TABLE, gyro_unit="deg/s"), "rate"),
        (lambda: aj.fit(TABLE, rate=100), "gyro_unit="),
        (lambda: aj.fit(TABLE.T, rate=100, gyro_unit="deg/s"), "transposed"),
        (lambda: aj.fit(pd.DataFrame(TABLE, columns=list("abc")), rate=100), "a, b, c"),
        (lambda: aj.fit(pd.DataFrame({"gyro_x [deg/s]": TABLE[:, 0]})), "rate="),
        (lambda: aj.fit(None), "NoneType"),
        (lambda: aj.fit(gyro(), rate=100.0), "rate"),
        (lambda: aj.fit(gyro(), "whittle"), "objective="),
        (lambda: aj.fit(gyro(), "N=0.1 m/s/√h"), "m/s"),
        (lambda: aj.fit(bench.recording("small"), "N=0.1 deg/√h"), "both"),
        (lambda: aj.allan_deviation(gyro(), estimator="hadamard"), "kind="),
    ],
)
def test_what_is_missing_is_asked_for(call, word):
    refuses(word, call)


CALLS = {
    "sample": (aj.sample, "allanjax.fit"),
    "horizon": (lambda x: aj.horizon(x, 1.0), "data sheet"),
    "export": (lambda x: aj.export(x, "kalibr"), "data sheet"),
    "inspect": (aj.inspect, "allanjax.read"),
    "accumulate": (aj.accumulate, "read_chunks"),
    "joint_fit": (aj.joint_fit, "list"),
    "calibrate": (aj.calibrate, "list"),
    "random_effects": (aj.random_effects, "numbers|finite values"),
    "write": (lambda x: aj.write(x, "imu.csv"), "recording"),
}


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize("name", CALLS)
def test_arguments_of_another_kind_are_refused_in_words(name):
    call, word = CALLS[name]
    for other in (None, 3, "BMI088", {1, 2}):
        with pytest.raises(aj.AllanjaxError, match=word):
            call(other)
