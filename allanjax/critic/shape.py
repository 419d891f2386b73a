"""The structure of a view's spectrum: how it is searched, and what is told of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from allanjax.critic.noise import MARKOV, POWER_LAW
from allanjax.critic.view import View
from allanjax.critic.windows import conspicuous
from allanjax.estimate.spectral.components import NONE, ONE_POLE
from allanjax.estimate.spectral.model import FULL
from allanjax.estimate.structure.as_model import model_of, response_of
from allanjax.estimate.structure.search import Record, completed, searched
from allanjax.estimate.structure.structure import FIXED, FURTHER, OUTSIDE, Fitted, Spectrum, Structure
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model
from allanjax.noise.terms import PowerLaw


#: Names of the findings.
LOW_PASS, RESONANCE = "low_pass", "resonance"
# Resonances closer than the mean of their widths times this are one that moves: a judgement.
_CLOSE = 1.5
# Points at which the response is looked at for its half-power frequency, and the step of derivatives.
_POINTS, _STEP = 4096, 1e-3


def _record(view: View, further: PowerLaw | None) -> Record:
    """Spectrum of a view, without what its baseline has besides the basic terms."""
    squares = view.residual**2
    return Record(squares if view.base is None else squares / view.base, view.rate, further)


def _further(view: View) -> PowerLaw | None:
    """Power law of a view's noise, if it has one."""
    power_law = POWER_LAW in view.noise.power
    return PowerLaw(1.0, float(view.noise.shape)) if power_law else None


def _start(view: View, further: PowerLaw | None) -> Structure:
    """Structure of a view with all terms that it may have."""
    columns = [FIXED.index(name) for name in FIXED if name in view.allowed]
    columns += [] if further is None else [FURTHER]
    start = Structure.plain(columns)
    noise = view.noise
    for name, power in noise.power.items():
        if name in FIXED:
            start = start.using(FIXED.index(name), power)
        elif name == POWER_LAW:
            start = start.using(FURTHER, power)
        elif (slow := start.with_markov(noise.shape * view.rate, 0.5 * power * noise.shape)) is not None:
            start = slow
    if view.structure is not None:
        start = start.with_shape_of(view.structure)
    return start


def candidate_structure(view: View) -> tuple[Structure, float] | None:
    """Structure of a view's spectrum if it has more than was found, and the log odds that it gains [nats]."""
    further = _further(view)
    start = _start(view, further)
    spectrum, found = searched(_record(view, further), start)
    if found.structure.has_shape_of(start):
        return None
    gain = found.evidence - spectrum.fit(start).evidence
    return (found.structure, gain) if gain > 0.0 else None


class Part(NamedTuple):
    """A filter, or one or more resonances at about one frequency, as it is told.

    Attributes:
        cause: name of the cause.
        estimates: parameters in the recording's units.
        gain: log odds for it, all else being fitted anew [nats].
        held_out: gain in log-likelihood on every other half of the coefficients [nats].
        p_value: p-value of its statistic.
        support: lowest and highest frequency [Hz].
        structure: structure with this part and all that gain more.
    """

    cause: str
    estimates: Sequence[Estimate]
    gain: float
    held_out: float
    p_value: float
    support: tuple[float, float]
    structure: Structure


class Shape(NamedTuple):
    """Structure of a view's spectrum, finished: its parts by their gain, and the model of all of it."""

    parts: tuple[Part, ...]
    structure: Structure
    model: Model


def finished(view: View, folds: Sequence[Bool[np.ndarray, " n-1"]]) -> Shape | None:
    """Final fit of a view's structure and what is told of it; None if there is nothing besides the basic terms."""
    if view.structure is None:
        return None
    further = _further(view)
    record = _record(view, further)
    spectrum, found = searched(record, _start(view, further))
    found = completed(spectrum, found, MARKOV in view.allowed and further is None)
    structure = found.structure
    groups = _groups(structure)
    if not groups:
        return None
    without = [spectrum.fit(_without(structure, group)) for group in groups]
    gains = [found.evidence - less.evidence for less in without]
    held_out = _held_out(record, spectrum, structure, groups, folds)
    order = sorted(range(len(groups)), key=lambda k: -gains[k])
    parts = []
    for place, k in enumerate(order):
        left = [component for j in order[place + 1 :] for component in groups[j]]
        partial = spectrum.fit(_without(structure, left)).structure if left else structure
        parts.append(_part(view, found, groups[k], gains[k], held_out[k], partial))
    return Shape(tuple(parts), structure, model_of(structure, view.rate, further))


#: Stands for the response among the components of a group.
_RESPONSE = -1


def _groups(structure: Structure) -> list[list[int]]:
    """The response, and resonances that are near each other, as lists of components."""
    groups = [[_RESPONSE]] if structure.kind != NONE else []
    members: list[int] = []
    for k in sorted(structure.oscillators, key=structure.frequency):
        if members and _near(structure, members, int(k)):
            groups[-1].append(FULL.first_oscillator + int(k))
        else:
            groups.append([FULL.first_oscillator + int(k)])
            members = []
        members.append(int(k))
    return groups


def _near(structure: Structure, members: Sequence[int], k: int) -> bool:
    """Whether a resonance is about as near to one of others as they are wide."""

    def width(i: int) -> float:
        return structure.frequency(i) / structure.quality(i)

    return any(
        structure.frequency(k) - structure.frequency(i) < _CLOSE * 0.5 * (width(i) + width(k)) for i in members
    )


