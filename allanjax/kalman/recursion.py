"""Kalman filter and smoother, one compiled scan each, and the exact likelihood.

The filter (3.5)–(3.17) carries states and their covariance. Two columns are filtered with the same gains: the
samples, and ones, from which an unknown constant is estimated without a state of its own (see `Constant`).

Lengths and numbers of states are padded to a few values: samples and matrices are data, and few programs are
compiled.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from allanjax.base.errors import AllanjaxError
from allanjax.noise.model import Model
from allanjax.noise.state_space import StateSpace
from allanjax.record.units import Sensor

# Samples of a block: the smoother repeats the filter block by block, from the state before each.
_BLOCK = 64


class System(NamedTuple):
    """Matrices of a filter, padded to a number of states for which a program is compiled.

    Attributes:
        A, h: transition and observation.
        Q, R, P0: covariances of the noise of states and samples, and that of the states at the start.
        rows: requested sums of states, one per row.
    """

    A: Float[Array, "n n"]
    h: Float[Array, " n"]
    Q: Float[Array, "n n"]
    R: Float[Array, ""]
    P0: Float[Array, "n n"]
    rows: Float[Array, "rows n"]


class Columns(NamedTuple):
    """Numbers of both columns, and their standard deviation for a known constant.

    Innovations, zero where there is no sample; or requested sums of states.
    """

    value: Float[Array, "*samples 2"]
    std: Float[Array, "*samples"]


class State(NamedTuple):
    """States of both columns before a sample (3.13) or after it (3.16), and their covariance (3.14, 3.17)."""

    x: Float[Array, "*samples n 2"]
    P: Float[Array, "*samples n n"]


class Record(NamedTuple):
    """Samples in blocks, and which of them exist; padding does not."""

    sample: Float[Array, "blocks block"]
    there: Bool[Array, "blocks block"]


class _Outputs(NamedTuple):
    """Innovations of both columns, their standard deviation, gains (3.15), and states after samples."""

    innovation: Float[Array, "*samples 2"]
    std: Float[Array, "*samples"]
    gain: Float[Array, "*samples n"]
    state: State


def _filtered(system: System, state: State, block: Record) -> tuple[State, _Outputs]:
    """State after a block of samples, with outputs in it."""

    def step(before: State, at: Record) -> tuple[State, _Outputs]:
        h = jnp.where(at.there, system.h, 0.0)
        shared = before.P @ h
        variance = jnp.where(at.there, h @ shared + system.R, 1.0)
        gain = shared / variance
        both = jnp.append(at.sample, 1.0)
        innovation = jnp.where(at.there, both - h @ before.x, 0.0)
        after = State(before.x + jnp.outer(gain, innovation), before.P - jnp.outer(gain, shared))
        P = system.A @ after.P @ system.A.T + system.Q
        # Rounding must not make it asymmetric.
        ahead = State(system.A @ after.x, (P + P.T) / 2.0)
        return ahead, _Outputs(innovation, jnp.sqrt(variance), gain, after)

    return jax.lax.scan(step, state, block)


@eqx.filter_jit
def run_filter(system: System, record: Record) -> tuple[Columns, Columns, State]:
    """Innovations and updated rows at every sample, and the state before every block of samples."""

    def block(state: State, at: Record) -> tuple[State, tuple[Columns, Columns, State]]:
        end, found = _filtered(system, state, at)
        variance = jnp.sum((system.rows @ found.state.P) * system.rows, axis=-1)
        rows = Columns(system.rows @ found.state.x, jnp.sqrt(jnp.maximum(variance, 0.0)))
        return end, (Columns(found.innovation, found.std), rows, state)

    start = State(jnp.zeros((len(system.h), 2)), jnp.asarray(system.P0))
    _, (*found, states) = jax.lax.scan(block, start, jax.tree.map(jnp.asarray, record))
    innovations, rows = jax.tree.map(_joined, found)
    return innovations, rows, states


def _joined(x: Array) -> Array:
    """Samples of all blocks."""
    return x.reshape(x.shape[0] * x.shape[1], *x.shape[2:])


# Of later samples: r of both columns, and its covariance N.
_Later = tuple[Float[Array, "n 2"], Float[Array, "n n"]]


@eqx.filter_jit
def run_smoother(system: System, states: State, record: Record) -> Columns:
    """Rows at every sample given all samples, from the states of the filter before every block.

    The estimates of Rauch, Tung and Striebel (1965) in the form of Bryson and Frazier, which inverts no
    covariance (states that are known exactly have a singular one): with r and N = cov(r), backwards,

        x̂ = x + P Aᵀr,   cov = P − P Aᵀ N A P,   r ← h e/s + (I − h gᵀ)Aᵀr,   N ← h hᵀ/s + (…)N(…)ᵀ.
    """

    def backward(later: _Later, at: tuple[Array, _Outputs]) -> tuple[_Later, _Later]:
        (r, N), (there, found) = later, at
        h = jnp.where(there, system.h, 0.0) / found.std
        closed = system.A.T - jnp.outer(h * found.std, system.A @ found.gain)
        before = closed @ r + jnp.outer(h, found.innovation / found.std)
        return (before, closed @ N @ closed.T + jnp.outer(h, h)), later

    def block(later: _Later, at: tuple[State, Record]) -> tuple[_Later, Columns]:
        state, samples = at
        found = _filtered(system, state, samples)[1]
        later, (r, N) = jax.lax.scan(backward, later, (samples.there, found), reverse=True)
        known = system.rows @ found.state.P
        moved = known @ system.A.T
        variance = jnp.sum(known * system.rows, axis=-1) - jnp.sum((moved @ N) * moved, axis=-1)
        value = system.rows @ found.state.x + moved @ r
        return later, Columns(value, jnp.sqrt(jnp.maximum(variance, 0.0)))

    n = len(system.h)
    last = (jnp.zeros((n, 2)), jnp.zeros((n, n)))
    at = (states, jax.tree.map(jnp.asarray, record))
    return jax.tree.map(_joined, jax.lax.scan(block, last, at, reverse=True)[1])


# Numbers of states that programs are compiled for.
_SIZES = (2, 4, 8, 16, 32, 64, 128)
# Least number of blocks that programs are compiled for; others are powers of two times that.
_FEWEST = 4
# Samples over which a term must keep more than 1/e of itself to be drift.
_SLOW = 10.0


@dataclasses.dataclass(frozen=True, eq=False)
class FilterModel:
    """A noise model for a filter.

    Attributes:
        space: its state space.
        drift: row that sums the states that are drift, those of the slow terms.
        slow: labels of these terms.
    """

    space: StateSpace
    drift: Float[np.ndarray, " n"]
    slow: tuple[str, ...]

    @classmethod
    def of(cls, model: Model, rate: float, duration: float, sensor: Sensor) -> FilterModel:
        """The model of samples at `rate` [Hz], for records of this duration [s].

        A term is slow, that is drift, if its slowest state decays without oscillating and keeps more than 1/e
        over ten samples: walks, ramps, Gauss–Markov processes, flicker, but not white noise, quantization,
        resonances and lines. With a response, drift is taken before it.
        """
        space = model.state_space(rate, duration=duration, sensor=sensor)
        places = {name: k for k, name in enumerate(space.names)}
        drift, slow = np.zeros(space.size), []
        for label, term in zip(model.term_labels, model.sampled(rate).terms, strict=True):
            block = term.state_block(rate, duration).labelled(label)
            poles = np.linalg.eigvals(block.transition)
            slowest = poles[np.argmax(abs(poles))] if block.size else 0.0
            if slowest.imag == 0.0 and slowest.real > math.exp(-1.0 / _SLOW):
                drift[[places[name] for name in block.names]] = block.observation
                slow.append(label)
        return cls(space, drift, tuple(slow))


def padded(space: StateSpace, drift: Float[np.ndarray, " n"]) -> System:
    """Matrices padded to a number of states that programs are compiled for; rows are all states and drift.

    Raises:
        AllanjaxError: the model has too many states.
    """
    if space.size > _SIZES[-1]:
        raise AllanjaxError(f"the model has {space.size} states; a filter takes at most {_SIZES[-1]}")
    most = next(size for size in _SIZES if space.size <= size)

    def grown(x: Float[np.ndarray, "*n"]) -> Any:
        return np.pad(x, [(0, most - space.size)] * x.ndim)

    rows: Any = np.concatenate([np.eye(most), grown(drift)[None]])
    white: Any = space.R[0, 0]
    return System(
        A=grown(space.A),
        h=grown(space.H[0]),
        Q=grown(space.Q),
        R=white,
        P0=grown(space.P0),
        rows=rows,
    )


def in_blocks(samples: Float[np.ndarray, " n"], missing: Bool[np.ndarray, " n"] | None) -> Record:
    """Samples in blocks, and which of them exist; padding counts as missing."""
    n = len(samples)
    size = _BLOCK * _FEWEST * 2 ** max(math.ceil(math.log2(n / (_BLOCK * _FEWEST))), 0)
    there, values = np.zeros(size, bool), np.zeros(size)
    there[:n] = True if missing is None else ~missing
    values[:n] = np.where(there[:n], samples, 0.0)
    parts: Any = (values.reshape(-1, _BLOCK), there.reshape(-1, _BLOCK))
    return Record(*parts)


# The unknown constant of a record, beside a filter for noise about zero (de Jong 1991, Ann. Stat. 19:1073).
#
# A filter without the constant b is run over the samples and over ones. Innovations are linear in both, so
# that those of samples less b are e − b·e₁: after k samples the information about b is Σ e₁²/s, and its
# estimate Σ e·e₁/s over that, both cumulative sums. The covariances of the filter itself keep converging,
# which they would not with a state for the constant; and an unknown constant needs no large initial variance.


@dataclasses.dataclass(frozen=True, eq=False)
class Constant:
    """Constant after each sample, and the innovations of the samples without it.

    Attributes:
        value, variance: estimate of the constant after each sample, and its variance, infinite before the
            first.
        innovation, innovation_std: innovations of the samples; NaN for missing and unpredictable ones.
    """

    value: Float[np.ndarray, " n"]
    variance: Float[np.ndarray, " n"]
    innovation: Float[np.ndarray, " n"]
    innovation_std: Float[np.ndarray, " n"]

    @classmethod
    def of(
        cls,
        innovation: Float[np.ndarray, "n 2"],
        std: Float[np.ndarray, " n"],
        there: Bool[np.ndarray, " n"],
        prior_std: float | None,
        offset: float = 0.0,
    ) -> Constant:
        """Constant from the innovations of samples and ones.

        Args:
            innovation, std: innovations of both columns, and their common standard deviation.
            there: which samples exist.
            prior_std: prior standard deviation of the constant about zero; None if nothing is known, 0 if
                there is no constant.
            offset: number that was subtracted from the samples, and also from `value`.
        """
        e, ones = innovation.T
        s = np.where(there, std, 1.0) ** 2
        known = prior_std == 0.0
        precision = 0.0 if prior_std is None or known else prior_std**-2.0
        with np.errstate(divide="ignore", invalid="ignore"):
            information = precision + np.cumsum(ones**2 / s)
            weighted = -offset * precision + np.cumsum(e * ones / s)
            value = np.where(information > 0.0, weighted / information, 0.0)
            variance = np.where(information > 0.0, 1.0 / information, np.inf)
        if known:
            value, variance = np.full(len(e), -offset), np.zeros(len(e))
        prior = (-offset, np.inf if prior_std is None else prior_std**2)
        before, uncertain = (
            np.concatenate([[p], x[:-1]]) for p, x in zip(prior, (value, variance), strict=True)
        )
        predicted = there & np.isfinite(uncertain)
        with np.errstate(invalid="ignore"):
            spread = np.sqrt(s + np.where(predicted, uncertain, 0.0) * ones**2)
        e = np.where(predicted, e - before * ones, np.nan)
        return cls(value, variance, e, np.where(predicted, spread, np.nan))

    def added_to(
        self, rows: Columns, smoothed: bool
    ) -> tuple[Float[np.ndarray, "n rows"], Float[np.ndarray, "n rows"]]:
        """Rows, to the last of which the constant is added, and their standard deviations.

        The constant is that after each sample, or, if the rows are `smoothed`, after all of them.
        """
        n, after = len(self.value), slice(-1, None) if smoothed else slice(None)
        value, variance = self.value[after, None], self.variance[after, None]
        of_samples, of_ones = np.moveaxis(np.asarray(rows.value)[:n], -1, 0)
        moved = np.eye(of_ones.shape[1])[-1] - of_ones
        added = np.where(moved == 0.0, 0.0, moved**2 * variance)
        return of_samples + moved * value, np.sqrt(np.asarray(rows.std)[:n] ** 2 + added)


def log_densities(
    innovation: Float[np.ndarray, "*n"], variance: Float[np.ndarray, "*n"]
) -> Float[np.ndarray, "*n"]:
    """Logarithms of the normal densities of innovations.

    Their sum is the log-likelihood of all samples; with an unknown constant, that of the differences of
    successive samples, which do not depend on it.
    """
    return -0.5 * (np.log(2.0 * math.pi * variance) + innovation**2 / variance)


def innovations_under(
    models: Sequence[Model],
    z: Float[np.ndarray, " n"],
    rate: float,
    missing: Bool[np.ndarray, " n"] | None = None,
) -> tuple[Float[np.ndarray, "models n1"], Float[np.ndarray, "models n1"]]:
    """Innovations of the samples under each model, and their variances, except for the first sample.

    The mean of the samples is unknown; missing samples are left out.
    """
    n = len(z)
    there = np.ones(n, bool) if missing is None else ~missing
    record, used, each = in_blocks(z - z[there].mean(), missing), np.flatnonzero(there)[1:], []
    for model in models:
        space = model.state_space(rate, duration=n / rate)
        found = run_filter(padded(space, np.zeros(space.size)), record)[0]
        e, std = (np.asarray(x)[:n] for x in found)
        each.append(Constant.of(e, std, there, None))
    return np.stack([c.innovation[used] for c in each]), np.stack([c.innovation_std[used] ** 2 for c in each])


def log_likelihoods(
    innovation: Float[np.ndarray, "models n1"], variance: Float[np.ndarray, "models n1"]
) -> Float[np.ndarray, " models"]:
    """Log-likelihood [nats] of each model, from its innovations; NaN if a sample has no variance."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.sum(log_densities(innovation, variance), axis=1)
