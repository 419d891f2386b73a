"""A noise model's matrices as the compiled filters take them, and which of its states are drift."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from allanjax.base.errors import AllanjaxError
from allanjax.kalman.recursion import BLOCK, Record, Skip, System
from allanjax.noise.model import Model
from allanjax.noise.state_space import StateSpace
from allanjax.record.units import Sensor

# Numbers of states that programs are compiled for.
_SIZES = (2, 4, 8, 16, 32, 64, 128)
# Least number of blocks that programs are compiled for; others are powers of two times that.
_FEWEST = 4
# A state that oscillates and loses less than 1/e in so many samples: gains may oscillate as long.
_LASTING = 100.0
# Samples in which a term must keep more than 1/e of itself to be drift.
_SLOW = 10.0


@dataclasses.dataclass(frozen=True, eq=False)
class FilterModel:
    """A noise model for a filter.

    Attributes:
        space: its state space.
        drift: what of the states is drift, a row: the sum of the slow terms.
        slow: their labels.
    """

    space: StateSpace
    drift: Float[np.ndarray, " n"]
    slow: tuple[str, ...]

    @classmethod
    def of(cls, model: Model, rate: float, duration: float, sensor: Sensor) -> FilterModel:
        """The model of samples at `rate` [Hz], for records of this duration [s].

        A term is slow, that is drift, if its slowest state decays without oscillating and keeps more than 1/e
        over ten samples: walks, ramps, Gauss–Markov processes, flicker. White noise, quantization, resonances
        and lines are not. Behind a response it is the drift before it that counts.

        Raises:
            AllanjaxError: see `Model.state_space`.
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


def padded(space: StateSpace, rows: Float[np.ndarray, "rows n"], room: int | None = None) -> System:
    """Matrices with room for one of a few numbers of states, or for `room` of them; `rows` are told of.

    Raises:
        AllanjaxError: the model has more states than a filter takes.
    """
    n = space.size
    if room is None:
        room = room_for([space])
    grown = [(0, room - n)] * 2
    parts: Any = (
        np.pad(space.A, grown),
        np.pad(space.H[0], grown[0]),
        np.pad(factor(space.Q), grown),
        np.sqrt(space.R[0, 0]),
        np.pad(factor(space.P0), grown),
        np.pad(rows, [(0, 0), grown[0]]),
        _skip(space, room),
    )
    return System(*parts)


def _skip(space: StateSpace, room: int) -> Skip:
    """What the samples that are skipped make of the covariance: of one sample, joined in powers of two."""
    poles = np.linalg.eigvals(space.A)
    lasting = (abs(poles) > math.exp(-1.0 / _LASTING)) & (poles.imag != 0.0)
    n, grown = space.size, [(0, room - space.size)] * 2
    h, R, one = space.H[0], space.R[0, 0], np.eye(space.size)
    s = float(h @ space.Q @ h + R)
    parts: Any
    if n == 0 or lasting.any() or not s > 0.0:
        nothing = np.zeros((room, room))
        parts = (nothing, nothing, nothing, np.asarray(False))
        return Skip(*parts)
    closed = one - np.outer(space.Q @ h / s, h)
    seen = space.A.T @ h
    power = (closed @ space.A, closed @ space.Q, np.outer(seen, seen) / s)
    total = (one, 0.0 * one, 0.0 * one)
    for bit in bin(BLOCK - 1)[:1:-1]:
        if bit == "1":
            total = _joined(total, power)
        power = _joined(power, power)
    A, C, J = total
    parts = (np.pad(A, grown), np.pad(J, grown), np.pad(factor((C + C.T) / 2.0), grown), np.asarray(True))
    return Skip(*parts)


def _joined(
    first: tuple[np.ndarray, np.ndarray, np.ndarray], then: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Transition, covariance and information of samples and of those that follow."""
    (A1, C1, J1), (A2, C2, J2) = first, then
    between = np.linalg.inv(np.eye(len(A1)) + C1 @ J2)
    return A2 @ between @ A1, A2 @ between @ C1 @ A2.T + C2, A1.T @ J2 @ between @ A1 + J1


def room_for(spaces: Sequence[StateSpace]) -> int:
    """Number of states that a program for all of these has."""
    most = max(space.size for space in spaces)
    for size in _SIZES:
        if most <= size:
            return size
    raise AllanjaxError(f"a filter takes at most {_SIZES[-1]} states, and the model has {most}")


def stacked(systems: Sequence[System]) -> System:
    """Matrices of several models of one size, for a bank."""
    import jax

    return jax.tree.map(lambda *of_each: np.stack(of_each), *systems)


def in_blocks(samples: Float[np.ndarray, " n"], missing: Bool[np.ndarray, " n"] | None) -> Record:
    """Samples in blocks, which are there and which are missing; those that only pad are missing, too."""
    n = len(samples)
    room = BLOCK * _FEWEST * 2 ** max(math.ceil(math.log2(n / (BLOCK * _FEWEST))), 0)
    there, values = np.zeros(room, bool), np.zeros(room)
    there[:n] = True if missing is None else ~missing
    values[:n] = np.where(there[:n], samples, 0.0)
    after = np.arange(0, room, BLOCK) >= n
    parts: Any = (values.reshape(-1, BLOCK), there.reshape(-1, BLOCK), after)
    return Record(*parts)
