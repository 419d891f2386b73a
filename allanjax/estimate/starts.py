"""Start values of a fit: rough powers for any shape, a few shapes to try, and lines in the spectrum."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from allanjax.estimate.design import Design, free_shapes
from allanjax.noise.model import Model, ModelParameter

# Shapes that are evaluated roughly, so many at a time; those from which a fit may start; and frequencies that
# are tried for lines.
_CANDIDATES = 512
_BLOCK = 16
_STARTS = 4
_PEAKS = 4
# Starts that differ by less than this in ln lead to the same solution; 1 for kinds of shapes not listed.
_APART = {"line": 0.02}


class Starts(NamedTuple):
    """Start values: powers [axes, starts, terms] and transformed shapes [axes, starts, shapes]."""

    power: Float[np.ndarray, "axes starts terms"]
    shape: Float[np.ndarray, "axes starts shapes"]


def find_starts(
    model: Model,
    design: Design,
    V: Float[np.ndarray, "axes m"],
    active: Bool[np.ndarray, "axes terms"],
    records: Iterable[Float[np.ndarray, " samples"] | None],
    n: int,
    rate: float,
) -> Starts:
    """Start values for every axis, from its Allan variances and, for lines, its record of n samples.

    Shape parameters without a value of their own are tried on a grid (`shape_candidates`); see `best_starts`.
    """
    shapes = free_shapes(model)
    searched = any(p.parameter.kind == "line" and p.start is None for p in shapes)
    peaks = (find_lines(x, rate) if searched and x is not None else () for x in records)
    candidates = [shape_candidates(shapes, n / rate, rate, of_axis) for of_axis in peaks]
    return best_starts(model, design, V, active, np.stack(candidates))


def best_starts(
    model: Model,
    design: Design,
    V: Float[np.ndarray, "axes m"],
    active: Bool[np.ndarray, "axes terms"],
    shape: Float[np.ndarray, "axes candidates shapes"],
) -> Starts:
    """Start values for every axis from candidate shapes: the best few, with the powers that fit best.

    The powers come from a non-negative least squares fit weighted by `Design.weight`.
    """
    from scipy.ndimage import median_filter

    given = [getattr(t, t.amplitude_parameter().name) for t in model.terms]
    # A single estimate that is small by chance must not lower all powers.
    smooth = np.exp(median_filter(np.log(np.maximum(V, 1e-300)), (1, 5), mode="nearest"))
    data = design.padded_estimates(smooth), design.padded_terms(active)
    count = shape.shape[1]
    # In blocks of one size: one program serves any number of candidates.
    shapes, block = design.padded_shapes(shape), min(count, _BLOCK)
    order = np.arange(-(-count // block) * block) % count
    found = (_rough_powers(design, *data, shapes[:, rows]) for rows in order.reshape(-1, block))
    rough, misfit = (np.concatenate(part, axis=1) for part in zip(*map(jax.device_get, found), strict=True))
    power, misfit = rough[:, :count, : len(model)], misfit[:, :count]
    for k, (term, value) in enumerate(zip(model.terms, given, strict=True)):
        if value is not None and not term.has_free_amplitude:
            power[:, :, k] = value**2
    apart = np.array([_APART.get(p.parameter.kind, 1.0) for p in free_shapes(model)])
    best = np.stack([_different(*of_axis, apart) for of_axis in zip(shape, misfit, strict=True)])
    axis = np.arange(len(V))[:, None]
    return Starts(power[axis, best], shape[axis, best])


def _different(
    shape: Float[np.ndarray, "candidates shapes"],
    misfit: Float[np.ndarray, " candidates"],
    apart: Float[np.ndarray, " shapes"],
) -> Int[np.ndarray, " starts"]:
    """Indices of the best candidates that are no neighbours of a better one, then of the best others."""
    order = list(np.argsort(misfit))
    chosen: list[int] = []
    for i in order:
        if all(np.any(abs(shape[i] - shape[k]) > apart) for k in chosen):
            chosen.append(i)
    return np.array((chosen + [i for i in order if i not in chosen])[:_STARTS])


@eqx.filter_jit
def _rough_powers(
    design: Design,
    V: Float[ArrayLike, "axes m"],
    active: Bool[ArrayLike, "axes terms"],
    shape: Float[ArrayLike, "axes candidates shapes"],
) -> tuple[Float[Array, "axes candidates terms"], Float[Array, "axes candidates"]]:
    """Non-negative powers that fit each candidate's shapes best, and their weighted misfit."""
    weight = design.weight

    def at(
        V: Float[Array, " m"], active: Bool[Array, " terms"], shape: Float[Array, " shapes"]
    ) -> tuple[Array, Array]:
        A = design.means(shape) / V
        normal, target = (A * weight) @ A.T, A @ weight

        # Lee & Seung's (2001) multiplicative steps keep powers positive and never increase the misfit.
        def step(_: int, v: Array) -> Array:
            return jnp.where(active, v * target / (normal @ v), 0.0)

        # The start is low enough for no term alone to exceed the curve.
        start = jnp.where(active, 1.0 / jnp.max(A, axis=1) / design.terms, 0.0)
        v = jax.lax.fori_loop(0, 500, step, start)
        return v, jnp.sum(weight * (v @ A - 1.0) ** 2)

    def of_axis(V: Array, active: Array, shapes: Array) -> tuple[Array, Array]:
        return jax.vmap(lambda u: at(V, active, u))(shapes)

    return jax.vmap(of_axis)(jnp.asarray(V), jnp.asarray(active), jnp.asarray(shape))


