"""Fit of an axis whose spectrum the plain noise terms do not follow: with filter, resonances and lines.

What there is besides the terms is searched for in the spectrum (`content`); the terms are chosen anew, from
the spectrum divided by what that makes of it; and all of it is fitted jointly (`joint_fit`).
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from allanjax.allan.deviation import AllanDeviation
from allanjax.estimate.axis_fits import result_of
from allanjax.estimate.extension.content import Content, content_of
from allanjax.estimate.extension.joint_fit import Template, fit_jointly
from allanjax.estimate.misfit import misfit_of
from allanjax.estimate.ranking import candidates_of, rank_terms
from allanjax.estimate.result import AxisFit, extended_model
from allanjax.estimate.selection import AxisSelection
from allanjax.estimate.spectral.model import FULL
from allanjax.estimate.structure.as_model import response_of, term_of
from allanjax.estimate.structure.search import TIMES, Record
from allanjax.estimate.structure.structure import FIXED, LINE, Structure
from allanjax.noise.estimate import Estimate
from allanjax.noise.terms import Markov, basic_terms
from allanjax.record.recording import Axis
from allanjax.spectrum.cosine import Bins, ramp_column

# Least distance of two lines [coefficients].
_APART = 1.5
# Joint fits, until all that is in the model is seen.
_ROUNDS = 6
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
    content = content_of(x, rate)
    # Without plain terms there is nothing to correct.
    if content.is_plain or not content.plain_terms:
        return None
    selection = _selection(content, axis)
    content = content._replace(structure=_with_terms(content, selection))
    ramp = "drift_ramp" in selection.chosen.terms
    for _ in range(_ROUNDS):
        template, found, structure = fit_jointly(content, ramp, axis, x)
        result = result_of(found, template.model, axis, template.active)
        if (
            not result.converged
            or (tidied := _tidied(content._replace(structure=structure), template, result)) is None
        ):
            break
        content = tidied
    if not result.converged or (plain.converged and result.discrepancy > _LESS * plain.discrepancy):
        return None
    inactive = [s for s, here in zip(template.model.term_labels, template.active, strict=True) if not here]
    model = extended_model(template.model, result.coefficients, inactive)
    deviation = np.sqrt(np.asarray(model.sampled(rate).allan_variance(curve.cluster_time)))
    misfit = misfit_of(curve.cluster_time, curve.deviation[:, k] / deviation, curve.edf[:, k], "s")
    if result.misfit is not None and misfit.excessive:
        return None
    result = dataclasses.replace(result, own_template=template.model, plain=plain, _model=model)
    result = dataclasses.replace(result, allan_misfit=misfit.beside(result.misfit))
    return Extension(result, selection)


def _selection(content: Content, axis: Axis) -> AxisSelection:
    """Ranking of the terms by the spectrum, divided by what the rest of the structure makes of it."""
    structure, fine = content.structure, content.bins
    bins = Bins.of(fine.n, fine.rate)
    f, response = fine.frequency, response_of(structure, fine.rate)
    passed = 1.0 if response is None else np.asarray(response.power(f, fine.rate))
    total, terms = np.zeros(len(f)), np.zeros(len(f))
    for k in structure.there:
        density = np.asarray(term_of(structure, k, fine.rate).sampled_psd(f, fine.rate))
        total += density * (passed if structure.inside[k] else 1.0)
        terms += density if k in content.plain_terms else 0.0
    every = np.log(np.arange(1.0, fine.n) * fine.rate / (2.0 * fine.n))
    # A ramp is not divided: it is in the lowest coefficients, where nothing is changed.
    corrected = content.c / np.exp(0.5 * np.interp(every, np.log(f), np.log(total / terms)))
    basic = basic_terms() + Markov()
    candidates = candidates_of(basic + Markov() if len(structure.markovs) > 1 else basic, fine.rate)
    statistics = bins.statistics(corrected[:, None], ramp_column(fine.n, fine.rate))
    return rank_terms(candidates, bins, statistics, [axis], axis.name).results[0]


def _with_terms(content: Content, selection: AxisSelection) -> Structure:
    """Structure with the chosen terms, and as many Markov processes as were chosen.

    Where no set of terms suffices those with a free time were left out, and the structure keeps its own.
    """
    chosen, structure = selection.chosen.terms, content.structure
    for k, label in enumerate(FIXED):
        if label not in chosen:
            structure = structure.without(k)
        elif not structure.active[k]:
            structure = structure.using(k, 0.0)
    count = sum(label.startswith("markov") for label in chosen)
    if selection.discrepancy > 0.0 or count == len(structure.markovs):
        return structure
    for k in structure.markovs:
        structure = structure.without(FULL.first_markov + int(k))
    spectrum = Record(content.c**2, content.bins.rate).binned(structure)
    for _ in range(count):
        level = float(np.median(spectrum.rough[: len(spectrum.bins.size)]))
        starts = [structure.with_markov(max(spectrum.n**p, 20.0), level) for p in TIMES]
        fits = [spectrum.fit(start) for start in starts if start is not None]
        structure = min(fits, key=lambda fit: fit.loss).structure
    return structure


def _overlap(structure: Structure, k: int, other: int) -> bool:
    """Whether two components are resonances with overlapping peaks."""
    first = FULL.first_oscillator
    return min(k, other) >= first and structure.are_close(k - first, other - first)


def _tidied(content: Content, template: Template, result: AxisFit) -> Content | None:
    """Content without resonances and lines that the joint fit does not show; None if it shows all.

    A resonance that has become as narrow as a line is one.
    """
    structure, spacing = content.structure, content.bins.rate / (2.0 * content.bins.n)
    further = dict(
        zip(
            template.model.term_labels[len(template.model) - len(content.further) :],
            content.further,
            strict=True,
        )
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
    unseen = sorted(
        (label for label, own in found.items() if not own["amplitude"].detected),
        key=lambda label: found[label]["amplitude"].value,
    )
    gone = list(narrow)
    # Of resonances that overlap none may be seen, but all together are: the weakest goes first.
    for label in unseen if not narrow else ():
        if not any(_overlap(structure, further[label], further[other]) for other in gone):
            gone.append(label)
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
