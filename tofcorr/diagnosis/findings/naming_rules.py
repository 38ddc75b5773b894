"""The rules by which the next effect of a model is chosen."""

from collections.abc import Sequence
from typing import NamedTuple, Protocol

from tofcorr.diagnosis.findings.cause_set import LEAST_ALIKE_SHARE, cause_set
from tofcorr.diagnosis.findings.effect_comparison import (
    EffectComparison,
    closed_square,
    held_out_squares,
)
from tofcorr.diagnosis.findings.effect_test import EffectTest
from tofcorr.diagnosis.findings.form_error import unexplained_squares, vary_alike
from tofcorr.diagnosis.sums.left_out import left_out_model
from tofcorr.diagnosis.sums.study import Study, absent_forms
from tofcorr.simulation.effects import CATALOGUE

# Of effects whose totals differ by less than this share of the best, the simplest is named. Chosen.
_EQUAL_SHARE = 0.02
# A probe above this score counts even below `unknown_mm`. Scores are standard deviations; chosen
# far above what any of the few hundred sign flips reaches.
_CLEAR_SCORE = 12.0
# An error term that the base model lacks is named first if it closes at least this share of what
# the best effect closes. Chosen: every camera has these errors.
_ABSENT_SHARE = 0.6
# An effect that varies like a named one closes more than this share of that one's form error, in
# millimetres, or is not reported. Chosen: what a form misses is rarely of the shape of a single
# other effect.
_SHARE_OF_FORM = 0.25
# Share of the squared gap that an effect must close to be named because the gap as a whole is
# significant. Chosen: the larger part decides.
_MOST_OF_GAP = 0.5
# An effect below the same score is named if it closes at least this share, in squares, of what then
# stays unexplained. Chosen: a cause that is not in the catalogue resembles some effect a little.
_LEAST_OF_REST = 0.1


class ModelSoFar(Protocol):
    """What the rules read of a model that grows.

    Attributes:
        study: The recording, with the model's maps subtracted.
        names: Effects named.
        refined_terms: Finer forms of base terms in the model.
        probes: Probes in the model.
        rejected: Effects and probes that would lead back to a model that was there before.
        columns: All of the model that has columns.
    """

    study: Study
    names: list[str]
    refined_terms: list[str]
    probes: dict[str, float]
    rejected: set[str]

    @property
    def columns(self) -> list[str]:
        """All of the model that has columns."""
        ...


class NextEffect(NamedTuple):
    """The effect to add; `report` under its name, or silently as a finer form of a base term."""

    test: EffectTest
    report: bool


def probe_to_add(model: ModelSoFar, comparison: EffectComparison, gap: float) -> str | None:
    """Return a probe that explains what no effect of the catalogue explains; None: there is none.

    Args:
        model: The model so far.
        comparison: All effects and probes as additions to it.
        gap: Squared gap of the base model, m^2.
    """
    tests = model.study.options.tests
    least = max((tests.unknown_mm * 1e-3) ** 2, tests.material_share * gap)
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
    model: ModelSoFar, comparison: EffectComparison, gap: float, *, certain: bool = False
) -> NextEffect | None:
    """Return the effect to add, and whether to report it; None: stop.

    Args:
        model: The model so far.
        comparison: All effects as additions to it.
        gap: Squared gap of the base model, m^2.
        certain: Whether other tests have found that something is missing.
    """
    tests = model.study.options.tests
    unexplained = unexplained_squares(model.study, comparison, at_least=True)
    for test in comparison.ordered():
        if test.total <= 0:
            return None
        rest = _LEAST_OF_REST * (unexplained - test.total)
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
        if finer and closed < (tests.form_tolerance_mm * 1e-3) ** 2:
            return NextEffect(comparison.tests[finer[0]], report=False)
        if closed >= least_closed(model, gap, test.name, further=bool(model.names)):
            first = absent[0] if absent else simplest(comparison, members, tests.level)
            return NextEffect(comparison.tests[first], report=True)
    return None


def _explains_gap(model: ModelSoFar, test: EffectTest, gap: float) -> bool:
    """Return whether a first effect may be named where the gap as a whole is significant.

    The correction for the number of effects guards against a name where nothing is missing. Where
    that is excluded, an effect must be significant by itself, and close most of a gap that matters.
    """
    options = model.study.options
    closed = closed_square(model.study, test)
    large = closed >= max(_MOST_OF_GAP * gap, (options.target_gap_mm * 1e-3) ** 2)
    return not model.names and large and test.p_value <= options.tests.level


def _closed_by_probes(model: ModelSoFar, name: str) -> float:
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


def least_closed(model: ModelSoFar, gap: float, name: str, *, further: bool) -> float:
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
    """
    tests = model.study.options.tests
    alike = [
        CATALOGUE[other].form_error
        for other in model.names
        if other != name and vary_alike(name, other)
    ]
    size, share = model.study.material_mm, tests.material_share
    if further:
        size, share = tests.further_mm, (_SHARE_OF_FORM * max(alike, default=0.0)) ** 2
    if model.refined_terms:
        size = tests.form_tolerance_mm
    return max((size * 1e-3) ** 2, share * gap)


def least_of_hand_eye(study: Study) -> float:
    """Return what a change of the hand-eye transform must close to have a share of a gap, m^2."""
    tests = study.options.tests
    gap = left_out_model(study, ()).mean_square() - study.fit.floor**2
    return max((tests.further_mm * 1e-3) ** 2, tests.material_share * gap)


def _absent_terms(model: ModelSoFar, comparison: EffectComparison, best: EffectTest) -> list[str]:
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


def simplest(comparison: EffectComparison, members: Sequence[str], level: float) -> str:
    """Return the significant effect with the fewest columns among those that close equally much.

    Args:
        comparison: All effects.
        members: The effects to choose from; the first one counts as significant.
        level: Of significance.
    """
    significant = [
        comparison.tests[name]
        for name in members
        if name == members[0] or comparison.family_p_value(name) <= level
    ]
    best = max(test.total for test in significant)
    equal = [test for test in significant if test.total >= (1 - _EQUAL_SHARE) * best]
    return min(equal, key=lambda test: (test.size, -test.total)).name
