"""State space of a noise model: the matrices of a Kalman filter, with names and units."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Bool, Float

from allanjax.base.equality import ByValue
from allanjax.base.late import presented
from allanjax.base.tables import Column, Tabled, columns_from
from allanjax.base.wording import significant
from allanjax.record.units import Sensor, default_coefficient_unit, si_unit

# State-space blocks: what one noise term, or one filter after several, adds to a Kalman filter's state.
#
# A block is the recursion x_{k+1} = A x_k + w_k with samples z_k = H x_k + v_k, in which w and v are white
# and independent of each other. Where a sample is the mean of a process over its interval, that mean is a
# state of its own beside the value at the end of the interval: the two share their noise, and R stays zero.

_Square: TypeAlias = Float[np.ndarray, "n n"]
SCHEMA_VERSION = 1
# Doublings after which the sum for a stationary covariance has converged, or never will.
_DOUBLINGS = 80


@dataclasses.dataclass(frozen=True)
class Block:
    """States of a noise term and the samples that they make; by default rates, and stationary.

    Attributes:
        transition: A, from one sample to the next.
        observation: H, a row: weights of the states in a sample.
        noise: Q, covariance of the noise that drives the states.
        start: P0, covariance of the states at the first sample.
        names: names of the states within their term; "" for the only one.
        white: R, variance of white noise on the samples [rate²].
        time_exponents: p in the unit (rate)·s^p of each state.
        level: which states are random walks, that is, have no stationary law.
    """

    transition: _Square
    observation: Any
    noise: _Square
    start: _Square
    names: tuple[str, ...]
    white: float = 0.0
    time_exponents: tuple[float, ...] = ()
    level: Any = ()

    def __post_init__(self) -> None:
        n = len(self.names)
        complete: dict[str, Any] = {
            "observation": np.asarray(self.observation, float),
            "white": float(self.white),
            "time_exponents": self.time_exponents or (0.0,) * n,
            "level": np.asarray(self.level if len(self.level) else (False,) * n, bool),
        }
        for name, value in complete.items():
            object.__setattr__(self, name, value)

    @property
    def size(self) -> int:
        """Number of states."""
        return len(self.names)

    def labelled(self, label: str) -> Block:
        """A copy whose states have the term's name before theirs."""
        names = tuple(f"{label}_{name}" if name else label for name in self.names)
        return dataclasses.replace(self, names=names)


def white_block(variance: float) -> Block:
    """White noise on the samples, which needs no state."""
    none = np.zeros((0, 0))
    return Block(none, [], none, none, (), white=variance)


def mean_block(variance: float, x: float) -> Block:
    """Means over sample intervals of a process of autocovariance variance·e^{−|t|}, t in correlation times.

    An interval has x correlation times. States: the mean over the interval, and the value at its end. With u
    the time within an interval, mean − m(e) and end − E(e) given the value e before are
    (1/x)∫(1 − e^{−u})dW and ∫e^{−u}dW, integrals of white noise of density 2·variance.
    """
    decay, gone = np.exp(-x), -np.expm1(-x)
    own = x - 2.0 * gone - np.expm1(-2.0 * x) / 2.0
    if x < 0.03:  # Series of ∫(1 − e^{−u})² du, which would cancel.
        own = x**3 * (1 / 3 - x * (1 / 4 - x * (7 / 60 - x * (1 / 24 - x * (31 / 2520 - x / 320)))))
    shared = gone**2 / x
    noise = variance * np.array([[2.0 * own / x**2, shared], [shared, -np.expm1(-2.0 * x)]])
    transition = np.array([[0.0, gone / x], [0.0, decay]])
    # The value before the first interval has the stationary law.
    start = variance * np.outer(transition[:, 1], transition[:, 1]) + noise
    return Block(transition, [1.0, 0.0], noise, start, ("mean", "end"))


