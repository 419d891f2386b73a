"""Fits of a noise model to a recording: Allan or wavelet variances, Whittle's or the exact likelihood.

An axis that the plain noise terms do not fit is fitted with filter, resonances and lines: its spectrum is
searched for components besides the terms (`Content`); the terms are chosen anew, from the spectrum divided by
the effect of these components; and the model of all of them is fitted by Whittle's likelihood, without what
that does not detect.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Literal, NamedTuple, get_args

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
    fit_spectrum,
    fit_wavelet,
    judged,
    with_curve,
)
from allanjax.estimate.design import check_no_response
from allanjax.estimate.deterministic import (
    AxisSpectrum,
    Cosines,
    InUse,
    Line,
    Regressors,
    Samples,
    lines_of,
    needs_record,
    take_out_lines,
    without_lines,
)
from allanjax.estimate.exact import check_exact, fit_exact
from allanjax.estimate.misfit import misfit_of
from allanjax.estimate.result import AxisFit, Fit
from allanjax.estimate.seen import with_what_was_seen
from allanjax.estimate.selection import AxisSelection, TermSelection, candidates_in_record, rank_terms, ranked
from allanjax.estimate.spectral import search
from allanjax.estimate.spectral.components import MARKOV, NONE
from allanjax.estimate.spectral.model import (
    FIXED,
    LINE,
    OUTSIDE,
    QUANTIZATION,
    Component,
    Spectrum,
    Structure,
    peak_of,
    response_of,
    term_of,
)
from allanjax.estimate.spectral.search import Record
from allanjax.estimate.variation import with_variations
from allanjax.inspection import Inspection, inspect
from allanjax.inspection.facts import ordered
from allanjax.inspection.units import units_of_curve
from allanjax.noise.model import Model
from allanjax.noise.notation import ModelLike, as_model
from allanjax.noise.terms import (
    Markov,
    NoiseTerm,
    PowerLaw,
    Resonance,
    Sinusoid,
    Telegraph,
    WanderingResonance,
    basic_terms,
)
from allanjax.noise.terms.deterministic import Transient
from allanjax.record.completion import widening
from allanjax.record.held import between_changes
from allanjax.record.io.given import RecordingLike, as_recording
from allanjax.record.io.options import GapChoice
from allanjax.record.recording import Axis, Recording
from allanjax.record.shapes import Which
from allanjax.spectrum.cosine import cosine_transform, fast_length, joint_statistics, ramp_column
from allanjax.spectrum.peaks import MEDIAN, lines_in

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
            both = [extended(values[:, k], rate, results[k], rankings[k], curve, k) for k in range(len(axes))]
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


# Coefficients on either side of a line that contain its power, and that are inspected.
_CORE, _LINE_AROUND = 4, 40
# Share of the excess there in a line's core; log odds of a peak in white noise; number of peaks tried, and of
# searches, each after removal of the lines found before; and least distance of two lines [coefficients].
_NEARLY_ALL, _SURE, _TRIED, _LOOKS, _APART = 0.9, 10.0, 64, 3, 1.5
# Most fits until every component of the model is detected, and the growth of the discrepancy, relative and
# absolute, that the removal of what is not detected may cause: judgements.
_ROUNDS, _WORSE, _SLIGHT = 6, 1.2, 0.001
# Share of the discrepancy that must be removed, and fewest samples for a search.
_LESS, _SHORTEST = 0.5, 1024


class Content(NamedTuple):
    """Components of a spectrum, its lines, the spectrum in bins, and its coefficients.

    The coefficients are as `take_out_lines` leaves them; `doubt` is a relative error of N, see `Fitted`.
    """

    structure: Structure
    lines: tuple[Line, ...]
    spectrum: Spectrum
    c: Cosines
    doubt: float

    @classmethod
    def of(cls, x: Samples, rate: float, c: Cosines, lines: tuple[Line, ...]) -> Content:
        """Components of the spectrum of these samples, of which these lines are known."""
        record = Record(without_lines(c, lines, rate) ** 2, rate)
        spectrum, found = search.searched(record, Structure.plain(list(range(len(FIXED)))))
        if sharp := search.narrow(found.structure, len(x)):
            own, rest = found.structure.components, found.structure.without(*sharp)
            more = [own[k].frequency * rate / (2.0 * np.pi) for k in sharp]
            c, lines = _with_more_lines(x, rate, lines, more)
            record = Record(without_lines(c, lines, rate) ** 2, rate)
            spectrum, found = search.searched(record, search.refitted(record, rest)[1].structure)
        spectrum, last = search.completed(record, spectrum, found)
        if last.structure.kind != NONE:
            halves = _halves(x, rate, lines)
            if not search.shows_response(halves, last.structure):
                spectrum, last = search.without_response(record, last)
        structure = last.structure.without(*search.narrow(last.structure, len(x)))
        return cls(structure, lines, spectrum, c, last.doubt)

    @property
    def rest(self) -> Cosines:
        """The coefficients without the lines."""
        return without_lines(self.c, self.lines, self.spectrum.bins.rate)

    @property
    def plain_terms(self) -> list[int]:
        """Components with some power that are basic terms or Markov processes before the response, if any."""
        of = self.structure
        plain = [*of.of_kind(MARKOV), *map(of.place, range(OUTSIDE))]
        return [k for k in of.there if k in plain and (of.kind == NONE or of.components[k].inside)]


def _halves(x: Samples, rate: float, lines: Sequence[Line]) -> list[Record]:
    """Squared coefficients of both halves of a record without its lines."""
    half, found = fast_length(len(x) // 2), list[Record]()
    known = [(line.frequency, False) for line in lines]
    for part in (x[:half], x[-half:]):
        c, own = take_out_lines(part - part.mean(), rate, known)
        found.append(Record(without_lines(c, own, rate) ** 2, rate))
    return found


def _conspicuous(square: Cosines, rate: float) -> list[float]:
    """Frequencies of peaks that are as narrow as lines and far above their surroundings [Hz]."""
    n, found = len(square) + 1, list[float]()
    sure = 2.0 * (np.log(n) + _SURE)
    for j in lines_in(square, _TRIED):
        around = square[max(j - 1 - _LINE_AROUND, 0) : j + _LINE_AROUND]
        level = float(np.median(around)) / MEDIAN
        core = square[max(j - 1 - _CORE, 0) : j + _CORE] - level
        if square[j - 1] > sure * level and core.sum() > _NEARLY_ALL * (around - level).sum():
            found.append(j * rate / (2.0 * n))
    return found


def _conspicuous_lines(x: Samples, rate: float) -> tuple[Cosines, tuple[Line, ...]]:
    """Coefficients and conspicuous lines of samples; see `take_out_lines`."""
    c, lines = cosine_transform(x), tuple[Line, ...]()
    for _ in range(_LOOKS):
        if not (more := _conspicuous(without_lines(c, lines, rate) ** 2, rate)):
            break
        c, lines = _with_more_lines(x, rate, lines, more)
    return c, lines


def _with_more_lines(
    x: Samples, rate: float, lines: Sequence[Line], more: Sequence[float]
) -> tuple[Cosines, tuple[Line, ...]]:
    """Coefficients and lines, of which there are more near these frequencies [Hz]; see `take_out_lines`."""
    return take_out_lines(x, rate, [(f, False) for f in (*(line.frequency for line in lines), *more)])


def extended(
    x: Samples, rate: float, plain: AxisFit, selection: AxisSelection, curve: AllanDeviation, k: int
) -> tuple[AxisFit, AxisSelection]:
    """Fit of one axis with components besides the plain terms, and the ranking of these.

    They are the given ones if the plain terms fit and no line stands out, or if the components explain
    little. Samples are at a rate [Hz]; the axis is k of the Allan deviations.
    """
    as_given = plain, selection
    if len(x) < _SHORTEST:
        return as_given
    x = x[: fast_length(len(x))]
    x = x - x.mean()
    c, lines = _conspicuous_lines(x, rate)
    # Among many coefficients of one level a line may not show.
    if plain.converged and not plain.discrepancy > 0.0 and not lines:
        return as_given
    content = Content.of(x, rate, c, lines)
    of = content.structure
    besides = of.kind != NONE or of.oscillators or of.of_kind(MARKOV) or content.lines
    # Without plain terms nothing is to be corrected.
    if not besides or not content.plain_terms:
        return as_given
    selection = _selection(content, plain.axis)
    content = content._replace(structure=_with_terms(content, selection))
    template, active = _template(content, selection)
    if all(term.deterministic for term in itertools.compress(template.terms, active)):
        return as_given
    template, result = _detected(content, template, active, plain.axis, x)
    if not result.converged:
        return as_given
    deviation = np.sqrt(np.asarray(result.model.sampled(rate).allan_variance(curve.cluster_time)))
    misfit = misfit_of(curve.cluster_time, curve.deviation[:, k] / deviation, curve.edf[:, k], "s")
    # Deep in a stop band levels may be far off that no Allan deviation notices.
    left = min(result.discrepancy, misfit.rms if misfit else 0.0)
    is_far_off = result.discrepancy > 0.0 and misfit is not None and misfit.excessive
    if is_far_off or (plain.converged and left > _LESS * plain.discrepancy):
        return as_given
    own = _with_values(template, result)
    # Other filters, and other places of resonances, with another N may fit nearly as well.
    N = result.coefficients["angle_random_walk"]
    if N.std > 0.0:
        wider = N.widened(math.hypot(1.0, content.doubt * N.value / N.std))
        result = result.with_estimates({**result.coefficients, N.label: wider})
    return dataclasses.replace(result, own_template=own, plain=plain, other_misfit=misfit), selection


def _selection(content: Content, axis: Axis) -> AxisSelection:
    """Ranking of the terms by the spectrum divided by the effect of the rest of the structure."""
    structure, spectrum, bins = content.structure, content.spectrum, content.spectrum.bins
    plain = [structure.components[k] for k in content.plain_terms]
    total, terms = (
        np.array([c.power for c in own]) @ spectrum.units(of, own)
        for of, own in ((structure, structure.components), (structure.without_response(), plain))
    )
    every, middle = np.log(np.arange(1.0, bins.n)), np.log(bins.frequency * 2.0 * bins.n / bins.rate)
    # A ramp is not divided: it is in the lowest coefficients, which the structure does not change.
    corrected = content.rest / np.exp(0.5 * np.interp(every, middle, np.log(total / terms)))
    candidates = candidates_in_record(bins.n, bins.rate, 2 if len(structure.of_kind(MARKOV)) > 1 else 1)
    statistics = candidates.bins.statistics(corrected[:, None], ramp_column(bins.n, bins.rate))
    return rank_terms(candidates, statistics, [axis], axis.name).results[0]


def _with_terms(content: Content, selection: AxisSelection) -> Structure:
    """Structure with the chosen terms, and as many Markov processes, slower than filtered white noise.

    If no set of terms suffices, those with a free time were left out, and the structure keeps its own.
    """
    chosen, structure = selection.chosen.terms, content.structure
    count, own = sum(label.startswith("markov") for label in chosen), structure.of_kind(MARKOV)
    if selection.discrepancy > 0.0 or count == len(own):
        return structure
    structure = structure.without(*own, *map(structure.place, range(len(FIXED))))
    for k, label in enumerate(FIXED):
        structure = structure.with_column(k, 0.0) if label in chosen else structure
    spectrum = Record(content.rest**2, content.spectrum.bins.rate).binned(structure)
    for _ in range(count):
        structure = min(search.with_process(spectrum, structure), key=lambda fit: fit.loss).structure
    # What follows the response is as the search found it.
    processes = [structure.components[k] for k in structure.of_kind(MARKOV)]
    return content.structure.without(*own).plus(*processes)


def _template(content: Content, selection: AxisSelection) -> tuple[Model, InUse]:
    """Model of the content with the chosen terms, and the terms in use; the others get a limit."""
    structure, rate, chosen = content.structure, content.spectrum.bins.rate, selection.chosen.terms
    after = structure.kind != NONE and not structure.column(QUANTIZATION).inside
    terms: list[tuple[NoiseTerm, bool, bool]] = []
    for label, term in zip(basic_terms().term_labels, basic_terms().terms, strict=True):
        k = FIXED.index(label) if label in FIXED else None
        # The search has chosen what follows the response.
        here = structure.place(k) is not None if k == QUANTIZATION and after else label in chosen
        terms.append((term, k is not None and structure.column(k).inside, here))
    components = structure.of_kind(MARKOV) + structure.oscillators
    for k in components:
        term, passes = term_of(structure, k, rate), structure.components[k].inside
        # A spectrum hardly tells how narrow a resonance is at any moment from how far it moves.
        moves = isinstance(term, WanderingResonance)
        terms.append((term.hold("quality_factor") if moves else term, passes, True))
    if structure.place(OUTSIDE) is not None:
        terms.append((PowerLaw(exponent=0.0).hold("exponent"), False, True))
    terms += [(Sinusoid(frequency=line.frequency), False, True) for line in content.lines]
    each, inside, active = zip(*terms, strict=True)
    response = response_of(structure, rate)
    return Model(each, response, () if response is None else inside), np.array(active)


def _detected(
    content: Content, template: Model, active: InUse, axis: Axis, x: Samples
) -> tuple[Model, AxisFit]:
    """Model without what its fit does not detect, and its fit."""
    rate, c, lines, n = content.spectrum.bins.rate, content.c, content.lines, len(x)
    last: tuple[Model, AxisFit] | None = None
    for _ in range(_ROUNDS):
        if len(wanted := lines_of(template)[1]) != len(lines):
            c, lines = take_out_lines(x, rate, wanted)
        peaks = [term for term in template.terms if isinstance(term, Resonance)]
        around = [(peak.frequency, peak.quality) for peak in map(peak_of, peaks)]
        spectrum = AxisSpectrum.in_bins(template, search.bins_around(around, n, rate), c, lines)
        result = fit_spectrum(template, axis, spectrum, active, at_low=True)
        if last is not None and not result.discrepancy <= _WORSE * last[1].discrepancy + _SLIGHT:
            # What was taken out was needed, though its size is not known.
            break
        last = template, result
        template, active = _tidied(template, active, result, rate / (2.0 * n))
        if template is last[0]:
            break
    assert last is not None
    return last


def _tidied(template: Model, active: InUse, result: AxisFit, spacing: float) -> tuple[Model, InUse]:
    """Model without resonances and lines that its fit does not detect, if there are any.

    A resonance that has become as narrow as a line becomes a line. Coefficients have a `spacing` [Hz].
    """
    if not result.converged:
        return template, active
    model, peaks, lines = _with_values(template, result), dict[str, Component](), list[float]()
    every = dict(zip(model.term_labels, model.terms, strict=True))
    for label, term in every.items():
        if isinstance(term, Resonance):
            peaks[label] = peak_of(term)
        elif isinstance(term, Sinusoid):
            lines.append(float(term.frequency or 0.0))
    # Too narrow a resonance spoils its neighbours; these are judged once it is a line.
    gone = sharp = [label for label, peak in peaks.items() if peak.width < LINE * spacing]
    if not sharp:
        further = [k for k, term in every.items() if isinstance(term, (PowerLaw, Resonance, Sinusoid))]
        unseen = [c for c in result.coefficients.values() if c.is_amplitude and not c.detected]
        gone = []
        # Overlapping resonances may be detected only together, not singly: the weakest goes first.
        for c in sorted((c for c in unseen if c.term in further), key=lambda c: c.value):
            beside = [peaks[k] for k in gone if {k, c.term} <= peaks.keys()]
            if not any(peaks[c.term].is_close_to(other) for other in beside):
                gone.append(c.term)
    if not gone:
        return template, active
    active = active[[label not in gone for label in every]]
    model = model.without(gone)
    for frequency in (peaks[k].frequency for k in sharp):
        if all(abs(frequency - line) > _APART * spacing for line in lines):
            lines.append(frequency)
            model, active = model + Sinusoid(frequency=frequency), np.append(active, True)
    return model, active


def _with_values(template: Model, result: AxisFit) -> Model:
    """The template with the values of its fit, in which white noise excludes what wide resonances have."""
    values = {label: c.value for label, c in result.coefficients.items() if np.isfinite(c.value)}
    own = result.model.values
    values["angle_random_walk"] = float(own.get("angle_random_walk") or 0.0)
    return template.with_values(**values)
