"""Statistics in which simulations are compared with the measurement: their laws, and what they notice."""

import numpy as np
import pytest
from scipy.fft import idct
from scipy.optimize import minimize
from scipy.stats import kstest

import allanjax as aj
from allanjax.critic.comparison import StageResiduals, allan_law, octave_bins, summaries
from allanjax.critic.discrepancies import discrepancies
from allanjax.critic.noise import centred, family_of
from allanjax.critic.result import Snapshot
from allanjax.record.recording import Axis

AXIS = Axis("gyro_x", "gyro", "deg/s")
DEG = np.pi / 180.0
N, RATE = 4096, 100.0
POWERS = {"angle_random_walk": 1e-6, "rate_random_walk": 1e-7}
# Statistics whose value can only be one of a few: their p-values are those of counts.
DISCRETE = {"lattice", "repeated_values"}


@pytest.fixture(scope="module")
def variance():
    """White noise and a random walk."""
    return family_of(N, RATE).expected(POWERS, float("nan"))


def record(x, variance, powers=None):
    """Of a model whose levels are known exactly unless there are `powers`."""
    powers = powers or {}
    return StageResiduals(AXIS, DEG, RATE, Snapshot(x, variance, tuple(powers), powers, float("nan"), 0.0))


def drawn(variance, rng):
    """A record of the model."""
    return idct(np.concatenate([[0.0], rng.standard_normal(len(variance)) * np.sqrt(variance)]), norm="ortho")


def found(x, variance, **more):
    w = record(x, variance)
    return {d.statistic: d for d in discrepancies(w, more.pop("raw", x), **more)}


def test_p_values_are_uniform_where_the_model_is_true(variance):
    rng = np.random.default_rng(1)
    channel = np.cumsum(rng.standard_normal(N))
    p = {}
    for _ in range(250):
        x, y, z = (drawn(variance, rng) for _ in range(3))
        others = {"gyro_y": record(y, variance), "gyro_z": record(z, variance)}
        for name, d in found(x, variance, others=others, auxiliary={"temperature": channel}).items():
            p.setdefault(name, []).append(d.p_value)
    assert len(p) == 13
    for name in set(p) - DISCRETE:
        # Of eleven statistics none should be this far off more than once in a hundred seeds.
        assert kstest(p[name], "uniform").pvalue > 1e-3, name
    assert min(p["lattice"]) == 1.0
    assert min(p["repeated_values"]) > 1e-4


def test_levels_known_no_better_than_their_posterior_widen_the_law(variance):
    rng = np.random.default_rng(2)
    family = family_of(N, RATE)
    w = record(np.ones(N), variance, POWERS)
    sizes = 2 ** np.arange(11)
    law = allan_law(w, sizes)
    root = np.linalg.cholesky(w.level_covariance)
    draws = []
    for _ in range(400):
        factors = np.maximum(1.0 + root @ rng.standard_normal(2), 0.05)
        powers = {name: factor * POWERS[name] for name, factor in zip(POWERS, factors, strict=True)}
        x = drawn(family.expected(powers, float("nan")), rng)
        draws.append(allan_law(record(x, variance, POWERS), sizes).measured / law.mean)
    # A variance of 400 draws has a relative error of √(2/400), more where the law has longer tails.
    assert np.var(draws, axis=0) == pytest.approx(np.diag(law.covariance), rel=0.4)
    # White noise of n samples: its level is known to √(2/n).
    assert np.sqrt(w.level_covariance[0, 0]) == pytest.approx(np.sqrt(2.0 / N), rel=0.1)


