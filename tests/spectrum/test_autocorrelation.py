"""Autocorrelations against `numpy.correlate`, and Bartlett's formula written out."""

from types import SimpleNamespace

import dense
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refuses
from scipy import stats

import allanjax as aj

N, RATE = 400, 2.0
AXES = (aj.Axis("gyro_x", "gyro", "deg/s"), aj.Axis("accel_z", "accel", "g"))


def record(n: int = N) -> np.ndarray:
    return 9.8 + np.random.default_rng(0).standard_normal((n, 2)).cumsum(axis=0) * [1.0, 3.0]


def test_the_estimate_is_the_mean_product_of_samples_so_far_apart():
    x = record(300)
    found = aj.autocorrelation(x, RATE, longest_lag=50.0)
    assert_array_equal(found.lag, np.arange(101) / RATE)
    for k, axis in enumerate(x.T - x.mean(axis=0)[:, None]):
        sums = np.correlate(axis, axis, "full")[299 : 299 + 101]
        assert_allclose(found.value[:, k], sums / (300 - np.arange(101)), rtol=1e-9, atol=1e-9)
    assert np.isnan(found.standard_error).all()
    assert (found.n, found.rate, found.names) == (300, RATE, ("0", "1"))
    # A tenth of the record.
    assert len(aj.autocorrelation(x, RATE).lag) == 31


MODELS = {
    "gyro_x": aj.Quantization(1.0) + aj.AngleRandomWalk(0.3),
    "accel_z": aj.Markov(1.3, 4.0) + aj.AngleRandomWalk(1.0),
}


def bartlett(R: np.ndarray, k: int) -> float:
    """Standard error at lag k from R(0) … R(n−1), summed over positive and negative m."""
    n = len(R)
    R = np.concatenate([np.zeros(n), R[:0:-1], R, np.zeros(n)])
    m, zero = np.arange(1 - n, n), 2 * n - 1
    taper = np.maximum(1.0 - abs(m) / (n - k), 0.0)
    return np.sqrt(np.sum(taper * R[zero + m] ** 2 + R[zero + m + k] * R[zero + m - k]) / (n - k))


def test_standard_errors_are_those_of_bartlett():
    """Each axis under its own model, of covariances that are written out."""
    fit = {name: SimpleNamespace(model=model) for name, model in MODELS.items()}
    found = aj.autocorrelation(aj.Recording(record(), RATE, AXES), model=fit, longest_lag=30.0)
    alone = aj.autocorrelation(record(), RATE, model=MODELS["gyro_x"], longest_lag=30.0)
    assert_array_equal(alone.standard_error[:, 1], found.standard_error[:, 0])
    for axis, model in enumerate(MODELS.values()):
        R = dense.autocovariance(model, N, RATE)
        for k in (0, 1, 7, 60):
            assert found.standard_error[k, axis] == pytest.approx(bartlett(R, k), rel=1e-9)


def test_what_is_not_stationary_has_no_standard_error():
    for term in (aj.BiasInstability(1.0), aj.RateRandomWalk(1.0), aj.DriftRamp(1.0), aj.Markov(1.0, 100.0)):
        name = term.name().replace("_", " ")
        found = aj.autocorrelation(record(), RATE, model=aj.AngleRandomWalk(1.0) + term)
        assert np.isnan(found.standard_error).all()
        assert all(f" {name} " in remark for remark in found.remarks)


def test_parameters_are_read_at_zero_and_at_one_over_e():
    """By a straight line between the lags around it, with √(2/(βT)) for errors; no interval is below zero."""
    lag = np.arange(10.0)
    value = np.exp(-lag / 2.5)[:, None] * [4.0, 0.01]
    for n, clipped in ((4000, False), (10, True)):
        curve = aj.Autocorrelation(lag, value, value, ("", ""), n, 1.0, AXES)
        time = 2.0 + (value[2, 0] - 4.0 / np.e) / (value[2, 0] - value[3, 0])
        accuracy = np.sqrt(2.0 * time / n)
        for axis, R0 in (("gyro_x", 4.0), ("accel_z", 0.01)):
            read = curve.markov()[axis].estimates
            for label, truth in (("markov variance", R0), ("markov correlation time", time)):
                estimate = read[label]
                assert (estimate.value, estimate.std) == pytest.approx((truth, accuracy * truth))
                for level, interval in ((0.95, estimate.interval), (0.68, estimate.interval_68)):
                    half = stats.norm.ppf(0.5 + level / 2.0) * accuracy * truth
                    assert_allclose(interval, [max(truth - half, 0.0), truth + half], rtol=1e-5)
            assert (estimate.interval[0] == 0.0) == clipped
            unit = "(deg/h)²" if axis == "gyro_x" else "µg²"
            assert (read["markov variance"].usual_unit, estimate.usual_unit) == (unit, "s")
        table = curve.markov().to_dataframe().set_index(["axis", "coefficient"])["value"]
        assert table["accel_z", "markov variance"] == pytest.approx(0.01 / 9.80665e-6**2)


def test_what_cannot_be_read_or_estimated_is_explained():
    value = np.stack([[1.0, 0.9, 0.8, 0.4], [1.0, 0.3, 0.2, 0.1]], axis=1)
    read = aj.Autocorrelation(np.arange(4.0), value, value, ("", ""), 100, 1.0, AXES).markov()
    for axis, word in (("gyro_x", "1/e"), ("accel_z", "sample")):
        assert set(read[axis].estimates.values()) == {None}
        assert word in read[axis].reasons["markov correlation time"]
    refuses("longest_lag", aj.autocorrelation, record(50), 1.0, longest_lag=49.0)
    assert len(aj.autocorrelation(record(50), 1.0, longest_lag=48.0).lag) == 49
    refuses("gyro_unit", aj.autocorrelation(record(50), 1.0).markov)
