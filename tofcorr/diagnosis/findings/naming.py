"""Names the missing effects: add one, try to swap, drop; say which others it could be."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, combinations

from torch import Tensor

from tofcorr.diagnosis.findings.effect_comparison import (
    EffectComparison,
    EffectTest,
    cause_set,
    closed_square,
    comparable,
    compare_effects,
    fits_too_badly,
    held_out_squares,
    one_cause,
    pose_scatter_squares,
    unexplained_squares,
    vary_alike,
)
from tofcorr.diagnosis.sums.gains import FittedMap, HeldOutSquares
from tofcorr.diagnosis.sums.observations import TINY
from tofcorr.diagnosis.sums.study import (
    Study,
    absent_forms,
    relinearised,
    with_poses_reestimated,
    without_map,
)
from tofcorr.simulation.effects import CATALOGUE

# A score above this counts whatever the size is. Scores are standard deviations; chosen far above
# what any of the few hundred sign flips reaches.
_CLEAR_SCORE = 12.0


@dataclass(frozen=True, kw_only=True)
class NamedEffects:
    """A model of named effects, while it grows and in the end, and what led to it.

    Attributes:
        study: The recording with the named maps subtracted, and the uncertainty of the poses
            estimated with the model.
        first: All effects as additions to the base model.
        last: All others as additions to this model.
        names: The effects named, in the order added.
        refined_terms: Finer forms of base terms that were added to the model; too small to report.
        probes: Probes in the model, which explain what no effect explains, and the p-value of each
            when it was added.
        maps: Value in each pixel of every named effect that has no columns, (M,) each, metres.
        map_sets: The cause set of each of these, from when it was added.
        order: All effects ever named; one that was dropped and comes back keeps its place.
        rejected: Effects that lead back to an earlier model.
        sets: For each named effect those that the data cannot distinguish from it, itself first,
            and what each closes in its place over what it closes; NaN for another named effect,
            where it may be an error in the form of that one.
        likeliest: At most three effects that would close most of what remains, but are not
            significant among so many; the likeliest first.
        tested: Whether there were enough poses for a test.
        certain: Whether other tests have found that something is missing, so that a first effect
            is named which is not significant among so many.
    """

    study: Study
    first: EffectComparison
    last: EffectComparison
    names: tuple[str, ...] = ()
    refined_terms: tuple[str, ...] = ()
    probes: Mapping[str, float] = field(default_factory=dict)
    maps: Mapping[str, Tensor] = field(default_factory=dict)
    map_sets: Mapping[str, list[str]] = field(default_factory=dict)
    order: tuple[str, ...] = ()
    rejected: frozenset[str] = frozenset()
    sets: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    likeliest: tuple[str, ...] = ()
    tested: bool = True
    certain: bool = False

    @property
    def cause_sets(self) -> tuple[tuple[str, ...], ...]:
        """The members of each cause set."""
        return tuple(map(tuple, self.sets.values()))

    @property
    def adds_something(self) -> bool:
        """Whether a simulator with the findings differs from one without."""
        return bool(self.names or self.refined_terms)

    @property
    def gap(self) -> float:
        """Squared gap of the base model, m^2."""
        square = float(self.first.squares.sum() / self.study.sums.count.sum())
        return square - self.study.fit.floor**2

    @property
    def columns(self) -> tuple[str, ...]:
        """Effects of the model that have columns, refined base terms included."""
        effects = self.study.candidates.effects
        return tuple(name for name in (*self.names, *self.refined_terms) if name in effects)

    @property
    def with_probes(self) -> tuple[str, ...]:
        """All of the model that has columns, probes included."""
        return (*self.columns, *self.probes)

    def without(self, name: str | None) -> list[str]:
        """Return all columns but those of one effect."""
        return [other for other in self.with_probes if other != name]

    def naming(self, effect: str, instead_of: str | None = None) -> "NamedEffects":
        """Return the model with an effect under its name."""
        order, place = list(self.order), len(self.order)
        if instead_of is not None:
            place = order.index(instead_of) + 1
        if effect not in order:
            order.insert(place, effect)
        names = {*self.names, effect} - {instead_of}
        return replace(
            self,
            names=tuple(name for name in order if name in names),
            order=tuple(order),
            refined_terms=tuple(name for name in self.refined_terms if name != effect),
        )


def name_effects(study: Study, *, certain: bool = False, most_steps: int = 12) -> NamedEffects:
    """Name effects until none is both significant and large enough to report.

    Args:
        study: The recording.
        certain: Whether other tests have found that something is missing. A first effect that
            explains most of the gap need then be significant by itself only.
        most_steps: At most so many additions; a bound on the time, never reached in practice.
    """
    tests, final, first = study.options.tests, study, compare_effects(study, ())
    tested = study.sums.num_units >= tests.least_images
    model = NamedEffects(study=study, first=first, last=first, tested=tested, certain=certain)
    compared, seen = [first], [_members(model)]
    for _ in range(most_steps if tested else 0):
        if len(model.names) >= tests.most_effects:
            break
        name, larger = _with_next(model)
        if name is None:
            break
        if _members(larger) in seen:
            # Two effects would otherwise drop one another in turn.
            model = replace(model, rejected=model.rejected | {name})
            continue
        final = relinearised(larger.study, larger.with_probes)
        model = replace(larger, last=compare_effects(final, larger.with_probes))
        compared.append(model.last)
        seen.append(_members(model))
    return replace(
        model,
        study=final,
        sets=final_sets(model, compared),
        likeliest=likeliest(study, model.last),
        certain=certain and model.names != (),
    )


def _members(model: NamedEffects) -> tuple[set[str], ...]:
    return set(model.names), set(model.refined_terms), set(model.probes)


def _with_next(model: NamedEffects) -> tuple[str | None, NamedEffects]:
    """Return the effect or probe to add, and the model with it; None: there is none to add."""
    name, study = probe_to_add(model), model.study
    if name is not None:
        larger = replace(model, probes={**model.probes, name: model.last.family_p_value(name)})
    else:
        found = next_effect(model)
        if found is None:
            return None, model
        name, report = found
        larger = replace(model, refined_terms=(*model.refined_terms, name))
        if report:
            larger = model.naming(name)
        if name in study.candidates.maps:
            tests, effect = study.options.tests, study.candidates.maps[name]
            members = cause_set(model.last, name, tests.level, tests.set_share)
            fitted = FittedMap(study, effect, study.system.residual_of(model.with_probes, gls=True))
            larger = replace(
                larger,
                map_sets={**model.map_sets, name: members},
                maps={**model.maps, name: fitted.values},
                study=without_map(study, fitted.values, {name, *effect.contains}),
            )
    larger = _reestimated(larger)
    return name, refined(larger) if len(larger.with_probes) > 1 else larger


def _reestimated(model: NamedEffects) -> NamedEffects:
    return replace(model, study=with_poses_reestimated(model.study, model.with_probes))


def probe_to_add(model: NamedEffects) -> str | None:
    """Return a probe that explains what no effect explains; None: there is none."""
    tests, comparison = model.study.options.tests, model.last
    least = max((tests.unknown_mm / 1000) ** 2, tests.material_share * model.gap)
    best = max((test.total for test in comparison.tests.values()), default=0.0)
    for test in sorted(comparison.probes.values(), key=lambda test: -test.total):
        if test.total <= max(best, 0.0) or test.name in model.rejected:
            continue
        if comparison.family_p_value(test.name) > tests.level:
            continue
        if closed_square(model.study, test) < least and test.score < _CLEAR_SCORE:
            continue
        members = cause_set(comparison, test.name, tests.level, tests.set_share)
        # A map of single pixels can also take any smooth shape, so maps are no rivals of probes;
        # nor is an effect that is as likely but explains little of what the probe does.
        rivals = comparison.tests.keys() & set(members) - model.study.candidates.maps.keys()
        if all(comparison.tests[name].total <= 0.5 * test.total for name in rivals):
            return test.name
    return None


def next_effect(model: NamedEffects, *, least_of_rest: float = 0.1) -> tuple[str, bool] | None:
    """Return the effect to add, and whether under its name, not as a base term; None: stop.

    Args:
        model: The model so far.
        least_of_rest: An effect below the same score is named if it closes at least this share, in
            squares, of what then stays unexplained. Chosen: a cause that is not in the catalogue
            resembles some effect a little.
    """
    tests, comparison = model.study.options.tests, model.last
    unexplained = unexplained_squares(model.study, comparison, at_least=True)
    for test in comparison.ordered():
        if test.total <= 0:
            return None
        rest = least_of_rest * (unexplained - test.total)
        little = test.total <= rest and test.score < _CLEAR_SCORE
        if little or test.name in model.rejected.union(model.names):
            continue
        significant = comparison.naming_p_value(test.name) <= tests.level
        if not significant and not _explains_gap(model, test):
            continue
        found = _to_add(model, test)
        if found is not None and test.total > _closed_by_probes(model, test.name):
            return found
    return None


def _to_add(model: NamedEffects, test: EffectTest) -> tuple[str, bool] | None:
    """Return the effect to add where one is significant: it, or another of its cause set."""
    tests, comparison = model.study.options.tests, model.last
    closed = closed_square(model.study, test)
    members = cause_set(comparison, test.name, tests.level, tests.set_share)
    members = [name for name in members if name not in model.rejected]
    absent = _absent_terms(model, test)
    for name in members:
        finer = CATALOGUE[name].refines and name not in (*absent, *model.refined_terms)
        small = closed < (tests.form_tolerance_mm / 1000) ** 2
        if finer and small and comparison.tests[name].p_value <= tests.level:
            return name, False
    if closed < least_closed(model, test.name):
        return None
    return (absent or [simplest(comparison, members, tests.level)])[0], True


def _explains_gap(model: NamedEffects, test: EffectTest) -> bool:
    """Return whether a first effect may be named where the gap as a whole is significant.

    The correction for the number of effects guards against a name where nothing is missing. Where
    that is excluded, an effect must be significant by itself, and close most of a gap that matters.
    """
    options, closed = model.study.options, closed_square(model.study, test)
    large = closed >= max(0.5 * model.gap, (options.target_gap_mm / 1000) ** 2)
    first = model.certain and not model.names
    return first and large and test.p_value <= options.tests.level


def _closed_by_probes(model: NamedEffects, name: str) -> float:
    """Return what the probes of a model close that are no part of an effect, m^2.

    They stand for a cause that is in no catalogue. Its form is known least of all, so it may leave
    as much of itself as they explain: what an effect closes beside them, if it is no more, may be
    that.
    """
    known = model.study.candidates.probes
    probes = [probe for probe in model.probes if name not in known[probe].part_of]
    if not probes:
        return 0.0
    without = [column for column in model.with_probes if column not in probes]
    left, all_left = (held_out_squares(model.study, each) for each in (without, model.with_probes))
    return float((left - all_left).sum())


def least_closed(model: NamedEffects, name: str, *, share_of_form: float = 0.25) -> float:
    """Return what an effect must close to be reported, m^2.

    The first one must close a share of the gap. Beside others, a size in millimetres is enough;
    but beside one that varies alike, an effect must close what no error in the form of that one
    would.

    Once a finer form of a base term is in the model, the tolerance for such forms applies: what
    that form leaves can look like an effect that resembles it. It applies as well where the
    simulator's error was fitted at other poses, to which that fit has another form error.

    Args:
        model: The model so far.
        name: The effect.
        share_of_form: An effect that varies like a named one closes more than this share of that
            one's form error, in millimetres, or is not reported. Chosen: what a form misses is
            rarely of the shape of a single other effect.
    """
    tests = model.study.options.tests
    size, share = model.study.material_mm, tests.material_share
    others = [other for other in model.names if other != name]
    if others:
        errors = (CATALOGUE[other].form_error for other in others if vary_alike(name, other))
        size, share = tests.further_mm, (share_of_form * max(errors, default=0.0)) ** 2
    if model.refined_terms:
        size = tests.form_tolerance_mm
    return max((size / 1000) ** 2, share * model.gap)


def _absent_terms(model: NamedEffects, best: EffectTest, *, as_much: float = 0.6) -> list[str]:
    """Return error terms that the base model lacks and that close nearly as much as the best.

    Args:
        model: The model so far.
        best: The best effect.
        as_much: Such a term is named first if it closes this share of what the best effect
            closes. Chosen: every camera has these errors.
    """
    tests, least = model.last.tests, as_much * best.total
    known = [name for name in absent_forms(model.study) if name in tests.keys() - model.rejected]
    level = model.study.options.tests.level
    large = [name for name in known if tests[name].total >= least]
    return [name for name in large if model.last.family_p_value(name) <= level]


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
    others = [name for name in members[1:] if comparison.family_p_value(name) <= level]
    significant = [comparison.tests[name] for name in (members[0], *others)]
    least = (1 - equal_share) * max(test.total for test in significant)
    equal = [test for test in significant if test.total >= least]
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
    least, level = (study.options.target_gap_mm / 1000) ** 2, study.options.tests.level
    ordered = sorted(last.tests.values(), key=lambda test: -test.score)
    large = (test for test in ordered if closed_square(study, test) >= least)
    return tuple(test.name for test in large if test.p_value <= level)[:most]


def refined(model: NamedEffects, *, swap_share: float = 0.05) -> NamedEffects:
    """Swap named effects for better ones; drop small ones; report refined terms grown large.

    Args:
        model: The model.
        swap_share: An effect is swapped for another that closes more by at least this share of the
            other's. Chosen, so that noise swaps nothing.
    """
    before = model
    for name in [*before.names, *before.refined_terms]:
        if name not in model.study.candidates.effects:
            continue
        comparison = compare_effects(model.study, model.without(name), flips=False, maps=False)
        own, best = comparison.tests[name], comparison.ordered()[0]
        small = closed_square(model.study, own) < least_closed(model, name)
        if name in before.refined_terms:
            if not small and _significant(model, name, instead_of=name):
                model = model.naming(name)
            continue
        better = best.name != name and own.total < (1 - swap_share) * best.total
        if better and _significant(model, best.name, instead_of=name):
            model = model.naming(best.name, instead_of=name)
        elif small:
            model = replace(model, names=tuple(n for n in model.names if n != name))
    return _reestimated(model) if model is not before else model


def _significant(model: NamedEffects, name: str, *, instead_of: str) -> bool:
    """Return whether an effect is significant in the model beside all others.

    A refined term came into the model in the place of another effect, and an effect that is swapped
    in was compared by size alone, so nothing has tested them yet.
    """
    others = compare_effects(model.study, model.without(instead_of), maps=False)
    return others.family_p_value(name) <= model.study.options.tests.level


def final_sets(
    model: NamedEffects, compared: Sequence[EffectComparison]
) -> dict[str, dict[str, float]]:
    """Return the cause set of each named effect, as in `NamedEffects.sets`.

    The cause of a significant gap is significant where it is added alone. Millimetres do not show
    that where poses scatter: there an effect that does nothing may close as much as the named one
    by chance. Each effect is judged as if it were the only one tested, so that few are missed.

    Args:
        model: The final model.
        compared: Effects as additions to the base model, to every model since, and to the final
            one, with null distributions.
    """
    level = model.study.options.tests.level
    every = chain.from_iterable(comparison.tests.values() for comparison in compared)
    possible = {test.name for test in every if test.p_value <= level}.union(model.names)
    whole, sets = causes_of_several(model), {}
    for name in model.names:
        beside = compared[0]  # Beside a map all effects are additions to the base model.
        if name not in model.map_sets:
            beside = compare_effects(model.study, model.without(name), flips=False)
        members = [*own_set(model, name, beside, compared[-1]), *whole[name]]
        kept = [m for m in members if m in possible or m in CATALOGUE[name].may_be]
        tests, own = beside.tests, max(beside.tests[name].total, TINY)
        sets[name] = {
            member: tests[member].total / own if member in tests else float("nan")
            for member in (name, *kept)
        }
    return sets


def own_set(
    model: NamedEffects, name: str, beside: EffectComparison, last: EffectComparison
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
    study, tests = model.study, model.study.options.tests
    # What a form misses is left, or looks like scatter of the poses.
    missed = unexplained_squares(study, last, at_least=True) + pose_scatter_squares(study)
    unexplained = unexplained_squares(study, last)
    gains = chi_squared(study, model.without(name)).closed
    members = cause_set(beside, name, tests.level, tests.set_share, missed, unexplained, gains)
    rivals = [member for member in members if member not in model.names]
    return rivals + [one for one in CATALOGUE[name].may_be if one in (*beside.tests, *model.names)]


def chi_squared(study: Study, chosen: Sequence[str]) -> HeldOutSquares:
    """Return the chi-squared of held-out poses, by some effects of the model and by one more.

    It knows that poses scatter, and so which part of what an effect closes is a shift of single
    images, and which part has the effect's own shape within them.
    """
    return HeldOutSquares(study.sums.gls, chosen, study.folds)


def causes_of_several(model: NamedEffects) -> dict[str, list[str]]:
    """Return for each named effect the causes of which it and others may be parts."""
    study, level = model.study, model.study.options.tests.level
    found: dict[str, list[str]] = {name: [] for name in model.names}
    named = [name for name in model.names if name in model.with_probes]
    if len(named) <= 1:
        return found
    left = held_out_squares(study, model.with_probes)
    whole = chi_squared(study, model.with_probes).squares
    sizes = range(2, len(named) + 1)
    for parts in chain.from_iterable(combinations(named, size) for size in sizes):
        rest = [name for name in model.with_probes if name not in parts]
        comparison = compare_effects(study, rest, flips=False, maps=False)
        beside, known = chi_squared(study, rest), [comparison.tests[part] for part in parts]

        def excluded(
            test: EffectTest, beside: HeldOutSquares = beside, known: Sequence[EffectTest] = known
        ) -> bool:
            """Return whether an effect fits too badly to be the cause of several parts."""
            gains, of_cause = beside.closed(test.name), beside.squares - whole
            return comparable(test, *known) and fits_too_badly(test, gains, of_cause, level)

        causes = one_cause(comparison, comparison.squares - left, level, excluded)
        for part in parts:
            found[part] += [cause for cause in causes if vary_alike(cause, part)]
    return found
