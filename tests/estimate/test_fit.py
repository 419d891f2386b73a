"""The fit: recovers what was simulated, says what it cannot know, and refuses what it does not have."""

import dataclasses
import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import allanjax as aj
from allanjax.estimate.allan_design import AllanDesign
from allanjax.estimate.gls import Solution
from allanjax.estimate.inference import Inference
from allanjax.estimate.starts import Starts

RATE = 100.0
# Estimates of true coefficients lie within this many of their standard deviations (once in 16,000 not).
K_SIGMA = 4.0


def recording(model: aj.Model, n: int, axes: int = 1, seed: int = 0, scale: float = 1.0) -> aj.Recording:
    keys = jax.random.split(jax.random.PRNGKey(seed), axes)
    values = scale * np.stack([np.asarray(aj.simulate(model, n, RATE, key)) for key in keys], axis=1)
    described = tuple(aj.Axis(f"gyro_{k}", "gyro", "rad/s") for k in range(axes))
    return aj.Recording(values, RATE, described)


def check(found: aj.AxisFit, truth: aj.Model) -> None:
    for label, value in truth.values.items():
        if label not in found.coefficients:
            continue
        c = found[label]
        assert c.detected, f"{label} not detected: {c}"
        assert abs(c.value - value) < K_SIGMA * c.std, f"{c}, truth {value}"
        assert c.interval[0] < c.value < c.interval[1]


WHITE = aj.AngleRandomWalk(0.01)


class PowerLaw(aj.NoiseTerm):
    """A slope between random walk and flicker: S(f) ∝ f^(−1/2)."""

    coefficient: float | None = aj.parameter("H", time_exponent=0.25)

    def phase_covariance(self, lag):
        return -(self.coefficient**2) * jnp.where(lag > 0.0, lag, 1.0) ** 1.5 * (lag > 0.0)


@pytest.mark.parametrize(
    ("truth", "asked"),
    [
        (
            WHITE + aj.Markov(0.05, 0.3) + aj.RateRandomWalk(0.002),
            aj.AngleRandomWalk() + aj.Markov() + aj.RateRandomWalk(),
        ),
        (WHITE + aj.Sinusoid(0.02, 0.7), aj.AngleRandomWalk() + aj.Sinusoid()),
        (WHITE + aj.Resonance(0.05, 12.0, 8.0), aj.AngleRandomWalk() + aj.Resonance()),
        (
            WHITE + aj.BiasInstability(0.02, 0.05),
            aj.AngleRandomWalk() + aj.BiasInstability(cutoff_frequency=None),
        ),
        (WHITE + PowerLaw(0.006), aj.AngleRandomWalk() + PowerLaw()),
    ],
    ids=["markov", "sinusoid", "resonance", "cutoff", "user's own"],
)
def test_terms_with_shapes_are_found_without_help(truth: aj.Model, asked: aj.Model) -> None:
    fit = aj.fit(recording(truth, 30_000, seed=11), asked)
    result = fit["gyro_0"]
    assert result.converged
    assert result.discrepancy == 0.0
    check(result, truth)
    np.testing.assert_allclose(
        fit.model_deviation("gyro_0", [1.0]) ** 2,
        np.asarray(result.model.sampled(RATE).allan_variance([1.0])),
    )


def test_without_a_model_the_supported_basic_terms_remain() -> None:
    truth = aj.Quantization(2e-4) + WHITE + aj.RateRandomWalk(0.003)
    fit = aj.fit(recording(truth, 60_000, axes=4, seed=5))
    for result in fit.results:
        check(result, truth)
        assert {c.label for c in result.coefficients.values() if c.detected} == set(truth.values)
        assert set(result.model.values) - {"bias_instability_cutoff_frequency"} == set(truth.values)
        ramp = result["drift_ramp"]
        assert ramp.value == 0.0
        assert 0.0 < ramp.upper_limit < np.inf
        assert "not detectable, below" in ramp.describe()
        assert "deg/h²" in ramp.in_unit().describe()


