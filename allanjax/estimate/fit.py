"""Fits of a noise model to a recording: Allan or wavelet variances, Whittle's or the exact likelihood.

Fits of one noise model to the Allan variances of many axes go in blocks that share the cores.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from jaxtyping import Bool, Float

from allanjax.allan.deviation import AllanDeviation, allan_deviation
from allanjax.allan.estimators import Spacing
from allanjax.base.cache import release_programs
from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError, FitError
from allanjax.base.tables import Column, Tabled, columns_from
from allanjax.base.threads import for_each
from allanjax.base.wording import significant
from allanjax.estimate.axis_fits import (
    check_count,
    check_exact,
    check_terms,
    fit_allan,
    fit_exact,
    fit_spectra,
    fit_wavelet,
    judged,
    solve_and_infer,
    with_curve,
)
from allanjax.estimate.design import AllanDesign, model_to_fit
from allanjax.estimate.deterministic import AxisSpectrum, InUse, Regressors, needs_record
from allanjax.estimate.extension import extended
from allanjax.estimate.inference import count_estimated, reported
from allanjax.estimate.result import AxisFit, Fit
from allanjax.estimate.selection import AxisSelection, TermSelection, ranked
from allanjax.inspection import Inspection, inspect
from allanjax.inspection.facts import Fact, ordered
from allanjax.noise.estimate import usual_unit
from allanjax.noise.model import Model
from allanjax.noise.notation import ModelLike
from allanjax.noise.terms import Markov, Sinusoid, Telegraph, basic_terms
from allanjax.noise.terms.deterministic import Transient
from allanjax.record.completion import widening
from allanjax.record.io.given import RecordingLike, as_recording
from allanjax.record.io.options import GapChoice
from allanjax.record.recording import Axis, Recording
from allanjax.record.units import unit_scale
from allanjax.spectrum.cosine import joint_statistics

if TYPE_CHECKING:
    import pandas as pd

# Denser cluster times than octaves gain some 5 % in the middle of the curve, up to four per octave.
_PER_OCTAVE = 4
Objective = Literal["allan", "whittle", "wavelet", "exact"]


def fit(
    recording: RecordingLike | AllanDeviation,
    model: ModelLike | None = None,
    objective: Objective = "allan",
    *,
    wavelet: str = "haar",
    regressors: Sequence[str] = (),
    as_is: bool = False,
    vibrating: bool = False,
    plain: bool = False,
    rate: float | None = None,
    gyro_unit: str | None = None,
    accel_unit: str | None = None,
    names: Sequence[str] | None = None,
    gaps: GapChoice | None = None,
) -> Fit:
    """Estimate the coefficients of a noise model from every axis of a recording.

    The recording is inspected first (see `inspect`). Parts in which it was handled are left out on all axes;
    `warnings` and `longest_part` of the fit report them. If too little remains, there is no result. With a
    step, a warm-up, a telegraph or regressors the mean may move, which does not count as handling then.

    `objective="allan"`: generalized least squares of the overlapping Allan variances at four cluster times
    per octave, weighted with their full covariance under the fitted model (see `gls`).
    `objective="whittle"`: maximum likelihood of the cosine spectrum (see `cosine`): more efficient where
    terms have similar Allan curves, and far more for lines. Ramps, lines and regressors are profiled out.
    `objective="wavelet"`: generalized least squares of the wavelet variances of all levels (see
    `wavelet_variance`). With "haar" these are half the Allan variances at octaves.
    `objective="exact"`: maximum of the Gaussian likelihood of the samples, by a Kalman filter, for a given
    model and up to 100,000 samples, of which the lowest frequencies matter; missing samples are not filled
    in. An axis that the model does not fit has the result of Whittle's likelihood.

    The segments of a recording with gaps (`gaps="segments"`) are fitted jointly by Whittle's likelihood, each
    less its own mean; `objective` is then "whittle". Whatever needs a single record is fitted to the longest
    segment, in which filters, resonances and lines are searched for; a note reports it.

    Args:
        recording: a result of `read`; or samples [samples, axes], a data frame, or the path of a file; or a
            curve without its record (`read_curve`), to which "allan" fits the five basic terms or the given
            ones.
        model: sum of terms, or its text as on the command line, `"N + B + K"`. Parameters with a value start
            there; held ones stay there. The time of a step and the time constant of a warm-up need a value
            and are held; such terms need "whittle".
            Without a model, `select_terms` chooses the terms for each axis among the five basic ones and a
            Markov process; basic terms not chosen have an upper limit. Where no set of terms fits, or a line
            stands out, the spectrum is searched for a filter, resonances, lines and further Markov processes,
            which are fitted jointly with the terms (`AxisFit.own_template`, `plain`).
        objective: "allan", "whittle", "wavelet" or "exact".
        wavelet: name of an orthogonal wavelet in PyWavelets, for "wavelet"; only "haar" determines ramps and
            lines.
        regressors: names of auxiliary channels, such as temperature, on which the rate may depend linearly;
            with "whittle" only.
        as_is: whether to use the whole recording even where it was disturbed; the warnings stay.
        vibrating: whether the platform is meant to move or vibrate; motion then raises no warning.
        plain: whether to fit the noise terms only, even where they do not fit the data.
        rate, gyro_unit, accel_unit, names: for an array, as in `Recording.from_array`; data frames and files
            may state their own.
        gaps: treatment of missing samples, as in `read`; in an array, of samples that are nan.

    Returns:
        The fit. The coefficients of an axis that did not converge raise FitError.

    Raises:
        FitError: the record is too short for the model; a step or warm-up without a time, or with "allan";
            "exact" with a record that is too long, without a model, or with lines or ramps.
        AllanjaxError: an unknown objective; a regressor that is not an auxiliary channel, or is constant.
    """
    if model in get_args(Objective):
        raise AllanjaxError(f'{model!r} is an objective, not a model; pass objective="{model}"')
    if isinstance(recording, AllanDeviation):
        return fit_curve(recording, model, objective)
    recording = as_recording(recording, rate, gyro_unit, accel_unit, names, gaps)
    seen = inspected(recording, model, regressors, as_is, vibrating)
    return fit_inspected(recording, seen, model, objective, regressors, plain, wavelet, as_is)


def fit_curve(curve: AllanDeviation, model: ModelLike | None = None, objective: Objective = "allan") -> Fit:
    """Fit of a curve without its record; see `fit`.

    Raises:
        FitError: another objective than "allan"; a term that needs the record itself; too few cluster times.
        AllanjaxError: a curve of another kind, or without units.
    """
    if curve.kind != "allan" or curve.axes is None:
        raise AllanjaxError(f"a fit needs Allan deviations with units, not a {curve.kind} curve without axes")
    if objective != "allan":
        raise FitError(f'objective="{objective}" needs the record itself; leave it out for a curve')
    template = basic_terms() if model is None else model_to_fit(model, curve.axes)
    check_terms(template, "needs the record itself; leave it out for a curve")
    check_count(len(curve.cluster_size), "Allan variances", curve.n, template, curve.name)
    active = np.ones((len(curve.axes), len(template)), bool)
    fitted = fit_allan(curve, None, curve.axes, template, active)
    results, curve = with_curve(curve, template, fitted)
    if not curve.determined:
        results = tuple(r.unmeasured(not_measured=("curve",)) if r.converged else r for r in results)
    bare = dataclasses.replace(curve, name="", notes=(), determined=True)
    return Fit(curve.name, template, bare, results, curve.notes)


def fit_inspected(
    recording: Recording,
    seen: Inspection,
    model: ModelLike | None,
    objective: Objective,
    regressors: Sequence[str] = (),
    plain: bool = False,
    wavelet: str = "haar",
    as_is: bool = False,
) -> Fit:
    """Fit of a recording that has been inspected already; see `fit`."""
    if objective not in get_args(Objective):
        told = ", ".join(f'"{name}"' for name in get_args(Objective))
        raise AllanjaxError(f"the objective must be one of {told}, not {objective!r}")
    model = None if model is None else model_to_fit(model, recording.axes, with_response=True)
    quiet = recording if seen.refusal else seen.quiet(recording)
    channels = _regressors(quiet, regressors, objective)
    if seen.refusal:
        template, _ = terms_to_fit(model, None, recording.axes, objective)
        curve = allan_deviation(recording, cluster_times=_PER_OCTAVE)
        none = tuple(AxisFit(axis, False, seen.refusal) for axis in seen.axes)
        fit = Fit(seen.name, template, curve, none, recording.notes, objective, dead=recording.dead)
        return with_what_was_seen(fit, seen)
    if recording.others and not as_is:
        quiet = _with_quiet_segments(quiet, len(recording.others))
    if quiet.others:
        quiet = _joined(quiet, model or Model(()), objective, channels)
    if quiet.missing is None or objective == "exact":
        return with_what_was_seen(_fitted(quiet, model, objective, channels, plain, wavelet), seen)
    # The record is fitted as if complete; then intervals are widened.
    complete, by = dataclasses.replace(quiet, missing=None), widening(quiet.missing)
    fit = _fitted(complete, model, objective, channels, plain, wavelet)
    curve = dataclasses.replace(fit.curve, edf=fit.curve.edf / by**2)
    results = tuple(map(AxisFit.widened, fit.results, by.tolist()))
    return with_what_was_seen(dataclasses.replace(fit, curve=curve, results=results), seen)


def inspected(
    recording: Recording, model: ModelLike | None, regressors: Sequence[str], as_is: bool, vibrating: bool
) -> Inspection:
    """Inspection of a recording for a fit of this model, under which the mean may move."""
    terms = () if model is None else model_to_fit(model, recording.axes, with_response=True).terms
    timed = any(isinstance(term, Transient) for term in terms)
    may_move = timed or bool(regressors) or any(isinstance(term, Telegraph) for term in terms)
    # The time of a step counts from the first sample.
    return inspect(recording, as_is=as_is or timed, vibrating=vibrating, may_move=may_move)


def _with_quiet_segments(quiet: Recording, count: int) -> Recording:
    """The quiet part of a recording, with the undisturbed parts of its first `count` other segments."""
    kept, touched = [], 0
    for x in quiet.others[:count]:
        segment = Recording(x, quiet.rate, quiet.axes)
        look = inspect(segment, vibrating=True)
        touched += bool(look.parts or look.refusal)
        part = segment if look.refusal else look.quiet(segment)
        if not look.refusal and part.names == segment.names:
            kept += [part.values, *part.others]
    notes = quiet.notes
    if touched:
        note = "parts in which the sensor was touched are left out"
        notes += (f"{touched} of {count + 1} segments: {note}",)
    return dataclasses.replace(quiet, others=(*kept, *quiet.others[count:]), notes=notes)


def _joined(recording: Recording, template: Model, objective: Objective, regressors: Regressors) -> Recording:
    """The recording with all segments if they can be fitted jointly, else the longest; a note reports it."""
    reasons = {
        f'objective="{objective}" takes a single segment': objective not in ("allan", "whittle"),
        "regressors need a single segment": bool(regressors),
        "a response is fitted to a single segment": template.response is not None,
    }
    reasons |= {f"{term.name()} is fitted to a single segment": needs_record(term) for term in template.terms}
    others, lengths = recording.others, [recording.n, *map(len, recording.others)]
    note = f"joint fit of {len(lengths)} segments, {sum(lengths):,} samples, by Whittle's likelihood"
    if why := next((reason for reason, holds in reasons.items() if holds), ""):
        others, note = (), f"only the longest segment was fitted: {why}"
    return dataclasses.replace(recording, others=others, notes=(*recording.notes, note))


def _fitted(
    recording: Recording,
    model: Model | None,
    objective: Objective,
    regressors: Regressors,
    plain: bool,
    wavelet: str,
) -> Fit:
    """Fit of all samples of a recording."""
    name, rate, axes, values = recording.name, recording.rate, recording.axes, recording.values
    if objective == "exact":
        check_exact(model, recording)
    release_programs(0.75)
    # Haar wavelet variances are half the Allan variances at octaves.
    octaves = objective == "wavelet" and wavelet == "haar"
    joint, selection, notes = None, None, recording.notes
    with ThreadPoolExecutor(1) as pool:
        pending = pool.submit(allan_deviation, recording, cluster_times="octave" if octaves else _PER_OCTAVE)
        if model is None or recording.others:
            # Segments are taken to be independent.
            joint = joint_statistics((values, *recording.others), rate)
        if model is None:
            selection = ranked(recording, None, joint)
        curve = pending.result()
    template, active = terms_to_fit(model, selection, axes, objective)
    check_count(len(curve.cluster_size), "Allan variances", curve.n, template, name)
    if objective == "wavelet" and not octaves:
        unused = [label for label, used in zip(template.term_labels, active.T, strict=True) if not used.any()]
        template, active = template.without(unused), active[:, active.any(axis=0)]
    if joint is not None and not regressors:
        spectra = AxisSpectrum.of_axes(*joint, template)
        objective = "whittle" if recording.others else objective
    elif objective != "exact":
        spectra = for_each(lambda x: AxisSpectrum.of(template, x, rate, regressors), values.T)
    if objective == "exact":
        results, notes = _exact(recording, template, active)
    elif objective == "whittle":
        results = fit_spectra(template, axes, spectra, active)
    else:
        if objective == "allan" or octaves:
            fits = fit_allan(curve, spectra, axes, template, active)
        else:
            fits = fit_wavelet(recording, spectra, template, active, wavelet)
        each = zip(spectra, active, fits, strict=True)
        results = tuple(for_each(lambda of_axis: judged(template, *of_axis), each))
    results, curve = with_curve(curve, template, results)
    if selection is not None:
        rankings = selection.results
        # Regressors belong to a given model, or to the plain terms.
        if not (plain or regressors):
            # Threads would wait for each other: searches are many short calls.
            both = [extended(values[:, k], rate, results[k], rankings[k], curve, k) for k in range(len(axes))]
            results, rankings = zip(*both, strict=True)
            selection = dataclasses.replace(selection, results=rankings)
        results = tuple(map(with_doubts, results, rankings))
        notes = (*notes, *selection.ambiguities())
    return Fit(name, template, curve, results, notes, objective, selection, recording.dead)


def _exact(
    recording: Recording, template: Model, active: InUse
) -> tuple[tuple[AxisFit, ...], tuple[str, ...]]:
    """Results by the exact likelihood, and notes; axes with Whittle's are widened for missing samples."""
    fits = [fit_exact(recording, k, template, of_axis) for k, of_axis in enumerate(active)]
    by = np.ones(len(fits)) if recording.missing is None else widening(recording.missing)
    results = [r if exact else r.widened(x) for (r, exact), x in zip(fits, by.tolist(), strict=True)]
    names = ", ".join(r.axis.name for r, exact in fits if not exact)
    note = f"{names}: fitted by Whittle's likelihood instead, as the model does not fit"
    return tuple(results), (*recording.notes, *([note] if names else []))


