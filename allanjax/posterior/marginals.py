"""Marginal posteriors of single parameters, other parameters integrated out, as estimates.

`value` is the median, `std` the standard deviation; the intervals hold 68 and 95 % of the posterior, as much
of the rest on either side; `upper_limit` is the 95 % quantile. An amplitude is `detected` if its Bayes
factor is below 1/20; otherwise its intervals begin at zero, and `interval` ends at `upper_limit`.

`bayes_factor`, of an amplitude, is the probability that the posterior gives to what cannot be told from zero
(a third of the prior's scale; for terms not sampled zero itself) over that of the prior: how the data change
the odds of the term's absence (Savage's density ratio; Dickey 1971, Ann. Math. Stat. 42:204). Under the
default prior 1/20 is what a square of the amplitude 3.5 to 3.8 standard deviations above zero yields. A
prior that excludes zero claims the term: 0. What has no draws (`sampled`) is the amplitude of a term that
the fit did not find.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from allanjax.noise.estimate import Estimate
from allanjax.noise.model import ModelParameter
from allanjax.record.recording import Axis

if TYPE_CHECKING:
    from allanjax.posterior.sampling import LogPosterior
    from allanjax.posterior.unsampled_limits import GridPosterior

# An amplitude is detected if the data make zero this much less credible than it was.
_DETECTED = 1.0 / 20.0
# Below this coordinate, a third of the prior's scale, an amplitude cannot be told from zero.
_INDISTINGUISHABLE = 0.3
# Of the median, the central 68 and 95 %, and the lowest 68 and 95 %.
_QUANTILES = (0.5, 0.16, 0.84, 0.025, 0.975, 0.68, 0.95)


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
    """Marginal of the shape of a term that was not sampled: of it these data say nothing."""
    nothing = (parameter.parameter.lower, parameter.parameter.upper)
    return Estimate(
        source="posterior",
        label=parameter.label,
        term=parameter.term_label,
        parameter=parameter.parameter,
        axis=axis,
        value=float("nan"),
        std=float("nan"),
        interval=nothing,
        interval_68=nothing,
        upper_limit=None,
        detected=False,
        sampled=False,
    )


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
    """Posterior over prior probability that this amplitude [SI] cannot be told from zero; 0 if a priori."""
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
