"""Upper limits: always there, never too low, and as low as the record lets them be."""

import jax
import numpy as np
import pytest
from scipy.stats import ncx2, norm
from white_and_walk import RATE, N, records, walk

import allanjax as aj
from allanjax.estimate.allan_design import AllanDesign
from allanjax.estimate.axis_fits import solve_and_infer
from allanjax.estimate.coefficients import deterministic_coefficients, estimates_of
from allanjax.estimate.deterministic import Line
from allanjax.estimate.inference import ceiling, infer
from allanjax.estimate.starts import find_starts

FIVE = aj.Model(
    (aj.Quantization(), aj.AngleRandomWalk(), aj.BiasInstability(), aj.RateRandomWalk(), aj.DriftRamp())
)
COUNT = 120


def limits(fit: aj.Fit, label: str) -> np.ndarray:
    return np.array([result[label].upper_limit for result in fit.values()])


def is_finite(c: aj.Coefficient) -> bool:
    return bool(np.isfinite([*c.interval, *c.interval_68, c.upper_limit]).all())


@pytest.mark.parametrize("K", [0.0, 1.0])
def test_five_terms_have_finite_limits_that_cover(K) -> None:
    """Without a rate random walk and with one at the edge of detection, whatever its neighbours explain."""
    fit = aj.fit(records(1.0, K, COUNT, seed=31), FIVE)
    truth = {"angle_random_walk": 1.0, "rate_random_walk": K}
    for result in fit.results:
        assert all(is_finite(c) for c in result.coefficients.values()), result.axis.name
    # Four binomial standard errors below 95 %.
    fewest = COUNT * 0.95 - 4.0 * np.sqrt(COUNT * 0.95 * 0.05)
    for label in FIVE.term_labels:
        assert np.sum(limits(fit, label) >= truth.get(label, 0.0)) >= fewest, label
    # The record's own slope is known to N·√(12/T³) beside white noise; with three more terms that look
    # alike, to some three times that, and a limit is two or three of them.
    slope = np.sqrt(12.0 / (N / RATE) ** 3)
    assert np.median(limits(fit, "drift_ramp")) < (12.0 if K == 0.0 else 25.0) * slope
    assert np.max(limits(fit, "drift_ramp")) < 60.0 * slope


@pytest.fixture(scope="module")
def white() -> aj.Recording:
    """White noise: of 40 records those that had no limit of the rate random walk when hypotheses ended."""
    values = np.random.default_rng(1).standard_normal((20_000, 40))[:, [6, 12, 18, 35]]
    return aj.Recording(values, RATE, tuple(aj.Axis(f"gyro_{k}", "gyro", "rad/s") for k in range(4)))


@pytest.mark.parametrize("objective", ["allan", "whittle"])
def test_nothing_of_white_noise_is_left_undetermined(white, objective) -> None:
    fit = aj.fit(white, objective=objective)
    assert all(is_finite(c) for result in fit.results for c in result.coefficients.values())
    assert "not determined" not in str(fit)
    # Beside white noise alone: N/T^1.5 is the scale of K that the record of T knows.
    assert np.max(limits(fit, "rate_random_walk")) < 200.0 * 0.1 / 200.0


def test_a_model_that_is_far_off_has_a_limit_where_nothing_is_refused() -> None:
    """Samples of alternating sign: an error of the model's curve of its own size refuses no power at all."""
    x = 0.01 * np.random.default_rng(5).standard_normal(N) + np.where(np.arange(N) % 2, 1.0, -1.0)
    recording = aj.Recording(x[:, None], RATE, (aj.Axis("gyro_x", "gyro", "rad/s"),))
    curve = aj.allan_deviation(recording, cluster_times=4)
    design = AllanDesign.of(FIVE, curve.n, curve.rate, curve.cluster_size, curve.strides)
    active = np.ones((1, len(FIVE)), bool)
    starts = find_starts(FIVE, design, curve.variance.T, active, [None], N, RATE)
    solution, *_ = solve_and_infer(design, curve.variance.T, active[0], active, starts)
    assert solution.power_error[0] > 0.6
    for wild in (solution, solution._replace(power_error=np.array([10.0]))):
        inference = infer(design, curve.variance.T, active[0], active, wild)
        estimates = estimates_of(FIVE, active, wild, inference)
        assert np.isfinite(estimates.upper_limit).all()
        assert np.isfinite(estimates.interval).all()
        assert (estimates.upper_limit >= estimates.value).all()


