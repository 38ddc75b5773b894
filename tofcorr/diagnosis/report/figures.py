"""Figures of a diagnosis: the gap, the residual, the effects and the poses."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tofcorr.diagnosis.findings.shares import TWO_SIDED
from tofcorr.diagnosis.findings.where import Estimated, Interval
from tofcorr.diagnosis.report.words import (
    SHARE_ENDS,
    STAGE_WORDS,
    axis_label,
    cause_words,
    effect_words,
    mm,
    most_biased,
    p_words,
    pose_errors,
    share_words,
    stages_shown,
)
from tofcorr.diagnosis.sums.study import LEAST_LEFT, Study, absorbed_share, left_over
from tofcorr.estimation.robust import LEVEL
from tofcorr.observables.figures import drawings as observable_drawings
from tofcorr.pages.drawing import (
    BLUE,
    FAINT,
    GREY,
    LIGHT,
    PALE,
    RED,
    SIGNED,
    TINT,
    image_map,
    line_across,
    panels,
    plain_look,
)

if TYPE_CHECKING:
    from tofcorr.diagnosis.report.result import DiagnosisResult

STAGE_COLOURS = {"as_given": GREY, "recalibrated": RED, "with_effects": BLUE}
"""The colour of a stage in every figure."""
_KIND_COLOURS = {"parameter": GREY, "effect": RED, "unexplained": LIGHT}


def all_figures(result: "DiagnosisResult") -> dict[str, Figure]:
    """Return every figure that the findings allow, by its name on the report page."""
    left_out = ("where_as_given",) if result.stages[0].gap is None else ()
    own = {name: draw(result) for name, draw in FIGURES.items() if name not in left_out}
    return own | {name: draw() for name, draw in observable_drawings(result.observables).items()}


Bar = tuple[str, Estimated, str]
"""Name, length with its interval, and colour."""


def stage_bars(result: "DiagnosisResult") -> Figure:
    """Draw the gap at each stage and after each named effect in turn, and the noise of a pixel."""
    bars: list[Bar] = [
        (STAGE_WORDS[one.name], one.gap, STAGE_COLOURS[one.name])
        for one in stages_shown(result)
        if one.gap is not None
    ]
    steps = [
        (f"+ {effect_words(result.evidence.study, name)}", size, BLUE)
        for name, size in result.gap_steps
    ]
    if steps:  # The last one is the stage with the effects.
        bars[-1:] = steps
    if result.degraded is not None:
        bars.append(("degraded frames", result.degraded.gap, PALE))
    label, limits = "gap, mm (root mean square, noise taken off)", (-math.inf, math.inf)
    figure, axes = _bars(bars, 1e3, label, lambda size: f"{mm(size)} mm", limits)
    floor = 1e3 * result.gap.floor
    if floor < axes.get_xlim()[1]:  # A card tells a larger one.
        axes.axvline(floor, color="black", linestyle=":", linewidth=1, label="noise of one pixel")
        figure.legend(fontsize=8, frameon=False, loc="outside upper right")
    return figure


def attribution_bars(result: "DiagnosisResult") -> Figure:
    """Draw the share of each cause in the squared gap, the largest first, the unexplained last."""
    shares = sorted(result.shares, key=lambda one: (one.kind == "unexplained", -one.share))
    study = result.evidence.study
    bars = [(cause_words(study, one), one.share, _KIND_COLOURS[one.kind]) for one in shares]
    figure, axes = _bars(bars, 100, "share of the squared gap, %", share_words, SHARE_ENDS)
    line_across(axes, vertical=True)
    return figure


def _bars(
    bars: Sequence[Bar], scale: float, label: str, words: Callable[[float], str], limits: Interval
) -> tuple[Figure, Axes]:
    """Draw bars from top to bottom, their lengths in words in a column at the right.

    Args:
        bars: What is drawn.
        scale: What lengths are multiplied by.
        label: Of the axis.
        words: Says a length.
        limits: Where intervals are cut off.
    """
    figure, (axes,) = panels(1 + len(bars) / 3)
    places, ends = np.arange(len(bars))[::-1], [0.0]
    for place, (_, size, colour) in zip(places, bars, strict=True):
        interval = scale * np.clip(size.interval, *limits)
        ends += [scale * size, *interval]
        axes.barh(place, scale * size, color=colour)
        axes.plot(interval, [place, place], color="black", marker="|")
        where = ("axes fraction", "data")
        axes.annotate(f"  {words(size)}", (1, place), xycoords=where, va="center", fontsize=9)
    margin = (max(ends) - min(ends)) / 30
    axes.set_xlim(min(ends) - margin if min(ends) < 0 else 0.0, max(ends) + (margin or 1.0))
    # A label is broken before what stands in brackets, so that room is left for the bars.
    axes.set_yticks(places, [name.replace(" (", "\n(") for name, *_ in bars], fontsize=9)
    axes.set_xlabel(label)
    return figure, axes


def covariate_strips(result: "DiagnosisResult", *, as_given: bool = False) -> Figure:
    """Draw the bias along the covariates of `most_biased`, six at most.

    Args:
        result: What was found.
        as_given: Whether of the simulator as given; else after recalibration, where they are
            chosen, and over that with the effects.
    """
    stages = stages_shown(result)[:1] if as_given else stages_shown(result, fitted=True)
    by_stage = [one.by_covariate() for one in stages]
    groups = most_biased(by_stage[0])[:6]
    rows = max(1, -(-len(groups) // 2))
    figure, found = panels(2 * rows, rows, 2)
    for axes in found[len(groups) :]:
        axes.remove()
    for axes, (name, regions) in zip(found, groups, strict=False):
        for stage, of_stage in zip(stages, by_stage, strict=True):
            bins = [region for region in of_stage.get(name, []) if not region.trend]
            middle = [(region.low + region.high) / 2 for region in bins]
            colour = STAGE_COLOURS[stage.name]
            axes.plot(middle, [1e3 * one.bias for one in bins], "o-", color=colour, markersize=3)
            if stage is stages[0]:
                low, high = ([1e3 * one.bias.interval[side] for one in bins] for side in (0, 1))
                axes.fill_between(middle, low, high, color=colour, alpha=FAINT, linewidth=0)
        line_across(axes)
        axes.set_xlabel(axis_label(name))
        best = min(region.p_value for region in regions)
        colour = RED if best <= LEVEL else GREY
        least = 1 / (result.options.tests.flips + 1)  # That the sign flips can give.
        axes.set_title(f"p {p_words(best, least)}", color=colour, fontsize=9)
        axes.locator_params(nbins=5)
    figure.supylabel("bias, mm", fontsize=9)
    return figure


def image_maps(result: "DiagnosisResult") -> Figure:
    """Draw the mean residual over the image at each stage, each with a scale of its own."""
    stages = stages_shown(result)
    figure, found = panels(2, 1, len(stages))
    for axes, stage in zip(found, stages, strict=True):
        tiles = 1e3 * stage.tiles
        # A least limit, so that noise does not look like structure.
        limit = max(float(np.nanmax(np.abs(tiles), initial=0.0)), 0.5)
        image_map(axes, tiles, "mean residual, mm", (-limit, limit), SIGNED)
        axes.set_aspect("auto")
        axes.set_title(STAGE_WORDS[stage.name], color=STAGE_COLOURS[stage.name], fontsize=9)
        rows, columns = np.nonzero(stage.tile_p_values <= LEVEL)
        axes.plot(columns, rows, "o", color="0.1", markersize=2)  # Dark on dark pages too.
    return figure


def pose_series(result: "DiagnosisResult") -> Figure:
    """Draw the mean residual of each pose in the order of the recording."""
    figure, (axes,) = panels(2)
    for stage in stages_shown(result, fitted=True):
        colour, label = STAGE_COLOURS[stage.name], STAGE_WORDS[stage.name]
        axes.plot(1e3 * stage.offsets, ".-", linewidth=1, color=colour, label=label)
    line_across(axes)
    axes.set_xlabel("pose, in the order of the recording")
    axes.set_ylabel("mean residual, mm")
    figure.legend(fontsize=8, frameon=False, ncols=2, loc="outside upper right")
    return figure


def effect_forest(result: "DiagnosisResult") -> Figure:
    """Draw what each effect closes, with its interval, and the probability that it is there."""
    study, found = result.evidence.study, result.evidence.named
    count, names = float(study.sums.count.sum()), found.ranking[::-1]
    figure, (left, right) = panels(1 + len(names) / 4, 1, 2, same_rows=True)
    alike = {member for members in result.cause_sets for member in members}
    for place, name in enumerate(names):
        colour = RED if name in result.effects else BLUE if name in alike else GREY
        closed = 1000**2 * found.closed[name].numpy() / count * len(found.closed[name])
        error = TWO_SIDED * closed.std(ddof=1) / len(closed) ** 0.5
        left.errorbar(closed.mean(), place, xerr=error, fmt="o", markersize=4, color=colour)
        right.barh(place, found.probabilities.get(name, 0.0), color=colour)
    line_across(left, vertical=True)
    left.set_xlabel("closes, mm² of the\nheld-out mean square")
    right.set_xlabel("probability\nthat it is there")
    right.set_xlim(0, 1)
    left.set_yticks(range(len(names)), [effect_words(study, name) for name in names])
    return figure


def absorption_table(study: Study) -> np.ndarray:
    """Return what calibration and every other effect absorb of every effect with columns.

    Returns:
        The share of each effect (row) that base model and hand-eye transform absorb, then of what
        remains the share that each other effect (column) absorbs; NaN of itself and where nothing
        remains. Shape (E, 1 + E).
    """
    names, layout, gram = tuple(study.effects), study.sums.layout, study.unabsorbed
    members = [torch.arange(*layout.effects[name]) for name in names]
    table = np.full((len(names), 1 + len(names)), np.nan)
    for row, (name, own) in enumerate(zip(names, members, strict=True)):
        table[row, 0] = absorbed_share(study, name)
        for column, other in enumerate(members, start=1):
            if column != row + 1 and 1 - table[row, 0] > LEAST_LEFT:
                left = left_over(gram, other, own, layout.prior_of(other)).trace()
                table[row, column] = 1 - float(left / gram.diagonal()[own].sum())
    return table


def absorption_map(result: "DiagnosisResult") -> Figure:
    """Draw the share of each effect that calibration absorbs, then that other effects absorb."""
    names, table = tuple(result.evidence.study.effects), absorption_table(result.evidence.study)
    figure, (axes,) = panels(5)
    axes.set_facecolor(TINT)
    shown = axes.imshow(table, cmap="Greys", vmin=0, vmax=1, aspect="auto")
    axes.axvline(0.5, color="white", linewidth=3)
    axes.set_xticks(range(len(names) + 1), ["calibration", *names], rotation=90)
    axes.set_yticks(range(len(names)), names)
    axes.tick_params(labelsize=7)
    axes.set_ylabel("share of this effect ...")
    axes.set_xlabel("... that calibration, or else this effect, absorbs")
    plain_look(figure.colorbar(shown, ax=axes, label="share absorbed").ax)
    return figure


def paired_poses(result: "DiagnosisResult") -> Figure:
    """Draw the held-out error of each pose before and after the effects, and the noise."""
    before, after = (1e3 * errors for errors in pose_errors(result))
    figure, (axes,) = panels(4)
    axes.set_box_aspect(1)
    limit = max(before.max(), after.max())
    axes.plot([0, limit], [0, limit], color="black", linewidth=1)
    axes.plot(before, after, "o", color=BLUE, markersize=4)
    axes.axhline(1e3 * result.gap.floor, color="black", linestyle=":", linewidth=1)
    axes.set_xlabel("held-out error before, mm")
    axes.set_ylabel("with the effects, mm")
    return figure


FIGURES: dict[str, Callable[["DiagnosisResult"], Figure]] = {
    "where_as_given": partial(covariate_strips, as_given=True),
    "where": covariate_strips,
    "which": effect_forest,
    "aliases": absorption_map,
    "map": image_maps,
    "poses": paired_poses,
    "series": pose_series,
    "stages": stage_bars,
    "attribution": attribution_bars,
}
"""The figures of a diagnosis alone, by their names on the report page."""
