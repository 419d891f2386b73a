"""What people have in hand is taken as it is: arrays, data frames, files, and models as a text."""

import dataclasses
import importlib

import numpy as np
import pandas as pd
import pytest

import allanjax as aj
from allanjax.record.io.given import as_recording

DEG = np.pi / 180.0
TERMS = aj.AngleRandomWalk() + aj.BiasInstability()


@pytest.fixture(scope="module")
def gyro(small_recording):
    """One gyro, of 20,000 samples in deg/s."""
    return small_recording["gyro_x"]


@pytest.fixture(scope="module")
def fitted(gyro):
    return aj.fit(gyro, TERMS)


def same_numbers(fit, other):
    """Whether both have the same coefficients, to rounding of the samples' units."""
    for label, c in fit.results[0].coefficients.items():
        found = other.results[0][label]
        np.testing.assert_allclose([found.value, *found.interval], [c.value, *c.interval], rtol=1e-6)


@pytest.mark.parametrize("kind", ["array", "column", "list", "series"])
def test_samples_with_a_rate_and_a_unit_are_fitted_as_their_recording_is(kind, gyro, fitted):
    samples = gyro.values[:, 0] / DEG
    data = {
        "array": samples[:, None],
        "column": samples,
        "list": samples.tolist(),
        "series": pd.Series(samples),
    }[kind]
    fit = aj.fit(data, TERMS, rate=100, gyro_unit="deg/s")
    assert fit.axes == ("gyro",)
    same_numbers(fitted, fit)


@pytest.mark.parametrize("stamps", ["column", "index", "dates", "none"])
def test_a_data_frame_says_by_its_columns_what_it_is(stamps, small_recording):
    frame = small_recording.to_dataframe()
    rate = None
    if stamps == "index":
        frame = frame.set_index("time [s]")
    elif stamps == "dates":
        frame.index = pd.Timestamp("2026-03-01") + pd.to_timedelta(frame.pop("time [s]"), unit="s")
        frame.index.name = None
    elif stamps == "none":
        del frame["time [s]"]
        rate = 100.0
    found = as_recording(frame, rate)
    assert found.axes == small_recording.axes
    assert found.rate == pytest.approx(100.0, rel=1e-9)
    np.testing.assert_allclose(found.values, small_recording.values, rtol=1e-12)


def test_a_mapping_and_a_file_are_taken_by_their_columns(tmp_path, small_recording, gyro):
    columns = {"gyro_x": gyro.values[:, 0] / DEG, "temperature": np.linspace(20.0, 25.0, gyro.n)}
    found = as_recording(columns, 100.0, gyro_unit="deg/s")
    assert found.names == ("gyro_x",)
    assert list(found.auxiliary) == ["temperature"]
    path = tmp_path / "imu.csv"
    aj.write(small_recording, path)
    for file in (path, str(path)):
        found = as_recording(file, names=["time [s]", "accel_z [g]"])
        assert (found.name, found.names) == ("imu", ("accel_z",))
        np.testing.assert_allclose(found.values[:, 0], small_recording.values[:, 3], rtol=1e-12)


def test_a_recording_stays_itself_and_states_its_own(small_recording):
    assert as_recording(small_recording) is small_recording
    with pytest.raises(aj.AllanjaxError, match="leave out rate, gyro_unit"):
        aj.fit(small_recording, rate=100.0, gyro_unit="deg/s")


SAMPLES = np.random.default_rng(0).normal(size=(64, 3))


@pytest.mark.parametrize(
    ("data", "given", "message"),
    [
        (SAMPLES, {"gyro_unit": "deg/s"}, "sample rate: give rate"),
        (SAMPLES, {"rate": 100}, 'give gyro_unit= or accel_unit=, e.g. gyro_unit="deg/s"'),
        (SAMPLES.T, {"rate": 100, "gyro_unit": "deg/s"}, "seem transposed; pass values.T"),
        (SAMPLES, {"rate": 100, "gyro_unit": "deg/s", "names": ["gyro_x"]}, "1 names for 3 columns"),
        (SAMPLES, {"rate": 100, "gyro_unit": "m/s"}, "m/s"),
        (pd.DataFrame(SAMPLES, columns=list("abc")), {"rate": 100}, "a, b, c"),
        (pd.DataFrame({"gyro_x": SAMPLES[:, 0]}), {"rate": 100}, "'gyro_x' has no unit; pass gyro_unit="),
        (pd.DataFrame({"gyro_x [deg/s]": SAMPLES[:, 0]}), {}, "no sample rate: pass rate="),
        ("nowhere.csv", {}, "nowhere.csv: no such file"),
        (None, {}, "a NoneType is no recording: give what allanjax.read returns, an array with rate="),
        (object(), {"rate": 1.0}, "an object is no recording"),
        (["a", "b"], {"rate": 1.0}, "a list is no recording"),
    ],
)
def test_what_is_missing_is_asked_for(data, given, message):
    with pytest.raises(aj.AllanjaxError) as raised:
        aj.fit(data, **given)
    assert message in str(raised.value)


