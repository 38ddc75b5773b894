"""Scores of degraded frames, at poses that their sensor never saw."""

import math
from collections.abc import Callable

from benchmarks.withheld.pairs.outcomes import PairOutcome

DEGRADED_MOST = 1.1  # times the gap of the stage with effects
DEGRADED_NOISE_WITHIN = 0.10  # of the camera's noise
ONE_SIDED, TWO_SIDED = 1.645, 1.96  # normal quantiles of 95 % and 97.5 %
LEAST_GAP_MM = 0.5  # no degraded frame has to be nearer: the robot's 0.3 mm and 0.3 mrad
# Effects of the robot, the target or the room, which no sensor can add to depth images.
BEYOND_IMAGES = frozenset({"robot_kinematics", "target_shape", "target_registration", "multipath"})

Judgement = Callable[[PairOutcome], bool | None]


def degraded_gap_right(one: PairOutcome) -> bool | None:
    """Whether degraded frames at held-out poses are as near as the stage with effects says."""
    return None if one.degraded is None else _near(one, one.degraded.gap_mm)


def degraded_gap_not_worse(one: PairOutcome) -> bool | None:
    """The same, or not significantly more than 1.1 times it (one-sided, 5 %).

    Squares are compared, for these have normal errors; that of the stage is in its interval.
    """
    right, interval = degraded_gap_right(one), one.intervals.get("with_effects")
    if right is not False or one.degraded is None or interval is None:
        return right
    excess = one.degraded.gap_mm**2 - (DEGRADED_MOST * one.stages["with_effects"]) ** 2
    error = DEGRADED_MOST**2 * (interval[1] ** 2 - interval[0] ** 2) / (2 * TWO_SIDED)
    return excess <= ONE_SIDED * math.hypot(error, one.degraded.error_of_square)


def degraded_gap_of_shown(one: PairOutcome) -> bool | None:
    """Whether degraded frames are near or not significantly farther, if images show the effect."""
    hidden = one.outcome.truths & BEYOND_IMAGES
    return None if hidden else degraded_gap_not_worse(one)


def true_gap_right(one: PairOutcome) -> bool | None:
    """Whether drawn frames of the true camera would be as near as the stage with effects says."""
    return None if one.degraded is None else _near(one, one.degraded.truth_mm)


def _near(one: PairOutcome, gap_mm: float) -> bool | None:
    stage = one.stages.get("with_effects")
    return None if stage is None else gap_mm <= DEGRADED_MOST * max(stage, LEAST_GAP_MM)


def degraded_noise_right(one: PairOutcome) -> bool | None:
    """Whether degraded frames are as noisy as the camera's."""
    if one.degraded is None:
        return None
    return abs(one.degraded.noise_mm / one.degraded.true_noise_mm - 1) <= DEGRADED_NOISE_WITHIN


DEGRADE: list[tuple[str, Judgement, float | None]] = [
    ("degraded frames within 1.1 times the last stage", degraded_gap_right, None),
    ("the same, or not significantly more", degraded_gap_not_worse, None),
    ("the same, of effects that a depth image can show", degraded_gap_of_shown, None),
    ("the same of the true camera, as far as noise lets measure", true_gap_right, None),
    ("noise of degraded frames within 10 %", degraded_noise_right, None),
]
