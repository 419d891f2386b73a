"""How far a fitted curve is off, and what is said of coefficients that are no measurement."""

import numpy as np
import pytest

import allanjax as aj
from allanjax.cosine import CosineBins
from allanjax.deterministic import AxisSpectrum
from allanjax.fit import fit_allan, result_of
from allanjax.recording import Axis
from allanjax.whittle import fit_spectrum

RATE, N = 100.0, 200_000
AXIS = Axis("gyro_x", "gyro", "rad/s")
TRUTH = aj.AngleRandomWalk(1e-3) + aj.RateRandomWalk(1e-5)
ACTIVE = np.ones((1, 2), bool)


def hump(octaves, height=0.1):
    """A raised cosine an octave wide at half its height, about 0."""
    return 1.0 + height * np.where(abs(octaves) < 1.0, 0.5 + 0.5 * np.cos(np.pi * octaves), 0.0)


def by_allan(height, n=N):
    """A fit of exact Allan deviations with a hump about 0.64 s."""
    curve = aj.allan_deviation(np.random.default_rng(0).normal(size=(n, 1)), RATE, cluster_times=4)
    exact = np.sqrt(np.asarray(TRUTH.sampled(RATE).allan_variance(curve.cluster_time)))
    off = hump(np.log2(curve.cluster_time / 0.64), height)
    vars(curve)["deviation"] = (exact * off)[:, None]
    model = aj.AngleRandomWalk() + aj.RateRandomWalk()
    return fit_allan(curve, [AXIS], model, ACTIVE)[0][0]


def by_spectrum(height, n=N):
    """A fit of exact levels with a hump of the root PSD about 3 Hz."""
    bins = CosineBins.of(n, RATE)
    level = sum(np.asarray(bins.expected(term)) for term in TRUTH.sampled(RATE).terms)
    level = level * hump(np.log2(bins.frequency / 3.0), height) ** 2
    c = np.sqrt(np.repeat(level, bins.size))
    model = aj.AngleRandomWalk() + aj.RateRandomWalk()
    found = fit_spectrum(model.sampled(RATE), AXIS, AxisSpectrum.of(bins, c, [], {}), ACTIVE[0])
    return result_of(found, model, AXIS, ACTIVE[0])


@pytest.fixture(scope="module")
def humps():
    return by_allan(0.1), by_spectrum(0.1)


def test_a_hump_of_ten_per_cent_is_said_to_be_one(humps):
    """The fit may give way by a third of it, no more: the hump is a tenth of the curve."""
    for result, place, unit in zip(humps, (0.64, 3.0), ("s", "Hz"), strict=True):
        assert result.measured
        assert 0.03 < result.discrepancy < 0.15
        assert 0.065 < result.misfit.largest < 0.105
        assert abs(np.log2(result.misfit.at / place)) <= 0.35
        assert result.misfit.unit == unit
        # Of a raised cosine over two octaves the mean square is ⅜·2 octaves' worth.
        octaves = np.log2(N / 2.0) if unit == "s" else np.log2(N)
        assert result.misfit.rms == pytest.approx(0.1 * np.sqrt(0.75 / octaves), rel=0.4)
    assert humps[0].discrepancy == pytest.approx(humps[1].discrepancy, rel=0.3)
    verdict = humps[0].verdict()
    largest = 100.0 * humps[0].misfit.largest
    assert f"model incomplete: its Allan deviation is off by up to {largest:.2g} % at 0.64 s" in verdict
