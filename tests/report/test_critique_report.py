"""A critique told, drawn, exported, and asked for on the command line."""

import dataclasses
import importlib
import json
import warnings
from importlib.resources import files
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from typer.testing import CliRunner

import allanjax as aj
from allanjax.base.errors import AllanjaxError
from allanjax.cli.app import app
from allanjax.critic.comparison import StageResiduals
from allanjax.critic.discrepancies import before_and_after, discrepancies
from allanjax.critic.finding import CoefficientChange, Discrepancy, DriftChange, Finding, Rival
from allanjax.critic.noise import family_of
from allanjax.critic.parameters import parameter_estimate
from allanjax.critic.result import AxisCritique, Critique, Snapshot
from allanjax.record.io import write
from allanjax.record.recording import Axis, DeadAxis, Recording
from allanjax.report.critique_figure import plot_critique
from allanjax.report.critique_story import format_remainder, headline_discrepancy, sentence
from allanjax.report.critique_words import amount, describe, parameters, suited, wrap

N, RATE = 8192, 100.0
MG = 9.80665e-3
NAN = float("nan")
WALK = 1e-3
ACCEL, GYRO = Axis("accel_x", "accel", "mg"), Axis("gyro_x", "gyro", "deg/s")


def snapshot(x):
    """White noise of WALK·√rate a sample."""
    power = {"angle_random_walk": WALK**2}
    return Snapshot(x, family_of(N, RATE).expected(power, NAN), tuple(power), power, NAN, 0.0)


def critique_of(findings):
    """An accelerometer with a line, and a clean gyro; `findings` are those of the former."""
    rng = np.random.default_rng(0)
    noise, other = rng.standard_normal((2, N)) * WALK * np.sqrt(RATE)
    t = np.arange(N) / RATE
    stages = (snapshot(noise + 5.0 * MG * np.cos(2.0 * np.pi * 0.552 * t)), snapshot(noise))
    records = [StageResiduals(ACCEL, MG, RATE, s) for s in stages]
    before, after = (discrepancies(record, record.samples) for record in records)
    clean = (snapshot(other),)
    same = discrepancies(StageResiduals(GYRO, np.pi / 180.0, RATE, clean[0]), other)
    model = aj.Model((aj.AngleRandomWalk(WALK),))
    extended = model + aj.Sinusoid(5.0 * MG, 0.552)
    (pairs,) = before_and_after(records)
    findings = tuple(dataclasses.replace(f, discrepancies=pairs) for f in findings)
    tests = {"sinusoid": 1e-60, "outliers": 0.4}
    line = AxisCritique(ACCEL, findings, before, after, tests, stages[: len(findings) + 1], model, extended)
    rest = AxisCritique(GYRO, (), same, same, {}, clean, model, model)
    return Critique("bench", RATE, None, (line, rest), (), ("a note",))


LINE = Finding(
    "sinusoid",
    ("accel_x",),
    {
        "frequency": parameter_estimate(ACCEL, "frequency", 0.552, 1e-4, "Hz"),
        "amplitude": parameter_estimate(ACCEL, "amplitude", 5.0, 0.02, "mg"),
    },
    1e-60,
    5310.0,
    5310.2,
    (Rival("resonance", 40.0),),
    (0.54, 0.564),
    "frequency",
    (CoefficientChange("angle_random_walk", 0.2, 0.1, "m/s/√h"), CoefficientChange("markov", NAN, NAN, "1")),
    DriftChange(100.0, 0.3, 0.1, 0.29, "m/s"),
)
STEP = dataclasses.replace(
    LINE,
    cause="outliers",
    parameters={},
    details={
        "times": tuple(parameter_estimate(ACCEL, "time", t, 0.01, "s") for t in np.arange(9.0)),
        "kind": "x",
    },
    span=(10.0, 20.0),
    domain="time",
    rivals=(),
    coefficients=(),
    drift=DriftChange(NAN, NAN, NAN, NAN, "m/s"),
)


@pytest.fixture(scope="module")
def critique():
    return critique_of((LINE,))


# --- Story --------------------------------------------------------------------------------------------------


def words(text):
    """Without line breaks."""
    return " ".join(str(text).split())


