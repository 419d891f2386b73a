"""The generator of composite sensors, which a study judges the critic by, makes what it says."""

import sys
from itertools import pairwise

import numpy as np
import pytest
from places import ROOT
from scipy.fft import dct

sys.path.append(str(ROOT / "benchmarks"))

from common.composite_noise import (
    Filter,
    Resonance,
    flicker,
    flicker_spectrum,
    flicker_theory,
    frequencies,
)
from common.composite_scene import NAMES
from common.composite_sensors import KINDS, composite

RATE, N_SAMPLES = 100.0, 2**16
ALL = [kind for kind in KINDS if kind not in ("rounding behind a matrix", "random outliers")]


def levels(x, expected):
    """Means of the squared cosine coefficients over their expectations in ten bands, and standard errors.

    Up to 0.7 of half the rate: beyond, other coefficients leak into what a filter takes away.
    """
    ratio = dct(x, norm="ortho")[1:] ** 2 / expected[1:]
    edges = np.geomspace(30, 0.7 * len(ratio), 11).astype(int)
    means = np.array([ratio[a:b].mean() for a, b in pairwise(edges)])
    return means, np.sqrt(2.0 / np.diff(edges))


def test_flicker_is_one_over_f():
    f = np.geomspace(RATE / N_SAMPLES / 2.0, RATE / 2.0, 500)
    assert np.allclose(
        flicker_spectrum(frequencies(N_SAMPLES, RATE), RATE)[1:10] * f[0], RATE / np.arange(1, 10)
    )
    # The means over sample intervals of 1/f noise fall short of it, and have aliases.
    assert np.allclose(flicker_theory(f[f < RATE / 20.0], RATE) * f[f < RATE / 20.0] / RATE, 1.0, atol=0.01)
    draws = [flicker(np.random.default_rng(seed), N_SAMPLES, RATE) for seed in range(20)]
    expected = flicker_theory(np.maximum(frequencies(N_SAMPLES, RATE), 1e-6), RATE)
    means = np.mean([levels(x, expected)[0] for x in draws], axis=0)
    error = levels(draws[0], expected)[1] / np.sqrt(len(draws))
    # 20 records know the bands of highest frequency within 0.3 %.
    assert np.all(np.abs(means - 1.0) < 4.0 * error + 0.005)


@pytest.mark.parametrize(
    "made",
    [
        Filter("one pole", 15.0, 1, RATE),
        Filter("two poles", 12.0, 2, RATE, quality=0.8),
        Filter("Butterworth", 20.0, 3, RATE),
        Filter("Bessel", 20.0, 4, RATE),
        Filter("digital IIR", 20.0, 2, RATE),
    ],
    ids=lambda made: made.kind,
)
def test_noise_behind_a_filter_has_the_spectrum_that_is_told(made):
    rng = np.random.default_rng(1)
    f = frequencies(N_SAMPLES, RATE)
    means, error = levels(made.white(rng, N_SAMPLES), made.white_spectrum(f))
    assert np.all(np.abs(means - 1.0) < 4.0 * error)
    resonance = Resonance(8.0, 10.0, RATE, inside=made)
    means, error = levels(resonance.draw(rng, N_SAMPLES), resonance.spectrum(f))
    # The coefficients of so peaked a spectrum leak into each other, far from the peak.
    assert np.all(np.abs(means - 1.0) < 4.0 * error + 0.05)
    assert np.mean(resonance.spectrum(f, filtered=False)) == pytest.approx(1.0, rel=1e-3)


def test_all_effects_at_once_are_told():
    made = composite(5, samples=N_SAMPLES, kinds=ALL)
    assert made.values.shape == (N_SAMPLES, 6)
    assert np.isfinite(made.values).all()
    assert sorted(effect.kind for effect in made.effects) == sorted(ALL)
    assert set(made.auxiliary) == {"temperature"}
    assert tuple(made.axes) == NAMES
    for effect in made.effects:
        assert effect.axes
        assert set(effect.asked) <= set(effect.axes) <= set(NAMES)
        assert all(gain >= 0.0 for gain in effect.gain.values())
        assert all(amplitude >= 0.0 for amplitude in effect.amplitude.values())
    assert all(truth.N > 0.0 for truth in made.axes.values())
    repeats = next(effect for effect in made.effects if effect.kind == "repeats")
    assert np.sum(np.all(np.diff(made.values, axis=0) == 0.0, axis=1)) >= repeats.parameters["count"]


def test_a_seed_is_a_recording_and_a_clean_one_has_no_effects():
    one, same, other = (composite(seed, samples=5000) for seed in (7, 7, 8))
    assert np.array_equal(one.values, same.values)
    assert not np.array_equal(one.values, other.values)
    clean = composite(7, clean=True, samples=5000)
    assert clean.effects == ()
    # White noise is most of what is between neighbours, at the rate's N.
    white = np.std(np.diff(clean.values, axis=0), axis=0) / np.sqrt(2.0 * clean.rate)
    units = {"rad/s": 1.0, "deg/s": np.pi / 180.0, "m/s²": 1.0, "g": 9.80665}
    scale = np.repeat([units[clean.gyro_unit], units[clean.accel_unit]], 3)
    N = np.array([truth.N for truth in clean.axes.values()])
    assert np.allclose(white * scale, N, rtol=0.08)


def test_counts_behind_a_matrix_show_on_no_axis_alone():
    plain = composite(3, samples=5000, kinds=["rounding"])
    behind = composite(3, samples=5000, kinds=["rounding behind a matrix"])
    few, many = (
        min(len(np.unique(np.round(made.values[:, NAMES.index(axis)], 12))) for axis in made.effects[0].axes)
        for made in (plain, behind)
    )
    assert few < 100
    assert many > 10 * few
