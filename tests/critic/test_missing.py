"""Samples that are missing, clipped or dropped: drawn with their noise, and no further knowledge."""

import critic_records as cr
import numpy as np
import pytest
from bench import critique, once, recording, truth

import allanjax as aj
from allanjax.critic import CAUSES

N, RATE = cr.N, 50.0


def lost():
    """A tenth of the samples: singly, and two gaps of two hundred."""
    missing = np.random.default_rng(2).random(N) < 0.078
    missing[2_000:2_200] = missing[9_000:9_200] = True
    return missing


def gappy():
    """Critique of a line and an outlier in white noise, of which a tenth is missing, and of noise alone."""
    x = np.random.default_rng(11).standard_normal((N, 2)) + 0.3
    x[:, 0] += 0.25 * np.sin(2.0 * np.pi * 3.2171 * np.arange(N) / RATE)
    x[5_000, 0] += 15.0
    missing = lost()
    missing[5_000] = False

    def make():
        return [
            aj.critique(values, rate=RATE, gyro_unit="deg/s", names=["gyro_x", "gyro_z"], gaps="fill")
            for values in (np.where(missing[:, None], np.nan, x), x)
        ]

    return (missing.mean(), *once("critique of a gappy record", make))


def test_what_is_found_is_what_there_is_with_a_tenth_less_known_of_it():
    share, lossy, whole = gappy()
    wide = np.sqrt(1.0 / (1.0 - share) + share)
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
        assert e.std == pytest.approx(wide * larger * other.std, rel=0.03)
        assert abs(e.value - true) < 4.0 * e.std
    # A record of nine tenths of the length gains nine tenths.
    assert 0.8 * (1.0 - share) * full.gain < line.gain < 1.1 * full.gain
    (time,) = spot.details["times"]
    assert time.value == 5_000 / RATE
    assert spot.parameters["count"].value == 1.0


def test_noise_is_as_loud_where_it_was_drawn_and_is_known_less_well():
    share, lossy, whole = gappy()
    wide = np.sqrt(1.0 / (1.0 - share) + share)
    missing = lost()
    missing[5_000] = False
    for axis in lossy:
        left = lossy[axis].stages[-1].x * 180.0 / np.pi
        for some, error in (
            (left, wide / np.sqrt(2.0 * N)),
            (left[missing], 1.0 / np.sqrt(2.0 * missing.sum())),
        ):
            assert np.std(some) == pytest.approx(1.0, abs=4.0 * error)
        assert lossy.fit[axis].widening == pytest.approx(wide)
        assert whole.fit[axis].widening == 1.0


def test_coefficients_of_what_is_left_are_as_uncertain_as_if_the_record_were_shorter():
    given, found = recording("lossy"), critique("lossy")
    share = given.missing.mean()
    wide = np.sqrt(1.0 / (1.0 - share) + share)
    drawn = aj.fit(
        given.values, rate=given.rate, gyro_unit="rad/s", accel_unit="m/s²", names=given.names, as_is=True
    )
    again = found.refit()
    for axis in again:
        assert again[axis].widening == pytest.approx(wide)
        for label, e in again[axis].coefficients.items():
            if e.detected:
                assert e.std == pytest.approx(wide * drawn[axis].coefficients[label].std, rel=1e-6)


def test_a_record_that_lost_bursts_on_all_axes_has_no_finding():
    found, hidden = critique("lossy"), truth("lossy")
    assert found.findings == ()
    assert any("drawn" in note for note in found.notes)
    # Bursts at the same times on both axes, drawn independently, are nothing that they share.
    assert all(d.p_value > 1e-4 for axis in found.results for d in axis.before)
    for axis in found:
        own = hidden.truth[axis]["angle_random_walk"]
        tolerance = 4.0 * 1.3 * found.fit[axis].widening / np.sqrt(2.0 * N)
        assert found.models[axis]["angle_random_walk"].coefficient == pytest.approx(own, rel=tolerance)
    assert recording("lossy").missing is not None


@pytest.mark.parametrize(("axis", "tolerance"), [("gyro_z", 0.06), ("gyro_x", 0.025), ("accel_x", 0.04)])
def test_noise_behind_rounding_repeats_and_a_range_has_its_level(axis, tolerance):
    """What was rounded, repeated or clipped is drawn within what is known of it, with its noise.

    Steps of 1.4 deviations, a twelfth of the samples repeated, a fifth of them clipped: without their noise N
    would be 8 % too large, 4 % and 20 % too small. Draws between limits are about a local mean of 200
    samples, which costs some per cent.
    """
    found, hidden = cr.critique("samples"), cr.scene("samples", 4.0)[axis]
    model = found.models[axis]
    x = np.std(np.diff(found[axis].stages[-1].x)) / np.sqrt(2.0)
    unit = {"gyro": np.pi / 180.0 / 3600.0, "accel": 9.80665e-3}[axis.split("_")[0]]
    assert x == pytest.approx(hidden.noise[0] * unit, rel=tolerance)
    n = model["angle_random_walk"].coefficient * np.sqrt(found.rate) / unit
    assert n == pytest.approx(hidden.noise[0], rel=tolerance)


def test_steps_of_the_output_and_a_range_are_those_of_measured_samples():
    """What was drawn is no multiple of a step, and may be beyond a range."""
    x = np.random.default_rng(12).standard_normal((N, 2))
    x = np.column_stack([np.round(x[:, 0]), np.clip(x[:, 1], -1.5, 1.5)])
    missing = lost()
    seen = [c for c in CAUSES if c.name in ("rounding", "saturation", "repeated_samples")]
    found = aj.critique(
        np.where(missing[:, None], np.nan, x),
        rate=RATE,
        gyro_unit="deg/s",
        names=["gyro_x", "gyro_z"],
        gaps="fill",
        causes=seen,
    )
    (step,), (limits,) = ([f for f in found[axis].findings if f.cause != "unexplained"] for axis in found)
    assert step.parameters["step"].value == pytest.approx(1.0)
    assert limits.parameters["upper_level"].value == pytest.approx(1.5)
    assert limits.parameters["lower_level"].value == pytest.approx(-1.5)
    clipped = np.sum(abs(x[~missing, 1]) == 1.5)
    assert limits.parameters["fraction"].value == pytest.approx(clipped / N)
