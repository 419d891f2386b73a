"""Priors of single parameters."""

import itertools

import numpy as np
import pytest
from scipy import stats
from scipy.integrate import quad

from allanjax import AllanjaxError, LogNormal, LogUniform, ModifiedLogUniform, Uniform

PRIORS = [
    Uniform(0.2, 7.0), Uniform(-1.0, 1.0), LogUniform(1e-3, 2.0), LogUniform(0.7, 50.0, 0.5),
    LogNormal(3.0, 2.5), ModifiedLogUniform(1e-2, 40.0), ModifiedLogUniform(5.0, 1.0),
]  # fmt: skip


@pytest.mark.parametrize("prior", PRIORS, ids=str)
def test_density_integrates_to_one_and_quantile_is_its_inverse(prior):
    density = lambda x: float(np.exp(prior.log_density(x)))  # noqa: E731
    for u in (0.0, 0.03, 0.4, 0.9, 1.0):
        end = prior.quantile(u)
        # Piecewise between quantiles, since densities span decades.
        pieces = prior.quantile(np.linspace(1e-9, 1.0 - 1e-9, 40))
        pieces = [prior.lower, *pieces[pieces < end], end]
        below = sum(quad(density, a, b, epsrel=1e-9)[0] for a, b in itertools.pairwise(pieces))
        assert below == pytest.approx(u, abs=1e-7)
    outside = np.array([prior.lower - 0.5, prior.lower - 1e-9, prior.upper * 1.001, prior.upper + 100.0])
    assert np.all(np.asarray(prior.log_density(outside[np.isfinite(outside)])) == -np.inf)
    assert np.all(np.isfinite(prior.log_density(prior.quantile(np.linspace(0.01, 0.99, 9)))))


def test_densities_are_those_of_scipy():
    x = np.geomspace(0.02, 1.9, 11)
    laws = {2: stats.loguniform(1e-3, 2.0), 4: stats.lognorm(np.log(2.5), scale=3.0)}
    for k, law in laws.items():
        np.testing.assert_allclose(PRIORS[k].log_density(x), law.logpdf(x), rtol=1e-12, atol=1e-12)
    # Gregory (2005): uniform far below the scale, 1/x far above it.
    gregory = PRIORS[5]
    assert gregory.log_density(0.0) == pytest.approx(-np.log(1e-2 * np.log(1.0 + 40.0 / 1e-2)))
    assert np.exp(gregory.log_density(2.0) - gregory.log_density(20.0)) == pytest.approx(10.0, rel=5e-3)


IMPROPER = [
    (Uniform, 1.0, 1.0), (Uniform, 0.0, np.inf), (LogUniform, 0.0, 1.0), (LogUniform, 0.4, 1.0, 0.5),
    (LogUniform, 2.0, 1.0), (LogNormal, 0.0, 2.0), (LogNormal, 1.0, 1.0),
    *((ModifiedLogUniform, *numbers) for numbers in ((0.0, 1.0), (np.nan, 1.0), (1.0, 0.0))),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "numbers"), [(kind, numbers) for kind, *numbers in IMPROPER])
def test_improper_priors_are_refused(kind, numbers):
    with pytest.raises(AllanjaxError, match="give "):
        kind(*numbers)
