"""Checks of recordings: files with one thing wrong each, and one with nothing wrong."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from commands import run
from places import DATA

import allanjax as aj
from allanjax.base.errors import AllanjaxError, RecordingError, UnitError
from allanjax.estimate.check import check_of, unreadable
from allanjax.inspection.checklist import _following, lines_of

RATE, N = 100.0, 20_000
GYRO = tuple(f"gyro_{k} [deg/s]" for k in "xyz")
ACCEL = tuple(f"accel_{k} [m/s²]" for k in "xyz")


def clean(seed: int = 0) -> pd.DataFrame:
    """White noise and a walk on three gyros and three accelerometers of one who knows what to record."""
    rng = np.random.default_rng(seed)
    table = {"time [s]": np.arange(N) / RATE}
    for label in GYRO:
        walk = np.cumsum(rng.standard_normal(N)) * 0.1 * np.sqrt(3.0) / 30.0 / RATE
        table[label] = 0.1 * rng.standard_normal(N) + walk + 0.2
    for label, level in zip(ACCEL, (0.3, -0.2, 9.79), strict=True):
        table[label] = 0.02 * rng.standard_normal(N) + level
    table["temperature [degC]"] = 25.0 + np.cumsum(rng.standard_normal(N)) * 1e-3
    return pd.DataFrame(table)


def checked(table: pd.DataFrame, tmp_path: Path, **reading: float) -> aj.Check:
    """Check of a file with this table, without the lines that need a fit."""
    table.to_csv(tmp_path / "imu.csv", index=False)
    try:
        recording = aj.read(tmp_path / "imu.csv", **reading)
    except RecordingError as error:
        return unreadable(error, "imu")
    return check_of(recording, aj.inspect(recording), None, "it was not fitted")


@pytest.fixture(scope="module")
def nothing_wrong(tmp_path_factory: pytest.TempPathFactory) -> aj.Check:
    path = tmp_path_factory.mktemp("clean") / "imu.csv"
    clean().to_csv(path, index=False)
    return aj.check(path)


LINES = """rate, jitter, gaps, repeated samples, resolution, saturation, dead axes, at rest, disturbances,
    accel unit, gyro unit, temperature, length, bandwidth, length for N, length for B, length for K"""


def test_nothing_stops_a_clean_recording(nothing_wrong: aj.Check) -> None:
    assert [line.name for line in nothing_wrong.lines] == [name.strip() for name in LINES.split(",")]
    assert nothing_wrong.stops == ()
    # White noise up to half the rate may be folded there, and B is hidden between N and K.
    looks = {line.name for line in nothing_wrong.lines if line.verdict == "look"}
    assert looks <= {"bandwidth", "length for B", "length for K"}
    assert nothing_wrong.verdict == "look"
    assert nothing_wrong["accel unit"].reason == "the mean is 9.797 m/s², 0.1 % off gravity"
    assert nothing_wrong["temperature"].reason.startswith("temperature varies by ")
    assert nothing_wrong["length for N"].reason.endswith("%, other axes better")


def constant(table: pd.DataFrame) -> None:
    table[GYRO[1]] = 0.25


def saturated(table: pd.DataFrame) -> None:
    table[GYRO[0]] = np.clip(table[GYRO[0]], None, 0.35)


def held(table: pd.DataFrame) -> None:
    """Every second sample repeats the one before, on all axes."""
    for label in (*GYRO, *ACCEL):
        table[label] = np.repeat(table[label].to_numpy()[::2], 2)


def coarse(table: pd.DataFrame) -> None:
    table[GYRO[0]] = np.round(table[GYRO[0]] / 1.0) * 1.0


def rounded(table: pd.DataFrame) -> None:
    """To steps of 1.25 times the noise."""
    table[ACCEL[0]] = np.round(table[ACCEL[0]] / 0.025) * 0.025


def in_g(table: pd.DataFrame) -> None:
    """Numbers in g under a heading of m/s²."""
    table[[*ACCEL]] /= 9.80665


def in_radians(table: pd.DataFrame) -> None:
    """Numbers in deg/s under a heading of rad/s."""
    table.columns = [label.replace("deg/s", "rad/s") for label in table.columns]


def moving(table: pd.DataFrame) -> None:
    t = table["time [s]"]
    table[GYRO[0]] += 20.0 * np.sin(2.0 * np.pi * 0.3 * t)
    table[GYRO[1]] += 15.0 * np.sin(2.0 * np.pi * 0.2 * t)


def jittering(table: pd.DataFrame) -> None:
    """By a tenth of the interval: differences of the stamps then vary by 14 %."""
    table["time [s]"] += np.random.default_rng(1).normal(0.0, 0.1 / RATE, N)


def irregular(table: pd.DataFrame) -> None:
    table["time [s]"] += np.random.default_rng(1).uniform(-0.45, 0.45, N) / RATE


def gap(table: pd.DataFrame) -> None:
    table.loc[N // 2 :, "time [s]"] += 2.0


def knocked(table: pd.DataFrame) -> None:
    table.loc[4000:4100, [*ACCEL]] += np.random.default_rng(1).normal(0.0, 1.0, (101, 3))


def warm(table: pd.DataFrame) -> None:
    """One gyro follows the temperature, by twice the noise over its range."""
    felt = table["temperature [degC]"] - 25.0
    table[GYRO[0]] += 0.2 / np.ptp(felt) * felt


def temperature_with_holes(table: pd.DataFrame) -> None:
    table.loc[100:200, "temperature [degC]"] = np.nan


def short(table: pd.DataFrame) -> pd.DataFrame:
    return table[:3000]


WRONG = {
    constant: ("dead axes", "stop", "gyro_y: constant, 0.25 deg/s throughout"),
    saturated: ("saturation", "stop", "gyro_x is at 0.35 deg/s in "),
    held: ("repeated samples", "look", "gyro_x: 53 % of its samples repeat the one before"),
    coarse: ("resolution", "stop", "its noise is below its resolution of 1 deg/s"),
    rounded: ("resolution", "look", "counts of 0.025 m/s² (accel_x) or more: rounding is part"),
    in_g: ("accel unit", "stop", "their unit is probably g"),
    in_radians: ("gyro unit", "stop", "are they deg/s? --gyro-unit deg/s"),
    moving: ("at rest", "stop", "this does not look like a static recording"),
    jittering: ("jitter", "look", "% of the interval: samples are taken as evenly spaced"),
    irregular: ("jitter", "stop", "is irregular: the mean interval is 0.0"),
    gap: ("gaps", "stop", "has a gap of 2.01 s"),
    knocked: ("disturbances", "look", "coefficients are of "),
    warm: ("temperature", "look", "gyro_x follows temperature, by 0."),
    temperature_with_holes: ("temperature", "look", "values of temperature are missing"),
    short: ("length", "look", "30 s: too short for B and K"),
}


@pytest.mark.parametrize("spoil", WRONG, ids=lambda spoil: spoil.__name__)
def test_one_thing_wrong_is_told_in_its_line(spoil, tmp_path: Path, nothing_wrong: aj.Check) -> None:
    table = clean()
    spoilt = spoil(table)
    found = checked(table if spoilt is None else spoilt, tmp_path)
    name, verdict, reason = WRONG[spoil]
    assert found[name].verdict == verdict
    assert reason in found[name].reason
    # No other line stops.
    assert [line.name for line in found.stops] == [name] * (verdict == "stop")
    assert nothing_wrong[name].verdict == "fine"


def test_without_time_stamps_rate_and_gaps_cannot_be_seen(tmp_path: Path) -> None:
    found = checked(clean().drop(columns="time [s]"), tmp_path, rate=RATE)
    assert {found[name].verdict for name in ("rate", "jitter", "gaps")} == {"look"}
    assert found["rate"].reason == "100 Hz as given: without time stamps it cannot be checked"


def test_a_rate_that_a_column_contradicts_stops() -> None:
    clock = {"time": np.arange(N) / RATE}
    recording = aj.Recording.from_array(clean()[[*GYRO]].to_numpy(), 50.0, gyro_unit="deg/s", auxiliary=clock)
    line = aj.check(recording)["rate"]
    assert line.verdict == "stop"
    assert "100 Hz if in s, and the rate given is 50 Hz" in line.reason


@pytest.mark.parametrize(("bandwidth", "ratio", "verdict"), [(40.0, 2.5, "look"), (10.0, 10.0, "fine")])
def test_the_rate_is_compared_with_the_bandwidth(bandwidth: float, ratio: float, verdict: str) -> None:
    model = aj.LowPass1(bandwidth) * aj.AngleRandomWalk(1e-4)
    recording = aj.simulate_recording({"gyro_x": model}, 60_000, RATE, 3)
    line = aj.check(recording)["bandwidth"]
    assert line.verdict == verdict
    told, _, rest = line.reason.partition(" Hz (gyro_x), the rate is ")
    assert float(told) == pytest.approx(bandwidth, rel=0.1)
    assert float(rest.partition(" times")[0]) == pytest.approx(ratio, rel=0.1)
    assert "three to five times" in line.reason


def test_walks_do_not_seem_to_follow_a_temperature_that_walks() -> None:
    """Two walks have a large correlation nearly always: of 200 axes less than 1 % may be said to follow."""
    rng = np.random.default_rng(2)
    said = 0
    for _ in range(200):
        x, z = np.cumsum(rng.standard_normal((2, 2048)), axis=1)
        recording = aj.Recording.from_array(x, RATE, gyro_unit="deg/s")
        said += len([*_following(recording, "temperature", z)])
    # 1 % is expected: more than 6 of 200 has a chance of 0.4 %.
    assert said <= 6


def test_a_check_is_printed_and_written(nothing_wrong: aj.Check) -> None:
    document = json.loads(json.dumps(nothing_wrong.to_dict(), allow_nan=False))
    assert document["recording"] == {"name": "imu", "n": N, "rate_hz": 100.0, "duration_s": 200.0}
    assert [line["name"] for line in document["lines"]] == [line.name for line in nothing_wrong.lines]
    assert {entry["coefficient"] for entry in document["lengths"]} == {
        "angle_random_walk",
        "bias_instability",
        "rate_random_walk",
    }
    assert str(nothing_wrong).startswith("imu: 20,000 samples at 100 Hz (200 s)")
    assert "repeated samples" in nothing_wrong._repr_html_()
    fine = sum(line.verdict == "fine" for line in nothing_wrong.lines)
    assert nothing_wrong.summary().endswith(f"{fine} of 17 checks are fine")
    with pytest.raises(AllanjaxError, match="no line 'color'; there are rate, jitter"):
        nothing_wrong["color"]


def test_what_is_no_recording_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no such file"):
        aj.check(tmp_path / "nothing.csv")
    with pytest.raises(UnitError, match="has no unit"):
        aj.check(clean().rename(columns={GYRO[0]: "gyro_x"}))


@pytest.mark.parametrize("unit", [1, 2])
def test_real_sensors_are_not_stopped(unit: int) -> None:
    recording = aj.read(DATA / f"adis16405_unit{unit}.parquet", rate=100, gyro_unit="deg/s", accel_unit="g")
    lines = {line.name: line for line in lines_of(recording, aj.inspect(recording))}
    assert {line.verdict for line in lines.values()} == {"fine", "look"}
    # A count is 3.33 mg, as in the data sheet.
    assert "counts of 0.00333 g" in lines["resolution"].reason
    assert lines["saturation"].verdict == lines["repeated samples"].verdict == "fine"


@pytest.mark.usefixtures("elsewhere")
class TestCommand:
    def test_a_clean_file_exits_with_0(self, tmp_path: Path) -> None:
        clean().to_csv("imu.csv", index=False)
        result = run("check", "imu.csv", "--json")
        assert (result.exit_code, result.stderr) == (0, "")
        document = json.loads(result.stdout)
        assert document["errors"] == []
        (found,) = document["checks"]
        assert (found["file"], found["verdict"]) == ("imu.csv", "look")
        assert not (tmp_path / "allanjax-results").exists()

    def test_a_bad_file_exits_with_1_and_the_others_go_on(self) -> None:
        table = clean()
        gap(table)
        table.to_csv("gap.csv", index=False)
        clean().iloc[:3000].to_csv("short.csv", index=False)
        result = run("check", "gap.csv", "short.csv", "missing.csv")
        assert result.exit_code == 1
        assert "gap: cannot be read as a recording" in result.stdout
        assert "has a gap of 2.01 s" in result.stdout.replace("\n", " ")
        assert "short: 3,000 samples at 100 Hz (30 s)" in result.stdout
        assert result.stderr.startswith("error: missing.csv")
