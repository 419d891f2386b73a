"""What ends at a bound of a search is told as a limit: truths that lie beyond each bound."""

import dataclasses
import json

import numpy as np
import pytest
from critic_views import view_of
from one_axis import searched
from scipy.signal import butter, lfilter, sosfilt
from scipy.stats import norm

from allanjax.critic.causes.additive import shape_parameter
from allanjax.critic.causes.basic_term import BasicTerm
from allanjax.critic.causes.bias_step import _parameters as step_parameters
from allanjax.critic.causes.common_mode import common_mode
from allanjax.critic.causes.disturbance import Disturbance
from allanjax.critic.causes.outliers import _log_scale
from allanjax.critic.causes.power_law import PowerLaw
from allanjax.critic.causes.saturation import Saturation
from allanjax.critic.causes.sinusoid import Sinusoid
from allanjax.critic.causes.spectral_shape import SpectralShape
from allanjax.critic.causes.telegraph import two_levels
from allanjax.critic.causes.temperature import Temperature
from allanjax.critic.causes.variance_change import VarianceChange, _ratio
from allanjax.critic.causes.warm_up import WarmUp
from allanjax.critic.noise import MARKOV
from allanjax.critic.parameters import limited, parameter_estimate
from allanjax.critic.result import Finding
from allanjax.critic.view import EVERYTHING
from allanjax.record.recording import Axis
from allanjax.report.critique_json import _parameter
from allanjax.report.critique_words import amount, parameters, side_of_limit

N, RATE, NAN = 30_000, 50.0, float("nan")


def white(seed):
    return np.random.default_rng(seed).standard_normal(N)


def check(q, limit, truth):
    """A limit that holds, told as one everywhere."""
    assert side_of_limit(q) == limit
    assert np.isnan([q.std, *q.interval, *q.interval_68]).all()
    q = dataclasses.replace(q, label="width")
    for text in (amount(dataclasses.replace(q, label=label)) for label in ("width", "start", "order")):
        assert "±" not in text
    assert amount(q).startswith(f"{limit} ")
    assert q.describe().startswith(f"{limit} ")
    assert str(q).endswith(" (95 %)")
    assert _parameter(q) == {"value": q.value, "std": None, "unit": q.unit, "limit": limit}
    json.dumps(_parameter(q), allow_nan=False)
    assert (q.value < truth) if limit == "above" else (q.value > truth)


def told(*estimates):
    """The parameters of a finding, in words."""
    by_label = {e.label: e for e in estimates}
    return parameters(Finding("any", ("gyro_x",), by_label, 0.0, 0.0, 0.0, (), (0.0, 1.0), "time"))


# --- Words --------------------------------------------------------------------------------------------------


def test_limits_in_words():
    limits = (
        ("ratio", 0.1, "1", "below"),
        ("quality_factor", 438.24, "1", "above"),
        ("start", 0.0, "s", "below"),
        ("end", 600.0, "s", "above"),
        ("order", 4.0, "1", "above"),
        ("bandwidth", 48.91, "Hz", "above"),
        ("amplitude", -0.00201, "deg/s", "below"),
    )
    axis = Axis("gyro_x", "gyro", "deg/s")
    assert told(*(parameter_estimate(axis, name, x, NAN, unit, side) for name, x, unit, side in limits)) == [
        "ratio below 0.1",
        "quality factor above 438",
        "start at or before 0 s",
        "end at or after 600 s",
        "order at least 4",
        "bandwidth above 48.9 Hz",
        "amplitude below -7.24 deg/h",
    ]


# --- What all searches share --------------------------------------------------------------------------------


@pytest.mark.parametrize(("place", "limit"), [(0.0, "below"), (5.0, ""), (10.0, "above"), (9.95, "above")])
def test_a_likelihood_cut_off_by_a_bank_is_a_limit(place, limit):
    """By the posterior under a flat prior: 5 % of it is beyond the limit, and 2.4 % in either tail of one."""
    values = np.linspace(0.0, 10.0, 2001)
    likelihood = np.exp(-0.5 * (values - place) ** 2)
    value, std, found = shape_parameter(values, likelihood)
    assert found == limit
    weight = likelihood / likelihood.sum()
    if limit:
        beyond = weight[values > value] if limit == "below" else weight[values < value]
        assert np.isnan(std)
        assert beyond.sum() == pytest.approx(0.05, abs=1e-3)
    else:
        assert (value, std) == pytest.approx((5.0, 1.0), rel=1e-3)


