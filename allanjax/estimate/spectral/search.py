"""Search for the structure of a spectrum: what it consists of besides the noise terms.

It opens with the best of all responses on a grid, around the peaks that stand out; then adds one component
after another; and at the end takes out what is not needed and swaps what may be another. Proposals are ranked
by fits of all powers with the shapes held, many models at a time; the best are fitted jointly.

A wide oscillator, white noise behind a filter and a Markov process of less than a sample have the same
spectrum; the order of the trials decides which of them is found. So no resonance may be wider than its
frequency, a response is tried in every round until there is one, and no correlation time is shorter than
eight samples.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Float

from allanjax.base.chi_squared import beyond_doubt
from allanjax.estimate.evidence import power_fits
from allanjax.estimate.spectral import components as kinds
from allanjax.estimate.spectral.fit import chi_squared, degrees_left
from allanjax.estimate.spectral.model import (
    FINE,
    LEAST_QUALITY,
    LINE,
    OUTSIDE,
    QUANTIZATION,
    ROUGH,
    WHITE,
    Component,
    Fitted,
    Spectrum,
    Structure,
    markov,
    model_error,
    resonance,
    response_of,
    wandering,
)
from allanjax.noise.terms import NoiseTerm
from allanjax.spectrum.cosine import Bins
from allanjax.spectrum.peaks import LOWEST, Peak, level_beside, peaks_of

# Least gain of a peak that is worth a proposal [nats].
_WORTH = 4.0
# Oscillators an octave that are proposed, and their quality factors; number of correlation times; and most
# components of a kind to which a search adds another one.
_OCTAVE, _QUALITIES, _TIMES = 8, (1.6, 3.5, 8.0), 20
_MOST_PEAKS, _MOST_MOVING, _MOST_PROCESSES = 12, 3, 4
# Gains [nats]: log odds of an addition, and of any other change, beyond a fit's tolerance; in likelihood by a
# slow process, of which two are the expected ones of its two parameters; and from which on a proposal is
# fitted jointly, less than its evidence costs.
_GAIN, _BETTER, _PREDICTS, _HOPEFUL = 1.0, 0.02, 3.0, 5.0
# Peaks that the search opens with, and the least gain [nats] and quality factor of one; peaks of a round; and
# quality factor above which a resonance is narrow, gain of a peak that is surely one.
_PEAKS, _CLEAR_PEAK, _SLIM, _MORE_PEAKS, _NARROW, _SURE = 8, 20.0, 3.0, 3, 8.0, 30.0
# Peaks that may move: least width, in that of a line; spread of one, in its width, and widths that it has
# then, at any moment; and width of a peak below it.
_BROADER, _HALF, _NARROWER, _UNDER = 4.0, 0.4, (0.3, 1.0), 4.0
# What a response has to gain in data that did not choose it [nats], and where no peaks make up for it.
_SHOWN, _CLEARLY_SHOWN = 10.0, 100.0
# Bins in an octave; and width of a resonance [coefficients] below which it is a line.
_PER_OCTAVE, _LINE = 12, 1.25 * LINE
# Kinds of responses: of low order, all, and those that a search opens with, the last ones if there is a deep
# stop band; orders that are tried beside one, and that from which on no low one is; corners that a response
# is tried with [cycles per sample], or in units of another one; the largest one to start from [radians per
# sample]; and the power above which a response has not fallen.
_LOW = (kinds.ONE_POLE, kinds.TWO_POLES, kinds.MEANS[0], kinds.BIQUAD, *kinds.BUTTERWORTH[:4])
_EVERY = (*_LOW, *kinds.MEANS[1:], *kinds.BUTTERWORTH[4:])
_OPENING = (kinds.ONE_POLE, kinds.TWO_POLES, kinds.MEANS[0], *kinds.BUTTERWORTH[1:3])
_STEEP = (kinds.MEANS[2], kinds.BUTTERWORTH[5])
_NEXT, _STEEPER = 2, 5
_BANDWIDTHS = np.geomspace(0.012, 0.42, 12)
_BESIDE, _HIGHEST, _FLAT = np.array([0.6, 0.75, 0.9, 1.0, 1.15, 1.4, 1.8]), 2.8, 0.98
# Samples from which on a mean starts with whole ones.
_SEVERAL = 3.0
# Correlation times that a slow process starts from, in powers of the number of samples.
_SLOW_TIMES = (0.35, 0.55, 0.75, 0.95)
# Proposals of a round whose powers are fitted, and of these the ones that are fitted jointly; and how far
# behind the best one [nats] a proposal may end to be followed.
_RANKED, _TRIED, _HOPELESS = 12, 3, 100.0
# How many edits of a model that fits are fitted jointly, how far behind the best one these may be, and what
# they have to gain [nats].
_LAST = 10, 1000.0, 0.5
# Most rounds of growing and editing.
_ROUNDS = 6
# Most components that are placed anew together.
_PLACED = 5
# Evidence that a resonance costs, a process or a response, and what follows it [nats]: rough values.
_PRICES = np.array([13.0, 9.0, 6.0])
# Share of its median below which a spectrum has a deep stop band.
_DEEP = 0.05
# Frequencies [radians per sample] and quality factors of resonances that may be taken for a filter's shape.
_EDGES, _ROUND = np.pi * np.geomspace(0.15, 0.95, 8), (2.0, 5.0)
# Difference of the logarithms of correlation times below which two processes are alike.
_SAME_TIME = 0.7
# Tolerance [nats] of fits that show what is worth a better one.
_GLANCE = 0.1
# Relative error of a power beyond which the fit is tried without it; and deviation of a smoothed level from
# its expectation, in standard deviations, beyond which a search begins.
_DOUBTFUL, _CLEAR = 0.2, 2.5


class Record(NamedTuple):
    """Squared cosine coefficients [rate²] of one record, without lines and ramps, and its rate [Hz].

    A further term may be used besides the basic ones.
    """

    squares: Float[np.ndarray, " n-1"]
    rate: float
    further: NoiseTerm | None = None

    @property
    def n(self) -> int:
        return len(self.squares) + 1

    def binned(self, structure: Structure) -> Spectrum:
        """Spectrum in bins that are finer around the resonances of a structure."""
        hertz = self.rate / (2.0 * np.pi)
        own = [structure.components[k] for k in structure.oscillators]
        around = [(c.frequency * hertz, c.quality) for c in own]
        return Spectrum.of(self.squares, bins_around(around, self.n, self.rate), self.further)


def bins_around(resonances: Sequence[tuple[float, float]], n: int, rate: float) -> Bins:
    """Bins of a record that are finer around resonances of these frequencies [Hz] and quality factors."""
    return Bins.of(n, rate, [(f, 2.0 * f / quality) for f, quality in resonances], _PER_OCTAVE)


def searched(record: Record, start: Structure) -> tuple[Spectrum, Fitted]:
    """Search from a start: the structure of the spectrum, and the binned spectrum to which it was fitted."""
    spectrum, now = refitted(record, start)
    edited: Fitted | None = None
    last: Fitted | None = None
    rivals: tuple[Fitted, ...] = ()
    if _lacks_response(spectrum, now):
        spectrum, now = _opened(record, now)
    # Editing may take back what growing added, again and again, as levels are weighed anew.
    for _ in range(_ROUNDS):
        while (grown := _grown(record, spectrum, now)) is not None:
            spectrum, now = grown
        if now is edited:
            break
        now = _edited(spectrum, now, _peaks_that_may_move)
        found = _edited(spectrum, now, _edits)
        now = pruned(spectrum, found)
        # Levels count as little as befits the peaks that are left.
        spectrum = spectrum.weighing(now)
        now = edited = spectrum.again(now)
        rivals = found.rivals
        if last is not None and now.evidence <= spectrum.again(last).evidence:
            break
        last = now
    return spectrum, now._replace(rivals=tuple(map(spectrum.again, rivals)))


def narrow(structure: Structure, n: int) -> list[int]:
    """Resonances of a structure of n samples that are as narrow as lines."""
    return [k for k in structure.oscillators if structure.components[k].width < _LINE * np.pi / n]


def refitted(record: Record, start: Structure) -> tuple[Spectrum, Fitted]:
    """Structure fitted anew without superfluous components, and the spectrum to which it was fitted."""
    spectrum = record.binned(start)
    if not start.there:
        unit = spectrum.units(start, start.components)
        start = start.with_powers(np.min(spectrum.rough / unit, axis=1).tolist())
    rough = spectrum.fit(start)
    spectrum = spectrum.weighing(rough)
    return spectrum, pruned(spectrum, spectrum.fit(rough.structure))


def in_full(spectrum: Spectrum, now: Fitted) -> tuple[Spectrum, Fitted]:
    """Spectrum whose levels have their full weight, and the fit to it, if that explains them."""
    full = spectrum.with_full_weight(now)
    again = full.fit(now.structure)
    return (full, again) if _excess(full, again) <= 0.0 else (spectrum, now)


def completed(record: Record, spectrum: Spectrum, now: Fitted, slow: bool = True) -> tuple[Spectrum, Fitted]:
    """Final fit with the slow processes that predict best, without idle components.

    A search trusts levels less where a filter has fallen, as real filters differ from the model. Only these
    levels tell what enters before the filter and what after it. If some model fits them with their full
    weight, it is edited once more.
    """
    compared, now = now, pruned(spectrum, _slow(spectrum, now)) if slow else now
    of, fits = spectrum, False
    if (exact := _exact(record, spectrum, now)) is not None:
        of, again = exact
        compared = again = _edited(of, pruned(of, again), functools.partial(_edits, together=True), *_LAST)
        now, fits = (again, True) if _excess(of, again) <= 0.0 else (now, False)
    if fits:
        spectrum = of.with_full_weight(now)
    elif of.bins is not spectrum.bins:
        finer = record.binned(now.structure)
        spectrum = finer.weighing(finer.fit(now.structure))
    now = pruned(spectrum, spectrum.fit(now.structure))
    # What is not needed may show only without the idle ones.
    now = pruned(spectrum, spectrum.fit(now.structure.without(*_idle(now.structure))))
    return spectrum, spectrum.fit(now.structure, FINE)._replace(doubt=_doubt(of, compared))


def shows_response(halves: Sequence[Record], structure: Structure) -> bool:
    """Whether each half of a record predicts the other one better with the structure's response than without.

    Levels beside its peaks count less: no peak is just like the model's, and a response may mend its flanks.
    """
    fits = [refitted(half, structure) for half in halves]
    judges = []
    for (spectrum, fit), other in zip(fits, halves[::-1], strict=True):
        error = model_error(fit.structure, fit.maximum, spectrum.bins) + spectrum.error
        judges.append(other.binned(structure).with_error(error))

    def gain_over(rivals: Sequence[Fitted]) -> float:
        each = zip(judges, fits, rivals, strict=True)
        return sum(judge.loss_of(rival) - judge.loss_of(fit) for judge, (_, fit), rival in each)

    rivals = [spectrum.fit(structure.without_response()) for spectrum, _ in fits]
    if gain_over(rivals) > _CLEARLY_SHOWN:
        return True
    # Peaks may move instead.
    both = zip(fits, rivals, strict=True)
    return gain_over([_edited(own, rival, _peaks_that_may_move) for (own, _), rival in both]) > _SHOWN


def without_response(record: Record, last: Fitted) -> tuple[Spectrum, Fitted]:
    """Final fit of a structure without its response, with peaks that move where these explain more.

    White noise keeps the doubt of the fit with the response.
    """
    spectrum, now = refitted(record, last.structure.without_response())
    now = pruned(spectrum, _slow(spectrum, _edited(spectrum, now, _peaks_that_may_move)))
    final = spectrum.fit(now.structure.without(*_idle(now.structure)), FINE)
    return spectrum, final._replace(doubt=last.doubt)


def _exact(record: Record, spectrum: Spectrum, now: Fitted) -> tuple[Spectrum, Fitted] | None:
    """Spectrum in which all levels have their full weight, and the model that fits it; None if none does.

    Where a model does not fit, others are tried while they halve the misfit: with its components in other
    places, with another filter, and with one component more.
    """
    full = spectrum.with_full_weight(now)
    fit = full.fit(now.structure)
    while (left := _excess(full, fit)) > 0.0 and fit.structure.kind != kinds.NONE:
        # Real filters that do not fall far differ from the models by as much as other models do.
        nearby = _nearby(record, full, fit) if _floor(spectrum) else ()
        better = (found for found in nearby if _excess(*found) < 0.5 * left)
        if (found := next(iter(better), None)) is None:
            return None
        full, fit = found
    return full, fit


def _nearby(record: Record, spectrum: Spectrum, now: Fitted) -> Iterator[tuple[Spectrum, Fitted]]:
    """Other models, and spectra with their full weight."""
    structure = now.structure
    for groups in (_placements(spectrum, structure), _others(structure, structure.corner, _EVERY)):
        for tried in _ranked(spectrum, groups)[:_TRIED]:
            fit = spectrum.fit(tried)
            full = spectrum.with_full_weight(fit)
            yield full, full.fit(fit.structure)
    if (found := _grown(record, spectrum, now, exact=True)) is not None:
        yield found


def _doubt(spectrum: Spectrum, best: Fitted) -> float:
    """Relative standard deviation of white noise over a fit and its rivals, by Akaike's weights.

    The evidence is not used here: it penalizes a component by the width of its prior. That decides whether
    the component is reported, but the interval has to allow for it if the data do.
    """
    # Several proposals may have become the same model.
    found = {_what(f.structure): f for f in sorted(best.rivals, key=lambda f: f.evidence)}
    found.pop(_what(best.structure), None)
    fits = [best, *(f for f in found.values() if _keeps_white(best, f) and np.isfinite(f.loss))]
    white = np.array([_white(spectrum, f.structure) for f in fits])
    costs = np.array([f.loss + np.count_nonzero(f.maximum.interior) for f in fits])
    odds = np.where(white > 0.0, np.exp(np.min(costs) - costs), 0.0)
    ratio = np.log(np.maximum(white, 1e-300) / max(white[0], 1e-300))
    return 0.5 * math.sqrt(float(odds @ np.where(odds > 0.0, ratio, 0.0) ** 2 / max(odds.sum(), 1e-300)))


def _what(structure: Structure) -> tuple[kinds.Kind, frozenset[tuple[float, ...]]]:
    """What a structure consists of: the kind of response, and the components with their places."""
    own = (structure.components[k] for k in structure.there)
    return structure.kind, frozenset(
        (c.kind, c.which, c.inside, *(round(x, 1) for x in c.shape[:1])) for c in own
    )


def _white(spectrum: Spectrum, structure: Structure) -> float:
    """Level of all that is white at low frequencies [rate²]."""
    own = [
        c
        for c in structure.components
        if _is(c, WHITE, OUTSIDE)
        or (c.oscillates and c.quality < kinds.BROAD)
        or (c.kind == kinds.MARKOV and c.time < kinds.QUICK)
    ]
    return float(np.array([c.power for c in own]) @ spectrum.units(structure, own)[:, 0]) if own else 0.0


def _excess(spectrum: Spectrum, fitted: Fitted) -> float:
    """By how much χ² of the levels of a spectrum about a fit exceeds what chance explains."""
    dof = 2.0 * spectrum.levels.shape
    degrees = degrees_left(dof, np.sum(fitted.maximum.interior))
    return chi_squared(spectrum.levels.level / fitted.mean, dof) - float(beyond_doubt(degrees))


def _idle(structure: Structure) -> list[int]:
    """Components without power, besides white noise."""
    return [k for k, c in enumerate(structure.components) if c.power <= 0.0 and not _is(c, WHITE)]


def _is(component: Component, *columns: int) -> bool:
    """Whether a component is one of these columns."""
    return component.kind == kinds.COLUMN and component.which in columns


def _opened(record: Record, plain: Fitted) -> tuple[Spectrum, Fitted]:
    """The best of fits with some response, and without any, to all peaks that stand out."""
    structure, level = plain.structure, level_beside(record.squares)
    for peak in peaks_of(record.squares, level, 2 * _PEAKS):
        if peak.gain > _CLEAR_PEAK and peak.slimness > _SLIM and len(structure.oscillators) < _PEAKS:
            structure = structure.plus(_resonance_at(peak, level))
    spectrum = record.binned(structure)
    tried = _ranked(spectrum, _responses(spectrum, structure))
    fits = [spectrum.fit(s, _GLANCE) for s in (structure, *tried[:2])]
    finer = spectrum.weighing(max(fits, key=lambda f: f.evidence))
    best = max((finer.fit(f.structure) for f in fits), key=lambda f: f.evidence)
    now = pruned(finer, best)
    return finer, _settled(finer, now, now.structure.oscillators, now.structure.kind != plain.structure.kind)


def _lacks_response(spectrum: Spectrum, now: Fitted) -> bool:
    """Whether there is no response, and levels that are averaged over half an octave or more deviate."""
    excess, deviation = spectrum.levels.shape * (spectrum.levels.level / now.mean - 1.0), 0.0
    for width in (6, 12, 24, 48):
        total, weight = (np.convolve(x, np.ones(width), "valid") for x in (excess, spectrum.levels.shape))
        deviation = max(deviation, float(np.max(abs(total) / np.sqrt(np.maximum(weight, 1.0)))))
    return now.structure.kind == kinds.NONE and deviation > _CLEAR


def _responses(spectrum: Spectrum, structure: Structure) -> list[list[Structure]]:
    """Structures with a response, by its kind, inside which all resonances are, or after it."""
    # Without white noise after it the depth of a deep stop band would decide what the response is.
    floor = _floor(spectrum)
    if floor and structure.place(OUTSIDE) is None:
        structure = structure.with_column(OUTSIDE, floor)
    places, opening = (structure, _all_placed(structure, True)), _OPENING + (_STEEP if floor else ())
    return _filtered(places, opening, 2.0 * np.pi * _BANDWIDTHS)


def _filtered(
    structures: Iterable[Structure], responses: Sequence[kinds.Kind], corners: Float[np.ndarray, " k"]
) -> list[list[Structure]]:
    """Those structures that differ with each other response of these corners, by its kind."""
    different = {s.components: s for s in structures}.values()
    return [
        [
            s.with_response(kind, w)
            for s in different
            for w in _starts(kind, corners)
            if kind != s.kind or abs(w / s.corner - 1.0) > 1e-6
        ]
        for kind in responses
    ]


def _starts(kind: kinds.Kind, corners: Float[np.ndarray, " k"]) -> list[float]:
    """Corners to start from: those of means over whole samples, since their zeros fit or do not."""
    if not kind.is_mean:
        return corners.tolist()
    samples = kind.of_one_sample / corners
    return (kind.of_one_sample / np.unique(np.where(samples < _SEVERAL, samples, np.rint(samples)))).tolist()


def _kinds(kind: kinds.Kind) -> list[kinds.Kind]:
    """Kinds to try in place of one: steep ones, and several means, beside one that is steep or a mean."""
    own = kinds.MEANS if kind.is_mean or kind.order > 1 else ()
    if kind in kinds.BUTTERWORTH[_NEXT:]:
        own += kinds.BUTTERWORTH[kind.order - _NEXT - 1 : kind.order + _NEXT]
    return list(dict.fromkeys((*_LOW, *own) if kind.order < _STEEPER else own))


def _others(
    structure: Structure, corner: float, responses: Sequence[kinds.Kind] = ()
) -> list[list[Structure]]:
    """Structures with another response of about this corner [radians per sample], by its kind."""
    rounded = structure.column(QUANTIZATION)
    moved = structure.placed([structure.place(QUANTIZATION)], not rounded.inside)
    places = structure, moved, _all_placed(structure, True), _all_placed(structure, False)
    return _filtered(places, responses or _kinds(structure.kind), np.minimum(corner * _BESIDE, _HIGHEST))


def _all_placed(structure: Structure, inside: bool) -> Structure:
    """Structure with all resonances and quantization inside the response, or after it."""
    return structure.placed([structure.place(QUANTIZATION), *structure.oscillators], inside)


def _ranked(
    spectrum: Spectrum, groups: Sequence[Sequence[Structure]], behind: float = np.inf
) -> list[Structure]:
    """The best structure of each group by fits of their powers with shapes held, the best one first.

    Without those that are farther `behind` the best one [nats].
    """
    every = [s for group in groups for s in group]
    if not every:
        return []
    levels, most = spectrum.levels, max(len(s.components) for s in every)
    unit, power = np.ones((len(every), most, len(spectrum.rough))), np.zeros((len(every), most))
    used = np.zeros(power.shape, bool)
    spectrum.know(every)
    for k, s in enumerate(every):
        own = slice(len(s.components))
        unit[k, own], used[k, own] = spectrum.units(s, s.components), True
        # The noise before a response is about what it is without.
        power[k, own] = [c.power for c in s.components]
    power, loss = power_fits(
        levels.level, levels.shape, spectrum.rough, unit, power, used, far=_HOPELESS, tolerance=ROUGH
    )
    loss += [_price(s) for s in every]
    best, first = [], 0
    for group in groups:
        k = first + int(np.argmin(loss[first : first + len(group)]))
        best.append((loss[k], every[k].with_powers(power[k, : len(every[k].components)].tolist())))
        first += len(group)
    best.sort(key=lambda pair: pair[0])
    return [s for loss, s in best if loss <= best[0][0] + behind]


def _price(structure: Structure) -> float:
    """About what the components of a structure cost in evidence [nats]."""
    filtered, rounded = structure.kind != kinds.NONE, structure.place(QUANTIZATION) is not None
    shaped = len(structure.of_kind(kinds.MARKOV)) + filtered
    added = structure.place(OUTSIDE) is not None
    beside = added + filtered * rounded * (0.5 + structure.column(QUANTIZATION).inside)
    return float(_PRICES @ (len(structure.oscillators), shaped, beside))


def _grown(
    record: Record, spectrum: Spectrum, now: Fitted, exact: bool = False
) -> tuple[Spectrum, Fitted] | None:
    """The best of all additions, fitted in bins that are made for it; None if none gains enough.

    `exact`: whether levels have their full weight.
    """
    for proposal in _additions(record, spectrum, now):
        best = spectrum.fit(proposal, _GLANCE)
        if best.evidence < now.evidence - 1.0 or not _keeps_white(now, best):
            continue
        finer = record.binned(best.structure)
        again = finer.fit(best.structure, np.inf)
        # Whatever is added has to show where the filter has not fallen, lest it mends the filter's shape.
        same = best.structure.kind == now.structure.kind
        if exact:
            # A wide resonance would mend the filter's shape.
            new = again.structure.components[len(now.structure.components) :]
            if any(c.oscillates and c.quality < kinds.WIDE for c in new):
                continue
            plain = finer = finer.with_full_weight(again)
        else:
            plain, finer = finer.weighing(again), finer.weighing(again, filters=same)
        again, before = finer.fit(again.structure), finer.fit(now.structure)
        if again.evidence - before.evidence > _GAIN and _keeps_white(now, again):
            again, count = plain.fit(again.structure) if same else again, len(now.structure.components)
            return plain, _settled(
                plain, again, [k for k in again.structure.oscillators if k >= count], not same
            )
    return None


def _additions(record: Record, spectrum: Spectrum, now: Fitted) -> list[Structure]:
    """Structures with one component more, or with several narrow resonances, the most promising first."""
    structure, inside = now.structure, now.structure.kind != kinds.NONE
    resonances = _MOST_PEAKS - len(structure.oscillators)
    processes = _MOST_PROCESSES - len(structure.of_kind(kinds.MARKOV))
    level = at_all(spectrum, now)
    left = peaks_of(record.squares, level, _MORE_PEAKS) if resonances else []
    left = [peak for peak in left if peak.gain > _WORTH]
    proposals = [_resonance_at(peak, level, inside) for peak in left]
    found = zip(left, proposals, strict=True)
    sure = [new for peak, new in found if peak.slimness > _NARROW and peak.gain > _SURE]
    proposals += _oscillators(spectrum.n, inside) if resonances else []
    if processes:
        proposals += [
            markov(time, 1.0) for time in np.geomspace(kinds.QUICK, spectrum.n / 4.0, _TIMES).tolist()
        ]
    if inside and structure.place(OUTSIDE) is None:
        proposals.append(Component(kinds.COLUMN, 1.0, which=OUTSIDE))
    gain, power = _promised(spectrum, now, spectrum.units(structure, proposals))
    best: list[Component] = []
    for k in np.argsort(-gain)[: np.count_nonzero(gain > _HOPEFUL)].tolist():
        if len(best) < _RANKED and not any(_alike(proposals[k], other) for other in best):
            best.append(proposals[k]._replace(power=float(power[k])))
    groups = [[structure.plus(new)] for new in best]
    if _lacks_response(spectrum, now):
        groups += _responses(spectrum, structure)
    together = [structure.plus(*sure[:resonances])] * (len(sure) > 1)
    return together + _ranked(spectrum, groups)[:_TRIED]


def _alike(one: Component, other: Component) -> bool:
    """Whether a joint fit of one component is likely to end where that of the other one does."""
    if one.kind != other.kind or not one.shape:
        return False
    if one.kind == kinds.MARKOV:
        return abs(one.shape[0] - other.shape[0]) < _SAME_TIME
    return abs(one.frequency - other.frequency) < min(one.width, other.width)


def _resonance_at(peak: Peak, level: Float[np.ndarray, " n-1"], inside: bool = False) -> Component:
    n = len(level) + 1
    quality = float(np.clip(peak.slimness, 2.0, max(peak.middle / LINE / 2.0, 2.0)))
    # The excess is about as large as the level, over the window.
    power = float(level[int(peak.middle) - 1]) * peak.width / n
    return resonance(np.pi * peak.middle / n, quality, power, inside)


def _oscillators(n: int, inside: bool) -> list[Component]:
    """Oscillators of unit power on a grid of their shapes."""
    lowest = LOWEST * np.pi / n
    places = np.geomspace(lowest, 0.97 * np.pi, int(np.log2(np.pi / lowest) * _OCTAVE)).tolist()
    return [resonance(w, Q, 1.0, inside) for w in places for Q in _QUALITIES]


def _promised(
    spectrum: Spectrum, now: Fitted, rows: Float[np.ndarray, "proposals m"]
) -> tuple[Float[np.ndarray, " proposals"], Float[np.ndarray, " proposals"]]:
    """Gain [nats] that the score test promises each component beside a fit, and its power then."""
    k, y = spectrum.levels.shape, spectrum.levels.level
    mean, maximum = now.mean, now.maximum
    relative = rows / mean
    g = relative @ (k * (y / mean - 1.0))
    interior = np.flatnonzero(maximum.interior)
    slope = maximum.slope[interior]
    F = maximum.information[np.ix_(interior, interior)]
    size = 1.0 / np.sqrt(np.maximum(np.diag(F), 1e-12))
    cross = (relative * k) @ (slope * size[:, None]).T
    alone = relative**2 @ k
    scaled = F * np.outer(size, size) + 1e-9 * np.eye(len(F))
    left = alone - np.einsum("cp,cp->c", cross, np.linalg.solve(scaled, cross.T).T)
    left = np.maximum(left, 1e-6 * alone)
    power = np.maximum(g, 0.0) / left
    return 0.5 * np.maximum(g, 0.0) * power, power


def _floor(spectrum: Spectrum) -> float:
    """Lowest level of a spectrum that falls to a small part of itself, else zero."""
    floor = float(np.min(spectrum.rough))
    return floor if floor < _DEEP * float(np.median(spectrum.rough)) else 0.0


def _edited(
    spectrum: Spectrum,
    now: Fitted,
    edits: Callable[[Spectrum, Structure], Iterable[list[Structure]]],
    most: int = _TRIED,
    behind: float = np.inf,
    least: float = _BETTER,
) -> Fitted:
    """Fit after all edits of the structure that gain, of groups of which the best one is fitted jointly.

    Its rivals are the fits of the last round.
    """
    while True:
        tried = _ranked(spectrum, [group for group in edits(spectrum, now.structure) if group], behind)[:most]
        rivals = [*map(spectrum.fit, tried)]
        best = functools.reduce(_better, rivals, now)
        if best is now or best.evidence < now.evidence + least:
            return now._replace(rivals=tuple(rivals))
        now = best


def _settled(spectrum: Spectrum, now: Fitted, new: Sequence[int], other: bool) -> Fitted:
    """Fit with new resonances inside the response or after it, and the best kind of another response."""

    def edits(_: Spectrum, structure: Structure) -> Iterator[list[Structure]]:
        yield from _moved(structure, [structure.place(QUANTIZATION), *new] if other else new)
        yield from _others(structure, structure.corner) if other else ()

    return _edited(spectrum, now, edits)


def _edits(spectrum: Spectrum, structure: Structure, together: bool = False) -> Iterator[list[Structure]]:
    """Structures with another response or none, one component elsewhere, or one as something else.

    There may be white noise after a response. A wide resonance may be a Markov process, this white noise, or
    the response itself, which a quick process may be, too; quantization behind a filter, white noise there,
    or the shape of that filter or of a resonance. Several may also be in other places `together`.
    """
    filtered, corner = structure.kind != kinds.NONE, structure.corner
    own, rounded = structure.components, structure.place(QUANTIZATION)
    if filtered:
        yield [structure.without_response()]
        yield from _others(structure, corner)
        yield from _moved(structure, [rounded, *structure.oscillators])
        if structure.place(OUTSIDE) is None:
            yield [structure.with_column(OUTSIDE, float(np.min(spectrum.rough)))]
    else:
        yield from _responses(spectrum, structure)
    rests = []
    if quick := [k for k in structure.of_kind(kinds.MARKOV) if own[k].time < kinds.QUICK]:
        rests.append((structure.without(*quick), corner))
    if filtered and rounded is not None and own[rounded].power > 0.0:
        rest = structure.without(rounded)
        rests.append((rest, corner))
        yield [rest.with_column(OUTSIDE, float(np.min(spectrum.rough)))]
        wide = [rest.plus(resonance(w, Q, 0.0, False)) for w in _EDGES for Q in _ROUND]
        yield from _filtered(wide, _OPENING, np.minimum(corner * _BESIDE, _HIGHEST))
    for k in structure.oscillators:
        if own[k].quality < kinds.WIDE:
            w, rest, power = own[k].frequency, structure.without(k), own[k].power
            rests.append((rest, corner if filtered else w))
            yield [rest.plus(markov(1.0 / w, power))]
            yield [rest.with_column(OUTSIDE, _floor(spectrum) or power)] if filtered else []
    for rest, corner in rests:
        yield [rest]
        yield from _others(rest, corner)
    if together:
        yield [s for (s,) in _placements(spectrum, structure)]


def _peaks_that_may_move(spectrum: Spectrum, structure: Structure) -> Iterator[list[Structure]]:
    """Structures in which neighbouring peaks, or one, are a resonance whose frequency is spread."""
    own, least = structure.components, _BROADER * LINE * np.pi / spectrum.n
    places = sorted(structure.oscillators, key=lambda k: own[k].frequency)
    places = [k for k in places if own[k].width > least and own[k].power > 0.0]
    if len(structure.of_kind(kinds.WANDERING)) >= _MOST_MOVING:
        return
    for first, k in enumerate(places):
        run = [k]
        if own[k].kind == kinds.OSCILLATOR:
            yield _as_one(structure, run)
        else:
            one = resonance(own[k].frequency, max(own[k].quality, LEAST_QUALITY), own[k].power, own[k].inside)
            yield [structure.without(k).plus(one)]
        for beside in places[first + 1 :]:
            if not own[run[-1]].is_close_to(own[beside]):
                break
            run.append(beside)
            yield _as_one(structure, run)


def _as_one(structure: Structure, run: Sequence[int]) -> list[Structure]:
    """Structures in which some peaks are one whose frequency is spread by as much.

    A broad one may be below it, which the flanks of the others hid.
    """
    several = [structure.components[k] for k in run]
    power, place, width = np.array([(c.power, c.frequency, c.width) for c in several]).T
    share, inside = power / power.sum(), several[int(np.argmax(power))].inside
    w, mean_width = float(share @ place), float(share @ width)
    spread = math.sqrt(float(share @ ((place - w) ** 2 + (_HALF * width) ** 2)))
    narrow, wide = (max(w / (narrower * mean_width), kinds.WIDE) for narrower in _NARROWER)
    broad = max(w / (_UNDER * (mean_width + spread)), LEAST_QUALITY)
    rest, total = structure.without(*run), float(power.sum())
    one, other = (rest.plus(wandering(w, quality, spread, total, inside)) for quality in (narrow, wide))
    return [one, other, one.plus(resonance(w, broad, total, inside))]


def _moved(structure: Structure, places: Iterable[int | None]) -> Iterator[list[Structure]]:
    """Structures with one of these components inside the response if it is after it, or after it."""
    for k in _movable(structure, places):
        yield [structure.placed([k], not structure.components[k].inside)]


def _movable(structure: Structure, places: Iterable[int | None]) -> list[int]:
    """Those of these components for which it makes a difference whether they are inside the response."""
    if (response := response_of(structure, 2.0 * np.pi)) is None:
        return []
    found = []
    for k in (k for k in places if k is not None):
        own = structure.components[k]
        # Where the response has not fallen yet there is no difference.
        top = own.frequency + own.width if own.oscillates else np.pi
        if float(response.power(min(top, np.pi), 2.0 * np.pi)) < _FLAT:
            found.append(k)
    return found


def _placements(spectrum: Spectrum, structure: Structure) -> list[list[Structure]]:
    """Other choices of what is inside the response, with white noise after it or without."""
    every = [structure]
    for k in _movable(structure, [structure.place(QUANTIZATION), *structure.oscillators])[:_PLACED]:
        every += [s.placed([k], not structure.components[k].inside) for s in every]
    outside, floor = structure.place(OUTSIDE), float(np.min(spectrum.rough))
    every += [s.with_column(OUTSIDE, floor) if outside is None else s.without(outside) for s in every]
    return [[s] for s in every[1:]]


def _better(now: Fitted, other: Fitted) -> Fitted:
    """The other fit if it is more likely and still has white noise."""
    return other if other.evidence > now.evidence + _BETTER and _keeps_white(now, other) else now


def _keeps_white(now: Fitted, other: Fitted) -> bool:
    """Whether a fit has white noise, or lacks it without a wide resonance or another response in its place.

    White noise before a filter has the same spectrum as a response with wide resonances.
    """
    structure = other.structure
    if structure.column(WHITE).power > 0.0:
        return True
    narrow = all(structure.components[k].quality > kinds.WIDE for k in structure.oscillators)
    return narrow and structure.kind == now.structure.kind


def pruned(spectrum: Spectrum, now: Fitted) -> Fitted:
    """Fit without components that gain nothing; white noise stays."""
    while True:
        structure, own = now.structure, now.structure.components
        # Terms without power get a limit.
        if idle := [k for k in _idle(structure) if not _is(own[k], *range(OUTSIDE))]:
            now = spectrum.fit(structure.without(*idle))
            continue
        # Components whose power is known better than `_DOUBTFUL` stay without a trial.
        std = np.sqrt(np.diag(now.covariance))
        judged = (OUTSIDE, QUANTIZATION) if structure.kind != kinds.NONE else (OUTSIDE,)
        doubt = {
            k: -std[k] / own[k].power
            for k in structure.there
            if (own[k].kind != kinds.COLUMN or _is(own[k], *judged)) and std[k] > _DOUBTFUL * own[k].power
        }
        weakest = sorted(doubt, key=doubt.__getitem__)[:2]
        if structure.kind.is_mean:
            # After a mean over less than two samples they make one of another duration.
            after = structure.place(QUANTIZATION), structure.place(OUTSIDE)
            weakest += [k for k in after if k in structure.there and k not in weakest]
        best = functools.reduce(_better, (spectrum.fit(structure.without(k)) for k in weakest), now)
        if best is now:
            return now
        now = best


def _slow(spectrum: Spectrum, now: Fitted) -> Fitted:
    """Fit with further Markov processes if these predict better (Akaike 1973).

    Slow terms are hardly distinguished by the evidence, but differ in the drift that they predict.
    """
    for _ in range(2):
        fits = [f for f in with_process(spectrum, now.structure) if _keeps_white(now, f)]
        best = min(fits, key=lambda found: found.loss, default=now)
        if best.loss > now.loss - _PREDICTS:
            break
        now = best
    return now


def with_process(spectrum: Spectrum, structure: Structure) -> list[Fitted]:
    """Fits with another Markov process, slower than filtered white noise, from the best start values."""
    level = float(np.median(spectrum.rough))
    starts = [[structure.plus(markov(max(spectrum.n**p, kinds.QUICK), level))] for p in _SLOW_TIMES]
    return [spectrum.fit(s) for s in _ranked(spectrum, starts)[:2]]


def at_all(spectrum: Spectrum, fitted: Fitted) -> Float[np.ndarray, " n-1"]:
    """Expected squares of all coefficients, interpolated between the bins."""
    return at_some(spectrum, fitted, np.arange(1.0, spectrum.n))


def at_some(spectrum: Spectrum, fitted: Fitted, places: Float[ArrayLike, "*k"]) -> Float[np.ndarray, "*k"]:
    """Expected squares of the coefficients at these places, from 1."""
    edges = spectrum.bins.edges
    middle = np.log(0.5 * (edges[:-1] + edges[1:] - 1))
    return np.exp(np.interp(np.log(places), middle, np.log(fitted.mean)))
