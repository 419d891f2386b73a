"""Results compare by value, pickles of them included, and are told in two lines."""

import copy
import dataclasses
import pickle

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

import allanjax as aj
from allanjax.base.equality import equal


@pytest.fixture(scope="module")
def objects(small_recording, small_fit, small_posterior, small_critique):
    """One of every public kind, by the name of its class."""
    posterior, critique = small_posterior, small_critique
    curve, spectrum = aj.allan_deviation(small_recording), aj.power_spectrum(small_recording)
    draws = posterior["gyro_x"]
    accumulator = aj.AllanAccumulator(100.0, ["gyro_x"])
    accumulator.update(small_recording.values[:, :1])
    found = [
        dataclasses.replace(small_recording, auxiliary={"temperature": small_recording.time}),
        small_recording.between(0.0, 100.0),
        *(small_recording.axes[0], curve, spectrum, spectrum.random_walk("gyro_x")),
        *(small_fit, small_fit["gyro_x"], small_fit["gyro_x"]["quantization"]),
        *(small_fit.selection, small_fit.selection["gyro_x"], small_fit.selection["gyro_x"].best),
        *(small_fit.template, small_fit["gyro_x"].model, aj.Markov(correlation_time=3.0)),
        *(posterior, draws, draws["angle_random_walk"], draws.bias_instability_minimum()),
        draws.predicted_drift()[60.0],
        *(critique, critique["gyro"], critique.findings[0], critique["gyro"].before[0]),
        critique["gyro"].stages[0],
        aj.fit_many([small_recording], aj.AngleRandomWalk() + aj.BiasInstability()),
        aj.FleetResult(small_fit.to_dataframe(), (), (), 0),
        *(aj.SENSORS["hg1700"], aj.SENSORS["hg1700"]["gyro_x"], aj.LogUniform(1e-6, 1e-3)),
        accumulator,
    ]
    return {f"{k} {type(x).__name__}": x for k, x in enumerate(found)}


def test_pickles_and_copies_are_equal_and_have_the_same_hash(objects):
    for name, x in objects.items():
        for other in (pickle.loads(pickle.dumps(x)), copy.deepcopy(x)):
            assert (other == x) is True or bool(other == x), name
            if not isinstance(x, aj.AllanAccumulator):
                assert hash(other) == hash(x), name


def test_what_differs_in_one_number_is_not_equal(small_recording, small_fit):
    values = small_recording.values.copy()
    values[-1, -1] += 1e-12
    assert small_recording != dataclasses.replace(small_recording, values=values)
    assert small_recording != dataclasses.replace(small_recording, name="other")
    assert small_recording != small_recording.values.tolist()
    edf = small_fit.curve.edf.copy()
    edf[3, 1] *= 1.0 + 1e-12
    other = dataclasses.replace(small_fit, curve=dataclasses.replace(small_fit.curve, edf=edf))
    assert other != small_fit
    assert len({small_fit, other, pickle.loads(pickle.dumps(small_fit))}) == 2
    walk = small_fit["gyro_x"]["angle_random_walk"]
    assert walk != dataclasses.replace(walk, interval=(walk.interval[0], walk.interval[1] * 1.0001))


@pytest.mark.parametrize(
    ("a", "b", "same"),
    [
        (float("nan"), float("nan"), True),
        (np.array([1.0, np.nan]), np.array([1.0, np.nan]), True),
        (np.array([1.0, np.nan]), np.array([1.0, 2.0]), False),
        (np.array([1.0]), jnp.array([1.0]), True),
        (np.ones(2), np.ones((2, 1)), False),
        (np.ones(2), None, False),
        (np.array(["a"]), np.array(["a"]), True),
        ({"a": (1.0, [float("nan")])}, {"a": (1.0, [float("nan")])}, True),
        ({"a": 1.0}, {"b": 1.0}, False),
        ((1, 2), (1, 2, 3), False),
        (1, 1.0, False),
        (pd.DataFrame({"x": [np.nan]}), pd.DataFrame({"x": [np.nan]}), True),
        (pd.DataFrame({"x": [1.0]}), pd.DataFrame({"x": [2.0]}), False),
        (aj.Uniform(0.0, 1.0), aj.Uniform(0.0, 2.0), False),
    ],
)
def test_equality_of_values(a, b, same):
    assert equal(a, b) is equal(b, a) is same


def test_objects_are_told_in_two_lines_and_tables_as_tables(objects):
    tables = (aj.Fit, aj.TermSelection, aj.Posterior, aj.Critique, aj.BulkFit, aj.FleetResult)
    for name, x in objects.items():
        if not isinstance(x, tables):
            lines = repr(x).splitlines()
            assert len(lines) <= 2, name
            assert max(map(len, lines)) < 250, name
            assert "array(" not in repr(x), name
        if not isinstance(x, aj.FleetResult):
            assert repr(x) == str(x) or not isinstance(x, tables)


