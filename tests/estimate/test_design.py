"""The model of Allan variances that the solver sees."""

import jax.numpy as jnp
import numpy as np

import allanjax as aj
from allanjax.estimate.allan_design import AllanDesign


def test_the_models_own_error_is_correlated_over_an_octave():
    """What whitening leaves of the identity is the inverse root of the covariance it believes in.

    Of a model error s that is s² at each cluster time, and falls off by e for every octave between two. The
    estimates' own part is 10⁻⁴ larger on the diagonal, lest it be singular.
    """
    sizes, s = np.array([1, 2, 3, 8, 32, 128]), 0.2
    design = AllanDesign.of(aj.Model((aj.AngleRandomWalk(),)), 1024, 10.0, sizes)
    none, power = jnp.zeros(0), jnp.array([4.0])
    mean = power @ design.means(none)
    own = design.covariance(power, design.products(none))
    root = np.asarray(design.whiten(own, mean, jnp.asarray(s), jnp.eye(len(sizes))).values)
    relative = np.asarray(own / (mean[:, None] * mean))
    believed = np.linalg.inv(root.T @ root) - relative - 1e-4 * np.diag(np.diag(relative))
    octaves = abs(np.log2(sizes[:, None] / sizes))
    np.testing.assert_allclose(believed, s**2 * np.exp(-octaves), rtol=1e-6)
