"""The joint spectral model: expected levels as a function of its parameters, and its maximum likelihood.

    μ = R·Σ p_c S_c (what is inside the response R) + Σ p_c S_c (what is after it)

The parameters are the powers p of the components, then their shapes, then the bandwidth and the quality
factor of the response.

The likelihood is maximized by Fisher scoring. A power is moved in ln(p + s), s being one standard deviation
of a power that is not there: linearly below that, where the data hardly show it, logarithmically above.
Parameters are known with very different precision, a resonance's frequency to 10⁻⁴ and a long correlation
time to a factor; so the damping is proportional to the diagonal of the information (Marquardt 1963), not to
the identity.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Iterator
from typing import Any, NamedTuple, Self

import numpy as np
from jaxtyping import Bool, Float, Int

from allanjax.estimate.spectral import components as kinds
from allanjax.estimate.spectral.components import (
    Levels,
    passed,
    passed_and_slopes,
    piece_of,
    response_of_kind,
)
from allanjax.estimate.spectral.others import Others
from allanjax.noise.response import Response

# Damping of the first step, relative to the information; shares of the predicted gain above which it falls,
# below which it rises, and below which a step is taken back besides; by what factors it changes; and one at
# which the iteration ends in any case.
_DAMPING, _GOOD, _POOR, _BAD, _LESS, _MORE, _STUCK = 0.01, 0.5, 0.25, 0.01, 1.0 / 6.0, 1.0 / 0.15, 1e8
#: Expected gain of a step [nats] at which the fit of a model ends.
TOLERANCE = 1e-9
# Expected gain [nats] of a step that is taken in any case; most steps; and the longest one of a parameter, in
# ln.
_SMALL, _STEPS, _LONGEST = 1e-8, 200, 2.0
# Excess of a level over its expectation below which a series is used, and the least ratio of the two; and the
# smallest expected level, in units of the largest scale of a power.
_CLOSE, _LOWEST, _LEAST = 1e-4, 1e-12, 1e-30
#: Distance of two resonances, in the mean of their widths, below which they may be one that moves.
CLOSE = 1.5


class Component(NamedTuple):
    """Component of a spectrum, of a kind of `spectral.components`, with its power [rate²].

    Its shapes are logarithms: of a Markov process T_c in samples; of an oscillator ω_0 in radians per sample
    and Q − ½; of another term what its free parameters are above their lower bounds. `inside` says whether it
    passes through the response, and `which` one of the columns it is.
    """

    kind: int
    power: float = 0.0
    shape: tuple[float, ...] = ()
    inside: bool = False
    which: int = 0

    @property
    def time(self) -> float:
        """Correlation time of a Markov process [samples]."""
        return math.exp(self.shape[0])

    @property
    def frequency(self) -> float:
        """Frequency of an oscillator [radians per sample]."""
        return math.exp(self.shape[0])

    @property
    def quality(self) -> float:
        """Quality factor of an oscillator."""
        return 0.5 + math.exp(self.shape[1])

    @property
    def width(self) -> float:
        """Width of an oscillator's peak [radians per sample]."""
        return self.frequency / self.quality

    def is_close_to(self, other: Component) -> bool:
        """Whether two oscillators are so close that they may be one whose frequency drifts."""
        return abs(self.frequency - other.frequency) < CLOSE * 0.5 * (self.width + other.width)


