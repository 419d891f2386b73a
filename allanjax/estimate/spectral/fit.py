"""Fit of a model to the levels of a spectrum: its composition, the maximum likelihood, and its tangent.

Where a model cannot follow the levels within their scatter (p < 1e-6), these first get the errors that models
of filters and resonances have; where that does not suffice, all get a relative error, common to about an
octave, that brings χ² to its degrees of freedom.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Int

from allanjax.base.chi_squared import beyond_doubt, normal_score
from allanjax.estimate.design import INSIDE, REACH, Solution, Tangent, free_powers, free_shapes, of_owners
from allanjax.estimate.deterministic import InUse
from allanjax.estimate.spectral import components as kinds
from allanjax.estimate.spectral.components import Levels, Others, bandwidths, columns_of, kind_of
from allanjax.estimate.spectral.model import (
    TOLERANCE,
    Component,
    Joint,
    Maximum,
    Structure,
    error_of_ends,
    maximize,
    model_error,
    share_with_error,
)
from allanjax.noise.model import Model
from allanjax.noise.terms import Markov, NoiseTerm, Resonance, WanderingResonance
from allanjax.spectrum.cosine import Bins

_Levels: TypeAlias = Float[np.ndarray, " m"]
_Theta: TypeAlias = Float[np.ndarray, " parameters"]
_Power: TypeAlias = Float[np.ndarray, " terms"]
_Shapes: TypeAlias = Float[np.ndarray, " shapes"]
_Flags: TypeAlias = Bool[np.ndarray, " terms+shapes"]
# Names and bounds of the shapes of a kind of component, in ln and units of the sample interval; of the shapes
# of other terms [SI]; and a value to hold what has none.
_OF_PEAKS = {"frequency": (-30.0, math.log(math.pi)), "quality_factor": (-7.0, 14.0)}
_SHAPES = {
    kinds.MARKOV: {"correlation_time": (-3.0, 40.0)},
    kinds.OSCILLATOR: _OF_PEAKS,
    kinds.WANDERING: {**_OF_PEAKS, "spread": (-30.0, math.log(math.pi))},
}
_RESPONSE, _OF_OTHERS, _HELD = ("bandwidth", "quality_factor"), (-60.0, 60.0), math.log(5.0)
# Power of what is not in use, which has levels, too, for its limit.
_NOTHING = 1e-290
# Number of times that a model's error is re-estimated, and the change below which it has settled.
_ROUNDS, _SETTLED = 8, 0.02
# Largest error of a model, and most steps towards it.
_LARGEST, _STEPS = 1e3, 60
# Levels with fewer degrees of freedom say nothing about how well a model fits; difference of minus twice the
# log-likelihood below which two solutions are the same; and tolerance [nats] of fits before the last one.
_FEW, _AS_LIKELY, _ROUGH = 0.05, 0.02, 1e-4


class Arrangement(NamedTuple):
    """A model of random terms as a composition, of which each term is one component, and levels for it.

    Each free shape has a parameter, an offset that is added to ln(value − lower bound) for it, and an owner:
    its term, or the number of terms for the response.
    """

    model: Model
    composition: Structure
    parameter: Int[np.ndarray, " shapes"]
    offset: _Shapes
    owner: Int[np.ndarray, " shapes"]
    levels: Levels
    bins: Bins

    @classmethod
    def of(cls, model: Model, bins: Bins) -> Arrangement:
        """Arrangement of a model for the levels of these bins."""
        model = model.sampled(bins.rate)
        of_terms, inside = [*map(_kind, model.terms)], model.inside or [False] * len(model)
        shapes = _shapes_of(model, of_terms, bins.rate)
        components = []
        for k, kind in enumerate(of_terms):
            values = tuple(shape.value for shape in shapes if shape.owner == k)
            components.append(Component(kind, 0.0, values, bool(inside[k]), of_terms[:k].count(kind)))
        columns = [k for k, kind in enumerate(of_terms) if kind == kinds.COLUMN]
        others = [k for k, kind in enumerate(of_terms) if kind == kinds.OTHER]
        own = tuple((others.index(s.owner), s.name, s.lower) for s in shapes if s.owner in others)
        further = Others.of(tuple(model.terms[k] for k in others), own, bins) if others else None
        response = shapes[-2].value, shapes[-1].value
        composition = Structure(tuple(components), kind_of(model.response), response, further)
        free = [(len(model) + k, s.unit, s.owner) for k, s in enumerate(shapes) if s.free]
        parameter, offset, owner = np.array(free).reshape(-1, 3).T
        levels = Levels.of(bins, columns_of([model.terms[k] for k in columns], bins))
        return cls(model, composition, parameter.astype(int), offset, owner.astype(int), levels, bins)

    def with_data(self, level: _Levels, dof: _Levels) -> Arrangement:
        """Copy with these mean squares [rate²] and degrees of freedom as data."""
        return self._replace(levels=self.levels._replace(level=level, shape=dof / 2.0))

    def unit_power(self, theta: Float[np.ndarray, "*b parameters"]) -> Float[np.ndarray, "*b terms"]:
        """Power of each term's component where the term has unit amplitude.

        That of a Gauss–Markov process is its variance q_c²T_c/2 (4.59).
        """
        power, of = np.ones((*theta.shape[:-1], len(self.model))), self.composition
        for k, component in enumerate(of.components):
            if component.kind == kinds.MARKOV:
                power[..., k] = np.exp(theta[..., of.first[k]]) / (2.0 * self.bins.rate)
        return power

    def parameters(self, shape: Float[np.ndarray, "*b shapes"]) -> Float[np.ndarray, "*b parameters"]:
        """Parameters for these values of ln(shape − lower bound), with no powers."""
        held = self.composition.parameters
        theta = np.broadcast_to(held, (*shape.shape[:-1], len(held))).copy()
        theta[..., self.parameter] = shape + self.offset
        return theta

    def expected(self, shape: Float[np.ndarray, "b shapes"]) -> Float[np.ndarray, "_ terms m"]:
        """Levels [rate²] of each term of unit amplitude for these values of ln(shape − lower bound).

        They are [1, terms, m] if all shapes are the same.
        """
        theta = self.parameters(shape[:1] if (shape == shape[:1]).all() else shape)
        return self.composition.levels(theta, self.levels) * self.unit_power(theta)[..., None]

    def error_of_ends(self, shape: _Shapes, power: _Power) -> _Levels:
        """Relative variance of the levels from the record's ends, for squared amplitudes of the terms."""
        theta = self.parameters(shape)
        theta[: len(power)] = power * self.unit_power(theta)
        return error_of_ends(self.composition, theta, self.levels, self.bins)

    def joint(self, estimated: _Flags) -> Joint:
        """Joint model in which these powers and free shapes are estimated, with the widest bounds."""
        count, of = len(self.model), self.composition
        bounds = [(0.0, np.inf)] * count
        for c in of.components:
            bounds += [*_SHAPES[c.kind].values()] if c.kind in _SHAPES else [_OF_OTHERS] * len(c.shape)
        least, most = bandwidths(of.kind)
        bounds += [(math.log(least), math.log(most)), _OF_PEAKS["quality_factor"]]
        lower, upper = np.array(bounds).T
        free = np.zeros(len(lower), bool)
        free[np.append(np.arange(count), self.parameter)] = estimated
        return Joint(of, free, lower, upper, 0.0 * lower, 0.0 * lower)

    def start(self, active: InUse, power: _Power, shape: _Shapes) -> tuple[_Theta, Joint]:
        """Parameters to start from, and the joint model of these terms, with bounds around the start."""
        estimated = [free_powers(self.model) & active, of_owners(self.model, active)[self.owner]]
        start, joint, of = self.parameters(shape), self.joint(np.concatenate(estimated)), self.composition
        count = len(self.model)
        start[:count] = np.where(active, power * self.unit_power(start), _NOTHING)
        for k, u, p in zip(self.parameter, self.offset, free_shapes(self.model), strict=True):
            reach, top = REACH[p.parameter.kind], p.parameter.upper
            if k == of.first[-1]:
                top = bandwidths(of.kind)[1] * self.bins.rate / (2.0 * np.pi)
            end = np.log(top - p.parameter.lower) - INSIDE + u
            joint.lower[k] = max(joint.lower[k], start[k] - reach)
            joint.upper[k] = min(joint.upper[k], start[k] + reach, end)
        return start, joint

    def unit_levels(
        self, maximum: Maximum
    ) -> tuple[Float[np.ndarray, "terms m"], Float[np.ndarray, "terms m shapes"]]:
        """Levels of each term of unit amplitude, and their derivatives by the free shapes, in ln."""
        of, theta, count = self.composition, maximum.theta, len(self.model)
        unit = self.unit_power(theta)[:, None]
        base = maximum.unit * unit
        by_shape = np.zeros((*base.shape, len(self.parameter)))
        # What passes through the response changes in proportion.
        passing = of.inside[:, None] * base
        total = theta[:count] @ (passing / unit)
        for s, (p, k) in enumerate(zip(self.parameter.tolist(), self.owner.tolist(), strict=True)):
            if k == count:
                slope = maximum.by_response[p - of.first[-1]]
                by_shape[:, :, s] = passing * slope / np.where(total > 0.0, total, 1.0)
            else:
                by_shape[k, :, s] = maximum.by_shape[p - count] * unit[k]
                by_shape[k, :, s] += base[k] if of.components[k].kind == kinds.MARKOV else 0.0
        return base, by_shape

    def tangent(
        self, fit: LevelFit, plateaus: Mapping[int, Mapping[str, float]], white: int
    ) -> tuple[LevelTangent, Solution]:
        """Levels around a fit, linear in all shapes, and the solution in them.

        A plateau is the density at low frequencies of a term that is white there, for unit amplitude (""),
        with logarithmic derivatives by its shapes. It counts as white noise, and not as the term's own power.
        """
        base, by_shape = self.unit_levels(fit.maximum)
        power: Any = np.array(fit.solution.power)
        # The response belongs to the term that has most of what passes through it.
        passed, owner = np.where(self.composition.inside, power * (base @ fit.degrees), 0.0), self.owner
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


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class LevelTangent(Tangent):
    """Levels of a spectrum around a fit: independent, χ² around expectations that are linear in the shapes.

    Those in the octave around each, of this number, share an error of the model.
    """

    degrees: _Levels
    per_octave: _Levels

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


