"""Fits of a noise model to a recording: Allan or wavelet variances, Whittle's or the exact likelihood.

An axis that the plain noise terms do not fit is fitted with filter, resonances and lines (`extension`): its
spectrum is searched for components besides the terms; the terms are chosen anew, from the spectrum divided by
the effect of these components; and the model of all of them is fitted by Whittle's likelihood, without what
that does not detect.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Literal, get_args

import numpy as np

from allanjax.allan.deviation import AllanDeviation, CurveOptions, allan_of
from allanjax.base.cache import release_programs
from allanjax.base.errors import AllanjaxError, FitError
from allanjax.base.threads import for_each
from allanjax.estimate.axis_fits import (
    check_count,
    check_terms,
    fit_allan,
    fit_judged,
    fit_spectra,
    fit_wavelet,
    judged,
    with_curve,
)
from allanjax.estimate.design import check_no_response
from allanjax.estimate.deterministic import (
    AxisSpectrum,
    InUse,
    Regressors,
    needs_record,
)
from allanjax.estimate.exact import check_exact, fit_exact
from allanjax.estimate.extension import content_of, extended, with_common_filters
from allanjax.estimate.result import AxisFit, Fit
from allanjax.estimate.seen import with_what_was_seen
from allanjax.estimate.selection import AxisSelection, TermSelection, ranked
from allanjax.estimate.variation import with_variations
from allanjax.inspection import Inspection, inspect
from allanjax.inspection.facts import ordered
from allanjax.inspection.units import units_of_curve
from allanjax.noise.model import Model
from allanjax.noise.notation import ModelLike, as_model
from allanjax.noise.terms import (
    Markov,
    Telegraph,
    basic_terms,
)
from allanjax.noise.terms.deterministic import Transient
from allanjax.record.completion import widening
from allanjax.record.held import between_changes
from allanjax.record.io.given import RecordingLike, as_recording
from allanjax.record.io.options import GapChoice
from allanjax.record.recording import Axis, Recording
from allanjax.record.shapes import Which
from allanjax.spectrum.cosine import joint_statistics

# Denser cluster times than octaves gain some 5 % in the middle of the curve, up to four per octave.
_CURVE = CurveOptions(cluster_times=4)
Objective = Literal["allan", "whittle", "wavelet", "exact"]


def fit(
    recording: RecordingLike | AllanDeviation,
    model: ModelLike | None = None,
    objective: Objective = "allan",
    *,
    wavelet: str = "haar",
    regressors: Sequence[str] | str = (),
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
    per octave, weighted with their full covariance under the fitted model (see `design`).
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
        own = {"rate": rate, "gyro_unit": gyro_unit, "accel_unit": accel_unit, "names": names, "gaps": gaps}
        unused = [name for name, value in own.items() if value is not None]
        if regressors:
            unused.append("regressors")
        if unused:
            raise AllanjaxError(f"a curve has its own rate, axes and units: omit {', '.join(unused)}")
        return fit_curve(recording, model, objective)
    recording = as_recording(recording, rate, gyro_unit, accel_unit, names, gaps)
    regressors = (regressors,) if isinstance(regressors, str) else regressors
    terms = None if model is None else as_model(model, recording.axes)
    seen = inspected(recording, terms, regressors, as_is, vibrating)
    return fit_inspected(recording, seen, terms, objective, regressors, plain, wavelet, as_is)


def fit_curve(curve: AllanDeviation, model: ModelLike | None = None, objective: Objective = "allan") -> Fit:
    """Fit of a curve without its record; see `fit`."""
    if curve.kind != "allan" or curve.axes is None:
        raise AllanjaxError(f"a fit needs Allan deviations with units, not a {curve.kind} curve without axes")
    if objective != "allan":
        raise FitError(f'objective="{objective}" needs the record itself; leave it out for a curve')
    facts = units_of_curve(curve.axes, curve.cluster_time, curve.deviation, curve.given)
    template = basic_terms() if model is None else as_model(model, curve.axes)
    check_no_response(template)
    check_terms(template, "needs the record itself; leave it out for a curve")
    check_count(len(curve.cluster_size), "Allan variances", curve.n, template, curve.name)
    active = np.ones((len(curve.axes), len(template)), bool)
    fitted = fit_allan(curve, None, curve.axes, template, active)
    results, curve = with_curve(curve, template, fitted)
    if not curve.determined:
        results = tuple(r.without_intervals() if r.measured else r for r in results)
    results = tuple(r.with_misfits_felt(curve.rate) if r.converged else r for r in results)
    doubtful = {axis: (fact.kind,) for fact in facts if fact.grave for axis in fact.axes}
    results = tuple(
        r.unmeasured(not_measured=doubtful[r.axis.name]) if r.converged and r.axis.name in doubtful else r
        for r in results
    )
    bare = dataclasses.replace(curve, name="", notes=())
    return Fit(curve.name, template, bare, results, curve.notes, facts=ordered(facts))


def fit_inspected(
    recording: Recording,
    seen: Inspection,
    model: Model | None,
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
    quiet = recording if seen.refusal else seen.quiet(recording)
    channels = _regressors(quiet, regressors, objective)
    if seen.refusal:
        found = _refused(recording, seen, model, objective)
    else:
        if recording.others and not as_is:
            quiet = _with_quiet_segments(quiet, len(recording.others))
        if quiet.others:
            quiet = _joined(quiet, model or Model(()), objective, channels)
        # The exact likelihood leaves out missing samples by itself.
        missing = None if objective == "exact" else quiet.missing
        if missing is not None:
            quiet = dataclasses.replace(quiet, missing=None)
        found = _fitted(quiet, model, objective, channels, plain, wavelet)
        if missing is not None:
            found = _widened(found, missing)
    return with_what_was_seen(found, seen)


def _refused(recording: Recording, seen: Inspection, model: Model | None, objective: Objective) -> Fit:
    """Fit without results of a recording that is not a measurement of the sensor at rest."""
    template, _ = terms_to_fit(model, None, recording.axes, objective)
    none = tuple(AxisFit(axis, False, seen.refusal) for axis in seen.axes)
    curve, notes = allan_of(recording, _CURVE), recording.notes
    return Fit(seen.name, template, curve, none, notes, objective, dead=recording.dead)


def _widened(found: Fit, missing: Which) -> Fit:
    """Fit of a record as if it were complete, with intervals that allow for the samples that were missing."""
    by = widening(missing)
    curve = dataclasses.replace(found.curve, edf=found.curve.edf / by**2)
    results = tuple(map(AxisFit.widened, found.results, by.tolist()))
    return dataclasses.replace(found, curve=curve, results=results)


def inspected(
    recording: Recording, model: Model | None, regressors: Sequence[str], as_is: bool, vibrating: bool
) -> Inspection:
    """Inspection of a recording for a fit of this model, under which the mean may move."""
    terms = () if model is None else model.terms
    timed = any(isinstance(term, Transient) for term in terms)
    may_move = timed or bool(regressors) or any(isinstance(term, Telegraph) for term in terms)
    # The time of a step counts from the first sample.
    seen = inspect(recording, as_is=as_is or timed, vibrating=vibrating, may_move=may_move)
    # What an axis follows is regressed on, so that it needs no advice.
    facts = tuple(fact for fact in seen.facts if fact.kind != "temperature" or not regressors)
    return dataclasses.replace(seen, facts=facts)


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
    note = f"{touched} of {count + 1} segments: parts in which the sensor was touched are left out"
    notes = (*quiet.notes, note) if touched else quiet.notes
    return dataclasses.replace(quiet, others=(*kept, *quiet.others[count:]), places=(), notes=notes)


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
    return dataclasses.replace(recording, others=others, places=(), notes=(*recording.notes, note))


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
        pending = pool.submit(allan_of, recording, CurveOptions() if octaves else _CURVE)
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
    elif objective == "allan" or octaves:
        results = fit_judged(curve, spectra, axes, template, active)
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
            contents = [content_of(x, rate, r) for x, r in zip(values.T, results, strict=True)]
            contents = with_common_filters(contents, axes)
            parts = zip(contents, results, rankings, curve.deviation.T, curve.edf.T, strict=True)
            both = [extended(*of_axis, curve.cluster_time) for of_axis in parts]
            results, rankings = zip(*both, strict=True)
            selection = dataclasses.replace(selection, results=rankings)
        results = tuple(map(with_doubts, results, rankings))
        notes = (*notes, *selection.ambiguities())
    if objective != "exact":
        # Missing samples, which that likelihood leaves out, have no values.
        columns = [[x[:, k] for x in (values, *recording.others)] for k in range(len(axes))]
        pairs = zip(results, columns, strict=True)
        results = tuple(for_each(lambda pair: with_variations(*pair, rate), pairs))
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


def terms_to_fit(
    model: Model | None, selection: TermSelection | None, axes: Sequence[Axis], objective: Objective
) -> tuple[Model, InUse]:
    """Model to fit, given or chosen, and the terms that each axis has."""
    if selection is None:
        template = basic_terms() if model is None else model
        if objective == "allan":
            check_no_response(template)
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
    """Auxiliary channels of these names, their means and, if they hold values, their steps taken out."""
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
        channel = between_changes(np.asarray(recording.auxiliary[name], float))
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
        elif label in intervals and c.upper_limit is not None and not c.held:
            limit = max(c.upper_limit, intervals[label][1])
            found[label] = c = dataclasses.replace(c, upper_limit=limit)
        if c.term in doubtful and c.detected:
            rivals = doubtful[c.term] if c.is_amplitude else ()
            found[label] = dataclasses.replace(c, detected=False, rivals=rivals)
    return result.with_estimates(found)
