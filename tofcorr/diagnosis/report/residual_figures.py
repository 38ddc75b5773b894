"""Figures of the residual: along covariates, over the image, and from pose to pose."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tofcorr.conditions import CONDITIONS, condition
from tofcorr.diagnosis.findings.where import Region, Stage
from tofcorr.diagnosis.report.stage_figures import STAGE_COLOURS, STAGE_WORDS
from tofcorr.diagnosis.report.style import GREY, RED, WIDTH, single_axes
from tofcorr.diagnosis.report.words import p_words

# Covariates that are drawn: three rows of two.
_MOST_STRIPS = 6
# Height of a row of strips, inches. Chosen.
_STRIP_HEIGHT = 1.75
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


def axis_label(covariate: str) -> str:
    """Return what a covariate is called on an axis, with its unit."""
    return _LABELS.get(covariate, covariate)


def name_of(covariate: str) -> str:
    """Return what a covariate is called in a sentence: as on an axis, without its unit."""
    return axis_label(covariate).split(",")[0]


def most_biased(groups: Mapping[str, Sequence[Region]]) -> list[tuple[str, Sequence[Region]]]:
    """Return covariates and their regions: the most significant first, then the widest range."""

    def order(item: tuple[str, Sequence[Region]]) -> tuple[float, float]:
        return min(region.p_value for region in item[1]), -range_of(item[1])

    return sorted(groups.items(), key=order)


def range_of(regions: Sequence[Region]) -> float:
    """Return the largest bias of a covariate's bins minus the smallest, metres."""
    biases = [region.bias for region in regions if not region.trend]
    return max(biases) - min(biases) if biases else 0.0


def covariate_strips(stages: Sequence[Stage], least_p: float, most: int = _MOST_STRIPS) -> Figure:
    """Draw the bias along the covariates of `most_biased` at the first of the stages.

    Args:
        stages: One or more, which are drawn over each other.
        least_p: The smallest p-value that the test can give.
        most: Covariates that are drawn at most.
    """
    by_stage = [one.found_where.by_covariate() for one in stages]
    groups = most_biased(by_stage[0])[:most]
    rows = max(1, -(-len(groups) // 2))
    height = _STRIP_HEIGHT * rows
    figure = Figure(figsize=(WIDTH, height))
    figure.subplots_adjust(
        left=0.14, right=0.98, bottom=0.4 / height, top=1 - 0.25 / height, hspace=0.75, wspace=0.22
    )
    for number, (name, regions) in enumerate(groups):
        axes = figure.add_subplot(rows, 2, number + 1)
        for first, (stage, found) in enumerate(zip(stages, by_stage, strict=True)):
            bins = [region for region in found.get(name, []) if not region.trend]
            _strip(axes, bins, STAGE_COLOURS[stage.name], band=first == 0)
        axes.axhline(0, color="black", linewidth=0.8)
        axes.set_xlabel(axis_label(name), fontsize=9)
        best = min(region.p_value for region in regions)
        colour = RED if best <= _SIGNIFICANT else GREY
        axes.set_title(f"p {p_words(best, least_p)}", fontsize=9, color=colour)
        axes.tick_params(labelsize=8)
        axes.locator_params(nbins=5)
    figure.supylabel("bias, mm", x=0.01, fontsize=9)
    return figure


def _strip(axes: Axes, regions: Sequence[Region], colour: str, *, band: bool) -> None:
    if not regions:
        return
    middle = [(region.low + region.high) / 2 for region in regions]
    bias = [1e3 * region.bias for region in regions]
    axes.plot(middle, bias, "o-", color=colour, markersize=3, linewidth=1.2)
    if band:
        low = [1e3 * region.interval[0] for region in regions]
        high = [1e3 * region.interval[1] for region in regions]
        axes.fill_between(middle, low, high, color=colour, alpha=0.15, linewidth=0)


def image_maps(stages: Sequence[Stage]) -> Figure:
    """Draw the mean residual over the image at each stage, each with a scale of its own.

    Args:
        stages: Those that exist.
    """
    figure = Figure(figsize=(WIDTH, 2.4))
    figure.subplots_adjust(left=0.02, right=0.98, bottom=0.2, top=0.9, wspace=0.1)
    for number, stage in enumerate(stages):
        where = stage.found_where
        axes = figure.add_subplot(1, len(stages), number + 1)
        most = float(np.nanmax(np.abs(1e3 * where.tiles), initial=0.0))
        limit = max(most, _LEAST_COLOUR_LIMIT)
        shown = axes.imshow(
            1e3 * where.tiles, cmap="RdBu_r", vmin=-limit, vmax=limit, aspect="auto"
        )
        axes.set_title(STAGE_WORDS[stage.name], fontsize=9, color=STAGE_COLOURS[stage.name])
        axes.set_xticks([])
        axes.set_yticks([])
        rows, columns = np.nonzero(where.tile_p_values <= _SIGNIFICANT)
        axes.plot(columns, rows, "k.", markersize=3)
        bar = figure.colorbar(shown, ax=axes, orientation="horizontal", fraction=0.06, pad=0.04)
        bar.ax.tick_params(labelsize=8)
        bar.ax.locator_params(nbins=5)
        bar.set_label("mean residual, mm", fontsize=8)
    return figure


def pose_series(stages: Sequence[Stage]) -> Figure:
    """Draw the mean residual of each pose in the order of the recording.

    Args:
        stages: Those to be drawn over each other.
    """
    figure, axes = single_axes(WIDTH, 2.4)
    figure.subplots_adjust(left=0.12, right=0.98, top=0.88)
    for stage in stages:
        axes.plot(
            1e3 * stage.found_where.offsets,
            ".-",
            color=STAGE_COLOURS[stage.name],
            linewidth=0.8,
            label=STAGE_WORDS[stage.name],
        )
    axes.axhline(0, color="black", linewidth=0.8)
    axes.set_xlabel("pose, in the order of the recording", fontsize=9)
    axes.set_ylabel("mean residual, mm", fontsize=9)
    axes.tick_params(labelsize=8)
    axes.legend(
        fontsize=8,
        frameon=False,
        ncols=2,
        loc="lower right",
        bbox_to_anchor=(1.0, 0.97),
        borderpad=0,
    )
    return figure
