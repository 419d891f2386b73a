"""Estimates, standard deviations and χ² of every objective, against dense matrices and scipy's optimum."""

import dataclasses

import numpy as np
import pytest
import pywt
from dense_fits import Gaussian, Spectrum, Variances, drawn, fitted, recording
from scipy.linalg import qr
from scipy.stats import chi2, norm

import allanjax as aj

RATE, N = 10.0, 256
WHITE, WALK = aj.AngleRandomWalk(0.1), aj.RateRandomWalk(0.06)
AFTER = aj.AngleRandomWalk(0.01)

# Whatever starts with these values; records of seeds in which every term is well inside its range.
SPECTRA = {
    "N + K": (WHITE + WALK, 5),
    "N + B": (WHITE + aj.BiasInstability(0.3), 5),
    "Q + N": (aj.Quantization(0.03) + WHITE, 5),
    "N + markov": (WHITE + aj.Markov(0.5, 1.5), 7),
    "N + held time": (WHITE + aj.Markov(0.5, 1.5).hold("correlation_time"), 7),
    "N + A": (aj.AngleRandomWalk(0.05) + aj.PowerLaw(0.1, 1.6), 5),
    "N + resonance": (WHITE + aj.Resonance(0.4, 2.0, 6.0), 5),
    "one pole": (aj.LowPass1(1.5) * (WHITE + aj.RateRandomWalk(0.2)), 5),
    "held pole": (aj.LowPass1(1.5).hold("bandwidth") * (WHITE + aj.RateRandomWalk(0.2)), 3),
    "two poles": (aj.LowPass2(1.5, 0.8) * WHITE + AFTER, 3),
    "Butterworth": (aj.Butterworth(2.0, order=3) * WHITE + AFTER, 5),
    "biquad": (aj.Biquad(1.5, 0.8) * WHITE + AFTER, 3),
    "mean": (aj.MovingAverage(2.0) * WHITE, 5),
}


def check_maximum(result, dense, model, found, of_std, width):
    """Estimates are the most likely ones, and their deviations those of the dense law, to a share of each."""
    labels = [label for label, c in result.coefficients.items() if not c.held]
    best, std = dense.maximum(model, labels), dense.std(found, labels)
    for label in labels:
        assert abs(result[label].value - best.values[label]) < of_std * std[label], label
        assert result[label].std == pytest.approx(std[label], rel=width), label


def check_verdict(result, x, model, found):
    """χ² is that of the spectrum under the fitted model, whatever was fitted."""
    edges = aj.fit(recording(x, RATE), model, "whittle", as_is=True).results[0].spectrum.bins.edges
    dense = Spectrum(x, RATE, edges)
    assert result.chi2 == pytest.approx(dense.chi2(found), rel=1e-3)
    assert result.dof == len(dense.count) - sum(not c.held for c in result.coefficients.values())
    assert result.p_value == pytest.approx(chi2.sf(result.chi2, result.dof), rel=1e-6)


def dear(names, *rare):
    """All names; of terms beyond the joint model's own, each compiles for 15 s: these are for the studies."""
    return [pytest.param(name, marks=[pytest.mark.study] * (name in rare)) for name in names]


@pytest.mark.parametrize("name", dear(SPECTRA, "N + A"))
def test_whittles_estimate_is_the_maximum_and_its_error_the_inverse_information(name):
    """Independent χ² levels about the diagonal of the dense covariance of the cosine coefficients."""
    # The first 64 have their exact expectation; of higher ones that are not white, and of flicker, the
    # density at two nodes of a bin stands for it: 2 % of a standard deviation, 1 % of it.
    model, seed = SPECTRA[name]
    x = drawn(model, N, RATE, seed)[:, 0]
    result, found, _labels = fitted(model, x, "whittle", RATE)
    dense = Spectrum(x, RATE, result.spectrum.bins.edges)
    check_maximum(result, dense, model, found, 0.02, 0.01)
    for c in result.coefficients.values():
        if not c.is_amplitude:
            # Normal in the logarithm of the distance from the lower bound.
            low = c.parameter.lower
            for ends, z in ((c.interval, 1.95996), (c.interval_68, 0.99446)):
                ratio = np.exp(z * c.std / (c.value - low) * np.array([-1.0, 1.0]))
                np.testing.assert_allclose(ends, low + (c.value - low) * ratio, rtol=1e-4)
    check_verdict(result, x, model, found)