def exponential_block(weight: Any, pole: Any) -> Block:
    """Process of the autocovariance Re[weight·e^{pole·|k|}] at the samples k: one state, or an oscillator.

    A complex pole −a + iω_d is that of x'' + 2a x' + ω0² x = white noise. Its states are position, and
    velocity divided by ω0, which is uncorrelated with it and has the same variance.
    """
    variance = float(np.real(weight))
    if not np.iscomplexobj(pole):
        noise = np.array([[-np.expm1(2.0 * pole) * variance]])
        return Block(np.exp([[pole]]), [1.0], noise, np.array([[variance]]), ("",))
    a, wd, w0 = -float(np.real(pole)), float(np.imag(pole)), float(abs(pole))
    c, s = np.cos(wd), np.sin(wd) / wd
    transition = np.exp(-a) * np.array([[c + a * s, w0 * s], [-w0 * s, c - a * s]])
    # I − A Aᵀ without its cancellation: 4a∫ g gᵀ du over the interval, g(u) = e^{−au}·(ω0 sin(ω_d u)/ω_d,
    # cos ω_d u − a sin(ω_d u)/ω_d) = Re[m e^{pole·u}], whose products have the exponents 2·pole and −2a.
    mode = np.array([w0 / (1j * wd), 1.0 - a / (1j * wd)])
    same, mixed = np.expm1(2.0 * pole) / (2.0 * pole), -np.expm1(-2.0 * a) / (2.0 * a)
    product = np.outer(mode, mode) * same + np.outer(mode, mode.conj()) * mixed
    noise = variance * 2.0 * a * product.real
    return Block(transition, [1.0, 0.0], noise, variance * np.eye(2), ("position", "velocity"))


def together(blocks: Sequence[Block]) -> Block:
    """Sum of independent blocks: their states side by side."""
    from scipy.linalg import block_diag

    def joined(name: str) -> _Square:
        parts = [getattr(b, name) for b in blocks if b.size]
        return block_diag(*parts) if parts else np.zeros((0, 0))

    return Block(
        joined("transition"),
        np.concatenate([np.zeros(0), *(b.observation for b in blocks)]),
        joined("noise"),
        joined("start"),
        tuple(name for b in blocks for name in b.names),
        sum(b.white for b in blocks),
        tuple(p for b in blocks for p in b.time_exponents),
        np.concatenate([np.zeros(0, bool), *(b.level for b in blocks)]),
    )


def filtered_block(inner: Block, b: Float[np.ndarray, " q"], a: Float[np.ndarray, " p"], name: str) -> Block:
    """Block after a digital filter y_k = Σ b_j u_{k−j} − Σ_{j≥1} a_j y_{k−j}, a_0 = 1.

    The filter's states are those of Harvey (Time Series Models, 1993, 4.4), the first of which is its output.
    It has filtered the noise for a long time before the record begins.
    """
    n, m = inner.size, max(len(a) - 1, len(b))
    feedback = np.zeros((m, m))
    feedback[: len(a) - 1, 0] = -a[1:]
    feedback[:-1, 1:] = np.eye(m - 1)
    gain = np.pad(b, (0, m - len(b)))
    A, H, Q = inner.transition, inner.observation, inner.noise
    transition = np.block([[A, np.zeros((n, m))], [np.outer(gain, H @ A), feedback]])
    # The filter receives the sample at once: the noise of the inner states, and the white noise.
    enters = np.vstack([np.eye(n), np.outer(gain, H)])
    noise = enters @ Q @ enters.T
    noise[n:, n:] += inner.white * np.outer(gain, gain)
    level = np.concatenate([inner.level, np.zeros(m, bool)])
    return Block(
        transition,
        np.concatenate([np.zeros(n), [1.0], np.zeros(m - 1)]),
        noise,
        transition @ settled(transition, noise, level) @ transition.T + noise,
        (*inner.names, *((name,) if m == 1 else (f"{name}_{j + 1}" for j in range(m)))),
        time_exponents=(*inner.time_exponents, *(0.0,) * m),
        level=level,
    )


