"""Checks of recordings: tables with one thing wrong each, one with nothing wrong; and how long to record."""

import json

import bench
import numpy as np
import pandas as pd
import pytest
from commands import run
from dense_fits import Spectrum, recording
from places import DATA

import allanjax as aj

RATE, N = 100.0, 16_384
GYRO = tuple(f"gyro_{k} [deg/s]" for k in "xyz")
ACCEL = tuple(f"accel_{k} [m/s²]" for k in "xyz")


def clean(n=N, seed=0):
    """White noise and a walk on three gyros and three accelerometers of one who knows what to record."""
    rng = np.random.default_rng(seed)
    table = {"time [s]": np.arange(n) / RATE}
    for label in GYRO:
        walk = np.cumsum(rng.standard_normal(n)) * 0.1 * np.sqrt(3.0) / 30.0 / RATE
        table[label] = 0.1 * rng.standard_normal(n) + walk + 0.2
    for label, level in zip(ACCEL, (0.3, -0.2, 9.79), strict=True):
        table[label] = 0.02 * rng.standard_normal(n) + level
    table["temperature [degC]"] = 25.0 + np.cumsum(rng.standard_normal(n)) * 1e-3
    return pd.DataFrame(table)


def nothing_wrong():
    return bench.once("check of a clean table", lambda: aj.check(clean()))


LINES = """rate, jitter, gaps, repeated samples, resolution, saturation, dead axes, at rest, disturbances,
    accel unit, gyro unit, temperature, length, bandwidth, length for N, length for B, length for K"""


def test_nothing_stops_a_clean_recording():
    found = nothing_wrong()
    assert [line.name for line in found.lines] == [name.strip() for name in LINES.split(",")]
    assert found.stops == ()
    # White noise up to half the rate may be folded there, and B is hidden between N and K.
    looks = {line.name for line in found.lines if line.verdict == "look"}
    assert looks <= {"bandwidth", "length for B", "length for K"}
    assert found.verdict == "look"
    assert "9.797 m/s²" in found["accel unit"].reason
    assert (found.n, found.rate) == (N, pytest.approx(RATE))
    assert found.summary().endswith(f"{17 - len(looks)} of 17 checks are fine")
    document = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert document["recording"] == {"name": "", "n": N, "rate_hz": found.rate, "duration_s": N / found.rate}
    assert [line["verdict"] for line in document["lines"]] == [line.verdict for line in found.lines]


def constant(table):
    table[GYRO[1]] = 0.25


def saturated(table):
    table[GYRO[0]] = np.clip(table[GYRO[0]], None, 0.35)


def held(table):
    """Every second sample repeats the one before, on all axes."""
    for label in GYRO:
        table[label] = np.repeat(table[label].to_numpy()[::2], 2)


def coarse(table):
    table[GYRO[0]] = np.round(table[GYRO[0]] / 1.0) * 1.0


def rounded(table):
    """To steps of 1.25 times the noise."""
    table[ACCEL[0]] = np.round(table[ACCEL[0]] / 0.025) * 0.025


def in_g(table):
    """Numbers in g under a heading of m/s²."""
    table[[*ACCEL]] /= 9.80665


def in_radians(table):
    """Numbers in deg/s under a heading of rad/s."""
    table.columns = [label.replace("deg/s", "rad/s") for label in table.columns]


def moving(table):
    t = table["time [s]"]
    table[GYRO[0]] += 20.0 * np.sin(2.0 * np.pi * 0.3 * t)
    table[GYRO[1]] += 15.0 * np.sin(2.0 * np.pi * 0.2 * t)


def jittering(table):
    """By a tenth of the interval: differences of the stamps then vary by 14 %."""
    table["time [s]"] += np.random.default_rng(1).normal(0.0, 0.1 / RATE, len(table))


def irregular(table):
    table["time [s]"] += np.random.default_rng(1).uniform(-0.45, 0.45, len(table)) / RATE


