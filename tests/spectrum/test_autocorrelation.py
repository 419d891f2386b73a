"""Autocorrelation against numpy.correlate, dense covariances, and the accuracies of Hou (2004) table 3.3."""

import numpy as np
import pytest
from scipy.linalg import toeplitz
from scipy.signal import lfilter

import allanjax as aj
from allanjax.spectrum.autocorrelation import autocovariance, markov_accuracy

N, RATE = 400, 2.0


@pytest.mark.parametrize(
    ("correlation_time", "accuracy"),
    [(58, 12.69), (72, 14.14), (33, 9.57), (355, 31.40), (512, 37.71), (690, 43.78)],
)
def test_accuracies_of_table_3_3(correlation_time, accuracy):
    """The thesis's own numbers, of two hours, to the two decimals it prints."""
    assert round(100.0 * markov_accuracy(correlation_time, 7200.0), 2) == accuracy


def test_the_estimate_is_the_mean_product_of_samples_so_far_apart():
    x = np.random.default_rng(0).standard_normal((300, 2)).cumsum(axis=0)
    found = aj.autocorrelation(x, RATE, longest_lag=50.0)
    np.testing.assert_array_equal(found.lag, np.arange(101) / RATE)
    for k, axis in enumerate(x.T - x.mean(axis=0)[:, None]):
        sums = np.correlate(axis, axis, "full")[299 : 299 + 101]
        np.testing.assert_allclose(found.value[:, k], sums / (300 - np.arange(101)), rtol=1e-9, atol=1e-9)
    assert np.isnan(found.standard_error).all()
    assert len(aj.autocorrelation(x, RATE).lag) == 31


@pytest.mark.parametrize(
    "model",
    [
        aj.Quantization(1.0) + aj.AngleRandomWalk(0.3),
        aj.Markov(1.0, 4.0) + aj.AngleRandomWalk(1.0),
        aj.Model((aj.Markov(1.0, 8.0),)),
    ],
    ids=["quantization", "markov in white noise", "markov"],
)
def test_standard_errors_are_those_of_the_dense_matrix(model):
    """Var R̂(k) = 2 tr((A_k C)²) of a zero-mean record, exact; Bartlett's formula leaves out the ends.

    These are (correlation time)/(record) of the variance: 4 % at most here, half of it of the error.
    """
    g = np.asarray(model.sampled(RATE).phase_covariance(np.arange(N + 2) / RATE))
    R = -(RATE**2) * (np.append(g[1], g[:-2]) - 2.0 * g[:-1] + g[1:])
    C = toeplitz(R[:N] - R[N])
    x = np.random.default_rng(1).standard_normal(N)
    found = aj.autocorrelation(x, RATE, model=model, longest_lag=30.0)
    for k in (0, 1, 7, 60):
        A = (np.eye(N, k=k) + np.eye(N, k=-k)) / (2.0 * (N - k))
        exact = np.sqrt(2.0 * np.trace(A @ C @ A @ C))
        assert found.standard_error[k, 0] == pytest.approx(exact, rel=0.02)


def test_standard_errors_bound_those_of_equation_3_34():
    """The thesis's bound 2σ⁴/(βT) is the variance at lag zero, which is the largest."""
    T, sigma2 = 6.0, 6.0 / 2.0
    model = aj.Model((aj.Markov(1.0, T),))
    x = np.random.default_rng(1).standard_normal(20_000)
    found = aj.autocorrelation(x, RATE, model=model)
    bound = sigma2 * markov_accuracy(T, 20_000 / RATE)
    assert found.standard_error[0, 0] == pytest.approx(bound, rel=0.02)
    assert found.standard_error.max() == found.standard_error[0, 0]


def test_what_is_not_stationary_has_no_standard_error():
    x = np.random.default_rng(1).standard_normal(N)
    for term, name in (
        (aj.BiasInstability(1.0), "bias instability"),
        (aj.RateRandomWalk(1.0), "rate random walk"),
        (aj.DriftRamp(1.0), "drift ramp"),
        (aj.Markov(1.0, 100.0), "markov"),
    ):
        found = aj.autocorrelation(x, RATE, model=aj.AngleRandomWalk(1.0) + term)
        assert np.isnan(found.standard_error).all()
        assert f"the correlation of {name} outlasts the record" in str(found)
        assert autocovariance(aj.AngleRandomWalk(1.0) + term, N, RATE)[1] == (name,)


def test_parameters_are_read_at_zero_and_at_one_over_e():
    """A long record of a known process: (3.34) makes 1.7 %; the fixed draw is within three of these."""
    n, T = 400_000, 30.0
    a = np.exp(-1.0 / T)
    drive = np.random.default_rng(2).standard_normal(n) * np.sqrt(1.0 - a**2)
    x = 2.0 * lfilter([1.0], [1.0, -a], drive)
    found = aj.autocorrelation(x, 1.0, gyro_unit="rad/s", names=["gyro_x"], longest_lag=200.0).markov()
    variance, time = found["gyro_x"].estimates.values()
    assert variance.value == pytest.approx(4.0, rel=0.06)
    assert time.value == pytest.approx(T, rel=0.06)
    for estimate in (variance, time):
        accuracy = np.sqrt(2.0 * time.value / n)
        assert estimate.std == pytest.approx(accuracy * estimate.value)
        np.testing.assert_allclose(
            estimate.interval, estimate.value * (1.0 + 1.95996 * accuracy * np.array([-1, 1]))
        )
    assert variance.usual_unit == "(deg/h)²"
    assert f"accuracy {100.0 * accuracy:.2f} % (3.34)" in time.describe()
    table = found.to_dataframe().set_index("coefficient")
    assert table.loc["markov variance", "value"] == pytest.approx(
        variance.value * (180.0 / np.pi * 3600.0) ** 2
    )
    assert "markov correlation time" in str(found)


def test_nothing_is_read_where_the_curve_does_not_fall():
    x = np.arange(100.0)
    found = aj.autocorrelation(x, 1.0, gyro_unit="rad/s", names=["gyro_x"], longest_lag=5.0).markov()
    assert set(found["gyro_x"].estimates.values()) == {None}
    reason = found["gyro_x"].reasons["markov variance"]
    assert reason == "the autocorrelation does not fall to 1/e within lags up to 5 s"
    assert "none: the autocorrelation" in str(found)


def test_errors_name_the_remedy():
    x = np.random.default_rng(0).standard_normal(50)
    with pytest.raises(aj.AllanjaxError, match="longest_lag of 100 s does not fit a record of 50 s"):
        aj.autocorrelation(x, 1.0, longest_lag=100.0)
    with pytest.raises(aj.AllanjaxError, match="give gyro_unit"):
        aj.autocorrelation(x, 1.0).markov()


def test_white_noise_has_no_correlation_time():
    """Its autocorrelation is that of lag zero: a time between two lags would be that of the interpolation."""
    white = np.random.default_rng(3).standard_normal((5000, 1))
    recording = aj.Recording.from_array(white, RATE, gyro_unit="deg/h", names=["gyro_x"])
    axis = aj.autocorrelation(recording).markov()["gyro_x"]
    assert list(axis.estimates.values()) == [None, None]
    assert "within a sample" in axis.reasons["markov correlation time"]
