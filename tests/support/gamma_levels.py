"""Two noise terms of which the spectral levels have Gamma laws: posteriors that quadrature gives as well."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import allanjax.posterior.axis_sampler
from allanjax.noise.terms import AngleRandomWalk, RateRandomWalk

DEGREE, HOUR = np.pi / 180.0, 3600.0
N, K = 0.3 * DEGREE / 60.0, 40.0 * DEGREE / HOUR**1.5
FREQUENCY = np.geomspace(1e-3, 50.0, 40)
ORDINATES = np.maximum(1.0, 200.0 * FREQUENCY)


class Likelihood(eqx.Module):
    """What the sampler has to know of a likelihood beside its values."""

    parameters: tuple = eqx.field(static=True)
    start: np.ndarray
    scatter: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    prior_scale: np.ndarray
    found: np.ndarray


class SpectralLevels(Likelihood):
    """Gamma laws of spectral levels, the mean linear in the squares of all amplitudes."""

    levels: np.ndarray

    def __call__(self, values):
        mean = self.densities(values**2)
        return -jnp.sum(ORDINATES * (jnp.log(mean) + self.levels / mean))

    @staticmethod
    def densities(power):
        shapes = np.stack([np.ones(len(FREQUENCY)), 1.0 / (2.0 * np.pi * FREQUENCY) ** 2])
        return power @ shapes


def spectral_levels(truth=(N, K), seed=0, found=(True, True)):
    random = np.random.default_rng(seed)
    truth = np.array(truth)
    mean = np.asarray(SpectralLevels.densities(truth**2))
    derivative = np.asarray(SpectralLevels.densities(np.eye(2))) / mean
    sd = np.sqrt(1.0 / np.sum(ORDINATES * derivative**2, axis=1))
    prior_scale = np.sqrt(sd)
    return SpectralLevels(
        parameters=(AngleRandomWalk() + RateRandomWalk()).parameters,
        start=truth * np.array(found),
        scatter=sd / 2.0 / np.maximum(truth, prior_scale),
        lower=np.zeros(2),
        upper=1e3 * np.maximum(truth, prior_scale),
        prior_scale=prior_scale,
        found=np.array(found),
        levels=random.gamma(ORDINATES) / ORDINATES * mean,
    )


def quadrature(likelihood, priors, points=401):
    """Marginal distribution functions of N and K on a two-dimensional grid: (values, probability) of each."""
    grids = []
    for i, p in enumerate(likelihood.parameters):
        top = likelihood.start[i] + 8.0 * likelihood.scatter[i] + 5.0 * likelihood.prior_scale[i]
        bottom = max(likelihood.start[i] - 8.0 * likelihood.scatter[i], 0.0)
        grids.append(np.linspace(bottom, top, points))
        assert priors[p.label] is not None
    power = np.stack(np.meshgrid(*grids, indexing="ij"), axis=-1) ** 2
    mean = np.maximum(np.asarray(SpectralLevels.densities(power)), 1e-300)
    log_density = -np.sum(ORDINATES * (np.log(mean) + likelihood.levels / mean), axis=-1)
    for i, p in enumerate(likelihood.parameters):
        log_prior = np.asarray(priors[p.label].log_density(grids[i]))
        log_density += log_prior[:, None] if i == 0 else log_prior
    density = np.exp(log_density - log_density.max())
    marginals = []
    for i, grid in enumerate(grids):
        margin = density.sum(axis=1 - i)
        steps = (margin[1:] + margin[:-1]) / 2.0
        marginals.append((grid, np.concatenate([[0.0], np.cumsum(steps)]) / steps.sum()))
    return marginals


def with_likelihood(patch, fit, likelihood, chosen=True):
    """The fit with N and K as its model, every axis of which has this likelihood."""
    patch.setattr(allanjax.posterior.axis_sampler, "likelihood_of", lambda fit, axis: likelihood)
    patch.setattr(type(fit), "chosen", chosen)
    results = tuple(dataclasses.replace(r, _coefficients={}) for r in fit.results)
    return dataclasses.replace(fit, template=AngleRandomWalk() + RateRandomWalk(), results=results)
