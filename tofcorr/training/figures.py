"""Figures of a calibration: errors of frames and over covariates, the poses, the hand-eye."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from tofcorr.estimation.robust import LEVEL, without_strays
from tofcorr.pixels.sample import PixelSample, errors_along_ray, thinned
from tofcorr.training.advice import along_axis
from tofcorr.training.calibration import Calibration
from tofcorr.training.judgement import stage_words

if TYPE_CHECKING:  # Matplotlib takes longer to import than a short fit.
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Ends = tuple[float, float]
"""Range of a covariate."""


def profile(
    x: np.ndarray, error: np.ndarray, ends: Ends
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return middles of bins of a covariate, and mean and standard deviation of the error in them.

    There are 30 bins. In those of fewer than 30 pixels both are NaN: they would be mostly noise.

    Args:
        x: The covariate, shape (M,).
        error: The error of each pixel, shape (M,); NaN is left out.
        ends: Range of the covariate.
    """
    bins = 30
    edges = np.linspace(*ends, bins + 1)
    number = np.digitize(x, edges) - 1
    inside = (number >= 0) & (number < bins) & np.isfinite(error)
    count, total, square = (
        np.bincount(number[inside], weights, bins)
        for weights in (None, error[inside], error[inside] ** 2)
    )
    count = np.where(count >= 30, count, np.nan)
    mean = total / count
    spread = np.sqrt(np.maximum(square / count - mean**2, 0))
    return (edges[1:] + edges[:-1]) / 2, mean, spread


