"""Fit of a model to the levels of a spectrum: its slots in the joint model, designs, and the maximum.

Where a model cannot follow the levels within their scatter (p < 1e-6), all levels are given a relative error,
common to about an octave, that brings χ² to its degrees of freedom.
"""

from __future__ import annotations

import abc
import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Shaped

from allanjax.base.arrays import namespace
from allanjax.base.chi_squared import beyond_doubt, normal_score
from allanjax.base.linalg import CholeskyWhitened
from allanjax.estimate.design import Design, free_shapes
from allanjax.estimate.gls import Solution
from allanjax.estimate.inference import Inference, infer, without_padding
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
    room_for,
)
from allanjax.estimate.spectral.model import (
    FULL,
    Layout,
    Others,
    Slots,
    expected,
    maximize,
)
from allanjax.noise.model import Model, ModelParameter
from allanjax.noise.response import Biquad, Butterworth, LowPass1, LowPass2, MovingAverage
from allanjax.noise.terms import Markov, NoiseTerm, Resonance
from allanjax.spectrum.cosine import Bins

_COLUMN, _MARKOV, _OSCILLATOR, _OTHER = range(4)
# Numbers of levels in a tight arrangement are multiples of this.
_TIGHT = 64
# Farthest that a shape moves from its start, in ln: the spectrum's peaks locate a line better than that; the
# starts of other shapes are two to a decade or denser.
_REACH = {"line": 0.1, "time": 4.0, "frequency": 4.0, "number": 3.0}
# Margin kept from a shape's upper bound in ln, since the bound is open.
_INSIDE = 1e-2
# Numbers of terms and free shapes to which arrays are padded; beyond, multiples of the last.
_TERMS, _SHAPES = (8, 24), (4, 8, 32)
# Number of times that a model's error is re-estimated, and the change below which it has settled.
_ROUNDS, _SETTLED = 8, 0.02
# Levels with fewer degrees of freedom say nothing about how well a model fits.
_FEW = 0.05
# Difference of minus twice the log-likelihood below which two solutions are the same.
_AS_LIKELY = 0.02


