"""What a simulation gets wrong: statistics and p-values by brute force, and their laws without effects."""

import critic_truth as ct
import golden_records as golden
import numpy as np
import pytest
from bench import critique, recording, truth
from scipy.signal import lfilter
from scipy.stats import binom, kstest, kurtosistest, norm
from scipy.stats import chi2 as chi_squared

import allanjax as aj


def stage_of(found, axis, which):
    """Samples less the model's ramp, the whitened ones, both in SI and in time; the levels; the unit."""
    # The levels are expected squares of cosine coefficients, which a critique states; all else is anew.
    stage, rate = found[axis].stages[which], found.rate
    x = stage.x - (stage.ramp or 0.0) * (np.arange(len(stage.x)) - (len(stage.x) - 1) / 2.0) / rate
    return x, ct.whitened(x, stage.variance), stage.variance, golden.UNITS[axis.split("_")[0]][1]


def any_of(p, count):
    """Probability that the smallest of independent p-values is less (Šidák)."""
    return -np.expm1(count * np.log1p(-p))


def allan_deviation(d, x, white, levels, scale, rate):
    """Of the record continued by its mirror image, all pairs of clusters; the median of a weighted χ²."""
    m = round(d.where * rate)
    total = np.cumsum(np.r_[0.0, np.tile(np.r_[x, x[::-1]], 2)])
    first = total[m : m + 2 * len(x)] - total[: 2 * len(x)]
    second = total[2 * m : 2 * m + 2 * len(x)] - total[m : m + 2 * len(x)]
    a = ct.ANGLE
    weight = 2.0 * np.sin(m * a / 2.0) ** 4 / (m * np.sin(a / 2.0)) ** 2 / len(x)
    dof = np.sum(weight * levels) ** 2 / np.sum((weight * levels) ** 2)
    median = np.sqrt(weight @ levels * chi_squared.median(dof) / dof)
    return np.sqrt(0.5 * np.mean(((second - first) / m) ** 2)) / scale, median / scale, None


def drift(d, x, white, levels, scale, rate):
    """The integrated rate over a time, less that at the mean rate of the stretch before; degrees or m/s."""
    measured, simulated, _ = allan_deviation(d, x, white, levels, 1.0, rate)
    unit = np.pi / 180.0 if d.unit == "deg" else 1.0
    return *(np.sqrt(2.0) * d.where * value / unit for value in (measured, simulated)), None


