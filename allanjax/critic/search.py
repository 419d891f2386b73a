"""The critic's main loop in one axis, and the rule by which candidates become findings.

The filter and the resonances of the fit come first, if there are any (`View.fitted`).

1. *Compare*: a view is the record as the model so far leaves it, whitened by that model.
2. *Propose*: every effect searches it and offers the correction of the model that explains most.
3. *Measure*: the offer with the largest evidence is accepted if it is significant and predicts data that it
   was not estimated from.
4. *Extend*: what it explains is taken out of the view or becomes part of the noise, which is estimated anew.
5. *Prune*: earlier findings are refitted if that changed their conditions, and dropped if nothing is left.

So on until no offer is accepted. Then everything is refitted once more, filter and resonances jointly.

A candidate's log posterior odds are its log Bayes factor `gain` plus the log prior odds of its effect in
`policy`. It is accepted if

- the log posterior odds reach ln(FALSE_ALARMS/α), where α is the allowed probability of a false finding in
  the axis: zero at the default, more if several axes share the probability;
- if the test is a p-value, p < α·share. Each effect has its own share of the false alarms, whatever the other
  effects. Under noise alone odds of e^gain have a probability of at most e^−gain (Markov's inequality), which
  replaces p if it is smaller or if there is no other test; and
- its parameters make sense: each is within the range that the effect declares (`Effect.sensible`).

An effect that is visible directly in the samples has no odds and is tested by its probability alone. A
finding must also gain on held-out data, if it can be tested on them, and may not raise the model's Allan
variance above the measured one: what fits a stop band by a drift explains neither.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from allanjax.base.wording import plain
from allanjax.critic.effect import Candidate, Effect, View
from allanjax.critic.effects.spectral_shape import SpectralShape, finished
from allanjax.critic.finding import OUTLIERS, Detail, Rival, cause_title, order_of, parameter_estimate
from allanjax.critic.policy import EQUAL, FALSE_ALARMS, OWN, PRIORS, SHARED, judged
from allanjax.critic.step import Step, refitted
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model


class AcceptanceRule(NamedTuple):
    """Rule by which effects in an axis are accepted, with the probability of a false finding in it."""

    false_alarms: float
    effects: Sequence[Effect] = ()

    def level(self, cause: str) -> float:
        """Probability of a false finding of an effect; 1 where its odds are the test."""
        own = {effect.name for effect in self.effects} - PRIORS.keys()
        share = PRIORS[cause].share if cause in PRIORS else EQUAL / max(len(own), 1)
        return 1.0 if share is None else self.false_alarms * share

    def accepts(self, candidate: Candidate) -> bool:
        """Whether a candidate is probable enough, unlikely to be chance, and makes sense."""
        prior = SHARED if candidate.is_shared else candidate.cause
        least = np.log(FALSE_ALARMS / self.false_alarms) - PRIORS.get(prior, OWN).log_odds
        # An effect that is visible directly in the samples has no odds: nan.
        if candidate.gain < least or candidate.chance >= self.level(prior):
            return False
        ranges = {effect.name: effect.sensible for effect in self.effects}.get(candidate.cause, {})
        return all(
            ranges[e.label].holds(e, candidate.after) for e in candidate.estimates if e.label in ranges
        )


_ODDS, _MOST, _CERTAIN, _CLEARLY, _TOO_MANY = (
    judged("search", name) for name in ("rivals", "most", "certain", "clearly", "imputed")
)


_WORSE = judged("search", "worse")
# Logarithm to base 2 of the lowest coefficient of which octaves are compared.
_FIRST_OCTAVE = 3


@dataclasses.dataclass(frozen=True, eq=False)
class Search:
    """Search in one axis, which may be continued.

    Attributes:
        start, end: view of the axis without findings, and with all of them subtracted.
        steps: the findings in order.
        tests: `Effect.p_value` at the start, of those effects that have one.
        notes: notes for the user: effects about as probable as noise terms, or an early end of the search.
        preprocessed: whether a finding concerns the samples themselves, such as rounding.
        noise_model: random terms of the extended model, if there is a filter or a resonance among them.
    """

    start: View
    steps: tuple[Step, ...]
    end: View
    tests: Mapping[str, float]
    notes: tuple[str, ...] = ()
    preprocessed: bool = False
    noise_model: Model | None = None

    def noting(self, texts: Iterable[str]) -> Search:
        """Ended search, with these further notes on its axis."""
        # It may have to wait for the searches in other axes.
        self.end.forget()
        more = (f"{self.end.axis.name}: {text}" for text in texts if text)
        return dataclasses.replace(self, notes=tuple(dict.fromkeys((*self.notes, *more))))


def search(view: View, rule: AcceptanceRule, tell: Callable[[str], None]) -> Search:
    """Search for effects in one axis; `tell` is called with a text that describes the step."""
    state = prepared(view, rule)
    sought = _sought(state.end, rule.effects)
    tests = {c.name: p for c in sought if (p := c.p_value(state.end)) is not None}
    return going_on(dataclasses.replace(state, tests=tests), rule.effects, rule, tell)


def going_on(
    state: Search, effects: Sequence[Effect], rule: AcceptanceRule, tell: Callable[[str], None]
) -> Search:
    """Continued search, with effects that have not been tried yet."""
    effects, promised = _sought(state.end, effects), dict[Effect, float]()
    # Findings that are dropped again count too.
    for _ in range(2 * int(_MOST)):
        if len(state.steps) >= _MOST:
            break
        found, untried = propose(state.end, effects, promised, tell)
        step = measure(found, state.end, rule)
        if step is None and untried:
            found |= propose(state.end, untried, {}, tell)[0]
            step = measure(found, state.end, rule)
        if step is None:
            return state.noting(_undecided(c, state.end) for c in found.values())
        longer = extend(state, step)
        state = prune(longer, effects)
        # A waveform may have hidden any effect, others hardly; in the end all effects are tried again.
        alone = len(state.steps) < len(longer.steps) or step.candidate.has_waveform
        promised = {} if alone else _promised(found, untried, promised, effects, step)
    return state.noting([f"the search stopped at {len(state.steps)} findings; there may be more"])


def prepared(view: View, rule: AcceptanceRule) -> Search:
    """Search with what is visible directly in the samples and must be undone before the search for others."""
    state = Search(view, (), view, {})
    for effect in (c for c in rule.effects if c.is_preprocessing):
        candidate = effect.detect(state.end)
        # Gains that cannot be held out are nan.
        if candidate and rule.accepts(candidate) and not (gain := candidate.held_out()) <= 0.0:
            step = Step.of(candidate, gain, (), state.end)
            after = candidate.after.with_findings(*state.end.found, candidate.cause)
            state = Search(view, (*state.steps, step), after, {}, preprocessed=True)
    return state


def propose(
    view: View, effects: Sequence[Effect], promised: Mapping[Effect, float], tell: Callable[[str], None]
) -> tuple[dict[Effect, Candidate], list[Effect]]:
    """Candidates in a view, until one gains far more than the other effects promise, and those effects."""
    left = sorted(effects, key=lambda effect: -promised.get(effect, np.inf))
    candidates: dict[Effect, Candidate] = {}
    most = 0.0
    while left:
        promise = promised.get(left[0], np.inf)
        # What offered nothing, or was rejected, is tried again when nothing else is left.
        if most > (promise + _CLEARLY if promise else 0.0):
            break
        effect = left.pop(0)
        tell(f"{view.axis.name}: looking for {cause_title(effect.name, view.axis.sensor)}")
        if (candidate := effect.detect(view)) is not None and candidate.gain > 0.0:
            for part in (candidate, *candidate.parts):
                part.after.forget()
            candidates[effect] = candidate
            most = max(most, float(candidate.gain))
    return candidates, left


def measure(found: Mapping[Effect, Candidate], view: View, rule: AcceptanceRule) -> Step | None:
    """Candidate with the largest evidence that is significant and has a gain on held-out data."""
    ranked = sorted(found.values(), key=lambda candidate: -candidate.gain)
    for place, candidate in enumerate(ranked):
        allowed = rule.accepts(candidate) and not worse(view, candidate.after)
        if allowed and (gain := candidate.held_out()) > 0.0:
            # Those before it in the ranking have been rejected.
            rivals = [(other.cause, candidate.gain - other.gain) for other in ranked[place + 1 :]]
            # Basic terms that the finding replaces had explained it so far.
            rivals += [(t, candidate.gain) for t in view.noise.terms if t not in candidate.after.noise.terms]
            odds = (Rival(name, float(np.exp(nats))) for name, nats in rivals if nats < np.log(_ODDS))
            return Step(candidate, gain, tuple(odds), view)
    return None


def worse(before: View, after: View) -> bool:
    """Whether a model's Allan variance exceeds the measured one much farther after a finding than before.

    At a cluster time it is that of the noise in about an octave. The lowest ones scatter too much, and what
    the highest ones have in excess a steep filter leaves.
    """
    edges = 2 ** np.arange(_FIRST_OCTAVE, int(np.log2(before.n)) - 1) - 1
    excess = []
    for view in (before, after):
        measured, model = (np.add.reduceat(x, edges[:-1]) for x in (view.residual**2, view.variance()))
        excess.append(np.max(np.log(model[:-1] / np.maximum(measured[:-1], 1e-300)), initial=0.0))
    return bool(excess[1] > excess[0] + np.log(_WORSE))


def extend(state: Search, step: Step) -> Search:
    """Search with a further finding, or with all that were accepted together."""
    view, steps = state.end, list(state.steps)
    for part in step.candidate.parts or (step.candidate,):
        gain = part.held_out() if step.candidate.parts else step.gain
        # Candidates accepted together were built independently: the list of findings is extended here.
        after = part.after.accepted().with_findings(*view.found, part.cause)
        steps.append(Step.of(dataclasses.replace(part, after=after), gain, step.rivals, view))
        view = after
    return dataclasses.replace(state, steps=tuple(steps), end=view)


def prune(state: Search, effects: Sequence[Effect], last: bool = False) -> Search:
    """Search with findings refitted where others changed their conditions, and without superfluous ones."""
    steps, end = refitted(state.steps, state.end, effects, last)
    return dataclasses.replace(state, steps=tuple(steps), end=end)


def concluded(state: Search, effects: Sequence[Effect]) -> Search:
    """Finished search: everything is refitted, and the filter and the resonances are described."""
    state = prune(state, _sought(state.end, effects), last=True)
    steps, end = list(state.steps), state.end
    model: Model | None = None
    mine = [s for s in steps if s.candidate.cause == SpectralShape.name]
    if mine:
        found, end, model = finished(end, mine)
        place = steps.index(mine[0])
        steps[place:] = [*found, *(s for s in steps[place:] if s not in mine)]
    return dataclasses.replace(
        state,
        start=state.start.without_caches(),
        steps=tuple(grouped(steps)),
        end=end.without_caches(),
        noise_model=model,
    )


def _sought(view: View, effects: Sequence[Effect]) -> list[Effect]:
    """Effects that are not visible directly in the samples; none in a record that is mostly imputed."""
    return [c for c in effects if not c.is_preprocessing and np.mean(view.imputed) < _TOO_MANY]


def _promised(
    found: Mapping[Effect, Candidate],
    untried: Sequence[Effect],
    before: Mapping[Effect, float],
    effects: Sequence[Effect],
    step: Step,
) -> dict[Effect, float]:
    """Gains that effects offered last, of those that a finding hardly affects; 0 for what was rejected."""
    nothing = {effect: 0.0 for effect in effects if effect not in untried and effect not in found}
    # What is found in time hardly affects the spectrum, and the other way round.
    others = {e: float(c.gain) for e, c in found.items() if "time" in (c.domain, step.candidate.domain)}
    rejected = {effect: 0.0 for effect, c in found.items() if c.gain > step.candidate.gain}
    return {effect: before[effect] for effect in untried} | nothing | others | rejected


def _undecided(candidate: Candidate, view: View) -> str:
    """Note on a candidate that is about as probable as basic terms, if chance is unlikely."""
    sensor = view.axis.sensor
    if candidate.chance > _CERTAIN:
        return ""
    # The noise without the candidate is estimated only now.
    instead = [cause_title(t, sensor) for t in view.noise.terms if t not in candidate.after.noise.terms]
    if not instead:
        return ""
    name, odds = cause_title(candidate.cause, sensor), np.exp(min(candidate.gain, 700.0))
    return f"{' and '.join(instead)} may actually be {name} (odds {plain(odds, 2)} : 1)"


def grouped(steps: Sequence[Step]) -> list[Step]:
    """Steps in which the harmonics of a fundamental are one finding, and all outliers are one."""
    groups: dict[Step, list[Step]] = {}
    for step in steps:
        groups.setdefault(_first(step, steps), []).append(step)
    return [_together(first, group) if len(group) > 1 else first for first, group in groups.items()]


def _first(step: Step, steps: Sequence[Step]) -> Step:
    """Step to which another one belongs: its fundamental, the first outliers, or itself."""
    alike = [s for s in steps if s.candidate.cause == step.candidate.cause]
    if step.candidate.cause == "sinusoid":
        lower = [s for s in alike if order_of(_frequency(step), _frequency(s))]
        return _first(min(lower, key=lambda s: _frequency(s).value), steps) if lower else step
    return alike[0] if step.candidate.cause == OUTLIERS else step


def _frequency(step: Step) -> Estimate:
    return step.candidate.parameters["frequency"]


def _together(first: Step, group: Sequence[Step]) -> Step:
    """A group of steps as one, with what the first of them has and lists of what the others add."""
    others = [s for s in group if s is not first]
    every, estimates, details = (first, *others), first.candidate.estimates, _lists(first, others)
    if "times" in details:
        # Each group's error allows for missing samples.
        error = float(np.linalg.norm([s.candidate.parameters["count"].std for s in every]))
        count, *rest = estimates
        estimates = [parameter_estimate(count.axis, "count", len(details["times"]), error, "1"), *rest]
    after = first.candidate.after
    for path in (s.path for s in others if s.path is not None):
        after = after.with_samples(after.samples - path)
    candidate = dataclasses.replace(
        first.candidate,
        estimates=estimates,
        details=details,
        after=after,
        gain=sum(s.candidate.gain for s in every),
        add_to_model=lambda model: functools.reduce(lambda m, s: s.candidate.add_to_model(m), every, model),
    )
    return dataclasses.replace(first, candidate=candidate, gain=sum(s.gain for s in every))


def _lists(first: Step, others: Sequence[Step]) -> Mapping[str, Detail]:
    """Harmonics of a line with their amplitudes, or times and sizes of all outliers."""
    if first.candidate.cause == "sinusoid":
        orders = (round(_frequency(s).value / _frequency(first).value) for s in others)
        return {
            "harmonics": tuple(first.before.estimate("harmonic", order, 0.0, "1") for order in orders),
            "harmonic_amplitudes": tuple(s.candidate.parameters["amplitude"] for s in others),
        }
    each = [s.candidate.details for s in (first, *others)]
    lists = {name: [e for own in each for e in own[name] if isinstance(e, Estimate)] for name in each[0]}
    order = np.argsort([e.value for e in lists["times"]], kind="stable")
    return {name: tuple(own[k] for k in order) for name, own in lists.items()}
