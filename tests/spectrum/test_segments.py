"""Averaged spectra of streams: any split gives the same, levels have the law that the terms say, fits find
the truth.
"""

import itertools

import jax
import numpy as np
import pytest
from scipy.fft import dct

import allanjax as aj
from allanjax.estimate.evidence import without_ramp
from allanjax.estimate.spectral.columns import columns_of
from allanjax.estimate.spectral.design import SpectralDesign
from allanjax.estimate.stream_fits import fit_stream, select_stream_terms
from allanjax.estimate.whittle import fit_axis
from allanjax.noise.exponential import exponential_density
from allanjax.spectrum.cosine import Bins, SpectralStatistics
from allanjax.spectrum.segments import SegmentSpectra

RATE = 100.0
FACTOR, SEGMENT, LOWEST, KEPT = 8, 2**13, 2**8, 2**18
# Three levels, none of them a whole number of blocks or segments.
LONG = 2**21 + 2**18 + 12_345
K_SIGMA = 4.5
AXES = (aj.Axis("gyro_x", "gyro", "rad/s"), aj.Axis("gyro_y", "gyro", "rad/s"))


def white(seed, n=LONG, axes=2):
    return np.random.default_rng(seed).normal(size=(n, axes))


def same(found, wanted):
    """The same statistics, to the rounding of sums of 10⁵ squares."""
    (bins, levels), (other_bins, other_levels) = found.statistics(), wanted.statistics()
    np.testing.assert_array_equal(bins.size, other_bins.size)
    np.testing.assert_array_equal(bins.frequency, other_bins.frequency)
    scale = np.sqrt(other_levels.squares * other_levels.gram)
    np.testing.assert_allclose(levels.squares, other_levels.squares, rtol=1e-10)
    np.testing.assert_allclose(levels.cross / scale, other_levels.cross / scale, atol=1e-10)
    np.testing.assert_allclose(levels.gram, other_levels.gram, rtol=1e-12)


# --- What is summed -----------------------------------------------------------------------------------------


