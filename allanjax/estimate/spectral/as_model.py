"""Structures of spectra as models for users, and the other way round."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from allanjax.estimate.spectral import components as kinds
from allanjax.estimate.spectral.model import (
    FIXED,
    FURTHER,
    OUTSIDE,
    Component,
    Structure,
    of_column,
    peak_of,
    resonance,
    response_of,
    wandering,
)
from allanjax.noise.model import Model
from allanjax.noise.terms import (
    AngleRandomWalk,
    Markov,
    NoiseTerm,
    PowerLaw,
    Resonance,
    WanderingResonance,
    basic_terms,
)


def model_of(structure: Structure, rate: float) -> Model:
    """Model with the values of a structure for samples at `rate` [Hz]."""
    terms = [(term_of(structure, k, rate), structure.components[k].inside) for k in structure.there]
    response = response_of(structure, rate)
    if response is None:
        return Model(tuple(term for term, _ in terms))
    inside, after = (Model(tuple(term for term, passes in terms if passes == side)) for side in (True, False))
    return (response * inside if len(inside) else inside) + after


def shape_of(model: Model, rate: float) -> Structure:
    """Response and resonances of a model for samples at `rate` [Hz], and what is after the response."""
    components, turn = list[Component](), 2.0 * math.pi / rate
    passes = model.inside or (False,) * len(model)
    for label, term, inside in zip(model.term_labels, model.terms, passes, strict=True):
        if isinstance(term, Resonance):
            peak = peak_of(term)
            place = peak.frequency * turn, 0.5 + math.exp(peak.shape[1])
            power = float(term.amplitude or 0.0) ** 2
            if isinstance(term, WanderingResonance):
                components.append(wandering(*place, peak.spread * turn, power, inside))
            else:
                components.append(resonance(*place, power, inside))
        elif label in FIXED:
            components.append(of_column(FIXED.index(label))._replace(inside=inside))
        elif isinstance(term, PowerLaw) and term.exponent == 0.0:
            components.append(of_column(OUTSIDE)._replace(power=float(term.amplitude or 0.0) ** 2))
    structure = Structure(tuple(components), kinds.kind_of(model.response))
    if model.response is None:
        return structure
    values: Any = model.response
    quality = float(getattr(values, "quality_factor", math.sqrt(0.5)))
    response = math.log(float(values.bandwidth) * turn), math.log(quality - 0.5)
    return dataclasses.replace(structure, response=response)


def term_of(structure: Structure, k: int, rate: float) -> NoiseTerm:
    """Term of component k; before the response if it passes through it."""
    component = structure.components[k]
    root = math.sqrt(component.power)
    if component.kind == kinds.MARKOV:
        time = component.time / rate
        return Markov(math.sqrt(2.0 / time) * root, time)
    if component.kind == kinds.OSCILLATOR:
        return Resonance(root, component.frequency * rate / (2.0 * np.pi), component.quality)
    if component.kind == kinds.WANDERING:
        w, excess, spread = np.exp(component.shape).tolist()
        hertz = rate / (2.0 * np.pi)
        return WanderingResonance(root, w * hertz, 0.5 + excess, spread * hertz)
    if component.which < OUTSIDE:
        return basic_terms()[FIXED[component.which]].replace(coefficient=root)
    if component.which == FURTHER and (further := structure.further) is not None:
        return further.replace(**{further.amplitude_parameter().name: root})
    return AngleRandomWalk(root)
