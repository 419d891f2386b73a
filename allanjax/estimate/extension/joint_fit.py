"""Joint fit of terms, response, resonances and lines to an axis's spectrum, from a structure."""

from __future__ import annotations

from collections.abc import Container, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from allanjax.base.chi_squared import beyond_doubt
from allanjax.estimate.design import free_shapes
from allanjax.estimate.extension.content import Content
from allanjax.estimate.gls import Solution
from allanjax.estimate.spectral.fit import chi_squared, error_of_powers
from allanjax.estimate.spectral.level_design import TangentDesign
from allanjax.estimate.spectral.levels import padded
from allanjax.estimate.spectral.model import FULL
from allanjax.estimate.structure.as_model import response_of, term_of
from allanjax.estimate.structure.search import WIDE, Record
from allanjax.estimate.structure.structure import FINE, FIXED, OUTSIDE, WHITE, Fitted, Spectrum, Structure
from allanjax.estimate.whittle import WhittleFit, inferred, spectrum_of
from allanjax.noise.model import Model
from allanjax.noise.terms import Markov, NoiseTerm, PowerLaw, Resonance, Sinusoid, basic_terms
from allanjax.record.recording import Axis

# Rounds of projecting out ramp and lines and fitting the rest.
_ROUNDS = 2
# Numbers of terms, free shapes and levels that arrays have room for: those of the joint spectral model.
_TERMS, _SHAPES, _LEVELS = 24, 32, 1024
# Relative errors of what a response has taken away, and of a resonance farther from its peak than so many of
# its widths: judgements.
_FILTER, _SKIRT, _BESIDE = 0.05, 0.2, 1.5
# Relative error of the power around a resonance, up to this factor from its frequency, beyond which it is not
# shown to be the oscillator's shape: a judgement.
_SHAPED, _AROUND = 0.05, 1.5
# Correlation time [samples] below which a Markov process is filtered white noise.
_SHORT = 20.0


class Template(NamedTuple):
    """Model of an axis, with the values of a structure.

    Attributes:
        model: all five basic terms first, the ramp too, then Markov processes and what there is further.
        active: its terms that are in use; for the others there is a limit.
        component: of its random terms, the component of the structure.
    """

    model: Model
    active: Bool[np.ndarray, " terms"]
    component: Int[np.ndarray, " random"]

    @classmethod
    def of(cls, content: Content, ramp: bool) -> Template:
        """Template of what there is, with or without a ramp in use."""
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


def fit_jointly(
    content: Content, ramp: bool, axis: Axis, x: Float[np.ndarray, " n"]
) -> tuple[Template, WhittleFit, Structure]:
    """Joint fit of what the spectrum of these samples consists of, and its structure."""
    template, rate = Template.of(content, ramp), content.bins.rate
    base = Record(content.c**2, rate).binned(content.structure)
    spectrum = spectrum_of(template.model, x, rate, {}, bins=base.bins)
    used = spectrum.used([k for k in range(len(template.model)) if not template.active[k]])
    found, rows = base.fit(content.structure), len(base.bins.size)
    for _ in range(_ROUNDS):
        projection = spectrum.project(found.mean[:rows], used)
        base = base.with_data(projection.level, projection.dof).weighing(found, _error(found, base))
        found = base.fit(found.structure, FINE)
    template = Template.of(content._replace(structure=found.structure), ramp)
    mean, per_octave = found.mean[:rows], base.bins.per_octave()
    degrees = 2.0 * np.asarray(base.levels.shape)
    unshaped = _unshaped(found.structure, base, projection.level / mean)
    design, solution = _tangent(template, found, rate, degrees, per_octave, unshaped)
    left = max(projection.estimates - np.sum(template.active) - len(solution.shape), 1.0)
    ratio = projection.level / mean
    chi2 = chi_squared(ratio, projection.dof)
    sure = chi2 > beyond_doubt(left)
    error = error_of_powers(ratio, projection.dof, per_octave, left) if sure else 0.0
    misfit: dict[str, Any] = {"chi2": np.asarray(chi2), "power_error": np.asarray(error)}
    solution = solution._replace(**misfit)
    of = template.model, axis, template.active, spectrum, projection, design, solution, mean
    return template, inferred(*of), found.structure


def _error(found: Fitted, spectrum: Spectrum) -> Float[np.ndarray, " capacity"]:
    """Relative error of the levels where the response has fallen and on the skirts of resonances.

    No sensor's are just like the model's; such errors are common to an octave.
    """
    structure, bins = found.structure, spectrum.bins
    f, rows, square = bins.frequency, len(bins.size), np.zeros(len(bins.size))
    if (response := response_of(structure, bins.rate)) is not None:
        fallen = 1.0 - np.minimum(np.asarray(response.power(f, bins.rate)), 1.0)
        square += (_FILTER * fallen) ** 2
    hertz = bins.rate / (2.0 * np.pi)
    for k in structure.oscillators:
        beside = abs(f - structure.frequency(k) * hertz) > _BESIDE * structure.width(k) * hertz
        square += np.where(beside, _SKIRT * found.resonant[k, :rows], 0.0) ** 2
    return padded(np.sqrt(square * bins.per_octave()), len(spectrum.size), 0.0)


