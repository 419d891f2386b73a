"""The structure of a view's spectrum: the search for it, and its description."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.fft import dct
from scipy.special import gammaincc

from allanjax.critic.bank import any_of
from allanjax.critic.factor import stop_band
from allanjax.critic.noise import MARKOV, POWER_LAW, coefficient_folds
from allanjax.critic.parameters import Detail, Limit, limited
from allanjax.critic.places import Place
from allanjax.critic.policy import judged
from allanjax.critic.step import Step
from allanjax.critic.view import Candidate, View
from allanjax.estimate.spectral.components import BUTTERWORTH_4, NONE
from allanjax.estimate.spectral.model import Component, response_of
from allanjax.estimate.structure.search import Record, at_all, completed, narrow, refitted, searched
from allanjax.estimate.structure.structure import (
    FIXED,
    FREQUENCIES,
    FURTHER,
    LEAST_QUALITY,
    LINE,
    LOWEST_BANDWIDTH,
    Fitted,
    Spectrum,
    Structure,
    markov,
    model_of,
    order_of,
    resonance,
)
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model
from allanjax.noise.terms import PowerLaw
from allanjax.record.completion import in_time
from allanjax.spectrum.peaks import LOWEST, NARROWEST

# Number of independent windows per width, and its growth per e-fold of a smaller p-value; number of the
# widest windows that add nothing. Measured on simulated spectra.
_INDEPENDENT, _WIDE = (1.9, 0.11), 3.0


class Window(NamedTuple):
    """Window with the largest excess: its middle and width [coefficients], and the p-value of the search."""

    middle: float
    width: float
    p_value: float


def conspicuous(ratio: Float[np.ndarray, " n-1"]) -> Window:
    """Most conspicuous window of squared whitened coefficients.

    Windows a quarter of a width apart count as two to four independent ones for each width, the more the
    smaller the p-value (`_INDEPENDENT`).
    """
    total = np.concatenate([[0.0], np.cumsum(ratio)])
    best = (-np.inf, 0.0, 0.0)
    width, widths = NARROWEST, 0.0
    least = 1.0
    while width <= (len(ratio) - LOWEST) // 4:
        step = max(width // 4, 1)
        excess = total[LOWEST + width :: step] - total[LOWEST : len(total) - width : step]
        k = int(np.argmax(excess))
        level = float(excess[k]) / width
        windows = len(ratio) / width
        gain = 0.5 * width * (level - 1.0 - np.log(level)) if level > 1.0 else 0.0
        tail = min(max(float(gammaincc(width / 2.0, level * width / 2.0)), 1e-300), 1.0 - 1e-12)
        independent = min(_INDEPENDENT[0] - _INDEPENDENT[1] * np.log(tail), 4.0)
        least, widths = min(least, any_of(tail, independent * windows)), widths + 1.0
        best = max(best, (gain - np.log(windows), LOWEST + k * step + width / 2.0 + 1.0, float(width)))
        width *= 2
    # Every width is a separate search, except that the widest ones repeat narrower ones.
    return Window(best[1], best[2], any_of(least, max(widths - _WIDE, 1.0)))


#: Names of the findings.
LOW_PASS, RESONANCE = "low_pass", "resonance"
_LINES, _BESIDE = judged("line", "quality"), judged("line", "beside")
# Share of a filter's corner frequency at which its pass band is judged.
_PASSED = 0.5
# Share of the record at each end that is drawn anew behind a steep filter.
_ENDS = 0.02
_LEFT = judged("spectral_shape", "left")
# Correlation time [samples] below which a Markov process without white noise is filtered white noise.
_SHORT = 20.0
# Number of points of the response in the search for its half-power frequency, the share of half the sample
# rate up to which this is sought, and the step of derivatives.
_POINTS, _REACHED, _STEP = 4096, 0.8, 1e-3


def _record(view: View, further: PowerLaw | None) -> Record:
    """Spectrum of a view without the terms of its baseline other than basic ones."""
    squares = view.residual**2
    return Record(squares if view.base is None else squares / view.base, view.rate, further)


def _further(view: View) -> PowerLaw | None:
    """Power law of a view's noise, if it has one."""
    power_law = POWER_LAW in view.noise.power
    return PowerLaw(1.0, float(view.noise.shape)) if power_law else None


