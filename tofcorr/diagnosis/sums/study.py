"""Probes: patterns of effects that the catalogue does not contain.

A probe is never reported as a cause. Where one explains what no effect of the catalogue explains,
the cause is unknown, and the probe describes its pattern.

What may be added to the base model: effects of the catalogue that the recording can test.

A recording under diagnosis: pixels, base fit, candidate effects, and their linear system.

Steps that change the model of a study: each returns another study.

How well a model predicts each pose from all others.

The offset and two tilts of each pose that a residual contains.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, TypeVar

import torch
from torch import Tensor

from tofcorr.diagnosis.options import DiagnosisOptions, TestOptions
from tofcorr.diagnosis.sums.base_fit import BaseFit
from tofcorr.diagnosis.sums.columns import tile_moments
from tofcorr.diagnosis.sums.gains import NullScores, ScoreDraws
from tofcorr.diagnosis.sums.linear_system import (
    Blocks,
    LinearSystem,
    Sums,
    blocks_of,
    changed_system,
    left_out_squares,
    linear_system,
    solve,
    with_pose_uncertainty,
)
from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.diagnosis.sums.resampling import Folds, Tiles, assign_folds, cut_into_tiles, draw_signs
from tofcorr.geometry.ranges import phase_from_radial_distance
from tofcorr.simulation.effects import CATALOGUE, CatalogueEffect, MapEffect
from tofcorr.simulation.effects.inputs import EffectInputs
from tofcorr.simulation.effects.numerics import by_frame

# Periods of the periodic probe, frames. Chosen: cycles of exposures and modulation frequencies.
_PERIODS = (2, 3, 4, 5)
# Most half waves over the image, in both directions together. Chosen.
_MAP_WAVES = 9
# Prior standard deviation of a probe, metres. Chosen.
_SIZE = 0.01
# Amplitude ratios are clamped here, so that dark pixels do not dominate a probe.
_MOST_BRIGHTER = 20.0


@dataclass(frozen=True)
class Probe:
    """One pattern.

    Attributes:
        name: For programs.
        trace: What it looks like: a clause that follows "It".
        columns: Computes its columns, shape (M, K), metres at one prior standard deviation.
        part_of: Effects of the catalogue that may look like it.
    """

    name: str
    trace: str
    columns: Callable[[EffectInputs], Tensor]
    part_of: tuple[str, ...] = ()


def probes_for(inputs: EffectInputs) -> dict[str, Probe]:
    """Return the probes that a recording allows."""
    found = [
        Probe("frame_period", "repeats every few frames", _frame_period),
        Probe(
            "image_shape",
            "has one shape in every image, finer than the pixel effect",
            _map,
            part_of=("fixed_pattern", "row_column_pattern"),
        ),
    ]
    if len(inputs.facts.timestamp) > 2:
        found.append(Probe("previous_frame", "depends on the previous frame", _previous_frame))
    return {probe.name: probe for probe in found}


def _frame_period(inputs: EffectInputs) -> Tensor:
    number = torch.arange(len(inputs.facts.timestamp), dtype=torch.float64)
    columns = []
    for period in _PERIODS:
        turn = 2 * torch.pi * number / period
        columns.append(torch.cos(turn))
        if period > 2:
            columns.append(torch.sin(turn))
    return inputs.of_frame(_SIZE * torch.stack(columns, dim=-1))


def _map(inputs: EffectInputs) -> Tensor:
    """Return products of cosines over the image, up to nine half waves, shape (M, K).

    Short waves have smaller priors, so that the probe is smooth.
    """
    # Each pixel once, however many frames show it.
    used, number = inputs.pixel.unique(return_inverse=True)
    height, width = inputs.camera.height, inputs.camera.width
    x = torch.remainder(used, width).double() / max(width - 1, 1)
    y = torch.div(used, width, rounding_mode="floor").double() / max(height - 1, 1)
    of_x = [torch.cos(torch.pi * i * x) for i in range(_MAP_WAVES)]
    of_y = [torch.cos(torch.pi * i * y) for i in range(_MAP_WAVES)]
    columns = [
        _SIZE / (1.0 + 0.3 * (i + j)) * of_x[i] * of_y[j]
        for i in range(_MAP_WAVES)
        for j in range(_MAP_WAVES)
        if 0 < i + j <= _MAP_WAVES
    ]
    return torch.stack(columns, dim=-1)[number]


def _previous_frame(inputs: EffectInputs) -> Tensor:
    """Return the change since the previous frame, and the error that its signal would make."""
    before = (inputs.frame - 1).clamp(min=0)
    first = inputs.frame == 0
    assert inputs.distance_images is not None
    distance = inputs.distance_images.flatten(1)[before, inputs.pixel].double()
    seen = (distance > 0) & ~first
    further = torch.where(seen, distance - inputs.radial_distance, 0.0)
    columns = [0.05 * further]
    if inputs.amplitude_images is not None and inputs.modulation_frequency is not None:
        amplitude = inputs.amplitude_images.flatten(1)[before, inputs.pixel].double()
        columns.append(_by_other(inputs, torch.where(seen, amplitude, 0.0), distance))
    return torch.stack(columns, dim=-1)


def _by_other(inputs: EffectInputs, amplitude: Tensor, distance: Tensor) -> Tensor:
    """Return the error by a tenth of another signal added to the pixel's own, (M,), metres."""
    difference = phase_from_radial_distance(distance, inputs.known_frequency) - inputs.phase
    share = (amplitude / inputs.known_amplitude.clamp(min=1e-6)).clamp(max=_MOST_BRIGHTER)
    return 0.1 * inputs.metres_per_radian * share * torch.sin(difference)


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

    def sources(self) -> dict[str, Callable[[EffectInputs], Tensor]]:
        """Return what computes the columns of effects and probes, at one prior deviation."""
        probes = {name: probe.columns for name, probe in self.probes.items()}
        return {
            name: partial(_scaled_columns, effect) for name, effect in self.effects.items()
        } | probes

    def is_tested_by_tiles(self, name: str) -> bool:
        """Return whether a few images may hold all of an effect, so that tiles test it."""
        return name in self.effects and self.effects[name].in_few_images


