"""Selection of noise terms: every subset of the candidates, ranked by its evidence."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from jaxtyping import Float

from allanjax.base.chi_squared import beyond_doubt
from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError, FitError
from allanjax.base.per_axis import PerAxis
from allanjax.estimate.design import model_to_fit
from allanjax.estimate.evidence import Evidence, TermSubset, evidences, term_subsets, without_ramp
from allanjax.estimate.spectral.columns import columns_of
from allanjax.estimate.spectral.fit import chi_squared, error_of_powers
from allanjax.estimate.starts import correlation_times
from allanjax.noise.model import Model
from allanjax.noise.notation import ModelLike
from allanjax.noise.terms import Markov, basic_terms
from allanjax.record.io.given import RecordingLike, as_recording
from allanjax.record.recording import Axis
from allanjax.spectrum.cosine import (
    Bins,
    SpectralStatistics,
    cosine_transform,
    ramp_column,
    term_column,
)

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
# Number of times that the evidence is computed anew with the error of the best set.
_ROUNDS = 2


@dataclasses.dataclass(frozen=True)
class TermSet:
    """Set of noise terms with its evidence.

    Attributes:
        terms: names of the terms.
        parameters: number of their free parameters.
        log_evidence: logarithm of the marginal likelihood of the set [nats], up to a common constant.
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
    """

    axis: Axis
    ranking: tuple[TermSet, ...]
    discrepancy: float

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
            extra = tuple(t.replace("_", " ") for t in other.terms if t not in self.chosen.terms)
            missing = tuple(t.replace("_", " ") for t in self.chosen.terms if t not in other.terms)
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
    """

    CALLED: ClassVar[str] = "the selection"
    HEADINGS: ClassVar[tuple[str, ...]] = ("axis", "noise terms", *_NUMBERS)
    RIGHT: ClassVar[tuple[str, ...]] = _NUMBERS
    ERROR: ClassVar[type[AllanjaxError]] = FitError

    name: str
    results: tuple[AxisSelection, ...]

    def _title(self) -> str:
        return f"{self.name}: noise terms by evidence".lstrip(": ")

    def _cells(self) -> list[tuple[str, ...]]:
        rows: list[tuple[str, ...]] = []
        for axis in self.results:
            for rank, s in enumerate(axis.ranking[: max(3, len(axis.indistinguishable))]):
                behind = axis.best.log_evidence - s.log_evidence
                mark = "" if rank == 0 else " (not told apart)" if s in axis.indistinguishable else ""
                words = f"{s}{mark}".replace("_", " ")
                rows.append((axis.axis.name, words, f"{100 * s.probability:.3g} %", f"{behind:.1f}"))
        return rows


def select_terms(
    recording: RecordingLike,
    candidates: ModelLike | None = None,
    *,
    rate: float | None = None,
    gyro_unit: str | None = None,
    accel_unit: str | None = None,
    names: Sequence[str] | None = None,
) -> TermSelection:
    """Rank every set of noise terms by its evidence, for every axis of a recording.

    The evidence (marginal likelihood) is Whittle's likelihood integrated over the coefficients by Laplace's
    method, with the boundary at zero by quadrature (see `evidence`). Unlike BIC it needs no "number of
    samples" to say how sharply a coefficient is known, which is ten for a rate random walk and all for an
    angle random walk; unlike held-out likelihood it uses a drift's few low frequencies in full. All sets have
    the same prior probability.

    Where no set follows the spectrum within its scatter (p < 10⁻⁶), all are given a relative error that makes
    the best one fit, which lowers all Bayes factors; sets with a free time are left out then: it would fit
    whatever else the model lacks.

    Args:
        recording: what `read` returns, or what else `fit` takes.
        candidates: the terms to choose from, as `fit` takes a model; by default the five basic ones and a
            Markov process.
        rate, gyro_unit, accel_unit, names: for an array, see `fit`.

    Raises:
        AllanjaxError: candidates that cannot be compared: lines, resonances and steps, a free shape that is
            no time, more than one term with a free time, more than six terms.
        FitError: a record of fewer than 64 samples.
    """
    recording = as_recording(recording, rate, gyro_unit, accel_unit, names)
    model = candidates_of(candidates, recording.rate)
    ramps = _sorted(model)[2]
    if recording.n < 64:
        raise FitError(
            f"{recording.name or 'the recording'}: {recording.n} samples are too few to choose terms; "
            "record at least 64"
        )
    bins = Bins.of(recording.n, recording.rate)
    place = recording.n, recording.rate
    ramp = term_column(model.terms[ramps[0]], *place) if ramps else ramp_column(*place)
    c = cosine_transform(recording.values - recording.values.mean(axis=0))
    return rank_terms(model, bins, bins.statistics(c, ramp), recording.axes, recording.name)


def candidates_of(candidates: ModelLike | None, rate: float) -> Model:
    """Candidate terms as sampled at `rate` [Hz]: those given, or the basic ones and a Markov process."""
    return (basic_terms() + Markov() if candidates is None else model_to_fit(candidates)).sampled(rate)


