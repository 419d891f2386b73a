"""State-space blocks: what one noise term, or one filter after several, adds to a Kalman filter's state.

A block is the recursion x_{k+1} = A x_k + w_k with samples z_k = H x_k + v_k, in which w and v are white and
independent of each other. Where a sample is the mean of a process over its interval, that mean is a state of
its own beside the value at the end of the interval: the two share their noise, and R stays zero.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

# Doublings after which the sum for a stationary covariance has converged, or never will.
_DOUBLINGS = 80


@dataclasses.dataclass(frozen=True)
class Block:
    """States of a noise term and the samples that they make.

    Attributes:
        transition: A, from one sample to the next.
        observation: H, a row: what a sample sees of the states.
        noise: Q, covariance of the noise that drives the states.
        white: R, variance of white noise on the samples [rate²].
        start: P0, covariance of the states at the first sample.
        names: of the states within their term; "" for the only one.
        time_exponents: p in the unit (rate)·s^p of each state.
        level: which states are random walks, that is, have no stationary law.
    """

    transition: Float[np.ndarray, "n n"]
    observation: Float[np.ndarray, " n"]
    noise: Float[np.ndarray, "n n"]
    white: float
    start: Float[np.ndarray, "n n"]
    names: tuple[str, ...]
    time_exponents: tuple[float, ...]
    level: Bool[np.ndarray, " n"]

    @property
    def size(self) -> int:
        """Number of states."""
        return len(self.names)

    def labelled(self, label: str) -> Block:
        """A copy whose states have the term's name before theirs."""
        names = tuple(f"{label}_{name}" if name else label for name in self.names)
        return dataclasses.replace(self, names=names)


def block(
    transition: Float[np.ndarray, "n n"],
    observation: Sequence[float],
    noise: Float[np.ndarray, "n n"],
    start: Float[np.ndarray, "n n"],
    names: tuple[str, ...],
    *,
    white: float = 0.0,
    time_exponents: tuple[float, ...] = (),
    level: Sequence[bool] = (),
) -> Block:
    """Block of these matrices; its states are rates, and stationary, unless said otherwise."""
    n = len(names)
    return Block(
        np.asarray(transition, float).reshape(n, n),
        np.asarray(observation, float).reshape(n),
        np.asarray(noise, float).reshape(n, n),
        float(white),
        np.asarray(start, float).reshape(n, n),
        names,
        time_exponents or (0.0,) * n,
        np.array(level or (False,) * n, bool),
    )


def white_block(variance: float) -> Block:
    """White noise on the samples, which needs no state."""
    none = np.zeros((0, 0))
    return block(none, [], none, none, (), white=variance)


def exponential_block(variance: float, x: float) -> Block:
    """Process of the autocovariance variance·e^{−x|k|} at the samples k: one state."""
    noise = -np.expm1(-2.0 * x) * variance
    return block(np.exp([[-x]]), [1.0], np.array([[noise]]), np.array([[variance]]), ("",))


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
    return block(transition, [1.0, 0.0], noise, start, ("mean", "end"))


def oscillator_block(variance: float, pole: complex) -> Block:
    """Damped oscillator x'' + 2a x' + ω0² x = white noise, read at the samples; pole −a + iω_d per interval.

    States: position, and velocity divided by ω0, which is uncorrelated with it and has the same variance.
    """
    a, wd = -pole.real, pole.imag
    w0 = abs(pole)
    c, s = np.cos(wd), np.sin(wd) / wd
    transition = np.exp(-a) * np.array([[c + a * s, w0 * s], [-w0 * s, c - a * s]])
    noise = variance * _innovation(a, wd, w0)
    return block(transition, [1.0, 0.0], noise, variance * np.eye(2), ("position", "velocity"))


def _innovation(a: float, wd: float, w0: float) -> Float[np.ndarray, "2 2"]:
    """Noise of an oscillator of unit variance over one interval: I − A Aᵀ, without its cancellation.

    It is 4a∫ g gᵀ du over the interval, g(u) = e^{−au}·(ω0 sin(ω_d u)/ω_d, cos ω_d u − a sin(ω_d u)/ω_d).
    """
    pole = complex(-a, wd)
    # In modes: g = Re[m e^{pole·u}], so that its products have the exponents 2·pole and −2a.
    mode = np.array([w0 / (1j * wd), 1.0 - a / (1j * wd)])
    same = np.expm1(2.0 * pole) / (2.0 * pole)
    mixed = -np.expm1(-2.0 * a) / (2.0 * a)
    product = np.outer(mode, mode) * same + np.outer(mode, mode.conj()) * mixed
    return 2.0 * a * product.real