@dataclasses.dataclass(frozen=True, eq=False)
class Composition:
    """Components of a spectrum, and a response that some pass through, with values.

    The response has a kind, and in ln its bandwidth [radians per sample] and its quality factor less ½.
    """

    components: tuple[Component, ...]
    kind: int = kinds.NONE
    response: tuple[float, float] = (0.0, math.log(5.0))
    others: Others | None = None

    def with_parameters(self, theta: Float[np.ndarray, " parameters"]) -> Self:
        """Copy with other values of all parameters."""
        values, at, new = theta.tolist(), self.first, []
        for k, own in enumerate(self.components):
            new.append(own._replace(power=values[k], shape=tuple(values[at[k] : at[k + 1]])))
        return dataclasses.replace(self, components=tuple(new), response=(values[-2], values[-1]))

    @property
    def bandwidth(self) -> tuple[float, float]:
        """Bandwidth of the response [radians per sample], and its quality factor."""
        return math.exp(self.response[0]), 0.5 + math.exp(self.response[1])

    def of_kind(self, kind: int) -> list[int]:
        """Places of the components of a kind."""
        return [k for k, c in enumerate(self.components) if c.kind == kind]

    @property
    def oscillators(self) -> list[int]:
        """Places of the oscillators among the components."""
        return self.of_kind(kinds.OSCILLATOR)

    @property
    def parameters(self) -> Float[np.ndarray, " parameters"]:
        """Values of all parameters."""
        shapes = (x for c in self.components for x in c.shape)
        return np.array([*(c.power for c in self.components), *shapes, *self.response])

    @functools.cached_property
    def first(self) -> list[int]:
        """Parameter that is the first shape of each component; and of the response."""
        counts = [len(self.components), *(len(c.shape) for c in self.components)]
        return np.cumsum(counts).tolist()

    @functools.cached_property
    def inside(self) -> Bool[np.ndarray, " components"]:
        """Which components pass through the response."""
        return np.array([c.inside for c in self.components], bool)

    @functools.cached_property
    def owner(self) -> Int[np.ndarray, " shapes"]:
        """Component of each shape."""
        return np.array([k for k, c in enumerate(self.components) for _ in c.shape], int)

    @functools.cached_property
    def _groups(self) -> list[tuple[int, list[int], Int[np.ndarray, ...]]]:
        """Kinds of components, their places among all, and their columns or their shapes' parameters."""
        found = []
        for kind in (kinds.COLUMN, *kinds.CLOSED, kinds.OTHER):
            if places := self.of_kind(kind):
                columns = [self.components[k].which for k in places]
                own = [k for place in places for k in range(self.first[place], self.first[place + 1])]
                rows = 1 if kind == kinds.OTHER else len(places)
                shapes = np.array(own, int).reshape(rows, -1)
                found.append((kind, places, np.array(columns) if kind == kinds.COLUMN else shapes))
        return found

    def squares(
        self, theta: Float[np.ndarray, "*b parameters"], levels: Levels, sloped: bool = False
    ) -> Iterator[tuple[list[int], Any, Any, Any]]:
        """Expected squares at the nodes before the response [*b, components, 2, m], of each kind.

        Before them the places of these components and their shapes' parameters; after them, if wanted, the
        derivatives by these [..., 2, m].
        """
        for kind, places, own in self._groups:
            if kind == kinds.COLUMN:
                yield places, own, levels.columns[own], None
            elif kind == kinds.OTHER and self.others is not None:
                evaluated = self.others.squares_and_slopes if sloped else self.others.squares
                found = evaluated(theta[..., own[0]], levels.angle.shape[1])
                yield places, own, *(found if sloped else (found, None))
            else:
                yield places, own, *kinds.CLOSED[kind](levels, theta[..., own], sloped)

    def levels(
        self, theta: Float[np.ndarray, "b parameters"], levels: Levels
    ) -> Float[np.ndarray, "b components m"]:
        """Expected levels of all components of unit power [rate²] for many values of the parameters."""
        unit, response = np.empty((len(theta), len(self.components), levels.angle.shape[1])), None
        if self.kind != kinds.NONE:
            wc, excess = np.exp(theta[:, -2:]).T[:, :, None, None]
            response = passed(levels, self.kind, wc, 0.5 + excess)
        for places, _, value, _ in self.squares(theta, levels):
            for row, k in enumerate(places):
                own = value[..., row, :, :]
                own = own * response if response is not None and self.inside[k] else own
                unit[:, k] = 0.5 * (own[..., 0, :] + own[..., 1, :])
        return unit


def response_of(of: Composition, rate: float) -> Response | None:
    """Response of a composition, for samples at `rate` [Hz]; None without one."""
    w, quality = of.bandwidth
    return None if of.kind == kinds.NONE else response_of_kind(of.kind, w * rate / (2.0 * math.pi), quality)


@dataclasses.dataclass(frozen=True, eq=False)
class Joint:
    """What of a composition is estimated.

    Parameters that are not free keep their value; the others have bounds, powers not in ln, and a normal
    prior, unless its precision is 0.
    """

    composition: Composition
    free: Bool[np.ndarray, " parameters"]
    lower: Float[np.ndarray, " parameters"]
    upper: Float[np.ndarray, " parameters"]
    centre: Float[np.ndarray, " parameters"]
    precision: Float[np.ndarray, " parameters"]


