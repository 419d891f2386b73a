"""Coefficients of records in several stretches: against the Gaussian likelihood of their differences."""

import numpy as np
import pytest
from scipy.linalg import cholesky_banded, solveh_banded
from scipy.optimize import minimize

import allanjax as aj

RATE, N, K = 100.0, 1e-3, 2e-3
LENGTHS = (2500, 6000, 300, 4000)


def record(seed=41, axes=2):
    """A walk in white noise, of which a sample is missing between the stretches."""
    rng, n = np.random.default_rng(seed), sum(LENGTHS) + len(LENGTHS) - 1
    x = N * np.sqrt(RATE) * rng.standard_normal((n, axes))
    x += K / np.sqrt(RATE) * np.cumsum(rng.standard_normal((n, axes)), axis=0)
    x[np.cumsum(np.array(LENGTHS[:-1]) + 1) - 1] = np.nan
    return x


def made(x, gaps="segments"):
    names = [f"gyro_{axis}" for axis in "xyz"[: x.shape[1]]]
    return aj.Recording.from_array(x, RATE, gyro_unit="rad/s", names=names, gaps=gaps)


def exact(stretches, rate):
    """Maximum of the likelihood of ln N and ln K, and their covariance, from differences of samples.

    They have no mean; their covariance has three diagonals: 2·N²·rate + K²/rate, and −N²·rate beside it.
    """
    differences = [np.diff(z) for z in stretches]

    def cost(p):
        white, walk = np.exp(2.0 * np.asarray(p))
        found = 0.0
        for d in differences:
            banded = np.array(
                [np.full(len(d), -white * rate), np.full(len(d), 2 * white * rate + walk / rate)]
            )
            root = cholesky_banded(banded)
            found += np.log(root[1]).sum() + 0.5 * d @ solveh_banded(banded, d)
        return found

    best = minimize(cost, np.log([N, K]), method="Nelder-Mead", options={"xatol": 1e-5, "fatol": 1e-6}).x
    h = 0.02
    steps = h * np.eye(2)
    hessian = [
        [
            (cost(best + a + b) - cost(best + a - b) - cost(best - a + b) + cost(best - a - b)) / (4 * h**2)
            for b in steps
        ]
        for a in steps
    ]
    return np.exp(best), np.sqrt(np.diag(np.linalg.inv(hessian)))


@pytest.fixture(scope="module")
def recording():
    return made(record())


@pytest.fixture(scope="module")
def fitted(recording):
    return aj.fit(recording, "N + K", as_is=True)


def test_coefficients_are_those_of_the_likelihood_of_all_stretches(recording, fitted):
    assert recording.n == 6000
    assert [len(other) for other in recording.others] == [2500, 300, 4000]
    assert fitted.objective == "whittle"
    assert any("of 4 stretches together, 12800 samples" in note for note in fitted.notes)
    for k, result in enumerate(fitted.values()):
        values, errors = exact([x[:, k] for x in (recording.values, *recording.others)], RATE)
        for label, value, error in zip("NK", values, errors, strict=True):
            # Both use all that the stretches say, but bins average over frequencies: a fifth of an error.
            assert result[label].value == pytest.approx(value, rel=0.2 * error)
            assert result[label].std == pytest.approx(error * value, rel=0.1)


def test_the_longest_alone_says_less(recording, fitted):
    alone = aj.fit(recording.between(0.0, recording.duration), "N + K", "whittle", as_is=True)
    for label, ratio in (("N", np.sqrt(6000 / 12_800)), ("K", np.sqrt(6000 / 12_500))):
        found = fitted["gyro_x"][label].std / alone["gyro_x"][label].std
        # The errors of K depend on its estimate, which differs by some of them.
        assert found == pytest.approx(ratio, rel=0.05 if label == "N" else 0.35)


def test_the_curve_is_that_of_all_stretches_with_their_degrees_of_freedom(recording, fitted):
    curve = aj.allan_deviation(recording, cluster_times=fitted.curve.cluster_time)
    np.testing.assert_allclose(fitted.curve.deviation, curve.deviation, rtol=1e-12)
    whole = aj.allan_deviation(recording.values, RATE, cluster_times=curve.cluster_time)
    assert (fitted.curve.edf > whole.edf).any()
    # White noise, at the shortest times: as many as there are samples.
    assert fitted.curve.edf[0] == pytest.approx(curve.edf[0], rel=0.02)
    assert curve.edf[0] == pytest.approx(whole.edf[0] * 12_800 / 6000, rel=0.01)


def test_terms_are_chosen_from_all_stretches(recording):
    fit = aj.fit(recording, as_is=True)
    alone = aj.select_terms(recording.between(0.0, recording.duration))
    for selection, single in zip(fit.selection.values(), alone.values(), strict=True):
        assert ("angle_random_walk", "rate_random_walk") in [s.terms for s in selection.indistinguishable]
        # White noise alone is less likely than by the longest one.
        lost = [
            found.best.log_evidence
            - next(s.log_evidence for s in found.ranking if s.terms == ("angle_random_walk",))
            for found in (selection, single)
        ]
        assert lost[0] > 1.2 * lost[1] > 0.0


def test_what_needs_one_record_is_of_the_longest(recording):
    longest = recording.between(0.0, recording.duration)
    for model, objective, why in (
        ("N + K", "wavelet", 'objective="wavelet" has one stretch'),
        ("N + K + sinusoid(frequency=7 Hz)", "whittle", "sinusoid is found in one stretch only"),
        ("low_pass1(bandwidth=20 Hz) * (N + K)", "whittle", "responses are fitted to one stretch"),
    ):
        fit = aj.fit(recording["gyro_x"], model, objective, as_is=True)
        assert any(f"the longest stretch alone: {why}" in note for note in fit.notes)
        alone = aj.fit(longest["gyro_x"], model, objective, as_is=True)
        assert fit["gyro_x"]["N"] == alone["gyro_x"]["N"]


def test_a_stretch_in_which_the_sensor_was_touched_is_left_out():
    x = record(42, axes=1)
    x[500:600] += 0.5 * np.random.default_rng(1).standard_normal((100, 1))
    fit = aj.fit(made(x), "N + K")
    assert any("1 of 4 stretches not used" in note for note in fit.notes)
    assert fit["gyro_x"]["N"].value == pytest.approx(N, rel=0.05)
    assert aj.fit(made(x), "N", as_is=True)["gyro_x"]["N"].value > 2.0 * N


def test_a_fit_that_is_loaded_tells_of_all_stretches(fitted, tmp_path):
    aj.write_json(fitted, tmp_path / "fit.json")
    again = aj.load(tmp_path / "fit.json")
    assert again.curve.others == (2500, 300, 4000)
    assert "6,000 samples at 100 Hz (60 s) and 6,800 in 3 other stretches" in str(again)


def test_axes_are_selected_in_all_stretches(recording):
    one = recording["gyro_y"]
    for mine, whole in zip(one.others, recording.others, strict=True):
        np.testing.assert_array_equal(mine[:, 0], whole[:, 1])
    assert recording.between(1.0, 20.0).others == ()
