"""Noise at several sample rates: levels by their definition, what is folded of white noise, the bandwidth."""

import dataclasses
import json

import bench
import golden_records
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refuses
from scipy import signal

import allanjax as aj

RATE, N, Q, K = 100.0, 1e-4, 3e-6, 2e-5


def simulated():
    """Two sensors by NumPy, of 164 s at 100 Hz, as long as those of the bench."""
    rng, n, w = np.random.default_rng(8), 16_384 + 512, np.exp(-2.0 * np.pi * 10.0 / RATE)
    quantized = golden_records.quantization(rng, n - 512, Q, RATE)
    white, walk = N * np.sqrt(RATE) * rng.standard_normal((2, n)), golden_records.walk(rng, n, K, RATE)
    return {
        "butterworth": signal.lfilter(*signal.butter(2, 10.0, fs=RATE), white[0] + walk)[512:],
        "quantized": signal.lfilter([1.0 - w], [1.0, -w], white[1])[512:] + quantized,
    }


SAMPLES = simulated()


@pytest.fixture(scope="module")
def results():
    options = {"rate": RATE, "names": ["gyro_x"], "gyro_unit": "rad/s"}
    return {name: aj.sample_rates(x, [12.5, 50.0], **options) for name, x in SAMPLES.items()}


def allan_variance(x, m):
    phase = np.r_[0.0, np.cumsum(x)]
    return np.mean((phase[2 * m :] - 2.0 * phase[m:-m] + phase[: -2 * m]) ** 2) / (2.0 * m**2)


