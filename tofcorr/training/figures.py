"""Figures of a calibration: profiles of errors and frames, as numbers, as colours, and drawn."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from tofcorr.geometry.rays import tangents
from tofcorr.pixels.passes import frame_errors
from tofcorr.pixels.sample import PixelSample, errors_along_ray, thinned
from tofcorr.training.calibration import Calibration

if TYPE_CHECKING:  # Matplotlib takes longer to import than a short fit.
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Images = Sequence[Mapping[str, np.ndarray]]
"""For each frame the errors `before` and `after`, shape (H, W), mm; NaN where not used."""

_STAGES = {
    "before": ("before", "tab:red"),
    "hand_eye_only": ("hand-eye only", "tab:orange"),
    "after": ("after", "tab:blue"),
}
# Colours from too near to too far, of 255, in equal steps: the diverging scale of ColorBrewer
# (RdBu). Pixels that are not used are grey, which is no colour of it.
_SCALE = np.array(
    [(33, 102, 172), (146, 197, 222), (247, 247, 247), (244, 165, 130), (178, 24, 43)]
)


def profile(
    x: np.ndarray, error: np.ndarray, ends: tuple[float, float] | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return middles of bins of a covariate, and mean and standard deviation of the error in them.

    There are 30 bins; those of fewer than 30 pixels are left out: their mean is mostly noise.

    Args:
        x: The covariate, shape (M,).
        error: The error of each pixel, shape (M,); NaN is left out.
        ends: Range of the covariate; None: see `ends_of`.
    """
    bins = 30
    edges = np.linspace(*(ends or ends_of(x)), bins + 1)
    number = np.digitize(x, edges) - 1
    inside = (number >= 0) & (number < bins) & np.isfinite(error)
    count, total, square = (
        np.bincount(number[inside], weights, bins)
        for weights in (None, error[inside], error[inside] ** 2)
    )
    enough = count >= 30
    mean = total[enough] / count[enough]
    spread = np.sqrt(np.maximum(square[enough] / count[enough] - mean**2, 0))
    return ((edges[1:] + edges[:-1]) / 2)[enough], mean, spread


def ends_of(x: np.ndarray) -> tuple[float, float]:
    """Return the range of a covariate without the outermost thousandth at either end."""
    low, high = np.quantile(x, (1 / 1000, 1 - 1 / 1000))
    return float(low), float(high)


def columns_of_errors(images: Images) -> list[tuple[np.ndarray, float]]:
    """Return errors before, after, and after on a finer scale: frames below one another, and limit.

    Returns:
        Errors with free rows between the frames, mm, and the limits of their colours, mm: all but
        one pixel in fifty are within.
    """

    def stacked(stage: str) -> np.ndarray:
        gap = np.full((gap_rows(len(images[0][stage])), images[0][stage].shape[1]), np.nan)
        return np.concatenate([part for one in images for part in (one[stage], gap)][:-1])

    before, after = stacked("before"), stacked("after")
    common, own = (
        float(np.nanquantile(np.abs(column), 1 - 1 / 50)) or 1.0
        if np.isfinite(column).any()
        else 1.0
        for column in (before, after)
    )
    return [(before, common), (after, common), (after, own)]


