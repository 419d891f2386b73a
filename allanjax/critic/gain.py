"""Changes by a finding: of the basic coefficients, and of the drift that the model predicts."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from allanjax.critic.comparison import NarrowBins, allan_weights
from allanjax.critic.finding import CoefficientChange, DriftChange
from allanjax.critic.model_evidence import ModelEvidence
from allanjax.critic.noise import FIXED, MARKOV, centred, family_of
from allanjax.critic.profiles import ANGLE
from allanjax.critic.step import Step
from allanjax.critic.view import View
from allanjax.estimate.spectral.components import COLUMN, WIDE
from allanjax.estimate.spectral.components import MARKOV as PROCESS
from allanjax.estimate.structure.structure import FIXED as COLUMNS
from allanjax.estimate.structure.structure import Structure, term_of
from allanjax.noise.terms import Markov, basic_terms
from allanjax.record.units import default_coefficient_unit, unit_scale
from allanjax.spectrum.cosine import SpectralStatistics

# Times over which drift is predicted [s].
_HORIZONS = 4.0 ** np.arange(0.0, 10.0)
# Name of white noise among the basic terms.
_N = "angle_random_walk"


def coefficient_changes(step: Step) -> tuple[CoefficientChange, ...]:
    """Changes of every basic coefficient that is in the noise before or after a finding."""
    views = step.before, step.candidate.after
    # Spectral structure is fitted jointly with the terms, waveforms in time are not.
    jointly = views[0].structure is not views[1].structure
    before, after = (
        dict(v.noise.power) if v.structure is None or not jointly else _of_structure(v.structure, v.rate)
        for v in views
    )
    sensor = step.before.axis.sensor
    changes = []
    for name in (*FIXED, MARKOV):
        if name not in before and name not in after:
            continue
        term = Markov() if name == MARKOV else basic_terms()[name]
        unit = default_coefficient_unit(sensor, term.amplitude_parameter().time_exponent)
        scale = unit_scale(unit, sensor)
        old, new = (float(np.sqrt(p[name])) / scale if name in p else float("nan") for p in (before, after))
        changes.append(CoefficientChange(name, old, new, unit))
    return tuple(changes)


def _of_structure(structure: Structure, rate: float) -> dict[str, float]:
    """Squared coefficients of the basic terms that were fitted jointly with filter and resonances.

    A wide resonance is white noise at low frequencies, of N² = σ²/(π·f0·Q): an angle grows by both.
    """
    power: dict[str, float] = {}
    for k in structure.there:
        own = structure.components[k]
        if own.kind == COLUMN and own.which < len(COLUMNS):
            power[COLUMNS[own.which]] = own.power
        elif own.kind == PROCESS:
            term = term_of(structure, k, rate)
            power[MARKOV] = (
                power.get(MARKOV, 0.0) + float(getattr(term, term.amplitude_parameter().name)) ** 2
            )
    for own in map(structure.components.__getitem__, structure.oscillators):
        if own.quality < WIDE:
            width = np.pi * own.frequency * rate / (2.0 * np.pi) * own.quality
            power[_N] = power.get(_N, 0.0) + own.power / width
    return power


def drift_changes(steps: Sequence[Step]) -> list[DriftChange | None]:
    """Drift predicted for one half of the record from the noise of the other, before and after each finding.

    The drift over a time T is the integral of the rate over T less that over the T before: its mean square is
    2T² times the Allan variance. It is given at the time at which the finding changes the prediction most,
    both halves taken together. An effect with a waveform drifts as the waveform does.
    """
    known: dict[int, _Halves] = {}

    def halves(view: View) -> _Halves:
        # The view after one finding is the view before the next, at least in its samples.
        return known.setdefault(id(view.samples), _Halves(view.samples, view.rate))

    return [_drift_change(step, halves(step.before), halves(step.candidate.after)) for step in steps]


def _drift_change(step: Step, before: _Halves, after: _Halves) -> DriftChange | None:
    """Change of the predicted drift by one finding; None if the record is too short."""
    axis, m = step.before.axis, before.m
    if len(m) == 0:
        return None
    new = after.predicted(step.candidate.after)
    if after is not before:
        # Purely spectral effects have no path.
        new = new + _mean_squares(before.samples - after.samples, m)
    T, rows = m / before.rate, (before.measured, before.predicted(step.before), new)
    measured, old, new = (np.sqrt(2.0 * np.mean(row, axis=0)) * T for row in rows)
    k = int(np.argmax(abs(np.log(np.maximum(new, 1e-300) / np.maximum(old, 1e-300)))))
    unit = ANGLE[axis.sensor]
    scale = unit_scale(unit, axis.sensor)
    found, was, now = (float(x[k] / scale) for x in (measured, old, new))
    return DriftChange(float(T[k]), found, was, now, unit)


class _Halves:
    """Halves of a record's samples, each of which predicts the drift of the other."""

    def __init__(self, samples: Float[np.ndarray, " n"], rate: float) -> None:
        self.samples, self.rate, self.half = samples, rate, len(samples) // 2
        self.m = np.rint(_HORIZONS[_HORIZONS * rate * 4.0 <= self.half] * rate).astype(int)
        self._known: dict[tuple, Float[np.ndarray, "halves m"]] = {}

    @functools.cached_property
    def measured(self) -> Float[np.ndarray, "halves m"]:
        """Allan variances of the halves."""
        return _mean_squares(self.samples, self.m)

    @functools.cached_property
    def coefficients(self) -> list[Float[np.ndarray, " half-1"]]:
        """Cosine coefficients of the halves."""
        return [centred(x) for x in _halves(self.samples)]

    def predicted(self, view: View) -> Float[np.ndarray, "halves m"]:
        """Allan variances of each half by the noise of the other, with the terms and the factor of a view."""
        key = id(view.structure), tuple(view.allowed)
        if key not in self._known:
            self._known[key] = self._predicted(view)
        return self._known[key]

    def _predicted(self, view: View) -> Float[np.ndarray, "halves m"]:
        half = self.half
        family, bins = family_of(half, view.rate), NarrowBins.of(half)
        weights = allan_weights(half, tuple(self.m.tolist()))
        # Every other coefficient of the whole record has the frequency of one of a half.
        factor = None if view.factor is None else view.factor[1 : 2 * half - 1 : 2]
        evidences = [ModelEvidence.of(family, c, factor) for c in self.coefficients]
        both = _joint(evidences)
        found = []
        for c, evidence in zip(self.coefficients, evidences, strict=True):
            if not c.any():
                # A silent half predicts no drift.
                found.append(np.zeros(len(self.m)))
                continue
            noise = dataclasses.replace(evidence, like=both, known={}).best(view.allowed)
            v = noise.variance if factor is None else noise.variance * factor
            ramp = family.slope(c, v)[0] if noise.ramp else 0.0
            found.append(weights @ bins.sums(v) + 0.5 * (ramp * self.m / view.rate) ** 2)
        return np.stack(found[::-1])