def expected(theta: Float[np.ndarray, " parameters"], of: Composition, levels: Levels) -> tuple[Any, ...]:
    """Expected levels of components of unit power [rate²], and the derivatives of each by its own shapes.

    Also the derivatives of the sum of all components by the bandwidth and by the quality factor of the
    response, and half the jump of the derivative by the bandwidth.
    """
    count, m = len(of.components), levels.angle.shape[1]
    rows = np.empty((count + len(of.owner), 2, m))
    for places, own, value, slope in of.squares(theta, levels, True):
        rows[places] = value
        if slope is not None:
            rows[own.ravel()] = slope.reshape(-1, 2, m)
    by_response = np.zeros((3, m))
    if of.kind != kinds.NONE:
        passed, moved = passed_and_slopes(levels, theta[-2:], of.kind)
        passing = np.tensordot(theta[:count] * of.inside, rows[:count], 1)
        by_response = np.mean(moved * passing, axis=1)
        rows[np.append(of.inside, of.inside[of.owner])] *= passed
    mean = 0.5 * (rows[:, 0] + rows[:, 1])
    return mean[:count], mean[count:], by_response


class Maximum(NamedTuple):
    """Maximum of the likelihood, or a place on the way there.

    The loss is Σ k(ln μ + y/μ) over the levels, minus the logarithm of the prior. Powers are in
    ln(p + scale), the scale of each being one standard deviation. The information is Fisher's, prior
    included, of what is estimated and not at a bound (`interior`); the others have a unit on the diagonal.
    """

    theta: Float[np.ndarray, " parameters"]
    scale: Float[np.ndarray, " components"]
    loss: float
    mean: Float[np.ndarray, " m"]
    unit: Float[np.ndarray, "components m"]
    by_shape: Float[np.ndarray, "shapes m"]
    by_response: Float[np.ndarray, "3 m"]
    owner: Int[np.ndarray, " shapes"]
    information: Float[np.ndarray, "parameters parameters"] = np.zeros((0, 0))
    interior: Bool[np.ndarray, " parameters"] = np.zeros(0, bool)
    converged: bool = False

    @property
    def slope(self) -> Float[np.ndarray, "parameters m"]:
        """Derivatives of the logarithms of the levels by ln(p + scale) of the powers and by the shapes."""
        power = self.theta[: len(self.scale)]
        of_powers = (power + self.scale)[:, None] * self.unit
        slope = [of_powers, power[self.owner, None] * self.by_shape, self.by_response[:2]]
        return np.concatenate(slope) / self.mean


def maximize(
    theta: Float[np.ndarray, " parameters"],
    joint: Joint,
    levels: Levels,
    noise: Float[np.ndarray, " m"],
    tolerance: float = TOLERANCE,
) -> Maximum:
    """Maximum of the likelihood from a start.

    The scales of the powers are one standard deviation in rough levels of the noise [rate²]. The iteration
    ends with a step that gains less than the tolerance [nats] and would do so without damping.
    """
    of, count = joint.composition, len(joint.composition.components)

    def place(theta: Any, scale: Any = None) -> Maximum:
        unit, by_shape, by_response = expected(theta, of, levels)
        scale = power_scales(unit, levels.shape, noise) if scale is None else scale
        mean = np.maximum(theta[:count] @ unit, _LEAST * np.max(scale))
        loss = levels.shape @ (np.log(mean) + levels.level / mean)
        loss += 0.5 * joint.free * joint.precision @ (theta - joint.centre) ** 2
        return Maximum(theta, scale, loss, mean, unit, by_shape, by_response, of.owner)

    with np.errstate(all="ignore"):
        best = place(np.clip(theta, joint.lower, joint.upper))
        slopes = _slopes(best, joint, levels)
        damping, predicted, steps, converged = _DAMPING, np.inf, 0, False
        while not converged and steps < _STEPS and not np.isnan(predicted):
            steps += 1
            trial, predicted = _next(best, slopes, joint, levels, damping)
            converged = abs(predicted) * (1.0 + damping) < tolerance or damping > _STUCK
            new = place(trial, best.scale)
            # Of a small step the gain is lost in rounding.
            share = 1.0 if 0.0 <= predicted < _SMALL else (best.loss - new.loss) / abs(predicted)
            damping *= _LESS if share > _GOOD else _MORE if not share > _POOR else 1.0
            if share > _BAD:
                best, slopes = new, _slopes(new, joint, levels)
        slope, _, interior = slopes
        slope, prior = np.where(interior[:, None], slope, 0.0), np.where(interior, joint.precision, 1.0)
    information = (slope * levels.shape) @ slope.T + np.diag(prior)
    return best._replace(information=information, interior=interior, converged=bool(converged))


