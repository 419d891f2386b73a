"""Numbers and words as they are written, by estimates and commands, in any encoding."""

import contextlib
import dataclasses
import io
import re
import sys

import bench
import numpy as np
import pytest
from commands import without_progress

import allanjax as aj
from allanjax.cli.app import main

#: A value with its error, as it has to be written.
WRITTEN = {
    (0.512, 0.0068): "0.5120 ± 0.0068",
    (5.0, 0.0996): "5.00 ± 0.10",
    (0.99951, 0.0999): "1.00 ± 0.10",
    (99.96, 9.96): "100 ± 10",
    (12226.0, 19.6): "12,226 ± 20",
    (310756.0, 1234.0): "310,800 ± 1,200",
    (-0.001, 0.3): "0.00 ± 0.30",
    (1e-3, 1e-4): "0.00100 ± 0.00010",
    (0.99999e-3, 1e-5): "(10.00 ± 0.10)×10⁻⁴",
    (1.68e-5, 1.3e-7): "(1.680 ± 0.013)×10⁻⁵",
    (0.25, 0.0): "0.25",
    (0.25, float("nan")): "0.25",
}


def estimate(value, std, interval=None):
    ends = (value - 1.96 * std, value + 2.3 * std) if interval is None else interval
    about = {"axis": aj.Axis("accel_x", "accel", "m/s²"), "label": "height", "unit": "m", "usual_unit": "m"}
    return aj.Estimate(value=value, std=std, interval=ends, interval_68=ends, **about)


def test_an_error_has_two_digits_and_its_value_as_many_decimals():
    for (value, std), text in WRITTEN.items():
        assert estimate(value, std).describe().partition(" m")[0] == text


def test_an_interval_has_the_decimals_of_its_value_and_a_limit_three_digits():
    e = estimate(0.5121, 0.0068, (0.49877, 0.52774))
    assert e.describe_interval() == "0.4988 … 0.5277"
    assert e.describe() == "0.5121 ± 0.0068 m (95 %: 0.4988 … 0.5277)"
    # A deviation that the interval contradicts is not told.
    for interval in ((0.51, 0.515), (0.508, 0.7), (0.3, np.inf)):
        assert estimate(0.5121, 0.0068, interval).describe().startswith("0.512 m (95 %: 0.")
    # Where only the interval is known, its width says how many digits there are.
    assert estimate(1.2, 0.0, (1.0, 1.4)).describe_interval() == "1.00 … 1.40"
    assert estimate(1.68e-5, 1.3e-7, (1.66e-5, 1.70e-5)).describe_interval() == "(1.660 … 1.700)×10⁻⁵"
    limit, N = (bench.fit("small")["gyro_x"][name] for name in ("quantization", "N"))
    told = re.search(r"< ([\d,]+(?:\.\d+)?) arcsec", limit.in_unit().describe())[1]
    assert float(told) == pytest.approx(limit.in_unit().upper_limit, rel=5e-3)
    assert len(told.replace(".", "").lstrip("0")) == 3
    assert dataclasses.replace(N.in_unit(), held=True, value=0.25).describe() == "0.25 deg/√h (held)"
    rivalled = dataclasses.replace(N, detected=False, rivals=("markov",), upper_limit=1.0)
    assert rivalled.describe().count("Markov process") == 1


def test_short_records_are_in_seconds_long_ones_in_hours():
    lengths = {(64, 1280.0): "0.05 s", (64, 0.32): "200 s", (1500, 1.0): "25 min", (99, 0.01): "2.75 h"}
    for (n, rate), text in lengths.items():
        assert text in repr(aj.Recording.from_array(np.arange(float(n)) % 7.0, rate, gyro_unit="deg/s"))


@pytest.mark.usefixtures("elsewhere")
def test_what_an_encoding_does_not_have_is_written_in_words(monkeypatch):

    def said(action):
        streams = {name: io.TextIOWrapper(io.BytesIO(), "ascii") for name in ("stdout", "stderr")}
        for name, stream in streams.items():
            monkeypatch.setattr(sys, name, stream)
        action()
        for stream in streams.values():
            stream.flush()
        return [stream.buffer.getvalue().decode("ascii") for stream in streams.values()]

    def command(*words):
        monkeypatch.setattr(sys, "argv", ["allanjax", "horizon", *words, "--horizon", "10"])
        with contextlib.suppress(SystemExit):
            main()

    aj.write_json(bench.fit("small"), "fit.json")
    out, err = said(lambda: command("fit.json", "--axis", "gyro_x"))
    assert ("deg/sqrt(h)" in out, without_progress(err)) == (True, "")
    assert [len(line) > 40 for line in out.splitlines() if set(line) == {"-"}] == [True]
    assert r"\u221a" in said(lambda: command("fit.json", "--axis", "gyro_x", "--json"))[0]
    assert r"gr\xfcn.json" in said(lambda: command("grün.json"))[1]
    text, _ = said(lambda: print(bench.fit("small")["gyro_x"], bench.fit("small")["gyro_x"]["N"]))
    assert all(word in text for word in ("0.15148 +- 0.00098 deg/sqrt(h)", "chi^2"))


def test_names_are_data():
    from IPython.core.formatters import HTMLFormatter

    name = "[/red] x $a$ :smile: <b>& grün"
    named = dataclasses.replace(bench.fit("small"), name=name)
    assert str(named).startswith(name)
    assert "&lt;b&gt;&amp;" in HTMLFormatter()(named)
