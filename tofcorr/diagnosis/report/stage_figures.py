"""Figures of the gap as a whole: its stages, and what it consists of."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tofcorr.diagnosis.findings.gap import Interval
from tofcorr.diagnosis.findings.shares import Share
from tofcorr.diagnosis.findings.where import Stage
from tofcorr.diagnosis.report.style import BLUE, GREY, RED, WIDTH, single_axes
from tofcorr.diagnosis.report.words import LEAST_SHARE, MOST_SHARE, share_words
from tofcorr.diagnosis.rerun.degraded_stage import DegradedStage

STAGE_WORDS = {
    "as_given": "as given",
    "recalibrated": "recalibrated",
    "with_effects": "with the effects",
}
"""What a stage is called on the page."""
DEGRADED_WORDS = "degraded frames"
"""What ideal frames through the sensor that was found are called on the page."""
STAGE_COLOURS = {"as_given": GREY, "recalibrated": RED, "with_effects": BLUE}
"""The colour of a stage in every figure."""

_LIGHT_BLUE = "#8fbbd9"
_KIND_COLOURS = {"parameter": GREY, "effect": RED, "unexplained": "#bbbbbb"}
# Height of a bar and of what surrounds the bars, inches. Chosen: labels of 9 points stand clear.
_BAR, _AROUND = 0.34, 0.85
# Characters of the longest label in one line. Set by hand: what the margin holds.
_LONG = 22


def stage_bars(
    stages: Sequence[Stage],
    steps: Sequence[tuple[str, float, Interval]],
    floor: float,
    degraded: DegradedStage | None = None,
) -> Figure:
    """Draw the gap at each stage with its interval, and the noise of a pixel.

    Args:
        stages: Those of the diagnosis; a stage without gap is left out.
        steps: The gap after each named effect in turn with its interval, metres. The bar of the
            last one is that of the stage with the effects.
        floor: Noise of one pixel, metres.
        degraded: What degraded frames leave; None: not measured.
    """
    bars: list[tuple[str, float, Interval | None, str]] = [
        (STAGE_WORDS[one.name], one.gap, one.interval, STAGE_COLOURS[one.name])
        for one in stages
        if one.gap is not None
    ]
    bars[-1:-1] = [(f"+ {name}", size, interval, BLUE) for name, size, interval in steps[:-1]]
    if steps:
        last = steps[-1][0].split(" (")[0]  # Three lines would touch the next bar's.
        bars[-1] = (f"+ {last}:\n{bars[-1][0]}", *bars[-1][1:])
    if degraded is not None:
        bars.append((DEGRADED_WORDS, degraded.gap, degraded.interval, _LIGHT_BLUE))
    figure, axes = single_axes(WIDTH, _BAR * len(bars) + _AROUND + 0.2)
    scaled = [(name, 1e3 * size, _scaled(ends), colour) for name, size, ends, colour in bars]
    _bars(axes, scaled, [f"{size:.1f} mm" for _, size, _, _ in scaled])
    if 1e3 * floor < axes.get_xlim()[1]:  # Beyond, its label would be cut; a card tells it.
        _mark_noise(axes, 1e3 * floor)
    axes.set_xlabel("gap, mm (root mean square, noise taken off)", fontsize=9)
    return figure


def _mark_noise(axes: Axes, size: float) -> None:
    axes.axvline(size, color="black", linestyle=":", linewidth=1, zorder=0)
    axes.annotate(
        "noise of one pixel",
        (size, 1.0),
        xycoords=("data", "axes fraction"),
        xytext=(3, 1),
        textcoords="offset points",
        fontsize=8,
        ha="left" if size < 0.6 * axes.get_xlim()[1] else "right",
    )


def attribution_bars(shares: Sequence[Share]) -> Figure:
    """Draw the share of each cause in the squared gap as given, with intervals.

    Args:
        shares: As attributed; drawn from the largest to the smallest, the unexplained last.
    """
    known = sorted((one for one in shares if one.kind != "unexplained"), key=lambda s: -s.share)
    ordered = [*known, *(one for one in shares if one.kind == "unexplained")]
    figure, axes = single_axes(WIDTH, _BAR * len(ordered) + _AROUND)
    bars = [
        (
            one.cause,
            100 * one.share,
            (100 * max(one.interval[0], LEAST_SHARE), 100 * min(one.interval[1], MOST_SHARE)),
            _KIND_COLOURS[one.kind],
        )
        for one in ordered
    ]
    _bars(axes, bars, [share_words(one.share) for one in ordered])
    axes.axvline(0, color="black", linewidth=0.8)
    axes.set_xlabel("share of the squared gap, %", fontsize=9)
    return figure


def _scaled(interval: Interval | None) -> Interval | None:
    return None if interval is None else (1e3 * interval[0], 1e3 * interval[1])


def _bars(
    axes: Axes,
    bars: Sequence[tuple[str, float, Interval | None, str]],
    texts: Sequence[str],
) -> None:
    """Draw bars from top to bottom, their texts in a column at the right."""
    places = np.arange(len(bars))[::-1]
    axes.barh(places, [bar[1] for bar in bars], color=[bar[3] for bar in bars], height=0.62)
    ends = [0.0]
    for place, (_, value, interval, _), text in zip(places, bars, texts, strict=True):
        ends += [value, *(interval or ())]
        if interval is not None:
            axes.plot(interval, [place, place], color="black", linewidth=1.4, marker="|")
        axes.annotate(
            text,
            (1.02, place),
            xycoords=("axes fraction", "data"),
            va="center",
            fontsize=9,
        )
    reach = max(ends) - min(ends)
    low = min(ends) - 0.03 * reach if min(ends) < 0 else 0.0
    axes.set_xlim(low, max(ends) + 0.04 * reach if reach else 1.0)
    axes.set_yticks(places, [_in_two_lines(bar[0]) for bar in bars], fontsize=9)
    axes.tick_params(axis="x", labelsize=8)


def _in_two_lines(label: str) -> str:
    """Break a long label before what stands in brackets."""
    return label if len(label) <= _LONG else label.replace(" (", "\n(")
