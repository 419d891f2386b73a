"""The choice of noise terms: every subset of the candidates, ranked by its evidence."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from allanjax.base.chi_squared import beyond_doubt
from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError, FitError
from allanjax.base.normal import TWO_SIDED_95
from allanjax.base.tables import Column, PerAxis, columns_from
from allanjax.base.wording import percent, plain
from allanjax.estimate.design import check_no_response, correlation_times
from allanjax.estimate.evidence import Ramps, TermSets, evidence, information, term_sets
from allanjax.estimate.spectral.components import columns_of
from allanjax.estimate.spectral.fit import chi_squared, error_of_powers, share_with_error
from allanjax.inspection import inspect
from allanjax.inspection.facts import Fact, warnings_of
from allanjax.noise.estimate import SYMBOLS, title_of
from allanjax.noise.model import Model
from allanjax.noise.notation import ModelLike, as_model
from allanjax.noise.terms import DriftRamp, Markov, basic_terms
from allanjax.record.io.given import RecordingLike, as_recording
from allanjax.record.recording import Axis, Recording
from allanjax.spectrum.cosine import Bins, Part, SpectralStatistics, joint_statistics

if TYPE_CHECKING:
    import pandas as pd

# Standard deviation, in ln, of a power that the data hardly determine.
_WIDEST = 1.5
# Bayes factors of the best set below which another cannot be distinguished (Kass & Raftery 1995: 20 is
# "strong"), and below which a fit takes the other if it is simpler.
_ODDS, _PARSIMONY = 20.0, 5.0
# Posterior probability of a chosen term, summed over its sets, above which it is detected; and the least one
# of a further term that is reported as undecided: any term may be there undetected.
_CERTAIN, _WORTH_SAYING = 0.95, 0.1
# Number of times that the evidence is recomputed with the model error of the best set.
_ROUNDS = 2
# Samples up to which a record is short: a process of some samples is then hardly more than a filter's colour.
_SHORT = 1 << 13
# Sets more nats than this behind the best one are not tried with a second free time.
_FAR = 7.0


@dataclasses.dataclass(frozen=True)
class TermSet:
    """Set of noise terms with its evidence.

    Attributes:
        terms, parameters: names of the terms, and number of their free parameters.
        log_evidence: logarithm of the marginal likelihood relative to the best set [nats].
        probability: posterior probability of the set, all sets having equal prior probabilities.
        intervals: 95 % interval [SI] of each amplitude but a ramp's by label, for sets that cannot be
            distinguished from the best one.
    """

    terms: tuple[str, ...]
    parameters: int
    log_evidence: float
    probability: float
    intervals: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict, hash=False)

    def __str__(self) -> str:
        return " + ".join(self.terms)

    def __repr__(self) -> str:
        return f"<TermSet {self}: {percent(self.probability, 3)}, {self.parameters} parameters>"


@dataclasses.dataclass(frozen=True, eq=False)
class AxisSelection(ByValue):
    """Ranking of the sets of noise terms for one axis.

    Sets with a free time compete with the chosen one only if that has one, too: a short time is like white
    noise, and a long one like a random walk.

    Attributes:
        axis, ranking: the axis, and all sets, the most probable first.
        discrepancy: relative error of the best set's root spectrum that explains its misfit; 0 if it fits.
        spectrum: what was ranked; None for a selection from a file.
    """

    axis: Axis
    ranking: tuple[TermSet, ...]
    discrepancy: float
    spectrum: tuple[Bins, SpectralStatistics] | None = dataclasses.field(default=None, compare=False)

    @property
    def best(self) -> TermSet:
        """Most probable set."""
        return self.ranking[0]

    def _within(self, odds: float) -> tuple[TermSet, ...]:
        """Sets against which the best one has a smaller Bayes factor."""
        return tuple(s for s in self.ranking if s.log_evidence > self.best.log_evidence - np.log(odds))

    @property
    def indistinguishable(self) -> tuple[TermSet, ...]:
        """The best set and those that cannot be distinguished from it: Bayes factors below 20."""
        return self._within(_ODDS)

    def gain(self, terms: Iterable[str], over: Iterable[str]) -> float:
        """ln of the Bayes factor of one set of terms over another [nats]; infinite over one not ranked."""
        known = {frozenset(s.terms): s.log_evidence for s in self.ranking}
        return known[frozenset(terms)] - known.get(frozenset(over), -np.inf)

    @property
    def chosen(self) -> TermSet:
        """The set with the fewest parameters among those at most five times less probable than the best."""
        return min(self._within(_PARSIMONY), key=lambda s: (s.parameters, -s.log_evidence))

    @property
    def _compared(self) -> list[TermSet]:
        """The sets that compete with the chosen one."""
        free = self.chosen.parameters > len(self.chosen.terms)
        return [s for s in self.ranking if free or s.parameters == len(s.terms)]

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """95 % interval [SI] of each amplitude that covers those of all indistinguishable sets."""
        found: dict[str, list[float]] = {}
        for label, ends in (item for s in self._compared for item in s.intervals.items()):
            found.setdefault(label, []).extend(ends)
        return {label: (min(ends), max(ends)) for label, ends in found.items()}

    @property
    def inclusion(self) -> dict[str, float]:
        """Posterior probability of each term: the sum over the sets that have it."""
        names = max((s.terms for s in self.ranking), key=len)
        return {name: sum(s.probability for s in self.ranking if name in s.terms) for name in names}

    def doubtful(self) -> dict[str, tuple[str, ...]]:
        """The chosen terms whose posterior probability is below 95 %, and the terms that may replace each.

        The rivals are terms that the sets indistinguishable from the best one need, the most probable first;
        none if the term may just as well be missing.
        """
        compared, found = self._compared, {}
        total = sum(s.probability for s in compared)
        close = {frozenset(s.terms) for s in self.indistinguishable}
        for term in self.chosen.terms:
            without = [s for s in compared if term not in s.terms]
            if sum(s.probability for s in without) > (1.0 - _CERTAIN) * total:
                likely = (s for s in (frozenset(of.terms) for of in without) if s in close)
                needed = (t for s in likely for t in sorted(s) if s - {t} not in close)
                found[term] = tuple(t for t in dict.fromkeys(needed) if t not in self.chosen.terms)
        return found

    def undecided(self) -> tuple[tuple[str, str, float, float], ...]:
        """At most three questions that the data leave undecided, the most probable first.

        Each has its text, a text for two probabilities, and these probabilities: for a term, of a set without
        it and one with it; for "one or another", of the chosen set and the other.
        """
        found, chosen = [], self.chosen
        for other in self.indistinguishable:
            extra = [t for t in other.terms if t not in chosen.terms]
            missing = [t for t in chosen.terms if t not in other.terms]
            titles = [title_of(t, self.axis.sensor) for t in missing + extra]
            one, two = (chosen, other) if extra else (other, chosen)
            if len(missing) == len(extra) == 1:
                found.append((" or ".join(titles), "{} and {}", one.probability, two.probability))
            elif len(titles) == 1 and other.probability > _WORTH_SAYING:
                found.append((titles[0], "{} without it, {} with it", one.probability, two.probability))
        return tuple(found[:3])

    def to_dataframe(self) -> pd.DataFrame:
        """Table with one row per set; log-evidences are relative to the best set [nats]."""
        import pandas as pd

        name, best, close = self.axis.name, self.best.log_evidence, len(self.indistinguishable)
        rows = [
            (name, rank, str(s), s.probability, s.log_evidence - best, rank <= close)
            for rank, s in enumerate(self.ranking, 1)
        ]
        columns = ["axis", "rank", "terms", "probability", "log_evidence", "indistinguishable"]
        return pd.DataFrame(rows, columns=columns)

    def __repr__(self) -> str:
        chosen, best = (f"{s} ({percent(s.probability, 3)})" for s in (self.chosen, self.best))
        close = f"{len(self.indistinguishable)} of {len(self.ranking)} sets cannot be distinguished"
        return f"<AxisSelection {self.axis.name}: chosen {chosen}, best {best};\n {close}>"


def _in_words(question: str, words: str, *probabilities: Sequence[float]) -> str:
    """An undecided question with ranges of the probabilities of the best sets, e.g. "19–30 %"."""
    ends = (dict.fromkeys(plain(100.0 * x, 2) for x in (min(p), max(p))) for p in probabilities)
    ranges = (f"{'–'.join(of)} %" for of in ends)
    return f"{question} (probabilities of the best sets: {words.format(*ranges)})"


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class TermSelection(ByValue, PerAxis[AxisSelection]):
    """Ranking of sets of noise terms, for every axis of a recording.

    Attributes:
        name, results: name of the recording, and rankings of its axes.
        facts: what the inspection of the recording detected, the gravest first.
    """

    ERROR: ClassVar[type[AllanjaxError]] = FitError

    name: str
    results: tuple[AxisSelection, ...]
    facts: tuple[Fact, ...] = ()

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about the ranking, the gravest first."""
        return warnings_of(self.facts)

    def undecided(self) -> dict[tuple[str, str], list[tuple[str, float, float]]]:
        """Questions that the data leave undecided, as for an axis, and for which axes, with probabilities."""
        found: dict[tuple[str, str], list[tuple[str, float, float]]] = {}
        for axis in self.results:
            for question, words, one, other in axis.undecided():
                found.setdefault((question, words), []).append((axis.axis.name, one, other))
        return found

    def ambiguities(self) -> tuple[str, ...]:
        """Notes on what the data leave undecided: one per question, with its axes and probabilities."""
        notes = []
        for (question, words), of in self.undecided().items():
            names, *probabilities = zip(*of, strict=True)
            on = f"{question} on {', '.join(names)}"
            notes.append(f"undecided: {_in_words(on, words, *probabilities)}")
        return tuple(notes)

    def _title(self) -> str:
        return "noise terms by evidence"

    def _tables(self) -> list[list[Column]]:
        """The sets with their probabilities."""
        rows = []
        for axis in self.results:
            close, chosen = len(axis.indistinguishable), axis.chosen
            for k, s in enumerate(axis.ranking[: max(3, close)]):
                verdict = "chosen" if s == chosen else "undecided" if k < close else ""
                terms = " + ".join(SYMBOLS.get(term, term) for term in s.terms)
                behind = f"{axis.best.log_evidence - s.log_evidence:.1f}"
                rows.append((axis.axis.name, terms, f"{100.0 * s.probability:.1f}", behind, verdict))
        heads = ("axis", "noise terms", "probability (%)", "nats behind", "verdict")
        return [columns_from(heads, rows)]

    def _notes(self) -> list[str]:
        terms = {t for axis in self.results for s in axis.ranking for t in s.terms}
        sensor = self.results[0].axis.sensor
        names = [f"{symbol}: {title_of(term, sensor)}" for term, symbol in SYMBOLS.items() if term in terms]
        return [", ".join(names)]


