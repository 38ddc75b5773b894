"""A recording under diagnosis: pixels, base fit, candidate effects, and their linear system."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, TypeVar

import torch
from torch import Tensor

from tofcorr.diagnosis.options import DiagnosisOptions, TestOptions
from tofcorr.diagnosis.sums.base_fit import BaseFit
from tofcorr.diagnosis.sums.blocks import Blocks, solve
from tofcorr.diagnosis.sums.candidate_effects import CandidateEffects, candidate_effects
from tofcorr.diagnosis.sums.folds import Folds, assign_folds, draw_signs
from tofcorr.diagnosis.sums.linear_system import LinearSystem, linear_system
from tofcorr.diagnosis.sums.linear_system import residual_of as residual_of_system
from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.diagnosis.sums.score_draws import NullScores, ScoreDraws
from tofcorr.diagnosis.sums.tiles import Tiles, cut_into_tiles
from tofcorr.simulation.effects import CATALOGUE, MapEffect
from tofcorr.simulation.effects.inputs import EffectInputs

Kept = TypeVar("Kept")

# Added to the diagnosis' seed for the draws of null distributions; others add 1 to 3.
_SEED_OF_DRAWS = 4


@dataclass(frozen=True, kw_only=True)
class Resampling:
    """Folds and sign flips of all tests.

    Attributes:
        folds: Of the cross-validation over poses.
        signs: Sign flips of the poses, shape (B, U).
        tiles: The units of effects that few images show; None where no such effect is tested.
        seed: Of the draws of null distributions.
    """

    folds: Folds
    signs: Tensor
    tiles: Tiles | None
    seed: int
    _draws: list[ScoreDraws] = field(default_factory=list, init=False, repr=False)

    def null_scores(self, system: LinearSystem) -> NullScores:
        """Return draws of the scores of all poses if the base model is complete.

        They come from the same random numbers for all models, and are drawn once for the same
        columns.
        """
        products, blocks = system.moments.weighted[:, :-1, :-1], system.blocks
        if not (self._draws and torch.equal(self._draws[0].products, products)):
            flips = len(self.signs)
            self._draws[:] = [ScoreDraws(products, self.folds, flips, self.seed)]
        return NullScores(self._draws[0], blocks.pose_sd, blocks.dispersion)


@dataclass(frozen=True, kw_only=True)
class Study:
    """A recording under diagnosis. Functions that change the model return another study.

    Attributes:
        options: Of the diagnosis.
        observations: The chosen pixels.
        fit: The base model, fitted.
        inputs: What effects may depend on.
        candidates: What may be added to the base model.
        system: Columns, residual and sums.
        resampling: Folds and sign flips.
        pattern: The base model's fixed pattern, estimated; None if it has none.
    """

    options: DiagnosisOptions
    observations: Observations
    fit: BaseFit
    inputs: EffectInputs
    candidates: CandidateEffects
    system: LinearSystem
    resampling: Resampling
    pattern: MapEffect | None = None
    _remembered: dict[str, Any] = field(default_factory=dict, init=False, repr=False)

    def remembered(self, what: str, make: Callable[[], Kept]) -> Kept:
        """Return what is kept under this name; compute it on the first call."""
        if what not in self._remembered:
            self._remembered[what] = make()
        return self._remembered[what]

    @cached_property
    def weight(self) -> Tensor:
        """Inverse variance of each pixel, with its robust weight, shape (M,), 1 / m^2."""
        return self.fit.trust / (self.system.blocks.dispersion * self.fit.sigma**2)

    @property
    def material_mm(self) -> float:
        """Minimum size of the first effect that is named, millimetres.

        A simulator's error that was fitted at other poses is carried to these with a form error.
        What the tolerance for finer forms of base terms allows is then no effect either.
        """
        tests, known = self.options.tests, self.fit.known
        if known is not None and known.carried:
            return max(tests.material_mm, tests.form_tolerance_mm)
        return tests.material_mm

    @cached_property
    def unit_of_pixel(self) -> Tensor:
        """Pose of every pixel, shape (M,), int64."""
        return self.observations.unit[self.observations.frame]


def build_study(
    options: DiagnosisOptions,
    observations: Observations,
    fit: BaseFit,
    inputs: EffectInputs,
    generator: torch.Generator,
) -> Study:
    """Compute the linear system of all candidates; draw folds and sign flips."""
    tests, num_units = options.tests, observations.num_units
    folds = assign_folds(num_units, tests.folds, generator)
    signs = draw_signs(tests.flips, num_units, generator)
    candidates = candidate_effects(options, inputs)
    system = linear_system(observations, fit, inputs, candidates)
    filtered = max(fit.shared.share.values()) > 0
    tiles = _tiles_for(candidates, observations, system.blocks, tests, generator, filtered=filtered)
    return Study(
        options=options,
        observations=observations,
        fit=fit,
        inputs=inputs,
        candidates=candidates,
        system=system,
        resampling=Resampling(
            folds=folds, signs=signs, tiles=tiles, seed=options.seed + _SEED_OF_DRAWS
        ),
    )


def residual_of(study: Study, names: Sequence[str]) -> Tensor:
    """Return the residual of base model and effects fitted to all poses, shape (M,), metres."""
    return residual_of_system(study.system, names)


def likely_residual_of(study: Study, names: Sequence[str]) -> Tensor:
    """Return the residual of base model and effects fitted by likelihood, shape (M,), metres.

    Where poses scatter, an even fit bends the model towards their offsets, and leaves the same bend
    in every image.
    """
    system = study.system
    return system.residual - system.columns.times(names, solve(system.blocks.likely, names))


def absent_forms(study: Study) -> list[str]:
    """Return the effects that refine error terms of which the base model has none."""
    groups = study.fit.model.groups
    return [
        name
        for name, effect in CATALOGUE.items()
        if effect.refines and groups.isdisjoint(effect.refines)
    ]


def _tiles_for(
    candidates: CandidateEffects,
    observations: Observations,
    blocks: Blocks,
    tests: TestOptions,
    generator: torch.Generator,
    *,
    filtered: bool,
) -> Tiles | None:
    """Cut the poses that would show most of the effects that few images show."""
    few = [blocks.layout.effects[n] for n in candidates.effects if candidates.is_tested_by_tiles(n)]
    if not few:
        return None
    own = torch.cat([torch.arange(*place) for place in few])
    return cut_into_tiles(
        blocks.likely.gram.diagonal(dim1=1, dim2=2)[:, own].sum(1),
        observations.unit[observations.frame],
        observations.pixel,
        observations.recording.camera,
        tests.folds,
        tests.flips,
        generator,
        filtered=filtered,
    )
