"""Markov chain Monte Carlo: emcee's ensemble of walkers for each axis, and results from its draws.

`value` is the median, `std` the standard deviation; the central intervals hold 68 and 95 % of the posterior;
`upper_limit` is the 95 % quantile. An amplitude is `detected` if its Bayes factor is below 1/20; otherwise
its intervals begin at zero, and `interval` ends at `upper_limit`.

The `bayes_factor` of an amplitude is the posterior over the prior probability of values that cannot be
distinguished from zero (up to a third of the prior's scale; for terms not sampled, zero itself): the factor
by which the data change the odds of the term's absence (Savage's density ratio; Dickey 1971, Ann. Math.
Stat. 42:204). Under the default prior it is 1/20 if the squared amplitude is 3.5 to 3.8 standard deviations
above zero. It is 0 under a prior that excludes zero. Amplitudes without draws (`sampled` is False) belong to
terms that the fit did not detect.
"""

from __future__ import annotations

import dataclasses
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, TypeVar

import emcee
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from emcee.moves import DEMove, DESnookerMove, RedBlueMove
from jaxtyping import Array, ArrayLike, Bool, Float, Int
from scipy.special import logsumexp

from allanjax.base.errors import AllanjaxError, FitError
from allanjax.base.wording import percent, plain
from allanjax.estimate.result import Fit
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import ModelParameter
from allanjax.posterior.likelihood import Likelihood, Prior, WiderLikelihood, default_priors, likelihood_of
from allanjax.posterior.result import AxisPosterior, PosteriorWarning
from allanjax.record.recording import Axis

# An amplitude is detected if the data make zero less credible by this factor.
_DETECTED = 1.0 / 20.0
# Below this coordinate, a third of the prior's scale, an amplitude cannot be distinguished from zero.
_INDISTINGUISHABLE = 0.3
# Probabilities of the median, the central 68 and 95 %, and the lowest 68 and 95 %.
_QUANTILES = (0.5, 0.16, 0.84, 0.025, 0.975, 0.68, 0.95)
Coordinates = TypeVar("Coordinates", np.ndarray, jax.Array)
# Steps before the convergence of the chain is first checked.
_FIRST_BLOCK = 200
# Length of the burn-in, in autocorrelation times.
_BURN_IN = 5.0
# Scatter of the first walkers over the fit's standard deviations.
_OVERDISPERSION = 1.5
# Attempts to place a walker; the later half are draws from the priors.
_ATTEMPTS = 40
# Degrees of freedom of the proposed Student law, with tails heavier than those of any posterior seen here.
_STUDENT_DOF = 4.0
# The range of the amplitude ends where the density is e^-12 of its maximum.
_NEGLIGIBLE = 12.0
# Grid points of the search for that range, for which so few draws suffice, and of the density in it.
_COARSE, _FINE = 25, 33
_FEW_DRAWS = 64
# Largest number of times that the range is narrowed.
_MAX_ROUNDS = 8
# Attempts to translate the draws at one point, until effective draws over draws reach this ratio.
_CORRECTIONS = 6
_EVEN = 0.3
# Points at which the interpolated density is integrated.
_DENSE = 4001
# Default number of walkers, or four per parameter if that is more.
_WALKERS = 32


def sampled_marginals(
    posterior: LogPosterior, axis: Axis, chosen: list[int], draws: Float[np.ndarray, "draws sampled"]
) -> dict[int, Estimate]:
    """Marginals of the parameters with these indices from their draws [SI], by index."""
    parameters = posterior.likelihood.parameters
    found: dict[int, Estimate] = {}
    by_index = dict(zip(chosen, draws.T, strict=True))
    evidence = {i: bayes_factor(posterior, i, x) for i, x in by_index.items() if posterior.amplitude[i]}
    detected = {parameters[i].term: factor < _DETECTED for i, factor in evidence.items()}
    for i, x in by_index.items():
        quantiles = np.quantile(x, _QUANTILES)
        is_detected = detected.get(parameters[i].term, True)
        found[i] = _marginal(parameters[i], axis, quantiles, float(x.std()), is_detected, evidence.get(i))
    return found


