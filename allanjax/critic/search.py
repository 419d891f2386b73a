"""Look for causes one after the other, the most telling first, until nothing is left."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from allanjax.critic.noise import RAMP, family_of
from allanjax.critic.refit import refitted
from allanjax.critic.step import Step, replay
from allanjax.critic.view import EVERYTHING, FALSE_ALARMS, Candidate, Cause, Quantity, View, in_time
from allanjax.estimate.deterministic import line_columns, lines_of, take_out_lines
from allanjax.noise.model import Model
from allanjax.noise.terms import DriftRamp
from allanjax.record.recording import Axis

# Rivals with longer odds against them than this are not worth a word.
_ODDS = 1000.0
_MOST = 8
_CERTAIN = 1e-6
# What gains so much [nats], and so many times what a cause offered before the last finding in the spectrum,
# is before it whatever has become of that.
_EARLY_STOP_NATS, _EARLY_STOP_RATIO = 30.0, 4.0
_TOO_MANY = 0.5


@dataclasses.dataclass(frozen=True, eq=False)
class Search:
    """All that was found in one axis.

    Attributes:
        start: the axis as it came.
        steps: the findings in their order.
        end: the axis with all findings taken out.
        tests: `Cause.p_value` of those causes that have one, in the axis as it came.
        notes: for people: causes that explain about as much as noise does; that the search ended early.
        restored: whether a finding says that the samples are not what the sensor gave.
    """

    start: View
    steps: tuple[Step, ...]
    end: View
    tests: Mapping[str, float]
    notes: tuple[str, ...] = ()
    restored: bool = False


class AcceptanceRule(NamedTuple):
    """False findings that are accepted in one axis.

    Attributes:
        share: probability of one, for each kind of cause.
        ratio: of all of them to those that margins and levels are for.
    """

    share: float
    ratio: float

    @classmethod
    def of(cls, false_alarms: float, causes: Sequence[Cause]) -> AcceptanceRule:
        """One share for each kind of cause, and one for what axes have in common."""
        kinds = len({type(cause) for cause in causes}) + 1
        return cls(false_alarms / kinds, false_alarms / FALSE_ALARMS)

    def accepts(self, candidate: Candidate, cause: Cause) -> bool:
        """Whether that is significant: with fewer accepted, the odds for it must be so much longer."""
        level = self.share if cause.max_p is None else cause.max_p * self.ratio
        return bool(candidate.gain >= cause.min_log_odds - np.log(self.ratio) and candidate.p_value < level)


def search(
    view: View, causes: Sequence[Cause], false_alarms: float, progress: Callable[[str], None]
) -> Search:
    """Find all causes in one axis.

    Args:
        view: the axis.
        causes: what to look for.
        false_alarms: probability of a false finding.
        progress: is told what is being done.
    """
    accepted = AcceptanceRule.of(false_alarms, causes)
    start, steps = view, []
    for cause in (c for c in causes if c.is_preprocessing):
        candidate = cause.detect(view)
        if (
            candidate is not None
            and candidate.p_value < accepted.share
            and (gain := candidate.held_out()) > 0.0
        ):
            steps.append(Step.of(candidate, gain, (), view))
            view = candidate.after
    restored = bool(steps)
    # Of a record that was mostly filled in nothing else is said.
    others = [c for c in causes if not c.is_preprocessing and np.mean(view.restored) < _TOO_MANY]
    tests = {c.name: p for c in others if (p := c.p_value(view)) is not None}
    notes: tuple[str, ...] = ()
    # What those that may not have to be asked again offered last.
    offered: dict[Cause, float] = {}
    # Those count too that are dropped again beside later ones.
    rounds, anew = 0, False
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
            notes = tuple(text for text in texts if text)
            break
        for part in step.candidate.parts or (step.candidate,):
            gain = part.held_out() if step.candidate.parts else step.gain
            steps.append(Step.of(part, gain, step.rivals, view))
            # Of two at once the second one does not know of the first.
            view = part.after.with_findings(*view.found, part.cause)
        known = steps
        steps, view = refitted(known, view, others)
        anew |= [s.candidate for s in steps] != [s.candidate for s in known]
        # What is in time may have hidden anything; what is in the spectrum hardly hides what is in time.
        if len(steps) < len(known) or step.candidate.domain == "time":
            offered = {}
        else:
            found = dict(candidates)
            nothing = {cause: 0.0 for cause in others if cause not in left and cause not in found}
            in_time = {cause: float(c.gain) for cause, c in candidates if c.domain == "time"}
            offered = {cause: offered[cause] for cause in left} | nothing | in_time
    else:
        notes = (f"{view.axis.name}: {len(steps)} findings are enough; there may be more",)
    known = steps
    steps, view = refitted(known, view, others, last=True)
    if anew or [s.candidate for s in steps] != [s.candidate for s in known]:
        steps = replay(start, steps)
    return Search(
        start.without_caches(), tuple(_grouped(steps)), view.without_caches(), tests, notes, restored
    )


def _candidates(
    view: View, causes: Sequence[Cause], offered: Mapping[Cause, float], progress: Callable[[str], None]
) -> tuple[list[tuple[Cause, Candidate]], list[Cause]]:
    """What the causes offer in this view; and those left that had offered far less than the best one does."""
    left = sorted(causes, key=lambda cause: -offered.get(cause, np.inf))
    candidates: list[tuple[Cause, Candidate]] = []
    most = 0.0
    while left and most < max(_EARLY_STOP_NATS, _EARLY_STOP_RATIO * offered.get(left[0], np.inf)):
        cause = left.pop(0)
        progress(f"{view.axis.name}: looking for {cause.name.replace('_', ' ')}")
        if (candidate := cause.detect(view)) is not None and candidate.gain > 0.0:
            candidates.append((cause, candidate))
            most = max(most, float(candidate.gain))
    return candidates, left


def _undecided(candidate: Candidate, view: View) -> str:
    """What could as well be there, if it is something that noise alone does not do."""
    instead = [t.replace("_", " ") for t in view.noise.terms if t not in candidate.after.noise.terms]
    if candidate.p_value > _CERTAIN or not instead:
        return ""
    name, odds = candidate.cause.replace("_", " "), np.exp(candidate.gain)
    return f"{view.axis.name}: {' and '.join(instead)} may be a {name} (odds {odds:.2g} to 1 for it)"


def _chosen(
    candidates: Sequence[tuple[Cause, Candidate]], view: View, accepted: AcceptanceRule
) -> Step | None:
    """The candidate that explains most, if it is significant and holds on data that it has not seen."""
    by_gain = sorted(candidates, key=lambda pair: -pair[1].gain)
    ranked = [candidate for _, candidate in by_gain]
    for cause, candidate in by_gain:
        if not accepted.accepts(candidate, cause):
            continue
        gain = candidate.held_out()
        if not gain > 0.0:
            continue
        # Those before it in the ranking have been rejected.
        behind = ranked[ranked.index(candidate) + 1 :]
        rivals = [(other.cause, candidate.gain - other.gain) for other in behind]
        # Basic terms that the finding replaces explained it so far.
        rivals += [(t, candidate.gain) for t in view.noise.terms if t not in candidate.after.noise.terms]
        odds = ((name, float(np.exp(nats))) for name, nats in rivals if nats < np.log(_ODDS))
        return Step(candidate, gain, tuple(odds), view)
    return None


def _grouped(steps: Sequence[Step]) -> list[Step]:
    """Harmonics of one fundamental together, and outliers that came to light one after the other."""
    left, grouped = list(steps), []
    while left:
        first, others = left[0], []
        if first.candidate.cause == "sinusoid":
            family = [s for s in left if s is first or _harmonic(first, s)]
            first = min(family, key=lambda s: _number(s.candidate.parameters["frequency"]))
            others = [s for s in left if s is not first and _harmonic(first, s)]
            grouped.append(_with_harmonics(first, others) if others else first)
        elif first.candidate.cause == "outliers":
            others = [s for s in left[1:] if s.candidate.cause == "outliers"]
            grouped.append(_with_outliers(first, others) if others else first)
        else:
            grouped.append(first)
        left = [s for s in left if s is not first and s not in others]
    return grouped


def _number(q: Quantity) -> float:
    return float(np.asarray(q.value))


def _harmonic(one: Step, other: Step) -> bool:
    """Whether these are lines, and the higher frequency is a small multiple of the lower one."""
    if one is other or {one.candidate.cause, other.candidate.cause} != {"sinusoid"}:
        return False
    low, high = sorted((s.candidate.parameters["frequency"] for s in (one, other)), key=_number)
    order = np.rint(_number(high) / _number(low))
    error = 4.0 * np.hypot(high.std, order * low.std)
    return bool(2 <= order <= 20 and abs(_number(high) - order * _number(low)) < error)


def _with_harmonics(step: Step, others: Sequence[Step]) -> Step:
    f = _number(step.candidate.parameters["frequency"])
    orders = tuple(float(np.rint(_number(s.candidate.parameters["frequency"]) / f)) for s in others)
    amplitudes = tuple(_number(s.candidate.parameters["amplitude"]) for s in others)
    own = step.candidate.parameters["amplitude"]
    return _together(
        step,
        others,
        {
            "harmonics": Quantity(orders, 0.0, "1"),
            "harmonic_amplitudes": Quantity(amplitudes, own.std, own.unit),
        },
    )


def _with_outliers(step: Step, others: Sequence[Step]) -> Step:
    own = step.candidate.parameters
    found = [np.atleast_1d(s.candidate.parameters["times"].value) for s in (step, *others)]
    times = tuple(np.sort(np.concatenate(found).astype(float)).tolist())
    count = dataclasses.replace(own["count"], value=float(len(times)))
    return _together(step, others, {"count": count, "times": dataclasses.replace(own["times"], value=times)})


def _together(step: Step, others: Sequence[Step], parameters: Mapping[str, Quantity]) -> Step:
    """Several findings as one, with these parameters changed or added."""

    def add_to_model(model: Model) -> Model:
        for s in (step, *others):
            model = s.candidate.add_to_model(model)
        return model

    candidate = dataclasses.replace(
        step.candidate,
        parameters={**step.candidate.parameters, **parameters},
        gain=step.candidate.gain + sum(s.candidate.gain for s in others),
        add_to_model=add_to_model,
    )
    return dataclasses.replace(step, candidate=candidate, gain=step.gain + sum(s.gain for s in others))


def view_of(
    axis: Axis,
    scale: float,
    x: Float[np.ndarray, " n"],
    rate: float,
    auxiliary: Mapping[str, Float[np.ndarray, " n"]],
    baseline: tuple[Model, Model] | None,
) -> View:
    """The first view of an axis: the baseline's basic terms, and what else it has taken out.

    The baseline is a fitted model and what terms it might have had; None: all basic terms may be there.
    """
    n = len(x)
    family = family_of(n, rate)
    if baseline is None:
        return View(axis, scale, rate, x, x, None, auxiliary, EVERYTHING, family, np.zeros(n, bool))
    model, template = baseline
    allowed = tuple(name for name in template.term_labels if name in EVERYTHING)
    basic = [name for name in model.term_labels if name in EVERYTHING]
    others = model.without(basic)
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
    # A baseline without any basic noise still needs one to be compared with.
    if not set(allowed) - {RAMP}:
        allowed = ("angle_random_walk", *allowed)
    return View(axis, scale, rate, x, y, factor, auxiliary, allowed, family, np.zeros(n, bool))


def _without_deterministic(model: Model, x: Float[np.ndarray, " n"], rate: float) -> Float[np.ndarray, " n"]:
    """The record without a baseline's lines and transients, by least squares."""
    lines, wanted = lines_of(model)
    y = x - x.mean()
    t = (np.arange(len(x)) + 0.5) / rate
    columns = [
        np.asarray(term.column(jnp.asarray(t)))
        for k, term in enumerate(model.terms)
        if term.deterministic and k not in lines
    ]
    if columns:
        D = np.column_stack(columns)
        D = D - D.mean(axis=0)
        y = y - D @ np.linalg.lstsq(D, y, rcond=None)[0]
    if lines:
        c, found = take_out_lines(y, rate, wanted)
        c = c.copy()
        for line in found:
            D = np.asarray(line_columns(line.frequency, line.indices, len(x), rate))
            c[line.indices - 1] -= D @ np.linalg.lstsq(D, line.coefficients, rcond=None)[0]
        y = in_time(c)
    return y + x.mean()


def basic_model(view: View) -> Model:
    """The basic terms of a view, with their values."""
    model = view.noise.model()
    return model + DriftRamp(abs(view.slope)) if view.noise.ramp else model


def extended(search: Search) -> Model:
    """The model of an axis with all findings in it."""
    model = basic_model(search.end)
    for step in search.steps:
        model = step.candidate.add_to_model(model)
    return model
