"""Allan deviation against allantools, published values, and the defining equations written out."""

import os

import allantools
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilations import compilations
from places import DATA
from scipy import stats

from allanjax.allan.deviation import AllanDeviation, allan_deviation, allan_variance_estimates, cluster_sizes
from allanjax.base.errors import AllanjaxError
from allanjax.record.recording import Axis, Recording

RECORDING = DATA / "adis16405_unit1.parquet"

ESTIMATORS = {
    "adev": ("allan", False),
    "oadev": ("allan", True),
    "mdev": ("modified", True),
    "hdev": ("hadamard", False),
    "ohdev": ("hadamard", True),
}
each_estimator = pytest.mark.parametrize("name", ESTIMATORS)


N = 20011
SPACING = 3


def estimate(name: str, data, rate: float = 1.0, *, cluster_times=SPACING, **options) -> AllanDeviation:
    kind, overlapping = ESTIMATORS[name]
    return allan_deviation(
        data, rate, kind=kind, overlapping=overlapping, cluster_times=cluster_times, **options
    )


def white_and_walk(n: int = N) -> np.ndarray:
    rng = np.random.default_rng(n)
    return np.stack([3.0 + rng.normal(size=n), rng.normal(size=n).cumsum()], axis=1)


def assert_agrees_with_allantools(name: str, ours: AllanDeviation, data: np.ndarray, data_type: str) -> None:
    peer = {"rate": "freq", "phase": "phase"}[data_type]
    several = ours.count > 1  # allantools leaves out cluster times with a single difference
    for axis in range(data.shape[1]):
        times, deviation, _, count = getattr(allantools, name)(
            data[:, axis], ours.rate, data_type=peer, taus=ours.cluster_time
        )
        np.testing.assert_allclose(ours.cluster_time[several], times, rtol=1e-14)
        np.testing.assert_array_equal(ours.count[several], count)
        np.testing.assert_allclose(ours.deviation[several, axis], deviation, rtol=1e-9)


@each_estimator
@pytest.mark.parametrize(
    ("data_type", "n", "spacing"),
    [
        ("rate", 23, "all"),
        ("rate", 8192, "octave"),
        ("rate", N, SPACING),
        ("phase", N, SPACING),
    ],
)
def test_agrees_with_allantools(name, data_type, n, spacing):
    data = white_and_walk(n)
    ours = estimate(name, data, 50.0, data_type=data_type, cluster_times=spacing)
    assert_agrees_with_allantools(name, ours, data, data_type)


@pytest.mark.skipif(not RECORDING.exists(), reason="the ADIS16405 recording is not shipped with the package")
@each_estimator
def test_agrees_with_allantools_on_a_million_real_samples(name):
    import pandas as pd

    data = pd.read_parquet(RECORDING, columns=["gyro_z", "accel_z"]).to_numpy()
    sizes = [1, 2, 7, 100, 4096, 50_001, 333_000]
    ours = estimate(name, data, 100.0, cluster_times=[m / 100 for m in sizes])
    np.testing.assert_array_equal(ours.cluster_size, sizes)
    assert_agrees_with_allantools(name, ours, data, "rate")


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("adev", ["0.2922319", "0.09965736", "0.03897804"]),
        ("oadev", ["0.2922319", "0.09159953", "0.03241343"]),
        ("mdev", ["0.2922319", "0.06172376", "0.02170921"]),
        # The table ends in 0; integer arithmetic on these numbers gives 0.0391086056.
        ("hdev", ["0.2943883", "0.1052754", "0.03910861"]),
        ("ohdev", ["0.2943883", "0.09581083", "0.03237638"]),
    ],
)
def test_nist_sp1065_thousand_point_suite(name, expected):
    numbers = [1234567890]
    while len(numbers) < 1000:
        numbers.append(16807 * numbers[-1] % 2147483647)
    ours = estimate(name, np.array(numbers) / 2147483647, cluster_times=[1, 10, 100])
    printed = [np.format_float_positional(d, 7, fractional=False) for d in ours.deviation[:, 0]]
    assert printed == [digits.rstrip("0") for digits in expected]