class _Shape(NamedTuple):
    """A shape of a term or the response: its value in ln, and what its unit adds to that."""

    owner: int
    name: str
    lower: float
    free: bool
    unit: float
    value: float


def _shapes_of(model: Model, of_terms: Sequence[int], rate: float) -> list[_Shape]:
    """All shapes of the components with a closed form and of the response, and the free ones of others."""
    angle, found = math.log(2.0 * math.pi / rate), []
    units = {"correlation_time": math.log(rate), "frequency": angle, "bandwidth": angle, "spread": angle}
    known = {(p.term, p.parameter.name): p for p in model.parameters if not p.parameter.is_amplitude}
    for k, kind in enumerate([*of_terms, None]):
        free = [name for (owner, name), p in known.items() if owner == k and p.free]
        for name in _RESPONSE if kind is None else _SHAPES.get(kind, free):
            p, unit = known.get((k, name)), 0.0 if kind == kinds.OTHER else units.get(name, 0.0)
            lower = 0.0 if p is None else p.parameter.lower
            value = _HELD if p is None or p.start is None else math.log(p.start - lower) + unit
            found.append(_Shape(k, name, lower, p is not None and p.free, unit, value))
    return found


def _kind(term: NoiseTerm) -> int:
    free = [p for p in term.parameters()[1:] if term.is_free(p)]
    if not free:
        return kinds.COLUMN
    if isinstance(term, Markov) and term.has_free_amplitude:
        return kinds.MARKOV
    if isinstance(term, Resonance):
        return kinds.WANDERING if isinstance(term, WanderingResonance) else kinds.OSCILLATOR
    return kinds.OTHER


