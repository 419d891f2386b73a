"""The README's code runs as it stands there, from its first block to its last."""

import re
import shlex

import pytest
from commands import run
from places import ROOT

import allanjax as aj

pytestmark = pytest.mark.notebook
README = ROOT / "README.md"
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```$", README.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


def blocks(language):
    return [text for of, text in BLOCKS if of == language]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder with the files that the README speaks of."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ALLANJAX_CACHE", "off")
    # As long as the record whose critique is shown, for the compiled programs; with a line to find as well.
    terms = "N=0.1 deg/sqrt(h) + B=2 deg/h + sinusoid(amplitude=20 deg/h, frequency=1.4 Hz)"
    recording = aj.simulate_recording({"gyro_x": terms}, 45_000, 100.0, 0)
    aj.write(recording, "imu.csv")
    aj.write(recording, "week.parquet")
    return tmp_path


def test_python_blocks_run_in_order(folder, capsys):
    given = {}
    for text in blocks("python"):
        exec(compile(text, str(README), "exec"), given)
    for name in ("allan.png", "corner.png", "pictures"):
        assert (folder / name).exists(), name
    assert given["accumulator"].n == 45_000
    assert "noise terms by evidence" in capsys.readouterr().out


def commands(text):
    """The allanjax commands of a block, without comments, prompts and output."""
    lines = text.replace("\\\n", " ").splitlines()
    found = [re.sub(r"^\$ ", "", line) for line in lines]
    return [shlex.split(line, comments=True)[1:] for line in found if line.startswith("allanjax ")]


def test_commands_run(folder):
    ran = [words for text in blocks("bash") for words in commands(text)]
    assert [words[0] for words in ran] == ["characterize", "fleet", "fleet", "export", "export"]
    for words in ran:
        # Of a fleet, a cluster and files that are not there, only that the command line is right.
        shown = run(*words, "--help") if words[0] == "fleet" else run(*words)
        assert shown.exit_code == 0, shown.output
    names = {path.name for path in (folder / "results").iterdir()}
    told = re.search(r"prints a table and writes (.*?)\.\n", README.read_text(encoding="utf-8"), re.DOTALL)
    assert names == set(re.findall(r"`(imu[\w.]+)`", told[1]))


def test_the_critique_says_what_the_readme_shows(folder):
    (text,) = (text for text in blocks("text") if "allanjax critique" in text)
    for words in commands(text):
        result = run(*words)
        assert result.exit_code == 0, result.output
    _, shown = text.split("allanjax critique bench.csv\n")
    told = result.stdout[: result.stdout.index("none left")]
    # Digits beyond these may differ from one machine to the next.
    rounded = [
        re.sub(r"\d+\.?\d*", lambda number: f"{float(number[0]):.1g}", re.sub("p = [^;)]*", "", words))
        for words in (told, shown[: shown.index("none left")])
    ]
    assert rounded[0].split() == rounded[1].split()