def test_the_story_says_what_was_found_what_it_changes_and_what_is_wrong(critique):
    told = words(critique)
    worst = next(d for d in critique["accel_x"].before if d.statistic == "allan_deviation")
    assert worst.p_value < 1e-4
    start = (
        "bench: 1 finding in 2 axes, worth 5,310 nats on held-out data - sinusoid 0.552 Hz: accel_x 5 mg; "
    )
    # The Allan deviation is off by more than a factor of 2.9, by which the drift changes.
    assert told.startswith(start + "Allan deviation was ")
    assert f"at {worst.where:.3g} s " in told
    assert "of 11 tests fail); none left gyro_x:" in told
    assert "tests fail); left: nothing, all 11 tests pass" in words(critique.details())
    assert "gyro_x: nothing found: the simulation is indistinguishable from the measurement" in told
    assert "note: a note" in told
    assert " nan" not in told
    assert "unexplained" not in told
    assert max(len(line) for line in str(critique).splitlines()) <= 108


def test_the_story_at_length_says_why_and_what_else_it_might_be(critique):
    told = words(critique.details())
    wrong, _ = headline_discrepancy(critique["accel_x"].findings[0])
    assert wrong.statistic in ("allan_deviation", "psd_line", "psd")
    assert told.startswith("bench: 1 finding in 2 axes, worth 5,310 nats on held-out data accel_x: ")
    assert f"{describe(wrong)}. Cause: sinusoid, frequency 0.55200 ± 0.00010 Hz" in told
    assert "Hz, amplitude 5.000 ± 0.020 mg. After: " in told
    assert "gain 5,310 nats on held-out data. Rivals: resonance (1 : 40)." in told
    assert "velocity random walk 0.2 → 0.1 m/s/√h; drift over 100 s: measured 0.3 m/s" in told
    assert "predicted 0.1 before and 0.29 after" in told
    assert "markov" not in told
    assert " nan" not in told
    assert max(len(line) for line in critique.details().splitlines()) <= 108
    # A page of a notebook shows all of it.
    assert "Rivals" in critique._repr_html_()


def test_a_finding_by_itself_says_what_it_mended(critique):
    (finding,) = critique["accel_x"].findings
    before, after = headline_discrepancy(finding)
    assert str(finding).startswith(f"accel_x: {describe(before)}. Cause: sinusoid")
    assert (before.statistic, before.where) == (after.statistic, after.where)
    assert before.p_value < 1e-4 < after.p_value


def test_what_a_finding_did_not_mend_it_is_not_credited_with(critique):
    pair = headline_discrepancy(LINE_WITH := critique["accel_x"].findings[0])
    useless = dataclasses.replace(LINE_WITH, discrepancies=((pair[0], pair[0]),))
    assert headline_discrepancy(useless) is None
    assert str(useless).startswith("accel_x: sinusoid, frequency")
    assert "(p = 1e-60). Gain" in str(useless)


def test_every_finding_has_its_own_before_and_after():
    rng = np.random.default_rng(3)
    noise = rng.standard_normal(N) * WALK * np.sqrt(RATE)
    t = np.arange(N) / RATE
    slow, fast = (MG * np.cos(2.0 * np.pi * f * t) for f in (0.552, 11.0))
    stages = (snapshot(noise + slow + fast), snapshot(noise + fast), snapshot(noise))
    first, second = before_and_after([StageResiduals(ACCEL, MG, RATE, s) for s in stages])
    for pairs, f in ((first, 0.552), (second, 11.0)):
        lines = {before.statistic: (before, after) for before, after in pairs}
        before, after = lines["psd_line"]
        assert before.where == after.where == pytest.approx(f, abs=RATE / N)
        assert before.p_value < 1e-4 < after.p_value
        # A line between two frequencies of whole periods shows at least 2/π of its amplitude, here 1 mg.
        assert 0.6 < before.measured < 1.3


def test_what_has_no_cause_is_said_to_be_unexplained_and_once():
    first, clean = critique_of(()).results
    bare = dataclasses.replace(first, after=())
    told = words(Critique("bench", RATE, None, (bare, clean), (), ()))
    assert told.startswith("bench: nothing found in 2 axes")
    assert "accel_x: unexplained: " in told
    worst = min(first.before, key=lambda d: d.p_value)
    unexplained = dataclasses.replace(LINE, cause="unexplained", discrepancies=((worst, worst),), rivals=())
    assert str(unexplained) == f"accel_x: unexplained: {describe(worst)}."
    found = dataclasses.replace(first, after=first.before, findings=(unexplained,))
    told = words(Critique("bench", RATE, None, (found, clean), (), ()))
    assert told.startswith("bench: nothing found in 2 axes")
    assert told.count("unexplained") == told.count(describe(worst)) == 1


