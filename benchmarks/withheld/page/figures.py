"""Figures of the page."""

from collections.abc import Callable, Sequence
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import itertools

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.withheld.fitting import linearise
from benchmarks.withheld.outcomes import Outcome, findable, load, main_of, named_first
from benchmarks.withheld.reading import read
from benchmarks.withheld.statistics import share

BINS_MM = np.array([0.5, 1.0, 2.0, 4.0, 8.0, 16.5])


def confusion(outcomes: Sequence[Outcome]) -> Figure | None:
    """True effect against the one named first, findable effects of tier A."""
    cases = findable(main_of(outcomes, "A"))
    if not cases:
        return None
    said = [
        one.said.effects[0] if one.said.effects else ("unknown" if one.said.unknown else "nothing")
        for one in cases
    ]
    rows = sorted({one.truth for one in cases})
    columns = rows + sorted(set(said) - set(rows) - {"unknown", "nothing"}) + ["unknown", "nothing"]
    counts = np.zeros((len(rows), len(columns)), dtype=int)
    for one, name in zip(cases, said, strict=True):
        counts[rows.index(one.truth), columns.index(name)] += 1
    figure, axes = plt.subplots(figsize=(0.42 * len(columns) + 2, 0.36 * len(rows) + 1.6))
    axes.imshow(counts / counts.sum(1, keepdims=True), cmap="Blues", vmin=0, vmax=1)
    for (i, j), count in np.ndenumerate(counts):
        if count:
            axes.text(
                j,
                i,
                str(count),
                ha="center",
                va="center",
                color="white" if 2 * count > counts[i].sum() else "black",
            )
    axes.set_xticks(range(len(columns)), columns, rotation=90)
    axes.set_yticks(range(len(rows)), rows)
    axes.set_xlabel("named first")
    axes.set_ylabel("true effect")
    plt.close(figure)
    return figure


def power(outcomes: Sequence[Outcome]) -> Figure | None:
    """Shares found by size: of the raw error, and of what the oracle closes."""
    cases = main_of(outcomes, "A")
    if not cases:
        return None
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4), sharey=True)
    _curves(left, cases, lambda one: one.answer["sizes_mm"][one.truth], BINS_MM)
    left.set_xlabel("raw error of the effect, mm RMS")
    _curves(
        right,
        cases,
        lambda one: one.oracle.plain.shrinkage_mm,
        np.array([0.0, 0.1, 0.3, 1.0, 3.0, 20.0]),
    )
    right.set_xlabel("what the oracle closes, mm")
    left.set_ylabel("share of recordings")
    left.legend(loc="lower right")
    plt.close(figure)
    return figure


def failure_figure(one: Outcome, out: Path) -> Figure:
    """What is true and what the base fit leaves: mean over frames, and mean of each frame."""
    data = read(out / "recordings" / one.name)
    left_over = np.full(data.depth.shape, np.nan)
    left_over[data.valid] = 1e3 * linearise(data).residual
    truth = sum(load(out, one.name, f"field_{name}") for name in one.truths) * 1e3
    truth = np.where(data.valid, truth, np.nan)
    figure, axes = plt.subplots(1, 3, figsize=(11, 2.8), width_ratios=[1, 1, 1.4])
    for panel, field, title in zip(
        axes, (truth, left_over), ("true effect", "left by the base fit"), strict=False
    ):
        mean = np.nanmean(field, axis=0)
        image = panel.imshow(mean - np.nanmean(mean), cmap="RdBu_r")
        panel.set_title(f"{title}: mean of frames, centred, mm", fontsize=8)
        panel.set_axis_off()
        figure.colorbar(image, ax=panel, shrink=0.8)
    axes[2].plot(np.nanmean(truth, axis=(1, 2)) - np.nanmean(truth), label="true effect")
    axes[2].plot(np.nanmean(left_over, axis=(1, 2)), label="left by the base fit")
    axes[2].set_xlabel("frame")
    axes[2].set_ylabel("mean, mm")
    axes[2].legend(fontsize=8)
    plt.close(figure)
    return figure


def _curves(
    axes: Axes, cases: Sequence[Outcome], size: Callable[[Outcome], float], edges: np.ndarray
) -> None:
    kinds: dict[str, Callable[[Outcome], bool]] = {
        "something named": lambda one: bool(one.said.effects),
        "named first": named_first,
        "in the set": lambda one: one.covered(one.truth),
    }
    sizes = np.array([size(one) for one in cases])
    groups = [
        [one for one, s in zip(cases, sizes, strict=True) if a <= s < b]
        for a, b in itertools.pairwise(edges)
    ]
    for shift, (label, judge) in enumerate(kinds.items()):
        shares = [share(map(judge, group)) for group in groups]
        values = np.array([one.value for one in shares])
        limits = np.abs(np.array([one.interval for one in shares]).T - values)
        places = np.arange(len(groups)) + 0.12 * (shift - 1)
        axes.errorbar(places, values, limits, marker="o", capsize=2, label=label)
    labels = [
        f"{a:g}–{b:g}\n(n={len(g)})" for a, b, g in zip(edges[:-1], edges[1:], groups, strict=True)
    ]
    axes.set_xticks(range(len(groups)), labels, fontsize=8)
    axes.set_ylim(-0.03, 1.03)
    axes.grid(alpha=0.3)