def with_what_was_seen(found: Fit, seen: Inspection) -> Fit:
    """A fit with the results of its inspection: facts, parts, levels, and consequences for each axis."""
    rate, results = found.curve.rate, []
    facts = ordered(_left(fact, found) for fact in seen.facts)
    for r in found.results:
        k = [axis.name for axis in seen.axes].index(r.axis.name)
        r = dataclasses.replace(r, mean=float(seen.mean[k]), rms=float(seen.rms[k]))
        # A relative change of the power is half as large in the amplitude.
        widened = (f for f in facts if f.consequence == "widened" and r.axis.name in f.axes)
        share = float(np.hypot(seen.disturbance_error[k], sum(f.share or 0.0 for f in widened) / 2.0))
        r = r.allowing(share, float(seen.added_noise[k]) / np.sqrt(rate))
        kinds = seen.why_not(r.axis.name)
        results.append(r.unmeasured(not_measured=kinds) if r.converged and kinds else r)
    return dataclasses.replace(
        found, results=tuple(results), facts=facts, parts=seen.parts, notes=found.notes + seen.notes
    )


def _left(fact: Fact, found: Fit) -> Fact:
    """The fact; one about lines widens the intervals if no term of the axis's model describes them."""
    result = found[fact.axes[0]] if fact.kind == "lines" else None
    if result is None or not result.converged:
        return fact
    if any(term.narrow_band or isinstance(term, Sinusoid) for term in result.model.terms):
        return fact
    text = f"{fact.text}: no term of the model describes it; the intervals are widened accordingly"
    return dataclasses.replace(fact, consequence="widened", text=text)


