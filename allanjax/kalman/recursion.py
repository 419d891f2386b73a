"""Kalman filter and smoother in square-root form, one compiled scan each, and the exact likelihood.

The filter (3.5)–(3.17) carries a factor S of the covariance P = SSᵀ, which no rounding can make negative, and
updates it by an orthogonal triangularization of

    [√R  hᵀF]      [√s   0]
    [ 0   F ]  →   [g√s  S],      F = [A S⁺, √Q] the factor of (3.14), g the gain (3.15), S that of (3.17).

Once gain and covariance no longer change, they are kept, and a step computes the states alone. Long after the
start, where they change slowly, they are computed at every 64th sample (exactly, by the transition over all
samples between, see `Skip`), and the gains between are interpolated to 10⁻⁶, since their relative change per
step is at most the inverse of the number of samples so far. A missing sample restarts all this. Two columns
are filtered with the same gains: the samples, and ones, from which an unknown constant is estimated without a
state of its own (see `Constant`).

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
from jaxtyping import Array, Bool, Float, Int

from allanjax.base.errors import AllanjaxError
from allanjax.noise.model import Model
from allanjax.noise.state_space import StateSpace
from allanjax.record.units import Sensor

# Relative change of gain and standard deviations in a step below which they are kept: as it falls in
# proportion to the distance from the limit, the error is less than this times the filter's time constant in
# samples.
_SETTLED = 1e-12
#: Samples of a block, for which gains are computed one by one, or at its end only.
BLOCK = 64
# Samples after which gains change slowly.
_YOUNG = 1 << 15


class Skip(NamedTuple):
    """Effect of several samples on the factor S of the covariance: S' of P' = C + A(P⁻¹ + J)⁻¹Aᵀ.

    `A` is the transition of the states, `C` the covariance of a filter that started from known states, J the
    information of the samples about these (Särkkä & García-Fernández 2021, IEEE TAC 66:299).

    Attributes:
        A, J: as above.
        noise: a factor of C.
        allowed: whether the filter may skip samples.
    """

    A: Float[Array, "*models n n"]
    J: Float[Array, "*models n n"]
    noise: Float[Array, "*models n n"]
    allowed: Bool[Array, "*models"]


class System(NamedTuple):
    """Matrices of a filter, padded to a number of states for which a program is compiled.

    Attributes:
        A, h: transition and observation.
        noise, white, start: factors of Q and P0, and the root of R.
        rows: requested sums of states, one per row.
        skip: effect of a block less one sample on the covariance.
    """

    A: Float[Array, "*models n n"]
    h: Float[Array, "*models n"]
    noise: Float[Array, "*models n n"]
    white: Float[Array, "*models"]
    start: Float[Array, "*models n n"]
    rows: Float[Array, "*models rows n"]
    skip: Skip


class Columns(NamedTuple):
    """Numbers of both columns, and their standard deviation for a known constant.

    Innovations, zero where there is no sample; or requested sums of states.
    """

    value: Float[Array, "*samples 2"]
    std: Float[Array, "*samples"]


class Gains(NamedTuple):
    """Gain (3.15), standard deviation of the innovation, and those of the rows after the sample."""

    gain: Float[Array, " n"]
    innovation_std: Float[Array, ""]
    std: Float[Array, " rows"]


class State(NamedTuple):
    """State of the filter before a sample.

    Attributes:
        x: predicted states, of both columns (3.13).
        gains: of the last sample.
        S: factor of the covariance after it (3.17).
        age: samples since the first or a missing one, −1 before the first.
        settled: whether gains and covariance no longer change.
    """

    x: Float[Array, "n 2"]
    gains: Gains
    S: Float[Array, "n n"]
    age: Int[Array, ""]
    settled: Bool[Array, ""]


class Record(NamedTuple):
    """Samples in blocks, which of them exist, and which blocks are padding after the end."""

    sample: Float[Array, "blocks block"]
    there: Bool[Array, "blocks block"]
    after: Bool[Array, " blocks"]


def _triangular(M: Float[Array, "n m"]) -> Float[Array, "n n"]:
    """Triangular factor L of LLᵀ = MMᵀ."""
    return jnp.linalg.qr(M.T, mode="r").T


def _unchanged(new: Array, old: Array, scale: Array) -> Bool[Array, ""]:
    return jnp.all(jnp.abs(new - old) <= _SETTLED * scale)


def _updated(
    system: System, S: Float[Array, "n n"], there: Array, first: Array
) -> tuple[Gains, Float[Array, "n n"]]:
    """Gains at a sample, and the factor after it, from the factor after the one before."""
    h, white = jnp.where(there, system.h, 0.0), jnp.where(there, system.white, 1.0)
    n = len(h)
    predicted = jnp.where(first, jnp.asarray(system.start), system.A @ S)
    factor = jnp.concatenate([predicted, jnp.where(first, 0.0, system.noise)], axis=1)
    top = jnp.concatenate([white[None], h @ factor])
    below = jnp.concatenate([jnp.zeros((n, 1)), factor], axis=1)
    found = _triangular(jnp.concatenate([top[None], below]))
    S = found[1:, 1:]
    std = jnp.sqrt(jnp.sum((system.rows @ S) ** 2, axis=1))
    return Gains(found[1:, 0] / found[0, 0], jnp.abs(found[0, 0]), std), S


def _skipped(skip: Skip, S: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Factor after the samples that are skipped."""
    inner = jnp.linalg.cholesky(jnp.eye(len(S)) + S.T @ skip.J @ S)
    known = jax.scipy.linalg.solve_triangular(inner, S.T, lower=True).T
    return _triangular(jnp.concatenate([skip.A @ known, jnp.asarray(skip.noise)], axis=1))