def _start(view: View, further: PowerLaw | None, whole: bool = False) -> Structure:
    """Structure of a view with all terms that it may have.

    A Markov process that may be filtered white noise is left out, unless the `whole` noise is wanted.
    """
    columns = [FIXED.index(name) for name in FIXED if name in view.allowed]
    columns += [] if further is None else [FURTHER]
    start = dataclasses.replace(Structure.plain(columns), further=further)
    noise = view.noise
    # As filtered white noise it shows where the pass band ends.
    filtered = not whole and "angle_random_walk" not in noise.power and noise.shape * view.rate < _SHORT
    for name, power in noise.power.items():
        if name in FIXED:
            start = start.with_column(FIXED.index(name), power)
        elif name == POWER_LAW:
            start = start.with_column(FURTHER, power)
        elif not filtered:
            start = start.plus(markov(noise.shape * view.rate, 0.5 * power * noise.shape))
    if view.structure is not None:
        start = start.with_shape_of(view.structure)
    return start


def candidate_structure(view: View) -> tuple[View, float] | None:
    """View with the structure of its spectrum beyond the findings, and its log odds [nats].

    The odds are against all basic terms, also missing ones: a Markov process may explain much of a filter.
    """
    if view.structure is not None and not _left(view):
        return None
    further = _further(view)
    start = _start(view, further)
    spectrum, found = _searched(_record(view, further), start)
    if found.structure.has_shape_of(start):
        return None
    before, after = spectrum.fit(start), view.with_structure(found.structure)
    gain = found.evidence - before.evidence
    occam = before.loss - found.loss - gain
    gain = min(gain, after.log_evidence_all_terms - view.log_evidence_all_terms - occam)
    return (_without_ends(after), gain) if gain > 0.0 else None


def structure_at(view: View, places: Sequence[Place]) -> tuple[View, float] | None:
    """View with narrow resonances at some of these places, and their log odds [nats].

    The frequency of each is known within its place, which costs less than an unknown frequency.
    """
    further = _further(view)
    record = _record(view, further)
    spectrum, now = refitted(record, _start(view, further))
    total = 0.0
    for place in places:
        low, high = (2.0 * np.pi * f / record.rate for f in place[1:])
        angle, width = 0.5 * (low + high), high - low
        level = at_all(spectrum, now)[int(np.clip(angle / np.pi * record.n, 1, record.n - 1)) - 1]
        k, inside = len(now.structure.components), now.structure.kind != NONE
        power = 0.5 * float(level) * width / np.pi
        new = now.structure.plus(resonance(angle, 2.0 * angle / width, power, inside))
        finer = record.binned(new)
        found, before = finer.fit(new), finer.fit(now.structure)
        own, first = found.structure.components[k], found.structure.first[k]
        if own.power <= 0.0:
            continue
        std = float(np.sqrt(found.covariance[first, first]))
        share = max(width / angle * len(places), np.sqrt(2.0 * np.pi) * std)
        gain = found.evidence - before.evidence + float(np.log(np.log(record.n / FREQUENCIES) / share))
        if gain > 0.0 and low <= own.frequency <= high:
            spectrum, now, total = finer, found, total + gain
    return (view.with_structure(now.structure), total) if total > 0.0 else None


def _searched(record: Record, start: Structure) -> tuple[Spectrum, Fitted]:
    """Structure of a spectrum without resonances that are as narrow as lines."""
    spectrum, found = searched(record, start)
    if lines := narrow(found.structure, record.n):
        found = spectrum.fit(found.structure.without(*lines))
    return spectrum, found