def test_levels_are_the_squares_of_transformed_block_means():
    """Each level anew with NumPy alone: means of blocks, orthonormal transforms, sums over the same bins."""
    x = white(1) + 9.8
    bins, levels = SegmentSpectra.of(x, RATE).statistics()
    squares, cross, gram, sizes = [], [], [], []
    for k in (2, 1, 0):
        rate, n = RATE / FACTOR**k, len(x) // FACTOR**k
        y = x[: n * FACTOR**k].reshape(n, FACTOR**k, 2).mean(axis=1)
        length = n if k == 2 else SEGMENT
        segments = y[: n // length * length].reshape(-1, length, 2)
        assert (k == 2) == (n <= KEPT)
        first = 1 if k == 2 else LOWEST
        # Up to the frequency at which the level below begins.
        stop = SEGMENT if k == 0 else int(np.ceil(LOWEST * FACTOR / SEGMENT * length))
        c = dct(segments, axis=1, norm="ortho")[:, first:stop]
        ramp = dct(np.arange(length) / rate, norm="ortho")[first:stop, None]
        squares.append((c**2).sum(axis=0))
        cross.append((c * ramp).sum(axis=0))
        gram.append(len(segments) * ramp**2)
        sizes.append(np.full(stop - first, len(segments)))
    # Coefficients are assigned to bins by how many samples of the spectrum each bin has.
    counted = np.cumsum(np.concatenate(sizes))
    edges = np.searchsorted(counted, np.cumsum(bins.size)) + 1
    assert edges[-1] == len(counted)
    np.testing.assert_array_equal(counted[edges - 1], np.cumsum(bins.size))
    begins = np.append(0, edges[:-1])
    summed = [np.add.reduceat(np.concatenate(part), begins, axis=0).T for part in (squares, cross, gram)]
    # A ramp has no even coefficients, but for rounding.
    tiny = 1e-12 * summed[2].max(), 1e-12 * np.sqrt(summed[2].max() * summed[0].max())
    np.testing.assert_allclose(levels.squares, summed[0], rtol=1e-9)
    np.testing.assert_allclose(levels.cross, summed[1], rtol=1e-7, atol=tiny[1])
    np.testing.assert_allclose(
        levels.gram, np.broadcast_to(summed[2], (2, len(begins))), rtol=1e-9, atol=tiny[0]
    )
    assert np.all(np.diff(bins.frequency) > 0.0)


@pytest.mark.parametrize("start", [0, 77_777])
@pytest.mark.parametrize("pieces", [2, 7, 40])
def test_any_split_gives_the_same(start, pieces):
    random = np.random.default_rng(pieces)
    x = white(2, axes=1) + 9.8
    cuts = random.integers(0, LONG, pieces - 1)
    # Pieces of a few samples too, around the cuts and at the ends.
    cuts = np.unique(np.concatenate([[0, 1, 3, LONG - 1, LONG], cuts, cuts + 1, cuts + 9]))
    cuts = cuts[cuts <= LONG]
    parts = [SegmentSpectra.of(x[a:b], RATE, start + a) for a, b in itertools.pairwise(cuts)]
    while len(parts) > 1:
        k = random.integers(len(parts) - 1)
        parts[k : k + 2] = [parts[k].merge(parts[k + 1])]
    assert (parts[0].start, parts[0].stop, parts[0].n) == (start, start + LONG, LONG)
    same(parts[0], SegmentSpectra.of(x, RATE, start))


def test_memory_does_not_grow_with_the_stream():
    """A stream of sixteen times the samples keeps at most what one level more needs."""

    def kept(spectra):
        return sum(leaf.nbytes for leaf in jax.tree.leaves(jax.tree.map(np.asarray, parts_of(spectra))))

    def parts_of(spectra):
        return [spectra.last, *(a for s in spectra.segmented for a in (s.head, s.tail, s.squares, s.cross))]

    x = white(3, 2**20, 1)
    total = SegmentSpectra.of(x, RATE)
    for _ in range(15):
        total = total.merge(SegmentSpectra.of(x, RATE, total.stop))
    assert total.n == 2**24
    assert len(total.segmented) == 2
    assert kept(total) <= 8 * (KEPT + 2 * 2 * SEGMENT + 200)


# --- What it means ------------------------------------------------------------------------------------------


def brownian(random, n):
    """Means over sample intervals of an integral of white noise."""
    steps, bridge = random.normal(size=(2, n)) / np.sqrt(RATE)
    return np.cumsum(steps) - steps / 2.0 + bridge / np.sqrt(12.0)


def simulated(random, n):
    """Records of known laws, the first three with NumPy alone."""
    seed = int(random.integers(2**31))
    reading = random.normal(size=n + 1)
    noise = random.normal(size=n)
    N, Q, K = aj.AngleRandomWalk(0.1), aj.Quantization(0.004), aj.RateRandomWalk(0.003)
    markov, low_pass = aj.Markov(0.1, 3.0), aj.LowPass(0.1, 2.0, order=2)
    flicker = aj.BiasInstability(0.1)
    return {
        "N": (aj.Model((N,)), noise),
        "Q": (N + Q, noise + 0.004 * RATE * np.diff(reading)),
        "K": (N + K, noise + 0.003 * brownian(random, n)),
        "B": (aj.Model((flicker,)), np.asarray(aj.simulate(flicker, n, RATE, seed))),
        "Markov": (aj.Model((markov,)), np.asarray(aj.simulate(markov, n, RATE, seed + 1))),
        "low-pass": (aj.Model((low_pass,)), np.asarray(aj.simulate(low_pass, n, RATE, seed + 2))),
    }


@pytest.fixture(scope="module")
def records():
    return simulated(np.random.default_rng(4), LONG)


@pytest.mark.parametrize("name", ["N", "Q", "K", "B", "Markov", "low-pass"])
def test_levels_scatter_around_their_expectations(records, name):
    """χ² with as many degrees of freedom as coefficients, at each level: mean and variance of the scores.

    A ramp is in all records, and taken out. A score (level/expected − 1)·√(size/2) has the variance 1, its
    square the variance 2 + 12/size.
    """
    model, x = records[name]
    x = x + 9.8 - 0.02 * np.arange(LONG) / RATE
    bins, levels = SegmentSpectra.of(x[:, None], RATE).statistics()
    assert len(bins.parts) == 3
    amplitudes = [getattr(term, term.amplitude_parameter().name) for term in model.terms]
    mean = np.square(amplitudes) @ columns_of(model.terms, bins).mean(axis=1)
    one = SpectralStatistics(*(np.asarray(part[0]) for part in levels))
    squares, dof = (np.asarray(part) for part in without_ramp(one, bins.size, mean, True))
    z = (squares / mean - dof) / np.sqrt(2.0 * dof)
    # All bins, and those of each level: 128 of the last, three octaves of the middle one, five of the first.
    for part in (slice(None), slice(0, 128), slice(128, 146), slice(146, None)):
        count = len(z[part])
        assert abs(z[part].sum()) < K_SIGMA * np.sqrt(count)
        scatter = np.sum(2.0 + 12.0 / dof[part])
        assert abs(np.sum(z[part] ** 2) - count) < K_SIGMA * np.sqrt(scatter)
        share = squares[part].sum() / (mean * dof)[part].sum()
        assert abs(share - 1.0) < K_SIGMA * np.sqrt(2.0 * np.sum(mean[part] ** 2 * dof[part])) / np.sum(
            mean[part] * dof[part]
        )


@pytest.mark.parametrize("pole", [-0.02 + 0.0j, -30.0 + 0.0j, 5.0 * (-1.0 + 1.0j), 300.0 * (-1.0 + 1.0j)])
@pytest.mark.parametrize("readings", [1, 8, 64])
def test_density_of_means_of_readings(pole, readings):
    """Against the readings' own density, aliased after the filter that a mean is."""
    weight = 1.0 - 1.0j if pole.imag else 1.0
    rate = RATE / readings
    f = np.array([0.003, 0.02, 0.1, 0.3, 0.5]) * rate
    a = 2.0 * np.pi * (f[:, None] + rate * np.arange(readings)) / RATE
    q = np.exp(pole / RATE)
    own = np.real(weight * (1.0 / (1.0 - q * np.exp(1j * a)) + 1.0 / (1.0 - q * np.exp(-1j * a)) - 1.0))
    mean = (np.sin(readings * a / 2.0) / (readings * np.sin(a / 2.0))) ** 2
    found = exponential_density(pole if pole.imag else pole.real, weight, f, rate, 1.0 / RATE)
    np.testing.assert_allclose(found, np.sum(own * mean, axis=1) / RATE, rtol=1e-8)


# --- Selection and fit --------------------------------------------------------------------------------------


def test_a_short_record_is_treated_as_a_recording():
    x = 0.1 * white(5, 20_000) + np.cumsum(1e-3 * white(6, 20_000), axis=0)
    recording = aj.Recording.from_array(x, RATE, gyro_unit="rad/s", names=["gyro_x", "gyro_y"])
    halves = [SegmentSpectra.of(x[:7_001], RATE), SegmentSpectra.of(x[7_001:], RATE, 7_001)]
    spectra = halves[0].merge(halves[1])
    candidates = aj.AngleRandomWalk() + aj.RateRandomWalk() + aj.DriftRamp()
    ranked = select_stream_terms(spectra, recording.axes, candidates)
    assert ranked.results == aj.select_terms(recording, candidates).results
    active = np.ones((2, 3), bool)
    for k, found in enumerate(fit_stream(spectra, candidates, recording.axes, active)):
        wanted = fit_axis(candidates, recording.axes[k], x[:, k], RATE, active[k], {}).coefficients
        assert list(found.coefficients) == list(wanted.values)
        for label, b in wanted.values.items():
            a = found[label]
            np.testing.assert_allclose((a.value, *a.interval), (b.value, *b.interval), rtol=1e-12)
        np.testing.assert_allclose(found.covariance, wanted.covariance, rtol=1e-9, atol=1e-30)


# The ramp is fourteen standard deviations of a random walk's slope, K√(1.2/duration).
K_DRIFT, R_DRIFT = 0.003, 3e-4


@pytest.fixture(scope="module")
def drifting():
    """Two axes, the second with a ramp; fed in uneven chunks."""
    random = np.random.default_rng(7)
    x = np.stack([random.normal(size=LONG) + K_DRIFT * brownian(random, LONG) for _ in range(2)], axis=1)
    x[:, 1] += R_DRIFT * np.arange(LONG) / RATE
    total = None
    for part in np.array_split(x, 5):
        piece = SegmentSpectra.of(part, RATE, total.stop if total else 0)
        total = total.merge(piece) if total else piece
    return total


CANDIDATES = aj.AngleRandomWalk() + aj.RateRandomWalk() + aj.DriftRamp()


def test_selection_finds_the_terms_of_a_stream(drifting):
    plain, ramped = select_stream_terms(drifting, AXES, CANDIDATES, name="stream").values()
    assert plain.chosen.terms == ("angle_random_walk", "rate_random_walk")
    assert ramped.chosen.terms == ("angle_random_walk", "rate_random_walk", "drift_ramp")
    assert plain.discrepancy == ramped.discrepancy == 0.0


def test_fit_of_a_stream_finds_the_truth(drifting):
    active = np.array([[True, True, False], [True, True, True]])
    plain, ramped = fit_stream(drifting, CANDIDATES, AXES, active)
    for result in (plain, ramped):
        for label, truth in (("angle_random_walk", 0.1), ("rate_random_walk", K_DRIFT)):
            assert abs(result[label].value - truth) < K_SIGMA * result[label].std
        # N of white noise: 1/√(2n) of it, but for the segments' remainders.
        assert result["angle_random_walk"].std == pytest.approx(0.1 / np.sqrt(2.0 * LONG), rel=0.05)
        assert result.p_value > 1e-4
    assert abs(ramped["drift_ramp"].value - R_DRIFT) < K_SIGMA * ramped["drift_ramp"].std
    assert not plain["drift_ramp"].detected
    assert plain["drift_ramp"].upper_limit > 0.0


def test_streams_share_compiled_functions():
    """What a program is compiled for, shapes and structure: one for streams in segments, one for records.

    A stream that was not cut into segments is transformed as a record is, all of it at once.
    """
    model = aj.AngleRandomWalk() + aj.BiasInstability() + aj.Markov()

    def shapes(n):
        bins = SegmentSpectra.of(np.zeros((n, 1)), RATE).statistics()[0]
        leaves, structure = jax.tree.flatten(SpectralDesign.of(model, bins))
        return [np.shape(leaf) for leaf in leaves], structure

    leaves, structure = jax.tree.flatten(SpectralDesign.of(model, Bins.of(1000, RATE)))
    assert shapes(KEPT) == shapes(1000) == ([np.shape(leaf) for leaf in leaves], structure)
    assert shapes(KEPT + 100) == shapes(8 * KEPT - 12_345) != shapes(KEPT)


# --- What is refused ----------------------------------------------------------------------------------------


def test_pieces_that_do_not_belong_together():
    x = white(8, 1000)
    left = SegmentSpectra.of(x, RATE)
    with pytest.raises(aj.AllanjaxError, match=r"begins at sample 1001 .* ends before 1000"):
        left.merge(SegmentSpectra.of(x, RATE, 1001))
    with pytest.raises(aj.AllanjaxError, match="not of one stream"):
        left.merge(SegmentSpectra.of(x, 2.0 * RATE, 1000))
    with pytest.raises(aj.AllanjaxError, match="not of one stream"):
        left.merge(SegmentSpectra.of(x[:, :1], RATE, 1000))


@pytest.mark.usefixtures("unchecked_shapes")
def test_values_that_are_none():
    x = white(9, 1000)
    x[30, 1] = np.nan
    with pytest.raises(aj.AllanjaxError, match="sample 1030 of axis 1"):
        SegmentSpectra.of(x, RATE, 1000)
    with pytest.raises(aj.AllanjaxError, match="shape"):
        SegmentSpectra.of(x[:, 0], RATE)
    with pytest.raises(aj.AllanjaxError, match="rate"):
        SegmentSpectra.of(x[:30], 0.0)


def test_terms_that_need_the_record():
    spectra = SegmentSpectra.of(white(10, 1000), RATE)
    for term in (aj.Sinusoid(), aj.Resonance(), aj.BiasStep(time=3.0).hold("time")):
        model = aj.AngleRandomWalk() + term
        with pytest.raises(aj.FitError, match=rf"{term.name()}.*start=, stop="):
            fit_stream(spectra, model, AXES, np.ones((2, 2), bool))
    with pytest.raises(aj.AllanjaxError, match=r"3 axes .* 2"):
        fit_stream(spectra, CANDIDATES, (*AXES, AXES[0]), np.ones((3, 3), bool))
    with pytest.raises(aj.FitError, match="40 samples are too few"):
        select_stream_terms(SegmentSpectra.of(white(11, 40), RATE), AXES, CANDIDATES)