def test_a_stream_is_sent_to_the_accumulator(tmp_path, gyro):
    aj.write(gyro, tmp_path / "a.csv")
    with pytest.raises(aj.AllanjaxError, match=r"accumulate\(recording\)\.fit\(\)"):
        aj.fit(aj.read_chunks(tmp_path / "a.csv"))


def test_curves_and_spectra_of_arrays_with_a_unit_have_axes_and_without_none(gyro):
    samples = gyro.values[:, 0] / DEG
    for estimate, numbers in ((aj.allan_deviation, "deviation"), (aj.power_spectrum, "density")):
        expected = getattr(estimate(gyro), numbers)
        with_unit = estimate(samples, 100.0, gyro_unit="deg/s")
        assert with_unit.axes[0].name == "gyro"
        np.testing.assert_allclose(getattr(with_unit, numbers), expected, rtol=1e-9)
        without = estimate(samples, 100.0)
        assert without.axes is None
        power = 1 if numbers == "deviation" else 2
        np.testing.assert_allclose(getattr(without, numbers) * DEG**power, expected, rtol=1e-9)
        of_frame = estimate(gyro.to_dataframe())
        assert of_frame.axes == gyro.axes
        with pytest.raises(aj.AllanjaxError, match="give rate"):
            estimate(samples)


def test_terms_are_selected_and_criticized_of_arrays(gyro, monkeypatch):
    samples = gyro.values[:, 0] / DEG
    ranking = aj.select_terms(samples, "N + B", rate=100, gyro_unit="deg/s")["gyro"].ranking
    expected = aj.select_terms(gyro, TERMS)["gyro_x"].ranking
    assert [s.terms for s in ranking] == [s.terms for s in expected]
    seen = []
    # The function of that name hides the package.
    critic = importlib.import_module("allanjax.critic.criticize")
    monkeypatch.setattr(critic, "criticize", lambda *given: seen.append(given[0]))
    aj.critique(samples, rate=100, gyro_unit="deg/s", names=["gyro_y"])
    assert seen[0].names == ("gyro_y",)


def test_a_model_is_a_text_as_on_the_command_line(gyro, fitted):
    fit = aj.fit(gyro, "N + B")
    assert fit.template == TERMS
    same_numbers(fitted, fit)
    held = aj.fit(gyro, "angle_random_walk, B=20 deg/h held")["gyro_x"]["bias_instability"]
    assert held.held
    assert held.value == pytest.approx(20.0 * DEG / 3600.0)
    # Where a term of that name is refused, the text has been read.
    accumulator = aj.AllanAccumulator(100.0, gyro.axes)
    accumulator.update(gyro.values)
    for refuses in (lambda text: aj.fit_many([gyro], text), accumulator.fit):
        with pytest.raises(aj.FitError, match="sinusoid"):
            refuses("N + sinusoid")
    drawn = aj.simulate("N=0.1 deg/√h", 64, 10.0, 1)
    walk = aj.AngleRandomWalk(0.1 * DEG / 60.0)
    np.testing.assert_allclose(drawn, aj.simulate(walk, 64, 10.0, 1), rtol=1e-12)
    models = {"gyro_x": "N=0.1 deg/√h", "accel_z": "K=1 m/s/h/√h"}
    assert aj.simulate_recording(models, 64, 10.0, 1).names == ("gyro_x", "accel_z")


def test_a_text_that_is_no_model_or_none_of_these_axes_is_refused(gyro, small_recording):
    with pytest.raises(aj.AllanjaxError, match='an objective, not a model: give objective="whittle"'):
        aj.fit(gyro, "whittle")
    with pytest.raises(aj.AllanjaxError, match="there is no term 'Z'; there are angle"):
        aj.fit(gyro, "N + Z")
    with pytest.raises(aj.UnitError, match="m/s"):
        aj.fit(gyro, "N=0.1 m/s/√h")
    with pytest.raises(aj.AllanjaxError, match=r'there are axes of both: .* recording\["gyro"\]'):
        aj.fit(small_recording, "N=0.1 deg/√h")
    with pytest.raises(aj.UnitError):
        aj.simulate_recording({"accel_z": "N=0.1 deg/√h"}, 64, 10.0, 1)


@pytest.mark.parametrize("kind", ["hadamard", "modified", "allan"])
def test_a_kind_given_as_an_estimator_is_pointed_to_kind(kind, gyro):
    with pytest.raises(aj.AllanjaxError, match=f'give kind="{kind}"'):
        aj.allan_deviation(gyro, estimator=kind)


def test_a_fleet_takes_a_text(tmp_path, gyro, monkeypatch):
    seen = []
    monkeypatch.setattr("allanjax.fleet.fleet.key_of", lambda path, options: seen.append(options.model))
    monkeypatch.setattr("allanjax.fleet.fleet.connected", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    path = tmp_path / "a.csv"
    aj.write(dataclasses.replace(gyro), path)
    with pytest.raises(KeyboardInterrupt):
        aj.characterize_fleet(path, tmp_path / "out", "N + B")
    assert seen == [TERMS]
