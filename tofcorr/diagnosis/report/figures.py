"""Figures of a diagnosis."""

import io
from collections.abc import Callable

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from tofcorr.conditions import CONDITIONS, condition
from tofcorr.diagnosis.findings.where import Region
from tofcorr.diagnosis.findings.which import absorbed_share
from tofcorr.diagnosis.report.result import Diagnosis

_BLUE, _RED, _GREEN, _GREY = "#2166ac", "#b2182b", "#1b7837", "#777777"
_MOST_STRIPS = 6
# Of an effect of which calibration leaves less than this share, what else takes it up is moot.
_NOTHING_LEFT = 0.005
_LABELS = {
    "distance_m": "distance, m",
    "row": "row, px",
    "column": "column, px",
    "image_radius": "radius in the image",
    "incidence_deg": "incidence angle, deg",
    "amplitude": "amplitude, counts",
    "phase_quarter_deg": "four times the phase, deg",
    **{each.covariate: each.label for each in map(condition, CONDITIONS)},
    "frame": "frame",
    "target_x_m": "target x, m",
    "target_y_m": "target y, m",
    "tool_x_m": "tool x, m",
    "tool_y_m": "tool y, m",
    "tool_z_m": "tool z, m",
}


def all_figures(diagnosis: Diagnosis) -> dict[str, Figure]:
    """Return every figure of the report, by name."""
    makers: dict[str, Callable[[Diagnosis], Figure]] = {
        "waterfall": waterfall,
        "where": strips,
        "map": image_maps,
        "series": pose_series,
        "which": forest,
        "aliases": alias_map,
        "poses": paired_poses,
    }
    return {name: make(diagnosis) for name, make in makers.items()}


def svg_of(figure: Figure) -> str:
    """Return a figure as an SVG element, to be put into a page."""
    buffer = io.StringIO()
    FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def waterfall(diagnosis: Diagnosis) -> Figure:
    """Draw the gap as given, refitted, after each effect; and the noise floor."""
    gap, steps = diagnosis.gap, diagnosis.gap_steps
    names = ["as given", "refitted", *(f"+ {name}" for name, _ in steps)]
    values = 1e3 * np.array([gap.as_given, gap.before, *(value for _, value in steps)])
    figure, axes = _figure(8.0, 0.5 * len(names) + 1.2)
    colours = [_GREY, _RED, *([_BLUE] * len(steps))]
    # A guess far off would hide everything else.
    limit = 1.15 * max(values[1:].max(), 1e3 * gap.before_interval[1], 1e3 * gap.floor)
    places = np.arange(len(names))[::-1]
    axes.barh(places, np.minimum(values, limit), color=colours, height=0.6)
    for place, value in zip(places, values, strict=True):
        beyond = value > limit
        axes.text(
            min(value, limit) - (0.01 * limit if beyond else -0.01 * limit),
            place,
            f"{value:.1f} mm" + (" →" if beyond else ""),
            va="center",
            ha="right" if beyond else "left",
            color="white" if beyond else "black",
        )
    _whisker(axes, gap.before_interval, places[1])
    if steps:
        _whisker(axes, gap.after_interval, places[-1])
    axes.axvline(1e3 * gap.floor, color="black", linestyle=":", linewidth=1)
    axes.text(1e3 * gap.floor, len(names) - 0.45, " noise of one pixel", fontsize=8, va="bottom")
    axes.set_yticks(places, names)
    axes.set_xlim(0, 1.1 * limit)
    axes.set_xlabel("gap over the noise, mm (root mean square)")
    return figure


def _whisker(axes: Axes, interval: tuple[float, float], place: float) -> None:
    low, high = (1e3 * end for end in interval)
    axes.plot([low, high], [place + 0.36] * 2, color="black", linewidth=1.5)