def terms_to_fit(
    model: ModelLike | None, selection: TermSelection | None, axes: Sequence[Axis], objective: Objective
) -> tuple[Model, InUse]:
    """Model to fit, given or chosen, and the terms that each axis has.

    Raises:
        FitError: a step or a warm-up without a time, or with "allan"; the same term twice.
    """
    if selection is None:
        spectral = objective != "allan"
        template = basic_terms() if model is None else model_to_fit(model, axes, with_response=spectral)
        return _checked(template, objective), np.ones((len(axes), len(template)), bool)
    sets = [axis.chosen.terms for axis in selection.results]
    # A Markov process is in the template only if it is needed, as it costs time.
    template = basic_terms() + Markov() if any("markov" in s for s in sets) else basic_terms()
    return template, np.array([[label in s for label in template.term_labels] for s in sets])


def _checked(template: Model, objective: Objective) -> Model:
    """The model with the shapes of its steps and warm-ups held, as a record is not searched for them.

    Raises FitError for two terms that differ only in free amplitudes.
    """
    terms, seen = list(template.terms), set()
    for k, term in enumerate(template.terms):
        if isinstance(term, Transient):
            if objective != "whittle":
                raise FitError(f'{term.name()} has no Allan variance of its own; use objective="whittle"')
            shapes = [p.name for p in term.parameters()[1:]]
            for name in shapes:
                if getattr(term, name) is None:
                    raise FitError(
                        f"a fit does not estimate the {name} of a {term.name()}; give its value, e.g. "
                        f'{type(term).__name__}({name}=120.0).hold("{name}"); allanjax.critique estimates it'
                    )
            terms[k] = term = term.hold(*shapes)
        shape = [getattr(term, p.name) for p in term.parameters() if not term.is_free(p)]
        if len(term.parameters()) == len(shape) + 1:
            if (key := (type(term), *shape, template.inside[k : k + 1])) in seen:
                raise FitError(f"the model has {term.name()} twice; leave one of them out")
            seen.add(key)
    return dataclasses.replace(template, terms=tuple(terms))


