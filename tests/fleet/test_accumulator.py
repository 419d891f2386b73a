"""Samples that come piece by piece: the same answers however they were divided, restarted or merged."""

import dataclasses
import itertools
import subprocess
import sys

import numpy as np
import pytest

from allanjax import AllanAccumulator, accumulate, allan_deviation, read_chunks
from allanjax.base.errors import AllanjaxError, FitError, RecordingError
from allanjax.cli.app import app
from allanjax.estimate.axis_fits import fit_allan
from allanjax.estimate.fit import fit
from allanjax.noise.terms import AngleRandomWalk, BiasInstability, RateRandomWalk, Sinusoid
from allanjax.record.recording import Recording

RATE = 200.0
N, K = 1e-3, 3e-4
AXES = ["gyro_x", "gyro_y"]
ROUNDING = 1e-11


def samples(n: int, seed: int = 0) -> np.ndarray:
    """White noise and a random walk of two gyros; the coefficients N [rad/√s] and K [rad/s/√s] above."""
    rng = np.random.default_rng(seed)
    walk = np.cumsum(rng.standard_normal((n, 2)), axis=0) * K / np.sqrt(RATE)
    return N * np.sqrt(RATE) * rng.standard_normal((n, 2)) + walk + 9.81


@pytest.fixture(scope="module")
def x() -> np.ndarray:
    return samples(300_000)


def filled(x: np.ndarray, sizes: np.ndarray, start: int = 0) -> AllanAccumulator:
    accumulator = AllanAccumulator(RATE, AXES, start=start)
    edges = np.minimum(np.cumsum(sizes), len(x))
    for piece in np.split(x, edges):
        accumulator.update(piece)
    return accumulator


