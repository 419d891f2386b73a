"""The joint spectral model: expected levels as a function of its parameters, and its maximum likelihood.

Powers and shapes are in slots:

    μ = R·Σ p_c S_c (what is inside the response R) + Σ p_c S_c (what is after it)

A slot is idle where its power is zero and not estimated. Which slots are in use, what is inside, and the kind
of response are data, so that one compiled program serves every model.

The likelihood is maximized by Fisher scoring. A power is moved in ln(p + s), s being one standard deviation
of a power that is not there: linearly below that, where the data hardly show it, logarithmically above.
Parameters are known with very different precision, a resonance's frequency to 10⁻⁴ and a long correlation
time to a factor; so the damping is proportional to the diagonal of the information (Marquardt 1963), not to
the identity.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from allanjax.base.arrays import namespace
from allanjax.base.cache import compiled_once
from allanjax.base.linalg import solve
from allanjax.estimate.spectral.components import (
    NONE,
    Levels,
    Place,
    bandwidths,
    oscillation,
    padded,
    response_and_slope,
)
from allanjax.noise.terms import NoiseTerm
from allanjax.spectrum.cosine import Bins

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


class Layout(NamedTuple):
    """Numbers of slots, and the positions of each kind of parameter.

    The parameters are the powers of all components, then the correlation times of Markov processes,
    frequencies and quality factors of oscillators, bandwidth and quality factor of the response, and the
    free shapes of other terms.

    Attributes:
        columns: slots for terms without a free shape.
        markovs, oscillators: slots for these, whose shapes may be free.
        others: number of further terms with free shapes.
        shapes: number of their free shapes.
    """

    columns: int
    markovs: int
    oscillators: int
    others: int = 0
    shapes: int = 0

    @property
    def first_markov(self) -> int:
        """Index of the first Markov process among the components."""
        return self.columns

    @property
    def first_oscillator(self) -> int:
        """Index of the first oscillator among the components."""
        return self.columns + self.markovs

    @property
    def first_other(self) -> int:
        """Index of the first further term among the components."""
        return self.columns + self.markovs + self.oscillators

    @property
    def components(self) -> int:
        """Number of components, each of which has a power."""
        return self.first_other + self.others

    @property
    def times(self) -> int:
        """Index of the first correlation time among the parameters."""
        return self.components

    @property
    def frequencies(self) -> int:
        """Index of the first oscillator's frequency among the parameters."""
        return self.times + self.markovs

    @property
    def qualities(self) -> int:
        """Index of the first oscillator's quality factor among the parameters."""
        return self.frequencies + self.oscillators

    @property
    def response(self) -> int:
        """Index of the response's bandwidth among the parameters."""
        return self.qualities + self.oscillators

    @property
    def other_shapes(self) -> int:
        """Index of the first free shape of a further term among the parameters."""
        return self.response + 2

    @property
    def owner(self) -> Int[np.ndarray, " shapes"]:
        """Component of each correlation time, frequency and quality factor."""
        oscillators = np.arange(self.first_oscillator, self.first_other)
        return np.concatenate([np.arange(self.first_markov, self.first_oscillator), oscillators, oscillators])

    @property
    def parameters(self) -> int:
        """Number of parameters."""
        return self.other_shapes + self.shapes


#: Slots of every model that needs no more.
FULL = Layout(8, 4, 12)


