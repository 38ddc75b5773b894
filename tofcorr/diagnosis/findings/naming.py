"""Names the missing effects: add one, try to swap, drop; say which others it could be."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from torch import Tensor

from tofcorr.diagnosis.findings.cause_sets import (
    LEAST_ALIKE_SHARE,
    CauseSet,
    GrowingModel,
    cause_set,
    final_sets,
    unexplained_squares,
    vary_alike,
)
from tofcorr.diagnosis.findings.effect_comparison import (
    EffectComparison,
    EffectTest,
    closed_square,
    compare_effects,
    held_out_squares,
)
from tofcorr.diagnosis.sums.map_gain import map_gain
from tofcorr.diagnosis.sums.study import (
    Study,
    absent_forms,
    relinearised,
    with_poses_reestimated,
    without_map,
)
from tofcorr.simulation.effects import CATALOGUE

# A probe above this score counts even below `unknown_mm`. Scores are standard deviations; chosen
# far above what any of the few hundred sign flips reaches.
_CLEAR_SCORE = 12.0
# An error term that the base model lacks is named first if it closes at least this share of what
# the best effect closes. Chosen: every camera has these errors.
_ABSENT_SHARE = 0.6
# Share of the squared gap that an effect must close to be named because the gap as a whole is
# significant. Chosen: the larger part decides.
_MOST_OF_GAP = 0.5


def probe_to_add(model: GrowingModel, comparison: EffectComparison, gap: float) -> str | None:
    """Return a probe that explains what no effect of the catalogue explains; None: there is none.

    Args:
        model: The model so far.
        comparison: All effects and probes as additions to it.
        gap: Squared gap of the base model, m^2.
    """
    tests = model.study.options.tests
    least = max((tests.unknown_mm / 1000) ** 2, tests.material_share * gap)
    maps = model.study.candidates.maps
    for test in sorted(comparison.probes.values(), key=lambda test: -test.total):
        if test.total <= 0 or test.name in model.rejected:
            continue
        if comparison.family_p_value(test.name) > tests.level:
            continue
        if closed_square(model.study, test) < least and test.score < _CLEAR_SCORE:
            continue
        members = cause_set(comparison, test.name, tests.level, tests.set_share)
        # A map of single pixels can also take any smooth shape, so maps are no rivals of probes;
        # nor is an effect that is as likely but explains little of what the probe does.
        rivals = [
            name
            for name in members
            if name in comparison.tests
            and name not in maps
            and comparison.tests[name].total > LEAST_ALIKE_SHARE * test.total
        ]
        best = max((t.total for t in comparison.tests.values()), default=0.0)
        if not rivals and test.total > best:
            return test.name
    return None


def next_effect(
    model: GrowingModel,
    comparison: EffectComparison,
    gap: float,
    *,
    certain: bool = False,
    least_of_rest: float = 0.1,
) -> tuple[EffectTest, bool] | None:
    """Return the effect to add, and whether under its name, not as a base term; None: stop.

    Args:
        model: The model so far.
        comparison: All effects as additions to it.
        gap: Squared gap of the base model, m^2.
        certain: Whether other tests have found that something is missing.
        least_of_rest: An effect below the same score is named if it closes at least this share, in
            squares, of what then stays unexplained. Chosen: a cause that is not in the catalogue
            resembles some effect a little.
    """
    tests = model.study.options.tests
    unexplained = unexplained_squares(model.study, comparison, at_least=True)
    for test in comparison.ordered():
        if test.total <= 0:
            return None
        rest = least_of_rest * (unexplained - test.total)
        if test.total <= rest and test.score < _CLEAR_SCORE:
            continue
        if test.name in model.names or test.name in model.rejected:
            continue
        if comparison.naming_p_value(test.name) > tests.level and not (
            certain and _explains_gap(model, test, gap)
        ):
            continue
        if test.total <= _closed_by_probes(model, test.name):
            continue
        closed = closed_square(model.study, test)
        members = cause_set(comparison, test.name, tests.level, tests.set_share)
        members = [name for name in members if name not in model.rejected]
        absent = _absent_terms(model, comparison, test)
        finer = [name for name in members if CATALOGUE[name].refines and name not in absent]
        finer = [name for name in finer if name not in model.refined_terms]
        finer = [name for name in finer if comparison.tests[name].p_value <= tests.level]
        if finer and closed < (tests.form_tolerance_mm / 1000) ** 2:
            return comparison.tests[finer[0]], False
        if closed >= least_closed(model, gap, test.name, further=bool(model.names)):
            first = absent[0] if absent else simplest(comparison, members, tests.level)
            return comparison.tests[first], True
    return None


def _explains_gap(model: GrowingModel, test: EffectTest, gap: float) -> bool:
    """Return whether a first effect may be named where the gap as a whole is significant.

    The correction for the number of effects guards against a name where nothing is missing. Where
    that is excluded, an effect must be significant by itself, and close most of a gap that matters.
    """
    options = model.study.options
    closed = closed_square(model.study, test)
    large = closed >= max(_MOST_OF_GAP * gap, (options.target_gap_mm / 1000) ** 2)
    return not model.names and large and test.p_value <= options.tests.level


def _closed_by_probes(model: GrowingModel, name: str) -> float:
    """Return what the probes of a model close that are no part of an effect, m^2.

    They stand for a cause that is in no catalogue. Its form is known least of all, so it may leave
    as much of itself as they explain: what an effect closes beside them, if it is no more, may be
    that.
    """
    known = model.study.candidates.probes
    probes = [probe for probe in model.probes if name not in known[probe].part_of]
    if not probes:
        return 0.0
    without = [column for column in model.columns if column not in probes]
    closed = held_out_squares(model.study, without) - held_out_squares(model.study, model.columns)
    return float(closed.sum())


def least_closed(
    model: GrowingModel, gap: float, name: str, *, further: bool, share_of_form: float = 0.25
) -> float:
    """Return what an effect must close to be reported, m^2.

    The first one must close a share of the gap. Beside others, a size in millimetres is enough;
    but beside one that varies alike, an effect must close what no error in the form of that one
    would.

    Once a finer form of a base term is in the model, the tolerance for such forms applies: what
    that form leaves can look like an effect that resembles it. It applies as well where the
    simulator's error was fitted at other poses, to which that fit has another form error.

    Args:
        model: The model so far.
        gap: Squared gap of the base model, m^2.
        name: The effect.
        further: Whether another effect is named already.
        share_of_form: An effect that varies like a named one closes more than this share of that
            one's form error, in millimetres, or is not reported. Chosen: what a form misses is
            rarely of the shape of a single other effect.
    """
    tests = model.study.options.tests
    alike = [
        CATALOGUE[other].form_error
        for other in model.names
        if other != name and vary_alike(name, other)
    ]
    size, share = model.study.material_mm, tests.material_share
    if further:
        size, share = tests.further_mm, (share_of_form * max(alike, default=0.0)) ** 2
    if model.refined_terms:
        size = tests.form_tolerance_mm
    return max((size / 1000) ** 2, share * gap)


def least_of_hand_eye(study: Study) -> float:
    """Return what a change of the hand-eye transform must close to have a share of a gap, m^2."""
    tests = study.options.tests
    gap = study.left_out_mean_square(()) - study.fit.floor**2
    return max((tests.further_mm / 1000) ** 2, tests.material_share * gap)


def _absent_terms(model: GrowingModel, comparison: EffectComparison, best: EffectTest) -> list[str]:
    """Return error terms that the base model lacks and that close nearly as much as the best."""
    tests = model.study.options.tests
    return [
        name
        for name in absent_forms(model.study)
        if name in comparison.tests
        and name not in model.rejected
        and comparison.tests[name].total >= _ABSENT_SHARE * best.total
        and comparison.family_p_value(name) <= tests.level
    ]


def simplest(
    comparison: EffectComparison, members: Sequence[str], level: float, *, equal_share: float = 0.02
) -> str:
    """Return the significant effect with the fewest columns among those that close equally much.

    Args:
        comparison: All effects.
        members: The effects to choose from; the first one counts as significant.
        level: Of significance.
        equal_share: Of effects whose totals differ by less than this share of the best, the
            simplest is named. Chosen.
    """
    significant = [
        comparison.tests[name]
        for name in members
        if name == members[0] or comparison.family_p_value(name) <= level
    ]
    best = max(test.total for test in significant)
    equal = [test for test in significant if test.total >= (1 - equal_share) * best]
    return min(equal, key=lambda test: (test.size, -test.total)).name


def likeliest(study: Study, last: EffectComparison, *, most: int = 3) -> tuple[str, ...]:
    """Return the effects that may explain what remains, by their score, the likeliest first.

    Each closes at least the square of the target gap, and would be significant if it were the only
    one tested.

    Args:
        study: The recording.
        last: What could be added to the final model.
        most: At most so many are listed. Chosen: what a reader can follow up.
    """
    options = study.options
    least = (options.target_gap_mm / 1000) ** 2
    possible = [
        test
        for test in last.tests.values()
        if test.p_value <= options.tests.level and closed_square(study, test) >= least
    ]
    possible.sort(key=lambda test: -test.score)
    return tuple(test.name for test in possible[:most])


# A named effect is swapped for another that closes more by at least this share of the other's.
# Chosen, so that noise swaps nothing.
_SWAP_SHARE = 0.05


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


def name_effects(study: Study, *, certain: bool = False, most_steps: int = 12) -> NamedEffects:
    """Name effects until none is both significant and large enough to report.

    Args:
        study: The recording.
        certain: Whether other tests have found that something is missing. A first effect that
            explains most of the gap need then be significant by itself only.
        most_steps: At most so many additions; a bound on the time, never reached in practice.
    """
    tests = study.options.tests
    model, final = GrowingModel(study), study
    first = latest = compare_effects(study, ())
    compared, seen = [first], [model.members]
    tested = study.sums.num_units >= tests.least_images
    gap = _mean_square(study, first.squares) - study.fit.floor**2
    for _ in range(most_steps):
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
        test, report = found
        name = test.name
        _add(larger, comparison, test, report=report)
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
        residual = model.study.system.residual_of(model.columns, gls=True)
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
    return float(squares.sum() / study.sums.count.sum())
