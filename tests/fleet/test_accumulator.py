"""Samples that come piece by piece: the same answers however they were divided, restarted or merged."""

import numpy as np
import pytest
from commands import run
from imu_columns import refused

import allanjax as aj

RATE = 200.0
N, K = 1e-3, 3e-4
AXES = ["gyro_x", "gyro_y"]
ROUNDING = 1e-11


@pytest.fixture(scope="module")
def x():
    """White noise and a random walk of two unequal gyros; N and K of the first are in SI."""
    rng, n = np.random.default_rng(0), 300_000
    walk = np.cumsum(rng.standard_normal((n, 2)), axis=0) * K / np.sqrt(RATE)
    return (N * np.sqrt(RATE) * rng.standard_normal((n, 2)) + walk) * [1.0, 3.0] + [0.02, -0.5]


def filled(x, size, start=0, axes=AXES):
    accumulator = aj.AllanAccumulator(RATE, axes, start=start)
    for k in range(0, len(x), size):
        accumulator.update(x[k : k + size])
    return accumulator


def pyramid(x):
    return aj.allan_deviation(x, RATE, estimator="pyramid")


def test_a_stream_has_the_degrees_of_freedom_of_its_record_and_pieces_stay_as_they_were(x):
    whole = pyramid(x)
    for size in (1_000, 131_072, 300_000):
        found = filled(x, size).result()
        np.testing.assert_allclose(found.deviation, whole.deviation, rtol=ROUNDING)
        np.testing.assert_allclose(found.edf, whole.edf, rtol=1e-9)
    left, right = filled(x[:77_777], 31_007), filled(x[77_777:], 31_007, start=77_777)
    np.testing.assert_allclose(left.merge(right).result().edf, whole.edf, rtol=1e-9)
    assert [left.n, right.n] == [77_777, len(x) - 77_777]


