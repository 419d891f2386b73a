"""Words for what a fit was corrected for, of estimates made by hand."""

import math

import pytest

import allanjax as aj
from allanjax.estimate.correction import correction_of, further_terms
from allanjax.noise.estimate import Estimate
from allanjax.record.recording import Axis

AXIS = Axis("gyro_x", "gyro", "rad/s")
# 1 deg/√h in rad/√s.
DEGREE = math.pi / 180.0 / 60.0


def white(value):
    return estimate("angle_random_walk", value * DEGREE, 0.01 * DEGREE, "rad/√s", "deg/√h")


def estimate(label, value, std, unit="Hz", usual="Hz", **more):
    return Estimate(
        axis=AXIS,
        label=label,
        value=value,
        std=std,
        interval=(math.nan, math.nan),
        interval_68=(math.nan, math.nan),
        unit=unit,
        usual_unit=usual,
        **more,
    )


def words(model, bandwidth=None, after=None, before=None):
    return correction_of(model, model, after or white(2.0), before, bandwidth)


BUTTERWORTH = aj.Butterworth(28.04) * aj.AngleRandomWalk(1e-3)


@pytest.mark.parametrize(
    ("bandwidth", "said"),
    [
        (estimate("bandwidth", 28.04, 0.2), "a 28 Hz bandwidth"),
        (estimate("bandwidth", 28.04, math.nan, lower_limit=27.66), "a bandwidth above 27.7 Hz"),
        (estimate("bandwidth", 28.04, math.nan, upper_limit=31.2), "a bandwidth below 31.2 Hz"),
        # Any filter of this record has a bandwidth above so little.
        (estimate("bandwidth", 28.04, math.nan, lower_limit=0.09), "a filter of undetermined bandwidth"),
        (estimate("bandwidth", 28.04, math.nan), "a filter of undetermined bandwidth"),
        # A value that the user gave is told as it was given.
        (estimate("bandwidth", 28.04, math.nan, held=True), "a 28 Hz bandwidth"),
    ],
)
def test_a_bandwidth_is_told_only_where_the_data_determine_it(bandwidth, said):
    assert words(BUTTERWORTH, bandwidth) == f"corrected for {said}"


def test_a_bandwidth_is_where_the_power_is_halved():
    """Two poles at 10 Hz with Q = 2 halve the power at 10·√(7/8 + √(1 + 49/64)) Hz."""
    f = 10.0 * math.sqrt(7.0 / 8.0 + math.sqrt(1.0 + 49.0 / 64.0))
    model = aj.LowPass2(10.0, 2.0) * aj.AngleRandomWalk(1e-3)
    assert words(model, estimate("bandwidth", 10.0, 0.1)) == f"corrected for a {f:.3g} Hz bandwidth"


def test_places_are_listed_and_the_strongest_of_many_named():
    N = aj.AngleRandomWalk(1e-3)
    lines = [aj.Sinusoid(a, f) for a, f in ((1e-3, 3.0), (4e-3, 7.0), (2e-3, 1.0), (3e-3, 5.0))]
    assert words(N + lines[0]) == "corrected for a line at 3 Hz"
    assert words(N + lines[0] + lines[1]) == "corrected for lines at 3 and 7 Hz"
    four = words(N + lines[0] + lines[1] + lines[2] + lines[3])
    assert four == "corrected for lines at 1, 5 and 7 Hz (4 in all)"
    peak = aj.Resonance(1e-3, 20.16, 15.0)
    text = words(aj.LowPass1(12.0) * (N + peak) + lines[0], estimate("bandwidth", 12.0, 0.1))
    assert text == "corrected for a 12 Hz bandwidth, a resonance at 20.2 Hz and a line at 3 Hz"


def test_markov_processes_are_told_where_there_is_nothing_else():
    N, one, other = aj.AngleRandomWalk(1e-3), aj.Markov(1e-4, 10.0), aj.Markov(1e-4, 100.0)
    assert words(N + one) == "corrected for a Markov process"
    assert words(N + one + other) == "corrected for Markov processes of several correlation times"


def test_what_it_does_to_white_noise_is_told_where_both_fits_have_some():
    line = aj.AngleRandomWalk(1e-3) + aj.Sinusoid(1e-3, 3.0)
    told = words(line, after=white(2.2734), before=white(2.4631))
    assert told == "corrected for a line at 3 Hz: angle random walk 2.46 → 2.27 deg/√h"
    for after, before in ((white(2.0), None), (white(0.0), white(2.0)), (white(2.0), white(0.0))):
        assert words(line, after=after, before=before) == "corrected for a line at 3 Hz"


def test_terms_beside_the_plain_ones_are_named_as_the_model_has_them():
    model = aj.AngleRandomWalk(1e-3) + aj.Markov(1e-4, 10.0) + aj.Sinusoid(1e-3, 3.0) + aj.Sinusoid(1e-3, 5.0)
    assert further_terms(model) == ("sinusoid_1", "sinusoid_2")
    filtered = aj.LowPass1(12.0) * aj.AngleRandomWalk(1e-3) + aj.Markov(1e-4, 10.0)
    assert further_terms(filtered) == (aj.LowPass1(1.0).name(),)
