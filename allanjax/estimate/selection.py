"""Selection of noise terms: every subset of the candidates, ranked by its evidence."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError, FitError
from allanjax.base.per_axis import PerAxis
from allanjax.estimate.averaged import Averaged
from allanjax.inspection.facts import Fact, warnings_of
from allanjax.noise.estimate import title_of
from allanjax.record.recording import Axis

if TYPE_CHECKING:
    import pandas as pd

# Headings of the columns of numbers in the printed table.
_NUMBERS = ("probability", "nats behind")
# Bayes factor of the best set below which another is not told from it (Kass & Raftery 1995: 20 is "strong").
_ODDS = 20.0
# A fit takes the simplest of the sets against which the best one has a smaller Bayes factor than this.
_PARSIMONY = 5.0
# Posterior probability of a chosen term, summed over the sets that have it, from which on it is detected.
_CERTAIN = 0.95
# Probability below which a further term is not mentioned as an ambiguity: any might be there, unseen.
_WORTH_SAYING = 0.1


@dataclasses.dataclass(frozen=True)
class TermSet:
    """Set of noise terms with its evidence.

    Attributes:
        terms: names of the terms.
        parameters: number of their free parameters.
        log_evidence: logarithm of the marginal likelihood of the set over that of the best one [nats].
        probability: posterior probability of the set, with equal prior probabilities of all sets.
    """

    terms: tuple[str, ...]
    parameters: int
    log_evidence: float
    probability: float

    def __str__(self) -> str:
        return " + ".join(self.terms)

    def __repr__(self) -> str:
        return f"<TermSet {self}: {100.0 * self.probability:.3g} %, {self.parameters} parameters>"


@dataclasses.dataclass(frozen=True, eq=False)
class AxisSelection(ByValue):
    """Ranking of the sets of noise terms for one axis.

    Attributes:
        axis: the axis.
        ranking: all sets, the most probable first.
        discrepancy: relative error of the best set's root spectrum that its misfit calls for; 0 if it
            suffices.
        averaged: coefficients and drift averaged over all sets, for those to whom it does not matter which is
            right.
    """

    axis: Axis
    ranking: tuple[TermSet, ...]
    discrepancy: float
    averaged: Averaged | None = None

    @property
    def best(self) -> TermSet:
        """Most probable set."""
        return self.ranking[0]

    @property
    def indistinguishable(self) -> tuple[TermSet, ...]:
        """Best set, and those that the data do not tell from it: Bayes factors below 20."""
        return tuple(s for s in self.ranking if s.log_evidence > self.best.log_evidence - np.log(_ODDS))

    @property
    def chosen(self) -> TermSet:
        """Set with the fewest parameters among those that are at most five times less probable than the best.

        Of two explanations that the data hardly tell apart, it is the one that claims less.
        """
        close = [s for s in self.ranking if s.log_evidence > self.best.log_evidence - np.log(_PARSIMONY)]
        return min(close, key=lambda s: (s.parameters, -s.log_evidence))

    @property
    def inclusion(self) -> dict[str, float]:
        """Posterior probability of each term: the sum over the sets that have it."""
        names = max((s.terms for s in self.ranking), key=len)
        return {name: sum(s.probability for s in self.ranking if name in s.terms) for name in names}

    def doubtful(self) -> dict[str, tuple[str, ...]]:
        """The chosen terms whose posterior probability is below 95 %, and the terms that may replace each.

        Sets with a free time compete only if the chosen one has one, too: with a long time they say the same
        as a random walk. The rivals are of the sets that are not told from the best, the most probable
        first, if these sets need them; none if the term may as well be missing altogether.
        """
        free = self.chosen.parameters > len(self.chosen.terms)
        compared = [s for s in self.ranking if free or s.parameters == len(s.terms)]
        total, found = sum(s.probability for s in compared), {}
        close = {frozenset(s.terms) for s in self.indistinguishable}
        for term in self.chosen.terms:
            without = [s for s in compared if term not in s.terms]
            if sum(s.probability for s in without) > (1.0 - _CERTAIN) * total:
                likely = [frozenset(s.terms) for s in without if frozenset(s.terms) in close]
                needed = (t for s in likely for t in sorted(s) if s - {t} not in close)
                found[term] = tuple(t for t in dict.fromkeys(needed) if t not in self.chosen.terms)
        return found

    def to_dataframe(self) -> pd.DataFrame:
        """Table with one row a set; log-evidences are relative to the best set's [nats]."""
        import pandas as pd

        return pd.DataFrame(
            {
                "axis": self.axis.name,
                "rank": rank,
                "terms": str(s),
                "probability": s.probability,
                "log_evidence": s.log_evidence - self.best.log_evidence,
                "indistinguishable": s in self.indistinguishable,
            }
            for rank, s in enumerate(self.ranking, 1)
        )

    def __repr__(self) -> str:
        chosen, best = (f"{s} ({100.0 * s.probability:.3g} %)" for s in (self.chosen, self.best))
        close = f"{len(self.indistinguishable)} of {len(self.ranking)} sets"
        return (
            f"<AxisSelection {self.axis.name}: chosen {chosen}, best {best};\n"
            f" the data do not tell {close} apart>"
        )

    def ambiguities(self) -> tuple[str, ...]:
        """Phrases about what the data leave open beside the chosen set, the most probable first."""
        found = []
        for other in self.indistinguishable:
            sensor, chosen = self.axis.sensor, self.chosen.terms
            extra = tuple(title_of(t, sensor) for t in other.terms if t not in chosen)
            missing = tuple(title_of(t, sensor) for t in chosen if t not in other.terms)
            odds = f"{100.0 * self.chosen.probability:.2g} % against {100.0 * other.probability:.2g} %"
            if len(missing) <= 1 and len(extra) <= 1 and missing and extra:
                found.append(f"{missing[0]} from {extra[0]} ({odds})")
            elif len(missing) + len(extra) == 1 and other.probability > _WORTH_SAYING:
                found.append(
                    f"whether there is {(missing or extra)[0]} ({odds} {'with' if extra else 'without'} it)"
                )
        return tuple(found[:3])


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class TermSelection(ByValue, PerAxis[AxisSelection]):
    """Ranking of sets of noise terms, for every axis of a recording.

    Attributes:
        name: name of the recording.
        results: rankings of the axes.
        facts: what was found in the recording before, the gravest first.
    """

    CALLED: ClassVar[str] = "the selection"
    HEADINGS: ClassVar[tuple[str, ...]] = ("axis", "noise terms", *_NUMBERS)
    RIGHT: ClassVar[tuple[str, ...]] = _NUMBERS
    ERROR: ClassVar[type[AllanjaxError]] = FitError

    name: str
    results: tuple[AxisSelection, ...]
    facts: tuple[Fact, ...] = ()

    @property
    def warnings(self) -> tuple[str, ...]:
        """What a user of the ranking should know, the gravest first."""
        return warnings_of(self.facts)

    def _title(self) -> str:
        return f"{self.name}: noise terms by evidence".lstrip(": ")

    def _cells(self) -> list[tuple[str, ...]]:
        rows: list[tuple[str, ...]] = []
        for axis in self.results:
            for rank, s in enumerate(axis.ranking[: max(3, len(axis.indistinguishable))]):
                behind = axis.best.log_evidence - s.log_evidence
                mark = "" if rank == 0 else " (not told apart)" if s in axis.indistinguishable else ""
                words = title_of(f"{s}{mark}", axis.axis.sensor)
                rows.append((axis.axis.name, words, f"{100 * s.probability:.3g} %", f"{behind:.1f}"))
            if axis.averaged is not None:
                rows += [(axis.axis.name, words, "", "") for words in axis.averaged.told(axis.axis)]
        return rows
