"""Which other causes the form of a named effect leaves possible.

A catalogue holds some forms of an effect, and a camera or a room has its own. What a model leaves
beside noise and pose scatter shows that some form is wrong, by that much. The same may hold of
other effects, so three findings follow:

- An effect that closes less than the named one, by no more than the model leaves unexplained, is
  not excluded (`cause_set`).
- Nor is one that closes alone what all that are named close together, less no more than that, or
  that is as likely as the best of them.
- What a further effect closes may be an error in the form of another cause, if it is no larger
  than such errors are (`CatalogueEffect.form_error`). All named effects whose sets hold that cause
  may be parts of it: a form that is wrong by much is often named as two effects, and leaves room
  for a third.
"""

import math
from collections.abc import Mapping, Sequence

from tofcorr.diagnosis.findings.cause_set import LEAST_ALIKE_SHARE, LEAST_OF_WRONG_FORM
from tofcorr.diagnosis.findings.effect_comparison import EffectComparison
from tofcorr.diagnosis.findings.explained import FLOOR_ERROR
from tofcorr.diagnosis.sums.moments import NUM_POSE
from tofcorr.diagnosis.sums.study import Study
from tofcorr.simulation.effects import CATALOGUE
from tofcorr.simulation.effects.needs import VELOCITY

# An effect that explains less than this share of what there is to explain is not known by its form.
# Chosen: the larger part decides.
_MOST_OF_CAUSE = 0.5
# From this form error on an effect may leave as much of itself as it explains (no unit). Chosen: of
# 84 simulated recordings effects of smaller ones joined nine sets by it and were the cause of none.
_WIDE_FORM_ERROR = 1.0


def unexplained_squares(
    study: Study, comparison: EffectComparison, *, at_least: bool = False
) -> float:
    """Return the sum of squares that a model leaves beside noise and pose scatter, m^2.

    Args:
        study: The recording.
        comparison: What could be added to the model.
        at_least: Whether the noise counts as large as it may be, so that it is no form error.
    """
    blocks = study.system.blocks
    most = (1 + FLOOR_ERROR) * study.fit.noise.most if at_least else 1.0
    noise = float(blocks.count.sum()) * (most * study.fit.floor) ** 2
    return max(float(comparison.squares.sum()) - noise - pose_scatter_squares(study), 0.0)


def pose_scatter_squares(study: Study) -> float:
    """Return the sum of squares that a model takes for scatter of the poses, m^2."""
    last = study.system.moments.plain.shape[-1] - 1
    pose = slice(last - NUM_POSE, last)
    columns = study.system.moments.plain[:, pose, pose].diagonal(dim1=1, dim2=2).sum(0)
    return float((study.system.blocks.pose_sd**2 * columns).sum())


def significant_alone(comparisons: Sequence[EffectComparison], level: float) -> set[str]:
    """Return the effects that are significant by themselves, added to one of the models.

    The cause of a significant gap is significant where it is added alone. Millimetres do not show
    that where poses scatter: there an effect that does nothing may close as much as the named one
    by chance. Each effect is judged as if it were the only one tested, so that few are missed.

    Args:
        comparisons: Effects as additions to each model so far, with null distributions.
        level: Of significance.
    """
    return {
        test.name
        for comparison in comparisons
        for test in comparison.tests.values()
        if test.p_value <= level
    }


def also_possible(first: EffectComparison, winner: str, left: float, level: float) -> list[str]:
    """Return further causes of what a named effect explains only the smaller part of.

    What it leaves is then the larger part of the cause, so its form says little of that cause. What
    another effect must close, two thirds of the winner, falls with the winner's share.

    Args:
        first: All effects as additions to the base model.
        winner: The effect named, and the only one.
        left: Sum of squares that the final model leaves unexplained, m^2.
        level: Of significance.
    """
    if winner not in first.tests or CATALOGUE[winner].form_error == 0:
        return []
    best = first.tests[winner].total
    explained = best / max(best + left, 1e-30)
    if explained >= _MOST_OF_CAUSE:
        return []
    least = LEAST_OF_WRONG_FORM * explained / _MOST_OF_CAUSE * best
    return [
        test.name
        for test in first.ordered()
        if test.total >= least and first.family_p_value(test.name) <= level
    ]


