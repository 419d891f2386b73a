"""Every number of an Allan deviation, of streams in pieces too, by its definition, written out in NumPy."""

import dataclasses
import itertools
import os
import re

import jax.numpy as jnp
import numpy as np
import pytest
from dense_fits import Variances
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refuses
from scipy import stats

import allanjax as aj

#: Kind, whether clusters overlap.
KINDS = {
    "adev": ("allan", False), "oadev": ("allan", True), "mdev": ("modified", True),
    "hdev": ("hadamard", False), "ohdev": ("hadamard", True),
}  # fmt: skip
each_kind = pytest.mark.parametrize("name", KINDS)
RATE, SLOW = 50.0, 4.0


def curve(name: str, data, **options) -> aj.AllanDeviation:
    kind, overlapping = KINDS[name]
    given = {"cluster_times": "octave", "kind": kind, "overlapping": overlapping}
    return aj.allan_deviation(data, RATE, **(given | options))


def disturbed(n: int) -> np.ndarray:
    """Two axes: a large bias with a bright start and white noise; a random walk on a ramp."""
    rng = np.random.default_rng(n)
    first = 9.8e4 + 1e4 * np.exp(-np.arange(n) / 50.0) + rng.normal(size=n)
    return np.stack([first, rng.normal(size=n).cumsum() + 0.01 * np.arange(n)], axis=1)


def phases(x: np.ndarray) -> np.ndarray:
    return np.concatenate([np.full((1, 2), 3.0), 3.0 + x.cumsum(axis=0) / RATE])


def differences(x: np.ndarray, m: int, name: str) -> np.ndarray:
    """Second or third differences of phases of 64 binary digits, by slices of the whole record, over m."""
    kind, overlapping = KINDS[name]
    x = x.astype(np.longdouble)
    phase = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(x - x.mean(axis=0), axis=0)])
    d = (phase[2 * m :] - 2 * phase[m:-m] + phase[: -2 * m]) / m
    if kind == "modified":
        sums = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(d, axis=0)])
        d = (sums[m:] - sums[:-m]) / m
    elif kind == "hadamard":
        d = d[m:] - d[:-m]
    return d if overlapping else d[::m]


def check(found: aj.AllanDeviation, x: np.ndarray, name: str, rtol: float) -> None:
    """Deviations and numbers of differences are those of 64 binary digits."""
    for k, m in enumerate(found.cluster_size):
        d = differences(x, m, name)
        assert found.count[k] == len(d)
        expected = np.sqrt((d**2).mean(axis=0) / (6 if "h" in name else 2)).astype(float)
        assert_allclose(found.deviation[k], expected, rtol=rtol)


@each_kind
def test_every_cluster_size_of_short_records(name):
    for n in (9, 14, 16):
        rates = np.random.default_rng(n).normal([0.0, 5.0], size=(n, 2))
        found = curve(name, rates, cluster_times="all")
        assert_array_equal(found.cluster_size, np.arange(1, len(found.count) + 1))
        assert_allclose(found.cluster_time, found.cluster_size / RATE, rtol=1e-15)
        check(found, rates, name, 1e-12)
        # One size more and there is no difference left.
        assert len(differences(rates, len(found.count) + 1, name)) == 0


