"""What no known effect describes is told by its place, not by a wrong name."""

import functools

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.signal import butter, lfilter, sosfilt

import allanjax as aj

N, RATE = 1 << 16, 100.0
# Three means of five samples, as in a converter.
MEANS = np.convolve(np.convolve(np.ones(5), np.ones(5)), np.ones(5)) / 125.0
T = np.arange(N) / RATE


def unexplained(x):
    """The only finding of a record, which is unexplained."""
    found = aj.critique(x, rate=RATE, gyro_unit="deg/s", names=["gyro_x"])
    (one,) = found.findings
    assert one.cause == "unexplained"
    assert one.rest
    text = found.details()
    assert "unexplained" in text
    assert "None" not in text
    return one


def white(seed):
    return np.random.default_rng(seed).standard_normal(N)


@pytest.mark.parametrize("seed", [1, 2])
def test_a_notch_is_no_low_pass_filter(seed):
    band = (11.0, 14.0)
    one = unexplained(lfilter(*butter(4, band, "bandstop", fs=RATE), white(seed)))
    assert one.details["domain"] == "spectrum"
    # Half a bandwidth at either end, as the notch has slopes.
    assert one.span[0] == pytest.approx(band[0], abs=1.5)
    assert one.span[1] == pytest.approx(band[1], abs=1.5)


def test_shaped_quantization_noise_is_no_low_pass_filter():
    """Of a sigma-delta converter of second order."""
    rng = np.random.default_rng(3)
    x = rng.standard_normal(N) + 0.4 * np.diff(rng.standard_normal(N + 2), 2)
    one = unexplained(x)
    assert one.details["domain"] == "spectrum"
    assert one.details["reason"] == "the spectrum does not fall above its corner"
    assert one.span[1] > 0.45 * RATE


@pytest.mark.parametrize("seed", [4, 5])
def test_a_single_event_is_no_resonance(seed):
    """A positive and a negative half-wave, whose spectrum has a peak."""
    u = (T - 300.0) / 30.0
    one = unexplained(white(seed) + 2.0 * u * np.exp(-(u**2)))
    assert one.details["domain"] == "bias"
    # Nearly all of it is within two lengths of its middle.
    assert 240.0 - 30.0 < one.span[0] < 300.0 < one.span[1] < 360.0 + 30.0


def test_a_filter_after_quantization_is_described_although_the_spectrum_does_not_fall():
    """The quantization noise must stay before the filter when everything is refitted."""
    quantized = white(8) + 1.43 * np.diff(white(9), prepend=0.0)
    one = unexplained(lfilter([0.75], [1.0, -0.25], quantized))
    assert one.details["resembles"] == ("low_pass",)
    # The best spectrum of white and quantization noise without a filter, by the expected likelihood ratio.
    f = (np.arange(N) + 0.5) / N
    sine = 4.0 * np.sin(np.pi * f / 2.0) ** 2
    true = (1.0 + 1.43**2 * sine) * 0.75**2 / (0.75**2 + 0.25 * sine)
    loss = minimize(lambda p: np.sum(np.log(m := np.exp(p[0]) + np.exp(p[1]) * sine) + true / m), [0.0, 0.0])
    worth = 0.5 * (loss.fun - np.sum(np.log(true) + 1.0))
    # Its standard deviation is about √(2·worth).
    assert one.gain == pytest.approx(worth, abs=3.0 * np.sqrt(2.0 * worth))


def test_noise_whose_level_breathes_has_no_changes_of_variance():
    level = np.exp(0.15 * np.sin(2.0 * np.pi * 5.3 * T / T[-1]))
    one = unexplained(level * white(4))
    assert one.details["domain"] == "level"
    assert one.details["resembles"] == ("variance_change",)
    assert one.span[1] - one.span[0] > 0.7 * T[-1]
    # Simulations have the same level everywhere: at most e^0.15 too much or too little.
    measured = one.parameters["measured"].value
    assert 0.03 < abs(np.log(measured)) < 2.0 * 0.15