def select_terms(
    recording: RecordingLike,
    candidates: ModelLike | None = None,
    *,
    axes: Sequence[str] | str | None = None,
    rate: float | None = None,
    gyro_unit: str | None = None,
    accel_unit: str | None = None,
    names: Sequence[str] | None = None,
) -> TermSelection:
    """Rank every set of noise terms by its evidence, for every axis of a recording.

    The evidence (see `evidence`) is Whittle's likelihood integrated over the coefficients; all sets have the
    same prior probability. Where none fits the spectrum (p < 10⁻⁶), all are given the relative error that
    makes the best one fit, which lowers all Bayes factors; sets with a free time, which would absorb the
    misfit, are then left out. If the candidates have two Markov processes (`"N + B + K + markov + markov"`),
    both together are compared, too, beside the sets that come near the best with one of them.

    The segments of a recording with gaps are combined. Disturbed parts are left out, as by `fit`.

    Args:
        recording: a result of `read`, or anything else that `fit` takes.
        candidates: the terms to choose from, as in `fit`; by default the five basic ones and Markov.
        axes: names of the axes; by default all.
        rate, gyro_unit, accel_unit, names: for an array, see `fit`.

    Raises:
        AllanjaxError: candidates that cannot be compared: lines, resonances, steps, a free shape other than a
            time, more than one term with a free time (except two of one kind), more than six terms.
        FitError: a record of fewer than 64 samples.
    """
    recording = as_recording(recording, rate, gyro_unit, accel_unit, names)
    if axes is not None:
        recording = recording.select(*([axes] if isinstance(axes, str) else axes))
    seen = inspect(recording)
    quiet = recording if seen.refusal else seen.quiet(recording)
    terms = None if candidates is None else as_model(candidates)
    return dataclasses.replace(ranked(quiet, terms), facts=seen.facts)


