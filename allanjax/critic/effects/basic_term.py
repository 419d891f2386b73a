"""A basic noise term that the given model lacks."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import ClassVar

import numpy as np
from scipy.stats import chi2

from allanjax.base.normal import ONE_SIDED_95
from allanjax.critic.bank import SLOW, Bank
from allanjax.critic.effect import TIMES, Effect
from allanjax.critic.model_evidence import SETS, odds
from allanjax.critic.noise import MARKOV, POWER_LAW, RAMP, Noise
from allanjax.critic.parameters import limited
from allanjax.critic.spectral import SHAPE, likely_shape, relative_errors
from allanjax.critic.view import Candidate, View
from allanjax.noise.estimate import Estimate
from allanjax.noise.terms import Markov, basic_terms
from allanjax.record.units import default_coefficient_unit, unit_scale


class BasicTerm(Effect):
    """A basic noise term that the given model lacks: quantization, random walks, instability, ramp, Markov.

    The evidence decides between subsets of basic terms. The p-value, by Wilks's theorem, ignores other
    subsets.
    """

    refit = "at once"
    sensible: ClassVar = {"correlation_time": TIMES}

    def __init__(self, term: str) -> None:
        self.name = term

    def detect(self, view: View) -> Candidate | None:
        term = self.name
        # A power law takes the place of the Markov process.
        if term in view.allowed or (term == MARKOV and POWER_LAW in view.allowed):
            return None
        return noise_with(view, term, [*view.allowed, term], view.log_evidence, self._parameters, _p_value)

    def _parameters(self, view: View, allowed: Sequence[str], noise: Noise) -> list[Estimate]:
        """Parameters of the best subset; deviations include the spread between plausible subsets."""
        term = self.name
        sets = view.model_evidence.likely(allowed, (term,), most=SETS)
        found = [_value(view, other, term) for other in sets]
        value = _value(view, noise, term)[0]
        values, stds = np.transpose(found)
        std = float(np.sqrt(odds(sets) @ (stds**2 + (values - value) ** 2)))
        declared = Markov() if term == MARKOV else basic_terms()[term]
        parameter = declared.amplitude_parameter()
        unit = default_coefficient_unit(view.axis.sensor, parameter.time_exponent)
        scale = unit_scale(unit, view.axis.sensor)
        amplitude = view.estimate(parameter.name, value / scale, std / scale, unit)
        if term != MARKOV:
            return [amplitude]
        time = _correlation_time(view, noise)
        if time.upper_limit is not None:
            # It is larger for a shorter one, which looks like white noise.
            least = max(value - ONE_SIDED_95 * std, 0.0) / scale
            amplitude = view.estimate(parameter.name, least, np.nan, unit, "above")
        return [amplitude, time]


def noise_with(
    view: View,
    term: str,
    allowed: Sequence[str],
    without: float,
    parameters: Callable[[View, Sequence[str], Noise], Sequence[Estimate]],
    p_value: Callable[[View, str], float] | None = None,
) -> Candidate | None:
    """Noise with a term, one of the `allowed` ones, against the log evidence `without` it."""
    noise = view.model_evidence.best(allowed, required=(term,))
    gain = view.model_evidence.total(allowed, required=(term,)) - without
    if gain <= 0.0 or (term != RAMP and term not in noise.power):
        return None
    after = view.allowing(allowed)

    def held_out() -> float:
        if term == RAMP:
            # Its shape is known and nearly all in one coefficient, so parts of the time are held out.
            shape = Bank(view.family.ramp[None, :SLOW])
            return shape.held_out(view, after, dataclasses.replace(noise, ramp=False))
        best = view.cross_validated(lambda fold: view.model_evidence_of(fold).best(allowed, required=(term,)))
        return best - view.cv_log_likelihood

    found = parameters(view, allowed, noise)
    return Candidate(term, found, gain, p_value and p_value(view, term), after, held_out)


def _value(view: View, noise: Noise, term: str) -> tuple[float, float]:
    """Coefficient of a term [SI] in a subset of terms, and its standard deviation."""
    if term == RAMP:
        value, std = view.family.slope(view.coefficients, view.variance(noise))
        return abs(value), std
    value = float(np.sqrt(noise.power[term])) if term in noise.power else 0.0
    return value, 0.5 * relative_errors(view, noise)[term] * value if value else 0.0


def _p_value(view: View, term: str) -> float:
    """p-value of the likelihood ratio of the noise with the term to the noise without, by Wilks's law.

    Without the term its amplitude is at the boundary of its range.
    """
    present = view.noise.terms
    noise = view.model_evidence.best([*present, term], required=[*present, term])
    ratio = 2.0 * max(view.log_likelihood(noise) - view.log_likelihood(view.noise), 0.0)
    if term == MARKOV:
        return float(chi2.sf(ratio, 2))
    return float(chi2.sf(ratio, 1)) * (1.0 if term == RAMP else 0.5)


def _correlation_time(view: View, noise: Noise) -> Estimate:
    """Correlation time by maximum likelihood, between the neighbouring values of the grid."""
    times = np.log(view.family.times)
    middle, step = np.log(noise.shape), times[1] - times[0]
    u, _ = likely_shape(view, MARKOV, (middle - step, middle + step))
    std = relative_errors(view, noise)[SHAPE]
    # Beyond the grid a Markov process is the same as another term: white noise, or a random walk.
    return view.log_estimate("correlation_time", *limited(u, std, (times[0], times[-1])), "s")
