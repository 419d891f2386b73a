"""The joint spectral model: expected levels as a function of its parameters, and its maximum likelihood.

Powers and shapes are in slots:

    μ = R·Σ p_c S_c (what is inside the response R) + Σ p_c S_c (what is after it)

A slot is idle where its power is zero and not estimated.

The likelihood is maximized by Fisher scoring. A power is moved in ln(p + s), s being one standard deviation
of a power that is not there: linearly below that, where the data hardly show it, logarithmically above.
Parameters are known with very different precision, a resonance's frequency to 10⁻⁴ and a long correlation
time to a factor; so the damping is proportional to the diagonal of the information (Marquardt 1963), not to
the identity.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from allanjax.estimate.spectral.components import (
    NONE,
    Levels,
    bandwidths,
    markov_and_slope,
    oscillator_and_slopes,
    passed_and_slopes,
)
from allanjax.estimate.spectral.expected import Others

# Damping of the first step, relative to the information; shares of the predicted gain above which it falls
# and below which a step is taken back; and by what factors it changes.
_DAMPING, _GOOD, _BAD, _LESS, _MORE = 0.01, 0.5, 0.01, 1.0 / 6.0, 1.0 / 0.15
# Largest damping with which a small step ends the iteration, and with which any does.
_SLACK, _STUCK = 0.1, 1e8
# Expected gains of a step [nats]: of one that is taken in any case, and of one that is near the maximum.
_SMALL, _NEARBY = 1e-8, 1.0
# Longest step of a parameter, in ln.
_LONGEST = 2.0
# Excess of a level over its expectation below which a series is used, and the least ratio of the two.
_CLOSE, _LOWEST = 1e-4, 1e-12
# Gain of the next step [nats] at which a fit ends, and most steps.
_TOLERANCE = 1e-11
_STEPS = 200
# Smallest expected level, in units of the largest scale of a power.
_LEAST = 1e-30
# Bounds of powers [rate²], correlation times [samples], frequencies [radians per sample], Q − ½, and the
# shapes of other terms [SI], in ln but for powers.
_POWER, _TIME, _FREQUENCY, _QUALITY, _SHAPE = (
    (0.0, np.inf),
    (-3.0, 40.0),
    (-30.0, np.log(np.pi)),
    (-7.0, 14.0),
    (-60.0, 60.0),
)


class Layout:
    """Numbers of slots, and the first index of each kind of component and of parameter.

    The parameters are the powers of all components, then the correlation times of Markov processes,
    frequencies and quality factors of oscillators, the free shapes of other terms, and bandwidth and quality
    factor of the response.
    """

    def __init__(
        self, columns: int = 8, markovs: int = 4, oscillators: int = 12, others: int = 0, shapes: int = 0
    ) -> None:
        """Slots for terms without a free shape (columns), two kinds with them, and others with so many."""
        self.columns, self.markovs, self.oscillators = columns, markovs, oscillators
        self.others, self.shapes = others, shapes
        ends = np.cumsum([columns, markovs, oscillators, others]).tolist()
        self.first_markov, self.first_oscillator, self.first_other, self.components = ends
        self.times = self.components
        ends = np.cumsum([self.times + markovs, oscillators, oscillators, shapes, 2]).tolist()
        self.frequencies, self.qualities, self.other_shapes, self.response, self.parameters = ends


#: Slots of every model that needs no more.
FULL = Layout()


@dataclasses.dataclass(frozen=True)
class Slots:
    """Components and parameters of a joint spectral model.

    Components inside pass through the response, of a kind of `components`. Parameters that are not free keep
    their value; the others have bounds, powers not in ln, and a normal prior, unless its precision is 0.
    Others are terms whose free shapes fit no slot.
    """

    layout: Layout
    inside: Bool[np.ndarray, " components"]
    kind: int
    free: Bool[np.ndarray, " parameters"]
    lower: Float[np.ndarray, " parameters"]
    upper: Float[np.ndarray, " parameters"]
    centre: Float[np.ndarray, " parameters"]
    precision: Float[np.ndarray, " parameters"]
    others: Others | None

    @classmethod
    def of(
        cls,
        layout: Layout,
        free: Bool[np.ndarray, " parameters"],
        inside: Bool[np.ndarray, " components"],
        kind: int = NONE,
        others: Others | None = None,
    ) -> Slots:
        """Slots with the widest bounds and no prior."""
        bandwidth = tuple(np.log(bandwidths(kind)))
        bounds = (_POWER, _TIME, _FREQUENCY, _QUALITY, _SHAPE, bandwidth, _QUALITY)
        counts = (layout.components, layout.markovs, *[layout.oscillators] * 2, layout.shapes, 1, 1)
        lower, upper = np.repeat(np.array(bounds), counts, axis=0).T.copy()
        return cls(layout, inside, kind, free, lower, upper, 0.0 * lower, 0.0 * lower, others)

    def usual(self) -> Float[np.ndarray, " parameters"]:
        """Parameters with zero powers, and with shapes in the middle of their ranges."""
        at = self.layout
        theta = np.zeros(at.parameters)
        theta[at.times : at.frequencies] = np.log(100.0)
        theta[at.qualities : at.other_shapes] = np.log(5.0)
        return theta


class Expected(NamedTuple):
    """Expected levels of components of unit power [rate²], zero for idle slots, and their derivatives.

    These are by the shapes, each of which has a component as its owner, and of the sum of all components by
    bandwidth and quality factor of the response.
    """

    unit: Float[np.ndarray, "components m"]
    by_shape: Float[np.ndarray, "shapes m"]
    owner: Int[np.ndarray, " shapes"]
    by_response: Float[np.ndarray, "2 m"]

    def slope(self, power: Float[np.ndarray, " components"]) -> Float[np.ndarray, "parameters m"]:
        """Derivatives of the expected levels by the parameters."""
        return np.concatenate([self.unit, power[self.owner, None] * self.by_shape, self.by_response])


def expected(theta: Float[np.ndarray, " parameters"], slots: Slots, levels: Levels) -> Expected:
    """Expected levels of all components of unit power, each differentiated by its own shapes only."""
    at, m, power = slots.layout, levels.angle.shape[1], theta[: slots.layout.components]
    used = np.flatnonzero((power > 0.0) | slots.free[: at.components])
    # Columns that are not in use have levels, too, for their limits.
    column = np.arange(len(levels.columns))
    markov = used[(used >= at.first_markov) & (used < at.first_oscillator)]
    oscillator = used[(used >= at.first_oscillator) & (used < at.first_other)]
    time, nth = at.times + markov - at.first_markov, oscillator - at.first_oscillator
    frequency, quality = at.frequencies + nth, at.qualities + nth
    of_markov, by_time = markov_and_slope(levels, theta[time])
    of_oscillator, *by_both = oscillator_and_slopes(levels, theta[frequency], theta[quality])
    of_other, by_own, own = np.zeros((0, 2, m)), np.zeros((0, 2, m)), np.zeros(0, int)
    if slots.others is not None:
        own = at.first_other + np.array([k for k, *_ in slots.others.shapes])
        of_other, by_own = slots.others.squares_and_slopes(theta[at.other_shapes : at.response], m)
    component = np.concatenate([column, markov, oscillator, np.arange(at.first_other, at.components)])
    squares = np.concatenate([levels.columns, of_markov, of_oscillator, of_other])
    shape = np.concatenate([time, frequency, quality, np.arange(at.other_shapes, at.response)]) - at.times
    slopes = np.concatenate([by_time, *by_both, by_own])
    slot = np.arange(at.first_markov, at.first_other)
    owner = np.concatenate([slot, slot[at.markovs :], own])
    passed, moved = passed_and_slopes(levels, theta[at.response :], slots.kind)
    unit, by_shape, inside = np.zeros((at.components, m)), np.zeros((len(owner), m)), slots.inside
    for into, rows, of, values in (
        (unit, component, component, squares),
        (by_shape, shape, owner[shape], slopes),
    ):
        values = values * np.where(inside[of, None, None], passed, 1.0) if slots.kind else values
        into[rows] = 0.5 * (values[:, 0] + values[:, 1])
    passing = np.tensordot(power[component] * inside[component], squares, 1)
    return Expected(unit, by_shape, owner, np.mean(moved * passing, axis=1))


class Maximum(NamedTuple):
    """Maximum of the likelihood, or a place on the way there.

    Attributes:
        theta: the parameters there.
        scale: power of each component that would be one standard deviation: powers are in ln(p + scale).
        loss: minus the log-likelihood of the levels, without what depends on the data alone, prior included:
            Σ k(ln μ + y/μ).
        mean: the expected levels [rate²].
        model: expected levels of each component, and their derivatives.
        information: Fisher's information of the parameters that are estimated and not at a bound, prior
            included; the others have a unit on the diagonal.
        interior: which parameters these are.
        steps: number of steps taken.
        converged: whether the iteration converged.
    """

    theta: Float[np.ndarray, " parameters"]
    scale: Float[np.ndarray, " components"]
    loss: float
    mean: Float[np.ndarray, " m"]
    model: Expected
    information: Float[np.ndarray, "parameters parameters"] = np.zeros((0, 0))
    interior: Bool[np.ndarray, " parameters"] = np.zeros(0, bool)
    steps: int = 0
    converged: bool = False

    @property
    def slope(self) -> Float[np.ndarray, "parameters m"]:
        """Derivatives of the logarithms of the levels by ln(p + scale) of the powers and by the shapes."""
        power = self.theta[: len(self.scale)]
        slope = self.model.slope(power) / self.mean
        slope[: len(power)] *= (power + self.scale)[:, None]
        return slope


def maximize(
    theta: Float[np.ndarray, " parameters"],
    slots: Slots,
    levels: Levels,
    noise: Float[np.ndarray, " m"],
    tolerance: float = _TOLERANCE,
) -> Maximum:
    """Maximum of the likelihood from a start.

    Args:
        theta: the start.
        slots: the model.
        levels: the levels.
        noise: rough levels [rate²], in which the scales of the powers are one standard deviation.
        tolerance: gain of the next step at which the iteration ends [nats].
    """
    count = slots.layout.components

    def place(theta: Any, scale: Any = None) -> Maximum:
        model = expected(theta, slots, levels)
        scale = power_scales(model.unit, levels.shape, noise) if scale is None else scale
        mean = np.maximum(theta[:count] @ model.unit, _LEAST * np.max(scale))
        prior = 0.5 * slots.free * slots.precision @ (theta - slots.centre) ** 2
        return Maximum(theta, scale, levels.shape @ (np.log(mean) + levels.level / mean) + prior, mean, model)

    with np.errstate(all="ignore"):
        best = place(np.clip(theta, slots.lower, slots.upper))
        damping, predicted, steps, converged = _DAMPING, np.inf, 0, False
        while not converged and steps < _STEPS and not np.isnan(predicted):
            steps += 1
            trial, predicted = _next(best, slots, levels, damping, abs(predicted) > _NEARBY)
            # At a kink of a response no step gains anything.
            converged = (abs(predicted) < tolerance and damping < _SLACK) or damping > _STUCK
            if not converged:
                new = place(trial, best.scale)
                gain = best.loss - new.loss
                # Of a small step the gain is lost in rounding.
                taken = gain > max(_BAD * predicted, 0.0) or 0.0 <= predicted < _SMALL
                damping *= (_LESS if gain > _GOOD * predicted else 1.0) if taken else _MORE
                best = new if taken else best
        slope, _, interior = _slopes(best, slots, levels)
        slope, prior = np.where(interior[:, None], slope, 0.0), np.where(interior, slots.precision, 1.0)
    information = (slope * levels.shape) @ slope.T + np.diag(prior)
    return best._replace(information=information, interior=interior, steps=steps, converged=bool(converged))


def _slopes(best: Maximum, slots: Slots, levels: Levels) -> tuple[Any, Any, Any]:
    """Slope of the logarithms of the levels, gradient of the loss, and which parameters may move.

    A parameter may not at a bound beyond which the loss still falls.
    """
    slope, theta = best.slope, best.theta
    gradient = slope @ (levels.shape * (1.0 - levels.level / best.mean))
    gradient += slots.precision * (theta - slots.centre)
    outward = ((theta <= slots.lower) & (gradient > 0.0)) | ((theta >= slots.upper) & (gradient < 0.0))
    return slope, gradient, slots.free & ~outward


def _next(
    best: Maximum, slots: Slots, levels: Levels, damping: float, far: bool
) -> tuple[Float[np.ndarray, " parameters"], float]:
    """The next place to try, and the gain to expect there.

    Far from the maximum the curvature is that of the levels' deviances, with which steps are as long as in
    logarithms; near it, the information.
    """
    slope, gradient, interior = _slopes(best, slots, levels)
    moving, weight = np.flatnonzero(interior), levels.shape
    slope, gradient = slope[moving], gradient[moving]
    if far:
        excess = levels.level / best.mean - 1.0
        close, apart = abs(excess) < _CLOSE, np.maximum(excess, _LOWEST - 1.0)
        deviance = apart**2 / (2.0 * (apart - np.log1p(apart)))
        weight = weight * np.where(close, 1.0 + 2.0 * excess / 3.0, deviance)
    curvature = (slope * weight) @ slope.T + np.diag(slots.precision[moving])
    size = 1.0 / np.sqrt(np.maximum(np.diag(curvature), 1e-12))
    damped = curvature * np.outer(size, size) + (damping + 1e-12) * np.eye(len(size))
    move = np.clip(-size * np.linalg.solve(damped, gradient * size), -_LONGEST, _LONGEST)
    every, count = np.zeros(len(best.theta)), len(best.scale)
    every[moving] = move
    every[:count] = (best.theta[:count] + best.scale) * np.expm1(every[:count])
    return np.clip(best.theta + every, slots.lower, slots.upper), -0.5 * float(gradient @ move)


def power_scales(unit: Any, shape: Any, noise: Any) -> Float[np.ndarray, " components"]:
    """Power of each component that would be one standard deviation in noise of these levels [rate²]."""
    information = (unit / noise) ** 2 @ shape
    return np.where(information > 0.0, 1.0 / np.sqrt(np.maximum(information, 1e-300)), 1.0)


def covariance(maximum: Maximum) -> Float[np.ndarray, "parameters parameters"]:
    """Covariance of the estimates, powers as `Maximum.scale` says; zero for what is held or at a bound."""
    size = 1.0 / np.sqrt(np.diag(maximum.information))
    both = np.outer(size, size)
    spread = np.linalg.pinv(maximum.information * both, hermitian=True) * both
    return np.where(np.outer(maximum.interior, maximum.interior), spread, 0.0)
