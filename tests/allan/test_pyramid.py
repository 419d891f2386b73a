"""The pyramid estimator against its definition, and how its estimates scatter against brute force."""

import itertools
import math
import sys
from fractions import Fraction

import allantools
import jax
import numpy as np
import pytest

from allanjax.allan import pyramid_pass as climb
from allanjax.allan.covariance import AllanCovariance, equivalent_degrees_of_freedom
from allanjax.allan.deviation import AllanDeviation, allan_deviation
from allanjax.allan.pyramid import Pyramid, pyramid_strides
from allanjax.base.errors import AllanjaxError
from allanjax.estimate.fit import fit
from allanjax.noise.model import Model
from allanjax.noise.simulate import simulate_recording
from allanjax.noise.terms import (
    AngleRandomWalk,
    BiasInstability,
    DriftRamp,
    Markov,
    Quantization,
    RateRandomWalk,
    Resonance,
)

RATE = 4.0
A = np.array([1.0, -2.0, 1.0])


def noise(n: int, axes: int = 2) -> np.ndarray:
    """White noise on one axis; on the others, with what is drawn after it, a walk and a bias."""
    rng = np.random.default_rng(n)
    return np.stack(
        [rng.normal(size=n), *(5.0 + rng.normal(size=n).cumsum() for _ in range(axes - 1))], axis=1
    )


# --- The definition -----------------------------------------------------------------------------------------