def _without_ends(view: View) -> View:
    """View whose ends are redrawn in the stop band of its response; they count as imputed.

    Whitening amplifies the stop band, and with it the kinks of the mirrored record.
    """
    if view.structure is None or view.factor is None:
        return view
    band = stop_band(view.structure, view.family, view.factor)
    if band is None:
        return view
    deep, share = band
    k = np.arange(view.n)
    # Gradually, as an edge would be an outlying sample.
    near = np.clip(1.0 - np.minimum(k, view.n - 1 - k) / (_ENDS * view.n), 0.0, 1.0)
    root = np.sqrt(view.variance())
    drawn = np.sqrt(share) * np.random.default_rng(0).standard_normal(view.n - 1)
    change = np.sin(0.5 * np.pi * near) ** 2 * in_time(np.where(deep, drawn - view.residual / root, 0.0))
    more = in_time(np.where(deep, root * dct(change, norm="ortho", workers=-1)[1:], 0.0))
    return dataclasses.replace(view, samples=view.samples + more, imputed=view.imputed | (near > 0.0))


def _left(view: View) -> bool:
    """Whether the spectrum has a rest that its structure does not explain."""
    return conspicuous(view.squared_whitened).p_value < _LEFT


class Shape(NamedTuple):
    """Final structure of a view's spectrum: filter and resonances as findings, by gain; and the model."""

    steps: list[Step]
    model: Model


def finished(view: View, first: Step) -> Shape | None:
    """Final fit of the structure first found in a step; None if there are only basic terms."""
    further = _further(view)
    record, start = _record(view, further), _start(view, further)
    spectrum, found = _searched(record, start) if _left(view) else refitted(record, start)
    spectrum, found = completed(record, spectrum, found, MARKOV in view.allowed and further is None)
    while groups := _groups(found.structure):
        less = [_without(found.structure, group) for group in groups]
        best, *losses = _held_out_losses(record, spectrum, [found.structure, *less])
        held_out = [loss - best for loss in losses]
        if (least := min(held_out)) > 0.0:
            break
        # What predicts nothing is not reported.
        found = spectrum.fit(less[held_out.index(least)])
    else:
        return None
    structure = found.structure
    without = [spectrum.fit(each) for each in less]
    gains = [found.evidence - less.evidence for less in without]
    order = sorted(range(len(groups)), key=lambda k: -gains[k])
    steps = []
    for place, k in enumerate(order):
        left = [component for j in order[place + 1 :] for component in groups[j]]
        partial = spectrum.fit(_without(structure, left)).structure if left else structure
        # Of the spectrum without the group, to which everything else is fitted.
        left_over = conspicuous(record.squares / at_all(spectrum, without[k]))
        own = _candidate(view, first, found, groups[k])
        # For a filter, the odds are the only statistic.
        p_value = None if own.cause == LOW_PASS else left_over.p_value
        own = dataclasses.replace(
            own, gain=gains[k], p_value=p_value, after=own.after.with_structure(partial)
        )
        steps.append(Step(own, held_out[k], (), first.before))
    return Shape(steps, model_of(structure, view.rate))


#: Represents the response among the components of a group.
_RESPONSE = -1


def _groups(structure: Structure) -> list[list[int]]:
    """The response, and resonances that belong together, as lists of components, the strongest first."""
    groups: list[list[int]] = []
    own = structure.components
    for k in sorted(structure.oscillators, key=lambda k: own[k].frequency):
        if groups and any(own[i].is_close_to(own[k]) for i in groups[-1]):
            groups[-1].append(k)
        else:
            groups.append([k])
    sharp = [g for g in groups if all(own[k].quality > _LINES for k in g)]
    if sharp:
        first = max(sharp, key=lambda g: max(own[k].power for k in g))
        family = [g for g in sharp if g is first or _related(own[first[0]], own[g[0]])]
        groups = [g for g in groups if g not in family] + [[k for g in family for k in g]]
    places = [sorted(g, key=lambda k: -own[k].power) for g in groups]
    return ([[_RESPONSE]] if structure.kind != NONE else []) + places