def test_p_values_are_uniform_where_levels_are_fitted_to_the_record():
    """By maximum likelihood, by another optimizer than the package's; a random walk that the record shows."""
    rng = np.random.default_rng(3)
    family = family_of(N, RATE)
    truth = POWERS | {"rate_random_walk": 3e-5}
    shapes = np.stack([family.expected({name: power}, float("nan")) for name, power in truth.items()])

    def deviance(log_factors, squares):
        factors = np.exp(log_factors)
        v = factors @ shapes
        slope = ((1.0 - squares / v) / v) @ shapes.T
        return float(np.sum(np.log(v) + squares / v)), factors * slope

    p = []
    for _ in range(250):
        x = drawn(shapes.sum(axis=0), rng)
        fitted = minimize(deviance, np.zeros(2), (centred(x) ** 2,), "BFGS", jac=True)
        powers = dict(zip(truth, np.exp(fitted.x) * list(truth.values()), strict=True))
        found = discrepancies(record(x, family.expected(powers, float("nan")), powers), x)
        p.append([d.p_value for d in found if d.statistic in ("allan_deviation", "drift")])
    for column in np.transpose(p):
        assert kstest(column, "uniform").pvalue > 1e-3


def test_the_law_of_the_allan_variance_is_that_of_simulations(variance):
    rng = np.random.default_rng(3)
    sizes = 2 ** np.arange(11)
    law = allan_law(record(drawn(variance, rng), variance), sizes)
    draws = np.array([allan_law(record(drawn(variance, rng), variance), sizes).measured for _ in range(400)])
    # Mean and variance of 400 draws: four standard errors.
    scatter = np.sqrt(np.diag(law.covariance))
    assert np.all(abs(draws.mean(axis=0) / law.mean - 1.0) < 4.0 * scatter / 20.0)
    np.testing.assert_allclose(draws.std(axis=0) / law.mean, scatter, rtol=0.25)


def test_the_total_deviation_is_the_allan_deviation_for_short_clusters(variance):
    x = drawn(variance, np.random.default_rng(4))
    curve = aj.allan_deviation(x[:, None], RATE)
    w = record(x, variance)
    few = curve.cluster_size <= N // 64
    law = allan_law(w, np.asarray(curve.cluster_size)[few])
    # They differ by what happens at the ends.
    np.testing.assert_allclose(np.sqrt(law.measured), curve.deviation[few, 0], rtol=0.02)


def test_a_ramp_is_taken_out(variance):
    x = drawn(variance, np.random.default_rng(5))
    tilted = x + 0.01 * np.arange(N) / RATE
    snapshot = Snapshot(tilted, variance, (), {}, float("nan"), 0.01)
    np.testing.assert_allclose(StageResiduals(AXIS, DEG, RATE, snapshot).coefficients, centred(x), atol=1e-9)


def test_a_line_is_noticed_at_its_frequency(variance):
    x = drawn(variance, np.random.default_rng(6))
    t = np.arange(N) / RATE
    d = found(x + 2e-3 * np.sin(2.0 * np.pi * 7.3 * t), variance)["psd_line"]
    assert d.p_value < 1e-4
    assert d.where == pytest.approx(7.3, abs=RATE / N)
    # A line between two frequencies of whole periods shows at least 2/π of its amplitude.
    assert 0.6 * 2e-3 / DEG < d.measured < 1.3 * 2e-3 / DEG
    assert d.where_unit == "Hz"
    assert d.unit == "deg/s"