def by_definition(rates: np.ndarray, m: int, name: str) -> tuple[float, int]:
    """Eq. (4.5) of Hou (2004) and its relatives, start by start; the number of differences too."""
    n = len(rates)
    average = lambda k: sum(rates[k : k + m]) / m  # noqa: E731  eq. (4.1)
    first = lambda k: average(k + m) - average(k)  # noqa: E731  eq. (4.3)
    second = lambda k: first(k + m) - first(k)  # noqa: E731
    match name:
        case "adev" | "oadev":
            terms = [first(k) ** 2 / 2 for k in range(0, n - 2 * m + 1, m if name == "adev" else 1)]
        case "hdev" | "ohdev":
            terms = [second(k) ** 2 / 6 for k in range(0, n - 3 * m + 1, m if name == "hdev" else 1)]
        case "mdev":
            terms = [sum(first(k + i) for i in range(m)) ** 2 / (2 * m**2) for k in range(n - 3 * m + 2)]
    return sum(terms) / len(terms), len(terms)


@each_estimator
@pytest.mark.parametrize("n", [4, 23])
def test_equals_the_definition_at_every_cluster_size(name, n):
    rates = white_and_walk(n)
    ours = estimate(name, rates, 10.0, cluster_times="all")
    for axis in range(2):
        expected = [by_definition(rates[:, axis], m, name) for m in ours.cluster_size]
        np.testing.assert_allclose(ours.variance[:, axis], [v for v, _ in expected], rtol=1e-11)
        np.testing.assert_array_equal(ours.count, [c for _, c in expected])
    # One size more and there is no difference left.
    with pytest.raises(ZeroDivisionError):
        by_definition(rates[:, 0], ours.cluster_size[-1] + 1, name)


def with_long_doubles(x: np.ndarray, sizes: np.ndarray, name: str) -> np.ndarray:
    """Variances [m, axes] from phases of 64 binary digits, by slices of the whole record."""
    kind, overlapping = ESTIMATORS[name]
    x = x.astype(np.longdouble)
    phase = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(x - x.mean(axis=0), axis=0)])
    found = []
    for m in sizes:
        d = phase[2 * m :] - 2 * phase[m:-m] + phase[: -2 * m]
        if kind == "modified":
            sums = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(d, axis=0)])
            d = (sums[m:] - sums[:-m]) / m
        elif kind == "hadamard":
            d = d[m:] - d[:-m]
        d = d if overlapping else d[::m]
        found.append((d**2).mean(axis=0) / ({"hadamard": 6}.get(kind, 2) * float(m) ** 2))
    return np.array(found, dtype=float)


def disturbed(n: int, axes: int) -> np.ndarray:
    """White noise on a large bias, a random walk, and a bright start, over and over."""
    rng = np.random.default_rng(n)
    x = rng.normal(size=(n, axes))
    x[:, 0::3] += 1e6
    x[:, 1::3] = x[:, 1::3].cumsum(axis=0)
    x[:, 2::3] += 1e4 * np.exp(-np.arange(n)[:, None] / 500)
    return x


@each_estimator
@pytest.mark.parametrize(("n", "axes"), [(131_071, 1), (131_072, 2), (131_073, 1), (270_337, 3)])
def test_long_records_are_shared_out_among_the_cores(name, n, axes, monkeypatch):
    """From 131,072 samples on; here pieces of 4096 values by three cores, with borders of all kinds.

    Largest errors 10⁻¹⁰ of overlapping variances, of the walk; 2·10⁻⁹ of the modified one, as before.
    """
    monkeypatch.setattr(os, "cpu_count", lambda: 3)
    monkeypatch.setattr("allanjax.allan.estimators._PIECE", 4096)
    kind, overlapping = ESTIMATORS[name]
    x, sizes = disturbed(n, axes), np.array([1, 2, 7, 1000, 4096, 40_000])
    found = allan_variance_estimates(x, sizes, kind=kind, overlapping=overlapping)
    rtol = 1e-8 if kind == "modified" else 1e-9
    np.testing.assert_allclose(found, with_long_doubles(x, sizes, name), rtol=rtol)


