"""The critic's tools, each against a computation of another kind: dense matrices, simulation, enumeration."""

import dataclasses
import itertools
import types

import numpy as np
import pytest
from dense_records import POWERS, RATE, N, covariances, dense, simulated, view_of
from scipy.fft import dct
from scipy.stats import kstest, norm

from allanjax.critic.bank import Bank, extrapolated, step_coefficients
from allanjax.critic.causes.bias_step import BiasStep
from allanjax.critic.causes.common_mode import _error, _Link, common_mode
from allanjax.critic.causes.imputation import draw_between
from allanjax.critic.causes.saturation import Saturation
from allanjax.critic.causes.sinusoid import refined
from allanjax.critic.causes.telegraph import Telegraph, _chain, _noise, two_levels
from allanjax.critic.gain import coefficient_changes, drift_changes
from allanjax.critic.gap_filling import impute_gaussian
from allanjax.critic.noise import FIXED, MARKOV, Noise, NoiseFamily, centred, family_of
from allanjax.critic.step import Step
from allanjax.critic.view import Candidate, View
from allanjax.estimate.spectral.components import BUTTERWORTH_2
from allanjax.estimate.structure.structure import Structure
from allanjax.inspection.levels import lattice
from allanjax.record.recording import Axis
from allanjax.record.units import UnitError

# --- Parameters of findings ---------------------------------------------------------------------------------


def test_parameters_of_findings_are_estimates_as_those_of_a_fit():
    axis = Axis("gyro_x", "gyro", "deg/s")
    view = dataclasses.replace(view_of(np.zeros(N)), axis=axis, scale=np.pi / 180.0)
    slope = view.amplitude_estimate("coefficient", np.pi / 180.0, 0.1 * np.pi / 180.0, "/[temperature]")
    assert slope.source == "critique"
    assert (slope.value, slope.std) == pytest.approx((1.0, 0.1))
    assert slope.interval == pytest.approx(norm.interval(0.95, 1.0, 0.1))
    assert slope.interval_68 == pytest.approx((0.9, 1.1))
    hourly = slope.in_unit("deg/h/[temperature]")
    assert (hourly.value, hourly.std, hourly.unit) == pytest.approx((3600.0, 360.0, "deg/h/[temperature]"))
    assert hourly.describe() == "3,600 ± 360 deg/h/[temperature] (95 %: 2,890 … 4,310)"
    assert slope.in_unit() == hourly.in_unit() == slope
    assert slope.si_unit == "rad/s/[temperature]"
    assert str(slope).startswith("gyro_x coefficient: 1.00 ± 0.10 deg/s/[temperature] (95 %: 0.80 … 1.20)")
    for other in ("deg/h", "deg/h/[pressure]", "m/s²/[temperature]"):
        with pytest.raises(UnitError):
            slope.in_unit(other)
    # Known by its logarithm: e times as long is as far off as e times as short.
    time = view.log_estimate("time_constant", np.log(50.0), 0.5, "", "s")
    assert np.log(time.interval) == pytest.approx(norm.interval(0.95, np.log(50.0), 0.5))
    assert (time.value, time.std) == pytest.approx((50.0, 25.0))
    assert time.in_unit("min").interval[1] == pytest.approx(50.0 * np.exp(0.98) / 60.0, rel=1e-3)
    # What is counted, and what is only known to be beyond.
    assert str(view.estimate("longest", 29, 0.0, "samples")) == "gyro_x longest: 29 samples"
    end = view.time_estimate("end", N - 1, 5.0)
    assert (end.upper_limit, end.lower_limit) == (None, end.value)
    assert str(end) == f"gyro_x end: above {(N - 1 - 5.0 * 1.645) / RATE:.3g} s (95 %)"
    assert end.in_unit("min").lower_limit == pytest.approx(end.value / 60.0)


# --- Noise --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [*FIXED, MARKOV])
def test_expected_squares_are_those_of_the_dense_covariance(name):
    family = NoiseFamily(N, RATE)
    index = 6
    C = covariances(N, family.times[index])[name]
    D = dct(np.eye(N), norm="ortho", axis=0)[1:]
    ratio = family.expected({name: 1.0}, index) / np.einsum("ij,jk,ik->i", D, C, D)
    assert ratio[:64] == pytest.approx(1.0, abs=1e-4)
    # Above, the density: what the record's ends add is left out, most for quantization.
    assert ratio[64:] == pytest.approx(1.0, abs=0.05)


