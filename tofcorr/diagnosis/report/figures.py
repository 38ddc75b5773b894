"""Figures of a diagnosis: of the gap, of the effects, of the poses."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tofcorr.diagnosis.findings.absorption import AbsorptionTable
from tofcorr.diagnosis.findings.effect_comparison import EffectComparison
from tofcorr.diagnosis.findings.how_far import Gap
from tofcorr.diagnosis.report.residual_figures import covariate_strips, image_maps, pose_series
from tofcorr.diagnosis.report.style import BLUE, GREY, RED, single_axes

__all__ = [
    "absorption_map",
    "covariate_strips",
    "effect_forest",
    "gap_bars",
    "image_maps",
    "paired_poses",
    "pose_series",
]


def gap_bars(gap: Gap, steps: Sequence[tuple[str, float]]) -> Figure:
    """Draw the gap as given, after refitting, and after each effect; and the noise floor.

    Args:
        gap: Before and after the effects.
        steps: The gap after each named effect in turn, metres.
    """
    given = [] if gap.as_given is None else [gap.as_given]
    names = [*["as given"] * len(given), "refitted", *(f"+ {name}" for name, _ in steps)]
    values = 1e3 * np.array([*given, gap.before, *(value for _, value in steps)])
    figure, axes = single_axes(8.0, 0.5 * len(names) + 1.2)
    colours = [*[GREY] * len(given), RED, *([BLUE] * len(steps))]
    # The gap as given can be so large that the other bars would vanish: it is cut, with an arrow.
    limit = 1.15 * max(values[len(given) :].max(), 1e3 * gap.before_interval[1], 1e3 * gap.floor)
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
    _whisker(axes, gap.before_interval, places[len(given)])
    if steps:
        _whisker(axes, gap.after_interval, places[-1])
    axes.axvline(1e3 * gap.floor, color="black", linestyle=":", linewidth=1, zorder=0)
    axes.text(1e3 * gap.floor, len(names) - 0.45, " noise of one pixel", fontsize=8, va="bottom")
    axes.set_yticks(places, names)
    axes.set_xlim(0, 1.1 * limit)
    axes.set_xlabel("gap in excess of the noise, mm (root mean square)")
    return figure


def _whisker(axes: Axes, interval: tuple[float, float], place: float) -> None:
    low, high = (1e3 * end for end in interval)
    axes.plot([low, high], [place + 0.36] * 2, color="black", linewidth=1.5)


def effect_forest(
    comparison: EffectComparison,
    names: Sequence[str],
    cause_sets: Sequence[Sequence[str]],
    level: float,
    count: float,
) -> Figure:
    """Draw what each effect closes, with its interval, and its score.

    Args:
        comparison: All effects as additions to the base model.
        names: The effects named.
        cause_sets: For each named effect those that the data cannot distinguish from it.
        level: Significance level; the band ends at the critical score.
        count: Sum of the even weights of all poses, which the squares are divided by.
    """
    tests = comparison.ordered()[::-1]
    figure = Figure(figsize=(10.0, 0.27 * len(tests) + 1.1))
    figure.subplots_adjust(left=0.19, right=0.985, bottom=0.75 / figure.get_figheight(), top=0.97)
    left, right = figure.subplots(1, 2, sharey=True)
    alike = {member for members in cause_sets for member in members}
    critical = comparison.critical_score(level)
    right.axvspan(-1e3, critical, color=GREY, alpha=0.15, linewidth=0)
    for place, test in enumerate(tests):
        colour = RED if test.name in names else BLUE if test.name in alike else GREY
        closed = 1e6 * test.closed.numpy() / count * len(test.closed)
        mean, error = closed.mean(), 1.96 * closed.std(ddof=1) / np.sqrt(len(closed))
        left.errorbar(mean, place, xerr=error, fmt="o", color=colour, markersize=4, capsize=2)
        right.plot(test.score, place, "o", color=colour, markersize=4)
    left.axvline(0, color="black", linewidth=0.8)
    left.set_xlabel("closes, mm² of held-out mean square")
    right.set_xlabel("score: gain above chance, in standard deviations")
    scores = [test.score for test in tests]
    right.set_xlim(min(-2.5, *scores) - 0.5, max(critical + 1.0, *scores) + 1.0)
    left.set_yticks(range(len(tests)), [test.name for test in tests], fontsize=8)
    for label, test in zip(left.get_yticklabels(), tests, strict=True):
        label.set_fontweight("bold" if test.name in names else "normal")
    return figure


def absorption_map(table: AbsorptionTable) -> Figure:
    """Draw the share of each effect that calibration absorbs, then that other effects absorb."""
    names = table.names
    shares = np.concatenate([table.by_calibration[:, None], table.by_effect], axis=1)
    figure = Figure(figsize=(9.5, 6.6))
    axes = figure.subplots()
    figure.subplots_adjust(left=0.17, right=0.92, bottom=0.21, top=0.98)
    axes.set_facecolor("#f3e9e9")
    shown = axes.imshow(shares, cmap="Greys", vmin=0, vmax=1, aspect="auto")
    axes.axvline(0.5, color="white", linewidth=3)
    axes.set_xticks(range(len(names) + 1), ["calibration", *names], rotation=60, ha="right")
    axes.set_yticks(range(len(names)), names)
    axes.tick_params(labelsize=8)
    axes.set_ylabel("share of this effect ...")
    axes.set_xlabel("... that calibration absorbs, and of the rest, that this effect absorbs")
    bar = figure.colorbar(shown, ax=axes, fraction=0.03, pad=0.02)
    bar.set_label("share absorbed", fontsize=9)
    return figure


def paired_poses(before: np.ndarray, after: np.ndarray, *, floor: float) -> Figure:
    """Draw the held-out error of each pose before and after the effects.

    Args:
        before: Of the base model, shape (U,), metres.
        after: With the named effects, shape (U,), metres.
        floor: Noise of a pixel, metres.
    """
    figure, axes = single_axes(4.6, 4.2)
    limit = 1.05e3 * max(before.max(), after.max())
    axes.plot([0, limit], [0, limit], color="black", linewidth=0.8)
    axes.plot(1e3 * before, 1e3 * after, "o", color=BLUE, markersize=4, alpha=0.7)
    axes.axhline(1e3 * floor, color="black", linestyle=":", linewidth=1)
    axes.set_xlabel("held-out error before, mm")
    axes.set_ylabel("with the effects, mm")
    return figure
