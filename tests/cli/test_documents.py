"""Documents that commands print with `--json`: each follows the schema that `allanjax schema` prints."""

import json
import re
from pathlib import Path

import bench
import numpy as np
import pandas as pd
import pytest
from commands import run, schema
from turned_sensors import at_rest

import allanjax as aj
from allanjax.cli.app import app

pytestmark = pytest.mark.usefixtures("elsewhere")

LIMITS = "name: acceptance\ngyro:\n  N: {limit: 1 deg/√h, meaning: maximum}\n"
DAYS = ("day1.json", "day2.json")
SHORT = ("--terms", "N")
#: Words that follow each command, by the name of its schema; what it reads is in the fixture `prepared`.
WORDS = {
    "check": ("white.csv",),
    "characterize": ("white.csv", *SHORT),
    "watch": ("white.csv", *SHORT, "--until", "N 50 %"),
    "critique": ("white.csv", "none.csv"),
    "report": ("white.csv", *SHORT, "--quick", "--out", "pages/page.html", "--spec", "limits.yaml"),
    "compare": ("small.json", "BMI088", "--out", "tables/table.csv"),
    "spec": ("small.json", "limits.yaml", "--out", "xml/spec.xml"),
    "repeat": DAYS,
    "export": ("small.json", "--to", "kalibr", "-o", "files/imu.yaml"),
    "horizon": ("small.json", "--horizon", 10),
    "navigate": ("small.json", "--latitude", 51, "--out", "pictures/growth.png"),
    "statespace": ("small.json", "--axis", "gyro_y", "--out", "matrices/gyro_y.npz"),
    "kalman": ("white.csv", "--terms", "N=0.1 deg/√h"),
    "calibrate": ("up.csv", "down.csv", "--rate", 20, "--as-is", "--gravity", 9.81, "--fit", "small.json"),
    "simulate": ("motionpak2", "--duration", 1, "--out", "records/m.npz"),
    "convert": ("0.003", "deg/s/√Hz", "--to", "deg/√h"),
}
STATES = ("statespace", "small.json", "--axis", "accel_z")
PAGE = ("report", "small.json", "none.json", "--out", "page.html")
#: Other ways of commands, each with another document of the schema.
OTHERS = [
    ("export", "--list"),
    ("simulate", "--list"),
    ("convert", "--list"),
    ("convert", "--sheet", "BMI088"),
    ("convert", 2, "deg/h", "--to", "rad/s"),
    STATES,
    PAGE,
    ("report", "white.csv", "--terms", "N", "--out", "page.html"),
    ("critique", "white.csv"),
]


@pytest.fixture
def prepared():
    aj.write(bench.recording("white"), "white.csv")
    aj.write_json(bench.fit("small"), "small.json")
    for name in DAYS:
        aj.write_json(bench.fit("small"), name)
    Path("limits.yaml").write_text(LIMITS, encoding="utf-8")
    for way, x in (("up", 0.05 + 1.001 * 9.81), ("down", 0.05 - 1.001 * 9.81)):
        values = at_rest([x], 64, 20.0, axes="z").values[:, 0]
        pd.DataFrame({"accel_z [m/s^2]": values}).to_csv(f"{way}.csv", index=False)


def checked(command, *words):
    """The document of a command, which is all of its standard output."""
    done = run(command, *words, "--json")
    assert done.stdout, done.stderr
    document = json.loads(done.stdout)
    schema(command).validate(document)
    assert document["schema_version"] == (2 if command == "critique" else 1)
    assert not schema(command).is_valid(document | {"colour": "red"})
    assert done.exit_code == int(bool(document.get("errors")))
    for file in document.get("written", ()):
        assert Path(file).is_file()
        assert Path(file).name in done.stderr
    return document


@pytest.mark.parametrize("command", WORDS)
def test_every_document_follows_its_schema_and_nothing_else_is_printed(prepared, command):
    checked(command, *WORDS[command])


@pytest.mark.parametrize("words", OTHERS, ids=lambda words: " ".join(map(str, words[:2])))
def test_other_documents_follow_the_schema_too(prepared, words):
    checked(*words)


@pytest.mark.notebook
def test_the_document_of_the_demo():
    document = checked("demo", "--out", "there")
    told = {(c["axis"], c["label"]): c for c in document["coefficients"]}
    walk = told["gyro_y", "angle_random_walk"]
    # 0.25 deg/√h.
    assert (walk["true_si"], walk["inside"]) == (pytest.approx(np.pi / 180.0 / 240.0), True)
    assert len(told) == 30
    assert sum(c["inside"] for c in told.values()) >= 26