def test_a_finding_without_discrepancies_reads_well():
    text = sentence(STEP)
    assert text.startswith("accel_x: outliers, times 0, 1, 2 s, … (9 in all), kind x (p = 1e-60). Gain 5,310")


@pytest.mark.parametrize(
    ("value", "std", "unit", "text"),
    [
        (0.552, 1e-4, "Hz", "0.55200 ± 0.00010 Hz"),
        (1.5, 0.1, "1", "1.50 ± 0.10"),
        (3.0, 0.0, "samples", "3 samples"),
        (2.0, NAN, "mg", "2 mg"),
        # What is small is told in a finer unit, without digits that mean nothing.
        (0.012, 0.001, "g", "12.0 ± 1.0 mg"),
        (4.7e-6, 3e-7, "g", "4.70 ± 0.30 µg"),
        (-0.01, 0.001, "deg/s", "-36.0 ± 3.6 deg/h"),
        (6e-4, 1e-4, "g/[temperature]", "0.60 ± 0.10 mg/[temperature]"),
        (0.004, 0.0, "deg/s/√Hz", "14.4 deg/h/√Hz"),
        (0.564012345, 1e-9, "Hz", "0.564012 Hz"),
    ],
)
def test_amounts(value, std, unit, text):
    sensor = "gyro" if unit.startswith("deg") else "accel"
    assert amount(parameter_estimate(Axis("x", sensor, "1"), "any", value, std, unit)) == text


def test_counts_are_whole_shares_per_cent_and_resolutions_as_recorded():
    numbers = {
        "step": (0.00333, 3.3e-12, "g"),
        "count": (1916.0, 9.8, "1"),
        "fraction": (0.0668, 0.0012, "1"),
        "longest": (29.0, 0.0, "samples"),
    }
    found = {name: parameter_estimate(ACCEL, name, *own) for name, own in numbers.items()}
    finding = dataclasses.replace(LINE, parameters=found, details={"axes": ("accel_x",), "channel": "heat"})
    said = ["step 0.00333 g", "count 1,916", "fraction 6.68 %", "longest 29 samples", "channel heat"]
    assert parameters(finding) == said


def test_units_that_have_no_finer_one_stay():
    assert suited("Hz", 1e-9) == ("Hz", 1.0)
    assert suited("g", 0.5) == ("g", 1.0)
    assert suited("mg", 0.0) == ("mg", 1.0)
    assert suited("1", 1e-9) == ("", 1.0)


def test_lines_do_not_break_between_a_number_and_its_unit():
    text = "frequency 0.552 ± 0.001 Hz (p = 1e-30) at τ = 0.7 s"
    for width in range(12, 60):
        lines = wrap(text, width).splitlines()
        assert " ".join(lines) == text
        assert not any(line.startswith(("±", "Hz", "=", "s")) or line.endswith(("=", "±")) for line in lines)


@pytest.mark.parametrize(
    ("measured", "simulated", "text"),
    [
        (1.0, 0.62, "38 % low at τ = 0.7 s"),
        (1.0, 1.5, "50 % high"),
        (1.0, 2.6, "160 % high"),
        (1.0, 0.01, "100 times too low"),
        (1.0, 5.0, "5 times too high"),
        (0.0, 1.0, "wrong"),
    ],
)
def test_sizes(measured, simulated, text):
    d = Discrepancy("allan_deviation", 0.7, "s", measured, simulated, "mg", 1e-30)
    assert text in describe(d)
    assert describe(d).endswith("(p = 1e-30)")


@pytest.mark.parametrize(
    ("simulated", "p", "text"),
    [
        (1.38, 0.3, "within 38 %"),
        (2.42, 0.3, "within 140 %"),
        (1.0001, 0.3, "within 0.1 %"),
        (1.38, 1e-30, "38 % high"),
    ],
)
def test_what_is_left(simulated, p, text):
    d = Discrepancy("psd", 0.5, "Hz", 1.0, simulated, "mg²/Hz", 1e-30)
    assert format_remainder(d, dataclasses.replace(d, p_value=p)) == text


# --- Pictures -----------------------------------------------------------------------------------------------


