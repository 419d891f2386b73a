"""What a figure shows."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure


def panels(figure: Figure) -> dict[str, Axes]:
    """Axes by the name above them."""
    return {axes.get_title(loc="left"): axes for axes in figure.axes if axes.get_title(loc="left")}


def texts(figure: Figure) -> list[str]:
    """Texts within the panels, then those of the figure."""
    in_panels = [text.get_text() for axes in figure.axes for text in axes.texts]
    return in_panels + [text.get_text() for text in figure.texts]
