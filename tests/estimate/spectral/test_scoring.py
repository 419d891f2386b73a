"""The joint spectral model: its derivatives, its maximum, errors and derivatives of the maximum."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

import allanjax as aj
from allanjax.estimate.spectral.columns import columns_of
from allanjax.estimate.spectral.components import ONE_POLE
from allanjax.estimate.spectral.levels import levels_of
from allanjax.estimate.spectral.model import FULL, Slots, expected, power_scales
from allanjax.estimate.spectral.scoring import covariance, maximize
from allanjax.spectrum.cosine import Bins

BASIC = (aj.AngleRandomWalk(1.0), aj.RateRandomWalk(1.0))
LEVELS = 640
WAVE = FULL.first_oscillator
compiled = eqx.filter_jit(expected)


def parameters(power, scale, times, frequencies, qualities, response):
    """Parameters from their values."""
    shapes = np.log(times), np.log(frequencies), np.log(qualities - 0.5)
    return np.concatenate([np.log1p(power / scale), *shapes, np.log([response[0], response[1] - 0.5])])


def slots_of(scale, free, inside, kind=0, band_limited=False):
    return dataclasses.replace(Slots.of(FULL, free, inside, kind, band_limited), scale=scale)


def bins_of(n, around=()):
    return Bins.of(n, 1.0, around, 24)


def empty_levels(bins):
    return levels_of(bins, columns_of(BASIC, bins), FULL.columns, LEVELS)


def filtered_and_resonant(n):
    """White noise and a walk through one pole, with a resonance after it: true parameters and slots."""
    power = np.zeros(FULL.components)
    power[[0, 1, WAVE]] = 1.0, 3e-6, 0.3
    frequencies, qualities = np.full(12, 1.0), np.full(12, 5.0)
    frequencies[0], qualities[0] = 1.2, 12.0
    scale = np.where(power > 0.0, 1e-3 * power, 1e-3)
    theta = parameters(power, scale, np.full(4, 50.0), frequencies, qualities, np.array([0.9, 1.0]))
    free = np.zeros(FULL.parameters, bool)
    free[[0, 1, WAVE, FULL.frequencies, FULL.qualities, FULL.response]] = True
    inside = np.zeros(FULL.components, bool)
    inside[:2] = True
    bins = bins_of(n, [(1.2 / (2.0 * np.pi), 0.1 / (2.0 * np.pi))])
    return theta, slots_of(scale, free, inside, ONE_POLE), bins


def drawn(theta, slots, bins, n, seed):
    """Levels drawn from their law under the model."""
    size = bins.size.astype(float)
    empty = empty_levels(bins).with_data(np.ones(len(size)), size)
    mean = np.asarray(compiled(jnp.asarray(theta), slots, empty).mean)
    k = np.maximum(empty.shape, 0.5)
    y = mean * np.random.default_rng(seed).gamma(k) / k
    return empty._replace(level=np.where(empty.shape > 0.0, y, 1.0))


def plain_loss(theta, slots, levels):
    """−ln likelihood of χ² levels, from the expectation alone."""
    mean = np.asarray(compiled(jnp.asarray(theta), slots, levels).mean)
    return np.sum(levels.shape * (np.log(mean) + levels.level / mean))


def test_slopes_are_those_of_finite_differences():
    """Every slot in use, every parameter: central differences of the logarithm, to their own accuracy."""
    rng = np.random.default_rng(1)
    n = 5000
    scale = np.exp(rng.normal(size=FULL.components))
    theta = parameters(
        scale * np.exp(rng.normal(size=FULL.components)),
        scale,
        np.array([3.0, 20.0, 100.0, 2000.0]),
        np.linspace(0.05, 3.0, 12),
        np.linspace(0.7, 30.0, 12),
        np.array([1.0, 0.8]),
    )
    bins = bins_of(n)
    size = bins.size
    levels = empty_levels(bins).with_data(np.ones(len(size)), size.astype(float))
    inside = np.arange(FULL.components) % 2 == 0
    for kind in range(5):
        slots = slots_of(scale, np.ones(FULL.parameters, bool), inside, kind, band_limited=kind > 2)
        slope = np.asarray(compiled(jnp.asarray(theta), slots, levels).slope)
        steps = 1e-5 * np.eye(FULL.parameters)
        up, down = (
            np.log(np.array([compiled(jnp.asarray(theta + s * e), slots, levels).mean for e in steps]))
            for s in (1.0, -1.0)
        )
        np.testing.assert_allclose(slope, (up - down) / 2e-5, rtol=1e-5, atol=1e-8)


def test_an_idle_slot_is_as_if_it_were_evaluated():
    """A slot without power that is estimated is evaluated, one that is not is left out: of no consequence."""
    n = 5000
    theta, slots, bins = filtered_and_resonant(n)
    levels = empty_levels(bins).with_data(np.ones(len(bins.size)), bins.size.astype(float))
    everything = dataclasses.replace(slots, free=np.ones(FULL.parameters, bool))
    few, all_ = (compiled(jnp.asarray(theta), s, levels) for s in (slots, everything))
    # Sums of the same numbers and zeros.
    np.testing.assert_allclose(few.mean, all_.mean, rtol=1e-14)
    np.testing.assert_allclose(few.slope[slots.free], all_.slope[slots.free], rtol=1e-12, atol=1e-300)
    idle = WAVE + 1
    assert not np.any(few.slope[idle])
    assert np.any(all_.slope[idle])


def test_the_maximum_is_that_of_a_general_minimizer():
    n = 20_000
    theta, slots, bins = filtered_and_resonant(n)
    levels = drawn(theta, slots, bins, n, 2)
    free = np.flatnonzero(slots.free)
    found = maximize(jnp.asarray(theta + 0.3 * slots.free), slots, levels)
    assert bool(found.converged)

    def loss(x):
        at = theta.copy()
        at[free] = x
        return plain_loss(at, slots, levels)

    other = minimize(loss, np.asarray(found.theta)[free] + 0.02, method="Powell", options={"ftol": 1e-13})
    # Powell's search ends within 10⁻⁴ nats; standard deviations are 0.01 and more.
    assert float(found.loss) < other.fun + 1e-4
    np.testing.assert_allclose(np.asarray(found.theta)[free], other.x, atol=3e-3)
    held = ~slots.free
    np.testing.assert_array_equal(np.asarray(found.theta)[held], theta[held])


@pytest.mark.parametrize("seed", range(8))
def test_powers_off_by_a_factor_of_seven_lead_to_the_same_maximum(seed):
    n = 20_000
    theta, slots, bins = filtered_and_resonant(n)
    levels = drawn(theta, slots, bins, n, 3)
    best = maximize(jnp.asarray(theta), slots, levels)
    away = np.random.default_rng(seed).uniform(-2.0, 2.0, FULL.parameters)
    away[FULL.components :] = 0.0
    found = maximize(jnp.asarray(theta + away * slots.free), slots, levels)
    assert bool(found.converged)
    assert float(found.loss) == pytest.approx(float(best.loss), abs=1e-5)


def test_a_power_that_the_data_do_not_want_is_zero():
    """A walk and a Markov process in what is less than white noise: at zero, and the rest undisturbed."""
    n = 4096
    bins = bins_of(n)
    size = bins.size.astype(float)
    rng = np.random.default_rng(4)
    k = size / 2.0
    level = rng.gamma(k) / k
    # The data have less at low frequencies than white noise alone.
    level[:20] = 0.3
    levels = empty_levels(bins).with_data(level, size)
    free = np.zeros(FULL.parameters, bool)
    free[[0, 1, FULL.first_markov]] = True
    shapes = np.full(4, 500.0), np.full(12, 1.0), np.full(12, 5.0), np.array([1.0, 1.0])
    ones = np.ones(FULL.components)
    slots = slots_of(ones, free, np.zeros(FULL.components, bool))
    noise = jnp.ones(LEVELS)
    scale = np.asarray(power_scales(jnp.asarray(parameters(ones, ones, *shapes)), slots, levels, noise))
    # Of white noise the scale is the error of its power.
    assert scale[0] == pytest.approx(np.sqrt(2.0 / np.sum(size)), rel=1e-9)
    theta = parameters(np.where(free[: FULL.components], 5.0 * scale, 0.0), scale, *shapes)
    found = maximize(jnp.asarray(theta), dataclasses.replace(slots, scale=scale), levels)
    power = scale * np.expm1(np.asarray(found.theta)[: FULL.components])
    assert power[1] == 0.0
    assert power[FULL.first_markov] == 0.0
    # Of white noise alone the maximum is the mean of all squares.
    assert power[0] == pytest.approx(np.sum(size * level) / np.sum(size), rel=1e-6)
    assert np.asarray(covariance(found))[0, 0] == pytest.approx(
        (power[0] / (power[0] + scale[0])) ** 2 * 2.0 / np.sum(size), rel=1e-6
    )
    assert np.all(np.asarray(covariance(found))[[1, FULL.first_markov]] == 0.0)


def test_errors_are_the_scatter_of_many_draws():
    """Standardized errors of sixty draws: a mean of zero within 4/√60, a variance of one within 4·√(2/60)."""
    n = 20_000
    theta, slots, bins = filtered_and_resonant(n)
    free = np.flatnonzero(slots.free)
    scores = []
    for seed in range(60):
        found = maximize(jnp.asarray(theta), slots, drawn(theta, slots, bins, n, 100 + seed))
        sd = np.sqrt(np.diag(np.asarray(covariance(found))))[free]
        scores.append((np.asarray(found.theta)[free] - theta[free]) / sd)
    scores = np.array(scores)
    assert np.all(abs(scores.mean(axis=0)) < 4.0 / np.sqrt(60.0))
    assert np.all(abs(scores.var(axis=0) - 1.0) < 4.0 * np.sqrt(2.0 / 60.0))


def test_the_maximum_moves_with_the_data_as_its_derivative_says():
    """The implicit function theorem against finite differences of maxima."""
    n = 20_000
    theta, slots, bins = filtered_and_resonant(n)
    levels = drawn(theta, slots, bins, n, 5)
    direction = np.where(levels.shape > 0.0, np.cos(np.arange(LEVELS)), 0.0) * levels.level

    def peak(t):
        return maximize(jnp.asarray(theta), slots, levels._replace(level=levels.level + t * direction)).theta

    _, moved = jax.jvp(peak, (0.0,), (1.0,))
    h = 1e-2
    differences = (peak(h) - peak(-h)) / (2.0 * h)
    # Maxima are found to 10⁻⁵, so differences to 10⁻³; the cubic term of a hundredth is less.
    np.testing.assert_allclose(moved, differences, atol=2e-3 * float(jnp.max(jnp.abs(moved))) + 1e-3)
    assert float(jnp.max(jnp.abs(moved))) > 0.01


def test_one_program_serves_every_record_and_model():
    """Lengths, sets of slots, responses, lines of refinement: data, not shapes."""
    programs = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda name, *_, **__: programs.append(name) if name.endswith("backend_compile_duration") else None
    )
    theta, slots, bins = filtered_and_resonant(3000)
    levels = empty_levels(bins).with_data(np.ones(len(bins.size)), bins.size.astype(float))
    maximize(jnp.asarray(theta), slots, levels)
    maximize(jnp.asarray(theta + 0.0), slots, levels)
    del programs[:]
    cases = ((777, 0, FULL.times), (60_000, 2, FULL.response + 1), (10**6, 4, FULL.first_markov + 1))
    for n, kind, more in cases:
        free = np.array(slots.free)
        free[more] = True
        bins = bins_of(n, [(0.1, 0.01), (0.3, 0.001)])
        m = len(bins.size)
        levels = levels_of(bins, np.ones((3, 2, m)), FULL.columns, LEVELS)
        levels = levels.with_data(np.ones(m), bins.size.astype(float))
        maximize(jnp.asarray(theta), slots_of(slots.scale, free, slots.inside, kind), levels)
    assert not programs
