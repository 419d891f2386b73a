"""All public results: mappings, equal by value, pickled, told in short, with frames and JSON."""

import copy
import dataclasses
import functools
import json
import pickle
from collections.abc import Mapping

import bench
import numpy as np
import pandas as pd
import pytest
from scipy.stats import chi2

import allanjax as aj

NAMES = ["gyro_x", "gyro_y", "gyro_z", "accel_z"]
HOUR, MICRO_G = np.pi / 180.0 / 3600.0, 9.80665e-6
WALKING = {"gyro_x": "N=0.1 deg/√h + K=1 deg/h/√h", "accel_x": "N=0.05 m/s/√h"}


def recording():
    return dataclasses.replace(
        bench.recording("small"), auxiliary={"temperature": bench.recording("small").time}
    )


def short():
    return bench.recording("small")["gyro_x", "accel_z"].between(0.0, 5.12)


def accumulated():
    accumulator = aj.AllanAccumulator(100.0, ["gyro_x"])
    accumulator.update(bench.recording("small").values[:, :1])
    return accumulator


def calibrated():
    levels = {"z up": 9.81, "z down": -9.79}
    scatter = np.tile([1e-4, -1e-4], 32)[:, None]
    records = {
        k: aj.Recording.from_array(v + scatter, 10.0, accel_unit="m/s²", names=["accel_z"])
        for k, v in levels.items()
    }
    return aj.calibrate(records, gravity=9.8, model="N=0.01 m/s/√h", as_is=True)


def fit():
    return bench.fit("small")


def posterior():
    return bench.posterior("small", ("gyro_x", "accel_z"))


def critique():
    return bench.critique("steps")


@functools.cache
def rates():
    data = bench.recording("white").values[:1024, 0]
    axis = aj.Axis("gyro", "gyro", "rad/s")
    nothing = np.full(1, np.nan)
    one = aj.AxisRates(
        axis, np.array([50.0]), nothing, nothing, nothing, np.full((1, 2), np.nan), nothing, None, None
    )
    curve = aj.allan_deviation(data, 50.0, gyro_unit="rad/s")
    return aj.SampleRates("white", (curve,), (curve,), (one,))


#: Results of several axes, with the axes' names.
BY_AXIS = {
    "Fit": (fit, NAMES),
    "TermSelection": (lambda: fit().selection, NAMES),
    "Posterior": (posterior, ["gyro_x", "accel_z"]),
    "Critique": (critique, ["gyro_x", "accel_x"]),
    "Horizon": (lambda: aj.horizon(fit(), 10.0, axes=["gyro_y", "accel_z"]), ["gyro_y", "accel_z"]),
    "Filtered": (lambda: aj.kalman_filter(short(), fit()), ["gyro_x", "accel_z"]),
    "Alignment": (lambda: aj.align(WALKING, 45.0, rate=10.0), ["gyro_x", "accel_x"]),
    "SampleRates": (rates, ["gyro"]),
    "Calibration": (calibrated, ["accel_z"]),
}
#: Others, and parts of those.
MORE = {
    "Recording": recording,
    "AllanDeviation": lambda: fit().curve,
    "PowerSpectrum": lambda: aj.power_spectrum(recording()),
    "Autocorrelation": lambda: aj.autocorrelation(recording(), longest_lag=1.0),
    "WaveletVariance": lambda: aj.wavelet_variance(recording()),
    "WaveletDecomposition": lambda: aj.wavelet_decomposition(short(), levels=2),
    "Denoised": lambda: aj.denoise(short(), fit()),
    "Inspection": lambda: aj.inspect(recording()),
    "Check": lambda: aj.check(bench.recording("small")),
    "Navigation": lambda: aj.navigate(WALKING, [1.0, 5.0], rate=10.0),
    "ErrorGrowth": lambda: aj.navigate(WALKING, [1.0, 5.0], rate=10.0)["attitude"],
    "AxisFit": lambda: fit()["gyro_x"],
    "AxisSelection": lambda: fit().selection["gyro_x"],
    "TermSet": lambda: fit().selection["gyro_x"].best,
    "AxisPosterior": lambda: posterior()["gyro_x"],
    "AxisHorizon": lambda: BY_AXIS["Horizon"][0]()["gyro_y"],
    "FilteredAxis": lambda: BY_AXIS["Filtered"][0]()["gyro_x"],
    "AxisAlignment": lambda: BY_AXIS["Alignment"][0]()["gyro_x"],
    "AxisRates": lambda: rates()["gyro"],
    "Finding": lambda: critique().findings[0],
    "Estimate": lambda: fit()["gyro_x"]["bias_instability"],
    "Drift": lambda: posterior()["gyro_x"].predicted_drift()[60.0],
    "Axis": lambda: recording().axes[0],
    "Model": lambda: fit()["gyro_x"].model,
    "Markov": lambda: aj.Markov(correlation_time=3.0).hold("correlation_time"),
    "StateSpace": lambda: fit()["accel_z"].model.state_space(100.0),
    "DataSheet": lambda: aj.datasheet(aj.datasheets()[0]),
    "SensorPreset": lambda: aj.SENSORS["hg1700"],
    "LogUniform": lambda: aj.LogUniform(1e-6, 1e-3),
    "FleetResult": lambda: aj.FleetResult(fit().to_dataframe(), (), (), 0),
    "AllanAccumulator": accumulated,
}
ALL = MORE | {name: make for name, (make, _) in BY_AXIS.items()}


