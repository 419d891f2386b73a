"""The covariance of Allan variance estimates against its defining sum, simulation and published edf."""

import math

import allantools
import jax
import numpy as np
import pytest

from allanjax.allan.covariance import AllanCovariance, discrete_gauss, equivalent_degrees_of_freedom
from allanjax.noise.model import Model
from allanjax.noise.simulate import simulate
from allanjax.noise.terms import (
    AngleRandomWalk,
    BiasInstability,
    DriftRamp,
    Markov,
    Quantization,
    RateRandomWalk,
    Resonance,
    Sinusoid,
)

RATE = 4.0
A = np.array([1.0, -2.0, 1.0])

# --- Sums over the integers ---------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [9, 17, 100, 12345])
def test_sums_of_polynomials_to_degree_15_are_exact(count):
    nodes, weights = discrete_gauss(np.array(count))
    # Centred and scaled, so that the powers keep their digits.
    x = (np.arange(count) - (count - 1) / 2) / count
    y = (nodes - (count - 1) / 2) / count
    for degree in range(16):
        assert weights @ y**degree == pytest.approx(np.sum(x**degree), rel=1e-10, abs=1e-10 * count), degree
    # Eight nodes miss degree 16: the product of their squares is positive elsewhere.
    assert abs(weights @ y**16 - np.sum(x**16)) > 1e-9 * np.sum(x**16) or count == 9


@pytest.mark.parametrize("count", [-3, 0, 1, 2, 5, 8])
def test_few_integers_are_summed_one_by_one(count):
    nodes, weights = discrete_gauss(np.array(count))
    assert weights @ np.cos(3.7 * nodes) == pytest.approx(np.sum(np.cos(3.7 * np.arange(count))), abs=1e-12)


def test_counts_may_be_an_array():
    nodes, weights = discrete_gauss(np.array([[0, 4], [30, 1000]]))
    assert nodes.shape == weights.shape == (2, 2, 8)
    np.testing.assert_allclose(weights.sum(axis=-1), [[0, 4], [30, 1000]], rtol=1e-12)


# --- The defining sum ---------------------------------------------------------------------------------------


def table_of(terms, n):
    """G at every lag of n rate samples."""
    return np.asarray(Model(tuple(terms)).phase_covariance(np.arange(n + 1) / RATE))


def brute_force(terms, n, sizes):
    """[1/(4T_i²T_j²M_iM_j)] Σ_pairs 2C_ij(s)², C from all nine phase differences, a pair at a time."""
    everything = table_of(terms, n)
    repeated = table_of([t for t in terms if t.deterministic], n)
    V = np.empty((len(sizes), len(sizes)))
    for i, mi in enumerate(sizes):
        for j, mj in enumerate(sizes):
            Mi, Mj = n + 1 - 2 * mi, n + 1 - 2 * mj
            s, pairs = np.unique(np.subtract.outer(np.arange(Mi), np.arange(Mj)), return_counts=True)
            lag = np.abs(s[:, None, None] + np.arange(3)[:, None] * mi - np.arange(3) * mj)
            C, C_repeated = (np.einsum("p,q,spq->s", A, A, G[lag]) for G in (everything, repeated))
            scale = 4 * (mi / RATE) ** 2 * (mj / RATE) ** 2 * Mi * Mj
            V[i, j] = 2 * pairs @ (C**2 - C_repeated**2) / scale
    return V


# Tolerances are relative to the variances: polynomials between kinks are summed exactly, the others nearly.
CASES = {
    "quantization": ([Quantization(1.0)], 1e-9),
    "white": ([AngleRandomWalk(1.0)], 1e-9),
    "random walk": ([RateRandomWalk(1.0)], 1e-7),
    "all powers": ([Quantization(0.5), AngleRandomWalk(1.0), RateRandomWalk(0.1)], 1e-7),
    "white and ramp": ([AngleRandomWalk(1.0), DriftRamp(0.05)], 1e-7),
    "walk and ramp": ([RateRandomWalk(1.0), DriftRamp(0.05)], 1e-7),
    "flicker": ([BiasInstability(1.0)], 1e-3),
    "flicker with cutoff": ([BiasInstability(1.0, 0.3)], 0.04),
    "short markov": ([Markov(1.0, 0.6)], 1e-3),
    "long markov": ([AngleRandomWalk(1.0), Markov(1.0, 15.0)], 1e-3),
    "line": ([AngleRandomWalk(0.5), Sinusoid(1.0, 0.5)], 1e-3),
    "resonance": ([AngleRandomWalk(0.5), Resonance(1.0, 0.5, 12.0)], 0.02),
    "slow resonance": ([Resonance(1.0, 0.05, 12.0)], 0.02),
}
SIZES = np.array([1, 2, 3, 8, 21, 50, 64, 120])


