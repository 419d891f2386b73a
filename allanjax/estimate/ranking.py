"""Selection of noise terms: the evidence of every subset of the candidates."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from allanjax.base.chi_squared import beyond_doubt
from allanjax.base.errors import FitError
from allanjax.estimate.averaged import averaged
from allanjax.estimate.candidates import Candidates, Row, sorted_terms
from allanjax.estimate.design import model_to_fit
from allanjax.estimate.evidence import TermSubset, term_pairs, without_ramp
from allanjax.estimate.selection import AxisSelection, TermSelection, TermSet
from allanjax.estimate.spectral.fit import chi_squared, error_of_powers, share_with_error
from allanjax.inspection import inspect
from allanjax.noise.model import Model
from allanjax.noise.notation import ModelLike
from allanjax.noise.terms import Markov, basic_terms
from allanjax.record.io.given import RecordingLike, as_recording
from allanjax.record.recording import Axis, Recording
from allanjax.spectrum.cosine import (
    Bins,
    SpectralStatistics,
    cosine_transform,
    joint_statistics,
    ramp_column,
    term_column,
)

# Number of times that the evidence is computed anew with the error of the best set.
_ROUNDS = 2
# Sets so many nats behind the best one are not tried with a second free time.
_FAR = 7.0


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
    method, with the boundary at zero by quadrature (see `evidence`). Unlike BIC it needs no "number of
    samples" to say how sharply a coefficient is known, which is ten for a rate random walk and all for an
    angle random walk; unlike held-out likelihood it uses a drift's few low frequencies in full. All sets have
    the same prior probability.

    Where no set follows the spectrum within its scatter (p < 10⁻⁶), all are given a relative error that makes
    the best one fit, which lowers all Bayes factors; sets with a free time are left out then: it would fit
    whatever else the model lacks.

    Two Markov processes are compared, too, if the candidates have two (`"N + B + K + markov + markov"`),
    beside the sets that one of them brings near the best. What all sets say together, coefficients and drift
    averaged by their probabilities, is the `averaged` of each axis's result. Of a recording in stretches the
    evidence is that of all together. What `inspect` finds unlike the rest is left out, as by `fit`.

    Args:
        recording: what `read` returns, or what else `fit` takes.
        candidates: the terms to choose from, as `fit` takes a model; by default the five basic ones and a
            Markov process.
        axes: names of the axes; by default all.
        rate, gyro_unit, accel_unit, names: for an array, see `fit`.

    Raises:
        AllanjaxError: candidates that cannot be compared: lines, resonances and steps, a free shape that is
            no time, more than one term with a free time (but for two of one kind), more than six terms.
        FitError: a record of fewer than 64 samples.
    """
    recording = as_recording(recording, rate, gyro_unit, accel_unit, names)
    if axes is not None:
        recording = recording.select(*([axes] if isinstance(axes, str) else axes))
    seen = inspect(recording)
    quiet = recording if seen.refusal else seen.quiet(recording)
    return dataclasses.replace(ranked(quiet, candidates), facts=seen.facts)


def ranked(recording: Recording, candidates: ModelLike | None = None) -> TermSelection:
    """Ranking of the terms of all of a recording; see `select_terms`."""
    model = candidates_of(candidates, recording.rate)
    ramps = sorted_terms(model)[2]
    if recording.n < 64:
        raise FitError(
            f"{recording.name or 'the recording'}: {recording.n} samples are too few to choose terms; "
            "record at least 64"
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
        ranking, weight = _ranked(candidates, rows[k])
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
    """Some subsets as each axis sees them."""
    found = candidates.evidence(subsets, statistics, share)
    return [candidates.rows(subsets, found, k) for k in range(len(share))]


def _with_error(
    candidates: Candidates, statistics: SpectralStatistics, rows: list[list[Row]]
) -> tuple[list[list[Row]], Float[np.ndarray, "axes m"], Float[np.ndarray, " axes"]]:
    """The rows, the weights of the bins and the model's error, where no subset follows the spectrum.

    All are given the error that makes the best one follow it, and those with a free time are left out.
    """
    rows, size, per_octave = list(rows), candidates.size, candidates.bins.per_octave()
    subsets = candidates.subsets()
    # Without other terms there is nothing to prefer to a free time.
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
    """Subsets with two free times, beside the sets that are not far behind the best one of some axis."""
    cut, near = len(candidates.fixed), set()
    for some in rows:
        shaped = [row for row in some if len(row.members) and row.members[-1] >= cut]
        best = max(row.log_evidence for row in shaped)
        near |= {(row.key(cut), row.ramp) for row in shaped if row.log_evidence > best - _FAR}
    flags = np.array([[k in key for k in range(cut)] for key, _ in sorted(near)], bool)
    ramp = np.array([ramp for _, ramp in sorted(near)], bool)
    return term_pairs(flags.reshape(len(near), cut), ramp, len(candidates.grid))


def _ranked(
    candidates: Candidates, rows: Sequence[Row]
) -> tuple[tuple[TermSet, ...], Float[np.ndarray, " rows"]]:
    """Ranking of the sets of terms of one axis, and the probability of each row."""
    model, labels = candidates.model, candidates.model.term_labels
    names = []
    for row in rows:
        chosen = {int(candidates.owner[m]) for m in row.members} | set(candidates.ramps if row.ramp else ())
        names.append(tuple(labels[k] for k in sorted(chosen)))
    by_set: dict[tuple[str, ...], list[float]] = {}
    for name, row in zip(names, rows, strict=True):
        by_set.setdefault(name, []).append(row.log_evidence)
    # The evidence of a set with free times is the mean over the grid of times.
    total = {s: float(np.logaddexp.reduce(v) - np.log(len(v))) for s, v in by_set.items()}
    norm = float(np.logaddexp.reduce(list(total.values())))
    ranking = sorted(total.items(), key=lambda item: -item[1])
    free = {label: sum(p.free for p in model.parameters if p.term_label == label) for label in labels}
    sets = tuple(
        TermSet(s, sum(free[label] for label in s), value - ranking[0][1], float(np.exp(value - norm)))
        for s, value in ranking
    )
    each = [row.log_evidence - np.log(len(by_set[name])) for name, row in zip(names, rows, strict=True)]
    return sets, np.exp(np.array(each) - norm)
