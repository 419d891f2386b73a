"""Fits of single axes: from Allan variances or a spectrum to coefficients, misfit and model.

By Whittle's likelihood the levels of the cosine spectrum are χ² around their expectations (see `cosine`); the
joint spectral model computes these for all terms and the response at once (`spectral`). The inference is as
for Allan variances, with the levels in their place. Lines, ramps and regressors are estimated alongside
(`deterministic`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Bool, Float, Shaped

from allanjax.allan.covariance import AllanCovariance
from allanjax.allan.deviation import AllanDeviation
from allanjax.base.chi_squared import beyond_doubt, upper_tail
from allanjax.base.errors import FitError
from allanjax.estimate.design import (
    AllanDesign,
    Starts,
    Tangent,
    different,
    find_starts,
    free_powers,
    free_shapes,
    moments_behind,
    of_owners,
    quadrature_order,
    random_terms,
    shape_candidates,
)
from allanjax.estimate.deterministic import AxisSpectrum, Projection, find_lines, lines_of, take_out_lines
from allanjax.estimate.gls import Solution, solve
from allanjax.estimate.inference import (
    Coefficients,
    Inference,
    coefficients_of,
    deterministic_coefficients,
    infer,
    reported,
)
from allanjax.estimate.result import AxisFit, Misfit, fitted_model, misfit_of, spectral_misfit, widened
from allanjax.estimate.spectral.components import columns_of
from allanjax.estimate.spectral.expected import ExpectedLevels
from allanjax.estimate.spectral.fit import (
    Arrangement,
    LevelDesign,
    LevelFit,
    best_of,
    chi_squared,
    fit_levels,
)
from allanjax.estimate.spectral.powers import power_fits
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model
from allanjax.noise.terms.deterministic import Transient
from allanjax.record.recording import Axis, Recording
from allanjax.spectrum.cosine import PER_OCTAVE, Bins, cosine_transform, term_column
from allanjax.wavelets.variance import WaveletFilter, geometry_of, mean_squares

# Rounds of projecting out deterministic parts and fitting the noise, after which both have settled.
_ROUNDS = 3
# Levels with fewer degrees of freedom are smoothed for the start values.
_FEW = 8.0
# Bins per octave where the spectrum is not smooth: for resonances, and for filters.
_FINE = 24
# Difference of minus twice the log-likelihood below which two solutions are the same.
_AS_LIKELY = 0.02
# Candidates of start values that are evaluated together.
_BLOCK = 32
# Cluster sizes and terms to which a fit's arrays are padded: with four per octave, sizes of 6·10⁷ samples.
ALLAN_CAPACITY = (96, 6)


@dataclasses.dataclass(frozen=True, eq=False)
class WhittleFit:
    """Fit of one axis by Whittle's likelihood.

    Attributes:
        coefficients: coefficients of all terms of the model.
        solution: solution for its random terms.
        estimates: degrees of freedom of χ² before subtraction of the model's parameters.
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
            "Whittle's likelihood needs a random term besides lines and ramps; add AngleRandomWalk()"
        )
    noise = random_terms(template)
    used = spectrum.used([k for k in range(len(template)) if not active[k]])
    arrangement, projection, fit = _fit_noise(noise, spectrum, used, active[random], peaks)
    mean = np.asarray(fit.maximum.mean)[: len(projection.level)]
    design, solution = arrangement.tangent(fit), fit.solution
    return inferred(template, axis, active, spectrum, projection, design, solution, mean)


