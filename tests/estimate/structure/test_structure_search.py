"""What a spectrum consists of: filters and resonances that are found, and those that are not there."""

import numpy as np
import pytest
from scipy.signal import butter, freqz, lfilter

from allanjax.estimate.spectral.components import BUTTERWORTH_4, NONE, ONE_POLE, TWO_POLES
from allanjax.estimate.spectral.model import FULL
from allanjax.estimate.structure.as_model import model_of, order_of
from allanjax.estimate.structure.excess import windows
from allanjax.estimate.structure.search import Record, completed, searched
from allanjax.estimate.structure.structure import FIXED, WHITE, Spectrum, Structure
from allanjax.spectrum.cosine import Bins, cosine_transform

N, RATE = 60_000, 100.0


def structure_of(x):
    record = Record(cosine_transform(x - x.mean()) ** 2, RATE)
    return completed(*searched(record, Structure.plain(range(len(FIXED)))))


def oscillation(frequency, quality, rng):
    """A damped oscillator that noise drives, of unit deviation, at a sixteenth of its sampling interval."""
    over = 16
    n = N * over
    f = np.fft.rfftfreq(n, 1.0 / (RATE * over)) / frequency
    x = np.fft.irfft(np.fft.rfft(rng.standard_normal(n)) / (1.0 - f**2 + 1j * f / quality), n)[::over]
    return x / x.std()


def one_pole(x, bandwidth):
    w = np.exp(-2.0 * np.pi * bandwidth / RATE)
    return lfilter([1.0 - w], [1.0, -w], x)


def measured(x, sizes):
    """Allan deviations of overlapping clusters."""
    total = np.concatenate([[0.0], np.cumsum(x - x.mean())])
    differences = (total[2 * m :] - 2.0 * total[m:-m] + total[: -2 * m] for m in sizes)
    return np.array([np.sqrt(0.5 * np.mean((d / m) ** 2)) for d, m in zip(differences, sizes, strict=True)])


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("inside", [True, False])
def test_a_resonance_inside_a_filter_or_after_it_is_told_from_it(seed, inside):
    rng = np.random.default_rng([31, seed])
    white, wave = rng.standard_normal(N), 0.5 * oscillation(20.0, 15.0, rng)
    x = one_pole(white + wave, 15.0) if inside else one_pole(white, 15.0) + wave
    found = structure_of(x)
    structure = found.structure
    assert structure.kind == ONE_POLE
    (k,) = structure.oscillators
    assert structure.inside[FULL.first_oscillator + k] == inside
    bandwidth, frequency = (
        structure.bandwidth[0] * RATE / (2 * np.pi),
        structure.frequency(k) * RATE / (2 * np.pi),
    )
    # Known to about 1.5 %, 0.1 % and 8 %; four of these.
    assert bandwidth == pytest.approx(15.0, rel=0.06)
    assert frequency == pytest.approx(20.0, rel=0.004)
    assert structure.quality(k) == pytest.approx(15.0, rel=0.32)
    # White noise is known to 1 % in its power: four standard errors, and two for what is seen of the filter.
    assert np.sqrt(structure.power[WHITE] * RATE) == pytest.approx(1.0, rel=0.03)
    sizes = np.array([1, 2, 4, 8, 16, 32])
    deviation = np.sqrt(model_of(structure, RATE).sampled(RATE).allan_variance(sizes / RATE))
    # With 1,800 clusters and more, of which the deviation scatters by 2 %.
    np.testing.assert_allclose(deviation, measured(x, sizes), rtol=0.05)


@pytest.mark.parametrize("seed", range(10))
def test_nothing_is_found_in_plain_noise(seed):
    """White noise, a random walk and a Markov process; each of ten records with probability below 1 %."""
    rng = np.random.default_rng([32, seed])
    slow = lfilter([1.0], [1.0, -np.exp(-1.0 / 800.0)], rng.standard_normal(N))
    x = rng.standard_normal(N) + 3e-3 * np.cumsum(rng.standard_normal(N)) + 0.03 * slow
    structure = structure_of(x).structure
    assert structure.kind == NONE
    assert len(structure.oscillators) == 0


