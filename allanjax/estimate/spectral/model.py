"""The structure of a spectrum: its components and response, their expected levels, and their joint fit.

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
from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Int

from allanjax.estimate.spectral import components as kinds
from allanjax.estimate.spectral.components import Levels, Others
from allanjax.noise.response import Response
from allanjax.noise.terms import (
    AngleRandomWalk,
    NoiseTerm,
    Resonance,
    WanderingResonance,
    basic_terms,
)
from allanjax.noise.terms.random import LEAST_WIDTH
from allanjax.spectrum.cosine import Bins, smoothed
from allanjax.spectrum.peaks import LOWEST

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


# Relative errors of a model's parts, which are judgements: of a response, per factor of e by which it has
# fallen; of a resonance, whose frequency and damping drift; and of its skirt, so many widths from its peak.
_FILTER, _UNSTEADY, _SKIRT, _BESIDE = 0.05, 0.1, 0.2, 1.5
#: Terms without a free shape, in the first columns; the white noise that is added after a response.
FIXED = ("quantization", "angle_random_walk", "bias_instability", "rate_random_walk")
QUANTIZATION, WHITE, OUTSIDE = 0, FIXED.index("angle_random_walk"), len(FIXED)
#: Column of a further term, whose shape is given.
FURTHER = OUTSIDE + 1
#: Least quality factor of a resonance: a wider one is an edge, as of a filter.
LEAST_QUALITY = 1.5
#: A resonance narrower than so many coefficients is a line.
LINE = 4.0
# Least correlation time [samples] of a Markov process: a shorter one is filtered white noise.
_SHORTEST = 8.0
#: Least bandwidth [cycles per sample]: white noise behind a slower filter is a Markov process.
LOWEST_BANDWIDTH = 0.005
# Factor by which what the ends add exceeds its expectation in one record of fifty, by an exponential law.
_CHANCE_OF_ENDS = 4.0
# Relative error of any sensor's model in each bin, since real filters differ from all models: a judgement.
_ERROR = 0.005
# Number of factors of e beyond which the errors of a response count in a search: a judgement.
_DEEP = 3.0
#: Tolerances [nats] of a fit within a search, and of one whose numbers are reported.
ROUGH, FINE = 1e-2, 1e-7
#: The prior of a resonance's frequency is uniform in its logarithm, over ln(n/this) for n samples.
FREQUENCIES = 32.0
# Prior of ln(Q − ½) of resonances: mean and precision. A judgement.
_QUALITY = (math.log(10.0), 1.0 / 9.0)
# Width at half maximum of a normal law, in standard deviations.
_WIDTH = 2.0 * math.sqrt(2.0 * math.log(2.0))
# Largest spread of a frequency, in its mean: more is the shape of a broad peak.
_FARTHEST = 0.12
# Largest distance of a frequency from its start, in ln.
_REACH = 0.7
#: Log prior odds against a component [nats]: a judgement, twenty to one.
PRICE = 3.0
# Unit of the widths of the priors of powers, quality factors and bandwidth, in ln.
_DECADES = math.log(10.0)
_Theta: TypeAlias = Float[np.ndarray, " parameters"]
_Square: TypeAlias = Float[np.ndarray, "parameters parameters"]


class Component(NamedTuple):
    """Component of a spectrum, of a kind of `spectral.components`, with its power [rate²].

    Its shapes are logarithms: of a Markov process T_c in samples; of an oscillator ω_0 in radians per sample
    and Q − ½, and Δω if its frequency is spread; of another term what its free parameters are above their
    lower bounds. `inside` says whether it passes through the response, and `which` one of the columns it is.
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
    def oscillates(self) -> bool:
        """Whether it is an oscillator, of one frequency or of a spread one."""
        return self.kind in (kinds.OSCILLATOR, kinds.WANDERING)

    @property
    def quality(self) -> float:
        """Quality factor of an oscillator's peak."""
        return self.frequency / self.width

    @property
    def width(self) -> float:
        """Width of an oscillator's peak [radians per sample]."""
        return math.hypot(self.own_width, _WIDTH * self.spread)

    @property
    def own_width(self) -> float:
        """Width of an oscillator's peak at any moment [radians per sample]."""
        return self.frequency / (0.5 + math.exp(self.shape[1]))

    @property
    def spread(self) -> float:
        """Standard deviation of an oscillator's frequency [radians per sample]."""
        return math.exp(self.shape[2]) if self.kind == kinds.WANDERING else 0.0

    def is_close_to(self, other: Component) -> bool:
        """Whether two oscillators are so close that they may be one whose frequency drifts."""
        width = 0.5 * (self.width + other.width)
        if kinds.WANDERING in (self.kind, other.kind):
            # One that is known to drift has its own place.
            width = min(self.width, other.width)
        return abs(self.frequency - other.frequency) < CLOSE * width


