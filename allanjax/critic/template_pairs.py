"""Joint fit of two shapes of a bank, for effects that hide each other."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from allanjax.critic.bank import Bank, Matched
from allanjax.critic.noise import Noise
from allanjax.critic.view import View

# Every how many shapes of the bank one is tried at first.
_COARSER = 8
# Least norm of a shape after projecting out the other one, over the largest such norm: a judgement.
_CLEAR = 0.1


@dataclasses.dataclass(frozen=True, eq=False)
class Pair:
    """Most likely pair of shapes.

    Attributes:
        members: indices of the shapes in the bank.
        amplitude: amplitude of each, by generalized least squares.
        snr: signal-to-noise ratio of each given the other, with its sign.
        log_trials_factor: of the search for the two [nats]: the best likelihood over the mean of all pairs.
    """

    members: tuple[int, int]
    amplitude: Float[np.ndarray, 2]
    snr: Float[np.ndarray, 2]
    log_trials_factor: float


def best_pair(bank: Bank, view: View, noise: Noise, near: tuple[int, int] | None = None) -> Pair:
    """Most likely pair of shapes: of every eighth shape first, then of all, each in turn given the other.

    Where the pair is known approximately, the search begins `near` it.
    """
    matched = bank.matched(view, noise)
    p = matched.products(matched.whitened)
    some = np.arange(_COARSER // 2, len(p), _COARSER)
    i, j = np.triu_indices(len(some), 1)
    coarse = _gains(matched.rows(some), p[some], i, j)
    if near is None:
        best = int(np.argmax(coarse))
        near = int(some[i[best]]), int(some[j[best]])
    first, _ = _best_given(matched, p, near[1])
    second, price = _best_given(matched, p, first)
    price += _best_given(matched, p, second)[1] - np.log(2.0)
    chosen, p = matched.rows(np.array([first, second])), p[[first, second]]
    covariance = np.linalg.pinv(chosen @ chosen.T)
    amplitude = covariance @ p
    # Where both are located more sharply than the coarse pairs are apart, the factor from single searches is
    # better.
    among = 0.5 * float(p @ amplitude) - float(np.logaddexp.reduce(coarse)) + np.log(len(coarse))
    snr = amplitude / np.sqrt(np.diag(covariance))
    return Pair((first, second), amplitude, snr, min(price, float(among)))


def _gains(
    shapes: Float[np.ndarray, "shapes slow"],
    p: Float[np.ndarray, " shapes"],
    i: Int[np.ndarray, " pairs"],
    j: Int[np.ndarray, " pairs"],
) -> Float[np.ndarray, " pairs"]:
    """Gain in log-likelihood by each pair of whitened shapes, `p` being their products with the record."""
    gram = shapes @ shapes.T
    own = np.diag(gram)
    det = np.maximum(own[i] * own[j] - gram[i, j] ** 2, 1e-9 * own[i] * own[j])
    return 0.5 * (p[i] ** 2 * own[j] + p[j] ** 2 * own[i] - 2.0 * p[i] * p[j] * gram[i, j]) / det


def _best_given(matched: Matched, p: Float[np.ndarray, " shapes"], other: int) -> tuple[int, float]:
    """Most likely shape given another one of any amplitude, and its log trials factor [nats].

    `p` are the shapes' products with the record.
    """
    own = matched.lengths**2
    common = matched.products(matched.rows(np.array([other]))[0]) / own[other]
    left = np.maximum(own - common**2 * own[other], 0.0)
    clear = left > _CLEAR**2 * left.max()
    half = np.where(clear, 0.5 * (p - common * p[other]) ** 2 / np.where(clear, left, 1.0), 0.0)
    return int(np.argmax(half)), float(half.max() - np.logaddexp.reduce(half) + np.log(len(half)))