@pytest.mark.parametrize("name", CASES)
def test_covariance_is_the_sum_over_all_lags(name):
    terms, tolerance = CASES[name]
    n = 256
    terms = [term.sampled(RATE) for term in terms]
    # What oscillates needs more nodes.
    order = 32 if any(term.oscillates for term in terms) else 8
    found = np.asarray(AllanCovariance.of(n, RATE, SIZES, order).of_terms(terms))
    expected = brute_force(terms, n, SIZES)
    sd = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(found / np.outer(sd, sd), expected / np.outer(sd, sd), atol=tolerance)


@pytest.mark.parametrize(
    ("n", "sizes"), [(2, [1]), (3, [1]), (16, [1, 2, 4, 8]), (17, [8]), (40, [13, 19, 20])]
)
def test_covariance_at_the_largest_cluster_sizes(n, sizes):
    terms = [AngleRandomWalk(1.0), RateRandomWalk(2.0), Quantization(0.3)]
    found = AllanCovariance.of(n, RATE, np.array(sizes)).of_terms(terms)
    np.testing.assert_allclose(found, brute_force(terms, n, sizes), rtol=1e-8)


def test_a_line_and_a_ramp_alone_do_not_scatter():
    geometry = AllanCovariance.of(256, RATE, SIZES)
    for term in (DriftRamp(1.0), Sinusoid(1.0, 0.3).sampled(RATE)):
        np.testing.assert_array_equal(geometry.of_terms([term]), 0.0)


# --- Simulation ---------------------------------------------------------------------------------------------


def allan(x, sizes):
    """Overlapping Allan variances of records along the first axis, as NumPy has it: (records, sizes)."""
    theta = np.concatenate([np.zeros((len(x), 1)), np.cumsum(x, axis=1)], axis=1)
    return np.stack(
        [
            np.mean((theta[:, 2 * m :] - 2 * theta[:, m:-m] + theta[:, : -2 * m]) ** 2, axis=1) / (2 * m**2)
            for m in sizes
        ],
        axis=1,
    )


def draw(model, n, count):
    keys = jax.random.split(jax.random.key(11), count)
    return np.asarray(jax.jit(jax.vmap(lambda key: model.simulate(key, n, RATE)))(keys))


def test_covariance_is_that_of_simulated_records():
    """White noise and random walk: standard deviations within 4 standard errors, correlations within 0.08.

    The standard error of a sample variance of k values follows from their fourth moment, that of a
    correlation is below 1/√k = 0.022.
    """
    n, k = 2048, 2000
    sizes = 2 ** np.arange(11)
    model = AngleRandomWalk(1.0) + RateRandomWalk(0.02)
    V = allan(draw(model, n, k), sizes)
    expected = np.asarray(AllanCovariance.of(n, RATE, sizes).of_terms(model.terms))
    squares = (V - V.mean(axis=0)) ** 2
    error = squares.std(axis=0) / math.sqrt(k)
    assert np.all(np.abs(squares.mean(axis=0) - np.diag(expected)) < 4 * error)
    sd = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(np.corrcoef(V.T), expected / np.outer(sd, sd), atol=0.08)
    assert 0.3 < np.corrcoef(V.T)[3, 4] < 0.7


def test_a_ramps_cross_term_is_that_of_simulated_records():
    n, k, sizes = 512, 2000, np.array([4, 64, 200])
    model = AngleRandomWalk(1.0) + DriftRamp(0.03)
    V = allan(draw(model, n, k), sizes)
    expected = np.asarray(AllanCovariance.of(n, RATE, sizes).of_terms(model.terms))
    squares = (V - V.mean(axis=0)) ** 2
    assert np.all(np.abs(squares.mean(axis=0) - np.diag(expected)) < 4 * squares.std(axis=0) / math.sqrt(k))


# --- Degrees of freedom -------------------------------------------------------------------------------------

