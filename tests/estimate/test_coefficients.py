"""From a solution to coefficients."""

import numpy as np

from allanjax.estimate.coefficients import _around
from allanjax.noise.terms import Markov, Resonance


def test_a_shape_is_known_in_the_logarithm_of_its_distance_from_the_bound():
    """Quality factors are above ½, times above zero: ln(8 − ½) ± 0.3 is between ½ + 7.5·e^±0.3."""
    quality, time = Resonance.parameters()[2], Markov.parameters()[1]
    distance, width = np.array([7.5]), np.array([0.3])
    factor = np.exp([-0.3, 0.3])
    np.testing.assert_allclose(_around(quality, distance, width), [0.5 + 7.5 * factor])
    np.testing.assert_allclose(_around(time, distance, width), [7.5 * factor])
