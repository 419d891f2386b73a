"""Expected levels of a spectrum for many values of a model's parameters at once.

The walkers of a chain move together: a batch of them is one call of NumPy, which takes less time than a
compiled program of all kinds of terms, and none to compile. Expectations are those of `spectral.components`.
Only terms of other kinds with free shapes are JAX's, compiled once for each set of them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from allanjax.estimate.spectral.components import (
    NONE,
    Levels,
    Place,
    columns_of,
    kind_of,
    markov,
    oscillator,
    padded,
    passed,
)
from allanjax.noise.model import Model, NoiseTerm
from allanjax.noise.terms import Markov, Resonance
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
    """Terms whose free shapes have no closed form in `components`; they are evaluated directly.

    Attributes:
        terms: the terms, with unit amplitude.
        shapes: index of the term, name and lower bound of each free shape.
        places: where they are evaluated.
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
            room = -(-len(bins.size) // _LEVELS) * _LEVELS
            places[0] = places[0]._replace(frequency=padded(places[0].frequency, room, bins.rate / 4.0))
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


class ExpectedLevels:
    """Levels of the random terms of a model in these bins, for unit amplitudes.

    A call takes values of all parameters of the model [b, parameters] in SI, and returns the levels [rate²]
    of each term, [b, terms, m] or [1, terms, m] if all have the same shapes. Amplitudes make no difference.
    """

    def __init__(self, model: Model, bins: Bins) -> None:
        self._rate, self._inside, self._kind = bins.rate, model.inside, kind_of(model.response)
        shapes = [(k, p) for k, p in enumerate(model.parameters) if p.free and not p.parameter.is_amplitude]
        self._shapes = [k for k, _ in shapes]
        #: Places of the free shapes of each term, and last of the response, by their names.
        self._free: list[dict[str, int]] = [{} for _ in range(len(model) + 1)]
        for k, p in shapes:
            self._free[p.term][p.parameter.name] = k
        # Attributes of modules are slow.
        owners: list[Any] = [*model.terms, *filter(None, [model.response])]
        self._held = [{p.name: getattr(owner, p.name) for p in owner.parameters()} for owner in owners]
        self._is_markov = [isinstance(term, Markov) for term in model.terms]
        fixed = [k for k in range(len(model)) if not self._free[k]]
        self._levels = Levels.of(bins, columns_of([model.terms[k] for k in fixed], bins))
        self._columns = dict(zip(fixed, self._levels.columns, strict=True))
        apart = [
            (k, p)
            for k, p in shapes
            if p.term < len(model) and not isinstance(model.terms[p.term], Markov | Resonance)
        ]
        self._places, self._lower = [k for k, _ in apart], np.array([p.parameter.lower for _, p in apart])
        self._others = sorted({p.term for _, p in apart})
        own = tuple((self._others.index(p.term), p.parameter.name, p.parameter.lower) for _, p in apart)
        self._directly = Others.of(tuple(model.terms[k] for k in self._others), own, bins)
        self._last: tuple[bytes, Any] = (b"", None)

    def __call__(self, values: Float[np.ndarray, "b parameters"]) -> Float[np.ndarray, "_ terms m"]:
        shapes = values[:, self._shapes]
        if not (shapes == shapes[:1]).all():
            return self._evaluated(values)
        if self._last[0] != (key := shapes[0].tobytes()) or self._last[1] is None:
            self._last = (key, self._evaluated(values[:1]))
        return self._last[1]

    def _evaluated(self, values: Float[np.ndarray, "b parameters"]) -> Float[np.ndarray, "b terms m"]:
        squares, count = dict(self._columns), self._levels.angle.shape[1]
        if self._others:
            shapes = np.log(values[:, self._places] - self._lower)
            squares |= zip(self._others, self._directly.squares(shapes, count).swapaxes(0, 1), strict=True)
        response = None
        if self._kind != NONE:
            at = self._at(len(self._is_markov), values)
            wc = 2.0 * np.pi * np.asarray(at["bandwidth"]) / self._rate
            response = passed(self._levels, self._kind, wc, at.get("quality_factor"))
        rows = np.empty((len(values), len(self._is_markov), count))
        for k in range(rows.shape[1]):
            row = squares[k] if k in squares else self._slot(k, values)
            row = row * response if response is not None and self._inside[k] else row
            rows[:, k] = np.mean(row, axis=-2)
        return rows

    def _at(self, k: int, values: Float[np.ndarray, "b parameters"]) -> dict[str, Any]:
        """Shapes of a term, or of the response after all terms, by name, [b, 1, 1] or a number."""
        return self._held[k] | {name: values[:, at, None, None] for name, at in self._free[k].items()}

    def _slot(self, k: int, values: Float[np.ndarray, "b parameters"]) -> Float[np.ndarray, "b 2 m"]:
        """Expected squares at the nodes of a Gauss–Markov process or a resonance of unit amplitude."""
        at = self._at(k, values)
        if self._is_markov[k]:
            time = at["correlation_time"]
            return time / 2.0 * markov(self._levels, self._rate * time)
        return oscillator(self._levels, 2.0 * np.pi * at["frequency"] / self._rate, at["quality_factor"])
