"""Models written as text."""

import math

import pytest

from allanjax.base.errors import AllanjaxError, UnitError
from allanjax.noise.notation import parse_model, term_classes

DEG = math.pi / 180


def test_letters_and_names_are_the_same_terms():
    model = parse_model("Q + N+B + K, R")
    assert model.term_labels == (
        "quantization",
        "angle_random_walk",
        "bias_instability",
        "rate_random_walk",
        "drift_ramp",
    )
    assert parse_model(", ".join(model.term_labels)) == model
    others = {"markov", "sinusoid", "resonance", "power_law", "low_pass", "telegraph", "bias_step", "warm_up"}
    others |= {"wandering_resonance", "channel_effect"}
    assert set(term_classes()) == {*model.term_labels, *others}


def test_values_are_converted_to_si():
    model = parse_model(
        "N=0.1 deg/√h + B = 3e+0 deg/h + markov(amplitude=6 deg/h/sqrt(h), T_c=2 min)", "gyro"
    )
    assert model.values["angle_random_walk"] == pytest.approx(0.1 * DEG / 60, rel=1e-12)
    assert model.values["bias_instability"] == pytest.approx(3 * DEG / 3600, rel=1e-12)
    assert model.values["markov_amplitude"] == pytest.approx(6 * DEG / 3600 / 60, rel=1e-12)
    assert model.values["markov_correlation_time"] == pytest.approx(120.0, rel=1e-12)
    assert all(p.free for p in model.parameters if p.parameter.kind != "frequency")


def test_held_values_and_several_terms_of_a_kind():
    model = parse_model("markov(correlation_time=100 s held) + markov(correlation_time=1) + resonance(Q_f=5)")
    free = {p.label: p.free for p in model.parameters}
    assert free["markov_1_correlation_time"] is False
    assert free["markov_2_correlation_time"] is True
    assert model.values["markov_2_correlation_time"] == 1.0
    assert model.values["resonance_quality_factor"] == 5.0


@pytest.mark.parametrize(
    ("text", "error", "match"),
    [
        ("N + X", AllanjaxError, "no term 'X'; there are .*quantization"),
        ("N +", AllanjaxError, "cannot read"),
        ("markov(correlation_time=100 s", AllanjaxError, "cannot read"),
        ("N)+(B", AllanjaxError, "cannot read"),
        ("markov(tau=100 s)", AllanjaxError, "has amplitude, correlation_time"),
        ("markov(100 s)", AllanjaxError, "correlation_time=100 s"),
        ("markov(correlation_time=long)", AllanjaxError, "number and a unit"),
        ("markov(correlation_time=5 deg)", UnitError, "cannot convert"),
        ("N=0.1", UnitError, "needs a unit, e.g. deg/√h"),
        ("N=0.1 deg/h", UnitError, "cannot convert 'deg/h'"),
        ("N=0.1 m/s/√h", UnitError, "gyro"),
        ("N=-1 deg/√h", AllanjaxError, "must be ≥ 0"),
        ("resonance(Q_f=5 s)", UnitError, "plain number"),
    ],
)
def test_what_cannot_be_read_is_explained(text, error, match):
    with pytest.raises(error, match=match):
        parse_model(text, "gyro")