@pytest.mark.parametrize(
    "changed",
    [np.asfortranarray, lambda x: x[:, ::-1], lambda x: x.astype(">f8"), lambda x: np.repeat(x, 2, 0)[::2]],
)
def test_long_records_may_lie_in_memory_as_they_like(changed):
    x = changed(white_and_walk(140_001))
    plain = np.array(x, dtype=float, order="C")
    sizes = np.array([1, 30, 2048])
    np.testing.assert_array_equal(allan_variance_estimates(x, sizes), allan_variance_estimates(plain, sizes))
    np.testing.assert_array_equal(x, plain)


def test_long_phases():
    x = white_and_walk(150_000)
    phases = np.concatenate([np.zeros((1, 2)), x.cumsum(axis=0) / 4.0])
    sizes = np.array([1, 64, 5000, 50_000])
    found = allan_variance_estimates(phases, sizes, 4.0, data_type="phase")
    np.testing.assert_allclose(found, with_long_doubles(x, sizes, "oadev"), rtol=1e-8)


@pytest.mark.parametrize("row", [0, 77, 139_999])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_long_records_with_what_is_not_finite(row, value):
    x = white_and_walk(140_000)
    x[row, 1] = value
    with pytest.raises(AllanjaxError, match=f"1 values are not finite, the first at sample {row}, axis 1"):
        allan_deviation(x, 1.0)


def test_lengths_of_an_octave_share_their_programs():
    """Long records, too: no length of its own is in a program."""
    for n in (263_000, 400_001, 524_287):
        with compilations() as names:
            allan_deviation(np.ones((n, 2)) + np.arange(n)[:, None] % 7, 1.0)
        if n > 263_000:
            assert names == []


def test_equals_eq_4_9_on_phases():
    rate, m = 4.0, 3
    theta = np.random.default_rng(0).normal(size=40).cumsum()
    T, count = m / rate, len(theta) - 2 * m
    squares = [(theta[k + 2 * m] - 2 * theta[k + m] + theta[k]) ** 2 for k in range(count)]
    expected = sum(squares) / (2 * T**2 * count)
    ours = allan_deviation(theta, rate, data_type="phase", cluster_times=[T])
    np.testing.assert_allclose(ours.variance, [[expected]], rtol=1e-12)


@each_estimator
def test_rates_and_their_phases_agree(name):
    rates, rate = white_and_walk(), 200.0
    phases = np.concatenate([np.zeros((1, 2)), rates.cumsum(axis=0) / rate])
    from_rates = estimate(name, rates, rate)
    from_phases = estimate(name, phases, rate, data_type="phase")
    assert from_phases.n == from_rates.n == N
    np.testing.assert_allclose(from_phases.deviation, from_rates.deviation, rtol=1e-9)


@each_estimator
def test_blind_to_a_bias_and_hadamard_to_a_ramp(name):
    rates = white_and_walk()
    drift = 1e6 + (np.arange(N) * 0.01 if name in ("hdev", "ohdev") else 0)
    drifting = estimate(name, rates + np.expand_dims(drift, -1))
    # The added bias has itself rounded the samples to 1e-10.
    np.testing.assert_allclose(drifting.deviation, estimate(name, rates).deviation, rtol=1e-9, atol=1e-11)


def test_allan_deviation_of_a_ramp_is_eq_4_56():
    R, rate = 0.3, 25.0
    ours = allan_deviation(R * np.arange(3001) / rate, rate)
    np.testing.assert_allclose(ours.deviation[:, 0], R * ours.cluster_time / np.sqrt(2), rtol=1e-9)


@each_estimator
def test_several_axes_equal_one_at_a_time(name):
    data = white_and_walk()
    together = estimate(name, data).deviation
    for axis in range(2):
        alone = estimate(name, data[:, axis]).deviation[:, 0]
        np.testing.assert_allclose(alone, together[:, axis], rtol=1e-10)


