"""Checks of recordings: tables with one thing wrong each, one with nothing wrong; and how long to record."""

import json

import bench
import numpy as np
import pandas as pd
import pytest
from dense_fits import recording
from scipy.signal import lfilter
from white_and_walk import bound

import allanjax as aj

RATE, N = 100.0, 16_384
TIME, WARM = "time [s]", "temperature [degC]"
GYRO = tuple(f"gyro_{k} [deg/s]" for k in "xyz")
ACCEL = tuple(f"accel_{k} [m/s²]" for k in "xyz")


def clean(n=N, seed=0):
    """White noise and a walk on three gyros and three accelerometers of one who knows what to record."""
    rng = np.random.default_rng(seed)
    table = {TIME: np.arange(n) / RATE}
    for label in GYRO:
        walk = np.cumsum(rng.standard_normal(n)) * 0.1 * np.sqrt(3.0) / 30.0 / RATE
        table[label] = 0.1 * rng.standard_normal(n) + walk + 0.2
    for label, level in zip(ACCEL, (0.3, -0.2, 9.79), strict=True):
        table[label] = 0.02 * rng.standard_normal(n) + level
    table[WARM] = 25.0 + np.cumsum(rng.standard_normal(n)) * 1e-3
    return pd.DataFrame(table)


def nothing_wrong():
    return bench.once("check of a clean table", lambda: aj.check(clean()))


def test_nothing_stops_a_clean_recording():
    found = nothing_wrong()
    assert found.stops == ()
    # White noise up to half the rate may be folded there, and B is hidden between N and K.
    looks = {line.name for line in found.lines if line.verdict == "look"}
    assert looks <= {"bandwidth", "length for B", "length for K"}
    assert found.verdict == "look"
    assert "9.797 m/s²" in found["accel unit"].reason
    assert (found.n, found.rate) == (N, pytest.approx(RATE))
    assert found.summary().endswith(f"{20 - len(looks)} of 20 checks are fine")
    document = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert document["recording"] == {"name": "", "n": N, "rate_hz": found.rate, "duration_s": N / found.rate}
    assert [line["verdict"] for line in document["lines"]] == [line.verdict for line in found.lines]


RNG, (X, Y), A = np.random.default_rng, GYRO[:2], ACCEL[0]
t = np.arange(N) / RATE
KNOCK = (abs(t - 40.5) <= 0.5) * RNG(1).normal(size=N)
# What spoils a table, the line that says so, its verdict, and numbers or names in its reason. Every second
# sample repeats the one before; rounding is to 1.25 times the noise; jitter of a tenth of the interval makes
# differences of stamps vary by 14 %; a gyro follows the temperature by twice the noise over its range.
WRONG = {
    "constant": (lambda d: {Y: 0.25}, "dead axes", "stop", "gyro_y: constant at 0.25 deg/s"),
    "saturated": (lambda d: {X: np.clip(d[X], None, 0.35)}, "saturation", "stop", "gyro_x is at 0.35 deg/s"),
    "held": (lambda d: {X: d[X][::2].repeat(2).array}, "repeated samples", "look", "gyro_x: 5"),
    "coarse": (lambda d: {X: np.round(d[X])}, "resolution", "stop", "1 deg/s"),
    "rounded": (lambda d: {A: np.round(d[A] / 0.025) * 0.025}, "resolution", "look", "0.025 m/s²"),
    "in g": (lambda d: {k: d[k] / 9.80665 for k in ACCEL}, "accel unit", "stop", "g"),
    "rad/s": (lambda d: d.rename(columns=lambda k: k.replace("deg/", "rad/")), "gyro unit", "stop", "deg/s"),
    "moving": (lambda d: {X: d[X] + 20.0 * np.sin(1.9 * t)}, "at rest", "stop", "static"),
    "jittering": (lambda d: {TIME: t + RNG(1).normal(0.0, 1e-3, N)}, "jitter", "look", "14 %"),
    "irregular": (lambda d: {TIME: t + RNG(1).uniform(-0.45, 0.45, N) / RATE}, "jitter", "look", "evenly"),
    "gap": (lambda d: {TIME: t + 2.0 * (t >= 81.92)}, "gaps", "stop", "2.01 s"),
    "knocked": (lambda d: {k: d[k] + KNOCK for k in ACCEL}, "disturbances", "look", "from 0.0–39.8 s"),
    "warm": (lambda d: {X: d[X] + 0.2 * (d[WARM] - 25.0) / np.ptp(d[WARM])}, "temperature", "look", "gyro_x"),
    "holes": (lambda d: {WARM: d[WARM].where(abs(t - 1.5) > 0.5)}, "temperature", "look", "are missing"),
    "short": (lambda d: d[:2048], "length", "look", "too short for B and K"),
}  # fmt: skip