# --- Matched filters ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("ramp", [False, True])
def test_the_bank_is_generalized_least_squares(ramp):
    """Offset, and ramp if there is one, estimated with each shape's amplitude."""
    rng = np.random.default_rng(3)
    x = simulated(N, 1, rng)[0] + 0.05 * np.arange(N)
    places = np.array([10, 50, 64, 100])
    noise = Noise(POWERS, float("nan"), ramp, 0.0, family_of(N, RATE), -1)
    scan = Bank(step_coefficients(places, N, N - 1)).scan(view_of(x), noise)
    inverse = np.linalg.inv(dense(N) + 1e3 * np.ones((N, N)))
    nuisance = [np.ones(N), np.arange(N) / N][: 1 + ramp]
    for k, place in enumerate(places):
        H = np.column_stack([np.arange(N) >= place, *nuisance]).astype(float)
        covariance = np.linalg.inv(H.T @ inverse @ H)
        amplitude = (covariance @ H.T @ inverse @ x)[0]
        std = np.sqrt(covariance[0, 0])
        # The cosine basis is not quite that of means of a random walk.
        assert scan.std[k] == pytest.approx(std, rel=2e-3)
        assert scan.amplitude[k] == pytest.approx(amplitude, abs=0.02 * std)
        assert scan.snr[k] == pytest.approx(amplitude / std, abs=0.02)


def test_the_law_of_the_largest_of_many_filters():
    """Of a smooth process, by so many draws that the tail is seen; of independent ones, exactly."""
    rng = np.random.default_rng(4)
    kernel = np.exp(-0.5 * (np.arange(-20, 21) / 5.0) ** 2)
    kernel /= np.linalg.norm(kernel)
    many = np.concatenate(
        [
            abs(np.apply_along_axis(np.convolve, 1, rng.standard_normal((2000, 340)), kernel, "valid")).max(1)
            for _ in range(20)
        ]
    )
    found = [[extrapolated(many[i : i + 400], u) for u in (2.5, 3.5, 4.2)] for i in range(0, len(many), 400)]
    for p, u in zip(np.median(found, axis=0), (2.5, 3.5, 4.2), strict=True):
        assert p == pytest.approx(np.mean(many > u), rel=0.25), u
    for count in (20, 500):
        largest = abs(rng.standard_normal((25, 400, count))).max(axis=2)
        for u in (4.0, 6.0):
            p = np.exp(np.median([np.log(extrapolated(draws, u)) for draws in largest]))
            assert p == pytest.approx(-np.expm1(count * np.log1p(-2.0 * norm.sf(u))), rel=0.5), (count, u)


# --- Samples drawn anew -------------------------------------------------------------------------------------


class Known(View):
    """A view whose noise is known."""

    def variance(self, noise=None):
        return self.family.expected(POWERS, -1)


def test_filled_samples_have_the_conditional_law(monkeypatch):
    rng = np.random.default_rng(5)
    x = simulated(N, 1, rng)[0]
    missing = np.zeros(N, bool)
    missing[[0, 20, 21, 22, 70, 127]] = True
    view = view_of(np.where(missing, 50.0, x), kind=Known)
    # Every draw of a record takes the same seed otherwise.
    monkeypatch.setattr(np.random, "default_rng", lambda seed=None: rng)
    draws = np.array([impute_gaussian(view, missing).samples for _ in range(1500)])
    assert np.all(draws[:, ~missing] == x[~missing])
    C = dense(N) + 1e6 * np.ones((N, N))  # of any offset
    weights = np.linalg.solve(C[np.ix_(~missing, ~missing)], C[np.ix_(~missing, missing)]).T
    mean = weights @ x[~missing]
    covariance = C[np.ix_(missing, missing)] - weights @ C[np.ix_(~missing, missing)]
    root = np.linalg.cholesky(covariance)
    z = np.linalg.solve(root, (draws[:, missing] - mean).T)
    assert np.mean(z, axis=1) == pytest.approx(0.0, abs=4.0 / np.sqrt(1500))
    assert np.cov(z) == pytest.approx(np.eye(len(z)), abs=4.0 * np.sqrt(2.0 / 1500))
    assert impute_gaussian(view, missing).imputed.tolist() == missing.tolist()