ALPHA = {"white": 0, "flicker": -1, "walk": -2}
TERMS = {"white": AngleRandomWalk(1.0), "flicker": BiasInstability(1.0), "walk": RateRandomWalk(1.0)}
KINDS = [("allan", True), ("allan", False), ("modified", True), ("hadamard", True), ("hadamard", False)]


def brute_force_edf(term, n, m, kind, overlapping):
    """2E²/Var from the filter that makes one difference of the phases, and G at every lag."""
    clusters = np.zeros(m + 1)
    clusters[[0, m]] = -1.0, 1.0
    differences = np.convolve(clusters, clusters)
    if kind == "hadamard":
        differences = np.convolve(differences, clusters)
    if kind == "modified":
        differences = np.convolve(differences, np.ones(m))
    stride = 1 if overlapping else m
    s = np.arange(0, n + 2 - len(differences), stride)
    products = np.correlate(differences, differences, "full")
    reach = np.arange(1 - len(differences), len(differences))
    C = table_of([term], n)[np.abs(s[:, None] + reach)] @ products
    pairs = (len(s) - s // stride) * np.where(s > 0, 2, 1)
    return len(s) ** 2 * C[0] ** 2 / (pairs @ C**2)


@pytest.mark.parametrize(("kind", "overlapping"), KINDS)
@pytest.mark.parametrize("noise", ALPHA)
def test_degrees_of_freedom_are_their_definition(noise, kind, overlapping):
    n, sizes = 1024, np.array([1, 4, 16, 100])
    found = equivalent_degrees_of_freedom(n, RATE, sizes, kind, overlapping, Model((TERMS[noise],)))
    expected = [brute_force_edf(TERMS[noise], n, int(m), kind, overlapping) for m in sizes]
    # The tail of flicker that a modified variance leaves beyond four clusters is not summed.
    np.testing.assert_allclose(found, expected, rtol=5e-3)
    if noise == "white":
        without_a_model = equivalent_degrees_of_freedom(n, RATE, sizes, kind, overlapping)
        np.testing.assert_allclose(without_a_model, found, rtol=1e-6)


@pytest.mark.parametrize(("kind", "overlapping"), KINDS)
@pytest.mark.parametrize("noise", ALPHA)
def test_degrees_of_freedom_are_greenhalls(noise, kind, overlapping):
    """Greenhall & Riley's combined algorithm, as allantools has it; coarse for few samples a cluster."""
    d = 3 if kind == "hadamard" else 2
    expected = allantools.edf_greenhall(ALPHA[noise], d, 100, 1025, overlapping, modified=kind == "modified")
    found = equivalent_degrees_of_freedom(
        1024, RATE, np.array([100]), kind, overlapping, Model((TERMS[noise],))
    )
    assert found[0] == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize(("kind", "overlapping"), KINDS)
def test_degrees_of_freedom_are_those_of_simulated_records(kind, overlapping):
    """2E[V]²/Var[V] of 2000 records, to four standard errors of their sample variance."""
    n, k, sizes = 400, 2000, np.array([1, 5, 40])
    model = AngleRandomWalk(1.0) + Resonance(0.5, 0.7, 6.0).sampled(RATE)
    x = draw(model, n, k)
    found = equivalent_degrees_of_freedom(n, RATE, sizes, kind, overlapping, model)
    theta = np.concatenate([np.zeros((k, 1)), np.cumsum(x, axis=1)], axis=1)
    order = 3 if kind == "hadamard" else 2
    for m, edf in zip(sizes, found, strict=True):
        grid = theta if overlapping else theta[:, ::m]
        step = m if overlapping else 1
        d = grid
        for _ in range(order):
            d = d[:, step:] - d[:, :-step]
        if kind == "modified":
            sums = np.concatenate([np.zeros((k, 1)), np.cumsum(d, axis=1)], axis=1)
            d = sums[:, m:] - sums[:, :-m]
        V = np.mean(d**2, axis=1)
        deviation = (V - V.mean()) ** 2
        relative = deviation.std() / deviation.mean() / math.sqrt(k)
        assert edf == pytest.approx(2 * V.mean() ** 2 / V.var(), rel=4 * relative), m


def test_simulate_and_draw_agree():
    """The tests' batches are what `simulate` gives."""
    model = AngleRandomWalk(1.0) + RateRandomWalk(0.1)
    key = jax.random.split(jax.random.key(11), 2)[1]
    np.testing.assert_allclose(draw(model, 64, 2)[1], simulate(model, 64, RATE, key), rtol=1e-12)
