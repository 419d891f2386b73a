"""Small computations of the critic, each against one of its own: trials, held-out gains, errors, words."""

import dataclasses

import numpy as np
import pytest
from critic_views import view_of
from scipy.fft import dct

from allanjax.critic.bank import Scan, any_of
from allanjax.critic.causes import common_mode, disturbance, variance_change
from allanjax.critic.causes.basic_term import _value
from allanjax.critic.causes.power_law import PowerLaw
from allanjax.critic.causes.repeated_samples import RepeatedSamples
from allanjax.critic.causes.rounding import Rounding
from allanjax.critic.causes.telegraph import Telegraph
from allanjax.critic.causes.temperature import Temperature
from allanjax.critic.causes.warm_up import WarmUp
from allanjax.critic.comparison import StageResiduals
from allanjax.critic.finding import Discrepancy, Finding
from allanjax.critic.gain import _mean_squares
from allanjax.critic.merging import merged
from allanjax.critic.noise import family_of
from allanjax.critic.parameters import parameter_estimate
from allanjax.critic.profiles import cross_correlation, psd, windows
from allanjax.critic.result import Snapshot
from allanjax.critic.step import Change
from allanjax.critic.together import mean_of
from allanjax.estimate.spectral.model import FULL
from allanjax.estimate.structure.as_model import markov_of
from allanjax.estimate.structure.structure import FIXED, Structure
from allanjax.record.recording import Axis
from allanjax.report.critique_json import _parameter
from allanjax.report.critique_story import format_remainder
from allanjax.report.critique_summary import _between
from allanjax.report.critique_words import gain_of, significance

N, RATE = 2048, 50.0
WHITE, WALK = "angle_random_walk", "rate_random_walk"
GYRO = Axis("gyro_x", "gyro", "rad/s")
OTHER = Axis("gyro_y", "gyro", "rad/s")


@pytest.fixture(scope="module")
def white():
    return view_of(np.random.default_rng(0).standard_normal(N), (WHITE,))


def estimate(value, std, label="amplitude", axis=GYRO, unit="rad/s", limit=""):
    return parameter_estimate(axis, label, value, std, unit, limit)


def finding(cause="bias_step", axis=GYRO, p_value=1e-6, evidence=10.0, gain=5.0, **parameters):
    return Finding(cause, (axis.name,), parameters, p_value, evidence, gain, (), (0.0, 1.0), "time")


# --- Trials -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("p", "count"), [(0.1, 1), (0.1, 7), (0.02, 40)])
def test_the_smallest_of_independent_p_values(p, count):
    assert any_of(p, count) == pytest.approx(1.0 - (1.0 - p) ** count, rel=1e-12)


def test_the_trials_factor_is_the_largest_likelihood_over_the_mean():
    snr = np.array([0.5, -3.0, 1.0, 2.0])
    likelihood = np.exp(0.5 * snr**2)
    expected = np.log(likelihood.max() / likelihood.mean())
    assert Scan(snr, snr, np.ones(4)).log_trials_factor == pytest.approx(expected, rel=1e-12)


def test_the_best_of_two_channels_is_corrected_for_there_being_two(white, monkeypatch):
    """With a law that is known, whatever the filters: Šidák's of two."""
    from allanjax.critic.bank import Bank

    rng = np.random.default_rng(1)
    channels = {name: np.cumsum(rng.standard_normal(N)) for name in ("one", "two")}
    values = iter([0.3, 0.02])
    monkeypatch.setattr(Bank, "p_value", lambda self, view, noise, snr=None: next(values))
    found = Temperature().p_value(dataclasses.replace(white, auxiliary=channels))
    assert found == pytest.approx(1.0 - 0.98**2, rel=1e-12)


def test_two_kinds_of_noise_are_two_tests():
    """Of kinds that are hardly correlated a large score is by chance twice as often, of the same one once."""
    edges = np.arange(257.0)
    one, same, other = (
        variance_change._Kind("all", 1.0, np.ones(256), worth, edges) for worth in (1.0, 0.9999, 0.01)
    )
    alone, twice, both = (
        variance_change._p_value(8.0, kinds) for kinds in ([one], [one, same], [one, other])
    )
    assert twice == pytest.approx(alone, rel=0.2)
    assert both == pytest.approx(2.0 * alone, rel=0.1)


def test_a_correlation_with_one_of_several_axes_counts_them():
    rng = np.random.default_rng(2)
    v = np.ones(N - 1)
    records = [
        StageResiduals(GYRO, 1.0, RATE, Snapshot(rng.standard_normal(N), v, (), {}, np.nan, 0.0))
        for _ in range(6)
    ]
    others = {f"axis_{k}": r for k, r in enumerate(records[1:])}
    few = {"axis_0": records[1]}
    alone, among = (cross_correlation(records[0], some) for some in (few, others))
    score = float(abs(among.score[0]))
    assert among.law(score) == pytest.approx(1.0 - (1.0 - alone.law(score)) ** 5, rel=1e-9)


