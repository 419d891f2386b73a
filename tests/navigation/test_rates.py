"""Noise at several sample rates: filters of 10 Hz sampled at 200 Hz, and what is folded at lower rates."""

import dataclasses

import numpy as np
import pytest

import allanjax as aj

RATE, N, Q = 200.0, 1e-4, 2e-6
WHITE = aj.AngleRandomWalk(N)
SENSORS = {
    "one pole": aj.LowPass1(10.0) * WHITE,
    "Butterworth": aj.Butterworth(10.0) * WHITE,
    "one pole, quantized": aj.LowPass1(10.0) * WHITE + aj.Quantization(Q),
}


@pytest.fixture(scope="module", params=SENSORS)
def found(request):
    return request.param, aj.sample_rates(SENSORS[request.param], rate=RATE, duration=1800.0, seed=8)["gyro"]


def one_pole(f):
    """Power response of y_k = w y_{k−1} + (1 − w) x_k by its definition."""
    w = np.exp(-2.0 * np.pi * 10.0 / RATE)
    return np.abs((1.0 - w) / (1.0 - w * np.exp(-2j * np.pi * f / RATE))) ** 2


def butterworth(f):
    from scipy.signal import butter, freqz

    b, a = butter(2, 10.0, fs=RATE)
    return np.abs(freqz(b, a, f, fs=RATE)[1]) ** 2


def test_the_bandwidth_is_in_its_interval(found):
    """Of both filters the power is halved at 10 Hz; digital, the one pole at 10 Hz + 0.4 %."""
    name, result = found
    half = 10.0
    assert result.bandwidth.interval[0] <= half <= result.bandwidth.interval[1], name
    assert result.bandwidth.interval[1] < 1.1 * result.bandwidth.interval[0]
    assert result.needed == pytest.approx((3.0 * result.bandwidth.value, 5.0 * result.bandwidth.value))


def test_the_aliased_power_is_the_sum_over_aliases(found):
    """Clusters of eight samples by the picked spectrum Σ_k S(f + k·rate), integrated by brute force.

    The intervals are of 95 %, five for each of three sensors: all within one and a half times as much.
    """
    name, result = found
    response = butterworth if name == "Butterworth" else one_pole
    f = (np.arange(40_000) + 0.5) / 40_000 * RATE / 2.0
    density = N**2 * response(f)
    if "quantized" in name:
        density = density + 4.0 * Q**2 * RATE * np.sin(np.pi * f / RATE) ** 2

    def allan(rate, folded):
        """Allan variance of eight samples at this rate, times their duration, of means or of picks."""
        T, df = 8.0 / rate, f[1] - f[0]
        # Of means over T of samples a sample interval apart, and of picked ones.
        step = 1.0 / (rate if folded else RATE)
        mean = (np.sin(np.pi * f * T) / (T / step * np.sin(np.pi * f * step))) ** 2
        return 2.0 * T * 2.0 * df * np.sum(density * mean * np.sin(np.pi * f * T) ** 2)

    for k, rate in enumerate(result.rates[1:], 1):
        above, below = allan(rate, True), allan(rate, False)
        low, high = result.aliased_interval[k]
        middle, half = (low + high) / 2.0, 0.75 * (high - low)
        assert abs(1.0 - below / above - middle) <= half, (name, rate)
        assert result.picked[k] == pytest.approx(above, rel=0.1)


def test_sums_over_aliases_by_hand(found):
    """White noise behind one pole, picked at 10 Hz: near x·coth x of the analog filter, x = πf_c/rate = π.

    The interval of the share is some 0.02, and eight samples see a part of the spectrum, 0.02 more.
    """
    name, result = found
    if name == "one pole":
        aliases = one_pole(10.0 * np.arange(20)).sum()
        assert aliases == pytest.approx(np.pi / np.tanh(np.pi), rel=0.02)
        share = result.aliased[list(result.rates).index(10.0)]
        assert 1.0 - share == pytest.approx(1.0 / aliases, abs=0.04)


def test_quantization_is_told_from_aliases(found):
    """Its coefficient is in its interval, and so much of the picked power is 2Q²·200²/rate."""
    name, result = found
    if "quantized" not in name:
        # In the Butterworth's deep stop band there is nothing else, and rounding may be seen.
        assert not result.quantization.detected or result.quantization.value < 1e-4 * Q
        assert np.all(np.nan_to_num(result.from_quantization) < 1e-6)
        return
    assert result.quantization.interval[0] <= Q <= result.quantization.interval[1]
    white = N**2 * one_pole(10.0 * np.arange(20)).sum()
    folded = 2.0 * (Q * RATE) ** 2 / 10.0
    k = int(np.flatnonzero(result.rates == 10.0)[0])
    assert result.from_quantization[k] == pytest.approx(folded / (folded + white), rel=0.1)


def test_curves_agree_above_the_bandwidth(found):
    name, result = found
    assert result.agree_from == {"one pole": 100.0, "Butterworth": 40.0}.get(name, 200.0)


def test_a_recording_is_told_drawn_and_exported(tmp_path):
    samples = np.asarray(aj.simulate(aj.AngleRandomWalk(N), 360_000, RATE, 2))
    result = aj.sample_rates(samples, [50.0, 100.0], rate=RATE, gyro_unit="rad/s")
    text = str(result)
    for words in ("200 Hz down to 50 Hz", "picked", "aliased", "deg/√h", "curves agree from", "bandwidth"):
        assert words in text
    axis = result["gyro"]
    # White noise up to half the rate is folded whole: half and three quarters.
    np.testing.assert_allclose(axis.aliased, [0.0, 0.5, 0.75], atol=0.03)
    assert axis.needed is None
    assert list(result.to_dataframe().rate) == [200.0, 100.0, 50.0]
    assert result.to_dict()["axes"][0]["rate"] == [200.0, 100.0, 50.0]
    figure = result.plot(path=tmp_path / "a.png", how="averaged")
    lowest = f"{result.picked[-1].rate:g}"
    assert any(f" at {lowest} to 200 Hz" in text.get_text() for text in figure.texts)
    assert (tmp_path / "a.png").stat().st_size > 1000
    with pytest.raises(aj.AllanjaxError, match='how is "picked" or "averaged"'):
        result.plot(how="other")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rate": None}, "a model needs a rate"),
        ({"rates": [30.0]}, "30 Hz is no whole fraction of 200 Hz"),
        ({"rates": [-1.0]}, "no whole fraction"),
        ({"rates": [0.5], "duration": 60.0}, "0.5 Hz leaves 30 samples: give at least"),
        ({"duration": 1.0}, "500 are needed at each rate"),
    ],
)
def test_what_is_wrong_is_refused(options, message):
    with pytest.raises(aj.AllanjaxError, match=message):
        aj.sample_rates(WHITE, **{"rate": RATE, **options})


def test_the_lowest_rate_before_the_curves_part():
    """By hand: shares of 0, 2, 30 and 1 %."""
    axis = aj.Axis("gyro", "gyro", "rad/s")
    rates = np.array([200.0, 100.0, 50.0, 20.0])
    nothing = np.full(4, np.nan)
    share = np.array([0.0, 0.02, 0.3, 0.01])
    result = aj.AxisRates(axis, rates, nothing, nothing, share, np.full((4, 2), np.nan), nothing, None, None)
    assert result.agree_from == 100.0
    assert dataclasses.replace(result, aliased=0.1 * share).agree_from == 20.0