def _innovation(system: System, x: Float[Array, "n 2"], sample: Array, there: Array) -> Float[Array, " 2"]:
    """Innovations of the sample and of a one, zero where there is no sample."""
    return jnp.where(there, jnp.stack([sample, jnp.ones(())]) - system.h @ x, 0.0)


def _step(system: System, state: State, sample: Array, there: Array) -> tuple[State, tuple[Array, Array]]:
    """State before the next sample, with the innovations of this one and the updated states (3.16)."""
    innovation = _innovation(system, state.x, sample, there)
    new, S = _updated(system, state.S, there, state.age < 0)
    old, sd = state.gains, new.innovation_std
    settled = there & _unchanged(new.std, old.std, new.std) & _unchanged(sd, old.innovation_std, sd)
    size = jnp.sqrt(jnp.sum(S**2, axis=1))
    settled &= _unchanged(new.gain * sd, old.gain * old.innovation_std, size)
    age = jnp.where(there, jnp.maximum(state.age, 0) + 1, 0)
    x = state.x + new.gain[:, None] * innovation
    return State(system.A @ x, new, S, age, settled), (innovation, x)


# Innovations, updated states and gains, of a sample or of all in a block.
_Outputs = tuple[Array, Array, Gains]
# With factors of the covariance, and whether gains are settled.
_Steps = tuple[_Outputs, Array, Array]


def _steps(system: System, state: State, samples: Array, there: Array) -> tuple[State, _Steps]:
    """State after a block whose gains are computed one by one, with outputs in it."""

    def step(state: State, at: tuple[Array, Array]) -> tuple[State, _Steps]:
        new, found = _step(system, state, *at)
        return new, ((*found, new.gains), new.S, new.settled)

    return jax.lax.scan(step, state, (samples, there))


