"""How far a fitted curve is off, and what is said of coefficients that are no measurement."""

import bench
import numpy as np
import pytest
from dense_fits import recording
from scipy.fft import dct, idct
from scipy.signal import lfilter
from scipy.stats import chi2

import allanjax as aj

RATE, N, WHITE = 100.0, 16_384, 1e-3
# A central interval of 99.7 % of all places, outside of which a curve is off for certain.
OUTSIDE = 0.003


def noise(seed):
    """Angle random walk of 1e-3 rad/√s and rate random walk of 1e-5 rad/s/√s."""
    white, walk = np.random.default_rng(seed).normal(size=(2, N))
    return WHITE * np.sqrt(RATE) * white + 1e-5 / np.sqrt(RATE) * np.cumsum(walk)


@pytest.fixture(scope="module")
def records():
    """Handled for two seconds; under a line of thrice the noise; at rest; a small line; a hump of 35 %."""
    # The hump raises the root of the spectrum by a raised cosine about 20 Hz, an octave wide at half.
    x = np.stack([noise(seed) for seed in (5, 6, 7, 7, 7)], axis=1)
    x[:200, 0] += np.cumsum(np.random.default_rng(8).normal(size=200)) * 0.02
    for k, size, f in ((1, 3.0, 3.0), (3, 0.4, 5.0)):
        x[:, k] += size * WHITE * np.sqrt(RATE) * np.sin(2.0 * np.pi * f * np.arange(N) / RATE)
    octaves = np.log2(np.arange(1, N) * RATE / (2.0 * N) / 20.0)
    hump = 1.0 + 0.35 * (abs(octaves) < 1.0) * (0.5 + 0.5 * np.cos(np.pi * octaves))
    x[:, 4] = idct(dct(x[:, 4], norm="ortho") * np.append(1.0, hump), norm="ortho")
    return x


@pytest.fixture(scope="module")
def fits(records):
    whole, options = recording(records, RATE), {"as_is": True, "vibrating": True}
    return {objective: aj.fit(whole, "N + K", objective, **options) for objective in ("allan", "whittle")}


def squares_of(result):
    """What a fitted model expects of the squares of the cosine coefficients 1 … N − 1."""
    return RATE * np.asarray(result.model.sampled(RATE).sampled_psd(np.arange(1, N) * RATE / (2.0 * N), RATE))


def by_definition(place, ratio, edf, unit):
    """Each place by itself: how far the model is outside the interval of the estimate, in logarithms.

    A spectrum also over the octave and the three octaves that begin at each place.
    """
    every, count = [(p, r, d) for p, r, d in zip(place, ratio, edf, strict=True)], len(place)
    for octaves in (1.0, 3.0) if unit == "Hz" else ():
        for start in place:
            some = (place >= start) & (np.log2(place / start) <= octaves)
            weight = edf[some] / edf[some].sum()
            mean = np.exp(weight @ np.log(place[some])), np.sqrt(weight @ ratio[some] ** 2)
            every.append((*mean, edf[some].sum()))
    at, log, edf = (np.array(x) for x in zip(*every, strict=True))
    log, beyond = np.log(log), OUTSIDE / 2.0 / len(at)
    lower, upper = (log + 0.5 * np.log(edf / chi2.ppf(p, edf)) for p in (1.0 - beyond, beyond))
    certain = np.maximum(np.maximum(lower, -upper), 0.0)
    square = np.where(certain > 0.0, log**2 - (abs(log) - certain) ** 2, 0.0)
    k = int(np.argmax(square))
    rms, here = np.sqrt(np.mean(square[:count])), certain[k]
    certain = certain[:count]
    sustained = certain.max()
    if unit == "Hz":
        # The largest of the lower medians over octaves.
        more = 2.0 * (1.0 + 1e-9)
        whole = place[2.0 * place <= place[-1] * more / 2.0]
        octaves = [certain[(place >= p) & (place <= more * p)] for p in whole]
        sustained = max(np.quantile(octave, 0.5, method="lower") for octave in octaves)
    return at[k], *np.expm1([log[k], rms, sustained, abs(log[k]) - here])


def numbers_of(misfit):
    return [misfit.largest, misfit.rms, misfit.sustained, misfit.scatter]