def _scaled_columns(effect: CatalogueEffect, inputs: EffectInputs) -> Tensor:
    return effect.columns(inputs) * effect.prior_sd()


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
    system = linear_system(observations, fit, inputs, candidates.sources())
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
    return _left_by(study, study.system.blocks.even, names)


def likely_residual_of(study: Study, names: Sequence[str]) -> Tensor:
    """Return the residual of base model and effects fitted by likelihood, shape (M,), metres.

    Where poses scatter, an even fit bends the model towards their offsets, and leaves the same bend
    in every image.
    """
    return _left_by(study, study.system.blocks.likely, names)


def _left_by(study: Study, sums: Sums, names: Sequence[str]) -> Tensor:
    return study.system.residual - study.system.columns.times(names, solve(sums, names))


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


# Most linearisations of effects that are not linear; the second or third changes nothing any more.
_MOST_LINEARISATIONS = 3


def with_poses_reestimated(study: Study, names: Sequence[str]) -> Study:
    """Return the study whose pose uncertainty is estimated with these effects in the model."""
    known = [name for name in names if name in study.system.blocks.layout.effects]
    blocks = with_pose_uncertainty(study.system.moments, known, study.system.blocks)
    return replace(study, system=replace(study.system, blocks=blocks))


def with_residual(study: Study, residual: Tensor) -> Study:
    """Return the study of another residual (M,), metres."""
    system = changed_system(study.system, study.observations, study.fit, residual)
    return replace(study, system=system)


def without_map(study: Study, values: Tensor, spent: Collection[str]) -> Study:
    """Return the study with a map subtracted.

    Args:
        study: Before.
        values: The map's value in each pixel, shape (M,), metres.
        spent: Maps that are candidates no longer.
    """
    maps = {name: m for name, m in study.candidates.maps.items() if name not in spent}
    changed = with_residual(study, study.system.residual - values)
    return replace(changed, candidates=replace(study.candidates, maps=maps))


