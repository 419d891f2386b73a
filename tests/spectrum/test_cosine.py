"""Expected squares of the cosine coefficients of noise terms against dense covariance matrices, once."""

import itertools

import dense
import numpy as np
import pytest
from dense_fits import recording
from numpy.testing import assert_allclose
from scipy.fft import dct
from scipy.optimize import minimize

import allanjax as aj
from allanjax.estimate.spectral.components import columns_of
from allanjax.spectrum.cosine import Bins

RATE = 4.0
SINGLE = 64
# The term, and the tolerance in bins, where the record is taken to be long compared with a period: that costs
# flicker 0.3 % in the first of them and Markov noise up to 0.5 %. Two nodes a bin are right to the fourth
# power of its width.
CASES = {
    "quantization": (aj.Quantization(1.0), 2e-5), "white": (aj.AngleRandomWalk(1.0), 1e-10),
    "flicker": (aj.BiasInstability(1.0), 5e-3), "walk": (aj.RateRandomWalk(1.0), 2e-5),
    "fast markov": (aj.Markov(1.0, 0.06), 6e-3), "markov": (aj.Markov(1.0, 8.0), 6e-3),
    "slow markov": (aj.Markov(1.0, 250.0), 6e-3),
}  # fmt: skip


def squares(term, n: int) -> np.ndarray:
    """Variances of the coefficients c_1 … c_{n−1}."""
    V = dense.covariance(term, n, RATE)
    return np.diag(dct(dct(V, norm="ortho", axis=0), norm="ortho", axis=1))[1:]


def expected(bins: Bins, term) -> np.ndarray:
    """Mean expected square of the coefficients in each bin, of a term with its amplitude."""
    # Fits by Whittle's likelihood rest on it; no public number is the expectation of one term alone.
    amplitude = getattr(term, term.amplitude_parameter().name)
    return amplitude**2 * columns_of([term], bins)[0].mean(axis=0)


@pytest.mark.parametrize("name", CASES)
def test_expected_squares_are_those_of_the_dense_covariance(name):
    term, in_bins = CASES[name]
    for n in (65, 1000):
        bins = Bins.of(n, RATE)
        found, exact = expected(bins, term), bins.sums(squares(term, n)) / bins.size
        assert_allclose(found[:SINGLE], exact[:SINGLE], rtol=1e-6)
        assert_allclose(found[SINGLE:], exact[SINGLE:], rtol=in_bins)


def test_expected_squares_of_what_has_an_edge_or_a_line():
    """Flicker noise with a cutoff: exact at the lowest frequencies, up to the cutoff but for what leaks."""
    # Resonances around their line: what the record's ends cut off is 1/(its lifetimes in the record), 4 to 9
    # %; all their power is there.
    n = 1000
    for f0 in (0.4, 3.0):
        term, bins = aj.BiasInstability(1.0, f0), Bins.of(n, RATE)
        found, exact = expected(bins, term), bins.sums(squares(term, n)) / bins.size
        below = bins.frequency + bins.size * RATE / (4.0 * n) < 0.8 * f0
        assert_allclose(found[below], exact[below], rtol=0.02)
        assert_allclose(found[:5], exact[:5], rtol=0.01)
    for f0, Q_f in ((0.8, 12.0), (0.1, 3.0), (1.5, 40.0)):
        term, bins = aj.Resonance(1.0, f0, Q_f), Bins.of(n, RATE, [(f0, 0.0)])
        found, exact = expected(bins, term), bins.sums(squares(term, n)) / bins.size
        strong = exact > 0.05 * exact.max()
        assert_allclose(found[strong], exact[strong], rtol=2.0 * Q_f / (np.pi * f0 * n / RATE))
        assert found @ bins.size == pytest.approx(exact @ bins.size, rel=5e-3)


