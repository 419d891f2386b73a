"""Records with missing samples: what is refused, cut out or drawn, against what is known of the whole."""

import bench
import numpy as np
import pandas as pd
import pytest
from imu_columns import noted, refused
from scipy.linalg import block_diag, toeplitz
from scipy.signal import butter, freqz, lfilter

import allanjax as aj

RATE, N = 100.0, 20_000
GYROS = ["gyro_x", "gyro_y", "gyro_z"]


def whole(n=N, seed=1):
    rng = np.random.default_rng(seed)
    x = 1e-2 * rng.standard_normal((n, 3)) + 1e-4 * np.cumsum(rng.standard_normal((n, 3)), axis=0)
    columns = {"time [s]": np.arange(n) / RATE}
    columns |= {f"{name} [rad/s]": x[:, k] * (1 + k) + 0.1 for k, name in enumerate(GYROS)}
    return pd.DataFrame(columns | {"temperature": 25.0 + np.arange(n) / n})


def lost_at(n=N, seed=2):
    """Four per cent of the samples, singly and in bursts; the first and the last are there."""
    rng = np.random.default_rng(seed)
    lost = rng.random(n) < 0.02
    for first in rng.integers(100, n - 200, n // 2000):
        lost[first : first + 40] = True
    lost[:10] = lost[-10:] = False
    return lost


def filled(values, rate=RATE, **options):
    """The recording of an array whose samples are nan where they are missing."""
    options = {"gyro_unit": "rad/s", "names": GYROS[: values.shape[1]], "gaps": "fill"} | options
    return aj.Recording.from_array(values, rate, **options)


@pytest.mark.parametrize("late", [0.0, 0.1])
def test_what_is_there_stays_and_what_is_not_is_counted(written, late):
    table, lost = whole(), lost_at()
    table["time [s]"] += late / RATE * np.random.default_rng(3).uniform(-1.0, 1.0, N)
    recording = aj.read(written(table[~lost]), gaps="fill")
    assert recording.rate == pytest.approx(RATE, rel=1e-5 if late else 1e-9)
    expected = table.iloc[:, 1:4].to_numpy()
    assert np.array_equal(recording.missing, np.tile(lost[:, None], 3))
    assert np.array_equal(recording.values[~lost], expected[~lost])
    assert not np.any(recording.values[lost] == expected[lost])
    # A temperature that rises evenly is what it was.
    np.testing.assert_allclose(recording.auxiliary["temperature"], table["temperature"], atol=1e-9)
    edges = np.flatnonzero(np.diff(lost.astype(int), prepend=0, append=0))
    longest = np.diff(edges)[::2].max() / RATE
    assert [recording.gaps[0], len(recording.gaps)] == [(edges[0], edges[1] - edges[0]), len(edges) // 2]
    assert noted(recording, f"{lost.sum()} of {N}", f"{len(edges) // 2} gaps", f"{longest:.2g} s")
    assert recording == aj.read(written(table[~lost]), gaps="fill")
    part = recording.select("gyro_y").between(2000 / recording.rate, 10_000 / recording.rate)
    assert np.array_equal(part.missing, recording.missing[2000:10_000, 1:2])
    assert recording.between(stop=15.5 / recording.rate).missing is None
    assert np.array_equal(np.isnan(recording.to_dataframe()[table.columns[1:4]]), recording.missing)


def test_empty_cells_are_missing_of_their_axis_alone(written):
    table = whole(3000).drop(columns="time [s]")
    table.iloc[[5, 900, 901], 0] = np.nan
    assert refused(written(table), "and 2 more|--gaps fill", rate=RATE).about == "gaps"
    recording = aj.read(written(table), rate=RATE, gaps="fill")
    assert [np.flatnonzero(lost).tolist() for lost in recording.missing.T] == [[5, 900, 901], [], []]
    assert np.array_equal(filled(table.iloc[:, :3].to_numpy()).values, recording.values)
    assert np.array_equal(recording.values[:, 1], table["gyro_y [rad/s]"])
    # What is no number is not missing.
    broken = table.astype(object)
    broken.iloc[7, 0] = "broken"
    refused(written(broken), "broken", rate=RATE, gaps="fill")
    # At most three tenths are drawn.
    x = np.random.default_rng(1).standard_normal((1000, 1))
    x[100:400] = np.nan
    assert filled(x).missing.sum() == 300
    x[400] = np.nan
    refused(lambda: filled(x), "30 %|--gaps segments")


def test_packets_recorded_twice_are_left_out(written):
    table = whole(3000)
    twice = table.iloc[np.sort(np.concatenate([np.arange(3000), [50, 51, 2000]]))]
    for gaps in (None, "segments", "fill"):
        recording = aj.read(written(twice), gaps=gaps)
        assert noted(recording, "3 packets")
        np.testing.assert_array_equal(recording.values, table.iloc[:, 1:4].to_numpy())
    # Another sample of the same time is none of them.
    twice.iloc[51, 1] += 1.0
    refused(written(twice), "repeats", gaps="fill")


def test_draws_are_the_same_whatever_the_unit_and_the_last_bits():
    table, lost = whole(4096), lost_at(4096)
    x = np.where(lost[:, None], np.nan, table.iloc[:, 1:4].to_numpy())
    drawn = filled(x).values
    for k in range(1, 9):
        np.testing.assert_allclose(filled(x * (1.0 + k * 2.3e-16)).values, drawn, rtol=1e-12)
    np.testing.assert_allclose(filled(np.rad2deg(x), gyro_unit="deg/s").values, drawn, rtol=1e-9)
    moved = x + 0.003 * np.random.default_rng(1).standard_normal(x.shape)
    off = (filled(moved).values - drawn)[lost] / drawn.std(axis=0)
    assert np.corrcoef(off.T)[0, 1] < 0.3
    assert (off.std(axis=0) > 0.5).all()


def test_samples_are_drawn_from_their_conditional_distribution():
    """Of a Gauss–Markov process in white noise, whose dense conditional mean and covariance are exact."""
    # Samples 120 away tell nothing (0.9¹²⁰ = 3e-6), so that each gap has a dense window of its own.
    n, about = 16_384, 120
    gaps = [(200 + 290 * k, length) for k, length in enumerate(7 * [1, 1, 2, 4, 8, 25])] + [(13_000, 300)]
    squares, sums = [], []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        y = lfilter([1.0], [1.0, -0.9], np.sqrt(0.19) * rng.standard_normal(n + 200))[200:]
        y += 0.5 * rng.standard_normal(n)
        for first, length in gaps:
            y[first : first + length] = np.nan
        y = filled(y[:, None]).values[:, 0]
        for first, length in gaps:
            lag = np.arange(length + 2 * about)
            C = toeplitz(0.9**lag + 0.25 * (lag == 0))
            gap = np.isin(lag, about + np.arange(length))
            mean = np.linalg.solve(C[np.ix_(~gap, ~gap)], C[np.ix_(~gap, gap)]).T
            covariance = C[np.ix_(gap, gap)] - mean @ C[np.ix_(~gap, gap)]
            window = y[first - about : first + length + about]
            off = window[gap] - mean @ window[~gap]
            squares.append(off @ np.linalg.solve(covariance, off))
            sums.append(off.sum() / np.sqrt(covariance.sum()))
    # χ² of 2,935 degrees of freedom: the mean scatters by 2.6 %; that the spectrum is estimated adds 2 % (of
    # 200 such records). Hence 1.02 ± 8 %, three standard errors; draws of 0.9 of the variance fail.
    assert sum(squares) / (5 * sum(length for _, length in gaps)) == pytest.approx(1.02, abs=0.08)
    # Sums over gaps, 215 of them: mean 0 ± 0.07, variance 1 ± 0.1; three standard errors.
    assert (np.mean(sums), np.var(sums)) == (pytest.approx(0.0, abs=0.2), pytest.approx(1.0, abs=0.3))


def test_a_completed_record_has_the_spectrum_of_a_whole_one():
    rng, n = np.random.default_rng(5), 60_000
    f = np.arange(1, n // 2 + 1) / n
    b, a = butter(2, 0.5)
    walk = rng.standard_normal(n) + 0.05 * np.cumsum(rng.standard_normal(n))
    low_pass = lfilter(b, a, rng.standard_normal(n + 500))[500:]
    slow, steep = 1.0 + (0.05 / (2.0 * np.sin(np.pi * f))) ** 2, np.abs(freqz(b, a, 2.0 * np.pi * f)[1]) ** 2
    for x, expected in ((walk, slow), (low_pass, steep)):
        y = filled(np.where(lost_at(n), np.nan, x)[:, None]).values[:, 0]
        ratio = np.abs(np.fft.rfft(y - y.mean())[1:]) ** 2 / n / expected
        # Four standard errors of two thousand exponential values, and a twentieth for the averaging.
        close = 4.0 / np.sqrt(2000) + 0.05
        np.testing.assert_allclose(ratio[200:26_200].reshape(-1, 2000).mean(axis=1), 1.0, atol=close)


def test_segments_come_before_filling_in_if_a_gap_is_long(written):
    """Samples lost at random, without and with a pause of 5 % of the record."""
    table = whole()[~(np.random.default_rng(3).random(N) < 0.08)]
    for pause, first in ((0.0, "fill"), (10.0, "segments")):
        later = table.assign(**{"time [s]": table["time [s]"] + pause * (table.index > N // 2)})
        message = str(refused(written(later), "gaps='fill'|gaps='segments'"))
        assert message.index(f"gaps='{first}'") == message.index("gaps='")


def test_a_long_gap_is_filled_with_noise_of_the_right_size_at_all_frequencies():
    """White noise: the mean of a gap scatters by less than twice that of as many samples; the rms is right.

    48 means determine their scatter to 10 %, and 48 gaps the noise to 0.3 %.
    """
    n, means, rms = 10_000, [], []
    lost = slice(n // 3, n // 3 + int(0.3 * n))
    for seed in range(16):
        x = np.random.default_rng(seed).standard_normal((n, 3))
        there = np.delete(x, lost, axis=0)
        x[lost] = np.nan
        drawn = filled(x).values[lost]
        means.append(drawn.mean(axis=0) * np.sqrt(len(drawn)))
        rms.append(drawn.std(axis=0) / there.std(axis=0))
    # The mean of the gap is that of its own samples and, in part, of those that determine it.
    assert np.std(means) < 2.0
    assert np.mean(rms) == pytest.approx(1.0, abs=0.025)


def test_a_line_goes_on_through_gaps():
    """Ten times the noise, through gaps of 18 periods; what is drawn beside it is noise of its own level."""
    n, rng = 16_384, np.random.default_rng(9)
    line = 10.0 * np.sin(2.0 * np.pi * 0.3 * np.arange(n) + 1.0)
    lost = np.arange(n) % 600 >= 540
    y = filled(np.where(lost, np.nan, line + rng.standard_normal(n))[:, None]).values[:, 0]
    # 1,620 samples: 1.75 %; and what the line's own error adds.
    assert np.std((y - line)[lost]) == pytest.approx(1.05, abs=0.1)


def test_intervals_and_degrees_of_freedom_allow_for_what_is_missing():
    """With a share f missing, n(1 − f) determine a level, and f·n draws add their scatter."""
    x = whole(2048).iloc[:, 1:4].to_numpy(copy=True)
    x[::4, 1] = np.nan
    recording = filled(x)
    bare = filled(recording.values)
    factor = np.array([1.0, np.sqrt(1.0 / 0.75 + 0.25), 1.0])
    for estimator in ("exact", "pyramid"):
        one, other = (aj.allan_deviation(r, estimator=estimator) for r in (recording, bare))
        np.testing.assert_array_equal(one.deviation, other.deviation)
        np.testing.assert_allclose(one.edf * factor**2, other.edf, rtol=1e-12)
    assert noted(recording, "26 %")
    lines = bench.once("check lossy", lambda: aj.check(bench.recording("lossy")))
    assert lines["gaps"].verdict == "look"


def test_whatever_is_given_is_filled_as_a_file_is(written):
    table = whole(2048).drop(columns=["time [s]", "temperature"])
    table.iloc[1000, 1] = np.nan
    path = written(table)
    curve = aj.fit(aj.read(path, rate=RATE, gaps="fill"), "N + K", plain=True).curve
    for given, more in ((table, {}), (table.to_numpy(), {"names": GYROS, "gyro_unit": "rad/s"}), (path, {})):
        found = aj.fit(given, "N + K", rate=RATE, gaps="fill", plain=True, **more)
        np.testing.assert_array_equal(found.curve.deviation, curve.deviation)
    for command in (aj.fit, aj.check, aj.critique):
        refused(command, "gaps=", recording=table, rate=RATE, gaps="drop")
    refused(lambda: aj.fit(table, "N", rate=RATE), "has nan")


def in_stretches(x, lengths):
    parts = np.split(x[: sum(lengths)], np.cumsum(lengths)[:-1])
    gap = np.full((1, x.shape[1]), np.nan)
    return np.concatenate([y for part in parts for y in (part, gap)][:-1])


def test_segments_takes_the_longest_stretch_and_keeps_others(written):
    table = whole(3000)
    table.iloc[2200, 2] = np.nan
    lost = np.isin(np.arange(3000), [700, 701, 2900])
    recording = aj.read(written(table[~lost]), gaps="segments")
    np.testing.assert_array_equal(recording.values, table.iloc[702:2200, 1:4].to_numpy())
    np.testing.assert_array_equal(recording.auxiliary["temperature"], table["temperature"][702:2200])
    assert recording.missing is None
    for found, rows in zip(recording.others, (slice(700), slice(2201, 2900), slice(2901, None)), strict=True):
        np.testing.assert_array_equal(found, table.iloc[rows, 1:4].to_numpy())
    assert recording.gaps == ((-2, 2), (1498, 1), (2198, 1))
    assert noted(recording, "longest of 4")
    np.testing.assert_array_equal(recording["gyro_z"].others[1][:, 0], table.iloc[2201:2900, 3])
    assert recording.between(1.0, 5.0).others == ()
    # Segments in the part are kept, each cut at the ends of the part, with their places and gaps.
    rate = recording.rate
    part = recording.between(-100 / rate, 1700 / rate)
    np.testing.assert_array_equal(part.values, recording.values)
    for found, rows in zip(part.others, (slice(602, 700), slice(2201, 2402)), strict=True):
        np.testing.assert_array_equal(found, table.iloc[rows, 1:4].to_numpy())
    later = recording.between(start=500 / rate)
    assert (later.n, *map(len, later.others)) == (998, 699, 99)
    assert (later.places, later.gaps) == ((999, 1699), ((998, 1), (1698, 1)))
    # Those of fewer than 64 samples are not kept, and no more than fifteen, the longest.
    x = np.random.default_rng(1).standard_normal((3000, 1))
    cut = filled(in_stretches(x, [63, 400, *range(64, 82)]), gaps="segments")
    assert cut.n == 400
    assert sorted(map(len, cut.others)) == [*range(67, 82)]
    assert noted(cut, "64 to 463", "longest of 20")
    # Nor are those whose stamps give a rate that is a hundredth off that of the longest.
    for off, kept in ((1.009, [200, 300]), (1.011, [300])):
        intervals = np.repeat([0.01, 0.01, 0.01 * off], (700, 300, 200))
        times = np.cumsum(intervals) + np.repeat([0.0, 0.5, 1.0], (700, 300, 200))
        table = pd.DataFrame({"time [s]": times, "gx [rad/s]": x[:1200, 0]})
        recording = aj.read(written(table), gaps="segments")
        assert recording.n == 700
        assert sorted(map(len, recording.others)) == kept


KINDS = [{}, {"overlapping": False}, {"kind": "modified"}, {"kind": "hadamard", "overlapping": False}]
KINDS += [{"estimator": "pyramid"}, {"cluster_times": [0.03, 0.5, 1.15]}]


@pytest.mark.parametrize("options", KINDS)
def test_differences_whose_clusters_are_complete_are_averaged(options):
    """By brute force: every difference of the phase within a stretch, of all stretches together."""
    # Degrees of freedom for white noise are (tr A)²/tr A² of the quadratic form x'Ax that the estimate is.
    x = np.random.default_rng(31).standard_normal((638, 2)) + 0.2
    recording = filled(in_stretches(x, (110, 230, 64, 63, 171)), gaps="segments")
    found = aj.allan_deviation(recording, **options)
    weights = [-1, 3, -3, 1] if options.get("kind") == "hadamard" else [1, -2, 1]
    scale = 6.0 if len(weights) == 4 else 2.0
    for k, m in enumerate(found.cluster_size):
        rows = [differences(len(z), m, weights, options) for z in (recording.values, *recording.others)]
        D = block_diag(*rows)
        squares = (D @ np.concatenate([recording.values, *recording.others])) ** 2
        assert found.count[k] == len(D)
        np.testing.assert_allclose(found.variance[k], squares.mean(axis=0) / (scale * m**2), rtol=1e-9)
        A = D @ D.T
        # Of the pyramid's every eighth difference the package interpolates.
        close = 0.1 if "estimator" in options else 0.05
        np.testing.assert_allclose(found.edf[k], np.trace(A) ** 2 / np.sum(A**2), rtol=close)
    assert sorted(found.others) == [64, 110, 171]


def differences(n, m, weights, options):
    """Matrix of the differences that n samples have at the cluster size m."""
    phase = np.vstack([np.zeros(n), np.tril(np.ones((n, n)))])
    count = max(n + 1 - (len(weights) - 1) * m, 0)
    d = sum(w * phase[p * m : p * m + count] for p, w in enumerate(weights))
    if options.get("kind") == "modified":
        d = np.array([d[i : i + m].mean(axis=0) for i in range(count + 1 - m)]).reshape(-1, n)
    step = 1 if options.get("overlapping", True) else m
    # A pyramid takes every 2ᵏ⁻³-th of the clusters of 2ᵏ to 2ᵏ⁺¹ samples.
    return d[:: max(2 ** (int(m).bit_length() - 4), 1) if "estimator" in options else step]
