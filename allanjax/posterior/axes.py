"""Posterior of one axis: its chains, and marginals of all parameters from the draws.

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
import warnings
from collections.abc import Callable, Mapping
from typing import TypeAlias

import numpy as np
from jaxtyping import Float
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import CubicSpline
from scipy.special import logsumexp

from allanjax.base.wording import plain
from allanjax.estimate.result import AxisFit, Fit
from allanjax.noise.estimate import Estimate
from allanjax.posterior.priors import Prior
from allanjax.posterior.result import AxisPosterior, PosteriorWarning, summary
from allanjax.posterior.sampling import Options, run
from allanjax.posterior.target import Target

# An amplitude is detected if the data make zero less credible by this factor.
_DETECTED = 1.0 / 20.0
# Below this coordinate, a third of the prior's scale, an amplitude cannot be distinguished from zero.
_INDISTINGUISHABLE = 0.3
# Step of an amplitude's coordinate, least number of steps, and number of points between which the density is
# integrated. The range ends where the density is e^-12 of its maximum.
_STEP, _STEPS, _DENSE = 0.1, 16, 4001
_NEGLIGIBLE = 12.0
# Attempts to translate the draws at one point, until effective draws over draws reach this ratio.
_CORRECTIONS, _EVEN = 6, 0.5

_Draws: TypeAlias = Float[np.ndarray, "draws sampled"]


def posterior_of(
    fit: Fit, name: str, priors: Mapping[str, Prior], options: Options, report: Callable[[int, int], None]
) -> AxisPosterior:
    """Posterior of an axis whose model is the fit's; `report` gets the steps done and expected."""
    target, result = Target(fit, name, priors), fit[name]
    labels = tuple(target.parameters[i].label for i in target.sampled)
    # Each axis has random numbers of its own, so that its draws do not depend on the other axes.
    streams = np.random.SeedSequence([options.seed, fit.axes.index(name)]).generate_state(8)
    random = np.random.RandomState(streams)
    chain, found = run(target, random, options, report)
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
    few = y[np.linspace(0, len(y) - 1, options.absent_draws).round().astype(int)]
    # The density per SI unit, instead of per unit of the coordinates.
    found["log_probability"] = found["log_probability"] - chain.sum(axis=-1)
    return AxisPosterior(
        axis=result.axis,
        labels=labels,
        draws=target.values(y)[:, target.sampled],
        chain=target.values(chain)[..., target.sampled],
        coefficients=_marginals(target, result, y, few, random),
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
    columns = dict(zip(target.sampled.tolist(), target.values(y)[:, target.sampled].T, strict=True))
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
            there[p.term], limit = factor < _DETECTED, float(np.quantile(draws, 0.95))
        if draws is None:
            # Held, or a shape of an absent term.
            found[p.label] = dataclasses.replace(c, source="posterior", sampled=False)
            continue
        here = there.get(p.term, True)
        found[p.label] = dataclasses.replace(
            c,
            **summary(draws, from_zero=p.parameter.is_amplitude and not here),
            upper_limit=limit,
            lower_limit=None,
            # Draws are of the chosen terms only.
            detected=here and not c.rivals,
            bayes_factor=factor,
            sampled=i in columns,
        )
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
            values[:, target.sampled] = target.values(y + shift)[:, target.sampled]
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
