"""Several effects at once, behind a filter: all are found, and the model is what was measured."""

import numpy as np
import pytest
from scipy.signal import lfilter

import allanjax as aj

N, RATE = 60_000, 100.0
TIME = np.arange(N) / RATE


def oscillation(frequency, quality, rng):
    """A damped oscillator that noise drives, of unit deviation, at a sixteenth of its sampling interval."""
    over = 16
    f = np.fft.rfftfreq(N * over, 1.0 / (RATE * over)) / frequency
    drive = np.fft.rfft(rng.standard_normal(N * over))
    x = np.fft.irfft(drive / (1.0 - f**2 + 1j * f / quality), N * over)[::over]
    return x / x.std()


def sensor(seed):
    """White noise and a walk behind a pole at 18 Hz, a resonance, a line and a step."""
    rng = np.random.default_rng([41, seed])
    w = np.exp(-2.0 * np.pi * 18.0 / RATE)
    noise = rng.standard_normal(N) + 2e-3 * np.cumsum(rng.standard_normal(N))
    x = lfilter([1.0 - w], [1.0, -w], noise) + 0.4 * oscillation(30.0, 12.0, rng)
    return 1e-3 * (x + 0.05 * np.sin(2.0 * np.pi * 1.7 * TIME + 0.3) + 0.6 * (TIME > 400.0))


def deviations(x, sizes):
    total = np.concatenate([[0.0], np.cumsum(x - x.mean())])
    differences = (total[2 * m :] - 2.0 * total[m:-m] + total[: -2 * m] for m in sizes)
    return np.array([np.sqrt(0.5 * np.mean((d / m) ** 2)) for d, m in zip(differences, sizes, strict=True)])


@pytest.mark.parametrize("seed", range(2))
def test_all_effects_of_a_composite_sensor_are_found_and_the_model_is_what_was_measured(seed):
    x = sensor(seed)
    recording = aj.Recording.from_array(x[:, None], RATE, gyro_unit="rad/s", names=["gyro_x"])
    found = aj.critique(recording)
    named = {finding.cause: finding for finding in found.findings}
    assert sorted(f.cause for f in found.findings) == ["bias_step", "low_pass", "resonance", "sinusoid"]
    for cause, label, truth in (
        ("low_pass", "bandwidth", np.arccos(2.0 - np.cosh(2.0 * np.pi * 18.0 / RATE)) * RATE / (2.0 * np.pi)),
        ("resonance", "frequency", 30.0),
        ("resonance", "quality_factor", 12.0),
        ("sinusoid", "frequency", 1.7),
        ("bias_step", "time", 400.0),
    ):
        estimate = named[cause].parameters[label]
        assert abs(estimate.value - truth) < 4.0 * estimate.std, (cause, label)
    model = found.models["gyro_x"]
    # The coefficient is that of the noise before the filter, known to 1 %.
    assert model["angle_random_walk"].coefficient == pytest.approx(1e-3 / np.sqrt(RATE), rel=0.04)
    noise = model.without([label for label in model.term_labels if model[label].deterministic])
    sizes = 2 ** np.arange(6)
    left = found["gyro_x"].stages[-1].x
    # Of 1,800 clusters and more the deviation scatters by 2 %.
    expected = np.sqrt(noise.sampled(RATE).allan_variance(sizes / RATE))
    np.testing.assert_allclose(expected, deviations(left, sizes), rtol=0.05)
    # What is simulated from the whole model is like the record, the line and the step included: both scatter.
    again = aj.simulate_recording(found.models, N, RATE, seed, gyro_unit="rad/s")
    np.testing.assert_allclose(deviations(again.values[:, 0], sizes), deviations(x, sizes), rtol=0.08)
