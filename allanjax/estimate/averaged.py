"""Coefficients and drift averaged over sets of noise terms, whichever is the right one.

Where the data do not tell a random walk from flicker noise the coefficient of either may be zero, but what
the sensor drifts by is known: each set that has a share in the probability says nearly the same. Here draws
are taken of the sets by their probability, and of the logarithms of their powers from the normal law at the
maximum of their likelihood.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from allanjax.base.equality import ByValue
from allanjax.base.wording import duration, plain
from allanjax.estimate.candidates import Candidates, Row
from allanjax.noise.estimate import Estimate
from allanjax.record.recording import Axis
from allanjax.record.units import default_coefficient_unit, unit_scale
from allanjax.spectrum.cosine import SpectralStatistics

# Draws of sets and powers, and the shortest cluster of the drift, in samples.
_DRAWS = 2000
_SHORTEST = 10
# The drift is told at decades of the cluster time up to this power of ten [s].
_LAST_DECADE = 7
# Standard deviation, in ln, of a power that the data hardly determine.
_WIDEST = 1.5
# Subsets that are less probable are not drawn from.
_IMPROBABLE = 1e-4
_QUANTILES = (0.5, 0.025, 0.975, 0.16, 0.84, 0.95)


@dataclasses.dataclass(frozen=True, eq=False)
class Averaged(ByValue):
    """Coefficients and drift averaged over sets of noise terms.

    Attributes:
        coefficients: each candidate's amplitude by its label: median and intervals over all sets, those
            without the term included. It is detected if these leave less than 2.5 % to zero.
        cluster_time: cluster times [s], octaves from ten samples to a quarter of the record.
        deviation: median Allan deviation of the noise there [rad/s or m/s²].
        interval: its 95 % interval (m, 2).
    """

    coefficients: Mapping[str, Estimate]
    cluster_time: Float[np.ndarray, " m"]
    deviation: Float[np.ndarray, " m"]
    interval: Float[np.ndarray, "m 2"]

    def told(self, axis: Axis) -> list[str]:
        """The drift in words, at 1, 10, 100, … s."""
        unit = default_coefficient_unit(axis.sensor, 0.0)
        scale, found, log_time = unit_scale(unit, axis.sensor), [], np.log(self.cluster_time)
        curves = np.log(np.column_stack([self.deviation, self.interval]) / scale)
        for decade in range(int(np.ceil(np.log10(self.cluster_time[0]))), _LAST_DECADE):
            if 10.0**decade > self.cluster_time[-1]:
                break
            middle, low, high = (np.exp(np.interp(decade * np.log(10.0), log_time, y)) for y in curves.T)
            value = f"{plain(middle, 3)} {unit} ({plain(low, 3)} … {plain(high, 3)})"
            found.append(f"averaged: Allan deviation {value} at {duration(10.0**decade)}")
        return found


def averaged(
    axis: Axis,
    candidates: Candidates,
    rows: Sequence[Row],
    weight: Float[np.ndarray, " rows"],
    statistics: SpectralStatistics,
    share: Float[np.ndarray, " m"],
) -> Averaged:
    """What the sets of one axis say together, each row with its probability."""
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
    """Draws of a subset's powers, given what unit powers contribute to the mean, relative to it."""
    there = power > 0.0
    found = np.zeros((draws, len(power)))
    # Of ln p: a power that few coefficients know is as likely half as large as twice as large.
    scaled = relative[there] * power[there, None]
    information = (scaled * (0.5 * weight)) @ scaled.T
    information += np.diag(np.full(len(information), 1.0 / _WIDEST**2))
    root = np.linalg.cholesky(np.linalg.inv(information))
    found[:, there] = power[there] * np.exp(rng.standard_normal((draws, len(root))) @ root.T)
    return found