def _joint(evidences: Sequence[ModelEvidence]) -> ModelEvidence:
    """Evidence of the subsets of the noise terms, given several records of one length under one factor."""
    levels = SpectralStatistics(*(sum(x) for x in zip(*(e.levels for e in evidences), strict=True)))
    first, count = evidences[0], len(evidences)
    return dataclasses.replace(
        first, levels=levels, size=count * first.size, constant=count * first.constant, known={}
    )


def _halves(x: Float[np.ndarray, " n"]) -> tuple[Float[np.ndarray, " half"], Float[np.ndarray, " half"]]:
    """First and second half of a record."""
    half = len(x) // 2
    return x[:half], x[half : 2 * half]


def _mean_squares(x: Float[np.ndarray, " n"], m: Int[np.ndarray, " m"]) -> Float[np.ndarray, "halves m"]:
    """Half the mean square difference of successive means of m samples, in either half of a record."""
    found = np.empty((2, len(m)))
    for row, y in zip(found, _halves(x), strict=True):
        total = np.concatenate([[0.0], np.cumsum(y - y.mean())])
        for i, k in enumerate(m):
            d = total[k:-k] * -2.0
            d += total[2 * k :]
            d += total[: -2 * k]
            row[i] = 0.5 * float(d @ d) / (len(d) * k**2)
    return found