def together(blocks: Sequence[Block]) -> Block:
    """Sum of independent blocks: their states side by side."""
    from scipy.linalg import block_diag

    def joined(name: str) -> Float[np.ndarray, "n n"]:
        parts = [getattr(b, name) for b in blocks if b.size]
        return block_diag(*parts) if parts else np.zeros((0, 0))

    return Block(
        joined("transition"),
        np.concatenate([np.zeros(0), *(b.observation for b in blocks)]),
        joined("noise"),
        float(sum(b.white for b in blocks)),
        joined("start"),
        tuple(name for b in blocks for name in b.names),
        tuple(p for b in blocks for p in b.time_exponents),
        np.concatenate([np.zeros(0, bool), *(b.level for b in blocks)]),
    )


def filtered_block(inner: Block, b: Float[np.ndarray, " q"], a: Float[np.ndarray, " p"], name: str) -> Block:
    """Block after a digital filter y_k = Σ b_j u_{k−j} − Σ_{j≥1} a_j y_{k−j}, a_0 = 1.

    The filter's states are those of Harvey (Time Series Models, 1993, 4.4), the first of which is its output.
    It had seen the noise for long when the record begins.
    """
    n, m = inner.size, max(len(a) - 1, len(b))
    feedback = np.zeros((m, m))
    feedback[: len(a) - 1, 0] = -a[1:]
    feedback[:-1, 1:] = np.eye(m - 1)
    gain = np.pad(b, (0, m - len(b)))
    A, H, Q = inner.transition, inner.observation, inner.noise
    transition = np.block([[A, np.zeros((n, m))], [np.outer(gain, H @ A), feedback]])
    # The filter receives the sample at once: what drives the states within, and the white noise.
    enters = np.vstack([np.eye(n), np.outer(gain, H)])
    noise = enters @ Q @ enters.T
    noise[n:, n:] += inner.white * np.outer(gain, gain)
    level = np.concatenate([inner.level, np.zeros(m, bool)])
    return Block(
        transition,
        np.concatenate([np.zeros(n), [1.0], np.zeros(m - 1)]),
        noise,
        0.0,
        transition @ settled(transition, noise, level) @ transition.T + noise,
        (*inner.names, *((name,) if m == 1 else (f"{name}_{j + 1}" for j in range(m)))),
        (*inner.time_exponents, *(0.0,) * m),
        level,
    )


def settled(
    transition: Float[np.ndarray, "n n"], noise: Float[np.ndarray, "n n"], level: Bool[np.ndarray, " n"]
) -> Float[np.ndarray, "n n"]:
    """Covariance of states that have gone on for long, given that random walks are at zero now.

    What follows a walk (a filter, say) does so with a constant gain G, and its distance from G·walk is
    stationary.
    """
    rest = ~level
    own = transition[np.ix_(rest, rest)]
    follow = np.linalg.solve(np.eye(rest.sum()) - own, transition[np.ix_(rest, level)])
    enters = np.zeros((rest.sum(), len(level)))
    enters[:, rest], enters[:, level] = np.eye(rest.sum()), -follow
    found = np.zeros_like(transition)
    found[np.ix_(rest, rest)] = _stationary(own, enters @ noise @ enters.T)
    return found


def _stationary(
    transition: Float[np.ndarray, "n n"], noise: Float[np.ndarray, "n n"]
) -> Float[np.ndarray, "n n"]:
    """Solution of P = A P Aᵀ + Q, by a sum of positive terms that doubles in length."""
    total, power = noise, transition
    for _ in range(_DOUBLINGS):
        more = power @ total @ power.T
        total = total + more
        if np.all(np.abs(more) <= 1e-17 * np.abs(total)):
            break
        power = power @ power
    return (total + total.T) / 2.0