@pytest.mark.parametrize("step", [0.5, 2.0, 3.0])
def test_rounded_samples_get_their_variance_back(step):
    rng = np.random.default_rng(6)
    n = 20_000
    slow = 2.0 * np.sin(2.0 * np.pi * np.arange(n) / n)
    rounded = step * np.round((slow + rng.standard_normal(n)) / step)
    y, sigma = draw_between(rounded, rounded - step / 2.0, rounded + step / 2.0, 1)
    assert np.max(abs(y - rounded)) <= step / 2.0
    assert sigma == pytest.approx(1.0, abs=0.03)
    assert np.std(y - slow) == pytest.approx(1.0, abs=0.03)
    assert kstest(y - slow, "norm").statistic < 0.02


def test_clipped_samples_get_their_variance_back():
    rng = np.random.default_rng(7)
    x = rng.standard_normal(20_000)
    clipped = np.minimum(x, 0.8)
    y, sigma = draw_between(clipped, clipped, np.where(clipped == 0.8, 1e3, clipped), 1)
    assert np.all(y[x < 0.8] == x[x < 0.8])
    assert sigma == pytest.approx(1.0, abs=0.02)
    assert kstest(y, "norm").statistic < 0.015


@pytest.mark.parametrize("limits", [(-0.8, np.inf), (-np.inf, 1.1), (-0.8, 1.1)])
def test_what_was_clipped_is_restored_beyond_its_limit(limits):
    """Below as above, with the standard deviation that was there, within five per cent (4σ of 4,000)."""
    x = np.random.default_rng(23).standard_normal(4000)
    lower, upper = limits
    clipped = np.clip(x, lower, upper)
    found = Saturation().detect(view_of(clipped))
    assert found is not None
    restored = found.after.samples
    assert np.all(restored[x < lower] <= lower)
    assert np.all(restored[x > upper] >= upper)
    np.testing.assert_array_equal(restored[clipped == x], x[clipped == x])
    assert restored.std() == pytest.approx(x.std(), rel=0.05)
    levels = dict(zip(("lower_level", "upper_level"), limits, strict=True))
    told = {name: q.value for name, q in found.parameters.items() if name in levels}
    assert told == {name: level for name, level in levels.items() if np.isfinite(level)}


@pytest.mark.parametrize(("step", "bias"), [(1.0, 0.0), (0.01, 9.8), (7.3e-6, -3e-3), (1.0 / 32768.0, 1e3)])
def test_the_step_of_a_lattice(step, bias):
    rng = np.random.default_rng(8)
    k = np.round(3.0 * rng.standard_normal(5000))
    assert lattice(bias + step * k) == pytest.approx(step, rel=1e-3)
    assert lattice(bias + step * 2.0 * k) == pytest.approx(2.0 * step, rel=1e-3)
    assert lattice(bias + step * rng.standard_normal(5000)) is None


# --- Two levels ---------------------------------------------------------------------------------------------


def test_a_chain_of_two_states_is_summed_over_all_paths():
    """Likelihood and probability of the second state, against the sum over 2⁹ paths; also where one block
    rules a state out and others say nothing."""
    rng = np.random.default_rng(9)
    log_likelihood = -rng.exponential(2.0, (9, 2))
    log_likelihood[3] = -800.0, 0.0
    log_likelihood[6:8] = 0.0
    dwells = np.array([0.7, 3.0, 40.0])
    total, upper = _chain(log_likelihood[None], dwells)
    paths = np.array(list(itertools.product((0, 1), repeat=9)))
    for k, dwell in enumerate(dwells):
        # A chain in continuous time has changed its state after one block with this probability.
        changed = 0.5 * (1.0 - np.exp(-2.0 / dwell))
        jumps = np.sum(np.diff(paths, axis=1) != 0, axis=1)
        weight = 0.5 * changed**jumps * (1.0 - changed) ** (8 - jumps)
        weight *= np.exp(log_likelihood[np.arange(9), paths].sum(axis=1))
        assert total[k] == pytest.approx(np.log(weight.sum()), rel=1e-12)
        np.testing.assert_allclose(upper[k], weight @ paths / weight.sum(), rtol=1e-10, atol=1e-300)


