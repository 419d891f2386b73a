"""Terms are evaluated by NumPy where they are given its numbers, which compiles and changes nothing."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilations import compilations

import allanjax as aj
from allanjax.base.arrays import namespace

RATE = 100.0
# Times in a decade, so that G has no digits that its constants swallow; frequencies up to half of the rate.
TIMES = np.geomspace(0.3, 3.0, 7)
FREQUENCIES = np.geomspace(0.05, 49.0, 9)

TERMS = {
    "quantization": aj.Quantization(2.3e-6),
    "angle random walk": aj.AngleRandomWalk(1.7e-4),
    "bias instability": aj.BiasInstability(4.1e-5),
    "bias instability with a cutoff": aj.BiasInstability(4.1e-5, 0.5),
    "rate random walk": aj.RateRandomWalk(6.2e-6),
    "drift ramp": aj.DriftRamp(3.3e-7),
    "markov": aj.Markov(5.2e-5, 0.8),
    "markov, far shorter than a sample": aj.Markov(5.2e-2, 1e-4),
    "sinusoid": aj.Sinusoid(7.7e-4, 0.37),
    "resonance": aj.Resonance(2.9e-4, 0.8, 12.0),
    "power law": aj.PowerLaw(1e-4, 0.7),
    "power law near flicker": aj.PowerLaw(1e-4, 1.05),
    "low pass": aj.LowPass(1e-4, 3.0),
    "low pass of order 2": aj.LowPass(1e-4, 3.0, order=2),
    "telegraph": aj.Telegraph(1e-4, 0.7),
    "bias step": aj.BiasStep(1e-3, 1.0),
    "warm-up": aj.WarmUp(1e-3, 2.0),
}
TERMS |= {f"{name}, sampled": term.sampled(RATE) for name, term in TERMS.items()}


def values_of(term, times, frequencies):
    """What a term says, by what it is called; a transient's column, a line's scatter where there is one."""
    found = {
        "G": term.phase_covariance(times),
        "Allan variance": term.allan_variance(times),
        "Hadamard variance": term.hadamard_variance(times),
        "PSD of samples": term.sampled_psd(frequencies, RATE),
        "ends": term.end_effect(frequencies, RATE),
    }
    if not isinstance(term, aj.Quantization) or term.sample_interval > 0.0:
        found["PSD"] = term.psd(frequencies)
    if isinstance(term, aj.BiasStep | aj.WarmUp):
        found["column"] = term.column(times)
    if term.narrow_band:
        found["scatter"] = term.power_scatter(times[0])
    return found


def in_jax(term):
    """The term with its finite values as arrays of JAX, as they are in compiled functions."""
    values = {p.name: getattr(term, p.name) for p in term.parameters()}
    return term.replace(**{name: jnp.asarray(x) for name, x in values.items() if math.isfinite(x)})


def assert_same(found, expected, term, rtol=1e-12):
    """All values agree, but for the rounding of what they are differences of, a thousandth of that."""
    covariance = np.max(np.abs(term.phase_covariance(TIMES))) / TIMES.min() ** 2
    assert found.keys() == expected.keys()
    for name, value in found.items():
        size = covariance if name.endswith("variance") else np.max(np.abs(expected[name]))
        np.testing.assert_allclose(value, expected[name], rtol=rtol, atol=1e-3 * rtol * size, err_msg=name)


@pytest.mark.parametrize("term", TERMS.values(), ids=TERMS)
def test_a_value_is_numpys_and_that_of_jax(term):
    with compilations() as compiled:
        found = values_of(term, TIMES, FREQUENCIES)
    assert compiled == []
    assert [name for name, x in found.items() if not isinstance(x, np.ndarray | np.generic)] == []
    expected = values_of(term, jnp.asarray(TIMES), jnp.asarray(FREQUENCIES))
    assert [name for name, x in expected.items() if not isinstance(x, jax.Array)] == []
    assert_same(found, expected, term)


@pytest.mark.parametrize("term", TERMS.values(), ids=TERMS)
def test_a_compiled_value_and_its_derivative_are_those_of_traced_parameters(term):
    """With NumPy's times and frequencies. By the logarithm of the amplitude all grow twice as fast as it."""
    name = term.amplitude_parameter().name
    traced = in_jax(term)

    def values(log):
        return values_of(traced.replace(**{name: jnp.exp(log)}), TIMES, FREQUENCIES)

    log = jnp.log(getattr(term, name))
    value, slope = jax.jit(lambda x: jax.jvp(values, (x,), (jnp.ones(()),)))(log)
    expected = values_of(term, TIMES, FREQUENCIES)
    assert_same(value, expected, term, rtol=1e-11)
    power = {name: 0.0 if name in ("column", "scatter") else 2.0 for name in expected}
    assert_same(slope, {name: power[name] * x for name, x in expected.items()}, term, rtol=1e-11)


def test_a_model_is_evaluated_as_its_terms_are():
    model = aj.AngleRandomWalk(1e-4) + aj.BiasInstability(2e-5) + aj.Markov(1e-5, 3.0)
    times, frequencies = jnp.asarray(TIMES), jnp.asarray(FREQUENCIES)
    with compilations() as compiled:
        of_times = [model.phase_covariance, model.allan_variance, model.hadamard_variance]
        found = [method(TIMES) for method in of_times]
        found += [model.psd(FREQUENCIES), model.sampled_psd(FREQUENCIES, RATE)]
    assert compiled == []
    expected = [method(times) for method in of_times]
    expected += [model.psd(frequencies), model.sampled_psd(frequencies, RATE)]
    for one, other in zip(found, expected, strict=True):
        assert isinstance(one, np.ndarray)
        assert isinstance(other, jax.Array)
        np.testing.assert_allclose(one, other, rtol=1e-12)


@pytest.mark.parametrize("frequency", [0.0, np.array([0.0, 1.0]), [0.0, 1.0]])
def test_a_spectrum_at_zero_is_infinite_without_a_warning(frequency, recwarn):
    for term in (aj.RateRandomWalk(1.0), aj.BiasInstability(1.0), aj.DriftRamp(1.0), aj.PowerLaw(1.0, 1.5)):
        assert np.isinf(np.ravel(term.psd(frequency))[0])
    assert [w for w in recwarn if issubclass(w.category, RuntimeWarning)] == []


class OfJaxOnly(aj.NoiseTerm):
    """Flicker noise of the angle, as a user would write it."""

    coefficient: float | None = aj.parameter("F", time_exponent=1.0)

    def phase_covariance(self, lag):
        return -(self.coefficient**2) * jnp.log(jnp.maximum(lag, 1e-3))


def test_a_term_of_ones_own_need_not_know_of_numpy():
    """Also inside of a compiled function that gives it NumPy's numbers."""
    term = OfJaxOnly(2e-6)
    expected = term.allan_variance(jnp.asarray(TIMES))
    np.testing.assert_allclose(term.allan_variance(TIMES), expected, rtol=1e-12)
    np.testing.assert_allclose(jax.jit(lambda: term.allan_variance(TIMES))(), expected, rtol=1e-12)


def test_one_array_of_jax_makes_all_jaxs():
    x = np.ones(2)
    assert namespace(x, 1.0, None, [2.0]) is np
    for other in (jnp.ones(()), [jnp.ones(())], aj.AngleRandomWalk(jnp.ones(()))):
        assert namespace(x, other) is jnp
    assert jax.jit(lambda y: y * (namespace(x, y) is jnp))(1.0) == 1.0
