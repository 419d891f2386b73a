"""Extension of a fit by what a sensor has besides noise terms: a filter, resonances, and lines.

They are sought in the spectrum of each axis whose plain terms do not fit, and fitted jointly with them.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from allanjax.estimate.axis_fits import fit_spectrum
from allanjax.estimate.deterministic import (
    AxisSpectrum,
    Cosines,
    InUse,
    Line,
    Samples,
    lines_of,
    take_out_lines,
    without_lines,
)
from allanjax.estimate.misfit import misfit_of
from allanjax.estimate.result import AxisFit
from allanjax.estimate.selection import AxisSelection, candidates_in_record, rank_terms
from allanjax.estimate.spectral import search
from allanjax.estimate.spectral.as_model import term_of
from allanjax.estimate.spectral.components import MARKOV, NONE
from allanjax.estimate.spectral.model import (
    FIXED,
    LINE,
    OUTSIDE,
    QUANTIZATION,
    Component,
    Fitted,
    Spectrum,
    Structure,
    peak_of,
    response_of,
)
from allanjax.estimate.spectral.search import Record
from allanjax.noise.model import Model
from allanjax.noise.terms import (
    NoiseTerm,
    PowerLaw,
    Resonance,
    Sinusoid,
    WanderingResonance,
    basic_terms,
)
from allanjax.record.recording import Axis
from allanjax.record.units import SENSORS
from allanjax.spectrum.cosine import cosine_transform, fast_length, ramp_column
from allanjax.spectrum.peaks import MEDIAN, lines_in

# Coefficients on either side of a line that contain its power, and that are inspected.
_CORE, _LINE_AROUND = 4, 40
# Share of the excess there in a line's core; log odds of a peak in white noise; number of peaks tried, and of
# searches, each after removal of the lines found before; and least distance of two lines [coefficients].
_NEARLY_ALL, _SURE, _TRIED, _LOOKS, _APART = 0.9, 10.0, 64, 3, 1.5
# Most fits until every component of the model is detected, and the growth of the discrepancy, relative and
# absolute, that the removal of what is not detected may cause: judgements.
_ROUNDS, _WORSE, _SLIGHT = 6, 1.2, 0.001
# Share of the discrepancy that must be removed, and fewest samples for a search.
_LESS, _SHORTEST = 0.5, 1024
# Most lines that are fitted: more are a comb, as of pulses, which are outliers.
_MOST_LINES = 32
# Log prior odds that another axis of a sensor has the same kind of filter [nats]: a judgement, twenty to one.
_COMMON = 3.0


class Content(NamedTuple):
    """Components of the spectrum of samples x without mean, its lines, and the spectrum in bins.

    The coefficients c are as `take_out_lines` leaves them; `doubt` is a relative error of N, see `Fitted`.
    """

    x: Samples
    structure: Structure
    lines: tuple[Line, ...]
    spectrum: Spectrum
    c: Cosines
    doubt: float

    @classmethod
    def of(cls, x: Samples, rate: float, c: Cosines, lines: tuple[Line, ...]) -> Content:
        """Components of the spectrum of these samples, of which these lines are known."""
        record = Record(without_lines(c, lines, rate) ** 2, rate)
        spectrum, found = search.searched(record, Structure.plain(list(range(len(FIXED)))))
        if sharp := search.narrow(found.structure, len(x)):
            own, rest = found.structure.components, found.structure.without(*sharp)
            more = [own[k].frequency * rate / (2.0 * np.pi) for k in sharp]
            c, lines = _with_more_lines(x, rate, lines, more)
            record = Record(without_lines(c, lines, rate) ** 2, rate)
            spectrum, found = search.searched(record, search.refitted(record, rest)[1].structure)
        spectrum, last = search.completed(record, spectrum, found)
        if last.structure.kind != NONE:
            halves = _halves(x, rate, lines)
            if not search.shows_response(halves, last.structure):
                spectrum, last = search.without_response(record, last)
        structure = last.structure.without(*search.narrow(last.structure, len(x)))
        return cls(x, structure, lines, spectrum, c, last.doubt)

    @property
    def rest(self) -> Cosines:
        """The coefficients without the lines."""
        return without_lines(self.c, self.lines, self.spectrum.bins.rate)

    @property
    def plain_terms(self) -> list[int]:
        """Components with some power that are basic terms or Markov processes before the response, if any."""
        of = self.structure
        plain = [*of.of_kind(MARKOV), *map(of.place, range(OUTSIDE))]
        return [k for k in of.there if k in plain and (of.kind == NONE or of.components[k].inside)]


def _halves(x: Samples, rate: float, lines: Sequence[Line]) -> list[Record]:
    """Squared coefficients of both halves of a record without its lines."""
    half, found = fast_length(len(x) // 2), list[Record]()
    known = [(line.frequency, False) for line in lines]
    for part in (x[:half], x[-half:]):
        c, own = take_out_lines(part - part.mean(), rate, known)
        found.append(Record(without_lines(c, own, rate) ** 2, rate))
    return found


def _conspicuous(square: Cosines, rate: float) -> list[float]:
    """Frequencies of peaks that are as narrow as lines and far above their surroundings [Hz]."""
    n, found = len(square) + 1, list[float]()
    sure = 2.0 * (np.log(n) + _SURE)
    for j in lines_in(square, _TRIED):
        around = square[max(j - 1 - _LINE_AROUND, 0) : j + _LINE_AROUND]
        level = float(np.median(around)) / MEDIAN
        core = square[max(j - 1 - _CORE, 0) : j + _CORE] - level
        if square[j - 1] > sure * level and core.sum() > _NEARLY_ALL * (around - level).sum():
            found.append(j * rate / (2.0 * n))
    return found


def _conspicuous_lines(x: Samples, rate: float) -> tuple[Cosines, tuple[Line, ...]]:
    """Coefficients and conspicuous lines of samples; see `take_out_lines`."""
    c, lines = cosine_transform(x), tuple[Line, ...]()
    for _ in range(_LOOKS):
        if not (more := _conspicuous(without_lines(c, lines, rate) ** 2, rate)):
            break
        c, lines = _with_more_lines(x, rate, lines, more)
    return c, lines


def _with_more_lines(
    x: Samples, rate: float, lines: Sequence[Line], more: Sequence[float]
) -> tuple[Cosines, tuple[Line, ...]]:
    """Coefficients and lines, of which there are more near these frequencies [Hz]; see `take_out_lines`."""
    return take_out_lines(x, rate, [(f, False) for f in (*(line.frequency for line in lines), *more)])


def content_of(x: Samples, rate: float, plain: AxisFit) -> Content | None:
    """Components of the spectrum of an axis's samples at a rate [Hz] besides the plain terms.

    There are none to be sought if the plain terms fit and no line stands out, or far too many do.
    """
    if len(x) < _SHORTEST:
        return None
    x = x[: fast_length(len(x))]
    x = x - x.mean()
    c, lines = _conspicuous_lines(x, rate)
    # Among many coefficients of one level a line may not show.
    if len(lines) > _MOST_LINES or (plain.converged and not plain.discrepancy > 0.0 and not lines):
        return None
    content = Content.of(x, rate, c, lines)
    of = content.structure
    besides = of.kind != NONE or of.oscillators or of.of_kind(MARKOV) or content.lines
    # Without plain terms nothing is to be corrected.
    return content if besides and content.plain_terms else None


def with_common_filters(contents: Sequence[Content | None], axes: Sequence[Axis]) -> list[Content | None]:
    """Contents in which the axes of a sensor have one kind of filter, unless the data say otherwise.

    Axes of one sensor pass through equal filters, and their spectra hardly tell some kinds apart.
    """
    found = list(contents)
    for sensor in SENSORS:
        mates = dict[int, Content]()
        for k, (content, axis) in enumerate(zip(contents, axes, strict=True)):
            if content is not None and axis.sensor == sensor and content.structure.kind != NONE:
                mates[k] = content
        if len(mates) > 1:
            for k, fit in _common(mates).items():
                found[k] = mates[k]._replace(structure=fit.structure)
    return found


def _common(mates: Mapping[int, Content]) -> dict[int, Fitted]:
    """Fits of axes of one sensor with the kind of filter that is likeliest for all of them together."""
    own = {k: content.spectrum.fit(content.structure) for k, content in mates.items()}
    best, least = own, -_COMMON * (len(mates) - 1)
    # Of mates with filters of one kind any one is tried.
    kinds = {(fit.structure.kind, fit.structure.place(OUTSIDE) is None): fit for fit in own.values()}
    for mate in kinds.values():
        common = {k: _with_filter(content, mate.structure) for k, content in mates.items()}
        gain = sum(common[k].evidence - own[k].evidence for k in mates)
        if gain > least:
            best, least = common, gain
    return best


def _with_filter(content: Content, like: Structure) -> Fitted:
    """Fit of a content with the kind of filter of another structure, from the corner of either of them."""
    structure = content.structure
    if like.place(OUTSIDE) is None:
        structure = structure.without(structure.place(OUTSIDE))
    starts = like.corner, structure.corner
    fits = [content.spectrum.fit(structure.with_response(like.kind, corner)) for corner in starts]
    return max(fits, key=lambda fit: fit.evidence)


def extended(
    content: Content | None,
    plain: AxisFit,
    selection: AxisSelection,
    deviation: Float[np.ndarray, " m"],
    edf: Float[np.ndarray, " m"],
    time: Float[np.ndarray, " m"],
) -> tuple[AxisFit, AxisSelection]:
    """Fit of one axis with components besides the plain terms, and the ranking of these.

    They are the given ones without such components, or if these explain little. The Allan deviations are at
    cluster times [s], with their degrees of freedom.
    """
    as_given = plain, selection
    if content is None:
        return as_given
    rate = content.spectrum.bins.rate
    selection = _selection(content, plain.axis)
    content = content._replace(structure=_with_terms(content, selection))
    template, active = _template(content, selection)
    if all(term.deterministic for term in itertools.compress(template.terms, active)):
        return as_given
    template, result = _detected(content, template, active, plain.axis)
    if not result.converged:
        return as_given
    model = np.sqrt(np.asarray(result.model.sampled(rate).allan_variance(time)))
    misfit = misfit_of(time, deviation / model, edf, "s")
    # Deep in a stop band levels may be far off that no Allan deviation notices.
    left = min(result.discrepancy, misfit.rms if misfit else 0.0)
    is_far_off = result.discrepancy > 0.0 and misfit is not None and misfit.excessive
    if is_far_off or (plain.converged and left > _LESS * plain.discrepancy):
        return as_given
    own = _with_values(template, result)
    # Other filters, and other places of resonances, with another N may fit nearly as well.
    N = result.coefficients["angle_random_walk"]
    if N.std > 0.0:
        wider = N.widened(math.hypot(1.0, content.doubt * N.value / N.std))
        result = result.with_estimates({**result.coefficients, N.label: wider})
    return dataclasses.replace(result, own_template=own, plain=plain, other_misfit=misfit), selection


def _selection(content: Content, axis: Axis) -> AxisSelection:
    """Ranking of the terms by the spectrum divided by the effect of the rest of the structure."""
    structure, spectrum, bins = content.structure, content.spectrum, content.spectrum.bins
    plain = [structure.components[k] for k in content.plain_terms]
    total, terms = (
        np.array([c.power for c in own]) @ spectrum.units(of, own)
        for of, own in ((structure, structure.components), (structure.without_response(), plain))
    )
    every, middle = np.log(np.arange(1.0, bins.n)), np.log(bins.frequency * 2.0 * bins.n / bins.rate)
    # A ramp is not divided: it is in the lowest coefficients, which the structure does not change.
    corrected = content.rest / np.exp(0.5 * np.interp(every, middle, np.log(total / terms)))
    candidates = candidates_in_record(bins.n, bins.rate, 2 if len(structure.of_kind(MARKOV)) > 1 else 1)
    statistics = candidates.bins.statistics(corrected[:, None], ramp_column(bins.n, bins.rate))
    return rank_terms(candidates, statistics, [axis], axis.name).results[0]


def _with_terms(content: Content, selection: AxisSelection) -> Structure:
    """Structure with the chosen terms, and as many Markov processes, slower than filtered white noise.

    If no set of terms suffices, those with a free time were left out, and the structure keeps its own.
    """
    chosen, structure = selection.chosen.terms, content.structure
    count, own = sum(label.startswith("markov") for label in chosen), structure.of_kind(MARKOV)
    if selection.discrepancy > 0.0 or count == len(own):
        return structure
    structure = structure.without(*own, *map(structure.place, range(len(FIXED))))
    for k, label in enumerate(FIXED):
        structure = structure.with_column(k, 0.0) if label in chosen else structure
    spectrum = Record(content.rest**2, content.spectrum.bins.rate).binned(structure)
    for _ in range(count):
        structure = min(search.with_process(spectrum, structure), key=lambda fit: fit.loss).structure
    # What follows the response is as the search found it.
    processes = [structure.components[k] for k in structure.of_kind(MARKOV)]
    return content.structure.without(*own).plus(*processes)


def _template(content: Content, selection: AxisSelection) -> tuple[Model, InUse]:
    """Model of the content with the chosen terms, and the terms in use; the others get a limit."""
    structure, rate, chosen = content.structure, content.spectrum.bins.rate, selection.chosen.terms
    after = structure.kind != NONE and not structure.column(QUANTIZATION).inside
    terms: list[tuple[NoiseTerm, bool, bool]] = []
    for label, term in zip(basic_terms().term_labels, basic_terms().terms, strict=True):
        k = FIXED.index(label) if label in FIXED else None
        # The search has chosen what follows the response.
        here = structure.place(k) is not None if k == QUANTIZATION and after else label in chosen
        terms.append((term, k is not None and structure.column(k).inside, here))
    components = structure.of_kind(MARKOV) + structure.oscillators
    for k in components:
        term, passes = term_of(structure, k, rate), structure.components[k].inside
        # A spectrum hardly tells how narrow a resonance is at any moment from how far it moves.
        moves = isinstance(term, WanderingResonance)
        terms.append((term.hold("quality_factor") if moves else term, passes, True))
    if structure.place(OUTSIDE) is not None:
        terms.append((PowerLaw(exponent=0.0).hold("exponent"), False, True))
    terms += [(Sinusoid(frequency=line.frequency), False, True) for line in content.lines]
    each, inside, active = zip(*terms, strict=True)
    response = response_of(structure, rate)
    return Model(each, response, () if response is None else inside), np.array(active)


def _detected(content: Content, template: Model, active: InUse, axis: Axis) -> tuple[Model, AxisFit]:
    """Model without what its fit does not detect, and its fit."""
    rate, c, lines, n = content.spectrum.bins.rate, content.c, content.lines, len(content.x)
    last: tuple[Model, AxisFit] | None = None
    for _ in range(_ROUNDS):
        if len(wanted := lines_of(template)[1]) != len(lines):
            c, lines = take_out_lines(content.x, rate, wanted)
        peaks = [term for term in template.terms if isinstance(term, Resonance)]
        around = [(peak.frequency, peak.quality) for peak in map(peak_of, peaks)]
        spectrum = AxisSpectrum.in_bins(template, search.bins_around(around, n, rate), c, lines)
        result = fit_spectrum(template, axis, spectrum, active, at_low=True)
        if last is not None and not result.discrepancy <= _WORSE * last[1].discrepancy + _SLIGHT:
            # What was taken out was needed, though its size is not known.
            break
        last = template, result
        template, active = _tidied(template, active, result, rate / (2.0 * n))
        if template is last[0]:
            break
    assert last is not None
    return last


def _tidied(template: Model, active: InUse, result: AxisFit, spacing: float) -> tuple[Model, InUse]:
    """Model without resonances and lines that its fit does not detect, if there are any.

    A resonance that has become as narrow as a line becomes a line. Coefficients have a `spacing` [Hz].
    """
    if not result.converged:
        return template, active
    model, peaks, lines = _with_values(template, result), dict[str, Component](), list[float]()
    every = dict(zip(model.term_labels, model.terms, strict=True))
    for label, term in every.items():
        if isinstance(term, Resonance):
            peaks[label] = peak_of(term)
        elif isinstance(term, Sinusoid):
            lines.append(float(term.frequency or 0.0))
    # Too narrow a resonance spoils its neighbours; these are judged once it is a line.
    gone = sharp = [label for label, peak in peaks.items() if peak.width < LINE * spacing]
    if not sharp:
        further = [k for k, term in every.items() if isinstance(term, (PowerLaw, Resonance, Sinusoid))]
        unseen = [c for c in result.coefficients.values() if c.is_amplitude and not c.detected]
        gone = []
        # Overlapping resonances may be detected only together, not singly: the weakest goes first.
        for c in sorted((c for c in unseen if c.term in further), key=lambda c: c.value):
            beside = [peaks[k] for k in gone if {k, c.term} <= peaks.keys()]
            if not any(peaks[c.term].is_close_to(other) for other in beside):
                gone.append(c.term)
    if not gone:
        return template, active
    active = active[[label not in gone for label in every]]
    model = model.without(gone)
    for frequency in (peaks[k].frequency for k in sharp):
        if all(abs(frequency - line) > _APART * spacing for line in lines):
            lines.append(frequency)
            model, active = model + Sinusoid(frequency=frequency), np.append(active, True)
    return model, active


def _with_values(template: Model, result: AxisFit) -> Model:
    """The template with the values of its fit, in which white noise excludes what wide resonances have."""
    values = {label: c.value for label, c in result.coefficients.items() if np.isfinite(c.value)}
    own = result.model.values
    values["angle_random_walk"] = float(own.get("angle_random_walk") or 0.0)
    return template.with_values(**values)