def resonance(frequency: float, quality: float, power: float, inside: bool) -> Component:
    """Resonance at a frequency [radians per sample]."""
    return Component(kinds.OSCILLATOR, power, (math.log(frequency), math.log(quality - 0.5)), inside)


def wandering(frequency: float, quality: float, spread: float, power: float, inside: bool) -> Component:
    """Resonance at a frequency that has this standard deviation [both in radians per sample]."""
    shape = math.log(frequency), math.log(quality - 0.5), math.log(spread)
    return Component(kinds.WANDERING, power, shape, inside)


def peak_of(term: Resonance) -> Component:
    """Component of a resonance at 2π samples a second, so that its frequency and width are in Hz."""
    place = float(term.frequency or 0.0), float(term.quality_factor or 1.0)
    if isinstance(term, WanderingResonance):
        return wandering(*place, float(term.spread or 0.0), 0.0, False)
    return resonance(*place, 0.0, False)


def markov(time: float, power: float) -> Component:
    """Markov process of a correlation time [samples], inside the response."""
    return Component(kinds.MARKOV, power, (math.log(time),), True)


def of_column(which: int) -> Component:
    """Component of a column, without power."""
    # The output is rounded; and a term of its own kind may have no closed form behind a response.
    return Component(kinds.COLUMN, inside=which not in (QUANTIZATION, OUTSIDE, FURTHER), which=which)


@dataclasses.dataclass(frozen=True, eq=False)
class Structure:
    """Components of a spectrum, and a response that some pass through, with values or start values.

    The response has a kind, and in ln its bandwidth [radians per sample] and its quality factor less ½. The
    `further` term, with unit amplitude, is that of column `FURTHER`.
    """

    components: tuple[Component, ...]
    kind: kinds.Kind = kinds.NONE
    response: tuple[float, float] = (0.0, math.log(5.0))
    others: Others | None = None
    further: NoiseTerm | None = None

    def with_parameters(self, theta: _Theta) -> Structure:
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
        return [k for k, c in enumerate(self.components) if c.kind == kind]

    @property
    def oscillators(self) -> list[int]:
        return [k for k, c in enumerate(self.components) if c.oscillates]

    @property
    def parameters(self) -> _Theta:
        shapes = (x for c in self.components for x in c.shape)
        return np.array([*(c.power for c in self.components), *shapes, *self.response])

    @functools.cached_property
    def first(self) -> list[int]:
        """Parameter that is the first shape of each component; and of the response."""
        counts = [len(self.components), *(len(c.shape) for c in self.components)]
        return np.cumsum(counts).tolist()

    @functools.cached_property
    def inside(self) -> Bool[np.ndarray, " components"]:
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
            response = kinds.passed(levels, self.kind, wc, 0.5 + excess)
        for places, _, value, _ in self.squares(theta, levels):
            for row, k in enumerate(places):
                own = value[..., row, :, :]
                own = own * response if response is not None and self.inside[k] else own
                unit[:, k] = 0.5 * (own[..., 0, :] + own[..., 1, :])
        return unit

    @classmethod
    def plain(cls, columns: Iterable[int]) -> Structure:
        """Structure of some columns only, of which all but quantization pass through a response, if any."""
        return cls(tuple(map(of_column, columns)))

    def place(self, column: int) -> int | None:
        """Place of a column among the components; None if it is not one of them."""
        found = (k for k, c in enumerate(self.components) if c.kind == kinds.COLUMN and c.which == column)
        return next(found, None)

    def column(self, column: int) -> Component:
        """The component of a column, without power if there is none."""
        k = self.place(column)
        return of_column(column) if k is None else self.components[k]

    @property
    def there(self) -> list[int]:
        """Components whose power is not zero."""
        return [k for k, c in enumerate(self.components) if c.power > 0.0]

    def plus(self, *components: Component) -> Structure:
        return dataclasses.replace(self, components=(*self.components, *components))

    def with_column(self, column: int, power: float) -> Structure:
        k, own = self.place(column), self.column(column)._replace(power=power)
        return self.plus(own) if k is None else self._changed({k: own})

    @property
    def filter(self) -> tuple[Any, ...]:
        """Kind and shape of the response."""
        return self.kind, *self.response

    @property
    def corner(self) -> float:
        """Half-power frequency of the response, but for a resonance [radians per sample]."""
        return self.bandwidth[0] * self.kind.narrowing

    def with_response(self, kind: kinds.Kind, corner: float) -> Structure:
        """Structure with a response of this `corner`, and of Q = √½ if it has one."""
        response = math.log(corner / kind.narrowing), math.log(math.sqrt(0.5) - 0.5)
        return dataclasses.replace(self, kind=kind, response=response)

    def without_response(self) -> Structure:
        """Structure without a response, and without the white noise after it."""
        return dataclasses.replace(self.without(self.place(OUTSIDE)), kind=kinds.NONE)

    def with_shape_of(self, other: Structure) -> Structure:
        """Structure with another one's response and resonances, and with what is after the response there."""
        inside = {c.which: c.inside for c in other.components if c.kind == kinds.COLUMN}
        mine = (
            c._replace(inside=inside.get(c.which, c.inside)) if c.kind == kinds.COLUMN else c
            for c in self.components
            if not _is_shape(c)
        )
        components = (*mine, *filter(_is_shape, other.components))
        return dataclasses.replace(self, components=components, kind=other.kind, response=other.response)

    def has_shape_of(self, other: Structure) -> bool:
        """Whether both have the same kind of response and as many resonances."""
        return self.kind == other.kind and len(self.oscillators) == len(other.oscillators)

    def placed(self, places: Collection[int | None], inside: bool) -> Structure:
        """Structure in which these components are inside the response or after it."""
        return self._changed({k: self.components[k]._replace(inside=inside) for k in places if k is not None})

    def without(self, *places: int | None) -> Structure:
        return dataclasses.replace(
            self, components=tuple(c for k, c in enumerate(self.components) if k not in places)
        )

    def with_powers(self, powers: Iterable[float]) -> Structure:
        both = zip(self.components, powers, strict=True)
        return dataclasses.replace(self, components=tuple(c._replace(power=p) for c, p in both))

    def _changed(self, new: dict[int, Component]) -> Structure:
        components = tuple(new.get(k, c) for k, c in enumerate(self.components))
        return dataclasses.replace(self, components=components)