def _regressors(recording: Recording, names: Sequence[str], objective: Objective) -> Regressors:
    """Auxiliary channels of these names, their means subtracted."""
    if names and objective != "whittle":
        raise AllanjaxError(
            'regressors need the likelihood of the spectrum; use objective="whittle" (--objective whittle)'
        )
    channels = {}
    for name in names:
        if name not in recording.auxiliary:
            there = ", ".join(recording.auxiliary) or "none"
            raise AllanjaxError(
                f"{recording.name or 'the recording'} has no auxiliary channel {name!r}; it has {there}"
            )
        channel = np.asarray(recording.auxiliary[name], float)
        channels[name] = channel - channel.mean()
        if not np.isfinite(channel).all() or not channels[name].any():
            raise AllanjaxError(
                f"auxiliary channel {name!r} is constant or not finite; leave it out of the regressors"
            )
    return channels


def with_doubts(result: AxisFit, ranking: AxisSelection) -> AxisFit:
    """Result whose intervals include the uncertainty of the choice of terms.

    Intervals of amplitudes cover those of all sets that cannot be distinguished from the best one. A term is
    detected only if the sets that have it have nearly all the probability.
    """
    if not result.converged:
        return result
    doubtful, found = ranking.doubtful(), dict(result.coefficients)
    # The ranking of an extended axis is that of its corrected spectrum.
    intervals = ranking.intervals if result.own_template is None else {}
    for label, c in found.items():
        if label in intervals and c.detected and c.std > 0.0:
            found[label] = c = c.covering(*intervals[label])
        if c.term in doubtful and c.detected:
            rivals = doubtful[c.term] if c.is_amplitude else ()
            found[label] = dataclasses.replace(c, detected=False, rivals=rivals)
    return result.with_estimates(found)


