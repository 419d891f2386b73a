"""Power spectra against their definition, scipy, simulations with known truth, and Hou (2004) table 3.4."""

import dataclasses
from itertools import pairwise

import numpy as np
import pytest
from scipy import signal, stats

from allanjax.base.errors import AllanjaxError, RecordingError, UnitError
from allanjax.noise.notation import parse_model
from allanjax.noise.simulate import simulate_recording
from allanjax.record.recording import Recording
from allanjax.spectrum.psd import octave_groups, power_spectrum

# Hou (2004), table 3.4: first and last ordinate, ordinates averaged, points that gives.
TABLE_3_4 = [(1, 32, 1, 32)] + [(2**k + 1, 2 ** (k + 1), 2 ** (k - 4), 16) for k in range(5, 15)]


def white(n: int, axes: int = 1, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(n, axes))


def gyro(text: str, n: int, seed: int, axes: str = "xyz") -> Recording:
    model = parse_model(text, "gyro")
    return simulate_recording({f"gyro_{a}": model for a in axes}, n, 100.0, seed)


def test_groups_are_those_of_table_3_4():
    starts = octave_groups(32768)
    count = np.diff(starts, append=32768)
    last = starts + count
    assert TABLE_3_4[1] == (33, 64, 2, 16)
    assert TABLE_3_4[-1] == (16385, 32768, 1024, 16)
    assert len(TABLE_3_4) == 11
    for low, high, averaged, points in TABLE_3_4:
        row = (starts + 1 >= low) & (last <= high)
        assert row.sum() == points
        assert (count[row] == averaged).all()
    assert len(starts) == sum(points for *_, points in TABLE_3_4)


@pytest.mark.parametrize("m", [1, 7, 32, 33, 34, 65, 1000, 4999, 5_000_000])
def test_groups_of_a_broken_octave_hold_every_ordinate_once(m):
    starts = octave_groups(m)
    count = np.diff(starts, append=m)
    assert starts[0] == 0
    assert (count > 0).all()
    assert (starts[:32] == np.arange(min(m, 32))).all()
    width = 2.0 ** np.maximum(np.floor(np.log2(np.maximum(starts, 1))) - 4, 0)
    assert (count[:-1] == width[:-1]).all()
    assert width[-1] / 2 <= count[-1] < 2 * width[-1]