def strips(diagnosis: Diagnosis) -> Figure:
    """Draw the bias along the covariates where it is most significant."""
    groups = list(diagnosis.where.by_covariate().items())[:_MOST_STRIPS]
    after = diagnosis.where_after.by_covariate()
    rows = max(1, -(-len(groups) // 3))
    figure = Figure(figsize=(10.5, 2.6 * rows))
    figure.subplots_adjust(
        left=0.07, right=0.985, bottom=0.2 / rows, top=1 - 0.1 / rows, hspace=0.5
    )
    for number, (name, regions) in enumerate(groups):
        axes = figure.add_subplot(rows, 3, number + 1)
        _strip(axes, [region for region in regions if not region.trend], _RED, band=True)
        _strip(axes, [r for r in after.get(name, []) if not r.trend], _BLUE, band=False)
        axes.axhline(0, color="black", linewidth=0.8)
        axes.set_xlabel(_LABELS.get(name, name), fontsize=9)
        best = min(region.p_value for region in regions)
        axes.set_title(f"p = {best:.3f}", fontsize=9, color=_RED if best <= 0.05 else _GREY)
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


def image_maps(diagnosis: Diagnosis) -> Figure:
    """Draw the mean residual over the image, before and after the effects."""
    before = 1e3 * diagnosis.where.tiles
    after = 1e3 * diagnosis.where_after.tiles
    figure = Figure(figsize=(9.0, 3.1))
    figure.subplots_adjust(left=0.03, right=0.93, bottom=0.03, top=0.9, wspace=0.08)
    limit = max(float(np.nanmax(np.abs(before), initial=0.0)), 0.5)
    shown = None
    for number, (values, title) in enumerate(((before, "before"), (after, "with the effects"))):
        axes = figure.add_subplot(1, 2, number + 1)
        shown = axes.imshow(values, cmap="RdBu_r", vmin=-limit, vmax=limit, aspect="auto")
        axes.set_title(title, fontsize=10)
        axes.set_xticks([])
        axes.set_yticks([])
        if number == 0:
            rows, columns = np.nonzero(diagnosis.where.tile_p_values <= 0.05)
            axes.plot(columns, rows, "k.", markersize=4)
    assert shown is not None
    bar = figure.colorbar(shown, ax=figure.axes, fraction=0.03, pad=0.02)
    bar.set_label("mean residual, mm", fontsize=9)
    return figure


def pose_series(diagnosis: Diagnosis) -> Figure:
    """Draw the mean residual of each pose in the order of the recording."""
    figure, axes = _figure(9.0, 2.4)
    before = 1e3 * diagnosis.where.offsets
    axes.plot(before, ".-", color=_RED, linewidth=0.8, label="before")
    axes.plot(
        1e3 * diagnosis.where_after.offsets,
        ".-",
        color=_BLUE,
        linewidth=0.8,
        label="with the effects",
    )
    axes.axhline(0, color="black", linewidth=0.8)
    axes.set_xlabel("pose, in the order of the recording")
    axes.set_ylabel("mean residual, mm")
    axes.legend(fontsize=8, frameon=False, ncols=2)
    return figure


def forest(diagnosis: Diagnosis) -> Figure:
    """Draw what each effect closes, and how surely, with the band of chance."""
    tests = diagnosis.selection.first.ordered()[::-1]
    count = float(diagnosis.study.blocks.count.sum())
    figure = Figure(figsize=(10.0, 0.27 * len(tests) + 1.1))
    figure.subplots_adjust(left=0.19, right=0.985, bottom=0.75 / figure.get_figheight(), top=0.97)
    left, right = figure.subplots(1, 2, sharey=True)
    named = set(diagnosis.selection.named)
    alike = {member for members in diagnosis.selection.sets for member in members}
    critical = _critical(diagnosis)
    right.axvspan(-1e3, critical, color=_GREY, alpha=0.15, linewidth=0)
    for place, test in enumerate(tests):
        colour = _RED if test.name in named else _BLUE if test.name in alike else _GREY
        closed = 1e6 * test.closed.numpy() / count * len(test.closed)
        mean, error = closed.mean(), 1.96 * closed.std(ddof=1) / np.sqrt(len(closed))
        left.errorbar(mean, place, xerr=error, fmt="o", color=colour, markersize=4, capsize=2)
        right.plot(test.score, place, "o", color=colour, markersize=4)
    left.axvline(0, color="black", linewidth=0.8)
    left.set_xlabel("closes, mm² of held-out mean square")
    right.set_xlabel("score: gain over its own null")
    scores = [test.score for test in tests]
    right.set_xlim(min(-2.5, *scores) - 0.5, max(critical + 1.0, *scores) + 1.0)
    left.set_yticks(range(len(tests)), [test.name for test in tests], fontsize=8)
    for label, test in zip(left.get_yticklabels(), tests, strict=True):
        label.set_fontweight("bold" if test.name in named else "normal")
    return figure


def _critical(diagnosis: Diagnosis) -> float:
    tests = diagnosis.selection.first.tests.values()
    best = torch.stack([test.null_scores() for test in tests]).amax(0)
    return float(torch.quantile(best, 1 - diagnosis.study.options.tests.level))


def alias_map(diagnosis: Diagnosis) -> Figure:
    """Draw how much of an effect calibration takes up, and of the rest each other effect."""
    study = diagnosis.study
    names = list(study.effects)
    shares = np.full((len(names), len(names) + 1), np.nan)
    for row, name in enumerate(names):
        shares[row, 0] = absorbed_share(study, name)
        rest = 1 - shares[row, 0]
        for column, other in enumerate(names):
            if other != name and rest > _NOTHING_LEFT:
                taken = absorbed_share(study, name, [other]) - shares[row, 0]
                shares[row, column + 1] = taken / rest
    figure = Figure(figsize=(9.5, 6.6))
    axes = figure.subplots()
    figure.subplots_adjust(left=0.17, right=1.0, bottom=0.21, top=0.98)
    axes.set_facecolor("#f3e9e9")
    shown = axes.imshow(shares, cmap="Greys", vmin=0, vmax=1, aspect="auto")
    axes.axvline(0.5, color="white", linewidth=3)
    axes.set_xticks(range(len(names) + 1), ["calibration", *names], rotation=60, ha="right")
    axes.set_yticks(range(len(names)), names)
    axes.tick_params(labelsize=8)
    axes.set_ylabel("share of this effect that ...")
    axes.set_xlabel("... calibration takes up, and of the rest: this effect")
    figure.colorbar(shown, ax=axes, fraction=0.03, pad=0.02)
    return figure


def paired_poses(diagnosis: Diagnosis) -> Figure:
    """Draw the held-out error of each pose before and after the effects."""
    study, selection = diagnosis.study, diagnosis.selection
    before = _pose_errors(study.left_out_squares(()), study.blocks.count)
    after = _pose_errors(selection.study.left_out_squares(selection.columns), study.blocks.count)
    figure, axes = _figure(4.6, 4.2)
    limit = 1.05 * max(before.max(), after.max())
    axes.plot([0, limit], [0, limit], color="black", linewidth=0.8)
    axes.plot(before, after, "o", color=_BLUE, markersize=4, alpha=0.7)
    axes.axhline(1e3 * diagnosis.gap.floor, color="black", linestyle=":", linewidth=1)
    axes.set_xlabel("held-out error before, mm")
    axes.set_ylabel("with the effects, mm")
    return figure


def _pose_errors(squares: torch.Tensor, count: torch.Tensor) -> np.ndarray:
    return 1e3 * (squares / count.clamp(min=1e-12)).clamp(min=0.0).sqrt().numpy()


def _figure(width: float, height: float) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(width, height))
    axes = figure.subplots()
    left = 1.5 / width if width > 5 else 0.75 / width
    figure.subplots_adjust(
        left=left, right=0.97, bottom=min(0.6 / height, 0.4), top=1 - 0.25 / height
    )
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes
