"""Slopes of the spectrum against simulated noise of known coefficients, and what they must not read."""

import numpy as np
import pytest

import allanjax as aj
from allanjax.spectrum.slopes import SLOPES, unit_densities

RATE = 10.0
CASES = {
    "quantization": aj.Quantization(3e-6),
    "angle_random_walk": aj.AngleRandomWalk(1e-5),
    "bias_instability": aj.BiasInstability(2e-5),
    "rate_random_walk": aj.RateRandomWalk(1e-6),
}


def recording(model, n, seed):
    return aj.simulate_recording({f"gyro_{a}": model for a in "xyz"}, n, RATE, seed)


@pytest.mark.parametrize("label", CASES)
def test_a_term_alone_is_read_and_no_other(label):
    """Every interval of three axes holds the truth; a chance of one in 20 each, and these are fixed draws."""
    model = aj.Model((CASES[label],))
    for axis in aj.power_spectrum(recording(model, 2**15, 3)).readings().values():
        found = {name: e for name, e in axis.estimates.items() if e is not None}
        assert list(found) == [label]
        estimate, truth = found[label], model.terms[0].coefficient
        assert estimate.interval[0] <= truth <= estimate.interval[1]
        assert estimate.band[1] > 2.0 * estimate.band[0]
        # A standard deviation of the log of an octave's mean or more.
        assert 0.0 < estimate.std < 0.2 * truth


def test_between_two_slopes_no_third_is_read():
    """White noise turns to a random walk over an octave of slopes about −1: that is no flicker noise."""
    model = aj.AngleRandomWalk(1e-5) + aj.RateRandomWalk(1e-6)
    readings = aj.power_spectrum(recording(model, 2**17, 4)).readings()
    for axis in readings.values():
        assert axis["bias_instability"] is None
        assert axis["drift_ramp"] is None
        assert axis["quantization"] is None
        assert axis["rate_random_walk"].value == pytest.approx(1e-6, rel=0.3)
        assert axis["angle_random_walk"].value == pytest.approx(1e-5, rel=0.02)


def test_the_stretch_is_where_the_slope_is():
    """Density and random walk cross at f = K/(2πN) = 0.0159 Hz: K is read below, N above."""
    model = aj.AngleRandomWalk(1e-5) + aj.RateRandomWalk(1e-6)
    axis = aj.power_spectrum(recording(model, 2**17, 4)).readings()["gyro_x"]
    assert axis["rate_random_walk"].band[1] < 0.016
    assert axis["angle_random_walk"].band[0] > 0.016


def test_white_noise_is_that_of_equation_3_41():
    spectrum = aj.power_spectrum(recording(aj.Model((aj.AngleRandomWalk(1e-5),)), 2**14, 5))
    assert spectrum.readings()["gyro_y"]["angle_random_walk"] == spectrum.random_walk("gyro_y")


def test_unit_densities_have_the_slopes_they_are_called_by():
    """Twice the two-sided densities (4.28), (4.38), (4.52), (4.58), written out; far below Nyquist."""
    f = np.array([1e-3, 1e-2])
    density = unit_densities(f, RATE)
    w = 2.0 * np.pi * f
    by_hand = 2.0 * np.stack([w**2 / RATE, np.ones(2), 1.0 / w, w**-2.0, w**-3.0], axis=1)
    np.testing.assert_allclose(density, by_hand, rtol=1e-4)
    np.testing.assert_allclose(np.log10(density[1] / density[0]), list(SLOPES.values()), atol=1e-4)


def test_what_is_not_read_says_so_in_table_and_text(small_recording):
    readings = aj.power_spectrum(small_recording).readings()
    table = readings.to_dataframe()
    row = table[(table["axis"] == "accel_z") & (table["coefficient"] == "drift_ramp")].iloc[0]
    assert np.isnan(row["value"])
    assert row["reason"] == "no octave of slope -3 that is mostly its own"
    walk = readings["gyro_x"]["angle_random_walk"].in_unit()
    row = table[(table["axis"] == "gyro_x") & (table["coefficient"] == "angle_random_walk")].iloc[0]
    assert (row["value"], row["unit"]) == (walk.value, "deg/√h")
    assert "none: no octave of slope -3" in str(readings)
    with pytest.raises(aj.AllanjaxError, match="coefficients need the samples' unit"):
        aj.power_spectrum(small_recording.values, 100.0).readings()