def _block(
    system: System, state: State, samples: Array, there: Array, after: Array
) -> tuple[State, _Outputs]:
    """State after a block, with innovations, updated states and gains in it."""
    whole = jnp.all(there)
    steady = after | (whole & state.settled)
    old = whole & system.skip.allowed & (state.age >= _YOUNG)

    def one_by_one(state: State) -> tuple[State, _Outputs]:
        end, (found, *_) = _steps(system, state, samples, there)
        return end, found

    def at_once(state: State) -> tuple[State, _Outputs]:
        def skipped(state: State) -> tuple[Gains, Float[Array, "n n"]]:
            S = _skipped(system.skip, state.S)
            return _updated(system, S, jnp.asarray(True), jnp.asarray(False))

        end, S = jax.lax.cond(steady, lambda s: (s.gains, s.S), skipped, state)
        share = jnp.arange(1, BLOCK + 1) / BLOCK
        gains = jax.tree.map(
            lambda now, then: now + share.reshape(-1, *[1] * now.ndim) * (then - now), state.gains, end
        )

        def step(x: Array, at: tuple[Array, Array, Array]) -> tuple[Array, tuple[Array, Array]]:
            sample, there, gain = at
            innovation = _innovation(system, x, sample, there)
            updated = x + gain[:, None] * innovation
            return system.A @ updated, (innovation, updated)

        x, found = jax.lax.scan(step, state.x, (samples, there, gains.gain))
        return State(x, end, S, state.age + BLOCK, state.settled & steady), (*found, gains)

    return jax.lax.cond(steady | old, at_once, one_by_one, state)


@eqx.filter_jit
def run_filter(system: System, record: Record) -> tuple[Columns, Columns, State]:
    """Innovations and updated rows at every sample, and the state before every block of samples."""

    def block(state: State, at: Sequence[Array]) -> tuple[State, tuple[Columns, Columns, State]]:
        end, (innovation, x, gains) = _block(system, state, *at)
        rows = Columns(jnp.einsum("rn,bnc->brc", system.rows, x), gains.std)
        return end, (Columns(innovation, gains.innovation_std), rows, state)

    n, rows = len(system.h), len(system.rows)
    nothing = Gains(jnp.zeros(n), jnp.zeros(()), jnp.zeros(rows))
    start = State(jnp.zeros((n, 2)), nothing, jnp.zeros((n, n)), jnp.asarray(-1), jnp.asarray(False))
    _, (*found, states) = jax.lax.scan(block, start, tuple(map(jnp.asarray, record)))
    innovations, rows = jax.tree.map(_joined, found)
    return innovations, rows, states


def _joined(x: Array) -> Array:
    """Samples of all blocks."""
    return x.reshape(x.shape[0] * x.shape[1], *x.shape[2:])


@eqx.filter_jit
def run_bank(systems: System, record: Record) -> tuple[Columns, Columns]:
    """Innovations and updated rows of several filters with the same numbers of states, one after the other.

    Not side by side, so that each of them may stop computing gains.
    """
    return jax.lax.map(lambda system: run_filter(system, record)[:2], jax.tree.map(jnp.asarray, systems))


class _Adjoint(NamedTuple):
    """State of the smoother after a sample, from later samples.

    Attributes:
        r, N: of both columns, and its covariance.
        std: smoothed standard deviations of the rows at the next sample.
        age: samples to the last one, or to a missing one.
        settled: whether covariances no longer change.
    """

    r: Float[Array, "n 2"]
    N: Float[Array, "n n"]
    std: Float[Array, " rows"]
    age: Int[Array, ""]
    settled: Bool[Array, ""]


# Input of a step back for one sample: innovation, updated states, gains, and whether it exists.
_Sample = tuple[Array, Array, Gains, Array]


def _back(system: System, r: Float[Array, "n 2"], at: _Sample) -> tuple[Array, Array]:
    """r before a sample, and Aᵀr, by which the states at the sample are corrected."""
    innovation, _, gains, there = at
    h, sd = jnp.where(there, system.h, 0.0), jnp.where(there, gains.innovation_std, 1.0)
    a = system.A.T @ r
    return h[:, None] * (innovation / sd**2 - jnp.where(there, gains.gain, 0.0) @ a) + a, a


def _closed(system: System, gains: Gains, there: Array) -> tuple[Float[Array, "n n"], Float[Array, "n n"]]:
    """L and h·hᵀ/s of the effect of a sample on N: L·N·Lᵀ + h·hᵀ/s."""
    h, sd = jnp.where(there, system.h, 0.0), jnp.where(there, gains.innovation_std, 1.0)
    scaled = h / sd
    return system.A.T - jnp.outer(h, system.A @ gains.gain), jnp.outer(scaled, scaled)


