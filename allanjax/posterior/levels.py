"""Expected levels of a spectrum for many values of a model's parameters at once, in NumPy.

The walkers of a chain move together: a batch of them is one call of NumPy, which takes less time than a
compiled program of all kinds of terms, and none to compile. Expectations are those of the joint spectral model
(`spectral.components`, which explains their form). Other terms with free shapes are JAX's, compiled once for
each set of them.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from allanjax.estimate.spectral.components import columns_of, levels_of
from allanjax.estimate.spectral.model import Others
from allanjax.noise.model import Model, ModelParameter
from allanjax.noise.numerics import averaged_lags, mean_lags
from allanjax.noise.response import HALF_POWER, LONGEST, MovingAverage
from allanjax.noise.terms import Markov, Resonance
from allanjax.spectrum.cosine import Bins

# Number of rows of a program of JAX, in which batches are evaluated.
_ROWS = 16


def in_batches(
    function: Callable[[Array], Array],
) -> Callable[[Float[np.ndarray, "b k"]], Float[np.ndarray, "b ..."]]:
    """Function of JAX for rows of values, compiled once for any number of them."""
    compiled = jax.jit(lambda rows: jax.lax.map(function, rows))

    def every(rows: Float[np.ndarray, "b k"]) -> Float[np.ndarray, "b ..."]:
        whole = np.resize(rows, (-(-len(rows) // _ROWS) * _ROWS, rows.shape[1]))
        return np.concatenate([compiled(some) for some in np.split(whole, len(whole) // _ROWS)])[: len(rows)]

    return every


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
        self._inside, self._response = model.inside, self._model.response
        fixed = [k for k in range(len(model)) if not self._free[k]]
        columns = columns_of([model.terms[k] for k in fixed], bins)
        self._columns = dict(zip(fixed, columns, strict=True))
        levels = levels_of(bins, columns, len(columns), len(bins.size))
        self._angle, self._interval, self._length, self._parity = levels[2:6]
        self._others = self._program([(k, p) for k, p in shapes if self._is_other(p.term)], bins)
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
        others = {} if self._others is None else self._others(values)
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

    def _is_other(self, k: int) -> bool:
        """Whether a term is none that is evaluated in closed form."""
        return k < len(self._model) and not isinstance(self._model.terms[k], Markov | Resonance)

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

    def _program(
        self, shapes: list[tuple[int, ModelParameter]], bins: Bins
    ) -> Callable[..., dict[int, Any]] | None:
        """Expected squares at the nodes of the other terms, by their indices, from values of all parameters."""
        if not shapes:
            return None
        terms = sorted({p.term for _, p in shapes})
        places, lower = [k for k, _ in shapes], np.array([p.parameter.lower for _, p in shapes])
        own = tuple((terms.index(p.term), p.parameter.name, p.parameter.lower) for _, p in shapes)
        m = len(bins.size)
        others = Others.of(tuple(self._model.terms[k] for k in terms), own, bins, m)
        every = in_batches(lambda u: others.expected(u, m))

        def of(values: Float[np.ndarray, "b parameters"]) -> dict[int, Any]:
            found = every(np.log(values[:, places] - lower))
            return {k: found[:, i] for i, k in enumerate(terms)}

        return of