def absent_marginal(parameter: ModelParameter, axis: Axis, grid: GridPosterior) -> Estimate:
    """Marginal of the amplitude of a term that was not sampled."""
    quantiles = np.array([grid.quantile(u) for u in _QUANTILES])
    detected = grid.bayes_factor < _DETECTED
    return dataclasses.replace(
        _marginal(parameter, axis, quantiles, grid.std, detected, grid.bayes_factor), sampled=False
    )


def undetermined(parameter: ModelParameter, axis: Axis) -> Estimate:
    """Marginal of the shape of a term that was not sampled, which these data do not determine."""
    nothing = (parameter.parameter.lower, parameter.parameter.upper)
    unknown = _marginal(parameter, axis, np.full(len(_QUANTILES), np.nan), float("nan"), False, None)
    return dataclasses.replace(unknown, interval=nothing, interval_68=nothing, sampled=False)


def _marginal(
    p: ModelParameter,
    axis: Axis,
    quantiles: Float[np.ndarray, " quantiles"],
    std: float,
    detected: bool,
    evidence: float | None,
) -> Estimate:
    median, low_68, high_68, low_95, high_95, below_68, below_95 = (float(q) for q in quantiles)
    amplitude = p.parameter.is_amplitude
    one_sided = amplitude and not detected
    return Estimate(
        source="posterior",
        label=p.label,
        term=p.term_label,
        parameter=p.parameter,
        axis=axis,
        value=median,
        std=std,
        interval=(0.0, below_95) if one_sided else (low_95, high_95),
        interval_68=(0.0, below_68) if one_sided else (low_68, high_68),
        upper_limit=below_95 if amplitude else None,
        detected=detected,
        bayes_factor=evidence,
    )


def bayes_factor(posterior: LogPosterior, index: int, draws: Float[np.ndarray, " draws"]) -> float:
    """Posterior over prior probability of an amplitude [SI] indistinguishable from zero; 0 if excluded."""
    threshold = posterior.scale[index] * np.expm1(_INDISTINGUISHABLE)
    nodes, weights = np.polynomial.legendre.leggauss(200)
    prior = posterior.priors[index]
    # In ln(1 + c/scale) the default prior is uniform, and others are smooth inside their support.
    low = np.log1p(prior.lower / posterior.scale[index])
    if low >= _INDISTINGUISHABLE:
        return 0.0
    y = low + (_INDISTINGUISHABLE - low) * (nodes + 1.0) / 2.0
    value = posterior.scale[index] * np.expm1(y)
    density = np.exp(np.asarray(prior.log_density(value))) * posterior.scale[index] * np.exp(y)
    before = float(density @ weights) * (_INDISTINGUISHABLE - low) / 2.0
    # A prior without any mass there excludes zero whatever the data say.
    return float(np.mean(draws < threshold) / before) if before > 1e-9 else 0.0


class LogPosterior(eqx.Module):
    """Posterior of the parameters of one axis, in coordinates in which the default priors are uniform.

    Coordinates are ln(1 + c/scale) of an amplitude c, ln(x − lower bound) of a time, frequency or number, and
    the frequency itself of a line.
    """

    likelihood: Likelihood
    priors: tuple[Prior, ...]
    amplitude: Bool[np.ndarray, " params"]
    line: Bool[np.ndarray, " params"]
    scale: Float[np.ndarray, " params"]
    origin: Float[np.ndarray, " params"]

    @classmethod
    def of(cls, likelihood: Likelihood, priors: Mapping[str, Prior]) -> LogPosterior:
        """Posterior from a likelihood and a prior for each of its parameters, by label."""
        kinds = np.array([p.parameter.kind for p in likelihood.parameters])
        return cls(
            likelihood,
            tuple(priors[p.label] for p in likelihood.parameters),
            kinds == "amplitude",
            kinds == "line",
            np.where(kinds == "amplitude", likelihood.prior_scale, 1.0),
            np.array([p.parameter.lower for p in likelihood.parameters]),
        )

    def values(self, y: Coordinates) -> Coordinates:
        """Values in SI at these coordinates [..., params]; a NumPy array for a NumPy array."""
        xp: Any = jnp if isinstance(y, jax.Array) else np
        exponent = xp.where(self.line, 0.0, y)
        others = xp.where(self.line, y, self.origin + xp.exp(exponent))
        return xp.where(self.amplitude, self.scale * xp.expm1(exponent), others)

    def coordinates(self, values: Float[np.ndarray, "*batch params"]) -> Float[np.ndarray, "*batch params"]:
        """Coordinates of values in SI."""
        with np.errstate(invalid="ignore", divide="ignore"):
            others = np.where(self.line, values, np.log(values - self.origin))
            return np.where(self.amplitude, np.log1p(values / self.scale), others)

    def log_jacobian(self, y: Coordinates) -> Coordinates:
        """Logarithm of the derivative of each value by its coordinate [..., params]."""
        xp: Any = jnp if isinstance(y, jax.Array) else np
        return xp.where(self.line, 0.0, y + xp.log(self.scale))

    def log_prior(self, values: Float[Array, " params"]) -> Float[Array, " params"]:
        """Logarithm of the prior density [1/SI unit] of each parameter."""
        return jnp.stack([p.log_density(x) for p, x in zip(self.priors, values, strict=True)])


