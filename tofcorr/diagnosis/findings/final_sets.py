"""For each effect of the final model the causes that the data cannot distinguish from it."""

from collections.abc import Sequence
from typing import Protocol

from tofcorr.diagnosis.findings.cause_set import cause_set
from tofcorr.diagnosis.findings.effect_comparison import EffectComparison, compare_effects
from tofcorr.diagnosis.findings.form_error import (
    alone_as_good,
    also_possible,
    misfits,
    significant_alone,
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


def final_sets(
    model: FinalModel, compared: Sequence[EffectComparison]
) -> tuple[tuple[str, ...], ...]:
    """Return the cause set of each named effect, itself first.

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
        alone += also_possible(first, model.names[0], left, tests.level)
    possible = significant_alone(compared, tests.level)
    return tuple(
        tuple(dict.fromkeys([*_own_set(model, name, first, left, possible), *alone]))
        for name in model.names
    )


def _own_set(
    model: FinalModel, name: str, first: EffectComparison, left: float, possible: set[str]
) -> list[str]:
    """Return the cause set of a named effect; of the other named ones those it may be part of.

    Args:
        model: The final model.
        name: The named effect.
        first: All effects as additions to the base model.
        left: Sum of squares that the model leaves unexplained, m^2.
        possible: Effects that may be a cause at all.
    """
    if name in model.map_sets:
        members = model.map_sets[name]
        return [name, *(member for member in members if member in possible)]
    tests = model.study.options.tests
    comparison = compare_effects(model.study, model.without(name), flips=False)
    members = cause_set(comparison, name, tests.level, tests.set_share, left)
    rivals = [m for m in members if m in possible and m not in model.names]
    alike = [other for other in CATALOGUE[name].may_be if other in comparison.tests]
    return [name, *rivals, *misfits(first, comparison, name, model.names), *alike]
