"""Fits of models to levels: where a model suffices, and what an error of the model makes of the weights."""

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.stats import chi2, gamma

import allanjax as aj
from allanjax.base.chi_squared import exact_cube_root_score
from allanjax.estimate.spectral.design import SpectralDesign
from allanjax.estimate.spectral.fit import best_of, levels_under, solve_levels
from allanjax.spectrum.cosine import Bins

WHITE = aj.Model((aj.AngleRandomWalk(),))
YES = np.ones(1, bool)


def white_levels(level, bins):
    """Fit of white noise to these levels."""
    design = SpectralDesign.of(WHITE, bins).with_data(level, bins.size.astype(float))
    return design, solve_levels(design, YES, YES, np.array([0.25]), np.zeros(0), np.ones(len(level)))


def test_a_model_is_incomplete_beyond_all_doubt_only():
    """Levels that depart from white noise by more and more: from p = 10⁻⁶ on, and not before.

    The limit is Wilson and Hilferty's, good to a factor of two of p out there.
    """
    bins = Bins.of(500, 4.0)
    ripple = np.where(np.arange(len(bins.size)) % 2, 1.0, -1.0)
    found = [white_levels(np.exp(x * ripple), bins)[1] for x in np.linspace(0.6, 1.8, 60)]
    assert all(f.converged for f in found)
    p = chi2.sf([f.chi2 for f in found], len(bins.size) - 1)
    clear = abs(np.log(p / 1e-6)) > np.log(2.0)
    assert np.sum((p < 1e-2) & (p > 1e-6)) > 3
    incomplete = np.array([f.power_error > 0.0 for f in found])
    np.testing.assert_array_equal(incomplete[clear], (p < 1e-6)[clear])


def test_an_error_of_the_model_brings_chi_squared_to_its_degrees_of_freedom():
    """Of white noise alone the maximum is the mean of all levels, weighted by 1/(2/size + s²·per octave)."""
    rng, bins = np.random.default_rng(1), Bins.of(5000, 4.0)
    size, f = bins.size, bins.frequency
    level = np.exp(0.4 * np.cos(2.0 * np.log(f))) * rng.gamma(size / 2.0) / (size / 2.0)
    design, found = white_levels(level, bins)
    s = float(found.power_error)
    assert 0.05 < s < 1.0
    per_octave = np.sum(abs(np.log2(f[:, None] / f)) <= 0.5, axis=1)
    weight = 1.0 / (2.0 / size + s**2 * per_octave)
    power = np.sum(weight * level) / np.sum(weight)
    # White noise of N² = power/rate.
    assert found.power[0] == pytest.approx(power / 4.0, rel=1e-5)
    np.testing.assert_allclose(levels_under(design, found), power, rtol=1e-5)
    square = exact_cube_root_score(level / power, size.astype(float)) ** 2

    def excess(error):
        return np.sum(square / (1.0 + 0.5 * size * per_octave * error**2)) - (len(size) - 1.0)

    # The error is found anew until it moves by less than two per cent.
    assert s == pytest.approx(brentq(excess, 0.0, 10.0), rel=0.02)


@pytest.mark.parametrize("error", [0.0, 0.5])
def test_solutions_are_compared_by_the_density_of_their_levels(error):
    """By scipy's Gamma law of as many degrees of freedom as a relative error of the model leaves."""
    rng, bins = np.random.default_rng(3), Bins.of(5000, 4.0)
    size, f = bins.size.astype(float), bins.frequency
    level = np.exp(error * np.cos(2.0 * np.log(f))) * rng.chisquare(size) / size
    design, found = white_levels(level, bins)
    s = float(found.power_error)
    assert (s > 0.0) == (error > 0.0)
    per_octave = np.sum(abs(np.log2(f[:, None] / f)) <= 0.5, axis=1)
    dof = 2.0 / (2.0 / size + s**2 * per_octave)
    law = gamma(dof / 2.0, scale=2.0 * levels_under(design, found) / dof)
    assert float(found.cost) == pytest.approx(-2.0 * np.sum(law.logpdf(level)), rel=1e-9)


def test_the_most_likely_solution_is_taken():
    """Of those that are as likely one that converged; a less likely one is none."""
    _, one = white_levels(np.ones(len(Bins.of(500, 4.0).size)), Bins.of(500, 4.0))
    cost = np.array([3.0, 1.0, 1.01, 2.0])
    converged = np.array([True, False, True, True])
    several = [one._replace(cost=c, converged=k) for c, k in zip(cost, converged, strict=True)]
    assert float(best_of(several).cost) == 1.01
    assert float(best_of([several[0], several[1]]).cost) == 1.0