# --- Held-out gains -----------------------------------------------------------------------------------------


def test_what_is_not_there_gains_nothing_on_other_data():
    """A level or a correlation that chance shows loses elsewhere on average; in its own data it gains."""
    rng = np.random.default_rng(3)
    loud = [disturbance._held_out(rng.standard_normal(400) ** 2, 100, 300) for _ in range(60)]
    assert np.mean(loud) < 0.0
    linked = [
        common_mode._Link("all", *rng.standard_normal((2, 512)), np.ones(512)).held_out for _ in range(60)
    ]
    assert np.mean(linked) < 0.0


# --- Undoing ------------------------------------------------------------------------------------------------


def test_undoing_a_change_gives_the_view_before(white):
    path, gap = np.linspace(0.0, 1.0, N), np.arange(N) < 10
    known = dataclasses.replace(white, imputed=np.arange(N) >= N - 5)
    after = known.with_samples(known.samples - path, gap).allowing([WHITE, WALK])
    change = Change.of(known, after)
    undone = change.undo(after)
    np.testing.assert_allclose(undone.samples, known.samples, atol=1e-12)
    np.testing.assert_array_equal(undone.imputed, known.imputed)
    assert set(undone.allowed) == {WHITE}
    again = change.apply(known)
    np.testing.assert_allclose(again.samples, after.samples, atol=1e-12)
    np.testing.assert_array_equal(again.imputed, after.imputed)


# --- Levels and errors --------------------------------------------------------------------------------------


def test_the_slope_of_a_fold_is_that_of_least_squares_in_it():
    family, rng = family_of(N, RATE), np.random.default_rng(4)
    ramp = dct((np.arange(N) + 0.5) / RATE, norm="ortho")[1:]
    c, v = rng.standard_normal(N - 1) + 0.01 * ramp, 1.0 + rng.random(N - 1)
    for fold in (None, np.arange(N - 1) % 4 < 2):
        use = np.ones(N - 1, bool) if fold is None else fold
        w = 1.0 / np.sqrt(v[use])
        A = (ramp[use] * w)[:, None]
        expected = np.linalg.lstsq(A, c[use] * w, rcond=None)[0][0]
        assert family.slope(c, v, fold)[0] == pytest.approx(expected, rel=1e-6)
        assert family.slope(c, v, fold)[1] == pytest.approx(1.0 / np.linalg.norm(A), rel=1e-6)


def test_the_coefficient_of_white_noise_is_known_by_its_samples(white):
    value, std = _value(white, white.noise, WHITE)
    # Of n normal variates the deviation has the error σ/√(2n).
    assert value == pytest.approx(white.samples.std() / np.sqrt(RATE), rel=0.01)
    assert std == pytest.approx(value / np.sqrt(2.0 * N), rel=0.02)


def test_one_sided_density_adds_up_to_the_variance():
    x = np.random.default_rng(5).standard_normal(N)
    stage = Snapshot(x, np.ones(N - 1), (WHITE,), {WHITE: 1.0 / RATE}, np.nan, 0.0)
    profile = psd(StageResiduals(GYRO, 1.0, RATE, stage))
    # White noise of variance 1 up to half the rate; the topmost bin has hundreds of coefficients.
    assert profile.measured[-1] == pytest.approx(2.0 / RATE, rel=0.25)


def test_the_mean_square_of_a_ramps_differences():
    m, slope = np.array([1, 4, 16]), 0.3
    assert _mean_squares(slope * np.arange(200.0), m) == pytest.approx(0.5 * (slope * m) ** 2, rel=1e-9)


def test_estimates_that_scatter_have_a_mean_with_a_larger_error():
    each = [estimate(x, 0.1) for x in (1.0, 2.0, 3.0)]
    # Their scatter is 1, of three.
    assert mean_of(each).std == pytest.approx(1.0 / np.sqrt(3.0), rel=1e-9)
    assert mean_of([estimate(x, 0.1) for x in (1.0, 1.01)]).std == pytest.approx(0.1 / np.sqrt(2.0))


def test_a_markov_process_of_a_structure_has_its_power():
    """The spectrum of a component of power p is p at its plateau beside white noise: its variance is p."""
    structure = Structure.plain([FIXED.index(WHITE)]).with_markov(40.0, 2.0)
    term = markov_of(structure, 0, RATE)
    assert term.correlation_time == pytest.approx(40.0 / RATE)
    power = structure.power[FULL.first_markov]
    assert term.amplitude**2 * term.correlation_time / 2.0 == pytest.approx(power, rel=1e-12)


# --- Causes -------------------------------------------------------------------------------------------------


