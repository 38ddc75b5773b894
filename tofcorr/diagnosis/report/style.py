"""Colours and layout that the figures of a diagnosis share."""

import io

from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from tofcorr.observables.style import BLUE, GREY, RED

__all__ = ["BLUE", "GREY", "RED", "single_axes", "svg_of"]


def single_axes(width: float, height: float) -> tuple[Figure, Axes]:
    """Return a figure of this size in inches with one plot, its margins wide enough for labels."""
    figure = Figure(figsize=(width, height))
    axes = figure.subplots()
    left = 1.5 / width if width > 5 else 0.75 / width
    figure.subplots_adjust(
        left=left, right=0.97, bottom=min(0.6 / height, 0.4), top=1 - 0.25 / height
    )
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def svg_of(figure: Figure) -> str:
    """Return a figure as an SVG element, to be put into a page."""
    buffer = io.StringIO()
    FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]
