"""For each effect of the final model the causes that the data cannot distinguish from it."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol

from tofcorr.diagnosis.findings.cause_set import cause_set
from tofcorr.diagnosis.findings.effect_comparison import EffectComparison, compare_effects
from tofcorr.diagnosis.findings.form_error import (
    alone_as_good,
    also_possible,
    misfits,
    of_another_form,
    pose_scatter_squares,
    shifts_images,
    significant_alone,
    still_significant,
    unexplained_squares,
)
from tofcorr.diagnosis.findings.naming_rules import ModelSoFar, least_of_further
from tofcorr.diagnosis.sums.additions import HeldOutSquares
from tofcorr.diagnosis.sums.study import Study
from tofcorr.simulation.effects import CATALOGUE

# How often causes join sets: what is named of a cause grows with the sets that hold it. Chosen: one
# round for effects that are named, one for what those may be.
_ROUNDS = 2


class FinalModel(ModelSoFar, Protocol):
    """What is read of a model that grows no more.

    Attributes:
        map_sets: Cause sets of its maps, from when they were added.
    """

    map_sets: dict[str, list[str]]

    def without(self, name: str) -> list[str]:
        """Return all columns but those of one effect."""
        ...


class CauseSet(NamedTuple):
    """The effects that data cannot distinguish from one that is named.

    Attributes:
        members: Their names, that of the named one first.
        closes: What members close in the place of the named one, over what that closes. Other
            effects of the model are not among them.
    """

    members: tuple[str, ...]
    closes: Mapping[str, float]


def final_sets(model: FinalModel, compared: Sequence[EffectComparison]) -> tuple[CauseSet, ...]:
    """Return the cause set of each named effect.

    Args:
        model: The final model.
        compared: Effects as additions to the base model, to every model since, and to the final
            one, with null distributions.
    """
    first, last = compared[0], compared[-1]
    tests = model.study.options.tests
    left = unexplained_squares(model.study, last, at_least=True)
    alone = alone_as_good(first, last, left, tests.level, tests.set_share)
    if len(model.names) == 1:
        most = unexplained_squares(model.study, last)
        alone += also_possible(first, model.names[0], most, tests.level)
    possible = significant_alone(compared, tests.level) | set(model.names)
    beside = {name: _beside(model, name, first) for name in model.names}
    own = {name: _own_set(model, name, beside[name], left) for name in model.names}
    for _ in range(_ROUNDS):
        own = {name: [*own[name], *_misfits(model, name, own, beside[name])] for name in own}
    matters = least_of_further(model.study) * float(model.study.system.blocks.count.sum())
    sets = []
    for name in model.names:
        found = still_significant(first, last, name, tests.level, matters)
        members = [*own[name], *found]
        kept = [m for m in members if m in possible or m in CATALOGUE[name].may_be]
        sets.append(_with_sizes([name, *kept, *alone], beside[name]))
    return tuple(sets)


def _beside(model: FinalModel, name: str, first: EffectComparison) -> EffectComparison:
    """Return effects as additions to the model without a named one; of a map, to the base model."""
    if name in model.map_sets:
        return first
    return compare_effects(model.study, model.without(name), flips=False)


def _own_set(model: FinalModel, name: str, beside: EffectComparison, left: float) -> list[str]:
    """Return what a named effect may be instead.

    Args:
        model: The final model.
        name: The named effect.
        beside: All effects as additions to the model without it.
        left: Sum of squares that the model leaves unexplained, m^2.
    """
    if name in model.map_sets:
        return model.map_sets[name]
    tests = model.study.options.tests
    members = cause_set(beside, name, tests.level, tests.set_share, left)
    if shifts_images(name):
        left += pose_scatter_squares(model.study)  # What its form misses looks like scatter.
        wider = cause_set(beside, name, tests.level, tests.set_share, left)
        members += [member for member in wider if shifts_images(member)]
    members += of_another_form(beside, beside.tests[name].total)
    rivals = [member for member in members if member not in model.names]
    known = (*beside.tests, *model.names)
    alike = [other for other in CATALOGUE[name].may_be if other in known]
    return [*rivals, *alike]


def _misfits(
    model: FinalModel, name: str, own: Mapping[str, Sequence[str]], beside: EffectComparison
) -> list[str]:
    """Return the causes of other named effects that a named one may be an error in the form of."""
    if name in model.map_sets:
        return []
    return misfits(name, beside.tests[name].total, other_causes(model, name, own))


def other_causes(
    model: FinalModel, name: str, own: Mapping[str, Sequence[str]]
) -> dict[str, float]:
    """Return the causes of the other named effects, and what is named of each closes, m^2.

    Args:
        model: The final model.
        name: The effect that is left out.
        own: What each named effect may be instead.
    """
    others = [other for other in model.without(name) if other in model.names]
    parts: dict[str, tuple[str, ...]] = {}
    for cause in dict.fromkeys(member for other in others for member in (other, *own[other])):
        parts[cause] = tuple(other for other in others if cause in (other, *own[other]))
    closed = {names: _closed(model.study, names) for names in set(parts.values())}
    return {cause: closed[names] for cause, names in parts.items()}


def _closed(study: Study, names: Sequence[str]) -> float:
    """Return the fall of the held-out sum of squares by effects together, m^2."""
    blocks, folds = study.system.blocks, study.resampling.folds
    before, after = (HeldOutSquares(blocks, each, folds).squares for each in ((), names))
    return float((before - after).sum())


def _with_sizes(members: Sequence[str], beside: EffectComparison) -> CauseSet:
    """Return members, the named one first and each once, with what they close beside the others."""
    own = max(beside.tests[members[0]].total, 1e-30)
    closes = {n: beside.tests[n].total / own for n in members if n in beside.tests}
    return CauseSet(tuple(dict.fromkeys(members)), closes)