def test_a_filter_of_two_poles_is_one_and_a_steep_one_is_steep():
    rng = np.random.default_rng(33)
    two = lfilter(*butter(2, 0.3), rng.standard_normal(N)) + 0.02 * rng.standard_normal(N)
    assert order_of(structure_of(two).structure) == 2
    four = lfilter(*butter(4, 0.5), rng.standard_normal(N)) + 0.01 * rng.standard_normal(N)
    structure = structure_of(four).structure
    assert structure.kind == BUTTERWORTH_4
    bandwidth = structure.bandwidth[0] / np.pi
    assert bandwidth == pytest.approx(0.5, rel=0.01)
    response = model_of(structure, RATE).response
    f = np.linspace(1.0, 40.0, 50)
    np.testing.assert_allclose(
        response.power(f, RATE), abs(freqz(*butter(4, bandwidth), f, fs=RATE)[1]) ** 2, rtol=1e-6
    )


def test_a_resonance_that_moves_is_a_few_close_ones_and_the_filter_stays():
    """Its frequency goes from 19 to 21 Hz and back during the record."""
    rng = np.random.default_rng(34)
    parts = [oscillation(f0, 40.0, rng)[: N // 8] for f0 in (19.0, 19.5, 20.0, 20.5, 21.0, 20.5, 20.0, 19.5)]
    x = one_pole(rng.standard_normal(N), 25.0) + 0.7 * np.concatenate(parts)
    structure = structure_of(x).structure
    assert structure.kind in (ONE_POLE, TWO_POLES)
    assert np.sqrt(structure.power[WHITE] * RATE) == pytest.approx(1.0, rel=0.05)
    near = [structure.frequency(k) * RATE / (2.0 * np.pi) for k in structure.oscillators]
    assert 1 <= len(near) <= 6
    assert min(near) > 18.0
    assert max(near) < 23.0


def test_the_window_of_most_excess_is_where_it_is():
    rng = np.random.default_rng(35)
    ratio = rng.standard_normal(20_000) ** 2
    ratio[7000:7100] *= 2.0
    ratio[15_000:15_010] *= 8.0
    (middle, width, _), (other, narrow, _) = sorted(windows(ratio, 2))
    assert abs(middle - 7050) < 50
    assert 50 <= width <= 200
    assert abs(other - 15_005) < 8
    assert narrow <= 16


def test_fits_to_halves_of_the_coefficients_weigh_like_the_whole():
    """Two halves together have the weight of all, where bins are large; the loss is that of the levels."""
    rng = np.random.default_rng(36)
    squares = cosine_transform(rng.standard_normal(N)) ** 2
    bins = Bins.of(N, RATE, per_octave=12)
    whole = Spectrum.of(squares, bins)
    fold = (np.arange(N - 1) // 2 % 2 == 0).astype(float)
    halves = [Spectrum.of(squares, bins, None, part).weighed_like(whole) for part in (fold, 1.0 - fold)]
    size = np.asarray(whole.size)
    both = sum(half.size for half in halves)
    np.testing.assert_array_equal(both, size)
    fitted = whole.fit(Structure.plain([WHITE]))
    k = np.asarray(whole.levels.shape)
    level = np.asarray(whole.levels.level)
    assert whole.loss_of(fitted) == pytest.approx(np.sum(k * (np.log(fitted.mean) + level / fitted.mean)))
    assert fitted.structure.power[WHITE] == pytest.approx(squares.mean() / RATE, rel=0.01)


def test_a_resonance_is_found_where_there_is_no_white_noise():
    """In quantization noise only: no filter is put in the place of the noise that is not there."""
    rng = np.random.default_rng(37)
    x = np.diff(rng.uniform(-0.5, 0.5, N + 1)) + 0.2 * oscillation(20.0, 15.0, rng)
    structure = structure_of(x).structure
    assert structure.kind == NONE
    (k,) = structure.oscillators
    assert structure.frequency(k) * RATE / (2.0 * np.pi) == pytest.approx(20.0, rel=0.004)
    sizes = np.array([1, 2, 4, 8, 16, 32])
    deviation = np.sqrt(model_of(structure, RATE).sampled(RATE).allan_variance(sizes / RATE))
    np.testing.assert_allclose(deviation, measured(x, sizes), rtol=0.05)
