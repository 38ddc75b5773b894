"""The page of an inspection: one HTML file that needs nothing else."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from tofcorr.errors import CalibrationDataError
from tofcorr.files import write_text
from tofcorr.pages.drawing import BLUE, GREY, RED, image_map, panels, plain_numbers
from tofcorr.pages.page import page_text
from tofcorr.plausibility.alignment import judged
from tofcorr.plausibility.finding import Inspection
from tofcorr.plausibility.look import Look


def write_page(found: Inspection, path: Path) -> None:
    """Write the page, whole or not at all.

    Raises:
        CalibrationDataError: It cannot be written.
    """
    drawn = all_figures(found)
    text = page_text("tofcorr.plausibility", "inspection.html.j2", drawn, {}, inspection=found)
    write_text(path, text, CalibrationDataError)


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
    middle = np.ma.median(np.ma.masked_where(~used, depth), axis=0)
    image_map(left, middle, "median depth, m", None, "viridis")
    share = "frames in which a pixel is used, %"
    image_map(right, 100 * used.mean(0), share, (0.0, 100.0), "viridis")
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
