"""Fit of an axis whose spectrum the plain noise terms do not follow: with filter, resonances and lines.

What there is besides the terms is searched for in the spectrum (`structure`); the terms are chosen anew, from
the spectrum divided by what that makes of it; and all of it is fitted jointly by Whittle's likelihood.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from allanjax.allan.deviation import AllanDeviation
from allanjax.estimate.axis_fits import result_of
from allanjax.estimate.deterministic import line_columns, take_out_lines
from allanjax.estimate.misfit import misfit_of
from allanjax.estimate.ranking import candidates_of, rank_terms
from allanjax.estimate.result import AxisFit
from allanjax.estimate.selection import AxisSelection
from allanjax.estimate.spectral.components import NONE
from allanjax.estimate.spectral.model import FULL
from allanjax.estimate.structure.as_model import markov_of, response_of, term_of
from allanjax.estimate.structure.search import Record, completed, refitted, searched
from allanjax.estimate.structure.structure import FIXED, LINE, LOWEST, OUTSIDE, Structure
from allanjax.estimate.whittle import fit_spectrum, spectrum_of
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model
from allanjax.noise.terms import Markov, NoiseTerm, PowerLaw, Sinusoid, basic_terms
from allanjax.record.recording import Axis
from allanjax.spectrum.cosine import Bins, cosine_transform, ramp_column

# Width of a resonance [coefficients] below which it is a line.
_LINE = 1.25 * LINE
# Distance of lines [coefficients], and coefficients on either side of one that have its power, and that are
# looked at.
_APART, _CORE, _AROUND = 1.5, 4, 40
# Share of the excess there that a line's core has; log odds of a peak in white noise; peaks that are tried.
_NEARLY_ALL, _SURE, _TRIED = 0.9, 10.0, 64
# Coefficients whose median is a first guess of the level, and the median of χ² with one degree of freedom.
_BLOCK, _MEDIAN = 64, 0.4549
# Joint fits, until all that is in the model is seen.
_ROUNDS = 3
# Searches, before and after lines are taken out.
_SEARCHES = 3
# Share of the discrepancy that must be gone, and samples that a search needs.
_LESS, _SHORTEST = 0.5, 1024


class Extension(NamedTuple):
    """Fit of one axis with its extension, and the ranking of its terms."""

    result: AxisFit
    selection: AxisSelection


def extended(
    x: Float[np.ndarray, " n"], rate: float, plain: AxisFit, curve: AllanDeviation, k: int
) -> Extension | None:
    """Fit of one axis with what its spectrum has besides the plain terms; None if that explains little.

    Args:
        x: samples.
        rate: sample rate [Hz].
        plain: the fit of the plain terms.
        curve: Allan deviations of all axes, of which this one is k.
    """
    axis = plain.axis
    if len(x) < _SHORTEST:
        return None
    content = _content(x, rate)
    if content.is_plain:
        return None
    selection = _selection(content, axis)
    for _ in range(_ROUNDS):
        template, active = _template(content, selection)
        found = fit_spectrum(template, axis, spectrum_of(template, x, rate, {}), active)
        result = result_of(found, template, axis, active)
        if not result.converged or (tidied := _tidied(content, template, result)) is None:
            break
        content = tidied
    if not result.converged or result.discrepancy > _LESS * plain.discrepancy:
        return None
    deviation = np.sqrt(np.asarray(result.model.sampled(rate).allan_variance(curve.cluster_time)))
    ratio = curve.deviation[:, k] / deviation
    if misfit_of(curve.cluster_time, ratio, curve.edf[:, k], "s").excessive:
        return None
    return Extension(dataclasses.replace(result, own_template=template, plain=plain), selection)


class _Content(NamedTuple):
    """What a spectrum consists of.

    Attributes:
        structure: terms, response and resonances.
        lines: frequencies of the lines [Hz].
        bins: bins that are fine around the resonances.
        c: cosine coefficients without the lines.
    """

    structure: Structure
    lines: list[float]
    bins: Bins
    c: Float[np.ndarray, " n-1"]

    @property
    def further(self) -> list[int]:
        """Components that are no plain terms, then a negative number for each line."""
        own = [k for k in self.structure.there if k == OUTSIDE or k >= FULL.first_oscillator]
        return own + [-1 - k for k in range(len(self.lines))]

    @property
    def is_plain(self) -> bool:
        """Whether there is nothing besides plain terms."""
        of = self.structure
        return not (of.kind != NONE or len(of.oscillators) or len(of.markovs) or self.lines)


def _content(x: Float[np.ndarray, " n"], rate: float) -> _Content:
    """What the spectrum of these samples consists of."""
    n, lines, x = len(x), list[float](), x - x.mean()
    c = cosine_transform(x)
    for _ in range(_SEARCHES):
        if not (more := _conspicuous(c, rate)):
            break
        lines, c = _without_lines(x, rate, lines + more)
    spectrum, found = searched(Record(c**2, rate), Structure.plain(list(range(len(FIXED)))))
    if narrow := _narrow(found.structure, n):
        more = [found.structure.frequency(k) * rate / (2.0 * np.pi) for k in narrow]
        lines, c = _without_lines(x, rate, lines + more)
        record, rest = Record(c**2, rate), _without(found.structure, narrow)
        spectrum, found = searched(record, refitted(record, rest)[1].structure)
    structure = completed(spectrum, found).structure
    return _Content(_without(structure, _narrow(structure, n)), lines, spectrum.bins, c)


def _conspicuous(c: Float[np.ndarray, " n-1"], rate: float) -> list[float]:
    """Frequencies of peaks that are as narrow as lines and far above their surroundings [Hz]."""
    n, square = len(c) + 1, c**2
    blocks = square[: len(c) // _BLOCK * _BLOCK].reshape(-1, _BLOCK)
    rough = np.repeat(np.median(blocks, axis=1) / _MEDIAN, _BLOCK)
    sure = 2.0 * (np.log(n) + _SURE)
    found: list[int] = []
    for j in np.argsort(square[: len(rough)] / rough)[::-1][:_TRIED].tolist():
        if square[j] < sure * rough[j] or j < LOWEST or any(abs(j - k) <= _CORE for k in found):
            continue
        around = square[max(j - _AROUND, 0) : j + _AROUND + 1]
        level = float(np.median(around)) / _MEDIAN
        core = square[max(j - _CORE, 0) : j + _CORE + 1] - level
        if square[j] > sure * level and core.sum() > _NEARLY_ALL * (around - level).sum():
            found.append(j)
    return [(j + 1) * rate / (2.0 * n) for j in found]


def _without_lines(
    x: Float[np.ndarray, " n"], rate: float, lines: Sequence[float]
) -> tuple[list[float], Float[np.ndarray, " n-1"]]:
    """Lines near these frequencies [Hz], and the coefficients without them."""
    c, taken = take_out_lines(x, rate, [(f, False) for f in lines])
    for line in taken:
        own = line_columns(line.frequency, line.indices, len(x), rate)
        c[line.indices - 1] -= own @ np.linalg.lstsq(own, line.coefficients, rcond=None)[0]
    return [line.frequency for line in taken], c


def _tidied(content: _Content, template: Model, result: AxisFit) -> _Content | None:
    """Content without resonances and lines that the joint fit does not show; None if it shows all.

    A resonance that has become as narrow as a line is one.
    """
    structure, spacing = content.structure, content.bins.rate / (2.0 * content.bins.n)
    further = dict(
        zip(template.term_labels[len(template) - len(content.further) :], content.further, strict=True)
    )
    found: dict[str, dict[str, Estimate]] = {label: {} for label in further}
    for c in result.coefficients.values():
        if c.term in found and c.parameter is not None:
            found[c.term][c.parameter.name] = c
    narrow = {
        label: own["frequency"].value
        for label, own in found.items()
        if "quality_factor" in own and own["frequency"].value < own["quality_factor"].value * LINE * spacing
    }
    # What is too narrow spoils its neighbours, which are judged once it is a line.
    gone = list(narrow) or [label for label, own in found.items() if not own["amplitude"].detected]
    if not gone:
        return None
    for label in gone:
        structure = structure.without(further[label]) if further[label] >= 0 else structure
    lines = [
        own["frequency"].value for label, own in found.items() if further[label] < 0 and label not in gone
    ]
    for f in narrow.values():
        lines += [f] if all(abs(f - line) > _APART * spacing for line in lines) else []
    return content._replace(structure=structure, lines=lines)


def _narrow(structure: Structure, n: int) -> list[int]:
    """Resonances that are lines."""
    return [int(k) for k in structure.oscillators if structure.width(int(k)) < _LINE * np.pi / n]


def _without(structure: Structure, resonances: Sequence[int]) -> Structure:
    for k in resonances:
        structure = structure.without(FULL.first_oscillator + k)
    return structure


def _selection(content: _Content, axis: Axis) -> AxisSelection:
    """Ranking of the terms by the spectrum, divided by what the rest of the structure makes of it."""
    structure, fine = content.structure, content.bins
    bins = Bins.of(fine.n, fine.rate)
    f, response = fine.frequency, response_of(structure, fine.rate)
    passed = 1.0 if response is None else np.asarray(response.power(f, fine.rate))
    total, terms = np.zeros(len(f)), np.zeros(len(f))
    for k in structure.there:
        density = np.asarray(term_of(structure, k, fine.rate).sampled_psd(f, fine.rate))
        total += density * (passed if structure.inside[k] else 1.0)
        terms += density if k < OUTSIDE or FULL.first_markov <= k < FULL.first_oscillator else 0.0
    every = np.log(np.arange(1.0, fine.n) * fine.rate / (2.0 * fine.n))
    # A ramp is not divided: it is in the lowest coefficients, where nothing is changed.
    corrected = content.c / np.exp(0.5 * np.interp(every, np.log(f), np.log(total / terms)))
    basic = basic_terms() + Markov()
    candidates = candidates_of(basic + Markov() if len(structure.markovs) > 1 else basic, fine.rate)
    statistics = bins.statistics(corrected[:, None], ramp_column(fine.n, fine.rate))
    return rank_terms(candidates, bins, statistics, [axis], axis.name).results[0]


def _template(content: _Content, selection: AxisSelection) -> tuple[Model, Bool[np.ndarray, " terms"]]:
    """Model to fit, all five basic terms first, and which of its terms are in use."""
    structure, rate, chosen = content.structure, content.bins.rate, selection.chosen.terms
    terms: list[tuple[NoiseTerm, bool]] = []
    active = [label in chosen for label in basic_terms().term_labels]
    for label, term in zip(basic_terms().term_labels, basic_terms().terms, strict=True):
        if label in FIXED:
            k = FIXED.index(label)
            amplitude = float(np.sqrt(structure.power[k])) if label in chosen else None
            terms.append((term.replace(coefficient=amplitude), bool(structure.inside[k])))
        else:
            terms.append((term, False))
    # Where no set of terms suffices those with a free time were left out.
    own: list[NoiseTerm] = [markov_of(structure, int(k), rate) for k in structure.markovs]
    count = len(own) if selection.discrepancy > 0.0 else sum(s.startswith("markov") for s in chosen)
    terms += [(term, True) for term in (own if count == len(own) else [Markov()] * count)]
    for k in content.further:
        if k < 0:
            terms.append((Sinusoid(frequency=content.lines[-1 - k]), False))
        elif k == OUTSIDE:
            white = PowerLaw(float(np.sqrt(structure.power[k])), 0.0)
            terms.append((white.hold("exponent"), False))
        else:
            terms.append((term_of(structure, k, rate), bool(structure.inside[k])))
    active += [True] * (len(terms) - len(active))
    response = response_of(structure, rate)
    inside = () if response is None else tuple(passes for _, passes in terms)
    return Model(tuple(term for term, _ in terms), response, inside), np.array(active)
