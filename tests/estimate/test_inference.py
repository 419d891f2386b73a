"""What estimates say around their estimate."""

import numpy as np
from scipy.stats import chi2, norm

import allanjax as aj
from allanjax.allan.covariance import equivalent_degrees_of_freedom
from allanjax.estimate.allan_design import AllanDesign
from allanjax.estimate.gls import Solution
from allanjax.estimate.inference import infer


def test_one_estimate_alone_has_the_score_of_its_chi_square_law():
    """White noise by one Allan variance of four degrees of freedom, whose law is skew.

    Wilson and Hilferty's cube roots, by which the score is made, are good to 0.02 within two standard
    deviations.
    """
    n, rate, sizes, variance = 64, 1.0, np.array([16]), 0.7
    design = AllanDesign.of(aj.Model((aj.AngleRandomWalk(),)), n, rate, sizes)
    one, zero = np.ones((1, 1)), np.zeros(1)
    power = variance * 16.0
    solution = Solution(power * one, np.zeros((1, 0)), zero, zero, np.ones(1, bool), zero)
    found = infer(design, variance * one, np.ones(1, bool), one > 0.0, solution)
    hypothesis, score = np.asarray(found.power_at)[0, 0], np.asarray(found.pivot_at)[0, 0]
    edf = equivalent_degrees_of_freedom(n, rate, sizes)[0]
    near = (hypothesis > 0.3 * power) & (hypothesis < 6.0 * power)
    exact = norm.ppf(chi2.cdf(edf * power / hypothesis[near], edf))
    assert np.sum(abs(exact) < 2.0) >= 8
    np.testing.assert_allclose(score[near], exact, atol=0.03)
