"""Log evidence for a bank of shapes, with amplitude and noise marginalized."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from allanjax.critic.bank import NOTHING, Bank, log_occam_factor
from allanjax.critic.model_evidence import Sets
from allanjax.critic.view import View


def log_evidence(view: View, after: View, bank: Bank, taken: int, amplitude: float) -> float:
    """Log evidence of a record with one of a bank's shapes [nats]; without one it is `View.log_evidence`.

    The likelihood is averaged over shapes, amplitudes and plausible subsets of the noise terms. The subsets
    and their levels are those of the record without the effect at its most likely: without the shape h that
    is `taken` with the amplitude a in the view `after`. Otherwise a step would be taken for a random walk.
    With p and g the products of h with the record and with itself, the likelihood of the record is that
    without a·h times exp(½a²g − ap).
    """
    sets = after.model_evidence.sets(view.allowed)
    cross, gram = _products(view, bank, sets)
    snr = cross / np.sqrt(gram)
    each = 0.5 * snr**2 - log_occam_factor(snr)
    mean = np.logaddexp.reduce(each, axis=1) - np.log(each.shape[1])
    own = amplitude * cross[:, taken] - 0.5 * amplitude**2 * gram[:, taken]
    return float(np.logaddexp.reduce(sets.log_evidence - own + mean))


def _products(
    view: View, bank: Bank, sets: Sets
) -> tuple[Float[np.ndarray, "sets shapes"], Float[np.ndarray, "sets shapes"]]:
    """Products of the shapes with the record and with themselves, in the noise of each subset.

    The nuisances, a subset's ramp and other accepted shapes, are projected out.
    """
    J = bank.shapes.shape[1]
    first = view.family.bins.edges[:-1] - 1
    first = first[first < J]
    weight = np.ones(J) if view.factor is None else 1.0 / view.factor[:J]

    def sums(z: Float[np.ndarray, "... slow"]) -> Float[np.ndarray, "... sets"]:
        return np.add.reduceat(z, first, axis=-1) @ (1.0 / sets.level[:, : len(first)]).T

    cross, gram = sums(bank.shapes * (weight * view.coefficients[:J])).T, sums(bank.squares * weight).T
    for some, others in (
        (sets.ramp, (view.family.ramp, *view.nuisances)),
        (~sets.ramp, view.nuisances),
    ):
        if not others or not some.any():
            continue
        free = np.stack([h[:J] / np.linalg.norm(h[:J]) for h in others])
        mixed = np.stack([sums(bank.shapes * (weight * h))[:, some].T for h in free], axis=-1)
        with_record = sums(free * (weight * view.coefficients[:J]))[:, some].T
        among = np.moveaxis(sums(free[:, None] * free * weight)[..., some], -1, 0)
        # Not the inverse: two of them may be the same.
        along = mixed @ np.linalg.pinv(among, hermitian=True)
        cross[some] -= np.einsum("skf,sf->sk", along, with_record)
        gram[some] = np.maximum(gram[some] - np.sum(along * mixed, axis=-1), NOTHING * gram[some])
    return cross, gram
