"""What people have in hand is taken as it is: arrays, data frames, files, and models as a text."""

import bench
import numpy as np
import pandas as pd
import pytest

import allanjax as aj

DEG = np.pi / 180.0


def gyro():
    return bench.recording("white")


def samples():
    return gyro().values[:, 0] / DEG


def same_numbers(fit, other):
    """Whether both have the same coefficients, to rounding of the samples' units."""
    for label, c in fit.results[0].coefficients.items():
        found = other.results[0][label]
        np.testing.assert_allclose([found.value, *found.interval], [c.value, *c.interval], rtol=1e-6)


KINDS = {
    "array": lambda x: x[:, None],
    "column": lambda x: x,
    "list": lambda x: x.tolist(),
    "series": pd.Series,
}


@pytest.mark.parametrize("kind", KINDS)
def test_samples_with_a_rate_and_a_unit_are_taken_as_their_recording_is(kind):
    data = KINDS[kind](samples())
    same_numbers(bench.fit("white", "N"), aj.fit(data, "N", rate=100, gyro_unit="deg/s"))
    spectrum = aj.power_spectrum(data, 100.0, gyro_unit="deg/s", names=["gyro_y"])
    assert [axis.name for axis in spectrum.axes] == ["gyro_y"]
    np.testing.assert_allclose(spectrum.density, aj.power_spectrum(gyro()).density, rtol=1e-9)
    # Without a unit there are numbers only.
    without = aj.power_spectrum(data, 100.0)
    assert without.axes is None
    np.testing.assert_allclose(without.density * DEG**2, spectrum.density, rtol=1e-9)


@pytest.mark.parametrize("stamps", ["column", "index", "dates", "none"])
def test_a_data_frame_says_by_its_columns_what_it_is(stamps):
    recording, rate = bench.recording("small"), None
    frame = recording.to_dataframe()
    if stamps == "index":
        frame = frame.set_index("time [s]")
    elif stamps == "dates":
        frame.index = pd.Timestamp("2026-03-01") + pd.to_timedelta(frame.pop("time [s]"), unit="s")
        frame.index.name = None
    elif stamps == "none":
        del frame["time [s]"]
        rate = 100.0
    found = aj.power_spectrum(frame, rate)
    assert found.axes == recording.axes
    assert found.rate == pytest.approx(100.0, rel=1e-9)
    np.testing.assert_allclose(found.density, aj.power_spectrum(recording).density, rtol=1e-9)


def test_a_mapping_and_a_file_are_taken_by_their_columns(tmp_path):
    columns = {"gyro_x": samples(), "temperature": np.linspace(20.0, 25.0, gyro().n)}
    found = aj.power_spectrum(columns, 100.0, gyro_unit="deg/s")
    assert [axis.name for axis in found.axes] == ["gyro_x"]
    path = tmp_path / "imu.parquet"
    aj.write(bench.recording("small"), path)
    for file in (path, str(path)):
        found = aj.power_spectrum(file, names=["time [s]", "accel_z [g]"])
        assert [axis.name for axis in found.axes] == ["accel_z"]
        np.testing.assert_allclose(
            found.density[:, 0], aj.power_spectrum(bench.recording("small")).density[:, 3]
        )


TABLE = np.random.default_rng(0).normal(size=(64, 3))


@pytest.mark.parametrize(
    ("call", "word"),
    [
        (lambda: aj.fit(TABLE, gyro_unit="deg/s"), "rate"),
        (lambda: aj.fit(TABLE, rate=100), "gyro_unit="),
        (lambda: aj.fit(TABLE.T, rate=100, gyro_unit="deg/s"), "transposed"),
        (lambda: aj.fit(TABLE, rate=100, gyro_unit="deg/s", names=["gyro_x"]), "names"),
        (lambda: aj.fit(TABLE, rate=100, gyro_unit="m/s"), "m/s"),
        (lambda: aj.fit(pd.DataFrame(TABLE, columns=list("abc")), rate=100), "a, b, c"),
        (lambda: aj.fit(pd.DataFrame({"gyro_x": TABLE[:, 0]}), rate=100), "gyro_unit="),
        (lambda: aj.fit(pd.DataFrame({"gyro_x [deg/s]": TABLE[:, 0]})), "rate="),
        (lambda: aj.fit("nowhere.csv"), "nowhere.csv"),
        (lambda: aj.fit(None), "NoneType"),
        (lambda: aj.fit(["a", "b"], rate=1.0), "list"),
        (lambda: aj.fit(gyro(), rate=100.0), "rate"),
        (lambda: aj.fit(gyro(), "whittle"), "objective="),
        (lambda: aj.fit(gyro(), "N + Z"), "'Z'"),
        (lambda: aj.fit(gyro(), "N=0.1 m/s/√h"), "m/s"),
        (lambda: aj.fit(bench.recording("small"), "N=0.1 deg/√h"), "both"),
        (lambda: aj.simulate_recording({"accel_z": "N=0.1 deg/√h"}, 64, 10.0, 1), "deg"),
        (lambda: aj.fit_many([gyro()], "N + sinusoid"), "sinusoid"),
        (lambda: aj.allan_deviation(TABLE), "rate"),
        (lambda: aj.allan_deviation(gyro(), estimator="hadamard"), "kind="),
    ],
)
def test_what_is_missing_is_asked_for(call, word):
    with pytest.raises(aj.AllanjaxError, match=word):
        call()


def test_a_stream_is_sent_to_the_accumulator(tmp_path):
    aj.write(gyro(), tmp_path / "a.csv")
    with pytest.raises(aj.AllanjaxError, match="accumulate"):
        aj.fit(aj.read_chunks(tmp_path / "a.csv"))


def test_a_model_is_a_text_as_on_the_command_line():
    assert bench.fit("white", "N").template == aj.Model((aj.AngleRandomWalk(),))
    held = aj.fit(gyro(), "angle_random_walk, K=2 deg/h/√h held")["gyro_x"]["rate_random_walk"]
    assert held.held
    assert held.value == pytest.approx(2.0 * DEG / 3600.0 / 60.0)