@pytest.mark.parametrize("kind", BY_AXIS)
def test_results_of_axes_are_mappings(kind):
    make, names = BY_AXIS[kind]
    results = make()
    assert isinstance(results, Mapping)
    assert list(results) == list(results.keys()) == list(results.axes) == names
    assert len(results) == len(names)
    assert tuple(results.values()) == results.results
    for name, result in zip(names, results.results, strict=True):
        assert result.axis.name == name
        assert results[name] is results.get(name) is result
        assert name in results
    assert "mag_x" not in results
    assert results.get("mag_x", results) is results
    with pytest.raises(aj.AllanjaxError, match=f"has no axis 'mag_x'; it has {', '.join(names)}$"):
        results["mag_x"]
    for told in (str(results), repr(results)):
        assert all(name in told for name in names)


TABLES = ("Fit", "TermSelection", "Posterior", "Critique", "FleetResult", "Horizon", "Filtered", "Alignment")
TABLES += (
    "SampleRates",
    "Calibration",
    "Navigation",
    "Check",
    "Inspection",
    "DataSheet",
    "SensorPreset",
    "Denoised",
)


@pytest.mark.parametrize("kind", ALL)
def test_copies_are_equal_and_what_is_told_is_short(kind):
    result = ALL[kind]()
    for other in (pickle.loads(pickle.dumps(result)), copy.deepcopy(result)):
        assert bool(other == result)
        if kind not in ("AllanAccumulator", "StateSpace"):
            assert hash(other) == hash(result)
    assert result != 3
    if kind not in TABLES:
        lines = repr(result).splitlines()
        assert len(lines) <= 2
        assert max(map(len, lines)) < 250
        assert "array(" not in repr(result)


CHANGES = {
    "a sample": (
        recording,
        lambda r: dataclasses.replace(r, values=r.values + 1e-12 * (r.values == r.values[-1, -1])),
    ),
    "a name": (recording, lambda r: dataclasses.replace(r, name="other")),
    "a channel": (recording, lambda r: dataclasses.replace(r, auxiliary={"temperature": r.time + 1e-9})),
    "no channel": (recording, lambda r: dataclasses.replace(r, auxiliary={})),
    "an edf": (
        lambda: fit().curve,
        lambda c: dataclasses.replace(c, edf=c.edf * (1.0 + 1e-12 * (c.edf > 9.0))),
    ),
    "a shape": (lambda: fit().curve, lambda c: dataclasses.replace(c, edf=c.edf[:, :1])),
    "an end": (
        ALL["Estimate"],
        lambda e: dataclasses.replace(e, interval=(e.interval[0], e.interval[1] * 1.0001)),
    ),
    "no limit": (ALL["Estimate"], lambda e: dataclasses.replace(e, upper_limit=1.0)),
    "a prior": (lambda: aj.Uniform(0.0, 1.0), lambda p: aj.Uniform(0.0, 2.0)),
    "its kind": (lambda: aj.Uniform(1.0, 2.0), lambda p: aj.LogUniform(1.0, 2.0)),
    "a row": (ALL["FleetResult"], lambda f: dataclasses.replace(f, table=f.table.iloc[:-1])),
    "a term": (lambda: aj.Model((aj.Markov(1.0, 2.0),)), lambda m: aj.Model((aj.Markov(1.0, 2.5),))),
}


@pytest.mark.parametrize("what", CHANGES)
def test_what_differs_in_one_number_is_not_equal(what):
    make, change = CHANGES[what]
    one, other = make(), change(make())
    assert (one == other) is (other == one) is False
    assert one != other
    assert len({one, other, copy.deepcopy(one)}) == 2


def test_a_model_is_told_as_it_is_written():
    model = aj.Quantization(2e-6) + aj.BiasInstability(cutoff_frequency=None) + aj.AngleRandomWalk()
    model += aj.Markov(amplitude=1e-5, correlation_time=3.0).hold("correlation_time")
    assert eval(repr(model), vars(aj) | {name: getattr(aj, name) for name in aj.__all__}) == model


