"""The choice of noise terms: every subset of the candidates, ranked by its evidence, and their average.

Where the data cannot distinguish a random walk from flicker noise, the coefficient of either may be zero, but
the drift is known: all probable sets agree on it. For the average, sets are drawn by their probabilities, and
the logarithms of their powers from the normal law at the maximum of their likelihood.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from jaxtyping import Bool, Float

from allanjax.base.chi_squared import beyond_doubt
from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError, FitError
from allanjax.base.normal import TWO_SIDED_95
from allanjax.base.tables import Column, Number, PerAxis, column, columns_from, tables_of
from allanjax.base.wording import duration, plain
from allanjax.estimate.design import model_to_fit
from allanjax.estimate.evidence import Candidates, Row, TermSubset, sorted_terms, term_pairs, without_ramp
from allanjax.estimate.spectral.fit import chi_squared, error_of_powers, share_with_error
from allanjax.estimate.tables import SYMBOLS
from allanjax.inspection import inspect
from allanjax.inspection.facts import Fact, warnings_of
from allanjax.noise.estimate import Estimate, title_of
from allanjax.noise.model import Model
from allanjax.noise.notation import ModelLike
from allanjax.noise.terms import Markov, basic_terms
from allanjax.record.io.given import RecordingLike, as_recording
from allanjax.record.recording import Axis, Recording
from allanjax.record.units import SENSORS, default_coefficient_unit, unit_scale
from allanjax.spectrum.cosine import (
    Bins,
    SpectralStatistics,
    cosine_transform,
    joint_statistics,
    ramp_column,
    term_column,
)

if TYPE_CHECKING:
    import pandas as pd

# Number of draws of sets and powers, and the shortest cluster of the drift, in samples.
_DRAWS = 2000
_SHORTEST = 10
# Number of decades of the cluster time, from 1 s on, at which the drift is printed.
_DECADES = 7
# Standard deviation, in ln, of a power that the data hardly determine.
_WIDEST = 1.5
# Probability below which subsets are not drawn.
_IMPROBABLE = 1e-4
_QUANTILES = (0.5, 0.025, 0.975, 0.16, 0.84, 0.95)
# Bayes factor of the best set against another below which they cannot be distinguished (Kass & Raftery 1995:
# 20 is "strong").
_ODDS = 20.0
# A fit takes the simplest of the sets against which the best one has a Bayes factor below this.
_PARSIMONY = 5.0
# Posterior probability of a chosen term, summed over its sets, above which it is detected.
_CERTAIN = 0.95
# Probability below which a further term is not reported as undecided: any term may be there undetected.
_WORTH_SAYING = 0.1
# Number of times that the evidence is recomputed with the model error of the best set.
_ROUNDS = 2
# Sets more nats than this behind the best one are not tried with a second free time.
_FAR = 7.0


@dataclasses.dataclass(frozen=True, eq=False)
class Averaged(ByValue):
    """Coefficients and drift averaged over sets of noise terms.

    Attributes:
        coefficients: the candidates' amplitudes by label: median and intervals over all sets, including those
            without the term. A term is detected if zero has a probability below 2.5 %.
        cluster_time: cluster times [s], octaves from ten samples to a quarter of the record.
        deviation: median Allan deviation of the noise there [rad/s or m/s²].
        interval: its 95 % interval (m, 2).
    """

    coefficients: Mapping[str, Estimate]
    cluster_time: Float[np.ndarray, " m"]
    deviation: Float[np.ndarray, " m"]
    interval: Float[np.ndarray, "m 2"]

    def at(self, time: float) -> Float[np.ndarray, " 3"]:
        """Deviation and the ends of its interval at a cluster time [s]; nan where there is none."""
        if not self.cluster_time[0] <= time <= self.cluster_time[-1]:
            return np.full(3, np.nan)
        curves, log_time = np.log([self.deviation, *self.interval.T]), np.log(self.cluster_time)
        return np.exp([np.interp(np.log(time), log_time, y) for y in curves])


def percent(probabilities: Sequence[float]) -> str:
    """Range of probabilities, e.g. "19 %" or "19–30 %"."""
    ends = dict.fromkeys(plain(100.0 * p, 2) for p in (min(probabilities), max(probabilities)))
    return f"{'–'.join(ends)} %"


def averaged(
    axis: Axis,
    candidates: Candidates,
    rows: Sequence[Row],
    weight: Float[np.ndarray, " rows"],
    statistics: SpectralStatistics,
    share: Float[np.ndarray, " m"],
) -> Averaged:
    """Average over the sets of one axis, each row with its probability."""
    rng, bins = np.random.default_rng(0), candidates.bins
    octaves = np.log2(max(bins.n / 4.0 / _SHORTEST, 1.0))
    time = _SHORTEST / bins.rate * 2.0 ** np.arange(np.floor(octaves) + 1.0)
    units = np.stack([np.asarray(term.allan_variance(time)) for term in candidates.units])
    likely = np.flatnonzero(weight > _IMPROBABLE * weight.max())
    count = rng.multinomial(_DRAWS, weight[likely] / weight[likely].sum())
    amplitudes, variances = [], []
    for k, draws in zip(likely.tolist(), count.tolist(), strict=True):
        row, here = rows[k], rows[k].members
        mean = np.maximum(row.power @ candidates.columns[here], 1e-300)
        power = _powers(candidates.columns[here] / mean, row.power, candidates.size * share, draws, rng)
        found = np.zeros((draws, len(candidates.model)))
        found[:, candidates.owner[here]] = power
        variance = power @ units[here]
        if row.ramp:
            information = np.sum(share * statistics.gram / mean)
            slope = np.sum(share * statistics.cross / mean) / information
            drawn = slope + rng.standard_normal(draws) / np.sqrt(information)
            found[:, candidates.ramps[0]] = drawn**2
            # A ramp of R per second has σ² = R²T²/2 (4.56).
            variance = variance + np.outer(drawn**2, time**2 / 2.0)
        amplitudes.append(np.sqrt(found))
        variances.append(variance)
    values, deviation = np.concatenate(amplitudes), np.sqrt(np.concatenate(variances))
    middle, low, high = np.quantile(deviation, _QUANTILES[:3], axis=0)
    parameters = [p for p in candidates.model.parameters if p.parameter.is_amplitude]
    coefficients = {}
    for p, draws in zip(parameters, values.T, strict=True):
        median, low_95, high_95, low_68, high_68, limit = (float(x) for x in np.quantile(draws, _QUANTILES))
        coefficients[p.label] = Estimate(
            label=p.label,
            term=p.term_label,
            parameter=p.parameter,
            axis=axis,
            value=median,
            std=float(draws.std()),
            interval=(low_95, high_95),
            interval_68=(low_68, high_68),
            upper_limit=limit,
            detected=low_95 > 0.0,
            source="averaged",
        )
    return Averaged(coefficients, time, middle, np.stack([low, high], axis=1))


def _powers(
    relative: Float[np.ndarray, "some m"],
    power: Float[np.ndarray, " some"],
    weight: Float[np.ndarray, " m"],
    draws: int,
    rng: np.random.Generator,
) -> Float[np.ndarray, "draws some"]:
    """Draws of a subset's powers, given the contributions of unit powers relative to the mean."""
    there, covariance = _covariance(relative, power, weight)
    found, root = np.zeros((draws, len(power))), np.linalg.cholesky(covariance)
    found[:, there] = power[there] * np.exp(rng.standard_normal((draws, len(root))) @ root.T)
    return found