def response_of(of: Structure, rate: float) -> Response | None:
    """Response of a composition, for samples at `rate` [Hz]; None without one."""
    if of.kind == kinds.NONE:
        return None
    w, quality = of.bandwidth
    return of.kind.of(w * rate / (2.0 * math.pi), quality)


@dataclasses.dataclass(frozen=True, eq=False)
class Joint:
    """What of a composition is estimated.

    Parameters that are not free keep their value; the others have bounds, powers not in ln, and a normal
    prior, unless its precision is 0.
    """

    composition: Structure
    free: Bool[np.ndarray, " parameters"]
    lower: _Theta
    upper: _Theta
    centre: _Theta
    precision: _Theta


def expected(theta: _Theta, of: Structure, levels: Levels) -> tuple[Any, ...]:
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
        through, moved = kinds.passed_and_slopes(levels, theta[-2:], of.kind)
        passing = np.tensordot(theta[:count] * of.inside, rows[:count], 1)
        by_response = np.mean(moved * passing, axis=1)
        rows[np.append(of.inside, of.inside[of.owner])] *= through
    mean = 0.5 * (rows[:, 0] + rows[:, 1])
    return mean[:count], mean[count:], by_response


class Maximum(NamedTuple):
    """Maximum of the likelihood, or a place on the way there.

    The loss is Σ k(ln μ + y/μ) over the levels, minus the logarithm of the prior. Powers are in
    ln(p + scale), the scale of each being one standard deviation. The information is Fisher's, prior
    included, of what is estimated and not at a bound (`interior`); the others have a unit on the diagonal.
    """

    theta: _Theta
    scale: Float[np.ndarray, " components"]
    loss: float
    mean: Float[np.ndarray, " m"]
    unit: Float[np.ndarray, "components m"]
    by_shape: Float[np.ndarray, "shapes m"]
    by_response: Float[np.ndarray, "3 m"]
    owner: Int[np.ndarray, " shapes"]
    information: _Square = np.zeros((0, 0))
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
    theta: _Theta, joint: Joint, levels: Levels, noise: Float[np.ndarray, " m"], tolerance: float = TOLERANCE
) -> Maximum:
    """Maximum of the likelihood from a start.

    The scales of the powers are one standard deviation in rough levels of the noise [rate²]. The iteration
    ends with a step that gains less than the tolerance [nats] and would do so without damping.
    """
    of, count = joint.composition, len(joint.composition.components)

    def place(theta: Any, scale: Any = None) -> Maximum:
        unit, by_shape, by_response = expected(theta, of, levels)
        if scale is None:
            information = (unit / noise) ** 2 @ levels.shape
            scale = np.where(information > 0.0, 1.0 / np.sqrt(np.maximum(information, 1e-300)), 1.0)
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
            is_small = 0.0 <= predicted < _SMALL
            share = 1.0 if is_small else (best.loss - new.loss) / abs(predicted)
            converged |= bool(is_small and new.loss >= best.loss and damping < _DAMPING)
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
) -> tuple[_Theta, float]:
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
    share, piece = 1.0, np.log(kinds.piece_of(joint.composition.kind, math.exp(best.theta[-2])))
    if every[-2] != 0.0:
        share = min((piece[int(every[-2] > 0.0)] - best.theta[-2]) / every[-2], 1.0)
    every *= share
    every[:count] = (best.theta[:count] + best.scale) * np.expm1(every[:count])
    gain = -0.5 * float(gradient @ move) * share * (2.0 - share)
    return np.clip(best.theta + every, joint.lower, joint.upper), gain


