"""Search for the structure of a spectrum: what it consists of besides the noise terms.

It opens with the best of all responses on a grid, around the peaks that stand out; then adds one component
after another, each of which is the best of many proposals (`proposals`) and is kept if the evidence of a
joint fit rises; and at the end takes out what is not needed and swaps what may be another.

A wide oscillator, white noise behind a filter and a Markov process of less than a sample have the same
spectrum; the order of the trials decides which of them is found. So no resonance may be wider than its
frequency, a response is tried in every round until there is one, and no correlation time is shorter than
eight samples.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from allanjax.estimate.spectral.components import (
    BIQUAD,
    BUTTERWORTH_1,
    BUTTERWORTH_2,
    BUTTERWORTH_3,
    BUTTERWORTH_4,
    MOVING_AVERAGE,
    NONE,
    ONE_POLE,
    TWO_POLES,
)
from allanjax.estimate.spectral.model import FULL
from allanjax.estimate.spectral.powers import power_fits
from allanjax.estimate.structure.proposals import Units, promised, slots_to_try, windows
from allanjax.estimate.structure.structure import (
    FINE,
    LINE,
    OUTSIDE,
    QUANTIZATION,
    WHITE,
    Fitted,
    Spectrum,
    Structure,
)
from allanjax.noise.terms import NoiseTerm
from allanjax.spectrum.cosine import Bins

# Log odds that an addition must gain [nats]; and the gain in likelihood by a slow process, of which two are
# the expected ones of its two parameters.
_GAIN, _PREDICTS = 2.0, 3.0
# Gain in likelihood from which on a proposal is fitted jointly [nats]: less than its evidence costs.
_HOPEFUL = 5.0
# Peaks that the search opens with, and the least gain [nats] and quality factor of one; windows of a round.
_PEAKS, _CLEAR_PEAK, _SLIM, _WINDOWS = 8, 20.0, 3.0, 3
# Half the width, in octaves, of what the median around a place is taken of.
_AROUND = 0.45
# Width of a resonance [coefficients] below which it is a line.
_LINE = 1.25 * LINE
# Kinds of responses, and bandwidths that one is tried with [cycles per sample].
_KINDS = (ONE_POLE, TWO_POLES, MOVING_AVERAGE, BIQUAD, *range(BUTTERWORTH_1, BUTTERWORTH_4 + 1))
_OPENING = (ONE_POLE, TWO_POLES, MOVING_AVERAGE, BUTTERWORTH_2, BUTTERWORTH_3)
_BANDWIDTHS = np.geomspace(0.012, 0.42, 12)
_BESIDE = (0.6, 0.75, 0.9, 1.0, 1.15, 1.4, 1.8)
#: Correlation times that a Markov process starts from, in powers of the number of samples.
TIMES = (0.35, 0.55, 0.75, 0.95)
# Joint fits of the best proposals in a round, and most rounds.
_TRIED, _ROUNDS = 3, 20
# Proposals whose powers are fitted.
_RANKED = 12
# Evidence that a resonance costs, a process or a response, and what follows it [nats]: rough values.
_PRICES = np.array([13.0, 9.0, 6.0])
# Correlation time [samples] below which a Markov process may stand for what a response does.
_QUICK = 20.0
# Bins in an octave.
_PER_OCTAVE = 12
# Quality factor above which a resonance is narrow, gain [nats] above which a window is certainly accepted,
# and share of the bandwidth up to which a response is flat.
_NARROW, _SURE, _FLAT = 8.0, 30.0, 0.1
# Number of oscillators that represent one whose frequency drifts.
_MOVING = 3
# Share of its median below which a spectrum has a deep stop band.
_DEEP = 0.05
#: Quality factor below which a resonance may be white noise behind a filter.
WIDE = 4.0
# Frequencies [radians per sample] and quality factors of resonances that may be taken for a filter's shape.
_EDGES, _BROAD = np.pi * np.geomspace(0.15, 0.95, 8), (2.0, 5.0)
# Relative error of a power beyond which the fit is tried without it.
_DOUBTFUL = 0.2
# Deviation of a smoothed level from its expectation, in standard deviations, beyond which a search begins.
_CLEAR = 2.5


class Record(NamedTuple):
    """Spectrum of one record, which can be binned as its resonances require.

    Attributes:
        squares: squared cosine coefficients [rate²], without lines and ramps.
        rate: sample rate [Hz].
        further: a term whose column is used besides the basic ones.
    """

    squares: Float[np.ndarray, " n-1"]
    rate: float
    further: NoiseTerm | None = None

    @property
    def n(self) -> int:
        """Number of samples."""
        return len(self.squares) + 1

    def binned(self, structure: Structure) -> Spectrum:
        """Spectrum in bins that are finer around the resonances of a structure."""
        around = [
            (
                structure.frequency(k) * self.rate / (2.0 * np.pi),
                2.0 * structure.frequency(k) / structure.quality(k) * self.rate / (2.0 * np.pi),
            )
            for k in structure.oscillators
        ]
        return Spectrum.of(self.squares, Bins.of(self.n, self.rate, around, _PER_OCTAVE), self.further)


def searched(record: Record, start: Structure) -> tuple[Spectrum, Fitted]:
    """Search from a start: the structure of the spectrum, and the binned spectrum to which it was fitted."""
    spectrum, now = refitted(record, start)
    last = now.structure
    if last.kind == NONE and smoothed_scores(spectrum, now) > _CLEAR:
        spectrum, now = _opened(record, now)
    while True:
        for _ in range(_ROUNDS):
            found = _grown(record, spectrum, now)
            if found is None:
                break
            spectrum, now = found
        # A structure to which only lines were added has had its swaps.
        if _outline(now.structure, record.n) == _outline(last, record.n):
            return spectrum, now
        now = pruned(spectrum, _edited(spectrum, now, _final))
        last = now.structure


def narrow(structure: Structure, n: int) -> list[int]:
    """Resonances of a structure of n samples that are as narrow as lines."""
    return [int(k) for k in structure.oscillators if structure.width(int(k)) < _LINE * np.pi / n]


def _outline(structure: Structure, n: int) -> tuple[int, int, int]:
    """Kind of the response, number of Markov processes, and number of resonances that are not lines."""
    wide = len(structure.oscillators) - len(narrow(structure, n))
    return structure.kind, len(structure.markovs), wide


def refitted(record: Record, start: Structure) -> tuple[Spectrum, Fitted]:
    """Structure fitted anew without superfluous components, and the spectrum to which it was fitted."""
    spectrum = record.binned(start)
    spectrum = spectrum.weighing(spectrum.fit(start))
    return spectrum, pruned(spectrum, spectrum.fit(start))


def completed(spectrum: Spectrum, now: Fitted, slow: bool = True) -> Fitted:
    """Final fit with the slow processes that predict best, without idle components."""
    now = pruned(spectrum, _slow(spectrum, now)) if slow else now
    structure = now.structure
    for k in np.flatnonzero(structure.active & (structure.power <= 0.0)):
        if k != WHITE:
            structure = structure.without(int(k))
    if not structure.active[QUANTIZATION]:
        # Its limit is that of the rounding of the output.
        structure = structure.placed(QUANTIZATION, False)
    return spectrum.fit(structure, FINE)


def _opened(record: Record, plain: Fitted) -> tuple[Spectrum, Fitted]:
    """The best of fits with some response, and without any, to all peaks that stand out."""
    n, structure = record.n, plain.structure
    bins = Bins.of(n, record.rate, (), 2 * _PER_OCTAVE)
    level, f = np.log(bins.sums(record.squares) / bins.size), np.log2(bins.frequency)
    around = [_beside(level, f - g) for g in f]
    every = np.log2(np.arange(1.0, n) * record.rate / (2.0 * n))
    ratio = record.squares / np.exp(np.interp(every, f, around))
    for middle, width, gain in windows(ratio, 2 * _PEAKS):
        w, quality = np.pi * middle / n, middle / width
        power = float(np.exp(np.interp(np.log2(middle * record.rate / (2.0 * n)), f, around))) * width / n
        if gain > _CLEAR_PEAK and quality > _SLIM and len(structure.oscillators) < _PEAKS:
            quality = float(np.clip(quality, 2.0, max(middle / LINE / 2.0, 2.0)))
            structure = structure.with_oscillator(w, quality, power, False) or structure
    spectrum = record.binned(structure)
    tried = _ranked(spectrum, _responses(structure, _floor(spectrum)))
    fits = [spectrum.fit(s) for s in (structure, *tried[:2])]
    finer = spectrum.weighing(max(fits, key=lambda f: f.evidence))
    fits = [finer.fit(f.structure) for f in fits]
    best = max(fits, key=lambda f: f.evidence)
    return finer, _settled(finer, plain.structure, pruned(finer, best))


def _beside(level: Float[np.ndarray, " m"], away: Float[np.ndarray, " m"]) -> float:
    """The higher one of the medians of the levels on either side of a place: an edge is no peak."""
    sides = [level[(side * away >= 0.0) & (abs(away) <= _AROUND)] for side in (-1.0, 1.0)]
    return max(float(np.median(x)) for x in sides)


def _responses(structure: Structure, floor: float) -> list[list[Structure]]:
    """Structures with a response, by its kind, and white noise of a level of `floor` after it.

    Without that noise the depth of a deep stop band would decide what the response is. All resonances are
    inside it or after it.
    """
    if floor and not structure.active[OUTSIDE]:
        structure = structure.using(OUTSIDE, floor)
    found = []
    for kind in _OPENING:
        every = (structure, _all_placed(structure, True))
        places = {s.inside[s.active].tobytes(): s for s in every}.values()
        found.append([s.with_response(kind, 2.0 * np.pi * b) for s in places for b in _BANDWIDTHS])
    return found


def _all_placed(structure: Structure, inside: bool) -> Structure:
    """Structure with all resonances and quantization inside the response, or after it."""
    places = structure.inside.copy()
    places[FULL.first_oscillator + structure.oscillators] = places[QUANTIZATION] = inside
    return dataclasses.replace(structure, inside=places)


def _ranked(spectrum: Spectrum, groups: Sequence[Sequence[Structure]]) -> list[Structure]:
    """The best structure of each group by fits of their powers with shapes held, the best one first."""
    every = [s for group in groups for s in group]
    if not every:
        return []
    components = np.flatnonzero(np.any([s.active for s in every], axis=0)).tolist()
    of = Units(spectrum)
    unit = np.stack([of(s, components) for s in every])
    power = np.stack([s.power[components] for s in every])
    used = np.stack([s.active[components] for s in every])
    # The noise before a response is about what it is without.
    data = (spectrum.levels.level, spectrum.levels.shape, spectrum.rough)
    level, shape, rough = (np.asarray(x)[: unit.shape[-1]] for x in data)
    power, loss = power_fits(level, shape, rough, unit, power, used)
    best, first = [], 0
    loss = loss + np.array([_price(s) for s in every])
    for group in groups:
        k = first + int(np.argmin(loss[first : first + len(group)]))
        values = every[k].power.copy()
        values[components] = power[k]
        best.append((loss[k], every[k].with_powers(values)))
        first += len(group)
    return [s for _, s in sorted(best, key=lambda pair: pair[0])]


def _price(structure: Structure) -> float:
    """About what the components of a structure cost in evidence [nats]."""
    filtered, rounded = structure.kind != NONE, structure.active[QUANTIZATION]
    shaped = len(structure.markovs) + filtered
    beside = structure.active[OUTSIDE] + filtered * rounded * (0.5 + structure.inside[QUANTIZATION])
    return float(_PRICES @ (len(structure.oscillators), shaped, beside))


def _grown(record: Record, spectrum: Spectrum, now: Fitted) -> tuple[Spectrum, Fitted] | None:
    """The best of all additions, fitted in bins that are made for it; None if none gains enough."""
    for proposal in _additions(record, spectrum, now):
        best = spectrum.fit(proposal)
        if best.evidence < now.evidence - 1.0 or not _keeps_white(now, best):
            continue
        finer = record.binned(best.structure)
        again = finer.fit(best.structure)
        # Whatever is added has to show where the filter has not fallen, lest it mends the filter's shape.
        same = best.structure.kind == now.structure.kind
        plain, finer = finer.weighing(again), finer.weighing(again, filters=same)
        again, before = finer.fit(again.structure), finer.fit(now.structure)
        if again.evidence - before.evidence > _GAIN and _keeps_white(now, again):
            return plain, _settled(plain, now.structure, plain.fit(again.structure) if same else again)
    return None


def _additions(record: Record, spectrum: Spectrum, now: Fitted) -> Iterator[Structure]:
    """Structures with one component more, or with several narrow resonances, the most promising first."""
    structure, n = now.structure, spectrum.n
    inside = structure.kind != NONE
    proposals, together = _at_windows(record, spectrum, now)
    if together is not None:
        yield together
    proposals += slots_to_try(structure, n, inside)
    if inside and not structure.active[OUTSIDE]:
        proposals.append(structure.using(OUTSIDE, 1.0))
    new = [int(np.flatnonzero(s.active & ~structure.active)[0]) for s in proposals]
    of = Units(spectrum)
    rows = np.stack([of(s, [k])[0] for s, k in zip(proposals, new, strict=True)])
    gain, power = promised(spectrum, now, rows)
    best = [int(i) for i in np.argsort(-gain)[:_RANKED] if gain[i] > _HOPEFUL]
    groups = [[proposals[i].using(new[i], float(power[i]))] for i in best]
    if structure.kind == NONE and smoothed_scores(spectrum, now) > _CLEAR:
        groups += _responses(structure, _floor(spectrum))
    yield from _ranked(spectrum, groups)[:_TRIED]


def _at_windows(record: Record, spectrum: Spectrum, now: Fitted) -> tuple[list[Structure], Structure | None]:
    """Structures with a resonance in a window of much excess; and one with several narrow ones."""
    structure, n = now.structure, spectrum.n
    ratio = record.squares / at_all(spectrum, now)
    for k in structure.oscillators:
        if structure.companions(int(k)) >= _MOVING:
            # The excess that is left there belongs to the resonance that moves.
            low, high = (structure.frequency(k) + side * structure.width(k) for side in (-1.0, 1.0))
            ratio[max(int(low * n / np.pi), 0) : int(high * n / np.pi) + 1] = 1.0
    proposals, together, count = [], structure, 0
    for middle, width, gain in windows(ratio, _WINDOWS):
        w = np.pi * middle / n
        quality = float(np.clip(middle / width, 2.0, max(middle / LINE / 2.0, 2.0)))
        level = float(np.interp(middle, middles(spectrum), now.mean[: len(spectrum.bins.size)]))
        # The excess is about as large as the level, over the window.
        of = w, quality, level * width / n, structure.kind != NONE
        if (found := structure.with_oscillator(*of)) is not None:
            proposals.append(found)
        if quality > _NARROW and gain > _SURE and (more := together.with_oscillator(*of)) is not None:
            together, count = more, count + 1
    return proposals, together if count > 1 else None


def _floor(spectrum: Spectrum) -> float:
    """Lowest level of a spectrum that falls to a small part of itself, else zero."""
    rough = spectrum.rough[: len(spectrum.bins.size)]
    floor = float(np.min(rough))
    return floor if floor < _DEEP * float(np.median(rough)) else 0.0


def _edited(
    spectrum: Spectrum, now: Fitted, edits: Callable[[Spectrum, Structure], list[list[Structure]]]
) -> Fitted:
    """Fit after all edits of the structure that gain, of groups of which the best one is fitted jointly."""
    while True:
        tried = _ranked(spectrum, edits(spectrum, now.structure))[:_TRIED]
        best = functools.reduce(_better, map(spectrum.fit, tried), now)
        if best is now:
            return now
        now = best


def _settled(spectrum: Spectrum, before: Structure, now: Fitted) -> Fitted:
    """Fit with the best kind for a new response, and new components inside it or after it."""
    new = [FULL.first_oscillator + int(k) for k in set(now.structure.oscillators) - set(before.oscillators)]
    other = now.structure.kind != before.kind
    new += [QUANTIZATION] * other

    def edits(_: Spectrum, structure: Structure) -> list[list[Structure]]:
        return _moved(structure, new) + (_kinds(structure, structure.bandwidth[0]) if other else [])

    return _edited(spectrum, now, edits)


def _final(spectrum: Spectrum, structure: Structure) -> list[list[Structure]]:
    """Structures with another response, one component elsewhere, or a wide resonance as something else.

    A wide resonance may be a Markov process, white noise after the response, or the response itself.
    """
    every = [FULL.first_oscillator + int(k) for k in structure.oscillators]
    groups = _kinds(structure, structure.bandwidth[0]) + _moved(structure, [*every, QUANTIZATION])
    if quick := [FULL.first_markov + int(k) for k in structure.markovs if structure.time(int(k)) < _QUICK]:
        rest = functools.reduce(Structure.without, quick, structure)
        groups += [[rest], *_kinds(rest, rest.bandwidth[0], anew=True)]
    if structure.kind != NONE and structure.power[QUANTIZATION] > 0.0:
        # Behind a filter it may be the shape of that filter, or of a resonance.
        rest = structure.without(QUANTIZATION)
        groups += _kinds(rest, rest.bandwidth[0], anew=True)
        wide = [rest.with_oscillator(w, Q, 0.0, False) for w in _EDGES for Q in _BROAD]
        groups += [
            [s.with_response(kind, min(s.bandwidth[0] * by, _HIGHEST)) for s in wide if s for by in _BESIDE]
            for kind in _OPENING
        ]
    for k in structure.oscillators:
        if structure.quality(k) < WIDE:
            w, power = structure.frequency(k), float(structure.power[FULL.first_oscillator + k])
            rest = structure.without(FULL.first_oscillator + k)
            slow, filtered = rest.with_markov(1.0 / w, power), rest.kind != NONE
            groups += [[rest], [] if slow is None else [slow]]
            groups += [[rest.using(OUTSIDE, _floor(spectrum) or power)]] if filtered else []
            groups += _kinds(rest, rest.bandwidth[0] if filtered else w, anew=True)
    return [group for group in groups if group]


def _kinds(structure: Structure, width: float, anew: bool = False) -> list[list[Structure]]:
    """Structures with a response of about this bandwidth [radians per sample], by its kind."""
    if structure.kind == NONE and not anew:
        return []
    moved = structure.placed(QUANTIZATION, not structure.inside[QUANTIZATION])
    every = (structure, moved, _all_placed(structure, True), _all_placed(structure, False))
    places = {s.inside[s.active].tobytes(): s for s in every}.values()
    return [
        [
            s.with_response(kind, min(width * by, _HIGHEST))
            for s in places
            for by in _BESIDE
            if by != 1.0 or kind != structure.kind or anew
        ]
        for kind in _KINDS
    ]


def _moved(structure: Structure, components: Sequence[int]) -> list[list[Structure]]:
    """Structures with one of these components inside the response if it is after it, or after it."""
    groups = []
    for component in components if structure.kind != NONE else ():
        k = component - FULL.first_oscillator
        # Where the response has fallen by nothing yet there is no difference.
        flat = k >= 0 and structure.frequency(k) < _FLAT * structure.bandwidth[0]
        if structure.active[component] and not (flat and structure.quality(k) > _NARROW):
            groups.append([structure.placed(component, not structure.inside[component])])
    return groups


# Largest bandwidth that a response starts from [radians per sample].
_HIGHEST = 2.8


def _better(now: Fitted, other: Fitted) -> Fitted:
    """The other fit if it is more likely and still has white noise."""
    return other if other.evidence > now.evidence and _keeps_white(now, other) else now


def _keeps_white(now: Fitted, other: Fitted) -> bool:
    """Whether a fit has white noise, or lacks it without a wide resonance or another response in its place.

    White noise before a filter has the same spectrum as a response with wide resonances.
    """
    structure = other.structure
    narrow = all(structure.quality(int(k)) > WIDE for k in structure.oscillators)
    return bool(structure.power[WHITE] > 0.0 or (narrow and structure.kind == now.structure.kind))


def pruned(spectrum: Spectrum, now: Fitted) -> Fitted:
    """Fit without components that gain nothing; white noise stays."""
    while True:
        structure = now.structure
        idle = [int(k) for k in np.flatnonzero(structure.active & (structure.power <= 0.0)) if k >= OUTSIDE]
        if idle:
            for k in idle:
                structure = structure.without(k)
            now = spectrum.fit(structure)
            continue
        # Components whose power is known better than `_DOUBTFUL` stay without a trial.
        std = np.sqrt(np.diag(now.covariance))[: FULL.components]
        shaped = np.arange(FULL.components) >= FULL.first_markov
        loose = [OUTSIDE, QUANTIZATION] if structure.kind != NONE else [OUTSIDE]
        doubtful = structure.active & (shaped | np.isin(np.arange(FULL.components), loose))
        doubtful &= (structure.power > 0.0) & (std > _DOUBTFUL * structure.power)
        weakest = sorted(np.flatnonzero(doubtful).tolist(), key=lambda k: -std[k] / structure.power[k])[:2]
        if structure.kind == MOVING_AVERAGE and structure.power[QUANTIZATION] > 0.0:
            # After a mean over less than two samples it is that of another duration.
            weakest.append(QUANTIZATION)
        best = now
        for k in weakest:
            best = _better(best, spectrum.fit(structure.without(k)))
        if best is now:
            return now
        now = best


def _slow(spectrum: Spectrum, now: Fitted) -> Fitted:
    """Fit with further Markov processes if these predict better (Akaike 1973).

    Slow terms are hardly distinguished by the evidence, but differ in the drift that they predict.
    """
    for _ in range(2):
        starts = (
            now.structure.with_markov(max(spectrum.n**p, 20.0), float(np.median(now.mean))) for p in TIMES
        )
        tried = [[start] for start in starts if start is not None]
        fits = [spectrum.fit(start) for start in _ranked(spectrum, tried)[:2]]
        best = min((f for f in fits if _keeps_white(now, f)), key=lambda found: found.loss, default=now)
        if best.loss > now.loss - _PREDICTS:
            break
        now = best
    return now


def middles(spectrum: Spectrum) -> Float[np.ndarray, " m"]:
    """Index of the coefficient in the middle of each bin."""
    edges = spectrum.bins.edges
    return 0.5 * (edges[:-1] + edges[1:] - 1)


def at_all(spectrum: Spectrum, fitted: Fitted) -> Float[np.ndarray, " n-1"]:
    """Expected squares of all coefficients, interpolated between the bins."""
    middle = np.log(middles(spectrum))
    mean = np.log(fitted.mean[: len(middle)])
    return np.exp(np.interp(np.log(np.arange(1.0, spectrum.n)), middle, mean))


def smoothed_scores(spectrum: Spectrum, fitted: Fitted) -> float:
    """Largest deviation of levels, averaged over a fifth of an octave or more, in standard deviations."""
    k = np.asarray(spectrum.levels.shape)
    ratio = np.asarray(spectrum.levels.level) / fitted.mean - 1.0
    best = 0.0
    for width in (6, 12, 24, 48):
        window = np.ones(width)
        total, weight = np.convolve(k * ratio, window, "valid"), np.convolve(k, window, "valid")
        best = max(best, float(np.max(abs(total) / np.sqrt(np.maximum(weight, 1.0)))))
    return best
