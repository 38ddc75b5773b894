"""Figures of a diagnosis: of the effects and of the poses; and the names of all others."""

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.figure import Figure

from tofcorr.diagnosis.findings.absorption import AbsorptionTable
from tofcorr.diagnosis.findings.effect_comparison import EffectComparison
from tofcorr.diagnosis.findings.gap import TWO_SIDED
from tofcorr.diagnosis.report.residual_figures import covariate_strips, image_maps, pose_series
from tofcorr.diagnosis.report.stage_figures import attribution_bars, stage_bars
from tofcorr.diagnosis.report.style import BLUE, GREY, RED, WIDTH, single_axes
from tofcorr.observables.figures import drawings as observable_drawings

__all__ = [
    "absorption_map",
    "attribution_bars",
    "covariate_strips",
    "effect_forest",
    "image_maps",
    "observable_drawings",
    "paired_poses",
    "pose_series",
    "stage_bars",
]


def effect_forest(
    comparison: EffectComparison,
    names: Sequence[str],
    cause_sets: Sequence[Sequence[str]],
    level: float,
    count: float,
    words: Callable[[str], str],
) -> Figure:
    """Draw what each effect closes, with its interval, and its score.

    Args:
        comparison: All effects as additions to the base model.
        names: The effects named.
        cause_sets: For each named effect those that the data cannot distinguish from it.
        level: Significance level; the band ends at the critical score.
        count: Sum of the even weights of all poses, which the squares are divided by.
        words: Returns what an effect is called on the page.
    """
    tests = comparison.ordered()[::-1]
    figure = Figure(figsize=(WIDTH, 0.24 * len(tests) + 0.75))
    figure.subplots_adjust(
        left=1.75 / WIDTH, right=0.98, bottom=0.6 / figure.get_figheight(), top=0.99, wspace=0.08
    )
    left, right = figure.subplots(1, 2, sharey=True)
    alike = {member for members in cause_sets for member in members}
    critical = comparison.critical_score(level)
    right.axvspan(-1e3, critical, color=GREY, alpha=0.15, linewidth=0)
    colours = [RED if t.name in names else BLUE if t.name in alike else GREY for t in tests]
    for colour in dict.fromkeys(colours):
        own = [place for place, other in enumerate(colours) if other == colour]
        closed = np.stack([tests[place].closed.numpy() for place in own])
        closed = 1e6 * closed / count * closed.shape[1]
        error = TWO_SIDED * closed.std(axis=1, ddof=1) / np.sqrt(closed.shape[1])
        mean = closed.mean(axis=1)
        left.errorbar(mean, own, xerr=error, fmt="o", color=colour, markersize=4, capsize=2)
        right.plot([tests[place].score for place in own], own, "o", color=colour, markersize=4)
    left.axvline(0, color="black", linewidth=0.8)
    left.set_xlabel("closes, mm² of the\nheld-out mean square", fontsize=9)
    right.set_xlabel("score: gain above chance,\nin standard deviations", fontsize=9)
    for axes in (left, right):
        axes.tick_params(axis="x", labelsize=8)
    scores = [test.score for test in tests]
    low, high = min(-3.0, *scores), max(critical + 2.0, *scores)
    right.set_xlim(low - 0.04 * (high - low), high + 0.04 * (high - low))
    left.set_yticks(range(len(tests)), [words(test.name) for test in tests], fontsize=8)
    for label, test in zip(left.get_yticklabels(), tests, strict=True):
        label.set_fontweight("bold" if test.name in names else "normal")
    return figure


def absorption_map(table: AbsorptionTable) -> Figure:
    """Draw the share of each effect that calibration absorbs, then that other effects absorb."""
    names = table.names
    shares = np.concatenate([table.by_calibration[:, None], table.by_effect], axis=1)
    figure = Figure(figsize=(WIDTH, 5.4))
    axes = figure.subplots()
    figure.subplots_adjust(left=0.26, right=0.9, bottom=0.29, top=0.99)
    axes.set_facecolor("#f3e9e9")
    shown = axes.imshow(shares, cmap="Greys", vmin=0, vmax=1, aspect="auto")
    axes.axvline(0.5, color="white", linewidth=3)
    axes.set_xticks(range(len(names) + 1), ["calibration", *names], rotation=90)
    axes.set_yticks(range(len(names)), names)
    axes.tick_params(labelsize=7)
    axes.set_ylabel("share of this effect ...", fontsize=9)
    axes.set_xlabel("... that calibration, or else this effect, absorbs", fontsize=9)
    bar = figure.colorbar(shown, ax=axes, fraction=0.03, pad=0.02)
    bar.set_label("share absorbed", fontsize=9)
    bar.ax.tick_params(labelsize=8)
    return figure


def paired_poses(before: np.ndarray, after: np.ndarray, *, floor: float) -> Figure:
    """Draw the held-out error of each pose before and after the effects.

    Args:
        before: Of the base model, shape (U,), metres.
        after: With the named effects, shape (U,), metres.
        floor: Noise of a pixel, metres.
    """
    figure, axes = single_axes(4.2, 3.8)
    limit = 1.05e3 * max(before.max(), after.max())
    axes.plot([0, limit], [0, limit], color="black", linewidth=0.8)
    axes.plot(1e3 * before, 1e3 * after, "o", color=BLUE, markersize=4, alpha=0.7)
    axes.axhline(1e3 * floor, color="black", linestyle=":", linewidth=1)
    axes.set_xlabel("held-out error before, mm")
    axes.set_ylabel("with the effects, mm")
    return figure