@each_estimator
def test_a_bright_start_does_not_cost_digits(name):
    """A warm-up transient makes the phases large; the quiet remainder must keep its digits."""
    data = white_and_walk() + 1e4 * np.exp(-np.arange(N)[:, None] / 50)
    ours = estimate(name, data)
    for m in (1, 16):
        exact = [by_integers(data[:, axis], m, name) for axis in range(2)]
        np.testing.assert_allclose(ours.variance[ours.cluster_size == m][0], exact, rtol=1e-9)


def by_integers(rates: np.ndarray, m: int, name: str) -> float:
    """The variance by integer arithmetic on rates in units of 2^-60, where nothing is rounded."""
    kind, overlapping = ESTIMATORS[name]
    x = np.concatenate([[0], np.cumsum(np.array([int(r * 2.0**60) for r in rates], dtype=object))])
    step = 1 if overlapping else m
    d = x[2 * m :] - 2 * x[m:-m] + x[: -2 * m]
    if kind == "modified":
        sums = np.concatenate([[0], np.cumsum(d)])
        d = sums[m:] - sums[:-m]
    elif kind == "hadamard":
        d = d[m:] - d[:-m]
    d = d[::step]
    scale = {"allan": 2, "modified": 2 * m**2, "hadamard": 6}[kind] * m**2
    return float((d**2).sum() // (len(d) * scale)) / 2.0**120


@each_estimator
@pytest.mark.parametrize("data_type", ["rate", "phase"])
def test_arrays_of_jax_and_of_numpy_agree(name, data_type):
    """The one is computed by a compiled program, the other by NumPy, in chunks."""
    kind, overlapping = ESTIMATORS[name]
    values = white_and_walk(20_000)
    sizes = cluster_sizes(len(values) - 1, 1.0, kind=kind)
    options = {"kind": kind, "overlapping": overlapping, "data_type": data_type}
    ours = allan_variance_estimates(values, sizes, 4.0, **options)
    assert isinstance(ours, np.ndarray)
    compiled = allan_variance_estimates(jnp.asarray(values), sizes, 4.0, **options)
    np.testing.assert_allclose(compiled, ours, rtol=1e-9)


@pytest.mark.parametrize("name", ["oadev", "mdev", "hdev"])
def test_forward_derivative_of_a_quadratic_form(name):
    kind, overlapping = ESTIMATORS[name]
    rng = np.random.default_rng(1)
    values, tangent = rng.normal(size=(2, 401, 2))
    sizes = cluster_sizes(401, 1.0, kind=kind)

    def variances(v):
        return allan_variance_estimates(v, sizes, kind=kind, overlapping=overlapping)

    _, derivative = jax.jvp(variances, (values,), (tangent,))
    # The variance is quadratic in the values, so that the central difference is exact.
    expected = (variances(values + tangent) - variances(values - tangent)) / 2
    np.testing.assert_allclose(derivative, expected, rtol=1e-9, atol=1e-12)


def test_cluster_sizes():
    assert cluster_sizes(100, 1.0).tolist() == [1, 2, 4, 8, 16, 32]
    assert cluster_sizes(100, 1.0, "decade").tolist() == [1, 2, 4, 10, 20, 40]
    assert cluster_sizes(100, 1.0, 2).tolist() == [1, 2, 3, 4, 6, 8, 11, 16, 23, 32, 45]
    assert cluster_sizes(64, 1.0, "octave").tolist() == [1, 2, 4, 8, 16, 32]
    assert cluster_sizes(9, 1.0, "all", "hadamard").tolist() == [1, 2, 3]
    assert cluster_sizes(8, 1.0, "all", "modified").tolist() == [1, 2, 3]
    assert cluster_sizes(100, 30.0, [0.1, 1 / 30, 0.1]).tolist() == [1, 3]


@pytest.mark.parametrize(
    ("spacing", "message"),
    [
        ([0.02, 0.034], r"0\.034 s is not a multiple .* 0\.02 s: the nearest is 0\.04 s"),
        ([0.0], r"cluster time 0 s is not a multiple .* nearest is 0\.02 s"),
        ([1.02], r"1\.02 s is too long: the longest the recording allows is 1 s"),
        ([], "non-empty"),
        ("log", "unknown spacing 'log'"),
        (0, "at least 1"),
    ],
)
@pytest.mark.usefixtures("unchecked_shapes")
def test_refuses_cluster_times(spacing, message):
    with pytest.raises(AllanjaxError, match=message):
        cluster_sizes(100, 50.0, spacing)


@pytest.mark.parametrize(
    ("data", "options", "message"),
    [
        (np.ones(10), {"rate": None}, "rate in Hz"),
        (np.ones(10), {"rate": -1.0}, "positive number of Hz"),
        ([1.0, 2.0, np.nan, np.inf], {}, "2 values are not finite, the first at sample 2, axis 0"),
        (np.ones((2, 2, 2)), {}, "shape"),
        ([1.0], {}, "1 samples are too few for the allan variance: it needs at least 2"),
        ([1.0, 2.0], {"kind": "hadamard"}, "at least 3"),
        ([1.0, 2.0], {"data_type": "phase"}, "1 samples are too few"),
        (np.ones(10), {"kind": "total"}, "unknown kind 'total'"),
        (np.ones(10), {"data_type": "freq"}, "unknown data_type 'freq'"),
        (np.ones(10), {"kind": "modified", "overlapping": False}, "overlapping clusters only"),
    ],
)
def test_refuses_data_and_options(data, options, message):
    with pytest.raises(AllanjaxError, match=message):
        allan_deviation(data, **{"rate": 1.0, **options})


def test_a_recording_brings_its_rate_and_axes():
    axes = (Axis("gyro_x", "gyro", "rad/s"), Axis("accel_x", "accel", "m/s²"))
    recording = Recording(values=white_and_walk(500), rate=20.0, axes=axes)
    ours = allan_deviation(recording)
    assert ours.axes == axes
    assert ours.rate == 20.0
    np.testing.assert_array_equal(ours.deviation, allan_deviation(recording.values, 20.0).deviation)
    assert "gyro_x, accel_x; 500 samples at 20 Hz; 8 cluster times from 0.05 s to 6.4 s" in repr(ours)
    with pytest.raises(AllanjaxError, match="own rate"):
        allan_deviation(recording, 20.0)


def result_with(edf: float) -> AllanDeviation:
    return AllanDeviation(
        cluster_time=np.array([50.0]),
        cluster_size=np.array([5000]),
        deviation=np.array([[2.0]]),
        count=np.array([10001]),
        edf=np.array([[edf]]),
        n=20_000,
        rate=100.0,
    )


def test_errors_of_the_estimate():
    assert result_with(8.0).standard_error == pytest.approx(0.5)
    # Hou (2004) on eq. (4.66): 20,000 points in clusters of 5,000 are good to "approximately 40 %".
    assert result_with(8.0).thesis_relative_error == pytest.approx(0.408, abs=5e-4)


def test_confidence_interval_is_that_of_the_chi_squared_law():
    """SP 1065's rule: the true variance lies between s²·edf/χ²(0.975) and s²·edf/χ²(0.025)."""
    lower, upper = result_with(10.0).confidence_interval(0.95)
    assert lower == pytest.approx(2 * np.sqrt(10 / 20.483), rel=1e-4)
    assert upper == pytest.approx(2 * np.sqrt(10 / 3.247), rel=1e-4)
    with pytest.raises(AllanjaxError, match="between 0 and 1"):
        result_with(10.0).confidence_interval(95)


def test_edf_covers_white_noise():
    """In 4000 simulated records of 256 samples, the interval holds the truth 95 % of the time.

    At 64 samples a cluster the χ² law, only approximate there, gives 97 %.
    """
    data = np.random.default_rng(2).normal(size=(256, 4000))
    ours = allan_deviation(data, 1.0, cluster_times=[1, 2, 4, 8, 16, 32])
    assert ours.edf.shape == ours.deviation.shape
    lower, upper = ours.confidence_interval(0.95)
    truth = 1 / np.sqrt(ours.cluster_time)[:, None]
    covered = ((lower < truth) & (truth < upper)).mean(axis=1)
    margin = 4 * stats.binom(4000, 0.95).std() / 4000
    np.testing.assert_allclose(covered, 0.95, atol=margin)