def test_bins_hold_every_coefficient_once():
    """Single ones up to 64, twelve on either side of a line, then six bins an octave."""
    for n in (4, 63, 64, 65, 66, 100, 1000, 12_345):
        spacing = RATE / (2 * n)
        for around in ([], [0.1 * spacing], [64.5 * spacing, 1.1], [RATE / 2.0 - spacing]):
            bins = Bins.of(n, RATE, [(f, 0.0) for f in around])
            assert (bins.edges[0], bins.edges[-1]) == (1, n)
            np.testing.assert_array_equal(bins.size, np.diff(bins.edges))
            first = bins.edges[:-1]
            assert_allclose(bins.frequency, (first + (bins.size - 1) / 2.0) * spacing)
            single = first <= min(SINGLE, n - 1)
            for j in np.round(np.array(around) / spacing):
                single |= (first > max(j - 12, 0)) & (first < min(j + 12, n))
            assert (bins.size[single] == 1).all()
            wide = bins.size[SINGLE:] * spacing
            assert np.all(wide < 1.05 * (2.0 ** (1.0 / 6.0) - 1.0) * bins.frequency[SINGLE:] + 2.0 * spacing)


OF_STREAM = 100.0
FACTOR, SEGMENT, LOWEST = 8, 2**13, 2**8
# Three levels, none of them a whole number of blocks or segments.
N = 2**21 + 2**18 + 12_345
# White noise, random walk, ramp, of two axes of different sensors; the ramps are eight standard deviations of
# the walks' slopes or more.
TRUTH = {"gyro_x": (0.1, 3e-3, 4e-4), "accel_z": (0.3, 0.015, 2e-3)}
LABELS = ("angle_random_walk", "rate_random_walk", "drift_ramp")