def correlation_times(duration: float, rate: float) -> Float[np.ndarray, " grid"]:
    """Sixteen correlation times [s] that a record of this duration [s] may show."""
    return np.geomspace(4.0 / rate, duration / 4.0, 16)


def shape_candidates(
    shapes: tuple[ModelParameter, ...],
    duration: float,
    rate: float,
    peaks: Float[np.ndarray, " peaks"] | Sequence[float],
) -> Float[np.ndarray, "candidates shapes"]:
    """Transformed shape values to try in a record of this duration [s]: those given, or a grid.

    `peaks` are the frequencies [Hz] to try for lines (`find_lines`).
    """
    if not shapes:
        return np.zeros((1, 0))
    choices = []
    for p in shapes:
        if p.start is not None:
            choices.append(np.array([p.start]))
        elif p.parameter.kind == "time":
            choices.append(correlation_times(duration, rate))
        elif p.parameter.starts:
            choices.append(rate * np.array(p.parameter.starts))
        elif p.parameter.name == "bandwidth":
            choices.append(np.geomspace(rate / 200.0, rate / 3.0, 8))
        elif p.parameter.kind == "frequency":
            choices.append(np.geomspace(4.0 / duration, rate / 4.0, 16))
        elif p.parameter.kind == "line":
            choices.append(np.asarray(peaks))
        elif p.parameter.upper < np.inf:
            choices.append(np.linspace(p.parameter.lower, p.parameter.upper, 9)[1:-1])
        else:
            choices.append(p.parameter.lower + np.array([1.0, 5.0, 25.0]))
    grid = np.array(list(itertools.product(*choices)))
    if len(grid) > _CANDIDATES:
        grid = grid[np.random.default_rng(0).choice(len(grid), _CANDIDATES, replace=False)]
    return np.log(grid - np.array([p.parameter.lower for p in shapes]))


def find_lines(x: Float[np.ndarray, " samples"], rate: float) -> Float[np.ndarray, " peaks"]:
    """Frequencies [Hz] of the most conspicuous peaks of the spectrum, sharp lines and broad bumps alike.

    A peak is the excess of the periodogram over its running median, weighed by its likelihood, at each of
    several resolutions; a peak found at one resolution is not counted again at another.
    """
    from scipy.ndimage import median_filter
    from scipy.signal import welch

    found: list[tuple[float, float, float]] = []
    for length in {len(x), min(len(x), 8192), min(len(x), 512)}:
        f, S = welch(x, rate, nperseg=length, detrend="linear")
        f, S = f[2:-1], S[2:-1]
        ratio = S / median_filter(S, min(101, len(S) // 4 * 2 + 1))
        # Gain in log-likelihood from a free level of a mean of len(x)/length periodograms.
        excess = len(x) / length * np.where(ratio > 1.0, ratio - 1.0 - np.log(ratio), 0.0)
        for i in np.argsort(excess)[::-1][:40]:
            found.append((excess[i], f[i], 2.0 * rate / length))
    found.sort(reverse=True)
    chosen: list[float] = []
    for _, f, width in found:
        if all(abs(f - g) > width for g in chosen):
            chosen.append(f)
        if len(chosen) == _PEAKS:
            break
    return np.array(chosen + [rate / 8.0] * (_PEAKS - len(chosen)))
