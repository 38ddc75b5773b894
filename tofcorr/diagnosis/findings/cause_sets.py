"""Which effects the data cannot distinguish from those that are named.

A catalogue holds some forms of an effect, and a camera or a room has its own. If an effect is the
cause of C, its columns explain at least C / (1 + e^2), where e is its `form_error`. The rest is
left, looks like scatter of the poses, or is named as another effect. So two findings follow:

- An effect that closes less than the named one, by no more than is left or taken for scatter of
  the poses, is not excluded (`cause_set`).
- Nor is one that closes, in the place of several that are named, not significantly less of what
  they close together than the cause of it would (`one_cause`).

Neither is said of an effect that fits worse than such an error explains (`fits_too_badly`).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import NamedTuple

import numpy as np
from torch import Tensor

from tofcorr.diagnosis.findings.effect_comparison import (
    EffectComparison,
    EffectTest,
    compare_effects,
    held_out_squares,
)
from tofcorr.diagnosis.sums.gains import HeldOutSquares
from tofcorr.diagnosis.sums.linear_system import NUM_POSE
from tofcorr.diagnosis.sums.noise import FLOOR_ERROR
from tofcorr.diagnosis.sums.observations import TINY
from tofcorr.diagnosis.sums.study import Study
from tofcorr.estimation.robust import student_quantile
from tofcorr.simulation.effects import CATALOGUE
from tofcorr.simulation.effects.inputs import VELOCITY


@dataclass
class GrowingModel:
    """A model that grows; `order` holds all effects ever named, in the order they came."""

    study: Study
    names: list[str] = field(default_factory=list)
    order: list[str] = field(default_factory=list)
    refined_terms: list[str] = field(default_factory=list)
    probes: dict[str, float] = field(default_factory=dict)
    map_sets: dict[str, list[str]] = field(default_factory=dict)
    maps: dict[str, Tensor] = field(default_factory=dict)
    rejected: set[str] = field(default_factory=set)

    @property
    def members(self) -> tuple[set[str], set[str], set[str]]:
        """Effects named, refined base terms and probes."""
        return set(self.names), set(self.refined_terms), set(self.probes)

    def copied(self) -> "GrowingModel":
        """Return a model that can grow while this one stays as it is."""
        own = vars(self).copy()
        return GrowingModel(own.pop("study"), **{name: value.copy() for name, value in own.items()})

    @property
    def columns(self) -> list[str]:
        """All of the model that has columns."""
        known = self.study.sums.layout.effects
        return [n for n in (*self.names, *self.refined_terms, *self.probes) if n in known]

    def name(self, effect: str, instead_of: str | None = None) -> None:
        """Name an effect; one that was dropped and comes back keeps its place."""
        place = len(self.order)
        if instead_of is not None:
            self.names.remove(instead_of)
            place = self.order.index(instead_of) + 1
        if effect not in self.order:
            self.order.insert(place, effect)
        self.names.append(effect)
        self.names.sort(key=self.order.index)

    def without(self, name: str) -> list[str]:
        """Return all columns but those of one effect."""
        return [other for other in self.columns if other != name]


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
    explained = best.total / max(best.total + unexplained, TINY)
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
    t = float(np.mean(less)) / max(spread, TINY)
    return t <= student_quantile(1 - level, len(less) - 1)


def unexplained_squares(
    study: Study, comparison: EffectComparison, *, at_least: bool = False
) -> float:
    """Return the sum of squares that a model leaves beside noise and pose scatter, m^2.

    Args:
        study: The recording.
        comparison: What could be added to the model.
        at_least: Whether the noise counts as large as it may be, so that it is no form error.
    """
    blocks = study.sums
    most = (1 + FLOOR_ERROR) * study.fit.noise.most if at_least else 1.0
    noise = float(blocks.count.sum()) * (most * study.fit.floor) ** 2
    return max(float(comparison.squares.sum()) - noise - pose_scatter_squares(study), 0.0)


def pose_scatter_squares(study: Study) -> float:
    """Return the sum of squares that a model takes for scatter of the poses, m^2."""
    last = study.sums.plain.shape[-1] - 1
    pose = slice(last - NUM_POSE, last)
    columns = study.sums.plain[:, pose, pose].diagonal(dim1=1, dim2=2).sum(0)
    return float((study.sums.pose_sd**2 * columns).sum())


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


class CauseSet(NamedTuple):
    """The effects that data cannot distinguish from one that is named.

    Attributes:
        members: Their names, that of the named one first.
        closes: What members close in the place of the named one, over what that closes. Other
            effects of the model are not among them.
    """

    members: tuple[str, ...]
    closes: Mapping[str, float]


def final_sets(model: GrowingModel, compared: Sequence[EffectComparison]) -> tuple[CauseSet, ...]:
    """Return the cause set of each named effect.

    Args:
        model: The final model.
        compared: Effects as additions to the base model, to every model since, and to the final
            one, with null distributions.
    """
    level = model.study.options.tests.level
    possible = significant_alone(compared, level) | set(model.names)
    whole = _causes_of_several(model)
    sets = []
    for name in model.names:
        beside = _beside(model, name, compared[0])
        members = [*_own_set(model, name, beside, compared[-1]), *whole[name]]
        kept = [m for m in members if m in possible or m in CATALOGUE[name].may_be]
        sets.append(_with_sizes([name, *kept], beside))
    return tuple(sets)


def _beside(model: GrowingModel, name: str, first: EffectComparison) -> EffectComparison:
    """Return effects as additions to the model without a named one; of a map, to the base model."""
    if name in model.map_sets:
        return first
    return compare_effects(model.study, model.without(name), flips=False)


def _own_set(
    model: GrowingModel, name: str, beside: EffectComparison, last: EffectComparison
) -> list[str]:
    """Return what a named effect may be instead.

    Args:
        model: The final model.
        name: The named effect.
        beside: All effects as additions to the model without it.
        last: All effects as additions to the model.
    """
    if name in model.map_sets:
        return model.map_sets[name]
    tests = model.study.options.tests
    # What a form misses is left, or looks like scatter of the poses.
    missed = unexplained_squares(model.study, last, at_least=True)
    missed += pose_scatter_squares(model.study)
    unexplained = unexplained_squares(model.study, last)
    gains = _chi_squared(model, model.without(name)).closed
    members = cause_set(beside, name, tests.level, tests.set_share, missed, unexplained, gains)
    rivals = [member for member in members if member not in model.names]
    known = (*beside.tests, *model.names)
    alike = [other for other in CATALOGUE[name].may_be if other in known]
    return [*rivals, *alike]


def _chi_squared(model: GrowingModel, chosen: Sequence[str]) -> HeldOutSquares:
    """Return the chi-squared of held-out poses, by some effects of the model and by one more.

    It knows that poses scatter, and so which part of what an effect closes is a shift of single
    images, and which part has the effect's own shape within them.
    """
    return HeldOutSquares(model.study.sums.gls, chosen, model.study.folds)


def _causes_of_several(model: GrowingModel) -> dict[str, list[str]]:
    """Return for each named effect the causes of which it and others may be parts."""
    level = model.study.options.tests.level
    found: dict[str, list[str]] = {name: [] for name in model.names}
    named = [name for name in model.names if name in model.columns]
    if len(named) <= 1:
        return found
    left = held_out_squares(model.study, model.columns)
    whole = _chi_squared(model, model.columns).squares
    for size in range(2, len(named) + 1):
        for parts in combinations(named, size):
            rest = [name for name in model.columns if name not in parts]
            comparison = compare_effects(model.study, rest, flips=False, maps=False)
            together = comparison.squares - left
            beside, known = _chi_squared(model, rest), [comparison.tests[part] for part in parts]

            def excluded(
                test: EffectTest,
                beside: HeldOutSquares = beside,
                known: list[EffectTest] = known,
            ) -> bool:
                """Return whether an effect fits too badly to be the cause of several parts."""
                gains, of_cause = beside.closed(test.name), beside.squares - whole
                return comparable(test, *known) and fits_too_badly(test, gains, of_cause, level)

            for part in parts:
                found[part] += one_cause(comparison, part, together, level, excluded)
    return found


def _with_sizes(members: Sequence[str], beside: EffectComparison) -> CauseSet:
    """Return members, the named one first and each once, with what they close beside the others."""
    own = max(beside.tests[members[0]].total, TINY)
    closes = {n: beside.tests[n].total / own for n in members if n in beside.tests}
    return CauseSet(tuple(dict.fromkeys(members)), closes)
