"""Figures of the residual: along covariates, over the image, and from pose to pose."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tofcorr.conditions import CONDITIONS, condition
from tofcorr.diagnosis.findings.where import Region, Where
from tofcorr.diagnosis.report.style import BLUE, GREY, RED, single_axes

# Covariates that are drawn: two rows of three.
_MOST_STRIPS = 6
# Least limit of the colour scale, millimetres, so that noise does not look like structure.
_LEAST_COLOUR_LIMIT = 0.5
# p-value below which a tile gets a dot. 5 % by convention.
_SIGNIFICANT = 0.05
_LABELS = {
    "distance_m": "distance, m",
    "row": "row, px",
    "column": "column, px",
    "image_radius": "radius in the image (1: edge)",
    "incidence_deg": "incidence angle, deg",
    "amplitude": "amplitude, counts",
    "phase_quarter_deg": "four times the phase, deg",
    **{each.covariate: each.label for each in map(condition, CONDITIONS)},
    "frame": "frame number",
    "target_x_m": "target x, m",
    "target_y_m": "target y, m",
    "tool_x_m": "tool x, m",
    "tool_y_m": "tool y, m",
    "tool_z_m": "tool z, m",
}


def covariate_strips(before: Where, after: Where) -> Figure:
    """Draw the bias along the covariates where it is most significant.

    Args:
        before: Of the base model.
        after: With the named effects.
    """
    groups = list(before.by_covariate().items())[:_MOST_STRIPS]
    afterwards = after.by_covariate()
    rows = max(1, -(-len(groups) // 3))
    figure = Figure(figsize=(10.5, 2.6 * rows))
    figure.subplots_adjust(
        left=0.07, right=0.985, bottom=0.42 / (2.6 * rows), top=1 - 0.3 / (2.6 * rows), hspace=0.5
    )
    for number, (name, regions) in enumerate(groups):
        axes = figure.add_subplot(rows, 3, number + 1)
        _strip(axes, [region for region in regions if not region.trend], RED, band=True)
        _strip(axes, [r for r in afterwards.get(name, []) if not r.trend], BLUE, band=False)
        axes.axhline(0, color="black", linewidth=0.8)
        axes.set_xlabel(_LABELS.get(name, name), fontsize=9)
        best = min(region.p_value for region in regions)
        colour = RED if best <= _SIGNIFICANT else GREY
        axes.set_title(f"p = {best:.3f}", fontsize=9, color=colour)
        axes.tick_params(labelsize=8)
        if number % 3 == 0:
            axes.set_ylabel("bias, mm", fontsize=9)
    return figure


def _strip(axes: Axes, regions: list[Region], colour: str, *, band: bool) -> None:
    if not regions:
        return
    middle = [(region.low + region.high) / 2 for region in regions]
    bias = [1e3 * region.bias for region in regions]
    axes.plot(middle, bias, "o-", color=colour, markersize=3, linewidth=1.2)
    if band:
        low = [1e3 * region.interval[0] for region in regions]
        high = [1e3 * region.interval[1] for region in regions]
        axes.fill_between(middle, low, high, color=colour, alpha=0.15, linewidth=0)


def image_maps(before: Where, after: Where) -> Figure:
    """Draw the mean residual over the image.

    Args:
        before: Of the base model.
        after: With the named effects.
    """
    figure = Figure(figsize=(9.0, 3.1))
    figure.subplots_adjust(left=0.03, right=0.93, bottom=0.03, top=0.9, wspace=0.08)
    limit = max(float(np.nanmax(np.abs(1e3 * before.tiles), initial=0.0)), _LEAST_COLOUR_LIMIT)
    left, right = figure.subplots(1, 2)
    for axes, where, title in ((left, before, "before"), (right, after, "with the effects")):
        shown = axes.imshow(
            1e3 * where.tiles, cmap="RdBu_r", vmin=-limit, vmax=limit, aspect="auto"
        )
        axes.set_title(title, fontsize=10)
        axes.set_xticks([])
        axes.set_yticks([])
    rows, columns = np.nonzero(before.tile_p_values <= _SIGNIFICANT)
    left.plot(columns, rows, "k.", markersize=4)
    bar = figure.colorbar(shown, ax=[left, right], fraction=0.03, pad=0.02)
    bar.set_label("mean residual, mm", fontsize=9)
    return figure


def pose_series(before: Where, after: Where) -> Figure:
    """Draw the mean residual of each pose in the order of the recording.

    Args:
        before: Of the base model.
        after: With the named effects.
    """
    figure, axes = single_axes(9.0, 2.4)
    for where, colour, label in ((before, RED, "before"), (after, BLUE, "with the effects")):
        axes.plot(1e3 * where.offsets, ".-", color=colour, linewidth=0.8, label=label)
    axes.axhline(0, color="black", linewidth=0.8)
    axes.set_xlabel("pose, in the order of the recording")
    axes.set_ylabel("mean residual, mm")
    axes.legend(fontsize=8, frameon=False, ncols=2)
    return figure