def test_skewed_values_are_no_outliers():
    x = white(5)
    one = unexplained(x + 0.08 * x**2)
    assert one.details["domain"] == "values"
    # The skewness of x + a·x² is 6a + 8a³ over (1 + 2a²)^1.5, within three standard errors √(6/N).
    theory = (6 * 0.08 + 8 * 0.08**3) / (1 + 2 * 0.08**2) ** 1.5
    assert one.parameters["measured"].value == pytest.approx(theory, abs=3.0 * np.sqrt(6.0 / N) + 0.02)


def test_what_has_no_place_of_its_own_is_in_the_whole_record():
    x = white(5)
    one = unexplained(x + 0.03 * x**2)
    assert (one.details["domain"], "resembles" in one.details) == ("values", False)
    assert one.span == pytest.approx((0.0, N / RATE))


def test_a_slow_transition_is_no_step_and_no_random_walk():
    start, end, height = 250.0, 340.0, 0.2
    found = aj.critique(
        white(6) + height * np.clip((T - start) / (end - start), 0.0, 1.0), rate=RATE, gyro_unit="deg/s"
    )
    (one,) = found.findings
    assert (one.cause, one.details["domain"]) == ("unexplained", "bias")
    # Lengths that are compared differ by a factor of two, so that each end may be off by a quarter, and noise
    # adds to that.
    assert one.span[0] == pytest.approx(start, abs=0.5 * (end - start))
    assert one.span[1] == pytest.approx(end, abs=0.5 * (end - start))
    assert one.parameters["amplitude"].value == pytest.approx(height, rel=0.1)
    # The extended model has white noise alone: of 1 deg/s at 100 Hz, known to 1/√(2N).
    (model,) = found.models.values()
    assert set(model.term_labels) == {"angle_random_walk"}
    assert np.rad2deg(model["angle_random_walk"].coefficient) == pytest.approx(0.1, rel=0.02)


def test_a_periodic_square_wave_is_no_random_telegraph():
    wave = np.sign(np.sin(2.0 * np.pi * T / 41.0))
    found = aj.critique(white(7) + 0.15 * wave, rate=RATE, gyro_unit="deg/s", names=["gyro_x"])
    assert "telegraph" not in [f.cause for f in found.findings]


@pytest.mark.parametrize(
    ("cause", "make"),
    [
        ("low_pass", lambda x: lfilter([0.4], [1.0, -0.6], x)),
        *(
            ("low_pass", functools.partial(sosfilt, butter(order, f, fs=RATE, output="sos")))
            for order, f in ((2, 30.0), (6, 17.5), (8, 35.0))
        ),
        ("low_pass", lambda x: lfilter(MEANS, 1.0, x)),
        ("bias_step", lambda x: x + 0.15 * (T > 301.7)),
        ("variance_change", lambda x: x * np.where((T > 100.0) & (T < 300.0), 1.2, 1.0)),
        ("outliers", lambda x: x + 8.0 * (np.arange(N) % 6553 == 99)),
        ("sinusoid", lambda x: x + 0.1 * np.sin(2.0 * np.pi * 7.3 * T)),
    ],
)
def test_what_is_known_keeps_its_name(cause, make):
    found = aj.critique(make(white(8)), rate=RATE, gyro_unit="deg/s", names=["gyro_x"])
    assert [f.cause for f in found.findings] == [cause]


def test_a_strong_step_in_noise_of_short_correlation_is_a_step():
    """Whitened, it is in a few samples; if all of them are held out, nothing is left to predict it from."""
    n, rate = 30_000, 50.0
    rng = np.random.default_rng(7)
    decay = np.exp(-1.0 / (4.4 * rate))
    markov = lfilter([np.sqrt(1.0 - decay**2)], [1.0, -decay], rng.standard_normal(n + 5000))[5000:]
    x = rng.standard_normal(n) + 0.7 * markov + 6.0 * (np.arange(n) > 18_070)
    found = aj.critique(x, rate=rate, gyro_unit="deg/s", names=["gyro_x"])
    assert [f.cause for f in found.findings] == ["bias_step"]
    assert found.findings[0].parameters["amplitude"].value == pytest.approx(6.0, rel=0.1)