def test_a_figure_for_every_finding_and_one_for_each_axis_without(tmp_path):
    import matplotlib
    from matplotlib import pyplot as plt

    matplotlib.use("Agg")
    plt.close("all")
    twice = critique_of((LINE, STEP))
    shared = dataclasses.replace(STEP, cause="repeated_samples", axes=("accel_x", "gyro_x"))
    twice = dataclasses.replace(twice, shared_findings=(shared,))
    figures = plot_critique(twice, tmp_path / "new")
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == [
        "bench_accel_x_gyro_x_repeated_samples.png",
        "bench_accel_x_outliers.png",
        "bench_accel_x_sinusoid.png",
        "bench_gyro_x.png",
    ]
    line, outliers, _, clean = figures
    allan, psd, spectrum, text = line.axes
    assert allan.get_xlabel() == psd.get_xlabel().replace("frequency f [Hz]", "cluster time T [s]")
    assert allan.get_ylabel() == "Allan deviation [µg]"
    assert psd.get_ylabel() == "one-sided PSD [µg²/Hz]"
    assert spectrum.get_xlabel() == "frequency f [Hz]"
    assert "resonance" in text.texts[0].get_text()
    assert outliers.axes[2].get_xlabel() == "time since start [s]"
    assert outliers.axes[2].get_ylabel() == "whitened residual [σ]"
    assert [panel.get_ylabel() for panel in clean.axes] == [
        "Allan deviation [deg/h]",
        "one-sided PSD [(deg/h)²/Hz]",
    ]
    assert len(plot_critique(twice, findings=[twice["accel_x"].findings[1]])) == 1
    assert plt.get_fignums() == []
    # The line stands out of its own panel at its frequency.
    drawn = spectrum.get_lines()[0]
    peak = drawn.get_xdata()[np.argmax(drawn.get_ydata())]
    assert peak == pytest.approx(0.552, abs=RATE / N)


def test_many_figures_are_drawn_without_a_warning():
    from matplotlib import pyplot as plt

    plt.close("all")
    with plt.rc_context({"figure.max_open_warning": 1}), warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(plot_critique(critique_of((LINE, STEP)))) == 3
    assert plt.get_fignums() == []


# --- Export -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def schema():
    return json.loads(files("allanjax.report").joinpath("critique.schema.json").read_text(encoding="utf-8"))


def test_json_has_all_numbers_and_follows_the_schema(schema):
    document = json.loads(json.dumps(critique_of((LINE, STEP)).to_dict(), allow_nan=False))
    jsonschema.validate(document, schema)
    axis = document["axes"][0]
    assert [f["cause"] for f in document["findings"]] == ["sinusoid", "outliers"]
    assert [f["parts"] for f in document["findings"]] == [
        [{"axis": "accel_x", "index": 0}],
        [{"axis": "accel_x", "index": 1}],
    ]
    assert document["findings"][0]["amplitudes"]["accel_x"]["value"] == 5.0
    assert axis["findings"][0]["parameters"]["amplitude"] == {
        "value": 5.0,
        "std": 0.02,
        "unit": "mg",
        "limit": None,
    }
    assert axis["findings"][1]["parameters"]["times"]["value"] == list(range(9))
    assert axis["findings"][1]["drift"]["measured"] is None
    assert axis["findings"][0]["coefficients"][1]["before"] is None
    assert axis["findings"][0]["rivals"] == [{"cause": "resonance", "odds": 40.0}]
    walk = axis["baseline"]["parameters"]["angle_random_walk"]
    assert walk["unit"] == "m/s/√h"
    assert walk["value"] == pytest.approx(WALK * 60.0)
    lines = {d["statistic"]: d for d in axis["discrepancies"]}
    assert lines["psd_line"]["p_value"] < 1e-4 < lines["psd_line"]["after"]["p_value"]
    assert document["recording"] == {"name": "bench", "n": N, "rate_hz": RATE, "duration_s": N / RATE}


def test_what_cannot_be_held_out_has_no_gain_and_odds_are_no_p_value(schema):
    seen = dataclasses.replace(LINE, cause="rounding", p_value=None, evidence=None, gain=None, rivals=())
    odds = dataclasses.replace(LINE, cause="low_pass", p_value=None, rivals=())
    found = critique_of((seen, odds))
    bare = dataclasses.replace(seen, discrepancies=())
    assert sentence(bare).endswith("(seen in the samples themselves). Gain cannot be held out.")
    assert "(odds 1e+2306 : 1). Gain 5,310 nats" in sentence(dataclasses.replace(odds, discrepancies=()))
    assert "cannot be held out" in repr(seen)
    assert found.gain == 5310.2
    table = found.to_dataframe().groupby("cause")[["p_value", "gain"]].first()
    assert np.isnan(table.loc["rounding"]).all()
    document = found.to_dict()
    jsonschema.validate(json.loads(json.dumps(document, allow_nan=False)), schema)
    first, second = document["axes"][0]["findings"]
    assert (first["gain_nats"], first["evidence_nats"], first["p_value"]) == (None, None, None)
    assert (second["gain_nats"], second["p_value"]) == (5310.2, None)
    assert "worth" not in str(critique_of((seen,)))


