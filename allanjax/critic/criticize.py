"""A critique: fit, compare with simulations, find effects, extend, compare again."""

from __future__ import annotations

import dataclasses
import traceback
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import Float

from allanjax.base.cache import release_memory
from allanjax.base.errors import AllanjaxError, FitError
from allanjax.base.wording import duration, finite_or_none, plain
from allanjax.critic.change import change_of, without
from allanjax.critic.common_mode import NAME, common_mode
from allanjax.critic.comparison import CERTAIN, Comparison, compared, reported
from allanjax.critic.effect import EVERYTHING, Effect, View, elsewhere, places_in
from allanjax.critic.finding import Finding
from allanjax.critic.noise import RAMP, family_of
from allanjax.critic.policy import judged
from allanjax.critic.result import AxisCritique, Critique
from allanjax.critic.search import AcceptanceRule, Search, concluded, going_on, search
from allanjax.critic.stage import Stage
from allanjax.estimate.deterministic import lines_of, take_out_lines, without_lines
from allanjax.estimate.fit import fit_inspected
from allanjax.estimate.result import Fit
from allanjax.estimate.spectral.as_model import shape_of
from allanjax.inspection import Inspection, inspect
from allanjax.inspection.facts import NOT_A_MEASUREMENT, Fact
from allanjax.noise.model import Model
from allanjax.noise.terms import DriftRamp
from allanjax.record.completion import in_time
from allanjax.record.held import between_changes
from allanjax.record.recording import Axis, DeadAxis, Recording
from allanjax.spectrum.cosine import fast_length

_T = TypeVar("_T")

_SHORTEST = int(judged("search", "shortest"))
# Number of axes processed at a time: each takes some twenty times the memory of its samples.
_WORKERS = 2


def criticize(
    recording: Recording,
    given: Fit | None,
    effects: Sequence[Effect],
    false_alarms: float,
    vibrating: bool,
    tell: Callable[[str], None],
) -> Critique:
    """Critique of a recording; the arguments are those of `critique`."""
    recording, seen = _undisturbed(recording, vibrating)
    _check(recording, given, false_alarms)
    per_axis = false_alarms / len(recording.axes)

    failed: dict[str, DeadAxis] = {}
    searched, fit = _searches(recording, seen, given, effects, per_axis, tell, failed)
    recording = _left(recording, failed)
    searches, stages = zip(*searched, strict=True)
    events = {effect.name for effect in effects if effect.is_event}

    # Axes are compared with others at the first and the last stage.
    first, last = ([of_axis[stage] for of_axis in stages] for stage in (0, -1))
    shared = tuple(common_mode(last, AcceptanceRule(per_axis).level(NAME)))

    def told(k: int) -> AxisCritique:
        """Critique of an axis."""
        s, axis = searches[k], searches[k].start.axis
        result = fit[axis.name]
        raw = s.start.recorded(s.start.raw)
        others = [{w.axis.name: w for w in every if w is not every[k]} for every in (first, last)]
        seen = raw, s.end.recorded(s.end.samples) if s.preprocessed else raw
        tell(f"{axis.name}: comparing the measurement with simulations")
        own = stages[k]
        made = compared((own[0], own[-1])[: len(own)], seen, (others[0], others[1]), recording.auxiliary)
        # Other channels have a cause in common, or imputed samples were drawn by a simple rule.
        ignored = ["channels"] * any(axis.name in f.axes for f in shared) + ["values"] * s.preprocessed
        reasons = [step.candidate.doubt for step in s.steps]
        findings = tuple(reported(_findings(s, own, made, events), reasons, own[0], made, ignored))
        # The fit may have failed because of an effect.
        baseline = result.model if result.converged else basic_model(s.start)
        model, left_out = extended(s)
        if given is not None and not given.chosen and (further := further_terms(given[axis.name].model)):
            model = model + further
        # Copies, as other axes still need what these have computed.
        copies = tuple(map(dataclasses.replace, own))
        of_given = None if s.start.samples is s.start.raw else s.start.raw - s.start.samples
        ends = findings, made.before, made.after, s.tests, copies, baseline, model
        return AxisCritique(axis, *ends, result.misfit, left_out, of_given)

    with ThreadPoolExecutor(_WORKERS) as pool:
        found = tuple(pool.map(_guarded(told, recording.axes, failed), range(len(searches))))
    _left(recording, failed)
    axes, dead = tuple(a for a in found if a is not None), (*recording.dead, *failed.values())
    notes = _notes(recording, fit, searches)
    return Critique(recording.name, recording.rate, fit, axes, shared, notes, dead)