class LevelFit(NamedTuple):
    """Maximum of the likelihood of a model's levels.

    The levels' degrees of freedom are reduced to allow for the model's uncertainty.
    """

    solution: Solution
    maximum: Maximum
    degrees: _Levels


def chi_squared(ratio: _Levels, dof: _Levels) -> float:
    """χ² of levels from their ratios to their expectations."""
    return float(np.sum(_squares(ratio, dof)))


def degrees_left(dof: _Levels, estimated: int) -> float:
    """Degrees of freedom of χ² of levels to which so many parameters were fitted."""
    return max(float(np.sum(np.minimum(dof, 1.0))) - estimated, 1.0)


def _squares(ratio: _Levels, dof: _Levels) -> _Levels:
    return np.where(np.asarray(dof) > _FEW, normal_score(ratio, dof) ** 2, 0.0)


def error_of_powers(ratio: _Levels, dof: _Levels, per_octave: _Levels, degrees: float) -> float:
    """Relative error of a model that brings χ² to its degrees of freedom; 0 if χ² is not above them.

    The ratios are those of levels to their expectations; the levels in an octave share the error, which adds
    per_octave·error² to the relative variance of each.
    """
    squares, variance = _squares(ratio, dof), 0.0
    for _ in range(_STEPS):
        share = share_with_error(dof, per_octave * variance)
        chi2, slope = float(squares @ share), float(squares @ (0.5 * dof * per_octave * share**2))
        # Newton's steps for 1/χ², a harmonic mean, do not go too far, as it is concave.
        step = chi2 * (chi2 - degrees) / max(degrees * slope, 1e-300)
        # Levels may be beyond any error of the model, from a start that is far off.
        variance = min(variance + max(step, 0.0), _LARGEST**2)
        if not 1e-9 * variance < step < _LARGEST**2:
            break
    return math.sqrt(variance)


