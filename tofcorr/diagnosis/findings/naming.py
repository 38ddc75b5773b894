"""Names the missing effects, with the probability of each and of something unknown.

`probability` gives the probability of every set of effects. What is named is the most probable set;
each of its effects stands with all those that may be there in its place.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from torch import Tensor

from tofcorr.diagnosis.findings.probability import Evidence, Model, Models, Search
from tofcorr.diagnosis.sums.linearised import relinearised
from tofcorr.diagnosis.sums.study import (
    Study,
    with_poses_reestimated,
    without_map,
)
from tofcorr.simulation.effects import CATALOGUE


@dataclass(frozen=True, kw_only=True)
class NamedEffects:
    """The effects named, and how probable everything is.

    Attributes:
        study: The recording with the named map subtracted, the effects named linearised where they
            are, and the uncertainty of the poses estimated beside them.
        names: The effects named, the most probable first.
        sets: For each of them those that may be there in its place, itself first, and the
            probability of each there: they sum to at least `cover`.
        models: The models that were tried.
        probability: Of each of them, shape (N,).
        maps: Values in each pixel of the named effect that has no columns, (M,), metres.
        probes: What is in no catalogue, as far as it belongs to the most probable model.
        closed: By how much each effect alone lowers the squares of held-out poses, (U,), m^2.
        squares: What the base model leaves of all held-out poses, m^2.
        tested: Whether there were enough poses.
    """

    study: Study
    names: tuple[str, ...]
    sets: Mapping[str, Mapping[str, float]]
    models: Models
    probability: Tensor
    maps: Mapping[str, Tensor] = field(default_factory=dict)
    probes: tuple[str, ...] = ()
    closed: Mapping[str, Tensor] = field(default_factory=dict)
    squares: float = 0.0
    tested: bool = True

    @cached_property
    def probabilities(self) -> dict[str, float]:
        """The probability of each effect and probe that some model has, the highest first."""
        found: dict[str, float] = {}
        for model, probability in zip(self.models.models, self.probability.tolist(), strict=True):
            for name in model:
                found[name] = found.get(name, 0.0) + probability
        return dict(sorted(found.items(), key=lambda one: -one[1]))

    def probability_of_any(self, *names: str) -> float:
        """Return the probability that at least one of some effects and probes is there."""
        own = [not set(names).isdisjoint(model) for model in self.models.models]
        return float(self.probability[torch.tensor(own)].sum())

    @property
    def anything(self) -> float:
        """The probability that anything is missing."""
        return 1.0 - float(self.probability[self.models.models.index(())])

    @property
    def unknown(self) -> float:
        """The probability that something is missing that is in no catalogue."""
        return self.probability_of_any(*(self.probabilities.keys() - CATALOGUE.keys()))

    @property
    def ranking(self) -> list[str]:
        """Every effect tested, the most probable first, then by what each closes alone."""
        known = self.probabilities

        def order(name: str) -> tuple[float, float]:
            return -round(known.get(name, 0.0), 2), -float(self.closed[name].sum())

        return sorted(self.closed, key=order)

    def closed_gap(self, name: str) -> tuple[float, float]:
        """Return by how much an effect alone lowers the gap, metres, and its share of the square.

        Where it makes predictions worse, the first number is negative.
        """
        count = float(self.study.sums.count.sum())
        before = max(self.squares / count - self.study.fit.floor**2, 0.0)
        closed = float(self.closed[name].sum()) / count
        share = min(max(closed / before, 0.0), 1.0) if before > 0 else 0.0
        return before**0.5 - max(before - closed, 0.0) ** 0.5, share

    @property
    def cause_sets(self) -> tuple[tuple[str, ...], ...]:
        """The members of each cause set."""
        return tuple(map(tuple, self.sets.values()))

    @property
    def columns(self) -> tuple[str, ...]:
        """The effects named that have columns."""
        return self.columns_of(self.names)

    def columns_of(self, model: Model) -> tuple[str, ...]:
        """Return the effects of a model that have columns, probes left out."""
        return tuple(name for name in model if name in self.study.effects)


def name_effects(study: Study) -> NamedEffects:
    """Name as many effects as are probably there: the most probable set of that size.

    The search is done twice: what poses scatter, and how an effect that is not linear looks, is
    known only beside the effects that are there. The first one asks for half of the evidence: an
    effect that is there but not in the model would pass for scatter of the poses.

    Args:
        study: The recording.
    """
    options, tests, evidence = study.options, study.options.tests, Evidence(study)
    model = tuple(Search(evidence, tests.odds**0.5, tests.most_effects, width=1).best())
    if model:
        study = _beside(study, model, evidence)
        evidence = Evidence(study, [name for name in model if name in study.sums.layout.effects])
    models = Search(evidence, tests.odds, tests.most_effects).models()
    generator = torch.Generator().manual_seed(options.seed + 4)
    shape = options.bootstraps, study.sums.num_units
    weights = torch.empty(shape).exponential_(generator=generator).double()
    weights *= shape[1] / weights.sum(1, keepdim=True)
    base = study.left_out_squares(())
    found = NamedEffects(
        study=study,
        names=(),
        sets={},
        models=models,
        probability=models.posterior(weights, generator).mean(1),
        probes=tuple(name for name in models.best()[0] if name not in CATALOGUE),
        closed={
            name: base - evidence.left_out_squares((name,))
            for name in (*study.effects, *evidence.maps)
        },
        squares=float(base.sum()),
        tested=shape[1] >= tests.least_images,
    )
    return _with_names(found, evidence)


def _with_names(found: NamedEffects, evidence: Evidence) -> NamedEffects:
    """Name the effects of the most probable set of as many as are there, each with its cause set.

    Those that add too little are left out.
    """
    study, tests, order = found.study, found.study.options.tests, found.probabilities
    joint = _without_probes(found.models, found.probability)
    # How many effects are there, at the least, with this probability? The most probable set of all
    # may have fewer: the probability of an effect spreads over sets that differ in others.
    of_size = torch.zeros(1 + max(map(len, joint)), dtype=torch.float64)
    for one, own in joint.items():
        of_size[len(one)] += own
    number = int((of_size[1:].flip(0).cumsum(0) > tests.named_from).sum())
    chosen = max((one for one in joint if len(one) == number), key=lambda one: joint[one])
    sizes = found.models.sizes_of(chosen)
    large = _large_enough(study, evidence, sizes) if found.tested else ()
    sets = {
        name: _in_place_of(name, large, joint, tests.cover)
        for name in sorted(large, key=lambda name: -order[name])
    }
    sets = {n: own for n, own in sets.items() if found.probability_of_any(*own) > tests.named_from}
    maps = {name: evidence.maps[name].values for name in sets if name in evidence.maps}
    for name, values in maps.items():
        spent = {name, *study.maps[name].contains}
        study = without_map(study, values, spent)
    columns = found.columns_of(tuple(sets))
    study = relinearised(with_poses_reestimated(study, columns), columns)
    return replace(found, study=study, names=tuple(sets), maps=maps, sets=sets)


def _beside(study: Study, model: Model, evidence: Evidence) -> Study:
    """Return the study with a model's effects linearised, and poses as certain as beside them."""
    columns = [name for name in model if name in study.sums.layout.effects]
    sums = with_poses_reestimated(evidence.without_map_of(model), columns).sums
    known = replace(study.sums, dispersion=sums.dispersion, pose_sd=sums.pose_sd)
    return relinearised(replace(study, sums=known), columns)


