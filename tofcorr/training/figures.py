"""Figures of a calibration: profiles of errors and frames, as numbers, as colours, and drawn."""

from typing import TYPE_CHECKING

import numpy as np

from tofcorr.estimation.robust import without_strays
from tofcorr.pixels.sample import PixelSample, errors_along_ray, thinned
from tofcorr.training.calibration import Calibration

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


def error_picture(calibration: Calibration) -> tuple[np.ndarray, str]:
    """Return errors of some frames before, after, and after once more on a finer scale, in colours.

    Returns:
        One row a frame, from the best corrected to the worst, shape (H, W, 3), uint8; and what it
        shows, in Markdown. Pictures narrower than 600 pixels are enlarged by a whole factor.
    """
    from tofcorr.pages.drawing import coloured

    data, stages, titles = calibration.data, calibration.stages, []
    gap, columns = max(data.first.camera.height // 25, 1), {"before": [], "after": []}
    for frame in frames_to_show(calibration):
        (batch,) = data.batches(np.array([frame]))
        for stage, column in columns.items():
            error = errors_along_ray(data, stages[stage], batch)[0][0].numpy()
            column.append(np.pad(error, ((0, gap), (0, gap)), constant_values=np.nan))
        half = "held out" if frame in calibration.test else "fitted"
        titles.append(f"{len(titles) + 1}. frame {frame}, {data.targets[frame]}, {half}")
    before, after = (np.concatenate(column) for column in columns.values())
    # All but one pixel in fifty are within the limits of the colours.
    sizes = (np.abs(one[np.isfinite(one)]) for one in (before, after))
    common, own = (float(np.quantile(one, 1 - 1 / 50)) or 1.0 if len(one) else 1.0 for one in sizes)
    shown = (before, common), (after, common), (after, own)
    picture = np.concatenate([coloured(*one) for one in shown], axis=1)
    factor = -(-600 // picture.shape[1])
    words = (
        "Errors along the ray: purple too near, orange too far, grey not used. Left: before, up to "
        f"{common:.1f} mm; middle: after; right: after, up to {own:.2f} mm. From top to bottom:\n\n"
    )
    return picture.repeat(factor, axis=0).repeat(factor, axis=1), words + "\n".join(titles)


def frames_to_show(calibration: Calibration) -> np.ndarray:
    """Return global numbers of five frames from the best corrected to the worst, by their ranks."""
    errors = calibration.errors["after"]
    used = (errors.count > 0) & np.isin(errors.frames, calibration.frames)
    order = np.argsort(errors.squared[used] / errors.count[used])
    return thinned(errors.frames[used][order], 5)


def profile_figure(sample: PixelSample, covariate: str, held_out: np.ndarray) -> "Figure":
    """Draw mean and standard deviation of the error against one covariate.

    Above: all stages. Below: after correction, fitted and held-out frames separately.

    Args:
        sample: The pixels.
        covariate: One of its covariates.
        held_out: Global numbers of the frames held out; may be empty.
    """
    from tofcorr.pages.drawing import BLUE, GREY, PALE, RED, line_across, panels

    figure, found = panels(5, 2)
    x, last = sample.covariates[covariate], list(sample.errors_mm.values())[-1]
    ends, tested = without_strays(x), np.isin(sample.frame, held_out)
    colours = {"before": RED, "hand_eye_only": GREY}
    for stage, error in sample.errors_mm.items():
        label = stage.replace("hand_eye", "hand-eye").replace("_", " ")
        draw_profile(found[0], x, error, ends, colours.get(stage, BLUE), label)
    for chosen, colour, label in ((~tested, PALE, "fitted"), (tested, BLUE, "held out")):
        if chosen.any():
            draw_profile(found[1], x[chosen], last[chosen], ends, colour, label)
    titles = "All stages: mean, and one standard deviation", "After correction"
    for axes, title in zip(found, titles, strict=True):
        line_across(axes)
        axes.set(xlabel=covariate, ylabel="error along the ray [mm]")
        axes.set_title(title, fontsize=10)
        # The best place would be found by looking at every point.
        axes.legend(loc="upper right", fontsize=9, frameon=False)
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
    axes.fill_between(middle, mean - spread, mean + spread, color=(colour, FAINT), linewidth=0)


def residual_figure(calibration: Calibration) -> "Figure":
    """Draw what `error_picture` returns, with its words."""
    from matplotlib.figure import Figure

    picture, words = error_picture(calibration)
    height = 10 * picture.shape[0] / picture.shape[1] + 2
    figure = Figure(figsize=(10, height), layout="constrained")
    axes = figure.subplots()
    axes.imshow(picture)
    axes.set_axis_off()
    axes.set_title(words, fontsize="small", loc="left")
    return figure