def _tangent(
    template: Template,
    found: Fitted,
    rate: float,
    degrees: Float[np.ndarray, " capacity"],
    per_octave: Float[np.ndarray, " m"],
    unshaped: Container[int],
) -> tuple[TangentDesign, Solution]:
    """Levels around a fit, linear in all shapes, and the solution; see `_fillers` for the unshaped."""
    random = [k for k, term in enumerate(template.model.terms) if not term.deterministic]
    noise = template.model.without(
        [label for k, label in enumerate(template.model.term_labels) if k not in random]
    )
    at, slope, structure = FULL, found.slope * found.mean, found.structure
    component, shapes = template.component, free_shapes(noise)
    # A Gauss–Markov process of unit amplitude has the variance T_c/2 (4.59).
    is_markov = (component >= at.first_markov) & (component < at.first_oscillator)
    time = np.array(
        [
            structure.time(k - at.first_markov) / rate if m else 2.0
            for k, m in zip(component, is_markov, strict=True)
        ]
    )
    unit = slope[component] / found.by_power[component, None] * (time / 2.0)[:, None]
    power = structure.power[component] / (time / 2.0)
    inside = np.array(noise.inside, bool) if noise.response is not None else np.zeros(len(noise), bool)
    levels = np.where(inside & (power > 0.0), (power[:, None] * unit).sum(axis=1), 0.0)
    owner_of_response = WHITE if levels[WHITE] > 0.0 else int(np.argmax(levels))
    owner, by_shape = [], np.zeros((len(noise), unit.shape[1], len(shapes)))
    for s, p in enumerate(shapes):
        if p.term == len(noise):
            owner.append(owner_of_response)
            of_response = found.by_response[int(p.parameter.name != "bandwidth")]
            by_shape[:, :, s] = of_response[component] * (time / 2.0)[:, None]
            continue
        k = p.term
        owner.append(k)
        if power[k] > 0.0:
            place = _parameter(p.parameter.name, int(component[k]))
            by_shape[k, :, s] = slope[place] / power[k] + (unit[k] if is_markov[k] else 0.0)
    levels_of_white, slopes_of_white = unit[WHITE].copy(), by_shape[WHITE].copy()
    fillers = _fillers(noise, rate, [i for i, k in enumerate(component) if k in unshaped])
    for i, (plateau, by_own) in fillers.items():
        # Powers are counted anew: what it has at low frequencies is that of white noise.
        power[WHITE] += plateau * power[i]
        unit[i] -= plateau * levels_of_white
        by_shape[i] -= plateau * slopes_of_white
        for s, p in enumerate(shapes):
            if p.term == i:
                by_shape[i, :, s] -= plateau * by_own[p.parameter.name] * levels_of_white
    room = [(0, _TERMS - len(noise)), (0, max(_LEVELS - unit.shape[1], 0))]
    design = TangentDesign(
        owner=padded(np.array(owner, int), _SHAPES, 0),
        terms=np.asarray(len(noise)),
        rows=np.asarray(len(per_octave)),
        moves=np.arange(_SHAPES) < len(shapes),
        per_octave=padded(per_octave, max(_LEVELS, unit.shape[1]), 1.0),
        base=np.pad(unit, room),
        by_shape=np.pad(by_shape, [*room, (0, _SHAPES - len(shapes))]),
        centre=padded(shape_values(noise), _SHAPES, 0.0),
        degrees_of_freedom=padded(degrees, max(_LEVELS, len(degrees)), 0.0),
    )
    nothing, converged = np.asarray(0.0), np.asarray(np.isfinite(found.loss))
    values: Any = power, shape_values(noise), nothing, nothing, converged, np.asarray(2.0 * found.loss)
    return design, Solution(*values)


def _unshaped(structure: Structure, spectrum: Spectrum, ratio: Float[np.ndarray, " m"]) -> frozenset[int]:
    """Components that are resonances around which the levels are not those of the model."""
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
    """Terms that are white at low frequencies, which nothing tells from white noise there.

    So are resonances that are not shown to have an oscillator's shape. By index: their density there for unit
    amplitude, and its logarithmic derivatives by ln(shape − bound).
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


def _parameter(name: str, component: int) -> int:
    """Parameter of the joint spectral model that a shape of a component is."""
    at = FULL
    if component < at.first_oscillator:
        return at.times + component - at.first_markov
    first = at.frequencies if name == "frequency" else at.qualities
    return first + component - at.first_oscillator
