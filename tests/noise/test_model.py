"""Models: adding terms, naming and setting parameters, sums over the terms."""

import math

import jax.numpy as jnp
import numpy as np
import pytest

from allanjax.base.errors import AllanjaxError
from allanjax.noise.model import Model
from allanjax.noise.terms import (
    AngleRandomWalk,
    BiasInstability,
    DriftRamp,
    Markov,
    Quantization,
    RateRandomWalk,
    Resonance,
    Sinusoid,
)


def test_terms_and_models_add_up_in_order():
    q, n, k = Quantization(1.0), AngleRandomWalk(2.0), RateRandomWalk(3.0)
    for model in (q + n + k, q + (n + k), (q + n) + Model((k,)), Model((q,)) + n + k):
        assert isinstance(model, Model)
        assert model.terms == (q, n, k)
    assert len(q + n) == 2
    assert list(q + n) == [q, n]


def test_labels_are_numbered_where_a_term_occurs_several_times():
    model = Markov() + AngleRandomWalk() + Markov() + BiasInstability()
    assert model.term_labels == ("markov_1", "angle_random_walk", "markov_2", "bias_instability")
    assert [p.label for p in model.parameters] == [
        "markov_1_amplitude",
        "markov_1_correlation_time",
        "angle_random_walk",
        "markov_2_amplitude",
        "markov_2_correlation_time",
        "bias_instability",
        "bias_instability_cutoff_frequency",
    ]
    assert [p.term for p in model.parameters] == [0, 0, 1, 2, 2, 3, 3]
    assert model["markov_2"] is model.terms[2]
    assert (Markov() + AngleRandomWalk()).term_labels == ("markov", "angle_random_walk")


def test_values_are_set_by_label_and_the_rest_is_kept():
    model = Markov(1.0, 2.0) + Markov(3.0, 4.0)
    changed = model.with_values(markov_2_correlation_time=5.0)
    assert changed.values == model.values | {"markov_2_correlation_time": 5.0}
    assert model.values["markov_2_correlation_time"] == 4.0
    held = (Sinusoid(1.0).hold(frequency=50.0) + Quantization()).with_values(quantization=2.0)
    assert held.values == {"sinusoid_amplitude": 1.0, "sinusoid_frequency": 50.0, "quantization": 2.0}
    assert [p.free for p in held.parameters] == [True, False, True]


def test_holding_keeps_parameters_out_of_a_fit():
    markov = Markov(correlation_time=100.0)
    assert [p.free for p in Model((markov.hold("correlation_time"),)).parameters] == [True, False]
    assert markov.hold(correlation_time=7.0).correlation_time == 7.0
    assert markov.hold("correlation_time").hold(amplitude=1.0).held == {"correlation_time", "amplitude"}
    assert [p.free for p in Model((markov,)).parameters] == [True, True]
    # A cutoff at infinity is a choice of law, a cutoff without a value is estimated.
    assert [p.free for p in Model((BiasInstability(),)).parameters] == [True, False]
    assert [p.free for p in Model((BiasInstability(cutoff_frequency=None),)).parameters] == [True, True]


def test_without_drops_terms_by_label():
    model = Quantization() + Markov() + Markov()
    assert model.without(["markov_1", "quantization"]).terms == (model.terms[2],)
    assert model.without([]).terms == model.terms


def test_sampled_tells_every_term_the_sample_interval():
    model = (
        Quantization(1.0) + AngleRandomWalk(1.0) + Sinusoid(1.0, 3.0) + Resonance(1.0, 3.0, 5.0)
    ).sampled(20.0)
    assert [getattr(term, "sample_interval", None) for term in model] == [0.05, None, 0.05, 0.05]


def test_curves_are_sums_over_the_terms():
    terms = (AngleRandomWalk(2.0), RateRandomWalk(3.0), DriftRamp(0.5))
    model, T = Model(terms), np.array([[0.5, 1.0], [2.0, 8.0]])
    np.testing.assert_allclose(model.allan_variance(T), 4 / T + 3 * T + T**2 / 8, rtol=1e-12)
    np.testing.assert_allclose(model.hadamard_variance(T), 4 / T + 9 * T / 6, rtol=1e-12)
    np.testing.assert_allclose(model.psd(T), sum(np.asarray(t.psd(T)) for t in terms))
    np.testing.assert_allclose(model.phase_covariance(T), -2 * T + 9 / 12 * T**3 + 0.25 / 24 * T**4)
    assert model.allan_variance(2.0).shape == ()
    assert np.all(Model(()).allan_variance(T) == 0.0)


def test_values_may_be_arrays():
    model = (AngleRandomWalk() + RateRandomWalk()).with_values(
        angle_random_walk=jnp.asarray(2.0), rate_random_walk=jnp.asarray(0.0)
    )
    assert model.allan_variance(4.0) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("attempt", "message"),
    [
        (lambda: Quantization() + AngleRandomWalk, "instances"),
        (lambda: Quantization() + 3.0, "cannot add 3.0 to a model"),
        (lambda: Model((AngleRandomWalk,)), "with its parentheses"),
        (lambda: (Quantization() + Markov())["markov_1"], "no term 'markov_1'; it has quantization, markov"),
        (
            lambda: Model((Quantization(),)).with_values(markov=1.0),
            "no parameter 'markov'; it has quantization",
        ),
        (lambda: Model((Quantization(),)).with_values(quantization=-1.0), "must be ≥ 0"),
        (lambda: Model((Markov(1.0),)).allan_variance(1.0), "markov_correlation_time has no value"),
        (lambda: Model((Markov(),)).psd(1.0), "markov_amplitude has no value"),
        (lambda: Markov(1.0, math.nan), "correlation_time must be > 0"),
    ],
)
def test_mistakes_are_named(attempt, message):
    with pytest.raises(AllanjaxError, match=message):
        attempt()
