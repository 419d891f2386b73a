"""Fit of a noise model to the cosine spectrum of a recording by Whittle's likelihood, axis by axis.

The levels of the spectrum are χ² around their expectations (see `cosine`), which the joint spectral model has
for all terms and the response at once (`spectral`). The inference is that of the Allan variances, with the
levels in their place. Lines, ramps and regressors are estimated alongside (`deterministic`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from allanjax.base.errors import FitError
from allanjax.estimate.coefficients import Coefficients, coefficients_of, deterministic_coefficients, reported
from allanjax.estimate.design import free_powers, free_shapes
from allanjax.estimate.deterministic import AxisSpectrum, Projection, lines_of, take_out_lines
from allanjax.estimate.gls import Solution
from allanjax.estimate.misfit import Misfit, spectral_misfit, widened
from allanjax.estimate.spectral.design import SpectralDesign
from allanjax.estimate.spectral.fit import (
    best_of,
    chi_squared,
    infer_levels,
    levels_under,
    solve_levels,
    tangent_of,
)
from allanjax.estimate.spectral.level_design import TangentDesign
from allanjax.estimate.starts import best_starts, find_lines, shape_candidates
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model
from allanjax.record.recording import Axis
from allanjax.spectrum.cosine import PER_OCTAVE, Bins, cosine_transform, term_column

# Rounds of projecting out deterministic parts and fitting the noise, after which both have settled.
_ROUNDS = 3
# Levels with fewer degrees of freedom are smoothed for the start values.
_FEW = 8.0
# Bins an octave where the spectrum is not smooth: of resonances, and of filters.
_FINE = 24


@dataclasses.dataclass(frozen=True, eq=False)
class WhittleFit:
    """Fit of one axis by Whittle's likelihood.

    Attributes:
        coefficients: coefficients of all terms of the model.
        solution: solution for its random terms.
        estimates: degrees of freedom of χ² before the model's parameters are subtracted.
        spectrum: the statistics that the model was fitted to.
        regression: amplitude of each regressor and its standard deviation [rate per the regressor's unit].
        misfit: misfit of the levels; None if the model suffices.
    """

    coefficients: Coefficients
    solution: Solution
    estimates: float
    spectrum: AxisSpectrum
    regression: Mapping[str, tuple[float, float]]
    misfit: Misfit | None


def spectrum_of(
    template: Model,
    x: Float[np.ndarray, " n"],
    rate: float,
    regressors: Mapping[str, Float[np.ndarray, " n"]],
    peaks: Float[np.ndarray, " peaks"] | Sequence[float] = (),
    bins: Bins | None = None,
) -> AxisSpectrum:
    """Spectral statistics of one axis for a model: lines found, known columns transformed, bins summed.

    Bins that are not given are finer around narrow-band terms; `peaks` are the frequencies [Hz] of those
    without one.
    """
    n = len(x)
    lines, wanted = lines_of(template)
    known = [k for k, term in enumerate(template.terms) if term.deterministic and k not in lines]
    c, found = take_out_lines(x - x.mean(), rate, wanted)
    columns: list[tuple[str | int, np.ndarray]] = []
    for name, z in regressors.items():
        columns.append((name, cosine_transform(z)))
    columns += [(k, term_column(template.terms[k], n, rate)) for k in known]
    by_term = dict(zip(lines, found, strict=True))
    if bins is not None:
        return AxisSpectrum.of(bins, c, columns, by_term)
    around = [line.frequency for line in found]
    narrow = [p for p in template.parameters if p.parameter.kind == "line" and p.term not in lines]
    unknown = iter(peaks)
    around += [p.start if p.start is not None else float(next(unknown, rate / 8.0)) for p in narrow]
    per_octave = PER_OCTAVE if template.response is None else _FINE
    bins = Bins.of(n, rate, [(frequency, 0.0) for frequency in around], per_octave)
    return AxisSpectrum.of(bins, c, columns, by_term)


def fit_axis(
    template: Model,
    axis: Axis,
    x: Float[np.ndarray, " n"],
    rate: float,
    active: Bool[np.ndarray, " terms"],
    regressors: Mapping[str, Float[np.ndarray, " n"]],
) -> WhittleFit:
    """Fit a model to the samples of one axis by maximum likelihood.

    Raises:
        FitError: there is no random term in the model.
    """
    searched = any(p.parameter.kind == "line" and p.start is None for p in template.parameters)
    peaks = find_lines(x, rate) if searched else ()
    return fit_spectrum(template, axis, spectrum_of(template, x, rate, regressors, peaks), active, peaks)


def fit_spectrum(
    template: Model,
    axis: Axis,
    spectrum: AxisSpectrum,
    active: Bool[np.ndarray, " terms"],
    peaks: Float[np.ndarray, " peaks"] | Sequence[float] = (),
) -> WhittleFit:
    """Fit a model to the spectral statistics of one axis by maximum likelihood.

    Args:
        template: the terms.
        axis: the axis.
        spectrum: the statistics, with a column for each deterministic term.
        active: the terms in use; for the others there is an upper limit.
        peaks: frequencies [Hz] to try for narrow-band terms without one.

    Raises:
        FitError: there is no random term in the model.
    """
    random = np.array([not term.deterministic for term in template.terms])
    if not (random & active).any():
        raise FitError(
            "Whittle's likelihood needs a noise term besides lines and ramps: add AngleRandomWalk()"
        )
    labels = zip(template.term_labels, random, strict=True)
    noise = template.without([label for label, here in labels if not here])
    used = spectrum.used([k for k in range(len(template)) if not active[k]])
    design, projection, solution = _fit_noise(noise, spectrum, used, active[random], peaks)
    mean = levels_under(design, solution)
    design = design.owned(noise, active[random] & (np.asarray(solution.power) > 0.0))
    tangent = tangent_of(design, np.asarray(solution.shape))
    return inferred(template, axis, active, spectrum, projection, tangent, solution, mean)


def inferred(
    template: Model,
    axis: Axis,
    active: Bool[np.ndarray, " terms"],
    spectrum: AxisSpectrum,
    projection: Projection,
    design: TangentDesign,
    solution: Solution,
    mean: Float[np.ndarray, " m"],
) -> WhittleFit:
    """Fit of one axis from the solution for its random terms, with intervals and limits.

    Args:
        template: the terms, `active` those in use.
        axis: the axis.
        spectrum: the statistics, and `projection` their levels without the deterministic parts.
        design: the levels around the solution.
        solution: the solution.
        mean: expected levels there.
    """
    random = np.array([not term.deterministic for term in template.terms])
    noise = template.without([s for s, here in zip(template.term_labels, random, strict=True) if not here])
    chi2 = chi_squared(projection.level / mean, projection.dof)
    solution, misfit = solution._replace(chi2=jnp.asarray(chi2)), None
    if bool(solution.converged) and float(solution.discrepancy) > 0.0:
        misfit = spectral_misfit(spectrum.bins.frequency, projection.level, mean, projection.dof)
    solution = widened(jax.tree.map(lambda x: np.asarray(x)[None], solution), [misfit])
    inference = infer_levels(design, projection.level, free_powers(noise), active[random], solution)
    (noise_found,) = coefficients_of(
        noise, [axis], active[random][None], solution, inference, int(spectrum.bins.n), spectrum.bins.rate
    )
    solution = jax.tree.map(lambda x: np.asarray(x)[0], solution)
    values = dict(noise_found.values)
    for k in np.flatnonzero(~random):
        values |= _deterministic(template, int(k), axis, spectrum, mean, bool(active[k]))
    order = [p.label for p in reported(template)]
    covariance = np.diag([values[label].std ** 2 for label in order])
    places = [order.index(label) for label in noise_found.values]
    covariance[np.ix_(places, places)] = noise_found.covariance
    return WhittleFit(
        Coefficients({label: values[label] for label in order}, np.nan_to_num(covariance)),
        solution,
        projection.estimates,
        spectrum,
        _regression(spectrum, projection),
        misfit,
    )


def _fit_noise(
    noise: Model,
    spectrum: AxisSpectrum,
    used: Bool[np.ndarray, " columns"],
    active: Bool[np.ndarray, " terms"],
    peaks: Float[np.ndarray, " peaks"] | Sequence[float],
) -> tuple[SpectralDesign, Projection, Solution]:
    """Fit the random terms, alternating with the projection of the deterministic parts in use."""
    bins = spectrum.bins
    solution: Solution | None = None
    smooth, free = _smoothed(spectrum), free_powers(noise)
    variance = smooth
    empty = SpectralDesign.of(noise, bins).owned(noise, active)
    for _ in range(_ROUNDS if used.any() else 1):
        projection = spectrum.project(variance, used)
        design = empty.with_data(projection.level, projection.dof)
        if solution is None:
            # Single coefficients scatter too much for start values.
            rough = np.where(projection.dof < _FEW, smooth, projection.level)
            shapes = shape_candidates(free_shapes(noise), float(bins.n / bins.rate), bins.rate, peaks)
            starts = best_starts(noise, design, rough[None], active[None], shapes[None])
            # The likelihood may have several maxima in a correlation time: all starts are tried.
            tried = range(starts.power.shape[1] if design.moves.any() else 1)
            begun = [
                solve_levels(design, free, active, starts.power[0, k], starts.shape[0, k], smooth)
                for k in tried
            ]
            solution = best_of(begun)
        else:
            solution = solve_levels(design, free, active, solution.power, solution.shape, smooth)
        variance = levels_under(design, solution)
    assert solution is not None
    return design, projection, solution


def _smoothed(spectrum: AxisSpectrum) -> Float[np.ndarray, " m"]:
    """Levels averaged over neighbouring bins, a first guess of the noise."""
    window = np.ones(7)
    size = np.convolve(spectrum.bins.size, window, "same")
    squares = np.convolve(spectrum.squares, window, "same")
    return np.where(size > 0, squares / np.maximum(size, 1.0), spectrum.squares.sum() / spectrum.bins.n)


def _regression(spectrum: AxisSpectrum, projection: Projection) -> dict[str, tuple[float, float]]:
    """Amplitude of each regressor and its standard deviation."""
    places = [k for k, owner in enumerate(spectrum.owners) if isinstance(owner, str)]
    if not places:
        return {}
    std = np.sqrt(np.diag(projection.covariance))
    return {str(spectrum.owners[k]): (float(projection.amplitude[k]), float(std[k])) for k in places}


def _deterministic(
    template: Model,
    k: int,
    axis: Axis,
    spectrum: AxisSpectrum,
    variance: Float[np.ndarray, " m"],
    active: bool,
) -> dict[str, Estimate]:
    """Coefficients of a ramp, a step or a line, from the joint estimate of its components."""
    own = np.array([owner == k for owner in spectrum.owners])
    regressors = np.array([isinstance(owner, str) for owner in spectrum.owners])
    projection = spectrum.project(variance, own | (spectrum.used() if active else regressors))
    covariance = projection.covariance[np.ix_(own, own)]
    components = projection.amplitude[own]
    square = float(components @ np.linalg.solve(covariance, components))
    unit = float(np.sqrt(np.trace(covariance) / own.sum()))
    return deterministic_coefficients(
        template, k, axis, square, unit, int(own.sum()), spectrum.lines.get(k), spectrum.bins.n, active
    )
