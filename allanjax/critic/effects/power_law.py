"""Noise with a power-law spectrum whose exponent no basic term has."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from allanjax.critic.effect import Effect, Range
from allanjax.critic.effects.basic_term import noise_with
from allanjax.critic.noise import MARKOV, POWER_LAW, Noise
from allanjax.critic.parameters import limited
from allanjax.critic.policy import judged
from allanjax.critic.spectral import FineLevels, relative_errors
from allanjax.critic.view import Candidate, View
from allanjax.noise.estimate import Estimate
from allanjax.noise.terms import PowerLaw as PowerLawTerm

# Distance from the best exponent of the grid within which the maximum is sought.
_REACH = 0.6
# Exponents of basic terms.
_BASIC = {"quantization noise": -2.0, "white noise": 0.0, "bias instability": 1.0, "a random walk": 2.0}
# Range of the exponent, slightly less than that of the term; most rounds of the search for the maximum.
_EXPONENTS, _ROUNDS = (-0.95, 2.95), 4


class PowerLaw(Effect):
    """Noise with a power law of any exponent; it replaces the Markov process."""

    name = "power_law"
    refit = "at once"
    sensible: ClassVar = {"exponent": Range(*_EXPONENTS)}

    def detect(self, view: View) -> Candidate | None:
        if POWER_LAW in view.allowed:
            return None
        allowed = [t for t in view.allowed if t != MARKOV] + [POWER_LAW]
        # A basic term is preferred if it explains as much.
        found = noise_with(view, POWER_LAW, allowed, view.log_evidence_all_terms, _parameters)
        return found and dataclasses.replace(
            found,
            support=(view.rate / (2.0 * view.n), view.rate / 2.0),
            domain="frequency",
            bound=float(np.exp(-found.gain)),
            doubt=_doubt(found.parameters["exponent"].value),
        )


def _parameters(view: View, allowed: Sequence[str], noise: Noise) -> list[Estimate]:
    """Exponent and amplitude."""
    exponent, std, limit = limited(*_exponent(view, noise), _EXPONENTS)
    amplitude = float(np.sqrt(noise.power[POWER_LAW]))
    relative = relative_errors(view, noise)[POWER_LAW]
    return [
        view.estimate("exponent", exponent, std, "1", limit),
        view.amplitude_estimate("amplitude", amplitude, 0.5 * relative * amplitude, "/√Hz"),
    ]


def _doubt(exponent: float) -> str:
    """Why a power law of this exponent is hardly one of its own."""
    near = [name for name, own in _BASIC.items() if abs(exponent - own) < judged("power_law", "distinct")]
    return f"its exponent is nearly that of {near[0]}" if near else ""


def _exponent(view: View, noise: Noise) -> tuple[float, float]:
    """Exponent by maximum likelihood, with all powers fitted for each value, and its standard deviation."""
    levels = FineLevels(view)
    low, high = _EXPONENTS
    middle = noise.shape
    # If the maximum is at the end of the range, the search goes farther.
    for _ in range(_ROUNDS):
        bounds = (max(middle - _REACH, low), min(middle + _REACH, high))
        exponent, std = levels.shape_of(lambda u: PowerLawTerm(1.0, u), bounds)
        if abs(exponent - middle) < 0.95 * _REACH or exponent in (low, high):
            break
        middle = exponent
    return exponent, std
