"""The page of an inspection: one HTML file that needs nothing else."""

import io
import math
from collections.abc import Callable, Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, StrictUndefined
from markupsafe import Markup
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from tofcorr.errors import CalibrationDataError
from tofcorr.files import refuse_existing, staged_file
from tofcorr.plausibility.alignment import judged
from tofcorr.plausibility.finding import Inspection
from tofcorr.plausibility.look import Look
from tofcorr.version import __version__

BLUE, RED, GREY = "#2166ac", "#b2182b", "#777777"
"""The simulator or what is explained; the recording or the gap; what is neither."""
WIDTH = 5.7
"""Width of a figure, inches: 547 pixels, so that its words can be read on a narrow page too."""
FAINT = 0.2
"""Opacity of bands, no unit."""


def write_page(found: Inspection, path: Path) -> None:
    """Write the page, whole or not at all.

    Raises:
        CalibrationDataError: It cannot be written.
    """
    drawn = all_figures(found)
    text = page_text("tofcorr.plausibility", "inspection.html.j2", drawn, {}, inspection=found)
    with staged_file(path, CalibrationDataError) as part:
        part.write_text(text, encoding="utf-8")


def page_text(
    folder: str,
    name: str,
    figures: Mapping[str, Figure],
    filters: Mapping[str, Callable[..., Any]],
    **values: object,
) -> str:
    """Return a page, made by the template of this name in a package.

    Args:
        folder: The package.
        name: File name of the template.
        figures: Its figures, which it reads as `figures`.
        filters: What it calls.
        values: What else it reads; the program's `version` is given.
    """
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= filters
    drawn = {key: Markup(svg_of(figure)) for key, figure in figures.items()}
    template = environment.from_string(files(folder).joinpath(name).read_text(encoding="utf-8"))
    return template.render(values, figures=drawn, version=__version__)


def refuse_page(path: Path) -> None:
    """Raise CalibrationDataError unless a page can be written here: a new name in .html."""
    if path.suffix.lower() not in (".html", ".htm"):
        said = "the page of an inspection is one file; expected a name that ends in .html"
        raise CalibrationDataError(f"{path}: {said}")
    refuse_existing(path)


def svg_of(figure: Figure) -> str:
    """Return a figure as an SVG element, to be put into a page."""
    buffer = io.StringIO()
    # Words as text: they can be found and read aloud, and are drawn in half the time of outlines.
    with rc_context({"svg.fonttype": "none"}):
        FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]


# What all figures look like.

# Numbers at a logarithmic axis, by the decades that it spans at least. Chosen: three to seven.
_LABELS = ((1.3, (1.0, 3.0)), (0.7, (1.0, 2.0, 5.0)), (0.0, (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)))


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
    found = figure.subplots(rows, columns, squeeze=False, sharey=same_rows).ravel().tolist()
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


# The figures of an inspection.


def all_figures(found: Inspection) -> dict[str, Figure]:
    """Return every picture by its name on the page; what cannot be drawn is left out."""
    look = found.look
    figures = {"maps": depth_maps(look), "poses": poses_from_above(look, found)}
    if look.as_given is not None:
        figures["residuals"] = residuals(look, found)
    return figures


def depth_maps(look: Look) -> Figure:
    """Draw the median depth of some frames, and the share of them in which a pixel is used."""
    recording = look.recording
    camera = recording.camera
    step = max(camera.width // 64, 1)  # A picture shows no more.
    chosen = np.unique(np.linspace(0, recording.num_frames - 1, 40).astype(int))
    depth = np.array(recording.depth[chosen, ::step, ::step], dtype=np.float64)
    used = np.isfinite(depth) & (depth > 0)
    if recording.mask is not None:
        used &= np.array(recording.mask[chosen, ::step, ::step]) > 0
    figure, (left, right) = panels(3, 1, 2)
    _map(figure, left, np.ma.median(np.ma.masked_where(~used, depth), axis=0), "median depth, m")
    share = "frames in which a pixel is used, %"
    _map(figure, right, 100 * used.mean(0), share).set_clim(0, 100)
    return figure


def poses_from_above(look: Look, found: Inspection) -> Figure:
    """Draw where the tool was and where it looked, along the two widest axes of the world."""
    place = look.poses[:, :3, 3]
    guess = np.asarray(look.recording.tool_from_camera)
    axis = (look.poses @ guess)[:, :3, 2]
    first, second = np.sort(np.argsort(-np.ptp(place, axis=0))[:2])
    figure, (axes,) = panels(4)
    length = (float(np.ptp(place, axis=0).max()) or 1.0) / 8
    across, along = place[:, first], place[:, second]
    reach = length * axis[:, [first, second]]
    # One unit of an arrow is one of the axes.
    scale = {"angles": "xy", "scale_units": "xy", "scale": 1}
    axes.quiver(across, along, *reach.T, color=GREY, width=1 / 250, **scale)
    axes.update_datalim(place[:, [first, second]] + reach)
    axes.plot(across, along, "o", color=BLUE, markersize=4)
    odd = np.isin(look.sampled, list(found.outlying))
    axes.plot(across[odd], along[odd], "o", color=RED, markersize=7)
    for k in np.flatnonzero(odd):
        axes.annotate(str(look.sampled[k]), (across[k], along[k]), color=RED)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel=f"{'xyz'[first]} of the world, m", ylabel=f"{'xyz'[second]} of the world, m")
    return figure


def residuals(look: Look, found: Inspection) -> Figure:
    """Draw each frame's distance to its plane before and after the best alignment."""
    before = judged(look.scene, look.scene.guess if look.scene.moves else np.eye(4), 0.0, 0.0)
    figure, (axes,) = panels(4)
    axes.plot(look.frames, 1e3 * before.rms, "o", color=GREY, markersize=4, label="as recorded")
    axes.plot(look.frames, 1e3 * look.rms, "o", color=BLUE, markersize=4, label="best alignment")
    odd = np.isin(look.frames, list(found.outlying))
    if odd.any():
        axes.plot(look.frames[odd], 1e3 * look.rms[odd], "o", color=RED, label="disagree")
    axes.axhline(1e3 * look.flatness, color=BLUE, linewidth=1, linestyle=":", label="flatness")
    axes.set_yscale("log")
    plain_numbers(axes.yaxis)
    axes.set(xlabel="frame", ylabel="distance to the plane, mm RMS")
    axes.legend(ncols=4, frameon=False, loc="lower left", bbox_to_anchor=(0.0, 1.0))
    return figure


def _map(figure: Figure, axes: Axes, values: np.ndarray, title: str) -> AxesImage:
    shown = axes.imshow(values)
    figure.colorbar(shown, ax=axes)
    axes.set_title(title, fontsize=10)
    axes.set(xticks=[], yticks=[])
    return shown