class Others(eqx.Module):
    """Terms whose free shapes fit no slot; they are evaluated directly.

    Attributes:
        terms: the terms, with unit amplitude.
        shapes: index of the term, name and lower bound of each free shape.
        places: where they are evaluated.
    """

    terms: tuple[NoiseTerm, ...]
    shapes: tuple[tuple[int, str, float], ...] = eqx.field(static=True)
    places: tuple[Place, ...]

    @classmethod
    def of(
        cls,
        terms: tuple[NoiseTerm, ...],
        shapes: tuple[tuple[int, str, float], ...],
        bins: Bins,
        capacity: int,
    ) -> Others:
        """Terms as they are observed in these bins; those of a record are padded to the levels' capacity."""
        places = [Place.of(part) for part in bins.parts]
        if len(places) == 1:
            nodes = padded(places[0].frequency, capacity, bins.rate / 4.0)
            places[0] = places[0]._replace(frequency=nodes)
        units = tuple(term.with_unit_amplitude().sampled(bins.rate) for term in terms)
        return cls(units, shapes, tuple(places))

    def expected(self, values: Float[Array, " shapes"], m: int) -> Float[Array, "terms 2 m"]:
        """Expected squares at the nodes of m levels for these values of ln(shape − lower bound)."""
        terms = list(self.terms)
        for (k, name, lower), value in zip(self.shapes, values, strict=True):
            terms[k] = terms[k].replace(**{name: lower + jnp.exp(value)})
        every = [jnp.concatenate([place.expected(term) for place in self.places], axis=1) for term in terms]
        units = jnp.stack(every)
        return jnp.pad(units, [(0, 0), (0, 0), (0, m - units.shape[-1])])


class Slots(eqx.Module):
    """Components and parameters of a joint spectral model.

    Attributes:
        layout: numbers of slots.
        inside: whether each component passes through the response.
        kind: the kind of response, see `components`.
        free: which parameters are estimated; the others keep their value.
        lower, upper: bounds of the parameters, powers not in ln.
        centre, precision: normal prior of each parameter; a precision of 0 for none.
        others: terms whose free shapes fit no slot.
    """

    layout: Layout = eqx.field(static=True)
    inside: Any
    kind: Any
    free: Any
    lower: Any
    upper: Any
    centre: Any
    precision: Any
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
        """Slots with the widest bounds and no prior; see `Slots` for the arguments."""
        bandwidth = tuple(np.log(bandwidths(kind)))
        bounds = (_POWER, _TIME, _FREQUENCY, _QUALITY, bandwidth, _QUALITY, _SHAPE)
        counts = (
            layout.components,
            layout.markovs,
            layout.oscillators,
            layout.oscillators,
            1,
            1,
            layout.shapes,
        )
        lower, upper = np.repeat(np.array(bounds), counts, axis=0).T.copy()
        nothing = np.zeros(layout.parameters)
        return cls(layout, inside, np.asarray(kind), free, lower, upper, nothing, nothing, others)

    @property
    def own(self) -> list[int]:
        """Component of each free shape of a further term."""
        return [] if self.others is None else [self.layout.first_other + k for k, *_ in self.others.shapes]

    def usual(self) -> Float[np.ndarray, " parameters"]:
        """Parameters with zero powers, and with shapes in the middle of their ranges."""
        at = self.layout
        theta = np.zeros(at.parameters)
        theta[at.times : at.frequencies] = np.log(100.0)
        theta[at.qualities : at.response] = np.log(5.0)
        return theta


# Bounds of powers [rate²], correlation times [samples], frequencies [radians per sample], Q − ½, and the
# shapes of other terms [SI], in ln but for powers.
_POWER, _TIME, _FREQUENCY, _QUALITY, _SHAPE = (
    (0.0, np.inf),
    (-3.0, 40.0),
    (-30.0, np.log(np.pi)),
    (-7.0, 14.0),
    (-60.0, 60.0),
)


class Expected(NamedTuple):
    """Expected levels of components of unit power [rate²], and their derivatives.

    Attributes:
        unit: the levels.
        by_shape: derivatives by the shapes of the components, without those of the response.
        by_response: derivatives of their sum by bandwidth and quality factor of the response.
    """

    unit: Float[Array, "components m"]
    by_shape: Float[Array, "shapes m"]
    by_response: Float[Array, "2 m"]

    def slope(self, power: Any, at: Layout, own: Sequence[int] = ()) -> Float[Array, "parameters m"]:
        """Derivatives of the expected levels by the parameters; `own`: components of the further shapes."""
        xp = namespace(power, self.unit)
        owner = np.concatenate([at.owner, np.asarray(own, int)])
        moved, first = power[owner, None] * self.by_shape, len(at.owner)
        return xp.concatenate([self.unit, moved[:first], self.by_response, moved[first:]])


