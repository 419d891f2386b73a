"""What commands and objects say, wherever it goes and whatever the files are called."""

import dataclasses
import importlib
import io
import json
import os
import subprocess
import sys
import warnings
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib import pyplot as plt
from matplotlib.text import Text
from typer.testing import CliRunner

import allanjax as aj
from allanjax.base.plain import printable
from allanjax.cli import app as cli
from allanjax.cli import characterize
from allanjax.cli.app import app
from allanjax.record.io import write

NAME = "[/red] x $a$ :smile: <b>& grün"
ENCODINGS = ("ascii", "cp1252", "latin-1", "cp437", "utf-8")
mpl.use("agg")


pytestmark = pytest.mark.usefixtures("elsewhere")


@pytest.fixture
def fitted(small_recording, small_fit, monkeypatch):
    """A recording's file, and commands that have its fit before they begin, and draw nothing."""
    write(small_recording, "small.csv")
    monkeypatch.setattr("allanjax.report.allan_figure.plot_allan", lambda fit, path: Path(path).touch())
    monkeypatch.setattr(
        "allanjax.report.spectrum_figure.plot_psd", lambda spectrum, fit, path: Path(path).touch()
    )
    monkeypatch.setattr(characterize, "_spectrum", lambda recording: None)
    monkeypatch.setattr("allanjax.fleet.options.fit_inspected", lambda *args, **options: small_fit)
    return small_fit