def test_a_warm_up_in_the_model_is_the_one_that_is_told():
    t = np.arange(N) / RATE
    x = 0.1 * np.random.default_rng(6).standard_normal(N) - 2.0 * np.exp(-t / 8.0)
    found = WarmUp().detect(view_of(x, (WHITE,)))
    term = found.add_to_model(view_of(x, (WHITE,)).noise.model()).terms[-1]
    told = found.parameters["amplitude"]
    assert told.value == pytest.approx(-2.0, abs=4.0 * told.std + 0.05)
    assert term.sign * term.amplitude == pytest.approx(told.value, abs=2.0 * told.std)


def test_repeats_by_rounding_are_no_repeated_samples():
    x = np.round(np.random.default_rng(7).standard_normal(N) / 0.5) * 0.5
    assert np.sum(np.diff(x) == 0.0) > 100
    assert RepeatedSamples().detect(view_of(x, (WHITE,))) is None


def test_samples_before_rounding_are_within_half_a_step():
    x = np.round(np.random.default_rng(8).standard_normal(N))
    found = Rounding().detect(view_of(x, (WHITE,)))
    assert np.max(abs(found.after.samples - x)) <= 0.5 + 1e-9


def test_a_random_walk_that_the_model_lacks_is_no_power_law():
    """Terms that were not given are rivals, too."""
    rng = np.random.default_rng(9)
    x = rng.standard_normal(N) + 0.3 * np.cumsum(rng.standard_normal(N))
    found = PowerLaw().detect(view_of(x, (WHITE,)))
    assert found is None or found.gain < 3.0


def test_steps_at_other_times_are_not_one():
    both = [
        finding(
            axis=axis,
            time=estimate(time, 0.05, "time", axis, "s"),
            amplitude=estimate(1.0, 0.1, axis=axis),
        )
        for axis, time in ((GYRO, 100.0), (OTHER, 150.0))
    ]
    assert len(merged(both, (), 1000.0)) == 2


# --- Words --------------------------------------------------------------------------------------------------


def test_a_p_value_is_told_as_one_and_odds_as_odds():
    assert significance(finding()) == "p = 1e-06"
    assert significance(finding(p_value=None, evidence=np.log(50.0))) == "odds 50 : 1"
    assert significance(finding(p_value=None, evidence=None, gain=None)) == "seen in the samples themselves"


def test_what_cannot_be_held_out_has_no_gain():
    assert gain_of(finding(gain=None)) == "gain cannot be held out"
    assert gain_of(finding(gain=12.0)) == "gain 12 nats on held-out data"


def test_a_range_is_that_of_sizes_whatever_their_signs():
    assert _between([estimate(x, 0.1) for x in (-3.0, 0.5, 2.0)]) == "0.5 … -3 rad/s"


def test_limits_are_in_the_json():
    assert _parameter(estimate(1.0, np.nan, limit="above"))["limit"] == "above"
    assert _parameter(estimate(1.0, 0.1))["limit"] is None


def test_what_remains_is_within_where_it_is_not_significant():
    before, fine, wrong = (
        Discrepancy("allan_deviation", 1.0, "s", 1.0, simulated, "rad/s", p)
        for simulated, p in ((0.5, 1e-9), (1.02, 0.3), (1.4, 1e-9))
    )
    assert format_remainder(before, fine) == "within 2 %"
    assert format_remainder(before, wrong) == "40 % high"


def test_the_error_of_a_harmonics_frequency_has_that_of_the_fundamental_so_many_times():
    """Five times 1 ± 0.0005 Hz is 5 ± 0.0025 Hz, from which 5.008 Hz is three deviations away."""
    low, high = (
        finding("sinusoid", axis, frequency=estimate(f, std, "frequency", axis, "Hz"))
        for axis, f, std in ((GYRO, 1.0, 5e-4), (OTHER, 5.008, 1e-6))
    )
    assert len(merged([low, high], (), 1000.0)) == 1
    far = dataclasses.replace(high, parameters={"frequency": estimate(5.012, 1e-6, "frequency", OTHER, "Hz")})
    assert len(merged([low, far], (), 1000.0)) == 2


def test_scores_of_window_means_are_standard_normal():
    """Half of a record without its mean has a mean of variance 1/(2n), not 1/n of half of its samples."""
    rng, v = np.random.default_rng(10), np.ones(N - 1)
    scores = []
    for _ in range(200):
        x = rng.standard_normal(N)
        stage = Snapshot(x - x.mean(), v, (), {}, np.nan, 0.0)
        mean, _ = windows(StageResiduals(GYRO, 1.0, RATE, stage))
        scores.append(mean.score[-2])
    # Of 200 variates of variance 1 the mean square scatters by a tenth.
    assert np.mean(np.square(scores)) == pytest.approx(1.0, abs=0.4)


def test_the_path_of_a_telegraph_costs_what_its_search_gains():
    """In white noise the best path of two levels is much likelier than none, and its odds are still short."""
    rng = np.random.default_rng(11)
    for _ in range(3):
        found = Telegraph().detect(view_of(rng.standard_normal(N), (WHITE,)))
        assert found is None or found.gain < 3.0