def ranked(
    recording: Recording,
    candidates: Model | None = None,
    joint: tuple[Bins, SpectralStatistics] | None = None,
) -> TermSelection:
    """Ranking of the terms for a whole recording; see `select_terms`. `joint`: its statistics, if known."""
    if recording.n < 64:
        raise FitError(
            f"{recording.name or 'the recording'}: {recording.n} samples are too few to choose terms; "
            "record at least 64 samples, or fit given terms (--terms)"
        )
    bins, statistics = joint or joint_statistics((recording.values, *recording.others), recording.rate)
    model = candidates_for(bins.n) if candidates is None else candidates
    check_no_response(model)
    return rank_terms(Candidates.of(model, bins), statistics, recording.axes, recording.name)


def pooled(selections: Sequence[AxisSelection]) -> AxisSelection:
    """Ranking of the sets of basic terms for an axis of several records whose noise has the same powers.

    The records are at one rate, and each selection has its `spectrum`. The ramp is the same, too.
    """
    alike = dict[Any, tuple[Part, SpectralStatistics]]()
    for bins, statistics in (s.spectrum for s in selections if s.spectrum is not None):
        ends = np.cumsum([len(part.edges) - 1 for part in bins.parts])[:-1]
        sums = zip(*(np.split(x, ends) for x in statistics), strict=True)
        for part, own in zip(bins.parts, map(SpectralStatistics._make, sums), strict=True):
            key = part.n, part.rate, part.edges.tobytes()
            if key in alike:
                old, total = alike[key]
                part = part._replace(segments=old.segments + part.segments)
                own = SpectralStatistics(*(x + y for x, y in zip(total, own, strict=True)))
            alike[key] = part, own
    parts, each = zip(*alike.values(), strict=True)
    bins = Bins(parts[0].n, parts[0].rate, parts)
    statistics = SpectralStatistics(*map(np.concatenate, zip(*each, strict=True)))
    candidates = Candidates.of(basic_terms(), bins)._replace(statistics=statistics)
    return candidates.ranked_for(selections[0].axis)


