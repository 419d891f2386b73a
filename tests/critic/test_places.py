"""What was found in one axis is looked for in the others: weak lines are found there, noise is not told."""

import dataclasses

import numpy as np
import pytest
from critic_views import view_of
from one_axis import searched

import allanjax as aj
from allanjax.critic.causes.sinusoid import Sinusoid
from allanjax.critic.causes.spectral_shape import SpectralShape
from allanjax.critic.merging import merged
from allanjax.critic.places import Place, elsewhere
from allanjax.critic.policy import AcceptanceRule
from allanjax.noise.terms import AngleRandomWalk, Resonance

N, RATE, F = 20_000, 50.0, 3.2173


def white(seed, n=N):
    return np.random.default_rng(seed).standard_normal(n)


def line(amplitude, n=N):
    return amplitude * np.sin(2.0 * np.pi * F * np.arange(n) / RATE + 0.4)


def gain_of(amplitude, n=N):
    """Log-likelihood [nats] that a line of this amplitude in unit white noise gains."""
    return amplitude**2 * n / 4.0


@pytest.fixture(scope="module")
def weak():
    """Amplitude of a line that gains 15 nats: too little where its frequency is one of 20,000."""
    return np.sqrt(15.0 * 4.0 / N)


@pytest.fixture(scope="module")
def critique(weak):
    x = np.stack([white(1) + line(5.0 * weak), white(2) + line(weak), white(3)], axis=1)
    return aj.critique(x, rate=RATE, gyro_unit="rad/s")


def test_a_weak_line_alone_is_not_found(weak):
    assert gain_of(weak) == pytest.approx(15.0)
    assert searched(view_of(white(2) + line(weak)), [Sinusoid()]).steps == ()


def test_a_weak_line_is_found_where_a_strong_one_is(critique, weak):
    (found,) = critique.findings
    assert found.axes == ("gyro_x", "gyro_y")
    assert found.parameters["frequency"].value == pytest.approx(F, abs=4.0 * RATE / N)
    # The amplitude's deviation is √(2/n).
    assert found.amplitudes["gyro_y"].in_unit("rad/s").value == pytest.approx(
        weak, abs=4.0 * np.sqrt(2.0 / N)
    )


def test_noise_at_known_places_is_not_told():
    # Level of an axis of six. P(more than 3 of 200 | 200 · 0.01/90) < 1e-7, so three are a bug.
    rule = AcceptanceRule.of(0.01 / 6.0)
    places = [Place(f, 2.0 * RATE / N, f * N / RATE) for f in (1.1, 3.3, 7.7)]
    told = 0
    for seed in range(200):
        candidate = Sinusoid(places).detect(view_of(white(1_000 + seed)))
        told += candidate is not None and rule.accepts(candidate)
    assert told < 3


def test_the_p_value_of_a_line_at_known_places_is_uniform():
    # 300 records: a share p of them is within 4 √(p(1 − p)/300); the law is that of large values.
    places = [Place(f, 2.0 * RATE / N, f * N / RATE) for f in (1.1, 3.3, 7.7)]
    p = np.array([Sinusoid(places).p_value(view_of(white(5_000 + seed))) for seed in range(300)])
    for level in (0.03, 0.1, 0.3):
        assert np.mean(p < level) == pytest.approx(level, abs=4.0 * np.sqrt(level * (1.0 - level) / 300.0))


def resonant(seed, amplitude):
    """White noise and a resonance of 3.2 Hz and Q = 300, by the recursion of an oscillator."""
    w, r = 2.0 * np.pi * F / RATE, np.exp(-np.pi * F / (300.0 * RATE))
    drive = np.random.default_rng(seed).standard_normal((2, N + 5_000))
    z = np.zeros(N + 5_000, complex)
    turn = r * np.exp(1j * w)
    for k in range(1, len(z)):
        z[k] = turn * z[k - 1] + np.sqrt(1.0 - r**2) * (drive[0, k] + 1j * drive[1, k]) * amplitude
    return white(seed + 100) + z.real[5_000:]