@pytest.mark.parametrize("size", [1_000, 131_072, 300_000])
def test_chunks_of_any_size_give_the_one_shot_pyramid(x, size):
    found = filled(x, np.full(len(x) // size, size)).result()
    whole = allan_deviation(x, RATE, estimator="pyramid")
    np.testing.assert_array_equal(found.cluster_size, whole.cluster_size)
    np.testing.assert_array_equal(found.count, whole.count)
    np.testing.assert_allclose(found.deviation, whole.deviation, rtol=ROUNDING)


def test_single_samples_are_chunks_too():
    x = samples(300)
    found = filled(x, np.ones(300, int)).result()
    np.testing.assert_allclose(
        found.deviation, allan_deviation(x, RATE, estimator="pyramid").deviation, rtol=ROUNDING
    )


def test_small_cluster_times_are_those_of_the_overlapping_definition(x):
    # Up to m = 8 every start is used, as in eq. (4.5): means of m samples, squared differences of neighbours.
    total = np.vstack([np.zeros((1, 2)), np.cumsum(x - x.mean(axis=0), axis=0)])
    found = filled(x, np.full(7, 40_000)).result()
    for k, m in enumerate((1, 2, 4, 8)):
        d = (total[2 * m :] - 2.0 * total[m:-m] + total[: -2 * m]) / m
        np.testing.assert_allclose(found.deviation[k] ** 2, 0.5 * np.mean(d**2, axis=0), rtol=1e-9)


def test_adjacent_pieces_merge_to_the_whole_in_any_grouping(x):
    cuts = [0, 77_777, 77_778, 200_001, len(x)]
    pieces = [filled(x[a:b], np.full(9, 31_007), start=a) for a, b in itertools.pairwise(cuts)]
    left = pieces[0].merge(pieces[1]).merge(pieces[2]).merge(pieces[3])
    right = pieces[0].merge(pieces[1].merge(pieces[2].merge(pieces[3])))
    whole = allan_deviation(x, RATE, estimator="pyramid").deviation
    for merged in (left, right):
        assert merged.n == len(x)
        np.testing.assert_allclose(merged.result().deviation, whole, rtol=ROUNDING)
    # Merging leaves the pieces as they were.
    assert [piece.n for piece in pieces] == list(np.diff(cuts))


def test_a_snapshot_goes_on_where_it_was_taken(x, tmp_path):
    path = tmp_path / "rig.npz"
    before = filled(x[:150_001], np.full(3, 50_000))
    before.snapshot(path)
    after = AllanAccumulator.restore(path)
    assert (after.n, after.axes, after.rate) == (before.n, before.axes, before.rate)
    for accumulator in (before, after):
        accumulator.update(x[150_001:])
    np.testing.assert_array_equal(before.result().deviation, after.result().deviation)
    model = AngleRandomWalk() + RateRandomWalk()
    one, other = (a.fit(model, "whittle")["gyro_x"].coefficients for a in (before, after))
    assert {k: c.value for k, c in one.items()} == {k: c.value for k, c in other.items()}


def test_a_snapshot_is_written_as_a_whole_or_not_at_all(tmp_path, monkeypatch):
    path = tmp_path / "rig.npz"
    accumulator = filled(samples(2_000), np.full(2, 1_000))
    accumulator.snapshot(path)
    kept = path.read_bytes()

    def interrupted(*args: object, **arrays: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez", interrupted)
    accumulator.update(samples(100, 1))
    with pytest.raises(KeyboardInterrupt):
        accumulator.snapshot(path)
    assert path.read_bytes() == kept
    assert [p.name for p in tmp_path.iterdir()] == ["rig.npz"]


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut short", b"time,gyro_x\n0,1\n"])
def test_what_is_no_snapshot_is_said_to_be_none(tmp_path, content):
    path = tmp_path / "rig.npz"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=r"rig\.npz: not a snapshot"):
        AllanAccumulator.restore(path)


@pytest.mark.parametrize("objective", ["allan", "whittle"])
def test_a_stream_has_the_coefficients_of_the_recording(x, objective):
    """More than 2¹⁸ samples, so that the spectrum is put together from two rates."""
    model = AngleRandomWalk() + BiasInstability() + RateRandomWalk()
    streamed = filled(x, np.full(5, 60_000)).fit(model, objective)
    recording = Recording.from_array(x, RATE, gyro_unit="rad/s", names=AXES)
    whole = fit(recording, model, objective)
    for axis in AXES:
        one, other = streamed[axis].coefficients, whole[axis].coefficients
        for label in ("angle_random_walk", "rate_random_walk"):
            # Estimates from the same samples that use them a little differently: of what the samples leave
            # open, half a standard error is a lot.
            assert abs(one[label].value - other[label].value) < 0.5 * other[label].std
            assert one[label].std == pytest.approx(other[label].std, rel=0.1)
        # The truth, within four standard errors.
        assert abs(one["angle_random_walk"].value - N) < 4.0 * one["angle_random_walk"].std
        assert abs(one["rate_random_walk"].value - K) < 4.0 * one["rate_random_walk"].std


def test_terms_are_chosen_without_the_record(x):
    chosen = filled(x, np.full(5, 60_000)).fit().selection
    assert chosen is not None
    assert all(
        set(axis.chosen.terms) == {"angle_random_walk", "rate_random_walk"} for axis in chosen.values()
    )


def test_what_needs_the_record_says_so(x):
    with pytest.raises(FitError, match=r"sinusoid.*read a stretch"):
        filled(x[:5_000], np.full(1, 5_000)).fit(AngleRandomWalk() + Sinusoid())


def test_bad_samples_are_refused_and_nothing_is_lost():
    accumulator = AllanAccumulator(RATE, AXES, start=1_000)
    accumulator.update(samples(500))
    bad = samples(10)
    bad[3, 1] = np.nan
    with pytest.raises(AllanjaxError, match="sample 1503 of gyro_y is not finite"):
        accumulator.update(bad)
    with pytest.raises(AllanjaxError, match=r"\[n, 2\], not \(4, 3\)"):
        accumulator.update(np.ones((4, 3)))
    assert accumulator.n == 500


def test_a_buffer_may_be_filled_again():
    x, buffer = samples(4_000), np.empty((500, 2))
    accumulator = AllanAccumulator(RATE, AXES)
    for k in range(0, 4_000, 500):
        buffer[:] = x[k : k + 500]
        accumulator.update(buffer)
    whole = allan_deviation(x, RATE, estimator="pyramid").deviation
    np.testing.assert_allclose(accumulator.result().deviation, whole, rtol=ROUNDING)


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (AllanAccumulator(RATE, AXES, start=7), "adjacent"),
        (AllanAccumulator(RATE / 2.0, AXES, start=10), "not of one recording"),
        (AllanAccumulator(RATE, ["gyro_x", "gyro_z"], start=10), "not of one recording"),
    ],
)
def test_pieces_that_do_not_follow_are_not_merged(other, message):
    accumulator = AllanAccumulator(RATE, AXES)
    accumulator.update(samples(10))
    with pytest.raises(AllanjaxError, match=message):
        accumulator.merge(other)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"rate": 0.0}, "rate must be positive"),
        ({"start": -1}, "must not be negative"),
        ({"axes": "gyro_x"}, "list of names"),
        ({"axes": ["gyro_x", "gyro_x"]}, "both gyro_x"),
        ({"axes": ["temperature"]}, "axes=: 'temperature' is no axis"),
    ],
)
def test_nonsense_is_refused(arguments, message):
    with pytest.raises(AllanjaxError, match=message):
        AllanAccumulator(**{"rate": RATE, "axes": AXES} | arguments)


