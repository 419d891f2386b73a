"""Options reach what reads and fits, all of them, from every door."""

import inspect
import sys
from dataclasses import fields
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

from allanjax.base.errors import AllanjaxError
from allanjax.cli import characterize as cli
from allanjax.cli import critique as cli_critique
from allanjax.cli.app import app
from allanjax.fleet import fleet, options
from allanjax.fleet.options import FitOptions
from allanjax.noise.notation import parse_model
from allanjax.record.io import ReadOptions, chunks, read, read_chunks

READING = ReadOptions(
    rate=123.0,
    gyro_unit="deg/h",
    accel_unit="mg",
    columns="time,gyro_x,-,accel_z",
    time="clock",
    time_unit="ms",
    start=1.5,
    stop=99.5,
    topic="/imu",
    instance=2,
    gaps="fill",
)
FITTING = FitOptions(READING, parse_model("N + B"), "whittle", ("temperature", "voltage"), True, True, True)
WRITTEN = {"model": "N + B", "regressors": "temperature, voltage"}
NAMES = {"model": "--terms"}
LOOKING = {"as_is": True, "vibrating": True}


class EnoughError(AllanjaxError):
    """Ends a command where what it was to pass on is known."""


def arguments(given):
    """The command line that gives an object's options."""
    words = []
    for option in fields(given):
        if option.name != "reading":
            name = NAMES.get(option.name, f"--{option.name.replace('_', '-')}")
            value = getattr(given, option.name)
            words += [name] if value is True else [name, str(WRITTEN.get(option.name, value))]
    return words


def run(*words):
    return CliRunner().invoke(app, [str(word) for word in words])


@pytest.fixture
def seen(monkeypatch):
    """What was passed on, by who was called; a reader's recording is not read, nor anything computed."""
    calls = {}

    def noting(name, result=None):
        def called(*args, **keywords):
            calls[name] = SimpleNamespace(args=args, keywords=keywords)
            if result is None:
                raise EnoughError(name)
            return result

        return called

    recording = SimpleNamespace(n=100, axes=())
    monkeypatch.setattr(cli, "read_recording", noting("read", recording))
    monkeypatch.setattr(cli, "_spectrum", lambda recording: None)
    monkeypatch.setattr(cli, "open_chunks", noting("chunks"))
    monkeypatch.setattr(cli_critique, "read_recording", noting("read"))
    monkeypatch.setattr(options, "inspected", noting("inspected", SimpleNamespace(quiet=lambda x: x)))
    monkeypatch.setattr(options, "fit_inspected", noting("fit"))
    monkeypatch.setattr(fleet, "characterize_fleet", noting("fleet"))
    monkeypatch.setenv("ALLANJAX_CACHE", "off")
    return calls


def test_nothing_is_compared_with_what_is_so_by_default():
    for given in (READING, FITTING):
        for option in fields(given):
            assert getattr(given, option.name) != option.default


def test_characterize(seen):
    result = run("characterize", "a.csv", *arguments(READING), *arguments(FITTING))
    assert result.exit_code == 1, result.output
    assert seen["read"].args[1] == READING
    _, _, model, objective, regressors, plain = seen["fit"].args
    assert (str(model), objective) == (str(FITTING.model), FITTING.objective)
    assert (regressors, plain) == (FITTING.regressors, FITTING.plain)
    assert seen["inspected"].args[1:] == (model, FITTING.regressors, True, True)


def test_characterize_of_a_stream(seen):
    result = run("characterize", "a.csv", "--stream", *arguments(READING))
    assert result.exit_code == 1, result.output
    assert seen["chunks"].args[1] == READING


def test_what_was_accumulated_is_fitted_as_asked():
    asked = []
    FITTING.fit_accumulated(SimpleNamespace(fit=lambda *args, **keywords: asked.append((args, keywords))))
    assert asked == [((FITTING.model, FITTING.objective), LOOKING)]


def test_critique(seen):
    result = run("critique", "a.csv", *arguments(READING))
    assert result.exit_code == 1, result.output
    assert seen["read"].args[1] == READING


def test_fleet(seen):
    result = run("fleet", "a.csv", *arguments(READING), *arguments(FITTING))
    assert result.exit_code == 1, result.output
    passed = seen["fleet"].keywords
    reading = ReadOptions(**{option.name: passed.pop(option.name) for option in fields(ReadOptions)})
    assert reading == READING
    assert passed.pop("model").terms == FITTING.model.terms
    assert {name: passed[name] for name in ("objective", "regressors", "plain", *LOOKING)} == {
        "objective": FITTING.objective,
        "regressors": FITTING.regressors,
        "plain": FITTING.plain,
        **LOOKING,
    }


def test_a_worker_of_a_fleet(monkeypatch):
    seen = []
    recording = object()
    monkeypatch.setattr(fleet, "read_recording", lambda *args: seen.append(args) or recording)
    monkeypatch.setattr(options, "inspected", lambda *args: seen.append(args) or "what was seen")
    monkeypatch.setattr(options, "fit_inspected", lambda *args, as_is: seen.append((*args, as_is)))
    fleet.characterize_recording("a.csv", FITTING)
    assert seen == [
        ("a.csv", READING),
        (recording, FITTING.model, FITTING.regressors, *LOOKING.values()),
        (
            recording,
            "what was seen",
            FITTING.model,
            FITTING.objective,
            FITTING.regressors,
            FITTING.plain,
            FITTING.as_is,
        ),
    ]


@pytest.mark.parametrize("reader", [read, read_chunks])
def test_readers_take_every_option(reader, monkeypatch):
    seen = []
    monkeypatch.setattr(sys.modules["allanjax.record.io"], "read_recording", lambda *args: seen.append(args))
    monkeypatch.setattr(chunks, "open_chunks", lambda *args: seen.append(args))
    reader("a.csv", **READING.given())
    assert seen[0][:2] == ("a.csv", READING)


def test_the_reader_names_every_option():
    parameters = list(inspect.signature(read).parameters.values())[1:]
    defaults = {parameter.name: parameter.default for parameter in parameters}
    assert defaults == {option.name: option.default for option in fields(ReadOptions)}


def test_help_tells_every_option():
    for command in ("characterize", "critique", "fleet"):
        shown = CliRunner().invoke(app, [command, "--help"], env={"COLUMNS": "200"}).output
        for option in fields(ReadOptions):
            assert f"--{option.name.replace('_', '-')}" in shown
            assert option.metadata["help"][:40] in shown
