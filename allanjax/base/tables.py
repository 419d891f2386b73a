"""Tables of results: as text for a terminal, as HTML for a notebook. Empty columns are left out."""

from __future__ import annotations

import html
from collections.abc import Sequence

from allanjax.base.plain import printable

WIDTH = 110
"""Width of printed tables, in characters."""


def text_table(
    title: str, headings: Sequence[str], rows: Sequence[Sequence[str]], right: Sequence[str] = ()
) -> str:
    """Table as text, whose first column names the group of a row and is printed once a group.

    Cells are printed as they are, without markup. `right` are the headings of right-aligned columns.
    """
    from rich.console import Console
    from rich.table import Table

    headings, rows = _filled(headings, rows)
    table = Table(title=printable(title), title_justify="left")
    for heading in headings:
        table.add_column(printable(heading), justify="right" if heading in right else "left")
    previous = None
    for first, *others in rows:
        if previous not in (None, first):
            table.add_section()
        table.add_row(*map(printable, (first if first != previous else "", *others)))
        previous = first
    # In a notebook rich would show an empty block for each table that is made.
    console = Console(
        width=WIDTH, force_jupyter=False, color_system=None, markup=False, emoji=False, highlight=False
    )
    with console.capture() as capture:
        console.print(table)
    return capture.get().rstrip("\n")


def html_table(title: str, headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Table as HTML for a notebook."""
    headings, rows = _filled(headings, rows)
    head = "".join(f"<th>{html.escape(heading)}</th>" for heading in headings)
    body = "".join(
        "<tr>" + "".join(f"<td style='text-align:left'>{html.escape(cell)}</td>" for cell in row) + "</tr>"
        for row in rows
    )
    return f"<p>{html.escape(title)}</p><table><tr>{head}</tr>{body}</table>"


def _filled(
    headings: Sequence[str], rows: Sequence[Sequence[str]]
) -> tuple[Sequence[str], Sequence[Sequence[str]]]:
    """Headings and rows without the columns that have nothing in any row."""
    kept = [k for k in range(len(headings)) if not rows or any(row[k] for row in rows)]
    return [headings[k] for k in kept], [[row[k] for k in kept] for row in rows]