@pytest.mark.parametrize("n", [1001, 1000])
def test_points_are_means_of_the_windowed_periodogram(n):
    x, rate = white(n, 2) + np.arange(n)[:, None] * 0.01, 50.0
    ours = power_spectrum(x, rate)
    w = signal.get_window("hann", n)
    t = np.arange(n)
    level = np.stack([np.polyval(np.polyfit(t, column, 1), t) for column in x.T], axis=1)
    # Eq. (3.39) with the window's power instead of the record's length; one-sided, hence twice.
    j = np.arange(1, (n + 1) // 2)
    X = np.exp(-2j * np.pi * np.outer(j, t) / n) @ (w[:, None] * (x - level))
    S = 2 * abs(X) ** 2 / (rate * np.sum(w**2))
    starts = np.append(octave_groups(len(j)), len(j))
    for i, (a, b) in enumerate(pairwise(starts)):
        np.testing.assert_allclose(ours.density[i], S[a:b].mean(axis=0), rtol=1e-8)
        assert ours.frequency[i] == pytest.approx(j[a:b].mean() * rate / n)
        assert ours.count[i] == b - a


def test_parseval():
    """With an odd number of samples and no window, density times bandwidth adds up to the variance."""
    n, rate = 20_001, 10.0
    x = signal.detrend(white(n, 2).cumsum(axis=0), axis=0)
    ours = power_spectrum(x, rate, window="boxcar")
    np.testing.assert_allclose(ours.count @ ours.density * rate / n, x.var(axis=0), rtol=1e-9)


@pytest.mark.parametrize("length", [256, 501])
def test_welch_is_scipys(length):
    x = white(5000, 2)
    ours = power_spectrum(x, 20.0, method="welch", segment_time=length / 20)
    f, S = signal.welch(x, 20.0, nperseg=length, axis=0)
    inside = slice(1, (length + 1) // 2)
    np.testing.assert_allclose(ours.frequency, f[inside], rtol=1e-12)
    np.testing.assert_allclose(ours.density, S[inside], rtol=1e-9)
    assert "segments" in repr(ours)


def test_degrees_of_freedom_of_hann_windows():
    """Ordinates of a Hann window one and two apart have the squared correlations 4/9 and 1/36."""
    ours = power_spectrum(white(4096), 1.0)
    for k in (1, 2, 3, 1000):
        expected = 2 * k / (1 + 2 * 4 / 9 * (1 - 1 / k) + 2 / 36 * max(1 - 2 / k, 0))
        assert ours.degrees_of_freedom(k) == pytest.approx(expected, rel=1e-6)
    assert power_spectrum(white(4096), 1.0, window="boxcar").degrees_of_freedom(7) == pytest.approx(14)
    # Welch (1967): half-overlapping Hann segments have the squared correlation 1/36.
    welch = power_spectrum(white(4096), 1.0, method="welch", segment_time=512.0)
    assert welch.segments == 15
    assert welch.dof[0] == pytest.approx(30 / (1 + 2 * 14 / 15 / 36), rel=1e-6)


@pytest.mark.parametrize("method", ["logarithmic", "welch"])
def test_scatter_and_coverage_of_white_noise(method):
    """In 1000 records the interval holds the truth as often as it says, to four standard errors.

    Around a mean of two or three correlated ordinates the χ² law is an approximation, hence 2 % more.
    The lowest two ordinates have lost power to the straight line.
    """
    records = 1000
    ours = power_spectrum(white(1024, records), 10.0, method=method).averaged()
    relative = ours.density.var(axis=1) / ours.density.mean(axis=1) ** 2
    np.testing.assert_allclose(relative[2:], 2 / ours.dof[2:], rtol=0.35)
    np.testing.assert_allclose(relative[2:].mean(), (2 / ours.dof[2:]).mean(), rtol=0.05)
    for level in (0.68, 0.95):
        lower, upper = ours.confidence_interval(level)
        covered = ((lower < 0.2) & (upper > 0.2)).mean(axis=1)[2:]
        margin = 4 * stats.binom(records, level).std() / records + 0.02
        np.testing.assert_allclose(covered, level, atol=margin)
        assert covered.mean() == pytest.approx(level, abs=0.01)
    assert (ours.standard_error[:, 0] == ours.density[:, 0] * np.sqrt(2 / ours.dof)).all()


def test_a_strong_random_walk_does_not_leak():
    """Its density is K²/(2 sin(πf/rate))²/rate² everywhere, and the white noise 50 times below it returns.

    As it stands, eq. (3.39) is about twice too high where the random walk dominates.
    """
    n, records, rate = 4001, 400, 1.0
    walk = np.random.default_rng(1).normal(size=(n, records)).cumsum(axis=0)
    x = walk + white(n, records) / np.sqrt(200) + 0.1 * np.arange(n)[:, None]
    ours = power_spectrum(x, rate)
    truth = 2 * (1 / (2 * np.sin(np.pi * ours.frequency)) ** 2 + 1 / 200)
    ratio = ours.density.mean(axis=1) / truth
    error = np.sqrt(2 / ours.dof / records)
    # From 17 ordinates on; below, the window's width and the straight line shift it by some per cent.
    np.testing.assert_allclose(ratio[16:] - 1, 0, atol=4.5 * error.max())
    assert abs(np.average(ratio[32:], weights=ours.dof[32:]) - 1) < 0.004
    raw = power_spectrum(walk, rate, window="boxcar").density.mean(axis=1)
    assert (raw[32:64] / truth[32:64]).mean() > 1.15


@pytest.mark.parametrize("method", ["logarithmic", "welch"])
def test_white_noise_by_eq_3_41(method):
    recording = gyro("N=0.2 deg/√h", 40_000, 4)
    spectrum = power_spectrum(recording, method=method)
    N = parse_model("N=0.2 deg/√h", "gyro").values["angle_random_walk"]
    for name in recording.names:
        walk = spectrum.random_walk(name)
        assert abs(walk.value - N) < 4 * walk.std < 0.1 * N
        # (3.41) in the thesis's units: (1/60)·√(½·PSD), with the mean density of the band.
        low, high = walk.band
        assert high > 2 * low
        inside = (low <= spectrum.frequency) & (spectrum.frequency <= high)
        table = spectrum.to_dataframe()
        density = np.average(table[f"{name} [(deg/h)²/Hz]"][inside], weights=spectrum.count[inside])
        assert walk.in_unit("deg/√h").value == pytest.approx(np.sqrt(density / 2) / 60, rel=1e-12)
        assert walk.interval[0] < walk.interval_68[0] < walk.value < walk.interval_68[1] < walk.interval[1]
    given = spectrum.random_walk("gyro_x", band=(5.0, 20.0))
    assert given.band == (5.0, 20.0)
    assert abs(given.value - N) < 4 * given.std
    assert given.value / given.std == pytest.approx(np.sqrt(2 * given.degrees_of_freedom), rel=0.5)


@pytest.mark.parametrize(("K", "Q"), [(0.0, 0.5), (0.03, 0.0), (0.03, 0.5)])
def test_interval_of_n_covers_though_other_noise_is_in_the_band(K, Q):
    """N of 1 with K and Q beside it, per sample, on 90 axes; four standard errors below 95 % are 86 %."""
    covered, n = [], 30_000
    rng = np.random.default_rng(8)
    for _ in range(30):
        x = rng.normal(size=(n, 3)) + K * rng.normal(size=(n, 3)).cumsum(axis=0)
        x += Q * np.diff(rng.normal(size=(n + 1, 3)), axis=0)
        spectrum = power_spectrum(Recording.from_array(x, 1.0, gyro_unit="rad/s"))
        for name in spectrum.names:
            walk = spectrum.random_walk(name)
            covered.append(walk.interval[0] <= 1.0 <= walk.interval[1])
            assert walk.std < 0.1
    assert np.mean(covered) > 0.86


def test_white_noise_is_flat_down_to_the_lowest_frequency():
    """As a rule: chance bends the spectrum of one axis in three or four.

    Single ordinates have a mean logarithm 0.6 to 1.3 below that of their mean. Taken for less noise, they
    would be in no band.
    """
    axes = [f"gyro_{k}" for k in range(9)]
    recording = Recording.from_array(white(8192, 9), 100.0, gyro_unit="rad/s", names=axes)
    spectrum = power_spectrum(recording)
    lowest = [spectrum.flat_band(axis)[0] for axis in axes]
    assert np.sum(np.array(lowest) < 5.0 * 100.0 / 8192) >= 5


def test_a_line_is_not_taken_for_flat():
    recording = gyro("N=0.2 deg/√h", 60_000, 5, "x")
    t = np.arange(60_000) / 100
    line = 10 * recording.values.std() * np.cos(2 * np.pi * 7.3 * t)[:, None]
    spectrum = power_spectrum(dataclasses.replace(recording, values=recording.values + line))
    walk = spectrum.random_walk("gyro_x")
    assert not walk.band[0] <= 7.3 <= walk.band[1]
    assert walk.in_unit().value == pytest.approx(0.2, abs=4 * walk.in_unit().std)


@pytest.mark.parametrize("text", ["K=100 deg/h/√h", "Q=100 arcsec"])
def test_what_is_nowhere_flat_is_refused(text):
    spectrum = power_spectrum(gyro(text, 20_000, 2, "x"))
    with pytest.raises(AllanjaxError, match=r"gyro_x.*flat.*band=\(low, high\) in Hz"):
        spectrum.random_walk("gyro_x")
    assert spectrum.random_walk("gyro_x", band=(1.0, 2.0)).value > 0


def test_units_of_both_sensors(small_recording):
    spectrum = power_spectrum(small_recording)
    table = spectrum.to_dataframe()
    names = [f"gyro_{a} [(deg/h)²/Hz]" for a in "xyz"]
    assert list(table.columns) == ["frequency [Hz]", "degrees of freedom", *names, "accel_z [µg²/Hz]"]
    np.testing.assert_allclose(table["accel_z [µg²/Hz]"], spectrum.density[:, 3] / 9.80665e-6**2, rtol=1e-12)
    walk = spectrum.random_walk("accel_z")
    assert walk.title == "velocity random walk"
    assert (walk.unit, walk.usual_unit) == ("m/s/√s", "m/s/√h")
    assert walk.in_unit().describe().endswith("m/s/√h")
    assert walk.in_unit("m/s/√h").excess == pytest.approx(60 * walk.excess)
    assert walk.in_unit("m/s/√h").value == pytest.approx(0.05, abs=4 * 60 * walk.std)
    with pytest.raises(UnitError):
        walk.in_unit("deg/√h")
    assert "20000 samples at 100 Hz" in repr(spectrum)


def test_axes_together_and_alone_agree():
    data = white(3001, 2)
    together = power_spectrum(data, 10.0).density
    np.testing.assert_allclose(power_spectrum(data[:, 1], 10.0).density[:, 0], together[:, 1], rtol=1e-12)
    assert list(power_spectrum(data, 10.0).to_dataframe().columns[2:]) == ["0", "1"]


def test_bad_input(small_recording):
    x = white(100)
    with pytest.raises(AllanjaxError, match="give rate in Hz"):
        power_spectrum(x)
    with pytest.raises(AllanjaxError, match="own rate"):
        power_spectrum(small_recording, 100.0)
    for rate in (0.0, -1.0, np.nan):
        with pytest.raises(AllanjaxError, match="positive number of Hz"):
            power_spectrum(x, rate)
    with pytest.raises(AllanjaxError, match="'logarithmic' or 'welch'"):
        power_spectrum(x, 1.0, method="fft")
    with pytest.raises(AllanjaxError, match="unknown window 'hunn'"):
        power_spectrum(x, 1.0, window="hunn")
    with pytest.raises(AllanjaxError, match="segment_time is for method='welch'"):
        power_spectrum(x, 1.0, segment_time=10.0)
    for seconds in (0.0, 101.0, np.nan):
        with pytest.raises(AllanjaxError, match="does not fit"):
            power_spectrum(x, 1.0, method="welch", segment_time=seconds)
    with pytest.raises(RecordingError, match="too short: 15"):
        power_spectrum(x[:15], 1.0)
    with pytest.raises(AllanjaxError, match=r"\[samples, axes\]"):
        power_spectrum(white(100).reshape(10, 5, 2), 1.0)
    x[7] = np.nan
    with pytest.raises(RecordingError, match="row 7"):
        power_spectrum(x, 1.0)
    spectrum = power_spectrum(small_recording)
    with pytest.raises(AllanjaxError, match="between 0 and 1"):
        spectrum.confidence_interval(68)
    with pytest.raises(AllanjaxError, match=r"no axis 'gyro_q'.*gyro_x"):
        spectrum.random_walk("gyro_q")
    with pytest.raises(AllanjaxError, match="holds no frequency"):
        spectrum.random_walk("gyro_x", band=(60.0, 70.0))
    with pytest.raises(AllanjaxError, match=r"Recording\.from_array"):
        power_spectrum(white(100), 1.0).random_walk("0")


@pytest.mark.parametrize("method", ["logarithmic", "welch"])
def test_the_shortest_record(method):
    ours = power_spectrum(white(16), 1.0, method=method)
    assert np.isfinite(ours.density).all()
    assert (ours.dof >= 2).all()