class Outputs:
    """Standard output and error of an encoding, and a command that writes to them."""

    def __init__(self, monkeypatch, encoding):
        self.encoding, self.monkeypatch = encoding, monkeypatch
        self.streams = [io.TextIOWrapper(io.BytesIO(), encoding) for _ in range(2)]

    def use(self):
        # Pytest has its own between a fixture and the test.
        self.monkeypatch.setattr(sys, "stdout", self.streams[0])
        self.monkeypatch.setattr(sys, "stderr", self.streams[1])

    def run(self, *words):
        self.use()
        self.monkeypatch.setattr(sys, "argv", ["allanjax", *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        return ended.value.code, *map(self.text, self.streams)

    def text(self, stream):
        stream.flush()
        return stream.buffer.getvalue().decode(self.encoding)


@pytest.fixture(params=ENCODINGS)
def outputs(request, monkeypatch):
    return Outputs(monkeypatch, request.param)


# --- Encodings ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "plain"),
    [
        ("0.512 ± 0.007 deg/√h", "0.512 +- 0.007 deg/sqrt(h)"),
        ("√(2 edf), rad/s/√Hz", "sqrt(2 edf), rad/s/sqrt(Hz)"),
        ("µg²/Hz, 10⁻¹² m/s³", "ug^2/Hz, 10^-12 m/s^3"),
        ("τ ≤ 3 … 5 → χ² ≈ ∞, σ, Ω0", "tau <= 3 ... 5 -> chi^2 ~ inf, sigma, Omega0"),
        ("┏━┳─┃╇", "+-+-|+"),
        ("grün", r"gr\xfcn"),
    ],
)
def test_words_for_what_ascii_lacks(text, plain, monkeypatch):
    Outputs(monkeypatch, "ascii").use()
    assert printable(text) == plain


def test_what_can_be_shown_is(monkeypatch):
    Outputs(monkeypatch, "cp1252").use()
    assert printable("± 2 µg/√h of grün…") == "± 2 µg/sqrt(h) of grün…"
    Outputs(monkeypatch, "utf-8").use()
    assert printable("± 2 µg/√h") == "± 2 µg/√h"
    # A file name that is no text.
    assert printable("gr\udcfcn") == r"gr\udcfcn"


def test_characterize_in_any_encoding(fitted, outputs):
    code, out, err = outputs.run("characterize", "small.csv")
    assert (code, err) == (0, "")
    unit = "deg/√h" if outputs.encoding in ("utf-8", "cp437") else "deg/sqrt(h)"
    assert f" {unit} " in out
    assert "angle random walk" in out
    if outputs.encoding == "ascii":
        assert "0.2001 +- 0.0011 deg/sqrt(h)" in out
        lines = [line for line in out.splitlines() if line[:1] in "+|"]
        assert len({len(line) for line in lines}) == 1


def test_json_in_any_encoding_is_the_same(fitted, outputs):
    code, out, _ = outputs.run("characterize", "small.csv", "--json")
    assert code == 0
    (fit,) = json.loads(out)["fits"]
    assert fit.pop("file") == "small.csv"
    assert fit.pop("check")["verdict"] == "look"
    assert fit == json.loads(json.dumps(aj.to_dict(fitted)))


@pytest.mark.parametrize(
    "words",
    [
        ["--help"],
        ["characterize", "--help"],
        ["characterize", "grün/√.csv"],
        ["critique", "grün/√.csv", "--json"],
        ["fleet", "grün/√*.csv"],
        ["simulate", "--list"],
        ["simulate", "--terms", "N=1 √", "--out", "a.csv"],
        ["schema", "fit"],
    ],
)
def test_no_command_fails_for_an_encoding(outputs, words):
    code, out, err = outputs.run(*words)
    assert code in (0, 1, 2)
    assert out or err


def test_objects_can_be_printed_in_any_encoding(small_fit, outputs):
    outputs.use()
    print(small_fit, small_fit["gyro_x"]["angle_random_walk"], small_fit.selection)


def test_a_process_of_its_own_in_ascii(small_recording):
    environment = {**os.environ, "PYTHONIOENCODING": "ascii", "PYTHONPATH": os.pathsep.join(sys.path)}
    script = "import sys; from allanjax.cli.app import main; sys.argv[0] = 'allanjax'; main()"
    done = subprocess.run(
        [sys.executable, "-c", script, "characterize", "grün.csv"],
        env=environment,
        capture_output=True,
        timeout=120,
    )
    assert done.returncode == 1
    assert done.stderr.splitlines() == [rb"error: gr\xfcn.csv: no such file; check the path"]


def test_an_interruption_is_one_line(fitted, monkeypatch):
    def interrupted(*args, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr("allanjax.fleet.options.fit_inspected", interrupted)
    code, out, err = Outputs(monkeypatch, "utf-8").run("characterize", "small.csv")
    assert (code, out, err) == (130, "", "interrupted\n")


# --- Names are data -----------------------------------------------------------------------------------------


def test_names_in_tables_and_stories(small_fit):
    named = dataclasses.replace(small_fit, name=NAME)
    assert str(named).splitlines()[0].startswith(f"{NAME}: 20,000 samples")
    assert "&lt;b&gt;&amp;" in named._repr_html_()
    selection = dataclasses.replace(small_fit.selection, name=NAME)
    assert str(selection).splitlines()[0].startswith(NAME)


def test_names_in_pictures(small_fit):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figure = dataclasses.replace(small_fit, name=f"{NAME} 測").plot(path="a.png")
    (title,) = (text for text in figure.findobj(Text) if "smile" in text.get_text())
    drawn, is_formula = title._preprocess_math(title.get_text())
    assert (drawn, is_formula) == (f"{NAME} 測", False)


def test_files_of_any_name(fitted):
    name = "grün[bold]<b>&x.csv"
    Path("small.csv").rename(name)
    done = CliRunner().invoke(app, ["characterize", name], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    assert "grün[bold]<b>&x_coefficients.csv" in done.stdout
    assert (Path("allanjax-results") / "grün[bold]<b>&x.json").exists()


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere file names are text")
def test_a_file_name_that_is_no_text(fitted, monkeypatch):
    name = os.fsdecode(b"gr\xfcn.csv")
    Path("small.csv").rename(name)
    named = dataclasses.replace(fitted, name=Path(name).stem)
    monkeypatch.setattr("allanjax.fleet.options.fit_inspected", lambda *args, **options: named)
    code, out, err = Outputs(monkeypatch, "utf-8").run("characterize", name)
    assert (code, err) == (0, "")
    assert r"gr\udcfcn: 20,000 samples" in out
    (written,) = Path("allanjax-results").glob("gr*n.json")
    assert json.loads(written.read_text("utf-8"))["recording"]["name"] == "gr\udcfcn"


# --- Figures ------------------------------------------------------------------------------------------------


def test_figures_do_not_pile_up(small_fit):
    plt.close("all")
    own = plt.figure()
    # The user's, one that waits, and the one that is drawn; twenty by default.
    with warnings.catch_warnings(), mpl.rc_context({"figure.max_open_warning": 3}):
        warnings.simplefilter("error")
        for k in range(3):
            saved = small_fit.plot(["gyro_x"], path="a.png")
            assert len(plt.get_fignums()) == 1 + bool(k)
            shown = small_fit.plot("gyro_x")
            assert plt.gcf() is shown
            assert own.number in plt.get_fignums()
    # Axes that are the user's belong to a figure that is.
    for _ in range(2):
        aj.plot_allan(small_fit, ["gyro_x"], ax=own.add_subplot(), path="own.png")
    small_fit.plot("gyro_x")
    assert own.number in plt.get_fignums()
    saved.canvas.draw()
    saved.canvas.get_renderer()
    saved.savefig("again.png", dpi=130)
    assert Path("again.png").read_bytes() == Path("a.png").read_bytes()
    plt.close("all")


# --- Places -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", ["characterize", "critique", "fleet", "demo"])
def test_results_need_a_folder(fitted, command):
    files = [] if command == "demo" else ["small.csv"]
    for out in ("small.csv", "small.csv/inside"):
        done = CliRunner().invoke(app, [command, *files, "--out", out], catch_exceptions=False)
        assert done.exit_code == 1
        assert done.stderr.strip().endswith("small.csv is a file: give a folder for the results by --out")


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write anywhere")
def test_results_need_a_folder_that_can_be_written_to(fitted):
    Path("locked").mkdir(mode=0o500)
    done = CliRunner().invoke(app, ["characterize", "small.csv", "--out", "locked/results"])
    assert done.exit_code == 1
    assert "locked can not be written to" in done.stderr


# --- Inputs -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".npz"])
def test_standard_input(small_recording, fitted, suffix):
    write(small_recording, f"a{suffix}")
    content = Path(f"a{suffix}").read_bytes()
    done = CliRunner().invoke(app, ["characterize", "-", "--json", "--out", "there"], input=content)
    assert done.exit_code == 0, done.output
    assert [fit["file"] for fit in json.loads(done.stdout)["fits"]] == ["stdin"]
    assert (Path("there") / "stdin.json").exists()
    done = CliRunner().invoke(app, ["characterize", "-", "--stream"], input=b"")
    assert done.stderr.splitlines()[0].startswith("error: stdin: the file is empty")


def test_critique_of_standard_input(monkeypatch):
    read = []

    def enough(recording, **options):
        read.append(recording)
        raise aj.AllanjaxError("enough")

    monkeypatch.setattr(importlib.import_module("allanjax.critic.critique"), "critique", enough)
    values = np.random.default_rng(0).normal(size=(64, 1))
    write(aj.Recording.from_array(values, 10.0, gyro_unit="deg/s", names=["gyro_x"]), "a.csv")
    done = CliRunner().invoke(app, ["critique", "-", "a*.csv"], input=Path("a.csv").read_bytes())
    assert [recording.name for recording in read] == ["stdin", "a"]
    assert "error: stdin: enough" in done.stderr
    assert "error: a.csv: enough" in done.stderr


def test_patterns(small_recording, fitted):
    for name in ("unit_1.csv", "unit_2.csv", "allanjax-results/unit_3.csv"):
        Path(name).parent.mkdir(exist_ok=True)
        write(small_recording, name)
    done = CliRunner().invoke(app, ["characterize", "**/unit_*.csv", "unit_1.csv", "odd*.csv", "--json"])
    document = json.loads(done.stdout)
    # Each once; what is below the folder for results is results.
    assert [fit["file"] for fit in document["fits"]] == ["unit_1.csv", "unit_2.csv"]
    assert [error["file"] for error in document["errors"]] == ["odd*.csv"]
    assert done.exit_code == 1


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["characterize", "small.csv", "--start", "9", "--stop", "5"], 2, "9 s is not before 5 s"),
        (["characterize", "small.csv", "--start", "nan"], 2, "must be a time in s, not nan"),
        (["characterize", "small.csv", "--start", "300"], 1, "nothing is left of its 199.99 s"),
        (["characterize", ".", "--rate", "1"], 1, "a folder, and no ROS 2 bag"),
        (["simulate", "--terms", "N=1 deg/√h", "--out", "none/a.csv"], 1, "there is no folder none"),
        (
            ["simulate", "--terms", "N=1 deg/√h", "--out", "a.csv", "--duration", "nan"],
            2,
            "positive, not nan",
        ),
        (
            ["simulate", "--terms", "N=1 deg/√h", "--out", "a.csv", "--rate", "0"],
            2,
            "must be positive, not 0",
        ),
    ],
)
def test_what_can_not_be_is_said(fitted, words, code, said):
    done = CliRunner().invoke(app, words, catch_exceptions=False)
    assert done.exit_code == code
    assert said in " ".join(done.stderr.replace("│", " ").split())


def test_the_same_term_twice(small_recording):
    with pytest.raises(aj.FitError, match="no data tell angle_random_walk from angle_random_walk"):
        aj.fit(small_recording, aj.AngleRandomWalk() + aj.AngleRandomWalk())
