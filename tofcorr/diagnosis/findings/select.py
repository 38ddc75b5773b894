"""Naming several effects: add, try to swap, drop; say what each cannot be told from."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from torch import Tensor

from tofcorr.diagnosis.findings.which import Comparison, EffectTest, cause_set, compare
from tofcorr.diagnosis.sums.map_gain import map_gain
from tofcorr.diagnosis.sums.study import BASE_FORMS, Study

# Two effects whose gains differ by less than this share are level: the simpler one is named.
_LEVEL_SHARE = 0.02
# A swap is made if it closes more by at least this share.
_SWAP_SHARE = 0.05
_MOST_STEPS = 12
# A mark of something unknown with this score is there, however few millimetres it closes.
_CLEAR_SCORE = 12.0
# A base term left out is named first if it closes at least this share of what the best does.
_SUSPECT_SHARE = 0.6


@dataclass(frozen=True, kw_only=True)
class Selection:
    """Effects named, and how it came to that.

    Attributes:
        first: All effects as additions to the base model.
        last: All others as additions to the final model.
        named: In the order added.
        taken_up: Finer forms of base terms that are part of the model but not worth a name.
        unexplained: Marks of effects beyond the catalogue that explain what no effect does.
        sets: For every named effect those that the data cannot tell from it, itself first.
        study: The recording with chosen maps taken off and poses as certain as now known.
        tested: Whether there were enough poses to test.
    """

    first: Comparison
    last: Comparison
    named: tuple[str, ...]
    taken_up: tuple[str, ...]
    unexplained: tuple[str, ...]
    sets: tuple[tuple[str, ...], ...]
    study: Study
    tested: bool

    @property
    def columns(self) -> tuple[str, ...]:
        """Chosen effects that have columns, named or taken up."""
        return tuple(n for n in (*self.named, *self.taken_up) if n in self.study.effects)

    @property
    def model(self) -> tuple[str, ...]:
        """All of the final model that has columns, marks of unknown effects included."""
        return (*self.columns, *self.unexplained)


@dataclass
class _State:
    """A model that grows; `order` holds all that were ever named, as they came."""

    study: Study
    named: list[str] = field(default_factory=list)
    order: list[str] = field(default_factory=list)
    taken_up: list[str] = field(default_factory=list)
    unexplained: list[str] = field(default_factory=list)
    map_sets: dict[str, list[str]] = field(default_factory=dict)

    @property
    def model(self) -> list[str]:
        """Everything with columns in the model."""
        known = self.study.blocks.layout.effects
        return [n for n in (*self.named, *self.taken_up, *self.unexplained) if n in known]

    def name(self, effect: str, instead_of: str | None = None) -> None:
        """Name an effect; one that was dropped and comes back keeps its place."""
        place = len(self.order)
        if instead_of is not None:
            self.named.remove(instead_of)
            place = self.order.index(instead_of) + 1
        if effect not in self.order:
            self.order.insert(place, effect)
        self.named.append(effect)
        self.named.sort(key=self.order.index)


def select(study: Study) -> Selection:
    """Name effects until none is both significant and material."""
    tests = study.options.tests
    state = _State(study)
    first = latest = compare(study, ())
    tested = study.blocks.num_units >= tests.least_images
    gap = _mean_square(study, first.squares) - study.fit.floor**2
    for _ in range(_MOST_STEPS):
        if not tested or len(state.named) >= tests.most_effects:
            break
        probe = _probe_ahead(state, latest, gap)
        if probe is not None:
            state.unexplained.append(probe)
            state.study = state.study.with_chosen(state.model)
        else:
            step = _next_step(state, latest, gap)
            if step is None:
                break
            _take(state, latest, step[0], worth=step[1])
        if len(state.model) > 1:
            _refine(state, gap)
        latest = compare(state.study.bent(state.model), state.model)
    return Selection(
        first=first,
        last=latest,
        named=tuple(state.named),
        taken_up=tuple(state.taken_up),
        unexplained=tuple(state.unexplained),
        sets=tuple(tuple(_final_set(state, name)) for name in state.named),
        study=state.study.bent(state.model),
        tested=tested,
    )


def _probe_ahead(state: _State, comparison: Comparison, gap: float) -> str | None:
    """Return a mark of something unknown that explains what no effect of the catalogue does."""
    tests = state.study.options.tests
    least = max((tests.unknown_mm * 1e-3) ** 2, tests.material_share * gap)
    for test in sorted(comparison.probes.values(), key=lambda test: -test.total):
        if test.total <= 0 or comparison.family_p_value(test.name) > tests.level:
            continue
        if closed_square(state.study, test) < least and test.score < _CLEAR_SCORE:
            continue
        members = cause_set(comparison, test.name, tests.level, tests.set_share)
        # A map of single pixels also takes the shape of anything smooth: there the probe decides.
        rivals = [
            name
            for name in members
            if name not in state.study.maps and name not in comparison.probes
        ]
        best = max((t.total for t in comparison.tests.values()), default=0.0)
        if not rivals and test.total > best:
            return test.name
    return None


def _next_step(state: _State, comparison: Comparison, gap: float) -> tuple[EffectTest, bool] | None:
    """Return the effect to add, and whether it is worth a name; None: stop."""
    tests = state.study.options.tests
    for test in comparison.ordered():
        if test.total <= 0:
            return None
        if test.name in state.named or comparison.family_p_value(test.name) > tests.level:
            continue
        closed = closed_square(state.study, test)
        members = cause_set(comparison, test.name, tests.level, tests.set_share)
        withheld = _withheld(state, comparison, test)
        stiff = [name for name in members if name in BASE_FORMS and name not in withheld]
        stiff = [name for name in stiff if name not in state.taken_up]
        if stiff and closed < (tests.form_tolerance_mm * 1e-3) ** 2:
            return comparison.tests[stiff[0]], False
        if closed >= _least_closed(state, gap, further=bool(state.named)):
            first = withheld[0] if withheld else _simplest(comparison, members, tests.level)
            return comparison.tests[first], True
    return None


def _least_closed(state: _State, gap: float, *, further: bool) -> float:
    """Return what an effect must close to be worth a name, m^2; `further`: beside others.

    Where a base term was found too stiff, what its finer form still leaves may look like an effect
    that resembles it.
    """
    tests = state.study.options.tests
    size = tests.further_mm if further else tests.material_mm
    if state.taken_up:
        size = tests.form_tolerance_mm
    return max((size * 1e-3) ** 2, tests.material_share * gap)


def _withheld(state: _State, comparison: Comparison, best: EffectTest) -> list[str]:
    """Return terms that the base model was denied and that close nearly as much as the best.

    They are the first suspects: every camera has these errors.
    """
    tests = state.study.options.tests
    return [
        name
        for name in state.study.withheld_forms
        if name in comparison.tests
        and comparison.tests[name].total >= _SUSPECT_SHARE * best.total
        and comparison.family_p_value(name) <= tests.level
    ]


def _simplest(comparison: Comparison, members: Sequence[str], level: float) -> str:
    """Return the least flexible of a set's members that are significant and level with its best."""
    significant = [
        comparison.tests[name]
        for name in members
        if name == members[0] or comparison.family_p_value(name) <= level
    ]
    best = max(test.total for test in significant)
    equal = [test for test in significant if test.total >= (1 - _LEVEL_SHARE) * best]
    return min(equal, key=lambda test: (test.size, -test.total)).name


