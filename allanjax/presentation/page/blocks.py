"""What a page consists of: texts, tables, charts and exports, as data."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float

from allanjax.base.tables import Column


@dataclass(frozen=True)
class Text:
    """A paragraph, with the class by which the style sheet marks a verdict or a warning."""

    text: str
    style: str = ""


def texts(lines: Iterable[str], style: str) -> list[Text]:
    """A paragraph of this style for each line."""
    return [Text(line, style) for line in lines]


@dataclass(frozen=True)
class Cell:
    """Text of a cell in usual units, the same in SI, and a remark below."""

    text: str
    si: str = ""
    remark: str = ""
    si_remark: str = ""


@dataclass(frozen=True)
class Table:
    """A table; the first column has the names of the rows."""

    heads: Sequence[Cell]
    rows: Sequence[Sequence[Cell]]
    caption: str = ""

    @classmethod
    def of(cls, columns: Sequence[Column], caption: str = "") -> Table:
        """The table that a result prints."""
        shown = [c for c in columns if any(c.cells)]
        rows = zip(*(map(str.strip, c.cells) for c in shown), strict=True)
        return cls.of_texts([c.head.replace("\n", " ") for c in shown], rows, caption)

    @classmethod
    def of_texts(cls, heads: Iterable[str], rows: Iterable[Iterable[str]], caption: str = "") -> Table:
        """The table of these texts, which have no units."""
        return cls([*map(Cell, heads)], [[*map(Cell, row)] for row in rows], caption)


@dataclass(frozen=True)
class Units:
    """A long table that the browser sorts and filters, with some hundred rows at a time.

    Attributes:
        heads: heads of the columns.
        rows: texts or numbers; the first cell of a row may be a pair of a text and the target of its link.
        marked: numbers of the rows that are marked.
    """

    heads: Sequence[str]
    rows: Sequence[Sequence[Any]]
    marked: Sequence[int] = ()


@dataclass(frozen=True)
class Method:
    """The paragraph on the method: a fit's objective, and the terms that were given, if any."""

    objective: str
    terms: str


@dataclass(frozen=True)
class Exports:
    """Texts to copy, by the names under which they are chosen."""

    texts: Sequence[tuple[str, str]]


@dataclass(frozen=True)
class Fold:
    """Blocks that are shown at a click."""

    title: str
    blocks: Sequence[Block]
    is_open: bool = False


@dataclass(frozen=True)
class Row:
    """Blocks side by side where the screen is wide enough."""

    blocks: Sequence[Block]


@dataclass(frozen=True)
class Trace:
    """A curve of a chart, in SI.

    Attributes:
        group: number of the axis or recording that it belongs to.
        layer: what it is, e.g. "measured" or "model"; layers are shown and hidden together.
        x, y: the points.
        low, high: ends of their intervals.
        look: "dots", "rings", which dots do not hide, "line" or "dashes".
        labels: what hovering adds for each point, as numbers of `names`.
        names: texts for `labels`.
    """

    group: int
    layer: str
    x: Float[np.ndarray, " m"]
    y: Float[np.ndarray, " m"]
    low: Float[np.ndarray, " m"] | None = None
    high: Float[np.ndarray, " m"] | None = None
    look: str = "dots"
    labels: Sequence[int] = ()
    names: Sequence[str] = ()


@dataclass(frozen=True)
class Mark:
    """A named point of a chart in SI, or without y a line at x; of a group, or of all."""

    text: str
    x: float
    y: float | None = None
    group: int | None = None


@dataclass(frozen=True)
class Span:
    """A named part of the x axis."""

    text: str
    start: float
    stop: float
    group: int | None = None


@dataclass(frozen=True)
class View:
    """One of the pictures that a chart switches between.

    Attributes:
        name: its name, e.g. "Allan deviation".
        x, y: labels of the axes; x_unit is the unit of x.
        units: units of y, usual and SI, with their sizes in SI.
        groups: names of the axes or recordings.
        traces, marks, spans: what is drawn.
        log: which scales are logarithmic: "xy", "x", "y" or "".
        single: whether marks are shown of one group at a time.
        interval: what the intervals of the traces are.
        hidden: layers that are hidden at first.
    """

    name: str
    x: str
    x_unit: str
    y: str
    units: Sequence[tuple[str, float]]
    groups: Sequence[str]
    traces: Sequence[Trace]
    marks: Sequence[Mark] = ()
    spans: Sequence[Span] = ()
    log: str = "xy"
    single: bool = False
    interval: str = "95 %"
    hidden: Sequence[str] = ()


@dataclass(frozen=True)
class Chart:
    """A chart with one or more views.

    Attributes:
        title: its title.
        views: what it switches between.
        slider: what a slider below it chooses on the x axis, e.g. "horizon"; "" for none.
    """

    title: str
    views: Sequence[View]
    slider: str = ""


Block: TypeAlias = Text | Table | Units | Method | Exports | Fold | Row | Chart


@dataclass(frozen=True)
class Section:
    """A part of a page with its heading, on paper only if it is `printed`."""

    title: str
    blocks: Sequence[Block]
    printed: bool = True