def _covariance(
    relative: Float[np.ndarray, "some m"], power: Float[np.ndarray, " some"], weight: Float[np.ndarray, " m"]
) -> tuple[Bool[np.ndarray, " some"], Float[np.ndarray, "there there"]]:
    """Which powers of a subset are above zero, and the covariance of their logarithms."""
    there = power > 0.0
    # A power that few coefficients determine is as likely half as large as twice as large.
    scaled = relative[there] * power[there, None]
    information = (scaled * (0.5 * weight)) @ scaled.T
    return there, np.linalg.inv(information + np.diag(np.full(len(information), 1.0 / _WIDEST**2)))


def _intervals(
    candidates: Candidates, row: Row, weight: Float[np.ndarray, " m"]
) -> dict[str, tuple[float, float]]:
    """95 % interval of each amplitude of a subset but the ramp's, by its label."""
    columns = candidates.columns[row.members]
    there, covariance = _covariance(columns / np.maximum(row.power @ columns, 1e-300), row.power, weight)
    labels = {p.term: p.label for p in candidates.model.parameters if p.parameter.is_amplitude}
    factor = np.exp(TWO_SIDED_95 * np.sqrt(np.diag(covariance)) / 2.0)
    values = zip(
        candidates.owner[row.members[there]].tolist(), np.sqrt(row.power[there]), factor, strict=True
    )
    return {labels[k]: (float(value / by), float(value * by)) for k, value, by in values}


