"""Fit with filter, resonances and lines of an axis that the plain noise terms do not fit.

The spectrum is searched for components besides the terms (`Content`); the terms are chosen anew, from the
spectrum divided by the effect of these components; and everything is fitted jointly (`fit_jointly`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Container, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from allanjax.allan.deviation import AllanDeviation
from allanjax.base.chi_squared import beyond_doubt
from allanjax.estimate.axis_fits import WhittleFit, inferred, result_of, spectrum_of
from allanjax.estimate.design import free_shapes, random_terms
from allanjax.estimate.deterministic import line_columns, take_out_lines
from allanjax.estimate.gls import Solution
from allanjax.estimate.result import AxisFit, extended_model, misfit_of
from allanjax.estimate.selection import AxisSelection, candidates_of, rank_terms
from allanjax.estimate.spectral.components import NONE
from allanjax.estimate.spectral.fit import LevelDesign, Places, chi_squared, error_of_powers
from allanjax.estimate.spectral.model import FULL
from allanjax.estimate.structure.search import TIMES, WIDE, Record, completed, narrow, refitted, searched
from allanjax.estimate.structure.structure import (
    FINE,
    FIXED,
    LINE,
    LOWEST,
    OUTSIDE,
    QUANTIZATION,
    WHITE,
    Fitted,
    Spectrum,
    Structure,
    response_of,
    term_of,
)
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model
from allanjax.noise.terms import Markov, NoiseTerm, PowerLaw, Resonance, Sinusoid, basic_terms
from allanjax.record.recording import Axis
from allanjax.spectrum.cosine import Bins, cosine_transform, ramp_column

# Coefficients on either side of a line that contain its power, and that are inspected.
_CORE, _LINE_AROUND = 4, 40
# Share of the excess there in a line's core; log odds of a peak in white noise; number of peaks tried.
_NEARLY_ALL, _SURE, _TRIED = 0.9, 10.0, 64
# Coefficients whose median is a first guess of the level, and the median of χ² with one degree of freedom.
_BLOCK, _MEDIAN = 64, 0.4549
# Number of searches for lines, each after removal of the lines found before.
_LOOKS = 3
# Rounds of projecting out ramp and lines and fitting the rest.
_WEIGHT_ROUNDS = 2
# Relative error of the power around a resonance, up to this factor from its frequency, beyond which it is not
# shown to be the oscillator's shape: a judgement.
_SHAPED, _AROUND = 0.05, 1.5
# Correlation time [samples] below which a Markov process is filtered white noise.
_SHORT = 20.0
# Least distance of two lines [coefficients].
_APART = 1.5
# Most joint fits until every component of the model is detected.
_ROUNDS = 6
# Growth of the discrepancy, relative and absolute, that the removal of what is not detected may cause:
# judgements.
_WORSE, _SLIGHT = 1.2, 0.001
# Share of the discrepancy that must be removed, and fewest samples for a search.
_LESS, _SHORTEST = 0.5, 1024


class Content(NamedTuple):
    """Components of a spectrum.

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
        """Components that are not plain terms, then a negative number for each line."""
        own = [
            k
            for k in np.flatnonzero(self.structure.active).tolist()
            if k == OUTSIDE or k >= FULL.first_oscillator
        ]
        return own + [-1 - k for k in range(len(self.lines))]

    @property
    def plain_terms(self) -> list[int]:
        """Components with some power that are basic terms or Markov processes before the response, if any."""
        markovs, structure = range(FULL.first_markov, FULL.first_oscillator), self.structure
        before = structure.inside if structure.kind != NONE else np.ones_like(structure.inside)
        return [k for k in structure.there if (k < OUTSIDE or k in markovs) and before[k]]


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
        more = [found.structure.frequency(k) * rate / (2.0 * np.pi) for k in sharp]
        lines, c = _without_lines(x, rate, lines + more)
        record, rest = Record(c**2, rate), without(found.structure, sharp)
        spectrum, found = searched(record, refitted(record, rest)[1].structure)
    structure = completed(spectrum, found).structure
    return Content(without(structure, narrow(structure, n)), lines, spectrum.bins, c)


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


