"""What a figure shows."""

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text


def panels(figure: Figure) -> dict[str, Axes]:
    """Axes by the name above them."""
    return {axes.get_title(loc="left"): axes for axes in figure.axes if axes.get_title(loc="left")}


def lines_of(panel: Axes) -> dict[str, Line2D]:
    """Lines by their labels."""
    return {str(line.get_label()): line for line in panel.get_lines()}


def points_of(panel: Axes) -> dict[str, ErrorbarContainer]:
    """Points with error bars by their labels."""
    return {str(c.get_label()): c for c in panel.containers}


def strip_of(figure: Figure) -> Axes:
    """The panel of residuals in per cent."""
    return next(axes for axes in figure.axes if "[%]" in axes.get_ylabel())


def texts(figure: Figure) -> str:
    """Texts within the panels, then those of the figure, in one line."""
    every = [text.get_text() for of in (*figure.axes, figure) for text in of.texts]
    return " ".join(" ".join(every).split())


def check_texts_apart(figure: Figure) -> int:
    """Check that no two texts overlap and none leaves the figure; returns how many there are."""
    # A canvas of its own: pyplot may have closed the figure.
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    drawn = [*figure.texts, *(text for legend in figure.legends for text in legend.get_texts())]
    for axes in figure.axes:
        title = axes.get_title(loc="left") or None
        titles = (text for text in axes.findobj(Text) if text.get_text() == title)
        drawn += [*axes.texts, axes.xaxis.label, axes.yaxis.label, *titles]
    boxes = [(text.get_text(), text.get_window_extent(renderer)) for text in drawn if text.get_text()]
    for i, (first, a) in enumerate(boxes):
        assert 0 <= a.x0 < a.x1 <= figure.bbox.x1, first
        assert 0 <= a.y0 < a.y1 <= figure.bbox.y1, first
        for second, b in boxes[i + 1 :]:
            overlap = min(a.x1, b.x1) - max(a.x0, b.x0) > 1 and min(a.y1, b.y1) - max(a.y0, b.y0) > 1
            assert not overlap, (first, second)
    return len(boxes)