def gap(table):
    table.loc[len(table) // 2 :, "time [s]"] += 2.0


def knocked(table):
    table.loc[4000:4100, [*ACCEL]] += np.random.default_rng(1).normal(0.0, 1.0, (101, 3))


def warm(table):
    """One gyro follows the temperature, by twice the noise over its range."""
    felt = table["temperature [degC]"] - 25.0
    table[GYRO[0]] += 0.2 / np.ptp(felt) * felt


def temperature_with_holes(table):
    table.loc[100:200, "temperature [degC]"] = np.nan


def short(table):
    return table[:2048]


# The line, its verdict, and numbers or names in its reason.
WRONG = {
    constant: ("dead axes", "stop", "gyro_y: constant, 0.25 deg/s"),
    saturated: ("saturation", "stop", "gyro_x is at 0.35 deg/s"),
    held: ("repeated samples", "look", "gyro_x: 5"),
    coarse: ("resolution", "stop", "1 deg/s"),
    rounded: ("resolution", "look", "0.025 m/s² (accel_x)"),
    in_g: ("accel unit", "stop", "g"),
    in_radians: ("gyro unit", "stop", "--gyro-unit deg/s"),
    moving: ("at rest", "stop", "static"),
    jittering: ("jitter", "look", "14 %"),
    irregular: ("jitter", "stop", "0.00366 s"),
    gap: ("gaps", "stop", "2.01 s"),
    knocked: ("disturbances", "look", "coefficients are of"),
    warm: ("temperature", "look", "gyro_x follows temperature, by 0."),
    temperature_with_holes: ("temperature", "look", "values of temperature are missing"),
    short: ("length", "look", "too short for B and K"),
}


@pytest.mark.parametrize("spoil", WRONG, ids=lambda spoil: spoil.__name__)
def test_one_thing_wrong_is_told_in_its_line(spoil):
    # Of the sensor that it is about.
    table = clean().drop(columns=[*(GYRO if spoil in (rounded, in_g, knocked) else ACCEL)])
    spoilt = spoil(table)
    found = aj.check(table if spoilt is None else spoilt)
    name, verdict, reason = WRONG[spoil]
    assert found[name].verdict == verdict
    assert reason in found[name].reason
    # No other line stops.
    assert [line.name for line in found.stops] == [name] * (verdict == "stop")
    assert nothing_wrong()[name].verdict == "fine"


def test_without_time_stamps_rate_and_gaps_cannot_be_seen():
    found = aj.check(clean(2048).drop(columns="time [s]"), rate=RATE)
    assert {found[name].verdict for name in ("rate", "jitter", "gaps")} == {"look"}
    clock = {"time": np.arange(2048) / RATE}
    line = aj.check(recording(clean(2048)[GYRO[0]].to_numpy(), 50.0, **clock))["rate"]
    assert line.verdict == "stop"
    assert "100 Hz" in line.reason
    assert "50 Hz" in line.reason


def test_the_rate_is_compared_with_the_bandwidth():
    """Of one pole at 18 Hz a rate of 100 Hz is 5.6 times: more than it takes. Of 40 Hz it is too little."""
    line = aj.check(bench.recording("one_pole"))["bandwidth"]
    fit = bench.fit("one_pole")["gyro_x"]
    assert line.verdict == "fine"
    told, _, rest = line.reason.partition(" Hz (gyro_x), the rate is ")
    assert float(told) == pytest.approx(fit.model.response.half_power, rel=5e-3)
    assert float(rest.partition(" times")[0]) == pytest.approx(RATE / float(told), rel=0.02)
    rng = np.random.default_rng(3)
    x, w = np.zeros(N), np.exp(-2.0 * np.pi * 40.0 / RATE)
    for k, z in enumerate(rng.standard_normal(N)):
        x[k] = w * x[k - 1] + (1.0 - w) * z
    assert aj.check(recording(1e-4 * x, RATE))["bandwidth"].verdict == "look"


@pytest.mark.parametrize("unit", [1, 2])
def test_real_sensors_are_not_stopped(unit):
    path = DATA / f"adis16405_unit{unit}.parquet"
    if not path.exists():
        pytest.skip(f"the recordings of real sensors are not here: {path}")
    whole = aj.read(path, rate=100, gyro_unit="deg/s", accel_unit="g").between(0.0, N / 100.0)
    found = aj.check(whole)
    assert {line.verdict for line in found.lines} == {"fine", "look"}
    # A count is 3.33 mg, as in the data sheet.
    assert "0.00333 g" in found["resolution"].reason
    assert found["saturation"].verdict == found["repeated samples"].verdict == "fine"


# --- How long to record -------------------------------------------------------------------------------------


def test_lengths_are_those_of_the_cramer_rao_bound():
    """Fisher's information of the cosine coefficients' dense variances: where it gives 20 %, from whence.

    White noise and a walk have uncorrelated coefficients; the density at their frequencies stands for their
    variances, an approximation by 1/n. Where the fit is worse than the bound at its own length, it stays so.
    """
    rng, n, rate = np.random.default_rng(12), 2048, 10.0
    white, steps = (rng.standard_normal((n, 6)) for _ in range(2))
    x = 0.1 * np.sqrt(rate) * white + 1.6e-2 / np.sqrt(rate) * np.cumsum(steps, axis=0)
    whole = recording(x, rate)
    found = aj.check(whole)
    fit = aj.fit(whole)
    told = {(length.coefficient.axis.name, length.coefficient.label): length for length in found.lengths}
    seen = 0
    for axis, result in fit.items():
        if not set(result.model.term_labels) <= {"angle_random_walk", "rate_random_walk"}:
            continue
        for label in ("angle_random_walk", "rate_random_walk"):
            length, c = told[axis, label], result[label]
            assert length.now == n / rate
            if not c.detected:
                assert np.isnan(length.relative_std)
                size, target = c.upper_limit, 0.2
            else:
                assert length.relative_std == pytest.approx(c.std / c.value, rel=1e-6)
                size = c.value
                if length.known:
                    assert length.relative_std <= 0.2
                    assert length.seconds == length.now
                    continue
                own = bound(result["N"].value, size, n, rate)
                target = 0.2 * min(own / length.relative_std, 1.0)
            if length.seconds is None or length.seconds * rate > 100_000:
                continue
            seen += c.detected
            needed = round(length.seconds * rate)
            assert bound(result["N"].value, size, needed, rate) == pytest.approx(target, rel=0.02)
    # Of walks that are seen, but known to a third only.
    assert seen >= 2


def bound(N_, K, n, rate):
    """Cramér and Rao's relative error of K beside N, of n samples."""
    f = np.arange(1, n) * rate / (2.0 * n)
    h = 1.0 / rate
    # Differences of samples have the covariances N²·(2, −1)/h + K²h·(2/3, 1/6): over their transfer |1 − e|².
    transfer = 2.0 - 2.0 * np.cos(2.0 * np.pi * f * h)
    parts = np.stack(
        [np.full(n - 1, rate) * N_**2, K**2 * h * (2.0 / 3.0 + np.cos(2 * np.pi * f * h) / 3.0) / transfer]
    )
    share = parts / parts.sum(axis=0)
    return np.sqrt(np.linalg.inv(2.0 * share @ share.T)[1, 1])


def test_the_bound_here_is_the_dense_one():
    """Variances of cosine coefficients by the dense covariance."""
    n, rate, model = 200, 10.0, aj.AngleRandomWalk(0.1) + aj.RateRandomWalk(0.02)
    dense = Spectrum(np.arange(n, dtype=float), rate, np.arange(1, n + 1))
    F = dense.information(model, list(model.values))
    assert bound(0.1, 0.02, n, rate) == pytest.approx(np.sqrt(np.linalg.inv(F)[1, 1]), rel=0.02)


@pytest.mark.usefixtures("elsewhere")
def test_the_command_exits_with_1_if_a_file_is_bad_and_the_others_go_on():
    clean(2048).to_csv("short.csv", index=False)
    spoilt = clean(2048)
    gap(spoilt)
    spoilt.to_csv("gap.csv", index=False)
    result = run("check", "gap.csv", "short.csv", "missing.csv", "--json")
    assert result.exit_code == 1
    document = json.loads(result.stdout)
    assert [(c["file"], c["verdict"]) for c in document["checks"]] == [
        ("gap.csv", "stop"),
        ("short.csv", "look"),
    ]
    assert [e["file"] for e in document["errors"]] == ["missing.csv"]
