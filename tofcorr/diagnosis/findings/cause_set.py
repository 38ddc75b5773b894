"""Which effects the data cannot distinguish from the one that is named."""

import numpy as np

from tofcorr.diagnosis.findings.effect_comparison import EffectComparison
from tofcorr.estimation.student import student_quantile

LEAST_ALIKE_SHARE = 0.5
"""An effect that closes less than this share of the winner is distinguishable from it, however
large the variation between poses. Chosen."""
LEAST_OF_WRONG_FORM = 2 / 3
"""An effect whose form may be wrong closes at least this share of the winner, or it is
distinguishable. Chosen: multipath by a renderer closed nine tenths of what the winner did."""


def cause_set(
    comparison: EffectComparison, winner: str, level: float, share: float, left: float = 0.0
) -> list[str]:
    """Return the effects that these data cannot distinguish from the winner, itself first.

    An effect belongs to the set if it closes more than half of what the winner closes and not
    significantly less (a t-test, paired over poses) or less by no more than `left`, or if it closes
    at least `share` of it. So does an effect that is at least as likely: what an effect closes is
    uncertain where poses scatter and are few, and the likelihood knows how much they do.

    Args:
        comparison: All effects.
        winner: The effect or probe that is compared.
        level: Of the t-test.
        share: See above.
        left: Sum of squares that the form of an effect may miss, m^2.
    """
    best = comparison.probes.get(winner) or comparison.tests[winner]
    members = []
    for test in comparison.ordered():
        if test.name == winner:
            continue
        if test.gain >= best.gain and not best.by_tiles:
            members.append(test.name)
            continue
        if test.total <= LEAST_ALIKE_SHARE * best.total:
            continue
        less = (best.closed - test.closed).numpy()
        spread = float(np.std(less, ddof=1)) / np.sqrt(len(less))
        t = float(np.mean(less)) / max(spread, 1e-30)
        alike = t <= student_quantile(1 - level, len(less) - 1)
        alike = alike or test.total >= max(best.total - left, LEAST_OF_WRONG_FORM * best.total)
        if alike or test.total >= share * best.total:
            members.append(test.name)
    return [winner, *members]
