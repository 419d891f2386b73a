"""Records of which something is missing: samples, stretches, whole axes."""

import dataclasses

import numpy as np
import pytest
from scipy.fft import dst
from scipy.optimize import minimize
from white_and_walk import RATE, bound, variances, walk

import allanjax as aj

NAN = float("nan")
N, K = 1e-3, 2e-3
LENGTHS = (2048, 3000, 300, 1500)


def record(seed=41, axes=2):
    """A walk in white noise, of which a sample is missing between the stretches."""
    rng, n = np.random.default_rng(seed), sum(LENGTHS) + len(LENGTHS) - 1
    x = N * np.sqrt(RATE) * rng.standard_normal((n, axes)) + walk(K, (n, axes), rng)
    x[np.cumsum(np.array(LENGTHS[:-1]) + 1) - 1] = NAN
    return x


def made(x, gaps="segments"):
    names = [f"gyro_{axis}" for axis in "xyz"[: x.shape[1]]]
    return aj.Recording.from_array(x, RATE, gyro_unit="rad/s", names=names, gaps=gaps)


@pytest.fixture(scope="module")
def whole():
    return made(record())


@pytest.fixture(scope="module")
def fitted(whole):
    return aj.fit(whole, "N + K", as_is=True)


def test_coefficients_are_those_of_the_likelihood_of_all_stretches(whole, fitted):
    """Of the differences within each, whose sines are independent."""
    assert whole.n == 3000
    assert [len(other) for other in whole.others] == [2048, 300, 1500]
    assert fitted.objective == "whittle"
    assert any("4 segments, 6,848 samples" in note for note in fitted.notes)
    for k, result in enumerate(fitted.values()):
        stretches = [x[:, k] for x in (whole.values, *whole.others)]
        squares = np.concatenate([dst(np.diff(x), type=1, norm="ortho") ** 2 for x in stretches])

        def cost(p, stretches=stretches, squares=squares):
            own = np.concatenate([variances(*np.exp(p), len(x)).sum(axis=0) for x in stretches])
            return 0.5 * np.sum(np.log(own) + squares / own)

        options = {"xatol": 1e-6, "fatol": 1e-8}
        best = np.exp(minimize(cost, np.log([N, K]), method="Nelder-Mead", options=options).x)
        for label, value, std in zip("NK", best, bound(*best, LENGTHS), strict=True):
            # Both use all that the stretches say, but bins average over frequencies: a fifth of an error.
            assert result[label].value == pytest.approx(value, abs=0.2 * std)
            assert result[label].std == pytest.approx(std, rel=0.1)


def test_the_curve_is_that_of_all_stretches_with_their_degrees_of_freedom(whole, fitted):
    curve = aj.allan_deviation(whole, cluster_times=fitted.curve.cluster_time)
    np.testing.assert_allclose(fitted.curve.deviation, curve.deviation, rtol=1e-12)
    alone = aj.allan_deviation(whole.values, RATE, cluster_times=curve.cluster_time)
    # White noise, at the shortest times: as many as there are samples.
    assert fitted.curve.edf[0] == pytest.approx(curve.edf[0], rel=0.02)
    assert curve.edf[0] == pytest.approx(alone.edf[0] * 6848 / 3000, rel=0.01)
    assert fitted.curve.others == (2048, 300, 1500)


def test_terms_are_chosen_from_all_stretches(whole):
    fit = aj.fit(whole, as_is=True)
    alone = aj.select_terms(whole.between(0.0, whole.duration))
    for selection, single in zip(fit.selection.values(), alone.values(), strict=True):
        assert ("angle_random_walk", "rate_random_walk") in [s.terms for s in selection.indistinguishable]
        # White noise alone is less likely than by the longest one.
        found = [{s.terms: s.log_evidence for s in of.ranking} for of in (selection, single)]
        lost = [max(of.values()) - of[("angle_random_walk",)] for of in found]
        assert lost[0] > 1.2 * lost[1] > 0.0


