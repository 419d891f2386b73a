"""A basic noise term that the given model lacks."""

from __future__ import annotations

import numpy as np

from allanjax.critique.causes.spectral import (
    FineLevels,
    baseline_predictive,
    coefficient_folds,
    predictive,
)
from allanjax.critique.noise import MARKOV, POWER_LAW, RAMP, Noise, density
from allanjax.critique.view import EVERYTHING, Candidate, Cause, Quantity, View
from allanjax.selection import basic_terms
from allanjax.terms import Markov, NoiseTerm
from allanjax.units import default_coefficient_unit, unit_scale

# Of ln(correlation time), for a derivative.
_STEP = 0.02


class BasicTerm(Cause):
    """One of quantization, angle random walk, bias instability, rate random walk, drift ramp, Markov."""

    name = "basic_term"

    def detect(self, view: View) -> Candidate | None:
        known = set(view.allowed) | ({MARKOV} if POWER_LAW in view.allowed else set())
        found = [self._with(view, term) for term in EVERYTHING if term not in known]
        return max((c for c in found if c is not None), key=lambda c: c.gain, default=None)

    def _with(self, view: View, term: str) -> Candidate | None:
        allowed = [*view.allowed, term]
        noise = view.weighing.best(allowed, required=(term,))
        gain = noise.log_evidence - view.noise.log_evidence
        if gain <= 0.0 or (term != RAMP and term not in noise.power):
            return None

        def held_out() -> float:
            total = 0.0
            for fold in coefficient_folds(view.n):
                other = view.family.of(view.c, view.factor, fold).best(allowed, required=(term,))
                c = view.c
                if other.ramp:
                    c = c - view.family.slope(c, other.variance, fold)[0] * view.family.ramp
                total += predictive(c, view.variance(other), ~fold) - baseline_predictive(view, fold)
            return total

        return Candidate(
            term,
            self._parameters(view, noise, term),
            gain,
            float(np.exp(-gain)),
            view.allowing(allowed),
            held_out,
            (0.0, view.duration),
            "time",
        )

    def _parameters(self, view: View, noise: Noise, term: str) -> dict[str, Quantity]:
        if term == RAMP:
            value, std = view.family.slope(view.c, view.variance(noise))
            unit = _unit(view, basic_terms()[RAMP])
            scale = unit_scale(unit, view.axis.sensor)
            return {"coefficient": Quantity(abs(value) / scale, std / scale, unit)}
        declared = Markov() if term == MARKOV else basic_terms()[term]
        unit = _unit(view, declared)
        value = float(np.sqrt(noise.power[term]))
        relative = _relative_errors(view, noise)
        name = declared.parameters()[0].name
        scale = unit_scale(unit, view.axis.sensor)
        found = {name: Quantity(value / scale, 0.5 * relative[term] * value / scale, unit)}
        if term == MARKOV:
            time = _correlation_time(view, noise)
            found["correlation_time"] = Quantity(time, relative["correlation_time"] * time, "s")
        return found


def _relative_errors(view: View, noise: Noise) -> dict[str, float]:
    """Relative errors of all powers, and of the correlation time, by their Fisher information."""
    rows = {}
    for name, power in noise.power.items():
        spectra = [
            view.family.spectrum(term)
            for term in (
                [Markov(1.0, noise.shape * np.exp(s)) for s in (0.0, _STEP, -_STEP)]
                if name == MARKOV
                else [basic_terms()[name].replace(coefficient=1.0)]
            )
        ]
        rows[name] = power * spectra[0]
        if name == MARKOV:
            rows["correlation_time"] = power * (spectra[1] - spectra[2]) / (2.0 * _STEP)
    relative = np.stack(list(rows.values())) / noise.variance
    covariance = np.linalg.pinv(0.5 * relative @ relative.T)
    return dict(zip(rows, np.sqrt(np.diag(covariance)).tolist(), strict=True))


def _correlation_time(view: View, noise: Noise) -> float:
    """By maximum likelihood, between its neighbours in the grid."""
    levels = FineLevels(view)

    def likelihood(u: float) -> float:
        own = density(Markov(1.0, float(np.exp(u))), levels.frequency, view.rate)
        return levels.log_likelihood(extra=view.rate * own)

    middle, step = np.log(noise.shape), np.log(view.family.times[1] / view.family.times[0])
    return float(np.exp(levels.shape_of(likelihood, (middle - step, middle + step))[0]))


def _unit(view: View, term: NoiseTerm) -> str:
    return default_coefficient_unit(view.axis.sensor, term.parameters()[0].time_exponent)
