"""Fit of a model to the levels of a spectrum: its slots in the joint model, the maximum, and its tangent.

Where a model cannot follow the levels within their scatter (p < 1e-6), these first get the errors that models
of filters and resonances have; where that does not suffice, all get a relative error, common to about an
octave, that brings χ² to its degrees of freedom.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Bool, Float, Int

from allanjax.base.chi_squared import beyond_doubt, normal_score
from allanjax.estimate.design import INSIDE, REACH, Tangent, free_powers, free_shapes, of_owners
from allanjax.estimate.gls import Solution
from allanjax.estimate.spectral.components import Levels, bandwidths, columns_of, kind_of
from allanjax.estimate.spectral.expected import Others
from allanjax.estimate.spectral.model import FULL, Layout, Maximum, Slots, maximize
from allanjax.noise.model import Model
from allanjax.noise.terms import Markov, NoiseTerm, Resonance
from allanjax.spectrum.cosine import Bins

_COLUMN, _MARKOV, _OSCILLATOR, _OTHER = range(4)
# Power of what is not in use, which has levels, too, for its limit.
_NOTHING = 1e-290
# Number of times that a model's error is re-estimated, and the change below which it has settled.
_ROUNDS, _SETTLED = 8, 0.02
# Levels with fewer degrees of freedom say nothing about how well a model fits.
_FEW = 0.05
# Difference of minus twice the log-likelihood below which two solutions are the same.
_AS_LIKELY = 0.02
# Gain of the next step at which a fit ends [nats].
_TOLERANCE = 1e-7
#: Relative errors of a model's parts, which are judgements: of a response, per factor of e by which it has
# fallen; of a resonance, whose frequency and damping drift; and of its skirt, so many widths from its peak.
FILTER, UNSTEADY, _SKIRT, _BESIDE = 0.05, 0.1, 0.2, 1.5
#: Distance of two resonances, in the mean of their widths, below which they may be one that moves.
CLOSE = 1.5


class Arrangement(NamedTuple):
    """A model of random terms in the slots of the joint spectral model.

    Attributes:
        model: the model.
        rate: sample rate [Hz].
        component: component of each term.
        parameter, offset: parameter of each free shape, and what is added to ln(value − lower bound) for it.
        owner: term of each free shape; the number of terms for the response.
        inside: whether each term passes through the response.
        slots: the slots; no parameter is free yet.
        levels: the levels, without data yet.
        held: parameters with the shapes that have a value.
        bins: bins of the levels.
    """

    model: Model
    rate: float
    component: Int[np.ndarray, " terms"]
    parameter: Int[np.ndarray, " shapes"]
    offset: Float[np.ndarray, " shapes"]
    owner: Int[np.ndarray, " shapes"]
    inside: Bool[np.ndarray, " terms"]
    slots: Slots
    levels: Levels
    held: Float[np.ndarray, " parameters"]
    bins: Bins

    @classmethod
    def of(cls, model: Model, bins: Bins) -> Arrangement:
        """Arrangement of a model for the levels of these bins."""
        model, rate = model.sampled(bins.rate), bins.rate
        kind = _kinds(model)
        others = np.flatnonzero(kind == _OTHER)
        own = [p for p in free_shapes(model) if p.term in others]
        count = max(FULL.columns, int(np.sum(kind == _COLUMN)))
        layout = Layout(count, others=len(others), shapes=len(own))
        first = np.array([0, layout.first_markov, layout.first_oscillator, layout.first_other])
        before = np.array([np.sum(kind[:k] == kind[k]) for k in range(len(kind))], int)
        component = first[kind] + before
        columns = columns_of([model.terms[k] for k in np.flatnonzero(kind == _COLUMN)], bins)
        levels = Levels.of(bins, columns)
        inside = np.zeros(layout.components, bool)
        inside[component] = model.inside or False
        further = None
        if own:
            shapes = tuple((int(before[p.term]), p.parameter.name, p.parameter.lower) for p in own)
            further = Others.of(tuple(model.terms[k] for k in others), shapes, bins)
        slots = Slots.of(layout, np.zeros(layout.parameters, bool), inside, kind_of(model.response), further)
        # Kind of each owner of shapes, the response last; units are the sample interval's.
        slot, angle = [*kind.tolist(), None], math.log(2.0 * math.pi / rate)
        places = {
            (_MARKOV, "correlation_time"): (layout.times, math.log(rate)),
            (_OSCILLATOR, "frequency"): (layout.frequencies, angle),
            (_OSCILLATOR, "quality_factor"): (layout.qualities, 0.0),
            (None, "bandwidth"): (layout.response, angle),
            (None, "quality_factor"): (layout.response + 1, 0.0),
        }
        held, free = slots.usual(), []
        for p in model.parameters:
            if p.parameter.is_amplitude or not (p.free or slot[p.term] in (_MARKOV, _OSCILLATOR, None)):
                continue
            if slot[p.term] == _OTHER:
                index, offset = layout.other_shapes + own.index(p), 0.0
            else:
                index, offset = places[slot[p.term], p.parameter.name]
                index += int(before[p.term]) if p.term < len(model) else 0
            if p.free:
                free.append((index, offset, p.term))
            if p.start is not None:
                held[index] = math.log(p.start - p.parameter.lower) + offset
        parameter, offsets, owner = np.array(free).reshape(-1, 3).T
        of_shapes = parameter.astype(int), offsets, owner.astype(int)
        return cls(model, rate, component, *of_shapes, inside[component], slots, levels, held, bins)

    def with_data(self, level: Float[np.ndarray, " m"], dof: Float[np.ndarray, " m"]) -> Arrangement:
        """Copy with these mean squares [rate²] and degrees of freedom as data."""
        return self._replace(levels=self.levels.with_data(level, dof))

    @property
    def _time(self) -> Int[np.ndarray, " terms"]:
        """Parameter with the correlation time of each Markov process, −1 of other terms."""
        k = self.component - self.slots.layout.first_markov
        return np.where((k >= 0) & (k < self.slots.layout.markovs), self.slots.layout.times + k, -1)

    def unit_power(self, theta: Float[np.ndarray, " parameters"]) -> Float[np.ndarray, " terms"]:
        """Power of each term's component where the term has unit amplitude.

        That of a Gauss–Markov process is its variance q_c²T_c/2 (4.59).
        """
        return np.where(self._time >= 0, np.exp(theta[self._time]) / (2.0 * self.rate), 1.0)

    def estimated(self, active: Bool[np.ndarray, " terms"]) -> Bool[np.ndarray, " terms+shapes"]:
        """Which powers and which free shapes are estimated, if these terms are in use."""
        owned = of_owners(self.model, active)[self.owner]
        return np.concatenate([free_powers(self.model) & active, owned])

    def fitted_model(self, fit: LevelFit) -> Model:
        """The model with the shapes of a fit, and unit amplitudes."""
        values = zip(free_shapes(self.model), np.exp(fit.solution.shape), strict=True)
        return self.model.with_values(**{p.label: float(p.parameter.lower + x) for p, x in values})

    def unit_levels(
        self, maximum: Maximum
    ) -> tuple[Float[np.ndarray, "terms m"], Float[np.ndarray, "terms m shapes"]]:
        """Levels of each term of unit amplitude, and their derivatives by the free shapes, in ln."""
        at, model, theta = self.slots.layout, maximum.model, maximum.theta
        unit = self.unit_power(theta)[:, None]
        base = model.unit[self.component] * unit
        by_shape = np.zeros((*base.shape, len(self.parameter)))
        # What passes through the response changes in proportion.
        passing = self.inside[:, None] * base
        total = theta[self.component] @ (passing / unit)
        for s, (p, k) in enumerate(zip(self.parameter.tolist(), self.owner.tolist(), strict=True)):
            if p >= at.response:
                slope = model.by_response[p - at.response]
                by_shape[:, :, s] = passing * slope / np.where(total > 0.0, total, 1.0)
                continue
            by_shape[k, :, s] = model.by_shape[p - at.times] * unit[k]
            by_shape[k, :, s] += base[k] if p == self._time[k] else 0.0
        return base, by_shape

    def tangent(
        self, fit: LevelFit, plateaus: Mapping[int, Mapping[str, float]], white: int
    ) -> tuple[LevelTangent, Solution]:
        """Levels around a fit, linear in all shapes, and the solution in them.

        Args:
            fit: the fit.
            plateaus: for each term that is white at low frequencies its density there, for unit amplitude
                (""), and the logarithmic derivatives of that by its shapes. What it has there is counted
                as white noise, so that its own power is what it has beyond.
            white: index of the white noise term.
        """
        base, by_shape = self.unit_levels(fit.maximum)
        power: Any = np.array(fit.solution.power)
        # The response belongs to the term that has most of what passes through it.
        passed, owner = np.where(self.inside, power * (base @ fit.degrees), 0.0), self.owner
        owner = np.where(owner == len(power), np.argmax(passed), owner)
        level, slope = base[white].copy(), by_shape[white].copy()
        for k, plateau in plateaus.items():
            power[white] += plateau[""] * power[k]
            base[k] -= plateau[""] * level
            by_shape[k] -= plateau[""] * slope
            for s, p in enumerate(free_shapes(self.model)):
                if p.term == k:
                    by_shape[k, :, s] -= plateau[""] * plateau[p.parameter.name] * level
        tangent = LevelTangent(
            means=base[None],
            by_shape=by_shape[None],
            owner=owner,
            degrees=fit.degrees,
            per_octave=self.bins.per_octave(),
        )
        return tangent, fit.solution._replace(power=power)

    def uncertainty(self, fit: LevelFit) -> Float[np.ndarray, " m"]:
        """Relative variance of the levels from what sensors' filters and resonances differ from the model.

        Resonances drift, the more so where several stand for one that moves. Skirts and filters are nowhere
        just like the model's, which is common to the levels of an octave.
        """
        bins, model = self.bins, self.fitted_model(fit)
        mean = fit.maximum.mean
        drifting, common = np.zeros(len(mean)), np.zeros(len(mean))
        if model.response is not None:
            fallen = np.log(np.maximum(np.asarray(model.response.power(bins.frequency, bins.rate)), 1e-300))
            common += (FILTER * np.minimum(fallen, 0.0)) ** 2
        theta, f, narrow = fit.maximum.theta, bins.frequency, []
        for k, term in zip(self.component.tolist(), model.terms, strict=True):
            if isinstance(term, Resonance):
                share = theta[k] * fit.maximum.model.unit[k] / mean
                narrow.append((float(term.frequency or 1.0), float(term.quality_factor or 1.0), share))
        for middle, quality, share in narrow:
            near = sum(abs(middle - g) < CLOSE * 0.5 * (middle / quality + g / Q) for g, Q, _ in narrow)
            drifting += UNSTEADY * near * share
            beside = abs(f - middle) > _BESIDE * middle / quality
            common += np.where(beside, _SKIRT * share, 0.0) ** 2
        return drifting**2 + common * bins.per_octave()


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class LevelTangent(Tangent):
    """Levels of a spectrum around a fit: independent, χ² around expectations that are linear in the shapes.

    Attributes:
        degrees: degrees of freedom of each level.
        per_octave: number of levels in the octave around each, which share an error of the model.
    """

    degrees: Float[np.ndarray, " m"]
    per_octave: Float[np.ndarray, " m"]

    def variances(self, power: Float[np.ndarray, "axes terms"]) -> Float[np.ndarray, "axes m"]:
        return 2.0 * self.mean(power) ** 2 / np.maximum(self.degrees, 1e-9)

    def weighed(
        self,
        power: Float[np.ndarray, "axes terms"],
        error: Float[np.ndarray, " axes"],
        X: Float[np.ndarray, "axes m k"],
    ) -> Float[np.ndarray, "axes m k"]:
        variance = 2.0 / np.maximum(self.degrees, 1e-9) + error[:, None] ** 2 * self.per_octave
        return X * np.where(self.degrees > 0.0, 1.0 / variance, 0.0)[:, :, None]


def _kinds(model: Model) -> Int[np.ndarray, " terms"]:
    """Kind of each term; those beyond the slots of their kind count as others."""
    kind = np.array([_kind(term) for term in model.terms], int)
    for k, slots in ((_MARKOV, FULL.markovs), (_OSCILLATOR, FULL.oscillators)):
        kind[np.flatnonzero(kind == k)[slots:]] = _OTHER
    return kind


def _kind(term: NoiseTerm) -> int:
    free = [p for p in term.parameters()[1:] if term.is_free(p)]
    if not free:
        return _COLUMN
    if isinstance(term, Markov) and term.has_free_amplitude:
        return _MARKOV
    return _OSCILLATOR if isinstance(term, Resonance) else _OTHER


class LevelFit(NamedTuple):
    """Maximum of the likelihood of a model's levels.

    Attributes:
        solution: powers and shapes of its terms.
        maximum: the same in the slots, with the expected levels.
        sufficient: whether the model follows the levels within their scatter.
        degrees: degrees of freedom of the levels, less what the model's uncertainty costs.
    """

    solution: Solution
    maximum: Maximum
    sufficient: bool
    degrees: Float[np.ndarray, " m"]


def chi_squared(ratio: Float[ArrayLike, " m"], dof: Float[ArrayLike, " m"], share: ArrayLike = 1.0) -> float:
    """χ² of levels from their ratios to their expectations, each weighted by its share."""
    square = normal_score(ratio, dof) ** 2
    return float(np.sum((square * share)[np.asarray(dof) > _FEW]))


def share_with_error(dof: Any, per_octave: Any, error: Any) -> Any:
    """Share of their weight that levels keep if the model has a relative error that is common to an octave.

    The relative variance 2/dof of each becomes 2/dof + per_octave·error². For arrays of NumPy or JAX.
    """
    return 1.0 / (1.0 + 0.5 * dof * per_octave * error**2)


def error_of_powers(
    ratio: Float[ArrayLike, " m"],
    dof: Float[ArrayLike, " m"],
    per_octave: Float[np.ndarray, " m"],
    degrees: float,
) -> float:
    """Relative error of a model's levels that brings χ² to its degrees of freedom; 0 if χ² is not above them.

    Args:
        ratio: levels over their expectations.
        dof: degrees of freedom of the levels.
        per_octave: number of levels in an octave, which share the error.
        degrees: degrees of freedom of χ².
    """
    from scipy.optimize import brentq

    def excess(error: float) -> float:
        return chi_squared(ratio, dof, share_with_error(np.asarray(dof), per_octave, error)) - degrees

    return float(brentq(excess, 0.0, 1e3)) if excess(0.0) > 0.0 else 0.0


def fit_levels(
    arrangement: Arrangement,
    active: Bool[np.ndarray, " terms"],
    power: Float[ArrayLike, " terms"],
    shape: Float[ArrayLike, " shapes"],
    noise: Float[np.ndarray, " m"],
) -> LevelFit:
    """Maximum of the likelihood of one axis from a start.

    Args:
        arrangement: the model, with data.
        active: terms in use.
        power, shape: start values.
        noise: rough levels of the noise [rate²].
    """
    dof, per_octave = 2.0 * arrangement.levels.shape, arrangement.bins.per_octave()
    degrees = max(float(np.sum(np.minimum(dof, 1.0))) - np.sum(arrangement.estimated(active)), 1.0)

    def fitted(power: Any, shape: Any, share: Any = 1.0) -> LevelFit:
        solution, maximum = _maximum(arrangement, active, np.asarray(power), np.asarray(shape), noise, share)
        enough = bool(solution.converged and solution.chi2 < beyond_doubt(degrees))
        return LevelFit(solution, maximum, enough, dof)

    fit, error, share = fitted(power, shape), 0.0, np.ones(len(dof))
    if not fit.sufficient and np.isfinite(fit.solution.cost):
        share = 1.0 / (1.0 + 0.5 * dof * arrangement.uncertainty(fit))
        fit = fitted(*fit.solution[:2], share) if np.any(share < 1.0) else fit
    for _ in range(_ROUNDS if np.isfinite(fit.solution.cost) and not fit.sufficient else 0):
        wanted = error_of_powers(arrangement.levels.level / fit.maximum.mean, dof, per_octave, degrees)
        if abs(wanted - error) <= _SETTLED * wanted:
            break
        error = wanted
        fit = fitted(*fit.solution[:2], share * share_with_error(share * dof, per_octave, error))
    final: Any = np.asarray(error)
    return fit._replace(solution=fit.solution._replace(power_error=final), degrees=share * dof)


def _maximum(
    arrangement: Arrangement,
    active: Bool[np.ndarray, " terms"],
    power: Float[np.ndarray, " terms"],
    shape: Float[np.ndarray, " shapes"],
    noise: Float[np.ndarray, " m"],
    share: Any,
) -> tuple[Solution, Maximum]:
    """Maximum of the likelihood of levels that keep this share of their weight."""
    levels, slots = arrangement.levels, arrangement.slots
    component, parameter, offset = arrangement.component, arrangement.parameter, arrangement.offset
    start, estimated = np.array(arrangement.held), np.array(slots.free)
    start[parameter] = shape + offset
    estimated[np.append(component, parameter)] = arrangement.estimated(active)
    start[component] = np.where(active, power * arrangement.unit_power(start), _NOTHING)
    lower, upper, terms = np.array(slots.lower), np.array(slots.upper), len(arrangement.model)
    for k, u, p in zip(parameter, offset, free_shapes(arrangement.model), strict=True):
        reach, top = REACH[p.parameter.kind], p.parameter.upper
        if p.term == terms and p.parameter.name == "bandwidth":
            top = bandwidths(int(slots.kind))[1] * arrangement.rate / (2.0 * np.pi)
        end = np.log(top - p.parameter.lower) - INSIDE + u
        lower[k], upper[k] = max(lower[k], start[k] - reach), min(start[k] + reach, end)
    slots = dataclasses.replace(slots, free=estimated, lower=lower, upper=upper)
    found: Any = maximize(start, slots, levels._replace(shape=levels.shape * share), noise, _TOLERANCE)
    theta, mean = found.theta, found.mean
    values: Any = (
        np.where(active, theta[component] / arrangement.unit_power(theta), 0.0),
        theta[parameter] - offset,
        np.asarray(chi_squared(levels.level / mean, 2.0 * levels.shape)),
        np.asarray(0.0),
        np.asarray(found.converged & np.isfinite(found.loss)),
        np.asarray(-2.0 * np.sum(_log_densities(levels.level, mean, levels.shape * share))),
    )
    return Solution(*values), found


def _log_densities(
    level: Float[np.ndarray, " m"], mean: Float[np.ndarray, " m"], shape: Float[np.ndarray, " m"]
) -> Float[np.ndarray, " m"]:
    """Logarithm of each level's density, a Gamma law of this mean and shape; 0 of levels that only pad.

    It is normalized, so that solutions with different errors of the model can be compared.
    """
    from scipy.special import gammaln

    known, k = shape > 0.0, np.where(shape > 0.0, shape, 1.0)
    level = np.where(known, np.maximum(level, 1e-300), 1.0)
    ratio = level / np.where(known, mean, 1.0)
    return np.where(known, k * (np.log(k * ratio) - ratio) - gammaln(k) - np.log(level), 0.0)


def best_of(fits: Sequence[LevelFit]) -> LevelFit:
    """The most likely fit; of equally likely ones a converged one, if there is any."""
    cost = [float(np.nan_to_num(fit.solution.cost, nan=np.inf)) for fit in fits]
    close = [fit for fit, c in zip(fits, cost, strict=True) if c <= min(cost) + _AS_LIKELY]
    return next((fit for fit in close if fit.solution.converged), close[0])
