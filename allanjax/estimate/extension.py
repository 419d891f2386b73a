"""Fit with filter, resonances and lines of an axis that the plain noise terms do not fit.

The spectrum is searched for components besides the terms (`Content`); the terms are chosen anew, from the
spectrum divided by the effect of these components; and the model of all of them is fitted by Whittle's
likelihood, without what that does not detect.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from allanjax.allan.deviation import AllanDeviation
from allanjax.estimate.deterministic import line_columns, take_out_lines
from allanjax.estimate.result import AxisFit, misfit_of
from allanjax.estimate.selection import AxisSelection, candidates_of, rank_terms
from allanjax.estimate.spectral.components import MARKOV, NONE
from allanjax.estimate.spectral.model import CLOSE, response_of
from allanjax.estimate.structure.search import (
    Record,
    bins_around,
    completed,
    narrow,
    refitted,
    searched,
    with_process,
)
from allanjax.estimate.structure.structure import (
    FIXED,
    LINE,
    LOWEST,
    OUTSIDE,
    QUANTIZATION,
    Structure,
    term_of,
)
from allanjax.estimate.whittle import fit_spectrum, spectrum_of
from allanjax.noise.model import Model
from allanjax.noise.terms import Markov, NoiseTerm, PowerLaw, Resonance, Sinusoid, basic_terms
from allanjax.record.recording import Axis
from allanjax.spectrum.cosine import Bins, cosine_transform, fast_length, ramp_column

# Coefficients on either side of a line that contain its power, and that are inspected.
_CORE, _LINE_AROUND = 4, 40
# Share of the excess there in a line's core; log odds of a peak in white noise; number of peaks tried, and of
# searches, each after removal of the lines found before; and least distance of two lines [coefficients].
_NEARLY_ALL, _SURE, _TRIED, _LOOKS, _APART = 0.9, 10.0, 64, 3, 1.5
# Coefficients whose median is a first guess of the level, and the median of χ² with one degree of freedom.
_BLOCK, _MEDIAN = 64, 0.4549
# Most fits until every component of the model is detected, and the growth of the discrepancy, relative and
# absolute, that the removal of what is not detected may cause: judgements.
_ROUNDS, _WORSE, _SLIGHT = 6, 1.2, 0.001
# Share of the discrepancy that must be removed, and fewest samples for a search.
_LESS, _SHORTEST = 0.5, 1024


class Content(NamedTuple):
    """Components of a spectrum, its lines [Hz], bins that are fine around resonances, and the coefficients.

    These are without the lines.
    """

    structure: Structure
    lines: list[float]
    bins: Bins
    c: Float[np.ndarray, " n-1"]

    @property
    def plain_terms(self) -> list[int]:
        """Components with some power that are basic terms or Markov processes before the response, if any."""
        of = self.structure
        plain = [*of.of_kind(MARKOV), *map(of.place, range(OUTSIDE))]
        return [k for k in of.there if k in plain and (of.kind == NONE or of.components[k].inside)]


def content_of(x: Float[np.ndarray, " n"], rate: float) -> Content:
    """Components of the spectrum of these samples."""
    n, lines, x = len(x), list[float](), x - x.mean()
    c = cosine_transform(x)
    for _ in range(_LOOKS):
        if not (more := _conspicuous(c, rate)):
            break
        lines, c = _without_lines(x, rate, lines + more)
    spectrum, found = searched(Record(c**2, rate), Structure.plain(list(range(len(FIXED)))))
    if sharp := narrow(found.structure, n):
        more = [found.structure.components[k].frequency * rate / (2.0 * np.pi) for k in sharp]
        lines, c = _without_lines(x, rate, lines + more)
        record, rest = Record(c**2, rate), found.structure.without(*sharp)
        spectrum, found = searched(record, refitted(record, rest)[1].structure)
    structure = completed(spectrum, found).structure
    return Content(structure.without(*narrow(structure, n)), lines, spectrum.bins, c)


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
        around = square[max(j - _LINE_AROUND, 0) : j + _LINE_AROUND + 1]
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


def extended(
    x: Float[np.ndarray, " n"], rate: float, plain: AxisFit, curve: AllanDeviation, k: int
) -> tuple[AxisFit, AxisSelection] | None:
    """Fit of one axis with components besides the plain terms, and the ranking of these.

    None if the components explain little. Samples are at a rate [Hz]; the axis is k of the Allan deviations.
    """
    if len(x) < _SHORTEST:
        return None
    x = x[: fast_length(len(x))]
    content = content_of(x, rate)
    of = content.structure
    besides = of.kind != NONE or of.oscillators or of.of_kind(MARKOV) or content.lines
    # Without plain terms nothing is to be corrected.
    if not besides or not content.plain_terms:
        return None
    selection = _selection(content, plain.axis)
    content = content._replace(structure=_with_terms(content, selection))
    template, result = _detected(*_template(content, selection), plain.axis, x, rate)
    if not result.converged:
        return None
    deviation = np.sqrt(np.asarray(result.model.sampled(rate).allan_variance(curve.cluster_time)))
    misfit = misfit_of(curve.cluster_time, curve.deviation[:, k] / deviation, curve.edf[:, k], "s")
    # Deep in a stop band levels may be far off that no Allan deviation notices.
    left = min(result.discrepancy, misfit.rms)
    if (plain.converged and left > _LESS * plain.discrepancy) or (
        result.misfit is not None and misfit.excessive
    ):
        return None
    own, misfit_beside = _with_values(template, result), misfit.beside(result.misfit)
    result = dataclasses.replace(result, own_template=own, plain=plain, allan_misfit=misfit_beside)
    return result, selection


def _selection(content: Content, axis: Axis) -> AxisSelection:
    """Ranking of the terms by the spectrum divided by the effect of the rest of the structure."""
    structure, fine = content.structure, content.bins
    bins = Bins.of(fine.n, fine.rate)
    f, response = fine.frequency, response_of(structure, fine.rate)
    passed = 1.0 if response is None else np.asarray(response.power(f, fine.rate))
    total, terms = np.zeros(len(f)), np.zeros(len(f))
    for k in structure.there:
        density = np.asarray(term_of(structure, k, fine.rate).sampled_psd(f, fine.rate))
        total += density * (passed if structure.components[k].inside else 1.0)
        terms += density if k in content.plain_terms else 0.0
    every = np.log(np.arange(1.0, fine.n) * fine.rate / (2.0 * fine.n))
    # A ramp is not divided: it is in the lowest coefficients, which the structure does not change.
    corrected = content.c / np.exp(0.5 * np.interp(every, np.log(f), np.log(total / terms)))
    basic = basic_terms() + Markov()
    candidates = candidates_of(basic + Markov() if len(structure.of_kind(MARKOV)) > 1 else basic, fine.rate)
    statistics = bins.statistics(corrected[:, None], ramp_column(fine.n, fine.rate))
    return rank_terms(candidates, bins, statistics, [axis], axis.name).results[0]


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
    spectrum = Record(content.c**2, content.bins.rate).binned(structure)
    for _ in range(count):
        structure = min(with_process(spectrum, structure), key=lambda fit: fit.loss).structure
    # What follows the response is as the search found it.
    processes = [structure.components[k] for k in structure.of_kind(MARKOV)]
    return content.structure.without(*own).plus(*processes)


def _template(content: Content, selection: AxisSelection) -> tuple[Model, Bool[np.ndarray, " terms"]]:
    """Model of the content with the chosen terms, and the terms in use; the others get a limit."""
    structure, rate, chosen = content.structure, content.bins.rate, selection.chosen.terms
    after = structure.kind != NONE and not structure.column(QUANTIZATION).inside
    terms: list[tuple[NoiseTerm, bool, bool]] = []
    for label, term in zip(basic_terms().term_labels, basic_terms().terms, strict=True):
        k = FIXED.index(label) if label in FIXED else None
        # The search has chosen what follows the response.
        here = structure.place(k) is not None if k == QUANTIZATION and after else label in chosen
        terms.append((term, k is not None and structure.column(k).inside, here))
    components = structure.of_kind(MARKOV) + structure.oscillators
    terms += [(term_of(structure, k, rate), structure.components[k].inside, True) for k in components]
    if structure.place(OUTSIDE) is not None:
        terms.append((PowerLaw(exponent=0.0).hold("exponent"), False, True))
    terms += [(Sinusoid(frequency=f), False, True) for f in content.lines]
    each, inside, active = zip(*terms, strict=True)
    response = response_of(structure, rate)
    return Model(each, response, () if response is None else inside), np.array(active)


def _detected(
    template: Model, active: Bool[np.ndarray, " terms"], axis: Axis, x: Float[np.ndarray, " n"], rate: float
) -> tuple[Model, AxisFit]:
    """Model without what its fit does not detect, and its fit."""
    last: tuple[Model, AxisFit] | None = None
    for _ in range(_ROUNDS):
        spectrum = spectrum_of(template, x, rate, bins=bins_around(_resonances(template), len(x), rate))
        result = fit_spectrum(template, axis, spectrum, active, at_low=True)
        if last is not None and not result.discrepancy <= _WORSE * last[1].discrepancy + _SLIGHT:
            # What was taken out was needed, though its size is not known.
            return last
        last = template, result
        if not result.converged or (tidied := _tidied(template, active, result, spectrum.bins)) is None:
            break
        template, active = tidied
    assert last is not None
    return last


def _resonances(model: Model) -> list[tuple[float, float]]:
    """Frequency and quality factor of each resonance of a model with values."""
    found = [term for term in model.terms if isinstance(term, Resonance)]
    return [(float(term.frequency or 0.0), float(term.quality_factor or 1.0)) for term in found]


def _tidied(
    template: Model, active: Bool[np.ndarray, " terms"], result: AxisFit, bins: Bins
) -> tuple[Model, Bool[np.ndarray, " terms"]] | None:
    """Model without resonances and lines that its fit does not detect; None if it detects all.

    A resonance that has become as narrow as a line becomes a line.
    """
    spacing, found = bins.rate / (2.0 * bins.n), result.coefficients
    of = {label: type(term) for label, term in zip(template.term_labels, template.terms, strict=True)}
    further = [label for label, kind in of.items() if kind in (PowerLaw, Resonance, Sinusoid)]

    def value(label: str, name: str) -> float:
        return found[f"{label}_{name}"].value

    amplitude = {c.term: c for c in found.values() if c.is_amplitude and c.term in further}
    middle = {k: value(k, "frequency") for k in further if of[k] is not PowerLaw}
    width = {k: middle[k] / value(k, "quality_factor") for k in further if of[k] is Resonance}
    gone = narrow = [k for k in width if width[k] < LINE * spacing]
    # Too narrow a resonance spoils its neighbours; these are judged once it is a line.
    if not narrow:
        gone = []
        unseen = (k for k in further if not amplitude[k].detected)
        # Overlapping resonances may be detected only together, not singly: the weakest goes first.
        for k in sorted(unseen, key=lambda k: amplitude[k].value):
            beside = (i for i in gone if {k, i} <= width.keys())
            if all(abs(middle[k] - middle[i]) >= CLOSE * 0.5 * (width[k] + width[i]) for i in beside):
                gone.append(k)
    if not gone:
        return None
    lines = [middle[k] for k in further if of[k] is Sinusoid and k not in gone]
    new: list[NoiseTerm] = []
    for k in narrow:
        if all(abs(middle[k] - line) > _APART * spacing for line in lines):
            lines.append(middle[k])
            new.append(Sinusoid(frequency=middle[k]))
    stays = np.array([label not in gone for label in template.term_labels])
    rest = _with_values(template, result).without(gone)
    inside = (*rest.inside, *[False] * len(new)) if rest.inside else ()
    model = Model((*rest.terms, *new), rest.response, inside)
    return model, np.append(active[stays], np.ones(len(new), bool))


def _with_values(template: Model, result: AxisFit) -> Model:
    """The template with the values of its fit, in which white noise excludes what wide resonances have."""
    values = {label: c.value for label, c in result.coefficients.items() if np.isfinite(c.value)}
    own = result.model.values
    values["angle_random_walk"] = float(own.get("angle_random_walk") or 0.0)
    return template.with_values(**values)
