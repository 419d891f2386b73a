"""Fit of a model to the levels of a spectrum: its slots in the joint model, designs, and the maximum.

Where a model cannot follow the levels within their scatter (p < 1e-6), all levels are given a relative error,
common to about an octave, that brings χ² to its degrees of freedom.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Bool, Float, Int

from allanjax.base.chi_squared import beyond_doubt, normal_score
from allanjax.estimate.design import Tangent, free_shapes, of_owners
from allanjax.estimate.gls import Solution
from allanjax.estimate.spectral.components import (
    BIQUAD,
    BUTTERWORTH_1,
    MOVING_AVERAGE,
    NONE,
    ONE_POLE,
    TWO_POLES,
    Levels,
    bandwidths,
    columns_of,
    levels_of,
    padded,
)
from allanjax.estimate.spectral.model import (
    FULL,
    Layout,
    Maximum,
    Others,
    Slots,
    maximize,
)
from allanjax.noise.model import Model, ModelParameter
from allanjax.noise.response import Biquad, Butterworth, LowPass1, LowPass2, MovingAverage
from allanjax.noise.terms import Markov, NoiseTerm, Resonance
from allanjax.spectrum.cosine import Bins

_COLUMN, _MARKOV, _OSCILLATOR, _OTHER = range(4)
# Power of what is not in use, which has levels, too, for its limit.
_NOTHING = 1e-290
# Farthest that a shape moves from its start, in ln: the spectrum's peaks locate a line better than that; the
# starts of other shapes are two to a decade or denser.
_REACH = {"line": 0.1, "time": 4.0, "frequency": 4.0, "number": 3.0}
# Margin kept from a shape's upper bound in ln, since the bound is open.
_INSIDE = 1e-2
# Number of times that a model's error is re-estimated, and the change below which it has settled.
_ROUNDS, _SETTLED = 8, 0.02
# Levels with fewer degrees of freedom say nothing about how well a model fits.
_FEW = 0.05
# Difference of minus twice the log-likelihood below which two solutions are the same.
_AS_LIKELY = 0.02


class Places(NamedTuple):
    """Where the terms of a model and their free shapes are in the slots of the joint spectral model.

    Attributes:
        layout: the slots.
        component: component of each term.
        parameter: parameter of each free shape.
        owner: term of each free shape; the number of terms for the response.
        inside: whether each term passes through the response.
        interval: sample interval [s].
    """

    layout: Layout
    component: Int[np.ndarray, " terms"]
    parameter: Int[np.ndarray, " shapes"]
    owner: Int[np.ndarray, " shapes"]
    inside: Bool[np.ndarray, " terms"]
    interval: float

    @property
    def _time(self) -> Int[np.ndarray, " terms"]:
        """Parameter with the correlation time of each Markov process, −1 of other terms."""
        k = self.component - self.layout.first_markov
        return np.where((k >= 0) & (k < self.layout.markovs), self.layout.times + k, -1)

    def unit_power(self, theta: Float[np.ndarray, " parameters"]) -> Float[np.ndarray, " terms"]:
        """Power of each term's component where the term has unit amplitude.

        That of a Gauss–Markov process is its variance q_c²T_c/2 (4.59).
        """
        return np.where(self._time >= 0, np.exp(theta[self._time]) * self.interval / 2.0, 1.0)

    def levels(
        self, maximum: Maximum
    ) -> tuple[Float[np.ndarray, "terms m"], Float[np.ndarray, "terms m shapes"]]:
        """Expected levels of each term of unit amplitude, and their derivatives by the free shapes, in ln."""
        at, model = self.layout, maximum.model
        unit = self.unit_power(np.asarray(maximum.theta))[:, None]
        base = np.asarray(model.unit)[self.component] * unit
        by_shape = np.zeros((*base.shape, len(self.parameter)))
        # What passes through the response changes in proportion.
        passing = self.inside[:, None] * base
        total = np.asarray(maximum.theta)[self.component] @ (passing / unit)
        for s, (p, k) in enumerate(zip(self.parameter.tolist(), self.owner.tolist(), strict=True)):
            if at.response <= p < at.other_shapes:
                slope = np.asarray(model.by_response)[p - at.response]
                by_shape[:, :, s] = passing * slope / np.where(total > 0.0, total, 1.0)
                continue
            row = p - at.times if p < at.response else len(at.owner) + p - at.other_shapes
            by_shape[k, :, s] = np.asarray(model.by_shape)[row] * unit[k]
            by_shape[k, :, s] += base[k] if p == self._time[k] else 0.0
        return base, by_shape


class Arrangement(NamedTuple):
    """A model of random terms in the slots of the joint spectral model.

    Attributes:
        model: the model.
        places: where its terms and free shapes are.
        slots: the slots; no parameter is free yet.
        levels: the levels, without data yet.
        offset: what is added to ln(value − lower bound) of each free shape for its parameter.
        held: parameters with the shapes that have a value.
        per_octave: number of levels in the octave around each.
    """

    model: Model
    places: Places
    slots: Slots
    levels: Levels
    offset: Float[np.ndarray, " shapes"]
    held: Float[np.ndarray, " parameters"]
    per_octave: Float[np.ndarray, " m"]

    @classmethod
    def of(cls, model: Model, bins: Bins) -> Arrangement:
        """Arrangement of a model for the levels of these bins."""
        model = model.sampled(bins.rate)
        kind, layout = _kinds(model)
        others = np.flatnonzero(kind == _OTHER)
        own = [p for p in model.parameters if p.free and p.term in others and not p.parameter.is_amplitude]
        layout = layout._replace(others=len(others), shapes=len(own))
        first = np.array([0, layout.first_markov, layout.first_oscillator, layout.first_other])
        before = np.array([np.sum(kind[:k] == kind[k]) for k in range(len(kind))], int)
        component = first[kind] + before
        columns = columns_of([model.terms[k] for k in np.flatnonzero(kind == _COLUMN)], bins)
        levels = levels_of(bins, columns, layout.columns)
        inside = np.zeros(layout.components, bool)
        inside[component] = model.inside or False
        further = None
        if own:
            shapes = tuple((int(before[p.term]), p.parameter.name, p.parameter.lower) for p in own)
            terms = tuple(model.terms[k] for k in others)
            further = Others.of(terms, shapes, bins, len(levels.shape))
        slots = Slots.of(layout, np.zeros(layout.parameters, bool), inside, _response(model), further)

        def place(p: ModelParameter) -> tuple[int, float]:
            """Parameter of one of the model's shapes, and its offset."""
            angle = math.log(2.0 * math.pi / bins.rate)
            frequency = p.parameter.name in ("frequency", "bandwidth")
            if p.term == len(model):
                return (layout.response, angle) if frequency else (layout.response + 1, 0.0)
            if kind[p.term] == _MARKOV:
                return layout.times + int(before[p.term]), math.log(bins.rate)
            if kind[p.term] == _OSCILLATOR:
                at = layout.frequencies if frequency else layout.qualities
                return at + int(before[p.term]), angle if frequency else 0.0
            return layout.other_shapes + own.index(p), 0.0

        held, free = slots.usual(), []
        slotted = np.append((kind == _MARKOV) | (kind == _OSCILLATOR), True)
        for p in model.parameters:
            if p.parameter.is_amplitude or not (p.free or slotted[p.term]):
                continue
            index, offset = place(p)
            if p.free:
                free.append((index, offset))
            if p.start is not None:
                held[index] = math.log(p.start - p.parameter.lower) + offset
        parameter, shift = np.array(free).reshape(-1, 2).T
        owner = np.array([p.term for p in free_shapes(model)], int)
        through = inside[component]
        places = Places(layout, component, parameter.astype(int), owner, through, 1.0 / bins.rate)
        return cls(model, places, slots, levels, shift, held, bins.per_octave())

    def with_data(self, level: Float[np.ndarray, " m"], dof: Float[np.ndarray, " m"]) -> Arrangement:
        """Copy with these mean squares [rate²] and degrees of freedom as data."""
        return self._replace(levels=self.levels.with_data(level, dof))

    def tangent(self, fit: LevelFit) -> LevelDesign:
        """Levels around a fit; the response belongs to the term that has most of what passes through it."""
        base, by_shape = self.places.levels(fit.maximum)
        dof, model, owner = 2.0 * self.levels.shape, self.model, self.places.owner
        if model.response is not None:
            passed = np.asarray(fit.solution.power) * (base @ dof) * np.array(model.inside)
            owner = np.where(owner == len(model), np.argmax(passed), owner)
        return LevelDesign.of(base, by_shape, owner.tolist(), dof, self.per_octave)

    def estimated(
        self, free: Bool[np.ndarray, " terms"], active: Bool[np.ndarray, " terms"]
    ) -> Bool[np.ndarray, " terms+shapes"]:
        """Which powers and which free shapes are estimated, if these terms are in use."""
        owned = of_owners(self.model, active)[self.places.owner]
        return np.concatenate([free & active, owned])