def without(structure: Structure, resonances: Sequence[int]) -> Structure:
    for k in resonances:
        structure = structure.without(FULL.first_oscillator + k)
    return structure


class Template(NamedTuple):
    """Model of an axis, with the values of a structure.

    Attributes:
        model: first all five basic terms, the ramp included, then Markov processes and further components.
        active: terms of the model that are in use; the others get a limit.
        component: the component of the structure for each random term.
    """

    model: Model
    active: Bool[np.ndarray, " terms"]
    component: Int[np.ndarray, " random"]

    @classmethod
    def of(cls, content: Content, ramp: bool) -> Template:
        """Template of the content, with or without a ramp in use."""
        structure, rate = content.structure, content.bins.rate
        terms: list[tuple[NoiseTerm, bool, bool]] = []
        component = []
        for label, term in zip(basic_terms().term_labels, basic_terms().terms, strict=True):
            if label in FIXED:
                k = FIXED.index(label)
                component.append(k)
                here = bool(structure.active[k])
                amplitude = float(np.sqrt(structure.power[k])) if here else None
                terms.append((term.replace(coefficient=amplitude), bool(structure.inside[k]), here))
            else:
                terms.append((term, False, ramp))
        own = [FULL.first_markov + int(k) for k in structure.markovs]
        for k in [*own, *content.further]:
            if k < 0:
                terms.append((Sinusoid(frequency=content.lines[-1 - k]), False, True))
                continue
            component.append(k)
            white = PowerLaw(float(np.sqrt(structure.power[k])), 0.0).hold("exponent")
            terms.append(
                (white if k == OUTSIDE else term_of(structure, k, rate), bool(structure.inside[k]), True)
            )
        each, inside, active = zip(*terms, strict=True)
        response = response_of(structure, rate)
        model = Model(each, response, () if response is None else inside)
        return cls(model, np.array(active), np.array(component))

    @property
    def noise(self) -> Model:
        """The random terms."""
        return random_terms(self.model)

    def places(self, rate: float) -> Places:
        """Where the random terms and their shapes are in the structure's slots."""
        at, noise, parameter = FULL, self.noise, []
        shapes = free_shapes(noise)
        for p in shapes:
            first = p.parameter.name in ("correlation_time", "frequency", "bandwidth")
            if p.term == len(self.component):
                parameter.append(at.response if first else at.response + 1)
                continue
            k = int(self.component[p.term])
            if k < at.first_oscillator:
                parameter.append(at.times + k - at.first_markov)
            else:
                parameter.append((at.frequencies if first else at.qualities) + k - at.first_oscillator)
        owner = np.array([p.term for p in shapes], int)
        inside = np.array(noise.inside or [False] * len(noise), bool)
        return Places(at, self.component, np.array(parameter, int), owner, inside, 1.0 / rate)


def fit_jointly(
    content: Content, ramp: bool, axis: Axis, x: Float[np.ndarray, " n"]
) -> tuple[Template, WhittleFit, Structure]:
    """Joint fit of all components of the spectrum of these samples, and its structure."""
    template, rate = Template.of(content, ramp), content.bins.rate
    base = Record(content.c**2, rate).binned(content.structure)
    spectrum = spectrum_of(template.model, x, rate, {}, bins=base.bins)
    used = spectrum.used([k for k in range(len(template.model)) if not template.active[k]])
    first, rows = base.fit(content.structure), len(base.bins.size)
    # Errors of the model count only where the data show any.
    for errors in (False, True):
        found = first
        for _ in range(_WEIGHT_ROUNDS):
            projection = spectrum.project(found.mean[:rows], used)
            base = base.with_data(projection.level, projection.dof)
            base = base.weighing(found, filters=True, skirts=True) if errors else base
            found = base.fit(found.structure, FINE)
        mean = found.mean[:rows]
        chi2 = chi_squared(projection.level / mean, projection.dof)
        left = max(projection.estimates - np.sum(template.active) - len(free_shapes(template.model)), 1.0)
        if chi2 <= beyond_doubt(left):
            break
    template = Template.of(content._replace(structure=found.structure), ramp)
    per_octave = base.bins.per_octave()
    degrees = 2.0 * np.asarray(base.levels.shape)
    ratio = projection.level / mean
    unshaped = _unshaped(found.structure, base, ratio)
    design, solution = _tangent(template, found, rate, degrees, per_octave, unshaped)
    sure = chi2 > beyond_doubt(left)
    error = error_of_powers(ratio, projection.dof, per_octave, left) if sure else 0.0
    misfit: dict[str, Any] = {"chi2": np.asarray(chi2), "power_error": np.asarray(error)}
    solution = solution._replace(**misfit)
    of = template.model, axis, template.active, spectrum, projection, design, solution, mean
    return template, inferred(*of), found.structure