@eqx.filter_jit
def _log_densities(
    posterior: LogPosterior, y: Float[ArrayLike, "batch params"], counted: Bool[ArrayLike, " params"]
) -> Float[Array, "2 batch"]:
    """Log-likelihood, and log prior density of the counted coordinates; −inf, 0 outside the support."""

    def one(y: Float[Array, " params"]) -> Float[Array, " two"]:
        values = posterior.values(y)
        priors = posterior.log_prior(values) + posterior.log_jacobian(y)
        prior = jnp.sum(jnp.where(counted, priors, 0.0))
        allowed = jnp.isfinite(prior)
        # Outside the support the likelihood may be undefined.
        likelihood = posterior.likelihood(jnp.where(allowed, values, posterior.likelihood.start))
        allowed &= ~jnp.isnan(likelihood)
        return jnp.stack([jnp.where(allowed, likelihood, -jnp.inf), jnp.where(allowed, prior, 0.0)])

    return jax.vmap(one)(jnp.asarray(y)).T


@dataclasses.dataclass(frozen=True)
class Target:
    """Posterior of the sampled parameters, with the others kept at the coordinates `base`.

    Every evaluation has the same shape [batch, params], so that one program serves all axes.
    """

    posterior: LogPosterior
    sampled: Int[np.ndarray, " sampled"]
    base: Float[np.ndarray, " params"]
    batch: int
    _on_device: LogPosterior

    @classmethod
    def of(cls, posterior: LogPosterior, sampled: Int[np.ndarray, " sampled"], batch: int) -> Target:
        """Posterior of the parameters with these indices; other amplitudes are 0, shapes at their start."""
        lower, upper = np.array([(p.lower, p.upper) for p in posterior.priors], float).T
        start = np.clip(posterior.likelihood.start, lower, upper)
        sampled_here = np.isin(np.arange(len(start)), sampled)
        start = np.where(posterior.amplitude & ~sampled_here, 0.0, start)
        # Arrays replace numbers in compiled functions, so that other numbers need no compilation.
        on_device = jax.tree.map(
            lambda x: jnp.asarray(x, getattr(x, "dtype", float)) if eqx.is_array_like(x) else x, posterior
        )
        return cls(posterior, sampled, posterior.coordinates(start), batch, on_device)

    def embedded(self, y: Float[np.ndarray, "*batch sampled"]) -> Float[np.ndarray, "*batch params"]:
        """Coordinates of all parameters, given those that are sampled."""
        full = np.broadcast_to(self.base, (*y.shape[:-1], len(self.base))).copy()
        full[..., self.sampled] = y
        return full

    def densities(self, full: Float[np.ndarray, "k params"]) -> Float[np.ndarray, "2 k"]:
        """Log-likelihood, and log prior density of the sampled coordinates, at k points."""
        counted = np.isin(np.arange(len(self.base)), self.sampled)
        k = len(full)
        padded = np.resize(full, (-(-k // self.batch) * self.batch, full.shape[1]))
        parts = np.split(padded, len(padded) // self.batch)
        return np.concatenate([_log_densities(self._on_device, y, counted) for y in parts], axis=1)[:, :k]

    def __call__(self, y: Float[np.ndarray, "k sampled"]) -> Float[np.ndarray, " k"]:
        """Log-posterior density of the sampled coordinates."""
        return self.densities(self.embedded(y)).sum(axis=0)


class StudentMove(RedBlueMove):
    """Independence proposal: a Student t law with mean and covariance of the other half of the ensemble.

    If the posterior is nearly Gaussian in these coordinates, half of the proposals are accepted, each as good
    as a new draw. It follows emcee's KDEMove, without kernels; heavy tails keep the acceptance bounded.
    """

    def get_proposal(
        self,
        sample: Float[np.ndarray, "k d"],
        complement: list[Float[np.ndarray, "m d"]],
        random: np.random.RandomState,
    ) -> tuple[Float[np.ndarray, "k d"], Float[np.ndarray, " k"]]:
        others = np.concatenate(complement)
        k, d = sample.shape
        covariance = np.cov(others.T).reshape(d, d)
        # With few walkers in many dimensions, some directions may have no scatter.
        covariance += np.diag(1e-6 * np.diag(covariance) + 1e-20)
        L = np.linalg.cholesky(covariance)
        stretch = np.sqrt(_STUDENT_DOF / random.chisquare(_STUDENT_DOF, k))
        new = stretch[:, None] * random.standard_normal((k, d))
        old = np.linalg.solve(L, (sample - others.mean(axis=0)).T).T

        def log_density(z: Float[np.ndarray, "k d"]) -> Float[np.ndarray, " k"]:
            return -0.5 * (_STUDENT_DOF + d) * np.log1p(np.sum(z**2, axis=1) / _STUDENT_DOF)

        return others.mean(axis=0) + new @ L.T, log_density(old) - log_density(new)


def default_moves() -> list[tuple[RedBlueMove, float]]:
    """Moves and their weights: independence proposals, and differential evolution for other posteriors.

    Measured τ (steps) with 32 walkers, two / three / five terms sampled: 3 / 7 / 18; emcee's default stretch
    move has 31 / 47 / 77, DEMove with a fifth of DESnookerMove 10 / 15 / 29.
    """
    return [(StudentMove(), 0.6), (DEMove(), 0.3), (DESnookerMove(), 0.1)]


@dataclasses.dataclass(frozen=True)
class Convergence:
    """Criteria of convergence: length of the chain in autocorrelation times τ, relative change of τ, R̂."""

    max_steps: int
    min_length: float
    max_change: float
    max_r_hat: float

    def __post_init__(self) -> None:
        if not self.max_steps >= 10:
            raise AllanjaxError(f"max_steps must be at least 10, not {self.max_steps!r}")
        for name, bound in (("min_length", 0.0), ("max_change", 0.0), ("max_r_hat", 1.0)):
            if not getattr(self, name) > bound:
                raise AllanjaxError(f"{name} must be above {bound:g}, not {getattr(self, name)!r}")


@dataclasses.dataclass(frozen=True)
class Chains:
    """Chains of the walkers after the burn-in, in coordinates.

    `tau`, `change` and `r_hat` are per parameter; `change` is that of τ since the last check.
    """

    y: Float[np.ndarray, "steps walkers sampled"]
    log_density: Float[np.ndarray, "steps walkers"]
    tau: Float[np.ndarray, " sampled"]
    change: Float[np.ndarray, " sampled"]
    r_hat: Float[np.ndarray, " sampled"]
    acceptance: float
    steps: int
    converged: bool


def run(
    target: Target,
    start: Float[np.ndarray, "walkers sampled"],
    random: np.random.RandomState,
    wanted: Convergence,
    report: Callable[[int, int], None],
) -> Chains:
    """Run the ensemble until it has converged, or for `max_steps`; `report` gets steps done and expected."""
    sampler = emcee.EnsembleSampler(*start.shape, target, moves=default_moves(), vectorize=True)
    sampler.random_state = random.get_state()
    state = emcee.State(start, random_state=random.get_state())
    tau = np.full(start.shape[1], np.nan)
    expected = _FIRST_BLOCK
    while True:
        done = sampler.iteration
        state = sampler.run_mcmc(state, min(expected, wanted.max_steps) - done, skip_initial_state_check=True)
        steps = sampler.iteration
        tau, previous = _autocorrelation_time(sampler.get_chain(), tau), tau
        burn_in = min(int(np.ceil(_BURN_IN * np.nanmax([*tau, 1.0]))), steps // 2)
        chain = sampler.get_chain(discard=burn_in)
        change = np.abs(tau / previous - 1.0)
        r_hat = np.array([split_r_hat(chain[:, :, i]) for i in range(chain.shape[2])])
        long_enough = len(chain) > wanted.min_length * tau
        converged = bool(np.all(long_enough & (change < wanted.max_change) & (r_hat < wanted.max_r_hat)))
        # R̂² − 1 is inversely proportional to the length.
        lack = max(1.0, np.nan_to_num(np.max((r_hat**2 - 1.0) / (wanted.max_r_hat**2 - 1.0)), nan=1.0))
        expected_length = burn_in + max(
            1.1 * wanted.min_length * np.nanmax([*tau, 1.0]), 1.1 * lack * len(chain)
        )
        expected = int(np.clip(expected_length, 1.2 * steps, 2.0 * steps))
        report(steps, steps if converged else min(expected, wanted.max_steps))
        if converged or steps >= wanted.max_steps:
            return Chains(
                y=chain,
                log_density=sampler.get_log_prob(discard=burn_in),
                tau=tau,
                change=change,
                r_hat=r_hat,
                acceptance=float(sampler.acceptance_fraction.mean()),
                steps=steps,
                converged=converged,
            )


def _autocorrelation_time(
    chain: Float[np.ndarray, "steps walkers sampled"], previous: Float[np.ndarray, " sampled"]
) -> Float[np.ndarray, " sampled"]:
    """Autocorrelation time of each parameter after a burn-in by the previous one; NaN if unknown."""
    known = np.isfinite(previous)
    burn_in = int(_BURN_IN * previous[known].max()) if known.any() else len(chain) // 4
    with np.errstate(invalid="ignore", divide="ignore"):
        return emcee.autocorr.integrated_time(chain[min(burn_in, len(chain) // 2) :], tol=0, quiet=True)


def split_r_hat(chain: Float[np.ndarray, "steps walkers"]) -> float:
    """Rank-normalized split R̂ of one parameter, the larger one of bulk and tails.

    Vehtari, Gelman, Simpson, Carpenter & Bürkner (2021), Bayesian Analysis 16:667. NaN for a constant chain.
    """
    from scipy.special import ndtri
    from scipy.stats import rankdata

    half = len(chain) // 2
    halves = np.concatenate([chain[:half], chain[-half:]], axis=1)

    def r_hat(x: Float[np.ndarray, "half chains"]) -> float:
        z = ndtri((rankdata(x).reshape(x.shape) - 0.375) / (x.size + 0.25))
        within = z.var(axis=0, ddof=1).mean()
        if not within > 0.0:
            return float("nan")
        return float(np.sqrt((half - 1) / half + z.mean(axis=0).var(ddof=1) / within))

    return max(r_hat(halves), r_hat(np.abs(halves - np.median(halves))))


def first_walkers(
    target: Target, walkers: int, random: np.random.RandomState
) -> Float[np.ndarray, "walkers sampled"]:
    """Start of the walkers: a cloud around the fit, a little wider than its errors, inside the support.

    Raises FitError if the posterior is zero there and at all draws from the priors.
    """
    posterior, at = target.posterior, target.sampled
    start, scatter = posterior.likelihood.start[at], posterior.likelihood.scatter[at]
    centre = target.base[at]
    with np.errstate(all="ignore"):
        spread = scatter / np.exp(posterior.log_jacobian(target.base)[at])
    # The coordinate of a line is in Hz; all others are logarithms.
    reach = np.where(posterior.line[at], np.abs(start), 1.0)
    spread = np.where(np.isfinite(spread) & (spread > 0.0), np.minimum(spread, reach), 0.1 * reach)
    priors = [posterior.priors[i] for i in at]
    lower, upper = np.array([(p.lower, p.upper) for p in priors], float).T
    cloud = np.empty((walkers, len(at)))
    missing = np.arange(walkers)
    for attempt in range(_ATTEMPTS):
        # The cloud shrinks in case the fit's standard deviations are too large; finally, draws from the
        # priors.
        width = _OVERDISPERSION * spread * 0.5 ** min(attempt, 10)
        y = centre + width * random.standard_normal((len(missing), len(at)))
        y = np.where(posterior.amplitude[at], np.abs(y), y)
        values = posterior.values(target.embedded(y))
        drawn = np.stack([p.quantile(random.uniform(size=len(missing))) for p in priors], axis=1)
        outside = (values[:, at] < lower) | (values[:, at] > upper) | (attempt >= _ATTEMPTS // 2)
        values[:, at] = np.where(outside, drawn, values[:, at])
        cloud[missing] = posterior.coordinates(values)[:, at]
        missing = missing[~np.isfinite(target(cloud[missing]))]
        if not missing.size:
            return cloud
    raise FitError("the posterior has no density near the fit or within the priors; check the priors")


@dataclasses.dataclass(frozen=True, eq=False)
class GridPosterior:
    """Posterior of one amplitude on a grid: ascending amplitudes [SI], and the probability of a smaller one.

    `bayes_factor` is posterior over prior density at zero; `effective_draws` is the equivalent number of
    equally weighted draws at the 95 % quantile.
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
    others moves from their draws. The mean is invariant under any translation of the draws if the ratio
    includes the prior densities before and after; moving them to their weighted mean keeps the weights even.
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


@dataclasses.dataclass(frozen=True)
class AxisSampler:
    """Sampler of a fit's axes, with the checked arguments of `sample`."""

    fit: Fit
    priors: Mapping[str, Prior]
    seed: int
    walkers: int | None
    convergence: Convergence
    absent_draws: int

    def __post_init__(self) -> None:
        if not self.absent_draws >= 2:
            raise AllanjaxError(f"absent_draws must be at least 2, not {self.absent_draws!r}")
        if not (isinstance(self.seed, int | np.integer) and self.seed >= 0):
            raise AllanjaxError(f"seed must be an integer of at least 0, not {self.seed!r}")

    def all_axes(self, names: Sequence[str], progress: bool | None) -> tuple[AxisPosterior, ...]:
        """Posteriors of the named axes, with a progress bar if wanted."""
        results = []
        with _progress_bar(progress) as bar:
            for name in names:
                task = None if bar is None else bar.add_task(name, total=None)

                def report(steps: int, expected: int, task: Any = task) -> None:
                    if bar is not None:
                        bar.update(task, completed=steps, total=expected)

                results.append(dataclasses.replace(self, fit=self.fit.as_for(name))._one_axis(name, report))
        return tuple(results)

    def _one_axis(self, name: str, report: Callable[[int, int], None]) -> AxisPosterior:
        """Posterior of an axis whose model is the fit's; `report` gets the steps done and expected."""
        likelihood, widening = likelihood_of(self.fit, name), self.fit[name].widening
        if widening != 1.0:
            likelihood = WiderLikelihood.of(likelihood, widening)
        posterior = LogPosterior.of(likelihood, self._all_priors(likelihood))
        sampled = self._sampled(likelihood, name)
        walkers = self._walkers(len(sampled))
        target = Target.of(posterior, sampled, walkers // 2)
        # Each axis has random numbers of its own, so that its draws do not depend on the other axes.
        streams = np.random.SeedSequence([self.seed, self.fit.axes.index(name)]).generate_state(8)
        random = np.random.RandomState(streams)
        try:
            start = first_walkers(target, walkers, random)
        except FitError as error:
            raise FitError(f"{name}: {error}") from None
        chains = run(target, start, random, self.convergence, report)
        if not chains.converged:
            warnings.warn(self._complaint(name, likelihood, sampled, chains), PosteriorWarning, stacklevel=4)
        return self._result(name, target, chains, random)

    def _all_priors(self, likelihood: Likelihood) -> dict[str, Prior]:
        """Default priors, replaced by those of the user."""
        priors = default_priors(likelihood)
        for label, prior in self.priors.items():
            if label not in priors:
                raise AllanjaxError(
                    f"priors has {label!r}, which is not a parameter; the parameters are {', '.join(priors)}"
                )
            if not isinstance(prior, Prior):
                raise AllanjaxError(
                    f"the prior of {label} must be a Prior, e.g. LogUniform(1e-6, 1e-4), not {prior!r}"
                )
        return priors | dict(self.priors)

    def _sampled(self, likelihood: Likelihood, name: str) -> Int[np.ndarray, " sampled"]:
        """Indices of the parameters to sample."""
        sampled = np.flatnonzero(likelihood.found | (not self.fit.chosen))
        if not sampled.size:
            raise FitError(f"{name}: no posterior: the fit detected no term and has no free parameter")
        return sampled

    def _walkers(self, count: int) -> int:
        """Number of walkers for `count` parameters."""
        if self.walkers is None:
            return max(_WALKERS, 4 * count)
        if self.walkers % 2 or self.walkers < 2 * max(count, 2):
            raise AllanjaxError(
                f"walkers must be an even number of at least {2 * max(count, 2)} for {count} parameters, "
                f"not {self.walkers!r}"
            )
        return self.walkers

    def _complaint(
        self, name: str, likelihood: Likelihood, sampled: Int[np.ndarray, " sampled"], chains: Chains
    ) -> str:
        """Warning about chains that have not converged, with the worst parameter and the remedy."""
        wanted = self.convergence
        length = wanted.min_length * chains.tau
        excess = (chains.r_hat - 1.0) / (wanted.max_r_hat - 1.0)
        lack = np.max([length / len(chains.y), excess, chains.change / wanted.max_change], axis=0)
        lack = np.nan_to_num(lack, nan=np.inf)
        worst = int(np.argmax(lack))
        label = likelihood.parameters[sampled[worst]].label
        return (
            f"{name}: the posterior has not converged in {chains.steps} steps; {label} is worst, with "
            f"τ = {plain(chains.tau[worst], 3)} steps, {len(chains.y)} of {length[worst]:.0f} steps after "
            f"the burn-in, a last change of τ of {percent(chains.change[worst])} and "
            f"R̂ = {chains.r_hat[worst]:.4f}; allow more steps, e.g. max_steps={4 * wanted.max_steps}, "
            "or give narrower priors"
        )

    def _result(
        self, name: str, target: Target, chains: Chains, random: np.random.RandomState
    ) -> AxisPosterior:
        """Posterior of one axis from its chains, with the marginals of parameters that were not sampled."""
        posterior, sampled = target.posterior, target.sampled
        fit, parameters = self.fit[name], posterior.likelihood.parameters
        full = target.embedded(chains.y)
        chain = posterior.values(full)[..., sampled]
        # The density per SI unit, instead of per unit of the coordinates.
        jacobian = posterior.log_jacobian(full)[..., sampled].sum(axis=-1)
        thin = max(1, int(np.nan_to_num(chains.tau).max() / 2.0))
        y = chains.y[::thin].reshape(-1, len(sampled))
        draws = chain[::thin].reshape(-1, len(sampled))

        known = sampled_marginals(posterior, fit.axis, sampled.tolist(), draws)
        for i, p in enumerate(parameters):
            if i in known:
                continue
            if posterior.amplitude[i]:
                grid = absent_amplitude(target, i, y, self.absent_draws, random)
                known[i] = absent_marginal(p, fit.axis, grid)
            else:
                known[i] = undetermined(p, fit.axis)
        marginals = {parameters[i].label: m for i, m in known.items()}
        for c in fit.coefficients.values():
            if c.held:
                marginals[c.label] = dataclasses.replace(c, source="posterior", sampled=False)
            elif c.rivals:
                # Draws are of the chosen terms only.
                marginals[c.label] = dataclasses.replace(marginals[c.label], detected=False, rivals=c.rivals)
        in_order = [p.label for p in self.fit.template.parameters if p.label in marginals]
        curve = self.fit.curve
        return AxisPosterior(
            axis=fit.axis,
            labels=tuple(parameters[i].label for i in sampled),
            draws=draws,
            chain=chain,
            log_probability=chains.log_density - jacobian,
            coefficients={label: marginals[label] for label in in_order},
            priors=dict(zip((p.label for p in parameters), posterior.priors, strict=True)),
            converged=chains.converged,
            tau=chains.tau,
            r_hat=chains.r_hat,
            acceptance=chains.acceptance,
            steps=chains.steps,
            rate=curve.rate,
            duration=curve.n / curve.rate,
            _template=self.fit.template,
        )


def _progress_bar(wanted: bool | None) -> AbstractContextManager[Any]:
    """Context of a progress bar on stderr, or of None if no bar is wanted."""
    if not (sys.stderr.isatty() if wanted is None else wanted):
        return nullcontext()
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("steps"),
        TimeElapsedColumn(),
    )
    return Progress(*columns, console=Console(stderr=True))