def _smoothed_std(system: System, P: Float[Array, "n n"], N: Float[Array, "n n"]) -> Float[Array, " rows"]:
    """Standard deviations of the rows, from the filter's covariance and that of r after the sample."""
    known = system.rows @ P
    moved = known @ system.A.T
    variance = jnp.sum(known * system.rows, axis=1) - jnp.sum((moved @ N) * moved, axis=1)
    return jnp.sqrt(jnp.maximum(variance, 0.0))


@eqx.filter_jit
def run_smoother(system: System, states: State, record: Record) -> Columns:
    """Rows at every sample given all samples, from the states of the filter before every block.

    The estimates of Rauch, Tung and Striebel (1965) in the form of Bryson and Frazier, which inverts no
    covariance (states that are known exactly have a singular one): with r and N = cov(r), backwards,

        x̂ = x + P Aᵀr,   cov = P − P Aᵀ N A P,   r ← h e/s + (I − h gᵀ)Aᵀr,   N ← h hᵀ/s + (…)N(…)ᵀ,

    where N is a sum of squares and needs no factor. Long after the start and before the end, N is computed
    at the ends of blocks, and P and the standard deviations between are interpolated, as the filter's gains.
    """

    def backward(
        adjoint: _Adjoint, at: tuple[Array, tuple[_Outputs, Array, Array]]
    ) -> tuple[_Adjoint, Columns]:
        there, (found, S, is_settled) = at
        _, x, gains = found
        r, a = _back(system, adjoint.r, (*found, there))
        std = _smoothed_std(system, S @ S.T, adjoint.N)
        L, own = _closed(system, gains, there)
        N = L @ adjoint.N @ L.T + own
        size, old = (jnp.sqrt(jnp.diag(part)) for part in (N, adjoint.N))
        settled = is_settled & _unchanged(std, adjoint.std, std) & _unchanged(size, old, size)
        age = jnp.where(there, adjoint.age + 1, 0)
        return _Adjoint(r, N, std, age, settled), Columns(system.rows @ (x + S @ (S.T @ a)), std)

    def one_by_one(adjoint: _Adjoint, state: State, samples: Array, there: Array) -> tuple[_Adjoint, Columns]:
        found = _steps(system, state, samples, there)[1]
        return jax.lax.scan(backward, adjoint, (there, found), reverse=True)

    def at_once(adjoint: _Adjoint, state: State, samples: Array, there: Array) -> tuple[_Adjoint, Columns]:
        end, (innovation, x, gains) = _block(system, state, samples, there, jnp.asarray(False))
        P, change = state.S @ state.S.T, end.S @ end.S.T - state.S @ state.S.T
        L, N = _closed(system, jax.tree.map(lambda of: jnp.mean(of, axis=0), gains), jnp.asarray(True))
        for _ in range(BLOCK.bit_length() - 1):
            L, N = L @ L, N + L @ N @ L.T
        N = L @ adjoint.N @ L.T + N
        ends = _smoothed_std(system, P, N), _smoothed_std(system, P + change, adjoint.N)
        share = jnp.arange(1, BLOCK + 1) / BLOCK
        inputs = (innovation, x, gains, there)
        r, a = jax.lax.scan(lambda r, at: _back(system, r, at), adjoint.r, inputs, reverse=True)
        part = share[:, None, None]
        moved = jnp.einsum("ij,bjc->bic", P, a) + part * jnp.einsum("ij,bjc->bic", change, a)
        value = jnp.einsum("rn,bnc->brc", system.rows, x + moved)
        std = ends[0] + share[:, None] * (ends[1] - ends[0])
        return _Adjoint(r, N, std[0], adjoint.age + BLOCK, adjoint.settled), Columns(value, std)

    n, rows = len(system.h), len(system.rows)

    def nothing(adjoint: _Adjoint, state: State, samples: Array, there: Array) -> tuple[_Adjoint, Columns]:
        return adjoint, Columns(jnp.zeros((BLOCK, rows, 2)), jnp.zeros((BLOCK, rows)))

    def block(adjoint: _Adjoint, at: tuple[State, Array, Array, Array]) -> tuple[_Adjoint, Columns]:
        state, samples, there, after = at
        slow = system.skip.allowed & (jnp.minimum(state.age, adjoint.age) >= _YOUNG)
        kept = jnp.all(there) & (slow | (adjoint.settled & state.settled))
        ways = (one_by_one, at_once, nothing)
        return jax.lax.switch(jnp.where(after, 2, kept), ways, adjoint, state, samples, there)

    last = _Adjoint(jnp.zeros((n, 2)), jnp.zeros((n, n)), jnp.zeros(rows), jnp.asarray(0), jnp.asarray(False))
    at = (states, jnp.asarray(record.sample), jnp.asarray(record.there), jnp.asarray(record.after))
    _, found = jax.lax.scan(block, last, at, reverse=True)
    return jax.tree.map(_joined, found)