def _related(first: Component, other: Component) -> bool:
    """Whether a narrow resonance is at a multiple of another one's frequency, or beside such a multiple."""
    ratio = other.frequency / first.frequency
    return ratio > 0.5 and abs(ratio - np.rint(ratio)) < _BESIDE


def _without(structure: Structure, group: Sequence[int]) -> Structure:
    """Structure without a group of components."""
    rest = structure.without(*group)
    return dataclasses.replace(rest, kind=NONE) if _RESPONSE in group else rest


def held_out_gain(view: View, structure: Structure) -> float:
    """Gain in log-likelihood by a structure on each half of the coefficients, by fits to the other [nats].

    The noise without it has all terms that it may have.
    """
    further = _further(view)
    record = _record(view, further)
    before, after = _held_out_losses(
        record, record.binned(structure), [_start(view, further, True), structure]
    )
    return before - after


def _held_out_losses(record: Record, spectrum: Spectrum, structures: Sequence[Structure]) -> list[float]:
    """Minus the log-likelihood of each half of the coefficients under fits to the other half [nats]."""
    losses = np.zeros(len(structures))
    for fold in coefficient_folds(record.n):
        mine, other = (
            Spectrum.of(record.squares, spectrum.bins, record.further, half.astype(float)).with_error(
                spectrum.error
            )
            for half in (fold, ~fold)
        )
        losses += [other.loss_of(mine.fit(structure)) for structure in structures]
    return losses.tolist()


def _candidate(view: View, first: Step, found: Fitted, group: Sequence[int]) -> Candidate:
    """Filter, or resonances at about one frequency, as a candidate that leaves the spectrum as it is."""
    if group == [_RESPONSE]:
        estimates, low = _of_response(view, found)
        after, support = first.candidate.after, (low, view.rate / 2.0)
        doubt = _doubt_of_filter(found.structure, view, low)
        return Candidate(
            LOW_PASS, estimates, 0.0, None, after, lambda: 0.0, support, "frequency", doubt=doubt
        )
    own = found.structure.components
    # The strongest one and those close to it; the others are further lines of the same source.
    near = [k for k in group if own[k].is_close_to(own[group[0]])]
    others = sorted((k for k in group if k not in near), key=lambda k: own[k].frequency)
    estimates, support = _of_resonances(view, found, near)
    details: dict[str, Detail] = {}
    if others:
        each = [_of_resonances(view, found, [k])[0] for k in others]
        details["further_frequencies"] = tuple(e[0] for e in each)
        details["further_amplitudes"] = tuple(e[2] for e in each)
    broad = estimates[1].value < judged(RESONANCE, "quality")
    doubt = "it is too broad for a resonance" if broad else ""
    return Candidate(
        RESONANCE,
        estimates,
        0.0,
        None,
        first.before,
        lambda: 0.0,
        support,
        "frequency",
        details=details,
        doubt=doubt,
    )


def _doubt_of_filter(structure: Structure, view: View, corner: float) -> str:
    """Why a response with this corner [Hz] is hardly a low-pass filter."""
    nyquist = 0.5 * view.rate
    if corner >= nyquist:
        return "its corner would lie above half the sample rate"
    # Resonances may be what falls.
    smooth = model_of(structure.without(*structure.oscillators), view.rate)
    inside, highest = np.asarray(smooth.sampled_psd(np.array([_PASSED * corner, nyquist]), view.rate))
    return (
        "" if highest < judged(LOW_PASS, "falls") * inside else "the spectrum does not fall above its corner"
    )