def _without(structure: Structure, group: Sequence[int]) -> Structure:
    """Structure without a group of components."""
    for k in group:
        structure = dataclasses.replace(structure, kind=NONE) if k == _RESPONSE else structure.without(k)
    return structure


def _held_out(
    record: Record,
    spectrum: Spectrum,
    structure: Structure,
    groups: Sequence[Sequence[int]],
    folds: Sequence[Bool[np.ndarray, " n-1"]],
) -> list[float]:
    """Gain by each group in the likelihood of half of the coefficients, all being fitted to the other half."""
    gains = np.zeros(len(groups))
    for fold in folds:
        mine, other = (
            Spectrum.of(record.squares, spectrum.bins, record.further, half.astype(float)).weighed_like(spectrum)
            for half in (fold, ~fold)
        )
        best = other.loss_of(mine.fit(structure))
        for k, group in enumerate(groups):
            gains[k] += other.loss_of(mine.fit(_without(structure, group))) - best
    return gains.tolist()


def _part(
    view: View, found: Fitted, group: Sequence[int], gain: float, held_out: float, partial: Structure
) -> Part:
    structure = found.structure
    if group == [_RESPONSE]:
        estimates, low = _of_response(view, found)
        return Part(
            LOW_PASS, estimates, gain, held_out, float(np.exp(-max(gain, 0.0))), (low, view.rate / 2.0), partial
        )
    estimates, support = _of_resonances(view, found, [k - FULL.first_oscillator for k in group])
    hidden = view.with_structure(_without(structure, group))
    p_value = conspicuous(hidden.squared_whitened).p_value
    return Part(RESONANCE, estimates, gain, held_out, p_value, support, partial)


def _of_response(view: View, found: Fitted) -> tuple[list[Estimate], float]:
    """Half-power frequency of the response and its order, and where it begins to matter [Hz]."""
    structure, at = found.structure, FULL
    place = slice(at.response, at.other_shapes)
    covariance = found.covariance[place, place]
    value = _half_power(structure, view.rate)
    slope = np.zeros(2)
    for i in range(2):
        moved = structure.shape.copy()
        moved[at.response - at.components + i] += _STEP
        there = _half_power(dataclasses.replace(structure, shape=moved), view.rate)
        slope[i] = np.log(there / value) / _STEP
    std = float(np.sqrt(slope @ covariance @ slope))
    estimates = [
        view.log_estimate("bandwidth", float(np.log(value)), std, "", "Hz"),
        view.estimate("order", 1 if structure.kind == ONE_POLE else 2, 0.0, "1"),
    ]
    return estimates, value


def _half_power(structure: Structure, rate: float) -> float:
    """Frequency at which the response has fallen by half [Hz]; the poles' own where it does not fall so far."""
    response = response_of(structure, rate)
    assert response is not None
    f = np.linspace(0.0, rate / 2.0, _POINTS)[1:]
    log = np.log(np.asarray(response.power(f, rate)))
    below = np.flatnonzero(log < np.log(0.5))
    if len(below) == 0 or below[0] == 0:
        return structure.bandwidth[0] * rate / (2.0 * np.pi)
    k = int(below[0])
    share = (log[k - 1] - np.log(0.5)) / (log[k - 1] - log[k])
    return float(f[k - 1] + share * (f[k] - f[k - 1]))


def _of_resonances(
    view: View, found: Fitted, group: Sequence[int]
) -> tuple[list[Estimate], tuple[float, float]]:
    """Frequency, quality factor and amplitude of one resonance, or of several that are one that moves."""
    structure, at, hertz = found.structure, FULL, view.rate / (2.0 * np.pi)
    frequency = np.array([structure.frequency(k) for k in group]) * hertz
    quality = np.array([structure.quality(k) for k in group])
    places = [at.first_oscillator + k for k in group]
    power = np.array([structure.power[k] for k in places])
    response = response_of(structure, view.rate)
    if response is not None:
        # As they are recorded, after the response.
        passed = np.asarray(response.power(frequency, view.rate))
        power = np.where(structure.inside[places], power * passed, power)
    share = power / power.sum()
    f0 = float(share @ frequency)
    moved = float(np.sqrt(share @ (frequency - f0) ** 2))
    std = np.sqrt(np.diag(found.covariance))
    f_std = float(np.sqrt(share**2 @ std[[at.frequencies + k for k in group]] ** 2)) if moved == 0.0 else moved / f0
    relative = 0.5 * std[places] * found.by_power[places] / structure.power[places]
    amplitude = float(np.sqrt(power.sum()))
    a_std = amplitude * float(np.sqrt(share**2 @ relative**2))
    width = float(share @ (frequency / quality))
    # The full width at half of the maximum of a normal law is 2.355 standard deviations.
    Q = f0 / np.hypot(width, 2.355 * moved)
    q_std = float(np.sqrt(share**2 @ (std[[at.qualities + k for k in group]] * (1.0 - 0.5 / quality)) ** 2))
    estimates = [
        view.log_estimate("frequency", float(np.log(f0)), f_std, "", "Hz"),
        view.log_estimate("quality_factor", float(np.log(Q)), q_std, "", "1"),
        view.amplitude_estimate("amplitude", amplitude, a_std),
    ]
    half = 0.5 * frequency / quality
    support = max(float(min(frequency - 4.0 * half)), 0.0), min(float(max(frequency + 4.0 * half)), view.rate / 2.0)
    return estimates, support
