"""The pyramid's Allan deviations, of records and of streams in pieces, by their definition."""

import itertools

import numpy as np
import pytest
from dense_fits import Variances
from numpy.testing import assert_allclose, assert_array_equal

import allanjax as aj

RATE = 4.0
AXES = ["gyro_x", "accel_z"]


def noise(n: int, axes: int = 2) -> np.ndarray:
    """White noise on one axis, a random walk with a bias on the other."""
    rng = np.random.default_rng(n)
    return np.stack([rng.normal(size=n), 5.0 + rng.normal(size=n).cumsum()], axis=1)[:, 2 - axes :]


def by_definition(x: np.ndarray, start: int = 0) -> tuple[list[int], list[int], np.ndarray]:
    """Sizes, counts and variances: clusters begin at every multiple of m/8 of the stream's sample numbers."""
    # From running sums of 64 binary digits.
    sums = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(x.astype(np.longdouble), axis=0)])
    sizes, counts, variances = [], [], []
    for m in 2 ** np.arange(len(x).bit_length() - 1):
        stride = max(1, m // 8)
        d = (sums[2 * m :] - 2 * sums[m:-m] + sums[: -2 * m])[-start % stride :: stride] / m
        if len(d):
            sizes, counts = [*sizes, m], [*counts, len(d)]
            variances.append((d**2).mean(axis=0) / 2)
    return sizes, counts, np.array(variances, float)


def check(found: aj.AllanDeviation, x: np.ndarray, start: int = 0) -> None:
    sizes, counts, variances = by_definition(x, start)
    assert (found.cluster_size.tolist(), found.count.tolist()) == (sizes, counts)
    assert_array_equal(found.cluster_time, np.array(sizes) / RATE)
    assert_array_equal(found.strides, np.maximum(1, found.cluster_size // 8))
    # Rounding of means, and of walks that reach some hundreds.
    assert_allclose(found.variance, variances, rtol=1e-11)
    assert (found.estimator, found.n, found.kind, found.overlapping) == ("pyramid", len(x), "allan", True)


def stream(x: np.ndarray, start: int = 0) -> aj.AllanAccumulator:
    found = aj.AllanAccumulator(RATE, AXES, start=start)
    found.update(x)
    return found


def test_of_records_and_of_streams_that_begin_later_or_come_in_pieces():
    for n in (2, 3, 16, 17, 1000, 4097, 65_535, 140_000):
        for x in (noise(n, 1), noise(n, 2)):
            check(aj.allan_deviation(x, RATE, estimator="pyramid"), x)
    for n, start in ((2, 1), (3, 5), (17, 15), (40, 3), (1023, 77), (9000, 8191), (135_000, 13)):
        check(stream(noise(n), start).result(), noise(n), start)
    # From 131,072 gathered samples on they are processed.
    found, x = aj.AllanAccumulator(RATE, AXES, start=1001), noise(300_000)
    for piece in np.split(x, [7, 100_000, 131_079, 131_080, 290_000]):
        found.update(piece)
    check(found.result(), x, 1001)


@pytest.mark.parametrize("seed", range(5))
def test_any_split_merges_to_the_whole(seed):
    """Pieces of all sizes, of one sample and of none too, merged in any order."""
    rng = np.random.default_rng(seed)
    n, start = int(rng.integers(20, 4000)), int(rng.integers(0, 1000))
    x = noise(n)
    single = rng.integers(0, n, 4)
    cuts = np.sort(np.concatenate([[0, n], rng.integers(0, n + 1, 12), single, single + 1]))
    pieces = [stream(x[a:b], start + a) for a, b in itertools.pairwise(cuts.tolist())]
    while len(pieces) > 1:
        k = rng.integers(len(pieces) - 1)
        pieces[k : k + 2] = [pieces[k].merge(pieces[k + 1])]
    assert pieces[0].n == n
    check(pieces[0].result(), x, start)


def test_a_bias_costs_no_digits():
    """9.81 m/s² under noise of 10⁻⁴ m/s², to the digits that the samples still hold."""
    # A block mean is rounded to 10⁻¹⁵ m/s², which is 2·10⁻⁹ of what cluster averages scatter by at m = 2¹⁶.
    x = 9.81 + 1e-4 * np.random.default_rng(1).normal(size=(140_000, 2))
    found = aj.allan_deviation(x, RATE, estimator="pyramid")
    assert_allclose(found.variance, by_definition(x)[2], rtol=1e-8)


def test_degrees_of_freedom_are_those_of_every_so_manieth_start():
    """(tr C)²/tr C² of white noise, by products of the differences' weights; 1 to 2 % fewer than of all."""
    # The sum over lags is by quadrature, to 10⁻⁶.
    x = noise(1000)
    found = aj.allan_deviation(x, RATE, estimator="pyramid")
    forms = Variances.of_allan(x[:, 0], RATE, found.cluster_size, found.strides).forms
    for rows, edf in zip(forms, found.edf, strict=True):
        C = rows @ rows.T
        assert_allclose(edf, np.trace(C) ** 2 / np.sum(C**2), rtol=1e-6)
