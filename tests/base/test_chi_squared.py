"""Tail and quantiles of the χ² law are those of SciPy's statistics; what uses them does not load these."""

import subprocess
import sys

import numpy as np
import pytest
from scipy.stats import chi2

from allanjax.base.chi_squared import quantile, upper_tail

DOF = np.array([0.3, 1.0, 2.0, 17.5, 4000.0])


@pytest.mark.parametrize("probability", [1e-9, 0.025, 0.5, 0.975, 1.0 - 1e-9])
def test_tail_and_quantiles_are_those_of_the_law(probability):
    x = quantile(probability, DOF)
    np.testing.assert_allclose(x, chi2.ppf(probability, DOF), rtol=1e-12)
    np.testing.assert_allclose(upper_tail(x, DOF), chi2.sf(x, DOF), rtol=1e-12)


def test_two_degrees_of_freedom_are_an_exponential_law():
    assert upper_tail(3.0, 2) == pytest.approx(np.exp(-1.5), rel=1e-14)
    assert quantile(0.5, 2) == pytest.approx(2.0 * np.log(2.0), rel=1e-14)


@pytest.mark.parametrize("dof", [0.0, np.nan])
def test_without_degrees_of_freedom_there_is_no_probability(dof):
    assert np.isnan(upper_tail(3.0, dof))
    assert np.isnan(quantile(0.5, dof))


def test_intervals_load_no_statistics():
    program = """
import sys
import numpy as np
import allanjax as aj
x = np.random.default_rng(0).standard_normal(5000)
recording = aj.Recording.from_array(x, 50.0, gyro_unit="rad/s", names=["gyro_x"])
aj.allan_deviation(recording).confidence_interval()
aj.power_spectrum(recording).random_walk("gyro_x")
sys.exit(" ".join(name for name in ("scipy.stats", "scipy.signal") if name in sys.modules))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stderr.strip() == ""