@pytest.mark.parametrize(("name", "of_std"), [("N + K", 0.02), ("N + B", 0.1), ("Q + N", 0.25)])
def test_whittles_estimate_is_near_that_of_the_samples_themselves(name, of_std):
    """The dense Gaussian likelihood without bins."""
    # Coefficients correlate a little under flicker, and under quantization, whose end readings all share.
    model, seed = SPECTRA[name]
    x = drawn(model, N, RATE, seed)[:, 0]
    result, found, _ = fitted(model, x, "whittle", RATE)
    check_maximum(result, Gaussian(x, RATE), model, found, of_std, 0.05)


@pytest.mark.parametrize("name", dear(["N + K", "N + B", "Q + N", "N + markov", "stream"], "N + markov"))
def test_allan_variances_are_fitted_by_generalized_least_squares(name):
    """D'C⁻¹(V − μ) = 0 with all of it by quadratic forms: a further step is 5 % of a standard deviation."""
    # A thousandth is where the solver stops; the rest is the quadrature of its covariance over lags (half a
    # per cent), multiplied by 16 estimates that know much the same.
    model, seed = SPECTRA["N + K" if name == "stream" else name]
    # Of half the samples most seeds leave no more than a limit of a correlation time.
    x = drawn(model, 128, RATE, 12 if name == "N + markov" else seed)
    stream = aj.AllanAccumulator(RATE, ["gyro_x"])
    stream.update(x)
    fit = stream.fit(model, as_is=True) if name == "stream" else aj.fit(recording(x, RATE), model, as_is=True)
    (result,) = fit.results
    assert (result.converged, result.discrepancy) == (True, 0.0)
    values = {label: c.value for label, c in result.coefficients.items()}
    found, labels = model.with_values(**values), list(values)
    dense = Variances.of_allan(x[:, 0], RATE, fit.curve.cluster_size, fit.curve.strides)
    np.testing.assert_allclose(fit.curve.deviation[:, 0] ** 2, dense.found, rtol=1e-9)
    step, std, _ = dense.step(found, labels)
    assert (abs(step) < 0.05 * std).all()
    relative = [c.std / (c.value - c.parameter.lower) for c in result.coefficients.values()]
    np.testing.assert_allclose(relative, std, rtol=0.02)
    # The verdict is the spectrum's, which that of a short stream is, too.
    check_verdict(result, x[:, 0], model, found)
    # The curve's degrees of freedom are those under the fitted model.
    mean, C = dense.moments(found)
    np.testing.assert_allclose(fit.curve.edf[:, 0], 2.0 * mean**2 / np.diag(C), rtol=0.02)


def wavelet_forms(name, n):
    """Rows that take all coefficients of every level out of a record, from PyWavelets' filters."""
    low, high = (np.array(f)[::-1] / np.sqrt(2.0) for f in pywt.Wavelet(name).filter_bank[:2])
    smooth, forms, step = np.eye(n), [], 1
    while len(smooth) > step * (len(low) - 1):
        count = len(smooth) - step * (len(low) - 1)
        parts = [sum(c * smooth[k * step : k * step + count] for k, c in enumerate(f)) for f in (high, low)]
        forms.append(parts[0])
        smooth, step = parts[1], 2 * step
    return forms


@pytest.mark.parametrize(("wavelet", "of_std"), [("haar", 0.02), ("db2", 0.1)])
def test_wavelet_variances_are_fitted_by_generalized_least_squares(wavelet, of_std):
    """As above. The covariance of db2 is 6 % off at the last level: a tenth of a standard deviation."""
    model, seed = SPECTRA["N + K"]
    x = drawn(model, N, RATE, seed)[:, 0]
    result, found, labels = fitted(model, x, "wavelet", RATE, wavelet=wavelet)
    dense = Variances(x, RATE, wavelet_forms(wavelet, N))
    step, std, _ = dense.step(found, labels)
    assert (abs(step) < of_std * std).all()
    relative = [c.std / c.value for c in result.coefficients.values()]
    np.testing.assert_allclose(relative, std, rtol=0.1)
    check_verdict(result, x, model, found)


@pytest.mark.parametrize("name", ["N + K", "N + markov"])
def test_the_exact_likelihood_is_that_of_the_samples_themselves(name):
    """Maximum to the step at which the climb ends: a gain of 10⁻⁵ nats is 0.5 % of a standard deviation."""
    # The information is that of the innovations found, which scatters about the dense law's expected one.
    model, seed = SPECTRA[name]
    x = drawn(model, N, RATE, seed)[:, 0] + 3.0
    result, found, _ = fitted(model, x, "exact", RATE)
    check_maximum(result, Gaussian(x, RATE), model, found, 0.01, 0.1)


