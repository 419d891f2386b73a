"""Fits to wavelet variances: the estimating equation by dense matrices, and what such a fit refuses."""

import numpy as np
import pytest
import pywt
from scipy.linalg import toeplitz

import allanjax as aj
from allanjax.fleet.stream import AllanAccumulator
from allanjax.posterior.likelihood import likelihood_of

N, RATE = 600, 4.0
# Lags [s] at which the covariances of samples are written out.
LAG = np.arange(N) / RATE


@pytest.fixture(scope="module")
def recording():
    model = aj.AngleRandomWalk(1e-3) + aj.RateRandomWalk(3e-4)
    return aj.simulate_recording({"gyro_x": model, "gyro_y": model}, N, RATE, 11)


@pytest.fixture(scope="module")
def by_db2(recording):
    return aj.fit(recording, "N + K", objective="wavelet", wavelet="db2", as_is=True)


def coefficient_matrices(name):
    """Rows that take all coefficients of every level out of a record, from PyWavelets' filters."""
    wavelet = pywt.Wavelet(name)
    low, high = (np.array(f)[::-1] / np.sqrt(2.0) for f in (wavelet.dec_lo, wavelet.dec_hi))
    smooth, found = np.eye(N), []
    step = 1
    while len(smooth) > step * (len(low) - 1):
        count = len(smooth) - step * (len(low) - 1)
        parts = [sum(c * smooth[k * step : k * step + count] for k, c in enumerate(f)) for f in (high, low)]
        found.append(parts[0])
        smooth, step = parts[1], 2 * step
    return found


def test_the_fit_solves_the_estimating_equation_of_the_dense_covariance(recording, by_db2):
    """D'C⁻¹(V − μ) = 0 with C and μ at the fit itself: a Newton step from there is no step.

    All of it by dense matrices: white noise N²·rate, and the walk's −K²|t|/2 with its mean over an interval.
    The package's covariance is 6 % off at the last level, hence a tenth of a standard deviation.
    """
    walk = -LAG / 2.0
    walk[0] = -1.0 / (6.0 * RATE)
    unit = [RATE * np.eye(N), toeplitz(walk)]
    taken = coefficient_matrices("db2")
    for k, name in enumerate(("gyro_x", "gyro_y")):
        power = np.array([by_db2[name][c].value ** 2 for c in ("angle_random_walk", "rate_random_walk")])
        V = np.array([np.mean((A @ recording.values[:, k]) ** 2) for A in taken])
        D = np.array([[np.einsum("ti,ij,tj->t", A[:1], C, A[:1])[0] for C in unit] for A in taken])
        whole = power[0] * unit[0] + power[1] * unit[1]
        C = np.array([[2.0 * np.mean((A @ whole @ B.T) ** 2) for B in taken] for A in taken])
        information = D.T @ np.linalg.solve(C, D)
        step = np.linalg.solve(information, D.T @ np.linalg.solve(C, V - D @ power))
        std = np.sqrt(np.diag(np.linalg.inv(information)))
        assert (abs(step) < 0.1 * std).all()
        # Standard deviations of the amplitudes are half of those of the powers, relatively.
        for c, p, s in zip(("angle_random_walk", "rate_random_walk"), power, std, strict=True):
            assert by_db2[name][c].std == pytest.approx(s / (2.0 * np.sqrt(p)), rel=0.15)


def test_of_haar_it_is_the_fit_of_the_allan_variances_at_octaves(recording):
    found = aj.fit(recording, "N + K", objective="wavelet", as_is=True)
    assert found.objective == "wavelet"
    np.testing.assert_array_equal(found.curve.cluster_size, 2 ** np.arange(9))
    dense = aj.fit(recording, "N + K", as_is=True)
    for c in ("angle_random_walk", "rate_random_walk"):
        some, other = found["gyro_x"][c], dense["gyro_x"][c]
        # Four an octave know little more.
        assert abs(some.value - other.value) < 0.3 * other.std


def test_terms_that_a_wavelet_does_not_see_are_refused(recording):
    for model, name in (("N + K + R", "drift_ramp"), ("N + sinusoid", "sinusoid")):
        with pytest.raises(aj.FitError, match=f'do not determine {name}: .*wavelet="haar"'):
            aj.fit(recording, model, objective="wavelet", wavelet="db2", as_is=True)
    short = aj.Recording.from_array(
        recording.values[:60], RATE, gyro_unit="rad/s", names=["gyro_x", "gyro_y"]
    )
    with pytest.raises(aj.FitError, match="give 3 wavelet variances, too few for 3 parameters"):
        aj.fit(short, "N + B + K", objective="wavelet", wavelet="sym4", as_is=True)


def test_what_has_no_wavelet_variances_says_so(by_db2):
    with pytest.raises(aj.FitError, match='no likelihood to sample; fit with objective="whittle"'):
        likelihood_of(by_db2, "gyro_x")
    with pytest.raises(aj.AllanjaxError, match="needs the samples themselves"):
        AllanAccumulator(RATE, ["gyro_x"]).fit("N", "wavelet")


def test_a_fit_that_was_led_far_off_at_first_needs_no_error_of_the_model_at_last():
    """One of 130 records on which the first steps called the right model incomplete, and never came back."""
    model = aj.Quantization(0.5) + aj.AngleRandomWalk(1.0) + aj.Markov(2.0, 20.0)
    recording = aj.simulate_recording({f"gyro_{k}": model for k in range(10)}, 32_768, 100.0, 3)
    one = aj.Recording(recording.values[:, [7]], 100.0, recording.axes[7:8])
    terms = aj.Quantization() + aj.AngleRandomWalk() + aj.Markov()
    (found,) = aj.fit(one, terms, "wavelet", as_is=True, vibrating=True).results
    assert found.converged, found.reason
    assert found.discrepancy == 0.0
    for label, truth in (("quantization", 0.5), ("angle_random_walk", 1.0), ("markov_amplitude", 2.0)):
        # Four deviations.
        assert abs(found[label].value - truth) < 4.0 * found[label].std
