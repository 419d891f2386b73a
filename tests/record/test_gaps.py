"""Records with missing samples: what is refused, taken or drawn, against records of which nothing is lost."""

import numpy as np
import pandas as pd
import pytest
from scipy.linalg import cho_factor, cho_solve, toeplitz
from scipy.signal import butter, freqz, lfilter

import allanjax as aj
from allanjax.base.errors import AllanjaxError, RecordingError
from allanjax.record.completion import completed, in_time, predicted, widening
from allanjax.record.io.given import as_recording

RATE, N = 100.0, 20_000


def whole(n=N, seed=1):
    """White noise and a random walk on three gyros, with a temperature."""
    rng = np.random.default_rng(seed)
    x = 1e-2 * rng.standard_normal((n, 3)) + 1e-4 * np.cumsum(rng.standard_normal((n, 3)), axis=0)
    columns = {"time [s]": np.arange(n) / RATE}
    columns |= {f"gyro_{axis} [rad/s]": x[:, k] for k, axis in enumerate("xyz")}
    return pd.DataFrame(columns | {"temperature": 25.0 + np.arange(n) / n})


def lost_at(n=N, seed=2):
    """Four per cent of the samples, singly and in bursts; the first and the last are there."""
    rng = np.random.default_rng(seed)
    lost = rng.random(n) < 0.02
    for first in rng.integers(100, n - 200, n // 2000):
        lost[first : first + 40] = True
    lost[:10] = lost[-10:] = False
    return lost


@pytest.fixture
def written(tmp_path):
    def write(table):
        path = tmp_path / "log.csv"
        table.to_csv(path, index=False)
        return path

    return write


def test_what_is_there_stays_and_what_is_not_is_counted(written):
    table, lost = whole(), lost_at()
    recording = aj.read(written(table[~lost]), gaps="fill")
    assert recording.n == N
    assert recording.rate == pytest.approx(RATE, rel=1e-9)
    expected = table.iloc[:, 1:4].to_numpy()
    assert np.array_equal(recording.missing, np.tile(lost[:, None], 3))
    assert np.array_equal(recording.values[~lost], expected[~lost])
    assert not np.any(recording.values[lost] == expected[lost])
    # A temperature that rises evenly is what it was.
    np.testing.assert_allclose(recording.auxiliary["temperature"], table["temperature"], atol=1e-9)
    edges = np.flatnonzero(np.diff(lost.astype(int), prepend=0, append=0))
    (note,) = (note for note in recording.notes if "are missing" in note)
    assert f"{lost.sum()} of {N} samples" in note
    assert f"in {len(edges) // 2} gaps of at most {np.diff(edges)[::2].max() / RATE:.2g} s" in note
    # The same file is read in the same way.
    assert recording == aj.read(written(table[~lost]), gaps="fill")


def test_the_message_says_what_each_choice_would_do(written):
    lost = lost_at()
    with pytest.raises(RecordingError, match=r"--gaps segments.*let the \d+ missing") as raised:
        aj.read(written(whole()[~lost]))
    assert f"let the {lost.sum()} missing samples be drawn given the {N - lost.sum()} others" in str(
        raised.value
    )
    with pytest.raises(RecordingError, match="must be error, segments or fill"):
        aj.read(written(whole()), gaps="interpolate")
    with pytest.raises(RecordingError, match="whole record"):
        aj.read_chunks(written(whole()), gaps="fill")


def test_segments_takes_the_longest_stretch_without_gaps(written):
    table = whole(3000)
    table.iloc[2200, 2] = np.nan
    lost = np.isin(np.arange(3000), [700, 701, 2900])
    recording = aj.read(written(table[~lost]), gaps="segments")
    np.testing.assert_array_equal(recording.values, table.iloc[702:2200, 1:4].to_numpy())
    np.testing.assert_array_equal(recording.auxiliary["temperature"], table["temperature"][702:2200])
    assert recording.missing is None
    assert any("the longest of 4 stretches without gaps" in note for note in recording.notes)


def test_empty_cells_are_missing_of_their_axis_alone(written):
    table = whole(3000)
    table.iloc[[5, 900, 901], 1] = np.nan
    del table["time [s]"]
    with pytest.raises(RecordingError, match=r"3 values are not finite.*segments.*drawn.*fill") as raised:
        aj.read(written(table), rate=RATE)
    assert raised.value.about == "gaps"
    recording = aj.read(written(table), rate=RATE, gaps="fill")
    assert np.flatnonzero(recording.missing[:, 0]).tolist() == [5, 900, 901]
    assert not recording.missing[:, 1:].any()
    values = table.iloc[:, :3].to_numpy()
    again = aj.Recording.from_array(
        values, RATE, gyro_unit="rad/s", names=["gyro_x", "gyro_y", "gyro_z"], gaps="fill"
    )
    assert np.array_equal(again.values, recording.values)
    assert np.isfinite(again.values).all()
    assert aj.Recording.from_array(values, RATE, gyro_unit="rad/s", gaps="fill")["gyro_y"].missing.sum() == 0
    with pytest.raises(AllanjaxError, match="finite"):
        aj.Recording.from_array(values, RATE, gyro_unit="rad/s")
    # What is no number is not missing.
    table["gyro_x [rad/s]"] = table["gyro_x [rad/s]"].astype(object)
    table.iloc[7, 0] = "broken"
    with pytest.raises(RecordingError, match="broken"):
        aj.read(written(table), rate=RATE, gaps="fill")


def test_parts_and_data_frames_know_what_is_missing(written):
    recording = aj.read(written(whole()[~lost_at()]), gaps="fill")
    part = recording.select("gyro_y").between(20.0, 100.0)
    assert np.array_equal(part.missing, recording.missing[2000:10_000, 1:2])
    frame = recording.to_dataframe(si=True)
    assert aj.Recording.from_dataframe(frame) == recording
    cut = aj.Recording.from_dataframe(frame.iloc[777:])
    assert np.array_equal(cut.missing, recording.missing[777:])


def test_too_much_is_not_drawn(written):
    table = whole(3000)
    with pytest.raises(RecordingError, match="33% of the samples are missing, and at most 30%"):
        aj.read(written(table[(np.arange(3000) < 1000) | (np.arange(3000) >= 2000)]), gaps="fill")


def test_packets_recorded_twice_are_left_out(written):
    table = whole(3000)
    twice = table.iloc[np.sort(np.concatenate([np.arange(3000), [50, 51, 2000]]))]
    with pytest.raises(RecordingError, match=r"repeats .* \(3 such in all: packets recorded twice"):
        aj.read(written(twice))
    for gaps in ("segments", "fill"):
        recording = aj.read(written(twice), gaps=gaps)
        assert any("3 packets recorded twice left out" in note for note in recording.notes)
        np.testing.assert_array_equal(recording.values, table.iloc[:, 1:4].to_numpy())
    # Another sample of the same time is none of them.
    twice.iloc[51, 1] += 1.0
    with pytest.raises(RecordingError, match="repeats"):
        aj.read(written(twice), gaps="fill")


def test_a_clock_that_was_set_is_named(written):
    table = whole(3000)
    table.loc[1500:, "time [s]"] -= 2.5
    with pytest.raises(
        RecordingError, match=r"is earlier than the time before it, by 2.49 s, .* a clock that was set"
    ):
        aj.read(written(table))


@pytest.mark.parametrize(("bits", "unit", "per_second"), [(16, "ms", 1e3), (32, "us", 1e6), (24, "us", 1e6)])
def test_a_counter_that_starts_again_is_continued(written, bits, unit, per_second):
    table = whole(10_000)
    counts = np.round(table.pop("time [s]") * per_second).astype(int) + 2**bits - 12_345
    table.insert(0, f"time [{unit}]", counts % 2**bits)
    recording = aj.read(written(table))
    assert recording.rate == pytest.approx(RATE, rel=1e-9)
    assert any("starts again" in note and "continued" in note for note in recording.notes)


def test_late_stamps_beside_lost_samples_are_no_gaps(written):
    """Jitter of a tenth of the interval, and a sample lost here and there: each is at its place."""
    table, lost = whole(), lost_at()
    rng = np.random.default_rng(3)
    table["time [s]"] += 0.1 / RATE * rng.uniform(-1.0, 1.0, N)
    recording = aj.read(written(table[~lost]), gaps="fill")
    assert np.array_equal(recording.missing[:, 0], lost)


def test_samples_are_drawn_from_their_conditional_distribution():
    """Against the dense conditional mean and variance, over many draws of one record's gaps."""
    n, rng = 400, np.random.default_rng(4)
    lag = np.arange(n)
    C = toeplitz(0.9**lag + 0.1 * (lag == 0))
    root = np.linalg.cholesky(C)
    missing = np.zeros(n, bool)
    missing[[50, 51, 52, 53, 120, 200, 201, 300]] = True
    other = cho_factor(C[np.ix_(~missing, ~missing)])
    across = C[np.ix_(missing, ~missing)]
    covariance = C[np.ix_(missing, missing)] - across @ cho_solve(other, across.T)
    x = root @ rng.standard_normal((n, 300))
    drawn = np.column_stack([completed(column[:, None], missing[:, None])[:, 0] for column in x.T])
    error = drawn[missing] - across @ cho_solve(other, x[~missing])
    # The spectrum is that of 400 samples, averaged over 4 frequencies and more on either side: of variances
    # some 15 %; and the draws' own scatter of √(2/300) = 8 %, of which four.
    assert np.diag(np.cov(error)) == pytest.approx(np.diag(covariance), rel=0.4)
    assert error.mean(axis=1) == pytest.approx(0.0, abs=4.5 * np.sqrt(np.diag(covariance).max() / 300))
    assert np.array_equal(drawn[~missing], x[~missing])


@pytest.mark.parametrize("kind", ["walk", "filtered"])
def test_a_completed_record_has_the_spectrum_of_a_whole_one(kind):
    rng, n = np.random.default_rng(5), 60_000
    f = np.arange(1, n) / (2.0 * n)
    if kind == "walk":
        expected = 1.0 + (0.05 / (2.0 * np.sin(np.pi * f))) ** 2
        x = rng.standard_normal(n) + 0.05 * np.cumsum(rng.standard_normal(n))
    else:
        b, a = butter(2, 0.5)
        expected = np.abs(freqz(b, a, 2.0 * np.pi * f)[1]) ** 2
        x = lfilter(b, a, rng.standard_normal(n + 500))[500:]
    lost = lost_at(n)
    y = completed(np.where(lost, np.nan, x)[:, None], lost[:, None])[:, 0]
    c, of_zeros = (np.abs(np.fft.rfft(z - z.mean())[1:]) ** 2 / n for z in (y, np.where(lost, x.mean(), x)))
    low = np.interp(np.arange(1, len(c) + 1) / n, f, expected)
    for first in range(200, int(0.45 * n) - 1000, 2000):
        band = slice(first, first + 2000)
        # Four standard errors of two thousand exponential values, and a twentieth for the averaging.
        assert np.mean(c[band] / low[band]) == pytest.approx(1.0, abs=4.0 / np.sqrt(2000) + 0.05)
    # The test sees what zeros do: behind a filter, many times the noise.
    if kind == "filtered":
        assert np.mean(of_zeros[-5000:] / low[-5000:]) > 5.0


def test_the_prediction_is_that_of_a_dense_solution():
    from scipy.fft import dct

    n, rng = 1500, np.random.default_rng(6)
    v = 1.0 + (100.0 / np.arange(1.0, n)) ** 2
    missing = rng.random(n) < 0.1
    missing[300:700] = True
    d = in_time(np.sqrt(v) * rng.standard_normal(n - 1))
    D = dct(np.eye(n)[missing], norm="ortho", axis=1)[:, 1:]
    precision = (D / v) @ D.T
    exact = -np.linalg.solve(precision, (D / v) @ dct(np.where(missing, 0.0, d), norm="ortho")[1:])
    off = predicted(d, missing, v)[missing] - exact
    # A hundredth of what one sample's own chance adds.
    assert off @ precision @ off < 0.01


def test_intervals_allow_for_what_is_missing(written):
    table, lost = whole(), lost_at()
    recording = aj.read(written(table[~lost]), gaps="fill")
    bare = aj.Recording.from_array(recording.values, RATE, gyro_unit="rad/s")
    share = lost.mean()
    factor = np.sqrt(1.0 / (1.0 - share) + share)
    assert widening(recording.missing) == pytest.approx(np.full(3, factor))
    one, other = (aj.fit(r, "N + K", plain=True)["gyro_x"] for r in (recording, bare))
    assert one["N"].value == pytest.approx(other["N"].value, rel=1e-6)
    assert one["N"].std == pytest.approx(factor * other["N"].std, rel=1e-4)
    assert one.covariance == pytest.approx(factor**2 * other.covariance, rel=1e-4)
    widths = [np.ptp(np.log(result["N"].interval)) for result in (one, other)]
    assert widths[0] == pytest.approx(factor * widths[1], rel=1e-4)
    assert aj.check(recording)["gaps"].verdict == "look"


@pytest.mark.parametrize("kind", ["frame", "array", "file"])
def test_whatever_is_given_is_filled_or_cut_as_a_file_is(kind, written):
    """Nan in a column: the recording is the one that `read` makes of a file."""
    table = whole(3000).drop(columns=["time [s]", "temperature"])
    table.iloc[1000, 1] = np.nan
    path = written(table)
    given = {"frame": table, "array": table.to_numpy(), "file": path}[kind]
    told = {"names": [label.split()[0] for label in table], "gyro_unit": "rad/s"} if kind == "array" else {}
    for gaps in ("segments", "fill"):
        found, recording = as_recording(given, RATE, gaps=gaps, **told), aj.read(path, rate=RATE, gaps=gaps)
        assert found.n == (3000 if gaps == "fill" else 1999)
        assert np.array_equal(found.values, recording.values)
    for command in (aj.fit, aj.check, aj.critique):
        with pytest.raises(RecordingError, match="must be error, segments or fill"):
            command(given, rate=RATE, gaps="drop", **told)
    with pytest.raises(RecordingError, match="1 value is not a finite number"):
        aj.fit(given, "N", rate=RATE, **told)


def test_an_array_says_what_was_left_out_and_which_choices_there_are():
    x = np.random.default_rng(1).standard_normal((200, 1))
    x[[50, 60]] = np.nan
    cut = aj.Recording.from_array(x, RATE, gyro_unit="rad/s", names=["gyro_x"], gaps="segments")
    assert np.array_equal(cut.values, x[61:])
    assert any("samples 61 to 199 of 200 taken, the longest of 3" in note for note in cut.notes)
    with pytest.raises(RecordingError, match="must be error, segments or fill, not 'drop'"):
        aj.Recording.from_array(x, RATE, gyro_unit="rad/s", names=["gyro_x"], gaps="drop")
    with pytest.raises(AllanjaxError, match="no gaps: leave out gaps"):
        aj.fit(cut, gaps="fill")


def test_allan_deviations_of_a_filled_record_have_fewer_degrees_of_freedom():
    """The scatter is that of n(1 − f) samples, and that of f·n draws, of each axis by its own share."""
    x = np.random.default_rng(21).standard_normal((512, 2))
    x[::4, 1] = np.nan
    recording = aj.Recording.from_array(x, 1.0, gyro_unit="rad/s", names=["gyro_x", "gyro_y"], gaps="fill")
    for estimator in ("exact", "pyramid"):
        filled, whole = (
            aj.allan_deviation(data, estimator=estimator, **rate)
            for data, rate in ((recording, {}), (recording.values, {"rate": 1.0}))
        )
        np.testing.assert_array_equal(filled.deviation, whole.deviation)
        np.testing.assert_array_equal(filled.edf[:, 0], whole.edf[:, 0])
        np.testing.assert_allclose(filled.edf[:, 1] * (1.0 / 0.75 + 0.25), whole.edf[:, 1], rtol=1e-12)


def in_stretches(x, lengths):
    """Array with these stretches of samples, one sample missing between them."""
    parts = np.split(x[: sum(lengths)], np.cumsum(lengths)[:-1])
    gap = np.full((1, x.shape[1]), np.nan)
    return np.concatenate([y for part in parts for y in (part, gap)][:-1])


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"overlapping": False},
        {"kind": "hadamard"},
        {"kind": "modified"},
        {"kind": "hadamard", "overlapping": False},
        {"estimator": "pyramid"},
        {"cluster_times": [0.03, 0.5, 2.0]},
    ],
)
def test_differences_whose_clusters_are_complete_are_averaged(options):
    """By brute force: every difference of the phase within a stretch, of all stretches together."""
    lengths = (150, 500, 64, 63, 411)
    x = np.random.default_rng(31).standard_normal((1188, 2))
    recording = aj.Recording.from_array(
        in_stretches(x, lengths), RATE, gyro_unit="rad/s", names=["gyro_x", "gyro_y"], gaps="segments"
    )
    # That of 63 samples is too short for a spectrum.
    assert sorted(map(len, recording.others)) == [64, 150, 411]
    found = aj.allan_deviation(recording, **options)
    weights = [1, -2, 1] if options.get("kind", "allan") != "hadamard" else [-1, 3, -3, 1]
    modified = options.get("kind") == "modified"
    for k, m in enumerate(found.cluster_size):
        squares = []
        for z in (recording.values, *recording.others):
            phase = np.vstack([np.zeros(2), np.cumsum(z, axis=0)]) / RATE
            count = len(z) + 1 - (len(weights) - 1) * m
            d = sum(w * phase[p * m : p * m + max(count, 0)] for p, w in enumerate(weights))
            step = 1 if options.get("overlapping", True) else m
            step = max(m // 8, 1) if "estimator" in options else step
            if modified:
                starts = range(count + 1 - m)
                d = np.array([d[i : i + m].mean(axis=0) for i in starts]).reshape(-1, 2)
            squares.append(d[::step] ** 2)
        squares = np.concatenate(squares)
        scale = (6.0 if len(weights) == 4 else 2.0) * (m / RATE) ** 2
        assert found.count[k] == len(squares)
        np.testing.assert_allclose(found.variance[k], squares.mean(axis=0) / scale, rtol=1e-9)


def test_degrees_of_freedom_of_stretches_are_those_of_simulated_ones():
    """The relative variance of the pooled estimates is 2/ν: over 2000 sets of stretches to some 6 % (2 σ)."""
    lengths, rng = (100, 180, 70), np.random.default_rng(32)
    gaps = in_stretches(np.ones((350, 1)), lengths)
    estimates = []
    for _ in range(500):
        x = gaps * rng.standard_normal((len(gaps), 4))
        recording = aj.Recording.from_array(
            x, RATE, gyro_unit="rad/s", names=[f"gyro_{k}" for k in range(4)], gaps="segments"
        )
        curve = aj.allan_deviation(recording)
        estimates.append(curve.variance.T)
    estimates = np.concatenate(estimates)
    measured = 2.0 * estimates.mean(axis=0) ** 2 / estimates.var(axis=0)
    # The scatter of a variance of values with two degrees of freedom or more: √(8/2000).
    assert measured == pytest.approx(curve.edf[:, 0], rel=3.0 * np.sqrt(8.0 / 2000.0))
    assert curve.others == (100, 70)
    whole = aj.allan_deviation(x[101:281, :1], RATE)
    assert (curve.edf[:3, 0] > 1.5 * whole.edf[:3, 0]).all()