def test_a_maximum_near_a_bound_is_a_limit():
    assert limited(0.5, 0.1, (0.0, 1.0)) == (0.5, 0.1, "")
    # One-sided 95 % limits.
    away = 0.1 * norm.ppf(0.95)
    for u, limit, value in ((0.95, "above", 0.95 - away), (1.2, "above", 1.0 - away)):
        found = limited(u, 0.1, (0.0, 1.0))
        assert found[0] == pytest.approx(value)
        assert found[2] == limit
    assert limited(0.001, 1e-9, (0.0, 1.0))[2] == "below"


# --- Truths beyond the bounds -------------------------------------------------------------------------------


K = np.arange(N)
TIME = K / RATE


def test_noise_that_all_but_vanishes_has_a_ratio_below_a_limit():
    """The critic's smallest ratio is 0.1; the truth is 0.02."""
    inside = (K > 10_000) & (K < 17_000)
    found = VarianceChange().detect(view_of(np.where(inside, 0.02, 1.0) * white(1))).parameters
    check(found["ratio"], "below", 0.02)
    # Its scatter is that of what is known, not of a bound.
    view = view_of(np.zeros(N))
    ratio = _ratio(view, -0.5, 0.01)
    assert (ratio.value, ratio.std) == pytest.approx((np.sqrt(0.5), 0.01 / (2.0 * np.sqrt(0.5))))
    assert ratio.interval == pytest.approx((ratio.value - 1.96 * ratio.std, ratio.value + 1.96 * ratio.std))
    assert _ratio(view, -0.97, 0.03).upper_limit == pytest.approx(np.sqrt(0.03 + norm.ppf(0.95) * 0.03))


def test_noise_that_is_louder_to_the_end_ends_at_or_after_it():
    found = VarianceChange().detect(view_of(np.where(K > 19_000, 1.3, 1.0) * white(2))).parameters
    assert (found["end"].lower_limit, found["end"].upper_limit) == (N / RATE, None)
    assert told(found["end"]) == ["end at or after 600 s"]
    assert not side_of_limit(found["ratio"])


@pytest.mark.parametrize(("time_constant", "limit"), [(2000.0, "above"), (0.2, "below"), (40.0, "")])
def test_a_warm_up_slower_or_faster_than_all_in_the_bank(time_constant, limit):
    """Of 600 s, time constants from 1.2 to 300 s are looked through."""
    x = white(3) + 40.0 * np.exp(-TIME / time_constant)
    found = WarmUp().detect(view_of(x, ("quantization", "angle_random_walk"))).parameters
    if limit:
        check(found["time_constant"], limit, time_constant)
        check(found["amplitude"], "above", 40.0)
    else:
        assert found["time_constant"].value == pytest.approx(40.0, abs=4.0 * found["time_constant"].std)
        assert found["amplitude"].std > 0.0


def test_a_temperature_without_lag_has_one_below_a_limit():
    """Lags cannot be negative: zero is a bound, and what the sensors of most units have."""
    walk = np.cumsum(np.random.default_rng(5).standard_normal(N))
    channel = np.convolve(walk, np.ones(500) / 500, "same")
    channel = (channel - channel.mean()) / channel.std()
    view = view_of(white(4) + channel, EVERYTHING, {"temperature": channel})
    check(Temperature().detect(view).parameters["lag"], "below", 0.0)


def found_in(x, cause):
    """Parameters of the one filter or resonance that is found."""
    found = searched(view_of(x), [SpectralShape()])
    (parameters,) = (s.candidate.parameters for s in found.steps if s.candidate.cause == cause)
    return parameters


def test_a_filter_steeper_than_all_is_of_at_least_the_steepest_ones_order():
    """The steepest one that is looked for is of order 4."""
    x = sosfilt(butter(8, 0.5, output="sos"), white(6)) + 1e-3 * white(66)
    found = found_in(x, "low_pass")
    check(found["order"], "above", 8.0)
    assert told(found["order"]) == ["order at least 4"]