def test_a_telegraph_is_followed_to_the_end_of_the_record():
    n, rate = 30_000, 50.0
    jumps = np.array([41.0, 102.0, 167.0, 213.0, 247.0, 339.0, 453.0, 486.0, 548.0, 579.0, 593.0])
    path = np.searchsorted(jumps, np.arange(n) / rate) % 2
    x = np.random.default_rng(8).standard_normal(n) + 0.4 * path
    found = aj.critique(x, rate=rate, gyro_unit="deg/s", names=["gyro_x"])
    assert [f.cause for f in found.findings] == ["telegraph"]
    assert found.findings[0].parameters["jumps"].value == len(jumps)


@pytest.mark.parametrize("step", [0.1, 0.2, 0.3])
def test_harmless_rounding_is_nothing(step):
    """A resolution below a third of the deviation adds less than 1 % to the variance: Sheppard's step²/12."""
    found = aj.critique(np.rint(white(9) / step) * step, rate=RATE, gyro_unit="deg/s", names=["gyro_x"])
    assert found.findings == ()


@pytest.mark.parametrize("step", [0.2, 1.0])
def test_rounding_behind_a_steep_filter_is_compared_with_the_samples(step):
    """The stop band is far below any rounding, which is harmless all the same where it is in white noise."""
    x = sosfilt(butter(6, 17.5, fs=RATE, output="sos"), white(11))
    step *= x.std()
    found = aj.critique(np.rint(x / step) * step, rate=RATE, gyro_unit="deg/s", names=["gyro_x"])
    assert {f.cause for f in found.findings} == {"low_pass", *["rounding"] * int(step == x.std())}
    # A twentieth is some four standard errors of it, fitted with white noise of a twelfth of the variance.
    (low_pass,) = (f for f in found.findings if f.cause == "low_pass")
    assert low_pass.parameters["bandwidth"].value == pytest.approx(17.5, rel=0.05)
    assert low_pass.parameters["order"].value in (5, 6, 7)


# Two means of four samples, which halve the power at 8.21 Hz.
TWO_MEANS = np.convolve(np.ones(4), np.ones(4)) / 16.0


@pytest.mark.parametrize(
    ("coefficients", "bandwidth", "step"),
    [
        pytest.param((TWO_MEANS, [1.0]), 8.21, 0.0, id="two means of four samples"),
        pytest.param(butter(3, 27.0, fs=RATE), 27.0, 0.2, id="third order, fine steps"),
        pytest.param(butter(3, 27.0, fs=RATE), 27.0, 1.0, id="third order, coarse steps"),
    ],
)
def test_a_filter_leaves_nothing_unexplained(coefficients, bandwidth, step):
    """Around the zeros of a mean, and where errors of rounding are most of the spectrum."""
    x = lfilter(*coefficients, white(21))
    step *= x.std()
    found = aj.critique(
        np.rint(x / step) * step if step else x, rate=RATE, gyro_unit="deg/s", names=["gyro_x"]
    )
    causes = {f.cause: f for f in found.findings}
    assert len(found.findings) == len(causes)
    assert causes.keys() == {"low_pass", *["rounding"] * int(step == x.std())}
    assert causes["low_pass"].parameters["bandwidth"].value == pytest.approx(bandwidth, rel=0.02)


def test_a_steep_filter_of_two_axes_neither_moves_nor_drifts():
    """Both told once, with the bandwidth; before, one had a disturbance of 60,000 nats."""
    x = sosfilt(butter(6, 35.0, fs=RATE, output="sos"), [white(12), white(13)]).T
    found = aj.critique(x, rate=RATE, gyro_unit="deg/s", names=["gyro_x", "gyro_y"])
    (one,) = found.findings
    assert (one.cause, one.axes) == ("low_pass", ("gyro_x", "gyro_y"))
    for axis in found.results:
        assert min(d.p_value for d in axis.after) > 1e-4


