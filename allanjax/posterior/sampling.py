"""Markov chain Monte Carlo: emcee's ensemble of walkers for the coefficients of one axis.

Coordinates are those in which the default priors are uniform: ln(1 + c/scale) of an amplitude c,
ln(x − lower bound) of a time, frequency or number, and the frequency itself of a line.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import emcee
import numpy as np
from emcee.moves import DEMove, DESnookerMove, RedBlueMove
from jaxtyping import Float, Int

from allanjax.base.errors import AllanjaxError, FitError
from allanjax.posterior.likelihood import Likelihood
from allanjax.posterior.priors import Prior

# Steps in which the proposals adapt, and steps before the convergence of the chain is first checked.
_WARM_UP, _FIRST_BLOCK = 100, 200
# Length of the burn-in, in autocorrelation times.
_BURN_IN = 5.0
# Scatter of the first walkers over the fit's standard deviations.
_OVERDISPERSION = 1.5
# Attempts to place a walker; the later half are draws from the priors.
_ATTEMPTS = 40
# Degrees of freedom of the proposed Student law, with tails heavier than those of any posterior seen here.
_STUDENT_DOF = 4.0


class Target:
    """Log-posterior of the parameters `sampled` of one axis, by index, the others being kept at `base`.

    Attributes:
        likelihood, priors: of all free parameters.
        amplitude, line: which parameters are amplitudes, and frequencies of lines.
        scale, origin: of the coordinates.
        base: coordinates where amplitudes that are not sampled are 0, and shapes at their start.
    """

    def __init__(
        self, likelihood: Likelihood, priors: Mapping[str, Prior], sampled: Int[np.ndarray, " sampled"]
    ) -> None:
        parameters = likelihood.parameters
        self.likelihood, self.sampled = likelihood, sampled
        self.priors = tuple(priors[p.label] for p in parameters)
        kinds = np.array([p.parameter.kind for p in parameters])
        self.amplitude, self.line = kinds == "amplitude", kinds == "line"
        self.scale = np.where(self.amplitude, likelihood.prior_scale, 1.0)
        self.origin = np.array([p.parameter.lower for p in parameters])
        start = np.clip(likelihood.start, *np.array([(p.lower, p.upper) for p in self.priors], float).T)
        absent = self.amplitude & ~np.isin(np.arange(len(kinds)), sampled)
        self.base = self.coordinates(np.where(absent, 0.0, start))

    def values(self, y: Float[np.ndarray, ...], at: Any = slice(None)) -> Float[np.ndarray, ...]:
        """Values in SI at coordinates [..., params], or at those of the parameter with index `at`."""
        line = self.line[at]
        exponent = np.where(line, 0.0, y)
        others = np.where(line, y, self.origin[at] + np.exp(exponent))
        return np.where(self.amplitude[at], self.scale[at] * np.expm1(exponent), others)

    def coordinates(self, values: Float[np.ndarray, ...], at: Any = slice(None)) -> Float[np.ndarray, ...]:
        """Coordinates of values in SI, the inverse of `values`."""
        with np.errstate(invalid="ignore", divide="ignore"):
            others = np.where(self.line[at], values, np.log(values - self.origin[at]))
            return np.where(self.amplitude[at], np.log1p(values / self.scale[at]), others)

    def log_jacobian(self, y: Float[np.ndarray, ...], at: Any = slice(None)) -> Float[np.ndarray, ...]:
        """Logarithm of the derivative of each value by its coordinate."""
        return np.where(self.line[at], 0.0, y + np.log(self.scale[at]))

    def log_prior(self, y: Float[np.ndarray, ...], index: int) -> Float[np.ndarray, ...]:
        """Logarithm of the prior density of one of the coordinates; −inf outside its support."""
        with np.errstate(over="ignore"):
            density = self.priors[index].log_density(self.values(y, index))
        return np.asarray(density) + self.log_jacobian(y, index)

    def embedded(self, y: Float[np.ndarray, "*batch sampled"]) -> Float[np.ndarray, "*batch params"]:
        """Coordinates of all parameters, given those that are sampled."""
        full = np.broadcast_to(self.base, (*y.shape[:-1], len(self.base))).copy()
        full[..., self.sampled] = y
        return full

    def log_density(self, full: Float[np.ndarray, "k params"]) -> Float[np.ndarray, " k"]:
        """Log-likelihood plus log prior density of the sampled coordinates; −inf outside the support."""
        total = np.sum([self.log_prior(full[:, i], i) for i in self.sampled], axis=0)
        # Outside the support the likelihood may be undefined.
        allowed = np.isfinite(total)
        if allowed.any():
            total[allowed] += self.likelihood(self.values(full[allowed]))
        return np.where(allowed & ~np.isnan(total), total, -np.inf)

    def __call__(self, y: Float[np.ndarray, "k sampled"]) -> Float[np.ndarray, " k"]:
        """Log-posterior density of the sampled coordinates."""
        return self.log_density(self.embedded(y))


class StudentMove(RedBlueMove):
    """Independence proposal: a Student t law with mean and covariance of earlier points.

    These are the other half of the ensemble until `adapt` is called. If the posterior is nearly Gaussian in
    these coordinates, most of the proposals are accepted, each as good as a new draw; heavy tails keep the
    acceptance bounded.
    """

    points: Float[np.ndarray, "k d"] | None = None

    def get_proposal(
        self,
        sample: Float[np.ndarray, "k d"],
        complement: list[Float[np.ndarray, "m d"]],
        random: np.random.RandomState,
    ) -> tuple[Float[np.ndarray, "k d"], Float[np.ndarray, " k"]]:
        others = np.concatenate(complement) if self.points is None else self.points
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
    """Run the ensemble until it has converged, or for `max_steps`; `report` gets steps done and expected.

    Most proposals are independent, from a law that adapts in a warm-up, which no result contains; the others
    are differential evolution, for posteriors that are far from Gaussian.
    """
    student = StudentMove()
    moves = [(student, 0.6), (DEMove(), 0.3), (DESnookerMove(), 0.1)]
    sampler = emcee.EnsembleSampler(*start.shape, target, moves=moves, vectorize=True)
    sampler.random_state = random.get_state()
    state = emcee.State(start, random_state=random.get_state())
    warm_up = min(_WARM_UP, wanted.max_steps)
    state = sampler.run_mcmc(state, warm_up, skip_initial_state_check=True)
    student.points = sampler.get_chain(discard=warm_up // 2, flat=True)
    sampler.reset()
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
    at = target.sampled
    start, scatter = target.likelihood.start[at], target.likelihood.scatter[at]
    centre = target.base[at]
    with np.errstate(all="ignore"):
        spread = scatter / np.exp(target.log_jacobian(target.base)[at])
    # The coordinate of a line is in Hz; all others are logarithms.
    reach = np.where(target.line[at], np.abs(start), 1.0)
    spread = np.where(np.isfinite(spread) & (spread > 0.0), np.minimum(spread, reach), 0.1 * reach)
    priors = [target.priors[i] for i in at]
    lower, upper = np.array([(p.lower, p.upper) for p in priors], float).T
    # The cloud shrinks in case the fit's standard deviations are too large; finally, draws from the priors.
    shrinks = np.repeat(0.5 ** np.minimum(np.arange(_ATTEMPTS), 10), walkers)[:, None]
    y = centre + _OVERDISPERSION * spread * shrinks * random.standard_normal((len(shrinks), len(at)))
    values = target.values(target.embedded(np.where(target.amplitude[at], abs(y), y)))
    drawn = np.stack([p.quantile(random.uniform(size=len(y))) for p in priors], axis=1)
    outside = (values[:, at] < lower) | (values[:, at] > upper)
    outside[len(y) // 2 :] = True
    values[:, at] = np.where(outside, drawn, values[:, at])
    y = target.coordinates(values)[:, at]
    # As many as needed, mostly one block.
    cloud = np.empty((0, len(at)))
    for block in np.split(y, _ATTEMPTS):
        cloud = np.concatenate([cloud, block[np.isfinite(target(block))]])
        if len(cloud) >= walkers:
            return cloud[:walkers]
    raise FitError("the posterior has no density near the fit or within the priors; check the priors")