def alone_as_good(
    first: EffectComparison, last: EffectComparison, left: float, level: float, share: float
) -> list[str]:
    """Return the effects of which one alone explains nearly all that the model does.

    It closes as much, less no more than the model leaves unexplained; or its likelihood is that of
    the best effect of the model. An effect without form error explains all or is not the cause.

    Args:
        first: All effects as additions to the base model.
        last: What could be added to the final model.
        left: Sum of squares that the final model leaves unexplained, m^2.
        level: Of significance.
        share: Gain in likelihood over that of the best effect that counts as the same.
    """
    together = float(first.squares.sum() - last.squares.sum())
    gains = [first.tests[name].gain for name in last.chosen if name in first.tests]
    best = max(gains, default=math.inf)
    return [
        test.name
        for test in first.ordered()
        if test.name not in last.chosen
        and CATALOGUE[test.name].form_error > 0
        and test.total >= LEAST_OF_WRONG_FORM * together
        and (test.total >= together - left or test.gain >= share * best)
        and first.family_p_value(test.name) <= level
    ]


def of_another_form(comparison: EffectComparison, closed: float) -> list[str]:
    """Return the effects that close as much of a cause as their form errors let them.

    If an effect is the cause and its columns explain C, its form error e leaves up to e^2 C: the
    whole is up to (1 + e^2) C, and another effect that closes that much may only fit it better.
    Only effects whose forms are known to differ widely count.

    Args:
        comparison: Effects as additions to a model.
        closed: What the effect closes that is named, m^2.
    """
    return [
        test.name
        for test in comparison.ordered()
        if (error := CATALOGUE[test.name].form_error) >= _WIDE_FORM_ERROR
        and (1 + error**2) * test.total >= max(closed, 0.0)
    ]


def still_significant(
    first: EffectComparison, last: EffectComparison, name: str, level: float, matters: float
) -> list[str]:
    """Return the effects that one that is named leaves significant, and that closed half as much.

    They are not named beside it where they may be an error in its form. Just as well what it closes
    may be an error in theirs.

    Args:
        first: All effects as additions to the base model.
        last: What could be added to the final model.
        name: The named effect.
        level: Of significance.
        matters: What a further effect must close to be worth a report, a sum of squares, m^2.
    """
    if name not in first.tests or CATALOGUE[name].form_error == 0:
        return []
    least = LEAST_ALIKE_SHARE * first.tests[name].total
    return [
        other
        for other, test in last.tests.items()
        if other in first.tests
        and CATALOGUE[other].form_error > 0
        and vary_alike(name, other)
        and first.tests[other].total >= least
        and first.family_p_value(other) <= level
        and last.family_p_value(other) <= level
        and test.total >= matters
    ]


def misfits(name: str, closed: float, causes: Mapping[str, float]) -> list[str]:
    """Return the causes whose form error may be all that a named effect closes.

    An error that is the same in all pixels of a frame is no form error of one that is not, nor the
    other way round, unless that one displaces camera or target; nor is one that follows the
    velocity of one that does not.

    Args:
        name: The effect in question.
        closed: What it closes beside all others that are named, m^2.
        causes: Other causes, and what is named of each closes without the effect in question, m^2.
    """
    return [
        cause
        for cause, total in causes.items()
        if cause != name
        and vary_alike(name, cause)
        and closed <= CATALOGUE[cause].form_error ** 2 * total
    ]


def shifts_images(name: str) -> bool:
    """Return whether an effect mostly shifts whole images, as scatter of the poses does."""
    return CATALOGUE[name].of_frame or CATALOGUE[name].moves_images


def vary_alike(name: str, other: str) -> bool:
    """Return whether two effects both shift whole images or not, and follow the velocity or not.

    An effect that displaces camera or target mostly shifts whole images, but not only.
    """
    one, two = CATALOGUE[name], CATALOGUE[other]
    moved = (one.of_frame and two.moves_images) or (two.of_frame and one.moves_images)
    alike = moved or one.of_frame == two.of_frame
    return alike and (VELOCITY in one.needs) == (VELOCITY in two.needs)