@dataclasses.dataclass(frozen=True)
class TermSet:
    """Set of noise terms with its evidence.

    Attributes:
        terms: names of the terms.
        parameters: number of their free parameters.
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
        return f"<TermSet {self}: {plain(100.0 * self.probability, 3)} %, {self.parameters} parameters>"


@dataclasses.dataclass(frozen=True, eq=False)
class AxisSelection(ByValue):
    """Ranking of the sets of noise terms for one axis.

    Attributes:
        axis: the axis.
        ranking: all sets, the most probable first.
        discrepancy: relative error of the best set's root spectrum that explains its misfit; 0 if it fits.
        averaged: coefficients and drift averaged over all sets.
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
        """The best set and those that cannot be distinguished from it: Bayes factors below 20."""
        return tuple(s for s in self.ranking if s.log_evidence > self.best.log_evidence - np.log(_ODDS))

    @property
    def chosen(self) -> TermSet:
        """The set with the fewest parameters among those at most five times less probable than the best.

        Of two explanations that are hard to distinguish, it is the simpler one.
        """
        close = [s for s in self.ranking if s.log_evidence > self.best.log_evidence - np.log(_PARSIMONY)]
        return min(close, key=lambda s: (s.parameters, -s.log_evidence))

    @property
    def _compared(self) -> list[TermSet]:
        """The sets that compete with the chosen one; those with a free time if it has one."""
        free = self.chosen.parameters > len(self.chosen.terms)
        return [s for s in self.ranking if free or s.parameters == len(s.terms)]

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """95 % interval [SI] of each amplitude that covers those of all indistinguishable sets.

        Sets with a free time count only if the chosen one has one, too: a short time is like white noise.
        """
        found: dict[str, tuple[float, float]] = {}
        for label, (low, high) in (item for s in self._compared for item in s.intervals.items()):
            one, other = found.get(label, (low, high))
            found[label] = min(low, one), max(high, other)
        return found

    @property
    def inclusion(self) -> dict[str, float]:
        """Posterior probability of each term: the sum over the sets that have it."""
        names = max((s.terms for s in self.ranking), key=len)
        return {name: sum(s.probability for s in self.ranking if name in s.terms) for name in names}

    def doubtful(self) -> dict[str, tuple[str, ...]]:
        """The chosen terms whose posterior probability is below 95 %, and the terms that may replace each.

        Sets with a free time compete only if the chosen one has one, too: a long time is like a random walk.
        The rivals are terms that the sets indistinguishable from the best one need, the most probable first;
        none if the term may just as well be missing.
        """
        compared = self._compared
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
        """Table with one row per set; log-evidences are relative to the best set [nats]."""
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
        chosen, best = (f"{s} ({plain(100.0 * s.probability, 3)} %)" for s in (self.chosen, self.best))
        close = f"{len(self.indistinguishable)} of {len(self.ranking)} sets cannot be distinguished"
        return f"<AxisSelection {self.axis.name}: chosen {chosen}, best {best};\n {close}>"

    def ambiguities(self) -> tuple[str, ...]:
        """What the data leave undecided, in words, the most probable first."""
        return tuple(
            f"{question} (probabilities of the best sets: {words.format(percent([one]), percent([other]))})"
            for question, words, one, other in self.undecided()
        )

    def undecided(self) -> tuple[tuple[str, str, float, float], ...]:
        """At most three questions that the data leave undecided, the most probable first.

        Each has its text, a text for two probabilities, and these probabilities: for a term, of a set without
        it and one with it; for "one or another", of the chosen set and the other.
        """
        found = []
        for other in self.indistinguishable:
            chosen = self.chosen
            extra = [title_of(t, self.axis.sensor) for t in other.terms if t not in chosen.terms]
            missing = [title_of(t, self.axis.sensor) for t in chosen.terms if t not in other.terms]
            pair = (other, chosen) if missing and not extra else (chosen, other)
            odds = pair[0].probability, pair[1].probability
            if len(missing) == len(extra) == 1:
                found.append((f"{missing[0]} or {extra[0]}", "{} and {}", *odds))
            elif len(missing) + len(extra) == 1 and other.probability > _WORTH_SAYING:
                found.append(((missing or extra)[0], "{} without it, {} with it", *odds))
        return tuple(found[:3])


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class TermSelection(ByValue, PerAxis[AxisSelection]):
    """Ranking of sets of noise terms, for every axis of a recording.

    Attributes:
        name: name of the recording.
        results: rankings of the axes.
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
            names = ", ".join(name for name, *_ in of)
            odds = words.format(percent([one for _, one, _ in of]), percent([p for *_, p in of]))
            notes.append(f"undecided: {question} on {names} (probabilities of the best sets: {odds})")
        return tuple(notes)

    def _title(self) -> str:
        return "noise terms by evidence"

    def _tables(self) -> list[list[Column]]:
        """The sets with their probabilities, and the averaged drift at 1, 10, 100, … s."""
        rows = []
        for axis in self.results:
            for s in axis.ranking[: max(3, len(axis.indistinguishable))]:
                verdict = "chosen" if s == axis.chosen else "undecided" if s in axis.indistinguishable else ""
                terms = " + ".join(SYMBOLS.get(term, term) for term in s.terms)
                behind = f"{axis.best.log_evidence - s.log_evidence:.1f}"
                rows.append((axis.axis.name, terms, f"{100.0 * s.probability:.1f}", behind, verdict))
        heads = ("axis", "noise terms", "probability (%)", "nats behind", "verdict")
        tables = [columns_from(heads, rows)]
        for sensor in SENSORS:
            drifts = {r.axis.name: r.averaged for r in self.results if r.averaged and r.axis.sensor == sensor}
            unit = default_coefficient_unit(sensor, 0.0)
            columns = []
            for time in 10.0 ** np.arange(_DECADES):
                drift = [drift.at(time) / unit_scale(unit, sensor) for drift in drifts.values()]
                if np.isfinite(drift).any():
                    numbers = [Number(x, (high - low) / 2.0 / TWO_SIDED_95) for x, low, high in drift]
                    columns.append(column(f"σ at {duration(time)}", unit, numbers))
            tables += tables_of([Column("axis", list(drifts))], [], columns) if columns else []
        return tables

    def _notes(self) -> list[str]:
        terms = {t for axis in self.results for s in axis.ranking for t in s.terms}
        sensor = self.results[0].axis.sensor
        names = [f"{symbol}: {title_of(term, sensor)}" for term, symbol in SYMBOLS.items() if term in terms]
        drift = "σ: Allan deviation averaged over all sets by their probabilities, ± 1σ"
        return [", ".join(names), drift]


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

    The evidence (marginal likelihood) is Whittle's likelihood integrated over the coefficients by Laplace's
    method, with the boundary at zero by quadrature (see `evidence`). Unlike BIC it needs no effective number
    of samples per coefficient (about ten for a rate random walk, all for an angle random walk); unlike
    held-out likelihood it uses the few low frequencies of a drift in full. All sets have the same prior
    probability.

    Where no set fits the spectrum (p < 10⁻⁶), all are given the relative error that makes the best one fit,
    which lowers all Bayes factors; sets with a free time are then left out, as they would absorb the misfit.

    If the candidates have two Markov processes (`"N + B + K + markov + markov"`), both together are compared,
    too, beside the sets that come near the best with one of them. `averaged` of each result has coefficients
    and drift averaged over all sets by their probabilities. The segments of a recording with gaps are
    combined. Disturbed parts that `inspect` detects are left out, as by `fit`.

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
    return dataclasses.replace(ranked(quiet, candidates), facts=seen.facts)


def ranked(recording: Recording, candidates: ModelLike | None = None) -> TermSelection:
    """Ranking of the terms for a whole recording; see `select_terms`."""
    model = candidates_of(candidates, recording.rate)
    ramps = sorted_terms(model)[2]
    if recording.n < 64:
        raise FitError(
            f"{recording.name or 'the recording'}: {recording.n} samples are too few to choose terms; "
            "record at least 64 samples, or fit given terms (--terms)"
        )
    if recording.others:
        joint = joint_statistics((recording.values, *recording.others), recording.rate)
        return rank_terms(model, *joint, recording.axes, recording.name)
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
    candidates = Candidates.of(model, bins)
    statistics = SpectralStatistics(*map(np.asarray, statistics))
    share = np.ones((len(axes), len(candidates.size)))
    rows = _rows(candidates, candidates.subsets(), statistics, share)
    if len(candidates.shaped) > 1:
        more = _rows(candidates, _pairs(candidates, rows), statistics, share)
        rows = [some + others for some, others in zip(rows, more, strict=True)]
    rows, share, error = _with_error(candidates, statistics, rows)
    results = []
    for k, axis in enumerate(axes):
        ranking, weight = _ranked(candidates, rows[k], candidates.size * share[k])
        own = SpectralStatistics(*(x[k] for x in statistics))
        also = averaged(axis, candidates, rows[k], weight, own, share[k])
        results.append(AxisSelection(axis, ranking, float(error[k]) / 2.0, also))
    return TermSelection(name, tuple(results))


def _rows(
    candidates: Candidates,
    subsets: TermSubset,
    statistics: SpectralStatistics,
    share: Float[np.ndarray, "axes m"],
) -> list[list[Row]]:
    """Some subsets for each axis."""
    found = candidates.evidence(subsets, statistics, share)
    return [candidates.rows(subsets, found, k) for k in range(len(share))]


def _with_error(
    candidates: Candidates, statistics: SpectralStatistics, rows: list[list[Row]]
) -> tuple[list[list[Row]], Float[np.ndarray, "axes m"], Float[np.ndarray, " axes"]]:
    """The rows, the weights of the bins and the model's error, if no subset fits the spectrum.

    All are given the error that makes the best one fit, and those with a free time are left out.
    """
    rows, size, per_octave = list(rows), candidates.size, candidates.bins.per_octave()
    subsets = candidates.subsets()
    # Without other terms, those with a free time are kept.
    plain = TermSubset(*(x[~subsets.terms[:, -1]] for x in subsets)) if candidates.fixed else subsets

    def error_of(k: int) -> float:
        best = max(rows[k], key=lambda row: row.log_evidence)
        mean = best.power @ candidates.columns[best.members]
        own = SpectralStatistics(*(x[k] for x in statistics))
        rss, dof = without_ramp(own, size, mean, best.ramp)
        ratio, degrees = rss / np.maximum(dof, 1e-3) / mean, max(len(size) - 3.0, 1.0)
        if chi_squared(ratio, dof) <= beyond_doubt(degrees):
            return 0.0
        return error_of_powers(ratio, dof, per_octave, degrees)

    error = np.zeros(len(rows))
    incomplete = [k for k in range(len(rows)) if error_of(k) > 0.0]
    for k in incomplete if candidates.fixed else ():
        rows[k] = [row for row in rows[k] if not len(row.members) or row.members[-1] < len(candidates.fixed)]
    for _ in range(_ROUNDS if incomplete else 0):
        for k in incomplete:
            error[k] = max(error[k], error_of(k))
        again = _rows(candidates, plain, statistics, share_with_error(size, per_octave, error[:, None]))
        for k in incomplete:
            rows[k] = again[k]
    return rows, share_with_error(size, per_octave, error[:, None]), error


def _pairs(candidates: Candidates, rows: Sequence[Sequence[Row]]) -> TermSubset:
    """Subsets with two free times, from the sets that are not far behind the best one of any axis."""
    cut, near = len(candidates.fixed), set()
    for some in rows:
        shaped = [row for row in some if len(row.members) and row.members[-1] >= cut]
        best = max(row.log_evidence for row in shaped)
        near |= {(row.key(cut), row.ramp) for row in shaped if row.log_evidence > best - _FAR}
    flags = np.array([[k in key for k in range(cut)] for key, _ in sorted(near)], bool)
    ramp = np.array([ramp for _, ramp in sorted(near)], bool)
    return term_pairs(flags.reshape(len(near), cut), ramp, len(candidates.grid))


def _ranked(
    candidates: Candidates, rows: Sequence[Row], weight: Float[np.ndarray, " m"]
) -> tuple[tuple[TermSet, ...], Float[np.ndarray, " rows"]]:
    """Ranking of the sets of terms of one axis, and the probability of each row."""
    model, labels = candidates.model, candidates.model.term_labels
    names = []
    for row in rows:
        chosen = {int(candidates.owner[m]) for m in row.members} | set(candidates.ramps if row.ramp else ())
        names.append(tuple(labels[k] for k in sorted(chosen)))
    by_set: dict[tuple[str, ...], list[Row]] = {}
    for name, row in zip(names, rows, strict=True):
        by_set.setdefault(name, []).append(row)
    # The evidence of a set with free times is the mean over the grid of times.
    total = {
        s: float(np.logaddexp.reduce([row.log_evidence for row in own]) - np.log(len(own)))
        for s, own in by_set.items()
    }
    norm = float(np.logaddexp.reduce(list(total.values())))
    ranking = sorted(total.items(), key=lambda item: -item[1])
    free = {label: sum(p.free for p in model.parameters if p.term_label == label) for label in labels}
    sets = []
    for s, value in ranking:
        behind, best = value - ranking[0][1], max(by_set[s], key=lambda row: row.log_evidence)
        known = _intervals(candidates, best, weight) if behind > -np.log(_ODDS) else {}
        sets.append(TermSet(s, sum(free[k] for k in s), behind, float(np.exp(value - norm)), known))
    each = [row.log_evidence - np.log(len(by_set[name])) for name, row in zip(names, rows, strict=True)]
    return tuple(sets), np.exp(np.array(each) - norm)