def test_the_ceiling_is_seldom_too_low() -> None:
    """That of each term alone, which leaves no room for another: once in forty times at the most."""
    count = 200
    rng = np.random.default_rng(34)
    curves = {
        "angle_random_walk": np.sqrt(RATE) * rng.standard_normal((N, count)),
        "rate_random_walk": walk(1.0, (N, count), rng),
    }
    for label, values in curves.items():
        axes = tuple(aj.Axis(f"gyro_{k}", "gyro", "rad/s") for k in range(count))
        curve = aj.allan_deviation(aj.Recording(values, RATE, axes), cluster_times=4)
        design = AllanDesign.of(FIVE, N, RATE, curve.cluster_size, curve.strides)
        means, products = design.means(np.zeros(0)), design.products(np.zeros(0))
        k = FIVE.term_labels.index(label)
        of_each = jax.vmap(lambda V, k=k, of=(means, products, 0.0), d=design: ceiling(d, V, *of)[k])
        found = np.asarray(of_each(curve.variance.T))
        assert np.mean(found < 1.0) < 0.025 + 4.0 * np.sqrt(0.025 * 0.975 / count)
        assert np.median(found) < 100.0


AXIS = aj.Axis("gyro_x", "gyro", "rad/s")
LINE = Line(3.0, 0.0, 1.0, 1.0, 1.0, 1, np.zeros(3))


@pytest.mark.parametrize("square", [0.0, 0.3, 3.0, 7.0, 30.0, 900.0])
@pytest.mark.parametrize("term", [aj.DriftRamp(), aj.BiasStep(time=3.0).hold("time"), aj.Sinusoid()])
def test_ends_of_ramps_steps_and_lines_have_the_levels_they_are_said_to_have(term, square) -> None:
    """The probability of a square as small as this, or as large, if the truth were there."""
    degrees, line = (2, LINE) if isinstance(term, aj.Sinusoid) else (1, None)
    model = aj.Model((term,))
    c = next(iter(deterministic_coefficients(model, 0, AXIS, square, 0.02, degrees, line, 1000).values()))

    def smaller(amplitude: float, square: float) -> float:
        return float(ncx2.cdf(square, degrees, (amplitude / 0.02) ** 2))

    # Upper ends never rest on less than the median of pure noise.
    at_least = max(square, float(ncx2.ppf(0.5, degrees, 1e-12)))
    # Beyond a square of 400 a normal law stands for the noncentral one, to 2e-4.
    assert smaller(c.upper_limit, at_least) == pytest.approx(0.05, abs=2e-4)
    assert smaller(c.interval[1], at_least) == pytest.approx(0.025, abs=2e-4)
    assert smaller(c.interval_68[1], at_least) == pytest.approx(0.16, abs=2e-4)
    for end, level in ((c.interval[0], 0.025), (c.interval_68[0], 0.16)):
        if end > 0.0:
            assert 1.0 - smaller(end, square) == pytest.approx(level, abs=2e-4)
        else:
            assert 1.0 - smaller(1e-9, square) >= level - 2e-4


def test_the_limit_of_a_ramp_covers_by_simulation() -> None:
    """A slope of 1.5 standard deviations beside white noise of known size, fitted by regression."""
    rng = np.random.default_rng(7)
    n, count = 256, 400
    t = (np.arange(n) - (n - 1) / 2.0) / RATE
    std = np.sqrt(RATE) / np.sqrt(np.sum(t**2))
    slope = 1.5 * std
    x = np.sqrt(RATE) * rng.standard_normal((count, n)) + slope * t
    found = x @ t / np.sum(t**2)
    model = aj.Model((aj.DriftRamp(),))
    ends = [
        deterministic_coefficients(model, 0, AXIS, (b / std) ** 2, std, 1, None, n)["drift_ramp"]
        for b in found
    ]
    covers = np.mean([c.upper_limit >= slope for c in ends])
    # Four binomial standard errors, and what squares below the median of noise give away: those of slopes
    # between ∓0.67 standard deviations take their limit from 0.67.
    given = norm.cdf(0.6745 - 1.5) - norm.cdf(-0.6745 - 1.5)
    assert 0.95 - 0.044 < covers < 0.95 + given