def relinearised(study: Study, names: Sequence[str]) -> Study:
    """Return the study with effects of the model linearised at their fitted coefficients.

    Columns are derivatives at zero. Mixed or saturated signals are not linear in their strength.
    With J the derivative at the fitted coefficients c, the residual r = y - (shift(c) - J c) and
    the columns J replace those at zero, for the effects `names` only. A linearisation is kept if
    it lowers the sum of squares.
    """
    best, best_loss = study, _loss(study, names)
    effects = study.candidates.effects
    bent = [name for name in names if name in effects and not effects[name].linear]
    if not bent:
        return study
    current = study
    for _ in range(_MOST_LINEARISATIONS):
        system = _linearised_again(current.system, study, names, bent)
        current = replace(current, system=system)
        loss = _loss(current, names)
        if not loss < best_loss:
            break
        best, best_loss = current, loss
    return best


def _linearised_again(
    current: LinearSystem, plain: Study, names: Sequence[str], bent: Sequence[str]
) -> LinearSystem:
    """Linearise the effects `bent` at the coefficients that the current system gives."""
    layout = current.blocks.layout
    theta, places = solve(current.blocks.even, names), layout.only(names).effects
    residual = plain.system.residual
    changed: dict[str, Tensor] = {}
    for name in bent:
        effect = plain.candidates.effects[name]
        own = theta[slice(*places[name])] * effect.prior_sd()
        slope = effect.slope(plain.inputs, own)
        residual = residual - (effect.shift(plain.inputs, own) - slope @ own)
        changed[name] = slope * effect.prior_sd()
    return changed_system(current, plain.observations, plain.fit, residual, names, changed)


def _loss(study: Study, names: Sequence[str]) -> float:
    """Return the weighted sum of squares of a model fitted to all poses, m^2."""
    return float((study.fit.share * residual_of(study, names) ** 2).sum())


@dataclass(frozen=True, kw_only=True)
class LeftOutModel:
    """A model, and the sums over the units that are left out one by one.

    Attributes:
        names: Effects of the model.
        blocks: Sums over the units.
        tiles: The units, if few images show an effect of the model; None: the units are poses.
        pose_count: Sum of the even weights of each pose, shape (U,).
    """

    names: tuple[str, ...]
    blocks: Blocks
    tiles: Tiles | None
    pose_count: Tensor

    def squares(self) -> Tensor:
        """Return the even sum of squares of each pose, predicted by all others, (U,), m^2.

        With tiles, each tile and each other pose is predicted by all others of them.
        """
        squares = left_out_squares(self.blocks, self.names)
        return squares if self.tiles is None else self.tiles.per_pose(squares, len(self.pose_count))

    def mean_square(self) -> float:
        """Return the mean of `squares` over all pixels, m^2."""
        return float(self.squares().sum() / self.pose_count.sum())


def left_out_model(study: Study, names: Sequence[str]) -> LeftOutModel:
    """Return base model and effects, ready to predict each pose from all others."""
    blocks, tiles = study.system.blocks, study.resampling.tiles
    by_tiles = any(study.candidates.is_tested_by_tiles(name) for name in names)
    return LeftOutModel(
        names=tuple(names),
        blocks=tile_blocks(study, names) if by_tiles else blocks,
        tiles=tiles if by_tiles else None,
        pose_count=blocks.count,
    )


def tile_blocks(study: Study, names: Sequence[str]) -> Blocks:
    """Return the sums of base model and effects over whole poses and the tiles of others.

    Raises:
        ValueError: The study has no tiles, because it tests no effect by them.
    """
    tiles, own = study.resampling.tiles, study.system.blocks
    if tiles is None:
        raise ValueError("The study has no tiles: it tests no effect that few images show.")
    moments = tile_moments(
        study.system.moments,
        names,
        tiles,
        study.system.columns,
        study.system.pose,
        study.system.residual,
        study.fit,
    )
    return blocks_of(moments, own.pose_sd, own.dispersion, own.even_scale)


def pose_equations(study: Study, residual: Tensor) -> tuple[Tensor, Tensor]:
    """Return the normal equations of each pose's offset and tilts, (U, 3, 3) and (U, 3)."""
    pose = study.system.pose
    weighted = pose * study.weight[:, None]
    sums = study.observations.products(weighted, torch.cat([pose, residual[:, None]], dim=1))
    return sums[..., :-1], sums[..., -1]


def pose_surface(study: Study, own: Tensor) -> Tensor:
    """Return what offsets and tilts (U, 3) add to each pixel's distance, shape (M,), metres."""
    of_frame = own[study.observations.unit][:, :, None]
    return by_frame(study.system.pose, of_frame, study.observations.frame)[:, 0]
