"""Wavelet and Allan variances, octaves, de-noising: by brute-force filters, dense matrices and PyWavelets."""

import functools
import sys
from types import SimpleNamespace

import dense
import numpy as np
import pytest
import pywt
from dense_fits import Variances
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refuses

import allanjax as aj

N, RATE = 400, 4.0
LONG, FAST = 3001, 10.0
AXES = (aj.Axis("gyro_x", "gyro", "deg/s"), aj.Axis("accel_z", "accel", "g"))
UNITS = {"gyro_x": ("deg/h", "(deg/h)²", np.pi / 180.0 / 3600.0), "accel_z": ("µg", "µg²", 9.80665e-6)}


def model_of(
    quantization=1e-9, white=1e-9, flicker=1e-9, walk=1e-9, markov=1e-9, T_c=1.0, ramp=1e-12
) -> aj.Model:
    """One structure for all cases, compiled once: what a case leaves out is there with next to nothing."""
    model = aj.Quantization(quantization) + aj.AngleRandomWalk(white) + aj.BiasInstability(flicker)
    return model + aj.RateRandomWalk(walk) + aj.Markov(markov, T_c) + aj.DriftRamp(ramp)


ALONE = {"white": 1.0, "quantization": 0.7, "flicker": 1.3, "walk": 0.4}
CASES = {label: model_of(**{label: size}) for label, size in ALONE.items()}
CASES["mixture"] = model_of(white=1.0, markov=0.5, walk=0.2, T_c=3.0)


def filters(name: str, levels: int) -> list[np.ndarray]:
    """Equivalent filters of the MODWT, by brute force: PyWavelets' coefficients with zeros between."""
    low, high = (np.array(f) / np.sqrt(2.0) for f in pywt.Wavelet(name).filter_bank[:2])
    found, passed = [], np.ones(1)
    for k in range(levels):
        spread = np.zeros((2, 2**k * (len(low) - 1) + 1))
        spread[:, :: 2**k] = low, high
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
    assert_array_equal(found.level, np.arange(1, longest + 1))
    assert_array_equal(found.scale, 2.0 ** np.arange(longest) / RATE)
    assert_allclose(found.band, RATE / 2.0 ** (found.level[:, None] + [1.0, 0.0]))
    assert_array_equal(found.to_dataframe()[["from [Hz]", "to [Hz]"]], found.band)
    for j, h in enumerate(filters(name, longest)):
        squares = np.array([np.convolve(axis, h, "valid") for axis in x.T]) ** 2
        assert found.count[j] == squares.shape[1]
        assert_allclose(found.variance[j], squares.mean(axis=1), rtol=1e-9)
    assert aj.wavelet_variance(x, RATE, wavelet=name, levels=2).level.tolist() == [1, 2]


def test_of_haar_it_is_half_the_allan_variance(x):
    found, curve = aj.wavelet_variance(x, RATE), aj.allan_deviation(x, RATE)
    assert_array_equal(found.scale, curve.cluster_time)
    assert_array_equal(found.count, curve.count)
    assert_allclose(found.variance, curve.variance / 2.0, rtol=1e-10)
    assert_allclose(found.edf, curve.edf, rtol=1e-9)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("name", ["db2", "sym4"])
def test_expectation_and_covariance_are_those_of_the_dense_matrix(x, name, case):
    """The expectation is exact, the covariance to what the few coefficients make."""
    # That factor is exact under white noise. Of the last level of db2 there are 19 coefficients, which
    # overlap so much that they count for one: of a random walk its variance is 6 % off, of quantization,
    # which no record shows at such a level, 27 %. The others are within 1 %.
    model, C = CASES[case], dense.covariance(CASES[case], N, RATE)
    found = aj.wavelet_variance(x, RATE, wavelet=name, model=model)
    taken = [rows(h) for h in filters(name, len(found.level))]
    mean = np.array([np.einsum("ti,ij,tj->t", A[:1], C, A[:1])[0] for A in taken])
    within = [A @ C for A in taken]
    exact = np.array([[2.0 * np.mean((a @ B.T) ** 2) for B in taken] for a in within])
    assert_allclose(found.expectation(model), mean, rtol=2e-6)
    scale = np.sqrt(np.diag(exact))
    covariance = found.covariance(model)
    error = (covariance - exact) / np.outer(scale, scale)
    assert abs(np.diag(error)[:-1]).max() < (1e-5 if case == "white" else 0.01)
    last = {"db2": 0.3 if case == "quantization" else 0.08, "sym4": 0.04}[name]
    assert abs(error).max() < (1e-5 if case == "white" else last)
    # Degrees of freedom are those of the model; without one those of white noise.
    assert_allclose(found.edf.T, np.tile(2.0 * mean**2 / np.diag(covariance), (2, 1)), rtol=1e-5)
    if case == "white":
        assert_allclose(aj.wavelet_variance(x, RATE, wavelet=name).edf, found.edf, rtol=1e-6)