ALONE = {
    "wavelet": ("N + K", "wavelet"),
    "sinusoid": ("N + K + sinusoid(frequency=7 Hz)", "whittle"),
    "response": ("low_pass1(bandwidth=20 Hz) * (N + K)", "whittle"),
}


@pytest.mark.parametrize("why", ALONE)
def test_what_needs_one_record_is_of_the_longest(whole, why):
    model, objective = ALONE[why]
    fit = aj.fit(whole["gyro_x"], model, objective, as_is=True)
    assert any("longest segment" in note and why in note for note in fit.notes)
    alone = aj.fit(whole.between(0.0, whole.duration)["gyro_x"], model, objective, as_is=True)
    assert fit["gyro_x"]["N"] == alone["gyro_x"]["N"]


@pytest.mark.parametrize(("every", "touched"), [(1, True), (9, False)], ids=["touched", "spikes"])
def test_a_stretch_is_used_without_what_happened_in_it(every, touched):
    x = record(42, axes=1)
    x[500:600:every] += 0.5 * np.random.default_rng(1).standard_normal((100, 1))[::every]
    fit = aj.fit(made(x), "N + K")
    assert any("1 of 4 segments" in note for note in fit.notes) == touched
    assert fit["gyro_x"]["N"].value == pytest.approx(N, rel=0.05)
    assert aj.fit(made(x), "N", as_is=True)["gyro_x"]["N"].value > 2.0 * N


@pytest.mark.parametrize("objective", ["allan", "whittle"])
def test_missing_samples_widen_what_is_said_of_a_complete_record(objective):
    """With a share f missing, by √(1/(1 − f) + f): intervals in proportion to the value."""
    # Of white noise that is exact: n(1 − f) samples determine its level, and the draws, which are made at
    # that level, add the scatter of n·f samples.
    x = record(43)[: LENGTHS[0]]
    x[np.random.default_rng(7).random(len(x)) < 0.2, 0] = NAN
    holey = made(x, "fill")
    fit = aj.fit(holey, "N + K", objective, as_is=True)
    complete = aj.fit(dataclasses.replace(holey, missing=None), "N + K", objective, as_is=True)
    share = np.isnan(x).mean(axis=0)
    factors = np.sqrt(1.0 / (1.0 - share) + share)
    assert factors[0] > 1.15
    for result, other, by in zip(fit.results, complete.results, factors, strict=True):
        assert result.widening == pytest.approx(by)
        np.testing.assert_allclose(result.covariance, other.covariance * by**2, rtol=1e-9)
        for label in "NK":
            c, whole = result[label], other[label]
            told = (c.value, c.std, c.upper_limit)
            assert told == pytest.approx((whole.value, by * whole.std, by * whole.upper_limit))
            ends, of = (np.log(np.array([*e.interval, *e.interval_68]) / e.value) for e in (c, whole))
            np.testing.assert_allclose(ends, by * of)


DEAD = {"accel_x": "constant at 0.25 g", "accel_y": "without any number"}


def test_dead_axes_are_named_and_the_others_are_fitted():
    """Two gyros, a stuck accelerometer and one without numbers."""
    x = np.random.default_rng(3).standard_normal((2048, 4)) * 0.01
    x[:, 2], x[:, 3] = 0.25, NAN
    options = {"names": ["gyro_x", "gyro_y", *DEAD], "gyro_unit": "deg/s", "accel_unit": "g"}
    half_dead = aj.Recording.from_array(x, RATE, **options)
    fit, alone = aj.fit(half_dead, "N"), aj.fit(half_dead["gyro"], "N")
    assert (fit.axes, fit.converged) == (("gyro_x", "gyro_y"), False)
    assert list(fit.without_result) == [d.axis.name for d in fit.dead] == list(DEAD)
    for name, why in DEAD.items():
        assert why in fit.without_result[name]
        with pytest.raises(aj.FitError, match=name):
            fit[name]
    for name in fit.axes:
        assert fit[name]["N"] == alone[name]["N"]
    dead = {axis["name"]: axis["dead"] for axis in aj.to_dict(fit)["axes"]}
    assert dead == {name: name in DEAD for name in options["names"]}
