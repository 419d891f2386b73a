"""Changes of the basic coefficients by a finding."""

from __future__ import annotations

import numpy as np

from allanjax.critic.finding import CoefficientChange
from allanjax.critic.noise import FIXED, MARKOV, WHITE
from allanjax.critic.step import Step
from allanjax.estimate.spectral import components as kinds
from allanjax.estimate.spectral.model import Structure
from allanjax.noise.terms import Markov, basic_terms
from allanjax.record.units import default_coefficient_unit, unit_scale


def coefficient_changes(step: Step) -> tuple[CoefficientChange, ...]:
    """Changes of every basic coefficient that is in the noise before or after a finding."""
    views = step.before, step.candidate.after
    # Spectral structure is fitted jointly with the terms, waveforms in time are not.
    jointly = views[0].structure is not views[1].structure
    before, after = (
        v.noise.power if v.structure is None or not jointly else _of_structure(v.structure, v.rate)
        for v in views
    )
    sensor = step.before.axis.sensor
    changes = []
    for name in (*FIXED, MARKOV):
        if name not in before and name not in after:
            continue
        term = Markov() if name == MARKOV else basic_terms()[name]
        unit = default_coefficient_unit(sensor, term.amplitude_parameter().time_exponent)
        scale = unit_scale(unit, sensor)
        old, new = (float(np.sqrt(p[name])) / scale if name in p else float("nan") for p in (before, after))
        changes.append(CoefficientChange(name, old, new, unit))
    return tuple(changes)


def _of_structure(structure: Structure, rate: float) -> dict[str, float]:
    """Squared coefficients of the basic terms that were fitted jointly with filter and resonances.

    A wide resonance is white noise at low frequencies, of N² = σ²/(π·f0·Q): an angle grows by both.
    """
    power: dict[str, float] = {}
    for own in map(structure.components.__getitem__, structure.there):
        if own.kind == kinds.COLUMN and own.which < len(FIXED):
            name, square = FIXED[own.which], own.power
        elif own.kind == kinds.MARKOV:
            name, square = MARKOV, 2.0 * own.power * rate / own.time
        elif own.kind == kinds.OSCILLATOR and own.quality < kinds.WIDE:
            name, square = WHITE, 2.0 * own.power / (own.frequency * rate * own.quality)
        else:
            continue
        power[name] = power.get(name, 0.0) + square
    return power
