"""Rough estimates of quantization, N, B and K, within a fraction of a second, where their size is enough.

Whittle's likelihood of the cosine spectrum is maximized by Fisher scoring with non-negative powers; errors
are those of the Fisher information. Nothing is compiled, no terms are chosen, no structure is looked for.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.optimize import nnls

from allanjax.base.chi_squared import upper_tail
from allanjax.base.normal import ONE_SIDED_95, TWO_SIDED_68, TWO_SIDED_95
from allanjax.estimate.evidence import without_ramp
from allanjax.estimate.result import AxisFit, fitted_model
from allanjax.estimate.spectral.columns import columns_of
from allanjax.estimate.spectral.fit import chi_squared, error_of_powers
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model
from allanjax.noise.terms import basic_terms
from allanjax.record.recording import Axis, Recording
from allanjax.spectrum.cosine import Bins, SpectralStatistics, cosine_transform, ramp_column

# Steps of Fisher scoring, and scatter of a level beyond which it holds a line and is left out.
_STEPS, _LINE = 30, 6.0
# p-value below which the terms do not follow the spectrum.
_REJECTED = 1e-6


def rough_fits(recording: Recording, below: Float[np.ndarray, " axes"]) -> tuple[AxisFit, ...]:
    """Rough fit of every axis, to frequencies up to its `below` [Hz]; inf for all of them."""
    n, rate = recording.n, recording.rate
    bins = Bins.of(n, rate)
    model = Model(tuple(term for term in basic_terms().terms if not term.deterministic))
    columns = columns_of([term.sampled(rate) for term in model.terms], bins).mean(axis=1)
    c = cosine_transform(recording.values - recording.values.mean(axis=0))
    statistics = bins.statistics(c, ramp_column(n, rate))
    found = []
    for k, axis in enumerate(recording.axes):
        inside = bins.frequency <= below[k]
        own = SpectralStatistics(*(x[k][inside] for x in statistics))
        found.append(_fit(own, bins.size[inside].astype(float), columns[:, inside], model, axis))
    return tuple(found)


def _fit(
    statistics: SpectralStatistics,
    size: Float[np.ndarray, " m"],
    columns: Float[np.ndarray, "terms m"],
    model: Model,
    axis: Axis,
) -> AxisFit:
    """Rough fit of one axis."""
    mean, used = np.maximum(statistics.squares / size, 1e-300), np.ones(len(size), bool)
    # A first level of its neighbours, as single ones scatter.
    mean = np.exp(np.convolve(np.log(np.pad(mean, 3, mode="edge")), np.ones(7) / 7.0, "valid"))
    power = np.zeros(len(columns))
    scale = np.median(mean) / np.median(columns, axis=1)
    for step in range(_STEPS):
        squares, dof = (np.asarray(x) for x in without_ramp(statistics, size, mean, True))
        dof = np.maximum(dof, 1e-3)
        if step in (_STEPS // 3, 2 * _STEPS // 3):
            used = (squares / dof / mean - 1.0) * np.sqrt(dof / 2.0) < _LINE
            used |= size == 1.0
        weight = np.sqrt(dof / 2.0) / mean * used
        power = nnls((columns * scale[:, None] * weight).T, squares / dof * weight)[0] * scale
        mean = np.maximum(power @ columns, 1e-300)
    squares, dof = (np.asarray(x) for x in without_ramp(statistics, size, mean, True))
    dof = np.maximum(dof, 1e-3)
    ratio, degrees = (squares / dof / mean)[used], max(float(used.sum() - 3), 1.0)
    chi2 = float(chi_squared(ratio, dof[used]))
    p_value = float(upper_tail(chi2, degrees))
    wide = p_value < _REJECTED
    off = float(error_of_powers(ratio, dof[used], np.ones(int(used.sum())), degrees)) / 2.0 if wide else 0.0
    scaled = columns * scale[:, None] / mean * used
    information, present = (scaled * dof / 2.0) @ scaled.T, power > 0.0
    std = np.zeros(len(power))
    for k in range(len(power)):
        # Beside the terms that are there.
        own = present | (np.arange(len(power)) == k)
        inverse = np.linalg.pinv(information[np.ix_(own, own)], hermitian=True)
        std[k] = np.sqrt(inverse[own[:k].sum(), own[:k].sum()]) * scale[k]
    coefficients = _coefficients(model, axis, power, std)
    covariance = np.diag([c.std**2 for c in coefficients.values()])
    own = fitted_model(model, coefficients)
    return AxisFit(axis, True, "", chi2, int(degrees), p_value, off, coefficients, covariance, own)


def _coefficients(
    model: Model, axis: Axis, power: Float[np.ndarray, " terms"], std: Float[np.ndarray, " terms"]
) -> dict[str, Estimate]:
    """Amplitudes of the terms from their powers, with errors and limits."""
    found = {}
    for term, p, s in zip(model.terms, power, std, strict=True):
        detected, value = bool(p > ONE_SIDED_95 * s), float(np.sqrt(p))
        levels = (-TWO_SIDED_95, TWO_SIDED_95, -TWO_SIDED_68, TWO_SIDED_68)
        ends = [float(np.sqrt(max(p + z * s, 0.0))) for z in levels]
        found[term.name()] = Estimate(
            axis=axis,
            label=term.name(),
            value=value if detected else 0.0,
            std=float(s / 2.0 / value) if detected else float("nan"),
            interval=(ends[0], ends[1]),
            interval_68=(ends[2], ends[3]),
            parameter=term.amplitude_parameter(),
            term=term.name(),
            upper_limit=float(np.sqrt(p + ONE_SIDED_95 * s)),
            detected=detected,
        )
    return found