def model_error(
    of: Structure, maximum: Maximum, bins: Bins, allowed: float = 0.0, skirt: float = _SKIRT
) -> Float[np.ndarray, " m"]:
    """Relative variance of the levels from what sensors' filters and resonances differ from the model.

    Resonances drift, the more so where several stand for one that moves. Skirts and filters are nowhere
    just like the model's, which is common to the levels of an octave; of a filter it counts where that has
    fallen by more than so many factors of e.
    """
    f, common, unsteady = bins.frequency, np.zeros(len(bins.frequency)), np.zeros(len(bins.frequency))
    of = of.with_parameters(maximum.theta)
    if (response := response_of(of, bins.rate)) is not None:
        fallen = -np.log(np.maximum(np.asarray(response.power(f, bins.rate)), 1e-300)) - allowed
        # What comes after the filter, such as rounding, hides its errors.
        passing = of.inside * maximum.theta[: len(of.inside)] @ maximum.unit / maximum.mean
        common += (_FILTER * np.maximum(fallen, 0.0) * passing) ** 2
    resonances, angle = [of.components[k] for k in of.oscillators], 2.0 * np.pi * f / bins.rate
    for k, own in zip(of.oscillators, resonances, strict=True):
        share = own.power * maximum.unit[k] / maximum.mean
        unsteady += _UNSTEADY * sum(own.is_close_to(other) for other in resonances) * share
        beside = abs(angle - own.frequency) > _BESIDE * own.width
        common += (skirt * np.where(beside, share, 0.0)) ** 2
    return unsteady**2 + common * bins.per_octave()


def error_of_ends(
    of: Structure, theta: _Theta, levels: Levels, bins: Bins, chance: float = 1.0
) -> Float[np.ndarray, " m"]:
    """Relative variance of the levels from the two ends of a record: the floor below which none counts.

    Deep in a stop band a level consists of what the ends add, which scatters as two numbers do, however many
    coefficients it has, and is the same in all levels there. `chance` is the factor up to which it may exceed
    its expectation without saying anything.
    """
    if of.kind == kinds.NONE:
        return np.zeros(len(bins.size))
    w, excess = np.exp(theta[-2:]).reshape(2, 1, 1)
    both = (kinds.passed(x, of.kind, w, 0.5 + excess).reshape(2, -1) for x in (levels, levels.endless))
    whole, without = (x.mean(axis=0) for x in both)
    power = theta[: len(of.components), None] * of.levels(theta[None], levels)[0]
    passing, total = np.sum(power[of.inside], axis=0), np.sum(power, axis=0)
    # More than the model has is not from the ends either.
    share = passing * (1.0 - without / whole) / np.maximum(total, levels.level)
    return bins.per_octave() * np.minimum(chance * share, 1.0) ** 2


def share_with_error(dof: Any, variance: Any) -> Any:
    """Share of their weight that levels keep if the model's error has this relative variance.

    The relative variance 2/dof of each becomes 2/dof + variance.
    """
    return 1.0 / (1.0 + 0.5 * dof * variance)


def _is_shape(component: Component) -> bool:
    return component.oscillates or (component.kind, component.which) == (kinds.COLUMN, OUTSIDE)