class Arrangement(NamedTuple):
    """A model of random terms in the slots of the joint spectral model.

    Attributes:
        slots: the slots; no parameter is free yet.
        levels: the levels, without data yet.
        component: component of each term.
        time: parameter with the correlation time of each Markov process in a slot, −1 of other terms.
        parameter, offset: parameter of each free shape of the model, and what is added to ln(value − lower
            bound) for it.
        held: parameters with the shapes that have a value.
    """

    slots: Slots
    levels: Levels
    component: Int[np.ndarray, " terms"]
    time: Int[np.ndarray, " terms"]
    parameter: Int[np.ndarray, " shapes"]
    offset: Float[np.ndarray, " shapes"]
    held: Float[np.ndarray, " parameters"]

    @classmethod
    def of(cls, model: Model, bins: Bins, tight: bool = False) -> Arrangement:
        """Arrangement of a model for the levels of these bins, without spare slots if `tight`.

        A tight one is evaluated faster, but is compiled anew for each structure of a model.
        """
        model = model.sampled(bins.rate)
        kind, layout = _kinds(model, tight)
        others = np.flatnonzero(kind == _OTHER)
        own = [p for p in model.parameters if p.free and p.term in others and not p.parameter.is_amplitude]
        layout = layout._replace(others=len(others), shapes=len(own))
        first = np.array([0, layout.first_markov, layout.first_oscillator, layout.first_other])
        before = np.array([np.sum(kind[:k] == kind[k]) for k in range(len(kind))], int)
        component = first[kind] + before
        columns = columns_of([model.terms[k] for k in np.flatnonzero(kind == _COLUMN)], bins)
        capacity = -(-len(bins.size) // _TIGHT) * _TIGHT if tight else None
        levels = levels_of(bins, columns, layout.columns, capacity)
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

        held = slots.usual()
        free = []
        slotted = np.append((kind == _MARKOV) | (kind == _OSCILLATOR), True)
        for p in model.parameters:
            if p.parameter.is_amplitude or not (p.free or slotted[p.term]):
                continue
            index, offset = place(p)
            if p.free:
                free.append((index, offset))
            if p.start is not None:
                held[index] = math.log(p.start - p.parameter.lower) + offset
        time = np.where(kind == _MARKOV, layout.times + before, -1)
        parameter, shift = np.array(free).reshape(-1, 2).T
        return cls(slots, levels, component, time, parameter.astype(int), shift, held)


def _kinds(model: Model, tight: bool) -> tuple[Int[np.ndarray, " terms"], Layout]:
    """Kind of each term, and a layout that holds all; terms beyond its slots count as others."""
    kind = np.array([_kind(term) for term in model.terms], int)
    layout = FULL
    for k in (_MARKOV, _OSCILLATOR):
        kind[np.flatnonzero(kind == k)[layout[k] :]] = _OTHER
    if tight:
        kept = [int(np.sum(kind == k)) for k in range(_OTHER)]
        return kind, Layout(max(kept[_COLUMN], 1), kept[_MARKOV], kept[_OSCILLATOR])
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


class LevelDesign(Design):
    """Model of a spectrum's levels: independent, each with a χ² law around its expectation.

    A relative error of the model is taken to be common to the bins of an octave.

    Attributes:
        moves: which shapes exist; the others are padding.
        per_octave: number of bins in the octave around each bin.
    """

    moves: Bool[np.ndarray, " shapes"]
    per_octave: Float[np.ndarray, " m"]

    @property
    @abc.abstractmethod
    def degrees(self) -> Float[np.ndarray, " m"]:
        """Degrees of freedom of each level; 0 for padding."""

    @property
    @abc.abstractmethod
    def room(self) -> int:
        """Number of terms after padding."""

    @property
    def movable(self) -> Bool[np.ndarray, " shapes"]:
        return self.moves

    @property
    def has_shapes(self) -> bool:
        return True

    def padded_estimates(self, V: Float[np.ndarray, "axes m"]) -> Float[np.ndarray, "axes capacity"]:
        return padded(V, len(self.per_octave), 1.0)

    def padded_terms(self, values: Shaped[np.ndarray, "... terms"]) -> Shaped[np.ndarray, "... slots"]:
        return padded(values, self.room, 0)

    def padded_shapes(self, values: Float[np.ndarray, "... shapes"]) -> Float[np.ndarray, "... slots"]:
        return padded(values, len(self.moves), 0)

    def mean(self, power: Float[Array, " terms"], means: Float[Array, "terms m"]) -> Float[Array, " m"]:
        there = jnp.arange(means.shape[1]) < self.rows
        return jnp.where(there, power @ means, 1.0)

    def products(self, shape: Float[Array, " shapes"]) -> Array:
        return self.means(shape)

    def covariance(self, power: Float[Array, " terms"], products: Array) -> Array:
        return self.mean(power, products) ** 2 / jnp.maximum(self.degrees / 2.0, 1e-9)

    def variances(self, covariance: Array) -> Float[Array, " m"]:
        return covariance

    def whiten(
        self,
        covariance: Array,
        mean: Float[Array, " m"],
        power_error: Float[Array, ""],
        X: Float[Array, "m k"],
    ) -> CholeskyWhitened:
        relative = covariance / mean**2 + power_error**2 * self.per_octave
        known = jnp.asarray(self.degrees) / 2.0 > 0.0
        scale = jnp.where(known, 1.0 / jnp.sqrt(relative), 0.0)
        return CholeskyWhitened(X * scale[:, None], 0.5 * jnp.sum(jnp.where(known, jnp.log(relative), 0.0)))

    def whiten_and_weigh(
        self,
        covariance: Array,
        mean: Float[Array, " m"],
        power_error: Float[Array, ""],
        X: Float[Array, "m k"],
    ) -> tuple[Float[Array, "m k"], Float[Array, "k m"]]:
        scale = self.whiten(covariance, mean, power_error, jnp.ones((len(mean), 1))).values
        return X * scale, (X * scale**2).T

    @property
    def weight(self) -> Float[Array, " m"]:
        return jnp.asarray(self.degrees)


class TangentDesign(LevelDesign):
    """Levels whose expectations are linear in the shapes around a solution.

    Attributes:
        base: levels of each term of unit amplitude at the solution.
        by_shape: their derivatives by the shapes there.
        centre: the shapes there.
        degrees_of_freedom: of each level.
    """

    base: Float[ArrayLike, "terms m"]
    by_shape: Float[ArrayLike, "terms m shapes"]
    centre: Float[ArrayLike, " shapes"]
    degrees_of_freedom: Float[np.ndarray, " m"]

    @property
    def degrees(self) -> Float[np.ndarray, " m"]:
        return self.degrees_of_freedom

    @property
    def room(self) -> int:
        return int(np.shape(self.base)[0])

    def means(self, shape: Float[Array, " shapes"]) -> Float[Array, "terms m"]:
        return jnp.asarray(self.base) + jnp.asarray(self.by_shape) @ (shape - jnp.asarray(self.centre))


class SpectralDesign(LevelDesign):
    """Model of levels of the cosine spectrum, χ² around their expectations.

    Deterministic terms have been projected out of the levels, at the cost of degrees of freedom, and are not
    part of the model. The kinds of terms and shapes are data, so one program serves all models without shapes
    of a kind of their own.

    Attributes:
        levels, slots: the levels, and the slots of the joint spectral model.
        component: component of each term.
        time: parameter with the correlation time of a Markov process, −1 for other terms.
        parameter, offset: parameter of each free shape, and what is added to ln(value − lower bound) for it.
        held: parameters with the shapes that are not free.
        interval: sample interval [s].
        reach, top: largest distance of each shape from its start, and its upper end.
    """

    levels: Levels
    slots: Slots
    component: Int[np.ndarray, " terms"]
    time: Int[np.ndarray, " terms"]
    parameter: Int[np.ndarray, " shapes"]
    offset: Float[np.ndarray, " shapes"]
    held: Float[np.ndarray, " parameters"]
    interval: Float[np.ndarray, ""]
    reach: Float[np.ndarray, " shapes"]
    top: Float[np.ndarray, " shapes"]

    @classmethod
    def of(cls, model: Model, bins: Bins, tight: bool = False) -> SpectralDesign:
        """Design of a noise model of random terms only, for levels without data yet; see `Arrangement.of`."""
        found, shapes = Arrangement.of(model, bins, tight), free_shapes(model)
        terms = room_for(len(model), _TERMS) - len(model)
        more = room_for(len(shapes), _SHAPES) - len(shapes)
        owner = [p.term if p.term < len(model) else model.inside.index(True) for p in shapes]
        top = [
            np.log(_upper(found.slots.kind, p, len(model), bins.rate) - p.parameter.lower) - _INSIDE
            for p in shapes
        ]

        def with_room(values: Any, fill: float) -> Shaped[np.ndarray, " shapes"]:
            return np.append(values, np.full(more, fill)).astype(type(fill))

        return cls(
            owner=with_room(owner, 0),
            terms=np.asarray(len(model)),
            rows=np.asarray(len(bins.size)),
            levels=found.levels,
            slots=found.slots,
            component=np.append(found.component, np.zeros(terms, int)),
            time=np.append(found.time, np.full(terms, -1)),
            parameter=with_room(found.parameter, len(found.held)),
            offset=with_room(found.offset, 0.0),
            held=found.held,
            interval=np.asarray(1.0 / bins.rate),
            reach=with_room([_REACH[p.parameter.kind] for p in shapes], 0.0),
            top=with_room(top, 0.0),
            moves=np.arange(len(shapes) + more) < len(shapes),
            per_octave=padded(bins.per_octave(), len(found.levels.shape), 1.0),
        )

    def with_data(self, level: Float[np.ndarray, " m"], dof: Float[np.ndarray, " m"]) -> SpectralDesign:
        """Copy with these mean squares [rate²] and degrees of freedom as data."""
        return dataclasses.replace(self, levels=self.levels.with_data(level, dof))

    def owned(self, model: Model, there: Bool[np.ndarray, " terms"]) -> SpectralDesign:
        """Copy in which the response belongs to the first of these terms that passes through it, if any."""
        if model.response is None or not (passing := there & np.array(model.inside, bool)).any():
            return self
        owner = self.owner.copy()
        owner[[k for k, p in enumerate(free_shapes(model)) if p.term == len(model)]] = np.argmax(passing)
        return dataclasses.replace(self, owner=owner)

    @property
    def degrees(self) -> Float[np.ndarray, " m"]:
        return 2.0 * self.levels.shape

    @property
    def room(self) -> int:
        return len(self.component)

    def parameters(self, shape: Float[Array, " shapes"]) -> Float[Array, " parameters"]:
        """Parameters of the joint spectral model with these shapes and with zero powers."""
        return jnp.asarray(self.held).at[self.parameter].set(shape + self.offset, mode="drop")

    def unit_power(self, theta: Any) -> Any:
        """Power of each term's component where the term has unit amplitude; zero of what only pads.

        That of a Gauss–Markov process is its variance q_c²T_c/2 (4.59).
        """
        xp = namespace(theta, self.time)
        variance = xp.exp(theta[self.time]) * self.interval / 2.0
        there = np.arange(len(self.component)) < self.terms
        return xp.where(there, xp.where(self.time >= 0, variance, 1.0), 0.0)

    def means(self, shape: Float[Array, " shapes"]) -> Float[Array, "terms m"]:
        theta = self.parameters(shape).at[jnp.asarray(self.component)].set(1.0)
        every = expected(theta, self.slots, self.levels).unit
        return every[self.component] * self.unit_power(theta)[:, None]


def _upper(kind: int, p: ModelParameter, terms: int, rate: float) -> float:
    """Upper bound of a shape, of a term or of this kind of response, for samples at `rate` [Hz]."""
    if p.term == terms and p.parameter.name == "bandwidth":
        return bandwidths(kind)[1] * rate / (2.0 * np.pi)
    return p.parameter.upper


def solve_levels(
    design: SpectralDesign,
    free: Bool[np.ndarray, " terms"],
    active: Bool[np.ndarray, " terms"],
    power: Float[ArrayLike, " terms"],
    shape: Float[ArrayLike, " shapes"],
    noise: Float[np.ndarray, " m"],
) -> Solution:
    """Maximum of the likelihood of one axis from a start.

    Args:
        design: the model, with data.
        free: terms whose power is estimated.
        active: terms in use.
        power, shape: start values.
        noise: rough levels of the noise [rate²].
    """
    terms, shapes = len(free), np.size(shape)
    of_terms = design.padded_terms(free), design.padded_terms(active)

    def fitted(error: float, power: np.ndarray, shape: np.ndarray) -> tuple[Solution, np.ndarray]:
        return _maximum(design, *of_terms, power, shape, noise, error)

    noise = design.padded_estimates(noise[None])[0]
    start = design.padded_terms(np.asarray(power)), design.padded_shapes(np.asarray(shape))
    found, mean = fitted(0.0, *start)
    parameters = np.sum(free & active) + np.sum(active[design.owner[design.moves]])
    dof = 2.0 * np.asarray(design.levels.shape)
    degrees = max(float(np.sum(np.minimum(dof, 1.0))) - parameters, 1.0)
    if np.isfinite(found.cost) and not (found.converged and found.chi2 < beyond_doubt(degrees)):
        error = 0.0
        for _ in range(_ROUNDS):
            wanted = error_of_powers(design.levels.level / mean, dof, design.per_octave, degrees)
            if abs(wanted - error) <= _SETTLED * wanted:
                break
            error = wanted
            found, mean = fitted(error, np.asarray(found.power), np.asarray(found.shape))
    return found._replace(power=found.power[:terms], shape=found.shape[:shapes])


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


def _maximum(
    design: SpectralDesign,
    free: Bool[np.ndarray, " terms"],
    active: Bool[np.ndarray, " terms"],
    power: Float[np.ndarray, " terms"],
    shape: Float[np.ndarray, " shapes"],
    noise: Float[np.ndarray, " m"],
    error: float,
) -> tuple[Solution, Float[np.ndarray, " m"]]:
    """Maximum of the likelihood with this relative error of the model, and the expected levels there."""
    levels, slots = design.levels, design.slots
    dof = 2.0 * levels.shape
    less = levels._replace(shape=levels.shape * share_with_error(dof, design.per_octave, error))
    terms, moves = np.arange(int(design.terms)), np.flatnonzero(design.moves)
    component, parameter = design.component[terms], design.parameter[moves]
    start = np.array(design.held)
    start[parameter] = (shape + design.offset)[moves]
    estimated = np.array(slots.free)
    estimated[component] = (free & active)[terms]
    estimated[parameter] = active[design.owner[moves]]
    start[component] = np.where(active, power, 0.0)[terms] * design.unit_power(start)[terms]
    centre, reach = start[parameter], design.reach[moves]
    lower, upper = np.array(slots.lower), np.array(slots.upper)
    lower[parameter] = np.maximum(lower[parameter], centre - reach)
    upper[parameter] = np.minimum(centre + reach, (design.top + design.offset)[moves])
    slots = dataclasses.replace(slots, free=estimated, lower=lower, upper=upper)
    found = jax.device_get(maximize(start, slots, less, noise))
    theta, mean = found.theta, found.mean
    amplitude, shapes = np.zeros(len(free)), np.zeros(len(shape))
    amplitude[terms] = theta[component] / design.unit_power(theta)[terms]
    shapes[moves] = theta[parameter] - design.offset[moves]
    values: Any = (
        np.where(active, amplitude, 0.0),
        shapes,
        np.asarray(chi_squared(levels.level / mean, dof)),
        np.asarray(error),
        np.asarray(found.converged & np.isfinite(found.loss)),
        np.asarray(-2.0 * np.sum(_log_densities(levels.level, mean, less.shape))),
    )
    return Solution(*values), mean


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


def best_of(solutions: Sequence[Solution]) -> Solution:
    """The most likely solution; of equally likely ones a converged one, if there is any."""
    cost = [float(np.nan_to_num(s.cost, nan=np.inf)) for s in solutions]
    close = [s for s, c in zip(solutions, cost, strict=True) if c <= min(cost) + _AS_LIKELY]
    return next((s for s in close if s.converged), close[0])


def levels_under(design: SpectralDesign, solution: Solution) -> Float[np.ndarray, " m"]:
    """Expected levels [rate²] of one axis under a solution."""
    padded = _padded(design, solution)
    return np.asarray(_levels_under(design, padded.power, padded.shape))[: int(design.rows)]


@eqx.filter_jit
def _levels_under(
    design: SpectralDesign, power: Float[ArrayLike, " terms"], shape: Float[ArrayLike, " shapes"]
) -> Float[Array, " m"]:
    return design.mean(jnp.asarray(power), design.means(jnp.asarray(shape)))


def tangent_of(design: SpectralDesign, shape: Float[np.ndarray, " shapes"]) -> TangentDesign:
    """Design that is linear in the shapes around a solution, which suffices for the inference."""
    centre = design.padded_shapes(np.asarray(shape))
    base, by_shape = _tangent(design, centre)
    return TangentDesign(
        owner=design.owner,
        terms=design.terms,
        rows=design.rows,
        moves=design.moves,
        per_octave=design.per_octave,
        base=base,
        by_shape=by_shape,
        centre=centre,
        degrees_of_freedom=design.degrees,
    )


@eqx.filter_jit
def _tangent(
    design: SpectralDesign, shape: Float[ArrayLike, " shapes"]
) -> tuple[Float[Array, "terms m"], Float[Array, "terms m shapes"]]:
    at = jnp.asarray(shape)
    return design.means(at), jax.jacfwd(design.means)(at)


def infer_levels(
    design: LevelDesign,
    level: Float[np.ndarray, " m"],
    free: Bool[np.ndarray, " terms"],
    active: Bool[np.ndarray, " terms"],
    solution: Solution,
) -> Inference:
    """Inference of one axis around its solution, [1, …]; see `infer`."""
    padded = _padded(design, solution)
    V = design.padded_estimates(level[None])
    of_terms = design.padded_terms(free), design.padded_terms(active[None])
    found = jax.device_get(infer(design, V, *of_terms, padded))
    return without_padding(found, len(level), len(free), np.shape(solution.shape)[-1])


def _padded(design: LevelDesign, solution: Solution) -> Solution:
    """Solution in arrays of the design's length."""
    padded: dict[str, Any] = {
        "power": design.padded_terms(np.asarray(solution.power)),
        "shape": design.padded_shapes(np.asarray(solution.shape)),
    }
    return solution._replace(**padded)