@pytest.mark.parametrize("data_type", ["rate", "phase"])
@each_kind
def test_records_of_one_piece(name, data_type):
    """A bias, a ramp and a bright start cost no digits."""
    for n in (600, 1000):
        x = disturbed(n)
        sizes = [1, 2, 7, 100, (n + 1) // 3 if name == "mdev" else n // 3]
        values = x if data_type == "rate" else phases(x)
        found = curve(name, values, cluster_times=np.array(sizes) / RATE, data_type=data_type)
        assert (found.n, found.cluster_size.tolist()) == (n, sizes)
        check(found, x, name, 1e-9)


@each_kind
def test_long_records_are_shared_out_among_the_cores(name, monkeypatch):
    """From 131,072 samples on, in pieces. Phases reach 10⁸, the differences of the walk are of 1."""
    monkeypatch.setattr(os, "cpu_count", lambda: 3)
    x, sizes = disturbed(140_001), np.array([1, 2, 7, 1000, 4096, 40_000])
    check(curve(name, x, cluster_times=sizes / RATE), x, name, 5e-8 if name == "mdev" else 1e-9)
    if name == "oadev":
        found = curve(name, phases(x), cluster_times=sizes / RATE, data_type="phase")
        check(found, x, name, 1e-7)


@pytest.mark.parametrize("estimator", ["exact", "pyramid"])
def test_records_may_lie_in_memory_as_they_like(estimator, tmp_path):
    for n in (1000, 140_001):
        x = disturbed(n).astype(np.float32)
        np.save(tmp_path / "x.npy", x)
        plain = x.astype(float)
        expected = aj.allan_deviation(plain, RATE, estimator=estimator).deviation
        for same in (
            x,
            np.load(tmp_path / "x.npy", mmap_mode="r"),
            np.asfortranarray(plain),
            plain[:, ::-1].copy()[:, ::-1],
            plain.astype(">f8"),
            np.repeat(plain, 2, axis=0)[::2],
            jnp.asarray(plain),
        ):
            found = aj.allan_deviation(same, RATE, estimator=estimator).deviation
            assert_allclose(found, expected, rtol=1e-14 if estimator == "exact" else 0.0)
            assert_array_equal(same, plain)


OCTAVES = [1, 2, 4, 8, 16, 32, 64, 128, 256]
SIZES = [
    ("octave", "allan", OCTAVES), ("octave", "hadamard", OCTAVES),
    ("decade", "allan", [1, 2, 4, 10, 20, 40, 100, 200, 400]),
    ("decade", "modified", [1, 2, 4, 10, 20, 40, 100, 200]), (1, "allan", OCTAVES),
    (2, "allan", [1, 2, 3, 4, 6, 8, 11, 16, 23, 32, 45, 64, 91, 128, 181, 256, 362]),
    # Each to within a thousandth of a sample.
    ([0.1, 1 / 50, 0.1, 3.0003 / 50, 10.0], "allan", [1, 3, 5, 500]), (np.array([6.66]), "hadamard", [333]),
]  # fmt: skip


def test_cluster_sizes():
    for spacing, kind, sizes in SIZES:
        found = aj.allan_deviation(disturbed(1000), RATE, kind=kind, cluster_times=spacing)
        assert found.cluster_size.tolist() == sizes
        assert_allclose(found.cluster_time, np.array(sizes) / RATE)


@each_kind
def test_degrees_of_freedom_are_those_of_the_dense_covariance(name):
    """2·E[V]²/Var V. Of the modified variance beyond m = 64 the record is thinned, which costs 0.1 %."""
    for n, sizes in ((16, [1, 2, 4]), (1000, [1, 3, 16, 64, 100, 333])):
        data = np.random.default_rng(n).normal(size=(n, 2))
        found = curve(name, data, cluster_times=np.array(sizes) / RATE)
        for k, m in enumerate(sizes):
            # Of unit white noise the differences' weights have the products C.
            weights = differences(np.eye(n), m, name).astype(float)
            C = weights @ weights.T
            rel = 2e-3 if name == "mdev" and m > 64 else 1e-9
            assert_allclose(found.edf[k], np.trace(C) ** 2 / np.sum(C**2), rtol=rel, err_msg=str(m))


def test_intervals_are_those_of_the_chi_squared_law():
    """The true variance lies between s²·ν/χ² of the upper and s²·ν/χ² of the lower quantile."""
    edf = np.array([[0.9, 1.0, 4.5, 10.0, 300.0]])
    found = dataclasses.replace(curve("oadev", np.eye(5)), edf=edf, deviation=np.full(edf.shape, 2.0))
    for level in (0.68, 0.95, 0.3):
        quantiles = [stats.chi2(edf).ppf(p) for p in ((1.0 + level) / 2.0, (1.0 - level) / 2.0)]
        ends = 2.0 * np.sqrt(edf / np.array(quantiles))
        assert_allclose(found.confidence_interval(level), ends, rtol=1e-9)
    assert_array_equal(found.confidence_interval(), found.confidence_interval(0.95))
    assert_allclose(found.standard_error, 2.0 / np.sqrt(2.0 * edf))
    assert_array_equal(found.variance, np.full(edf.shape, 4.0))
    for level in (0.0, 1.0, 95):
        refuses("level", found.confidence_interval, level)


AXES = (aj.Axis("gyro_x", "gyro", "deg/s"), aj.Axis("accel_x", "accel", "g"))


def test_a_recording_has_its_rate_axes_and_units():
    recording = aj.Recording(values=disturbed(1000), rate=20.0, axes=AXES)
    found, bare = aj.allan_deviation(recording), curve("oadev", recording.values)
    assert (found.axes, found.names, found.rate) == (AXES, ("gyro_x", "accel_x"), 20.0)
    assert_array_equal(found.deviation, bare.deviation)
    assert (bare.names, list(bare.to_dataframe())[2]) == (("0", "1"), "0")
    for of in (aj.allan_deviation, aj.power_spectrum, aj.autocorrelation, aj.wavelet_variance):
        curves = of(recording)
        whole, own = curves.to_dataframe(), curves["accel_x"].to_dataframe()
        assert list(curves) == ["gyro_x", "accel_x"]
        assert own.equals(whole[[c for c in whole if not c.startswith("gyro_x")]])


HOUR, MICRO_G = np.pi / 180.0 / 3600.0, 9.80665e-6
# Abscissa and its column, values with the power and the end of their unit, labels of the errors if any.
CURVES = {
    aj.allan_deviation: ("cluster_time", "cluster time [s]", "deviation", 1, "", "edf"),
    aj.wavelet_variance: ("scale", "scale [s]", "variance", 2, "", "edf"),
    aj.power_spectrum: ("frequency", "frequency [Hz]", "density", 2, "/Hz", ""),
    aj.autocorrelation: ("lag", "lag [s]", "value", 2, "", ""),
}


@pytest.mark.parametrize("of", CURVES)
def test_tables_have_units(of):
    abscissa, label, ordinate, power, per, edf = CURVES[of]
    found = of(aj.Recording(values=disturbed(1000), rate=RATE, axes=AXES))
    table, values = found.to_dataframe(), {"": getattr(found, ordinate)}
    assert_array_equal(values[""], getattr(of(disturbed(1000), RATE), ordinate))
    assert_array_equal(table[label], getattr(found, abscissa))
    if edf:
        values |= zip((" lower_68", " upper_68"), found.confidence_interval(0.68), strict=True)
    if of is aj.power_spectrum:
        assert_array_equal(table["degrees of freedom"], found.dof)
    if of is aj.autocorrelation:
        values[" standard error"] = found.standard_error
    for k, (name, unit, scale) in enumerate((("gyro_x", "deg/h", HOUR), ("accel_x", "µg", MICRO_G))):
        squared = (f"({unit})²" if "/" in unit else f"{unit}²") if power == 2 else unit
        for what, x in values.items():
            assert_allclose(table[f"{name}{what} [{squared}{per}]"], x[:, k] / scale**power, rtol=1e-12)
        if edf:
            assert_array_equal(table[f"{name} degrees of freedom"], found.edf[:, k])


TEN = np.arange(20.0).reshape(10, 2) ** 2
REFUSED = [
    (TEN, {"cluster_times": [0.02, 0.034]}, "0.04 s"), (TEN, {"cluster_times": [0.0]}, "0.02 s"),
    (TEN, {"cluster_times": [0.12]}, "0.1 s"), (TEN, {"cluster_times": []}, "cluster times"),
    (TEN, {"cluster_times": "log"}, "'log'"), (TEN, {"cluster_times": 0}, "not 0"),
    (TEN, {"rate": None}, "rate"), (TEN, {"rate": -1.0}, "rate"),
    (np.where(TEN == 25.0, np.nan, TEN), {}, "sample 2, axis 1"), (np.ones((2, 2, 2)), {}, "shape"),
    (TEN.T, {}, "values.T"),
    ([1.0], {}, "2"), ([1.0, 2.0], {"kind": "hadamard"}, "3"), ([1.0, 2.0], {"data_type": "phase"}, "2"),
    (TEN, {"kind": "total"}, "'total'"), (TEN, {"data_type": "freq"}, "'freq'"),
    (TEN, {"kind": "modified", "overlapping": False}, "overlapping"), (TEN, {"estimator": "fast"}, "'fast'"),
    (TEN, {"estimator": "modified"}, 'kind="modified"'),
    (TEN, {"estimator": "pyramid", "kind": "hadamard"}, 'estimator="exact"'),
    (TEN, {"estimator": "pyramid", "overlapping": False}, 'estimator="exact"'),
    (TEN, {"estimator": "pyramid", "data_type": "phase"}, 'estimator="exact"'),
    (TEN, {"estimator": "pyramid", "cluster_times": 4}, 'estimator="exact"'),
    (np.ones((1, 1)), {"estimator": "pyramid"}, "2"), (aj.Recording(disturbed(16), 1.0, AXES), {}, "rate"),
    (aj.Recording(disturbed(16), 1.0, AXES), {"data_type": "phase"}, "data_type"),
]  # fmt: skip


def test_refused():
    for data, options, word in REFUSED:
        refuses(re.escape(word), aj.allan_deviation, data, **{"rate": RATE, **options})


@pytest.mark.parametrize("estimator", ["exact", "pyramid"])
def test_values_that_are_not_finite_are_named(estimator):
    for n, row, value in ((1000, 0, np.nan), (140_001, 77, np.inf), (140_001, 140_000, -np.inf)):
        x = disturbed(n)
        x[row, 1] = value
        refuses(f"sample {row}, axis 1", aj.allan_deviation, x, RATE, estimator=estimator)


def noise(n: int, axes: int = 2) -> np.ndarray:
    """White noise on one axis, a random walk with a bias on the other."""
    rng = np.random.default_rng(n)
    return np.stack([rng.normal(size=n), 5.0 + rng.normal(size=n).cumsum()], axis=1)[:, 2 - axes :]


def by_definition(x: np.ndarray, start: int = 0) -> tuple[list[int], list[int], np.ndarray]:
    """Sizes, counts and variances: those of 2ᵏ to 2ᵏ⁺¹ samples begin at every multiple of 2ᵏ⁻³ of the stream.

    They are at quarters of octaves.
    """
    # From running sums of 64 binary digits.
    sums = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(x.astype(np.longdouble), axis=0)])
    sizes, counts, variances = [], [], []
    quarters = np.outer(2.0 ** np.arange(len(x).bit_length()), [1.0, 1.25, 1.5, 1.75]).ravel()
    for m in (int(m) for m in quarters if m % 1.0 == 0.0 and 2 * m <= len(x)):
        stride = max(1, 2 ** (m.bit_length() - 4))
        d = (sums[2 * m :] - 2 * sums[m:-m] + sums[: -2 * m])[-start % stride :: stride] / m
        if len(d):
            sizes, counts = [*sizes, m], [*counts, len(d)]
            variances.append((d**2).mean(axis=0) / 2)
    return sizes, counts, np.array(variances, float)


