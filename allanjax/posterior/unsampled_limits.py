"""Posterior of an amplitude that was not sampled, by reweighting the draws of the other parameters."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float
from scipy.special import logsumexp

from allanjax.posterior.sampling import LogPosterior, Target

# The range of the amplitude ends where the density is e^-12 of its maximum.
_NEGLIGIBLE = 12.0
# Grid points of the search for that range, for which so few draws suffice, and of the density in it.
_COARSE, _FINE = 25, 33
_FEW_DRAWS = 64
# Largest number of times that the range is narrowed.
_MAX_ROUNDS = 8
# Attempts to translate the draws at one point until effective draws over draws reach this.
_CORRECTIONS = 6
_EVEN = 0.3
# Points at which the interpolated density is integrated.
_DENSE = 4001


@dataclasses.dataclass(frozen=True, eq=False)
class GridPosterior:
    """Posterior of one amplitude on a grid: amplitudes [SI], ascending, and the probability of a smaller one.

    `bayes_factor` is posterior over prior density at zero; `effective_draws` the number of equally weighted
    draws that the density at the 95 % quantile is worth.
    """

    value: Float[np.ndarray, " grid"]
    probability: Float[np.ndarray, " grid"]
    bayes_factor: float
    effective_draws: float

    def quantile(self, u: float) -> float:
        """Amplitude [SI] below which this share of the posterior lies."""
        return float(np.interp(u, self.probability, self.value))

    @property
    def std(self) -> float:
        """Standard deviation of the posterior [SI]."""
        middle = (self.value[1:] + self.value[:-1]) / 2.0
        weight = np.diff(self.probability)
        return float(np.sqrt(max(weight @ middle**2 - (weight @ middle) ** 2, 0.0)))


def absent_amplitude(
    target: Target,
    index: int,
    y: Float[np.ndarray, "draws sampled"],
    draws: int,
    random: np.random.RandomState,
) -> GridPosterior:
    """Marginal posterior of the amplitude with this index, which is zero in the draws y of the others.

    p(c | data) ∝ p(c) ∫ L(θ, c) p(θ) dθ ∝ p(c)·mean_i [L(θ_i, c)/L(θ_i, 0)] over draws θ_i of the others at c
    = 0; a shape of the term itself is drawn from its prior. The larger c, the farther the posterior of the
    others is from where they were drawn. Any translation of the draws, with the prior density before and
    after in the ratio, leaves the mean the same, and that to their weighted mean at c keeps the weights even.
    """
    posterior = target.posterior
    prior = posterior.priors[index]
    ends = np.tile(target.base, (2, 1))
    values = posterior.values(ends)
    values[:, index] = prior.lower, prior.upper if np.isfinite(prior.upper) else prior.quantile(1.0 - 1e-9)
    lower, upper = posterior.coordinates(values)[:, index]
    chosen = y[np.linspace(0, len(y) - 1, draws).round().astype(int)]
    full = _with_shapes(target, index, chosen, random)

    few = full[:: max(1, draws // _FEW_DRAWS)]
    for _ in range(_MAX_ROUNDS):
        grid = np.linspace(lower, upper, _COARSE)
        density, displaced = _followed(target, index, few, grid)
        seen = np.flatnonzero(density > density.max() - _NEGLIGIBLE)
        narrowed = grid[max(seen[0] - 1, 0)], grid[min(seen[-1] + 1, _COARSE - 1)]
        settled = narrowed[1] - narrowed[0] > 0.4 * (upper - lower)
        lower, upper = narrowed
        if settled:
            break

    fine = np.linspace(lower, upper, _FINE)
    translation = np.stack([np.interp(fine, grid, d) for d in displaced.T], axis=1)
    log_weight = _log_weights(target, index, full, fine, translation)
    log_ratio = logsumexp(log_weight, axis=1) - np.log(draws)
    effective = np.exp(2.0 * logsumexp(log_weight, axis=1) - logsumexp(2.0 * log_weight, axis=1))
    return _integrated(posterior, index, fine, log_ratio, effective)


def _followed(
    target: Target,
    index: int,
    few: Float[np.ndarray, "few params"],
    grid: Float[np.ndarray, " grid"],
) -> tuple[Float[np.ndarray, " grid"], Float[np.ndarray, "grid sampled"]]:
    """Log density of this coordinate on a grid, and the translation of the others at each point.

    The translation is followed from each point to the next, as far as the density is not negligible.
    """
    log_prior = _log_prior(target.posterior, index, grid)
    density = np.full(len(grid), -np.inf)
    displaced = np.zeros((len(grid), len(target.sampled)))
    for g in range(len(grid)):
        # Start from the linear continuation of the last two translations.
        moved = 2.0 * displaced[g - 1] - displaced[g - 2] if g > 1 else displaced[0]
        for _ in range(_CORRECTIONS):
            log_weight = _log_weights(target, index, few, grid[g : g + 1], moved[None])[0]
            total = logsumexp(log_weight)
            density[g] = total - np.log(len(few)) + log_prior[g]
            if not np.isfinite(total):
                moved = displaced[g - 1]
                continue
            share = np.exp(log_weight - total)
            moved = moved + share @ few[:, target.sampled] - few[:, target.sampled].mean(axis=0)
            if 1.0 / np.sum(share**2) > _EVEN * len(few):
                break
        displaced[g] = moved
        if density[g] < density.max() - _NEGLIGIBLE:
            displaced[g:] = moved
            break
    return density, displaced


def _with_shapes(
    target: Target, index: int, y: Float[np.ndarray, "draws sampled"], random: np.random.RandomState
) -> Float[np.ndarray, "draws params"]:
    """Coordinates of all parameters of these draws, the absent term's shapes being drawn from priors."""
    posterior = target.posterior
    full = target.embedded(y)
    values = posterior.values(full)
    parameters = posterior.likelihood.parameters
    for k, p in enumerate(parameters):
        if k != index and k not in target.sampled and p.term == parameters[index].term:
            values[:, k] = posterior.priors[k].quantile(random.uniform(size=len(full)))
    return posterior.coordinates(values)