def test_a_snapshot_goes_on_where_it_was_taken(x, tmp_path, monkeypatch):
    path, buffer = tmp_path / "rig.npz", np.empty((50_000, 2))
    before = aj.AllanAccumulator(RATE, AXES, start=7, name="rig")
    for k in range(0, 150_000, 50_000):
        buffer[:] = x[k : k + 50_000]
        before.update(buffer)
    before.snapshot(path)
    after = aj.AllanAccumulator.restore(path)
    assert (after.n, after.axes, after.rate, after.start) == (150_000, before.axes, RATE, 7)
    assert (after, after.name) == (before, "rig")
    for accumulator in (before, after):
        accumulator.update(x[150_000:])
    np.testing.assert_array_equal(before.result().deviation, after.result().deviation)
    kept = path.read_bytes()
    monkeypatch.setattr(np, "savez", lambda *args, **arrays: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        after.snapshot(path)
    assert path.read_bytes() == kept
    assert [p.name for p in tmp_path.iterdir()] == ["rig.npz"]


@pytest.mark.parametrize("objective", ["allan", "whittle"])
def test_a_stream_has_the_coefficients_of_its_noise(x, objective):
    """With the errors of the Cramér–Rao bound, to a tenth; more than 2¹⁸ samples, a spectrum of two rates."""
    streamed = filled(x, 60_000).fit("N + K", objective, as_is=True)
    assert streamed.objective == objective
    # Modes of the record have powers a + b/(2 sin(πk/2n))², whose logarithms have the information ½ Σ g g'.
    slow = (K / N / RATE / (2.0 * np.sin(0.5 * np.pi * np.arange(1, len(x)) / len(x)))) ** 2
    g = np.stack([1.0 / (1.0 + slow), slow / (1.0 + slow)])
    bound = 0.5 * np.sqrt(np.diag(np.linalg.inv(0.5 * g @ g.T)))
    for axis, scale in zip(AXES, (1.0, 3.0), strict=True):
        for label, truth, relative in (("N", N, bound[0]), ("K", K, bound[1])):
            found = streamed[axis][label]
            assert abs(found.value - scale * truth) < 4.0 * found.std
            assert found.std == pytest.approx(scale * truth * relative, rel=0.15)


def test_terms_are_chosen_without_the_record(x):
    for axis in filled(x, 60_000).fit().selection.values():
        assert {*axis.chosen.terms} == {"angle_random_walk", "rate_random_walk"}


def test_a_dead_axis_of_a_stream_has_no_result(x, tmp_path):
    part = x[:20_000].copy()
    part[:, 1] = np.nan
    accumulator = filled(part, 7_000)
    assert [dead.axis.name for dead in accumulator.dead] == ["gyro_y"]
    np.testing.assert_allclose(accumulator.result().deviation, pyramid(part[:, :1]).deviation, rtol=ROUNDING)
    piece = filled(x[20_000:30_000], 10_000, start=20_000)
    for call in (lambda: accumulator.update(x[20_000:30_000]), lambda: accumulator.merge(piece)):
        refused(call, "gyro_y", aj.AllanjaxError)
    part[:, 1] = 0.25
    constant = filled(part, 7_000)
    assert "0.25" in constant.dead[0].reason
    constant.snapshot(tmp_path / "state.npz")
    fit = aj.AllanAccumulator.restore(tmp_path / "state.npz").fit("N", as_is=True)
    assert list(fit.without_result) == ["gyro_y"]
    assert fit["gyro_x"]["N"] == filled(part[:, :1], 7_000, axes=AXES[:1]).fit("N", as_is=True)["gyro_x"]["N"]
    refused(filled(np.zeros((100, 2)), 100).fit, "gyro_x", aj.FitError)


def test_what_goes_wrong_is_named_and_nothing_is_lost(x, tmp_path):
    make, accumulator, bad = aj.AllanAccumulator, filled(x[:500], 500, start=1_000), x[:10].copy()
    bad[3, 1] = np.nan
    cut = tmp_path / "cut.npz"
    cut.write_bytes(b"PK\x03\x04 cut short")

    def merged(*arguments, **start):
        piece = make(*arguments, **start)
        piece.update(x[:10])
        return accumulator.merge(piece)

    for call, words, *kind in (
        (lambda: accumulator.update(bad), "1503|gyro_y"),
        (lambda: accumulator.update(np.full((3, 2), np.inf)), "gyro_x"),
        (lambda: accumulator.update(np.ones((4, 3))), "(4, 3)"),
        (lambda: merged(RATE, AXES, start=7), "adjacent"),
        (lambda: merged(RATE / 2.0, AXES, start=1_500), "100 Hz"),
        (lambda: merged(RATE, ["gyro_x", "gyro_z"], start=1_500), "gyro_z"),
        (lambda: make(0.0, AXES), "rate"),
        (lambda: make(RATE, AXES, start=-1), "start"),
        (lambda: make(RATE, "gyro_x"), "axes="),
        (lambda: make(RATE, ["gyro_x", "gyro_x"]), "gyro_x", aj.RecordingError),
        (lambda: make(RATE, ["temperature"]), "temperature", aj.RecordingError),
        (lambda: make.restore(cut), "cut.npz", aj.RecordingError),
        (lambda: make.restore(tmp_path / "no.npz"), "no such file", aj.RecordingError),
        (lambda: accumulator.fit("N", "exact"), "exact", aj.FitError),
        (lambda: accumulator.fit(aj.AngleRandomWalk() + aj.Sinusoid()), "sinusoid", aj.FitError),
    ):
        refused(call, words, *(kind or [aj.AllanjaxError]))
    assert accumulator.n == 500


@pytest.mark.usefixtures("elsewhere")
def test_a_file_is_accumulated_chunk_by_chunk(x, tmp_path):
    path, told = tmp_path / "long.npy", []
    np.save(path, x[:50_000])
    chunks = aj.read_chunks(path, rate=RATE, gyro_unit="rad/s", columns="gyro_x,gyro_y", chunk=15_000)
    found = aj.accumulate(chunks, start=3, progress=lambda *done: told.append(done))
    assert told == [(k, 50_000) for k in (15_000, 30_000, 45_000, 50_000)]
    assert found.start == 3
    # At larger clusters where differences begin depends on the start.
    whole = pyramid(x[:50_000]).deviation
    np.testing.assert_allclose(found.result().deviation[:4], whole[:4], rtol=ROUNDING)
    words = ["--rate", RATE, "--gyro-unit", "rad/s", "--columns", "gyro_x,gyro_y"]
    refusal = run("characterize", path, "--stream", *words, "--regressors", "temperature")
    assert (refusal.exit_code, "regressors" in refusal.stderr) == (1, True)


def test_the_same_samples_give_the_same_result_whichever_way_they_come(cluster, tmp_path):
    """As a whole, as a stream, in pieces that are merged, and in a fleet, divided or not."""
    kinds = ("N=0.2 deg/√h + B=4 deg/h", "N=0.2 deg/√h + K=20 deg/h/√h", "Q=0.5 arcsec + N=0.05 deg/√h")
    models = dict(zip(["gyro_x", "gyro_y", "gyro_z"], kinds, strict=True))
    recording = aj.simulate_recording(models, 120_000, 100.0, 7)
    path = tmp_path / "unit.parquet"
    aj.write(recording, path)
    whole = aj.fit(recording)

    def streamed(values, start):
        found = aj.AllanAccumulator(recording.rate, recording.axes, start=start)
        found.update(values)
        return found

    left, right = streamed(recording.values[:50_001], 0), streamed(recording.values[50_001:], 50_001)
    tables = [streamed(recording.values, 0).fit().to_dataframe(), left.merge(right).fit().to_dataframe()]
    for piece in (100_000, 20_000_000):
        fleet = aj.characterize_fleet(path, tmp_path / str(piece), scheduler=cluster, piece=piece)
        tables.append(fleet.table)
    for table in tables:
        found = table.set_index(["axis", "coefficient"])
        assert list(found.index) == [(axis, label) for axis in whole for label in whole[axis].coefficients]
        for (axis, label), row in found.iterrows():
            c = whole[axis][label].in_unit(row["unit"])
            assert row["detected"] == c.detected
            if c.detected:
                # Spectra of segments and clusters that begin at some samples only know as much to a per cent.
                assert abs(row["value"] - c.value) < 0.1 * c.std
                assert row["std"] == pytest.approx(c.std, rel=0.05)
