"""Markov chain Monte Carlo of one axis by emcee's ensemble of walkers, and marginals of all parameters.

`value` is the median, `std` the standard deviation; the central intervals hold 68 and 95 % of the posterior;
`upper_limit` is the 95 % quantile. An amplitude is `detected` if the fit detects it; otherwise its intervals
begin at zero, and `interval` ends at `upper_limit`.

The `bayes_factor` of an amplitude is the posterior over the prior probability of values that cannot be
distinguished from zero (up to a third of the prior's scale; for terms not sampled, zero itself): the factor
by which the data change the odds of the term's absence (Savage's density ratio; Dickey 1971, Ann. Math.
Stat. 42:204). Under the default prior it is 1/20 if the squared amplitude is 3.5 to 3.8 standard deviations
above zero. It is 0 under a prior that excludes zero. Amplitudes without draws (`sampled` is False) belong to
terms that the fit did not detect.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import emcee
import numpy as np
from emcee.autocorr import integrated_time
from emcee.moves import DEMove, DESnookerMove, RedBlueMove
from jaxtyping import Float
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import CubicSpline
from scipy.special import logsumexp, ndtri
from scipy.stats import rankdata

from allanjax.base.errors import AllanjaxError
from allanjax.base.wording import plain
from allanjax.estimate.result import AxisFit, Fit
from allanjax.noise.estimate import Estimate
from allanjax.posterior.priors import Prior
from allanjax.posterior.result import AxisPosterior, PosteriorWarning, spaced, summary
from allanjax.posterior.target import Target

# Steps in which the proposals adapt, in how many rounds, steps before convergence is first checked, and
# length of the burn-in in autocorrelation times.
_WARM_UP, _ROUNDS, _FIRST_BLOCK, _BURN_IN = 100, 4, 200, 5.0
# Degrees of freedom of the proposed Student law, with tails heavier than those of any posterior seen here.
_DOF = 4.0
# Below this coordinate, a third of the prior's scale, an amplitude cannot be distinguished from zero.
_INDISTINGUISHABLE = 0.3
# Step of an amplitude's coordinate, least number of steps, and number of points between which the density is
# integrated. The range ends where the density is e^-12 of its maximum.
_STEP, _STEPS, _DENSE = 0.1, 16, 4001
_NEGLIGIBLE = 12.0
# Attempts to translate the draws at one point, until effective draws over draws reach this ratio.
_CORRECTIONS, _EVEN = 6, 0.5

_Draws: TypeAlias = Float[np.ndarray, "draws sampled"]


@dataclasses.dataclass(frozen=True)
class Options:
    """Arguments of `sample`, checked."""

    seed: int
    walkers: int | None
    max_steps: int
    min_length: float
    max_change: float
    max_r_hat: float
    absent_draws: int

    def __post_init__(self) -> None:
        least = {"seed": -1, "max_steps": 9, "min_length": 0, "max_change": 0, "max_r_hat": 1}
        for name, bound in (least | {"absent_draws": 1}).items():
            if not getattr(self, name) > bound:
                raise AllanjaxError(f"{name} must be above {bound}, not {getattr(self, name)!r}")

    def walkers_for(self, count: int) -> int:
        """Number of walkers for `count` parameters."""
        least = 2 * max(count, 2)
        walkers = max(32, 2 * least) if self.walkers is None else self.walkers
        if walkers % 2 or walkers < least:
            allowed = f"an even number of at least {least} for {count} parameters"
            raise AllanjaxError(f"walkers must be {allowed}, not {walkers!r}")
        return walkers


class StudentMove(RedBlueMove):
    """Independence proposal: a Student t law with mean and covariance of earlier points.

    If the posterior is nearly Gaussian in these coordinates, most of the proposals are accepted, each as good
    as a new draw; heavy tails keep the acceptance bounded.
    """

    def __init__(self, points: _Draws) -> None:
        # All walkers move at once.
        super().__init__(nsplits=1)
        self.adapt(points)

    def adapt(self, points: _Draws) -> None:
        """Propose the law of these points."""
        self._mean, covariance = points.mean(axis=0), np.atleast_2d(np.cov(points.T))
        # With few walkers in many dimensions, some directions may have no scatter.
        self._L = np.linalg.cholesky(covariance + np.diag(1e-6 * np.diag(covariance) + 1e-20))

    def get_proposal(
        self, sample: _Draws, _: list[_Draws], random: np.random.RandomState
    ) -> tuple[_Draws, Float[np.ndarray, " k"]]:
        k, d = sample.shape
        new = random.standard_normal((k, d)) * np.sqrt(_DOF / random.chisquare(_DOF, (k, 1)))
        old = np.linalg.solve(self._L, (sample - self._mean).T).T
        tail, was = (np.log1p(np.sum(z**2, axis=1) / _DOF) for z in (new, old))
        return self._mean + new @ self._L.T, 0.5 * (_DOF + d) * (tail - was)


def _run(
    target: Target, random: np.random.RandomState, wanted: Options, report: Callable[[int, int], None]
) -> tuple[Float[np.ndarray, "steps walkers sampled"], dict[str, Any]]:
    """Run the ensemble until it has converged, or for `max_steps`; `report` gets steps done and expected.

    Returns coordinates after the burn-in, and fields of `AxisPosterior` that describe the chains.

    Most proposals are independent, from a law that adapts in a warm-up, which no result contains; the others
    are differential evolution, for posteriors that are far from Gaussian.
    """
    start = target.first_walkers(wanted.walkers_for(len(target.sampled)), random)
    student, most = StudentMove(start), wanted.max_steps
    moves = [(student, 0.6), (DEMove(), 0.3), (DESnookerMove(), 0.1)]
    sampler = emcee.EnsembleSampler(*start.shape, target, moves=moves, vectorize=True)
    state = emcee.State(start, random_state=random.get_state())
    for steps in [min(_WARM_UP, most) // _ROUNDS] * _ROUNDS:
        state = sampler.run_mcmc(state, steps, skip_initial_state_check=True)
        student.adapt(sampler.get_chain(discard=sampler.iteration // 2, flat=True))
    sampler.reset()
    tau, burn_in, expected = np.full(start.shape[1], np.nan), _FIRST_BLOCK // 4, _FIRST_BLOCK
    while True:
        ahead = min(expected, most) - sampler.iteration
        state = sampler.run_mcmc(state, ahead, skip_initial_state_check=True)
        steps = sampler.iteration
        with np.errstate(invalid="ignore", divide="ignore"):
            settled = target.drawn(sampler.get_chain(discard=min(burn_in, steps // 2)))
            tau, previous = integrated_time(settled, tol=0, quiet=True), tau
        burn_in = min(int(np.ceil(_BURN_IN * np.nanmax([*tau, 1.0]))), steps // 2)
        chain = sampler.get_chain(discard=burn_in)
        r_hat = np.array([_split_r_hat(chain[:, :, i]) for i in range(chain.shape[2])])
        enough = (len(chain) > wanted.min_length * tau) & (abs(tau / previous - 1.0) < wanted.max_change)
        converged = bool(np.all(enough & (r_hat < wanted.max_r_hat)))
        if converged or steps >= most:
            report(steps, steps)
            found = {"tau": tau, "r_hat": r_hat, "steps": steps, "converged": converged}
            found["acceptance"] = float(sampler.acceptance_fraction.mean())
            return chain, found | {"log_probability": sampler.get_log_prob(discard=burn_in)}
        length = burn_in + 1.1 * wanted.min_length * np.nanmax([*tau, 1.0])
        expected = int(np.clip(length, 1.2 * steps, 2.0 * steps))
        report(steps, min(expected, most))


def _split_r_hat(chain: Float[np.ndarray, "steps walkers"]) -> float:
    """Rank-normalized split R̂ of one parameter, the larger one of bulk and tails.

    Vehtari, Gelman, Simpson, Carpenter & Bürkner (2021), Bayesian Analysis 16:667. NaN for a constant chain.
    """
    half = len(chain) // 2
    halves = np.concatenate([chain[:half], chain[-half:]], axis=1)
    found = []
    for x in (halves, np.abs(halves - np.median(halves))):
        z = ndtri((rankdata(x).reshape(x.shape) - 0.375) / (x.size + 0.25))
        within, between = z.var(axis=0, ddof=1).mean(), z.mean(axis=0).var(ddof=1)
        found.append(np.sqrt((half - 1) / half + between / within) if within > 0.0 else np.nan)
    return float(max(found))


def posterior_of(
    fit: Fit, name: str, priors: Mapping[str, Prior], options: Options, report: Callable[[int, int], None]
) -> AxisPosterior:
    """Posterior of an axis whose model is the fit's; `report` gets the steps done and expected."""
    target, result = Target(fit, name, priors), fit[name]
    labels = tuple(target.parameters[i].label for i in target.sampled)
    # Each axis has random numbers of its own, so that its draws do not depend on the other axes.
    streams = np.random.SeedSequence([options.seed, fit.axes.index(name)]).generate_state(8)
    random = np.random.RandomState(streams)
    chain, found = _run(target, random, options, report)
    tau = found["tau"]
    if not found["converged"]:
        worst = int(np.argmax(np.nan_to_num(tau, nan=np.inf)))
        complaint = (
            f"{name}: the posterior has not converged in {found['steps']} steps; {labels[worst]} is worst "
            f"with τ = {plain(tau[worst], 3)} steps and R̂ = {found['r_hat'][worst]:.4f}; allow more steps, "
            f"e.g. max_steps={4 * options.max_steps}, or give narrower priors"
        )
        warnings.warn(complaint, PosteriorWarning, stacklevel=3)
    y = chain[:: max(1, int(np.nan_to_num(tau).max() / 2.0))].reshape(-1, len(labels))
    # The density per SI unit, instead of per unit of the coordinates.
    found["log_probability"] = found["log_probability"] - chain.sum(axis=-1)
    return AxisPosterior(
        axis=result.axis,
        labels=labels,
        draws=target.drawn(y),
        chain=target.drawn(chain),
        coefficients=_marginals(target, result, y, spaced(y, options.absent_draws), random),
        priors={target.parameters[k].label: prior for k, prior in target.priors.items()},
        rate=fit.curve.rate,
        duration=fit.curve.n / fit.curve.rate,
        _template=fit.template,
        **found,
    )