def _slopes(best: Maximum, joint: Joint, levels: Levels) -> tuple[Any, Any, Any]:
    """Slope of the logarithms of the levels, gradient of the loss, and which parameters may move.

    A parameter may not at a bound beyond which the loss still falls.
    """
    slope, theta = best.slope, best.theta
    gradient = slope @ (levels.shape * (1.0 - levels.level / best.mean))
    gradient += joint.precision * (theta - joint.centre)
    outward = ((theta <= joint.lower) & (gradient > 0.0)) | ((theta >= joint.upper) & (gradient < 0.0))
    return slope, gradient, joint.free & ~outward


def _next(
    best: Maximum, slopes: tuple[Any, Any, Any], joint: Joint, levels: Levels, damping: float
) -> tuple[Float[np.ndarray, " parameters"], float]:
    """The next place to try, and the gain to expect there.

    The curvature is that of the levels' deviances: far from the maximum steps are as long as in logarithms.
    Where the slope by the bandwidth jumps, it is that of the side on which the loss falls; if it falls on
    neither, the bandwidth stays. No step goes beyond the next jump.
    """
    (slope, gradient, interior), weight = slopes, levels.shape
    excess = levels.level / best.mean - 1.0
    if np.any(best.by_response[2]):
        slope, gradient, interior = slope.copy(), gradient.copy(), interior.copy()
        jump = best.by_response[2] / best.mean
        bend = -float(jump @ (weight * excess))
        side, interior[-2] = -np.sign(gradient[-2]), interior[-2] and abs(gradient[-2]) > bend
        slope[-2], gradient[-2] = slope[-2] + side * jump, gradient[-2] + side * bend
    moving = np.flatnonzero(interior)
    slope, gradient = slope[moving], gradient[moving]
    close, apart = abs(excess) < _CLOSE, np.maximum(excess, _LOWEST - 1.0)
    deviance = apart**2 / (2.0 * (apart - np.log1p(apart)))
    weight = weight * np.where(close, 1.0 + 2.0 * excess / 3.0, deviance)
    curvature = (slope * weight) @ slope.T + np.diag(joint.precision[moving])
    size = 1.0 / np.sqrt(np.maximum(np.diag(curvature), 1e-12))
    damped = curvature * np.outer(size, size) + (damping + 1e-12) * np.eye(len(size))
    move = np.clip(-size * np.linalg.solve(damped, gradient * size), -_LONGEST, _LONGEST)
    every, count = np.zeros(len(best.theta)), len(best.scale)
    every[moving] = move
    share, piece = 1.0, np.log(piece_of(joint.composition.kind, math.exp(best.theta[-2])))
    if every[-2] != 0.0:
        share = min((piece[int(every[-2] > 0.0)] - best.theta[-2]) / every[-2], 1.0)
    every *= share
    every[:count] = (best.theta[:count] + best.scale) * np.expm1(every[:count])
    gain = -0.5 * float(gradient @ move) * share * (2.0 - share)
    return np.clip(best.theta + every, joint.lower, joint.upper), gain


def power_scales(unit: Any, shape: Any, noise: Any) -> Float[np.ndarray, " components"]:
    """Power of each component that would be one standard deviation in noise of these levels [rate²]."""
    information = (unit / noise) ** 2 @ shape
    return np.where(information > 0.0, 1.0 / np.sqrt(np.maximum(information, 1e-300)), 1.0)


def covariance(maximum: Maximum) -> Float[np.ndarray, "parameters parameters"]:
    """Covariance of the estimates, powers as `Maximum.scale` says; zero for what is held or at a bound."""
    known = np.diag(maximum.information)
    # The data may tell nothing of the shape of a component without power.
    size = 1.0 / np.sqrt(np.where(known > 0.0, known, 1.0))
    both = np.outer(size, size)
    spread = np.linalg.pinv(maximum.information * both, hermitian=True) * both
    return np.where(np.outer(maximum.interior, maximum.interior), spread, 0.0)
