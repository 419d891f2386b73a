"""Models: adding terms, naming and setting parameters, text, and coefficients by what people call them."""

import dataclasses
import math

import bench
import jax.numpy as jnp
import numpy as np
import pytest
from noise_terms import RATE, RESPONSES, TERMS, TRANSIENT
from numpy.testing import assert_allclose
from refusals import refuses

import allanjax as aj

DEG, ARCSEC = math.pi / 180.0, math.pi / 180.0 / 3600.0
Q, N, K = aj.Quantization(1.0), aj.AngleRandomWalk(2.0), aj.RateRandomWalk(3.0)
WAVE, ONE = aj.Resonance(1e-3, 7.0, 6.0), aj.LowPass1(4.0)


def test_terms_and_models_add_up_in_order():
    for model in (Q + N + K, Q + (N + K), (Q + N) + aj.Model((K,)), aj.Model((Q,)) + N + K):
        assert isinstance(model, aj.Model)
        assert tuple(model) == model.terms == (Q, N, K)
    basic = "quantization angle_random_walk bias_instability rate_random_walk drift_ramp"
    assert aj.terms.basic_terms().term_labels == tuple(basic.split())


def test_labels_are_numbered_where_a_term_occurs_several_times():
    model = aj.Markov() + aj.AngleRandomWalk() + aj.Markov() + aj.BiasInstability()
    values = "markov_1_amplitude markov_1_correlation_time angle_random_walk markov_2_amplitude"
    values += " markov_2_correlation_time bias_instability bias_instability_cutoff_frequency"
    labels = ("markov_1", "angle_random_walk", "markov_2", "bias_instability")
    assert (model.term_labels, model["markov_2"]) == (labels, model.terms[2])
    assert [p.label for p in model.parameters] == values.split()
    assert [p.term for p in model.parameters] == [0, 0, 1, 2, 2, 3, 3]
    assert all(p.term_label == labels[p.term] for p in model.parameters)


def test_values_are_set_by_label_and_the_rest_is_kept():
    model = aj.Markov(1.0, 2.0) + aj.Markov(3.0, 4.0)
    changed = model.with_values(markov_2_correlation_time=5.0)
    assert changed.values == model.values | {"markov_2_correlation_time": 5.0}
    assert model.values["markov_2_correlation_time"] == 4.0
    held = (aj.Sinusoid(1.0).hold(frequency=50.0) + aj.Quantization()).with_values(quantization=2.0)
    assert held.values == {"sinusoid_amplitude": 1.0, "sinusoid_frequency": 50.0, "quantization": 2.0}
    assert [p.free for p in held.parameters] == [True, False, True]
    assert (ONE * N).with_values(low_pass1_bandwidth=3.0).response.bandwidth == 3.0
    arrays = (aj.AngleRandomWalk() + K).with_values(angle_random_walk=jnp.asarray(2.0))
    assert arrays.values == {"angle_random_walk": 2.0, "rate_random_walk": 3.0}


def test_holding_keeps_parameters_out_of_a_fit():
    """A cutoff at infinity is a choice of law, a cutoff without a value is estimated."""
    markov = aj.Markov(correlation_time=100.0)
    flicker = aj.BiasInstability(), aj.BiasInstability(cutoff_frequency=None)
    model = aj.Model((markov, markov.hold("correlation_time"), *flicker))
    assert [p.free for p in model.parameters] == [True, True, True, False, True, False, True, True]
    assert markov.hold(correlation_time=7.0).correlation_time == 7.0
    assert markov.hold("correlation_time").hold(amplitude=1.0).held == {"correlation_time", "amplitude"}
    assert (N.has_free_amplitude, N.hold("coefficient").has_free_amplitude) == (True, False)


