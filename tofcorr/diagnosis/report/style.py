"""Colours and layout that the figures of a diagnosis share."""

import io

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from tofcorr.observables.style import BLUE, GREY, RED, WIDTH

__all__ = ["BLUE", "GREY", "RED", "WIDTH", "single_axes", "svg_of"]

# Margins of a figure with one plot, inches: names at the left, values at the right. Chosen.
_LEFT, _RIGHT = 1.55, 0.75


def single_axes(width: float, height: float) -> tuple[Figure, Axes]:
    """Return a figure of this size in inches with one plot, its margins wide enough for labels."""
    figure = Figure(figsize=(width, height))
    axes = figure.subplots()
    wide = width > 5
    figure.subplots_adjust(
        left=(_LEFT if wide else 0.65) / width,
        right=1 - (_RIGHT if wide else 0.12) / width,
        bottom=min(0.5 / height, 0.4),
        top=1 - 0.22 / height,
    )
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def svg_of(figure: Figure) -> str:
    """Return a figure as an SVG element, to be put into a page."""
    buffer = io.StringIO()
    # Words as text: they can be found and read aloud, and are drawn in half the time of outlines.
    with rc_context({"svg.fonttype": "none"}):
        FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]