# Tolerance relative to the variances: between kinks polynomials are summed exactly, the others nearly.
OF_HAAR = {
    "quantization": (model_of(quantization=1.0), 1e-8), "white": (model_of(white=1.0), 1e-8),
    "walk": (model_of(walk=1.0), 1e-7), "flicker": (model_of(flicker=1.3), 1e-3),
    "all powers": (model_of(quantization=0.5, white=1.0, walk=0.1), 1e-7),
    "white and ramp": (model_of(white=1.0, ramp=0.05), 1e-7),
    "walk and ramp": (model_of(walk=1.0, ramp=0.05), 1e-7),
    "short markov": (model_of(markov=1.0, T_c=0.6), 1e-3),
    "long markov": (model_of(white=1.0, markov=1.0, T_c=15.0), 1e-3),
}  # fmt: skip


@pytest.mark.parametrize("name", OF_HAAR)
def test_covariance_is_the_sum_over_all_pairs_of_differences(name):
    """Of Haar's twice those of overlapping Allan variances. A ramp is the same in every record."""
    model, tolerance = OF_HAAR[name]
    for n in (16, 17, 300):
        x = np.random.default_rng(n).normal(size=n)
        found = aj.wavelet_variance(x, RATE, model=model)
        sizes = (found.scale * RATE).astype(int)
        np.testing.assert_array_equal(sizes, 2 ** np.arange(len(sizes)))
        differences = Variances.of_allan(x, RATE, sizes)
        mean, C = differences.moments(model)
        C -= differences.moments(model.terms[-1])[1]
        scale = np.sqrt(np.outer(np.diag(C), np.diag(C)))
        assert_allclose(4.0 * found.covariance(model) / scale, C / scale, atol=tolerance)
        assert_allclose(2.0 * found.expectation(model), mean, rtol=1e-7)
        assert_allclose(found.edf[:, 0], 2.0 * mean**2 / np.diag(C), rtol=2.0 * tolerance)
    ramp = model_of(ramp=1.0)
    assert abs(found.covariance(ramp)).max() < 1e-12 * found.expectation(ramp).max()


def test_high_levels_of_long_records():
    """Of white noise the expectation is the energy 2^−j of the filter, at 15 levels, too."""
    x = np.random.default_rng(1).standard_normal((2**18, 1))
    found = aj.wavelet_variance(x, RATE, wavelet="sym4")
    assert_allclose(found.expectation(CASES["white"]), RATE * 0.5 ** np.arange(1, 16), rtol=1e-4)
    # White noise of N = 1/√RATE; four standard errors.
    z = (found.variance.T * 2.0**found.level - 1.0) / np.sqrt(2.0 / found.edf.T)
    assert abs(z).max() < 4.0


def test_haar_does_without_pywavelets(x, monkeypatch):
    monkeypatch.setitem(sys.modules, "pywt", None)
    refuses(r"allanjax\[wavelets\]", aj.wavelet_variance, x, RATE, wavelet="db2")
    assert aj.wavelet_variance(x, RATE).level[-1] == 8


@pytest.fixture(scope="module")
def recording():
    values = 0.01 + np.random.default_rng(5).normal(size=(LONG, 2)) * [1e-4, 3e-3]
    values[:, 0] += 1e-5 * np.random.default_rng(6).normal(size=LONG).cumsum()
    return aj.Recording(values, FAST, AXES)


@pytest.fixture(scope="module")
def decomposition(recording):
    return aj.wavelet_decomposition(recording, wavelet="db4", levels=5)


def smooth(x: np.ndarray, wavelet: str, level: int) -> np.ndarray:
    """What is left of an axis: single transforms down, and up again with details of zero."""
    lengths = []
    for _ in range(level):
        lengths.append(len(x))
        x, _ = pywt.dwt(x, wavelet)
    for n in reversed(lengths):
        x = pywt.idwt(x, None, wavelet)[:n]
    return x


def test_approximations_are_pywavelets_and_details_what_they_leave(recording, decomposition):
    total, values = np.zeros_like(recording.values), recording.values
    for level in range(1, 6):
        found = decomposition.approximation(level)
        for axis in range(2):
            assert_allclose(found.values[:, axis], smooth(values[:, axis], "db4", level), atol=1e-15)
        total += decomposition.details(level).values
        assert_allclose(total + found.values, values, atol=1e-12 * abs(values).max())
        assert found.notes[-1].endswith(f"below {FAST / 2 ** (level + 1):.3g} Hz")
    assert (found.rate, found.axes) == (FAST, recording.axes)
    assert_allclose(decomposition.approximation(0).values, values, rtol=1e-9)


def test_the_table_has_the_means_of_the_details(decomposition):
    table = decomposition.to_dataframe()
    details = [decomposition.details(k).values for k in range(1, 6)]
    for axis, (name, (unit, square, scale)) in enumerate(UNITS.items()):
        means = [x[:, axis].mean() / scale for x in details]
        assert_allclose(table[f"{name} mean [{unit}]"], means, rtol=1e-9, atol=1e-9)
        squares = [np.mean(x[:, axis] ** 2) / scale**2 for x in details]
        assert_allclose(table[f"{name} mean square [{square}]"], squares)
    assert_array_equal(table[["from [Hz]", "to [Hz]"]], decomposition.band)
    assert list(table["to [Hz]"]) == [5.0, 2.5, 1.25, 0.625, 0.3125]