def levels(x: np.ndarray, start: int) -> tuple[np.ndarray, ...]:
    """Of every coefficient used: count, squares, products with a ramp's, its square, and expected squares."""
    # Level k has means of 8^k samples, whose blocks and segments begin at multiples of their length in the
    # stream's numbers. Expected squares of white noise and of a random walk, of coefficients 1, are exact.
    found = []
    for k in (2, 1, 0):
        block = FACTOR**k
        first = -(-start // block)
        y = x[first * block - start :]
        y = y[: len(y) // block * block].reshape(-1, block).mean(axis=1)
        length, lowest = (len(y), 1) if k == 2 else (SEGMENT, LOWEST)
        y = y if k == 2 else y[-first % SEGMENT :]
        segments = y[: len(y) // length * length].reshape(-1, length)
        stop = SEGMENT if k == 0 else int(np.ceil(LOWEST * FACTOR / SEGMENT * length))
        c = dct(segments, axis=1, norm="ortho")[:, lowest:stop]
        h = block / OF_STREAM
        ramp = dct(np.arange(length) * h, norm="ortho")[lowest:stop]
        a = np.pi * np.arange(lowest, stop) / length
        walk = h * (2.0 + np.cos(a)) / (12.0 * np.sin(a / 2.0) ** 2)
        count = np.full(len(a), len(segments))
        sums = (c**2).sum(axis=0), c.sum(axis=0) * ramp, ramp**2 * count
        found.append((count, *sums, np.full(len(a), 1.0 / h), walk))
    return tuple(map(np.concatenate, zip(*found, strict=True)))


def by_definition(x: np.ndarray, start: int, guess: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients that maximize Whittle's likelihood, and their standard errors."""
    # It is of every coefficient by itself, restricted: the ramp takes a degree of freedom.
    count, squares, cross, gram, white, walk = levels(x, start)

    def minus_log(p: np.ndarray) -> float:
        N2, K2, R = *np.exp(2.0 * p[:2]), np.exp(p[2])
        e = N2 * white + K2 * walk
        ramp = np.log(np.sum(gram / e))
        return np.sum(count * np.log(e) + (squares - 2.0 * R * cross + R**2 * gram) / e) / 2.0 + ramp / 2.0

    options = {"xatol": 1e-7, "fatol": 1e-7, "maxiter": 4000}
    value = np.exp(minimize(minus_log, np.log(guess), method="Nelder-Mead", options=options).x)
    e = value[0] ** 2 * white + value[1] ** 2 * walk
    slopes = np.stack([2.0 * value[0] * white / e, 2.0 * value[1] * walk / e])
    covariance = np.linalg.inv((slopes * count / 2.0) @ slopes.T)
    return value, np.sqrt([*np.diag(covariance), 1.0 / np.sum(gram / e)])


def pieces_merged(x: np.ndarray, start: int) -> aj.AllanAccumulator:
    """In pieces of all sizes, of a few samples from the beginning of a block too."""
    # They are merged in random order; often the last two, so that a short piece meets a long one after it.
    rng = np.random.default_rng(3)
    cuts = rng.integers(0, N, 9)
    blocks = FACTOR**2 * rng.integers(start // FACTOR**2 + 1, (start + N) // FACTOR**2, 9) - start
    cuts = np.unique(np.concatenate([[0, 1, 3, N - 1, N], cuts, cuts + 1, cuts + 9, blocks, blocks + 3]))
    parts = []
    for a, b in itertools.pairwise(cuts[cuts <= N].tolist()):
        parts.append(aj.AllanAccumulator(OF_STREAM, list(TRUTH), start=start + a))
        parts[-1].update(x[a:b])
    while len(parts) > 1:
        k = len(parts) - 2 if rng.random() < 0.8 else rng.integers(len(parts) - 1)
        parts[k : k + 2] = [parts[k].merge(parts[k + 1])]
    return parts[0]


def test_fits_are_those_of_the_levels_by_definition():
    """Bins of many coefficients cost some hundredths of a standard error; the truth is within four."""
    start, rng, x = 77_777, np.random.default_rng(7), np.zeros((N, 2))
    for k, (white, walk, ramp) in enumerate(TRUTH.values()):
        steps, bridge = rng.normal(size=(2, N)) / np.sqrt(OF_STREAM)
        brownian = np.cumsum(steps) - steps / 2.0 + bridge / np.sqrt(12.0)
        line = ramp * np.arange(N) / OF_STREAM
        x[:, k] = 9.8 + white * np.sqrt(OF_STREAM) * rng.normal(size=N) + walk * brownian + line
    stream = aj.AllanAccumulator(OF_STREAM, list(TRUTH), start=start)
    stream.update(x)
    model = aj.AngleRandomWalk() + aj.RateRandomWalk() + aj.DriftRamp()
    # The walk is far more than that of a sensor at rest.
    options = {"as_is": True, "vibrating": True}
    fit = stream.fit(model, "whittle", **options)
    # A value that is lost between pieces would change the coefficients by 10⁻⁵.
    merged = pieces_merged(x, start).fit(model, "whittle", **options)
    for name, label in itertools.product(TRUTH, LABELS):
        one, other = fit[name][label], merged[name][label]
        np.testing.assert_allclose([one.value, one.std], [other.value, other.std], rtol=1e-8)
    for k, (name, truth) in enumerate(TRUTH.items()):
        value, error = by_definition(x[:, k], start, truth)
        found = [fit[name][label] for label in LABELS]
        np.testing.assert_array_less(abs([c.value for c in found] - value), 0.05 * error)
        # The ramp's degree of freedom is missing in the walk's error, by definition.
        ratio = np.array([c.std for c in found]) / error
        np.testing.assert_array_less(abs(ratio - 1.0), [1e-4, 0.01, 0.01])
        np.testing.assert_array_less(abs(value - truth), 4.0 * error)
        assert fit[name].p_value > 1e-3


def test_long_records_are_cut_to_a_length_whose_transform_is_fast():
    """No more than needed: none between it and the record's has small prime factors only."""

    def largest_factor(m: int) -> int:
        return max(p for p in range(2, m + 1) if m % p == 0 and all(p % d for d in range(2, int(p**0.5) + 1)))

    n = 300_007  # a prime
    white = recording(np.random.default_rng(0).standard_normal(n), RATE)
    used = aj.fit(white, "N", "whittle", as_is=True).results[0]
    m = used.spectrum.bins.n
    assert largest_factor(m) <= 61 < min(map(largest_factor, range(m + 1, n + 1)))
