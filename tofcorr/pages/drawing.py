"""How every picture looks: panels, axes, numbers, and colours that mean the same everywhere."""

import io
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib import rc_context, rcParams
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.image import imsave
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

BLUE, RED, GREY = "#08519c", "#e34a33", "#777777"
"""The simulator, or what is corrected or explained; the recording, or an error or gap as it is
without; what is neither. From ColorBrewer (Blues, OrRd): in grey, blue is darker than red."""
STAGES = {"before": RED, "hand-eye only": GREY}
"""Colours of what was not corrected, by the words for it; all else is blue."""
PALE, LIGHT, TINT = "#6baed6", "#bbbbbb", "#f3e9e9"
"""A step towards what is blue; what is left or not used; no data."""
SIGNED = "PuOr_r"
"""The colours of a signed error: purple too near, orange too far (ColorBrewer)."""
FAINT = 0.2
"""Opacity of bands, no unit."""
WIDTH = 5.7
"""Width of a figure, inches: 547 pixels, so that its words can be read on a narrow page too."""

# What a page replaces colours by, so that its style decides between light and dark.
_OF_THE_PAGE = {
    "#000000": "currentColor",
    "#ffffff": "var(--paper)",
    BLUE: "var(--blue)",
    RED: "var(--red)",
    GREY: "var(--grey)",
    PALE: "var(--pale)",
    LIGHT: "var(--light)",
    TINT: "var(--tint)",
}

# Numbers at a logarithmic axis, by the decades that it spans at least. Chosen: three to seven.
_LABELS = ((1.3, (1.0, 3.0)), (0.7, (1.0, 2.0, 5.0)), (0.0, (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)))


def svg_of(figure: Figure) -> str:
    """Return a figure as an SVG element, to be put into a page, whose style gives its colours."""
    buffer = io.StringIO()
    # Words as text: they can be found and read aloud, and are drawn in half the time of outlines.
    with rc_context({"svg.fonttype": "none"}):
        FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None})
    figure.set_layout_engine("none")  # A third of the time: it stays as it is where drawn again.
    text = buffer.getvalue()
    for colour, variable in _OF_THE_PAGE.items():
        text = text.replace(colour, variable)
    return text[text.index("<svg") :]


def save_figure(figure: Figure, path: Path) -> np.ndarray:
    """Write a figure as PNG, and return it as `raster` does: it is drawn once."""
    image = raster(figure)
    imsave(path, image)
    return image


def raster(figure: Figure) -> np.ndarray:
    """Return a figure as an image, shape (H, W, 3), uint8."""
    figure.set_dpi(rcParams["figure.dpi"])  # An SVG has set another one.
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def panels(
    height: float,
    rows: int = 1,
    columns: int = 1,
    *,
    same_rows: bool = False,
    shares: Sequence[float] | None = None,
) -> tuple[Figure, list[Axes]]:
    """Return a figure of this height in inches, and its empty panels, row by row.

    Args:
        height: Of the figure, inches.
        rows: Of panels.
        columns: Of panels.
        same_rows: Whether the panels of a row share their vertical axis.
        shares: How high the rows are compared with each other; None: all the same.
    """
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    sharing = {"sharey": "row" if same_rows else False, "height_ratios": shares}
    found = figure.subplots(rows, columns, squeeze=False, **sharing).ravel().tolist()
    for axes in found:
        plain_look(axes)
    return figure, found


def plain_look(axes: Axes) -> None:
    """Let a panel have two sides only, and small numbers and labels."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=8)
    for words in (axes.xaxis.label, axes.yaxis.label):
        words.set_fontsize(9)


def line_across(axes: Axes, *, at: float = 0.0, vertical: bool = False) -> None:
    """Draw a thin line through the whole panel: where something is zero, or one."""
    (axes.axvline if vertical else axes.axhline)(at, color="black", linewidth=1)


def plain_numbers(axis: Axis) -> None:
    """Label a logarithmic axis in plain digits: by 1, 3, 10, ... or closer where it is short."""
    low, high = axis.get_view_interval()
    decades = math.log10(high / low)
    labels = next(labels for least, labels in _LABELS if decades >= least)
    axis.set_major_locator(LogLocator(subs=labels))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())  # Every tick takes a millisecond to draw.


def image_map(
    axes: Axes, values: np.ndarray, label: str, ends: tuple[float, float] | None, colours: str
) -> None:
    """Draw values over the image (H, W), with a bar of their colours below; NaN stays empty.

    Args:
        axes: Where to draw.
        values: What is drawn.
        label: What they are, with their unit.
        ends: Range of the colours; None: that of the values.
        colours: Name of the colour map.
    """
    low, high = ends or (None, None)
    shown = axes.imshow(values, cmap=colours, vmin=low, vmax=high)
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
    bar = axes.figure.colorbar(shown, ax=axes, orientation="horizontal", label=label)
    bar.ax.locator_params(nbins=5)
    plain_look(bar.ax)