def test_upper_limits_hold_for_a_random_walk_below_detection() -> None:
    # One-sided 95 % limits of 80 records: fewer than 68 above the truth would be 4 standard errors short.
    K = 4e-4
    fit = aj.fit(
        recording(WHITE + aj.RateRandomWalk(K), 8192, axes=80, seed=8),
        aj.AngleRandomWalk() + aj.RateRandomWalk(),
    )
    limits = np.array([result["rate_random_walk"].upper_limit for result in fit.values()])
    assert np.sum(limits > K) >= 68
    # And they say something: a walk ten times as strong is excluded in nearly all of them.
    assert np.median(limits) < 10.0 * K
    assert np.mean([result["rate_random_walk"].detected for result in fit.values()]) < 0.5


def test_axes_fitted_together_equal_axes_fitted_alone() -> None:
    whole = recording(WHITE + aj.BiasInstability(0.004), 8192, axes=3, seed=2)
    together = aj.fit(whole)
    for k, name in enumerate(together.axes):
        alone = aj.fit(dataclasses.replace(whole, values=whole.values[:, [k]], axes=(whole.axes[k],)))
        for label, c in alone[name].coefficients.items():
            # Each stops within a thousandth of a standard deviation of the solution.
            tolerance = 3e-3 * max(c.std, 1e-12)
            assert together[name][label].value == pytest.approx(c.value, abs=tolerance, rel=1e-6)


def test_coefficients_scale_with_the_data() -> None:
    truth = WHITE + aj.RateRandomWalk(0.003)
    one, tiny = (aj.fit(recording(truth, 8192, seed=3, scale=s))["gyro_0"] for s in (1.0, 1e-8))
    for label, c in one.coefficients.items():
        assert tiny[label].value == pytest.approx(1e-8 * c.value, rel=1e-3, abs=1e-20)
        assert tiny[label].detected == c.detected


def test_held_parameters_stay_and_starts_are_used() -> None:
    truth = WHITE + aj.Markov(0.05, 0.3)
    asked = aj.AngleRandomWalk() + aj.Markov(0.02, 0.5).hold("correlation_time")
    result = aj.fit(recording(truth, 20_000, seed=4), asked)["gyro_0"]
    held = result["markov_correlation_time"]
    assert (held.value, held.std, held.held) == (0.5, 0.0, True)
    assert "held" in held.describe()
    assert result["markov_amplitude"].std > 0.0


@pytest.mark.parametrize("objective", ["allan", "whittle"])
def test_an_amplitude_that_is_held_has_its_value(objective) -> None:
    """White noise held at its true level: the model suffices, and the random walk is found beside it."""
    walk = aj.RateRandomWalk(0.003)
    asked = WHITE.hold("coefficient") + aj.RateRandomWalk()
    result = aj.fit(recording(WHITE + walk, 8192, seed=7), asked, objective)["gyro_0"]
    held, found = result["angle_random_walk"], result["rate_random_walk"]
    assert (held.value, held.std, held.held) == (0.01, 0.0, True)
    assert result.p_value > 1e-4
    assert abs(found.value - 0.003) < K_SIGMA * found.std
    deviation = np.sqrt(np.asarray(result.model.allan_variance(1.0)))
    assert deviation == pytest.approx(np.sqrt(0.01**2 + found.value**2 / 3.0))


def test_an_incomplete_model_is_said_so_and_widens_the_intervals() -> None:
    clean = recording(WHITE, 20_000, seed=6)
    line = 0.05 * np.sin(2 * np.pi * 5.0 * clean.time)[:, None]
    model = aj.Model((aj.AngleRandomWalk(),))
    good, bad = (
        aj.fit(clean, model)["gyro_0"],
        aj.fit(dataclasses.replace(clean, values=clean.values + line), model)["gyro_0"],
    )
    assert good.p_value > 1e-4
    assert good.discrepancy == 0.0
    assert bad.p_value < 1e-6
    assert bad.discrepancy > 0.01
    assert "model incomplete" in bad.verdict()
    assert bad["angle_random_walk"].std > 5.0 * good["angle_random_walk"].std


