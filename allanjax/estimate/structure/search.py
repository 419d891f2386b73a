"""Greedy search for the structure of a spectrum: every step is a joint fit of all components.

A wide oscillator, white noise behind a filter and a Markov process of less than a sample have the same
spectrum; the order of the trials decides which of them is found. So no resonance may be wider than its
frequency, a response is tried in every round until there is one, and no correlation time is shorter than
eight samples.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from allanjax.estimate.spectral.components import (
    BIQUAD,
    BUTTERWORTH_1,
    BUTTERWORTH_2,
    BUTTERWORTH_4,
    MOVING_AVERAGE,
    NONE,
    ONE_POLE,
    TWO_POLES,
)
from allanjax.estimate.spectral.model import FULL
from allanjax.estimate.structure.structure import (
    FINE,
    LINE,
    LOWEST,
    OUTSIDE,
    QUANTIZATION,
    WHITE,
    Fitted,
    Spectrum,
    Structure,
)
from allanjax.noise.terms import NoiseTerm
from allanjax.spectrum.cosine import Bins

# Width of the narrowest window [coefficients], and the least gain of a window [nats].
_NARROWEST, _WORTH = 8, 4.0
# Log odds that an addition must gain [nats], and the gain in log-likelihood that a slow process must bring;
# two nats are expected from its two parameters alone.
_GAIN, _PREDICTS = 2.0, 3.0
# Windows that are tried for a resonance in a round.
_WINDOWS = 3
# Width of a resonance [coefficients] below which it is a line.
_LINE = 1.25 * LINE
# Bandwidths that a response starts from [cycles per sample].
_BANDWIDTHS = (0.06, 0.25)
# Kinds of responses, those tried first, and the largest start bandwidth of another kind [radians/sample].
_KINDS = (ONE_POLE, TWO_POLES, MOVING_AVERAGE, BIQUAD, *range(BUTTERWORTH_1, BUTTERWORTH_4 + 1))
_FIRST_KINDS = (ONE_POLE, TWO_POLES, BUTTERWORTH_2)
_HIGHEST = 2.8
#: Correlation times that a Markov process starts from, in powers of the number of samples.
TIMES = (0.35, 0.55, 0.75, 0.95)
# Difference in evidence below which two fits count as the same [nats], and how many different ones are tried.
_SAME, _TRIED = 0.1, 3
# Most rounds.
_ROUNDS = 20
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
# Relative error of a power beyond which the fit is tried without it.
_DOUBTFUL = 0.2
# Deviation of a smoothed level from its expectation, in standard deviations, beyond which a search begins.
_CLEAR = 2.5


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


def windows(ratio: Float[np.ndarray, " n-1"], most: int) -> list[tuple[float, float, float]]:
    """Non-overlapping windows with the largest excess: middle and width [coefficients] and gain [nats]."""
    total = np.concatenate([[0.0], np.cumsum(ratio)])
    found: list[tuple[float, float, float]] = []
    width = _NARROWEST
    while width <= (len(ratio) - LOWEST) // 4:
        step = max(width // 4, 1)
        excess = (total[LOWEST + width :: step] - total[LOWEST : len(total) - width : step]) / width
        for k in np.argsort(-excess)[: 4 * most]:
            level = float(excess[k])
            if level <= 1.0:
                break
            gain = 0.5 * width * (level - 1.0 - np.log(level)) - np.log(len(ratio) / width)
            found.append((gain, LOWEST + k * step + width / 2.0 + 1.0, float(width)))
        width *= 2
    chosen: list[tuple[float, float, float]] = []
    for gain, middle, wide in sorted(found, reverse=True):
        if gain < _WORTH or len(chosen) == most:
            break
        if all(abs(middle - other) > 0.5 * (wide + w) for other, w, _ in chosen):
            chosen.append((middle, wide, gain))
    return chosen


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
    before = now.structure
    for _ in range(_ROUNDS):
        found = _grown(record, spectrum, now)
        if found is None:
            break
        spectrum, now = found
    # If only lines were added to the start, replacements have been tried already.
    if _outline(now.structure, record.n) == _outline(before, record.n):
        return spectrum, now
    return spectrum, pruned(spectrum, _replaced(spectrum, now))


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
    return spectrum.fit(structure, FINE)


def _grown(record: Record, spectrum: Spectrum, now: Fitted) -> tuple[Spectrum, Fitted] | None:
    """The best of all additions, fitted in bins that are made for it; None if none gains enough."""
    tried = [spectrum.fit(proposal) for proposal in _additions(record, spectrum, now)]
    tried = [found for found in tried if _keeps_white(now, found)]
    tried = sorted((f for f in tried if f.evidence > now.evidence - 1.0), key=lambda f: -f.evidence)
    # Several starts end in the same place.
    places = [f for k, f in enumerate(tried) if k == 0 or tried[k - 1].evidence - f.evidence > _SAME]
    for best in places[:_TRIED]:
        finer = record.binned(best.structure)
        again = finer.fit(best.structure)
        finer = finer.weighing(again)
        again, before = finer.fit(again.structure), finer.fit(now.structure)
        if again.evidence - before.evidence > _GAIN and _keeps_white(now, again):
            return finer, _settled(finer, now.structure, again)
    return None


def _settled(spectrum: Spectrum, before: Structure, now: Fitted) -> Fitted:
    """Fit with the best kind for a new response, and new components inside it or after it."""
    new = [FULL.first_oscillator + int(k) for k in set(now.structure.oscillators) - set(before.oscillators)]
    if now.structure.kind != before.kind:
        now = _other_kind(spectrum, now)
        new += [QUANTIZATION] if now.structure.active[QUANTIZATION] else []
    return _placed(spectrum, now, new)


def _placed(spectrum: Spectrum, now: Fitted, components: Sequence[int]) -> Fitted:
    """Fit with each of these components inside the response or after it, whichever is more likely."""
    if now.structure.kind == NONE:
        return now
    for component in components:
        structure, k = now.structure, component - FULL.first_oscillator
        # Where the response is still flat, inside and after it are the same.
        if (
            k >= 0
            and structure.frequency(k) < _FLAT * structure.bandwidth[0]
            and structure.quality(k) > _NARROW
        ):
            continue
        now = _better(now, spectrum.fit(structure.placed(component, not structure.inside[component])))
    return now


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


def _additions(record: Record, spectrum: Spectrum, now: Fitted) -> Iterator[Structure]:
    """Structures with one component more, or with several narrow resonances."""
    structure, n = now.structure, spectrum.n
    if structure.kind == NONE:
        if smoothed_scores(spectrum, now) > _CLEAR:
            yield from responses(structure, _floor(spectrum))
    elif not structure.active[OUTSIDE] and (floor := _floor(spectrum)):
        yield structure.using(OUTSIDE, floor)
    ratio = record.squares / at_all(spectrum, now)
    for k in structure.oscillators:
        if structure.companions(int(k)) >= _MOVING:
            # The rest there is that of a resonance whose frequency drifts.
            low, high = (structure.frequency(k) + side * structure.width(k) for side in (-1.0, 1.0))
            ratio[max(int(low * n / np.pi), 0) : int(high * n / np.pi) + 1] = 1.0
    together, narrow = structure, 0
    for middle, width, gain in windows(ratio, _WINDOWS):
        w = np.pi * middle / n
        quality = float(np.clip(middle / width, 2.0, max(middle / LINE / 2.0, 2.0)))
        level = float(np.interp(middle, middles(spectrum), now.mean[: len(spectrum.bins.size)]))
        # The excess is about as large as the level, over the window.
        power = level * width / n
        if width > 0.5 * middle and 1.0 / w > 20.0:
            slow = structure.with_markov(1.0 / w, power)
            if slow is not None:
                yield slow
        inside = structure.kind != NONE
        found = structure.with_oscillator(w, quality, power, inside)
        if found is not None:
            yield found
        if quality > _NARROW and gain > _SURE:
            more = together.with_oscillator(w, quality, power, inside)
            together, narrow = (together, narrow) if more is None else (more, narrow + 1)
    if narrow > 1:
        yield together


def _floor(spectrum: Spectrum) -> float:
    """Lowest level of a spectrum with a deep stop band, else zero."""
    rough = spectrum.rough[: len(spectrum.bins.size)]
    floor = float(np.min(rough))
    return floor if floor < _DEEP * float(np.median(rough)) else 0.0


def responses(structure: Structure, floor: float) -> Iterator[Structure]:
    """Structures with a response and white noise after it; all resonances are inside it or after it.

    That noise has the level `floor`, if not zero; without it the stop band's depth would decide the response.
    """
    if floor:
        structure = structure.using(OUTSIDE, floor)
    count = len(structure.oscillators)
    for kind in _FIRST_KINDS:
        for bandwidth in _BANDWIDTHS:
            found = structure.with_response(kind, 2.0 * np.pi * bandwidth)
            for inside in (False, True) if count else (False,):
                for k in structure.oscillators:
                    found = found.placed(FULL.first_oscillator + int(k), inside)
                yield found


def _other_kind(spectrum: Spectrum, now: Fitted) -> Fitted:
    """Fit with another kind of response, if one is more likely."""
    if now.structure.kind == NONE:
        return now
    start = now.structure
    for kind in _KINDS:
        if kind != start.kind:
            now = _better(now, spectrum.fit(start.with_response(kind, min(start.bandwidth[0], _HIGHEST))))
    return now


def _replaced(spectrum: Spectrum, now: Fitted) -> Fitted:
    """Fit after all replacements that gain: another kind of response, components moved inside or after it."""
    for _ in range(3):
        before = now
        components = [FULL.first_oscillator + int(k) for k in now.structure.oscillators]
        components += [QUANTIZATION] if now.structure.active[QUANTIZATION] else []
        now = _other_kind(spectrum, _placed(spectrum, now, components))
        if now is before:
            break
    return now


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
        # Error of ln p; a component that is known better is needed.
        std = np.sqrt(np.diag(now.covariance)[: FULL.components]) * now.by_power
        shaped = np.arange(FULL.components) >= FULL.first_markov
        doubtful = structure.active & (shaped | (np.arange(FULL.components) == OUTSIDE))
        doubtful &= std > _DOUBTFUL * structure.power
        tried = [spectrum.fit(structure.without(int(k))) for k in np.flatnonzero(doubtful)]
        best = now
        for found in tried:
            best = _better(best, found)
        if best is now:
            return now
        now = best


def _slow(spectrum: Spectrum, now: Fitted) -> Fitted:
    """Fit with more Markov processes if these predict better (Akaike 1973), as their drifts differ."""
    for _ in range(2):
        starts = (
            now.structure.with_markov(max(spectrum.n**p, 20.0), float(np.median(now.mean))) for p in TIMES
        )
        tried = [spectrum.fit(start) for start in starts if start is not None]
        tried = [found for found in tried if _keeps_white(now, found)]
        best = min(tried, key=lambda found: found.loss, default=now)
        if best.loss > now.loss - _PREDICTS:
            break
        now = best
    return now