@pytest.mark.parametrize("name", SAMPLES)
def test_levels_shares_and_intervals_are_by_their_definition(results, name):
    x, found, result = SAMPLES[name], results[name], results[name]["gyro_x"]
    assert_allclose(result.rates, [100.0, 50.0, 12.5])
    for k, m in enumerate((1, 2, 8)):
        T = 8.0 * m / RATE
        means = x[: len(x) // m * m].reshape(-1, m).mean(axis=1)
        picked, averaged = (allan_variance(y, 8) * T for y in (x[::m], means))
        assert result.picked[k] == pytest.approx(picked, rel=1e-6)
        assert result.averaged[k] == pytest.approx(averaged, rel=1e-6)
        assert result.aliased[k] == pytest.approx(1.0 - averaged / picked, abs=1e-6)
        edf = [of[k].edf[list(of[k].cluster_size).index(8), 0] for of in (found.picked, found.averaged)]
        spread = 1.959964 * np.sqrt(2.0 / edf[0] + 2.0 / edf[1]) * (k > 0)
        ends = 1.0 - averaged / picked * np.exp([spread, -spread])
        assert_allclose(result.aliased_interval[k], ends, atol=1e-6)
        if result.quantization.detected:
            Q2 = result.quantization.value**2
            folded = 2.0 * Q2 * RATE**2 / result.rates[k] - 3.0 * Q2 * result.rates[k] / 8.0
            assert result.from_quantization[k] == pytest.approx(folded / picked * (k > 0), rel=1e-6)
    assert np.isnan(result.from_quantization).all() != result.quantization.detected


@pytest.mark.parametrize("name", SAMPLES)
def test_bandwidth_and_quantization_are_those_put_in(results, name):
    """Of both filters the power is halved at 10 Hz; digital, the one pole at 10 Hz + 1 %; four deviations."""
    result = results[name]["gyro_x"]
    bandwidth, c = result.bandwidth, result.quantization
    assert abs(bandwidth.value - 10.0) < 4.0 * bandwidth.std < 2.0
    assert bandwidth.interval[0] < bandwidth.interval_68[0] < bandwidth.value
    assert bandwidth.value < bandwidth.interval_68[1] < bandwidth.interval[1] < 1.25 * bandwidth.interval[0]
    assert result.needed == pytest.approx((3.0 * bandwidth.value, 5.0 * bandwidth.value))
    if name == "quantized":
        assert abs(c.value - Q) < 4.0 * c.std < 0.1 * Q
    else:
        # In a deep stop band there is nothing else, and rounding may be seen.
        assert not c.detected or c.value < 1e-3 * Q


def test_white_noise_is_folded_whole_also_that_of_a_model():
    """Shares scatter by 2 to 3 %, of 2,048 samples by 4. No filter is seen, hence no rate is needed."""
    result = aj.sample_rates(bench.recording("white"), [12.5, 50.0])["gyro_x"]
    assert_allclose(result.aliased, [0.0, 0.5, 0.875], atol=0.08)
    assert (result.bandwidth, result.needed) == (None, None)
    found = aj.sample_rates(aj.AngleRandomWalk(3e-3), [20.0], rate=40.0, duration=51.2, sensor="accel")
    assert (found.picked[0].n, list(found["accel"].rates)) == (2048, [40.0, 20.0])
    # 250 clusters of eight have some 350 degrees of freedom.
    assert_allclose(found["accel"].picked[0], 9e-6, rtol=0.3)
    assert_allclose(found["accel"].aliased, [0.0, 0.5], atol=0.16)
    assert found["accel"].needed is None


@pytest.mark.usefixtures("no_windows")
def test_it_is_told_drawn_and_exported(results):
    found, axis = results["quantized"], results["quantized"]["gyro_x"]
    frame = found.to_dataframe()
    (document,) = json.loads(json.dumps(found.to_dict(), allow_nan=False))["axes"]
    columns = {name: getattr(axis, name) for name in ("picked", "averaged", "aliased", "from_quantization")}
    for name, values in (columns | {"rate": axis.rates}).items():
        assert_array_equal([frame[name], document[name]], [values, values])
    assert_array_equal(frame[["aliased_lower_95", "aliased_upper_95"]], axis.aliased_interval)
    bandwidth = {"value": axis.bandwidth.value, "interval_95": list(axis.bandwidth.interval)}
    assert (document["bandwidth"], document["agree_from"]) == (bandwidth, axis.agree_from)
    levels = [float(row[2]) for row in axis.rows()]
    assert_allclose(levels, np.sqrt(axis.picked) * 180.0 / np.pi * 60.0, rtol=6e-3)
    for how, curves in (("picked", found.picked), ("averaged", found.averaged)):
        for points, curve in zip(found.plot(how=how).axes[0].containers, curves, strict=True):
            assert_allclose(points[0].get_ydata(), curve.deviation[:, 0] * 180.0 / np.pi * 3600.0)
    refuses("how", found.plot, how="other")


def test_the_lowest_rate_before_the_curves_part(results):
    axis, rates = results["quantized"]["gyro_x"], np.array([200.0, 100.0, 50.0, 20.0])
    own = {f.name: np.asarray(getattr(axis, f.name)) for f in dataclasses.fields(axis)}
    longer = {k: np.zeros((4, *x.shape[1:])) for k, x in own.items() if x.shape[:1] == axis.rates.shape}
    for aliased, expected in (([0.02, 0.3, 0.01], 100.0), ([0.049, 0.05, 0], 20.0), ([0.0501, 0, 0], 200.0)):
        found = longer | {"rates": rates, "aliased": np.array([0.0, *aliased])}
        assert dataclasses.replace(axis, **found).agree_from == expected


def test_what_is_wrong_is_refused():
    x, model = SAMPLES["butterworth"], aj.AngleRandomWalk(N)
    refused = [(x, [30.0], RATE, "30 Hz"), (x, [0.1], RATE, "0.1 Hz"), (x[:499], None, RATE, "500")]
    refused += [({"gyro_x": 1.0}, None, RATE, "dict"), (model, None, None, "rate")]
    for data, rates, rate, word in refused:
        refuses(word, aj.sample_rates, data, rates, rate=rate, gyro_unit="rad/s")