def test_a_bandwidth_below_all_that_are_looked_for_is_that_of_a_markov_process():
    """White noise behind a pole at 0.05 Hz; the least bandwidth is 0.25 Hz."""
    found = searched(view_of(lfilter(*butter(1, 0.002), white(7))), [SpectralShape()])
    assert found.steps == ()
    assert "markov" in found.end.noise.terms
    assert np.log(2.0 * np.pi * 0.05 * found.end.noise.shape) == pytest.approx(0.0, abs=0.5)


def resonance(frequency, quality, seed):
    """A damped oscillator driven by noise, in its steady state."""
    r, turn = np.exp(-np.pi * frequency / quality / RATE), 2.0 * np.cos(2.0 * np.pi * frequency / RATE)
    drive = np.random.default_rng(seed).standard_normal(N + 200_000)
    y = lfilter([1.0], [1.0, -turn * r, r**2], drive)[200_000:]
    return y / y.std()


def test_the_quality_factor_of_a_resonance_is_known():
    found = found_in(white(8) + resonance(5.0, 20.0, 9), "resonance")["quality_factor"]
    assert found.value == pytest.approx(20.0, abs=4.0 * found.std)


def test_a_resonance_narrower_than_a_line_may_be_is_left_to_the_search_for_lines():
    """At 5 Hz in 600 s a quality factor above 1500 is narrower than two lines are apart."""
    view = view_of(white(8) + resonance(5.0, 8000.0, 9))
    assert searched(view, [SpectralShape()]).steps == ()
    step = searched(view, [SpectralShape(), Sinusoid()]).steps[0]
    assert step.candidate.cause == "sinusoid"
    assert step.candidate.parameters["frequency"].value == pytest.approx(5.0, abs=0.002)


@pytest.mark.parametrize(("periods", "limit"), [(2.3, "below"), (5.2, "")])
def test_a_line_of_fewer_periods_than_any_has(periods, limit):
    duration = N / RATE
    x = white(10) + 3.0 * np.sin(2.0 * np.pi * periods / duration * TIME + 0.3)
    found = Sinusoid().detect(view_of(x, ("angle_random_walk",))).parameters
    if limit:
        check(found["frequency"], limit, periods / duration)
        check(found["amplitude"], "above", 3.0)
    else:
        frequency = found["frequency"]
        assert frequency.value == pytest.approx(periods / duration, abs=4.0 * frequency.std)


@pytest.mark.parametrize(("exponent", "limit"), [(-1.5, "below"), (0.5, ""), (3.6, "above")])
def test_an_exponent_beyond_those_that_a_term_may_have(exponent, limit):
    """From −1 to 3."""
    f = np.fft.rfftfreq(4 * N, 1.0 / RATE)
    shape = np.concatenate([[0.0], f[1:] ** (-exponent / 2.0)])
    x = np.fft.irfft(np.fft.rfft(np.random.default_rng(3).standard_normal(4 * N)) * shape)[:N]
    x = x / np.diff(x).std() + 0.01 * white(12)
    found = PowerLaw().detect(view_of(x)).parameters["exponent"]
    if limit:
        check(found, limit, exponent)
    else:
        assert found.value == pytest.approx(exponent, abs=4.0 * found.std)


@pytest.mark.parametrize(("time", "limit"), [(5000.0, "above"), (2.0, "")])
def test_a_correlation_time_longer_than_the_record(time, limit):
    """Of 600 s; times up to 150 s are looked through."""
    step = np.exp(-1.0 / (RATE * time))
    drive = np.random.default_rng(14).standard_normal(N + 10_000)
    process = lfilter([np.sqrt(1.0 - step**2)], [1.0, -step], drive)[10_000:]
    x = (30.0 if limit else 1.0) * process + white(13)
    found = BasicTerm(MARKOV).detect(view_of(x, ("quantization", "angle_random_walk"))).parameters
    if limit:
        check(found["correlation_time"], limit, time)
    else:
        q = found["correlation_time"]
        assert q.value == pytest.approx(time, abs=4.0 * q.std)