def test_shocks_that_decay_are_no_telegraph():
    """The levels of a telegraph stay until the next jump."""
    shocks = np.zeros(N)
    shocks[[int(t * RATE) for t in (41.0, 102.0, 167.0, 247.0, 339.0, 453.0, 548.0)]] = 0.8
    found = aj.critique(
        white(10) + lfilter([1.0], [1.0, -np.exp(-1.0 / (20.0 * RATE))], shocks), rate=RATE, gyro_unit="deg/s"
    )
    causes = [f.cause for f in found.findings]
    assert "unexplained" in causes
    assert "telegraph" not in causes


def test_a_level_that_is_raised_in_many_short_bursts_has_no_outliers():
    rng, level = np.random.default_rng(11), np.ones(N)
    for start in rng.integers(0, N - 200, 25):
        level[start : start + 200] = 2.0
    found = aj.critique(level * white(12), rate=RATE, gyro_unit="deg/s")
    assert {f.cause for f in found.findings} == {"unexplained"}
    (levels,) = [f for f in found.findings if f.details["domain"] == "level"]
    assert levels.span[1] - levels.span[0] > 0.7 * T[-1]


def test_large_values_that_come_in_groups_are_no_outliers():
    """A shocked oscillator rings down, in several samples each time."""
    shocks = np.zeros(N)
    shocks[np.random.default_rng(13).integers(0, N, 20)] = 7.0
    pole = np.exp(2.0 * np.pi * 17.0 / RATE * (1j - 0.5 / 20.0))
    ringing = lfilter([1.0], [1.0, -2.0 * pole.real, abs(pole) ** 2], shocks)
    found = aj.critique(white(14) + ringing, rate=RATE, gyro_unit="deg/s")
    assert "outliers" not in [f.cause for f in found.findings]


def test_a_power_law_beside_a_larger_change_of_the_bias_is_a_part_of_it():
    """What drifts in an unknown way has a spectrum that falls with some power."""
    u = (T - 330.0) / 15.0
    found = aj.critique(white(15) + 0.6 * np.exp(-0.5 * u**2), rate=RATE, gyro_unit="deg/s")
    assert {f.cause for f in found.findings} == {"unexplained"}


def test_a_slope_that_begins_within_the_record_is_no_warm_up():
    found = aj.critique(white(16) + 0.01 * np.maximum(T - 400.0, 0.0), rate=RATE, gyro_unit="deg/s")
    (one,) = found.findings
    assert (one.cause, one.details["domain"]) == ("unexplained", "bias")


def test_what_is_unexplained_on_several_axes_at_one_place_is_one_finding():
    sos = butter(4, (11.0, 14.0), "bandstop", fs=RATE, output="sos")
    x = np.column_stack([sosfilt(sos, white(seed)) for seed in (17, 18)])
    found = aj.critique(x, rate=RATE, gyro_unit="deg/s", names=["gyro_x", "gyro_y"])
    (one,) = found.findings
    assert (one.cause, one.axes, one.details["domain"]) == ("unexplained", ("gyro_x", "gyro_y"), "spectrum")
    assert one.gain == pytest.approx(sum(f.gain for axis in found.values() for f in axis.findings))
    assert f"in {one.shown}, simulated PSD" in " ".join(found.details().split())


@pytest.mark.parametrize("step", [3.5, 8.0])
def test_rounding_far_coarser_than_the_noise_is_rounding_alone(step):
    """Two or three values occur."""
    found = aj.critique(
        np.rint(white(19) / step + 0.3) * step, rate=RATE, gyro_unit="deg/s", names=["gyro_x"]
    )
    assert [f.cause for f in found.findings] == ["rounding"]
