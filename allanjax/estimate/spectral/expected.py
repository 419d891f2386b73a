"""Expected levels of a spectrum for many values of a model's parameters at once, in NumPy.

The walkers of a chain move together: a batch of them is one call of NumPy, which takes less time than a
compiled program of all kinds of terms, and none to compile. Expectations are those of the joint spectral
model (`spectral.components`, which explains their form). Other terms with free shapes are JAX's, compiled
once for each set of them.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from allanjax.estimate.spectral.components import CAPACITIES, columns_of, levels_of, room_for
from allanjax.estimate.spectral.model import Others
from allanjax.noise.model import Model, NoiseTerm
from allanjax.noise.numerics import averaged_lags, mean_lags
from allanjax.noise.response import HALF_POWER, LONGEST, MovingAverage
from allanjax.noise.terms import Markov, Resonance
from allanjax.spectrum.cosine import Bins

# Number of rows of a program of JAX, in which batches are evaluated.
_ROWS = 16


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


def _squares(others: tuple[Others, int], shapes: Array) -> Array:
    """Expected squares of terms that no slot serves, in so many levels."""
    return others[0].expected(shapes, others[1])


def _has_slot(term: NoiseTerm) -> bool:
    """Whether the expectation of a term with free shapes is in closed form here."""
    return isinstance(term, Markov | Resonance)


class ExpectedLevels:
    """Levels of the random terms of a model in these bins, for unit amplitudes.

    A call takes values of all parameters of the model [b, parameters] in SI, and returns the levels [rate²]
    of each term, [b, terms, m] or [1, terms, m] if all have the same shapes. Amplitudes make no difference.
    """

    def __init__(self, model: Model, bins: Bins) -> None:
        self._model, self._rate = model.sampled(bins.rate), bins.rate
        shapes = [(k, p) for k, p in enumerate(model.parameters) if p.free and not p.parameter.is_amplitude]
        self._shapes = np.array([k for k, _ in shapes], int)
        #: Places of the free shapes of each term, and last of the response, by their names.
        self._free: list[dict[str, int]] = [{} for _ in range(len(model) + 1)]
        for k, p in shapes:
            self._free[p.term][p.parameter.name] = k
        # Attributes of modules are slow.
        owners: list[Any] = [*model.terms, *filter(None, [model.response])]
        self._held = [{p.name: getattr(owner, p.name) for p in owner.parameters()} for owner in owners]
        self._is_markov = [isinstance(term, Markov) for term in model.terms]
        self._inside = model.inside
        self._response: Any = self._model.response
        fixed = [k for k in range(len(model)) if not self._free[k]]
        columns = columns_of([model.terms[k] for k in fixed], bins)
        self._columns = dict(zip(fixed, columns, strict=True))
        levels = levels_of(bins, columns, len(columns), len(bins.size))
        self._angle, self._parity = levels.angle, levels.parity
        # Powers of numbers are much faster than those of arrays.
        of_levels = (x[levels.part] for x in (levels.interval, levels.length))
        self._interval, self._length = (x[:1] if len(set(x)) == 1 else x for x in of_levels)
        apart = [(k, p) for k, p in shapes if p.term < len(model) and not _has_slot(model.terms[p.term])]
        terms, lower = sorted({p.term for _, p in apart}), np.array([p.parameter.lower for _, p in apart])
        own = tuple((terms.index(p.term), p.parameter.name, p.parameter.lower) for _, p in apart)
        room = room_for(len(bins.size), CAPACITIES)
        others = Others.of(tuple(self._model.terms[k] for k in terms), own, bins, room)
        self._others = terms, [k for k, _ in apart], lower, (others, room)
        self._last: tuple[bytes, Any] = (b"", None)

    def __call__(self, values: Float[np.ndarray, "b parameters"]) -> Float[np.ndarray, "_ terms m"]:
        shapes = values[:, self._shapes]
        if not (shapes == shapes[:1]).all():
            return self._evaluated(values)
        if self._last[0] != (key := shapes[0].tobytes()) or self._last[1] is None:
            self._last = (key, self._evaluated(values[:1]))
        return self._last[1]

    @functools.cached_property
    def _lags(self) -> Float[np.ndarray, "lags 2 m"]:
        """What the ends of a record cost a process at each lag d of its covariance, times -n/2."""
        a = self._angle
        return np.stack([d * np.cos(d * a) + np.sin(d * a) / np.sin(a) for d in range(1, LONGEST + 1)])

    def _evaluated(self, values: Float[np.ndarray, "b parameters"]) -> Float[np.ndarray, "b terms m"]:
        others = self._of_others(values)
        passed = None if self._response is None else self._passed(values)
        rows = []
        for k in range(len(self._is_markov)):
            row = self._columns.get(k, others.get(k))
            row = self._slot(k, values) if row is None else row
            row = row * passed if passed is not None and self._inside[k] else row
            rows.append(np.broadcast_to(np.mean(row, axis=-2), (len(values), row.shape[-1])))
        return np.stack(rows, axis=1)

    def _at(self, k: int, values: Float[np.ndarray, "b parameters"]) -> dict[str, Any]:
        """Shapes of a term, or of the response after all terms, by name, [b, 1, 1] or a number."""
        return self._held[k] | {name: values[:, at, None, None] for name, at in self._free[k].items()}

    def _passed(self, values: Float[np.ndarray, "b parameters"]) -> Float[np.ndarray, "b 2 m"]:
        """Power response at the nodes, with what the record's ends add to white noise after it."""
        response: Any = self._response.replace(**self._at(len(self._is_markov), values))
        power = response.power(self._angle * self._rate / (2.0 * np.pi), self._rate)
        n, M = self._length, self._interval
        if isinstance(response, MovingAverage):
            samples = np.clip(HALF_POWER * self._rate / np.ravel(response.bandwidth), 1.0, LONGEST)[:, None]
            whole, d = np.floor(samples), np.arange(1, LONGEST + 1)
            # Autocovariance of means of m samples and of one more, in the proportion of their shares.
            share = samples - whole
            one, other = (np.maximum(whole + k - d, 0.0) for k in (0, 1))
            norm = (1.0 - share) * whole**2 + share * (whole + 1.0) ** 2
            r = ((1.0 - share) * one + share * other) / norm
            return power + np.where(M == 1.0, -2.0 / n * np.tensordot(r, self._lags, 1), 0.0)
        s = np.sin(self._angle * M / 2.0) ** 2
        w, c = (x.reshape(*x.shape, *(1,) * (4 - x.ndim)) for x in response.poles(self._rate))
        if not np.any(w.imag):
            w, c = w.real, c.real
        last = w**M
        y = 1.0 - last
        first = c * w * (y / (M * (1.0 - w))) ** 2
        ends = first * y**2 * (1.0 - self._parity * w ** (M * n)) / (y**2 + 4.0 * last * s) ** 2
        return power - 4.0 / n * (1.0 - s) * np.sum(np.real(ends), axis=0)

    def _slot(self, k: int, values: Float[np.ndarray, "b parameters"]) -> Float[np.ndarray, "b 2 m"]:
        """Expected squares at the nodes of a Gauss–Markov process or a resonance, see `components`."""
        at, M = self._at(k, values), self._interval
        if self._is_markov[k]:
            time = at["correlation_time"]
            pole, weight = -1.0 / (self._rate * time), time / 2.0
            r_0, r_1 = averaged_lags(-pole * M)
        else:
            root = np.sqrt(4.0 * at["quality_factor"] ** 2 - 1.0)
            decay = np.pi * at["frequency"] / self._rate / at["quality_factor"]
            pole, weight = decay * (-1.0 + 1j * root), 1.0 - 1j / root
            r_0, r_1, _ = mean_lags(pole, M)
        y = -np.expm1(pole * M)
        s = np.sin(self._angle * M / 2.0) ** 2
        inverse = 1.0 / (y**2 + 4.0 * (1.0 - y) * s)
        ends = (
            y**2 * (1.0 - self._parity * np.exp(pole * M * self._length)) * (4.0 / self._length * (1.0 - s))
        )
        return np.real(weight * (r_0 + r_1 * (2.0 * (y - 2.0 * s) - ends * inverse) * inverse))

    def _of_others(self, values: Float[np.ndarray, "b parameters"]) -> dict[int, Any]:
        """Expected squares at the nodes of the terms that have no closed form here, by their indices."""
        terms, places, lower, others = self._others
        if not terms:
            return {}
        found = in_batches(_squares, others, np.log(values[:, places] - lower))
        return {k: found[:, i, :, : self._angle.shape[1]] for i, k in enumerate(terms)}