def _marginals(
    target: Target, fit: AxisFit, y: _Draws, few: _Draws, random: np.random.RandomState
) -> dict[str, Estimate]:
    """Marginals of all parameters by label, from the draws of those sampled; `few` are for absent terms."""
    columns = dict(zip(target.sampled.tolist(), target.drawn(y).T, strict=True))
    found, there = dict[str, Estimate](), dict[int, bool]()
    for i, p in enumerate(target.parameters):
        c, draws, factor, limit = fit.coefficients.get(p.label), columns.get(i), None, None
        if c is None or not (c.held or i in target.priors):
            continue
        if p.parameter.is_amplitude and not c.held:
            if draws is None:
                draws, factor = _absent_amplitude(target, i, few, random)
            else:
                factor = _bayes_factor(target, i, draws)
            there[p.term], limit = c.detected, float(np.quantile(draws, 0.95))
        # Without draws: held, or a shape of an absent term.
        more: dict[str, Any] = {"source": "posterior"}
        if draws is not None:
            here = there.get(p.term, True)
            more = summary(draws, from_zero=p.parameter.is_amplitude and not here)
            more |= {"detected": here, "upper_limit": limit, "lower_limit": None}
        found[p.label] = dataclasses.replace(c, **more, bayes_factor=factor, sampled=i in columns)
    return found


