"""Sampling one axis after the other, and marginals of all parameters from the draws.

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

import numpy as np
from jaxtyping import Float
from rich.console import Console
from rich.progress import Progress, TaskID
from scipy.interpolate import CubicSpline
from scipy.special import logsumexp

from allanjax.base.errors import AllanjaxError, FitError
from allanjax.base.wording import percent, plain
from allanjax.estimate.result import Fit
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import ModelParameter
from allanjax.posterior.likelihood import Likelihood, likelihood_of
from allanjax.posterior.priors import Prior
from allanjax.posterior.result import AxisPosterior, PosteriorWarning
from allanjax.posterior.sampling import Chains, Convergence, Target, first_walkers, run
from allanjax.record.recording import Axis

# An amplitude is detected if the data make zero less credible by this factor.
_DETECTED = 1.0 / 20.0
# Below this coordinate, a third of the prior's scale, an amplitude cannot be distinguished from zero.
_INDISTINGUISHABLE = 0.3
# Probabilities of the median, the central 68 and 95 %, and the lowest 68 and 95 %.
_QUANTILES = (0.5, 0.16, 0.84, 0.025, 0.975, 0.68, 0.95)
# Default number of walkers, or four per parameter if that is more.
_WALKERS = 32
# Step of an amplitude's coordinate, least number of steps, and number of points between which the density is
# integrated. The range ends where the density is e^-12 of its maximum.
_STEP, _STEPS, _DENSE = 0.1, 16, 4001
_NEGLIGIBLE = 12.0
# Attempts to translate the draws at one point, until effective draws over draws reach this ratio.
_CORRECTIONS, _EVEN = 6, 0.5


def absent_amplitude(
    target: Target, index: int, y: Float[np.ndarray, "draws sampled"], random: np.random.RandomState
) -> tuple[Float[np.ndarray, " amplitudes"], float]:
    """Equally probable amplitudes [SI] and Bayes factor of the amplitude with this index, which is zero in y.

    p(c | data) ∝ p(c) ∫ L(θ, c) p(θ) dθ ∝ p(c)·mean_i [L(θ_i, c)/L(θ_i, 0)] over draws θ_i of the others at c
    = 0; a shape of the term itself is drawn from its prior. The larger c, the farther the posterior of the
    others moves from their draws. The mean is invariant under any translation of the draws if the ratio
    includes the prior densities before and after; moving them to their weighted mean, which is followed from
    one c to the next, keeps the weights even.
    """
    full, prior = target.embedded(y), target.priors[index]
    for k, p in enumerate(target.likelihood.parameters):
        if k not in (index, *target.sampled) and p.term == target.likelihood.parameters[index].term:
            full[:, k] = target.coordinates(target.priors[k].quantile(random.uniform(size=len(y))), k)
    ends = prior.lower, prior.upper if np.isfinite(prior.upper) else prior.quantile(1.0 - 1e-9)
    lower, upper = target.coordinates(np.array(ends), index)
    grid = np.arange(lower, upper, min(_STEP, (upper - lower) / _STEPS))
    of_prior, before = target.log_prior(grid, index), target.log_density(full)
    log_ratio, shifts, moved = np.full(len(grid), -np.inf), [np.zeros(y.shape[1])] * 2, full.copy()
    for g, coordinate in enumerate(grid):
        moved[:, index] = coordinate
        # Start from the linear continuation of the last two translations.
        shift = 2.0 * shifts[-1] - shifts[-2]
        for _ in range(_CORRECTIONS):
            moved[:, target.sampled] = y + shift
            log_weight = target.log_density(moved) - before
            log_ratio[g] = logsumexp(log_weight) - np.log(len(y))
            if not np.isfinite(log_ratio[g]):
                shift = shifts[-1]
                continue
            share = np.exp(log_weight - log_ratio[g]) / len(y)
            shift = shift + share @ y - y.mean(axis=0)
            if 1.0 / np.sum(share**2) > _EVEN * len(y):
                break
        shifts.append(shift)
        density = (log_ratio + of_prior)[: g + 1]
        if density[-1] < density.max() - _NEGLIGIBLE:
            break
    known = np.isfinite(log_ratio)
    dense = np.linspace(lower, grid[known][-1], _DENSE)
    log_density = CubicSpline(grid[known], log_ratio[known])(dense) + target.log_prior(dense, index)
    density = np.exp(log_density - log_density.max())
    steps = (density[1:] + density[:-1]) / 2.0
    probability = np.append(0.0, np.cumsum(steps))
    even = (np.arange(_DENSE) + 0.5) / _DENSE
    amplitudes = target.values(np.interp(even, probability / probability[-1], dense), index)
    total = np.log(probability[-1] * (dense[1] - dense[0])) + log_density.max()
    return amplitudes, float(np.exp(log_ratio[0] - total))


def bayes_factor(target: Target, index: int, draws: Float[np.ndarray, " draws"]) -> float:
    """Posterior over prior probability of an amplitude [SI] indistinguishable from zero; 0 if excluded."""
    threshold = target.values(np.array(_INDISTINGUISHABLE), index)
    # A prior without any mass there excludes zero whatever the data say.
    u = np.geomspace(1e-9, 1.0 - 1e-9, _DENSE)
    before = np.interp(threshold, target.priors[index].quantile(u), np.log(u), left=np.inf)
    return float(np.mean(draws < threshold) * np.exp(-before))


def _marginal(
    p: ModelParameter,
    axis: Axis,
    draws: Float[np.ndarray, " draws"],
    detected: bool,
    evidence: float | None = None,
    sampled: bool = True,
) -> Estimate:
    """Marginal of a parameter from its draws [SI]; without any it is not determined."""
    known, one_sided = len(draws) > 0, p.parameter.is_amplitude and not detected
    quantiles = np.quantile(draws, _QUANTILES).tolist() if known else [np.nan] * len(_QUANTILES)
    median, low_68, high_68, low_95, high_95, below_68, below_95 = quantiles
    interval, interval_68 = (low_95, high_95), (low_68, high_68)
    if one_sided:
        interval, interval_68 = (0.0, below_95), (0.0, below_68)
    elif not known:
        interval = interval_68 = (p.parameter.lower, p.parameter.upper)
    return Estimate(
        source="posterior",
        label=p.label,
        term=p.term_label,
        parameter=p.parameter,
        axis=axis,
        value=median,
        std=float(draws.std()) if known else np.nan,
        interval=interval,
        interval_68=interval_68,
        upper_limit=below_95 if p.parameter.is_amplitude else None,
        detected=detected,
        bayes_factor=evidence,
        sampled=sampled,
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
        shown = sys.stderr.isatty() if progress is None else progress
        results = []
        with Progress(console=Console(stderr=True), disable=not shown) as bar:
            for name in names:
                task = bar.add_task(name, total=None)

                def report(steps: int, expected: int, task: TaskID = task) -> None:
                    bar.update(task, completed=steps, total=expected)

                results.append(dataclasses.replace(self, fit=self.fit.as_for(name))._one_axis(name, report))
        return tuple(results)

    def _one_axis(self, name: str, report: Callable[[int, int], None]) -> AxisPosterior:
        """Posterior of an axis whose model is the fit's; `report` gets the steps done and expected."""
        likelihood = likelihood_of(self.fit, name)
        sampled = np.flatnonzero(likelihood.found | (not self.fit.chosen))
        if not sampled.size:
            raise FitError(f"{name}: no posterior: the fit detected no term and has no free parameter")
        target = Target(likelihood, self._all_priors(likelihood), sampled)
        # Each axis has random numbers of its own, so that its draws do not depend on the other axes.
        streams = np.random.SeedSequence([self.seed, self.fit.axes.index(name)]).generate_state(8)
        random = np.random.RandomState(streams)
        try:
            start = first_walkers(target, self._walkers(len(sampled)), random)
        except FitError as error:
            raise FitError(f"{name}: {error}") from None
        chains = run(target, start, random, self.convergence, report)
        if not chains.converged:
            labels = [likelihood.parameters[i].label for i in sampled]
            warnings.warn(self._complaint(name, labels, chains), PosteriorWarning, stacklevel=4)
        return self._result(name, target, chains, random)

    def _all_priors(self, likelihood: Likelihood) -> dict[str, Prior]:
        """Default priors, overridden by the priors that the user gave."""
        priors = likelihood.default_priors()
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

    def _complaint(self, name: str, labels: Sequence[str], chains: Chains) -> str:
        """Warning about chains that have not converged, with the worst parameter and the remedy."""
        wanted, left = self.convergence, len(chains.y)
        excess = (chains.r_hat - 1.0) / (wanted.max_r_hat - 1.0)
        lack = [wanted.min_length * chains.tau / left, excess, chains.change / wanted.max_change]
        worst = int(np.argmax(np.nan_to_num(np.max(lack, axis=0), nan=np.inf)))
        tau, length = chains.tau[worst], wanted.min_length * chains.tau[worst]
        return (
            f"{name}: the posterior has not converged in {chains.steps} steps; {labels[worst]} is worst, "
            f"with τ = {plain(tau, 3)} steps, {left} of {length:.0f} steps after the burn-in, a last change "
            f"of τ of {percent(chains.change[worst])} and R̂ = {chains.r_hat[worst]:.4f}; allow more steps, "
            f"e.g. max_steps={4 * wanted.max_steps}, or give narrower priors"
        )

    def _result(
        self, name: str, target: Target, chains: Chains, random: np.random.RandomState
    ) -> AxisPosterior:
        """Posterior of one axis from its chains, with the marginals of parameters that were not sampled."""
        sampled, fit, parameters = target.sampled, self.fit[name], target.likelihood.parameters
        full = target.embedded(chains.y)
        chain = target.values(full)[..., sampled]
        # The density per SI unit, instead of per unit of the coordinates.
        jacobian = target.log_jacobian(full)[..., sampled].sum(axis=-1)
        thin = max(1, int(np.nan_to_num(chains.tau).max() / 2.0))
        y = chains.y[::thin].reshape(-1, len(sampled))
        draws = chain[::thin].reshape(-1, len(sampled))
        marginals = self._marginals(target, fit.axis, draws, y, random)
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
            priors=dict(zip((p.label for p in parameters), target.priors, strict=True)),
            converged=chains.converged,
            tau=chains.tau,
            r_hat=chains.r_hat,
            acceptance=chains.acceptance,
            steps=chains.steps,
            rate=curve.rate,
            duration=curve.n / curve.rate,
            _template=self.fit.template,
        )

    def _marginals(
        self,
        target: Target,
        axis: Axis,
        draws: Float[np.ndarray, "draws sampled"],
        y: Float[np.ndarray, "draws sampled"],
        random: np.random.RandomState,
    ) -> dict[str, Estimate]:
        """Marginals of all parameters by label, from the draws of those sampled, in SI and in coordinates."""
        parameters = target.likelihood.parameters
        by_index = dict(zip(target.sampled.tolist(), draws.T, strict=True))
        evidence = {i: bayes_factor(target, i, x) for i, x in by_index.items() if target.amplitude[i]}
        detected = {parameters[i].term: factor < _DETECTED for i, factor in evidence.items()}
        few = y[np.linspace(0, len(y) - 1, self.absent_draws).round().astype(int)]
        found = {}
        for i, p in enumerate(parameters):
            x, factor, sampled = by_index.get(i, y[:0, 0]), evidence.get(i), i in by_index
            if target.amplitude[i] and not sampled:
                x, factor = absent_amplitude(target, i, few, random)
            is_detected = detected.get(p.term, sampled) if factor is None or sampled else factor < _DETECTED
            found[p.label] = _marginal(p, axis, x, is_detected, factor, sampled)
        return found
