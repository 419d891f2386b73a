"""Markov chain Monte Carlo: emcee's ensemble of walkers for the parameters of one axis."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, TypeAlias

import emcee
import numpy as np
from emcee.autocorr import integrated_time
from emcee.moves import DEMove, DESnookerMove, RedBlueMove
from jaxtyping import Float
from scipy.special import ndtri
from scipy.stats import rankdata

from allanjax.base.errors import AllanjaxError
from allanjax.posterior.target import Target

# Steps in which the proposals adapt, in how many rounds, and steps before convergence is first checked.
_WARM_UP, _ROUNDS, _FIRST_BLOCK = 100, 4, 200
# Length of the burn-in, in autocorrelation times.
_BURN_IN = 5.0
# Degrees of freedom of the proposed Student law, with tails heavier than those of any posterior seen here.
_DOF = 4.0

_Points: TypeAlias = Float[np.ndarray, "k d"]


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
        least = {
            "seed": -1,
            "max_steps": 9,
            "absent_draws": 1,
            "min_length": 0,
            "max_change": 0,
            "max_r_hat": 1,
        }
        for name, bound in least.items():
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

    def __init__(self, points: _Points) -> None:
        # All walkers move at once.
        super().__init__(nsplits=1)
        self.adapt(points)

    def adapt(self, points: _Points) -> None:
        """Propose the law of these points."""
        self._mean, covariance = points.mean(axis=0), np.atleast_2d(np.cov(points.T))
        # With few walkers in many dimensions, some directions may have no scatter.
        self._L = np.linalg.cholesky(covariance + np.diag(1e-6 * np.diag(covariance) + 1e-20))

    def get_proposal(
        self, sample: _Points, _: list[_Points], random: np.random.RandomState
    ) -> tuple[_Points, Float[np.ndarray, " k"]]:
        k, d = sample.shape
        new = random.standard_normal((k, d)) * np.sqrt(_DOF / random.chisquare(_DOF, (k, 1)))
        old = np.linalg.solve(self._L, (sample - self._mean).T).T
        tail, was = (np.log1p(np.sum(z**2, axis=1) / _DOF) for z in (new, old))
        return self._mean + new @ self._L.T, 0.5 * (_DOF + d) * (tail - was)


def run(
    target: Target, random: np.random.RandomState, wanted: Options, report: Callable[[int, int], None]
) -> tuple[Float[np.ndarray, "steps walkers sampled"], dict[str, Any]]:
    """Run the ensemble until it has converged, or for `max_steps`; `report` gets steps done and expected.

    Returns coordinates after the burn-in, and fields of `AxisPosterior` that describe the chains.

    Half of the proposals are independent, from a law that adapts in a warm-up, which no result contains; the
    others are differential evolution, for posteriors that are far from Gaussian.
    """
    start = target.first_walkers(wanted.walkers_for(len(target.sampled)), random)
    student, most = StudentMove(start), wanted.max_steps
    moves = [(student, 0.5), (DEMove(), 0.4), (DESnookerMove(), 0.1)]
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
            settled = sampler.get_chain(discard=min(burn_in, steps // 2))
            tau, previous = integrated_time(settled, tol=0, quiet=True), tau
        burn_in = min(int(np.ceil(_BURN_IN * np.nanmax([*tau, 1.0]))), steps // 2)
        chain = sampler.get_chain(discard=burn_in)
        r_hat = np.array([split_r_hat(chain[:, :, i]) for i in range(chain.shape[2])])
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


def split_r_hat(chain: Float[np.ndarray, "steps walkers"]) -> float:
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