def test_filters_stand_before_the_terms_that_pass_them():
    model = ONE * (N + K) + WAVE
    assert model.inside == (True, True, False)
    assert list(model.values.items())[-1] == ("low_pass1_bandwidth", 4.0)
    assert (WAVE + ONE * N + K).inside == (False, True, False)
    assert model.without(["rate_random_walk"]).inside == (True, False)
    assert model.without(["angle_random_walk", "rate_random_walk"]) == aj.Model((WAVE,))
    assert (Q + aj.Markov() + aj.Markov()).without(["markov_1", "quantization"]).term_labels == ("markov",)
    for both in ((ONE * N).sampled(RATE) + K, K + (ONE * N).sampled(RATE), model.sampled(RATE)):
        assert both.rate == RATE
    assert [getattr(t, "sample_interval", None) for t in model.sampled(RATE)] == [None, None, 1.0 / RATE]
    assert (N + Q).sampled(RATE)["quantization"].sample_interval == 1.0 / RATE


def test_curves_are_sums_over_the_terms():
    model, T = N + K + aj.DriftRamp(0.5), np.array([[0.5, 1.0], [2.0, 8.0]])
    assert_allclose(model.allan_variance(T), 4 / T + 3 * T + T**2 / 8, rtol=1e-12)
    assert_allclose(model.hadamard_variance(T), 4 / T + 9 * T / 6, rtol=1e-12)
    assert_allclose(model.psd(T), 4 + (9 / T**2) / (2 * np.pi) ** 2 + 0.25 / (2 * np.pi * T) ** 3)
    assert_allclose(model.phase_covariance(T), -2 * T + 9 / 12 * T**3 + 0.25 / 24 * T**4)
    assert_allclose(model.sampled_psd(T, 20.0), sum(t.sampled_psd(T, 20.0) for t in model), rtol=1e-12)
    assert model.allan_variance(2.0).shape == ()
    assert np.all(aj.Model(()).allan_variance(T) == 0.0)


# Kind of each parameter, and p in the unit (rate)·s^p of the amplitude.
DECLARED = {
    "quantization": ("Q amplitude", 1.0), "angle_random_walk": ("N amplitude", 0.5),
    "bias_instability": ("B amplitude, f0 frequency", 0.0), "rate_random_walk": ("K amplitude", -0.5),
    "drift_ramp": ("R amplitude", -1.0), "markov": ("q_c amplitude, T_c time", -0.5),
    "sinusoid": ("Ω0 amplitude, f0 line", 0.0), "resonance": ("σ amplitude, f0 line, Q_f number", 0.0),
    "wandering_resonance": ("σ amplitude, f0 line, Q_f number, Δf frequency", 0.0),
    "power_law": ("A amplitude, α number", 0.5), "low_pass": ("N_f amplitude, f_c frequency", 0.5),
    "telegraph": ("J amplitude, T_d time", 0.0), "bias_step": ("Δ amplitude, t_s time", 0.0),
    "warm_up": ("W amplitude, τ time", 0.0), "channel_effect": ("c amplitude, t_l time", 0.0),
}  # fmt: skip


def test_every_term_declares_its_parameters():
    found = {}
    for term in (TERMS | TRANSIENT).values():
        told = ", ".join(f"{p.symbol} {p.kind}" for p in term.parameters())
        found[term.name()] = (told, term.parameters()[0].time_exponent)
    assert found == DECLARED


def test_what_is_printed_is_the_expression():
    models = [aj.Model((term,)) for term in TERMS.values()]
    models += [aj.Model((t.hold(*(p.name for p in t.parameters()[1:])),)) for t in TERMS.values()]
    models += [filter_ * (N + K) + WAVE for filter_ in RESPONSES.values()]
    models += [ONE.hold("bandwidth") * (N + K), aj.Model((aj.Markov(correlation_time=3.0),))]
    for model in models:
        again = aj.Model(()) + eval(repr(model), vars(aj))
        assert repr(again) == repr(model)
        given = {name: x for name, x in model.values.items() if x is not None}
        assert {name: again.values[name] for name in given} == pytest.approx(given, rel=1e-5)
        assert [p.free for p in again.parameters] == [p.free for p in model.parameters]
    assert repr(aj.Model(())) == "Model(())"