def candidates_for(n: int) -> Model:
    """The terms among which a fit of n samples chooses: short records do not bear a free correlation time."""
    return basic_terms() if n <= _SHORT else basic_candidates()


def basic_candidates(processes: int = 1) -> Model:
    """The basic terms and one or two Markov processes."""
    return basic_terms() + Model((Markov(),) * processes)


@functools.lru_cache(maxsize=4)
def candidates_in_record(n: int, rate: float, processes: int) -> Candidates:
    """Basic candidates for the spectrum of n samples at `rate` [Hz]."""
    return Candidates.of(basic_candidates(processes), Bins.of(n, rate))


def rank_terms(
    candidates: Candidates, statistics: SpectralStatistics, axes: Sequence[Axis], name: str
) -> TermSelection:
    """Rank every set of noise terms by its evidence, from the statistics [axes, m] of a spectrum.

    The ramp's statistics are those of unit slope.
    """
    own = map(SpectralStatistics._make, zip(*map(np.asarray, statistics), strict=True))
    # Threads would wait for each other: a ranking is many short calls.
    each = (candidates._replace(statistics=x).ranked_for(axis) for x, axis in zip(own, axes, strict=True))
    return TermSelection(name, tuple(each))


class Candidates(NamedTuple):
    """Candidate terms, and the statistics of an axis by which sets of them are ranked.

    A set has a place for each of the `plain` terms without a free shape, and for each term with a free time;
    `owner` is the term of each place. The columns, of unit amplitude, are of the plain terms, and of the
    term with a free time at the times of a grid: `levels` [rate²] in the bins. `ramp` is the index of the
    ramp, if there is one; `size` the number of coefficients in each bin, multiplied by the share of their
    weight that it keeps.
    """

    model: Model
    bins: Bins
    ramp: int | None
    plain: int
    owner: Int[np.ndarray, " places"]
    levels: Float[np.ndarray, "columns m"]
    size: Float[np.ndarray, " m"]
    statistics: Any = None

    @classmethod
    def of(cls, model: Model, bins: Bins) -> Candidates:
        """Candidates without data. Raises AllanjaxError as `select_terms` does."""
        fixed, shaped, ramps = _sorted_terms(model := model.sampled(bins.rate))
        units = [model.terms[k] for k in fixed]
        for term in (model.terms[k] for k in shaped[:1]):
            times = correlation_times(bins.n / bins.rate, bins.rate)
            name = next(p.name for p in term.parameters()[1:] if term.is_free(p))
            units += [term.replace(**{name: float(time)}) for time in times]
        ramp, owner = ramps[0] if ramps else None, np.array(fixed + shaped)
        levels = columns_of(units, bins).mean(axis=1)
        return cls(model, bins, ramp, len(fixed), owner, levels, bins.size.astype(float))

    @property
    def sets(self) -> TermSets:
        """All sets with at most one free time."""
        columns, used, ramp, *_ = term_sets(self.plain, len(self.levels) - self.plain, self.ramp is not None)
        # No set uses the place of a second time.
        more = ((0, 0), (0, len(self.owner) - columns.shape[1]))
        return TermSets(np.pad(columns, more), np.pad(used, more), ramp)

    def with_two_times(self, found: TermSets) -> TermSets:
        """All pairs of times with what those sets with one have besides that are not far behind the best."""
        one = found.used[:, self.plain]
        near = one & (found.log_evidence > found.log_evidence[one].max() - _FAR)
        besides = np.unique(np.c_[found.used[near, : self.plain], found.ramp[near]], axis=0)
        pairs = np.array(list(itertools.combinations(range(self.plain, len(self.levels)), 2)))
        rows, each = np.repeat(besides, len(pairs), axis=0), np.tile(pairs, (len(besides), 1))
        columns = np.c_[np.tile(np.arange(self.plain), (len(rows), 1)), each]
        return TermSets(columns, np.c_[rows[:, :-1], np.ones((len(rows), 2), bool)], rows[:, -1])

    def ranked_for(self, axis: Axis) -> AxisSelection:
        """Ranking of the sets."""
        weighed, found, error = self, self.sets, 0.0
        # Where all terms together do not fit, whatever their time, no set with a time is used.
        every = found.of(found.used.all(axis=1))
        one_time = self.plain and len(self.owner) == self.plain + 1
        refused = one_time and self.error_of(self.evidence(every)) > 0.0
        found = found if refused else self.evidence(found)
        if len(self.owner) > self.plain + 1:
            pairs = self.evidence(self.with_two_times(found))
            found = TermSets(*map(np.concatenate, zip(found, pairs, strict=True)))
        if refused or self.error_of(found) > 0.0:
            # Without other terms, those with a free time are kept. Sets far behind these are not fitted yet.
            if self.plain:
                found = self.evidence(found.of(~found.used[:, self.plain :].any(axis=1)))
            for _ in range(_ROUNDS):
                error = max(error, self.error_of(found))
                share = share_with_error(self.size, self.bins.per_octave() * error**2)
                statistics = SpectralStatistics(*(share * x for x in self.statistics))
                weighed = self._replace(statistics=statistics, size=share * self.size)
                found = weighed.evidence(found._replace(power=None))
        has = np.zeros((len(found.ramp), len(self.model)), bool)
        has[:, self.owner] = found.used
        if self.ramp is not None:
            has[:, self.ramp] = found.ramp
        sets, which = np.unique(has, axis=0, return_inverse=True)
        which = which.ravel()
        # The evidence of a set with free times is the mean over the grid of times.
        each = found.log_evidence - np.log(np.bincount(which))[which]
        total = np.array([np.logaddexp.reduce(each[which == k]) for k in range(len(sets))])
        probability, labels, ranking = np.exp(total - np.logaddexp.reduce(total)), self.model.term_labels, []
        free = np.bincount([p.term for p in self.model.parameters if p.free], minlength=len(labels))
        for k in np.argsort(-total, kind="stable").tolist():
            behind, rows = float(total[k] - total.max()), np.flatnonzero(which == k)
            best = found.of(rows[[np.argmax(each[rows])]])
            known = weighed.intervals(best) if behind > -np.log(_ODDS) else {}
            names = tuple(itertools.compress(labels, sets[k]))
            ranking.append(TermSet(names, int(free @ sets[k]), behind, float(probability[k]), known))
        return AxisSelection(axis, tuple(ranking), error / 2.0, (self.bins, self.statistics))

    def evidence(self, sets: TermSets) -> TermSets:
        return evidence(sets, self.levels, self.statistics, self.size)

    def mean(self, found: TermSets) -> Float[np.ndarray, "sets m"]:
        """Expected levels of sets at the maxima of their likelihoods."""
        return np.maximum((found.power[:, None] @ self.levels[found.columns])[:, 0], 1e-300)

    def error_of(self, found: TermSets) -> float:
        """Relative error that makes the best set fit; 0 if it does."""
        best = found.of([np.argmax(found.log_evidence)])
        level, mean = self.statistics.squares / self.size, self.mean(best)
        ramps = Ramps(self.statistics.cross, self.statistics.gram, best.ramp)
        level, shape, _ = ramps.removed(level, self.size / 2.0, mean)
        ratio, dof, degrees = (level / mean)[0], 2.0 * shape[0], max(len(self.size) - 3.0, 1.0)
        if chi_squared(ratio, dof) <= beyond_doubt(degrees):
            return 0.0
        return error_of_powers(ratio, dof, self.bins.per_octave(), degrees)

    def intervals(self, best: TermSets) -> dict[str, tuple[float, float]]:
        """95 % interval of each amplitude of a set but the ramp's, by its label."""
        labels = {p.term: p.label for p in self.model.parameters if p.parameter.is_amplitude}
        power, mean = best.power[0], self.mean(best)[0]
        F = information(self.levels[best.columns[0]], mean, self.size / 2.0) * np.outer(power, power)
        # A power that few coefficients determine is as likely half as large as twice as large.
        spread = np.sqrt(np.diag(np.linalg.inv(F + np.eye(len(F)) / _WIDEST**2))) / 2.0
        ends = np.sqrt(power) * np.exp(TWO_SIDED_95 * np.array([-spread, spread]))
        every = zip(self.owner.tolist(), *ends.tolist(), strict=True)
        return {labels[k]: (low, high) for k, low, high in every if high > 0.0}


