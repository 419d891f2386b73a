"""Fits of models with a response: white noise and a walk through a filter, with a resonance after it."""

import json
from importlib.resources import files

import numpy as np
import pytest
from scipy.linalg import toeplitz
from scipy.signal import bessel, butter, lfilter, sosfilt

import allanjax as aj
from allanjax.allan.covariance import AllanCovariance
from allanjax.estimate.allan_design import moments_behind

RATE, N, BANDWIDTH = 100.0, 30_000, 15.0
TRUTH = {
    "angle_random_walk": 1e-3,
    "rate_random_walk": 2e-4,
    "resonance_amplitude": 5e-3,
    "resonance_frequency": 20.0,
    "resonance_quality_factor": 15.0,
    "low_pass1_bandwidth": BANDWIDTH,
}
SCHEMA = json.loads(files("allanjax.report").joinpath("fit.schema.json").read_text(encoding="utf-8"))
MODEL = "low_pass1 * (N + K) + resonance"


def oscillation(rng, n):
    """Noise of an oscillator at the samples, R(t) = e^{−at}(cos wt + (a/w) sin wt), by its circulant."""
    w0, Q = 2.0 * np.pi * TRUTH["resonance_frequency"] / RATE, TRUTH["resonance_quality_factor"]
    a = w0 / (2.0 * Q)
    w = np.sqrt(w0**2 - a**2)
    t = np.arange(2 * n)
    t = np.minimum(t, 2 * n - t)
    S = np.maximum(np.fft.rfft(np.exp(-a * t) * (np.cos(w * t) + a / w * np.sin(w * t))).real, 0.0)
    white = np.fft.rfft(rng.standard_normal(2 * n))
    return TRUTH["resonance_amplitude"] * np.fft.irfft(white * np.sqrt(S), 2 * n)[:n]


@pytest.fixture(scope="module")
def recording():
    """Two axes by NumPy and SciPy alone; the filter has settled when the record begins."""
    rng, h = np.random.default_rng(11), 1.0 / RATE
    n = N + 1000
    axes = []
    for _ in range(2):
        white = TRUTH["angle_random_walk"] / np.sqrt(h) * rng.standard_normal(n)
        walk = TRUTH["rate_random_walk"] * np.sqrt(h) * np.cumsum(rng.standard_normal(n))
        w = np.exp(-2.0 * np.pi * BANDWIDTH * h)
        axes.append(lfilter([1.0 - w], [1.0, -w], white + walk)[1000:] + oscillation(rng, N))
    return aj.Recording.from_array(np.array(axes).T, RATE, gyro_unit="rad/s", names=["gyro_x", "gyro_y"])


@pytest.fixture(scope="module")
def fitted(recording):
    return aj.fit(recording, MODEL, objective="whittle", as_is=True)


def test_what_was_put_in_is_found(fitted):
    """Within four standard deviations each; of twelve numbers no more is expected once in 1300 times."""
    for result in fitted.results:
        assert list(result.coefficients) == list(TRUTH)
        for label, truth in TRUTH.items():
            c = result[label]
            assert c.detected
            assert abs(c.value - truth) < 4.0 * c.std, label
            assert c.interval[0] < c.value < c.interval[1]
        assert result.misfit is None
        assert result["low_pass1_bandwidth"].unit == "Hz"


def test_the_fitted_model_is_the_sensor(fitted):
    """Its Allan deviation is the measured one within the scatter of 97 % of the estimates, at all times."""
    for k, result in enumerate(fitted.results):
        name = result.axis.name
        model = result.model
        assert model.response is not None
        assert model.inside == (True, True, False)
        ratio = fitted.curve.deviation[:, k] / fitted.model_deviation(name, fitted.curve.cluster_time)
        scatter = 1.0 / np.sqrt(2.0 * fitted.curve.edf[:, k])
        assert np.mean(abs(ratio - 1.0) < 3.0 * scatter + 1e-3) > 0.97


def test_without_the_response_it_is_no_measurement(recording):
    plain = aj.fit(recording, "N + K + resonance", objective="whittle", as_is=True)
    assert not any(result.measured for result in plain.results)


