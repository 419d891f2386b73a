"""Samples that are missing, clipped or dropped: drawn with their noise, and no further knowledge."""

import functools

import critic_truth as ct
import numpy as np
import pytest
from bench import critique, recording

import allanjax as aj
from allanjax.critic import CAUSES

N, RATE = ct.N, 50.0
OPTIONS = {"rate": RATE, "gyro_unit": "deg/s", "names": ["gyro_x", "gyro_z"], "gaps": "fill"}
#: A tenth of the samples: singly, and two gaps of two hundred.
LOST = np.random.default_rng(2).random(N) < 0.078
LOST[2_000:2_200] = LOST[9_000:9_200] = True
LOST[5_000] = False
SHARE = LOST.mean()
# Errors of coefficients grow by this factor.
WIDE = np.sqrt(1.0 / (1.0 - SHARE) + SHARE)


@functools.cache
def gappy():
    """Critique of a line and an outlier in white noise, of which a tenth is missing, and of noise alone."""
    x = np.random.default_rng(11).standard_normal((N, 2)) + 0.3
    x[:, 0] += 0.25 * np.sin(2.0 * np.pi * 3.2171 * np.arange(N) / RATE)
    x[5_000, 0] += 15.0
    return [aj.critique(values, **OPTIONS) for values in (np.where(LOST[:, None], np.nan, x), x)]


def test_what_is_found_is_what_there_is_with_a_tenth_less_known_of_it():
    lossy, whole = gappy()
    for found in (lossy, whole):
        assert sorted(f.cause for f in found["gyro_x"].findings) == ["outliers", "sinusoid"]
        assert found["gyro_z"].findings == ()
        assert all(d.p_value > 1e-4 for axis in found.results for d in axis.after)
    (line, full), (spot, _) = (
        [next(f for f in found["gyro_x"].findings if f.cause == cause) for found in (lossy, whole)]
        for cause in ("sinusoid", "outliers")
    )
    assert full.size.std == pytest.approx(np.sqrt(2.0 / N), rel=0.03)
    # What is drawn between is noise: it shows nothing of what it was, and adds to the errors.
    for label, true in (("amplitude", 0.25), ("frequency", 3.2171)):
        e, other = (f.parameters[label] for f in (line, full))
        # A frequency is known the better the larger its line is.
        larger = 1.0 if label == "amplitude" else full.size.value / line.size.value
        assert e.std == pytest.approx(WIDE * larger * other.std, rel=0.03)
        assert abs(e.value - true) < 4.0 * e.std
    # A record of nine tenths of the length gains nine tenths.
    assert 0.8 * (1.0 - SHARE) * full.gain < line.gain < 1.1 * full.gain
    (time,) = spot.details["times"]
    assert time.value == 5_000 / RATE
    assert spot.parameters["count"].value == 1.0


def test_noise_is_as_loud_where_it_was_drawn_and_is_known_less_well():
    lossy, whole = gappy()
    for axis in lossy:
        left = lossy[axis].stages[-1].x * 180.0 / np.pi
        for some, error in ((left, WIDE / np.sqrt(2.0 * N)), (left[LOST], 1.0 / np.sqrt(2.0 * LOST.sum()))):
            assert np.std(some) == pytest.approx(1.0, abs=4.0 * error)
        assert lossy.fit[axis].widening == pytest.approx(WIDE)
        assert whole.fit[axis].widening == 1.0


def test_coefficients_of_what_is_left_are_as_uncertain_as_if_the_record_were_shorter():
    given, found = recording("lossy"), critique("lossy")
    assert any("filled in" in note for note in found.notes)
    wide = np.sqrt(1.0 / (1.0 - given.missing.mean()) + given.missing.mean())
    units = {"gyro_unit": "rad/s", "accel_unit": "m/s²"}
    drawn = aj.fit(given.values, rate=given.rate, **units, names=given.names, as_is=True)
    again = found.refit()
    for axis in again:
        assert again[axis].widening == pytest.approx(wide)
        for label, e in again[axis].coefficients.items():
            if e.detected:
                assert e.std == pytest.approx(wide * drawn[axis].coefficients[label].std, rel=1e-6)


def test_coefficients_of_what_is_left_are_of_the_given_model_and_know_less_by_outliers():
    rng = np.random.default_rng(3)
    x, spoilt = rng.standard_normal(N), rng.random(N) < 0.05
    x += 30.0 * spoilt * rng.choice([-1, 1], N)
    record = aj.Recording.from_array(x, RATE, gyro_unit="deg/s", names=["gyro_x"])
    given = aj.fit(record, "N + K", as_is=True)
    again = aj.critique(record, given).refit()
    assert again.template == given.template
    share = spoilt.mean()
    assert again["gyro_x"].widening == pytest.approx(np.sqrt(1.0 / (1.0 - share) + share), rel=1e-3)


BEHIND = [("rounded", "gyro_x", 0.06), ("more", "gyro_2", 0.025), ("rounded", "gyro_y", 0.04)]


@pytest.mark.parametrize(("name", "axis", "tolerance"), BEHIND)
def test_noise_behind_rounding_repeats_and_a_range_has_its_level(name, axis, tolerance):
    """What was rounded, repeated or clipped is drawn within what is known of it, with its noise."""
    # Steps of 1.8 deviations, a twelfth of the samples repeated, a fifth of them clipped: without their noise
    # N would be 13 % too large, 4 % and 20 % too small. Draws between limits are about a local mean of 200
    # samples, which costs some per cent.
    found = ct.critique(name)
    (true,) = (h.own["angle_random_walk"] for h in ct.hidden_in(name) if h.axis == axis)
    level = np.std(np.diff(found[axis].stages[-1].x)) / np.sqrt(2.0 * found.rate)
    assert level == pytest.approx(true, rel=tolerance)
    assert found.models[axis]["angle_random_walk"].coefficient == pytest.approx(true, rel=tolerance)


def test_steps_of_the_output_and_a_range_are_those_of_measured_samples():
    """What was drawn is no multiple of a step, and may be beyond a range."""
    x = np.random.default_rng(12).standard_normal((N, 2))
    x = np.column_stack([np.round(x[:, 0]), np.clip(x[:, 1], -1.5, 1.5)])
    causes = [c for c in CAUSES if c.name in ("rounding", "saturation", "repeated_samples")]
    found = aj.critique(np.where(LOST[:, None], np.nan, x), **OPTIONS, causes=causes)
    (step,), (limits,) = ([f for f in found[axis].findings if f.cause != "unexplained"] for axis in found)
    assert step.parameters["step"].value == pytest.approx(1.0)
    assert limits.parameters["upper_level"].value == pytest.approx(1.5)
    assert limits.parameters["lower_level"].value == pytest.approx(-1.5)
    clipped = np.sum(abs(x[~LOST, 1]) == 1.5)
    assert limits.parameters["fraction"].value == pytest.approx(clipped / N)