def _kinds(model: Model) -> tuple[Int[np.ndarray, " terms"], Layout]:
    """Kind of each term, and a layout that holds all; terms beyond its slots count as others."""
    kind = np.array([_kind(term) for term in model.terms], int)
    layout = FULL
    for k in (_MARKOV, _OSCILLATOR):
        kind[np.flatnonzero(kind == k)[layout[k] :]] = _OTHER
    columns = -(-np.sum(kind == _COLUMN) // layout.columns) * layout.columns
    return kind, layout._replace(columns=max(int(columns), layout.columns))


def _kind(term: NoiseTerm) -> int:
    """Kind of slot for a term."""
    free = [p for p in term.parameters()[1:] if term.is_free(p)]
    if not free:
        return _COLUMN
    if isinstance(term, Markov) and term.has_free_amplitude:
        return _MARKOV
    return _OSCILLATOR if isinstance(term, Resonance) else _OTHER


def _response(model: Model) -> int:
    """Kind of response of a model."""
    if model.response is None:
        return NONE
    if isinstance(model.response, Butterworth):
        return BUTTERWORTH_1 + model.response.order - 1
    kinds = {LowPass1: ONE_POLE, LowPass2: TWO_POLES, MovingAverage: MOVING_AVERAGE, Biquad: BIQUAD}
    return kinds[type(model.response)]


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class LevelDesign(Tangent):
    """Levels of a spectrum around a fit: independent, χ² around expectations that are linear in the shapes.

    A relative error of the model is taken to be common to the bins of an octave.

    Attributes:
        dof: degrees of freedom of each level.
        per_octave: number of bins in the octave around each bin.
    """

    dof: Float[np.ndarray, " m"]
    per_octave: Float[np.ndarray, " m"]

    @classmethod
    def of(
        cls,
        base: Float[np.ndarray, "terms capacity"],
        by_shape: Float[np.ndarray, "terms capacity shapes"],
        owner: Sequence[int],
        dof: Float[np.ndarray, " capacity"],
        per_octave: Float[np.ndarray, " m"],
    ) -> LevelDesign:
        """Levels of one axis, from arrays that may be padded."""
        m, owners = len(per_octave), np.array(owner, int)
        return cls(
            means=base[None, :, :m],
            by_shape=by_shape[None, :, :m],
            owner=owners,
            movable=np.ones(len(owners), bool),
            dof=dof[:m],
            per_octave=per_octave,
        )

    def variances(self, power: Float[np.ndarray, "axes h terms"]) -> Float[np.ndarray, "axes h m"]:
        return (power @ self.means) ** 2 / np.maximum(self.dof / 2.0, 1e-9)

    def weighed(
        self,
        power: Float[np.ndarray, "axes h terms"],
        error: Float[np.ndarray, " axes"],
        X: Float[np.ndarray, "axes h m k"],
    ) -> Float[np.ndarray, "axes h m k"]:
        variance = 1.0 / np.maximum(self.dof / 2.0, 1e-9) + error[:, None] ** 2 * self.per_octave
        return X * np.where(self.dof > 0.0, 1.0 / variance, 0.0)[:, None, :, None]


class LevelFit(NamedTuple):
    """Maximum of the likelihood of a model's levels.

    Attributes:
        solution: powers and shapes of its terms.
        maximum: the same in the slots, with the expected levels.
    """

    solution: Solution
    maximum: Maximum


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
    free: Bool[np.ndarray, " terms"],
    active: Bool[np.ndarray, " terms"],
    power: Float[ArrayLike, " terms"],
    shape: Float[ArrayLike, " shapes"],
    noise: Float[np.ndarray, " m"],
) -> LevelFit:
    """Maximum of the likelihood of one axis from a start.

    Args:
        arrangement: the model, with data.
        free: terms whose power is estimated.
        active: terms in use.
        power, shape: start values.
        noise: rough levels of the noise [rate²].
    """
    levels = arrangement.levels
    dof, capacity = 2.0 * levels.shape, len(levels.shape)
    noise, per_octave = padded(noise, capacity, 1.0), padded(arrangement.per_octave, capacity, 1.0)
    fit = _maximum(arrangement, free, active, np.asarray(power), np.asarray(shape), noise, 1.0)
    parameters = np.sum(arrangement.estimated(free, active))
    degrees = max(float(np.sum(np.minimum(dof, 1.0))) - parameters, 1.0)
    sufficient = fit.solution.converged and fit.solution.chi2 < beyond_doubt(degrees)
    error = 0.0
    for _ in range(_ROUNDS if np.isfinite(fit.solution.cost) and not sufficient else 0):
        wanted = error_of_powers(levels.level / fit.maximum.mean, dof, per_octave, degrees)
        if abs(wanted - error) <= _SETTLED * wanted:
            break
        error, share = wanted, share_with_error(dof, per_octave, wanted)
        start = np.asarray(fit.solution.power), np.asarray(fit.solution.shape)
        fit = _maximum(arrangement, free, active, *start, noise, share)
    final: Any = np.asarray(error)
    return fit._replace(solution=fit.solution._replace(power_error=final))