def test_a_resonance_is_found_at_a_known_place():
    place, view = Place(F, 2.0 * F / 300.0, 300.0), view_of(resonant(1, 0.15))
    alone = SpectralShape([place]).detect(view)
    assert alone is not None
    assert AcceptanceRule.of(2e-3).accepts(alone)
    (k,) = alone.after.structure.oscillators
    assert alone.after.structure.frequency(k) * RATE / (2.0 * np.pi) == pytest.approx(F, abs=place.reach)
    # At one of four places that it may have been at it is four times as likely by chance.
    others = [Place(f, 2.0 * f / 300.0, 300.0) for f in (7.1, 11.7, 19.3)]
    among_four = SpectralShape([*others, place]).detect(view)
    assert alone.gain - among_four.gain == pytest.approx(np.log(4.0), abs=0.5)


def test_no_resonance_is_told_at_known_places_in_noise():
    # Level 1.3e-4 for each record: of twenty none, or one in four hundred runs.
    places = [Place(f, 2.0 * f / 300.0, 300.0) for f in (1.1, 3.3, 7.7)]
    found = [SpectralShape(places).detect(view_of(white(9_000 + seed))) for seed in range(20)]
    assert not [c for c in found if c is not None and AcceptanceRule.of(2e-3).accepts(c)]


def test_places_that_an_axis_has_are_not_looked_at_again():
    own = [Place(3.2, 0.01, 300.0)]
    others = [Place(3.205, 0.001, 900.0), Place(7.0, 0.01, 300.0), Place(7.004, 0.01, 400.0)]
    assert elsewhere(own, others) == (others[1],)


def test_lines_of_one_unsteady_source_are_one_finding(critique):
    (found,) = critique.findings
    one = found.members[0]
    near, far = (
        dataclasses.replace(
            one,
            cause="sinusoid",
            parameters={
                **one.parameters,
                "frequency": dataclasses.replace(one.parameters["frequency"], value=F + shift * RATE / N),
            },
        )
        for shift in (2.0, 30.0)
    )
    assert [len(f.axes) for f in merged([one, near], [], N / RATE)] == [1]
    assert len(merged([one, far], [], N / RATE)) == 2


def test_coefficients_with_intervals_of_what_is_left(weak):
    """With a line and outliers taken out, N is what was simulated."""
    x = white(4) + line(20.0 * weak)
    x[:: N // 20] += 40.0
    critique = aj.critique(x, rate=RATE, gyro_unit="rad/s")
    assert {f.cause for f in critique.findings} >= {"sinusoid", "outliers"}
    N_true = 1.0 / np.sqrt(RATE)
    estimate = critique.refit()["gyro"].coefficients["angle_random_walk"].in_unit("rad/s/√Hz")
    low, high = estimate.interval
    # Its deviation is N/√(2n), 0.5 %.
    assert low < N_true < high
    assert estimate.value == pytest.approx(N_true, rel=4.0 / np.sqrt(2.0 * N))


def test_a_resonance_is_no_change_of_white_noise():
    """The finding tells N as the extended model has it, filter and resonance being fitted with it."""
    model = AngleRandomWalk(1e-3) + Resonance(4e-3, 11.0, 8.0)
    x = aj.simulate(model, 60_000, RATE, 5)
    critique = aj.critique(np.asarray(x), rate=RATE, gyro_unit="rad/s")
    (found,) = [f for f in critique.findings if f.cause == "resonance"]
    (change,) = [c for c in found.coefficients if c.label == "angle_random_walk"]
    assert change.unit == "deg/√h"
    after = change.after * np.pi / 180.0 / 60.0
    # N is known to 1/√(2n·share of the band): 1 %.
    assert after == pytest.approx(1e-3, rel=0.03)
