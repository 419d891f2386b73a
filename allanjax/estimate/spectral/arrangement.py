"""Which slot of the joint spectral model each term of a model has."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from allanjax.estimate.spectral.columns import columns_of
from allanjax.estimate.spectral.components import (
    BIQUAD,
    BUTTERWORTH_1,
    MOVING_AVERAGE,
    NONE,
    ONE_POLE,
    TWO_POLES,
)
from allanjax.estimate.spectral.levels import Levels, levels_of
from allanjax.estimate.spectral.model import FULL, PLAIN, Layout, Others, Slots
from allanjax.noise.model import Model, ModelParameter
from allanjax.noise.response import Biquad, Butterworth, LowPass1, LowPass2, MovingAverage
from allanjax.noise.terms import Markov, NoiseTerm, Resonance
from allanjax.spectrum.cosine import Bins

_COLUMN, _MARKOV, _OSCILLATOR, _OTHER = range(4)
# Numbers of levels of a tight arrangement are multiples of this.
_TIGHT = 64


class Arrangement(NamedTuple):
    """A model of random terms in the slots of the joint spectral model.

    Attributes:
        slots: the slots; no parameter is free yet.
        levels: the levels, without data yet.
        component: component of each term.
        time: parameter with the correlation time of each Markov process in a slot, −1 of other terms.
        parameter, offset: parameter of each free shape of the model, and what is added to ln(value − lower
            bound) for it.
        held: parameters with the shapes that have a value.
    """

    slots: Slots
    levels: Levels
    component: Int[np.ndarray, " terms"]
    time: Int[np.ndarray, " terms"]
    parameter: Int[np.ndarray, " shapes"]
    offset: Float[np.ndarray, " shapes"]
    held: Float[np.ndarray, " parameters"]

    @classmethod
    def of(cls, model: Model, bins: Bins, tight: bool = False) -> Arrangement:
        """Arrangement of a model for the levels of these bins, with no spare slots if it is to be tight.

        A tight one is evaluated faster, and is compiled for each structure of a model.
        """
        model = model.sampled(bins.rate)
        kind, layout = _kinds(model, tight)
        others = np.flatnonzero(kind == _OTHER)
        own = [p for p in model.parameters if p.free and p.term in others and not p.parameter.is_amplitude]
        layout = layout._replace(others=len(others), shapes=len(own))
        first = np.array([0, layout.first_markov, layout.first_oscillator, layout.first_other])
        before = np.array([np.sum(kind[:k] == kind[k]) for k in range(len(kind))], int)
        component = first[kind] + before
        columns = columns_of([model.terms[k] for k in np.flatnonzero(kind == _COLUMN)], bins)
        capacity = -(-len(bins.size) // _TIGHT) * _TIGHT if tight else None
        levels = levels_of(bins, columns, layout.columns, capacity)
        inside = np.zeros(layout.components, bool)
        inside[component] = model.inside or False
        further = None
        if own:
            shapes = tuple((int(before[p.term]), p.parameter.name, p.parameter.lower) for p in own)
            terms = tuple(model.terms[k] for k in others)
            further = Others.of(terms, shapes, bins, len(levels.shape))
        slots = Slots.of(layout, np.zeros(layout.parameters, bool), inside, _response(model), False, further)

        def place(p: ModelParameter) -> tuple[int, float]:
            """Parameter of a shape of the model, and its offset."""
            angle = math.log(2.0 * math.pi / bins.rate)
            frequency = p.parameter.name in ("frequency", "bandwidth")
            if p.term == len(model):
                return (layout.response, angle) if frequency else (layout.response + 1, 0.0)
            if kind[p.term] == _MARKOV:
                return layout.times + int(before[p.term]), math.log(bins.rate)
            if kind[p.term] == _OSCILLATOR:
                at = layout.frequencies if frequency else layout.qualities
                return at + int(before[p.term]), angle if frequency else 0.0
            return layout.other_shapes + own.index(p), 0.0

        held = slots.usual()
        free = []
        slotted = np.append((kind == _MARKOV) | (kind == _OSCILLATOR), True)
        for p in model.parameters:
            if p.parameter.is_amplitude or not (p.free or slotted[p.term]):
                continue
            index, offset = place(p)
            if p.free:
                free.append((index, offset))
            if p.start is not None:
                held[index] = math.log(p.start - p.parameter.lower) + offset
        time = np.where(kind == _MARKOV, layout.times + before, -1)
        parameter, shift = np.array(free).reshape(-1, 2).T
        return cls(slots, levels, component, time, parameter.astype(int), shift, held)


def _kinds(model: Model, tight: bool) -> tuple[Int[np.ndarray, " terms"], Layout]:
    """Kind of each term, and a layout that has room for all; what has no room is one of the others."""
    kind = np.array([_kind(term) for term in model.terms], int)
    counts = [np.sum(kind == k) for k in range(_OTHER)]
    usual = model.response is None and all(c <= room for c, room in zip(counts, PLAIN[:_OTHER], strict=True))
    layout = PLAIN if usual else FULL
    for k in (_MARKOV, _OSCILLATOR):
        kind[np.flatnonzero(kind == k)[layout[k] :]] = _OTHER
    if tight:
        kept = [int(np.sum(kind == k)) for k in range(_OTHER)]
        return kind, Layout(max(kept[_COLUMN], 1), kept[_MARKOV], kept[_OSCILLATOR])
    columns = -(-counts[_COLUMN] // layout.columns) * layout.columns
    return kind, layout._replace(columns=max(int(columns), layout.columns))


def _kind(term: NoiseTerm) -> int:
    """Kind of slot for a term."""
    free = [p for p in term.parameters()[1:] if term.is_free(p)]
    if not free:
        return _COLUMN
    if isinstance(term, Markov) and term.has_free_amplitude:
        return _MARKOV
    return _OSCILLATOR if isinstance(term, Resonance) else _OTHER


def _response(model: Model) -> int:
    """Kind of response of a model."""
    if model.response is None:
        return NONE
    if isinstance(model.response, Butterworth):
        return BUTTERWORTH_1 + model.response.order - 1
    kinds = {LowPass1: ONE_POLE, LowPass2: TWO_POLES, MovingAverage: MOVING_AVERAGE, Biquad: BIQUAD}
    return kinds[type(model.response)]