def expected(theta: Float[Array, " parameters"], slots: Slots, levels: Levels) -> Expected:
    """Expected levels of all components of unit power, each differentiated by its own shapes only.

    Idle slots for Markov processes and oscillators cost nothing, and have no levels.
    """
    at, others = slots.layout, slots.others
    R, moved = response_and_slope(levels, theta[at.response : at.other_shapes], slots.kind)
    power, m = theta[: at.components], levels.angle.shape[-1]
    inside = jnp.asarray(slots.inside)
    passes = jnp.where(inside, power, 0.0)

    def observed(squares: Array, inside: Array) -> Array:
        """Squares at the nodes as they are in the levels."""
        return jnp.mean(squares * jnp.where(inside, R, 1.0), axis=-2)

    first, last = at.first_markov, at.first_other
    columns = jnp.asarray(levels.columns)
    used = ((theta > 0.0) | slots.free)[first:last]
    order = jnp.argsort(~used)
    of_first = theta[at.times : at.qualities]
    of_second = jnp.concatenate([jnp.zeros(at.markovs), theta[at.qualities : at.response]])

    def slot(i: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        """The next used slot."""
        (passing, found), k = state, order[i]
        every = jnp.stack(oscillation(levels, of_first[k], of_second[k], k < at.markovs))
        passing += passes[first + k] * every[0]
        return passing, found.at[k].set(observed(every, inside[first + k]))

    # What passes through the response, before it.
    passing = jnp.tensordot(passes[:first], columns, 1)
    nothing = jnp.zeros((last - first, 3, m))
    passing, of_slots = jax.lax.fori_loop(0, jnp.sum(used), slot, (passing, nothing))
    parts = [observed(columns, inside[:first, None, None]), of_slots[:, 0]]
    by_shape = [of_slots[:, 1], of_slots[at.markovs :, 2]]
    if others is not None:
        values, inside = theta[at.other_shapes :], slots.inside[last:]
        squares, slopes = others.expected(values, m), jax.jacfwd(lambda u: others.expected(u, m))(values)
        passing += jnp.tensordot(passes[last:], squares, 1)
        parts.append(observed(squares, inside[:, None, None]))
        by_shape += [observed(slopes[k, ..., s], inside[k])[None] for s, (k, *_) in enumerate(others.shapes)]
    by_response = jnp.mean(moved * passing, axis=1)
    return Expected(jnp.concatenate(parts), jnp.concatenate(by_shape), by_response)


def loss(mean: Float[Array, " m"], levels: Levels) -> Float[Array, ""]:
    """Minus the log-likelihood of the levels, without what depends on the data alone: Σ k(ln μ + y/μ)."""
    return jnp.sum(levels.shape * (jnp.log(mean) + levels.level / mean))


class Maximum(NamedTuple):
    """Maximum of the likelihood.

    Attributes:
        theta: the parameters there.
        scale: power of each component that would be one standard deviation, to which that of the next two
            belongs: powers are in ln(p + scale) there.
        loss: minus the log-likelihood, see `model.loss`, prior included.
        information: Fisher's information of the parameters that are estimated and not at a bound, prior
            included; the others have a unit on the diagonal.
        interior: which parameters these are.
        mean: the expected levels [rate²].
        model: expected levels of each component, and their derivatives.
        steps: number of steps taken.
        converged: whether the iteration converged.
    """

    theta: Float[Array, " parameters"]
    scale: Float[Array, " components"]
    loss: Float[Array, ""]
    information: Float[Array, "parameters parameters"]
    interior: Bool[Array, " parameters"]
    mean: Float[Array, " m"]
    model: Expected
    steps: Int[Array, ""]
    converged: Bool[Array, ""]


class _State(NamedTuple):
    """State of the iteration: the best place, the next one to try, the gain expected there, the damping."""

    best: Maximum
    trial: Float[Array, " parameters"]
    predicted: Float[Array, ""]
    damping: Float[Array, ""]


class _Problem(NamedTuple):
    """What is maximized; see `maximize`."""

    slots: Slots
    levels: Levels
    noise: Any
    tolerance: Any

    def begun(self, theta: Any) -> _State:
        """State before the first step, which evaluates the start."""
        at, m = self.slots.layout, self.levels.angle.shape[-1]
        start = jnp.clip(theta, self.slots.lower, self.slots.upper)
        by_shape = jnp.zeros((len(at.owner) + at.shapes, m))
        nothing = Maximum(
            theta=start,
            scale=jnp.ones(at.components),
            loss=jnp.asarray(jnp.inf),
            information=jnp.eye(at.parameters),
            interior=jnp.zeros(at.parameters, bool),
            mean=jnp.ones(m),
            model=Expected(jnp.zeros((at.components, m)), by_shape, jnp.zeros((2, m))),
            steps=jnp.asarray(0),
            converged=jnp.asarray(False),
        )
        return _State(nothing, start, jnp.zeros(()), jnp.asarray(_DAMPING))

    def at(self, theta: Array, former: Maximum) -> Maximum:
        """The model and the loss at a place."""
        slots = self.slots
        model = expected(theta, slots, self.levels)
        scales = power_scales(model.unit, self.levels.shape, jnp.asarray(self.noise))
        scale = jnp.where(former.steps == 0, scales, former.scale)
        mean = theta[: slots.layout.components] @ model.unit
        mean = jnp.maximum(mean, _LEAST * jnp.max(scale))
        prior = jnp.where(slots.free, slots.precision * (theta - slots.centre) ** 2, 0.0)
        value = loss(mean, self.levels) + 0.5 * jnp.sum(prior)
        return former._replace(theta=theta, scale=scale, loss=value, mean=mean, model=model)

    def step(self, state: _State) -> _State:
        """The place that was to be tried, if it is better, and the next one."""
        best, predicted = state.best, state.predicted
        new = self.at(state.trial, best)
        gain = best.loss - new.loss
        taken = gain > jnp.maximum(_BAD * predicted, 0.0)
        # Of a small step the gain is lost in rounding.
        taken |= (predicted >= 0.0) & (predicted < _SMALL) & (best.steps > 0)
        best = jax.tree.map(lambda new, old: jnp.where(taken, new, old), new, best)
        change = jnp.where(taken & (gain > _GOOD * predicted), _LESS, jnp.where(taken, 1.0, _MORE))
        damping = jnp.where(best.steps == 0, _DAMPING, state.damping * change)
        far = (best.steps == 0) | (jnp.abs(predicted) > _NEARBY)
        trial, gain, interior = self.next(best, damping, far)
        # At a kink of a response no step gains anything.
        ended = (jnp.abs(gain) < self.tolerance) & (damping < _SLACK) | (damping > _STUCK)
        best = best._replace(interior=interior, steps=best.steps + 1, converged=ended)
        return _State(best, trial, gain, damping)

    def next(self, best: Maximum, damping: Array, far: Array) -> tuple[Array, Array, Array]:
        """The next place to try, the gain to expect there, and which parameters may move.

        Far from the maximum the curvature is that of the levels' deviances, with which steps are as long as
        in logarithms; near it, the information.
        """
        slots, k = self.slots, jnp.asarray(self.levels.shape)
        slope, gradient, interior = self.slope(best)
        excess = self.levels.level / best.mean - 1.0
        series = jnp.abs(excess) < _CLOSE
        apart = jnp.where(series, 1.0, jnp.maximum(excess, _LOWEST - 1.0))
        deviance = apart**2 / (2.0 * (apart - jnp.log1p(apart)))
        weight = jnp.where(far, jnp.where(series, 1.0 + 2.0 * excess / 3.0, deviance), 1.0)
        curvature = (slope * (k * weight)) @ slope.T + jnp.diag(jnp.where(interior, slots.precision, 1.0))
        size = 1.0 / jnp.sqrt(jnp.maximum(jnp.diag(curvature), 1e-12))
        damped = curvature * size[:, None] * size + jnp.diag(jnp.where(interior, damping + 1e-12, 0.0))
        move = jnp.clip(-size * solve(damped, gradient * size), -_LONGEST, _LONGEST)
        count = slots.layout.components
        to = (best.theta[:count] + best.scale) * jnp.expm1(move[:count])
        trial = jnp.clip(best.theta + jnp.concatenate([to, move[count:]]), slots.lower, slots.upper)
        return trial, -0.5 * gradient @ move, interior

    def slope(self, best: Maximum) -> tuple[Array, Array, Array]:
        """Slope of the logarithms of the levels, gradient of the loss, and which parameters may move.

        They are zero for parameters that may not, as at a bound beyond which the loss still falls.
        """
        slots, theta, count = self.slots, best.theta, self.slots.layout.components
        moved = jnp.concatenate([theta[:count] + best.scale, jnp.ones(len(theta) - count)])
        slope = best.model.slope(theta[:count], slots.layout, slots.own) / best.mean * moved[:, None]
        surplus = jnp.asarray(self.levels.shape) * (1.0 - self.levels.level / best.mean)
        gradient = slope @ surplus + slots.precision * (theta - slots.centre)
        outward = ((theta <= slots.lower) & (gradient > 0.0)) | ((theta >= slots.upper) & (gradient < 0.0))
        interior = slots.free & ~outward
        return jnp.where(interior[:, None], slope, 0.0), jnp.where(interior, gradient, 0.0), interior


def maximize(
    theta: Float[np.ndarray, " parameters"],
    slots: Slots,
    levels: Levels,
    noise: Float[np.ndarray, " m"],
    tolerance: float = _TOLERANCE,
) -> Maximum:
    """Maximum of the likelihood from a start, compiled once for all records and models; in NumPy arrays.

    Args:
        theta: the start.
        slots: the model.
        levels: the levels.
        noise: rough levels [rate²], in which the scales of the powers are one standard deviation.
        tolerance: gain of the next step at which the iteration ends [nats].
    """
    with compiled_once((slots.layout, len(levels.shape), slots.others is None)):
        return jax.device_get(_maximize(theta, slots, levels, noise, np.asarray(tolerance)))


@eqx.filter_jit
def _maximize(
    theta: Float[ArrayLike, " parameters"],
    slots: Slots,
    levels: Levels,
    noise: Float[ArrayLike, " m"],
    tolerance: Float[ArrayLike, ""],
) -> Maximum:
    problem = _Problem(slots, levels, noise, tolerance)

    def goes_on(state: _State) -> Array:
        return ~state.best.converged & (state.best.steps < _STEPS) & ~jnp.isnan(state.predicted)

    best = jax.lax.while_loop(goes_on, problem.step, problem.begun(theta)).best
    slope, _, interior = problem.slope(best)
    prior = jnp.diag(jnp.where(interior, slots.precision, 1.0))
    return best._replace(information=(slope * levels.shape) @ slope.T + prior)


def power_scales(unit: Array, shape: Array, noise: Array) -> Float[Array, " components"]:
    """Power of each component that would be one standard deviation in noise of these levels [rate²]."""
    information = jnp.sum(shape * (unit / noise) ** 2, axis=1)
    return jnp.where(information > 0.0, 1.0 / jnp.sqrt(jnp.maximum(information, 1e-300)), 1.0)


def covariance(maximum: Maximum) -> Float[np.ndarray, "parameters parameters"]:
    """Covariance of the estimates, powers as `Maximum.scale` says; zero for what is held or at a bound."""
    size = 1.0 / np.sqrt(np.diag(maximum.information))
    interior = np.asarray(maximum.interior)
    spread = np.linalg.pinv(maximum.information * np.outer(size, size), hermitian=True) * np.outer(size, size)
    return np.where(np.outer(interior, interior), spread, 0.0)
