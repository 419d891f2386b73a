"""Markov chain Monte Carlo for one axis: emcee's ensemble of walkers, run until it has converged."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, TypeVar

import emcee
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from emcee.moves import DEMove, DESnookerMove, RedBlueMove
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from allanjax.base.errors import AllanjaxError, FitError
from allanjax.posterior.priors import Prior

if TYPE_CHECKING:
    from allanjax.posterior.likelihood import Likelihood

Coordinates = TypeVar("Coordinates", np.ndarray, jax.Array)

# Steps before the convergence of the chain is first checked.
_FIRST_BLOCK = 200
# Length of the burn-in, in autocorrelation times.
_BURN_IN = 5.0
# Scatter of the first walkers over the fit's standard deviations.
_OVERDISPERSION = 1.5
# Attempts to place a walker; the later half of them are draws from the priors.
_ATTEMPTS = 40
# Degrees of freedom of the Student law proposed: tails heavier than those of any posterior met here.
_STUDENT_DOF = 4.0


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

    def on_device(self) -> LogPosterior:
        """Copy for compiled functions, with arrays for numbers, so that other numbers need no compilation."""
        return jax.tree.map(
            lambda x: jnp.asarray(x, getattr(x, "dtype", float)) if eqx.is_array_like(x) else x, self
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
        return cls(posterior, sampled, posterior.coordinates(start), batch, posterior.on_device())

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

    A posterior near Gaussian in these coordinates accepts half of them, each as good as a new draw. Like
    emcee's KDEMove, which it follows, but without its kernels; heavy tails keep the acceptance bounded.
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
        # Few walkers in many dimensions may have no scatter in some directions.
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
            raise AllanjaxError(f"max_steps must be at least 10, got {self.max_steps!r}")
        for name, bound in (("min_length", 0.0), ("max_change", 0.0), ("max_r_hat", 1.0)):
            if not getattr(self, name) > bound:
                raise AllanjaxError(f"{name} must be above {bound:g}, got {getattr(self, name)!r}")


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
    """Rank-normalized split R̂ of one parameter, the larger of those of the bulk and of the tails.

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

    Raises FitError if the posterior is zero there and at draws from the priors.
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
        # The cloud shrinks, in case the fit's standard deviations are too large; finally draws from the
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
    raise FitError("the posterior has no density near the fit nor where the priors allow; check the priors")
