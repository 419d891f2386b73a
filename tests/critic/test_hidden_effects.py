"""The generator of hidden effects makes what it says it does."""

import hidden_sensors
import numpy as np
import pytest
import scipy.fft
import scipy.linalg
import scipy.signal
from hidden_effects import CAUSES, PATHS, draw

RATE = 100.0
SMALL = {"duration": 5.12, "rate": RATE}
CORRELATION_TIME = 0.7
DENSITIES = {
    "N": lambda w: np.ones_like(w),
    "Q": lambda w: w**2 / RATE,
    "B": lambda w: 1.0 / w,
    "K": lambda w: 1.0 / w**2,
    "M": lambda w: CORRELATION_TIME**2 / (1.0 + (w * CORRELATION_TIME) ** 2),
}


def covariance(sensor, n):
    """Of a record [n, n], written in time."""
    size = scipy.fft.next_fast_len(2 * n, real=True)
    flicker = np.concatenate([[0.0], 1.0 / (2.0 * np.pi * np.arange(1, size // 2 + 1) / size)])
    lags = np.arange(n) / RATE
    time = sensor.get("Tc", 1.0)
    unit = {
        "N": RATE * np.eye(n),
        "Q": RATE**2 * scipy.linalg.toeplitz([2.0, -1.0, *np.zeros(n - 2)]),
        "B": scipy.linalg.toeplitz(scipy.fft.irfft(flicker, size)[:n]),
        "K": np.minimum.outer(np.arange(1, n + 1), np.arange(1, n + 1)) / RATE,
        "M": scipy.linalg.toeplitz(0.5 * time * np.exp(-lags / time)),
    }
    return sum(sensor[c] ** 2 * unit[c] for c in unit if c in sensor)


def of_differences(sensor, n):
    """Covariance of the differences between samples, which do not know the bias."""
    return np.diff(np.diff(covariance(sensor, n), axis=0), axis=1)


def snr(sensor, path):
    """Of a known path in a record with unknown bias."""
    differences = np.diff(path)
    return np.sqrt(differences @ np.linalg.solve(of_differences(sensor, len(path)), differences))


def at(multiple, seed, cause):
    return draw(seed, cause, multiple, **SMALL)


@pytest.mark.parametrize("term", DENSITIES)
def test_noise_has_its_density(term):
    noise = hidden_sensors.term_noise(term, 2**18, RATE, np.random.default_rng(1), CORRELATION_TIME)
    frequency, density = scipy.signal.welch(noise, RATE, nperseg=1024)
    low = slice(4, 50)  # the samples' density is that of continuous time
    ratio = density[low] / 2.0 / DENSITIES[term](2.0 * np.pi * frequency[low])
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.04)  # 4 standard errors
    assert np.std(ratio) < 0.15


@pytest.mark.parametrize("term", DENSITIES)
def test_noise_has_the_variances_that_limits_count_on(term):
    rng = np.random.default_rng(2)
    records = [hidden_sensors.term_noise(term, 256, RATE, rng, CORRELATION_TIME) for _ in range(4000)]
    squares = np.mean(scipy.fft.dct(np.array(records), norm="ortho")[:, 1:] ** 2, axis=0)
    ratio = squares / hidden_sensors.term_variances(term, 256, RATE, CORRELATION_TIME)
    assert ratio == pytest.approx(1.0, abs=0.12)  # 5 standard errors


@pytest.mark.parametrize("cause", [*PATHS, "outliers", "disturbance"])
def test_known_paths_are_so_many_times_their_limit(cause):
    for seed in range(12):
        low, high = (at(m, seed, cause) for m in (40.0, 80.0))
        expected = 5.0 * (high.effects[0].multiple - low.effects[0].multiple)
        sensor = {k: v for k, v in low.sensor.items() if k != "R"}
        path = (high.values - low.values)[:, 0]
        assert snr(sensor, path) == pytest.approx(expected, rel=0.001), (seed, sensor)


@pytest.mark.parametrize("cause", ["quantization", "bias_instability", "rate_random_walk", "markov"])
def test_terms_at_their_limit_are_just_detectable(cause):
    for seed in range(12):
        hidden = at(1.0, seed, cause)
        letters = {"quantization": "Q", "bias_instability": "B", "rate_random_walk": "K", "markov": "M"}
        without = {k: v for k, v in hidden.sensor.items() if k != letters[cause]}
        null, truth = (of_differences(x, len(hidden.values)) for x in (without, hidden.sensor))
        ratio = np.linalg.solve(null, truth)
        llr = 0.5 * (np.trace(ratio) - len(ratio) - np.linalg.slogdet(ratio)[1])
        assert llr == pytest.approx(12.5, rel=0.1), (seed, without)


@pytest.mark.parametrize("cause", [*CAUSES, None, ("sinusoid", "low_pass"), ("rounding", "temperature")])
def test_every_cause_draws_and_repeats(cause):
    hidden, again, other = (draw(seed, cause, duration=100.0, rate=50.0) for seed in (4, 4, 5))
    assert np.all(np.isfinite(hidden.values))
    assert hidden.values.shape == (5000, len(hidden.names))
    assert [e.cause for e in hidden.effects] == ([] if cause is None else np.atleast_1d(cause).tolist())
    assert np.array_equal(hidden.values, again.values)
    assert not np.array_equal(hidden.values, other.values)
    assert ("temperature" in hidden.auxiliary) or "temperature" not in np.atleast_1d(cause)
    assert all(x.shape == (5000,) for x in hidden.auxiliary.values())


@pytest.mark.parametrize("seed", range(8))
def test_records_of_natural_length_are_quick_to_handle(seed):
    hidden = draw(seed, None)
    assert len(hidden.values) <= 400_000
    assert 600.0 <= len(hidden.values) / hidden.rate <= 3600.0
    assert 50.0 <= hidden.rate <= 400.0


@pytest.mark.parametrize("seed", range(6))
def test_resonance_has_its_amplitude_frequency_and_width(seed):
    low, high = (draw(seed, "resonance", m, duration=1000.0, rate=RATE) for m in (1.0, 2.0))
    path = (high.values - low.values)[:, 0]
    truth = low.effects[0].parameters
    assert np.std(path) == pytest.approx(truth["amplitude"], rel=0.2)
    frequency, density = scipy.signal.welch(path, RATE, nperseg=8192)
    tolerance = 0.5 / truth["quality_factor"] + 0.01
    assert frequency[np.argmax(density)] == pytest.approx(truth["frequency"], rel=tolerance)


@pytest.mark.parametrize("seed", range(6))
def test_low_pass_halves_the_density_at_its_bandwidth(seed):
    hidden = draw(seed, "low_pass", duration=2000.0, rate=RATE)
    bandwidth = hidden.effects[0].parameters["bandwidth"]
    frequency, density = scipy.signal.welch(hidden.values[:, 0], RATE, nperseg=1024)
    near = np.abs(frequency - bandwidth) < 1.0
    quantization = 4.0 * RATE * hidden.sensor.get("Q", 0.0) ** 2 * np.sin(np.pi * bandwidth / RATE) ** 2
    assert np.mean(density[near]) == pytest.approx(hidden.sensor["N"] ** 2 + quantization, rel=0.12)


def test_shared_and_changed_variances_are_as_told():
    shared = draw(1, "common_mode", 1000.0, duration=500.0, rate=RATE)
    gains = np.array(shared.effects[0].parameters["gains"])
    correlations = np.corrcoef(np.diff(shared.values, axis=0), rowvar=False) - np.eye(3)
    share = 1.0 / (1.0 + 3.0 * (shared.sensor.get("Q", 0.0) / shared.sensor["N"]) ** 2 * RATE)
    expected = (
        shared.effects[0].parameters["correlation"] * share * (np.outer(gains, gains) - np.diag(gains**2))
    )
    assert correlations == pytest.approx(expected, abs=0.05)
    low, high = (draw(1, "variance_change", m, duration=500.0, rate=RATE) for m in (1.0, 4.0))
    inside = (high.values - low.values)[:, 0]
    truth = low.effects[0].parameters
    white = low.sensor["N"] * np.sqrt(RATE)
    times = np.arange(len(inside)) / RATE
    assert np.all((inside != 0.0) == ((times >= truth["start"]) & (times < truth["end"])))
    expected = white * np.sqrt(truth["ratio"] ** 2 - 1.0)
    assert np.std(inside[inside != 0.0]) == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize("seed", range(4))
def test_changes_of_samples_are_as_told(seed):
    saturation, rounding, repeats = (
        draw(seed, c, duration=300.0, rate=RATE) for c in ("saturation", "rounding", "repeated_samples")
    )
    assert np.max(saturation.values) == saturation.effects[0].parameters["level"]
    assert np.sum(saturation.values == np.max(saturation.values)) > 50
    steps = rounding.values / rounding.effects[0].parameters["step"]
    assert steps == pytest.approx(np.round(steps), abs=1e-6)
    same = np.diff(repeats.values[:, 0]) == 0.0
    truth = repeats.effects[0].parameters
    assert np.mean(same) == truth["fraction"]
    assert max(len(x) for x in "".join("01"[int(s)] for s in same).split("0")) == truth["longest"]
