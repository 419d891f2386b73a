"""Terms and responses in compiled programs: NumPy's values, derivatives by each parameter, no NaN."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilations import compilations
from noise_terms import OTHER_VALUES, RATE, RESPONSES, TERMS, by_slots, finite
from numpy.testing import assert_allclose

import allanjax as aj

# Clusters about the times of the terms; frequencies up to half the rate.
T, F = np.array([1.0, 7.0, 330.0]) / RATE, np.array([0.013, 1.7, 17.0])
# As a fit has them: its likelihoods take the spectrum after a response.
INNER = aj.AngleRandomWalk(1e-3) + aj.Markov(1e-3, 0.7)
MODELS = {
    **{name: aj.Model((term,)).sampled(RATE) for name, term in TERMS.items()},
    **{f"{name}, continuous": aj.Model((TERMS[name],)) for name in ("line", "resonance", "low pass")},
    **{name: (filter_ * INNER).sampled(RATE) for name, filter_ in RESPONSES.items()},
}
# Without a curve that compiles: eleven oscillators, and G after a filter, which has parts of its own for each
# kind of noise; of these two are enough.
DENSITY_ONLY = {"wandering resonance", *RESPONSES} - {"two poles", "mean of 3.7"}
# A pole at zero, where G (not the power) is that of one moved by 10⁻⁵; a kink of the power at whole samples.
KINKED = "mean of 5"


def values_of(name, values, times, frequencies):
    """Allan variances, where they are compiled, densities of samples, and what the ends of a record add."""
    model, slot = MODELS[name].with_values(**values), OTHER_VALUES.get(name, name)
    found = [] if slot in DENSITY_ONLY else [model.allan_variance(times)]
    found += [model.sampled_psd(frequencies, RATE)]
    found += [term.end_effect(frequencies, RATE) for term in model.terms if name == "quantization"]
    return (jnp if isinstance(times, jax.Array) else np).concatenate(found)


@jax.jit
def compiled(given, times):
    """Values of all models and their derivatives along directions, in the logarithms of the parameters."""

    def along(name, values, directions):
        def of_logs(step):
            moved = {k: x * jnp.exp(step * directions[k]) for k, x in values.items()}
            return values_of(name, moved, times, jnp.asarray(F))

        return jax.jvp(of_logs, (0.0,), (1.0,))

    return {name: along(name, *data) for name, data in given.items()}


def run(values, directions, times=T):
    data = {name: (values[name], directions[name]) for name in values}
    return by_slots(lambda given: compiled(given, times), data)


VALUES = {name: finite(model) for name, model in MODELS.items()}
DIRECTIONS = {n: dict(zip(v, (0.3, 0.45, 0.6, 0.75, 0.9), strict=False)) for n, v in VALUES.items()}


@functools.cache
def found(of_filters):
    return run({name: v for name, v in VALUES.items() if (name in RESPONSES) == of_filters}, DIRECTIONS)


@pytest.mark.parametrize("name", MODELS)
def test_values_are_numpys_and_derivatives_those_of_differences(name):
    (value, slope), step = found(name in RESPONSES)[name], 2e-5
    with compilations() as names:
        expected, above, below = (
            values_of(name, {k: x * math.exp(s * DIRECTIONS[name][k]) for k, x in VALUES[name].items()}, T, F)
            for s in (0.0, step, -step)
        )
        assert isinstance(MODELS[name].hadamard_variance(T), np.ndarray)
    assert (names, type(expected)) == ([], np.ndarray)
    assert_allclose(value, expected, rtol=1e-9, atol=1e-13 * abs(expected).max())
    if name != KINKED:
        difference = (above - below) / (2.0 * step)
        assert_allclose(slope, difference, rtol=5e-6, atol=1e-7 * abs(expected).max())


def test_values_and_derivatives_are_finite_at_the_edges():
    """Far below and above every characteristic time, where G has other formulas; and at no noise at all."""
    for group in (set(MODELS) - set(RESPONSES), set(RESPONSES)):
        values = {name: VALUES[name] for name in MODELS if name in group}
        for times in ([1e-9] * 3, [1e-3] * 3, [1e3] * 3, [1.003e7] * 3, [1e-9, 1.0, 1.003e7]):
            for name, numbers in run(values, DIRECTIONS, np.array(times)).items():
                assert np.isfinite(numbers).all(), (name, times)
        silent = {
            name: v | {p.label: 0.0 for p in MODELS[name].parameters if p.parameter.is_amplitude}
            for name, v in values.items()
        }
        assert not any(np.any(numbers) for numbers in run(silent, DIRECTIONS).values())