def by_definition(x: np.ndarray, start: int = 0) -> tuple[list[int], list[int], np.ndarray]:
    """Sizes, counts and variances: cluster averages at every multiple of m/8 of the recording's index."""
    sizes, counts, variances = [], [], []
    m = 1
    while 2 * m <= len(x):
        starts = np.array([k for k in range(len(x) - 2 * m + 1) if (start + k) % max(1, m // 8) == 0], int)
        if not starts.size:
            break
        clusters = np.lib.stride_tricks.sliding_window_view(x, m, axis=0)
        differences = clusters[starts + m].mean(axis=-1) - clusters[starts].mean(axis=-1)
        sizes, counts = [*sizes, m], [*counts, len(starts)]
        variances.append((differences**2).mean(axis=0) / 2)
        m *= 2
    return sizes, counts, np.array(variances)


@pytest.mark.parametrize(
    ("n", "start"),
    [(2, 0), (2, 1), (3, 5), (16, 0), (17, 15), (40, 3), (1000, 0), (1023, 77), (9000, 8191), (140_000, 13)],
)
def test_equals_the_definition(n, start):
    x = noise(n)
    pyramid = Pyramid.of(x, start)
    sizes, counts, variances = by_definition(x, start)
    assert pyramid.cluster_size.tolist() == sizes
    assert pyramid.count.tolist() == counts
    # Rounding of the brute-force means.
    np.testing.assert_allclose(pyramid.variance(), variances, rtol=1e-12)


def with_long_doubles(x: np.ndarray, start: int, sizes: np.ndarray) -> np.ndarray:
    """Variances [m, axes] from running sums of 64 binary digits."""
    sums = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(x.astype(np.longdouble), axis=0)])
    found = []
    for m in sizes:
        stride = max(1, m // 8)
        d = (sums[2 * m :] - 2 * sums[m:-m] + sums[: -2 * m])[-start % stride :: stride] / m
        found.append((d**2).mean(axis=0) / 2)
    return np.array(found, dtype=float)


@pytest.mark.parametrize("axes", [1, 2, 7, 20])
@pytest.mark.parametrize(
    ("n", "start"),
    [(4096, 0), (4097, 1), (8191, 0), (16_384, 16), (16_399, 1), (65_535, 1), (65_536, 4095), (65_537, 0)],
)
def test_lengths_around_chunks_and_pieces(n, start, axes, monkeypatch):
    """Pieces of 4096 samples of one axis, and of 2048 of each of several: one chunk."""
    monkeypatch.setattr(climb, "_PIECE", 4096)
    x = noise(n, axes)
    pyramid = Pyramid.of(x, start)
    expected = with_long_doubles(x, start, pyramid.cluster_size)
    # Rounding of the means of the walks, which reach some hundreds: 10⁻¹⁶ of them in each difference of 1.
    np.testing.assert_allclose(pyramid.variance(), expected, rtol=1e-12)


@pytest.mark.parametrize(
    "changed", [np.asfortranarray, lambda x: x[:, ::-1], lambda x: x.astype(">f8"), lambda x: x[1:]]
)
def test_samples_may_lie_in_memory_as_they_like(changed):
    x = changed(noise(150_000, 3))
    plain = np.array(x, dtype=float, order="C")
    np.testing.assert_array_equal(Pyramid.of(x, 5).sums, Pyramid.of(plain, 5).sums)
    np.testing.assert_array_equal(x, plain)


def test_one_sample_and_none_have_no_variance():
    for n in (0, 1):
        pyramid = Pyramid.of(np.ones((n, 2)))
        assert pyramid.cluster_size.size == pyramid.count.size == 0
        assert pyramid.variance().shape == (0, 2)


def test_small_clusters_equal_allantools():
    """Up to m = 8 every start is used."""
    x = noise(20_011)[:, 0]
    _, expected, _, count = allantools.oadev(x, 1.0, data_type="freq", taus=[1, 2, 4, 8])
    pyramid = Pyramid.of(x[:, None])
    np.testing.assert_allclose(np.sqrt(pyramid.variance()[:4, 0]), expected, rtol=1e-11)
    np.testing.assert_array_equal(pyramid.count[:4], count)


def test_axes_are_independent():
    x = noise(3000, 3)
    together = Pyramid.of(x)
    for axis in range(3):
        np.testing.assert_array_equal(Pyramid.of(x[:, [axis]]).sums[:, 0], together.sums[:, axis])


def test_a_bias_costs_no_digits():
    """9.81 m/s² under noise of 1e-4 m/s²: as in exact fractions, to the digits that the samples still hold.

    A block mean is rounded to 1e-15, that is 2e-9 of the scatter of cluster averages at m = 2^16; in the mean
    square of many it is 1e-10 or less.
    """
    n = 1 << 18
    x = 9.81 + 1e-4 * np.random.default_rng(1).normal(size=(n, 1))
    pyramid = Pyramid.of(x)
    # Integers in units of 2^-60, which float64 samples near 10 are multiples of.
    sums = np.concatenate(
        [[0], np.cumsum(np.array([int(Fraction(v) * 2**60) for v in x[:, 0]], dtype=object))]
    )
    for k in (0, 3, 9, 16):
        m = 1 << k
        d = (sums[2 * m :] - 2 * sums[m:-m] + sums[: -2 * m])[:: max(1, m // 8)]
        exact = float(Fraction(int((d**2).sum()), len(d) * 2 * m**2)) / 2.0**120
        assert pyramid.variance()[k, 0] == pytest.approx(exact, rel=1e-10), m


def test_chunks_of_another_backend(monkeypatch):
    """What runs off the CPU: large chunks whose squares are added up to fewer lanes, arrays of JAX."""
    monkeypatch.setattr(climb, "_shape", lambda axes: (1 << 15, 1 << 15))
    monkeypatch.setattr(climb, "_on_cpu", lambda: False)
    x = noise(70_000)
    for values in (x, jax.numpy.asarray(x)):
        found = Pyramid.of(values, 5)
        np.testing.assert_allclose(found.variance(), by_definition(x, 5)[2], rtol=1e-12)


def test_single_precision_and_memory_maps(tmp_path):
    x = noise(5000).astype(np.float32)
    path = tmp_path / "x.npy"
    np.save(path, x)
    expected = Pyramid.of(x.astype(float)).sums
    np.testing.assert_array_equal(Pyramid.of(np.load(path, mmap_mode="r")).sums, expected)


# --- Merging ------------------------------------------------------------------------------------------------


def assert_same(found: Pyramid, expected: Pyramid) -> None:
    """Sums differ by the order in which they were added up; blocks do not differ."""
    assert (found.start, found.n) == (expected.start, expected.n)
    np.testing.assert_allclose(found.sums, expected.sums, rtol=1e-13)
    np.testing.assert_array_equal(found.head, expected.head)
    np.testing.assert_array_equal(found.tail, expected.tail)


@pytest.mark.parametrize("seed", range(8))
def test_any_split_merges_to_the_whole(seed):
    """Pieces of all sizes, of one sample and of none too, merged in any order."""
    rng = np.random.default_rng(seed)
    n, start = int(rng.integers(1, 4000)), int(rng.integers(0, 1000))
    x = noise(n)
    single = rng.integers(0, n, 4)
    cuts = np.sort(np.concatenate([[0, n], rng.integers(0, n + 1, 12), single, single + 1]))
    pieces = [Pyramid.of(x[a:b], start + a) for a, b in itertools.pairwise(cuts.tolist())]
    while len(pieces) > 1:
        k = rng.integers(len(pieces) - 1)
        pieces[k : k + 2] = [pieces[k].merge(pieces[k + 1])]
    assert_same(pieces[0], Pyramid.of(x, start))


def test_long_records_are_merged_from_parts(monkeypatch):
    x = noise(50_000)
    whole = Pyramid.of(x, 3)
    monkeypatch.setattr("allanjax.allan.pyramid._PART", 7001)
    assert_same(Pyramid.of(x, 3), whole)


def test_only_adjacent_pieces_merge():
    x = noise(100)
    left = Pyramid.of(x[:50])
    with pytest.raises(AllanjaxError, match="ends before sample 50, the right one starts at sample 51"):
        left.merge(Pyramid.of(x[51:], 51))
    with pytest.raises(AllanjaxError, match="2 axes and one of 1"):
        left.merge(Pyramid.of(x[50:, :1], 50))


@pytest.mark.parametrize("row", [0, 17, 5000, 9998, 9999])
def test_refuses_what_is_not_finite(row):
    x = noise(10_000)
    for value in (np.nan, np.inf):
        x[row, 1] = value
        with pytest.raises(
            AllanjaxError, match=f"1 values are not finite, the first at sample {row}, axis 1"
        ):
            Pyramid.of(x, 3)


@pytest.mark.usefixtures("unchecked_shapes")
def test_refuses_other_shapes_and_starts():
    with pytest.raises(AllanjaxError, match="shape"):
        Pyramid.of(np.ones(10))
    with pytest.raises(AllanjaxError, match="start is -1"):
        Pyramid.of(np.ones((10, 1)), -1)


# --- The Allan deviation ------------------------------------------------------------------------------------


def test_allan_deviation_by_the_pyramid():
    x = noise(5000)
    found = allan_deviation(x, 50.0, estimator="pyramid")
    sizes, counts, variances = by_definition(x)
    assert found.estimator == "pyramid"
    assert "pyramid" in repr(found)
    assert found.cluster_size.tolist() == sizes
    assert found.count.tolist() == counts
    np.testing.assert_array_equal(found.cluster_time, np.array(sizes) / 50.0)
    np.testing.assert_allclose(found.variance, variances, rtol=1e-12)
    assert found.edf.shape == found.deviation.shape
    streamed = AllanDeviation.of_pyramid(Pyramid.of(x[:1234]).merge(Pyramid.of(x[1234:], 1234)), 50.0)
    np.testing.assert_allclose(streamed.deviation, found.deviation, rtol=1e-13)


def test_its_degrees_of_freedom_are_those_of_every_so_manieth_start():
    """Of white noise, by the products of the differences' weights: 1 to 2 % fewer than of all starts.

    2(Σ C_kk)²/(2 Σ C_kl²) is exact; the sum over lags is by quadrature, to 10⁻⁶.
    """
    n = 1000
    found = allan_deviation(noise(n), 50.0, estimator="pyramid")
    for m in (2, 16, 64, 128):
        weights = np.concatenate([np.full(m, -1.0), np.ones(m)])
        starts = np.arange(0, n - 2 * m + 1, max(m // 8, 1))
        rows = np.zeros((len(starts), n))
        rows[np.arange(len(starts))[:, None], starts[:, None] + np.arange(2 * m)] = weights
        C = rows @ rows.T
        expected = np.trace(C) ** 2 / np.sum(C**2)
        np.testing.assert_allclose(found.edf[found.cluster_size == m], expected, rtol=1e-6)


@pytest.mark.parametrize(
    "options",
    [{"kind": "hadamard"}, {"overlapping": False}, {"data_type": "phase"}, {"cluster_times": 4}],
)
def test_the_pyramid_has_octaves_of_the_overlapping_allan_variance_only(options):
    with pytest.raises(AllanjaxError, match=r'octaves only.*estimator="exact"'):
        allan_deviation(np.ones(100), 1.0, estimator="pyramid", **options)
    with pytest.raises(AllanjaxError, match="unknown estimator 'fast'"):
        allan_deviation(np.ones(100), 1.0, estimator="fast")
    with pytest.raises(AllanjaxError, match="1 samples are too few"):
        allan_deviation(np.ones(1), 1.0, estimator="pyramid")


# --- Covariance ---------------------------------------------------------------------------------------------


def brute_force(terms, n, sizes, strides):
    """[1/(4T_i²T_j²M_iM_j)] Σ over all pairs of starts of 2C_ij(lag)², C from all nine phase differences."""
    everything, repeated = (
        np.asarray(Model(tuple(some)).phase_covariance(np.arange(n + 1) / RATE))
        for some in (terms, [t for t in terms if t.deterministic])
    )
    V = np.empty((len(sizes), len(sizes)))
    for i, (mi, si) in enumerate(zip(sizes, strides, strict=True)):
        for j, (mj, sj) in enumerate(zip(sizes, strides, strict=True)):
            a, b = np.arange(0, n - 2 * mi + 1, si), np.arange(0, n - 2 * mj + 1, sj)
            s, pairs = np.unique(np.subtract.outer(a, b), return_counts=True)
            lag = np.abs(s[:, None, None] + np.arange(3)[:, None] * mi - np.arange(3) * mj)
            C, C_repeated = (np.einsum("p,q,spq->s", A, A, G[lag]) for G in (everything, repeated))
            scale = 4 * (mi / RATE) ** 2 * (mj / RATE) ** 2 * len(a) * len(b)
            V[i, j] = 2 * pairs @ (C**2 - C_repeated**2) / scale
    return V


# Tolerances are relative to the variances, as for overlapping estimates: polynomials between kinks are exact,
# what remains beyond m_i + m_j is summed with the mean of the steps in the number of pairs.
CASES = {
    "all powers": ([Quantization(0.5), AngleRandomWalk(1.0), RateRandomWalk(0.1)], 1e-7),
    "walk": ([RateRandomWalk(1.0)], 1e-7),
    "white and ramp": ([AngleRandomWalk(1.0), DriftRamp(0.05)], 1e-7),
    "flicker": ([BiasInstability(1.0)], 1e-3),
    "short markov": ([Markov(1.0, 0.6)], 1e-3),
    "long markov": ([AngleRandomWalk(1.0), Markov(1.0, 15.0)], 3e-3),
    "resonance": ([AngleRandomWalk(0.5), Resonance(1.0, 0.5, 12.0)], 0.02),
}


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("n", [512, 709])
def test_covariance_is_the_sum_over_all_pairs_of_starts(name, n):
    terms, tolerance = CASES[name]
    terms = [term.sampled(RATE) for term in terms]
    sizes = 2 ** np.arange(9)
    strides = pyramid_strides(sizes)
    order = 32 if any(term.oscillates for term in terms) else 8
    found = np.asarray(AllanCovariance.of(n, RATE, sizes, order, strides).of_terms(terms))
    expected = brute_force(terms, n, sizes, strides)
    sd = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(found / np.outer(sd, sd), expected / np.outer(sd, sd), atol=tolerance)


@pytest.mark.parametrize("name", ["all powers", "flicker", "long markov"])
def test_degrees_of_freedom_follow_from_the_covariance(name):
    terms, n = CASES[name][0], 709
    model = Model(tuple(terms))
    sizes = 2 ** np.arange(9)
    strides = pyramid_strides(sizes)
    found = equivalent_degrees_of_freedom(n, RATE, sizes, model=model, strides=strides)
    mean = np.asarray(model.sampled(RATE).allan_variance(sizes / RATE))
    variance = np.diag(brute_force(model.sampled(RATE).terms, n, sizes, strides))
    np.testing.assert_allclose(found, 2 * mean**2 / variance, rtol=5e-3)


SIMULATED = AngleRandomWalk(1.0) + RateRandomWalk(0.02)


def simulated(n: int, count: int) -> np.ndarray:
    """Records of n samples, [n, count]."""
    keys = jax.random.split(jax.random.key(3), count)
    return np.asarray(jax.jit(jax.vmap(lambda key: SIMULATED.simulate(key, n, RATE)))(keys)).T


def test_covariance_is_that_of_simulated_records():
    """Variances within 4 standard errors of a sample variance, correlations within 0.11 (3.5 / √1000)."""
    n, k = 2048, 1000
    V = allan_deviation(simulated(n, k), RATE, estimator="pyramid").variance
    sizes = 2 ** np.arange(len(V))
    geometry = AllanCovariance.of(n, RATE, sizes, strides=pyramid_strides(sizes))
    expected = np.asarray(geometry.of_terms(SIMULATED.terms))
    squares = (V - V.mean(axis=1, keepdims=True)) ** 2
    error = squares.std(axis=1) / math.sqrt(k)
    assert np.all(np.abs(squares.mean(axis=1) - np.diag(expected)) < 4 * error)
    sd = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(np.corrcoef(V), expected / np.outer(sd, sd), atol=0.11)


def test_the_loss_of_precision_is_below_a_hundredth():
    """The standard deviation of an estimate against the exact one's, in theory and in 500 records.

    The difference of two strongly correlated variances is known to better than a hundredth; the simulated
    one is within four standard errors of the one in theory.
    """
    n, x = 2048, simulated(2048, 500)
    fast, exact = (allan_deviation(x, RATE, estimator=e).variance for e in ("pyramid", "exact"))
    a, b = ((V - V.mean(axis=1, keepdims=True)) ** 2 for V in (fast, exact))
    excess = (a - b) / b.mean(axis=1, keepdims=True) / 2
    error = excess.std(axis=1) / math.sqrt(x.shape[1])
    sizes = 2 ** np.arange(len(fast))
    geometries = [AllanCovariance.of(n, RATE, sizes, strides=s) for s in (pyramid_strides(sizes), None)]
    losses = []
    for terms in SIMULATED.terms, (BiasInstability(1.0),), (Markov(1.0, 3.0),):
        fast_variance, exact_variance = (np.diag(geometry.of_terms(terms)) for geometry in geometries)
        losses.append(np.sqrt(fast_variance / exact_variance) - 1)
    assert np.all(np.array(losses) < 0.01)
    # At m = 1, 2, 4, 8, and where a single difference is left, the estimators are the same.
    assert np.all(np.abs(losses[0][4:-1]) > 1e-3)
    assert np.all(error < 0.01)
    assert np.all(np.abs(excess.mean(axis=1) - losses[0]) < 4 * error + 1e-9)


def test_a_fit_knows_the_estimator(monkeypatch):
    """The coefficient is as good as the record allows, N/√2n, and edf are those of the pyramid."""
    truth, n = 1e-3, 20_000
    recording = simulate_recording({"gyro_x": AngleRandomWalk(truth)}, n, 100.0, 1)
    module = sys.modules[fit.__module__]
    monkeypatch.setattr(module, "allan_deviation", lambda r, **_: allan_deviation(r, estimator="pyramid"))
    result = fit(recording, AngleRandomWalk())
    coefficient = result["gyro_x"]["angle_random_walk"]
    assert coefficient.std == pytest.approx(truth / math.sqrt(2 * n), rel=0.05)
    assert abs(coefficient.value - truth) < 4 * coefficient.std
    sizes = result.curve.cluster_size
    model = AngleRandomWalk(truth)
    edf, exact = (
        equivalent_degrees_of_freedom(n, 100.0, sizes, model=Model((model,)), strides=strides)
        for strides in (pyramid_strides(sizes), None)
    )
    np.testing.assert_allclose(result.curve.edf[:, 0], edf, rtol=1e-6)
    assert np.max(np.abs(edf / exact - 1)) > 0.01
