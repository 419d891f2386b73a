"""Which group a recording belongs to: by a pattern, a file, a mapping, a function."""

from contextlib import nullcontext
from pathlib import Path

import pytest
from typer.testing import CliRunner

from allanjax.base.errors import AllanjaxError
from allanjax.cli.app import app
from allanjax.fleet import fleet
from allanjax.fleet.fleet import characterize_fleet
from allanjax.fleet.groups import group_names

RECORDINGS = {
    "mems_a": Path("logs/mems/a.csv"),
    "mems_b": Path("logs/mems/b.csv"),
    "fog_a": Path("logs/fog/a.csv"),
}
EXPECTED = {"mems_a": "mems", "mems_b": "mems", "fog_a": "fog"}


@pytest.mark.parametrize(
    "group",
    [
        r"logs/(\w+)/",
        "mems|fog",
        "^([a-z]+)_",
        {"logs/mems/a.csv": "mems", "b.csv": "mems", "fog_a": "fog", "other.csv": "x"},
        {path: path.parent.name for path in RECORDINGS.values()},
        lambda path: path.parent.name,
    ],
    ids=lambda value: getattr(value, "__name__", None) or str(value),
)
def test_groups_by_pattern_mapping_and_function(group):
    assert group_names(group, RECORDINGS) == EXPECTED


def test_no_groups():
    assert group_names(None, RECORDINGS) == dict.fromkeys(RECORDINGS, "")


@pytest.mark.parametrize(
    "text",
    [
        "file,group\nlogs/mems/a.csv,mems\nb.csv,mems\nlogs/fog/a.csv,fog\nunused.csv,x\n",
        "\ufeffgroup, recording\nmems, mems_a\nmems, mems_b\nfog, fog_a\n",
        "id,file,group\n1,logs/mems/a.csv,mems\n2,logs/mems/b.csv,mems\n3,logs/fog/a.csv,fog\n",
    ],
)
def test_groups_by_a_file(text, tmp_path, monkeypatch):
    """Its paths are from here or from where it is."""
    (tmp_path / "groups.csv").write_text(text, encoding="utf-8")
    beside = {name: tmp_path / path for name, path in RECORDINGS.items()}
    assert group_names(str(tmp_path / "groups.csv"), beside) == EXPECTED
    monkeypatch.chdir(tmp_path)
    assert group_names("groups.csv", RECORDINGS) == EXPECTED


@pytest.mark.parametrize(
    ("group", "says"),
    [
        (
            "logs/(mems)/",
            r"1 of 3 recordings have no group, logs/fog/a.csv: the pattern 'logs/\(mems\)/' m",
        ),
        ("logs/(", r"group= \(--group\) 'logs/\(' is no regular expression"),
        ("gone/groups.csv", "'gone/groups.csv': no such file; check the path"),
        ({"mems_a": "mems"}, "2 of 3 recordings have no group, .*: add them to the mapping of group="),
        ({"mems_a": "x", "logs/mems/a.csv": "y"}, "logs/mems/a.csv: has two groups, 'x' and 'y'"),
        # Two recordings have this name.
        ({"a.csv": "x", "b.csv": "x"}, "2 of 3 recordings have no group"),
        (lambda path: "", "3 of 3 recordings have no group, .*: the function of group= must return a name"),
    ],
    ids=lambda value: getattr(value, "__name__", None) or str(value),
)
def test_what_is_wrong_with_groups_is_said(group, says):
    with pytest.raises(AllanjaxError, match=says):
        group_names(group, RECORDINGS)


def test_a_file_without_the_columns_says_which_it_has(tmp_path):
    path = tmp_path / "groups.csv"
    path.write_text("name,grade\na,x\n", encoding="utf-8")
    with pytest.raises(AllanjaxError, match=r"file \(or recording\) and group, not name, grade"):
        group_names(path, RECORDINGS)
    path.write_text("", encoding="utf-8")
    with pytest.raises(AllanjaxError, match="and group, not nothing"):
        group_names(path, RECORDINGS)


def test_the_command_hands_groups_on(monkeypatch):
    seen = {}

    def characterize(*arguments, **options):
        seen.update(options)
        raise AllanjaxError("enough")

    monkeypatch.setattr(fleet, "characterize_fleet", characterize)
    monkeypatch.setenv("ALLANJAX_CACHE", "off")
    CliRunner().invoke(app, ["fleet", "a.csv", "--group", r"logs/(\w+)/"])
    assert seen["group"] == r"logs/(\w+)/"


def test_groups_are_known_before_anything_is_computed(tmp_path, monkeypatch):
    (tmp_path / "a.csv").write_text("0\n", encoding="utf-8")
    monkeypatch.setattr(fleet, "connected", lambda *arguments: pytest.fail("has started"))
    with pytest.raises(AllanjaxError, match="have no group"):
        characterize_fleet(tmp_path / "a.csv", tmp_path / "out", group="nothing like it")
    monkeypatch.setattr(fleet, "connected", lambda *arguments: nullcontext())
    monkeypatch.setattr(fleet, "outcomes", lambda *arguments: [])
    characterize_fleet(tmp_path / "a.csv", tmp_path / "out", group="(a)")