def psd_line(d, x, white, levels, scale, rate):
    """Amplitude in the whitened residuals, times the noise there; the largest of n/2 exponential powers."""
    n, k = len(x), round(d.where * len(x) / rate)
    power = abs(np.exp(-2j * np.pi * k * np.arange(n) / n) @ white) ** 2 / n
    root = np.sqrt(levels[2 * k - 1] / n) / scale
    typical = -np.log(1.0 - 0.5 ** (2.0 / n))
    return 2.0 * np.sqrt(power) * root, 2.0 * np.sqrt(typical) * root, any_of(np.exp(-power), (n - 1) // 2)


def autocorrelation(d, x, white, levels, scale, rate):
    """Of the whitened residuals, continued by their mirror image."""
    lag = round(d.where * rate)
    both = np.r_[white, white[::-1]]
    # Less what the mirror image adds in white noise.
    r = np.mean(both * np.roll(both, -lag)) - np.sum(np.cos(ct.ANGLE * lag)) / len(x)
    return r, 0.0, any_of(2.0 * norm.sf(abs(r) * np.sqrt(len(x))), min(200, len(x) // 10))


def tails(d, x, white, levels, scale, rate):
    """Excess kurtosis, by Anscombe & Glynn's test."""
    excess = np.mean(white**4) / np.mean(white**2) ** 2 - 3.0
    return excess, 0.0, kurtosistest(white).pvalue


def largest_residual(d, x, white, levels, scale, rate):
    """Half of all simulations have none that is larger than the typical one."""
    largest = abs(white[round(d.where * rate)])
    assert largest == abs(white).max()
    return largest, norm.isf((1.0 - 0.5 ** (1.0 / len(x))) / 2.0), any_of(2.0 * norm.sf(largest), len(x))


def window(d, white, rate):
    """The window of a half, a quarter, … of the record with this middle."""
    n = len(white)
    (length,) = [m for m in n // 2 ** np.arange(1, 7) if abs((d.where * rate / m - 0.5) % 1.0 - 0.5) > 0.499]
    start = round(d.where * rate - length / 2)
    return white[start : start + length]


def windows_null(scores):
    """Largest scores of so many sets of 64 independent means, in all windows of a half, a quarter, …"""
    z = np.random.default_rng(8).standard_normal((4_000, 64))
    z = z - z.mean(axis=1, keepdims=True) * scores
    largest = np.zeros(len(z))
    for size in 2 ** np.arange(6):
        means = z.reshape(len(z), -1, size).sum(axis=2) / np.sqrt(size * (1.0 - scores * size / 64.0))
        largest = np.maximum(largest, abs(means).max(axis=1))
    return largest


def window_mean(d, x, white, levels, scale, rate):
    """All residuals together have no mean."""
    part = window(d, white, rate)
    score = abs(part.mean()) * np.sqrt(len(part) / (1.0 - len(part) / len(x)))
    return part.mean(), 0.0, np.mean(windows_null(1.0) > score)


def window_variance(d, x, white, levels, scale, rate):
    """Mean squares as normal scores of their χ² law."""
    part = window(d, white, rate)
    tail = min(chi_squared.cdf(part @ part, len(part)), chi_squared.sf(part @ part, len(part)))
    return part @ part / len(part), 1.0, np.mean(windows_null(0.0) > norm.isf(tail))


def psd(d, x, white, levels, scale, rate):
    """In sixths of an octave: mean squares over the model's, times its density."""
    n, ratio, edges = len(x), ct.coefficients(x) ** 2 / levels, [1]
    while edges[-1] < n:
        edges.append(max(edges[-1] + 1, int(edges[-1] * 2.0 ** (1.0 / 6.0))))
    edges = np.array([*edges[:-2], n])
    middle = (edges[:-1] + edges[1:] - 1) / 2.0 * rate / (2.0 * n)
    k = int(np.argmin(abs(middle - d.where)))
    part, count = slice(edges[k] - 1, edges[k + 1] - 1), edges[k + 1] - edges[k]
    density, total = 2.0 / rate * levels[part].mean() / scale**2, ratio[part].sum()
    assert (d.where, d.measured) == pytest.approx((middle[k], density * total / count))
    tail = 2.0 * min(chi_squared.cdf(total, count), chi_squared.sf(total, count))
    return d.measured, density * chi_squared.median(count) / count, any_of(tail, len(middle))


BRUTE = (psd, allan_deviation, drift, psd_line, autocorrelation, tails)
BRUTE += (largest_residual, window_mean, window_variance)
#: Statistics whose p-values are of some thousand draws.
DRAWN = ("window_mean", "window_variance")
# With effects, without, and of different units, before a finding and after it.
AXES = [("clean_1", "gyro_y", "before"), ("clean_2", "accel_x", "before")]
AXES += [("two_effects", axis, when) for axis, when in (("accel_z", "before"), ("gyro_x", "after"))]
AXES += [("temperature", "gyro_x", "before")]


@pytest.mark.parametrize(("name", "axis", "when"), AXES)
def test_statistics_are_those_of_brute_force(name, axis, when):
    found = critique(name)
    every = {d.statistic: d for d in getattr(found[axis], when)}
    x, white, levels, scale = stage_of(found, axis, 0 if when == "before" else -1)
    for brute in BRUTE:
        statistic = brute.__name__
        d = every[statistic]
        measured, simulated, p = brute(d, x, white, levels, scale, found.rate)
        assert d.measured == pytest.approx(measured, rel=2e-3, abs=1e-6), statistic
        # A curve of fitted levels scatters a little more than one of known ones, which moves the median.
        near = 0.05 if statistic in ("allan_deviation", "drift") else 1e-4
        assert d.simulated == pytest.approx(simulated, rel=near), statistic
        assert d.size == pytest.approx(d.simulated / d.measured - 1.0)
        if statistic in DRAWN:
            assert abs(d.p_value - p) < 4.0 * np.sqrt(max(p, 1e-3) / 2_000) + 0.1 * p, statistic
        elif p is not None:
            assert d.p_value == pytest.approx(max(p, 1e-300), rel=1e-6, abs=0.0), statistic


def test_correlations_count_the_axes_and_channels_that_there_are():
    """The p-value is that of the strongest of them, here of two axes and of one, and of one channel."""
    for name, others in (("clean_1", 2), ("clean_2", 1), ("temperature", 1)):
        found = critique(name)
        whites = {axis: stage_of(found, axis, 0)[1] for axis in found}
        for axis, white in whites.items():
            d = next(d for d in found[axis].before if d.statistic == "cross_correlation")
            z = {k: white @ y / np.linalg.norm(y) for k, y in whites.items() if k != axis}
            assert len(z) == others
            assert d.channel == max(z, key=lambda k: abs(z[k]))
            assert d.measured == pytest.approx(z[d.channel] / np.sqrt(len(white)), abs=1e-9)
            p = any_of(2.0 * norm.sf(abs(z[d.channel])), others)
            assert d.p_value == pytest.approx(p, rel=1e-6, abs=0.0)
    channel = ct.coefficients(recording("temperature").auxiliary["temperature"])
    for axis in found:
        d = next(d for d in found[axis].before if d.statistic == "auxiliary_correlation")
        x, _, levels, _ = stage_of(found, axis, 0)
        filtered = channel / levels
        z = filtered @ ct.coefficients(x) / np.sqrt(filtered @ channel)
        assert d.channel == "temperature"
        assert d.p_value == pytest.approx(2.0 * norm.sf(abs(z)), rel=1e-6, abs=1e-300)


def test_repeated_values_and_steps_are_those_of_the_samples():
    places = [(ct.critique(name), h) for name in ("rounded", "more") for h in ct.hidden_in(name)]
    for found, h in places:
        every = {d.statistic: d for d in found[h.axis].before}
        assert every["lattice"].measured == (h.cause == "rounding")
        assert (every["lattice"].p_value < 1e-99) is (h.cause == "rounding")
        same = int(np.sum(np.diff(h.x) == 0.0))
        d, n = every["repeated_values"], len(h.x) - 1
        assert d.measured == pytest.approx(same / n)
        # As many as in a simulation of the same resolution, by a test of two counts.
        p = binom.sf(same - 1, same + round(d.simulated * n), 0.5)
        assert d.p_value == pytest.approx(max(p, 1e-300), rel=1e-6, abs=0.0)


def test_what_a_finding_explains_is_gone_with_it():
    """Of the spectrum at the line; the place of the largest difference that is left may be any."""
    axis = critique("two_effects")["accel_z"]
    (line,) = axis.findings
    before, after = ({d.statistic: d for d in ends}["psd_line"] for ends in (axis.before, axis.after))
    assert before.where == pytest.approx(11.7, abs=0.01)
    assert before.measured == pytest.approx(line.size.value, rel=0.35)
    assert before.p_value < 1e-20
    assert after.p_value > 1e-3
    assert after.measured < 0.5 * before.measured


CLEAN = [*golden.CLEAN, "lossy"]


@pytest.mark.parametrize("name", CLEAN)
def test_a_clean_record_has_no_finding(name):
    found = critique(name)
    assert found.findings == found.shared_findings == ()
    assert found.gain == 0.0
    for axis in found.results:
        assert axis.findings == axis.left_out == ()
        assert axis.before == axis.after
        assert len(axis.stages) == 1
        # Fourteen statistics of five axes or fewer.
        assert min(d.p_value for d in axis.before) > 1e-5
        assert set(axis.model.term_labels) <= set(golden.LABELS.values()) | {"markov"}


def test_p_values_of_axes_without_an_effect_are_uniform():
    """Of discrepancies that take any value, and of the effects' tests, in fifteen axes or more."""
    axes = []
    for name in {*CLEAN, *golden.EFFECTS} - {"common"}:
        hidden = {axis for effect in truth(name).effects for axis in effect.axes}
        axes += [axis for axis in critique(name).results if axis.axis.name not in hidden]
    p = [d.p_value for axis in axes for d in axis.before if d.statistic not in ("lattice", "repeated_values")]
    assert len(p) > 180
    tests = [value for axis in axes for name, value in axis.tests.items() if name != "temperature"]
    assert len(tests) == 7 * len(axes)
    for values in (p, tests):
        assert kstest(values, "uniform").pvalue > 1e-3
        assert min(values) > 1e-3 / len(values)
    # The mean of so many, which are not all independent.
    assert np.mean(p) == pytest.approx(0.5, abs=4.0 * 2.0 / np.sqrt(12.0 * len(p)))


@pytest.mark.parametrize("shape", ["oscillator", "band"])
def test_what_a_named_cause_leaves_at_its_own_place_is_told(shape):
    """A resonance describes an oscillator, but not noise that is confined to a band."""
    n, rate = 1 << 13, 100.0
    # Some resonances that move describe the band where it is not as strong.
    rng = np.random.default_rng(7)
    drive = rng.standard_normal(n)
    if shape == "oscillator":
        r, w = np.exp(-np.pi * 0.09 / 10.0), 2.0 * np.pi * 0.09
        own = lfilter([1.0], [1.0, -2.0 * r * np.cos(w), r * r], drive)
    else:
        f = np.fft.rfftfreq(n, 1.0 / rate)
        own = np.fft.irfft(np.fft.rfft(drive) * ((f > 8.0) & (f < 10.0)), n)
    x = rng.standard_normal(n) + 4.0 * own / own.std()
    options = {"rate": rate, "gyro_unit": "deg/s", "names": ["gyro_x"]}
    found = [f for f in aj.critique(x, **options).findings if f.cause == "resonance"]
    left = [f.rest for f in found if f.rest]
    assert found
    assert bool(left) == (shape == "band")
    assert all(rest.statistic == "psd" and 7.0 < rest.where < 11.0 for rest in left)
    assert all(("Explained in part" in str(f)) == bool(f.rest) for f in found)
