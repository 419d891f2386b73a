"""Noise with a power-law spectrum whose exponent no basic term has."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from allanjax.critic.effect import Candidate, Effect, Range, View
from allanjax.critic.effects.basic_term import likely_shape, noise_with, relative_errors
from allanjax.critic.finding import limited
from allanjax.critic.noise import MARKOV, POWER_LAW, Noise
from allanjax.critic.policy import judged
from allanjax.noise.estimate import Estimate

# Distance from the best exponent of the grid within which the maximum is sought.
_REACH = 0.6
# Exponents of basic terms.
_BASIC = {"quantization noise": -2.0, "white noise": 0.0, "bias instability": 1.0, "a random walk": 2.0}
# Range of the exponent, slightly less than that of the term.
_EXPONENTS = (-0.95, 2.95)


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
        if found is None:
            return None
        exponent, distinct = found.parameters["exponent"].value, judged("power_law", "distinct")
        near = [name for name, own in _BASIC.items() if abs(exponent - own) < distinct]
        if "white noise" in near:
            # White noise is in the model: what differs from it is the shape of another effect.
            return None
        return dataclasses.replace(
            found,
            support=(view.rate / (2.0 * view.n), view.rate / 2.0),
            domain="frequency",
            bound=float(np.exp(-found.gain)),
            doubt=f"its exponent is nearly that of {near[0]}" if near else "",
        )


def _parameters(view: View, allowed: Sequence[str], noise: Noise) -> list[Estimate]:
    """Exponent by maximum likelihood, and amplitude."""
    low, high = np.clip([noise.shape - _REACH, noise.shape + _REACH], *_EXPONENTS).tolist()
    exponent, std, limit = limited(*likely_shape(view, POWER_LAW, (low, high)), _EXPONENTS)
    amplitude = float(np.sqrt(noise.power[POWER_LAW]))
    relative = relative_errors(view, noise)[POWER_LAW]
    return [
        view.estimate("exponent", exponent, std, "1", limit),
        view.amplitude_estimate("amplitude", amplitude, 0.5 * relative * amplitude, "/√Hz"),
    ]
