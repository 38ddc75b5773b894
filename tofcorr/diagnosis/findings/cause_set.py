"""Which effects the data cannot distinguish from the one that is named."""

from collections.abc import Callable

import numpy as np
from torch import Tensor

from tofcorr.diagnosis.findings.effect_comparison import EffectComparison
from tofcorr.diagnosis.findings.effect_test import EffectTest
from tofcorr.estimation.student import student_quantile
from tofcorr.simulation.effects import CATALOGUE

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
    gains: Callable[[str], Tensor] | None = None,
) -> list[str]:
    """Return the effects that these data cannot distinguish from the winner, itself first.

    An effect belongs to the set if it closes more than half of what the winner closes and not
    significantly less (a t-test, paired over poses) or at least `share` of it. So does one that
    closes two thirds of it, and less by no more than the form of an effect may miss. Where the
    winner explains less than half of what there is, its form says little of the cause: then less
    than two thirds are enough, in proportion. So does an effect that is at least as likely: what an
    effect closes is uncertain where poses scatter and are few, and the likelihood knows how much.

    Whatever it closes, an effect does not belong to the set if it gains significantly less in
    likelihood than any error in its form explains (`fits_too_badly`).

    Args:
        comparison: All effects.
        winner: The effect or probe that is compared.
        level: Of the t-test.
        share: See above.
        missed: Sum of squares that the form of an effect may miss, m^2.
        unexplained: Sum of squares that stays unexplained, m^2.
        gains: Falls of chi-squared of each pose by an effect, shape (U,); None: not asked for.
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
        alike = of_wrong_form or _closes_alike(test, best, level, share)
        if alike and not likely and gains is not None and comparable(test, best):
            alike = not fits_too_badly(test, gains(test.name), gains(winner), level)
        if likely or alike:
            members.append(test.name)
    return [winner, *members]


def comparable(test: EffectTest, *named: EffectTest) -> bool:
    """Return whether the likelihood of poses can say that a cause is not this effect.

    It cannot where what is named has more columns: they also fit what the form of a simpler cause
    misses. On a simulated recording `multipath` fitted a clear layer, which is another form of
    `incidence_angle`, better than that effect's two columns did. Nor can it of effects that are
    tested by tiles, or that have one value a cell.

    Args:
        test: The effect.
        named: What is named in its place.
    """
    form = all(CATALOGUE[one.name].form_error > 0 and not one.by_tiles for one in (test, *named))
    return form and sum(one.size for one in named) <= test.size


def fits_too_badly(test: EffectTest, gains: Tensor, of_cause: Tensor, level: float) -> bool:
    """Return whether an effect gains significantly less than if it were the cause of a gap.

    Of what the cause explains, the columns of an effect of that kind explain at least
    1 / (1 + e^2), with e its `form_error`. That holds for chi-squared as for millimetres, and the
    cause explains no less than what is named.

    Args:
        test: The effect.
        gains: Fall of chi-squared of each pose by it, shape (U,).
        of_cause: By what is named, shape (U,).
        level: Of the t-test, paired over poses.
    """
    most = (1 + CATALOGUE[test.name].form_error ** 2) * gains
    return not not_significantly_less(most, of_cause, level)


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
