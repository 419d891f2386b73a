"""The joint spectral model: expected levels as a function of its parameters, and its maximum likelihood.

Powers and shapes are in slots:

    μ = R·Σ p_c S_c (what is inside the response R) + Σ p_c S_c (what is after it)

A slot is idle if its power is zero. The slots in use, the components inside the response, and the kind of
response are data, so that one compiled program serves every model. A power p is written as
p = scale·(e^u − 1): linear below its scale, where the data hardly determine it, logarithmic above, 0 at u =
0.
The deviance residuals of the levels, r = sign(x − 1)·√(2k(x − 1 − ln x)) with x = level/mean, make the
log-likelihood a sum of squares, whose Gauss–Newton matrix is nearly Fisher's information. Some parameters are
known to 10⁻⁴, such as a resonance's frequency, others only to a factor, such as a long correlation time; so
the damping is proportional to the diagonal of that matrix (Marquardt 1963), not to the identity.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from allanjax.base.linalg import inverse, solve
from allanjax.estimate.spectral.components import (
    NONE,
    Levels,
    Place,
    bandwidths,
    markov,
    oscillator,
    padded,
    response,
    response_ends,
)
from allanjax.noise.terms import NoiseTerm
from allanjax.spectrum.cosine import Bins

# Damping of the first step, relative to the information, and the longest step of a parameter.
_DAMPING = 0.01
_LONGEST = 2.0
# Tolerance of a fit.
_TOLERANCE = 1e-5
# Most steps of a fit.
_STEPS = 400
# Lower bound of the ratio of a level to its expectation, and excess over 1 below which a series is used.
_LEAST_RATIO = 1e-12
_NEAR = 1e-4


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
    def parameters(self) -> int:
        """Number of parameters."""
        return self.other_shapes + self.shapes


#: Slots for the usual models, and for those with resonances or a response.
PLAIN, FULL = Layout(8, 2, 0), Layout(8, 4, 12)


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
        """Terms evaluated in these bins; for a record, padded to the capacity of the levels."""
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
        found = jnp.stack(every)
        return jnp.pad(found, [(0, 0), (0, 0), (0, m - found.shape[-1])])


class Slots(eqx.Module):
    """Components and parameters of a joint spectral model.

    Attributes:
        layout: numbers of slots.
        scale: scale of each power [rate²] (components).
        inside: whether each component passes through the response.
        band_limited: whether oscillators are free of aliases.
        kind: the kind of response, see `components`.
        free: which parameters are estimated; the others keep their values.
        lower, upper: bounds of the parameters.
        centre, precision: normal prior of each parameter; a precision of 0 for none.
        others: terms whose free shapes fit no slot.
    """

    layout: Layout = eqx.field(static=True)
    scale: Any
    inside: Any
    band_limited: Any
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
        band_limited: bool = False,
        others: Others | None = None,
    ) -> Slots:
        """Slots with the widest bounds, powers in units of 1 and no prior; see `Slots` for the arguments."""
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
        scale, nothing = np.ones(layout.components), np.zeros(layout.parameters)
        kind_of, limited = np.asarray(kind), np.asarray(band_limited)
        return cls(layout, scale, inside, limited, kind_of, free, lower, upper, nothing, nothing, others)

    def usual(self) -> Float[np.ndarray, " parameters"]:
        """Parameters with zero powers, and with shapes in the middle of their ranges."""
        at = self.layout
        theta = np.zeros(at.parameters)
        theta[at.times : at.frequencies] = np.log(100.0)
        theta[at.qualities : at.response] = np.log(5.0)
        return theta


# Bounds of powers, correlation times [samples], frequencies [radians per sample], Q − ½, and the shapes of
# other terms [SI], in ln.
_POWER, _TIME, _FREQUENCY, _QUALITY, _SHAPE = (
    (0.0, 80.0),
    (-3.0, 40.0),
    (-30.0, np.log(np.pi)),
    (-7.0, 14.0),
    (-60.0, 60.0),
)


class Expected(NamedTuple):
    """Expected levels, and the contribution of each component and each parameter.

    Attributes:
        mean: the expected levels [rate²].
        components: the part of each component in them.
        slope: derivatives of their logarithms by the parameters.
        by_response: derivatives of the levels of each component, at unit power, by the response's parameters.
    """

    mean: Float[Array, " m"]
    components: Float[Array, "components m"]
    slope: Float[Array, "parameters m"]
    by_response: Float[Array, "components 2 m"]


@eqx.filter_jit
def expected(theta: Float[Array, " parameters"], slots: Slots, levels: Levels) -> Expected:
    """Expected levels and their derivatives, those of each slot by its own parameters only.

    Idle slots, which have no power and are not estimated, cost nothing and have no derivatives.
    """
    at, others = slots.layout, slots.others
    u = theta[: at.components]
    power, by_u = slots.scale * jnp.expm1(u), slots.scale * jnp.exp(u)
    used = (power != 0.0) | slots.free[: at.components]
    passed = _passed_and_slope(_of_response(theta, at), slots, levels)
    fixed = jax.vmap(lambda unit, inside: _seen(unit[None], inside, passed))
    seen = [fixed(jnp.asarray(levels.columns), slots.inside[: at.columns])]
    first = at.columns
    for function, shapes in _free_slots(theta, slots, levels):
        of = slice(first, first + len(shapes))
        seen.append(_of_slots(function, shapes, used[of], slots.inside[of], passed))
        first += len(shapes)
    along, owner = [], []
    for (level, _), start in zip(seen[1:], (at.first_markov, at.first_oscillator), strict=False):
        along += [level[:, k] for k in range(1, level.shape[1])]
        owner += [np.arange(start, start + len(level))] * (level.shape[1] - 1)
    if others is not None:
        values, inside = theta[at.other_shapes :], slots.inside[first:]
        seen.append(fixed(others.expected(values, len(levels.shape)), inside))
        slope = jax.jacfwd(lambda shapes: others.expected(shapes, len(levels.shape)))(values)
        for s, (k, *_) in enumerate(others.shapes):
            along.append(_seen(slope[k, None, ..., s], inside[k], passed).levels)
            owner.append(np.array([at.first_other + k]))
    unit = jnp.concatenate([part.levels[:, 0] for part in seen])
    by_response = jnp.concatenate([part.by_response for part in seen])
    mean = jnp.maximum(power @ unit, _LEAST * jnp.max(slots.scale))
    by_shape = power[np.concatenate(owner), None] * jnp.concatenate(along) if along else unit[:0]
    of_slots = at.response - at.times
    parts = [by_u[:, None] * unit, by_shape[:of_slots], jnp.tensordot(power, by_response, 1)]
    slope = jnp.concatenate([*parts, by_shape[of_slots:]]) / mean
    return Expected(mean, power[:, None] * unit, slope, by_response)


class _Seen(NamedTuple):
    """A component of unit power in the levels, with its derivatives by its shapes and by the response.

    The arrays are (1 + shapes, m) and (2, m).
    """

    levels: Array
    by_response: Array


def _seen(units: Float[Array, "k 2 m"], inside: Array, passed: tuple[Array, Array]) -> _Seen:
    """Expected squares in the levels, after the response if the component passes through it."""
    response, slope = passed
    through = units * jnp.where(inside, response, 1.0)
    moved = jnp.where(inside, units[0] * slope, 0.0)
    return _Seen(*(0.5 * (x[:, 0] + x[:, 1]) for x in (through, moved)))


def _of_slots(
    function: Callable[[Array], Array],
    shapes: Float[Array, "slots shapes"],
    used: Bool[Array, " slots"],
    inside: Bool[Array, " slots"],
    passed: tuple[Array, Array],
) -> _Seen:
    """Slots with free shapes, one after another; unused ones are not evaluated."""
    count, m = shapes.shape[1], passed[0].shape[-1]

    def slot(of: tuple[Array, Array, Array]) -> _Seen:
        shape, here, within = of

        def evaluated() -> _Seen:
            return _seen(jnp.stack([function(shape), *_derivatives(function, shape)]), within, passed)

        return jax.lax.cond(here, evaluated, lambda: _Seen(jnp.zeros((1 + count, m)), jnp.zeros((2, m))))

    return jax.lax.map(slot, (shapes, used, inside))


def _derivatives(function: Callable[[Array], Array], shape: Float[Array, " shapes"]) -> list[Array]:
    """Derivatives by each shape in separate arrays, which is faster than one array with the shapes last."""
    return [jax.jvp(function, (shape,), (tangent,))[1] for tangent in jnp.eye(len(shape))]


def units(theta: Float[Array, " parameters"], slots: Slots, levels: Levels) -> Float[Array, "components m"]:
    """Expected levels [rate²] of each component at unit power, after the response if it passes through it."""
    R = _passed(_of_response(theta, slots.layout), slots, levels)
    return jnp.mean(_units(theta, slots, levels) * jnp.where(slots.inside[:, None, None], R, 1.0), axis=1)


def _passed(shape: Float[Array, " 2"], slots: Slots, levels: Levels) -> Float[Array, "2 m"]:
    """Response for white noise in a record, the contribution of its two ends included."""
    return response(levels, shape, slots.kind) + response_ends(levels, shape, slots.kind)


def _passed_and_slope(
    shape: Float[Array, " 2"], slots: Slots, levels: Levels
) -> tuple[Float[Array, "2 m"], Float[Array, "2 2 m"]]:
    """Response as in `_passed`, and its derivatives.

    It is in a branch of its own, to be computed once: otherwise the compiler repeats it in every product.
    """

    def filtered(shape: Array) -> tuple[Array, Array]:
        passed = functools.partial(_passed, slots=slots, levels=levels)
        return passed(shape), jnp.stack(_derivatives(passed, shape))

    def plain(shape: Array) -> tuple[Array, Array]:
        everything = jnp.ones_like(levels.angle)
        return everything, jnp.zeros((2, *everything.shape))

    return jax.lax.cond(slots.kind == NONE, plain, filtered, shape)


def _of_response(theta: Array, at: Layout) -> Array:
    """Parameters of the response."""
    return theta[at.response : at.other_shapes]


def _free_slots(
    theta: Array, slots: Slots, levels: Levels
) -> list[tuple[Callable[[Array], Array], Float[Array, "slots shapes"]]]:
    """Each kind of slot with free shapes: expected squares for unit power at the nodes, and the shapes."""
    at = slots.layout
    kinds: list[tuple[Callable[[Array], Array], Array]] = []
    if at.markovs:
        kinds.append((lambda shape: markov(levels, shape[0]), theta[at.times : at.frequencies, None]))
    if at.oscillators:
        shapes = [theta[at.frequencies : at.qualities], theta[at.qualities : at.response]]
        kinds.append((lambda shape: oscillator(levels, shape, slots.band_limited), jnp.stack(shapes, axis=1)))
    return kinds


def _units(theta: Array, slots: Slots, levels: Levels) -> Float[Array, "components 2 m"]:
    """Expected squares of the components of unit power at the nodes, before the response."""
    parts = [jnp.asarray(levels.columns)]
    parts += [jax.vmap(function)(shapes) for function, shapes in _free_slots(theta, slots, levels)]
    if slots.others is not None:
        parts.append(slots.others.expected(theta[slots.layout.other_shapes :], len(levels.shape)))
    return jnp.concatenate(parts)


def power_scales(
    theta: Float[Array, " parameters"], slots: Slots, levels: Levels, noise: Float[Array, " m"]
) -> Float[Array, " components"]:
    """Power of each component that equals one standard deviation in noise of these levels [rate²].

    The shapes are those in `theta`. They are the scales for `Slots`, below which powers hardly show.
    """
    information = jnp.sum(levels.shape * (units(theta, slots, levels) / noise) ** 2, axis=1)
    return jnp.where(information > 0.0, 1.0 / jnp.sqrt(jnp.maximum(information, 1e-300)), 1.0)


# Smallest expected level, in units of the largest scale of a power.
_LEAST = 1e-30


def loss(mean: Float[Array, " m"], levels: Levels) -> Float[Array, ""]:
    """Minus the log-likelihood of the levels, without what depends on the data alone: Σ k(ln μ + y/μ)."""
    return jnp.sum(levels.shape * (jnp.log(mean) + levels.level / mean))


class Maximum(NamedTuple):
    """Maximum of the likelihood.

    Attributes:
        theta: the parameters there.
        loss: minus the log-likelihood, see `model.loss`, prior included.
        information: Fisher's information of the parameters that are estimated and not at a bound, prior
            included; the others have a unit on the diagonal.
        interior: which parameters are estimated and not at a bound.
        steps: number of steps taken.
        converged: whether the iteration converged.
    """

    theta: Float[Array, " parameters"]
    loss: Float[Array, ""]
    information: Float[Array, "parameters parameters"]
    interior: Bool[Array, " parameters"]
    steps: Int[Array, ""]
    converged: Bool[Array, ""]


class _Problem(NamedTuple):
    """Data on which the residuals depend, besides the parameters."""

    slots: Slots
    levels: Levels
    tolerance: Any


@eqx.filter_jit
def maximize(
    theta: Float[Array, " parameters"], slots: Slots, levels: Levels, tolerance: ArrayLike = _TOLERANCE
) -> Maximum:
    """Maximum of the likelihood from a start, compiled once for all records and models.

    The iteration ends when no parameter and no residual moves by more than the tolerance.
    Differentiable in the levels, their columns and the prior, by the implicit function theorem.
    """
    problem = _Problem(slots, levels, jnp.asarray(tolerance))
    found, steps, converged = _peak(problem, jnp.clip(theta, slots.lower, slots.upper))
    interior = _interior(found, slots, levels)
    model = expected(found, slots, levels)
    slope = jnp.where(interior[:, None], model.slope, 0.0)
    information = (slope * levels.shape) @ slope.T + jnp.diag(jnp.where(interior, slots.precision, 1.0))
    prior = 0.5 * jnp.sum(jnp.where(slots.free, slots.precision * (found - slots.centre) ** 2, 0.0))
    return Maximum(found, loss(model.mean, levels) + prior, information, interior, steps, converged)


def covariance(maximum: Maximum) -> Float[Array, "parameters parameters"]:
    """Covariance of the estimates; zero for parameters that are held or at a bound."""
    scale = 1.0 / jnp.sqrt(jnp.diag(maximum.information))
    both = maximum.interior[:, None] & maximum.interior
    spread = inverse(maximum.information * scale[:, None] * scale) * scale[:, None] * scale
    return jnp.where(both, spread, 0.0)


@eqx.filter_custom_jvp
def _peak(problem: _Problem, start: Array) -> tuple[Array, Array, Array]:
    """Parameters at the maximum, number of steps, and whether the iteration converged."""
    found: optx.Solution = optx.least_squares(
        _residuals,
        _Scoring(problem.slots.lower, problem.slots.upper, problem.tolerance),
        start,
        args=problem,
        max_steps=_STEPS,
        throw=False,
    )
    converged = jnp.asarray(found.result == optx.RESULTS.successful)
    return found.value, found.stats["num_steps"], converged


@_peak.def_jvp
def _peak_jvp(primals: Any, tangents: Any) -> tuple[Any, Any]:
    """The maximum moves by −H⁻¹ times the change of the gradient; H is the second derivative of the loss."""
    problem, start = primals
    theta, steps, converged = _peak(problem, start)
    interior = _interior(theta, problem.slots, problem.levels)
    differentiable, fixed = eqx.partition(
        problem, jax.tree.map(lambda t: t is not None, tangents[0], is_leaf=lambda t: t is None)
    )
    moved = jax.tree.leaves(tangents[0])
    leaves, structure = jax.tree.flatten(differentiable)

    def gradient_of(leaves: list[Array]) -> Array:
        of: _Problem = eqx.combine(jax.tree.unflatten(structure, leaves), fixed)
        return _gradient(theta, of.slots, of.levels)

    _, change = jax.jvp(gradient_of, (leaves,), (moved,))
    hessian = jax.jacfwd(lambda theta: _gradient(theta, problem.slots, problem.levels))(theta)
    both = interior[:, None] & interior
    system = jnp.where(both, hessian, 0.0) + jnp.diag(jnp.where(interior, 0.0, 1.0))
    return (theta, steps, converged), (-solve(system, jnp.where(interior, change, 0.0)), None, None)


def _gradient(theta: Array, slots: Slots, levels: Levels) -> Float[Array, " parameters"]:
    """Gradient of the loss, prior included."""
    model = expected(theta, slots, levels)
    prior = slots.precision * (theta - slots.centre)
    return model.slope @ (levels.shape * (1.0 - levels.level / model.mean)) + prior


def _interior(theta: Array, slots: Slots, levels: Levels) -> Bool[Array, " parameters"]:
    """Parameters that are estimated and that the data do not keep at a bound."""
    return slots.free & _movable(theta, _gradient(theta, slots, levels), slots.lower, slots.upper)


def _movable(theta: Array, gradient: Array, lower: Array, upper: Array) -> Bool[Array, " parameters"]:
    """Parameters that are not at a bound across which the likelihood would still rise."""
    return ~((theta <= lower) & (gradient > 0.0)) & ~((theta >= upper) & (gradient < 0.0))


@jax.custom_jvp
def _residuals(theta: Float[Array, " parameters"], problem: _Problem) -> Float[Array, " rows"]:
    """Deviance residuals of the levels, and the residuals of the prior."""
    return _residuals_and_slope(theta, problem)[0]


@_residuals.defjvp
def _residuals_jvp(primals: Any, tangents: Any) -> tuple[Array, Array]:
    # One matrix serves the tangents of all parameters.
    residuals, slope = _residuals_and_slope(*primals)
    return residuals, tangents[0] @ slope


def _residuals_and_slope(theta: Array, problem: _Problem) -> tuple[Array, Array]:
    """Residuals, and their derivatives by the parameters (parameters, rows)."""
    slots, levels, _ = problem
    model = expected(theta, slots, levels)
    excess = jnp.maximum(levels.level / model.mean, _LEAST_RATIO) - 1.0
    near = jnp.abs(excess) < _NEAR
    apart = jnp.where(near, 1.0, excess)
    root = jnp.where(near, jnp.abs(excess) * (1.0 - excess / 3.0), jnp.sqrt(2.0 * (apart - jnp.log1p(apart))))
    weight = jnp.where(near, 1.0 + excess / 3.0, jnp.abs(apart) / root)
    k = jnp.sqrt(levels.shape)
    by_data = jnp.where(slots.free[:, None], -(k * weight) * model.slope, 0.0)
    # A prior of its own keeps a parameter that is not estimated at its value.
    stiffness = jnp.where(slots.free, jnp.sqrt(slots.precision), 1.0)
    away = jnp.where(slots.free, theta - slots.centre, 0.0)
    return (
        jnp.concatenate([k * jnp.sign(excess) * root, stiffness * away]),
        jnp.concatenate([by_data, jnp.diag(stiffness)], axis=1),
    )


class _Place(NamedTuple):
    """A point of the descent: the parameters, the gradient and the Gauss–Newton matrix there."""

    theta: Any
    gradient: Any
    matrix: Any


class _ScaledDescent(optx.AbstractDescent):
    """Levenberg–Marquardt steps with damping λ·diag(JᵀJ), within bounds."""

    lower: Float[Array, " parameters"]
    upper: Float[Array, " parameters"]

    def init(self, y: Any, f_info_struct: Any) -> _Place:
        return _Place(y, jnp.zeros_like(y), jnp.zeros((len(y), len(y))))

    def query(self, y: Any, f_info: Any, state: _Place) -> _Place:
        J = f_info.jac.as_matrix()
        return _Place(y, J.T @ f_info.residual, J.T @ J)

    def step(self, step_size: Any, state: _Place) -> tuple[Any, Any]:
        theta, gradient, matrix = state
        movable = _movable(theta, gradient, self.lower, self.upper)
        scale = 1.0 / jnp.sqrt(jnp.maximum(jnp.diag(matrix), 1e-12))
        scaled = jnp.where(movable[:, None] & movable, matrix * scale[:, None] * scale, 0.0)
        damped = scaled + jnp.diag(jnp.where(movable, _DAMPING / step_size + 1e-12, 1.0))
        move = -scale * solve(damped, jnp.where(movable, gradient * scale, 0.0))
        moved = jnp.clip(theta + jnp.clip(move, -_LONGEST, _LONGEST), self.lower, self.upper)
        return moved - theta, optx.RESULTS.successful


class _Scoring(optx.AbstractGaussNewton):
    """Gauss–Newton iteration with scaled damping."""

    rtol: float
    atol: Any
    norm: Any
    descent: _ScaledDescent
    search: optx.ClassicalTrustRegion
    verbose: Any

    def __init__(self, lower: Array, upper: Array, tolerance: Array):
        self.rtol, self.atol, self.norm = 0.0, tolerance, optx.max_norm
        self.descent = _ScaledDescent(lower, upper)
        self.search = optx.ClassicalTrustRegion(0.5, 0.01, 6.0, 0.15)
        self.verbose = lambda **_: None