def test_exact_intervals_and_limits_are_where_the_likelihood_ratio_has_fallen():
    """By the profile of the dense likelihood; the fit's goes along a line, through few hypotheses."""
    model, seed = SPECTRA["N + K"]
    x = drawn(model, N, RATE, seed)[:, 0]
    result, found, _ = fitted(model, x, "exact", RATE)
    dense, c = Gaussian(x, RATE), result["K"]
    ends = [*c.interval, *c.interval_68, c.upper_limit]
    for end, level in zip(ends, np.abs(norm.ppf([0.025, 0.975, 0.16, 0.84, 0.95])), strict=True):
        assert dense.ratio(found, c.label, end) == pytest.approx(level, rel=0.08)


def test_exact_fits_leave_missing_samples_out():
    model, seed = SPECTRA["N + K"]
    x = drawn(model, N, RATE, seed)[:, 0]
    lost = (np.arange(N) >= 100) & (np.arange(N) < 150)
    spoilt = np.where(lost, x.mean(), x)
    holey = dataclasses.replace(recording(spoilt, RATE), missing=lost[:, None])
    result = aj.fit(holey, "N + K", "exact", as_is=True)["gyro_0"]
    check_maximum(result, Gaussian(spoilt, RATE, lost), model, result.model, 0.01, 0.1)


def test_a_temperature_that_holds_its_values_is_no_random_walk():
    """Regressed on as steps, it leaves what looks like a random walk, here five to twelve times K."""
    n, rate, N, K, seed = 100_000, 20.0, 5.8e-5, 8.1e-8, 4
    t, (white, steps) = np.arange(n) / rate, np.random.default_rng(seed).normal(size=(2, n))
    noise = N * np.sqrt(rate) * white + K / np.sqrt(rate) * np.cumsum(steps)
    exact = 25.0 - 6.0 * np.exp(-t / 1500.0) + 0.8 * np.sin(2.0 * np.pi * t / 1900.0 + seed)
    read_every_second = np.repeat(exact[::20], 20)
    found = {}
    shown = {"exact": exact, "held": read_every_second, "rounded": np.round(exact, 1)}
    for name, temperature in (shown | {"both": np.round(read_every_second, 1)}).items():
        whole = recording(noise + 1.9e-4 * exact, rate, temperature=temperature)
        fit = aj.fit(whole, "N + K", "whittle", regressors=["temperature"], as_is=True)
        found[name] = fit["gyro_0"]
    for result in found.values():
        assert result["K"].interval[0] < K < result["K"].upper_limit
        # As with the exact temperature, of which the curve is off by 5 mK, a tenth of a step.
        assert result["K"].upper_limit == pytest.approx(found["exact"]["K"].upper_limit, rel=0.15)
        assert result.regression["temperature"][0] == pytest.approx(1.9e-4, rel=0.01)


def test_a_regressor_is_estimated_by_generalized_least_squares():
    """And the noise by the likelihood of contrasts that are orthogonal to the mean and the regressor."""
    model = WHITE + WALK
    temperature = 20.0 + np.cumsum(np.random.default_rng(7).normal(size=N)) / 10.0
    x = drawn(model, N, RATE, 5)[:, 0] + 0.05 * temperature
    whole = recording(x, RATE, temperature=temperature)
    result = aj.fit(whole, model, "whittle", regressors=["temperature"], as_is=True)["gyro_0"]
    dense, found = Gaussian(x, RATE), result.model
    V, z, y = dense.covariance(found), dense.D @ temperature, dense.z
    precision = z @ np.linalg.solve(V, z)
    beta, std = result.regression["temperature"]
    assert std == pytest.approx(precision**-0.5, rel=0.01)
    assert beta == pytest.approx(z @ np.linalg.solve(V, y) / precision, abs=0.02 * std)
    # Without the regressor: the rest of an orthonormal base that begins with it. The degrees of freedom are
    # shared out before, by the noise of the round before.
    dense.D = qr(z[:, None])[0][:, 1:].T @ dense.D
    dense.z = dense.D @ x
    check_maximum(result, dense, model, found, 0.1, 0.05)