# Numbers of states that programs are compiled for.
_SIZES = (2, 4, 8, 16, 32, 64, 128)
# Least number of blocks that programs are compiled for; others are powers of two times that.
_FEWEST = 4
# A state that oscillates and loses less than 1/e in so many samples: gains may oscillate as long.
_LASTING = 100.0
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


def factor(covariance: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Factor L of a covariance LLᵀ that may be singular, whatever the units of its variables."""
    size = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    scale = np.where(size > 0.0, size, 1.0)
    value, vector = np.linalg.eigh(covariance / np.outer(scale, scale))
    return scale[:, None] * vector * np.sqrt(np.maximum(value, 0.0))


def padded(space: StateSpace, rows: Float[np.ndarray, "rows n"], most: int) -> System:
    """Matrices padded to this many states; `rows` are the requested sums of states."""
    skipped = _skipped_samples(space)
    white: Any = np.sqrt(space.R[0, 0])
    allowed: Any = np.asarray(skipped is not None)

    def grown(x: Float[np.ndarray, "*n"], kept: int = 0) -> Any:
        return np.pad(x, [(0, 0)] * kept + [(0, most - space.size)] * (x.ndim - kept))

    nothing = np.zeros((space.size, space.size))
    A, C, J = skipped or (nothing, nothing, nothing)
    return System(
        A=grown(space.A),
        h=grown(space.H[0]),
        noise=grown(factor(space.Q)),
        white=white,
        start=grown(factor(space.P0)),
        rows=grown(rows, kept=1),
        skip=Skip(grown(A), grown(J), grown(factor((C + C.T) / 2.0)), allowed),
    )


_Skipped = tuple[np.ndarray, np.ndarray, np.ndarray]


def _skipped_samples(space: StateSpace) -> _Skipped | None:
    """Transition, covariance and information of a block less one sample, joined in powers of two.

    None if the filter may not skip samples.
    """
    poles = np.linalg.eigvals(space.A)
    lasting = (abs(poles) > math.exp(-1.0 / _LASTING)) & (poles.imag != 0.0)
    h, R, one = space.H[0], space.R[0, 0], np.eye(space.size)
    s = float(h @ space.Q @ h + R)
    if space.size == 0 or lasting.any() or not s > 0.0:
        return None
    closed = one - np.outer(space.Q @ h / s, h)
    observed = space.A.T @ h
    power = (closed @ space.A, closed @ space.Q, np.outer(observed, observed) / s)
    total = (one, 0.0 * one, 0.0 * one)
    for bit in bin(BLOCK - 1)[:1:-1]:
        if bit == "1":
            total = _followed(total, power)
        power = _followed(power, power)
    return total


def _followed(first: _Skipped, then: _Skipped) -> _Skipped:
    """Transition, covariance and information of samples and of those that follow."""
    (A1, C1, J1), (A2, C2, J2) = first, then
    between = np.linalg.inv(np.eye(len(A1)) + C1 @ J2)
    return A2 @ between @ A1, A2 @ between @ C1 @ A2.T + C2, A1.T @ J2 @ between @ A1 + J1


def padded_size(spaces: Sequence[StateSpace]) -> int:
    """Number of states of a program that takes all of these; AllanjaxError if they are too many."""
    most = max(space.size for space in spaces)
    if most > _SIZES[-1]:
        raise AllanjaxError(f"the model has {most} states; a filter takes at most {_SIZES[-1]}")
    return next(size for size in _SIZES if most <= size)


def bank_of(spaces: Sequence[StateSpace], rows: Sequence[Float[np.ndarray, "rows n"]]) -> System:
    """Matrices of several models padded to one size, for a bank."""
    most = padded_size(spaces)
    each = [padded(space, of, most) for space, of in zip(spaces, rows, strict=True)]
    return jax.tree.map(lambda *of_each: np.stack(of_each), *each)


def in_blocks(samples: Float[np.ndarray, " n"], missing: Bool[np.ndarray, " n"] | None) -> Record:
    """Samples in blocks, and which of them exist; padding counts as missing."""
    n = len(samples)
    size = BLOCK * _FEWEST * 2 ** max(math.ceil(math.log2(n / (BLOCK * _FEWEST))), 0)
    there, values = np.zeros(size, bool), np.zeros(size)
    there[:n] = True if missing is None else ~missing
    values[:n] = np.where(there[:n], samples, 0.0)
    after = np.arange(0, size, BLOCK) >= n
    parts: Any = (values.reshape(-1, BLOCK), there.reshape(-1, BLOCK), after)
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
        log_density: logarithms of the innovations' densities; zero for those. Their sum is the log-likelihood
            of all samples; with an unknown constant, that of the differences of successive samples, which do
            not depend on it.
    """

    value: Float[np.ndarray, " n"]
    variance: Float[np.ndarray, " n"]
    innovation: Float[np.ndarray, " n"]
    innovation_std: Float[np.ndarray, " n"]
    log_density: Float[np.ndarray, " n"]

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
        spread = np.where(predicted, spread, np.nan)
        density = np.zeros(len(e))
        density[predicted] = -0.5 * _chi2(e[predicted], spread[predicted] ** 2)
        return cls(value, variance, e, spread, density)

    def added_to(
        self, rows: Columns, share: Float[np.ndarray, " rows"], smoothed: bool = False
    ) -> tuple[Float[np.ndarray, "n rows"], Float[np.ndarray, "n rows"]]:
        """Rows with shares of the constant, and their standard deviations.

        The constant is that after each sample, or, if the rows are `smoothed`, after all of them.
        """
        n, after = len(self.value), slice(-1, None) if smoothed else slice(None)
        value, variance = self.value[after, None], self.variance[after, None]
        of_samples, of_ones = np.moveaxis(np.asarray(rows.value)[:n], -1, 0)
        moved = share - of_ones
        added = np.where(moved == 0.0, 0.0, moved**2 * variance)
        return of_samples + moved * value, np.sqrt(np.asarray(rows.std)[:n] ** 2 + added)


def _chi2(e: Float[np.ndarray, "*n"], variance: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Minus twice the logarithms of normal densities."""
    return np.log(2.0 * math.pi * variance) + e**2 / variance


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
    spaces = [model.state_space(rate, duration=n / rate) for model in models]
    systems = bank_of(spaces, [np.zeros((0, space.size)) for space in spaces])
    out = jax.device_get(run_bank(systems, in_blocks(z - z[there].mean(), missing))[0])
    each = [Constant.of(e[:n], std[:n], there, None) for e, std in zip(out.value, out.std, strict=True)]
    used = np.flatnonzero(there)[1:]
    return np.stack([c.innovation[used] for c in each]), np.stack([c.innovation_std[used] ** 2 for c in each])


def log_likelihoods(
    innovation: Float[np.ndarray, "models n1"], variance: Float[np.ndarray, "models n1"]
) -> Float[np.ndarray, " models"]:
    """Log-likelihood [nats] of each model, from its innovations; NaN if a sample has no variance."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return -0.5 * np.sum(_chi2(innovation, variance), axis=1)