@pytest.mark.parametrize("what", WRONG)
def test_one_thing_wrong_is_reported_in_its_line(what):
    spoil, name, verdict, reason = WRONG[what]
    table = clean().drop(columns=[*(GYRO if what in ("rounded", "in g", "knocked") else ACCEL)])
    spoilt = spoil(table)
    found = aj.check(table.assign(**spoilt) if isinstance(spoilt, dict) else spoilt)
    assert found[name].verdict == verdict
    assert reason in found[name].reason
    # No other line stops; in the table it comes first, in 100 columns, and all that is fine is one line.
    assert [line.name for line in found.stops] == [name] * (verdict == "stop")
    table = [line for line in str(found).splitlines() if "─" not in line]
    assert (" stop " in table[2]) == (verdict == "stop")
    assert max(map(len, table)) <= 100
    assert sum(line.startswith("fine: ") for line in table) == 1
    assert nothing_wrong()[name].verdict == "fine"


def test_without_time_stamps_rate_and_gaps_cannot_be_checked():
    found = aj.check(clean(2048).drop(columns=TIME), rate=RATE)
    assert {found[name].verdict for name in ("rate", "jitter", "gaps")} == {"look"}
    line = aj.check(recording(clean(2048)[X], 50.0, time=t[:2048]))["rate"]
    assert line.verdict == "stop"
    assert ("100 Hz" in line.reason, "50 Hz" in line.reason) == (True, True)


def test_the_rate_is_compared_with_the_bandwidth():
    """Of one pole at 18 Hz a rate of 100 Hz is 5.6 times: more than it takes. Of 40 Hz it is too little."""
    # By bands of a quarter of an octave and their scatter.
    line = aj.check(bench.recording("one_pole"))["bandwidth"]
    assert line.verdict == "fine"
    width, _, rest = line.reason.partition(" Hz (gyro_x); the rate is ")
    assert float(width) == pytest.approx(18.0, rel=0.08)
    assert float(rest.partition(" times")[0]) == pytest.approx(RATE / float(width), rel=0.02)
    w, z = np.exp(-0.8 * np.pi), np.random.default_rng(3).standard_normal(N)
    x = 1e-4 * lfilter([1.0 - w], [1.0, -w], z)
    assert aj.check(recording(x, RATE))["bandwidth"].verdict == "look"


def test_lengths_are_those_of_the_cramer_rao_bound():
    """Where Fisher's information about white noise and a walk gives 20 %, from whence."""
    # Where the fit is worse than the bound at its own length, it stays so.
    rng, n, rate, N = np.random.default_rng(12), 2048, 10.0, 1e-5
    white, steps = (rng.standard_normal((n, 6)) for _ in range(2))
    whole = recording(N * (np.sqrt(rate) * white + 0.16 / np.sqrt(rate) * np.cumsum(steps, axis=0)), rate)
    lengths = aj.check(whole).lengths
    poor = 0
    for white_noise, flicker, walk in zip(lengths[::3], lengths[1::3], lengths[2::3], strict=True):
        assert white_noise.known
        assert white_noise.coefficient.value == pytest.approx(N, abs=4.0 * white_noise.coefficient.std)
        if flicker.coefficient.detected or not walk.coefficient.detected:
            continue
        assert (walk.now, walk.known) == (n / rate, walk.relative_std <= 0.2)
        pair = white_noise.coefficient.value, walk.coefficient.value
        own = bound(*pair, (n,), rate)[1] / pair[1]
        # Flicker noise, which may be there, makes it up to some times as large.
        assert 0.9 * own < walk.relative_std < 4.0 * own
        if not walk.known and walk.seconds is not None:
            poor += 1
            needed = bound(*pair, (round(walk.seconds * rate),), rate)[1] / pair[1]
            assert needed == pytest.approx(0.2 * own / walk.relative_std, rel=0.02)
    # Of walks that are detected, but known to a third only.
    assert poor >= 2