def inferred(
    template: Model,
    axis: Axis,
    active: Bool[np.ndarray, " terms"],
    spectrum: AxisSpectrum,
    projection: Projection,
    design: LevelDesign,
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
    noise = random_terms(template)
    chi2 = chi_squared(projection.level / mean, projection.dof)
    solution, misfit = solution._replace(chi2=jnp.asarray(chi2)), None
    if bool(solution.converged) and float(solution.discrepancy) > 0.0:
        misfit = spectral_misfit(spectrum.bins.frequency, projection.level, mean, projection.dof)
    solution = widened(jax.tree.map(lambda x: np.asarray(x)[None], solution), [misfit])
    of_noise = free_powers(noise), active[random][None]
    inference = infer(design, projection.level[None], *of_noise, solution)
    (noise_found,) = coefficients_of(
        noise, [axis], of_noise[1], solution, inference, int(spectrum.bins.n), spectrum.bins.rate
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
) -> tuple[Arrangement, Projection, LevelFit]:
    """Fit the random terms, alternating with the projection of the deterministic parts in use."""
    smooth, free = _smoothed(spectrum), free_powers(noise)
    empty, variance, fit = Arrangement.of(noise, spectrum.bins), smooth, None
    for _ in range(_ROUNDS if used.any() else 1):
        projection = spectrum.project(variance, used)
        arrangement = empty.with_data(projection.level, projection.dof)
        if fit is None:
            # Single coefficients scatter too much for start values.
            rough = np.where(projection.dof < _FEW, smooth, projection.level)
            starts = _starts(noise, spectrum.bins, rough, projection.dof, active, peaks)
        else:
            starts = [(np.asarray(fit.solution.power), np.asarray(fit.solution.shape))]
        # The likelihood may have several maxima in a correlation time: all starts are tried.
        fit = best_of([fit_levels(arrangement, free, active, *start, smooth) for start in starts])
        variance = np.asarray(fit.maximum.mean)[: len(smooth)]
    assert fit is not None
    return arrangement, projection, fit


def _starts(
    noise: Model,
    bins: Bins,
    level: Float[np.ndarray, " m"],
    dof: Float[np.ndarray, " m"],
    active: Bool[np.ndarray, " terms"],
    peaks: Float[np.ndarray, " peaks"] | Sequence[float],
) -> list[tuple[Float[np.ndarray, " terms"], Float[np.ndarray, " shapes"]]]:
    """Powers and shapes to start from: the best candidates of shapes with the powers that fit best."""
    shapes, parameters = free_shapes(noise), noise.parameters
    candidates = shape_candidates(shapes, float(bins.n / bins.rate), bins.rate, peaks)
    values = np.tile([1.0 if p.start is None else p.start for p in parameters], (len(candidates), 1))
    places = [k for k, p in enumerate(parameters) if p.free and not p.parameter.is_amplitude]
    values[:, places] = np.exp(candidates) + [p.parameter.lower for p in shapes]
    of, found = ExpectedLevels(noise, bins), []
    amplitudes = [p for p in parameters if p.parameter.is_amplitude]
    held, free = np.array([float(p.start or 0.0) ** 2 for p in amplitudes]), free_powers(noise)
    for some in np.array_split(values, -(-len(values) // _BLOCK)):
        unit = np.broadcast_to(of(some), (len(some), len(noise), len(level)))
        start = np.where(free, np.min(level / np.maximum(unit, 1e-300), axis=-1), held)
        found.append(power_fits(level, dof / 2.0, level, unit, start, np.tile(active, (len(some), 1))))
    power, loss = (np.concatenate(part) for part in zip(*found, strict=True))
    power = np.where(free, power, held)
    best = different(candidates, loss, shapes)
    return [(power[k], candidates[k]) for k in best]


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


def fit_allan(
    curve: AllanDeviation,
    axes: Sequence[Axis],
    template: Model,
    active: Bool[np.ndarray, "axes terms"],
    values: Float[np.ndarray, "n axes"] | None = None,
) -> tuple[tuple[AxisFit, ...], AllanDeviation]:
    """Fit every axis by generalized least squares; the curve gets its degrees of freedom under the fit.

    Args:
        curve: the Allan variances.
        axes: its axes.
        template: the model.
        active: the terms that each axis has.
        values: the record, which is needed to find lines and resonances.
    """
    design = AllanDesign.of(template, curve.n, curve.rate, curve.cluster_size, curve.strides, ALLAN_CAPACITY)
    of_record = curve.n, curve.rate
    results = _fit_estimates(design, curve.variance, of_record, axes, template, active, values)
    return results, _with_model_edf(curve, results, _moments_under(curve, template, results))


def fit_wavelet(
    recording: Recording, template: Model, active: Bool[np.ndarray, "axes terms"], wavelet: str
) -> tuple[AxisFit, ...]:
    """Fit every axis of a recording by generalized least squares of its wavelet variances.

    Raises:
        FitError: a term that these variances do not determine, or too few levels.
    """
    found = WaveletFilter.of(wavelet)
    for term in template.terms:
        if term.deterministic or term.narrow_band:
            raise FitError(
                f"the {wavelet} wavelet variances do not determine {term.name()}; leave it out, or use "
                'wavelet="haar"'
            )
    levels = np.arange(1, found.most_levels(recording.n) + 1)
    check_count(len(levels), "wavelet variances", recording.n, template, recording.name)
    of_record = recording.n, recording.rate
    geometry = geometry_of(found, levels, *of_record)
    design = AllanDesign.of_geometry(template, recording.rate, geometry, ALLAN_CAPACITY[1])
    variance = np.stack([mean_squares(x, found, len(levels)) for x in recording.values.T], axis=1)
    return _fit_estimates(design, variance, of_record, recording.axes, template, active, None)


def _fit_estimates(
    design: AllanDesign,
    variances: Float[np.ndarray, "m axes"],
    of_record: tuple[int, float],
    axes: Sequence[Axis],
    template: Model,
    active: Bool[np.ndarray, "axes terms"],
    values: Float[np.ndarray, "n axes"] | None,
) -> tuple[AxisFit, ...]:
    """Fits of every axis to its estimates; see `fit_allan`.

    `of_record`: number of samples and their rate [Hz].
    """
    n, rate = of_record
    records = [None] * len(axes) if values is None else values.T
    # The record determines a line far better than its Allan variances do, which start from this line.
    indices, wanted = lines_of(template)
    free = free_powers(template) & ~np.isin(np.arange(len(template)), indices)
    results = []
    for k, (axis, x) in enumerate(zip(axes, records, strict=True)):
        here = active[[k]]
        variance = variances[:, [k]].T
        starts = find_starts(template, design, variance, here, [x], n, rate)
        lines = {}
        if wanted and x is not None:
            found = take_out_lines(x - x.mean(), rate, wanted)[1]
            lines = dict(zip(indices, found, strict=True))
        for i, line in lines.items():
            if template.terms[i].has_free_amplitude:
                starts.power[:, :, i] = line.amplitude**2
            of_line = [p.term == i for p in free_shapes(template)]
            starts.shape[:, :, of_line] = np.log(line.frequency)
        solution, inference, (misfit,) = solve_and_infer(design, variance, free, here, starts)
        (coefficients,) = coefficients_of(template, [axis], here, solution, inference, n, rate)
        for i, line in lines.items():
            square = (line.amplitude / line.amplitude_std) ** 2
            of_square = (square, line.amplitude_std, 2, line, n)
            coefficients = coefficients.with_values(deterministic_coefficients(template, i, axis, *of_square))
        dof = len(variances) - estimated(template, active[k])
        solution = jax.tree.map(lambda x: x[0], solution)
        result = _axis_fit(axis, template, active[k], coefficients, solution, dof)
        # With one or two degrees of freedom, as at the longest cluster times, the χ² tail is not valid.
        results.append(dataclasses.replace(with_misfit(result, misfit), p_value=np.nan))
    return tuple(results)


def solve_and_infer(
    design: AllanDesign,
    variance: Float[np.ndarray, "axes m"],
    free: Bool[np.ndarray, " terms"],
    active: Bool[np.ndarray, "axes terms"],
    starts: Starts,
) -> tuple[Solution, Inference, list[Misfit | None]]:
    """Best solution of each axis over its starts, the inference around it, and its misfit."""
    powers, shapes = starts.power.swapaxes(0, 1), starts.shape.swapaxes(0, 1)
    solution = solve(design, variance, free, active, powers[0], shapes[0])
    # The cost may have several minima in a correlation time: all starts are tried.
    for power, shape in zip(powers[1:], shapes[1:], strict=True):
        doubtful = np.asarray(~solution.converged | design.has_shapes)
        if not doubtful.any():
            break
        other = solve(design, variance, free, active, power, shape)
        better = other.converged & ~(other.cost >= solution.cost - _AS_LIKELY) | ~solution.converged
        solution = _choose(doubtful & better, other, solution)
    tangent = design.tangent(np.asarray(solution.shape))
    misfits = _misfits(tangent, design.geometry.cluster_time, variance, solution)
    solution = widened(solution, misfits)
    return solution, infer(tangent, variance, free, active, solution), misfits


def _misfits(
    tangent: Tangent,
    cluster_time: Float[np.ndarray, " capacity"],
    variance: Float[np.ndarray, "axes m"],
    solution: Solution,
) -> list[Misfit | None]:
    """Misfit of each axis's curve; None where the model suffices."""
    found: list[Misfit | None] = [None] * len(variance)
    for k in np.flatnonzero(np.asarray(solution.converged) & (np.asarray(solution.power_error) > 0.0)):
        own, power = tangent.of_axes(np.array([k])), np.asarray(solution.power)[None, [k]]
        mean, scatter = (power @ own.means)[0, 0], own.variances(power)[0, 0]
        ratio = np.sqrt(variance[k] / mean)
        found[k] = misfit_of(cluster_time[: len(mean)], ratio, 2.0 * mean**2 / scatter, "s")
    return found


def fit_whittle(
    recording: Recording,
    k: int,
    template: Model,
    active: Bool[np.ndarray, " terms"],
    regressors: Mapping[str, Float[np.ndarray, " n"]],
) -> AxisFit:
    """Fit one axis of a recording by maximum likelihood of its cosine spectrum."""
    axis = recording.axes[k]
    found = fit_axis(template, axis, recording.values[:, k], recording.rate, active, regressors)
    return result_of(found, template, axis, active)


def judged(
    recording: Recording, k: int, template: Model, active: Bool[np.ndarray, " terms"], result: AxisFit
) -> AxisFit:
    """Fit of an axis's variances with the verdict of its spectrum, or Whittle's fit where the two disagree.

    The law of the levels is known at all frequencies, but that of variances at long cluster times is not.
    """
    sufficient = result.converged and result.discrepancy == 0.0
    if sufficient:
        spectrum = spectrum_of(template, recording.values[:, k], recording.rate, {})
        noise = [term for term in result.model.sampled(recording.rate).terms if not term.deterministic]
        power = [getattr(term, term.amplitude_parameter().name) ** 2 for term in noise]
        mean = np.array(power) @ columns_of(noise, spectrum.bins).mean(axis=1)
        projection = spectrum.project(mean, spectrum.used(np.flatnonzero(~active).tolist()))
        chi2 = chi_squared(projection.level / mean, projection.dof)
        dof = round(projection.estimates) - estimated_noise(template, active)
        if chi2 <= beyond_doubt(dof):
            return _with_verdict(result, chi2, dof)
    other = fit_whittle(recording, k, template, active, {})
    # A doubtful spectrum does not overrule variances that refuse the model.
    if result.converged and not sufficient and (other.discrepancy > 0.0 or other.doubtful):
        return _with_verdict(result, other.chi2, other.dof)
    return other if other.converged else result


def _with_verdict(result: AxisFit, chi2: float, dof: int) -> AxisFit:
    """Result with this χ² and number of degrees of freedom."""
    return dataclasses.replace(result, chi2=chi2, dof=dof, p_value=float(upper_tail(chi2, dof)))


def result_of(found: WhittleFit, template: Model, axis: Axis, active: Bool[np.ndarray, " terms"]) -> AxisFit:
    """Result of one axis from its fit by Whittle's likelihood."""
    dof = round(found.estimates) - estimated_noise(template, active)
    result = _axis_fit(axis, template, active, found.coefficients, found.solution, dof)
    result = dataclasses.replace(result, regression=found.regression, spectrum=found.spectrum)
    return with_misfit(result, found.misfit)


def with_misfit(result: AxisFit, misfit: Misfit | None) -> AxisFit:
    """Result with its misfit, if any; if that is excessive, coefficients lose intervals and limits."""
    if misfit is None or not result.converged:
        return result
    if not misfit.excessive:
        return dataclasses.replace(result, misfit=misfit)
    return result.unmeasured(misfit=misfit)


def _choose(rows: Bool[np.ndarray, " axes"], new: Solution, old: Solution) -> Solution:
    """New solution for these axes, old one for the others."""

    def of(new: ArrayLike, old: ArrayLike) -> Shaped[np.ndarray, "axes ..."]:
        return np.where(rows.reshape(-1, *[1] * (np.ndim(new) - 1)), new, old)

    return jax.tree.map(of, new, old)


def check_count(count: int, estimates: str, n: int, template: Model, name: str) -> None:
    """Raise FitError unless n samples give more of the `estimates` than there are free parameters."""
    free_count = sum(p.free for p in template.parameters)
    if count <= free_count:
        raise FitError(
            f"{name or 'the recording'}: {n} samples give {count} {estimates}, too few for {free_count} "
            "parameters; record for longer or use fewer terms"
        )


def estimated(template: Model, active: Bool[np.ndarray, " terms"]) -> int:
    """Number of coefficients that are estimated, by which the degrees of freedom of χ² are reduced."""
    here = of_owners(template, active)
    return sum(p.free and bool(here[p.term]) for p in reported(template))


def estimated_noise(template: Model, active: Bool[np.ndarray, " terms"]) -> int:
    """Number of coefficients of the random terms that are estimated."""
    return estimated(template, active & [not term.deterministic for term in template.terms])


def _axis_fit(
    axis: Axis,
    template: Model,
    active: Bool[np.ndarray, " terms"],
    coefficients: Coefficients,
    solution: Solution,
    dof: int,
) -> AxisFit:
    """Result of one axis from its solution and coefficients."""
    inactive = [label for label, here in zip(template.term_labels, active, strict=True) if not here]
    return AxisFit(
        axis=axis,
        converged=bool(solution.converged),
        reason=""
        if solution.converged
        else "the fit did not converge; try fewer terms or other start values",
        chi2=float(solution.chi2),
        dof=dof,
        p_value=float(upper_tail(solution.chi2, dof)),
        discrepancy=float(solution.discrepancy),
        _coefficients=coefficients.values,
        _covariance=coefficients.covariance,
        _model=fitted_model(template, coefficients.values, inactive),
    )


def with_curve(
    curve: AllanDeviation, template: Model, results: Sequence[AxisFit]
) -> tuple[tuple[AxisFit, ...], AllanDeviation]:
    """Fits of spectra with the misfit of the Allan deviations, and the curve with its degrees of freedom."""
    moments = _moments_under(curve, template, results)
    curve = _with_model_edf(curve, results, moments)
    # Effects that are projected out of the spectrum are still in the Allan deviations.
    profiled = any(isinstance(term, Transient) for term in template.terms)
    found = []
    for k, result in enumerate(results):
        if result.converged and result.spectrum is not None and not (profiled or result.regression):
            ratio = curve.deviation[:, k] / np.sqrt(moments[k][0])
            misfit = misfit_of(curve.cluster_time, ratio, curve.edf[:, k], "s")
            # The misfit of a fitted spectrum is that of its levels, unless that of the Allan deviations is
            # excessive.
            if result.misfit is not None and result.measured and misfit.excessive:
                result = with_misfit(result, misfit)
            else:
                result = dataclasses.replace(result, allan_misfit=misfit.beside(result.misfit))
        found.append(result)
    return tuple(found), curve


def _with_model_edf(
    curve: AllanDeviation,
    results: Sequence[AxisFit],
    moments: Sequence[tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]],
) -> AllanDeviation:
    """Curve with degrees of freedom 2μ²/Var under the fitted models."""
    edf = np.array(curve.edf)
    for k, result in enumerate(results):
        if result.converged:
            mean, variance = moments[k]
            edf[:, k] = 2.0 * mean**2 / variance * curve.gain
    return dataclasses.replace(curve, edf=edf)


def _moments_under(
    curve: AllanDeviation, template: Model, results: Sequence[AxisFit]
) -> list[tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]]:
    """Expectation and variance of the Allan variances of each axis under its fitted model."""
    of_curve, order = (curve.n, curve.rate, curve.cluster_size), quadrature_order(template)
    geometry = AllanCovariance.of(*of_curve, order, curve.strides)
    nothing = np.full(len(curve.cluster_size), np.nan)
    return [
        moments_behind(_with_all_terms(template, result).sampled(curve.rate), geometry)
        if result.converged
        else (nothing, nothing)
        for result in results
    ]


def _with_all_terms(template: Model, result: AxisFit) -> Model:
    """The fitted model; absent terms are included with an amplitude of zero and an arbitrary shape."""
    values = {}
    for p in template.parameters:
        value = result[p.label].value if p.label in result.coefficients else p.start
        absent = 0.0 if p.parameter.is_amplitude else p.parameter.lower + 1.0
        values[p.label] = absent if value is None or np.isnan(value) else float(value)
    return template.with_values(**values)