def test_a_held_response_is_what_was_given(recording):
    model = aj.LowPass1(BANDWIDTH).hold("bandwidth") * (aj.AngleRandomWalk() + aj.RateRandomWalk())
    found = aj.fit(recording, model + aj.Resonance(), objective="whittle", as_is=True)
    free = aj.fit(recording, MODEL, objective="whittle", as_is=True)
    for one, other in zip(found.results, free.results, strict=True):
        c = one["low_pass1_bandwidth"]
        assert c.held
        assert c.value == BANDWIDTH
        # What is known need not be estimated beside the rest.
        assert one["angle_random_walk"].std < other["angle_random_walk"].std


def test_two_poles_are_found(recording):
    """A Butterworth filter of 12 Hz: the bandwidth and its Q within four standard deviations."""
    truth = aj.LowPass2(12.0, 0.7) * aj.AngleRandomWalk(1e-3)
    x = np.asarray(aj.simulate(truth, N, RATE, 5))
    record = aj.Recording.from_array(x[:, None], RATE, gyro_unit="rad/s", names=["gyro_x"])
    (result,) = aj.fit(record, aj.LowPass2(12.0, 0.7) * aj.AngleRandomWalk(), "whittle", as_is=True).results
    for label, value in {"angle_random_walk": 1e-3, "low_pass2_bandwidth": 12.0}.items():
        assert abs(result[label].value - value) < 4.0 * result[label].std
    assert abs(result["low_pass2_quality_factor"].value - 0.7) < 4.0 * result["low_pass2_quality_factor"].std


def texts_of(figure):
    """Texts in the panels and the keys of a figure."""
    keys = [axes.get_legend() for axes in figure.axes if axes.get_legend()]
    return [t.get_text() for axes in figure.axes for t in axes.texts] + [
        t.get_text() for key in keys for t in key.get_texts()
    ]


@pytest.fixture(scope="module")
def butterworth():
    """White noise and a walk through SciPy's Butterworth filter of order 3, white noise after it."""
    rng, n = np.random.default_rng(12), N + 1000
    walk = 2e-4 / np.sqrt(RATE) * np.cumsum(rng.standard_normal(n))
    x = sosfilt(butter(3, 30.0, fs=RATE, output="sos"), 1e-2 * rng.standard_normal(n) + walk)[1000:]
    x = x + 5e-4 * rng.standard_normal(N)
    record = aj.Recording.from_array(x[:, None], RATE, gyro_unit="rad/s", names=["gyro_x"])
    model = "butterworth(order=3) * (N + K) + N"
    return aj.fit(record, model, objective="whittle", as_is=True)


def test_a_butterworth_filter_is_found(butterworth):
    """Within four standard deviations each, with white noise after it that is 400 times weaker."""
    (result,) = butterworth.results
    truth = {
        "angle_random_walk_1": 1e-3,
        "rate_random_walk": 2e-4,
        "angle_random_walk_2": 5e-5,
        "butterworth_bandwidth": 30.0,
    }
    for label, value in truth.items():
        assert abs(result[label].value - value) < 4.0 * result[label].std, label
    assert result["butterworth_bandwidth"].std < 1.0
    assert result["butterworth_bandwidth"].unit == "Hz"
    assert result.misfit is None
    assert result.model.response.order == 3


def test_a_butterworth_filter_is_written_loaded_sampled_and_drawn(butterworth, tmp_path):
    from jsonschema import validate

    from allanjax.report.files import write_json

    path = tmp_path / "fit.json"
    write_json(butterworth, path)
    document = json.loads(path.read_text())
    validate(document, SCHEMA)
    assert document["response"]["options"] == {"order": 3}
    assert "options" not in document["model"][0]
    again = aj.load(path)
    assert repr(again["gyro_x"].model) == repr(butterworth["gyro_x"].model)
    assert "order=3" in repr(again.template)
    c = aj.sample(butterworth, seed=1)["gyro_x"]["butterworth_bandwidth"]
    assert c.sampled
    assert c.std == pytest.approx(butterworth["gyro_x"]["butterworth_bandwidth"].std, rel=0.2)
    figure = butterworth.plot(path=tmp_path / "fit.png")
    assert any("butterworth" in text for text in texts_of(figure))