class Fitted(NamedTuple):
    """A structure fitted to a spectrum: log evidence and loss [nats], expected levels [rate²].

    The loss is minus the log-likelihood, prior included. The evidence is Laplace's approximation, where each
    component costs as much as odds of twenty to one.
    The `rivals` are other structures that were compared with it, and `doubt` is the relative error of white
    noise that follows from these.
    """

    structure: Structure
    evidence: float
    loss: float
    mean: Float[np.ndarray, " m"]
    maximum: Maximum
    rivals: tuple[Fitted, ...] = ()
    doubt: float = 0.0

    @property
    def covariance(self) -> _Square:
        """Covariance of powers [rate²] and shapes, in ln; zero for what is held or at a bound."""
        information, interior, scale = self.maximum.information, self.maximum.interior, self.maximum.scale
        known = np.diag(information)
        # The data may tell nothing of the shape of a component without power.
        size = 1.0 / np.sqrt(np.where(known > 0.0, known, 1.0))
        both = np.outer(size, size)
        spread = np.linalg.pinv(information * both, hermitian=True) * both
        moved = np.ones(len(known))
        moved[: len(scale)] = self.maximum.theta[: len(scale)] + scale
        return np.where(np.outer(interior, interior), spread, 0.0) * np.outer(moved, moved)