def _notes(recording: Recording, fit: Fit, searches: Sequence[Search]) -> tuple[str, ...]:
    """Notes of the fit, and those on the search."""
    notes = [*fit.notes]
    if recording.others:
        notes.append(
            f"effects are searched for in the longest segment, {duration(recording.duration)}; the fit from "
            "which the critique starts uses all segments"
        )
    notes += [
        f"{r.axis.name}: the fit failed ({r.reason}); critique starts from the most probable terms instead"
        for r in fit.results
        if not r.converged
    ]
    return (*notes, *(note for s in searches for note in s.notes))


def _guarded(
    work: Callable[[int], _T], axes: Sequence[Axis], failed: dict[str, DeadAxis]
) -> Callable[[int], _T | None]:
    """The work on an axis by its number; if it fails, None and a reason in `failed`."""

    def attempt(k: int) -> _T | None:
        if axes[k].name in failed:
            return None
        release_memory()
        try:
            return work(k)
        except (MemoryError, OSError):
            raise
        except AllanjaxError as error:
            reason = str(error)
        except Exception as error:
            *_, (frame, line) = traceback.walk_tb(error.__traceback__)
            place = f"{Path(frame.f_code.co_filename).name}:{line}"
            reason = (
                f"its critique failed because of a bug in allanjax: {type(error).__name__} in {place} "
                f"({error}); please report it with the recording"
            )
        failed[axes[k].name] = DeadAxis(axes[k], reason)
        return None

    return attempt


def _left(recording: Recording, failed: Mapping[str, DeadAxis]) -> Recording:
    """The recording without axes whose critique failed; FitError if no axis is left."""
    left = [name for name in recording.names if name not in failed]
    if not left:
        reasons = "; ".join(f"{name}: {failed[name].reason}" for name in recording.names)
        raise FitError(f"{recording.name or 'the recording'}: {reasons}")
    return dataclasses.replace(recording.select(*left), dead=recording.dead)


def _undisturbed(recording: Recording, vibrating: bool) -> tuple[Recording, Inspection]:
    """The recording without disturbances at its ends (findings are in between), and the facts about it."""
    seen = inspect(recording, vibrating=vibrating, may_move=True)
    facts = [fact for fact in seen.facts if fact.kind not in ("disturbances", "spikes")]
    whole = 0.0, recording.duration
    start, stop = (seen.parts[0][0], seen.parts[-1][1]) if seen.parts else whole
    if (start, stop) != whole:
        means = f"the critique uses only {plain(start)} to {plain(stop)} s"
        facts.append(
            Fact("disturbances", seen.left_out, recording.names, spans=((start, stop),), meaning=means)
        )
    elif seen.refusal:
        means = "the critique uses all samples, because too few would remain"
        refused = Fact("disturbances", seen.left_out, recording.names, NOT_A_MEASUREMENT, meaning=means)
        facts.insert(0, refused)
    first, last = round(start * recording.rate), round(stop * recording.rate)
    fast = fast_length(last - first)
    if fast < recording.n:
        # Up to but not including the sample with this number.
        cut = recording.between(start, (first + fast - 0.5) / recording.rate)
        others = recording.select(*cut.names).others
        recording = dataclasses.replace(cut, others=others, places=(), notes=recording.notes)
    return recording, dataclasses.replace(seen, facts=tuple(facts), parts=(), lost={}, refusal="")