@pytest.mark.parametrize(("path", "limit"), [("one jump", "above"), ("always", "below"), ("some", "")])
def test_dwell_times_beyond_those_that_are_compared(path, limit):
    """From four blocks to half of 2048."""
    k = np.arange(2048)
    levels = {"one jump": k > 1500, "always": k // 2 % 2 == 0, "some": k // 60 % 2 == 0}[path]
    found = two_levels(5.0 * levels + 0.5 * np.random.default_rng(15).standard_normal(2048), 0.5)
    assert found.limit == limit
    assert np.isnan(found.log_dwell_std) == bool(limit)
    if limit:
        assert (found.dwell < 1500.0) if limit == "above" else (found.dwell > 2.0)


def test_a_step_at_the_ends_of_the_record_and_one_inside():
    """The likelihood is all at the first place that is looked at; or at that of a finer bank, inside."""
    places, view = np.arange(30.0, N, 30.0), view_of(np.zeros(N))
    likelihood = np.exp(-np.arange(len(places)) / 2.0)
    check(step_parameters(view, places, 1.0, 0.1, likelihood)[0], "below", 0.0)
    check(step_parameters(view, places, 1.0, 0.1, likelihood[::-1])[0], "above", N / RATE)
    inside = np.arange(10_000.0, 10_060.0)
    time = step_parameters(view, inside, 1.0, 0.1, np.exp(-np.arange(60.0) / 2.0))[0]
    assert not side_of_limit(time)


@pytest.mark.parametrize("side", ["start", "end"])
def test_handling_at_an_end_began_before_or_ended_after(side):
    loud = K < 300 if side == "start" else K >= N - 300
    found = Disturbance().detect(view_of(white(11) + np.where(loud, 10.0 * np.sin(K / 40.0), 0.0))).parameters
    other = {"start": "end", "end": "start"}[side]
    assert side_of_limit(found[side]) == {"start": "below", "end": "above"}[side]
    assert "±" not in told(found[side])[0]
    assert found[other].std > 0.0


def test_the_scale_of_outliers_of_which_one_or_only_the_faintest_are_seen():
    assert _log_scale(np.array([90.0]), 5.0)[2] == "above"
    assert _log_scale(np.array([5.2, -5.4, 5.1, 5.6, -5.3]), 5.0)[2] == "below"
    log_scale, std, limit = _log_scale(30.0 * np.random.default_rng(16).standard_normal(40), 5.0)
    assert limit == ""
    assert log_scale == pytest.approx(np.log(30.0), abs=4.0 * std)


@pytest.mark.parametrize(("own", "limit"), [(1e-3, "above"), (0.3, "")])
def test_axes_that_are_the_same_are_correlated_by_more_than_a_limit(own, limit):
    axes = [Axis(name, "gyro", "deg/s") for name in ("gyro_x", "gyro_y")]
    z, other = np.random.default_rng(17).standard_normal((2, 4000))
    (found,) = common_mode(axes, [z, z + own * other], [None, None], RATE, 0.01)
    q = found.parameters["correlation"]
    if limit:
        check(q, limit, 1.0 / np.sqrt(1.0 + own**2))
    else:
        assert q.value == pytest.approx(1.0 / np.sqrt(1.0 + own**2), abs=4.0 * q.std)


# --- Saturation: two levels, two names, one unit ------------------------------------------------------------


@pytest.mark.parametrize("sides", ["upper", "lower", "both"])
def test_levels_of_saturation_have_one_name_each_and_are_told_in_one_unit(sides):
    """In mg levels of 0.02 and 2000 would be told in µg and mg; people look for them as they are recorded."""
    x = 0.01 * white(18)
    top, bottom = 0.012, -0.015
    low, high = (bottom if sides != "upper" else -1.0), (top if sides != "lower" else 1.0)
    view = dataclasses.replace(view_of(np.clip(x, low, high)), axis=Axis("accel_x", "accel", "g"))
    found = Saturation().detect(view).parameters
    levels = {name: q.value for name, q in found.items() if name.endswith("level")}
    expected = {"upper_level": top, "lower_level": bottom}
    assert levels == pytest.approx({k: v for k, v in expected.items() if sides in ("both", k.split("_")[0])})
    for name, q in found.items():
        if name.endswith("level"):
            assert amount(q) == f"{q.value:.4g} g"