def test_an_axis_is_told_by_its_coefficients_in_usual_units(small_fit, half_failed_fit, small_posterior):
    told = repr(small_fit["gyro_x"])
    for c in small_fit["gyro_x"].coefficients.values():
        assert (f"{c.title} {c.in_unit().describe()}" if c.detected else c.title) in told
    assert "χ² = " in told
    assert "velocity random walk" in repr(small_fit["accel_z"])
    assert repr(half_failed_fit["gyro_y"]) == "<AxisFit gyro_y: no result: the start was hopeless>"
    draws = small_posterior["gyro_x"]
    assert draws["angle_random_walk"].in_unit().describe() in repr(draws)
    assert draws.verdict() in repr(draws)
    walk = small_fit["gyro_x"]["angle_random_walk"]
    assert repr(walk) == f"<Estimate {walk}>"


def test_tables_of_axes_are_the_rows_of_the_whole(small_fit, small_posterior):
    table = pd.concat([result.to_dataframe() for result in small_fit.results], ignore_index=True)
    pd.testing.assert_frame_equal(table, small_fit.to_dataframe())
    walk = small_fit["accel_z"]["angle_random_walk"]
    row = table[(table["axis"] == "accel_z") & (table["coefficient"] == "angle_random_walk")].iloc[0]
    # 1 m/s/√h is 1/60 m/s/√s.
    assert (row["value"], row["unit"]) == (pytest.approx(60.0 * walk.value), "m/s/√h")
    # What has no limit, as a held value, has NaN among numbers.
    held = dataclasses.replace(walk, upper_limit=None, held=True)
    first = dataclasses.replace(small_fit["gyro_x"], _coefficients={"angle_random_walk": held})
    with_held = dataclasses.replace(small_fit, results=(first, *small_fit.results[1:]))
    limits = with_held.to_dataframe()["upper_limit_95"]
    assert limits.dtype == float
    assert np.isnan(limits[0])
    draws = small_posterior["gyro_x"]
    row = draws.to_dataframe().set_index("coefficient").loc["angle_random_walk"]
    assert row["median"] == pytest.approx(np.median(draws.draws[:, 0]) * 180.0 / np.pi * 60.0)
    pd.testing.assert_frame_equal(draws.to_dataframe(), small_posterior.to_dataframe())


def test_a_model_is_told_as_it_is_written():
    model = aj.Quantization(2e-6) + aj.BiasInstability(cutoff_frequency=None) + aj.AngleRandomWalk()
    model += aj.Markov(amplitude=1e-5, correlation_time=3.0).hold("correlation_time")
    assert repr(model) == (
        "Quantization(2e-06) + BiasInstability(cutoff_frequency=None) + AngleRandomWalk() + "
        'Markov(amplitude=1e-05, correlation_time=3).hold("correlation_time")'
    )
    assert eval(repr(model), vars(aj)) == model


def test_tables_of_results_hold_their_numbers_in_the_units_they_name(small_recording, small_critique):
    table = small_recording.to_dataframe()
    assert list(table)[:2] == ["time [s]", "gyro_x [deg/s]"]
    np.testing.assert_allclose(table["accel_z [g]"], small_recording.values[:, 3] / 9.80665)
    curve = aj.allan_deviation(small_recording)
    table = curve.to_dataframe()
    hour = np.pi / 180.0 / 3600.0
    np.testing.assert_allclose(table["gyro_y [deg/h]"], curve.deviation[:, 1] / hour)
    lower, upper = curve.confidence_interval(0.68)
    np.testing.assert_allclose(table["accel_z lower_68 [µg]"], lower[:, 3] / 9.80665e-6)
    np.testing.assert_allclose(table["gyro_x upper_68 [deg/h]"], upper[:, 0] / hour)
    assert list(aj.allan_deviation(np.arange(99.0) ** 2, 1.0).to_dataframe())[2] == "0"
    table = small_critique.to_dataframe().set_index(["cause", "parameter"])
    finding = small_critique.findings[0]
    assert finding.cause == "sinusoid"
    frequency = table.loc[("sinusoid", "frequency")]
    assert (frequency["value"], frequency["unit"]) == (finding.parameters["frequency"].value, "Hz")
    assert abs(frequency["value"] - 7.3) < 0.01
    assert frequency["axes"] == "gyro"
    estimate = finding.parameters["frequency"]
    assert (estimate.label, estimate.axis.name, estimate.source) == ("frequency", "gyro", "critique")
    assert estimate.in_unit("1/h").value == pytest.approx(3600.0 * estimate.value)
    assert estimate.in_unit("1/h").in_unit().value == pytest.approx(estimate.value)
