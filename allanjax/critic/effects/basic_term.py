"""A basic noise term that the given model lacks."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import ClassVar

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize_scalar
from scipy.stats import chi2

from allanjax.base.normal import ONE_SIDED_95
from allanjax.critic.bank import SLOW, Bank
from allanjax.critic.effect import TIMES, Candidate, Effect, View
from allanjax.critic.finding import limited
from allanjax.critic.noise import FIXED, MARKOV, POWER_LAW, RAMP, SETS, Noise, NoiseFamily, odds, term_of
from allanjax.estimate.evidence import information, power_fits
from allanjax.estimate.spectral.components import columns_of
from allanjax.noise.estimate import Estimate
from allanjax.noise.terms import Markov, basic_terms
from allanjax.record.units import default_coefficient_unit, unit_scale
from allanjax.spectrum.cosine import Bins, smoothed

#: Name of the free shape in the result of `relative_errors`.
SHAPE = "shape"

# Bins in an octave, and the step of numerical derivatives.
_PER_OCTAVE, _STEP = 64, 0.02


@functools.lru_cache(maxsize=2)
def _bins(family: NoiseFamily) -> Bins:
    return Bins.of(family.n, family.rate, (), _PER_OCTAVE)


@functools.lru_cache(maxsize=32)
def _unit(family: NoiseFamily, name: str, shape: float = 0.0) -> Float[np.ndarray, " bins"]:
    """Levels of a term of unit amplitude and this shape."""
    term = term_of(name, 1.0, np.exp(shape) if name == MARKOV else shape)
    return columns_of([term], _bins(family))[0].mean(axis=0)


def likely_shape(view: View, name: str, bounds: tuple[float, float]) -> tuple[float, float]:
    """Most likely shape of a term beside all allowed terms of any power, and its std from the curvature."""
    bins, squares = _bins(view.family), view.coefficients**2
    size, total = bins.size, bins.sums(squares if view.factor is None else squares / view.factor)
    level, rough = total / size, smoothed(total, size)
    columns = [_unit(view.family, term) for term in FIXED if term in view.allowed]

    def loss(u: float) -> float:
        unit = np.stack([*columns, _unit(view.family, name, float(u))])
        return float(power_fits(level, 0.5 * size, rough, unit[None])[1][0])

    found = minimize_scalar(loss, bounds=bounds, method="bounded", options={"xatol": 1e-3})
    u = float(found.x)
    curvature = (loss(u + _STEP) + loss(u - _STEP) - 2.0 * found.fun) / _STEP**2
    return u, float(1.0 / np.sqrt(max(curvature, 1e-2)))


def relative_errors(view: View, noise: Noise) -> dict[str, float]:
    """Relative errors of all powers from their Fisher information, and the error of the `SHAPE`."""
    rows, family = {}, view.family
    for name, power in noise.power.items():
        shape = np.log(noise.shape) if name == MARKOV else noise.shape
        if name in FIXED:
            rows[name] = power * _unit(family, name)
            continue
        below, rows[name], above = (
            power * _unit(family, name, float(shape + step)) for step in (-_STEP, 0.0, _STEP)
        )
        rows[SHAPE] = (above - below) / (2.0 * _STEP)
    level = np.sum([row for name, row in rows.items() if name != SHAPE], axis=0)
    covariance = np.linalg.pinv(information(np.stack([*rows.values()]), level, 0.5 * _bins(family).size))
    return dict(zip(rows, np.sqrt(np.diag(covariance)).tolist(), strict=True))


class BasicTerm(Effect):
    """A basic noise term that the given model lacks: quantization, random walks, instability, ramp, Markov.

    The evidence decides between subsets of basic terms, which the p-value, by Wilks's theorem, ignores.
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
        found = [_coefficient(view, other, term) for other in sets]
        value = _coefficient(view, noise, term)[0]
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


def _coefficient(view: View, noise: Noise, term: str) -> tuple[float, float]:
    """Coefficient of a term [SI] in a subset of terms, and its standard deviation."""
    if term == RAMP:
        value, std = view.family.slope(view.coefficients, view.variance(noise))
        return abs(value), std
    value = float(np.sqrt(noise.power[term])) if term in noise.power else 0.0
    return value, 0.5 * relative_errors(view, noise)[term] * value if value else 0.0


def _p_value(view: View, term: str) -> float:
    """p-value of a term's likelihood ratio, by Wilks's law; without it its amplitude is at the boundary."""
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
