"""The smallest effect that a diagnosis promises to find, against the smallest that it finds."""

import math
from collections.abc import Sequence

import numpy as np

from benchmarks.withheld.outcomes import Outcome, main_of
from benchmarks.withheld.scoring.figures import Score, share_score
from benchmarks.withheld.statistics import share

FOUND_AT_LEAST = 0.8  # the share that a smallest detectable effect promises


def detectable(outcomes: Sequence[Outcome]) -> list[Score]:
    """The size, over the smallest that is promised to be found, at which the promise is kept."""
    promised: dict[str, list[float]] = {}
    for one in main_of(outcomes, "C"):
        for name, size in (one.said.report.get("minimum_detectable_mm") or {}).items():
            if size is not None and math.isfinite(size):
                promised.setdefault(name, []).append(size)
    points = [
        (
            one.answer["sizes_mm"][one.truth] / float(np.median(promised[one.truth])),
            one.truth in one.said.effects,
        )
        for one in main_of(outcomes, "A")
        if one.truth in promised and one.answer["case"]["design"]["frames"] == 60
    ]
    if len(points) < 20:
        return []
    return [
        Score(
            "A",
            "real over promised smallest detectable effect (0.8 found)",
            _threshold(points),
            (math.nan, math.nan),
            len(points),
        ),
        share_score(
            "A",
            "found, of those above the promised size",
            share(found for size, found in points if size >= 1),
        ),
    ]


def _threshold(points: Sequence[tuple[float, bool]]) -> float:
    """Size at which a logistic curve in log size reaches the promised share (ridge, Newton)."""
    x = np.log([size for size, _ in points])
    design, y = (
        np.column_stack([np.ones_like(x), x]),
        np.array([found for _, found in points], float),
    )
    theta = np.zeros(2)
    for _ in range(50):
        p = 1 / (1 + np.exp(-design @ theta))
        hessian = design.T @ (design * (p * (1 - p))[:, None]) + 1e-2 * np.eye(2)
        theta += np.linalg.solve(hessian, design.T @ (y - p) - 1e-2 * theta)
    return float(np.exp((math.log(FOUND_AT_LEAST / (1 - FOUND_AT_LEAST)) - theta[0]) / theta[1]))
