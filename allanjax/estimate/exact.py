"""Fits of single axes by the exact Gaussian likelihood, computed by a Kalman filter.

The mean of the record is unknown: the likelihood is that of the differences of successive samples. From the
maximum of Whittle's likelihood, Fisher scoring climbs the exact one. With the innovations e, their variances
s, and their derivatives by central differences, score and information are

    −Σ e ∂_i e/s − ½ Σ ∂_i s/s·(1 − e²/s)    and    Σ ∂_i e ∂_j e/s + ½ Σ ∂_i s ∂_j s/s²

(Harvey 1989, Forecasting, Structural Time Series Models and the Kalman Filter, 3.4.5): a step is least
squares. Intervals of amplitudes come from the likelihood ratio, with the other parameters moving along their
regression on the amplitude; intervals of shapes come from the information matrix.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float

from allanjax.base.errors import FitError
from allanjax.estimate.axis_fits import absent, fit_spectrum
from allanjax.estimate.design import INSIDE, free_shapes
from allanjax.estimate.deterministic import AxisSpectrum, InUse
from allanjax.estimate.inference import coefficients_of, ends_of, estimates_of
from allanjax.estimate.result import AxisFit, fitted_model
from allanjax.kalman.recursion import innovations_under, log_likelihoods
from allanjax.noise.model import Model
from allanjax.noise.terms import PowerLaw
from allanjax.record.recording import Recording

_Vector: TypeAlias = Float[np.ndarray, " p"]
_Square: TypeAlias = Float[np.ndarray, "p p"]
_Flags: TypeAlias = Bool[np.ndarray, " p"]

#: Most samples of a record.
MOST = 100_000
# Difference for the derivatives, and least power, in units of a power and in ln of shapes.
_DIFFERENCE, _LEAST = 1e-3, 1e-12
# Most steps; gain of a step [nats] below which the maximum is reached; and in ln of a shape the longest step,
# and bounds about its start.
_MOST_STEPS, _REACHED, _LONGEST, _REACH = 30, 1e-5, 1.0, 4.0
# Hypothetical powers: number and lowest of those below the estimate, and those above, in standard deviations.
_BELOW, _LOWEST = 12, -7.0
_ABOVE = np.array([0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 6.0, 10.0, 20.0, 50.0, 200.0])


def check_exact(model: Model | None, recording: Recording) -> None:
    """Raise FitError if the exact likelihood cannot be used, with an alternative."""
    whittle = 'use objective="whittle" (--objective whittle)'
    if model is None:
        raise FitError(
            'objective="exact" needs a model, e.g. "N + K" (--terms); select_terms ranks the terms'
        )
    if recording.n > MOST:
        raise FitError(
            f"{recording.name or 'the recording'}: the exact likelihood takes at most {MOST:,} samples, not "
            f"{recording.n:,}; {whittle}, which is as precise for long records, or average the samples"
        )
    for label, term in zip(model.term_labels, model.terms, strict=True):
        if term.deterministic:
            raise FitError(
                f"{label} is deterministic, but the exact likelihood is of random terms; {whittle}"
            )
        if isinstance(term, PowerLaw) and any(term.is_free(p) for p in term.parameters()[1:]):
            raise FitError(f"{label} has no state space with a free exponent; hold it, or {whittle}")


def fit_exact(recording: Recording, k: int, template: Model, active: InUse) -> tuple[AxisFit, bool]:
    """Fit one axis by its exact likelihood, starting from Whittle's, and whether that was possible.

    Where the model does not fit the spectrum, the result is that of Whittle's likelihood.
    """
    spectrum = AxisSpectrum.of(template, recording.values[:, k], recording.rate)
    start = fit_spectrum(template, recording.axes[k], spectrum, active)
    if not start.converged or start.discrepancy > 0.0:
        return start, False
    problem = _Problem(template, start, recording, k)
    at = problem.maximum()
    if at is None:
        reason = "the maximum of the exact likelihood was not reached; try fewer terms"
        return dataclasses.replace(start, converged=False, reason=reason), True
    estimates = estimates_of(template, active[None], *(x[None] for x in problem.inferred(at)))
    others = {label: c for label, c in start.coefficients.items() if c.term in problem.left_out}
    place = recording.n, recording.rate
    values, covariance = coefficients_of(template, start.axis, template, estimates, others, *place)
    model = fitted_model(template, values, absent(template, active))
    return dataclasses.replace(start, _coefficients=values, _covariance=covariance, _model=model), True


class _Place(NamedTuple):
    """Parameters, their likelihood, its score and information, the next step, and its expected gain."""

    theta: _Vector
    log_likelihood: float
    score: _Vector
    information: _Square
    step: _Vector
    gain: float

    def covariance(self, of: _Flags) -> _Square:
        """Covariance of these parameters if the others are known."""
        return np.linalg.pinv(self.information * np.outer(of, of), rcond=1e-14, hermitian=True)


class _Problem:
    """Samples and parameters: powers of all terms, each in its `unit`, and ln(shape − lower bound) if free.

    `moves` tells which are fitted; `left_out` are labels of absent terms with shapes, which are not.
    """

    def __init__(self, template: Model, found: AxisFit, recording: Recording, k: int) -> None:
        missing = None if recording.missing is None else recording.missing[:, k]
        self.template, self.data = template, (recording.values[:, k], recording.rate, missing)
        shapes, every = free_shapes(template), found.coefficients
        parameters = (*(p for p in template.parameters if p.parameter.is_amplitude), *shapes)
        value, terms = np.array([every[p.label].value for p in parameters]), len(template)
        limit = np.array([every[p.label].upper_limit or 0.0 for p in parameters])
        self.labels, self.is_power = [p.label for p in parameters], np.arange(len(value)) < terms
        self.left_out = {p.term_label for p in shapes if p.term < terms and not value[p.term] > 0.0}
        self.moves = np.array([p.free and p.term_label not in self.left_out for p in parameters])
        amplitude = np.where(value > 0.0, value, np.maximum(limit / 2.0, 1e-150))
        self.unit = np.where(self.is_power, amplitude**2, 1.0)
        self.origin, end = np.array([(p.parameter.lower, p.parameter.upper) for p in parameters]).T
        # The shape of an absent term does not matter.
        distance = np.where(np.isfinite(value) & ~self.is_power, value - self.origin, 1.0)
        self.start = np.where(self.is_power, value**2 / self.unit, np.log(distance))
        self.lower = np.where(self.is_power, 0.0, self.start - _REACH)
        highest = np.maximum(np.log(end - self.origin) - INSIDE, self.start)
        self.upper = np.where(self.is_power, np.inf, np.minimum(highest, self.start + _REACH))

    def innovations(self, thetas: Float[np.ndarray, "points p"]) -> tuple[np.ndarray, np.ndarray]:
        """Innovations [points, n − 1] under models with these parameters, and their variances."""
        shape = self.origin + np.exp(np.where(self.is_power, 0.0, thetas))
        rows = np.where(self.is_power, np.sqrt(np.maximum(thetas, _LEAST) * self.unit), shape).tolist()
        models = [self.template.with_values(**dict(zip(self.labels, row, strict=True))) for row in rows]
        return innovations_under(models, *self.data)

    def place(self, theta: _Vector) -> _Place:
        """Likelihood and its derivatives at these parameters."""
        from scipy.optimize import lsq_linear

        move = np.diag(_DIFFERENCE * np.where(self.is_power, np.maximum(theta, 1e-2), 1.0))[self.moves]
        # At zero power the difference is one-sided.
        up, down = theta + move, np.where(self.is_power, np.maximum(theta - move, 0.0), theta - move)
        e, s = self.innovations(np.concatenate([theta[None], up, down]))
        width = np.sum(up - down, axis=1)[:, None]
        of_e, of_s = ((x[1 : len(up) + 1] - x[len(up) + 1 :]) / width for x in (e, s))
        columns = np.concatenate([of_e / np.sqrt(s[0]), of_s / s[0] / np.sqrt(2.0)], axis=1).T
        target = np.concatenate([-e[0] / np.sqrt(s[0]), (e[0] ** 2 / s[0] - 1.0) / np.sqrt(2.0)])
        R = np.nan_to_num(np.linalg.qr(np.column_stack([columns, target]), mode="r"))
        m, b, A, step = self.moves, R[:, -1], np.zeros((len(R), len(theta))), np.zeros(len(theta))
        A[:, m] = R[:, :-1]
        longest = np.where(self.is_power, np.inf, _LONGEST)
        low, high = np.maximum(self.lower - theta, -longest), np.minimum(self.upper - theta, longest)
        # Fisher scoring within the bounds.
        step[m] = lsq_linear(A[:, m], b, (low[m], high[m] + 1e-12), "bvls").x
        gain = float(b @ A @ step - 0.5 * np.sum((A @ step) ** 2))
        log_likelihood = log_likelihoods(e[:1], s[:1])
        return _Place(theta, float(log_likelihood[0]), A.T @ b, A.T @ A, step, gain)

    def maximum(self) -> _Place | None:
        """Maximum of the likelihood, if it was reached."""
        at, share = self.place(self.start), 1.0
        for _ in range(_MOST_STEPS):
            if at.gain < _REACHED:
                return at if np.isfinite(at.log_likelihood) else None
            new = self.place(np.clip(at.theta + share * at.step, self.lower, self.upper))
            higher = new.log_likelihood >= at.log_likelihood - 1e-9
            at, share = (new, 1.0) if higher else (at, share / 3.0)
        return None

    def inferred(self, at: _Place) -> tuple[_Vector, _Vector, np.ndarray, np.ndarray]:
        """Powers, shapes, their covariance and the ends of the powers' intervals, as `estimates_of` wants."""
        terms, value = len(self.template), at.theta * self.unit
        inside = self.moves & (at.theta > self.lower) & (at.theta < self.upper)
        ends = np.full((terms, 5), np.nan)
        for k in np.flatnonzero(self.moves[:terms]).tolist():
            ends[k] = self._ends(at, k, inside)
        return value[:terms], value[terms:], at.covariance(inside) * np.outer(self.unit, self.unit), ends

    def _ends(self, at: _Place, k: int, inside: _Flags) -> Float[np.ndarray, " 5"]:
        """Ends of the intervals of a power, where the signed roots of the likelihood ratio have their levels.

        For an absent term the likelihood is modified to have its maximum at zero: its negative slope there is
        removed, so that the term's limit does not shrink.
        """
        covariance = at.covariance(inside | (np.arange(len(inside)) == k))
        sd, here = float(np.sqrt(covariance[k, k])), float(at.theta[k])
        below = np.linspace(max(here + _LOWEST * sd, 0.0), here, _BELOW)
        v = np.unique([*below, *(here + _ABOVE * sd)])
        least = np.where(self.is_power, 0.05 * at.theta, at.theta - _LONGEST)
        most = np.minimum(np.where(self.is_power, np.inf, at.theta + _LONGEST), self.upper)
        thetas = np.clip(at.theta + (v - here)[:, None] * covariance[k] / sd**2, least, most)
        thetas[:, k] = v
        ratio = np.maximum(2.0 * (at.log_likelihood - log_likelihoods(*self.innovations(thetas))), 0.0)
        slope = 0.0 if inside[k] else max(-float(at.score[k]), 0.0) * sd
        root = np.where(v == here, 0.0, np.sqrt(ratio + slope**2) - slope)
        both = np.stack([v * self.unit[k], root])[:, None]
        return ends_of((*both[..., v <= here][..., ::-1],), (*both[..., v >= here],), np.full(1, np.inf))[0]
