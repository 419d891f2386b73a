"""Decomposition into octaves against PyWavelets itself, and de-noising at the level of a model."""

import dataclasses

import numpy as np
import pytest
import pywt
from phase_laws import LAWS, autocovariance, mixed

import allanjax as aj

RATE, N = 10.0, 3001
NAMES = ("gyro_x", "accel_z")


@pytest.fixture(scope="module")
def recording():
    values = 0.01 + np.random.default_rng(5).normal(size=(N, 2)) * [1e-4, 3e-3]
    values[:, 0] += 1e-5 * np.random.default_rng(6).normal(size=N).cumsum()
    axes = (aj.Axis("gyro_x", "gyro", "deg/s"), aj.Axis("accel_z", "accel", "g"))
    return aj.Recording(values, RATE, axes)


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


def smooth(x: np.ndarray, wavelet: str, level: int) -> np.ndarray:
    """What is left of an axis: single transforms down, and up again with details of zero."""
    lengths = []
    for _ in range(level):
        lengths.append(len(x))
        x, _ = pywt.dwt(x, wavelet)
    for n in reversed(lengths):
        x = pywt.idwt(x, None, wavelet)[:n]
    return x


def test_an_approximation_is_what_pywavelets_makes_of_the_coefficients(recording, decomposition):
    found = decomposition.approximation(3)
    for axis in range(2):
        expected = smooth(recording.values[:, axis], "db4", 3)
        np.testing.assert_allclose(found.values[:, axis], expected, atol=1e-15)
    assert (found.rate, found.axes) == (RATE, recording.axes)
    assert found.notes[-1].endswith("below 0.625 Hz")


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


def test_the_table_has_the_means_of_the_details(decomposition):
    table = decomposition.to_dataframe()
    units = {"gyro_x": ("deg/h", "(deg/h)²", np.pi / 180.0 / 3600.0), "accel_z": ("µg", "µg²", 9.80665e-6)}
    details = [decomposition.details(k).values for k in range(1, 6)]
    for axis, (name, (unit, square, scale)) in enumerate(units.items()):
        means = [d[:, axis].mean() / scale for d in details]
        np.testing.assert_allclose(table[f"{name} mean [{unit}]"], means, rtol=1e-9, atol=1e-9)
        squares = [np.mean(d[:, axis] ** 2) / scale**2 for d in details]
        np.testing.assert_allclose(table[f"{name} mean square [{square}]"], squares)
    np.testing.assert_array_equal(table[["from [Hz]", "to [Hz]"]], decomposition.band)
    assert list(table["to [Hz]"]) == [5.0, 2.5, 1.25, 0.625, 0.3125]


# --- De-noising ---------------------------------------------------------------------------------------------


@dataclasses.dataclass
class Fitted:
    model: aj.Model


def variances(parts: dict[str, float], wavelet: str, levels: int) -> np.ndarray:
    """Wavelet variances of noises of these coefficients, from the filters of the levels by brute force."""
    low, high = (np.array(f) / np.sqrt(2.0) for f in pywt.Wavelet(wavelet).filter_bank[:2])
    law = mixed(*((c, LAWS[name]) for name, c in parts.items()))
    R = autocovariance(law, 2**levels * len(low), RATE)
    found, passed = [], np.ones(1)
    for k in range(levels):
        spread = np.zeros((2, 2**k * (len(low) - 1) + 1))
        spread[:, :: 2**k] = low, high
        h = np.convolve(passed, spread[1])
        passed = np.convolve(passed, spread[0])
        lags = np.correlate(h, h, "full")[len(h) - 1 :]
        found.append(lags[0] * R[0] + 2.0 * lags[1:] @ R[1 : len(h)])
    return np.array(found)


