"""For each effect of the final model the causes that the data cannot distinguish from it."""

from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from typing import NamedTuple, Protocol

from tofcorr.diagnosis.findings.cause_set import cause_set, comparable, fits_too_badly
from tofcorr.diagnosis.findings.effect_comparison import (
    EffectComparison,
    compare_effects,
    held_out_squares,
)
from tofcorr.diagnosis.findings.effect_test import EffectTest
from tofcorr.diagnosis.findings.form_error import (
    one_cause,
    pose_scatter_squares,
    significant_alone,
    unexplained_squares,
)
from tofcorr.diagnosis.findings.likelihood import Likelihood
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


def _beside(model: FinalModel, name: str, first: EffectComparison) -> EffectComparison:
    """Return effects as additions to the model without a named one; of a map, to the base model."""
    if name in model.map_sets:
        return first
    return compare_effects(model.study, model.without(name), flips=False)


def _own_set(
    model: FinalModel, name: str, beside: EffectComparison, last: EffectComparison
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
    gains = Likelihood(model.study, model.without(name)).gains
    members = cause_set(beside, name, tests.level, tests.set_share, missed, unexplained, gains)
    rivals = [member for member in members if member not in model.names]
    known = (*beside.tests, *model.names)
    alike = [other for other in CATALOGUE[name].may_be if other in known]
    return [*rivals, *alike]


def _causes_of_several(model: FinalModel) -> dict[str, list[str]]:
    """Return for each named effect the causes of which it and others may be parts."""
    level = model.study.options.tests.level
    found: dict[str, list[str]] = {name: [] for name in model.names}
    named = [name for name in model.names if name in model.columns]
    if len(named) <= 1:
        return found
    left = held_out_squares(model.study, model.columns)
    whole = Likelihood(model.study, model.columns)
    for size in range(2, len(named) + 1):
        for parts in combinations(named, size):
            rest = [name for name in model.columns if name not in parts]
            comparison = compare_effects(model.study, rest, flips=False, maps=False)
            together = comparison.squares - left
            excluded = _excluded(Likelihood(model.study, rest), whole, comparison, parts, level)
            for part in parts:
                found[part] += one_cause(comparison, part, together, level, excluded)
    return found


def _excluded(
    beside: Likelihood,
    whole: Likelihood,
    comparison: EffectComparison,
    parts: Sequence[str],
    level: float,
) -> Callable[[EffectTest], bool]:
    """Return what says that an effect fits too badly to be the cause of several parts.

    Args:
        beside: Of the model without the parts.
        whole: Of the model.
        comparison: All effects as additions to the model without the parts.
        parts: Effects of the model.
        level: Of the test.
    """
    of_cause = beside.gains_of(whole)
    known = [comparison.tests[part] for part in parts]

    def excluded(test: EffectTest) -> bool:
        if not comparable(test, *known):
            return False
        return fits_too_badly(test, beside.gains(test.name), of_cause, level)

    return excluded


def _with_sizes(members: Sequence[str], beside: EffectComparison) -> CauseSet:
    """Return members, the named one first and each once, with what they close beside the others."""
    own = max(beside.tests[members[0]].total, 1e-30)
    closes = {n: beside.tests[n].total / own for n in members if n in beside.tests}
    return CauseSet(tuple(dict.fromkeys(members)), closes)
