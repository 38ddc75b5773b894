"""The model to which effects are added while they are named."""

from dataclasses import dataclass, field

from torch import Tensor

from tofcorr.diagnosis.findings.naming_rules import ModelSoFar
from tofcorr.diagnosis.sums.study import Study


@dataclass
class GrowingModel(ModelSoFar):
    """A model that grows; `order` holds all effects ever named, in the order they came."""

    study: Study
    names: list[str] = field(default_factory=list)
    order: list[str] = field(default_factory=list)
    refined_terms: list[str] = field(default_factory=list)
    probes: dict[str, float] = field(default_factory=dict)
    map_sets: dict[str, list[str]] = field(default_factory=dict)
    maps: dict[str, Tensor] = field(default_factory=dict)
    rejected: set[str] = field(default_factory=set)

    @property
    def members(self) -> tuple[set[str], set[str], set[str]]:
        """Effects named, refined base terms and probes."""
        return set(self.names), set(self.refined_terms), set(self.probes)

    def copied(self) -> "GrowingModel":
        """Return a model that can grow while this one stays as it is."""
        own = vars(self).copy()
        return GrowingModel(own.pop("study"), **{name: value.copy() for name, value in own.items()})

    @property
    def columns(self) -> list[str]:
        """All of the model that has columns."""
        known = self.study.system.blocks.layout.effects
        return [n for n in (*self.names, *self.refined_terms, *self.probes) if n in known]

    def name(self, effect: str, instead_of: str | None = None) -> None:
        """Name an effect; one that was dropped and comes back keeps its place."""
        place = len(self.order)
        if instead_of is not None:
            self.names.remove(instead_of)
            place = self.order.index(instead_of) + 1
        if effect not in self.order:
            self.order.insert(place, effect)
        self.names.append(effect)
        self.names.sort(key=self.order.index)

    def without(self, name: str) -> list[str]:
        """Return all columns but those of one effect."""
        return [other for other in self.columns if other != name]