def _searches(
    recording: Recording,
    seen: Inspection,
    given: Fit | None,
    effects: Sequence[Effect],
    false_alarms: float,
    tell: Callable[[str], None],
    failed: dict[str, DeadAxis],
) -> tuple[list[tuple[Search, tuple[Stage, ...]]], Fit]:
    """Searches and stages of all axes except those that `failed`; the fit from which the critique starts."""

    rule = AcceptanceRule(false_alarms, effects)
    fit = _baseline(recording, seen, tell) if given is None else given

    def searched(k: int) -> Search:
        """Search in one axis, starting from its fit."""
        found = fit.results[k]
        baseline = None if fit.chosen else (found.model, fit.template)
        view = _first_view(recording, k, baseline)
        # A structure that is off somewhere would be inherited.
        if found.fits and found.own_template is not None:
            view = dataclasses.replace(view, fitted=shape_of(found.model, recording.rate))
        return search(view, rule, tell)

    def concluding(k: int) -> tuple[Search, tuple[Stage, ...]]:
        """Search in an axis, also at the places of findings in other axes, and its stages."""
        others = elsewhere(places[k], [place for i, own in places.items() if i != k for place in own])
        there = [
            effect.at(own)
            for effect in effects
            if (own := [place for place in others if place.effect == effect.name])
        ]
        state = going_on(states[k], there, rule, tell) if there else states[k]
        found = concluded(state, effects)
        stages = _stages(found)
        for stage in (stages[0], stages[-1]):
            # Other axes are compared with it.
            _ = stage.whitened_coefficients
            stage.forget(keep_transform=True)
        return found, stages

    # Transforms and compiled functions, which do most of the work, run in parallel.
    with ThreadPoolExecutor(_WORKERS) as pool:
        found = pool.map(_guarded(searched, recording.axes, failed), range(len(recording.axes)))
        states = {k: state for k, state in enumerate(found) if state is not None}
        places = {k: places_in(state.end, (s.candidate for s in state.steps)) for k, state in states.items()}
        searches = list(pool.map(_guarded(concluding, recording.axes, failed), range(len(recording.axes))))
    # What a user would simulate is the plain model.
    return [s for s in searches if s is not None], fit.without_extensions()


def _check(recording: Recording, given: Fit | None, false_alarms: float) -> None:
    """Raise AllanjaxError or FitError if a critique is not possible."""
    label = recording.name or "the recording"
    if not 0.0 < false_alarms < 1.0:
        raise AllanjaxError(f"false_alarms must be between 0 and 1, not {false_alarms}")
    if recording.n < _SHORTEST:
        raise FitError(
            f"{label}: {recording.n} samples are too few for a critique; record at least {_SHORTEST} samples"
        )
    if given is not None and given.axes != recording.names:
        raise AllanjaxError(
            f"the fit has axes {', '.join(given.axes)}, the recording {', '.join(recording.names)}; "
            "leave out fit"
        )
    if given is not None and given.template.response is not None:
        raise FitError(
            f"{label}: critique does not support models with a response ({given.template.response!r}); "
            "leave out fit, and critique searches for a filter itself"
        )
    for result in given.results if given else ():
        if not result.converged:
            raise FitError(f"{label}: the fit of {result.axis.name} failed: {result.reason}")


def _baseline(recording: Recording, seen: Inspection, tell: Callable[[str], None]) -> Fit:
    """Fit with filters and resonances; of the plain terms by the spectrum if that does not converge."""
    tell("fitting the noise model")
    # Events in the recording are the subject of the search.
    fit = fit_inspected(recording, seen, None, "allan", as_is=True)
    if all(result.converged for result in fit.results):
        return fit
    # If an effect dwarfs the noise, the fit of Allan variances may fail; that of the spectrum is robust.
    return fit_inspected(recording, seen, None, "whittle", plain=True, as_is=True)


def _stages(s: Search) -> tuple[Stage, ...]:
    """The axis without any finding, without each of them, and with all; only the first if there is none."""
    first = _stage(s.start)
    if not s.steps:
        return (first,)
    last = _stage(s.end)
    return (first, *(without(step, last) for step in s.steps), last)


def _stage(view: View) -> Stage:
    """The axis as a view has it."""
    noise, slope = view.noise, view.slope
    view.forget()
    own = noise.power, noise.index, slope if np.isfinite(slope) else 0.0
    return Stage(view.axis, view.samples, view.rate, *own, view.factor, view.imputed)


