"""Fit of a noise model by the maximum of its exact Gaussian likelihood, computed by a Kalman filter.

The mean of the record is unknown: the likelihood is that of the differences of successive samples. From the
maximum of Whittle's likelihood, Fisher scoring climbs the exact one. Derivatives of the
innovations e and their variances s are central differences, all of them in one compiled program; with them

    score_i = −Σ e ∂_i e/s − ½ Σ ∂_i s/s·(1 − e²/s),    information_ij = Σ ∂_i e ∂_j e/s + ½ Σ ∂_i s ∂_j s/s²

(Harvey 1989, Forecasting, Structural Time Series Models and the Kalman Filter, 3.4.5). Intervals of
amplitudes are those of the likelihood ratio, the other parameters moving along their regression on the
amplitude; those of shapes are by the information.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from allanjax.base.errors import FitError
from allanjax.estimate.axis_fits import fit_whittle
from allanjax.estimate.design import free_shapes
from allanjax.estimate.gls import Solution
from allanjax.estimate.inference import ABOVE, Inference, coefficients_of
from allanjax.estimate.result import AxisFit, fitted_model
from allanjax.kalman.recursion import innovations_under, log_likelihoods
from allanjax.noise.model import Model, ModelParameter
from allanjax.noise.terms import PowerLaw
from allanjax.record.recording import Recording

#: Most samples of a record.
MOST = 100_000
# Difference for the derivatives, in units of a power's scale and in ln of shapes; least power, in its scale.
_DIFFERENCE, _LEAST = 1e-3, 1e-12
# Most steps, longest step of a shape in ln, and gain of a step [nats] below which the maximum is reached.
_STEPS, _LONGEST, _REACHED = 30, 1.0, 1e-5
# Hypothetical powers in standard deviations, below and above the estimate.
_BELOW = np.array([-7.0, -5.5, -4.5, -3.5, -3.0, -2.5, -2.0, -1.75, -1.5, -1.0, -0.5, 0.0])
_ABOVE = np.array([0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 6.0, 10.0, 20.0, 50.0, 200.0])


def check_exact(model: Model | None, recording: Recording) -> None:
    """Raise FitError if the exact likelihood cannot be used, with an alternative."""
    whittle = 'use objective="whittle" (--objective whittle)'
    if model is None:
        raise FitError(
            'objective="exact" needs a model, e.g. "N + K" (--terms); allanjax.select_terms ranks the terms'
        )
    if recording.n > MOST:
        raise FitError(
            f"{recording.name or 'the recording'}: the exact likelihood takes at most {MOST:,} samples, not "
            f"{recording.n:,}; {whittle}, which is as precise for long records, or average the samples"
        )
    for label, term in zip(model.term_labels, model.terms, strict=True):
        if term.deterministic:
            raise FitError(
                f"{label} is deterministic, but the exact likelihood takes random terms only; {whittle}"
            )
        if isinstance(term, PowerLaw) and any(term.is_free(p) for p in term.parameters()[1:]):
            raise FitError(
                f"{label} has no state space with a free exponent; hold the exponent, or {whittle}"
            )


def fit_exact(
    recording: Recording, k: int, template: Model, active: Bool[np.ndarray, " terms"]
) -> tuple[AxisFit, bool]:
    """Fit one axis by its exact likelihood, starting from Whittle's, and whether that was possible.

    Where the model does not fit the spectrum, the result is that of Whittle's likelihood.
    """
    start = fit_whittle(recording, k, template, active, {})
    missing = None if recording.missing is None else recording.missing[:, k]
    if not start.converged or start.discrepancy > 0.0:
        return start, False
    problem = _Problem.of(template, start, recording.values[:, k], recording.rate, missing)
    place, converged = problem.maximum()
    if not converged:
        reason = "the maximum of the exact likelihood was not reached; try fewer terms"
        return dataclasses.replace(start, converged=False, reason=reason), True
    solution, inference = problem.inferred(place)
    (found,) = coefficients_of(
        template, [start.axis], active[None], solution, inference, recording.n, recording.rate
    )
    fitted = {p.term_label for p in problem.parameters}
    values = {
        label: c if c.held or c.term in fitted else start.coefficients[label]
        for label, c in found.values.items()
    }
    inactive = [label for label, here in zip(template.term_labels, active, strict=True) if not here]
    return dataclasses.replace(
        start,
        _coefficients=values,
        _covariance=np.nan_to_num(found.covariance),
        _model=fitted_model(template, values, inactive),
    ), True


@dataclasses.dataclass(frozen=True, eq=False)
class _Place:
    """Parameters, and likelihood, score and information there."""

    theta: Float[np.ndarray, " p"]
    log_likelihood: float
    score: Float[np.ndarray, " p"]
    information: Float[np.ndarray, "p p"]


@dataclasses.dataclass(frozen=True, eq=False)
class _Problem:
    """Samples, and the part of the model that is fitted to them.

    Attributes:
        template, z, rate, missing: the model and the samples.
        parameters: the fitted ones: powers in units of `scale`, shapes as ln of the distance from their
            bound.
        start, scale, is_power: start, scale and kind of each.
        lower, upper: bounds of each.
        held: values of all parameters that are not fitted.
    """

    template: Model
    z: Float[np.ndarray, " n"]
    rate: float
    missing: Bool[np.ndarray, " n"] | None
    parameters: tuple[ModelParameter, ...]
    start: Float[np.ndarray, " p"]
    scale: Float[np.ndarray, " p"]
    is_power: Bool[np.ndarray, " p"]
    lower: Float[np.ndarray, " p"]
    upper: Float[np.ndarray, " p"]
    held: dict[str, float]

    @classmethod
    def of(
        cls,
        template: Model,
        found: AxisFit,
        z: Float[np.ndarray, " n"],
        rate: float,
        missing: Bool[np.ndarray, " n"] | None,
    ) -> _Problem:
        coefficients = found.coefficients
        shaped = {p.term_label for p in free_shapes(template)}
        absent = {c.term for c in coefficients.values() if c.is_amplitude and not c.value > 0.0}
        parameters, rows, held = [], [], {}
        for p in template.parameters:
            c = coefficients.get(p.label)
            if not p.free or c is None or (p.term_label in absent and p.term_label in shaped):
                # The shape of an absent term does not matter.
                own = p.start if c is None or not np.isfinite(c.value) else c.value
                held[p.label] = p.parameter.lower + 1.0 if own is None else float(own)
                continue
            parameters.append(p)
            if p.parameter.is_amplitude:
                scale = c.value**2 if c.value > 0.0 else max(float(c.upper_limit or 0.0) / 2.0, 1e-150) ** 2
                rows.append((c.value**2 / scale, scale, True, 0.0, np.inf))
                continue
            bound = p.parameter
            ends = {"time": (0.3 / rate, 30.0 * len(z) / rate), "frequency": (rate / len(z) / 9.0, rate)}
            low, high = ends.get(bound.kind, (bound.lower, bound.upper))
            low, high = max(low - bound.lower, 1e-3), min(high, bound.upper) - bound.lower
            at = np.clip(c.value - bound.lower, low, high)
            rows.append((np.log(at), 1.0, False, np.log(low), np.log(high)))
        columns: Any = [np.array(column) for column in zip(*rows, strict=True)]
        start, scale, is_power, lower, upper = columns
        return cls(template, z, rate, missing, tuple(parameters), start, scale, is_power, lower, upper, held)

    def model(self, theta: Float[np.ndarray, " p"]) -> Model:
        """The model with these parameters."""
        values = dict(self.held)
        for p, t, scale in zip(self.parameters, theta, self.scale, strict=True):
            amplitude = p.parameter.is_amplitude
            values[p.label] = float(
                np.sqrt(max(t, _LEAST) * scale) if amplitude else p.parameter.lower + np.exp(t)
            )
        return self.template.with_values(**values)

    def _innovations(
        self, thetas: Float[np.ndarray, "points p"]
    ) -> tuple[Float[np.ndarray, "points n1"], Float[np.ndarray, "points n1"]]:
        return innovations_under([self.model(t) for t in thetas], self.z, self.rate, self.missing)

    def place(self, theta: Float[np.ndarray, " p"]) -> _Place:
        """Likelihood and its derivatives at these parameters."""
        size = len(theta)
        step = _DIFFERENCE * np.where(self.is_power, np.maximum(theta, 1e-2), 1.0)
        up, down = theta + np.diag(step), theta - np.diag(step)
        # At zero power the difference is one-sided.
        down = np.where(self.is_power & (down < 0.0), theta, down)
        e, s = self._innovations(np.concatenate([theta[None], up, down]))
        width = np.diag(up - down)[:, None]
        of_e, of_s = ((x[1 : size + 1] - x[size + 1 :]) / width for x in (e, s))
        e0, s0 = e[0], s[0]
        score = -(of_e @ (e0 / s0)) - 0.5 * (of_s / s0) @ (1.0 - e0**2 / s0)
        information = (of_e / s0) @ of_e.T + 0.5 * (of_s / s0) @ (of_s / s0).T
        return _Place(theta, float(log_likelihoods(e[:1], s[:1])[0]), score, information)

    def _move(self, at: _Place) -> tuple[Float[np.ndarray, " p"], float]:
        """Step of Fisher scoring within the bounds, and the gain of likelihood that it promises."""
        low, high = self.lower - at.theta, self.upper - at.theta
        fixed = ((at.theta <= self.lower) & (at.score <= 0.0)) | (
            (at.theta >= self.upper) & (at.score >= 0.0)
        )
        move = np.zeros(len(at.theta))
        for _ in range(len(move) + 1):
            rest = ~fixed
            if rest.any():
                information = at.information[np.ix_(rest, rest)]
                target = at.score[rest] - at.information[np.ix_(rest, fixed)] @ move[fixed]
                move[rest] = np.linalg.lstsq(information, target, rcond=1e-12)[0]
            outside = rest & ((move < low) | (move > high))
            if not outside.any():
                break
            move[outside] = np.clip(move, low, high)[outside]
            fixed |= outside
        gain = float(at.score @ move - 0.5 * move @ at.information @ move)
        longest = float(np.max(np.abs(move[~self.is_power]), initial=0.0))
        return move * min(1.0, _LONGEST / longest if longest > 0.0 else 1.0), gain

    def maximum(self) -> tuple[_Place, bool]:
        """Maximum of the likelihood, and whether it was reached."""
        at = self.place(self.start)
        move, gain = self._move(at)
        for _ in range(_STEPS):
            if gain < _REACHED:
                return at, bool(np.isfinite(at.log_likelihood))
            new = self.place(np.clip(at.theta + move, self.lower, self.upper))
            if new.log_likelihood >= at.log_likelihood - 1e-9:
                at = new
                move, gain = self._move(at)
            else:
                move = move / 3.0
        return at, False

    def inferred(self, at: _Place) -> tuple[Solution, Inference]:
        """Solution and inference, as `gls.solve` and `infer` return them for one axis."""
        terms, shapes = len(self.template), free_shapes(self.template)
        labels = [p.label for p in shapes]
        places = np.array(
            [
                p.term if power else terms + labels.index(p.label)
                for p, power in zip(self.parameters, self.is_power, strict=True)
            ]
        )
        size = terms + len(shapes)
        inside = (at.theta > self.lower) & (at.theta < self.upper)
        unit = np.where(self.is_power, self.scale, 1.0)
        own = _covariance(at.information, inside)
        covariance = np.zeros((size, size))
        covariance[np.ix_(places, places)] = own * np.outer(unit, unit)
        values = np.zeros(size)
        values[places] = at.theta * unit
        # Amplitudes that are held, and shapes of absent terms.
        for p in self.template.parameters:
            if p.parameter.is_amplitude and p.label in self.held:
                values[p.term] = self.held[p.label] ** 2
            elif p.label in labels and p.label in self.held:
                values[terms + labels.index(p.label)] = np.log(self.held[p.label] - p.parameter.lower)
        power_at = np.full((terms, ABOVE + len(_ABOVE)), np.nan)
        pivot_at = power_at.copy()
        for k in map(int, np.flatnonzero(self.is_power)):
            power_at[places[k]], pivot_at[places[k]] = self._hypotheses(at, k, inside)
        found: Any = (covariance, power_at, pivot_at, np.full(terms, np.inf))
        cost = -2.0 * at.log_likelihood
        solved: Any = (values[:terms], values[terms:], 0.0, 0.0, True, cost)
        # As of several axes.
        solved, found = ([np.asarray(x)[None] for x in parts] for parts in (solved, found))
        return Solution(*solved), Inference(*found)

    def _hypotheses(
        self, at: _Place, k: int, inside: Bool[np.ndarray, " p"]
    ) -> tuple[Float[np.ndarray, " grid"], Float[np.ndarray, " grid"]]:
        """Hypothetical powers of a term, and signed roots of the likelihood ratio of each.

        For an absent term the likelihood is modified to have its maximum at zero: its negative slope there is
        removed, so that the term's limit does not shrink.
        """
        with_it = inside.copy()
        with_it[k] = True
        covariance = _covariance(at.information, with_it)
        sd, here = float(np.sqrt(covariance[k, k])), float(at.theta[k])
        below = here + _BELOW * sd
        if below[0] <= 0.0:
            below = np.linspace(0.0, here, len(_BELOW))
        v = np.concatenate([below, here + _ABOVE * sd])
        moved = (v - here)[:, None] * covariance[k] / covariance[k, k]
        shapes = np.clip(moved, -_LONGEST, _LONGEST)
        moved = np.where(self.is_power, np.maximum(moved, -0.95 * at.theta), shapes)
        moved[:, k] = v - here
        thetas = np.clip(at.theta + moved, self.lower, self.upper)
        e, s = self._innovations(thetas[v != here])
        ratio = np.zeros(len(v))
        ratio[v != here] = 2.0 * (at.log_likelihood - log_likelihoods(e, s))
        slope = max(-float(at.score[k]), 0.0) * sd if not inside[k] else 0.0
        root = np.sqrt(np.maximum(ratio, 0.0) + slope**2) - slope
        return v * self.scale[k], np.where(v < here, root, -root)


def _covariance(
    information: Float[np.ndarray, "p p"], of: Bool[np.ndarray, " p"]
) -> Float[np.ndarray, "p p"]:
    """Inverse of the information about these parameters, the others being known; zero for the others."""
    found = np.zeros_like(information)
    found[np.ix_(of, of)] = np.linalg.pinv(information[np.ix_(of, of)], rcond=1e-14, hermitian=True)
    return found