def _bayes_factor(target: Target, index: int, draws: Float[np.ndarray, " draws"]) -> float:
    """Posterior over prior probability of an amplitude [SI] indistinguishable from zero; 0 if excluded."""
    threshold = -target.origin[index] * np.expm1(_INDISTINGUISHABLE)
    # A prior without any mass there excludes zero whatever the data say.
    u = np.geomspace(1e-9, 1.0 - 1e-9, _DENSE)
    before = np.interp(threshold, target.priors[index].quantile(u), np.log(u), left=np.inf)
    return float(np.mean(draws < threshold) * np.exp(-before))


def _absent_amplitude(
    target: Target, index: int, y: _Draws, random: np.random.RandomState
) -> tuple[Float[np.ndarray, " amplitudes"], float]:
    """Equally probable amplitudes [SI] and Bayes factor of the amplitude with this index, which is zero in y.

    p(c | data) ∝ p(c) ∫ L(θ, c) p(θ) dθ ∝ p(c)·mean_i [L(θ_i, c)/L(θ_i, 0)] over draws θ_i of the others at c
    = 0; a shape of the term itself is drawn from its prior. The larger c, the farther the posterior of the
    others moves from their draws. The mean is invariant under any translation of the draws if the ratio
    includes the prior densities before and after; moving them to their weighted mean, which is followed from
    one c to the next, keeps the weights even.
    """
    values, prior, origin = target.values(y), target.priors[index], target.origin[index]
    for k in target.priors.keys() - {index, *target.sampled.tolist()}:
        if target.parameters[k].term == target.parameters[index].term:
            values[:, k] = target.priors[k].quantile(random.uniform(size=len(y)))
    lower, upper = np.log(prior.quantile(np.array([0.0, 1.0 - 1e-9])) - origin)
    grid = np.arange(lower, upper, min(_STEP, (upper - lower) / _STEPS))
    amplitude = np.maximum(origin + np.exp(grid), prior.lower)
    before, of_prior = target.log_density(values), target.log_prior(amplitude, index)
    log_ratio, shifts = np.full(len(grid), -np.inf), [np.zeros(y.shape[1])] * 2
    for g in range(len(grid)):
        values[:, index] = amplitude[g]
        # Start from the linear continuation of the last two translations.
        shift = 2.0 * shifts[-1] - shifts[-2]
        for _ in range(_CORRECTIONS):
            values[:, target.sampled] = target.drawn(y + shift)
            log_weight = target.log_density(values) - before
            log_ratio[g] = logsumexp(log_weight) - np.log(len(y))
            if not np.isfinite(log_ratio[g]):
                shift = shifts[-1]
                continue
            share = np.exp(log_weight - log_ratio[g]) / len(y)
            shift = shift + share @ y - y.mean(axis=0)
            if 1.0 / np.sum(share**2) > _EVEN * len(y):
                break
        shifts.append(shift)
        log_density = (log_ratio + of_prior)[: g + 1]
        if log_density[-1] < log_density.max() - _NEGLIGIBLE:
            break
    known = np.isfinite(log_density)
    dense = np.linspace(lower, grid[g], _DENSE)
    log_density = CubicSpline(grid[: g + 1][known], log_density[known])(dense)
    mass = cumulative_trapezoid(np.exp(log_density - log_density.max()), dense, initial=0.0)
    drawn = origin + np.exp(np.interp(np.arange(0.5, _DENSE) / _DENSE, mass / mass[-1], dense))
    return np.maximum(drawn, prior.lower), float(np.exp(log_ratio[0] - log_density.max()) / mass[-1])
