"""Expectations of terms without a free shape, of unit power, at the nodes of a record's levels."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from allanjax.estimate.spectral.components import flicker
from allanjax.estimate.spectral.levels import Levels, levels_of, node_angles
from allanjax.noise.terms import BiasInstability, NoiseTerm
from allanjax.spectrum.cosine import exact_expectation

_flicker = jax.jit(flicker)


def columns_of(
    terms: Sequence[NoiseTerm], edges: Int[np.ndarray, " m+1"], n: int, rate: float
) -> Float[np.ndarray, "columns 2 m"]:
    """Expected squares [rate² per unit power] of each term at the nodes of the levels with these edges.

    Args:
        terms: random terms whose shape parameters have values.
        edges: first coefficients of the levels, and the one after the last.
        n: number of samples.
        rate: sample rate [Hz].
    """
    nodes = node_angles(edges, n)
    found = [_column(term.with_unit_amplitude().sampled(rate), edges, nodes, n, rate) for term in terms]
    return np.stack(found) if found else np.zeros((0, *nodes.shape))


def _column(
    term: NoiseTerm, edges: Int[np.ndarray, " m+1"], nodes: Float[np.ndarray, "2 m"], n: int, rate: float
) -> Float[np.ndarray, "2 m"]:
    if isinstance(term, BiasInstability) and not term.oscillates:
        m = len(edges) - 1
        return np.asarray(_flicker(_bare(edges, n)))[:, :m]
    f = nodes * rate / (2.0 * np.pi)
    expected = np.asarray(term.sampled_psd(f, rate)) * rate + np.asarray(term.end_effect(f, rate)) / n
    if term.oscillates:
        return expected
    # The lowest coefficients, of which each is a level, feel the record's finite length.
    low = int(np.argmax(np.append(np.diff(edges) > 1, True)))
    lags, weights = exact_expectation(n, rate, low)
    expected[:, :low] = weights @ np.asarray(term.phase_covariance(jnp.asarray(lags)))
    return expected


def _bare(edges: Int[np.ndarray, " m+1"], n: int) -> Levels:
    """Levels without data or columns."""
    m = len(edges) - 1
    return levels_of(np.ones(m), np.ones(m), edges, n, np.zeros((0, 2, m)))