def filtered_record(passed):
    """White noise and a walk through a filter of NumPy or SciPy, which settles first."""
    rng, n = np.random.default_rng(21), N + 1000
    x = 1e-2 * rng.standard_normal(n) + 2e-4 / np.sqrt(RATE) * np.cumsum(rng.standard_normal(n))
    return aj.Recording.from_array(passed(x)[1000:, None], RATE, gyro_unit="rad/s", names=["gyro_x"])


# Means of four samples, and Bessel's digital filter of two poles, of which Q is 1/√3.
FILTERS = {
    "moving_average": (lambda x: lfilter(np.full(4, 0.25), [1.0], x), {"bandwidth": 0.4429465 * RATE / 4.0}),
    "biquad": (
        lambda x: sosfilt(bessel(2, 20.0, fs=RATE, output="sos", norm="phase"), x),
        {"bandwidth": 20.0, "quality_factor": 3.0**-0.5},
    ),
}


@pytest.mark.parametrize("name", FILTERS)
def test_a_moving_average_and_a_biquad_are_found(name, tmp_path):
    """Within four standard deviations each; nothing is left over, and the result is written and loaded.

    In 300 s the walk crosses the white noise below the tenth frequency: it is known to a sixth only.
    """
    from allanjax.report.files import write_json

    passed, truth = FILTERS[name]
    fit = aj.fit(filtered_record(passed), f"{name} * (N + K)", objective="whittle", as_is=True)
    (result,) = fit.results
    values = {f"{name}_{label}": value for label, value in truth.items()}
    for label, value in {"angle_random_walk": 1e-3, "rate_random_walk": 2e-4, **values}.items():
        assert abs(result[label].value - value) < 4.0 * result[label].std, label
        assert result[label].std < (0.25 if label == "rate_random_walk" else 0.02) * value
    assert result.misfit is None
    path = tmp_path / "fit.json"
    write_json(fit, path)
    assert repr(aj.load(path)["gyro_x"].model) == repr(result.model)


@pytest.mark.parametrize("name", FILTERS)
def test_a_fit_without_a_model_finds_them(name):
    """N is inside its interval and the Allan deviation within 5 % where there are a thousand clusters.

    The 1,400 coefficients below a quarter of the bandwidth, 4.7 Hz, give N to 1.3 % without the filter.
    """
    fit = aj.fit(filtered_record(FILTERS[name][0]), as_is=True)
    (result,) = fit.results
    low, high = result["angle_random_walk"].interval
    assert low < 1e-3 < high
    assert high / low < np.exp(2 * 1.96 / np.sqrt(2 * 2 * 1400))
    T = fit.curve.cluster_time
    often = N / RATE / T > 1000.0
    ratio = fit.curve.deviation[often, 0] / result.model.sampled(RATE).allan_variance(T[often]) ** 0.5
    assert np.max(abs(ratio - 1.0)) < 0.05


@pytest.mark.parametrize("samples", [2.6, 28.0])
def test_a_mean_of_any_duration_is_found(samples):
    """White noise, twenty times as fast as the samples, is averaged; each zero of the response is a trap.

    The record tells the duration to a thousandth of a sample; 0.05 is a tenth of the way to the next maximum.
    """
    fine, rng = 20, np.random.default_rng(5)
    total = np.cumsum(rng.standard_normal(20_000 * fine))
    width = round(samples * fine)
    x = (total[width:] - total[:-width])[::fine, None] / width
    record = aj.Recording.from_array(x, RATE, gyro_unit="rad/s", names=["gyro_x"])
    (result,) = aj.fit(record, "moving_average * N", objective="whittle", as_is=True).results
    assert abs(0.4429465 * RATE / result["moving_average_bandwidth"].value - samples) < 0.05
    assert result.misfit is None