def _sorted_terms(model: Model) -> tuple[list[int], list[int], list[int]]:
    """Indices of the random terms without a free shape, of those with a free time, and of the ramp.

    Raises AllanjaxError for candidates that cannot be compared.
    """
    fixed, shaped, ramps = list[int](), list[int](), list[int]()
    for k, term in enumerate(model.terms):
        free = [p for p in term.parameters()[1:] if term.is_free(p)]
        if not term.has_free_amplitude:
            raise AllanjaxError(
                f"{term.name()}: a term with a held amplitude cannot be ranked; leave it free"
            )
        if isinstance(term, DriftRamp):
            ramps.append(k)
        elif term.deterministic or term.narrow_band or len(free) > 1 or any(p.kind != "time" for p in free):
            raise AllanjaxError(
                f"{term.name()} cannot be compared by evidence; fit with and without it, and compare the fits"
            )
        else:
            (shaped if free else fixed).append(k)
    kinds = {type(model.terms[k]) for k in shaped}
    few = 1 <= len(fixed) + len(kinds) <= 6 - len(ramps)
    if len(shaped) > 2 or len(kinds) > 1 or len(ramps) > 1 or not few:
        raise AllanjaxError(
            "select_terms takes at most six terms, not only a ramp, with at most one ramp and one term with "
            "a free time (or two of one kind); hold other times, e.g. Markov().hold(correlation_time=100.0)"
        )
    return fixed, shaped, ramps
