"""All studies are listed, and each runs to its end with small numbers."""

import pytest

from benchmarks.__main__ import main
from benchmarks.common.study import UnavailableError, names, perform, question, settings

pytestmark = pytest.mark.study


def test_all_studies_are_listed_with_their_questions(capsys):
    assert main(["--list"]) == 0
    listed = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in listed] == names()
    assert all(question(name).endswith("?") for name in names())


@pytest.mark.parametrize("name", names())
def test_a_study_runs(name, monkeypatch, tmp_path):
    monkeypatch.setattr(settings, "workers", 1)
    path = tmp_path / "results.md"
    try:
        text = perform(name, quick=True, results=path)
    except UnavailableError as reason:
        pytest.skip(str(reason))
    assert path.read_text(encoding="utf-8") == text
    assert text.startswith(f"# {question(name)}\n")


def test_options_are_the_keywords_of_a_study(capsys):
    with pytest.raises(SystemExit):
        main(["accuracy", "--rekords", "3"])
    assert "--rekords" in capsys.readouterr().err
    assert main(["mutants", "--count", "0", "--results", "/dev/null"]) == 0
