"""Tables of results as text."""

import rich.console

from allanjax.base.tables import text_table


def test_making_a_table_shows_nothing_in_a_notebook(monkeypatch):
    # As in a notebook, where rich by itself would show each table, here an empty one, beside the result.
    shown = []
    monkeypatch.setattr(rich.console, "_is_jupyter", lambda: True)
    monkeypatch.setattr("rich.jupyter.display", lambda segments, text: shown.append(text))
    table = text_table("title", ("axis", "value"), [("x", "1"), ("x", "2"), ("y", "3")])
    assert not shown
    assert [line.count("x") for line in table.splitlines()].count(1) == 2  # heading and first row