def test_louder_noise_is_noticed_when_it_is(variance):
    rng = np.random.default_rng(7)
    w = record(drawn(variance, rng), variance)
    e = w.whitened.copy()
    inside = slice(N // 2, N // 2 + N // 8)
    e[inside] *= np.sqrt(2.0)
    x = idct(np.concatenate([[0.0], centred(e) * np.sqrt(variance)]), norm="ortho")
    d = found(x, variance)["window_variance"]
    assert d.p_value < 1e-4
    assert N // 2 / RATE < d.where < (N // 2 + N // 8) / RATE
    # Four standard deviations of the mean square of 512.
    assert d.measured == pytest.approx(2.0, abs=4.0 * 2.0 * np.sqrt(2.0 / 512))


def test_a_wrong_level_is_noticed_in_the_spectrum_and_the_allan_deviation(variance):
    f = np.arange(1, N) * RATE / (2.0 * N)
    wrong = np.where((f > 8.0) & (f < 16.0), 0.5 * variance, variance)
    d = found(drawn(variance, np.random.default_rng(8)), wrong)
    assert d["psd"].p_value < 1e-4
    assert 8.0 < d["psd"].where < 16.0
    assert d["psd"].size == pytest.approx(-0.5, abs=0.2)
    low = found(drawn(variance, np.random.default_rng(8)), 0.5 * variance)["allan_deviation"]
    assert low.p_value < 1e-4
    assert low.size == pytest.approx(np.sqrt(0.5) - 1.0, abs=0.05)


def test_what_is_in_the_values_is_noticed(variance):
    rng = np.random.default_rng(9)
    x = drawn(variance, rng)
    spiked = x.copy()
    spiked[1234] += 0.08
    d = found(spiked, variance)
    assert max(d["largest_residual"].p_value, d["tails"].p_value) < 1e-4
    assert d["largest_residual"].where == pytest.approx(12.34, abs=0.02)
    sigma = float(np.sqrt(np.median(variance)))
    coarse = np.rint(x / sigma) * sigma
    assert found(x, variance, raw=coarse)["lattice"].p_value < 1e-4
    # Written with four digits to the noise's standard deviation, as files are.
    written = np.rint(x / sigma * 1e4) * sigma * 1e-4
    assert min(found(x, variance, raw=written)[name].p_value for name in DISCRETE) > 1e-4
    held = x.copy()
    held[1::50] = held[:-1:50][: len(held[1::50])]
    assert found(x, variance, raw=held)["repeated_values"].p_value < 1e-4


def test_other_channels_are_named(variance):
    rng = np.random.default_rng(10)
    x, y, z = (drawn(variance, rng) for _ in range(3))
    temperature = np.sin(np.linspace(0.0, 9.0, N))
    others = {"gyro_y": record(y, variance), "gyro_z": record(z + 0.5 * x, variance)}
    channels = {"flat": np.ones(N), "temperature": temperature, "noise": rng.standard_normal(N)}
    d = found(x + 0.1 * temperature, variance, others=others, auxiliary=channels)
    assert d["cross_correlation"].p_value < 1e-4
    assert d["cross_correlation"].channel == "gyro_z"
    assert d["auxiliary_correlation"].p_value < 1e-4
    assert d["auxiliary_correlation"].channel == "temperature"


def test_a_coloured_residual_is_noticed_at_its_lag(variance):
    x = drawn(variance, np.random.default_rng(11))
    d = found(x + 0.3 * np.roll(x, 5), variance)["autocorrelation"]
    assert d.p_value < 1e-4
    assert d.where == pytest.approx(0.05)


def test_bands_hold_95_percent(variance):
    rng = np.random.default_rng(12)
    inside = []
    for _ in range(100):
        for c in summaries(record(drawn(variance, rng), variance)):
            inside.append(np.mean((c.low <= c.measured) & (c.measured <= c.high)))
    # Points of a curve scatter together; the Allan band is that of a χ² law with the right mean and variance.
    assert np.mean(inside[::2]) == pytest.approx(0.95, abs=0.02)
    assert np.mean(inside[1::2]) == pytest.approx(0.95, abs=0.01)


def test_the_spectrum_is_drawn_at_the_mean_frequency_of_its_bins(variance):
    x = drawn(variance, np.random.default_rng(13))
    _, spectrum = summaries(record(x, variance))
    frequency = np.arange(1, N) * RATE / (2.0 * N)
    first = octave_bins(N)[:-1] - 1
    count = np.diff(octave_bins(N))
    np.testing.assert_allclose(spectrum.place, np.add.reduceat(frequency, first) / count, rtol=1e-12)
    # One-sided: the mean of c² over its bin, times 2/rate.
    squares = np.add.reduceat(centred(x) ** 2, first) / count
    np.testing.assert_allclose(spectrum.measured, 2.0 / RATE * squares, rtol=1e-12)


@pytest.mark.parametrize("n", [16, 100, N])
def test_bins_hold_every_coefficient_once(n):
    edges = octave_bins(n)
    assert edges[0] == 1
    assert edges[-1] == n
    assert np.all(np.diff(edges) > 0)