def test_of_several_starts_the_best_solution_is_taken(monkeypatch) -> None:
    """Of those that converged the one of least cost; axis by axis, whatever the order."""
    module = importlib.import_module("allanjax.estimate.axis_fits")
    cost = np.array([[3.0, 1.0, np.nan], [1.0, 2.0, 5.0], [0.5, 0.5, 4.0], [2.0, 3.0, 9.0]])
    converged = np.array([[1, 1, 0], [1, 1, 1], [0, 0, 1], [1, 1, 1]], bool)

    def solve(design, V, free, active, power, shape):
        k = int(power[0, 0])
        zero = np.zeros(3)
        return Solution(power, shape, zero, zero, converged[k], cost[k])

    monkeypatch.setattr(module, "solve", solve)
    monkeypatch.setattr(module, "infer", lambda *_: Inference(*np.zeros((5, 3, 2, 2))))
    starts = Starts(np.tile(np.arange(4.0)[:, None], (3, 1, 1)), np.zeros((3, 4, 1)))
    sizes = np.array([1, 2, 4, 8, 16])
    design = AllanDesign.of(aj.Model((aj.PowerLaw(),)), 64, 1.0, sizes)
    solution, *_ = module.solve_and_infer(
        design, np.ones((3, 5)), np.ones(1, bool), np.ones((3, 1), bool), starts
    )
    np.testing.assert_array_equal(solution.power[:, 0], [1.0, 0.0, 2.0])


def test_an_unconverged_fit_is_no_result() -> None:
    fit = aj.fit(recording(WHITE, 2048), aj.Model((aj.AngleRandomWalk(),)))
    failed = dataclasses.replace(fit["gyro_0"], converged=False, reason="the fit did not converge")
    refused = dataclasses.replace(fit, results=(failed,))
    assert not refused.converged
    for ask in (
        lambda: failed.coefficients,
        lambda: failed.covariance,
        lambda: failed.model,
        lambda: failed["angle_random_walk"],
        lambda: refused.coefficients,
        lambda: refused.to_dataframe(),
    ):
        with pytest.raises(aj.FitError, match="did not converge"):
            ask()
    assert "no result" in str(refused)


def test_covariance_is_that_of_the_coefficients() -> None:
    result = aj.fit(
        recording(WHITE + aj.RateRandomWalk(0.003), 8192, seed=7), aj.AngleRandomWalk() + aj.RateRandomWalk()
    )["gyro_0"]
    std = [c.std for c in result.coefficients.values()]
    np.testing.assert_allclose(np.sqrt(np.diag(result.covariance)), std, rtol=1e-12)
    correlation = result.covariance[0, 1] / np.prod(std)
    assert -1.0 < correlation < 0.0  # what one term explains, the other need not


def test_errors_say_what_to_do() -> None:
    markovs = aj.Markov() + aj.Markov() + aj.Markov() + aj.Markov() + aj.Markov()
    short = recording(WHITE, 20)
    with pytest.raises(aj.FitError, match="too few for 10 parameters; record longer or use fewer terms"):
        aj.fit(short, markovs)
    fit = aj.fit(recording(WHITE, 2048), aj.Model((aj.AngleRandomWalk(),)))
    with pytest.raises(aj.FitError, match="no axis 'gyro_x'; it has gyro_0"):
        fit["gyro_x"]
    with pytest.raises(aj.FitError, match="no coefficient 'markov'"):
        fit["gyro_0"]["markov"]


def test_prints_with_units_in_terminal_and_notebook() -> None:
    fit = aj.fit(recording(WHITE, 4096, seed=9))
    for text in (str(fit), fit._repr_html_()):
        assert "gyro_0" in text
        assert "angle random walk" in text
        assert "deg/√h" in text
        assert "not detectable, below" in text
    table = fit.to_dataframe().set_index("coefficient")
    row = table.loc["angle_random_walk"]
    assert row["unit"] == "deg/√h"
    assert row["value"] == pytest.approx(fit["gyro_0"]["angle_random_walk"].value * 180.0 / np.pi * 60.0)