# Axes per block: for so many, the data of the compiled programs stay in a core's cache.
_BLOCK = 64
# Arrays are padded to a multiple of so many cluster sizes: at octaves, two programs serve all records.
_CAPACITY = 8


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class BulkFit(ByValue, Tabled):
    """The fit of one model to many axes: arrays [axes] or [axes, coefficients], in SI.

    Axes that did not converge have NaN for their coefficients and detect nothing.

    Attributes:
        template: the model whose terms were fitted.
        curve: the Allan deviations it was fitted to.
        value: the estimates; zero for the amplitude of a term that improves nothing.
        std: their standard deviations.
        lower, upper: ends of the 95 % intervals; the lower one is zero where zero is not excluded.
        upper_limit: one-sided 95 % limits of amplitudes; NaN for other coefficients.
        detected: whether zero is excluded.
        converged: whether the axis has a result.
        chi2, dof: misfit of the Allan variances to the model within their own scatter.
        discrepancy: as in `AxisFit`.
        measured: whether the coefficients are a measurement. They are not where the fitted curve is far off
            (see `AxisFit.misfit`): there is then no standard deviation, interval or limit.
    """

    template: Model
    curve: AllanDeviation
    value: Float[np.ndarray, "axes coefficients"]
    std: Float[np.ndarray, "axes coefficients"]
    lower: Float[np.ndarray, "axes coefficients"]
    upper: Float[np.ndarray, "axes coefficients"]
    upper_limit: Float[np.ndarray, "axes coefficients"]
    detected: Bool[np.ndarray, "axes coefficients"]
    converged: Bool[np.ndarray, " axes"]
    chi2: Float[np.ndarray, " axes"]
    dof: int
    discrepancy: Float[np.ndarray, " axes"]
    measured: Bool[np.ndarray, " axes"]

    @property
    def coefficients(self) -> tuple[str, ...]:
        """Labels of the coefficients, in the order of the arrays' columns."""
        return tuple(p.label for p in reported(self.template))

    @property
    def names(self) -> tuple[str, ...]:
        """The axes' names; their numbers where the curve is that of an array."""
        return self.curve.names

    def __len__(self) -> int:
        return len(self.value)

    def to_dataframe(self) -> pd.DataFrame:
        """One row per axis and coefficient, with the columns of `Fit.to_dataframe`.

        Numbers are in the usual units; for the curve of an array, whose sensor is unknown, in the array's own
        unit and seconds, with an empty `unit`.
        """
        import pandas as pd

        sensors = [a.sensor for a in self.curve.axes] if self.curve.axes else [None] * len(self)
        parameters = [p.parameter for p in reported(self.template)]
        usual = {s: [usual_unit(p, s) if s else "" for p in parameters] for s in set(sensors)}
        scales = {s: [unit_scale(u, s) if u else 1.0 for u in units] for s, units in usual.items()}
        unit, scale = np.array([usual[s] for s in sensors], object), np.array([scales[s] for s in sensors])
        columns: dict[str, Any] = {
            "axis": np.array(self.names, object)[:, None],
            "coefficient": np.array(self.coefficients, object),
            "value": self.value / scale,
            "std": self.std / scale,
            "lower_95": self.lower / scale,
            "upper_95": self.upper / scale,
            "unit": unit,
            "detected": self.detected,
            "upper_limit_95": self.upper_limit / scale,
            "measured": self.measured[:, None],
        }
        return pd.DataFrame({key: np.broadcast_to(x, unit.shape).ravel() for key, x in columns.items()})

    def _tables(self) -> list[list[Column]]:
        rows = []
        for (label, unit), of_label in self.to_dataframe().groupby(["coefficient", "unit"], sort=False):
            seen = of_label["value"][of_label["detected"]]
            ends = [significant(x, 4) for x in seen.quantile([0.05, 0.5, 0.95])] if len(seen) else [""] * 3
            rows.append([str(label), str(unit), *ends, f"{len(seen)} of {len(of_label)} axes"])
        return [columns_from(("coefficient", "unit", "5 %", "median", "95 %", "detected"), rows)]

    def _title(self) -> str:
        return (
            f"{len(self)} axes of {self.curve.n:,} samples at {self.curve.rate:g} Hz, "
            f"{np.count_nonzero(self.converged)} converged; values where detected"
        )