def _without_probes(models: Models, probability: Tensor) -> dict[Model, float]:
    """Return the probability of each set of effects, whatever else may be there."""
    joint: dict[Model, float] = {}
    for effects, own in zip(models.effects, probability.tolist(), strict=True):
        joint[effects] = joint.get(effects, 0.0) + own
    return joint


def _large_enough(study: Study, evidence: Evidence, sizes: Mapping[str, float]) -> list[str]:
    """Return the effects of a model that add enough to be named.

    The largest must add `material_mm`, each further one `further_mm`, and one that is a finer form
    of a base term `form_tolerance_mm`: what a polynomial misses of a curve is rarely news.
    """
    tests, added = study.options.tests, evidence.added(sizes)
    effects = {name: own for name, own in added.items() if name in CATALOGUE}

    def least(name: str) -> float:
        largest = effects[name] == max(effects.values())
        refines = not study.fit.model.groups.isdisjoint(CATALOGUE[name].refines)
        size = study.material_mm if largest else tests.further_mm
        return max(size, tests.form_tolerance_mm if refines else 0.0) / 1000

    return [name for name, own in effects.items() if own >= least(name)]


def _in_place_of(
    name: str, named: Collection[str], joint: Mapping[Model, float], cover: float
) -> dict[str, float]:
    """Return the credible set of a named effect: itself, and what may be there in its place.

    One of the set is there with the probability `cover`, given the others named and that there is
    something more. Each adds the probability of the models that none before it has.

    Args:
        name: The effect.
        named: All effects named.
        joint: The probability of each set of effects.
        cover: How probable it must be that one of the set is there.
    """
    rest = set(named) - {name}
    left = {one: own for one, own in joint.items() if rest < set(one)}
    total, members = sum(left.values()), dict[str, float]()
    while left and sum(members.values()) < cover:
        added = dict.fromkeys(sorted(set().union(*left) - rest), 0.0)
        for one, own in left.items():
            for other in set(one) - rest:
                added[other] += own / total
        new = max(added, key=added.__getitem__) if members else name
        members[new] = added[new]
        left = {one: own for one, own in left.items() if new not in one}
    return members
