"""What errors in the forms of effects leave possible.

A catalogue holds some forms of an effect, and a camera or a room has its own. If an effect is the
cause of C, its columns explain at least C / (1 + e^2), where e is its `form_error`. The rest is
left, looks like scatter of the poses, or is named as another effect. So two findings follow:

- An effect that closes less than the named one, by no more than is left or taken for scatter of
  the poses, is not excluded (`cause_set`).
- Nor is one that closes, in the place of several that are named, not significantly less of what
  they close together than the cause of it would (`one_cause`).

Neither is said of an effect that fits worse than such an error explains (`fits_too_badly`).
"""

from collections.abc import Callable, Sequence

from torch import Tensor

from tofcorr.diagnosis.findings.cause_set import LEAST_ALIKE_SHARE, not_significantly_less
from tofcorr.diagnosis.findings.effect_comparison import EffectComparison
from tofcorr.diagnosis.findings.effect_test import EffectTest
from tofcorr.diagnosis.findings.explained import FLOOR_ERROR
from tofcorr.diagnosis.sums.moments import NUM_POSE
from tofcorr.diagnosis.sums.study import Study
from tofcorr.simulation.effects import CATALOGUE
from tofcorr.simulation.effects.needs import VELOCITY


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


def one_cause(
    comparison: EffectComparison,
    part: str,
    together: Tensor,
    level: float,
    excluded: Callable[[EffectTest], bool] = lambda _: False,
) -> list[str]:
    """Return the effects of which a named one and others may be parts.

    An error that is the same in all pixels of a frame is no form of one that is not, nor the other
    way round, unless that one displaces camera or target; nor is one that follows the velocity of
    one that does not.

    Args:
        comparison: Effects as additions to the model without the parts.
        part: The named effect.
        together: What it and the others close of every pose in that place, shape (U,), m^2.
        level: Of the test whether an effect closes less than the cause would.
        excluded: Whether an effect fits too badly for that.
    """
    found = []
    for test in comparison.ordered():
        error = CATALOGUE[test.name].form_error
        most = (1 + error**2) * test.closed
        alike = error > 0 and vary_alike(test.name, part)
        large = float(most.sum()) > LEAST_ALIKE_SHARE * float(together.sum())
        possible = alike and large and not_significantly_less(most, together, level)
        if possible and not excluded(test):
            found.append(test.name)
    return found


def vary_alike(name: str, other: str) -> bool:
    """Return whether two effects both shift whole images or not, and follow the velocity or not.

    An effect that displaces camera or target mostly shifts whole images, but not only.
    """
    one, two = CATALOGUE[name], CATALOGUE[other]
    moved = (one.of_frame and two.moves_images) or (two.of_frame and one.moves_images)
    alike = moved or one.of_frame == two.of_frame
    return alike and (VELOCITY in one.needs) == (VELOCITY in two.needs)