def _tangent(
    template: Template,
    found: Fitted,
    rate: float,
    degrees: Float[np.ndarray, " capacity"],
    per_octave: Float[np.ndarray, " m"],
    unshaped: Container[int],
) -> tuple[LevelDesign, Solution]:
    """Levels around a fit, linear in all shapes, and the solution; see `_fillers` for the unshaped."""
    noise, component = template.noise, template.component
    shapes, theta = free_shapes(noise), np.asarray(found.maximum.theta)
    places = template.places(rate)
    base, by_shape = places.levels(found.maximum)
    power = theta[component] / places.unit_power(theta)
    passed = np.where(places.inside, power * (base @ degrees), 0.0)
    response_of_term = WHITE if passed[WHITE] > 0.0 else int(np.argmax(passed))
    levels_of_white, slopes_of_white = base[WHITE].copy(), by_shape[WHITE].copy()
    fillers = _fillers(noise, rate, [i for i, k in enumerate(component) if k in unshaped])
    for i, (plateau, by_own) in fillers.items():
        # Its power is redefined: at low frequencies it is that of white noise.
        power[WHITE] += plateau * power[i]
        base[i] -= plateau * levels_of_white
        by_shape[i] -= plateau * slopes_of_white
        for s, p in enumerate(shapes):
            if p.term == i:
                by_shape[i, :, s] -= plateau * by_own[p.parameter.name] * levels_of_white
    owner = [response_of_term if p.term == len(noise) else p.term for p in shapes]
    design = LevelDesign.of(base, by_shape, owner, degrees, per_octave)
    nothing, converged = np.asarray(0.0), np.asarray(np.isfinite(found.loss))
    solution: Any = power, shape_values(noise), nothing, nothing, converged, np.asarray(2.0 * found.loss)
    return design, Solution(*solution)


def _unshaped(structure: Structure, spectrum: Spectrum, ratio: Float[np.ndarray, " m"]) -> frozenset[int]:
    """Resonances around which the levels differ from the model."""
    f, rows, hertz = spectrum.bins.frequency, len(ratio), spectrum.bins.rate / (2.0 * np.pi)
    weight, found = np.asarray(spectrum.levels.shape)[:rows], set[int]()
    for k in structure.oscillators:
        apart = abs(np.log(f / (structure.frequency(k) * hertz)))
        w = np.where(apart < np.log(_AROUND), weight, 0.0)
        by_chance = np.count_nonzero(w)
        if (w @ (ratio - 1.0) ** 2 - by_chance) > _SHAPED**2 * w.sum():
            found.add(FULL.first_oscillator + int(k))
    return frozenset(found)


def _fillers(noise: Model, rate: float, unshaped: Sequence[int]) -> dict[int, tuple[float, dict[str, float]]]:
    """Terms that are white at low frequencies, where nothing distinguishes them from white noise.

    These include resonances whose oscillator shape the data do not show. By index: their density there at
    unit amplitude, and its logarithmic derivatives by ln(shape − bound).
    """
    found: dict[int, tuple[float, dict[str, float]]] = {}
    for i, term in enumerate(noise.terms):
        if isinstance(term, PowerLaw):
            found[i] = 1.0, {}
        elif isinstance(term, Markov):
            T = float(term.correlation_time or 0.0)
            if T * rate < _SHORT:
                found[i] = T**2, {"correlation_time": 2.0}
        elif isinstance(term, Resonance):
            f, Q = float(term.frequency or 0.0), float(term.quality_factor or 0.0)
            if Q < WIDE or i in unshaped:
                found[i] = 1.0 / (np.pi * f * Q), {"frequency": -1.0, "quality_factor": 0.5 / Q - 1.0}
    return found


