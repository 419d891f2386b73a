"""Fleets: many recordings on a Dask cluster, and which of their units are unlike the others."""

import json
import os
import signal
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from matplotlib import pyplot as plt
from typer.testing import CliRunner

from allanjax import AllanAccumulator
from allanjax.base.errors import AllanjaxError
from allanjax.cli.app import app
from allanjax.fleet import cluster as fleet_cluster
from allanjax.fleet import fleet
from allanjax.fleet.cluster import connected, outcomes
from allanjax.fleet.files import matching_files, recording_names
from allanjax.fleet.fleet import characterize_fleet
from allanjax.fleet.options import FitOptions
from allanjax.fleet.store import key_of
from allanjax.fleet.summary import cells, judged
from allanjax.fleet.table import table_of, table_schema
from allanjax.noise.notation import parse_model
from allanjax.record.io import write
from allanjax.record.recording import Recording
from allanjax.report.fleet_figure import plot_fleet

UNITS = 10
ODD = 6
MODEL = parse_model("N + B")
mpl.use("agg")


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """White noise of ten units, of one three times the others', and a file that is no recording.

    N of the like units scatters by 5 %, and 5000 samples tell it to 1 %; there is no bias instability.
    """
    folder = tmp_path_factory.mktemp("logs")
    rng = np.random.default_rng(1)
    for k, factor in enumerate(np.exp(0.05 * rng.standard_normal(UNITS))):
        values = (0.3 if k == ODD else 0.1) * factor * rng.standard_normal(5000)
        recording = Recording.from_array(values, 100.0, gyro_unit="deg/s", names=["gyro_x"])
        write(recording, folder / f"unit_{k}.parquet")
    (folder / "corrupt.parquet").write_bytes(b"PAR1 but no more")
    return folder


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def client(cache):
    """Of a cluster of two workers, which all tests share."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ALLANJAX_CACHE", str(cache))
        with connected(None, 2, 2) as client:
            yield client


@pytest.fixture(scope="module")
def characterized(logs, client, tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    result = characterize_fleet(logs / "*.parquet", out, MODEL, scheduler=client.scheduler.address)
    return out, result


def result_times(out):
    return {path.stem: path.stat().st_mtime_ns for path in (out / "recordings").iterdir()}


def run(*arguments, cache, cwd):
    script = "import sys; from allanjax.cli.app import main; sys.argv[0] = 'allanjax'; main()"
    command = [sys.executable, "-c", script, *map(str, arguments)]
    environment = {**os.environ, "ALLANJAX_CACHE": str(cache), "COLUMNS": "200"}
    return subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=300)


def test_the_table_holds_what_characterize_finds(characterized, logs, cache):
    out, result = characterized
    pd.testing.assert_frame_equal(pd.read_parquet(out / "fleet.parquet"), result.table)
    assert pq.read_schema(out / "fleet.parquet").remove_metadata() == table_schema()
    assert list(result.table["recording"].unique()) == [f"unit_{k}" for k in range(UNITS)]
    alone = run("characterize", logs / "unit_4.parquet", "--terms", "N + B", "--json", cache=cache, cwd=out)
    (axis,) = json.loads(alone.stdout)["fits"][0]["axes"]
    rows = result.table[result.table["recording"] == "unit_4"].set_index("coefficient")
    assert list(rows.index) == ["angle_random_walk", "bias_instability"]
    for c in axis["coefficients"]:
        found = rows.loc[c["label"]]
        # The same program on the same samples: rounding.
        numbers = [c["value"], *c["interval_95"], axis["p_value"]]
        assert found[["value", "lower_95", "upper_95", "p_value"]].tolist() == pytest.approx(numbers, 1e-6)
        assert (found["unit"], found["detected"], found["axis"]) == (c["unit"], c["detected"], "gyro_x")
    assert set(result.table["terms"]) == {"angle_random_walk + bias_instability"}
    assert (out / "fleet.png").read_bytes().startswith(b"\x89PNG")


def test_the_odd_unit_is_marked_and_no_other(characterized):
    # One clean fleet in a hundred would have a mark.
    _, result = characterized
    marked = result.outlying[["recording", "coefficient"]].values.tolist()
    assert marked == [[f"unit_{ODD}", "angle_random_walk"]]
    assert f"unit_{ODD}" in str(result)
    assert f"unit_{ODD}" in result._repr_html_()


def test_a_corrupt_recording_is_reported_and_the_others_go_on(characterized, logs):
    out, result = characterized
    (error,) = result.errors
    assert error["file"] == str(logs / "corrupt.parquet")
    assert "Parquet" in error["message"]
    assert pd.read_csv(out / "errors.csv").to_dict("records") == [error]
    assert "10 without an error, 1 with" in str(result)


def test_workers_share_a_cache_and_take_a_core_each(characterized, client, cache):
    # A worker that has had no recording yet has no reason to.
    threads = set(client.run(os.getenv, "NPROC").values())
    assert "1" in threads
    assert threads <= {"1", None}
    assert any(cache.iterdir())


def test_a_second_run_computes_only_what_is_not_there(characterized, logs, client, tmp_path):
    out, first = characterized
    before = result_times(out)
    counts = []

    def again(files=logs / "*.parquet", **options):
        counts.clear()
        options |= {"scheduler": client.scheduler.address, "progress": lambda *n: counts.append(n)}
        return characterize_fleet(files, out, MODEL, **options)

    second = again()
    # The corrupt one is tried again.
    assert counts == [(UNITS, 0, UNITS + 1), (UNITS + 1, 1, UNITS + 1)]
    assert second.resumed == UNITS
    assert result_times(out) == before
    pd.testing.assert_frame_equal(second.table, first.table)
    os.utime(logs / "unit_2.parquet")
    (out / "recordings" / "unit_5.json").write_text('{"key": ', encoding="utf-8")
    third = again(logs / "unit_*.parquet")
    changed = {name for name, time in result_times(out).items() if time != before[name]}
    assert changed == {"unit_2", "unit_5"}
    assert third.resumed == UNITS - 2
    assert third.errors == ()
    pd.testing.assert_frame_equal(third.table, first.table)
    # The unit that the header has anyway: another option, and the same result.
    fourth = again(logs / "unit_0.parquet", gyro_unit="deg/s")
    assert fourth.resumed == 0
    pd.testing.assert_frame_equal(fourth.table, first.table.iloc[:2])
    assert again(logs / "unit_0.parquet", gyro_unit="deg/s").resumed == 1


def test_a_worker_killed_half_way_loses_nothing(characterized, logs, client, tmp_path):
    _, first = characterized
    killed = []

    def kill(done, failed, total):
        if done and not killed:
            busy = {address for address, tasks in client.processing().items() if tasks}
            address, pid = next((a, p) for a, p in client.run(os.getpid).items() if a in busy)
            os.kill(pid, signal.SIGKILL)
            killed.append(address)

    result = characterize_fleet(
        logs / "unit_*.parquet", tmp_path, MODEL, scheduler=client.scheduler.address, progress=kill
    )
    assert len(killed) == 1
    assert result.errors == ()
    pd.testing.assert_frame_equal(result.table, first.table)


def deadly(name):
    """Kills its worker."""
    if name == "poison":
        os.kill(os.getpid(), signal.SIGKILL)
    if name == "bad":
        raise ValueError("bad luck")
    return name


def test_only_the_guilty_is_blamed_for_a_dead_worker(client):
    client.wait_for_workers(2)
    # One death is enough for the scheduler to give up on all that the worker had been given.
    client.run_on_scheduler(lambda dask_scheduler: setattr(dask_scheduler, "allowed_failures", 0))
    names = ["poison", *(f"unit_{k}" for k in range(20)), "bad"]
    found = dict(outcomes(client, {name: (deadly, (name,)) for name in names}))
    assert set(found) == set(names)
    assert type(found.pop("poison")).__name__ == "KilledWorker"
    assert str(found.pop("bad")) == "bad luck"
    assert all(name == value for name, value in found.items())


def test_the_command_runs_a_cluster_of_its_own(characterized, logs, cache, tmp_path):
    files = [logs / "unit_0.parquet", "missing.csv", "--terms", "N + B"]
    result = run("fleet", *files, "--workers", "1", "--out", "out", cache=cache, cwd=tmp_path)
    assert result.returncode == 1
    assert "2 recordings: 1 without an error, 1 with; 0 taken from an earlier run" in result.stdout
    assert "wrote out/fleet.parquet, out/fleet.png, out/errors.csv" in result.stdout.replace("\\", "/")
    assert result.stderr.splitlines() == [
        "error: missing.csv: no such file; check the path",
        "1 of 2 files failed: missing.csv",
    ]
    table = pd.read_parquet(tmp_path / "out" / "fleet.parquet")
    _, first = characterized
    of_first = first.table[first.table["recording"] == "unit_0"]
    np.testing.assert_allclose(table["value"], of_first["value"], rtol=1e-8)
    document = json.loads((tmp_path / "out" / "recordings" / "unit_0.json").read_text(encoding="utf-8"))
    assert document["fit"]["axes"][0]["name"] == "gyro_x"


def test_a_pattern_without_files_ends_the_command(tmp_path, monkeypatch):
    monkeypatch.setenv("ALLANJAX_CACHE", "off")
    monkeypatch.chdir(tmp_path)
    nothing = CliRunner().invoke(app, ["fleet", "*.parquet"], catch_exceptions=False)
    assert nothing.exit_code == 1
    assert nothing.stderr == (
        "error: no file matches '*.parquet': check the pattern, and the folder it starts from\n"
    )


def test_wrong_arguments_say_what_to_do(logs, tmp_path, monkeypatch):
    with pytest.raises(AllanjaxError, match=r"no file matches '.*none\*.csv': check the pattern"):
        characterize_fleet([logs / "unit_1.parquet", logs / "none*.csv"], tmp_path)
    with pytest.raises(AllanjaxError, match="no recordings: give files"):
        characterize_fleet([], tmp_path)
    with pytest.raises(AllanjaxError, match="at least 1, not 0"):
        characterize_fleet(logs / "unit_1.parquet", tmp_path, workers=0)
    with pytest.raises(AllanjaxError, match="leave out one of the two"):
        characterize_fleet(logs / "unit_1.parquet", tmp_path, workers=1, scheduler="tcp://127.0.0.1:1")
    monkeypatch.setattr(fleet_cluster, "_CONNECT_SECONDS", 0.2)
    with pytest.raises(AllanjaxError, match="no Dask scheduler answers at"):
        characterize_fleet(logs / "unit_1.parquet", tmp_path, scheduler="tcp://127.0.0.1:1")
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(AllanjaxError, match=r'pip install "allanjax\[fleet\]"'):
        characterize_fleet(logs / "unit_1.parquet", tmp_path)


def test_reasons_say_what_to_do(logs, tmp_path, monkeypatch):
    from concurrent.futures import CancelledError

    from distributed import KilledWorker

    file = logs / "unit_1.parquet"
    failures = [KilledWorker("task", None, 3), CancelledError("gone"), MemoryError("too much")]
    monkeypatch.setattr(fleet, "connected", lambda *arguments: nullcontext())
    messages = []
    for failure in failures:
        monkeypatch.setattr(fleet, "outcomes", lambda *_, failure=failure: [("unit_1", failure)])
        result = characterize_fleet(file, tmp_path)
        (error,) = result.errors
        messages.append(error["message"])
        assert len(result.table) == 0
    assert "died, most likely for want of memory; use fewer workers=" in messages[0]
    assert "run again: what is done is kept" in messages[1]
    assert messages[2] == "MemoryError: too much"


def test_patterns_find_each_file_once_and_no_results(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("b/imu.csv", "a/imu.csv", "log[1].csv", "out/fleet.csv", "a/deeper/x.csv"):
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).touch()
    found = matching_files(["b/*.csv", "**/*.csv", "log[1].csv", "gone.csv"], Path("out"))
    names = [path.as_posix() for path in found]
    assert names == ["b/imu.csv", "a/deeper/x.csv", "a/imu.csv", "log[1].csv", "gone.csv"]


def test_the_folder_of_a_bag_is_one_recording(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("bags/one/metadata.yaml", "bags/one/one_0.mcap", "bags/imu.csv", "bags/notes/a.csv"):
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).touch()
    for pattern, names in (
        ("bags/*", ["bags/imu.csv", "bags/one"]),
        ("**/*", ["bags/imu.csv", "bags/notes/a.csv", "bags/one"]),
        ("**/*.mcap", ["bags/one/one_0.mcap"]),
    ):
        assert [path.as_posix() for path in matching_files(pattern, Path("out"))] == names
    before = key_of(Path("bags/one"), FitOptions())
    Path("bags/one/one_0.mcap").write_text("more")
    assert key_of(Path("bags/one"), FitOptions()) != before


def test_names_of_recordings_tell_them_apart():
    paths = ["x/a/imu.csv", "y/a/imu.csv", "y/b/imu.csv.gz", "y/b/imu.npz", "z/gyro.1.csv"]
    names = recording_names([Path(path) for path in paths])
    assert names == ["x_a_imu", "y_a_imu", "imu.csv.gz", "imu.npz", "gyro.1"]


# ---------------------------------------------------------------------------- table and picture
def fleet_table(rows):
    """A table as `characterize_fleet` makes it."""
    table, _ = judged(table_of(rows))
    return table


def row(unit, axis, coefficient, value, *, detected=True, outlying=False, group=""):
    return {
        "recording": f"unit_{unit}",
        "file": f"unit_{unit}.csv",
        "group": group,
        "axis": axis,
        "sensor": axis.split("_")[0],
        "coefficient": coefficient,
        "value": value if detected else 0.0,
        "std": 0.05 * value,
        "lower_95": 0.9 * value if detected else 0.0,
        "upper_95": 1.1 * value,
        "unit": "deg/√h",
        "detected": detected,
        "upper_limit_95": 1.08 * value,
        "measured": True,
        "p_value": 0.5,
        "terms": "angle_random_walk",
        "outlying": outlying,
        "warnings": "",
    }


def test_the_table_has_its_types_when_all_has_failed(tmp_path):
    full = fleet_table([row(k, "gyro_x", "angle_random_walk", 1.0 + 0.01 * k) for k in range(4)])
    empty = fleet_table([])
    assert len(empty) == 0
    assert list(empty.columns) == table_schema().names
    assert dict(empty.dtypes) == dict(full.dtypes)
    figure = plot_fleet(empty, tmp_path / "empty.png")
    assert [text.get_text() for text in figure.texts] == ["0 units", "no results"]
    plt.close(figure)


def test_the_picture_has_a_panel_a_coefficient_and_names_odd_units():
    rows = [
        row(k, axis, "angle_random_walk", 1.0 + 0.01 * k) for k in range(8) for axis in ("gyro_x", "gyro_y")
    ]
    rows += [row(8, "gyro_y", "angle_random_walk", 30.0)]
    rows += [row(k, "gyro_x", "bias_instability", 2.0 + 0.1 * k, detected=k < 5) for k in range(8)]
    rows += [row(k, "accel_z", "angle_random_walk", 2.0 + 0.1 * k) for k in range(8)]
    rows += [
        {**row(k, "gyro_x", "markov_correlation_time", 9.0), "lower_95": 9.0, "upper_95": 9.0} for k in (0, 1)
    ]
    figure = plot_fleet(fleet_table(rows))
    panels = {panel.get_title(loc="left"): panel for panel in figure.axes}
    assert list(panels) == [
        "gyros: angle random walk",
        "accelerometers: velocity random walk",
        "gyros: bias instability",
    ]
    walk, instability = panels["gyros: angle random walk"], panels["gyros: bias instability"]
    assert [text.get_text() for text in walk.texts] == ["unit_8"]
    assert [label.get_text() for label in walk.get_xticklabels()] == ["gyro_x", "gyro_y"]
    assert walk.get_yscale() == "log"
    assert not instability.texts
    (limits,) = [line for line in instability.lines if line.get_marker() == "v"]
    np.testing.assert_allclose(limits.get_ydata(), 1.08 * (2.0 + 0.1 * np.arange(5, 8)))
    plt.close(figure)
    with pytest.raises(AllanjaxError, match="column outlying"):
        plot_fleet(fleet_table(rows).drop(columns="outlying"))


def test_the_picture_names_its_axes_units_and_groups():
    groups = ["mems", "mems", "mems", "$tactical$", "$tactical$", "$tactical$"]
    rows = [
        row(k, axis, "angle_random_walk", 1.0 + k, group=group)
        for k, group in enumerate(groups)
        for axis in ("gyro_x", "gyro_y")
    ]
    # Neither an estimate nor a limit: held, and no measurement.
    rows += [{**row(8, "gyro_x", "angle_random_walk", 50.0, group="mems"), "lower_95": None, "std": None}]
    figure = plot_fleet(fleet_table(rows))
    (panel,) = figure.axes
    assert panel.get_ylabel() == "angle random walk [deg/√h]"
    first, facts = (text.get_text() for text in figure.texts)
    assert first == "7 units"
    assert facts.replace("\n", " ") == (
        "none of them outlying; left to right: unit_0, unit_1, unit_2, unit_8 | unit_3, unit_4, unit_5"
    ).replace("$", r"\$")
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels[:2] == ["group mems (4)", r"group \$tactical\$ (3)"]
    # On each axis a group's points, side by side, and its own median.
    points = [c for c in panel.containers if len(c.lines[0].get_xdata())]
    drawn = [(c.lines[0].get_color(), c.lines[0].get_ydata().tolist()) for c in points]
    assert [y for _, y in drawn] == [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]] * 2
    assert drawn[0][0] != drawn[1][0]
    x = np.concatenate([c.lines[0].get_xdata() for c in points[:2]])
    assert np.all(np.diff(x) > 0.0)
    assert x[3] - x[2] > 1.5 * (x[1] - x[0])
    medians = [line.get_ydata()[0] for line in panel.lines if line.get_linewidth() == 1.4]
    assert medians == [2.0, 5.0, 2.0, 5.0]
    plt.close(figure)


def test_the_printed_table_has_two_digits_of_the_scatter():
    values = [1.0, 1.06, 0.94, 1.03, 0.97]
    rows = [row(k, "gyro_x", "angle_random_walk", value) for k, value in enumerate(values)]
    rows += [row(k, "gyro_x", "bias_instability", 12347.0 * v, detected=k < 1) for k, v in enumerate(values)]
    headings, (walk, instability) = cells(fleet_table(rows))
    assert headings[2:] == ("detected", "median ± scatter", "5 … 95 %", "outlying (× median)")
    # Their standard deviation is 0.0474; quantiles are 0.946 and 1.054.
    assert walk[2:] == ("5 of 5", "1.000 ± 0.047 deg/√h", "0.946 … 1.054", "")
    # Of one alone its own error.
    assert instability[2:] == ("1 of 5", "12,350 ± 620 deg/√h", "", "")


@pytest.mark.parametrize("stretch", [{}, {"start": 100.003, "stop": 1_400.0}])
def test_a_long_recording_is_divided_and_put_together(client, tmp_path, stretch):
    """The workers' pieces give what one accumulator of the whole gives."""
    rng = np.random.default_rng(3)
    x = rng.standard_normal((150_000, 1)) + np.cumsum(rng.standard_normal((150_000, 1)), axis=0) * 1e-3
    np.save(tmp_path / "long.npy", x)
    reading = {"rate": 100.0, "gyro_unit": "rad/s", "columns": "gyro_x", **stretch}
    address = client.scheduler.address
    options = {"scheduler": address, "piece": 100_000, **reading}
    result = characterize_fleet(tmp_path / "long.npy", tmp_path / "out", MODEL, **options)
    assert not result.errors
    rows = slice(
        *(int(np.ceil(t * 100.0)) for t in (stretch.get("start", 0.0), stretch.get("stop", 1_500.0)))
    )
    accumulator = AllanAccumulator(100.0, ["gyro_x"])
    accumulator.update(x[rows])
    whole = accumulator.fit(MODEL)["gyro_x"].coefficients
    for label, coefficient in whole.items():
        (row,) = result.table[result.table["coefficient"] == label].to_dict("records")
        scale = coefficient.in_unit(row["unit"]).value / row["value"] if row["detected"] else 1.0
        assert scale == pytest.approx(1.0, rel=1e-9)
        assert row["detected"] == coefficient.detected


def test_pieces_must_be_worth_a_task(tmp_path):
    with pytest.raises(AllanjaxError, match="piece"):
        characterize_fleet(tmp_path / "any.npy", tmp_path / "out", MODEL, piece=10)
