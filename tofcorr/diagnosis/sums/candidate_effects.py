"""What may be added to the base model: effects of the catalogue that the recording can test."""

from collections.abc import Mapping
from dataclasses import dataclass

from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.sums.probes import Probe, probes_for
from tofcorr.simulation.effects import CATALOGUE, CatalogueEffect, MapEffect
from tofcorr.simulation.effects.inputs import EffectInputs


@dataclass(frozen=True, kw_only=True)
class CandidateEffects:
    """The candidates of one recording, by name.

    Attributes:
        effects: Effects with columns.
        maps: Effects with one value a cell of the image.
        probes: Patterns that no effect of the catalogue makes, with columns.
        missing: Untestable effects and their missing inputs.
    """

    effects: Mapping[str, CatalogueEffect]
    maps: Mapping[str, MapEffect]
    probes: Mapping[str, Probe]
    missing: Mapping[str, list[str]]

    def is_tested_by_tiles(self, name: str) -> bool:
        """Return whether a few images may hold all of an effect, so that tiles test it."""
        return name in self.effects and self.effects[name].in_few_images


def candidate_effects(options: DiagnosisOptions, inputs: EffectInputs) -> CandidateEffects:
    """Return the effects asked for, sorted by how they are tested, and the probes."""
    wanted = options.catalogue if options.catalogue is not None else tuple(CATALOGUE)
    effects: dict[str, CatalogueEffect] = {}
    maps: dict[str, MapEffect] = {}
    missing: dict[str, list[str]] = {}
    for name in wanted:
        if name in options.leave_out:
            continue
        kind = CATALOGUE[name]
        wants = kind.missing(inputs)
        if wants:
            missing[name] = wants
            continue
        effect = kind.for_recording(inputs)
        if isinstance(effect, MapEffect):
            maps[name] = effect
        else:
            effects[name] = effect
    return CandidateEffects(effects=effects, maps=maps, probes=probes_for(inputs), missing=missing)