def _maximum(
    arrangement: Arrangement,
    free: Bool[np.ndarray, " terms"],
    active: Bool[np.ndarray, " terms"],
    power: Float[np.ndarray, " terms"],
    shape: Float[np.ndarray, " shapes"],
    noise: Float[np.ndarray, " capacity"],
    share: Any,
) -> LevelFit:
    """Maximum of the likelihood of levels that keep this share of their weight."""
    levels, slots, places = arrangement.levels, arrangement.slots, arrangement.places
    component, parameter, offset = places.component, places.parameter, arrangement.offset
    start, estimated = np.array(arrangement.held), np.array(slots.free)
    start[parameter] = shape + offset
    estimated[np.append(component, parameter)] = arrangement.estimated(free, active)
    start[component] = np.where(active, power * places.unit_power(start), _NOTHING)
    lower, upper, rate = np.array(slots.lower), np.array(slots.upper), 1.0 / places.interval
    for k, u, p in zip(parameter, offset, free_shapes(arrangement.model), strict=True):
        reach, terms = _REACH[p.parameter.kind], len(arrangement.model)
        top = np.log(_upper(int(slots.kind), p, terms, rate) - p.parameter.lower) - _INSIDE + u
        lower[k], upper[k] = max(lower[k], start[k] - reach), min(start[k] + reach, top)
    slots = dataclasses.replace(slots, free=estimated, lower=lower, upper=upper)
    found: Any = maximize(start, slots, levels._replace(shape=levels.shape * share), noise)
    theta, mean = found.theta, found.mean
    values: Any = (
        np.where(active, theta[component] / places.unit_power(theta), 0.0),
        theta[parameter] - offset,
        np.asarray(chi_squared(levels.level / mean, 2.0 * levels.shape)),
        np.asarray(0.0),
        np.asarray(found.converged & np.isfinite(found.loss)),
        np.asarray(-2.0 * np.sum(_log_densities(levels.level, mean, levels.shape * share))),
    )
    return LevelFit(Solution(*values), found)


def _upper(kind: int, p: ModelParameter, terms: int, rate: float) -> float:
    """Upper bound of a shape, of a term or of this kind of response, for samples at `rate` [Hz]."""
    if p.term == terms and p.parameter.name == "bandwidth":
        return bandwidths(kind)[1] * rate / (2.0 * np.pi)
    return p.parameter.upper


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
