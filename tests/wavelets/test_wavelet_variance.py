"""Wavelet variances against brute-force filters, dense covariances, PyWavelets and the Allan variance."""

import builtins

import numpy as np
import pytest
import pywt
from phase_laws import LAWS, dense, markov, mixed
from scipy import stats

import allanjax as aj

N, RATE = 400, 4.0
# One structure for all cases, compiled once: what a case leaves out is there with next to nothing.
TERMS = {
    "quantization": (1e-9, LAWS["quantization"]),
    "white": (1e-9, LAWS["white"]),
    "flicker": (1e-9, LAWS["flicker"]),
    "walk": (1e-9, LAWS["walk"]),
    "markov": (1e-9, markov(3.0)),
}
CASES = {
    "white": {"white": 1.0},
    "quantization": {"quantization": 0.7},
    "flicker": {"flicker": 1.3},
    "walk": {"walk": 0.4},
    "mixture": {"white": 1.0, "markov": 0.5, "walk": 0.2},
}


def noise(case: str) -> tuple[aj.Model, np.ndarray]:
    """A model, and the covariance of N samples by the laws alone."""
    c = {name: CASES[case].get(name, least) for name, (least, _) in TERMS.items()}
    model = (
        aj.Quantization(c["quantization"]) + aj.AngleRandomWalk(c["white"]) + aj.BiasInstability(c["flicker"])
    )
    model = model + aj.RateRandomWalk(c["walk"]) + aj.Markov(c["markov"], 3.0)
    return model, dense(mixed(*((c[name], law) for name, (_, law) in TERMS.items())), N, RATE)


def filters(name: str, levels: int) -> list[np.ndarray]:
    """Equivalent filters of the MODWT, by brute force: PyWavelets' coefficients with zeros between."""
    wavelet = pywt.Wavelet(name)
    low, high = (np.array(f) / np.sqrt(2.0) for f in (wavelet.dec_lo, wavelet.dec_hi))
    found, passed = [], np.ones(1)
    for k in range(levels):
        spread = [np.zeros(2**k * (len(f) - 1) + 1) for f in (low, high)]
        for with_zeros, f in zip(spread, (low, high), strict=True):
            with_zeros[:: 2**k] = f
        found.append(np.convolve(passed, spread[1]))
        passed = np.convolve(passed, spread[0])
    return found


def rows(h: np.ndarray) -> np.ndarray:
    """The matrix whose rows take the coefficients out of N samples."""
    count = N - len(h) + 1
    return np.stack([np.concatenate([np.zeros(s), h[::-1], np.zeros(count - 1 - s)]) for s in range(count)])


@pytest.fixture(scope="module")
def x() -> np.ndarray:
    return 9.8 + np.random.default_rng(3).standard_normal((N, 2)).cumsum(axis=0) * [1.0, 3.0]


@pytest.mark.parametrize("name", ["haar", "db2", "sym4", "coif1"])
def test_the_estimate_is_the_mean_square_of_what_brute_force_filters_leave(x, name):
    found = aj.wavelet_variance(x, RATE, wavelet=name)
    length = len(pywt.Wavelet(name).dec_lo)
    longest = max(j for j in range(1, 12) if (2**j - 1) * (length - 1) + 1 <= N)
    np.testing.assert_array_equal(found.level, np.arange(1, longest + 1))
    np.testing.assert_array_equal(found.scale, 2.0 ** np.arange(longest) / RATE)
    np.testing.assert_allclose(found.band, RATE / 2.0 ** (found.level[:, None] + [1.0, 0.0]))
    for j, h in enumerate(filters(name, longest)):
        squares = np.array([np.convolve(axis, h, "valid") for axis in x.T]) ** 2
        assert found.count[j] == squares.shape[1]
        np.testing.assert_allclose(found.variance[j], squares.mean(axis=1), rtol=1e-9)
    assert aj.wavelet_variance(x, RATE, wavelet=name, levels=2).level.tolist() == [1, 2]


def test_levels_split_the_variance_as_pywavelets_does():
    """Against the stationary transform of PyWavelets, whose details are ours where no end is near."""
    x = np.random.default_rng(4).standard_normal(256)
    details = pywt.swt(x, "db2", 4, norm=True, trim_approx=True)[:0:-1]
    found = aj.wavelet_variance(x, 1.0, wavelet="db2", levels=4)
    for j, d in enumerate(details):
        # Somewhere on its circle there are as many in a row.
        turned = np.concatenate([d, d])[:-1] ** 2
        count = found.count[j]
        means = np.convolve(turned, np.ones(count) / count, "valid")
        assert abs(means / found.variance[j, 0] - 1.0).min() < 1e-9


def test_of_haar_it_is_half_the_allan_variance(x):
    found, curve = aj.wavelet_variance(x, RATE), aj.allan_deviation(x, RATE)
    np.testing.assert_array_equal(found.scale, curve.cluster_time)
    np.testing.assert_array_equal(found.count, curve.count)
    np.testing.assert_allclose(found.variance, curve.variance / 2.0, rtol=1e-10)
    np.testing.assert_allclose(found.edf, curve.edf, rtol=1e-9)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("name", ["db2", "sym4"])