def fit_many(
    data: AllanDeviation | Sequence[Recording], model: ModelLike, *, cluster_times: Spacing = "octave"
) -> BulkFit:
    """Estimate the coefficients of one noise model for each of many axes, thousands per second.

    The result for an axis is that of `fit` with `objective="allan"` for the same Allan variances, by default
    at octaves of the cluster time: some 5 % less precise in the middle of the curve than `fit`, which has
    four cluster times per octave, and twenty times faster.

    Args:
        data: a curve of any number of axes, e.g. `allan_deviation(x, rate)` of an array [samples, units]; or
            recordings of equal length and rate, whose axes are then named "recording/axis".
        model: the terms, with start values and held parameters as in `fit`.
        cluster_times: spacing of the cluster times of recordings, see `allan_deviation`; a curve has its own.

    Raises:
        FitError: a line, resonance or transient, which needs the record itself; too few cluster times.
        AllanjaxError: no recordings, or of different lengths or rates; a modified or Hadamard curve.
    """
    curve = _curve_of(data, cluster_times)
    template, variance = model_to_fit(model, curve.axes or ()), curve.variance.T
    own = "is estimated from the record itself, not from Allan variances"
    check_terms(template, f"{own}; leave it out, or fit each recording with allanjax.fit")
    check_count(len(curve.cluster_size), "Allan variances", curve.n, template, "the curve")
    capacity = -(-len(curve.cluster_size) // _CAPACITY) * _CAPACITY
    design = AllanDesign.of(template, curve, (capacity, 0))
    blocks = for_each(
        lambda k: _of_block(template, design, variance[k : k + _BLOCK]),
        range(0, len(variance), _BLOCK),
    )
    arrays = {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}
    dof = len(curve.cluster_size) - count_estimated(template, np.ones(len(template), bool))
    return BulkFit(template=template, curve=curve, dof=dof, **arrays)


def _of_block(template: Model, design: AllanDesign, variance: Float[np.ndarray, "axes m"]) -> dict[str, Any]:
    """Arrays of a `BulkFit` for at most `_BLOCK` axes; a smaller block is filled up with its last axis."""
    count, active = len(variance), np.ones((_BLOCK, len(template)), bool)
    V = np.pad(variance, ((0, _BLOCK - count), (0, 0)), mode="edge")
    solution, found, misfits = solve_and_infer(template, design, V, active)
    converged = solution.converged
    measured = converged & [m is None or not m.excessive for m in misfits]
    lower, upper, _, _, limit = found.ends.transpose(2, 0, 1)
    known = {"std": found.std, "lower": lower, "upper": upper, "upper_limit": limit}
    arrays = {name: np.where(measured[:, None], x, np.nan) for name, x in known.items()} | {
        "value": np.where(converged[:, None], found.value, np.nan),
        "detected": found.detected & measured[:, None],
        "converged": converged,
        "chi2": solution.chi2,
        "discrepancy": solution.discrepancy,
        "measured": measured,
    }
    return {name: x[:count] for name, x in arrays.items()}


def _curve_of(data: AllanDeviation | Sequence[Recording], cluster_times: Spacing) -> AllanDeviation:
    """The Allan deviations of all axes."""
    if isinstance(data, AllanDeviation):
        if data.kind != "allan":
            raise AllanjaxError(f"a fit needs the Allan deviation, not a {data.kind} one; leave out kind")
        if not (isinstance(cluster_times, str) and cluster_times == "octave"):
            raise AllanjaxError("a curve has its own cluster times; leave out cluster_times")
        return data
    if isinstance(data, Recording) or not all(isinstance(r, Recording) for r in data) or not len(data):
        raise AllanjaxError("pass an AllanDeviation or a sequence of recordings, e.g. [recording]")
    names, curves = [recording.name or str(k) for k, recording in enumerate(data)], []
    for name, recording in zip(names, data, strict=True):
        if (recording.n, recording.rate) != (data[0].n, data[0].rate):
            raise AllanjaxError(
                f"{name} has {recording.n} samples at {recording.rate:g} Hz, but {names[0]} {data[0].n} at "
                f"{data[0].rate:g} Hz; cut them to one length with between(), or fit it separately"
            )
        axes = [dataclasses.replace(axis, name=f"{name}/{axis.name}") for axis in recording.axes]
        alone = dataclasses.replace(recording, axes=tuple(axes), others=())
        curves.append(allan_deviation(alone, cluster_times=cluster_times))
    deviation, edf = (np.hstack([getattr(curve, name) for curve in curves]) for name in ("deviation", "edf"))
    every = tuple(axis for curve in curves for axis in curve.axes or ())
    return dataclasses.replace(curves[0], deviation=deviation, edf=edf, axes=every)
