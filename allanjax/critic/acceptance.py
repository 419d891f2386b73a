"""Which candidates are accepted as findings: one rule, with the assumptions of `policy`.

A candidate's log posterior odds are its log Bayes factor `gain` plus the log prior odds of its effect. It is
accepted if

- the log posterior odds reach ln(FALSE_ALARMS/α), where α is the allowed probability of a false finding in
  the axis: zero at the default, more if several axes share the probability;
- if the test is a p-value, p < α·share. Each effect has its own share of the false alarms, whatever the other
  effects. Under noise alone odds of e^gain have a probability of at most e^−gain (Markov's inequality), which
  replaces p if it is smaller or if there is no other test; and
- its parameters make sense: each is within the range that the effect declares (`Effect.sensible`).

An effect that is visible directly in the samples has no odds and is tested by its probability alone. A
finding must also gain on held-out data, if it can be tested on them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from allanjax.critic.effect import Effect, Range
from allanjax.critic.policy import EQUAL, FALSE_ALARMS, OWN, PRIORS, SHARED
from allanjax.critic.view import Candidate


class AcceptanceRule(NamedTuple):
    """Rule by which candidates in one axis are accepted.

    Attributes:
        false_alarms: probability of a false finding in the axis.
        own: names of effects that are not in the table.
        sensible: where the parameters of each effect make sense, by label.
    """

    false_alarms: float
    own: tuple[str, ...] = ()
    sensible: Mapping[str, Mapping[str, Range]] = MappingProxyType({})

    @classmethod
    def of(cls, false_alarms: float, effects: Iterable[Effect] = ()) -> AcceptanceRule:
        """Rule for an axis with these effects."""
        effects = tuple(effects)
        own = (effect.name for effect in effects if effect.name not in PRIORS)
        return cls(
            false_alarms, tuple(dict.fromkeys(own)), {effect.name: effect.sensible for effect in effects}
        )

    def least_log_odds(self, cause: str) -> float:
        """Gain [nats] above which a candidate of a cause has the required posterior odds."""
        return float(np.log(FALSE_ALARMS / self.false_alarms)) - PRIORS.get(cause, OWN).log_odds

    def level(self, cause: str) -> float:
        """Probability of a false finding of an effect; 1 where its odds are the test."""
        share = PRIORS[cause].share if cause in PRIORS else EQUAL / max(len(self.own), 1)
        return 1.0 if share is None else self.false_alarms * share

    def accepts(self, candidate: Candidate) -> bool:
        """Whether a candidate is probable enough, unlikely to be chance, and makes sense."""
        # An effect that is visible directly in the samples has no odds: nan.
        prior = SHARED if candidate.is_shared else candidate.cause
        doubtful = candidate.gain < self.least_log_odds(prior)
        probable = not doubtful and candidate.chance < self.level(prior)
        return bool(probable and self._makes_sense(candidate))

    def _makes_sense(self, candidate: Candidate) -> bool:
        """Whether all parameters of a candidate are where its effect declares them to make sense."""
        ranges = self.sensible.get(candidate.cause, {})
        return all(
            ranges[e.label].holds(e, candidate.after) for e in candidate.estimates if e.label in ranges
        )