@pytest.mark.parametrize("change", ["schema_version", "missing", "nan"])
def test_the_schema_refuses_what_it_does_not_describe(critique, schema, change):
    document = critique.to_dict()
    if change == "schema_version":
        document["schema_version"] = 2
    elif change == "missing":
        del document["axes"][0]["findings"]
    else:
        document["axes"][0]["findings"][0]["gain_nats"] = "NaN"
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(document, schema)


# --- Command line -------------------------------------------------------------------------------------------


@pytest.fixture
def command(critique, tmp_path, monkeypatch):
    """The command, with a critic that has its mind made up."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ALLANJAX_CACHE", "off")

    def fake(recording, *, progress=None):
        progress("looking")
        if recording.name == "odd":
            raise AllanjaxError("odd: cannot be criticized")
        return critique

    # The package by its own name: allanjax.critique is the function that it is named after.
    monkeypatch.setattr(importlib.import_module("allanjax.critic.critique"), "critique", fake)
    values = np.random.default_rng(0).standard_normal((64, 1))
    for name in ("imu", "odd"):
        recording = Recording.from_array(values, RATE, gyro_unit="deg/s", names=["gyro_x"], name=name)
        write(recording, tmp_path / f"{name}.csv")
    return lambda *words: CliRunner().invoke(app, ["critique", *words], catch_exceptions=False)


def test_the_command_tells_the_story_and_writes_the_results(command, critique):
    done = command("imu.csv")
    assert done.exit_code == 0, done.stderr
    assert str(critique) in done.stdout
    assert sorted(p.name for p in Path("allanjax-results").iterdir()) == [
        "imu_accel_x_sinusoid.png",
        "imu_critique.json",
        "imu_gyro_x.png",
    ]
    assert str(Path("allanjax-results") / "imu_accel_x_sinusoid.png") in done.stdout


def test_json_of_one_file_is_its_document(command, critique, schema):
    done = command("imu.csv", "--json")
    assert done.exit_code == 0
    document = json.loads(done.stdout)
    assert document == json.loads(json.dumps(critique.to_dict())) | {"errors": []}
    jsonschema.validate(document, schema)
    done = command("odd.csv", "--json")
    assert done.exit_code == 1
    assert json.loads(done.stdout) == {
        "schema_version": 1,
        "critiques": [],
        "errors": [{"file": "odd.csv", "message": "odd: cannot be criticized"}],
    }


def test_a_dead_axis_is_told_and_an_error(critique, command, monkeypatch, schema):
    dead = dataclasses.replace(critique, dead=(DeadAxis.of(Axis("gyro_z", "gyro", "deg/s"), 0.0),))
    assert "gyro_z: not compared: constant, 0 deg/s throughout" in str(dead)
    package = importlib.import_module("allanjax.critic.critique")
    monkeypatch.setattr(package, "critique", lambda recording, *, progress: dead)
    done = command("imu.csv", "--json")
    assert done.exit_code == 1
    assert "error: imu.csv: gyro_z: not compared, constant, 0 deg/s throughout" in done.stderr
    document = json.loads(done.stdout)
    assert [error["message"].split(",")[0] for error in document["errors"]] == ["gyro_z: not compared"]
    jsonschema.validate(document, schema)


def test_one_bad_file_does_not_stop_the_others(command, schema):
    done = command("odd.csv", "none.csv", "imu.csv", "--json")
    assert done.exit_code == 1
    document = json.loads(done.stdout)
    assert [error["file"] for error in document["errors"]] == ["odd.csv", "none.csv"]
    (found,) = document["critiques"]
    assert found.pop("file") == "imu.csv"
    jsonschema.validate(found, schema)
    assert "error: odd.csv: odd: cannot be criticized" in done.stderr
    assert not Path("allanjax-results").exists()
    assert command("imu.csv", "--json", "--out", "there").exit_code == 0
    assert len(list(Path("there").iterdir())) == 3