def tile_means(pixel: np.ndarray, values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the mean of values in tiles of the image; NaN in a tile without any.

    Args:
        pixel: Numbers of the pixels, counted row by row, shape (M,).
        values: Shape (M,).
        shape: Of the image.
    """
    # Single pixels would show noise alone: sixteen tiles along the longer side.
    side = max(1, max(shape) // 16)
    rows, columns = (-(-length // side) for length in shape)
    place = pixel // shape[1] // side * columns + pixel % shape[1] // side
    count = np.bincount(place, minlength=rows * columns)
    total = np.bincount(place, values, minlength=rows * columns)
    return np.divide(total, np.where(count, count, np.nan)).reshape(rows, columns)


def frames_to_show(calibration: Calibration) -> np.ndarray:
    """Return global numbers of five frames from the best corrected to the worst, by their ranks."""
    errors = calibration.errors["after"]
    used = (errors.count > 0) & np.isin(errors.frames, calibration.frames)
    order = np.argsort(errors.squared[used] / errors.count[used])
    return thinned(errors.frames[used][order], 5)


def profile_figure(
    sample: PixelSample, covariates: Sequence[str], held_out: np.ndarray
) -> "Figure":
    """Draw mean and standard deviation of the error against covariates, a column each.

    Above: all stages. In the middle: after correction, fitted and held-out frames separately.
    Below: how many pixels there are.

    Args:
        sample: The pixels.
        covariates: Some of its covariates.
        held_out: Global numbers of the frames held out; may be empty.
    """
    from tofcorr.pages.drawing import BLUE, GREY, PALE, STAGES, line_across, panels

    count, last = len(covariates), list(sample.errors_mm.values())[-1]
    figure, found = panels(5, 3, count, same_rows=True, shares=(3, 3, 1))
    tested = np.isin(sample.frame, held_out)
    halves = (~tested, PALE, "after: fitted"), (tested, BLUE, "after: held out")
    for covariate, above, middle, below in zip(
        covariates, found, found[count:], found[2 * count :], strict=False
    ):
        x = sample.covariates[covariate]
        ends = without_strays(x)
        for stage, error in sample.errors_mm.items():
            words = stage_words(stage)
            draw_profile(above, x, error, ends, STAGES.get(words, BLUE), words)
        for chosen, colour, label in halves:
            if chosen.any():
                draw_profile(middle, x[chosen], last[chosen], ends, colour, label)
        below.hist(x, bins=30, range=ends, color=GREY)
        below.set(xlabel=covariate, yticks=[])
        for axes in (above, middle, below):
            axes.set_xlim(*ends)
            axes.locator_params(axis="x", nbins=5)
        for axes in (above, middle):
            line_across(axes)
            axes.set_xticklabels([])
    lines = [*found[0].get_lines()[: len(sample.errors_mm)], *found[count].get_lines()[:-1]]
    figure.legend(handles=lines, fontsize=8, frameon=False, ncols=5, loc="outside upper left")
    found[0].set_ylabel("error along the ray, mm")
    found[count].set_ylabel("after correction, mm")
    found[2 * count].set_ylabel("pixels")
    return figure


def draw_profile(
    axes: "Axes", x: np.ndarray, error: np.ndarray, ends: Ends, colour: str, label: str
) -> None:
    """Draw the mean of an error over a covariate, and a band of one standard deviation.

    Args:
        axes: Where to draw.
        x: The covariate, shape (M,).
        error: The error of each pixel, shape (M,).
        ends: Range of the covariate.
        colour: Of line and band.
        label: Of the line.
    """
    from tofcorr.pages.drawing import FAINT

    middle, mean, spread = profile(x, error, ends)
    axes.plot(middle, mean, color=colour, label=label)
    axes.fill_between(middle, mean - spread, mean + spread, color=colour, alpha=FAINT, linewidth=0)


def image_figure(sample: PixelSample, shape: tuple[int, int]) -> "Figure":
    """Draw the mean error over the image (H, W) at each stage, each on a scale of its own."""
    from tofcorr.pages.drawing import BLUE, SIGNED, STAGES, image_map, panels

    figure, found = panels(1 + 1.7 * shape[0] / shape[1], 1, len(sample.errors_mm))
    row, column = (sample.covariates[f"{name} [pixel]"] for name in ("row", "column"))
    pixel = (row * shape[1] + column).astype(int)
    for axes, (stage, error) in zip(found, sample.errors_mm.items(), strict=True):
        tiles = tile_means(pixel, error, shape)
        limit = float(np.nanmax(np.abs(tiles), initial=0.0)) or 1.0
        image_map(axes, tiles, "mean error, mm", (-limit, limit), SIGNED)
        words = stage_words(stage)
        axes.set_title(words, fontsize=9, color=STAGES.get(words, BLUE))
    return figure


def residual_figure(calibration: Calibration, frames: np.ndarray) -> "Figure":
    """Draw errors of some frames before, after, and after once more on a finer scale.

    All but one pixel in fifty are within the limits of the colours.

    Args:
        calibration: The fitted model and its errors.
        frames: Global numbers of the frames, from top to bottom.
    """
    from tofcorr.pages.drawing import SIGNED, image_map, panels

    data, camera = calibration.data, calibration.data.first.camera
    gap, columns = max(camera.height // 25, 1), {"before": [], "after": []}
    for frame in frames:
        (batch,) = data.batches(np.array([frame]))
        for stage, column in columns.items():
            error = errors_along_ray(data, calibration.stages[stage], batch)[0][0].numpy()
            column.append(np.pad(error, ((0, gap), (0, 0)), constant_values=np.nan))
    before, after = (np.concatenate(column) for column in columns.values())
    sizes = (np.abs(one[np.isfinite(one)]) for one in (before, after))
    common, own = (float(np.quantile(one, 1 - 1 / 50)) or 1.0 if len(one) else 1.0 for one in sizes)
    figure, found = panels(1 + 1.7 * len(before) / camera.width, 1, 3)
    shown = ("before", before, common), ("after", after, common), ("after, finer", after, own)
    for axes, (title, image, limit) in zip(found, shown, strict=True):
        image_map(axes, image, "error, mm", (-limit, limit), SIGNED)
        axes.set_title(title, fontsize=9)
    halves = np.where(np.isin(frames, calibration.test), "held out", "fitted")
    names = [
        f"frame {k}\n{data.targets[k]}\n{half}" for k, half in zip(frames, halves, strict=True)
    ]
    rows = (np.arange(len(frames)) + 1 / 2) * (len(before) / len(frames))
    found[0].set_yticks(rows, names, fontsize=7)
    found[0].tick_params(length=0)
    return figure


def before_walls(cameras: Tensor, plane: tuple[Tensor, Tensor]) -> tuple[np.ndarray, np.ndarray]:
    """Return where cameras stand before their walls, and the direction in which they look.

    The axes are to the right along the wall, up along it, and away from it; the origin is the
    middle of what the cameras look at. "Up" is the world's z axis, or y where the wall is level.

    Args:
        cameras: world_from_camera, shape (N, 4, 4).
        plane: Of the wall that each looks at: normals towards the camera, shape (N, 3), and
            offsets, shape (N,).

    Returns:
        Places, metres, and unit vectors, shape (N, 3) each.
    """
    (normal, offset), centre, forward = plane, cameras[:, :3, 3], cameras[:, :3, 2]
    level = int(normal.mean(dim=0).abs().argmax()) == 2
    up = torch.eye(3, dtype=normal.dtype)[1 if level else 2].expand_as(normal)
    right = normalize(torch.linalg.cross(up, normal), dim=1)
    axes = torch.stack([right, torch.linalg.cross(normal, right), normal], dim=1)
    seen = centre + along_axis(cameras, plane)[:, None] * forward
    middle = seen.nan_to_num().median(dim=0).values
    place = torch.einsum("nij,nj->ni", axes, centre - middle)
    place[:, 2] = (normal * centre).sum(dim=1) + offset
    return place.numpy(), torch.einsum("nij,nj->ni", axes, forward).numpy()


def poses_figure(
    calibration: Calibration, advised: Tensor, known: Sequence[Mapping[str, float]]
) -> "Figure":
    """Draw the wall and where the camera stood and looked, from above and from the side, to scale.

    Args:
        calibration: The fitted model and its errors.
        advised: world_from_tool of poses to add, each before the wall of a fitted frame, shape
            (K, 4, 4); drawn with their numbers.
        known: `correction_curves` over the distance: the redder a strip, the less well is the
            error known at that distance.
    """
    from tofcorr.pages.drawing import BLUE, RED, panels

    data, hand_eye = calibration.data, calibration.fit.solution.parameters.tool_from_camera
    *columns, poses = data.planes_and_poses()
    first = int(calibration.train[0])
    walls = [torch.cat([one, one[first].expand(len(advised), *one.shape[1:])]) for one in columns]
    cameras = torch.cat([poses, advised]) @ hand_eye
    place, way = before_walls(cameras, (walls[0], walls[1]))
    fitted, tested = (
        np.isin(np.arange(data.num_frames), k) for k in (calibration.train, calibration.test)
    )
    groups = (
        (fitted, "o", BLUE, BLUE, "fitted"),
        (tested, "o", BLUE, "white", "held out"),
        (~(fitted | tested), "X", RED, RED, "left out"),
    )
    figure, found = panels(3, 1, 2)
    length = float(np.ptp(place, axis=0).max()) / 12
    distance, error = (
        np.array([one[k] for one in known]) for k in ("radial_distance_m", "standard_error_mm")
    )
    for axes, across, label in zip(found, (0, 1), ("to the right, m", "up, m"), strict=True):
        for low, high, size in zip(distance, distance[1:], error, strict=False):
            axes.axvspan(low, high, color=RED, alpha=size / error.max() / 2, linewidth=0)
        axes.axvline(0, color="black", linewidth=4)
        at = place[:, [2, across]]
        ends = at + length * way[:, [2, across]]
        for chosen, mark, colour, inside, name in groups:
            own = np.flatnonzero(chosen)
            if len(own):
                axes.plot(
                    *np.stack([at[own], ends[own]]).transpose(2, 0, 1), color=colour, linewidth=1
                )
                look = {"color": colour, "markerfacecolor": inside, "markersize": 4, "label": name}
                axes.plot(*at[own].T, mark, **look)
        for number, (x, y) in enumerate(at[data.num_frames :], start=1):
            axes.plot(
                *np.stack([at, ends])[:, data.num_frames + number - 1].T, color="black", linewidth=1
            )
            axes.plot(x, y, "D", color="black", markersize=4)
            axes.annotate(f" {number}", (x, y), fontsize=9, weight="bold")
        axes.set_aspect("equal", adjustable="datalim")
        axes.set(xlabel="distance from the wall, m", ylabel=label)
        axes.set_title(("from above", "from the side")[across], fontsize=9)
    figure.legend(
        *found[0].get_legend_handles_labels(),
        fontsize=8,
        ncols=3,
        loc="outside upper right",
        frameon=False,
    )
    return figure


def ellipse(covariance: np.ndarray, degrees_of_freedom: int) -> np.ndarray:
    """Return points of the ellipse that holds two unknowns with 95 %, shape (2, P), around zero.

    Its radius, in standard deviations, is that of Hotelling's T^2 of two unknowns, whose F
    distribution of two and n degrees of freedom has a closed form.

    Args:
        covariance: Of the two, shape (2, 2).
        degrees_of_freedom: n, of the covariance.
    """
    values, vectors = np.linalg.eigh(covariance)
    radius = (degrees_of_freedom * (LEVEL ** (-2 / degrees_of_freedom) - 1)) ** 0.5
    angle = np.linspace(0, 2 * np.pi, 100)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    return radius * vectors @ (np.sqrt(values.clip(min=0))[:, None] * circle)


def hand_eye_figure(hand_eye: Mapping[str, Any], degrees_of_freedom: int) -> "Figure":
    """Draw 95 % ellipses of translation and rotation around the estimate, x-y and x-z.

    Args:
        hand_eye: That of the report, with its covariance.
        degrees_of_freedom: Of the covariance.
    """
    from tofcorr.pages.drawing import BLUE, FAINT, line_across, panels

    figure, found = panels(5, 2, 2)
    covariance = np.array(hand_eye["covariance_mm_deg"])
    for axes, (start, other) in zip(found, ((0, 1), (0, 2), (3, 4), (3, 5)), strict=True):
        points = ellipse(covariance[np.ix_([start, other], [start, other])], degrees_of_freedom)
        axes.fill(*points, color=BLUE, alpha=FAINT)
        axes.plot(*points, color=BLUE)
        line_across(axes)
        line_across(axes, vertical=True)
        kind, unit = ("turn about", "deg") if start else ("shift along", "mm")
        axes.set(xlabel=f"{kind} x, {unit}", ylabel=f"{kind} {'xyz'[other - start]}, {unit}")
        axes.set_aspect("equal", adjustable="datalim")
    return figure
