"""Candidate noise terms for one kind of spectrum: what each contributes to its levels, and their subsets."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from allanjax.base.errors import AllanjaxError
from allanjax.estimate.evidence import Evidence, TermSubset, evidences, term_subsets
from allanjax.estimate.spectral.columns import columns_of
from allanjax.estimate.starts import correlation_times
from allanjax.noise.model import Model
from allanjax.noise.terms import NoiseTerm
from allanjax.spectrum.cosine import Bins, SpectralStatistics


class Row(NamedTuple):
    """Subset of the candidates, each free time with a value, as one axis sees it.

    Attributes:
        members: which of the candidates' columns it has.
        power: their powers at the maximum of the likelihood.
        ramp: whether it has a ramp.
        log_evidence: logarithm of its evidence [nats].
    """

    members: Int[np.ndarray, " some"]
    power: Float[np.ndarray, " some"]
    ramp: bool
    log_evidence: float

    def key(self, cut: int) -> tuple[int, ...]:
        """Its columns without a free shape, of which there are `cut`."""
        return tuple(int(m) for m in self.members if m < cut)


@dataclasses.dataclass(frozen=True, eq=False)
class Candidates:
    """Candidate terms with their expectations in the bins of a spectrum.

    Attributes:
        model: the terms.
        bins: the bins.
        fixed, shaped, ramps: indices of the random terms without a free shape, of those with a free time (two
            of one kind at most), and of the ramp.
        units: a term of unit amplitude for each column: those without a free shape, then each free one at
            each of its times.
        owner: index of the term that each column is of.
        columns: its expected levels [rate²].
    """

    model: Model
    bins: Bins
    fixed: tuple[int, ...]
    shaped: tuple[int, ...]
    ramps: tuple[int, ...]
    units: tuple[NoiseTerm, ...]
    owner: Int[np.ndarray, " columns"]
    columns: Float[np.ndarray, "columns m"]

    @classmethod
    def of(cls, model: Model, bins: Bins) -> Candidates:
        """Candidates as sampled. Raises AllanjaxError as `sorted_terms` does."""
        fixed, shaped, ramps = sorted_terms(model)
        times = correlation_times(bins.n / bins.rate, bins.rate)
        units, owner = [model.terms[k] for k in fixed], list(fixed)
        for k in shaped:
            term = model.terms[k]
            name = next(p.name for p in term.parameters()[1:] if term.is_free(p))
            units += [term.replace(**{name: float(time)}) for time in times]
            owner += [k] * len(times)
        units = [term.with_unit_amplitude() for term in units]
        once = columns_of(units[: len(fixed) + len(times) * min(len(shaped), 1)], bins).mean(axis=1)
        # A second one is of the same kind.
        columns = np.concatenate([once, once[len(fixed) :]]) if len(shaped) > 1 else once
        return cls(model, bins, fixed, shaped, ramps, tuple(units), np.array(owner, int), columns)

    @property
    def size(self) -> Float[np.ndarray, " m"]:
        """Number of coefficients in each bin."""
        return self.bins.size.astype(float)

    @property
    def grid(self) -> Float[np.ndarray, "grid m"]:
        """Columns of the first term with a free time; some levels if there is none."""
        if not self.shaped:
            return np.ones((1, self.columns.shape[1]))
        count = (len(self.columns) - len(self.fixed)) // len(self.shaped)
        return self.columns[len(self.fixed) :][:count]

    def subsets(self) -> TermSubset:
        """All subsets with one free time at most, those without first."""
        return term_subsets(len(self.fixed), len(self.grid) if self.shaped else 0, bool(self.ramps))

    def evidence(
        self, subsets: TermSubset, statistics: SpectralStatistics, share: Float[np.ndarray, "axes m"]
    ) -> Evidence:
        """Evidence [axes, subsets] of some subsets, and their powers."""
        fixed = self.columns[: len(self.fixed)]
        found = evidences(subsets, statistics, fixed, self.grid, self.size, share)
        return Evidence(*(np.array(x) for x in found))

    def rows(self, subsets: TermSubset, found: Evidence, axis: int) -> list[Row]:
        """The subsets that were compared, as one axis sees them."""
        cut, count = len(self.fixed), len(self.grid)
        rows = []
        for k in np.flatnonzero(found.log_evidence[axis] > -np.inf):
            places = np.flatnonzero(subsets.terms[k])
            shapes = np.append(np.arange(cut), cut + np.atleast_1d(subsets.column[k]))
            shapes[cut + 1 :] += count
            power = found.power[axis, k, places]
            rows.append(Row(shapes[places], power, bool(subsets.ramp[k]), float(found.log_evidence[axis, k])))
        return rows


def sorted_terms(model: Model) -> tuple[tuple[int, ...], tuple[int, ...], tuple[int, ...]]:
    """Indices of the random terms without a free shape, of those with a free time, and of the ramp.

    Raises:
        AllanjaxError: candidates that cannot be compared.
    """
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
    kinds = {type(model.terms[k]) for k in shaped}
    few = 1 <= len(fixed) + len(ramps) + len(kinds) <= 6
    if len(shaped) > 2 or len(kinds) > 1 or len(ramps) > 1 or not few:
        raise AllanjaxError(
            "the candidates may be at most six terms, one of them with a free time (or two of one kind) and "
            "one a ramp; hold the others' times, e.g. Markov().hold(correlation_time=100.0)"
        )
    return tuple(fixed), tuple(shaped), tuple(ramps)