def test_a_file_is_accumulated_chunk_by_chunk(tmp_path):
    x, path = samples(50_000), tmp_path / "long.npy"
    np.save(path, x)
    told = []
    chunks = read_chunks(path, rate=RATE, gyro_unit="rad/s", columns="gyro_x,gyro_y", chunk=15_000)
    found = accumulate(chunks, progress=lambda done, total: told.append((done, total)))
    assert told == [(15_000, 50_000), (30_000, 50_000), (45_000, 50_000), (50_000, 50_000)]
    whole = allan_deviation(x, RATE, estimator="pyramid").deviation
    np.testing.assert_allclose(found.result().deviation, whole, rtol=ROUNDING)


def test_the_command_streams(tmp_path):
    from typer.testing import CliRunner

    np.save(tmp_path / "long.npy", samples(50_000))
    options = ["--rate", "200", "--gyro-unit", "rad/s", "--columns", "gyro_x,gyro_y", "--terms", "N + K"]
    arguments = [
        "characterize",
        str(tmp_path / "long.npy"),
        "--stream",
        *options,
        "--out",
        str(tmp_path / "out"),
    ]
    outcome = CliRunner().invoke(app, arguments)
    assert outcome.exit_code == 0, outcome.output
    assert "angle random walk" in outcome.output
    names = ["long.json", "long_allan.csv", "long_allan.png", "long_coefficients.csv"]
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == names
    refused = CliRunner().invoke(app, [*arguments, "--regressors", "temperature"])
    assert refused.exit_code == 1


def test_memory_does_not_grow_with_the_stream():
    """Peak memory of processes that accumulate 2 and 20 million samples: the difference is no multiple."""
    program = """
import resource, sys
import numpy as np
from allanjax import AllanAccumulator
accumulator = AllanAccumulator(200.0, ["gyro_x"])
rng = np.random.default_rng(0)
for _ in range(int(sys.argv[1])):
    accumulator.update(rng.standard_normal(1_000_000))
accumulator.result()
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""
    short, long = (
        int(subprocess.run([sys.executable, "-c", program, k], check=True, capture_output=True).stdout)
        for k in ("2", "20")
    )
    # 18 million more samples are 144 MB; a tenth of that is the allocator's to waste (units of 1 kB).
    if sys.platform.startswith("linux"):
        assert long - short < 14_400


def test_where_the_allan_variances_determine_nothing_the_spectra_do(x, monkeypatch):
    def hopeless(*given):
        results, curve = fit_allan(*given)
        return tuple(dataclasses.replace(r, converged=False) for r in results), curve

    monkeypatch.setattr("allanjax.fleet.stream.fit_allan", hopeless)
    model = AngleRandomWalk() + RateRandomWalk()
    found = filled(x, np.full(5, 60_000)).fit(model)
    assert found.objective == "whittle"
    assert "whittle" in found.notes[-1]
    assert abs(found["gyro_x"].coefficients["angle_random_walk"].value / N - 1.0) < 0.01
