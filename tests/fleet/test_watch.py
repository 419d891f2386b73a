"""A record that grows: the numbers of a record that has ended, pieces, forecasts, and the command."""

import io
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from functools import partial

import numpy as np
import pytest
from commands import run

import allanjax as aj

RATE = 100.0
HEADER = "time [s],gyro_x [deg/s],accel_x [g]\n"
posix = pytest.mark.skipif(sys.platform == "win32", reason="pipes and signals of POSIX")


def rows(samples, times=None):
    times = np.arange(len(samples)) / RATE if times is None else times
    table = io.StringIO()
    np.savetxt(table, np.column_stack([times, samples]), fmt="%.9g", delimiter=",")
    return table.getvalue().splitlines(keepends=True)


def noise(n, seed=0):
    """White noise of 0.02 deg/s and 0.2 mg, and a random walk in the accelerometer."""
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((n, 2)) * [0.02, 2e-4] + [0.1, 1.0]
    x[:, 1] += 4e-6 * np.cumsum(rng.standard_normal(n))
    return x


@pytest.fixture
def pipe(tmp_path):
    """Begins to write lines into a named pipe, in pieces that do not end with lines; returns its path."""

    def filled(lines):
        path = tmp_path / "pipe"
        os.mkfifo(path)
        sent = "".join([HEADER, *lines]).encode() + b"half a line"

        def write():
            # The command may end before its input does.
            with suppress(BrokenPipeError), path.open("wb", buffering=0) as stream:
                for first in range(0, len(sent), 9_973):
                    stream.write(sent[first : first + 9_973])

        threading.Thread(target=write, daemon=True).start()
        return path

    return filled


def result(done):
    (document,) = json.loads(done.stdout)["fits"]
    return document


def by_label(axis):
    return {c["label"]: c for c in axis["coefficients"]}


@posix
def test_the_numbers_are_those_of_a_record_that_has_ended(pipe, tmp_path):
    lines = rows(noise(20_000))
    (tmp_path / "log.csv").write_text(HEADER + "".join(lines))
    done = run("watch", pipe(lines), "--json")
    assert (done.exit_code, "warning: pipe" in done.stderr) == (0, False)
    whole = aj.fit(tmp_path / "log.csv")
    document = result(done)
    assert document["recording"]["n"] == whole.curve.n == 20_000
    for axis in document["axes"]:
        ours, theirs = by_label(axis), whole[axis["name"]].coefficients
        assert list(ours) == list(theirs)
        for label, c in theirs.items():
            assert ours[label]["detected"] == c.detected
            if c.detected:
                # The spectrum of a stream is averaged over segments: 0.2 of the standard deviation is asked.
                assert abs(ours[label]["si"]["value"] - c.value) < 0.2 * c.std
                assert ours[label]["si"]["std"] == pytest.approx(c.std, rel=0.2)


@posix
def test_gaps_and_disturbances_begin_a_new_piece_and_the_longest_counts(pipe):
    n = 70_000
    samples, times = noise(n), np.arange(n) / RATE
    # Two seconds are missing at 40 s, while the logger starts; at 600 s someone knocks for 0.5 s.
    times[4_000:] += 2.0
    samples[60_000:60_050] += np.random.default_rng(1).standard_normal((50, 2)) * [5.0, 0.3]
    # A batch has at most 256 kB, some 8,000 lines.
    done = run("watch", pipe(rows(samples, times)), "--terms", "N + K", "--json")
    assert done.exit_code == 0, done.stderr
    said = [line for line in done.stderr.splitlines() if "a new piece of the record begins here" in line]
    # The end of the knock is one more if a batch happens to end within it.
    assert len(said) in (2, 3)
    assert "gap of 2.01 s" in said[0]
    # A piece ends with the last batch before the gap or the knock, and begins after it.
    document = result(done)
    assert 56_000 - 3 * 9_000 < document["recording"]["n"] < 56_000
    # White noise of 0.02 deg/s at 100 Hz, to four standard deviations of its N.
    c = by_label(document["axes"][0])["angle_random_walk"]["si"]
    assert abs(c["value"] - np.deg2rad(0.02) / RATE**0.5) < 4 * c["std"]


@posix
def test_lines_that_are_no_samples_are_refused(pipe):
    done = run("watch", pipe(["nothing\n"] * 300), "--json")
    assert done.exit_code == 1
    assert "no row of numbers" in done.stderr


def test_a_file_is_watched_while_it_grows(tmp_path):
    path, lines, ended = tmp_path / "log.csv", rows(noise(200_000)), threading.Event()
    path.write_text(HEADER + "".join(lines[:1_000]) + lines[1_000][:7])

    def grow():
        text = lines[1_000][7:] + "".join(lines[1_001:])
        with path.open("a") as stream:
            for first in range(0, len(text), 20_011):
                stream.write(text[first : first + 20_011])
                stream.flush()
                if ended.wait(0.1):
                    break

    logger = threading.Thread(target=grow)
    logger.start()
    # 1,000 samples tell N to some 3 %, 200,000 to 0.2 %: white noise has a relative error of (2n)**-0.5.
    done = run("watch", path, "--until", "N 1 %", "--terms", "N + K", "--json", "--every", "0.1")
    ended.set()
    logger.join()
    assert done.exit_code == 0, done.stderr
    assert 5_000 < result(done)["recording"]["n"] < 200_000
    assert "a new piece" not in done.stderr


