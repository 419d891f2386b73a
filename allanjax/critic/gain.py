"""Changes by a finding: of the basic coefficients, and of the drift that the model predicts."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float, Int

from allanjax.critic.finding import CoefficientChange, DriftChange
from allanjax.critic.model_evidence import SpectralMask
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
    known: dict[tuple, Float[np.ndarray, "halves m"]] = {}

    def predicted(view: View) -> Float[np.ndarray, "halves m"]:
        # The view after one finding is the view before the next, at least in its samples and its factor.
        key = id(view.samples), id(view.structure), tuple(view.allowed)
        if key not in known:
            known[key] = _predicted(view)
        return known[key]

    return [_drift_change(step, predicted) for step in steps]


def _drift_change(
    step: Step, predicted: Callable[[View], Float[np.ndarray, "halves m"]]
) -> DriftChange | None:
    """Change of the predicted drift by one finding; None if the record is too short."""
    before, after = step.before, step.candidate.after
    T, m = _horizons(before)
    if len(T) == 0:
        return None
    # Purely spectral effects have no path.
    path = None if after.samples is before.samples else before.samples - after.samples
    rows = []
    for mine, old, new in zip(_halves(before), predicted(before)[::-1], predicted(after)[::-1], strict=True):
        effect = 0.0 if path is None else _mean_squares(path[mine], m)
        rows.append((_mean_squares(before.samples[mine], m), old, new + effect))
    measured, old, new = (np.sqrt(2.0 * np.mean(part, axis=0)) * T for part in zip(*rows, strict=True))
    k = int(np.argmax(abs(np.log(np.maximum(new, 1e-300) / np.maximum(old, 1e-300)))))
    unit = ANGLE[before.axis.sensor]
    scale = unit_scale(unit, before.axis.sensor)
    found, was, now = (float(x[k] / scale) for x in (measured, old, new))
    return DriftChange(float(T[k]), found, was, now, unit)


def _horizons(view: View) -> tuple[Float[np.ndarray, " m"], Int[np.ndarray, " m"]]:
    """Times of the drift that fit into half the record, in s and in samples."""
    T = _HORIZONS[_HORIZONS * view.rate * 4.0 <= view.n // 2]
    return T, np.rint(T * view.rate).astype(int)


def _halves(view: View) -> tuple[slice, slice]:
    """First and second half of the record."""
    half = view.n // 2
    return slice(0, half), slice(half, 2 * half)


def _mean_squares(x: Float[np.ndarray, " n"], m: np.ndarray) -> Float[np.ndarray, " m"]:
    """Half the mean square difference of successive means of m samples."""
    total = np.concatenate([[0.0], np.cumsum(x - x.mean())])
    found = []
    for k in m:
        d = (total[2 * k :] - 2.0 * total[k:-k] + total[: -2 * k]) / k
        found.append(0.5 * float(np.mean(d**2)))
    return np.array(found)


def _predicted(view: View) -> Float[np.ndarray, "halves m"]:
    """Allan variances of the noise estimated from each half of the record."""
    half = view.n // 2
    _, m = _horizons(view)
    family = family_of(half, view.rate)
    # Every other coefficient of the whole record has the frequency of one of a half.
    factor = None if view.factor is None else view.factor[1 : 2 * half - 1 : 2]
    mask = SpectralMask.of(family, factor)
    found = []
    for rows in _halves(view):
        c = centred(view.samples[rows])
        if not c.any():
            # A silent half predicts no drift.
            found.append(np.zeros(len(m)))
            continue
        noise = mask.evidence(c, view.model_evidence).best(view.allowed)
        v = noise.variance if factor is None else noise.variance * factor
        ramp = family.slope(c, v)[0] if noise.ramp else 0.0
        variances = _weights(half, tuple(int(k) for k in m)) @ v
        found.append(variances + 0.5 * (ramp * m / view.rate) ** 2)
    return np.stack(found)


@functools.lru_cache(maxsize=1)
def _weights(n: int, m: tuple[int, ...]) -> Float[np.ndarray, "m n-1"]:
    """Weights of the levels of n samples in Allan variances: (1/n)·2 sin⁴(m·a/2)/(m² sin²(a/2))."""
    a = np.pi * np.arange(1, n) / n
    sine = np.sin(a / 2.0) ** 2
    return np.stack([2.0 * np.sin(k * a / 2.0) ** 4 / (sine * n * k**2) for k in m])