def _log_weights(
    target: Target,
    index: int,
    full: Float[np.ndarray, "draws params"],
    grid: Float[np.ndarray, " grid"],
    translation: Float[np.ndarray, "grid sampled"],
) -> Float[np.ndarray, "grid draws"]:
    """Log ratio of likelihood times prior of translated draws with each amplitude, over that of the draws."""
    moved = np.tile(full, (len(grid), 1, 1))
    moved[:, :, target.sampled] += translation[:, None]
    moved[:, :, index] = grid[:, None]
    before = target.densities(full).sum(axis=0)
    after = target.densities(moved.reshape(-1, full.shape[1])).sum(axis=0)
    return after.reshape(len(grid), len(full)) - before


def _log_prior(
    posterior: LogPosterior, index: int, y: Float[np.ndarray, " grid"]
) -> Float[np.ndarray, " grid"]:
    """Logarithm of the prior density of this coordinate."""
    full = np.zeros((len(y), len(posterior.priors)))
    full[:, index] = y
    density = posterior.priors[index].log_density(posterior.values(full)[:, index])
    return np.asarray(density) + posterior.log_jacobian(full)[:, index]


def _integrated(
    posterior: LogPosterior,
    index: int,
    grid: Float[np.ndarray, " grid"],
    log_ratio: Float[np.ndarray, " grid"],
    effective: Float[np.ndarray, " grid"],
) -> GridPosterior:
    """Posterior from the likelihood ratio on a grid, interpolated and normalized."""
    from scipy.interpolate import PchipInterpolator

    dense = np.linspace(grid[0], grid[-1], _DENSE)
    floored = np.maximum(log_ratio, log_ratio.max() - 50.0)
    ratio = np.exp(PchipInterpolator(grid, floored - floored.max())(dense))
    density = ratio * np.exp(_log_prior(posterior, index, dense))
    steps = (density[1:] + density[:-1]) / 2.0
    probability = np.concatenate([[0.0], np.cumsum(steps)]) / steps.sum()
    full = np.zeros((_DENSE, len(posterior.priors)))
    full[:, index] = dense
    limit = np.interp(0.95, probability, dense)
    return GridPosterior(
        value=posterior.values(full)[:, index],
        probability=probability,
        bayes_factor=float(ratio[0] / (steps.sum() * (dense[1] - dense[0]))),
        effective_draws=float(np.interp(limit, grid, effective)),
    )
