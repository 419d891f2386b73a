"""Terms whose shapes have no closed form: expected levels by JAX, compiled once for each set of terms."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from allanjax.estimate.spectral.components import Place
from allanjax.noise.terms import NoiseTerm
from allanjax.spectrum.cosine import Bins

# Number of rows of a program of JAX, in which batches are evaluated; levels of a record are padded to a
# multiple of so many.
_ROWS, _LEVELS = 16, 512
# Step of a difference in ln.
_STEP = 1e-5


def in_batches(
    function: Callable[[Any, Array], Array], data: Any, rows: Float[np.ndarray, "b k"]
) -> Float[np.ndarray, "b ..."]:
    """Function of JAX of data and of each row, compiled once for any number of rows and other such data."""
    whole = np.resize(rows, (-(-len(rows) // _ROWS) * _ROWS, rows.shape[1]))
    parts = [_mapped(function, data, some) for some in np.split(whole, len(whole) // _ROWS)]
    return np.concatenate(parts)[: len(rows)]


@eqx.filter_jit
def _mapped(function: Callable[[Any, Array], Array], data: Any, rows: ArrayLike) -> Array:
    return jax.lax.map(lambda row: function(data, row), jnp.asarray(rows))


class Others(eqx.Module):
    """Terms of unit amplitude whose free shapes have no closed form, and the places where they are evaluated.

    Each shape has the index of its term, its name and its lower bound.
    """

    terms: tuple[NoiseTerm, ...]
    shapes: tuple[tuple[int, str, float], ...] = eqx.field(static=True)
    places: tuple[Place, ...]

    @classmethod
    def of(
        cls, terms: tuple[NoiseTerm, ...], shapes: tuple[tuple[int, str, float], ...], bins: Bins
    ) -> Others:
        """Terms as they are observed in these bins, of which those of a record are padded."""
        places = [Place.of(part) for part in bins.parts]
        if len(places) == 1:
            more = [(0, 0), (0, -len(bins.size) % _LEVELS)]
            frequency = np.pad(places[0].frequency, more, constant_values=bins.rate / 4.0)
            places[0] = places[0]._replace(frequency=frequency)
        return cls(
            tuple(term.with_unit_amplitude().sampled(bins.rate) for term in terms), shapes, tuple(places)
        )

    def squares(self, values: Float[np.ndarray, "b shapes"], m: int) -> Float[np.ndarray, "b terms 2 m"]:
        """Expected squares at the nodes of m levels for these values of ln(shape − lower bound)."""
        return in_batches(_squares, self, values)[..., :m]

    def squares_and_slopes(self, values: Float[np.ndarray, " shapes"], m: int) -> tuple[Any, Any]:
        """Expected squares (terms, 2, m), and of the term of each shape the derivatives by it."""
        moves = _STEP * np.eye(len(values))
        here, *around = self.squares(values + np.concatenate([0.0 * values[None], moves, -moves]), m)
        slopes = (np.array(around[: len(values)]) - around[len(values) :]) / (2.0 * _STEP)
        return here, slopes[np.arange(len(values)), [k for k, *_ in self.shapes]]


def _squares(others: Others, values: Float[Array, " shapes"]) -> Float[Array, "terms 2 padded"]:
    terms = list(others.terms)
    for (k, name, lower), value in zip(others.shapes, values, strict=True):
        terms[k] = terms[k].replace(**{name: lower + jnp.exp(value)})
    every = [jnp.concatenate([place.expected(term) for place in others.places], axis=1) for term in terms]
    return jnp.stack(every)
