"""A structure as a model of noise terms with their values."""

from __future__ import annotations

import numpy as np

from allanjax.estimate.spectral.components import BIQUAD, BUTTERWORTH_1, MOVING_AVERAGE, NONE, ONE_POLE
from allanjax.estimate.spectral.model import FULL
from allanjax.estimate.structure.structure import FIXED, FURTHER, OUTSIDE, Structure
from allanjax.noise.model import Model, NoiseTerm
from allanjax.noise.response import Biquad, Butterworth, LowPass1, LowPass2, MovingAverage, Response
from allanjax.noise.terms import AngleRandomWalk, Markov, Resonance, basic_terms


def model_of(structure: Structure, rate: float, further: NoiseTerm | None = None) -> Model:
    """Model with the values of a structure for samples at `rate` [Hz].

    Args:
        structure: the structure.
        rate: sample rate [Hz].
        further: the term whose column it has besides the basic ones, with unit amplitude.
    """
    terms: list[tuple[NoiseTerm, bool]] = []
    for k in structure.there:
        terms.append((term_of(structure, k, rate, further), bool(structure.inside[k])))
    response = response_of(structure, rate)
    if response is None:
        return Model(tuple(term for term, _ in terms))
    inside = Model(tuple(term for term, passes in terms if passes))
    after = Model(tuple(term for term, passes in terms if not passes))
    return (response * inside if len(inside) else inside) + after


def response_of(structure: Structure, rate: float) -> Response | None:
    """Response of a structure, if it has one."""
    if structure.kind == NONE:
        return None
    w, quality = structure.bandwidth
    bandwidth = w * rate / (2.0 * np.pi)
    if structure.kind >= BUTTERWORTH_1:
        return Butterworth(bandwidth, order_of(structure))
    if structure.kind == MOVING_AVERAGE:
        return MovingAverage(bandwidth)
    if structure.kind == ONE_POLE:
        return LowPass1(bandwidth)
    return (Biquad if structure.kind == BIQUAD else LowPass2)(bandwidth, quality)


def order_of(structure: Structure) -> int:
    """Order of the response: its number of poles, 1 of a moving average."""
    if structure.kind >= BUTTERWORTH_1:
        return structure.kind - BUTTERWORTH_1 + 1
    return 1 if structure.kind in (ONE_POLE, MOVING_AVERAGE) else 2


def resonance_of(structure: Structure, k: int, rate: float) -> Resonance:
    """One of the oscillators as a term, before the response if it passes that."""
    power = float(structure.power[FULL.first_oscillator + k])
    return Resonance(np.sqrt(power), structure.frequency(k) * rate / (2.0 * np.pi), structure.quality(k))


def markov_of(structure: Structure, k: int, rate: float) -> Markov:
    """One of the Markov processes as a term."""
    power, time = float(structure.power[FULL.first_markov + k]), structure.time(k) / rate
    return Markov(np.sqrt(2.0 * power / time), time)


def term_of(structure: Structure, k: int, rate: float, further: NoiseTerm | None = None) -> NoiseTerm:
    """Term of component k, before the response if it passes that."""
    amplitude = float(np.sqrt(structure.power[k]))
    if k < OUTSIDE:
        return basic_terms()[FIXED[k]].replace(coefficient=amplitude)
    if k == OUTSIDE:
        return AngleRandomWalk(amplitude)
    if k == FURTHER and further is not None:
        return further.replace(**{further.amplitude_parameter().name: amplitude})
    if k < FULL.first_oscillator:
        return markov_of(structure, k - FULL.first_markov, rate)
    return resonance_of(structure, k - FULL.first_oscillator, rate)
