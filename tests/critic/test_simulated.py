"""What is simulated from a critique's models is like the record: bias, step, line, temperature and all."""

import numpy as np
import pytest
from scipy.signal import lfilter

import allanjax as aj
from allanjax.critic.causes.outliers import Outliers

N, RATE, CAUSES = 30_000, 50.0, ["bias_step", "low_pass", "sinusoid", "temperature"]
TIME = (np.arange(N) + 0.5) / RATE
#: Degrees, and of the second axis grams.
DEGREES, GRAVITY = np.pi / 180.0, 9.80665
SIGMA = 1e-3


@pytest.fixture(scope="module")
def recorded():
    """A gyro with a filter at 9 Hz, a step down, a line and a late temperature; an accelerometer without."""
    rng = np.random.default_rng(77)
    w = np.exp(-2.0 * np.pi * 9.0 / RATE)
    wander = np.cumsum(rng.standard_normal(N)) / np.sqrt(N)
    temperature = 25.0 + 5.0 * np.sin(2.0 * np.pi * TIME / 400.0) + 1.5 * wander
    late = np.concatenate([np.full(750, temperature[0]), temperature[:-750]])
    x = lfilter([1.0 - w], [1.0, -w], rng.standard_normal(N)) - 0.05 * late
    x += 0.1 * np.sin(2.0 * np.pi * 1.7 * TIME + 0.3) - 0.6 * (TIME > 400.0)
    values = np.stack([SIGMA * x / DEGREES + 1.0, 1.0 + SIGMA * rng.standard_normal(N)], axis=1)
    return aj.Recording.from_array(
        values,
        RATE,
        gyro_unit="deg/s",
        accel_unit="g",
        names=["gyro_z", "accel_x"],
        auxiliary={"temperature": temperature},
    )


@pytest.fixture(scope="module")
def found(recorded):
    return aj.critique(recorded)


@pytest.fixture(scope="module")
def again(recorded, found):
    return found.simulate(5, auxiliary=recorded.auxiliary)


def deviations(x, sizes):
    total = np.concatenate([[0.0], np.cumsum(x - x.mean())])
    differences = (total[2 * m :] - 2.0 * total[m:-m] + total[: -2 * m] for m in sizes)
    return np.array([np.sqrt(0.5 * np.mean((d / m) ** 2)) for d, m in zip(differences, sizes, strict=True)])


def test_all_that_was_hidden_is_in_the_model(recorded, found):
    assert sorted(f.cause for f in found["gyro_z"].findings) == CAUSES
    assert found["accel_x"].findings == ()
    terms = found.models["gyro_z"].term_labels
    assert {"sinusoid", "bias_step", "channel_effect"} <= set(terms)


def test_a_simulation_has_the_axes_units_and_channels_of_the_record(recorded, again):
    assert again.names == recorded.names
    assert [axis.unit for axis in again.axes] == ["deg/s", "g"]
    assert (again.rate, again.n) == (RATE, N)
    assert again.notes == ("simulated",)
    np.testing.assert_array_equal(again.auxiliary["temperature"], recorded.auxiliary["temperature"])


@pytest.mark.parametrize("axis", [0, 1])
def test_allan_deviations_agree_within_their_scatter(recorded, again, axis):
    sizes = 2 ** np.arange(11)
    x, y = (deviations(r.values[:, axis], sizes) for r in (recorded, again))
    # Of white noise in N/m clusters a deviation scatters by √(0.75·m/N) of itself, of filtered noise for
    # small m by more; two of them, four standard deviations, and the levels are known to half a per cent.
    scatter = np.sqrt(2.0 * 0.75 * np.maximum(sizes, 8) / N)
    assert np.all(abs(np.log(y / x)) < 4.0 * scatter + 0.01)


def test_the_simulation_follows_the_channel_and_steps_as_the_record_does(recorded, again):
    """Means over ten seconds differ by no more than both noises: bias, signs and the lag are as recorded."""
    m = 500
    means = [r.values[:, 0].reshape(-1, m).mean(axis=1) for r in (recorded, again)]
    noise = SIGMA * np.sqrt(2.0 / m)
    difference = means[1] - means[0]
    # The step is located within some samples, and what is estimated is known to a tenth of such a mean.
    assert np.max(abs(difference)) < 5.0 * noise
    assert np.std(difference) == pytest.approx(noise, rel=0.5)
    correlation = [np.corrcoef(r.values[:, 0], r.auxiliary["temperature"])[0, 1] for r in (recorded, again)]
    # Of N samples correlated over a few.
    assert correlation[1] == pytest.approx(correlation[0], abs=5.0 / np.sqrt(N / 4.0))
    assert correlation[0] < -0.1


def test_the_line_keeps_its_phase(recorded, again):
    wave = np.exp(2j * np.pi * 1.7 * TIME)
    lines = [2.0 / N * np.vdot(wave, r.values[:, 0] - r.values[:, 0].mean()) for r in (recorded, again)]
    assert abs(lines[0]) == pytest.approx(0.1 * SIGMA, rel=0.2)
    # Each of the two is known by N samples, and the critic's own estimate is as good as the first.
    assert abs(lines[1] - lines[0]) < 4.0 * SIGMA * np.sqrt(2.0 / N) * np.sqrt(2.0)


def test_an_effect_whose_channel_is_not_given_is_left_out_and_that_is_said(recorded, found):
    without = found.simulate(5)
    (note,) = [note for note in without.notes if "temperature" in note]
    assert note.startswith("gyro_z: the effect of temperature is left out")
    given = found.simulate(5, auxiliary=recorded.auxiliary)
    effect = given.values - without.values
    (temperature,) = recorded.auxiliary.values()
    late = np.concatenate([np.full(750, temperature[0]), temperature[:-750]])
    # The lag is known within two seconds of the four hundred of the wave.
    assert np.corrcoef(effect[:, 0], late)[0, 1] < -0.995
    assert np.all(effect[:, 1] == 0.0)
    with pytest.raises(aj.RecordingError, match="'temperature' has the shape"):
        found.simulate(5, auxiliary={"temperature": temperature[:-1]})


def test_what_no_term_stands_for_is_said():
    """Outliers are in the samples, not in the model."""
    rng = np.random.default_rng(3)
    x = SIGMA * rng.standard_normal(N)
    x[rng.choice(N, 20, replace=False)] += 0.05
    recording = aj.Recording.from_array(x, RATE, gyro_unit="rad/s", names=["gyro_x"])
    found = aj.critique(recording, causes=[Outliers()])
    assert [f.cause for f in found.findings] == ["outliers"]
    assert "gyro_x: not simulated: outliers" in found.simulate(1, n=1000).notes


def test_terms_of_the_baseline_are_in_the_extended_model():
    """What the given model has besides basic terms was not looked for, but is there."""
    rng = np.random.default_rng(4)
    x = SIGMA * (rng.standard_normal(N) + np.sin(2.0 * np.pi * 3.0 * TIME))
    recording = aj.Recording.from_array(x, RATE, gyro_unit="rad/s", names=["gyro_x"])
    fit = aj.fit(recording, aj.AngleRandomWalk() + aj.Sinusoid(frequency=3.0), objective="whittle")
    simulated = aj.critique(recording, fit, causes=[]).simulate(1)
    # The line has half of the square of its amplitude, two thirds of the noise's power together.
    assert np.std(simulated.values) == pytest.approx(np.std(x), rel=0.03)