MISTAKES = [
    (lambda: Q + aj.AngleRandomWalk, "instances"), (lambda: Q + 3.0, "3.0"),
    (lambda: aj.Model((aj.AngleRandomWalk,)), "parentheses"),
    (lambda: (Q + aj.Markov())["markov_1"], "markov_1"), (lambda: (Q + N).with_values(markov=1.0), "markov"),
    (lambda: (Q + N).with_values(quantization=-1.0), "coefficient"),
    (lambda: aj.Model((aj.Markov(1.0),)).allan_variance(1.0), "markov_correlation_time"),
    (lambda: aj.Model((aj.Markov(),)).psd(1.0), "markov_amplitude"),
    (lambda: aj.Model((aj.AngleRandomWalk(),)).sampled_psd(1.0, RATE), "angle_random_walk"),
    (lambda: Q.psd(1.0), "sampled"), (lambda: aj.Quantization(-1.0), "coefficient"),
    (lambda: aj.AngleRandomWalk(math.nan), "coefficient"), (lambda: aj.Markov(1.0, 0.0), "correlation_time"),
    (lambda: aj.Markov(1.0, math.nan), "correlation_time"),
    (lambda: aj.Resonance(1.0, 2.0, 0.5), "quality_factor"), (lambda: aj.PowerLaw(1.0, 3.0), "exponent"),
    (lambda: aj.PowerLaw(1.0, -1.0), "exponent"), (lambda: aj.LowPass(1.0, 1.0, order=3), "order"),
    (lambda: aj.Markov().hold("time"), "time"),
    (lambda: aj.Markov().hold("correlation_time"), "correlation_time"),
    (lambda: aj.ChannelEffect(1.0, 0.0, channel="heat").column(np.ones(2)), "heat"),
]  # fmt: skip


def test_mistakes_are_named():
    for attempt, word in MISTAKES:
        refuses(word, attempt)
    # What is just possible.
    assert aj.Quantization(0.0).coefficient == 0.0


def read(text, axis="gyro_x"):
    """The model that a text is for an axis, of records of one length."""
    return aj.kalman_filter(bench.recording("small")[axis].between(0.0, 0.64), text).results[0].model


ARW, RRW = aj.AngleRandomWalk, aj.RateRandomWalk
WRITTEN = {
    "Q=2 arcsec, N=1e-3 rad/s/√Hz , K=7 deg/h/√h + B = 3e+0 deg/h": (
        aj.Quantization(2 * ARCSEC) + ARW(1e-3) + RRW(7 * ARCSEC / 60) + aj.BiasInstability(3 * ARCSEC)
    ),
    "angle_random_walk=0.2 m/s/√h held + markov(amplitude=31 µg/√h, T_c=2 min held)": (
        ARW(0.2 / 60).hold("coefficient") + aj.Markov(31e-6 * 9.80665 / 60, 120.0).hold("correlation_time")
    ),
    "N=1 rad/√s + resonance(σ=0.1 deg/s, f0=3 Hz, Q_f=5) + low_pass(N_f=2 rad/√s, f_c=4, order=2)": (
        ARW(1.0) + aj.Resonance(0.1 * DEG, 3.0, 5.0) + aj.LowPass(2.0, 4.0, order=2)
    ),
    "butterworth(f_c=0.004 kHz held, order=3) * (N=1e-3 rad/√s + K=2e-5 rad/s/√s) + N=1e-4 rad/√s": (
        aj.Butterworth(4.0, 3).hold("bandwidth") * (ARW(1e-3) + RRW(2e-5)) + ARW(1e-4)
    ),
    "moving_average(bandwidth=6 Hz) * N=1e-3 rad/√s": aj.MovingAverage(6.0) * ARW(1e-3),
}


@pytest.mark.parametrize("text", WRITTEN)
def test_text_is_the_model_that_it_says(text):
    """Values to six digits, what is held, options and filters are all in the expression."""
    found, expected = read(text, "accel_z" if "m/s/√h" in text else "gyro_x"), aj.Model(()) + WRITTEN[text]
    assert repr(found) == repr(expected)
    assert found.values == pytest.approx(expected.values, rel=1e-12)


