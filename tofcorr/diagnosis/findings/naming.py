"""Names the missing effects: add one, try to swap, drop; say which others it could be."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from torch import Tensor

from tofcorr.diagnosis.findings.cause_set import cause_set
from tofcorr.diagnosis.findings.effect_comparison import (
    EffectComparison,
    closed_square,
    compare_effects,
)
from tofcorr.diagnosis.findings.effect_test import EffectTest
from tofcorr.diagnosis.findings.final_sets import CauseSet, final_sets
from tofcorr.diagnosis.findings.growing_model import GrowingModel
from tofcorr.diagnosis.findings.likeliest import likeliest
from tofcorr.diagnosis.findings.naming_rules import (
    least_closed,
    next_effect,
    probe_to_add,
)
from tofcorr.diagnosis.sums.changes import relinearised, with_poses_reestimated, without_map
from tofcorr.diagnosis.sums.map_gain import map_gain
from tofcorr.diagnosis.sums.study import Study, likely_residual_of

# A named effect is swapped for another that closes more by at least this share of the other's.
# Chosen, so that noise swaps nothing.
_SWAP_SHARE = 0.05
# At most so many additions; a bound on the time, never reached in practice.
_MOST_STEPS = 12


@dataclass(frozen=True, kw_only=True)
class NamedEffects:
    """The effects named, and the comparisons that led to them.

    Attributes:
        first: All effects as additions to the base model.
        last: All others as additions to the final model.
        names: The effects named, in the order added.
        refined_terms: Finer forms of base terms that were added to the model; too small to report.
        probes: Probes in the model: they explain what no effect explains.
        sets: For each named effect those that the data cannot distinguish from it, itself first;
            another named effect where it may be an error in the form of that one.
        likeliest: At most three effects that would close most of what remains, but are not
            significant among so many; the likeliest first.
        study: The recording with the named maps subtracted, and the uncertainty of the poses
            estimated with the final model.
        tested: Whether there were enough poses for a test.
        certain: Whether the first effect is named because tests of the whole found a gap; among so
            many effects it is not significant.
        probe_p_values: Of each probe when it was added.
        maps: Value in each pixel of every named effect that has no columns, (M,) each, metres.
    """

    first: EffectComparison
    last: EffectComparison
    names: tuple[str, ...]
    refined_terms: tuple[str, ...]
    probes: tuple[str, ...]
    sets: tuple[CauseSet, ...]
    likeliest: tuple[str, ...]
    study: Study
    tested: bool
    certain: bool
    probe_p_values: Mapping[str, float]
    maps: Mapping[str, Tensor]

    @property
    def cause_sets(self) -> tuple[tuple[str, ...], ...]:
        """The members of each cause set."""
        return tuple(one.members for one in self.sets)

    @property
    def adds_something(self) -> bool:
        """Whether a simulator with the findings differs from one without."""
        return bool(self.names or self.refined_terms)

    @property
    def columns(self) -> tuple[str, ...]:
        """Effects of the final model that have columns, refined base terms included."""
        effects = self.study.candidates.effects
        return tuple(name for name in (*self.names, *self.refined_terms) if name in effects)

    @property
    def model(self) -> tuple[str, ...]:
        """All of the final model that has columns, probes included."""
        return (*self.columns, *self.probes)


def name_effects(study: Study, *, certain: bool = False) -> NamedEffects:
    """Name effects until none is both significant and large enough to report.

    Args:
        study: The recording.
        certain: Whether other tests have found that something is missing. A first effect that
            explains most of the gap need then be significant by itself only.
    """
    tests = study.options.tests
    model, final = GrowingModel(study), study
    first = latest = compare_effects(study, ())
    compared, seen = [first], [model.members]
    tested = study.system.blocks.num_units >= tests.least_images
    gap = _mean_square(study, first.squares) - study.fit.floor**2
    for _ in range(_MOST_STEPS):
        if not tested or len(model.names) >= tests.most_effects:
            break
        name, larger = _with_next(model, latest, gap, certain=certain)
        if name is None:
            break
        if larger.members in seen:
            # Two effects would otherwise drop one another in turn.
            model.rejected.add(name)
            continue
        model = larger
        seen.append(model.members)
        final = relinearised(model.study, model.columns)
        latest = compare_effects(final, model.columns)
        compared.append(latest)
    return NamedEffects(
        first=first,
        last=latest,
        names=tuple(model.names),
        refined_terms=tuple(model.refined_terms),
        probes=tuple(model.probes),
        probe_p_values=model.probes,
        sets=final_sets(model, compared),
        likeliest=likeliest(final, latest),
        study=final,
        tested=tested,
        certain=certain and bool(model.names),
        maps=model.maps,
    )


def _with_next(
    model: GrowingModel, comparison: EffectComparison, gap: float, *, certain: bool
) -> tuple[str | None, GrowingModel]:
    """Return the effect or probe to add, and the model with it; None: there is none to add.

    Args:
        model: The model so far.
        comparison: All effects and probes as additions to it.
        gap: Squared gap of the base model, m^2.
        certain: Whether other tests have found that something is missing.
    """
    larger, name = model.copied(), probe_to_add(model, comparison, gap)
    if name is not None:
        larger.probes[name] = comparison.family_p_value(name)
        larger.study = with_poses_reestimated(larger.study, larger.columns)
    else:
        found = next_effect(model, comparison, gap, certain=certain)
        if found is None:
            return None, model
        name = found.test.name
        _add(larger, comparison, found.test, report=found.report)
    if len(larger.columns) > 1:
        _refine(larger, gap)
    return name, larger


def _add(
    model: GrowingModel, comparison: EffectComparison, test: EffectTest, *, report: bool
) -> None:
    """Add an effect to the model; `report`: under its name, else as a refined base term."""
    if report:
        model.name(test.name)
    else:
        model.refined_terms.append(test.name)
    if test.name in model.study.candidates.maps:
        tests = model.study.options.tests
        model.map_sets[test.name] = cause_set(comparison, test.name, tests.level, tests.set_share)
        effect = model.study.candidates.maps[test.name]
        residual = likely_residual_of(model.study, model.columns)
        values = map_gain(model.study, effect, residual).values
        model.maps[test.name] = values
        model.study = without_map(model.study, values, {test.name, *effect.contains})
    model.study = with_poses_reestimated(model.study, model.columns)


def _refine(model: GrowingModel, gap: float) -> None:
    """Swap named effects for better ones; drop small ones; report refined terms grown large."""
    changed = False
    for name in [n for n in model.names if n in model.study.candidates.effects]:
        comparison = _compared(model.study, model.without(name))
        own = comparison.tests[name]
        best = comparison.ordered()[0]
        better = best.name != name and own.total < (1 - _SWAP_SHARE) * best.total
        if better and _significant(model, best.name, instead_of=name):
            model.name(best.name, instead_of=name)
            changed = True
            continue
        closed = closed_square(model.study, own)
        if closed < least_closed(model, gap, name, further=len(model.names) > 1):
            model.names.remove(name)
            changed = True
    for name in list(model.refined_terms):
        own = _compared(model.study, model.without(name)).tests[name]
        least = least_closed(model, gap, name, further=bool(model.names))
        large = closed_square(model.study, own) >= least
        if large and _significant(model, name):
            model.refined_terms.remove(name)
            model.name(name)
            changed = True
    if changed:
        model.study = with_poses_reestimated(model.study, model.columns)


def _significant(model: GrowingModel, name: str, instead_of: str | None = None) -> bool:
    """Return whether an effect is significant in the model beside all others.

    A refined term came into the model in the place of another effect, and an effect that is swapped
    in was compared by size alone, so nothing has tested them yet.
    """
    rest = model.without(name if instead_of is None else instead_of)
    others = compare_effects(model.study, rest, maps=False)
    return others.family_p_value(name) <= model.study.options.tests.level


def _compared(study: Study, names: Sequence[str]) -> EffectComparison:
    return compare_effects(study, names, flips=False, maps=False)


def _mean_square(study: Study, squares: Tensor) -> float:
    return float(squares.sum() / study.system.blocks.count.sum())