def test_two_levels_are_found_in_noise():
    rng = np.random.default_rng(10)
    truth = np.searchsorted(np.array([300, 700, 800, 1500]), np.arange(2048), side="right") % 2
    found = two_levels(5.0 + 1.5 * truth + rng.standard_normal(2048), 1.0)
    assert np.mean((found.upper > 0.5) == truth) > 0.995
    # Four jumps in 2048 blocks: the mean time between them, 410, may be half the record: the search's end.
    assert found.limit == "above"
    assert np.isnan(found.log_dwell_std)
    assert 100.0 < found.dwell < 410.0
    # Twenty: it is known to a factor of about 1 + 1/√20.
    jumps = np.cumsum(rng.exponential(100.0, 20)).astype(int)
    truth = np.searchsorted(jumps[jumps < 2048], np.arange(2048), side="right") % 2
    found = two_levels(5.0 + 1.5 * truth + rng.standard_normal(2048), 1.0)
    assert found.limit == ""
    assert abs(np.log(found.dwell / 100.0)) < 3.0 * found.log_dwell_std
    assert 0.1 < found.log_dwell_std < 0.5


def test_a_telegraph_has_the_levels_that_it_jumps_between():
    rng = np.random.default_rng(10)
    truth = np.searchsorted(np.array([300, 700, 800, 1500]) * 8, np.arange(2048 * 8), side="right") % 2
    x = 5.0 + 0.8 * truth + 3.0 * rng.standard_normal(len(truth))
    assert _noise(x.reshape(-1, 8).mean(axis=1)) == pytest.approx(3.0 / np.sqrt(8.0), rel=0.1)
    found = Telegraph().detect(view_of(x))
    assert found is not None
    amplitude = found.parameters["amplitude"]
    assert abs(amplitude.value - 0.8) < 3.0 * amplitude.std
    # White noise of 16,384 samples, of which 1,100 · 8 are on one level: 2 · 3/√n; and a little more, since
    # the record does not rule out that the noise drifts.
    assert 0.98 < amplitude.std / (2.0 * 3.0 / np.sqrt(len(truth))) < 1.25
    assert found.parameters["jumps"].value == 4.0
    assert found.held_out() > 0.0


def test_two_levels_of_some_blocks_bridge_the_others():
    rng = np.random.default_rng(10)
    truth = np.searchsorted(np.array([300, 700, 800, 1500]), np.arange(2048), side="right") % 2
    known = rng.random(2048) < 0.8
    means = np.where(known, 1.5 * truth + rng.standard_normal(2048), 1e3)
    assert np.mean((two_levels(means, 1.0, known).upper > 0.5) == truth) > 0.99


def test_the_likelihood_ratio_of_two_levels_is_a_fair_bet_in_noise():
    """Summed over paths and dwell times, two levels that are fixed gain nothing on average: E[ratio] = 1.

    Levels half a deviation apart, 400 records of 64 blocks: the ratio's mean is within 4 standard errors.
    """
    rng = np.random.default_rng(11)
    dwells = np.geomspace(4.0, 32.0, 5)
    ratios = []
    for _ in range(400):
        y = rng.standard_normal((64, 1))
        total, _ = _chain(-0.5 * (y[None] - np.array([0.0, 0.5])) ** 2, dwells)
        ratios.append(np.exp(total + 0.5 * np.sum(y**2)).mean())
    assert np.mean(ratios) == pytest.approx(1.0, abs=4.0 * np.std(ratios) / np.sqrt(400))


# --- Shared noise -------------------------------------------------------------------------------------------


def test_the_p_value_of_a_correlation():
    rng = np.random.default_rng(11)
    k = 64
    a, b = rng.standard_normal((2, 20_000, k))
    share = np.ones(k)
    a, b = (x / np.sqrt(np.mean(x**2, axis=1, keepdims=True)) for x in (a, b))
    p = [_Link("all", *pair, share).p_value for pair in zip(a, b, strict=True)]
    assert kstest(p, "uniform").pvalue > 1e-3