def _take(state: _State, comparison: Comparison, test: EffectTest, *, worth: bool) -> None:
    if worth:
        state.name(test.name)
    else:
        state.taken_up.append(test.name)
    if test.name in state.study.maps:
        tests = state.study.options.tests
        state.map_sets[test.name] = cause_set(comparison, test.name, tests.level, tests.set_share)
        effect = state.study.maps[test.name]
        residual = state.study.residual_of(state.model)
        values = map_gain(state.study, effect, residual).values
        spent = {test.name, *effect.contains}
        maps = {n: e for n, e in state.study.maps.items() if n not in spent}
        state.study = replace(state.study.without_map(values), maps=maps)
    state.study = state.study.with_chosen(state.model)


def _refine(state: _State, gap: float) -> None:
    """Swap a named effect for a better one; drop what no longer adds; name a form that now does."""
    changed = False
    for name in [n for n in state.named if n in state.study.effects]:
        others = [n for n in state.model if n != name]
        comparison = compare(state.study, others, flips=False, maps=False)
        own = comparison.tests[name]
        best = comparison.ordered()[0]
        if best.name != name and own.total < (1 - _SWAP_SHARE) * best.total:
            state.name(best.name, instead_of=name)
            changed = True
            continue
        closed = closed_square(state.study, own)
        if closed < _least_closed(state, gap, further=len(state.named) > 1):
            state.named.remove(name)
            changed = True
    for name in list(state.taken_up):
        others = [n for n in state.model if n != name]
        own = compare(state.study, others, flips=False, maps=False).tests[name]
        if closed_square(state.study, own) >= _least_closed(state, gap, further=False):
            state.taken_up.remove(name)
            state.name(name)
            changed = True
    if changed:
        state.study = state.study.with_chosen(state.model)


def _final_set(state: _State, name: str) -> list[str]:
    if name in state.map_sets:
        return state.map_sets[name]
    tests = state.study.options.tests
    others = [n for n in state.model if n != name]
    comparison = compare(state.study, others, flips=False)
    return [
        n
        for n in cause_set(comparison, name, tests.level, tests.set_share)
        if n == name or n not in state.named
    ]


def least_p_value(study: Study, comparison: Comparison) -> float:
    """Return the smallest p-value of all that would close what counts; 1 if nothing would.

    Held-out likelihood feels what closes no millimetres; that is no gap worth a word.
    """
    least = (study.options.tests.material_mm * 1e-3) ** 2
    candidates = (comparison.tests | comparison.probes).values()
    counting = [test.name for test in candidates if closed_square(study, test) >= least]
    return min((comparison.family_p_value(name) for name in counting), default=1.0)


def closed_square(study: Study, test: EffectTest) -> float:
    """Return by how much an effect lowers the held-out mean square, m^2."""
    return test.total / float(study.blocks.count.sum())


def _mean_square(study: Study, squares: Tensor) -> float:
    return float(squares.sum() / study.blocks.count.sum())