def fit_levels(
    arrangement: Arrangement, active: InUse, power: _Power, shape: _Shapes, noise: _Levels
) -> LevelFit:
    """Maximum of the likelihood of one axis from a start, in noise of these rough levels [rate²]."""
    levels, per_octave = arrangement.levels, arrangement.bins.per_octave()
    theta, joint = arrangement.start(active, power, shape)
    dof = 2.0 * levels.shape
    degrees = degrees_left(dof, np.sum(joint.free))

    def fitted(theta: Any, share: Any, tolerance: float = _ROUGH) -> tuple[Maximum, bool]:
        """Maximum for levels that keep this share of their weight, and whether it does not suffice."""
        found = maximize(theta, joint, levels._replace(shape=levels.shape * share), noise, tolerance)
        off = chi_squared(np.maximum(levels.level, 1e-300) / found.mean, dof) >= beyond_doubt(degrees)
        return found, bool(np.isfinite(found.loss) and (off or not found.converged))

    own, error, share = np.ones(len(dof)), 0.0, np.ones(len(dof))
    found, insufficient = fitted(theta, own)
    if insufficient:
        own = share = share_with_error(dof, model_error(arrangement.composition, found, arrangement.bins))
        found, insufficient = fitted(found.theta, share) if np.any(share < 1.0) else (found, True)
    for _ in range(_ROUNDS if insufficient else 0):
        wanted = error_of_powers(levels.level / found.mean, dof, per_octave, degrees)
        if abs(wanted - error) <= _SETTLED * wanted:
            break
        error = wanted
        share = own * share_with_error(own * dof, per_octave * error**2)
        found, _ = fitted(found.theta, share)
    found, _ = fitted(found.theta, share, TOLERANCE)
    return LevelFit(_solution(arrangement, active, found, share, error), found, own * dof)


def _solution(
    arrangement: Arrangement, active: InUse, found: Maximum, share: _Levels, error: float
) -> Solution:
    """Solution of a model whose levels keep this share of their weight."""
    from scipy.special import gammaln

    levels, theta, count = arrangement.levels, found.theta, len(arrangement.model)
    ratio = np.maximum(levels.level, 1e-300) / found.mean
    some = levels.shape * share > 0.0
    k, own = (levels.shape * share)[some], ratio[some]
    # Gamma laws, normalized, so that solutions with different errors of the model can be compared.
    densities = k * (np.log(k * own) - own) - gammaln(k) - np.log(own * found.mean[some])
    values: Any = (
        np.where(active, theta[:count] / arrangement.unit_power(theta), 0.0),
        theta[arrangement.parameter] - arrangement.offset,
        np.asarray(chi_squared(ratio, 2.0 * levels.shape)),
        np.asarray(error),
        np.asarray(found.converged & np.isfinite(found.loss)),
        np.asarray(-2.0 * np.sum(densities)),
    )
    return Solution(*values)


def best_of(fits: Sequence[LevelFit]) -> LevelFit:
    """The most likely fit; of equally likely ones a converged one, if there is any."""
    cost = [float(np.nan_to_num(fit.solution.cost, nan=np.inf)) for fit in fits]
    close = [fit for fit, c in zip(fits, cost, strict=True) if c <= min(cost) + _AS_LIKELY]
    return next((fit for fit in close if fit.solution.converged), close[0])