def shape_values(noise: Model) -> Float[np.ndarray, " shapes"]:
    """Free shapes of a model with values, ln(value − lower bound)."""
    return np.log([float(p.start or 0.0) - p.parameter.lower for p in free_shapes(noise)])


class Extension(NamedTuple):
    """Fit of one axis with its extension, and the ranking of its terms."""

    result: AxisFit
    selection: AxisSelection


def extended(
    x: Float[np.ndarray, " n"], rate: float, plain: AxisFit, curve: AllanDeviation, k: int
) -> Extension | None:
    """Fit of one axis with components besides the plain terms; None if they explain little.

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
    of = content.structure
    besides = of.kind != NONE or len(of.oscillators) or len(of.markovs) or content.lines
    # Without plain terms nothing is to be corrected.
    if not besides or not content.plain_terms:
        return None
    selection = _selection(content, axis)
    content = content._replace(structure=_with_terms(content, selection))
    ramp = "drift_ramp" in selection.chosen.terms
    last = None
    for _ in range(_ROUNDS):
        template, found, structure = fit_jointly(content, ramp, axis, x)
        result = result_of(found, template.model, axis, template.active)
        if last is not None and not result.discrepancy <= _WORSE * last[1].discrepancy + _SLIGHT:
            # What was taken out was needed, though its size is not known.
            template, result = last
            break
        tidied = (
            _tidied(content._replace(structure=structure), template, result) if result.converged else None
        )
        if tidied is None:
            break
        content, last = tidied, (template, result)
    if not result.converged:
        return None
    inactive = [s for s, here in zip(template.model.term_labels, template.active, strict=True) if not here]
    model = extended_model(template.model, result.coefficients, inactive)
    deviation = np.sqrt(np.asarray(model.sampled(rate).allan_variance(curve.cluster_time)))
    misfit = misfit_of(curve.cluster_time, curve.deviation[:, k] / deviation, curve.edf[:, k], "s")
    # Deep in a stop band levels may be far off that no Allan deviation notices.
    left = min(result.discrepancy, misfit.rms)
    if (plain.converged and left > _LESS * plain.discrepancy) or (
        result.misfit is not None and misfit.excessive
    ):
        return None
    result = dataclasses.replace(result, own_template=template.model, plain=plain, _model=model)
    result = dataclasses.replace(result, allan_misfit=misfit.beside(result.misfit))
    return Extension(result, selection)


def _selection(content: Content, axis: Axis) -> AxisSelection:
    """Ranking of the terms by the spectrum divided by the effect of the rest of the structure."""
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
    # A ramp is not divided: it is in the lowest coefficients, which the structure does not change.
    corrected = content.c / np.exp(0.5 * np.interp(every, np.log(f), np.log(total / terms)))
    basic = basic_terms() + Markov()
    candidates = candidates_of(basic + Markov() if len(structure.markovs) > 1 else basic, fine.rate)
    statistics = bins.statistics(corrected[:, None], ramp_column(fine.n, fine.rate))
    return rank_terms(candidates, bins, statistics, [axis], axis.name).results[0]


def _with_terms(content: Content, selection: AxisSelection) -> Structure:
    """Structure with the chosen terms, and as many Markov processes as were chosen.

    If no set of terms suffices, those with a free time were left out, and the structure keeps its own.
    """
    chosen, structure = selection.chosen.terms, content.structure
    after = structure.kind != NONE and not structure.inside[QUANTIZATION]
    for k, label in enumerate(FIXED):
        if k == QUANTIZATION and after:
            # The search has chosen what follows the response.
            continue
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
    """Content without resonances and lines that the joint fit does not detect; None if it detects all.

    A resonance that has become as narrow as a line becomes a line.
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
    # Too narrow a resonance spoils its neighbours; these are judged once it is a line.
    unseen = sorted(
        (label for label, own in found.items() if not own["amplitude"].detected),
        key=lambda label: found[label]["amplitude"].value,
    )
    gone = list(narrow)
    # Overlapping resonances may be detected only together, not singly: the weakest goes first.
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