def test_shared_noise_is_found_as_often_as_said_where_there_is_none():
    rng = np.random.default_rng(12)
    axes, alpha = [Axis(name, "gyro", "rad/s") for name in "xyz"], 0.1
    white = [np.linspace(0.2, 1.0, 1023)] * 3
    alarms = [
        bool(common_mode(axes, list(rng.standard_normal((3, 1023))), white, RATE, alpha)) for _ in range(400)
    ]
    # Nested bands are not independent, and what is found must hold on held-out data too.
    assert np.mean(alarms) < alpha + 3.0 * np.sqrt(alpha / 400)
    shared = rng.standard_normal(1023)
    z = 0.5 * rng.standard_normal((3, 1023)) + [[1.0], [0.0], [-1.0]] * shared
    (finding,) = common_mode(axes, list(z), [None] * 3, RATE, 1e-3)
    assert finding.axes == ("x", "z")
    assert finding.parameters["correlation"].value == pytest.approx(0.8, abs=0.05)


@pytest.mark.parametrize("r", [0.1, 0.5, 0.8])
def test_the_error_of_a_mean_correlation_is_olkin_and_siotanis(r):
    """Of three axes that share all: 1/3 of the variance of a correlation, 2/3 of the covariance of two."""
    k = 500
    link = types.SimpleNamespace(share=np.ones(k), top=k)
    own = (1.0 - r**2) ** 2
    common = r * (1.0 - 2.0 * r**2) - 0.5 * r**2 * (1.0 - 3.0 * r**2)
    assert _error(r, [link] * 3) ** 2 == pytest.approx((own / 3.0 + 2.0 / 3.0 * common) / k, rel=1e-12)


@pytest.mark.parametrize(
    ("r", "signs"), [(0.25, (1.0, 1.0)), (0.2, (-1.0, 1.0, 1.0)), (0.5, (1.0, 1.0, 1.0))]
)
def test_shared_white_noise_beside_noise_that_is_not_shared(r, signs):
    """The correlation is the white noise's, whatever else the axes have; it scatters by its deviation."""
    rng = np.random.default_rng(13)
    k, trials = 8191, 100
    white = 1.0 / (1.0 + np.linspace(0.0, 3.0, k) ** 2)
    axes = [Axis(f"{i}", "gyro", "rad/s") for i in range(len(signs))]
    errors = []
    for _ in range(trials):
        common = rng.standard_normal(k) * np.array(signs)[:, None]
        own = rng.standard_normal((2, len(signs), k))
        z = np.sqrt(white) * (np.sqrt(r) * common + np.sqrt(1.0 - r) * own[0]) + np.sqrt(1.0 - white) * own[1]
        (finding,) = common_mode(axes, list(z), [white] * len(signs), RATE, 1e-3)
        assert finding.details["noise"] == "white"
        found = finding.parameters["correlation"]
        errors.append((found.value - r) / found.std)
    # Four standard errors of a mean and of a standard deviation of 100 values.
    assert abs(np.mean(errors)) < 4.0 / np.sqrt(trials)
    assert np.std(errors) == pytest.approx(1.0, abs=4.0 / np.sqrt(2.0 * trials))


# --- Drift --------------------------------------------------------------------------------------------------


def test_drift_and_coefficients_are_those_of_simulations():
    """A line is found in noise of which the levels are estimated; drift by definition, sums of the rate."""
    rng = np.random.default_rng(13)
    n = 4096
    noise, *more = simulated(n, 40, rng)
    line = 8.0 * np.sin(2.0 * np.pi * 0.02 * np.arange(n) / RATE)
    before = view_of(noise + line)
    after = view_of(noise)
    candidate = Candidate("sinusoid", {}, 1.0, 0.0, after, lambda: 1.0, (0.0, 1.0), "frequency")
    step = Step(candidate, 1.0, (), before)
    # Of 4096 samples the white noise is known to a per cent or two: in m/s/√h, 60 times its SI value.
    walk = next(c for c in coefficient_changes(step) if c.label == "angle_random_walk")
    assert walk.unit == "m/s/√h"
    assert walk.after == pytest.approx(60.0 * np.sqrt(POWERS["angle_random_walk"]), rel=0.1)
    (change,) = drift_changes([step])
    assert change is not None
    m = int(np.rint(change.horizon * RATE))

    def drift(x):
        total = np.convolve(x, np.ones(m), "valid") / RATE
        return total[m:] - total[:-m]

    halves = np.split(noise + line, 2)
    assert change.measured == pytest.approx(np.sqrt(np.mean([drift(h) ** 2 for h in halves])), rel=1e-6)
    # The line's drift, and the noise's in records of the same sensor.
    expected = np.mean([drift(x) ** 2 for x in more]) + np.mean([drift(h) ** 2 for h in np.split(line, 2)])
    assert change.after == pytest.approx(np.sqrt(expected), rel=0.15)
    assert abs(np.log(change.after / change.measured)) < abs(np.log(change.before / change.measured))