def test_expectation_and_covariance_are_those_of_the_dense_matrix(x, name, case):
    """The expectation is exact, the covariance to what the few coefficients make.

    That factor is exact under white noise. Of the last level of db2 there are 19 coefficients, which overlap
    so much that they count for one: of a random walk its variance is 6 % off, of quantization, which no
    record shows at such a level, 27 %. The others are within 1 %.
    """
    model, C = noise(case)
    found = aj.wavelet_variance(x, RATE, wavelet=name, model=model)
    taken = [rows(h) for h in filters(name, len(found.level))]
    mean = np.array([np.einsum("ti,ij,tj->t", A[:1], C, A[:1])[0] for A in taken])
    within = [A @ C for A in taken]
    exact = np.array([[2.0 * np.mean((a @ B.T) ** 2) for B in taken] for a in within])
    np.testing.assert_allclose(found.expectation(model), mean, rtol=2e-6)
    scale = np.sqrt(np.diag(exact))
    covariance = found.covariance(model)
    error = (covariance - exact) / np.outer(scale, scale)
    assert abs(np.diag(error)[:-1]).max() < (1e-5 if case == "white" else 0.01)
    last = {"db2": 0.3 if case == "quantization" else 0.08, "sym4": 0.04}[name]
    assert abs(error).max() < (1e-5 if case == "white" else last)
    # Degrees of freedom are those of the model; without one those of white noise.
    np.testing.assert_allclose(found.edf.T, np.tile(2.0 * mean**2 / np.diag(covariance), (2, 1)), rtol=1e-5)
    if case == "white":
        np.testing.assert_allclose(aj.wavelet_variance(x, RATE, wavelet=name).edf, found.edf, rtol=1e-6)


@pytest.mark.parametrize("level", [0.68, 0.95])
def test_errors_and_intervals_are_those_of_the_chi_squared_law(x, level):
    found = aj.wavelet_variance(x, RATE)
    lower, upper = found.confidence_interval(level)
    low, high = (stats.chi2(found.edf).ppf(p) for p in ((1.0 - level) / 2.0, (1.0 + level) / 2.0))
    np.testing.assert_allclose(lower, found.variance * found.edf / high, rtol=1e-9)
    np.testing.assert_allclose(upper, found.variance * found.edf / low, rtol=1e-9)
    np.testing.assert_allclose(found.standard_error, found.variance * np.sqrt(2.0 / found.edf))
    if level == 0.95:
        np.testing.assert_array_equal(found.confidence_interval(), (lower, upper))


def test_a_ramp_is_seen_by_haar_only():
    ramp = np.arange(N, dtype=float)
    found = aj.wavelet_variance(ramp, RATE)
    # Half of R²T²/2, a ramp of RATE per second.
    np.testing.assert_allclose(found.variance[:, 0], (found.scale * RATE) ** 2 / 4.0, rtol=1e-9)
    assert aj.wavelet_variance(ramp, RATE, wavelet="db2").variance.max() < 1e-18 * N**2


def test_high_levels_of_long_records():
    """Of white noise the expectation is the energy 2^−j of the filter, at 16 levels, too."""
    x = np.random.default_rng(1).standard_normal(2**18)
    found = aj.wavelet_variance(x, RATE, wavelet="sym4")
    white = noise("white")[0]
    assert len(found.level) == 15
    np.testing.assert_allclose(found.expectation(white), RATE * 0.5**found.level, rtol=1e-4)
    # White noise of N = 1/√RATE; four standard errors.
    np.testing.assert_array_less(
        abs(found.variance * 2.0 ** found.level[:, None] - 1.0), 4.0 * np.sqrt(2.0 / found.edf)
    )


def test_tables_have_units(x):
    axes = (aj.Axis("gyro_x", "gyro", "deg/s"), aj.Axis("accel_z", "accel", "g"))
    found = aj.wavelet_variance(aj.Recording(x, RATE, axes), wavelet="db2")
    np.testing.assert_array_equal(found.variance, aj.wavelet_variance(x, RATE, wavelet="db2").variance)
    table = found.to_dataframe()
    units = {"gyro_x": ("(deg/h)²", (np.pi / 180.0 / 3600.0) ** 2), "accel_z": ("µg²", 9.80665e-6**2)}
    lower, upper = found.confidence_interval(0.68)
    for k, (name, (unit, scale)) in enumerate(units.items()):
        for label, column in (("", found.variance), (" lower_68", lower), (" upper_68", upper)):
            np.testing.assert_allclose(table[f"{name}{label} [{unit}]"], column[:, k] / scale)
        np.testing.assert_array_equal(table[f"{name} degrees of freedom"], found.edf[:, k])
    np.testing.assert_array_equal(table[["from [Hz]", "to [Hz]"]], found.band)
    np.testing.assert_array_equal(table["scale [s]"], found.scale)


REFUSED = {
    "not orthogonal": ({"wavelet": "bior2.2"}, "'bior2.2'"),
    "levels": ({"wavelet": "db2", "levels": 9}, "7"),
    "no level": ({"levels": 0}, "1 to 8"),
    "no values": ({"model": "N"}, "angle_random_walk"),
    "resonance": ({"model": aj.AngleRandomWalk(1.0) + aj.Resonance(1.0, 1.0, 50.0)}, "resonance"),
    "line": ({"model": aj.AngleRandomWalk(1.0) + aj.Sinusoid(1.0, 0.5)}, "sinusoid"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refused(x, name):
    options, word = REFUSED[name]
    with pytest.raises(aj.AllanjaxError) as refused:
        aj.wavelet_variance(x, RATE, **options)
    assert word in str(refused.value)


def test_haar_does_without_pywavelets(x, monkeypatch):
    real = builtins.__import__

    def without(name, *args, **kwargs):
        if name == "pywt":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(aj.AllanjaxError, match=r"allanjax\[wavelets\]"):
        aj.wavelet_variance(x, RATE, wavelet="db2")
    assert aj.wavelet_variance(x, RATE).level[-1] == 8