def test_a_butterworth_filter_stays_below_half_the_sample_rate():
    """White noise alone: there is no filter, and none beyond what there can be."""
    x = np.random.default_rng(2).standard_normal((4000, 1))
    record = aj.Recording.from_array(x, RATE, gyro_unit="rad/s", names=["gyro_x"])
    model = aj.Butterworth(45.0) * (aj.AngleRandomWalk() + aj.RateRandomWalk())
    (result,) = aj.fit(record, model, "whittle", as_is=True).results
    assert 40.0 < result["butterworth_bandwidth"].value < RATE / 2.0
    with pytest.raises(aj.AllanjaxError, match="below half the sample rate"):
        aj.fit(record, aj.Butterworth(51.0) * aj.AngleRandomWalk(), "whittle", as_is=True)


def test_it_is_written_and_loaded(fitted, tmp_path):
    from allanjax.report.files import write_json

    path = tmp_path / "fit.json"
    write_json(fitted, path)
    document = json.loads(path.read_text())
    assert document["response"]["inside"] == ["angle_random_walk", "rate_random_walk"]
    again = aj.load(path)
    for one, other in zip(again.results, fitted.results, strict=True):
        assert one.coefficients == other.coefficients
        assert repr(one.model) == repr(other.model)
        time = np.geomspace(0.01, 10.0, 20)
        np.testing.assert_allclose(
            again.model_deviation(one.axis.name, time), fitted.model_deviation(one.axis.name, time)
        )


def test_its_posterior_and_its_picture_have_the_bandwidth(fitted, tmp_path):
    posterior = aj.sample(fitted, axes=["gyro_x"], seed=1)
    c = posterior["gyro_x"]["low_pass1_bandwidth"]
    assert c.sampled
    assert abs(c.value - BANDWIDTH) < 4.0 * c.std
    # Of what the data know well, posterior and interval are as wide.
    assert c.std == pytest.approx(fitted["gyro_x"]["low_pass1_bandwidth"].std, rel=0.2)
    figure = fitted.plot(path=tmp_path / "fit.png")
    assert any("low pass1" in text for text in texts_of(figure))


def test_what_cannot_be_done_is_said(recording, fitted):
    with pytest.raises(aj.FitError, match='objective="whittle"'):
        aj.fit(recording, MODEL)
    with pytest.raises(aj.FitError, match="does not judge a model with a response"):
        aj.critique(recording, fitted)


def test_moments_of_allan_variances_behind_a_filter_are_those_of_quadratic_forms():
    """Expectation and variance of x'Ax of 300 samples, by the dense covariance of filtered noise.

    The walk makes the samples' own covariance grow without end; differences of clusters do not see it, so a
    Markov process stands in for it.
    """
    n, rate = 300, 4.0
    w, q = np.exp(-2.0 * np.pi * 0.3 / rate), np.exp(-1.0 / (5.0 * rate))
    model = aj.LowPass1(0.3) * (aj.AngleRandomWalk(1.0) + aj.Markov(1.0, 5.0)) + aj.AngleRandomWalk(0.1)
    sizes = np.array([1, 2, 5, 20])
    geometry = AllanCovariance.of(n, rate, sizes)
    mean, variance = moments_behind(model.sampled(rate), geometry)
    # The impulse response of the filter, applied to the covariances of white noise and of Markov means.
    x = 1.0 / (5.0 * rate)
    r0, r1 = 2.0 * (np.exp(-x) - 1.0 + x) / x**2, ((1.0 - np.exp(-x)) / x) ** 2
    lags = np.arange(2000)
    before = 2.5 * np.where(lags == 0, r0, r1 * q ** np.maximum(lags - 1.0, 0.0)) + rate * (lags == 0)
    pulse = (1.0 - w) * w ** np.arange(200)
    echo = np.correlate(pulse, pulse, "full")
    both = np.convolve(np.concatenate([before[:0:-1], before]), echo, "same")
    V = toeplitz(both[len(both) // 2 :][:n]) + 0.01 * rate * np.eye(n)
    for k, m in enumerate(sizes):
        count = n - 2 * m + 1
        D = np.zeros((count, n))
        for i in range(count):
            D[i, i : i + m], D[i, i + m : i + 2 * m] = -1.0 / m, 1.0 / m
        C = D @ V @ D.T
        assert mean[k] == pytest.approx(np.trace(C) / (2.0 * count), rel=1e-6)
        # The quadrature over lags is good to half a per cent.
        assert variance[k] == pytest.approx(np.sum(C**2) / (2.0 * count**2), rel=5e-3)
