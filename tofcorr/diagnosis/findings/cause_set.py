"""Which effects the data cannot distinguish from the one that is named."""

import numpy as np
from torch import Tensor

from tofcorr.diagnosis.findings.effect_comparison import EffectComparison, EffectTest
from tofcorr.estimation.student import student_quantile

LEAST_ALIKE_SHARE = 0.5
"""An effect that closes less than this share of the winner is distinguishable from it, however
large the variation between poses. Chosen."""
LEAST_OF_WRONG_FORM = 2 / 3
"""An effect whose form may be wrong closes at least this share of the winner, or it is
distinguishable. Chosen: multipath by a renderer closed nine tenths of what the winner did."""

# An effect that explains less than this share of what there is to explain is not known by its form.
# Chosen: the larger part decides.
_MOST_OF_CAUSE = 0.5


def cause_set(
    comparison: EffectComparison,
    winner: str,
    level: float,
    share: float,
    missed: float = 0.0,
    unexplained: float = 0.0,
) -> list[str]:
    """Return the effects that these data cannot distinguish from the winner, itself first.

    An effect belongs to the set if it closes more than half of what the winner closes and not
    significantly less (a t-test, paired over poses) or at least `share` of it. So does one that
    closes two thirds of it, and less by no more than the form of an effect may miss. Where the
    winner explains less than half of what there is, its form says little of the cause: then less
    than two thirds are enough, in proportion. So does an effect that is at least as likely: what an
    effect closes is uncertain where poses scatter and are few, and the likelihood knows how much.

    Args:
        comparison: All effects.
        winner: The effect or probe that is compared.
        level: Of the t-test.
        share: See above.
        missed: Sum of squares that the form of an effect may miss, m^2.
        unexplained: Sum of squares that stays unexplained, m^2.
    """
    best = comparison.probes.get(winner) or comparison.tests[winner]
    explained = best.total / max(best.total + unexplained, 1e-30)
    least = LEAST_OF_WRONG_FORM * min(explained / _MOST_OF_CAUSE, 1.0) * best.total
    members = []
    for test in comparison.ordered():
        if test.name == winner:
            continue
        likely = test.gain >= best.gain and not best.by_tiles
        of_wrong_form = test.total >= max(best.total - missed, least)
        if likely or of_wrong_form or _closes_alike(test, best, level, share):
            members.append(test.name)
    return [winner, *members]


def _closes_alike(test: EffectTest, best: EffectTest, level: float, share: float) -> bool:
    """Return whether an effect closes nearly what the best one does, or not significantly less."""
    if test.total <= LEAST_ALIKE_SHARE * best.total:
        return False
    alike = not_significantly_less(test.closed, best.closed, level)
    return alike or test.total >= share * best.total


def not_significantly_less(closed: Tensor, other: Tensor, level: float) -> bool:
    """Return whether one sum over poses is not significantly less than another.

    Args:
        closed: Of every pose, shape (U,).
        other: What it is compared with, shape (U,).
        level: Of the t-test, paired over poses.
    """
    less = (other - closed).numpy()
    spread = float(np.std(less, ddof=1)) / np.sqrt(len(less))
    t = float(np.mean(less)) / max(spread, 1e-30)
    return t <= student_quantile(1 - level, len(less) - 1)