def gap_rows(height: int) -> int:
    """Return the rows left free between two frames, pixels."""
    return max(height // 25, 1)


def coloured(image: np.ndarray, limit: float) -> np.ndarray:
    """Return an image of errors (H, W) in colours, shape (H, W, 3), uint8; NaN is grey."""
    place = (np.clip(image / limit, -1, 1) + 1) / 2 * (len(_SCALE) - 1)
    known, steps = np.isfinite(image), np.arange(len(_SCALE))
    channels = [np.interp(np.where(known, place, 0.0), steps, one) for one in _SCALE.T]
    shown = np.where(known[..., None], np.stack(channels, axis=-1), 190)
    return shown.round().astype(np.uint8)


def error_picture(images: Images, titles: Sequence[str]) -> tuple[np.ndarray, str]:
    """Return errors before, after, and after once more on a finer scale, and what it shows.

    Args:
        images: The errors.
        titles: One a frame.

    Returns:
        One row a frame, (H, W, 3), uint8; and the words, in Markdown. Pictures narrower than 600
        pixels are enlarged by a whole factor.
    """
    columns = columns_of_errors(images)
    first, second, third = (coloured(column, limit) for column, limit in columns)
    free = np.full((len(first), gap_rows(first.shape[1]), 3), 255, dtype=np.uint8)
    picture = np.concatenate([first, free, second, free, third], axis=1)
    factor = -(-600 // picture.shape[1])
    rows = "\n".join(f"{n}. {title.replace(chr(10), ', ')}" for n, title in enumerate(titles, 1))
    scales = f"Left: before, up to {columns[1][1]:.1f} mm; middle: after; right: after, up to"
    scales += f" {columns[2][1]:.2f} mm. From top to bottom:\n\n{rows}"
    words = f"Errors along the ray: blue too near, red too far, grey not used. {scales}"
    return picture.repeat(factor, axis=0).repeat(factor, axis=1), words


def frames_to_show(calibration: Calibration, shown: int = 5, pixels: int = 3_000_000) -> np.ndarray:
    """Return global numbers of frames from the best corrected to the worst, at regular ranks.

    Args:
        calibration: The fitted model.
        shown: How many: as many as fit on a page.
        pixels: About how many are measured to choose them; bounds the time on long recordings.
    """
    data = calibration.data
    most = max(pixels // (data.first.camera.height * data.first.camera.width), shown)
    ranked = thinned(calibration.frames, most)
    errors = frame_errors(data, {"after": calibration.stages["after"]}, ranked)["after"]
    used = errors.count > 0
    order = np.argsort(errors.squared[used] / errors.count[used])
    return thinned(errors.frames[used][order], shown)


def error_images(
    calibration: Calibration, frames: np.ndarray
) -> tuple[list[dict[str, np.ndarray]], list[str]]:
    """Return each frame's errors `before` and `after` along the ray, (H, W), mm, and its title.

    Args:
        calibration: The fitted model.
        frames: Global numbers, in any order.
    """
    data, stages, images, titles = calibration.data, calibration.stages, [], []
    for frame in frames:
        (batch,) = data.batches(np.array([frame]))
        errors = {s: errors_along_ray(data, stages[s], batch)[0] for s in ("before", "after")}
        images.append({stage: error[0].numpy() for stage, error in errors.items()})
        half = "held out" if frame in calibration.test else "fitted"
        titles.append(f"frame {frame}, {data.targets[frame]}\n{half}")
    return images, titles


def save_figure(figure: "Figure", path: Path) -> np.ndarray:
    """Write a figure as PNG; return it as an image, shape (H, W, 3), uint8: it is drawn once."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.print_png(path)
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def profile_figure(sample: PixelSample, covariate: str, held_out: np.ndarray) -> "Figure":
    """Draw mean and standard deviation of the error against one covariate.

    Left: all stages. Right: after correction, fitted and held-out frames separately.

    Args:
        sample: The pixels.
        covariate: One of its covariates.
        held_out: Global numbers of the frames held out; may be empty.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4), layout="constrained")
    panels = figure.subplots(1, 2)
    x, last = sample.covariates[covariate], list(sample.errors_mm.values())[-1]
    ends, tested = ends_of(x), np.isin(sample.frame, held_out)
    for stage, error in sample.errors_mm.items():
        label, colour = _STAGES.get(stage, (stage, "k"))
        draw_profile(panels[0], x, error, colour, label)
    halves = (~tested, "tab:blue", "fitted"), (tested, "tab:green", "held out")
    for chosen, colour, label in halves:
        if chosen.any():
            draw_profile(panels[1], x[chosen], last[chosen], colour, label, ends)
    titles = "All stages: mean, and one standard deviation", "After correction"
    for axes, title in zip(panels, titles, strict=True):
        axes.axhline(0, color="0.4")
        axes.set(title=title, xlabel=covariate, ylabel="error along the ray [mm]")
        # The best place would be found by looking at every point.
        axes.legend(loc="upper right", fontsize="small")
        axes.grid(color="0.9")
    return figure


def draw_profile(
    axes: "Axes",
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
        ends: Range of the covariate; None: see `ends_of`.
    """
    middle, mean, spread = profile(x, error, ends)
    axes.plot(middle, mean, color=colour, label=label)
    axes.fill_between(middle, mean - spread, mean + spread, color=(colour, 0.2), linewidth=0)


def residual_figure(images: Images, titles: Sequence[str]) -> "Figure":
    """Draw the errors of some frames before and after, and after once more on a finer scale.

    Args:
        images: The errors.
        titles: One a frame.
    """
    from matplotlib.figure import Figure

    height, width = images[0]["before"].shape
    figure = Figure(figsize=(10, 3 * len(images) * height / width + 1), layout="constrained")
    # One picture a column: an axes a frame takes three times as long to draw.
    panels = figure.subplots(1, 3)
    headings = "before", "after, same scale", "after, own scale"
    columns = columns_of_errors(images)
    for axes, heading, (column, limit) in zip(panels, headings, columns, strict=True):
        axes.set_title(heading, fontsize="medium")
        axes.set(facecolor="0.75", xticks=[], yticks=[])
        picture = axes.imshow(column, cmap="RdBu_r", vmin=-limit, vmax=limit, aspect="auto")
        figure.colorbar(picture, ax=axes, location="bottom", label="error along the ray [mm]")
    rows = height + gap_rows(height)
    middles = np.arange(len(images)) * rows + (height - 1) / 2
    panels[0].set_yticks(middles, titles, rotation=90, va="center", fontsize="small")
    panels[0].tick_params(length=0)
    return figure


def points_figure(calibration: Calibration, frame: int, points: int = 4000) -> "Figure":
    """Draw a frame's points on its plane at each stage, with the distance to it stretched.

    Args:
        calibration: The fitted model.
        frame: Global number of the frame.
        points: About how many of its points.
    """
    from matplotlib.figure import Figure

    data, clouds = calibration.data, {}
    (batch,) = data.batches(np.array([frame]))
    used = torch.from_numpy(thinned(batch.valid[0].flatten().nonzero()[:, 0].numpy(), points))
    rays, along = data.ray_directions().flatten(0, 1)[used], batch.radial_distance.flatten()[used]
    for name, model in calibration.stages.items():
        error, cosine = errors_along_ray(data, model, batch)
        seen = (rays @ model.hand_eye().detach()[:3, :3].T) * along[:, None]
        within = seen @ tangents(batch.normal_tool[0]).T
        # Two coordinates in the plane, metres, and the distance to it, millimetres, (M, 3).
        clouds[name] = torch.cat([within, (error * cosine).flatten()[used, None]], dim=1).numpy()
    figure = Figure(figsize=(5 * len(clouds), 5), layout="constrained")
    figure.suptitle(f"Frame {frame}, {data.targets[frame]}: points and plane, height stretched")
    low, high = ends_of(np.concatenate([cloud[:, 2] for cloud in clouds.values()]))
    for k, (stage, cloud) in enumerate(clouds.items()):
        axes = figure.add_subplot(1, len(clouds), k + 1, projection="3d")
        label, colour = _STAGES[stage]
        x, y = np.meshgrid(*(np.array([one.min(), one.max()]) for one in cloud[:, :2].T))
        axes.plot_surface(x, y, np.zeros_like(x), color=("0.5", 0.3))  # type: ignore[attr-defined]
        shown = cloud[(cloud[:, 2] >= low) & (cloud[:, 2] <= high)]
        axes.scatter(*shown.T, color=colour, s=2)
        axes.set(title=label, xlabel="[m]", ylabel="[m]", zlabel="in front of the plane [mm]")
        axes.set_zlim(min(low, 0.0), max(high, 0.0))
        axes.view_init(elev=10)
    return figure