def settled(
    transition: Float[np.ndarray, "*g n n"], noise: Float[np.ndarray, "*g n n"], level: Bool[np.ndarray, " n"]
) -> Float[np.ndarray, "*g n n"]:
    """Covariance of states after a long time, given that random walks are at zero now.

    States that follow a walk (e.g. a filter's) do so with a constant gain G; their distance from G·walk is
    stationary.
    """
    rest = ~level
    own = transition[..., rest, :][..., rest]
    follow = np.linalg.solve(np.eye(rest.sum()) - own, transition[..., rest, :][..., level])
    enters = np.zeros((*follow.shape[:-1], len(level)))
    enters[..., rest], enters[..., level] = np.eye(rest.sum()), -follow
    covariance = np.zeros_like(transition)
    # P = A P Aᵀ + Q, by a sum of positive terms that doubles in length.
    found, power = enters @ noise @ np.swapaxes(enters, -1, -2), own
    for _ in range(_DOUBLINGS):
        more = power @ found @ np.swapaxes(power, -1, -2)
        found = found + more
        if np.all(np.abs(more) <= 1e-17 * np.abs(found)):
            break
        power = power @ power
    found = (found + np.swapaxes(found, -1, -2)) / 2.0
    covariance[..., rest[:, None] & rest] = found.reshape(*found.shape[:-2], rest.sum() ** 2)
    return covariance


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class StateSpace(ByValue, Tabled):
    """Noise of the samples as x_{k+1} = A x_k + w_k, z_k = H x_k + v_k, where x_0 has the covariance P0.

    w and v are white and independent, with covariances Q and R. Everything is in SI: samples are in rad/s or
    m/s².

    Attributes:
        A: transition from one sample to the next, (n, n).
        H: weights of the states in a sample, (1, n).
        Q: covariance of w, (n, n).
        R: variance of v, (1, 1) [rate²].
        P0: covariance of the states at the first sample, (n, n); their mean is zero.
        names: names of the states.
        units: units of the states.
        rate: sample rate [Hz].
        sensor: "gyro" or "accel".
        model: the noise model in words.
    """

    A: _Square
    H: Float[np.ndarray, "1 n"]
    Q: _Square
    R: Float[np.ndarray, "1 1"]
    P0: _Square
    names: tuple[str, ...]
    units: tuple[str, ...]
    rate: float
    sensor: Sensor = "gyro"
    model: str = ""

    @classmethod
    def of(cls, block: Block, rate: float, sensor: Sensor, model: str) -> StateSpace:
        """State space of a block of states at a rate [Hz]."""
        units = (si_unit(default_coefficient_unit(sensor, p)) for p in block.time_exponents)
        return cls(
            A=block.transition,
            H=block.observation[None, :],
            Q=block.noise,
            R=np.array([[block.white]]),
            P0=block.start,
            names=block.names,
            units=tuple(units),
            rate=float(rate),
            sensor=sensor,
            model=model,
        )

    @property
    def size(self) -> int:
        """Number of states."""
        return len(self.names)

    def sum_covariance(self, n: int) -> tuple[Float[np.ndarray, "n1 n1"], Float[np.ndarray, "n1 n1"]]:
        """Transition over n samples of the states and the sum of the samples, and the covariance added to it.

        The last row and column are those of the sum. The number of samples doubles in each of log₂ n steps.
        """
        transition = np.block([[self.A, np.zeros((self.size, 1))], [self.H, np.ones((1, 1))]])
        noise = np.zeros_like(transition)
        noise[:-1, :-1], noise[-1, -1] = self.Q, self.R[0, 0]
        all_of, added = np.eye(self.size + 1), np.zeros_like(transition)
        while n:
            if n % 2:
                all_of, added = transition @ all_of, transition @ added @ transition.T + noise
            transition, noise = transition @ transition, transition @ noise @ transition.T + noise
            n //= 2
        return all_of, added

    def to_dict(self) -> dict[str, Any]:
        """The matrices as nested lists, with names and units of the states, for JSON; in SI."""
        known = {"model": self.model, "sensor": self.sensor, "rate_hz": self.rate}
        matrices = {name: getattr(self, name).tolist() for name in ("A", "H", "Q", "R", "P0")}
        states = {"names": list(self.names), "units": list(self.units)}
        return {"schema_version": SCHEMA_VERSION, **known, **states, **matrices}

    @presented
    def to_numpy(self, path: str | os.PathLike[str]) -> None:
        """Write an .npz file of A, H, Q, R, P0, names, units and rate."""
        raise NotImplementedError

    @presented
    def to_matlab(self) -> str:
        """Text of a MATLAB script that defines A, H, Q, R, P0, names, units and rate, to all digits."""
        raise NotImplementedError

    @presented
    def to_c_header(self, prefix: str = "noise") -> str:
        """Text of a C header: constants `NOISE_STATES` and `NOISE_RATE`, arrays `noise_A` to `noise_P0`."""
        raise NotImplementedError

    def _tables(self) -> list[list[Column]]:
        start, noise = (np.sqrt(np.diag(x)) for x in (self.P0, self.Q))
        numbers = zip(start, noise, self.H[0], strict=True)
        rows = zip(self.names, self.units, numbers, strict=True)
        heads = ("state", "unit", "initial std", "noise std per sample", "weight in a sample")
        return [columns_from(heads, [(name, unit, *map(significant, x)) for name, unit, x in rows])]

    def _title(self) -> str:
        unit = si_unit(default_coefficient_unit(self.sensor, 0.0))
        white = f"R = ({significant(float(np.sqrt(self.R[0, 0])))} {unit})²"
        return f"State space of {self.size} states at {self.rate:g} Hz, {white}: {self.model}"

    def __repr__(self) -> str:
        return f"<{self._title()}>"
