"""Tables for people: of text for a terminal, of HTML for a notebook."""

from __future__ import annotations

import html
from collections.abc import Sequence


def text_table(title: str, headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table whose first column names the group of rows; it is written once a group."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title, title_justify="left")
    for heading in headings:
        table.add_column(heading)
    previous = None
    for first, *others in rows:
        if previous not in (None, first):
            table.add_section()
        table.add_row(first if first != previous else "", *others)
        previous = first
    console = Console(width=110, record=False, color_system=None)
    with console.capture() as capture:
        console.print(table)
    return capture.get().rstrip("\n")


def html_table(title: str, headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """The same for a notebook."""
    head = "".join(f"<th>{html.escape(heading)}</th>" for heading in headings)
    body = "".join(
        "<tr>" + "".join(f"<td style='text-align:left'>{html.escape(cell)}</td>" for cell in row) + "</tr>"
        for row in rows
    )
    return f"<p>{html.escape(title)}</p><table><tr>{head}</tr>{body}</table>"