def check_pyramid(found: aj.AllanDeviation, x: np.ndarray, start: int = 0) -> None:
    sizes, counts, variances = by_definition(x, start)
    assert (found.cluster_size.tolist(), found.count.tolist()) == (sizes, counts)
    assert_array_equal(found.cluster_time, np.array(sizes) / SLOW)
    assert_array_equal(found.strides, [max(1, 2 ** int(np.log2(m) - 3)) for m in sizes])
    # Rounding of means, and of walks that reach some hundreds.
    assert_allclose(found.variance, variances, rtol=1e-11)
    assert (found.estimator, found.n, found.kind, found.overlapping) == ("pyramid", len(x), "allan", True)


def stream(x: np.ndarray, start: int = 0) -> aj.AllanAccumulator:
    found = aj.AllanAccumulator(SLOW, ["gyro_x", "accel_z"], start=start)
    found.update(x)
    return found


def test_of_records_and_of_streams_that_begin_later_or_come_in_pieces():
    for n in (2, 3, 16, 17, 1000, 4097, 65_535, 140_000):
        for x in (noise(n, 1), noise(n, 2)):
            check_pyramid(aj.allan_deviation(x, SLOW, estimator="pyramid"), x)
    for n, start in ((2, 1), (3, 5), (17, 15), (40, 3), (1023, 77), (9000, 8191), (135_000, 13)):
        check_pyramid(stream(noise(n), start).result(), noise(n), start)
    # From 131,072 gathered samples on they are processed.
    found, x = aj.AllanAccumulator(SLOW, ["gyro_x", "accel_z"], start=1001), noise(300_000)
    for piece in np.split(x, [7, 100_000, 131_079, 131_080, 290_000]):
        found.update(piece)
    check_pyramid(found.result(), x, 1001)


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
    check_pyramid(pieces[0].result(), x, start)


def test_a_bias_costs_no_digits():
    """9.81 m/s² under noise of 10⁻⁴ m/s², to the digits that the samples still hold."""
    # A block mean is rounded to 10⁻¹⁵ m/s², which is 2·10⁻⁹ of what cluster averages scatter by at m = 2¹⁶.
    x = 9.81 + 1e-4 * np.random.default_rng(1).normal(size=(140_000, 2))
    found = aj.allan_deviation(x, SLOW, estimator="pyramid")
    assert_allclose(found.variance, by_definition(x)[2], rtol=1e-8)


def test_degrees_of_freedom_are_those_of_every_so_manieth_start():
    """(tr C)²/tr C² of white noise, by products of the differences' weights; 1 to 2 % fewer than of all."""
    # The sum over lags is by quadrature, to 10⁻⁶.
    x = noise(1000)
    found = aj.allan_deviation(x, SLOW, estimator="pyramid")
    forms = Variances.of_allan(x[:, 0], SLOW, found.cluster_size, found.strides).forms
    for rows, edf in zip(forms, found.edf, strict=True):
        C = rows @ rows.T
        assert_allclose(edf, np.trace(C) ** 2 / np.sum(C**2), rtol=1e-6)