def test_every_command_has_json_and_a_schema_that_defines_what_it_refers_to():
    names = {name for name in app if not name.startswith("-")}
    # The demo and fleets have tests of their own; `schema` prints nothing but JSON.
    assert names == {*WORDS, "fleet", "demo", "schema"}
    for name in names - {"schema"}:
        assert "--json" in run(name, "--help").stdout, name
        document = schema(name).schema
        named = re.findall(r'"#/\$defs/([\w.]+)"', json.dumps(document))
        assert {*named} == {*document["$defs"]}, name


def test_documents_say_what_the_tables_say(prepared):
    fit = aj.load("small.json")
    made = checked("export", *WORDS["export"])
    assert made["text"] == aj.export(fit, "kalibr") == Path("files/imu.yaml").read_text(encoding="ascii")
    space = checked(*STATES, "--rate", 20, "--duration", 50)
    expected = fit["accel_z"].model.state_space(20.0, duration=50.0, sensor="accel")
    for name in ("A", "H", "Q", "R", "P0"):
        np.testing.assert_array_equal(space[name], getattr(expected, name))
    assert (space["names"], space["units"]) == ([*expected.names], [*expected.units])
    files = checked("simulate", *WORDS["simulate"])["recordings"]
    assert {(file["rate_hz"], file["n"], len(file["axes"])) for file in files} == {
        (1000, 1000, 3),
        (100, 100, 3),
    }
    for file in files:
        assert aj.read(file["file"]).names == tuple(file["axes"])
    # A one-sided density is √2 times the two-sided one.
    one, two = checked("convert", *WORDS["convert"])["converted"]
    assert (one["density"], two["density"]) == ("one-sided", "two-sided")
    assert two["value"] == pytest.approx(0.003 * 60.0) == pytest.approx(one["value"] * np.sqrt(2.0))
    page = checked("report", *WORDS["report"])
    assert [entry["spec"]["verdict"] for entry in page["fits"]] == ["pass"]
    assert page["critiques"] == []
    assert [entry["file"] for entry in checked(*PAGE)["errors"]] == ["none.json"]


@pytest.mark.parametrize(
    "words",
    [
        ("simulate", "--terms", "N=1 deg/√h", "--duration", "1e12", "--out", "a.csv/b.csv"),
        ("characterize", "none.csv", "--out", "a.csv/results"),
        ("critique", "none.csv", "--json", "--out", "a.csv/results"),
        ("watch", "none.csv", "--out", "a.csv/results"),
        ("report", "none.csv", "--out", "a.csv/page.html"),
        ("compare", "none.json", "--out", "a.csv/page.html"),
        ("repeat", "none.csv", "nor.csv", "--out", "a.csv/results"),
        ("export", "none.json", "--to", "kalibr", "--out", "a.csv/imu.yaml"),
        ("navigate", "none.json", "--latitude", 51, "--out", "a.csv/a.png"),
        ("statespace", "none.json", "--axis", "gyro", "--out", "a.csv/a.npz"),
        ("kalman", "none.csv", "--terms", "N=1 deg/√h", "--out", "a.csv/a.png"),
        ("calibrate", "none.csv", "--out", "a.csv/results"),
        ("spec", "none.json", "none.yaml", "--out", "a.csv/spec.xml"),
        ("demo", "--out", "a.csv/results"),
    ],
)
def test_a_folder_that_cannot_be_made_is_told_before_the_work(words):
    """Before anything is read, for none of the files exists; a file is in the folder's place."""
    Path("a.csv").write_text("1\n")
    done = run(*words)
    assert (done.exit_code, done.stdout, done.stderr.count("error: ")) == (1, "", 1)
    assert done.stderr.startswith("error: a.csv")
    assert "--out" in done.stderr
    assert "none" not in done.stderr
    assert [path.name for path in Path().iterdir()] == ["a.csv"]


def test_folders_are_made_and_left_only_if_there_are_results(prepared):
    assert run("characterize", "none.csv", "--out", "new/inside").exit_code == 1
    assert not Path("new").exists()
    Path("old").mkdir()
    assert run("characterize", "none.csv", "--out", "old").exit_code == 1
    assert Path("old").is_dir()
    assert "is a folder" in run("export", "small.json", "--to", "kalibr", "--out", "old").stderr
    assert run("export", "small.json", "--to", "kalibr", "--out", "new/inside/imu.yaml").exit_code == 0
    assert Path("new/inside/imu.yaml").is_file()


def test_the_readme_and_the_help_list_the_same_exit_codes():
    readme = (Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8")
    _, _, table = readme.partition("| exit code |")
    listed = re.findall(r"^\| (\d+) \|", table.partition("\n\n")[0], re.MULTILINE)
    printed = " ".join(run("--help").stdout.partition("Exit codes: ")[2].split())
    assert listed == [entry.split()[0] for entry in printed.split("; ")] == ["0", "1", "2", "3", "130"]
