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
from functools import partial

import numpy as np
import pytest
from commands import run

import allanjax as aj
from allanjax.fleet.options import FitOptions
from allanjax.fleet.watch import Aim, Watch, lines_of

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


def in_batches(lines, size=1500):
    for first in range(0, len(lines), size):
        yield "".join(lines[first : first + size]).encode()


def watched(lines, model=None, size=1500):
    said = []
    watch = Watch(in_batches([HEADER, *lines], size), FitOptions(model=model), "log.csv", said.append)
    return list(watch.fits()), watch.longest, said


def test_the_numbers_are_those_of_a_record_that_has_ended(tmp_path):
    lines = rows(noise(20_000))
    path = tmp_path / "log.csv"
    path.write_text(HEADER + "".join(lines))
    fits, longest, said = watched(lines)
    whole = aj.fit(path)
    assert said == []
    assert longest is fits[-1]
    assert longest.curve.n == whole.curve.n == 20_000
    for axis in whole:
        ours, theirs = longest[axis].coefficients, whole[axis].coefficients
        assert list(ours) == list(theirs)
        for name, c in theirs.items():
            if c.detected:
                # The spectrum of a stream is averaged over segments: 0.2 of the standard deviation is asked.
                assert abs(ours[name].value - c.value) < 0.2 * c.std
                assert ours[name].std == pytest.approx(c.std, rel=0.2)


def test_gaps_and_disturbances_begin_a_new_piece_and_the_longest_counts():
    n = 24_000
    samples, times = noise(n), np.arange(n) / RATE
    # Two seconds are missing at 40 s; at 200 s someone knocks for 0.5 s.
    times[4_000:] += 2.0
    samples[20_000:20_050] += np.random.default_rng(1).standard_normal((50, 2)) * [5.0, 0.3]
    fits, longest, said = watched(rows(samples, times), "N")
    assert len(said) == 2
    assert "gap of 2.01 s" in said[0]
    assert all(text.endswith("a new piece of the record begins here") for text in said)
    # A piece ends with the last batch of 1,500 lines before the gap or the knock, and begins after it.
    assert fits[0].curve.n < 4_000
    assert 20_000 - 4_000 - 4 * 1_500 < longest.curve.n < 20_000 - 4_000
    # White noise of 0.02 deg/s at 100 Hz, to four standard deviations of its N.
    c = longest["gyro_x"]["N"]
    assert abs(c.in_unit("deg/√s").value - 0.02 / RATE**0.5) < 4 * c.in_unit("deg/√s").std


def test_lines_before_the_samples_are_refused():
    with pytest.raises(aj.RecordingError, match=r"log\.csv"):
        watched(["1,2,3\n"] * 10 + ["nothing\n"] * 300)


def test_whole_lines_come_from_a_pipe():
    sent = "".join(f"{k} {'x' * (k % 50)}\n" for k in range(5_000)).encode()
    receiver, sender = os.pipe()

    def send():
        with os.fdopen(sender, "wb", buffering=0) as pipe:
            for first in range(0, len(sent), 997):
                pipe.write(sent[first : first + 997])
            pipe.write(b"half a line")

    threading.Thread(target=send).start()
    with os.fdopen(receiver, "rb", buffering=0) as pipe:
        batches = list(lines_of(pipe, False, 0.01, lambda: False))
    assert b"".join(batches) == sent
    assert all(batch.endswith(b"\n") for batch in batches)
    assert batches[0].count(b"\n") >= 200


def test_lines_come_while_a_file_grows_and_end_on_request(tmp_path):
    path, stop = tmp_path / "log.csv", threading.Event()
    path.write_bytes(b"a\n" * 300 + b"b")
    batches = []
    with path.open("rb", buffering=0) as stream:
        for batch in lines_of(stream, True, 0.05, stop.is_set):
            batches.append(batch)
            if len(batches) == 1:
                with path.open("ab") as more:
                    more.write(b"c\nd")
            else:
                stop.set()
    assert batches == [b"a\n" * 300, b"bc\n"]


def test_a_file_that_becomes_shorter_is_an_error(tmp_path):
    path = tmp_path / "log.csv"
    path.write_bytes(b"a\n" * 300)
    with path.open("rb", buffering=0) as stream:
        lines = lines_of(stream, True, 0.05, lambda: False)
        next(lines)
        path.write_bytes(b"a\n")
        with pytest.raises(aj.RecordingError, match="shorter"):
            next(lines)


@pytest.mark.parametrize("text", ["B", "B ten %", "Q 10 %", "B 0 %", "10 %"])
def test_other_words_are_no_aim(text):
    with pytest.raises(aj.AllanjaxError, match="B 10 %"):
        Aim.parse(text)


def test_the_forecast_comes_true():
    """The predicted length gives the standard deviation that was asked for."""
    aim, x = Aim.parse("N 1%"), noise(40_000, 3)[:, :1]

    def fitted(n):
        return aj.fit(aj.Recording.from_array(x[:n], RATE, gyro_unit="deg/s", names=["gyro_x"]), "N + B")

    short = fitted(2_000)
    seconds = aim.seconds(short)
    assert seconds > 20.0
    assert aim.words(short, seconds).startswith("N to 1 % in about ")
    n = round(seconds * RATE)
    c = fitted(n)["gyro_x"]["N"]
    # The forecast is made from one draw of 2,000 samples, for lengths in steps.
    assert c.std / c.value == pytest.approx(0.01, rel=0.3)
    long = fitted(40_000)
    assert aim.seconds(long) == 400.0
    assert aim.words(long, 400.0) == "N known to 1 %"
    # White noise alone shows no B.
    assert np.isnan(Aim.parse("B 10 %").seconds(long))


@pytest.fixture
def pipe(tmp_path):
    """A named pipe into which a thread writes a recording."""
    path = tmp_path / "pipe"
    os.mkfifo(path)
    text = HEADER + "".join(rows(noise(20_000)))
    writer = threading.Thread(target=partial(path.write_text, text), daemon=True)
    writer.start()
    return path


@posix
def test_the_command_ends_when_the_aim_is_reached(pipe, tmp_path):
    done = run("watch", pipe, "--until", "N 2 %", "--terms", "N + K", "--out", tmp_path / "out", "--json")
    assert done.exit_code == 0, done.stderr
    (document,) = json.loads(done.stdout)["fits"]
    for axis in document["axes"]:
        c = axis["coefficients"][0]
        assert c["std"] <= 0.02 * c["value"]
    assert "N known to 2 %" in done.stderr
    assert {"pipe.json", "pipe_allan.png"} <= {path.name for path in (tmp_path / "out").iterdir()}


@posix
def test_a_record_that_ends_too_early_has_an_exit_code(pipe, elsewhere):
    done = run("watch", pipe, "--until", "B 1 %", "--terms", "N + K")
    assert done.exit_code == 3
    assert "before B 1 % was reached" in done.stderr
    assert "B is not among the terms" in done.stdout


@posix
def test_the_record_is_not_there_or_has_no_samples(tmp_path, elsewhere):
    (tmp_path / "empty.csv").write_text(HEADER)
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
