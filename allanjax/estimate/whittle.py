"""Fit of one axis by Whittle's likelihood: from the levels of its spectrum to coefficients, misfit and model.

The levels of the cosine spectrum are χ² around their expectations (see `cosine`); the joint spectral model
computes these for all terms and the response at once (`spectral`). The inference is as for Allan variances,
with the levels in their place. Lines, ramps and regressors are estimated alongside (`deterministic`).
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np
from jaxtyping import Float

from allanjax.base.chi_squared import upper_tail
from allanjax.base.errors import FitError
from allanjax.estimate.design import find_starts, shape_candidates
from allanjax.estimate.deterministic import AxisSpectrum, InUse, Projection, Regressors
from allanjax.estimate.gls import Solution
from allanjax.estimate.inference import (
    Coefficients,
    coefficients_of,
    count_estimated,
    deterministic_coefficients,
    infer,
)
from allanjax.estimate.result import AxisFit, Misfit, extended_model, fitted_model, spectral_misfit, widened
from allanjax.estimate.spectral.components import BROAD, QUICK
from allanjax.estimate.spectral.fit import Arrangement, LevelFit, best_of, fit_levels, share_with_error
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model
from allanjax.noise.terms import Markov, PowerLaw, Resonance
from allanjax.record.recording import Axis, Recording
from allanjax.spectrum.cosine import smoothed

# Rounds of projecting out deterministic parts and fitting the noise, after which both have settled.
_ROUNDS = 3
# Levels with fewer degrees of freedom are smoothed for the start values.
_FEW = 8.0
# Share of their weight that levels keep beside the ends of a record, above which these do not matter.
_NEARLY_ALL = 0.9
# Candidates of start values that are evaluated together.
_BLOCK = 32
# Relative error of the power around a resonance, up to this factor from its frequency, beyond which it is not
# the oscillator's shape, a judgement; and how certain that has to be, in standard deviations.
_SHAPED, _AROUND, _CERTAIN = 0.05, 1.5, 5.0
# Powers and shapes.
_Start: TypeAlias = tuple[Float[np.ndarray, " terms"], Float[np.ndarray, " shapes"]]


def fit_whittle(
    recording: Recording, k: int, template: Model, active: InUse, regressors: Regressors | None = None
) -> AxisFit:
    """Fit one axis of a recording by maximum likelihood of its cosine spectrum; see `fit_spectrum`."""
    spectrum = AxisSpectrum.of(template, recording.values[:, k], recording.rate, regressors)
    return fit_spectrum(template, recording.axes[k], spectrum, active)


def fit_spectra(
    template: Model, axes: Sequence[Axis], spectra: Sequence[AxisSpectrum], active: InUse
) -> tuple[AxisFit, ...]:
    """Fit every axis to its spectral statistics; see `fit_spectrum`."""
    each = zip(axes, spectra, active, strict=True)
    return tuple(fit_spectrum(template, *of_axis) for of_axis in each)


def fit_spectrum(
    template: Model, axis: Axis, spectrum: AxisSpectrum, active: InUse, at_low: bool = False
) -> AxisFit:
    """Fit a model to the spectral statistics of one axis by maximum likelihood.

    Terms that are not active have an upper limit. `at_low`: N is the density at low frequencies, which
    includes that of wide resonances and of short processes; the fitted model has them apart.

    Raises:
        FitError: there is no random term in the model.
    """
    random = np.array([not term.deterministic for term in template.terms])
    if not (random & active).any():
        raise FitError(
            "Whittle's likelihood needs a random term besides lines and ramps; add AngleRandomWalk()"
        )
    noise, here, used = template.without(absent(template, random)), active[random], spectrum.used(active)
    arrangement, projection, fit = _fit_noise(noise, spectrum, used, here)
    bins, level, mean, misfit = spectrum.bins, projection.level, fit.maximum.mean, None
    if fit.solution.converged and fit.solution.power_error > 0.0:
        misfit = spectral_misfit(bins.frequency, level, mean, projection.dof)
    white = noise.term_labels.index("angle_random_walk") if at_low else 0
    plateaus = _plateaus(arrangement, projection, fit) if at_low else {}
    tangent, found = arrangement.tangent(fit, plateaus, white)
    solution = widened(Solution(*(np.asarray(x)[None] for x in found)), [misfit])
    estimates = infer(noise, tangent, level[None], here[None], solution)
    others: dict[str, Estimate] = {}
    for k in np.flatnonzero(~random).tolist():
        own = np.array([owner == k for owner in spectrum.owners])
        joint = spectrum.project(mean, own | used)
        estimate = joint.amplitude[own], joint.covariance[np.ix_(own, own)]
        line = spectrum.lines.get(k)
        others |= deterministic_coefficients(template, k, axis, *estimate, line, bins.n, bool(active[k]))
    coefficients = coefficients_of(template, axis, noise, estimates, others, bins.n, bins.rate)
    degrees = projection.estimates - count_estimated(template, active & random)
    result = axis_fit(axis, template, active, coefficients, solution, degrees, misfit)
    std = np.sqrt(np.diag(projection.covariance)).tolist()
    amplitudes = zip(spectrum.owners, projection.amplitude.tolist(), std, strict=True)
    regression = {owner: (x, error) for owner, x, error in amplitudes if isinstance(owner, str)}
    result = dataclasses.replace(result, regression=regression, spectrum=spectrum)
    if plateaus:
        alone = template.with_values(angle_random_walk=float(np.sqrt(fit.solution.power[white])))
        model = extended_model(alone, coefficients.values, absent(template, active))
        result = dataclasses.replace(result, _model=model)
    return result


def _fit_noise(
    noise: Model, spectrum: AxisSpectrum, used: InUse, active: InUse
) -> tuple[Arrangement, Projection, LevelFit]:
    """Fit the active random terms, alternating with the projection of the deterministic columns in use.

    What the ends of the record contribute to the levels follows from the fit, too.
    """
    empty, starts = Arrangement.of(noise, spectrum.bins), list[_Start]()
    share = np.ones(len(spectrum.squares))
    variance = smooth = smoothed(spectrum.squares, spectrum.bins.size)
    for _ in range(_ROUNDS if used.any() else 2):
        projection = spectrum.project(variance, used)
        projection = projection._replace(dof=projection.dof * share)
        arrangement = empty.with_data(projection.level, projection.dof)
        # Single coefficients scatter too much for start values.
        rough = np.where(projection.dof < _FEW, smooth, projection.level)
        starts = starts or _starts(arrangement, rough, active, spectrum)
        # The likelihood may have several maxima in a correlation time: all starts are tried.
        fit = best_of([fit_levels(arrangement, active, *start, smooth) for start in starts])
        starts, variance = [fit.solution[:2]], fit.maximum.mean
        share = share_with_error(spectrum.bins.size, arrangement.error_of_ends(*fit.solution[1::-1]))
        if not used.any() and np.all(share > _NEARLY_ALL):
            break
    return arrangement, projection, fit


def _starts(
    arrangement: Arrangement, level: np.ndarray, active: InUse, spectrum: AxisSpectrum
) -> list[_Start]:
    """Powers and shapes to start from, found in these levels."""
    noise, bins, dof = arrangement.model, spectrum.bins, 2.0 * arrangement.levels.shape
    candidates = shape_candidates(noise, bins.n / bins.rate, bins.rate, spectrum.peaks)
    blocks = np.array_split(candidates, -(-len(candidates) // _BLOCK))
    each = (len(noise), len(level))
    unit = np.concatenate([np.broadcast_to(arrangement.expected(x), (len(x), *each)) for x in blocks])
    power, shape = find_starts(noise, candidates, unit, level[None], dof, active[None])
    return list(zip(power[0], shape[0], strict=True))


def _plateaus(
    arrangement: Arrangement, projection: Projection, fit: LevelFit
) -> dict[int, Mapping[str, float]]:
    """Terms that are white at low frequencies, where nothing distinguishes them from white noise.

    These include resonances of which the data show another shape than the oscillator's. See
    `Arrangement.tangent`.
    """
    bins, ratio = arrangement.bins, projection.level / fit.maximum.mean
    found: dict[int, Mapping[str, float]] = {}
    for place, term in enumerate(arrangement.fitted_model(fit).terms):
        if isinstance(term, PowerLaw):
            found[place] = {"": 1.0}
        elif isinstance(term, Markov):
            T = float(term.correlation_time or 0.0)
            if T * bins.rate < QUICK:
                found[place] = {"": T**2, "correlation_time": 2.0}
        elif isinstance(term, Resonance):
            f, Q = float(term.frequency or 0.0), float(term.quality_factor or 0.0)
            near = (abs(np.log(bins.frequency / f)) < np.log(_AROUND)) & (projection.dof > 0.5)
            w, k = 0.5 * fit.degrees[near], 0.5 * projection.dof[near]
            # Squared relative deviations of gamma laws have means 1/k and variances (2 + 6/k)/k².
            chance = np.sum(w / k) + _CERTAIN * np.sqrt(np.sum((w / k) ** 2 * (2.0 + 6.0 / k)))
            if Q < BROAD or w @ (ratio[near] - 1.0) ** 2 > chance + _SHAPED**2 * w.sum():
                slopes = {"frequency": -1.0, "quality_factor": 0.5 / Q - 1.0}
                found[place] = {"": 1.0 / (np.pi * f * Q), **slopes}
    return found


def absent(template: Model, active: InUse) -> list[str]:
    """Labels of the terms that are not among the active ones."""
    return list(itertools.compress(template.term_labels, ~active))


def axis_fit(
    axis: Axis,
    template: Model,
    active: InUse,
    coefficients: Coefficients,
    solution: Solution,
    dof: int,
    misfit: Misfit | None,
) -> AxisFit:
    """Result of one axis from its solution [1]; without intervals and limits if the misfit is excessive."""
    converged = bool(solution.converged[0])
    result = AxisFit(
        axis=axis,
        converged=converged,
        reason="" if converged else "the fit did not converge; try fewer terms or other start values",
        chi2=float(solution.chi2[0]),
        dof=dof,
        p_value=float(upper_tail(solution.chi2[0], dof)),
        discrepancy=float(solution.discrepancy[0]),
        _coefficients=coefficients.values,
        _covariance=coefficients.covariance,
        _model=fitted_model(template, coefficients.values, absent(template, active)),
        misfit=misfit if converged else None,
    )
    return result.unmeasured() if result.is_far_off else result