UNREADABLE = [
    ("N + X", "'X'"), ("n", "'n'"), ("N +", "cannot read"), ("", "cannot read"), ("N)+(B", "cannot read"),
    ("markov(correlation_time=100 s", "cannot read"), ("markov(tau=100 s)", "tau"),
    ("markov(100 s)", "correlation_time"), ("markov(correlation_time=long)", "long"),
    ("N=-1 deg/√h", "coefficient"), ("low * N", "'low'"), ("low_pass1 * low_pass2 * N", "one response"),
    ("butterworth(order=two) * N", "order"), ("butterworth(degree=2) * N", "degree"),
    # What has no value is told by its label: names and symbols are the same terms.
    ("Q=1 rad + markov(T_c=1 s) + markov", "markov_1_amplitude"),
    ("low_pass2 * N=1 rad/√s", "low_pass2_bandwidth"),
]  # fmt: skip
WRONG_UNITS = [("markov(correlation_time=5 deg)", "deg"), ("N=0.1", "unit"), ("N=0.1 deg/h", "deg/h")]
WRONG_UNITS += [("N=0.1 m/s/√h", "gyro"), ("resonance(Q_f=5 s)", "quality_factor")]


def test_what_cannot_be_read_is_explained():
    for error, table in ((aj.AllanjaxError, UNREADABLE), (aj.UnitError, WRONG_UNITS)):
        for text, word in table:
            with pytest.raises(error, match=word):
                read(text)
    # A value is of one sensor, and the record has both.
    refuses("angle_random_walk", aj.fit, bench.recording("small"), "N=1 deg/√h + B", as_is=True)


def test_every_term_is_read_by_its_name_and_its_symbol():
    symbols = {name: told.split()[0] for name, (told, _) in DECLARED.items()}
    for name, symbol in symbols.items():
        own = [symbol] * ([*symbols.values()].count(symbol) == 1)
        for text in (name, name.upper(), *own):
            refuses(f"^{name}", aj.simulate, text, 16, RATE, 0)


CALLED = {
    ("gyro_x", "angle_random_walk"): "N, ARW, arw, angle_random_walk, Angle random walk",
    ("gyro_x", "rate_random_walk"): "K, RRW, rate-random-walk",
    ("gyro_x", "bias_instability"): "B, BI, flicker, bias instability, flicker_noise",
    ("gyro_x", "drift_ramp"): "R, ramp, rate_ramp,  drift_ramp ",
    ("gyro_x", "markov_correlation_time"): "T_c, markov_correlation_time",
    ("accel_z", "angle_random_walk"): "N, VRW, velocity_random_walk, velocity random walk",
    ("accel_z", "rate_random_walk"): "K, RRW, acceleration_random_walk",
    ("accel_z", "quantization"): "Q, QN, quantization_noise",
    ("accel_z", "markov_amplitude"): "q_c, markov_amplitude",
}


def named(axis: str, model: aj.Model) -> aj.AxisFit:
    """An axis of a fit with coefficients of this model."""
    fitted, N = bench.fit("small")[axis], bench.fit("small")[axis]["N"]
    found = {p.label: dataclasses.replace(N, label=p.label, parameter=p.parameter) for p in model.parameters}
    return dataclasses.replace(fitted, _coefficients=found)


def test_coefficients_are_found_by_label_symbol_and_abbreviation():
    for (axis, label), names in CALLED.items():
        found = named(axis, aj.terms.basic_terms() + aj.Markov())
        assert all(found[name] is found.coefficients[label] for name in names.split(", ")), label


def test_what_could_be_two_things_is_neither():
    """ARW is the angle random walk for some, the acceleration random walk for others."""
    two = aj.AngleRandomWalk() + aj.Markov() + aj.Markov()
    for axis, name in [("accel_z", "ARW"), *(("gyro_x", x) for x in ("velocity_random_walk", "T_c", "n"))]:
        with pytest.raises(aj.FitError, match=name):
            named(axis, two)[name]
    assert named("gyro_x", two)["markov_2_correlation_time"].label == "markov_2_correlation_time"
