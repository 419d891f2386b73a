"""Numbers of power spectra and autocorrelations by their definitions, and spectra without scatter."""

import dataclasses
from types import SimpleNamespace

import dense
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refuses
from scipy import signal, special, stats

import allanjax as aj

RATE = 10.0
AXES = (aj.Axis("gyro_x", "gyro", "deg/s"), aj.Axis("accel_z", "accel", "g"))


def white(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(n, 2)) * [1.0, 2.0]


def recording(values: np.ndarray) -> aj.Recording:
    return aj.Recording(values, RATE, AXES[: values.shape[1]])


def groups(m: int) -> np.ndarray:
    """Ordinates averaged in each point, 16 points an octave above the first 32 (table 3.4)."""
    # The rest of a broken octave joins the last group if it is less than half of one.
    found = []
    while (done := sum(found)) < m:
        size = 1 if done < 32 else 2 ** int(np.log2(done / 16.0))
        found.append(min(size, m - done))
    if len(found) > 32 and found[-1] < 2 ** int(np.log2(sum(found[:-1]) / 16.0)) / 2:
        last = found.pop()
        found[-1] += last
    return np.array(found)


@pytest.mark.parametrize("window", ["hann", "boxcar", "blackman"])
def test_points_are_means_of_the_windowed_periodogram(window):
    """Eq. (3.39) with the window's power instead of the record's length; one-sided, hence twice."""
    for n in (16, 17, 66, 67, 131, 133, 263, 1000, 1001):
        t = np.arange(n)
        x = white(n) + t[:, None] * [0.01, -3.0] + 9.8
        found = aj.power_spectrum(x, 50.0, window=window)
        w = signal.get_window(window, n)
        j = np.arange(1, (n + 1) // 2)
        X = np.exp(-2j * np.pi * np.outer(j, t) / n) @ (w[:, None] * signal.detrend(x, axis=0))
        S = 2.0 * abs(X) ** 2 / (50.0 * np.sum(w**2))
        assert_array_equal(found.count, groups(len(j)))
        starts, count = np.cumsum(found.count) - found.count, found.count
        means = np.add.reduceat(S, starts) / count[:, None]
        assert_allclose(found.density, means, rtol=1e-7, atol=1e-12)
        assert_allclose(found.frequency, np.add.reduceat(j, starts) / count * 50.0 / n)
        assert (found.n, found.rate, found.method) == (n, 50.0, "logarithmic")
        assert (found.window, found.segments) == (window, 1)


@pytest.mark.parametrize("length", [256, 501])
def test_welch_is_scipys(length):
    x = white(5000)
    found = aj.power_spectrum(x, 20.0, method="welch", segment_time=length / 20)
    f, S = signal.welch(x, 20.0, nperseg=length, axis=0)
    inside = slice(1, (length + 1) // 2)
    assert_allclose(found.frequency, f[inside], rtol=1e-12)
    assert_allclose(found.density, S[inside], rtol=1e-9)
    assert found.segments == 1 + (5000 - length) // (length - length // 2)
    averaged = found.averaged()
    assert_array_equal(averaged.count, groups(len(found.frequency)))
    starts = np.cumsum(averaged.count) - averaged.count
    means = np.add.reduceat(found.density, starts) / averaged.count[:, None]
    assert_allclose(averaged.density, means, rtol=1e-12)
    assert_allclose(averaged.dof, found.degrees_of_freedom(averaged.count))
    assert averaged.averaged() is averaged
    # By default as many samples, a power of two, as fit into a record eight times, and eight at least.
    for n, own in ((16, 8), (1023, 64), (1024, 128), (5000, 512)):
        found = aj.power_spectrum(white(n), RATE, method="welch")
        assert found.frequency[0] == pytest.approx(RATE / own)
        assert len(found.frequency) == own // 2 - 1


def dense_dof(window: str, n: int, length: int, count: int) -> float:
    """(tr G)²/tr G² of the mean of ordinates under white noise, from the products of all its rows."""
    w = signal.get_window(window, length)
    step = max(length - length // 2, 1)
    t, rows = np.arange(length), []
    for start in range(0, n - length + 1, step) if length < n else (0,):
        for j in range(length // 4, length // 4 + count):
            for wave in (np.cos, np.sin):
                rows.append(np.zeros(n))
                rows[-1][start : start + length] = w * wave(2.0 * np.pi * j * t / length)
    G = np.array(rows) @ np.array(rows).T
    return np.trace(G) ** 2 / np.sum(G**2)


@pytest.mark.parametrize("window", ["hann", "boxcar", "blackman"])
def test_degrees_of_freedom_are_those_of_dense_covariances(window):
    n = 1024
    whole = aj.power_spectrum(white(n), RATE, window=window)
    welch = aj.power_spectrum(white(n), RATE, window=window, method="welch", segment_time=128 / RATE)
    assert_allclose(whole.dof, whole.degrees_of_freedom(whole.count))
    assert_allclose(welch.dof, welch.degrees_of_freedom(1))
    for count in (1, 2, 3, 20):
        assert whole.degrees_of_freedom(count) == pytest.approx(dense_dof(window, n, n, count), rel=1e-6)
        # A little of half-overlapping segments' correlation at other distances is neglected.
        assert welch.degrees_of_freedom(count) == pytest.approx(dense_dof(window, n, 128, count), rel=0.01)
    if window == "hann":
        # Squared correlations of 4/9 and 1/36.
        assert_allclose(whole.correlation[:4], [1.0, 4 / 9, 1 / 36, 0.0], atol=1e-7)


SQUARES = [(aj.power_spectrum, "density", "dof"), (aj.wavelet_variance, "variance", "edf")]


@pytest.mark.parametrize(("of", "value", "degrees"), SQUARES)
def test_errors_and_intervals_are_those_of_the_chi_squared_law(of, value, degrees):
    found = of(white(1024), RATE)
    y, dof = getattr(found, value), getattr(found, degrees).reshape(len(found.count), -1)
    for level in (0.68, 0.95):
        ends = [y * dof / stats.chi2(dof).ppf(0.5 + s * level / 2.0) for s in (1.0, -1.0)]
        assert_allclose(found.confidence_interval(level), ends, rtol=1e-9)
    assert_array_equal(found.confidence_interval(), found.confidence_interval(0.95))
    assert_allclose(found.standard_error, y * np.sqrt(2.0 / dof))


def shapes(f: np.ndarray) -> np.ndarray:
    """Densities of white noise, flicker, random walk and quantization of coefficients 1, (4.28) to (4.52)."""
    # Those of the second and third are without aliases.
    sine = np.sin(np.pi * f / RATE)
    return np.stack([0.0 * f + 2.0, 1.0 / (np.pi * f), 0.5 / (np.pi * f) ** 2, 8.0 * RATE * sine**2], 1)


def without_scatter(n: int, density, dof: float | None = None) -> aj.PowerSpectrum:
    """A spectrum of this density [m, 2] to 10⁻⁵, and of as many degrees of freedom everywhere if given."""
    found = aj.power_spectrum(recording(white(n)))
    scatter = 1.0 + 1e-5 * np.random.default_rng(1).normal(size=found.density.shape)
    found = dataclasses.replace(found, density=density(found.frequency) * scatter)
    return found if dof is None else dataclasses.replace(found, dof=np.full(len(found.dof), dof))


def chi_squared_ends(value: float, dof: float, level: float) -> list[float]:
    """Lower and upper end of the interval of a deviation."""
    return [value * np.sqrt(dof / stats.chi2(dof).ppf(0.5 + s * level / 2.0)) for s in (1.0, -1.0)]


COEFFICIENTS = np.array([[2.0, 0.4, 0.03, 0.05], [0.5, 0.02, 0.06, 0.001]])


def test_white_noise_in_a_band_is_eq_3_41():
    """√(mean/2), of the χ² law of the mean, and below it by what other noise contributes."""
    found = without_scatter(4096, lambda f: shapes(f) @ COEFFICIENTS.T**2)
    for k, name in enumerate(found.names):
        for low, high in ((0.3, 1.7), (0.02, 4.9)):
            inside = (low <= found.frequency) & (found.frequency <= high)
            count = found.count[inside]
            parts = (shapes(found.frequency[inside]) * COEFFICIENTS[k] ** 2 / 2.0).T @ count / count.sum()
            walk = found.random_walk(name, band=(low, high))
            value, nu = np.sqrt(parts.sum()), walk.degrees_of_freedom
            excess = value - np.sqrt(parts[0])
            assert walk.value == pytest.approx(value, rel=1e-5)
            assert walk.excess == pytest.approx(excess, rel=1e-3)
            assert nu == pytest.approx(found.degrees_of_freedom(count.sum()))
            assert walk.std == pytest.approx(np.hypot(value / np.sqrt(2.0 * nu), excess), rel=1e-3)
            for level, interval in ((0.95, walk.interval), (0.68, walk.interval_68)):
                low_end, high_end = chi_squared_ends(value, nu, level)
                uncertain = stats.norm.ppf(0.5 + level / 2.0) * excess / 2.0
                bottom = max(value - excess - np.hypot(value - low_end, uncertain), 0.0)
                assert_allclose(interval, (bottom, high_end), rtol=2e-4, atol=1e-12)
            assert (walk.band, walk.source, walk.axis.name) == ((low, high), "spectrum", name)
            assert walk.usual_unit == ("deg/√h" if k == 0 else "m/s/√h")


def best_band(s: aj.PowerSpectrum, coloured: np.ndarray) -> tuple[float, float]:
    """The rule of `PowerSpectrum.flat_band`, band by band with `numpy.polyfit`, the best first."""
    share = s.degrees_of_freedom(s.count.sum()) * s.count / s.count.sum()
    x, half = np.log(s.frequency), s.dof / 2.0
    y = np.log(s.density[:, 0]) - special.digamma(half) + np.log(half)
    w = share / s.dof / special.polygamma(1, half)
    bands = [slice(a, b + 1) for a in range(len(x)) for b in range(a + 4, len(x)) if x[b] - x[a] >= np.log(2)]
    part = [s.count[i] @ coloured[i] / (s.count[i] @ s.density[i, 0]) for i in bands]
    error = 2.0 / np.array([share[i].sum() for i in bands]) + np.square(part)
    for band in (bands[k] for k in np.argsort(error)):
        z = x[band] - np.average(x[band], weights=w[band])
        fits = [np.polyfit(z, y[band], degree, w=np.sqrt(w[band])) for degree in range(3)]
        left = [w[band] @ (y[band] - np.polyval(fit, z)) ** 2 for fit in fits]
        slope = abs(fits[1][0]) + 2.0 / np.sqrt(w[band] @ z**2)
        if slope < 0.5 and left[0] - left[2] <= 2.0 and stats.chi2.sf(left[0], len(z) - 1) > 1e-3:
            edges = (np.append(0, np.cumsum(s.count)) + 0.5) * s.frequency[0]
            return edges[band.start], edges[band.stop]
    raise AssertionError


# Chosen for what decides: slope and curvature, the octave, curvature, scatter.
RECORDS = [(21, 1024, 0.1, 1.0, 0.1), (82, 1024, 0.3, 0.0, 0.1), (216, 1024, 0.3, 0.5, 0.2)]
RECORDS += [(72, 4096, 0.1, 0.0, 0.3)]


@pytest.mark.parametrize(("seed", "n", "K", "Q", "line"), RECORDS)
def test_the_flat_band_is_the_best_of_all(seed, n, K, Q, line):
    rng = np.random.default_rng(seed)
    x = rng.normal(size=n) + K * np.cumsum(rng.normal(size=n)) + Q * np.diff(rng.normal(size=n + 1))
    found = aj.power_spectrum(recording((x + line * np.cos(2.0 * np.pi * 0.13 * np.arange(n)))[:, None]))
    # What other noise contributes to a point is in the excess of a band of this point alone.
    alone = [found.random_walk("gyro_x", band=(f * 0.999999, f * 1.000001)) for f in found.frequency]
    coloured = np.array([2.0 * (w.value**2 - (w.value - w.excess) ** 2) for w in alone])
    band = found.flat_band("gyro_x")
    assert_allclose(band, best_band(found, coloured), rtol=1e-9)
    assert found.random_walk("gyro_x") == found.random_walk("gyro_x", band=band)


TERMS = {
    "quantization": (aj.Quantization(2e-3), 2), "angle_random_walk": (aj.AngleRandomWalk(0.03), 0),
    "bias_instability": (aj.BiasInstability(0.02), -1), "rate_random_walk": (aj.RateRandomWalk(0.4), -2),
    "drift_ramp": (aj.DriftRamp(0.7), -3),
}  # fmt: skip


def term_density(term: aj.NoiseTerm, f: np.ndarray) -> np.ndarray:
    """Twice the two-sided density of the samples; a ramp stands for R²/(2πf)³ (4.58)."""
    if isinstance(term, aj.DriftRamp):
        return 2.0 * term.coefficient**2 / (2.0 * np.pi * f) ** 3
    return 2.0 * np.asarray(term.sampled_psd(f, RATE))


@pytest.mark.parametrize("label", TERMS)
def test_a_term_alone_is_read_and_no_other(label):
    """Its coefficient as it is, with the χ² law of a mean over an octave or more, but for two ordinates."""
    term, slope = TERMS[label]
    found = without_scatter(4096, lambda f: term_density(term, f)[:, None] * [1.0, 9.0], 200.0)
    f = np.array([0.01, 0.04])
    assert np.diff(np.log(term_density(term, f)))[0] / np.log(4.0) == pytest.approx(slope, abs=1e-3)
    readings = found.readings()
    for k, name in enumerate(found.names):
        read = {key: e for key, e in readings[name].estimates.items() if e is not None}
        assert list(read) == [label]
        assert set(readings[name].reasons) == set(TERMS) - {label}
        estimate, truth = read[label], (1.0 + 2.0 * k) * term.coefficient
        assert estimate.value == pytest.approx(truth, rel=1e-5)
        assert estimate.excess == pytest.approx(0.0, abs=1e-4 * truth)
        low, high = estimate.band
        inside = (low <= found.frequency) & (found.frequency <= high)
        nu = found.degrees_of_freedom(found.count[inside].sum())
        assert estimate.degrees_of_freedom == pytest.approx(nu)
        assert estimate.std == pytest.approx(truth / np.sqrt(2.0 * nu), rel=1e-4)
        for level, interval in ((0.95, estimate.interval), (0.68, estimate.interval_68)):
            assert_allclose(interval, chi_squared_ends(truth, nu, level), rtol=1e-4)
        # The lowest two ordinates are left out, for N only where it is not worth while.
        assert low == pytest.approx((0.5 if slope == 0 else 2.5) * found.frequency[0])
        assert high == pytest.approx((found.count.sum() + 0.5) * found.frequency[0])


def test_two_terms_are_read_on_either_side_of_their_crossing():
    """The mean of density over that of the term, of which the other one is the excess; no third between."""
    N, K = aj.AngleRandomWalk(0.03), aj.RateRandomWalk(0.003)
    density = [lambda f, t=t: np.stack([term_density(t, f)] * 2, axis=1) for t in (N, K)]
    found = without_scatter(2**17, lambda f: density[0](f) + density[1](f), 200.0)
    readings = found.readings()["gyro_x"]
    read = [label for label, e in readings.estimates.items() if e is not None]
    assert read == ["angle_random_walk", "rate_random_walk"]
    assert readings["angle_random_walk"] == found.random_walk("gyro_x")
    crossing = 0.003 / 0.03 / (2.0 * np.pi)
    for label, term, of in (("rate_random_walk", K, 1), ("angle_random_walk", N, 0)):
        estimate = readings[label]
        assert (estimate.band[1] < crossing) if of else (estimate.band[0] > crossing)
        inside = (estimate.band[0] <= found.frequency) & (found.frequency <= estimate.band[1])
        count, f = found.count[inside], found.frequency[inside]
        unit = term_density(term.with_unit_amplitude(), f)
        own, other = (np.average(density[i](f)[:, 0] / unit, weights=count) for i in (of, 1 - of))
        assert estimate.value == pytest.approx(np.sqrt(own + other), rel=1e-5)
        assert estimate.excess == pytest.approx(np.sqrt(own + other) - np.sqrt(own), rel=0.05)


def test_what_is_nowhere_flat_is_refused():
    spectrum = aj.power_spectrum(recording(white(20_000, seed=2).cumsum(axis=0)))
    refuses(r"gyro_x.*band=\(low, high\)", spectrum.random_walk, "gyro_x")
    assert spectrum.random_walk("gyro_x", band=(1.0, 2.0)).value > 0
    assert spectrum.readings()["gyro_x"]["angle_random_walk"] is None


def test_readings_have_a_table():
    spectrum = aj.power_spectrum(recording(white(1000)))
    readings = spectrum.readings()
    table = readings.to_dataframe().set_index(["axis", "coefficient"])
    walk = readings["accel_z"]["angle_random_walk"].in_unit("m/s/√h")
    row = table.loc[("accel_z", "angle_random_walk")]
    numbers = [row[c] for c in ("value", "std", "lower_95", "upper_95", "unit")]
    assert numbers == [walk.value, walk.std, *walk.interval, "m/s/√h"]
    row = table.loc[("gyro_x", "drift_ramp")]
    assert np.isnan(row["value"])
    assert row["reason"] == readings["gyro_x"].reasons["drift_ramp"] != ""


HUNDRED = white(100)
UNREADABLE = [
    (HUNDRED, {"rate": None}, "rate"), (recording(HUNDRED), {"rate": 100.0}, "rate"),
    (HUNDRED, {"rate": -1.0}, "rate"), (HUNDRED, {"method": "fft"}, "'fft'"),
    (HUNDRED, {"window": "hunn"}, "'hunn'"), (HUNDRED, {"segment_time": 10.0}, "segment_time"),
    (HUNDRED, {"method": "welch", "segment_time": 7.0}, "8 samples"),
    (HUNDRED, {"method": "welch", "segment_time": 101.0}, "100 s"), (HUNDRED[:15], {}, "15"),
    (HUNDRED.reshape(10, 10, 2), {}, "axes"), (np.where(HUNDRED > 2.0, np.nan, HUNDRED), {}, "finite"),
]  # fmt: skip
REFUSED = [
    (HUNDRED, lambda s: s.confidence_interval(68), "level"),
    (HUNDRED, lambda s: s.random_walk("0", (0.1, 0.2)), "gyro_unit"),
    (HUNDRED, lambda s: s.readings(), "gyro_unit"),
    (recording(HUNDRED), lambda s: s.random_walk("gyro_q"), "'gyro_q'"),
    (recording(HUNDRED), lambda s: s.random_walk("gyro_x", (6.0, 7.0)), "no frequency"),
]


def test_refused():
    for data, options, word in UNREADABLE:
        refuses(word, aj.power_spectrum, data, **{"rate": 1.0, **options})
    for data, call, word in REFUSED:
        spectrum = aj.power_spectrum(data, None if data is not HUNDRED else 1.0)
        refuses(word, call, spectrum)


N, LOW = 400, 2.0


def record(n: int = N) -> np.ndarray:
    return 9.8 + np.random.default_rng(0).standard_normal((n, 2)).cumsum(axis=0) * [1.0, 3.0]


def test_the_estimate_is_the_mean_product_of_samples_so_far_apart():
    x = record(300)
    found = aj.autocorrelation(x, LOW, longest_lag=50.0)
    assert_array_equal(found.lag, np.arange(101) / LOW)
    for k, axis in enumerate(x.T - x.mean(axis=0)[:, None]):
        sums = np.correlate(axis, axis, "full")[299 : 299 + 101]
        assert_allclose(found.value[:, k], sums / (300 - np.arange(101)), rtol=1e-9, atol=1e-9)
    assert np.isnan(found.standard_error).all()
    assert (found.n, found.rate, found.names) == (300, LOW, ("0", "1"))
    # A tenth of the record.
    assert len(aj.autocorrelation(x, LOW).lag) == 31


ROUNDED = aj.Quantization(1.0) + aj.AngleRandomWalk(0.3)
MODELS = {"gyro_x": ROUNDED, "accel_z": aj.Markov(1.3, 4.0) + aj.AngleRandomWalk(1.0)}


def bartlett(R: np.ndarray, k: int) -> float:
    """Standard error at lag k from R(0) … R(n−1), summed over positive and negative m."""
    n = len(R)
    R = np.concatenate([np.zeros(n), R[:0:-1], R, np.zeros(n)])
    m, zero = np.arange(1 - n, n), 2 * n - 1
    taper = np.maximum(1.0 - abs(m) / (n - k), 0.0)
    return np.sqrt(np.sum(taper * R[zero + m] ** 2 + R[zero + m + k] * R[zero + m - k]) / (n - k))


def test_standard_errors_are_those_of_bartlett():
    """Each axis under its own model, of covariances that are written out."""
    fit = {name: SimpleNamespace(model=model) for name, model in MODELS.items()}
    found = aj.autocorrelation(aj.Recording(record(), LOW, AXES), model=fit, longest_lag=30.0)
    alone = aj.autocorrelation(record(), LOW, model=MODELS["gyro_x"], longest_lag=30.0)
    assert_array_equal(alone.standard_error[:, 1], found.standard_error[:, 0])
    for axis, model in enumerate(MODELS.values()):
        R = dense.autocovariance(model, N, LOW)
        for k in (0, 1, 7, 60):
            assert found.standard_error[k, axis] == pytest.approx(bartlett(R, k), rel=1e-9)


def test_what_is_not_stationary_has_no_standard_error():
    for term in (aj.BiasInstability(1.0), aj.RateRandomWalk(1.0), aj.DriftRamp(1.0), aj.Markov(1.0, 100.0)):
        name = term.name().replace("_", " ")
        found = aj.autocorrelation(record(), LOW, model=aj.AngleRandomWalk(1.0) + term)
        assert np.isnan(found.standard_error).all()
        assert all(f" {name} " in remark for remark in found.remarks)


def test_parameters_are_read_at_zero_and_at_one_over_e():
    """By a straight line between the lags around it, with √(2/(βT)) for errors; no interval is below zero."""
    lag = np.arange(10.0)
    value = np.exp(-lag / 2.5)[:, None] * [4.0, 0.01]
    for n, clipped in ((4000, False), (10, True)):
        curve = aj.Autocorrelation(lag, value, value, ("", ""), n, 1.0, AXES)
        time = 2.0 + (value[2, 0] - 4.0 / np.e) / (value[2, 0] - value[3, 0])
        accuracy = np.sqrt(2.0 * time / n)
        for axis, R0 in (("gyro_x", 4.0), ("accel_z", 0.01)):
            read = curve.markov()[axis].estimates
            for label, truth in (("markov variance", R0), ("markov correlation time", time)):
                estimate = read[label]
                assert (estimate.value, estimate.std) == pytest.approx((truth, accuracy * truth))
                for level, interval in ((0.95, estimate.interval), (0.68, estimate.interval_68)):
                    half = stats.norm.ppf(0.5 + level / 2.0) * accuracy * truth
                    assert_allclose(interval, [max(truth - half, 0.0), truth + half], rtol=1e-5)
            assert (estimate.interval[0] == 0.0) == clipped
            unit = "(deg/h)²" if axis == "gyro_x" else "µg²"
            assert (read["markov variance"].usual_unit, estimate.usual_unit) == (unit, "s")
        table = curve.markov().to_dataframe().set_index(["axis", "coefficient"])["value"]
        assert table["accel_z", "markov variance"] == pytest.approx(0.01 / 9.80665e-6**2)


def test_what_cannot_be_read_or_estimated_is_explained():
    value = np.stack([[1.0, 0.9, 0.8, 0.4], [1.0, 0.3, 0.2, 0.1]], axis=1)
    read = aj.Autocorrelation(np.arange(4.0), value, value, ("", ""), 100, 1.0, AXES).markov()
    for axis, word in (("gyro_x", "1/e"), ("accel_z", "sample")):
        assert set(read[axis].estimates.values()) == {None}
        assert word in read[axis].reasons["markov correlation time"]
    refuses("longest_lag", aj.autocorrelation, record(50), 1.0, longest_lag=49.0)
    assert len(aj.autocorrelation(record(50), 1.0, longest_lag=48.0).lag) == 49
    refuses("gyro_unit", aj.autocorrelation(record(50), 1.0).markov)