# ------------------------------------------------------------------------------------------- frames and JSON
def test_frames_of_fits_and_posteriors_are_in_usual_units():
    table = fit().to_dataframe().set_index(["axis", "coefficient"])
    # 1 m/s/√h is 1/60 m/s/√s.
    for name, label, unit, scale in (
        ("accel_z", "angle_random_walk", "m/s/√h", 1.0 / 60.0),
        ("gyro_y", "bias_instability", "deg/h", HOUR),
        ("gyro_y", "rate_random_walk", "deg/h/√h", HOUR / 60.0),
    ):
        row, c = table.loc[name, label], fit()[name][label]
        assert (row["unit"], row["detected"]) == (unit, c.detected)
        numbers = row[["value", "std", "lower_95", "upper_95", "upper_limit_95"]].to_numpy(float) * scale
        np.testing.assert_allclose(numbers, [c.value, c.std, *c.interval, c.upper_limit], rtol=1e-9)
    whole = pd.concat([result.to_dataframe() for result in fit().results], ignore_index=True)
    pd.testing.assert_frame_equal(whole, fit().to_dataframe())
    draws = posterior()["gyro_x"]
    row = draws.to_dataframe().set_index("coefficient").loc["angle_random_walk"]
    x = draws.draws[:, draws.labels.index("angle_random_walk")] * 180.0 / np.pi * 60.0
    assert row["median"] == pytest.approx(np.median(x))
    assert row["std"] == pytest.approx(x.std(), rel=1e-3)
    np.testing.assert_allclose(row[["lower_95", "upper_95"]].astype(float), np.quantile(x, [0.025, 0.975]))
    np.testing.assert_allclose(row[["lower_68", "upper_68"]].astype(float), np.quantile(x, [0.16, 0.84]))


def test_frames_of_recordings_and_curves_are_in_the_units_they_name():
    table = recording().to_dataframe()
    assert list(table) == ["time [s]", *(f"gyro_{a} [deg/s]" for a in "xyz"), "accel_z [g]", "temperature"]
    np.testing.assert_allclose(table["accel_z [g]"], recording().values[:, 3] / 9.80665)
    np.testing.assert_allclose(table["time [s]"], np.arange(16_384) / 100.0)
    curve = fit().curve
    table = curve.to_dataframe()
    lower, upper = curve.confidence_interval(0.68)
    for name, k, unit, scale in (("gyro_y", 1, "deg/h", HOUR), ("accel_z", 3, "µg", MICRO_G)):
        for kind, values in (("", curve.deviation), ("lower_68 ", lower), ("upper_68 ", upper)):
            np.testing.assert_allclose(table[f"{name} {kind}[{unit}]"], values[:, k] / scale)
    assert list(aj.allan_deviation(np.arange(99.0) ** 2, 1.0).to_dataframe())[2] == "0"


def test_intervals_and_p_values_are_those_of_chi_squared():
    """Of an Allan deviation: ν·σ̂²/σ² has ν degrees of freedom; of a fit, its χ² by its own."""
    curve = fit().curve
    for probability in (0.68, 0.95):
        tail = (1.0 - probability) / 2.0
        ends = curve.confidence_interval(probability)
        for end, q in zip(ends, (1.0 - tail, tail), strict=True):
            expected = curve.deviation * np.sqrt(curve.edf / chi2.ppf(q, curve.edf))
            np.testing.assert_allclose(end, expected, rtol=1e-9)
    for result in fit().results:
        assert result.p_value == pytest.approx(chi2.sf(result.chi2, result.dof), rel=1e-9)


def test_frames_of_findings_and_filters_have_their_numbers():
    finding = critique().findings[0]
    rows = critique().to_dataframe()
    for name, estimate in finding.parameters.items():
        row = rows[(rows["cause"] == finding.cause) & (rows["parameter"] == name)].iloc[0]
        assert (row["value"], row["std"], row["unit"]) == (estimate.value, estimate.std, estimate.unit)
    time = finding.parameters["time"]
    assert (time.source, time.axis.name) == ("critique", "gyro_x")
    assert time.in_unit("min").value == pytest.approx(time.value / 60.0)
    assert time.in_unit("min").std == pytest.approx(time.std / 60.0)
    filtered = BY_AXIS["Filtered"][0]()["accel_z"]
    table = filtered.to_dataframe()
    np.testing.assert_array_equal(table["bias"], filtered.bias)
    np.testing.assert_array_equal(table["bias_std"], filtered.bias_std)


@pytest.mark.parametrize(
    "kind", ["Fit", "Critique", "Horizon", "Filtered", "Alignment", "SampleRates", "Calibration"]
)
def test_documents_are_json_and_name_their_axes(kind):
    result = BY_AXIS[kind][0]()
    document = json.loads(
        json.dumps(aj.to_dict(result) if kind == "Fit" else result.to_dict(), allow_nan=False)
    )
    axes = document.get("axes") or document["parameters"]
    told = {axis.get("name", axis.get("axis")) for axis in axes}
    assert told == set(result.axes)
