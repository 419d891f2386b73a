"""Fits in bulk: what a fit of each axis gives, for any number of axes; and intervals that cover."""

import dataclasses

import jax
import numpy as np
import pandas as pd
import pytest

import allanjax as aj
from allanjax.estimate import bulk
from allanjax.estimate.axis_fits import fit_allan

RATE = 100.0
N = 4096
ARW, RRW = aj.AngleRandomWalk(0.01), aj.RateRandomWalk(0.003)


def samples(model: aj.Model, axes: int, seed: int = 0) -> np.ndarray:
    keys = jax.random.split(jax.random.PRNGKey(seed), axes)
    return np.stack([np.asarray(aj.simulate(model, N, RATE, key)) for key in keys], axis=1)


def recording(values: np.ndarray, name: str = "", sensor: str = "gyro") -> aj.Recording:
    unit = "deg/s" if sensor == "gyro" else "g"
    axes = tuple(aj.Axis(f"{sensor}_{k}", sensor, unit) for k in range(values.shape[1]))
    return aj.Recording(values, RATE, axes, name=name)


@pytest.fixture
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Five axes are then three blocks, the last of them filled up."""
    monkeypatch.setattr(bulk, "_BLOCK", 2)


@pytest.mark.usefixtures("small_blocks")
@pytest.mark.parametrize(
    ("truth", "model"),
    [
        (
            ARW + aj.BiasInstability(0.01),
            aj.AngleRandomWalk() + aj.BiasInstability() + aj.RateRandomWalk(),
        ),
        (
            aj.Quantization(3e-4) + ARW + RRW,
            aj.Quantization() + aj.AngleRandomWalk() + aj.RateRandomWalk() + aj.DriftRamp(),
        ),
    ],
    ids=["N+B+K", "Q+N+K+R"],
)
def test_each_axis_gets_what_a_fit_of_it_gives(truth: aj.Model, model: aj.Model) -> None:
    x = samples(truth, 5)
    # Under a line of ten times the noise nothing is measured.
    x[:, 3] += np.sin(2.0 * np.pi * 5.0 * np.arange(N) / RATE)
    record = recording(x, "unit")
    curve = aj.allan_deviation(record)
    many = aj.fit_many(curve, model)
    results = []
    # Each with its neighbour: programs for two axes are compiled already.
    for pair in ([k, (k + 1) % 5] for k in range(5)):
        axes = tuple(record.axes[k] for k in pair)
        two = dataclasses.replace(
            curve, deviation=curve.deviation[:, pair], edf=curve.edf[:, pair], axes=axes
        )
        results.append(fit_allan(two, axes, model, np.ones((2, len(model)), bool))[0][0])
    assert many.converged.all()
    assert not many.detected.all()
    # To rounding, which the iteration's last steps may amplify.
    close = {"rtol": 1e-6, "atol": 1e-15}
    fit = aj.Fit("unit", model, curve, tuple(results))
    pd.testing.assert_frame_equal(
        many.to_dataframe(), fit.to_dataframe().astype({"upper_limit_95": float}), **close
    )
    for name in ("chi2", "p_value", "discrepancy"):
        np.testing.assert_allclose(getattr(many, name), [getattr(r, name) for r in fit.values()], **close)
    assert {many.dof} == {r.dof for r in fit.values()}
    assert many.measured.tolist() == [r.measured for r in fit.values()] == [k != 3 for k in range(5)]


def test_absent_terms_have_limits_and_intervals_cover() -> None:
    axes, N_true = 200, 0.02
    x = np.random.default_rng(5).normal(scale=N_true * np.sqrt(RATE), size=(N, axes))
    many = aj.fit_many(aj.allan_deviation(x, RATE), aj.AngleRandomWalk() + aj.RateRandomWalk())
    assert many.converged.all()
    (N_found, K), (N_std, _) = many.value.T, many.std.T
    # Four standard errors of a mean, a standard deviation and a share of so many axes.
    z = (N_found - N_true) / N_std
    assert abs(z.mean()) < 4.0 / np.sqrt(axes)
    assert abs(z.std() - 1.0) < 4.0 / np.sqrt(2.0 * axes)
    covered = (many.lower[:, 0] <= N_true) & (N_true <= many.upper[:, 0])
    error = np.sqrt(0.95 * 0.05 / axes)
    assert abs(covered.mean() - 0.95) < 4.0 * error
    # No random walk: found by chance in one axis of forty, and at zero in many.
    assert many.detected[:, 1].mean() < 0.025 + 4.0 * np.sqrt(0.025 * 0.975 / axes)
    absent = K == 0.0
    assert absent.mean() > 0.25
    assert (many.lower[absent, 1] == 0.0).all()
    assert (many.upper_limit[absent, 1] > 0.0).all()


@pytest.mark.usefixtures("small_blocks")
def test_recordings_are_stacked() -> None:
    x = samples(ARW + RRW, 3)
    first, second = recording(x[:, :2], "a"), recording(x[:, 2:], sensor="accel")
    model = aj.AngleRandomWalk() + aj.RateRandomWalk()
    many = aj.fit_many([first, second], model)
    assert many.names == ("a/gyro_0", "a/gyro_1", "1/accel_0")
    alone = aj.fit_many(aj.allan_deviation(x, RATE), model)
    assert alone.names == ("0", "1", "2")
    np.testing.assert_allclose(many.value, alone.value, rtol=1e-6)
    table = many.to_dataframe()
    assert list(table["unit"][::2]) == ["deg/√h", "deg/√h", "m/s/√h"]
    # 1 rad/√s is 180/π · 60 deg/√h, 1 m/s/√s is 60 m/s/√h.
    to_usual = np.array([3437.7467707849, 3437.7467707849, 60.0])
    np.testing.assert_allclose(table["value"][::2], alone.value[:, 0] * to_usual, rtol=1e-6)
    assert (alone.to_dataframe()["unit"] == "").all()
    np.testing.assert_array_equal(alone.to_dataframe()["value"], alone.value.ravel())
    assert "3 axes of 4,096 samples" in str(many)
    assert "angle_random_walk" in str(many)


@pytest.mark.usefixtures("small_blocks")
def test_an_axis_without_result_says_so_and_spoils_no_other() -> None:
    x = samples(ARW + RRW, 3)
    model = aj.AngleRandomWalk() + aj.RateRandomWalk()
    expected = aj.fit_many(aj.allan_deviation(x, RATE), model)
    x[:, 1] = 1.0
    many = aj.fit_many(aj.allan_deviation(x, RATE), model)
    np.testing.assert_array_equal(many.converged, [True, False, True])
    np.testing.assert_allclose(many.value[[0, 2]], expected.value[[0, 2]], rtol=1e-6)
    assert np.isnan(many.to_dataframe()["value"][2:4]).all()
    assert not many.detected[1].any()
    assert "2 converged" in str(many)


@pytest.mark.usefixtures("small_blocks")
def test_an_incomplete_model_is_off_by_as_much_as_in_a_fit() -> None:
    """White noise alone for a record with a random walk: to rounding, which the iteration may amplify."""
    record = recording(samples(ARW + RRW, 2))
    curve, model = aj.allan_deviation(record), aj.Model((aj.AngleRandomWalk(),))
    many = aj.fit_many(curve, model)
    results, _ = fit_allan(curve, record.axes, model, np.ones((2, 1), bool))
    assert (many.discrepancy > 0.01).all()
    np.testing.assert_allclose(many.discrepancy, [r.discrepancy for r in results], rtol=1e-6)


def test_what_it_cannot_do_it_refuses() -> None:
    x = samples(ARW, 2)
    model = aj.AngleRandomWalk()
    curve = aj.allan_deviation(x, RATE)
    for term in (aj.Sinusoid(), aj.Resonance(), aj.BiasStep(time=3.0)):
        with pytest.raises(aj.FitError, match=rf"{term.name()} .*allanjax\.fit"):
            aj.fit_many(curve, model + term)
    with pytest.raises(aj.AllanjaxError, match="hadamard"):
        aj.fit_many(aj.allan_deviation(x, RATE, kind="hadamard"), model)
    with pytest.raises(aj.AllanjaxError, match="cluster_times"):
        aj.fit_many(curve, model, cluster_times=4)
    with pytest.raises(aj.AllanjaxError, match=r"^b has 2000 samples .* between"):
        aj.fit_many([recording(x, "a"), recording(x[:2000], "b")], model)
    for nothing in ([], recording(x), [x]):
        with pytest.raises(aj.AllanjaxError, match="sequence of recordings"):
            aj.fit_many(nothing, model)
    with pytest.raises(aj.FitError, match="too few"):
        aj.fit_many(aj.allan_deviation(x[:8], RATE), model + aj.RateRandomWalk() + aj.BiasInstability())
