"""Discrepancies between a measurement and its simulations, and those that a finding removes."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from scipy.stats import binom

from allanjax.allan.clusters import cluster_sizes
from allanjax.critic import profiles
from allanjax.critic.causes.rounding import HARMLESS
from allanjax.critic.comparison import StageResiduals, allan_laws
from allanjax.critic.finding import Discrepancy
from allanjax.critic.noise import centred
from allanjax.critic.profiles import TINY
from allanjax.inspection.plausible import lattice


def discrepancies(
    record: StageResiduals,
    raw: Float[np.ndarray, " recorded"],
    others: Mapping[str, StageResiduals] | None = None,
    auxiliary: Mapping[str, Float[np.ndarray, " n"]] | None = None,
    seed: int = 0,
) -> tuple[Discrepancy, ...]:
    """Discrepancy of one axis at one stage from its simulations in every statistic, also where p is near 1.

    Args:
        record: the axis.
        raw: its samples as recorded [SI], without those that were missing; imputed ones once a cause that
            makes them what they are was found.
        others, auxiliary: other axes and other channels, by name.
        seed: seed of the simulation in which repeated values are counted.
    """
    of_samples = [_lattice(record, raw), _repeated(record, raw, seed)]
    first = [*profiles.cluster_times(record), profiles.psd(record), profiles.line(record)]
    first += [of(record) for of in (profiles.autocorrelation, profiles.tails, profiles.largest_residual)]
    last = profiles.windows(record)
    if others:
        last.append(profiles.cross_correlation(record, others))
    if channels := _varying(auxiliary):
        last.append(profiles.auxiliary_correlation(record, channels))
    return (*(p.worst() for p in first), *of_samples, *(p.worst() for p in last))


def before_and_after(
    records: Sequence[StageResiduals], auxiliary: Mapping[str, Float[np.ndarray, " n"]] | None = None
) -> list[tuple[tuple[Discrepancy, Discrepancy], ...]]:
    """Pairs of a statistic before and after each finding, at the place where it improved it most.

    The records are those of an axis before its first finding and after each.
    """
    laws = allan_laws(records, cluster_sizes(records[0].n, records[0].rate))
    channels = _varying(auxiliary)
    stages = []
    for record, law in zip(records, laws, strict=True):
        # Those that cost little beside the transforms.
        cheap = (profiles.psd, profiles.line, profiles.tails, profiles.largest_residual)
        of_record = [profiles.allan_deviation(record, law), *(of(record) for of in cheap)]
        of_record += profiles.windows(record)
        if channels:
            of_record.append(profiles.auxiliary_correlation(record, channels))
        stages.append(of_record)
        record.forget()
    found = []
    for before, after in itertools.pairwise(stages):
        pairs = []
        for old, new in zip(before, after, strict=True):
            place = int(np.argmax(abs(old.score) ** 2 - abs(new.score) ** 2))
            pairs.append((old.at(place), new.at(place)))
        found.append(tuple(pairs))
    return found


def _varying(
    auxiliary: Mapping[str, Float[np.ndarray, " n"]] | None,
) -> dict[str, Float[np.ndarray, " n-1"]]:
    """Cosine coefficients of the channels that are finite and not constant."""
    channels = {name: np.asarray(h, float) for name, h in (auxiliary or {}).items()}
    return {name: centred(h) for name, h in channels.items() if np.isfinite(h).all() and np.ptp(h) > 0.0}


def _lattice(record: StageResiduals, raw: Float[np.ndarray, " recorded"]) -> Discrepancy:
    """Share of the samples on a lattice; one finer than the noise is only how the file writes numbers."""
    q = lattice(raw)
    if q is None or q < HARMLESS / np.sqrt(np.mean(1.0 / record.variance)):
        return Discrepancy("lattice", 0.0, "", 0.0, 0.0, "1", 1.0)
    return Discrepancy("lattice", 0.0, "", 1.0, 0.0, "1", TINY)


def _repeated(record: StageResiduals, raw: Float[np.ndarray, " recorded"], seed: int) -> Discrepancy:
    """Share of samples equal to the one before, in simulations of the recording's resolution too."""
    gaps = np.diff(np.unique(raw))
    q = float(gaps.min()) if len(gaps) else 0.0
    count = int(np.sum(raw[1:] == raw[:-1]))
    simulated = 0
    if q > 0.0:
        x = np.rint((record.simulate(seed)[: len(raw)] + float(np.mean(raw))) / q)
        simulated = int(np.sum(x[1:] == x[:-1]))
    # Two counts of one expectation: which of the two an event is in is a matter of chance.
    p = max(float(binom.sf(count - 1, count + simulated, 0.5)), TINY)
    n = len(raw) - 1
    return Discrepancy("repeated_values", 0.0, "", count / n, simulated / n, "1", p)