def rank_terms(
    model: Model, bins: Bins, statistics: SpectralStatistics, axes: Sequence[Axis], name: str
) -> TermSelection:
    """Rank every set of noise terms by its evidence, from the statistics [axes, m] of a spectrum.

    The ramp's statistics are those of unit slope. Raises AllanjaxError as `select_terms` does.
    """
    fixed, shaped, ramps = _sorted(model)
    columns, count = _columns(model, fixed, shaped, bins)
    subsets = term_subsets(len(fixed), count, bool(ramps))
    size = bins.size.astype(float)
    cut = len(fixed)
    grid = columns[cut:] if shaped else np.ones((1, len(size)))

    def run(share: Float[np.ndarray, "axes m"], last: int) -> Evidence:
        """Evidence of the first subsets, up to this one."""
        return evidences(
            TermSubset(*(x[:last] for x in subsets)), statistics, columns[:cut], grid, size, share
        )

    def error_of(k: int) -> float:
        """Error of powers that the best subset of an axis calls for."""
        best = int(np.argmax(log_evidence[k]))
        mean = power[k, best] @ np.concatenate([columns[:cut], grid[subsets.column[best]][None]])
        own = SpectralStatistics(*(np.asarray(x)[k] for x in statistics))
        rss, dof = without_ramp(own, size, mean, bool(subsets.ramp[best]))
        ratio, degrees = rss / np.maximum(dof, 1e-3) / mean, max(len(size) - 3.0, 1.0)
        if chi_squared(ratio, dof) <= beyond_doubt(degrees):
            return 0.0
        return error_of_powers(ratio, dof, per_octave, degrees)

    per_octave = bins.per_octave()
    log_evidence, power = (np.array(x) for x in run(np.ones((len(axes), len(size))), len(subsets.ramp)))
    incomplete = np.array([error_of(k) > 0.0 for k in range(len(axes))])
    # The sets without a free time come first; only these are compared where none suffices.
    plain = int((~subsets.terms[:, -1]).sum())
    log_evidence[incomplete, plain:] = -np.inf
    found_error = np.zeros(len(axes))
    for _ in range(_ROUNDS if incomplete.any() else 0):
        for k in map(int, np.flatnonzero(incomplete)):
            found_error[k] = max(found_error[k], error_of(k))
        found = run(1.0 / (1.0 + 0.5 * size * per_octave * found_error[:, None] ** 2), plain)
        log_evidence[incomplete, :plain] = found.log_evidence[incomplete]
        power[incomplete, :plain] = found.power[incomplete]
    ranked = (
        _ranked(axis, model, (fixed, shaped, ramps), subsets, log_evidence[k], float(found_error[k]) / 2.0)
        for k, axis in enumerate(axes)
    )
    return TermSelection(name, tuple(ranked))


def _sorted(model: Model) -> tuple[list[int], list[int], list[int]]:
    """Indices of the random terms without a free shape, of that with a free time, and of the ramp."""
    fixed: list[int] = []
    shaped: list[int] = []
    ramps: list[int] = []
    for k, term in enumerate(model.terms):
        free = [p for p in term.parameters()[1:] if term.is_free(p)]
        if not term.has_free_amplitude:
            raise AllanjaxError(f"{term.name()}: a held amplitude leaves nothing to choose")
        if term.deterministic and len(term.parameters()) == 1:
            ramps.append(k)
        elif term.deterministic or term.narrow_band or len(free) > 1 or any(p.kind != "time" for p in free):
            raise AllanjaxError(
                f"{term.name()} cannot be compared by evidence; fit with and without it and compare"
            )
        else:
            (shaped if free else fixed).append(k)
    if len(shaped) > 1 or len(ramps) > 1 or not 1 <= len(model) <= 6:
        raise AllanjaxError(
            "the candidates may be at most six terms, one of them with a free time and one a ramp; "
            "hold the others' times, e.g. Markov().hold(correlation_time=100.0)"
        )
    return fixed, shaped, ramps


def _columns(
    model: Model, fixed: list[int], shaped: list[int], bins: Bins
) -> tuple[Float[np.ndarray, "columns m"], int]:
    """Unit expectations of the terms without a free shape, then of the other over its grid; and its size."""
    terms = [model.terms[k] for k in fixed]
    for term in (model.terms[k] for k in shaped):
        name = next(p.name for p in term.parameters()[1:] if term.is_free(p))
        times = correlation_times(bins.n / bins.rate, bins.rate)
        terms += [term.replace(**{name: float(time)}) for time in times]
    return columns_of(terms, bins).mean(axis=1), len(terms) - len(fixed)


def _ranked(
    axis: Axis,
    model: Model,
    sorts: tuple[list[int], list[int], list[int]],
    subsets: TermSubset,
    log_evidence: Float[np.ndarray, " subsets"],
    discrepancy: float,
) -> AxisSelection:
    """Ranking of the sets of terms of one axis from the evidence of all subsets."""
    labels = model.term_labels
    fixed, shaped, ramps = sorts
    places = fixed + (shaped or [-1])
    by_set: dict[tuple[str, ...], list[float]] = {}
    for terms, _, ramp, value in zip(*subsets, log_evidence, strict=True):
        if value == -np.inf:
            continue
        chosen = {places[i] for i in np.flatnonzero(terms)} | (set(ramps) if ramp else set())
        by_set.setdefault(tuple(labels[k] for k in sorted(chosen)), []).append(float(value))
    # The evidence of a set with a free time is the mean over the grid of times.
    total = {s: float(np.logaddexp.reduce(v) - np.log(len(v))) for s, v in by_set.items()}
    norm = float(np.logaddexp.reduce(list(total.values())))
    ranking = sorted(total.items(), key=lambda item: -item[1])
    free = {label: sum(p.free for p in model.parameters if p.term_label == label) for label in labels}
    sets = tuple(
        TermSet(s, sum(free[label] for label in s), value, float(np.exp(value - norm)))
        for s, value in ranking
    )
    return AxisSelection(axis, sets, discrepancy)