def _findings(s: Search, stages: Sequence[Stage], made: Comparison, events: Collection[str]) -> list[Finding]:
    """Findings of an axis, with what each alone changes; `events` are the causes that happen in a record."""
    findings = []
    for k, step in enumerate(s.steps, 1):
        candidate, view = step.candidate, step.before
        start, end = candidate.support
        span = float(start), float(end if np.isfinite(end) else view.duration)
        # An effect on the entire record has no place of its own.
        rest = None if span == (0.0, view.duration) else made.rest(span, candidate.domain)
        found = Finding(
            cause=candidate.cause,
            axes=(view.axis.name,),
            parameters=candidate.parameters,
            p_value=candidate.p_value,
            evidence=finite_or_none(candidate.gain),
            gain=finite_or_none(step.gain),
            rivals=step.rivals,
            span=span,
            domain=candidate.domain,
            is_event=candidate.cause in events,
            change=change_of(stages[-1], stages[k], candidate.has_waveform),
            details=candidate.details,
            rest=rest if rest and rest.p_value < CERTAIN else None,
            stage=k,
        )
        stages[k].forget()
        findings.append(found)
    return findings


def _first_view(recording: Recording, k: int, baseline: tuple[Model, Model] | None) -> View:
    """First view of an axis; terms of the baseline other than basic ones are subtracted or in the factor.

    The baseline is a fitted model and the template of its terms; None: all basic terms are allowed.
    """
    x, rate, missing = recording.values[:, k], recording.rate, recording.missing
    drawn = np.zeros(len(x), bool) if missing is None else missing[:, k]
    allowed: tuple[str, ...] = EVERYTHING
    factor, y = None, x
    if baseline is not None:
        model, template = baseline
        allowed = tuple(name for name in template.term_labels if name in EVERYTHING)
        # A baseline without basic noise still needs some to be compared with.
        if not set(allowed) - {RAMP}:
            allowed = ("angle_random_walk", *allowed)
        others, family = further_terms(model), family_of(len(x), rate)
        basic = [name for name in model.term_labels if name in EVERYTHING and name != RAMP]
        noise, density = (
            sum((family.spectrum(term.sampled(rate)) for term in some), np.zeros(len(x) - 1))
            for some in (map(model.__getitem__, basic), (t for t in others.terms if not t.deterministic))
        )
        factor = 1.0 + density / np.maximum(noise, 1e-12 * density) if density.any() else None
        if any(term.deterministic for term in others.terms):
            y = _without_deterministic(others, x, rate)
    axis, scale = recording.axes[k], float(recording.own_scales[k])
    channels = {name: between_changes(np.asarray(z, float)) for name, z in recording.auxiliary.items()}
    return View(axis, scale, rate, x, y, factor, channels, allowed, drawn, drawn)


def further_terms(model: Model) -> Model:
    """Model without its basic terms."""
    return model.without([name for name in model.term_labels if name in EVERYTHING])


def _without_deterministic(model: Model, x: Float[np.ndarray, " n"], rate: float) -> Float[np.ndarray, " n"]:
    """Record from which a baseline's lines and transients are subtracted, by least squares."""
    lines, wanted = lines_of(model)
    y = x - x.mean()
    t = (np.arange(len(x)) + 0.5) / rate
    columns = [
        np.asarray(term.column(t))
        for k, term in enumerate(model.terms)
        if term.deterministic and k not in lines
    ]
    if columns:
        D = np.column_stack(columns)
        D = D - D.mean(axis=0)
        y = y - D @ np.linalg.lstsq(D, y, rcond=None)[0]
    if lines:
        y = in_time(without_lines(*take_out_lines(y, rate, wanted), rate))
    return y + x.mean()


def basic_model(view: View, random: Model | None = None) -> Model:
    """Model of a view's basic terms with their values, or with these in place of the random ones."""
    model = random or view.noise.model()
    if not view.noise.ramp:
        return model
    return model + DriftRamp(abs(view.slope), sign=int(np.copysign(1.0, view.slope)))


def extended(search: Search) -> tuple[Model, tuple[str, ...]]:
    """Model of an axis with all findings, and the effects that no model term can describe."""
    model, left_out = basic_model(search.end, search.noise_model), []
    for step in search.steps:
        before, model = model, step.candidate.add_to_model(model)
        if model is before and step.candidate.domain == "time" and step.path is not None:
            left_out.append(step.candidate.cause)
    return model, tuple(dict.fromkeys(left_out))
