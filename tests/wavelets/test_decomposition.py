"""Decomposition into octaves against PyWavelets itself, and de-noising at the level of a model."""

import dataclasses

import numpy as np
import pytest
import pywt

import allanjax as aj
from allanjax.wavelets.denoising import AxisDenoising

MODEL = aj.AngleRandomWalk(1e-4) + aj.RateRandomWalk(2e-5)


@pytest.fixture(scope="module")
def recording():
    models = {"gyro_x": MODEL, "gyro_y": aj.Model((aj.AngleRandomWalk(1e-4),))}
    return aj.simulate_recording(models, 3001, 10.0, 5, bias={"gyro_x": 0.01})


@pytest.fixture(scope="module")
def decomposition(recording):
    return aj.wavelet_decomposition(recording, wavelet="db4", levels=5)


def test_details_and_approximation_add_up_to_the_record(recording, decomposition):
    """To rounding, at every level."""
    total = np.zeros_like(recording.values)
    for level in range(1, 6):
        total += decomposition.details(level).values
        whole = total + decomposition.approximation(level).values
        np.testing.assert_allclose(whole, recording.values, atol=1e-12 * abs(recording.values).max())
    np.testing.assert_allclose(decomposition.approximation(0).values, recording.values, rtol=1e-9)


def test_an_approximation_is_what_pywavelets_makes_of_the_coefficients(recording, decomposition):
    """Step by step: single transforms down, and up again with details of zero."""
    x, lengths = recording.values[:, 0], []
    for _ in range(3):
        lengths.append(len(x))
        x, _ = pywt.dwt(x, "db4")
    for n in reversed(lengths):
        x = pywt.idwt(x, None, "db4")[:n]
    found = decomposition.approximation(3)
    np.testing.assert_allclose(found.values[:, 0], x, atol=1e-15)
    assert found.rate == recording.rate
    assert found.notes[-1] == "approximation at level 3 of db4, below 0.625 Hz"


def test_bands_hold_the_lines_that_are_in_them():
    """A line in the middle of each octave: nearly all of its power is in the details of that level."""
    t = np.arange(4096) / 64.0
    for level, (low, high) in enumerate(32.0 / 2.0 ** np.array([[k + 1, k] for k in range(4)]), start=1):
        line = np.cos(2.0 * np.pi * np.sqrt(low * high) * t)
        found = aj.wavelet_decomposition(
            line, 64.0, wavelet="db8", levels=5, gyro_unit="rad/s", names=["gyro_x"]
        )
        np.testing.assert_allclose(found.band[level - 1], [low, high])
        share = np.var(found.details(level).values) / np.var(line)
        # Ends apart; a filter of length 16 leaves a few per cent in the neighbours.
        assert 0.9 < share < 1.1


def test_the_table_has_the_means_of_the_details(recording, decomposition):
    table = decomposition.to_dataframe()
    hour = np.pi / 180.0 / 3600.0
    means = [decomposition.details(k).values[:, 1].mean() / hour for k in range(1, 6)]
    np.testing.assert_allclose(table["gyro_y mean [deg/h]"], means, atol=1e-9)
    squares = [np.mean(decomposition.details(k).values[:, 0] ** 2) / hour**2 for k in range(1, 6)]
    np.testing.assert_allclose(table["gyro_x mean square [(deg/h)²]"], squares)
    assert list(table["to [Hz]"]) == [5.0, 2.5, 1.25, 0.625, 0.3125]


def test_the_level_is_the_last_at_which_white_noise_exceeds_the_drift(recording):
    """With Haar: half the Allan variance, N²/2T against K²T/6, so that they cross at T = √3 N/K = 8.7 s.

    Scales are 0.1 s·2^(j−1): that of level 7, 6.4 s, is the last below.
    """
    found = aj.denoise(recording, MODEL, wavelet="haar")
    assert [r.level for r in found.results] == [7, 7]
    T = 0.1 * 2.0 ** np.arange(len(found["gyro_x"].white))
    np.testing.assert_allclose(found["gyro_x"].white, 1e-8 / (2.0 * T), rtol=1e-9)
    np.testing.assert_allclose(found["gyro_x"].drift, 4e-10 * T / 6.0, rtol=1e-9)
    assert found["gyro_x"].cutoff == 10.0 / 2**8
    assert "level 7" in str(found)
    assert "below 0.0391 Hz" in str(found)
    smooth = aj.wavelet_decomposition(recording, wavelet="haar").approximation(7)
    np.testing.assert_array_equal(found.recording.values, smooth.values)


def test_a_fit_gives_every_axis_its_own_level(recording):
    """What has no drift keeps none of the octaves, what has no white noise all."""

    @dataclasses.dataclass
    class Result:
        model: aj.Model

    walk = aj.Model((aj.RateRandomWalk(1e-5),))
    fits = {"gyro_x": Result(walk), "gyro_y": Result(aj.Model((aj.AngleRandomWalk(1e-4),)))}
    found = aj.denoise(recording, fits, wavelet="db2")
    x, y = found.results
    assert isinstance(x, AxisDenoising)
    assert (x.level, y.level) == (0, len(y.white))
    np.testing.assert_allclose(found.recording.values[:, 0], recording.values[:, 0], rtol=1e-9)
    assert "drift prevails from the start" in x.reason
    assert "drift prevails nowhere" in y.reason
    with pytest.raises(aj.AllanjaxError, match="the fit has no axis 'gyro_y'"):
        aj.denoise(recording, {"gyro_x": Result(walk)})


def test_errors_name_the_remedy(recording, decomposition):
    with pytest.raises(aj.AllanjaxError, match="unknown wavelet 'mexh'"):
        aj.wavelet_decomposition(recording, wavelet="mexh")
    with pytest.raises(aj.AllanjaxError, match="3001 samples have at most 8 levels of db4, not 12"):
        aj.wavelet_decomposition(recording, levels=12)
    with pytest.raises(aj.AllanjaxError, match="no level 6: this decomposition has 1 to 5"):
        decomposition.details(6)
    assert repr(decomposition).startswith(
        "WaveletDecomposition(db4; 5 levels of details from 0.156 Hz to 5 Hz"
    )
