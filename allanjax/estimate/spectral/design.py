"""Design of a fit to levels of the cosine spectrum: their expectations and scatter under a model."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from allanjax.estimate.design import free_shapes
from allanjax.estimate.spectral.arrangement import Arrangement
from allanjax.estimate.spectral.components import bandwidths
from allanjax.estimate.spectral.level_design import LevelDesign
from allanjax.estimate.spectral.levels import Levels, padded
from allanjax.estimate.spectral.model import Slots, units
from allanjax.noise.model import Model, ModelParameter
from allanjax.spectrum.cosine import Bins

# Farthest that a shape moves from its start, in ln: the spectrum's peaks locate a line better than that; the
# starts of other shapes are two to a decade or denser.
_REACH = {"line": 0.1, "time": 4.0, "frequency": 4.0, "number": 3.0}
# Margin kept from a shape's upper bound, which is open, in ln.
_INSIDE = 1e-2
# Numbers of terms and free shapes that arrays have room for; of more, multiples of the last.
_TERMS, _SHAPES = (8, 24), (4, 8, 32)


class SpectralDesign(LevelDesign):
    """Model of levels of the cosine spectrum, χ² around their expectations.

    Deterministic terms have been projected out of the levels, at the cost of degrees of freedom, and are no
    part of the model. What the terms and shapes are is data: one program serves all models without shapes of
    their own kind.

    Attributes:
        levels, slots: the levels, and the slots of the joint spectral model.
        component: component of each term.
        time: parameter with the correlation time of a Markov process, −1 of other terms.
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
        terms = _room(len(model), _TERMS) - len(model)
        more = _room(len(shapes), _SHAPES) - len(shapes)
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
        """Copy for these mean squares [rate²] and degrees of freedom."""
        return dataclasses.replace(self, levels=self.levels.with_data(level, dof))

    def owned(self, model: Model, there: Bool[np.ndarray, " terms"]) -> SpectralDesign:
        """Copy in which the response belongs to the first of these terms that pass it, if there is one."""
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
        """Parameters of the joint spectral model with these shapes, and without powers."""
        return jnp.asarray(self.held).at[self.parameter].set(shape + self.offset, mode="drop")

    def unit_power(self, theta: Float[Array, " parameters"]) -> Float[Array, " terms"]:
        """Power of each term's component where the term has unit amplitude; zero of what only pads.

        That of a Gauss–Markov process is its variance q_c²T_c/2 (4.59).
        """
        variance = jnp.exp(theta[self.time]) * self.interval / 2.0
        there = jnp.arange(len(self.component)) < self.terms
        return jnp.where(there, jnp.where(jnp.asarray(self.time) >= 0, variance, 1.0), 0.0)

    def means(self, shape: Float[Array, " shapes"]) -> Float[Array, "terms m"]:
        theta = self.parameters(shape)
        every = units(theta, self.slots, self.levels)
        return every[self.component] * self.unit_power(theta)[:, None]


def _room(count: int, rooms: tuple[int, ...]) -> int:
    """The smallest room for so many."""
    return next((room for room in rooms if room >= count), -(-count // rooms[-1]) * rooms[-1])


def _upper(kind: int, p: ModelParameter, terms: int, rate: float) -> float:
    """Upper bound of a shape, of a term or of this kind of response, for samples at `rate` [Hz]."""
    if p.term == terms and p.parameter.name == "bandwidth":
        return bandwidths(kind)[1] * rate / (2.0 * np.pi)
    return p.parameter.upper