@pytest.mark.parametrize("text", ["B", "B ten %", "Q 10 %", "B 0 %", "10 %"])
def test_other_words_are_no_aim(text, elsewhere):
    done = run("watch", "log.csv", "--until", text)
    assert done.exit_code == 1
    assert "'B 10 %'" in done.stderr


@posix
def test_the_forecast_comes_true(pipe, elsewhere):
    """The predicted length gives the standard deviation that was asked for."""
    x = noise(40_000, 3)
    done = run("watch", pipe(rows(x[:2_000])), "--terms", "N + B + K", "--columns", "time,gyro_x")
    (more,) = re.findall(r"N to 1 % in about ([\d.]+) s more", done.stdout)
    n = 2_000 + round(float(more) * RATE)
    recording = aj.Recording.from_array(x[:n, :1], RATE, gyro_unit="deg/s", names=["gyro_x"])
    c = aj.fit(recording, "N + B + K")["gyro_x"]["N"]
    # The forecast is made from one draw of 2,000 samples, for lengths in steps.
    assert c.std / c.value == pytest.approx(0.01, rel=0.3)


@posix
def test_the_command_ends_when_the_aim_is_reached(pipe, tmp_path):
    words = ("--until", "N 2 %", "--terms", "N + K", "--out", tmp_path / "out", "--json")
    done = run("watch", pipe(rows(noise(20_000))), *words)
    assert done.exit_code == 0, done.stderr
    for axis in result(done)["axes"]:
        c = by_label(axis)["angle_random_walk"]["si"]
        assert c["std"] <= 0.02 * c["value"]
    assert "N known to 2 %" in done.stderr
    # What a stream leaves out is told without advice for files: a pipe is read only once.
    (fact,) = [fact for fact in result(done)["facts"] if fact["kind"] == "not examined"]
    assert fact["text"].startswith("not examined in a stream: outliers")
    assert "--start" not in done.output
    assert {"pipe.json", "pipe_allan.png"} <= {path.name for path in (tmp_path / "out").iterdir()}


@posix
def test_a_record_that_ends_too_early_has_an_exit_code(pipe, elsewhere):
    done = run("watch", pipe(rows(noise(20_000))), "--until", "B 1 %", "--terms", "N + K")
    assert done.exit_code == 3
    assert "before B 1 % was reached" in done.stderr
    assert "B is not among the terms" in done.stdout


def test_a_file_that_is_not_there_is_an_error(tmp_path, elsewhere):
    done = run("watch", tmp_path / "none.csv")
    assert done.exit_code == 1
    assert "none.csv" in done.stderr


@posix
def test_the_first_interrupt_ends_with_the_result(tmp_path):
    """A logger prints lines of `ros2 topic echo --csv` and goes on."""
    gravity = np.array([0.0, 0.0, 9.81])
    about = "0.0," * 3 + "1.0," + "0.0," * 9
    x = np.random.default_rng(0).standard_normal((6_000, 6)) * [*[1e-3] * 3, *[1e-2] * 3]
    lines = [
        f"{k // 100},{k % 100 * 10_000_000},imu,{about}"
        + ",".join(f"{value:.9f}" for value in sample[:3])
        + ",0.0" * 9
        + ","
        + ",".join(f"{value:.9f}" for value in sample[3:] + gravity)
        + ",0.0" * 9
        + "\n"
        for k, sample in enumerate(x)
    ]
    heed = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    words = [sys.executable, "-m", "allanjax", "watch", "-", "--out", tmp_path, "--every", "1"]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    watching = subprocess.Popen([*words, "--terms", "N"], preexec_fn=heed, **pipes)
    watching.stdin.write("".join(lines).encode())
    watching.stdin.flush()
    shown = b""
    while b"to 1 %" not in shown:
        shown += watching.stdout.readline()
    time.sleep(0.5)
    watching.send_signal(signal.SIGINT)
    out, err = watching.communicate()
    assert watching.returncode == 0, err
    text = (shown + out).decode()
    assert re.search(r"stdin: 6,000 samples at 100 Hz", text)
    saved = json.loads((tmp_path / "stdin.json").read_text())
    by_name = {axis["name"]: axis["coefficients"][0] for axis in saved["axes"]}
    assert len(by_name) == 6
    # 1e-3 rad/s at 100 Hz, to four of its standard deviations.
    c = by_name["gyro_y"]["si"]
    assert abs(c["value"] - 1e-4) < 4 * c["std"]