@dataclasses.dataclass(frozen=True, eq=False)
class Spectrum:
    """Levels of the cosine spectrum of one record that structures are fitted to.

    Beside these: smooth ones, a first guess; the number of coefficients in each, the square of a model's
    relative error there, and the expectations of components and responses that were computed for these bins.
    """

    bins: Bins
    levels: Levels
    rough: Float[np.ndarray, " m"]
    size: Float[np.ndarray, " m"]
    error: Any = _ERROR**2
    known: dict[tuple[Any, ...], Float[np.ndarray, "2 m"]] = dataclasses.field(default_factory=dict)

    @classmethod
    def of(
        cls,
        squares: Float[np.ndarray, " n-1"],
        bins: Bins,
        further: NoiseTerm | None = None,
        weight: Float[np.ndarray, " n-1"] | None = None,
    ) -> Spectrum:
        """Spectrum of squared coefficients [rate²], of weight 0 or 1; with a column for a further term."""
        terms: list[NoiseTerm] = [basic_terms()[name] for name in FIXED] + [AngleRandomWalk()]
        terms += [] if further is None else [further]
        count = bins.size.astype(float) if weight is None else bins.sums(weight)
        total = bins.sums(squares if weight is None else squares * weight)
        level = np.where(count > 0.0, total / np.maximum(count, 1.0), 1.0)
        levels = Levels.of(bins, kinds.columns_of(terms, bins))._replace(level=level)
        return cls(bins, levels, smoothed(level * count, count), count).with_error(_ERROR**2)

    def with_error(self, error: Any) -> Spectrum:
        """Copy for models with these squares of relative errors, of which models are to be compared only."""
        levels = self.levels._replace(shape=0.5 * self.size * share_with_error(self.size, error))
        return dataclasses.replace(self, levels=levels, error=error)

    @property
    def n(self) -> int:
        return self.bins.n

    def weighing(self, fitted: Fitted, filters: bool = False) -> Spectrum:
        """Spectrum whose levels count less where a fit has its resonances, and deep in a filter's stop band.

        No sensor's filter is just like the model's; in the pass band (`filters`) its errors count once the
        kind of filter is known, as they hide it.
        """
        allowed = 0.0 if filters else _DEEP
        of = fitted.structure
        error = model_error(of, fitted.maximum, self.bins, allowed, skirt=0.0) + _ERROR**2
        return self.with_error(
            error + error_of_ends(of, of.parameters, self.levels, self.bins, _CHANCE_OF_ENDS)
        )

    def with_full_weight(self, fitted: Fitted) -> Spectrum:
        """Spectrum whose levels count as if the model of a fit were exact."""
        of = fitted.structure
        return self.with_error(error_of_ends(of, of.parameters, self.levels, self.bins, _CHANCE_OF_ENDS))

    def loss_of(self, fitted: Fitted) -> float:
        """Minus the log-likelihood of these levels under a fit to others [nats]."""
        return float(self.levels.shape @ (np.log(fitted.mean) + self.levels.level / fitted.mean))

    def know(self, structures: Sequence[Structure]) -> None:
        """Compute the responses of these structures that are not known yet, those of a kind together."""
        new = {s.filter: s for s in structures if s.kind != kinds.NONE and s.filter not in self.known}
        for kind in {s.kind for s in new.values()}:
            own = {key: s.bandwidth for key, s in new.items() if s.kind == kind}
            wc, Q = np.array(list(own.values())).T[:, :, None, None]
            self.known.update(zip(own, kinds.passed(self.levels, kind, wc, Q), strict=True))

    def units(self, structure: Structure, components: Sequence[Component]) -> Float[np.ndarray, "some m"]:
        """Levels of components of unit power before or after the response of a structure."""
        for kind, function in kinds.CLOSED.items():
            if new := [c.shape for c in components if c.kind == kind and c.shape not in self.known]:
                self.known.update(zip(new, function(self.levels, np.array(new))[0], strict=True))
        columns = self.levels.columns
        squares = np.array(
            [columns[c.which] if c.kind == kinds.COLUMN else self.known[c.shape] for c in components]
        )
        if structure.kind != kinds.NONE:
            self.know([structure])
            squares[[c.inside for c in components]] *= self.known[structure.filter]
        return 0.5 * (squares[:, 0] + squares[:, 1])

    def again(self, fitted: Fitted) -> Fitted:
        """A fit to other levels, or to these with other weights, repeated."""
        return self.fit(fitted.structure)

    def fit(self, structure: Structure, tolerance: float = ROUGH) -> Fitted:
        priors = self._priors(structure)
        lower, upper, centre, precision, width = np.array(priors).T
        free = np.ones(len(priors), bool)
        free[-2:] = structure.kind != kinds.NONE, structure.kind.is_shaped
        joint = Joint(structure, free, lower, np.maximum(upper, lower), centre, precision)
        found = maximize(structure.parameters, joint, self.levels, self.rough, tolerance)
        better = structure.with_parameters(found.theta)
        evidence = self._evidence(found, better, width)
        return Fitted(better, evidence, found.loss, found.mean, found)

    def _priors(self, structure: Structure) -> list[tuple[float, float, float, float, float]]:
        """Bounds of all parameters, mean and precision of a normal prior, and its width for the evidence."""
        spacing = np.pi / self.n
        rows = [(0.0, np.inf, 0.0, 0.0, 8.0 * _DECADES)] * len(structure.components)
        for c in structure.components:
            if c.kind == kinds.MARKOV:
                rows.append((math.log(_SHORTEST), math.log(self.n), 0.0, 0.0, math.log(self.n)))
            elif c.oscillates:
                lower = max(c.shape[0] - _REACH, math.log(LOWEST * spacing))
                upper = min(c.shape[0] + _REACH, math.log(np.pi))
                rows.append((lower, upper, 0.0, 0.0, math.log(self.n / FREQUENCIES)))
                least = max(LINE * spacing, LEAST_WIDTH * c.spread)
                lowest = LEAST_QUALITY if c.kind == kinds.OSCILLATOR else kinds.WIDE
                highest = math.log(max(c.frequency / least, lowest + 0.5) - 0.5)
                rows.append((math.log(lowest - 0.5), highest, *_QUALITY, 4.0 * _DECADES))
            if c.kind == kinds.WANDERING:
                rows.append((math.log(spacing), math.log(_FARTHEST * c.frequency), 0.0, 0.0, 2.0 * _DECADES))
        least, most = kinds.bandwidths(structure.kind)
        least = max(LOWEST * spacing, 2.0 * np.pi * LOWEST_BANDWIDTH, least)
        rows.append((math.log(least), math.log(min(4.0, most)), 0.0, 0.0, 2.0 * _DECADES))
        return [*rows, (math.log(0.02), math.log(20.0), 0.0, 0.0, math.log(20.0))]

    def _evidence(self, found: Maximum, structure: Structure, width: _Theta) -> float:
        """Laplace's approximation, in which a parameter that the data do not determine costs nothing."""
        free = found.interior
        D = width[free] / np.sqrt(2.0 * np.pi)
        F = found.information[np.ix_(free, free)]
        _, logdet = np.linalg.slogdet(F * np.outer(D, D) + np.eye(len(D)))
        used = [structure.components[k] for k in structure.there]
        more = sum(c.kind != kinds.COLUMN or c.which == OUTSIDE for c in used)
        more += sum(c.kind == kinds.WANDERING for c in used)
        if structure.kind != kinds.NONE:
            # Quantization beside a filter may be the filter's shape, the more so before it.
            rounded = structure.column(QUANTIZATION)
            more += 1 + (rounded.power > 0.0) * (1 + rounded.inside)
        return float(-found.loss - 0.5 * logdet - PRICE * more)