def test_views_keep_what_they_are_made_of():
    view = view_of(np.random.default_rng(14).standard_normal(N))
    structure = Structure.plain([1]).using(1, 2.0).with_response(BUTTERWORTH_2, 2.0 * np.pi * 0.2)
    filtered = dataclasses.replace(view, base=np.full(N - 1, 0.5)).with_structure(structure)
    power = 1.0 / (1.0 + (np.tan(np.pi * np.arange(1, N) / (2.0 * N)) / np.tan(0.2 * np.pi)) ** 4)
    # Deep in the stop band the record's ends are allowed for.
    passed = power > 0.02
    assert filtered.factor[passed] == pytest.approx(0.5 * power[passed])
    assert filtered.with_structure(None).factor == pytest.approx(np.full(N - 1, 0.5))
    assert view.recoloured(view.whitened) == pytest.approx(view.samples, abs=1e-9)
    assert dataclasses.replace(view, found=("sinusoid",)).found == ("sinusoid",)


# --- Errors that are told -----------------------------------------------------------------------------------


def test_a_lines_errors_are_those_of_many_records():
    """Of 100 records of a line in white noise; four standard errors of a standard deviation are 28 %."""
    n, rate, f, a, z = 2000, 10.0, 1.234, 0.25, []
    rng = np.random.default_rng(21)
    for _ in range(100):
        phase = 2.0 * np.pi * (f * (np.arange(n) + 0.5) / rate + rng.uniform())
        c = centred(a * np.cos(phase) + rng.standard_normal(n))
        found, f_std, beta, std, _ = refined(c, np.ones(n - 1), f, rate)
        z.append([(found - f) / f_std, (np.hypot(*beta) - a) / std])
    np.testing.assert_allclose(np.std(z, axis=0), 1.0, atol=0.28)


def test_a_steps_errors_are_those_of_many_records():
    """Steps of ten standard deviations: time and amplitude scatter as told.

    The place between two samples and the spacing of the bank make the time's deviation larger than the
    scatter, twice perhaps.
    """
    rng, places, times, amplitudes = np.random.default_rng(22), [], [], []
    n = 1000
    size = 10.0 * 2.0 / np.sqrt(n)
    for _ in range(10):
        place = int(rng.integers(n // 3, 2 * n // 3))
        x = rng.standard_normal(n) + size * (np.arange(n) >= place)
        candidate = BiasStep().detect(view_of(x))
        assert candidate is not None
        time, amplitude = candidate.parameters["time"], candidate.parameters["amplitude"]
        places.append(time.std * RATE)
        times.append((time.value - place / RATE) / time.std)
        amplitudes.append((abs(amplitude.value) - size) / amplitude.std)
    for z in (times, amplitudes):
        assert 0.3 < np.sqrt(np.mean(np.square(z))) < 2.0
    assert np.median(places) < n / 20.0


# --- Gain ---------------------------------------------------------------------------------------------------


def test_the_gain_is_what_other_records_of_the_sensor_gain():
    """Of a step: noise and step as found in one record, against noise alone, on another of equal length."""
    rng = np.random.default_rng(15)
    step = 0.8 * (np.arange(2048) >= 800)
    differences = []
    for _ in range(30):
        x, other = 1.6 * rng.standard_normal((2, len(step))) + step
        view = view_of(x)
        candidate = BiasStep().detect(view)
        if candidate is None:
            continue
        after, c = candidate.after, centred(other)
        gained = 0.0
        for found, sign in ((after, 1.0), (view, -1.0)):
            v, rest = found.variance(), c - centred(view.samples - found.samples)
            ramp = found.family.ramp
            rest = rest - (ramp / v @ rest) / (ramp / v @ ramp) * ramp if found.noise.ramp else rest
            gained -= 0.5 * sign * float(np.sum(np.log(v) + rest**2 / v))
        differences.append(candidate.held_out() - gained)
    assert len(differences) >= 20
    # Three standard errors, and a nat for the eighth of the record that an effect is foretold without.
    error = np.std(differences) / np.sqrt(len(differences))
    assert abs(np.mean(differences)) < 3.0 * error + 1.0
    assert error < 1.5
