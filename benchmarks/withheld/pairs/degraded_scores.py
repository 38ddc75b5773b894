"""Scores of degraded frames, in a session that their sensor never saw."""

import math
from collections.abc import Callable

from benchmarks.withheld.pairs.degraded import Degraded
from benchmarks.withheld.pairs.outcomes import PairOutcome

DEGRADED_MOST = 1.1  # times the gap of the stage with effects
NOISE_WITHIN = 0.10  # of the camera's noise
MISSING_WITHIN = (0.10, 0.002)  # of the camera's share of missing pixels, or of all pixels
ONE_SIDED, TWO_SIDED = 1.645, 1.96  # normal quantiles of 95 % and 97.5 %
LEAST_GAP_MM = 0.5  # no degraded frame has to be nearer: the robot's 0.3 mm and 0.3 mrad
# Effects of the robot, the target or the room, which no sensor can add to depth images.
BEYOND_IMAGES = frozenset({"robot_kinematics", "target_shape", "target_registration", "multipath"})

Judgement = Callable[[PairOutcome], bool | None]


def gap_right(one: PairOutcome) -> bool | None:
    """Whether degraded frames are as near as the stage with effects says."""
    return None if one.degraded is None else _near_stage(one, one.degraded.gap_mm)


def gap_not_worse(one: PairOutcome) -> bool | None:
    """The same, or not significantly more than 1.1 times it (one-sided, 5 %).

    Squares are compared, for these have normal errors; that of the stage is in its interval.
    """
    right, interval = gap_right(one), one.intervals.get("with_effects")
    if right is not False or one.degraded is None or interval is None:
        return right
    excess = one.degraded.gap_mm**2 - (DEGRADED_MOST * one.stages["with_effects"]) ** 2
    error = DEGRADED_MOST**2 * (interval[1] ** 2 - interval[0] ** 2) / (2 * TWO_SIDED)
    return excess <= ONE_SIDED * math.hypot(error, one.degraded.error_of_square)


def gap_kept(one: PairOutcome) -> bool | None:
    """Whether they are as near as at the poses that the camera was fitted to."""
    found = one.degraded
    return None if found is None else _near(found.gap_mm, found.own_mm)


def oracle_right(one: PairOutcome) -> bool | None:
    """Whether an oracle's fit to the same recording is as near as the stage with effects says."""
    return None if one.degraded is None else _near_stage(one, one.degraded.oracle_mm)


def shown(judge: Judgement) -> Judgement:
    """The same judgement, of effects that depth images can show."""
    return lambda one: None if one.outcome.truths & BEYOND_IMAGES else judge(one)


def noise_right(one: PairOutcome) -> bool | None:
    """Whether degraded frames are as noisy as the camera's."""
    found = one.degraded
    return None if found is None else abs(found.noise_mm / found.true_noise_mm - 1) <= NOISE_WITHIN


def missing_right(one: PairOutcome) -> bool | None:
    """Whether as many pixels are missing as in the camera's frames."""
    return None if one.degraded is None else _missing_right(one.degraded)


def _missing_right(found: Degraded) -> bool:
    share, least = MISSING_WITHIN
    return abs(found.missing - found.true_missing) <= max(share * found.true_missing, least)


def _near_stage(one: PairOutcome, gap_mm: float) -> bool | None:
    stage = one.stages.get("with_effects")
    return None if stage is None else _near(gap_mm, stage)


def _near(gap_mm: float, stage_mm: float) -> bool:
    return gap_mm <= DEGRADED_MOST * max(stage_mm, LEAST_GAP_MM)


DEGRADE: list[tuple[str, Judgement, float | None]] = [
    ("degraded frames within 1.1 times the last stage", gap_right, None),
    ("the same, of effects that a depth image can show", shown(gap_right), None),
    ("these, or not significantly more", shown(gap_not_worse), None),
    ("these, within 1.1 times what the stage truly leaves", shown(gap_kept), None),
    ("the last stage, by an oracle's fit to the same frames", shown(oracle_right), None),
    ("noise of degraded frames within 10 %", noise_right, None),
    ("their missing pixels within 10 % or 0.002, of those shown", shown(missing_right), None),
]