@pytest.mark.parametrize("wavelet", ["haar", "db2"])
def test_the_level_is_the_last_at_which_noise_without_memory_exceeds_the_drift(recording, wavelet):
    """Of each axis by its own model; white is quantization too, and a ramp or a line is neither.

    With Haar, half the Allan variance: N²/2T and K²T/6 cross at T = √3 N/K = 8.7 s, and of the scales
    0.1 s·2^(j−1) that of level 7, 6.4 s, is the last below.
    """
    x = aj.AngleRandomWalk(1e-4) + aj.RateRandomWalk(2e-5)
    z = aj.Quantization(3e-3) + aj.RateRandomWalk(2e-3) + aj.DriftRamp(1.0) + aj.Sinusoid(1.0, 0.5)
    found = aj.denoise(recording, {"gyro_x": Fitted(x), "accel_z": Fitted(z)}, wavelet=wavelet)
    assert found.wavelet == wavelet
    parts = {
        "gyro_x": ({"white": 1e-4}, {"walk": 2e-5}),
        "accel_z": ({"quantization": 3e-3}, {"walk": 2e-3}),
    }
    for k, (name, (white, drift)) in enumerate(parts.items()):
        result = found[name]
        levels = len(result.white)
        assert levels == pywt.dwt_max_level(N, wavelet)
        white, drift = (variances(part, wavelet, levels) for part in (white, drift))
        # Beyond level 7 the filters' ripples are averaged, which only quantization's rising spectrum sees.
        np.testing.assert_allclose(result.white[:7], white[:7], rtol=1e-5)
        np.testing.assert_allclose(result.white, white, rtol=0.1 if name == "accel_z" else 1e-4)
        np.testing.assert_allclose(result.drift, drift, rtol=1e-4)
        assert result.level == np.flatnonzero(white > drift)[-1] + 1
        assert result.cutoff == RATE / 2.0 ** (result.level + 1)
        smoothed = smooth(recording.values[:, k], wavelet, result.level)
        np.testing.assert_allclose(found.recording.values[:, k], smoothed, atol=1e-14)
        table = result.to_dataframe()
        assert table["taken out"].sum() == result.level
        unit, scale = {
            "gyro_x": ("(deg/h)²", (np.pi / 180.0 / 3600.0) ** 2),
            "accel_z": ("µg²", 9.80665e-6**2),
        }[name]
        np.testing.assert_allclose(table[f"white noise [{unit}]"], result.white / scale)
        np.testing.assert_allclose(table[f"drift [{unit}]"], result.drift / scale)
    if wavelet == "haar":
        assert found["gyro_x"].level == 7
    assert found["accel_z"].level != found["gyro_x"].level


def test_without_drift_no_octave_is_kept_and_without_white_noise_all_are(recording):
    walk, white = aj.Model((aj.RateRandomWalk(1e-5),)), aj.Model((aj.AngleRandomWalk(1e-4),))
    found = aj.denoise(recording, {"gyro_x": Fitted(walk), "accel_z": Fitted(white)}, wavelet="db2")
    x, z = found.results
    assert (x.level, z.level) == (0, len(z.white))
    assert not x.white.any()
    assert not z.drift.any()
    np.testing.assert_allclose(found.recording.values[:, 0], recording.values[:, 0], rtol=1e-9)
    # One model is that of all axes.
    same = aj.denoise(recording, white, wavelet="db2")
    assert [r.level for r in same.results] == [z.level, z.level]
    np.testing.assert_array_equal(same["gyro_x"].white, z.white)


def test_refused(recording, decomposition):
    with pytest.raises(aj.AllanjaxError, match="'mexh'"):
        aj.wavelet_decomposition(recording, wavelet="mexh")
    with pytest.raises(aj.AllanjaxError, match="8 levels"):
        aj.wavelet_decomposition(recording, levels=9)
    assert aj.wavelet_decomposition(recording, levels=8).levels == 8
    with pytest.raises(aj.AllanjaxError, match="level 6"):
        decomposition.details(6)
    with pytest.raises(aj.AllanjaxError, match="level 0"):
        decomposition.details(0)
    with pytest.raises(aj.AllanjaxError, match="'accel_z'"):
        aj.denoise(recording, {"gyro_x": Fitted(aj.Model((aj.AngleRandomWalk(1.0),)))})
