"""What the figures of noise, missing pixels and amplitude share: bins and plain axes."""

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

POINTS = 18
"""Points of a curve. Chosen for a readable figure."""
FEWEST = 30
"""Pixels that a point of a curve stands for at least. Chosen for a readable figure."""
# Numbers at a logarithmic axis, by the decades that it spans at least. Chosen: three to seven.
_LABELS = ((1.3, (1.0, 3.0)), (0.7, (1.0, 2.0, 5.0)), (0.0, (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)))


def centres(edges: np.ndarray) -> np.ndarray:
    """Return the geometric centres of bins."""
    return np.sqrt(edges[1:] * edges[:-1])


def binned(at: np.ndarray, values: np.ndarray, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and number of the values in each bin; NaN in an empty one."""
    place = np.searchsorted(edges, at, side="right") - 1
    inside = (place >= 0) & (place < len(edges) - 1)
    count = np.bincount(place[inside], minlength=len(edges) - 1)
    total = np.bincount(place[inside], values[inside], minlength=len(edges) - 1)
    empty = np.full(len(count), np.nan)
    return np.divide(total, count, out=empty, where=count > 0), count


def plain_numbers(axis: Axis) -> None:
    """Label a logarithmic axis in plain digits: by 1, 3, 10, ... or closer where it is short."""
    low, high = axis.get_view_interval()
    decades = math.log10(high / low)
    labels = next(labels for least, labels in _LABELS if decades >= least)
    axis.set_major_locator(LogLocator(subs=labels))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())  # Every tick takes a millisecond to draw.


def plain(panels: np.ndarray | list[Axes]) -> None:
    """Leave out the frame above and at the right."""
    for axes in panels:
        axes.spines[["top", "right"]].set_visible(False)
