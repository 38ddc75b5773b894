"""Colours, width and empty panels that the figures of a diagnosis share."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure

BLUE, RED, GREY = "#2166ac", "#b2182b", "#777777"
"""The simulator or what is explained; the recording or the gap; what is neither."""
WIDTH = 5.7
"""Width of a figure, inches: 547 pixels, so that its words can be read on a narrow page too."""


def panels(
    height: float, rows: int = 1, columns: int = 1, *, same_rows: bool = False
) -> tuple[Figure, list[Axes]]:
    """Return a figure of this height in inches, and its empty panels, row by row.

    Args:
        height: Of the figure, inches.
        rows: Of panels.
        columns: Of panels.
        same_rows: Whether the panels of a row share their vertical axis.
    """
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    found: list[Axes] = (
        figure.subplots(rows, columns, squeeze=False, sharey=same_rows).ravel().tolist()
    )
    for axes in found:
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=8)
        for words in (axes.xaxis.label, axes.yaxis.label):
            words.set_fontsize(9)
    return figure, found


def line_across(axes: Axes, *, at: float = 0.0, vertical: bool = False) -> None:
    """Draw a thin line through the whole panel: where something is zero, or one."""
    (axes.axvline if vertical else axes.axhline)(at, color="black", linewidth=0.8)
