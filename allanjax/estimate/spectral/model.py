"""The joint spectral model: powers and shapes in slots, their expected levels and derivatives.

    μ = R·Σ p_c S_c (what is inside the response R) + Σ p_c S_c (what is after it)

A slot is idle where its power is zero. Which slots are in use, what is inside, and the kind of response are
data, so that one compiled program serves every model. A power p is written as p = scale·(e^u − 1): linear
below its scale, where the data hardly show it, logarithmic above, and zero at u = 0.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from allanjax.estimate.spectral.components import NONE, markov, oscillator, response
from allanjax.estimate.spectral.levels import COLUMNS, Levels

#: Number of slots of each kind with a free shape.
MARKOVS, OSCILLATORS = 4, 12
#: Number of components, and of parameters: powers, then correlation times, then frequencies and quality
#: factors of the oscillators, then bandwidth and quality factor of the response.
COMPONENTS = COLUMNS + MARKOVS + OSCILLATORS
PARAMETERS = COMPONENTS + MARKOVS + 2 * OSCILLATORS + 2
#: First index of each group of parameters after the powers.
TIMES = COMPONENTS
FREQUENCIES = TIMES + MARKOVS
QUALITIES = FREQUENCIES + OSCILLATORS
RESPONSE = QUALITIES + OSCILLATORS


class Slots(NamedTuple):
    """What a joint spectral model consists of.

    Attributes:
        scale: scale of each power [rate²] (components).
        inside: whether each component passes through the response.
        band_limited: whether oscillators have no aliases.
        kind: the kind of response, see `components`.
        free: which parameters are estimated; the others keep their value.
        lower, upper: bounds of the parameters.
        centre, precision: normal prior of each parameter; a precision of 0 for none.
    """

    scale: Any
    inside: Any
    band_limited: Any
    kind: Any
    free: Any
    lower: Any
    upper: Any
    centre: Any
    precision: Any


# Bounds of correlation times [samples], frequencies [radians per sample], Q − ½, and bandwidths, in ln.
_POWER, _TIME, _FREQUENCY, _QUALITY, _BANDWIDTH = (
    (0.0, 80.0),
    (-3.0, 40.0),
    (-30.0, np.log(np.pi)),
    (-7.0, 14.0),
    (-20.0, 5.0),
)


def slots_of(
    scale: Float[np.ndarray, " components"],
    free: Bool[np.ndarray, " parameters"],
    inside: Bool[np.ndarray, " components"],
    kind: int = NONE,
    band_limited: bool = False,
) -> Slots:
    """Slots with the widest bounds and no prior; see `Slots` for the arguments."""
    counts = (COMPONENTS, MARKOVS, OSCILLATORS, OSCILLATORS, 1, 1)
    bounds = (_POWER, _TIME, _FREQUENCY, _QUALITY, _BANDWIDTH, _QUALITY)
    lower, upper = np.repeat(np.array(bounds), counts, axis=0).T
    nothing = np.zeros(PARAMETERS)
    return Slots(
        scale, inside, np.asarray(band_limited), np.asarray(kind), free, lower, upper, nothing, nothing
    )


class Expected(NamedTuple):
    """Expected levels, and what each component and each parameter contributes.

    Attributes:
        mean: the expected levels [rate²].
        components: the part of each component in them.
        slope: derivatives of their logarithms by the parameters.
    """

    mean: Float[Array, " m"]
    components: Float[Array, "components m"]
    slope: Float[Array, "parameters m"]


def expected(theta: Float[Array, " parameters"], slots: Slots, levels: Levels) -> Expected:
    """Expected levels and their derivatives, each slot's along its own parameters only."""
    u = theta[:COMPONENTS]
    power, by_u = slots.scale * jnp.expm1(u), slots.scale * jnp.exp(u)
    times = theta[TIMES:FREQUENCIES]
    oscillating = jnp.stack([theta[FREQUENCIES:QUALITIES], theta[QUALITIES:RESPONSE]], axis=1)

    def with_slope(function: Any, shape: Array) -> tuple[Array, Array]:
        return function(shape), jax.jacfwd(function)(shape)

    chains, by_time = jax.vmap(lambda t: with_slope(lambda t: markov(levels, t), t))(times)
    waves, by_wave = jax.vmap(
        lambda shape: with_slope(lambda shape: oscillator(levels, shape, slots.band_limited), shape)
    )(oscillating)
    R, by_response = with_slope(lambda shape: response(levels, shape, slots.kind), theta[RESPONSE:])
    unit = jnp.concatenate([levels.columns, chains, waves])
    passed = jnp.where(slots.inside[:, None, None], R, 1.0)
    seen = jnp.mean(unit * passed, axis=1)
    components = power[:, None] * seen
    mean = jnp.maximum(jnp.sum(components, axis=0), _LEAST * jnp.max(slots.scale))
    inside = jnp.tensordot(jnp.where(slots.inside, power, 0.0), unit, 1)
    by_shape = jnp.concatenate([by_time, by_wave[..., 0], by_wave[..., 1]])
    owner = np.append(np.arange(COLUMNS, COMPONENTS), np.arange(COLUMNS + MARKOVS, COMPONENTS))
    slope = jnp.concatenate(
        [
            by_u[:, None] * seen,
            power[owner, None] * jnp.mean(by_shape * passed[owner], axis=1),
            jnp.mean(inside * jnp.moveaxis(by_response, -1, 0), axis=1),
        ]
    )
    return Expected(mean, components, slope / mean)


def power_scales(
    theta: Float[Array, " parameters"], slots: Slots, levels: Levels, noise: Float[Array, " m"]
) -> Float[Array, " components"]:
    """Power of each component that would be one standard deviation in noise of these levels [rate²].

    The shapes of the components are those in `theta`. It is the scale for `Slots`: below it the data hardly
    show a power.
    """
    ones = jnp.ones(COMPONENTS)
    at_unit_power = jnp.asarray(theta).at[:COMPONENTS].set(jnp.log(2.0))
    unit = expected(at_unit_power, slots._replace(scale=ones), levels).components
    information = jnp.sum(levels.shape * (unit / noise) ** 2, axis=1)
    return jnp.where(information > 0.0, 1.0 / jnp.sqrt(jnp.maximum(information, 1e-300)), 1.0)


# Smallest expected level, in units of the largest scale of a power.
_LEAST = 1e-30


def loss(mean: Float[Array, " m"], levels: Levels) -> Float[Array, ""]:
    """Minus the log-likelihood of the levels, up to what the data alone determine: Σ k(ln μ + y/μ)."""
    return jnp.sum(levels.shape * (jnp.log(mean) + levels.level / mean))


def parameters(
    power: Float[np.ndarray, " components"],
    scale: Float[np.ndarray, " components"],
    times: Float[np.ndarray, " markovs"],
    frequencies: Float[np.ndarray, " oscillators"],
    qualities: Float[np.ndarray, " oscillators"],
    response: Float[np.ndarray, " 2"],
) -> Float[np.ndarray, " parameters"]:
    """Parameters from their values, times in sample intervals and frequencies in radians per interval.

    Args:
        power, scale: powers [rate²] and their scales.
        times: correlation times.
        frequencies, qualities: ω0 and Q of the oscillators.
        response: ω_c and Q of the response.
    """
    return np.concatenate(
        [
            np.log1p(power / scale),
            np.log(times),
            np.log(frequencies),
            np.log(qualities - 0.5),
            [np.log(response[0]), np.log(response[1] - 0.5)],
        ]
    )