@pytest.mark.parametrize("axis", ["gyro_0", "gyro_3", "gyro_4"])
def test_the_misfit_of_an_allan_deviation_is_that_of_a_search_through_all_places(fits, axis):
    fit, curve = fits["allan"], fits["allan"].curve
    misfit, k = fit[axis].misfit, fit.axes.index(axis)
    ratio = curve.deviation[:, k] / fit.model_deviation(axis, curve.cluster_time)
    at, *numbers = by_definition(curve.cluster_time, ratio, curve.edf[:, k], "s")
    assert (misfit.at, misfit.unit) == (pytest.approx(at), "s")
    np.testing.assert_allclose(numbers_of(misfit), numbers, rtol=1e-6, atol=1e-9)
    assert misfit.excessive == (misfit.rms > 0.3 or misfit.sustained > 0.5)


def test_where_terms_are_undecided_the_misfit_is_that_of_their_average():
    """White noise, a slow process and an oscillation of 6 s that no noise term describes."""
    rng, n = np.random.default_rng(3), 60_000
    slow = lfilter([1.0], [1.0, 1.0 / 400.0 - 1.0], rng.standard_normal(n)) * 1e-5
    slow[n // 2 :] *= 4.0
    line = 4e-4 * np.sin(2.0 * np.pi * np.arange(n) / (6.0 * RATE))
    fit = aj.fit(recording(WHITE * rng.standard_normal(n) + slow + line, RATE), plain=True, as_is=True)
    curve, result = fit.curve, fit["gyro_0"]
    assert len(fit.selection["gyro_0"].indistinguishable) > 1
    drawn, chosen = fit.model_deviation("gyro_0", curve.cluster_time), result.model.sampled(RATE)
    assert np.ptp(np.log(drawn**2 / np.asarray(chosen.allan_variance(curve.cluster_time)))) > 0.02
    ratio = curve.deviation[:, 0] / drawn
    at, *numbers = by_definition(curve.cluster_time, ratio, curve.edf[:, 0], "s")
    (misfit,) = (m for m in (result.misfit, result.other_misfit) if m.unit == "s")
    assert misfit.at == pytest.approx(at)
    np.testing.assert_allclose(numbers_of(misfit), numbers, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("axis", ["gyro_1", "gyro_4"])
def test_the_misfit_of_a_spectrum_is_that_of_thirds_of_octaves(records, fits, axis):
    """And of octaves: of the cosine spectrum's squares, averaged over these from the first coefficient on."""
    # The model's density at each coefficient instead of two in each bin: 2 % of a deviation.
    fit = fits["whittle"]
    result, k = fit[axis], fit.axes.index(axis)
    ratio = dct(records[:, k], norm="ortho")[1:] ** 2 / squares_of(result)
    edges = result.spectrum.bins.edges
    middle = (edges[:-1] + edges[1:] - 1) * RATE / (4.0 * N)
    part = np.repeat(np.floor(3.0 * np.log2(middle / middle[0]) + 1e-9).astype(int), np.diff(edges))
    count = np.bincount(part)
    some, count = count > 0, count[count > 0]
    own = np.exp(np.bincount(part, np.log(np.repeat(middle, np.diff(edges))))[some] / count)
    mean = np.bincount(part, ratio)[some] / count
    at, *numbers = by_definition(own, np.sqrt(mean), count.astype(float), "Hz")
    assert (result.misfit.at, result.misfit.unit) == (pytest.approx(at, rel=1e-3), "Hz")
    np.testing.assert_allclose(numbers_of(result.misfit), numbers, rtol=0.03, atol=2e-3)


def test_a_hump_is_said_to_be_one(fits):
    """The fit gives way to it by some per cent; the Allan deviation sees it over an octave or two."""
    for objective, least in (("whittle", 0.2), ("allan", 0.05)):
        result, good = fits[objective]["gyro_4"], fits[objective]["gyro_2"]
        assert least < result.misfit.largest < 0.4
        assert result.discrepancy >= result.misfit.rms
        assert result["N"].std > 3.0 * good["N"].std
        assert (result.measured, good.misfit, good.discrepancy) == (True, None, 0.0)
    assert abs(np.log2(fits["whittle"]["gyro_4"].misfit.at / 20.0)) < 0.35
    # The mean square of a raised cosine of 35 %, two octaves long, over the 13 octaves that there are.
    known = 0.35 * np.sqrt(0.75 / np.log2(N))
    assert 0.5 * known < fits["whittle"]["gyro_4"].misfit.rms < 1.15 * known


def test_the_discrepancy_brings_chi_square_to_its_degrees_of_freedom(fits):
    """Of levels: 2/dof of each becomes 2/dof + per_octave·(2·discrepancy)², common to an octave."""
    for axis in ("gyro_3", "gyro_4"):
        result = fits["whittle"][axis]
        bins = result.spectrum.bins
        k, octave = np.diff(bins.edges).astype(float), np.log(2.0) * np.arange(1, len(bins.edges))
        ratio = result.spectrum.squares / np.add.reduceat(squares_of(result), bins.edges[:-1] - 1)
        score = (np.cbrt(ratio) - 1.0 + 2.0 / (9.0 * k)) / np.sqrt(2.0 / (9.0 * k))
        high = 6.0 / np.log2(bins.frequency[-1] / bins.frequency[-7])
        per_octave = np.where(k > 1.0, high, np.maximum(octave, 1.0))
        chi_square = np.sum(score**2 / (1.0 + 2.0 * k * per_octave * result.discrepancy**2))
        assert chi_square < 1.1 * result.dof
        # Or it is the misfit's rms, if that is more.
        assert chi_square > 0.9 * result.dof or result.discrepancy < 1.001 * result.misfit.rms


@pytest.mark.parametrize("objective", ["allan", "whittle"])
def test_a_curve_that_is_far_off_is_no_measurement(fits, objective):
    found = fits[objective]
    assert [result.measured for result in found.values()] == [False, False, True, True, True]
    assert found["gyro_2"]["N"].interval[0] < WHITE < found["gyro_2"]["N"].interval[1]
    for axis in ("gyro_0", "gyro_1"):
        result = found[axis]
        assert result.is_far_off
        assert result.verdict.startswith("not a measurement of this sensor")
        assert np.isnan(result.covariance).all()
        for c in result.coefficients.values():
            assert np.isnan([c.std, *c.interval, *c.interval_68]).all()
            assert (c.detected, c.upper_limit, c.measured) == (False, None, False)
            assert "±" not in str(c)
        with pytest.raises(aj.FitError, match=axis):
            aj.sample(found, axis, progress=False)
    assert found.warnings[-1].startswith("gyro_0, gyro_1: not a measurement")
    table = found.to_dataframe()
    assert table["measured"].tolist() == table["std"].notna().tolist() == [False] * 4 + [True] * 6
    # As of the same curves in bulk, at octaves.
    many = aj.fit_many(found.curve, "N + K")
    np.testing.assert_array_equal(many.measured, np.arange(5) > 1)
    if objective == "allan":
        np.testing.assert_allclose(many.discrepancy, [r.discrepancy for r in found.results], rtol=1e-5)


def test_a_sensor_in_motion_is_no_measurement_unless_it_vibrates():
    x = noise(7) + 0.3 * np.sin(2.0 * np.pi * 0.3 * np.arange(N) / RATE)
    for vibrating in (False, True):
        (result,) = aj.fit(recording(x, RATE), "N + K", as_is=True, vibrating=vibrating).results
        assert result.moving == (not vibrating)
        assert not result.measured


def test_what_was_held_stays_as_it_was_given(records, fits):
    model = aj.AngleRandomWalk(WHITE).hold("coefficient") + aj.RateRandomWalk()
    for k, objective in ((2, "allan"), (2, "whittle"), (1, "whittle")):
        x = recording(records[:, k], RATE)
        result = aj.fit(x, model, objective, as_is=True, vibrating=True)["gyro_0"]
        free = fits[objective].results[k]
        c = result["N"]
        assert (c.value, c.std, c.held, c.measured, c.interval) == (WHITE, 0.0, True, True, (WHITE, WHITE))
        assert c.describe().endswith("(held)")
        assert result.dof == free.dof + 1
        assert k == 1 or 0.0 < result["K"].std < 1.05 * free["K"].std


def test_mean_and_rms_are_those_of_the_samples():
    fit, record = bench.fit("small"), bench.truth("small")
    np.testing.assert_allclose([r.mean for r in fit.results], record.values.mean(axis=0), rtol=1e-9)
    np.testing.assert_allclose([r.rms for r in fit.results], record.values.std(axis=0), rtol=1e-6)