def variances(model: aj.NoiseTerm, wavelet: str, levels: int) -> np.ndarray:
    """Wavelet variances of noise, from the filters of the levels by brute force."""
    R = dense.autocovariance(model, 2**levels * pywt.Wavelet(wavelet).dec_len, FAST)
    lags = [np.correlate(h, h, "full")[len(h) - 1 :] for h in filters(wavelet, levels)]
    return np.array([c[0] * R[0] + 2.0 * c[1:] @ R[1 : len(c)] for c in lags])


@pytest.mark.parametrize("wavelet", ["haar", "db2"])
def test_the_level_is_the_last_at_which_noise_without_memory_exceeds_the_drift(recording, wavelet):
    """Of each axis by its own model; white is quantization too, and a ramp or a line is neither."""
    # With Haar, half the Allan variance: N²/2T and K²T/6 cross at T = √3 N/K = 8.7 s, and of the scales 0.1
    # s·2^(j−1) that of level 7, 6.4 s, is the last below.
    parts = {
        "gyro_x": (aj.AngleRandomWalk(1e-4), aj.RateRandomWalk(2e-5)),
        "accel_z": (aj.Quantization(3e-3), aj.RateRandomWalk(2e-3)),
    }
    fit = {name: SimpleNamespace(model=white + drift) for name, (white, drift) in parts.items()}
    fit["accel_z"].model += aj.DriftRamp(1.0) + aj.Sinusoid(1.0, 0.5)
    found = aj.denoise(recording, fit, wavelet=wavelet)
    assert found.wavelet == wavelet
    for k, (name, (white, drift)) in enumerate(parts.items()):
        result = found[name]
        levels = len(result.white)
        assert levels == pywt.dwt_max_level(LONG, wavelet)
        white, drift = (variances(part, wavelet, levels) for part in (white, drift))
        # Beyond level 7 the filters' ripples are averaged, which only quantization's rising spectrum sees.
        assert_allclose(result.white[:7], white[:7], rtol=1e-5)
        assert_allclose(result.white, white, rtol=0.1 if name == "accel_z" else 1e-4)
        assert_allclose(result.drift, drift, rtol=1e-4)
        assert result.level == np.flatnonzero(white > drift)[-1] + 1
        assert result.cutoff == FAST / 2.0 ** (result.level + 1)
        smoothed = smooth(recording.values[:, k], wavelet, result.level)
        assert_allclose(found.recording.values[:, k], smoothed, atol=1e-14)
        table = result.to_dataframe()
        assert table["taken out"].sum() == result.level
        _, unit, scale = UNITS[name]
        assert_allclose(table[f"white noise [{unit}]"], result.white / scale**2)
        assert_allclose(table[f"drift [{unit}]"], result.drift / scale**2)
    if wavelet == "haar":
        assert found["gyro_x"].level == 7
    assert found["accel_z"].level != found["gyro_x"].level


def test_without_drift_no_octave_is_kept_and_without_white_noise_all_are(recording):
    walk, white = aj.Model((aj.RateRandomWalk(1e-5),)), aj.Model((aj.AngleRandomWalk(1e-4),))
    fit = {"gyro_x": SimpleNamespace(model=walk), "accel_z": SimpleNamespace(model=white)}
    found = aj.denoise(recording, fit, wavelet="db2")
    x, z = found.results
    assert (x.level, z.level) == (0, len(z.white))
    assert not x.white.any()
    assert not z.drift.any()
    assert_allclose(found.recording.values[:, 0], recording.values[:, 0], rtol=1e-9)
    # One model is that of all axes.
    same = aj.denoise(recording, white, wavelet="db2")
    assert [r.level for r in same.results] == [z.level, z.level]
    assert_array_equal(same["gyro_x"].white, z.white)


def test_what_cannot_be_decomposed_is_refused(x, recording, decomposition):
    wavelets, N = functools.partial(aj.wavelet_variance, x, RATE), aj.AngleRandomWalk(1.0)
    white = {"gyro_x": SimpleNamespace(model=aj.Model((N,)))}
    for call, word in (
        (lambda: wavelets(wavelet="bior2.2"), "'bior2.2'"),
        (lambda: wavelets(wavelet="db2", levels=9), "7"),
        (lambda: wavelets(levels=0), "1 to 8"),
        (lambda: wavelets(model="N"), "angle_random_walk"),
        (lambda: wavelets(model=N + aj.Resonance(1.0, 1.0, 50.0)), "resonance"),
        (lambda: wavelets(model=N + aj.Sinusoid(1.0, 0.5)), "sinusoid"),
        (lambda: aj.wavelet_decomposition(recording, wavelet="mexh"), "'mexh'"),
        (lambda: aj.wavelet_decomposition(recording, levels=9), "8 levels"),
        (lambda: decomposition.details(6), "level 6"),
        (lambda: decomposition.details(0), "level 0"),
        (lambda: aj.denoise(recording, white), "accel_z"),
    ):
        refuses(word, call)
    assert aj.wavelet_decomposition(recording, levels=8).levels == 8
