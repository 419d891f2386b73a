"""Greedy search for causes: the one with the largest evidence first, until none is significant."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float

from allanjax.base.wording import plain
from allanjax.critic.cause import Cause
from allanjax.critic.causes.spectral_shape import SpectralShape
from allanjax.critic.finding import cause_title
from allanjax.critic.noise import RAMP, coefficient_folds, family_of
from allanjax.critic.parameters import Detail
from allanjax.critic.policy import AcceptanceRule
from allanjax.critic.shape import LOW_PASS, Shape, finished
from allanjax.critic.step import Step, refitted, replay
from allanjax.critic.view import EVERYTHING, Candidate, View
from allanjax.estimate.deterministic import lines_of, take_out_lines, without_lines
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model
from allanjax.noise.terms import DriftRamp
from allanjax.record.completion import in_time
from allanjax.record.recording import Axis

# Rivals with higher odds against them are not reported: a judgement.
_ODDS = 1000.0
# Most findings in an axis: a judgement.
_MOST = 8
# p-value below which a rejected candidate is reported as undecided: a judgement.
_CERTAIN = 1e-6
# No further cause is tried once a candidate has gained this much [nats], and so many times the gain that any
# other cause offered in the round before: judgements.
_EARLY_STOP_NATS, _EARLY_STOP_RATIO = 30.0, 4.0
# Share of imputed samples above which no other cause is sought: a judgement.
_TOO_MANY = 0.5


@dataclasses.dataclass(frozen=True, eq=False)
class Draft:
    """Search in one axis that may be continued.

    Attributes:
        start, end: view of the axis without findings, and with all of them subtracted.
        steps: the findings in order.
        tests: `Cause.p_value` at the start, of those causes that have one.
        notes: notes for the user: causes about as probable as noise terms, or an early end of the search.
        preprocessed: whether a finding concerns the samples themselves, such as rounding.
        is_anew: whether findings were refitted, so that the views of the steps are outdated.
    """

    start: View
    steps: tuple[Step, ...]
    end: View
    tests: Mapping[str, float]
    notes: tuple[str, ...] = ()
    preprocessed: bool = False
    is_anew: bool = False


@dataclasses.dataclass(frozen=True, eq=False)
class Search(Draft):
    """Result of the search in one axis.

    Attributes:
        noise_model: random terms of the extended model, if there is a filter or a resonance among them.
        others: terms of the baseline other than basic ones, if any.
    """

    noise_model: Model | None = None
    others: Model | None = None


def search(
    view: View, causes: Sequence[Cause], false_alarms: float, progress: Callable[[str], None]
) -> Draft:
    """Search for causes in one axis; `progress` is called with a text that describes the step."""
    accepted = AcceptanceRule.of(false_alarms, causes)
    start, steps = view, []
    for cause in (c for c in causes if c.is_preprocessing):
        candidate = cause.detect(view)
        if (
            candidate is not None
            and accepted.accepts(candidate)
            # Gains that cannot be held out are nan.
            and not (gain := candidate.held_out()) <= 0.0
        ):
            steps.append(Step.of(candidate, gain, (), view))
            view = candidate.after
    tests = {c.name: p for c in _others(view, causes) if (p := c.p_value(view)) is not None}
    return going_on(Draft(start, tuple(steps), view, tests, (), bool(steps)), causes, false_alarms, progress)


def going_on(
    draft: Draft, causes: Sequence[Cause], false_alarms: float, progress: Callable[[str], None]
) -> Draft:
    """Continued search, with causes that have not been tried yet."""
    accepted, steps, view = AcceptanceRule.of(false_alarms, causes), list(draft.steps), draft.end
    others, notes = _others(view, causes), draft.notes
    # Gains that causes offered last, of those that may not have to be tried again.
    offered: dict[Cause, float] = {}
    # Findings that are dropped again count too.
    rounds, anew = 0, draft.is_anew
    while len(steps) < _MOST and rounds < 2 * _MOST:
        rounds += 1
        candidates, left = _candidates(view, others, offered, progress)
        step = _chosen(candidates, view, accepted)
        if step is None and left:
            more, left = _candidates(view, left, {}, progress)
            candidates += more
            step = _chosen(candidates, view, accepted)
        if step is None:
            texts = (_undecided(candidate, view) for _, candidate in candidates)
            notes += tuple(text for text in texts if text)
            break
        for part in step.candidate.parts or (step.candidate,):
            gain = part.held_out() if step.candidate.parts else step.gain
            steps.append(Step.of(part, gain, step.rivals, view))
            # Candidates accepted together were built independently: the list of findings is extended here.
            view = part.after.with_findings(*view.found, part.cause)
        known = steps
        steps, view = refitted(known, view, others)
        anew |= [s.candidate for s in steps] != [s.candidate for s in known]
        # A waveform may have hidden any effect, others hardly; in the end all causes are tried again.
        if len(steps) < len(known) or step.candidate.has_waveform:
            offered = {}
        else:
            found = dict(candidates)
            nothing = {cause: 0.0 for cause in others if cause not in left and cause not in found}
            waveforms = {cause: float(c.gain) for cause, c in candidates if c.domain == "time"}
            offered = {cause: offered[cause] for cause in left} | nothing | waveforms
    else:
        notes += (f"{view.axis.name}: the search stopped at {len(steps)} findings; there may be more",)
    # It may have to wait for the searches in other axes.
    view.forget()
    notes = tuple(dict.fromkeys(notes))
    return dataclasses.replace(draft, steps=tuple(steps), end=view, notes=notes, is_anew=anew)


def _others(view: View, causes: Sequence[Cause]) -> list[Cause]:
    """Causes that are not visible directly in the samples; none in a record that is mostly imputed."""
    return [c for c in causes if not c.is_preprocessing and np.mean(view.imputed) < _TOO_MANY]


def concluded(draft: Draft, causes: Sequence[Cause]) -> Search:
    """Finished search: everything is refitted, and the filter and the resonances are described."""
    start, known, anew = draft.start, list(draft.steps), draft.is_anew
    steps, view = refitted(known, draft.end, _others(draft.end, causes), last=True)
    shape = finished(view, coefficient_folds(view.n))
    if shape is not None:
        steps = _with_shape(steps, shape)
        anew = True
    elif any(s.candidate.cause == SpectralShape.name for s in steps):
        steps = [s for s in steps if s.candidate.cause != SpectralShape.name]
        view, anew = view.with_structure(None), True
    if anew or [s.candidate for s in steps] != [s.candidate for s in known]:
        steps = replay(start, steps)
        view = steps[-1].candidate.after if steps else start
    return Search(
        start.without_caches(),
        tuple(grouped(steps)),
        view.without_caches(),
        draft.tests,
        draft.notes,
        draft.preprocessed,
        anew,
        shape and shape.model,
    )


def _with_shape(steps: Sequence[Step], shape: Shape) -> list[Step]:
    """Steps in which the filter and the resonances represent the structure of the spectrum."""
    (first,) = [s for s in steps if s.candidate.cause == SpectralShape.name][:1]
    parts = []
    for part in shape.parts:
        candidate = Candidate(
            part.cause,
            part.estimates,
            part.gain,
            part.p_value,
            (first.candidate.after if part.cause == LOW_PASS else first.before).with_structure(
                part.structure
            ),
            lambda: 0.0,
            part.support,
            "frequency",
            details=part.details,
        )
        parts.append(Step(candidate, part.held_out, (), first.before))
    place = steps.index(first)
    others = [s for s in steps if s.candidate.cause != SpectralShape.name]
    return [*others[:place], *parts, *others[place:]]


def _candidates(
    view: View, causes: Sequence[Cause], offered: Mapping[Cause, float], progress: Callable[[str], None]
) -> tuple[list[tuple[Cause, Candidate]], list[Cause]]:
    """Candidates of the causes in this view, and the causes not tried because they had offered far less."""
    left = sorted(causes, key=lambda cause: -offered.get(cause, np.inf))
    candidates: list[tuple[Cause, Candidate]] = []
    most = 0.0
    while left and most < max(_EARLY_STOP_NATS, _EARLY_STOP_RATIO * offered.get(left[0], np.inf)):
        cause = left.pop(0)
        progress(f"{view.axis.name}: looking for {cause_title(cause.name, view.axis.sensor)}")
        if (candidate := cause.detect(view)) is not None and candidate.gain > 0.0:
            for part in (candidate, *candidate.parts):
                part.after.forget()
            candidates.append((cause, candidate))
            most = max(most, float(candidate.gain))
    return candidates, left


def _undecided(candidate: Candidate, view: View) -> str:
    """Note on a candidate that is about as probable as basic terms, if chance is unlikely."""
    sensor = view.axis.sensor
    instead = [cause_title(t, sensor) for t in view.noise.terms if t not in candidate.after.noise.terms]
    if candidate.chance > _CERTAIN or not instead:
        return ""
    name, odds = cause_title(candidate.cause, sensor), np.exp(candidate.gain)
    return f"{view.axis.name}: {' and '.join(instead)} may actually be {name} (odds {plain(odds, 2)} : 1)"


def _chosen(
    candidates: Sequence[tuple[Cause, Candidate]], view: View, accepted: AcceptanceRule
) -> Step | None:
    """Candidate with the largest gain that is significant and has a gain on held-out data."""
    by_gain = sorted(candidates, key=lambda pair: -pair[1].gain)
    ranked = [candidate for _, candidate in by_gain]
    for _, candidate in by_gain:
        if not accepted.accepts(candidate):
            continue
        gain = candidate.held_out()
        if not gain > 0.0:
            continue
        # Those before it in the ranking have been rejected.
        behind = ranked[ranked.index(candidate) + 1 :]
        rivals = [(other.cause, candidate.gain - other.gain) for other in behind]
        # Basic terms that the finding replaces had explained it so far.
        rivals += [(t, candidate.gain) for t in view.noise.terms if t not in candidate.after.noise.terms]
        odds = ((name, float(np.exp(nats))) for name, nats in rivals if nats < np.log(_ODDS))
        return Step(candidate, gain, tuple(odds), view)
    return None


def view_of(
    axis: Axis,
    scale: float,
    x: Float[np.ndarray, " n"],
    rate: float,
    auxiliary: Mapping[str, Float[np.ndarray, " n"]],
    baseline: tuple[Model, Model] | None,
    drawn: Bool[np.ndarray, " n"] | None = None,
) -> View:
    """First view of an axis; terms of the baseline other than basic ones are subtracted or in the factor.

    The baseline is a fitted model and the template of its terms; None: all basic terms are allowed. Samples
    that were missing are `drawn`.
    """
    n = len(x)
    drawn = np.zeros(n, bool) if drawn is None else drawn
    family = family_of(n, rate)
    if baseline is None:
        return View(axis, scale, rate, x, x, None, auxiliary, EVERYTHING, family, drawn, drawn=drawn)
    model, template = baseline
    allowed = tuple(name for name in template.term_labels if name in EVERYTHING)
    basic = [name for name in model.term_labels if name in EVERYTHING]
    others = further_terms(model)
    y, density = x, np.zeros(n - 1)
    for term in others.terms:
        if not term.deterministic:
            density += family.spectrum(term.sampled(rate))
    if any(term.deterministic for term in others.terms):
        y = _without_deterministic(others, x, rate)
    factor = None
    if density.any():
        noise = np.zeros(n - 1)
        for name in basic:
            if name != RAMP:
                noise += family.spectrum(model[name].sampled(rate))
        factor = 1.0 + density / np.maximum(noise, 1e-12 * density)
    # A baseline without basic noise still needs some to be compared with.
    if not set(allowed) - {RAMP}:
        allowed = ("angle_random_walk", *allowed)
    return View(axis, scale, rate, x, y, factor, auxiliary, allowed, family, drawn, drawn=drawn)


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
    """Model of an axis with all findings, and the causes that no model term can describe."""
    model, left_out = basic_model(search.end, search.noise_model), []
    for step in search.steps:
        before, model = model, step.candidate.add_to_model(model)
        if model is before and step.candidate.domain == "time" and step.change.path is not None:
            left_out.append(step.candidate.cause)
    return (model if search.others is None else model + search.others), tuple(dict.fromkeys(left_out))


def grouped(steps: Sequence[Step]) -> list[Step]:
    """Steps in which the harmonics of a fundamental are one finding, and all outliers are one."""
    left, grouped = list(steps), []
    while left:
        first, others = left[0], []
        if first.candidate.cause == "sinusoid":
            family = [s for s in left if s is first or _harmonic(first, s)]
            first = min(family, key=lambda s: s.candidate.parameters["frequency"].value)
            others = [s for s in left if s is not first and _harmonic(first, s)]
            grouped.append(_with_harmonics(first, others) if others else first)
        elif first.candidate.cause == "outliers":
            others = [s for s in left[1:] if s.candidate.cause == "outliers"]
            grouped.append(_with_outliers(first, others) if others else first)
        else:
            grouped.append(first)
        left = [s for s in left if s is not first and s not in others]
    return grouped


def _harmonic(one: Step, other: Step) -> bool:
    """Whether two steps are lines, the higher frequency being a small multiple of the lower one."""
    if one is other or {one.candidate.cause, other.candidate.cause} != {"sinusoid"}:
        return False
    both = (s.candidate.parameters["frequency"] for s in (one, other))
    low, high = sorted(both, key=lambda frequency: frequency.value)
    order = np.rint(high.value / low.value)
    error = 4.0 * np.hypot(high.std, order * low.std)
    return bool(2 <= order <= 20 and abs(high.value - order * low.value) < error)


def _with_harmonics(step: Step, others: Sequence[Step]) -> Step:
    """Fundamental and harmonics as one finding."""
    found = [s.candidate.parameters for s in others]
    view, fundamental = step.before, step.candidate.parameters["frequency"].value
    orders = (np.rint(one["frequency"].value / fundamental) for one in found)
    details: dict[str, Detail] = {
        "harmonics": tuple(view.estimate("harmonic", order, 0.0, "1") for order in orders),
        "harmonic_amplitudes": tuple(one["amplitude"] for one in found),
    }
    return _together(step, others, step.candidate.estimates, details)


def _with_outliers(step: Step, others: Sequence[Step]) -> Step:
    """Outliers that were found one after the other as one finding."""
    each = [s.candidate.details for s in (step, *others)]
    found = [
        (time, size)
        for own in each
        for time, size in zip(own["times"], own["sizes"], strict=True)
        if isinstance(time, Estimate) and isinstance(size, Estimate)
    ]
    times, sizes = zip(*sorted(found, key=lambda pair: pair[0].value), strict=True)
    count, *rest = step.candidate.estimates
    count = step.before.estimate("count", len(times), count.std, "1")
    return _together(step, others, [count, *rest], {"times": times, "sizes": sizes})


def _together(
    step: Step, others: Sequence[Step], estimates: Sequence[Estimate], details: Mapping[str, Detail]
) -> Step:
    """Several steps as one, with these parameters and details."""

    def add_to_model(model: Model) -> Model:
        for s in (step, *others):
            model = s.candidate.add_to_model(model)
        return model

    candidate = dataclasses.replace(
        step.candidate,
        estimates=estimates,
        details=details,
        gain=step.candidate.gain + sum(s.candidate.gain for s in others),
        add_to_model=add_to_model,
    )
    return dataclasses.replace(step, candidate=candidate, gain=step.gain + sum(s.gain for s in others))
