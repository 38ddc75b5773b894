"""Figures of a calibration."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from tofcorr.pixels.sample import PixelSample
from tofcorr.training.shown import columns_of_errors, ends_of, gap_rows, profile

_COLOURS = {"before": "tab:red", "hand_eye_only": "tab:orange", "after": "tab:blue"}
_LABELS = {"before": "before", "hand_eye_only": "hand-eye only", "after": "after"}


def save_figure(figure: Figure, path: Path) -> np.ndarray:
    """Write a figure as PNG; return it as an image, shape (H, W, 3), uint8: it is drawn once."""
    canvas = FigureCanvasAgg(figure)
    canvas.print_png(path)
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def profile_figure(sample: PixelSample, covariate: str, held_out: np.ndarray) -> Figure:
    """Draw mean and standard deviation of the error against one covariate.

    Left: all stages. Right: after correction, fitted and held-out frames separately.

    Args:
        sample: The pixels.
        covariate: One of its covariates.
        held_out: Global numbers of the frames held out; may be empty.
    """
    figure = Figure(figsize=(11, 4.2))
    left, right = figure.subplots(1, 2)
    # A constrained layout would double the time that drawing takes.
    figure.subplots_adjust(left=0.07, right=0.985, bottom=0.13, top=0.92, wspace=0.17)
    x = sample.covariates[covariate]
    for stage, error in sample.errors_mm.items():
        draw_profile(left, x, error, _COLOURS.get(stage, "k"), _LABELS.get(stage, stage))
    ends = ends_of(x)
    last = list(sample.errors_mm.values())[-1]
    tested = np.isin(sample.frame, held_out)
    for chosen, colour, label in (
        (~tested, "tab:blue", "fitted"),
        (tested, "tab:green", "held out"),
    ):
        if chosen.any():
            draw_profile(right, x[chosen], last[chosen], colour, label, ends)
    left.set_title("All stages: mean, and one standard deviation")
    right.set_title("After correction")
    for axes in (left, right):
        axes.axhline(0, color="0.4", linewidth=0.8)
        axes.set_xlabel(covariate)
        axes.set_ylabel("error along the ray [mm]")
        # The best place would be found by looking at every point.
        axes.legend(loc="upper right", fontsize=8)
        axes.grid(alpha=0.25)
    return figure


def draw_profile(
    axes: Axes,
    x: np.ndarray,
    error: np.ndarray,
    colour: str,
    label: str,
    ends: tuple[float, float] | None = None,
) -> None:
    """Draw the mean of an error over a covariate, and a band of one standard deviation.

    Args:
        axes: Where to draw.
        x: The covariate, shape (M,).
        error: The error of each pixel, shape (M,).
        colour: Of line and band.
        label: Of the line.
        ends: Range of the covariate; its central 99.8 % if None.
    """
    middle, mean, spread = profile(x, error, ends)
    axes.plot(middle, mean, color=colour, label=label, linewidth=1.6)
    axes.fill_between(middle, mean - spread, mean + spread, color=colour, alpha=0.18, linewidth=0)


def residual_figure(images: Sequence[Mapping[str, np.ndarray]], titles: Sequence[str]) -> Figure:
    """Draw the errors of some frames before and after, and after once more on a finer scale.

    Args:
        images: For each frame `before` and `after`, shape (H, W), mm; NaN where not used.
        titles: One a frame.
    """
    num = len(images)
    height, width = images[0]["before"].shape
    inches = 3.0 * height / width
    figure = Figure(figsize=(10, num * inches + 1.2))
    figure.subplots_adjust(
        left=0.06, right=0.99, wspace=0.03, bottom=0.9 / (num * inches + 1.2), top=0.97
    )
    # One picture a column: an axes a frame takes three times as long to draw.
    columns = figure.subplots(1, 3)
    headings = "before", "after, same scale", "after, own scale"
    for axes, heading, (column, limit) in zip(
        columns, headings, columns_of_errors(images), strict=True
    ):
        axes.set_title(heading, fontsize=10)
        axes.set_facecolor("0.75")
        axes.set_xticks([])
        axes.set_yticks([])
        picture = axes.imshow(
            column, cmap="RdBu_r", vmin=-limit, vmax=limit, interpolation="nearest", aspect="auto"
        )
        place = axes.get_position()
        bar_axes = figure.add_axes((place.x0, 0.6 * place.y0, place.width, 0.13 * place.y0))
        bar = figure.colorbar(picture, cax=bar_axes, orientation="horizontal")
        bar.set_label("error along the ray [mm]", fontsize=9)
    middles = (np.arange(num) + 0.5) * (height + gap_rows(height)) - gap_rows(height) / 2 - 0.5
    columns[0].set_yticks(middles, titles, rotation=90, va="center", fontsize=8)
    columns[0].tick_params(length=0)
    return figure


def points_figure(points: Mapping[str, np.ndarray], title: str) -> Figure:
    """Draw a frame's points on its plane, with the distance to the plane stretched.

    Args:
        points: For each stage: two coordinates within the plane in m, and the distance to the
            plane in mm, shape (M, 3).
        title: Which frame it is.
    """
    figure = Figure(figsize=(4.8 * len(points), 4.6))
    figure.subplots_adjust(left=0.0, right=0.96, bottom=0.04, top=0.9, wspace=0.08)
    figure.suptitle(title, fontsize=10)
    heights = np.concatenate([cloud[:, 2] for cloud in points.values()])
    low, high = np.quantile(heights, [0.005, 0.995])
    low, high = min(low, 0.0), max(high, 0.0)
    for k, (stage, cloud) in enumerate(points.items()):
        axes = figure.add_subplot(1, len(points), k + 1, projection="3d")
        _draw_plane(axes, cloud)
        shown = cloud[(cloud[:, 2] >= low) & (cloud[:, 2] <= high)]
        axes.scatter(*shown.T, color=_COLOURS.get(stage, "k"), s=2, alpha=0.6)
        axes.set_zlim(low, high)
        axes.set_title(_LABELS.get(stage, stage), fontsize=10, y=0.94)
        axes.set_xlabel("[m]", fontsize=8)
        axes.set_ylabel("[m]", fontsize=8)
        axes.set_zlabel("in front of the plane [mm]", fontsize=8)
        axes.tick_params(labelsize=7)
        axes.locator_params(nbins=5)
        axes.view_init(elev=10, azim=-60)
        axes.set_box_aspect((1, 1, 0.8))
    return figure


def _draw_plane(axes: Axes, cloud: np.ndarray) -> None:
    corners = [np.array([values.min(), values.max()]) for values in cloud[:, :2].T]
    x, y = np.meshgrid(*corners)
    axes.plot_surface(x, y, np.zeros_like(x), color="0.5", alpha=0.3)  # type: ignore[attr-defined]