def _of_response(view: View, found: Fitted) -> tuple[list[Estimate], float]:
    """Half-power frequency of the response and its order, and where it begins to matter [Hz]."""
    structure = found.structure
    covariance = found.covariance[-2:, -2:]
    value = _half_power(structure, view.rate)
    slope = np.zeros(2)
    for i in range(2):
        moved = structure.parameters
        moved[i - 2] += _STEP
        there = _half_power(structure.with_parameters(moved), view.rate)
        slope[i] = np.log(there / value) / _STEP
    std = float(np.sqrt(slope @ covariance @ slope))
    bounds = np.log([LOWEST_BANDWIDTH * view.rate, view.rate])
    # Filters steeper than the steepest one in the search look like it.
    steepest: Limit = "above" if structure.kind == BUTTERWORTH_4 else ""
    estimates = [
        view.log_estimate("bandwidth", *limited(float(np.log(value)), std, bounds), "Hz"),
        view.estimate("order", order_of(structure), 0.0, "1", steepest),
    ]
    return estimates, value


def _half_power(structure: Structure, rate: float) -> float:
    """Frequency at which the response has fallen by half [Hz].

    If aliases keep it above that, it is the frequency of the analog filter with these poles.
    """
    response = response_of(structure, rate)
    assert response is not None
    f = np.linspace(0.0, _REACHED * rate / 2.0, _POINTS)[1:]
    log = np.log(np.asarray(response.power(f, rate)))
    below = np.flatnonzero(log < np.log(0.5))
    if len(below) and below[0] > 0:
        k = int(below[0])
        share = (log[k - 1] - np.log(0.5)) / (log[k - 1] - log[k])
        return float(f[k - 1] + share * (f[k] - f[k - 1]))
    return response.half_power


def _of_resonances(
    view: View, found: Fitted, group: Sequence[int]
) -> tuple[list[Estimate], tuple[float, float]]:
    """Frequency, quality factor and amplitude of one resonance, or of several for one that drifts."""
    structure, hertz = found.structure, view.rate / (2.0 * np.pi)
    own, first = [structure.components[k] for k in group], np.array([structure.first[k] for k in group])
    frequency, quality = np.array([(c.frequency * hertz, c.quality) for c in own]).T
    power = fitted = np.array([c.power for c in own])
    response = response_of(structure, view.rate)
    if response is not None:
        # As recorded, after the response.
        passed = np.asarray(response.power(frequency, view.rate))
        power = np.where(structure.inside[group], power * passed, power)
    share = power / power.sum()
    f0 = float(share @ frequency)
    moved = float(np.sqrt(share @ (frequency - f0) ** 2))
    std = np.sqrt(np.diag(found.covariance))
    f_std = float(np.sqrt(share**2 @ std[first] ** 2)) if moved == 0.0 else moved / f0
    relative = 0.5 * std[group] / fitted
    amplitude = float(np.sqrt(power.sum()))
    a_std = amplitude * float(np.sqrt(share**2 @ relative**2))
    width = float(share @ (frequency / quality))
    # The full width at half of the maximum of a normal law is 2.355 standard deviations.
    Q = f0 / np.hypot(width, 2.355 * moved)
    q_std = float(np.sqrt(share**2 @ (std[first + 1] * (1.0 - 0.5 / quality)) ** 2))
    # A narrower one is a line, a wider one an edge; lower or higher ones are not observable.
    spacing = view.rate / (2.0 * view.n)
    band, shapes = np.log([LOWEST * spacing, view.rate / 2.0]), np.log([LEAST_QUALITY, f0 / (LINE * spacing)])
    estimates = [
        view.log_estimate("frequency", *limited(float(np.log(f0)), f_std, band), "Hz"),
        view.log_estimate("quality_factor", *limited(float(np.log(Q)), q_std, shapes), "1"),
        view.amplitude_estimate("amplitude", amplitude, a_std),
    ]
    half = 0.5 * frequency / quality
    support = (
        max(float(min(frequency - 4.0 * half)), 0.0),
        min(float(max(frequency + 4.0 * half)), view.rate / 2.0),
    )
    return estimates, support
