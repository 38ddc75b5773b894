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
from tofcorr.diagnosis.findings.naming_rules import ModelSoFar
from tofcorr.simulation.effects import CATALOGUE


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
    sets = []
    for name in model.names:
        beside = first
        if name not in model.map_sets:
            beside = compare_effects(model.study, model.without(name), flips=False)
        members = _own_set(model, name, first, beside, left)
        members += still_significant(first, last, name, tests.level)
        kept = [m for m in members if m in possible or m in CATALOGUE[name].may_be]
        sets.append(_with_sizes([name, *kept, *alone], beside))
    return tuple(sets)


def _own_set(
    model: FinalModel, name: str, first: EffectComparison, beside: EffectComparison, left: float
) -> list[str]:
    """Return what a named effect may be instead, and other named ones that it may be part of.

    Args:
        model: The final model.
        name: The named effect.
        first: All effects as additions to the base model.
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
    return [*rivals, *misfits(first, beside, name, model.names), *alike]


def _with_sizes(members: Sequence[str], beside: EffectComparison) -> CauseSet:
    """Return members, the named one first and each once, with what they close beside the others."""
    own = max(beside.tests[members[0]].total, 1e-30)
    closes = {n: beside.tests[n].total / own for n in members if n in beside.tests}
    return CauseSet(tuple(dict.fromkeys(members)), closes)
