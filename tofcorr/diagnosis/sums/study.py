"""Everything a diagnosis reckons with: pixels, base fit, effects, and their sums pose by pose."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from tofcorr.diagnosis.options import DiagnosisOptions, TestOptions
from tofcorr.diagnosis.sums.base_fit import BaseFit
from tofcorr.diagnosis.sums.blocks import Blocks, blocks_of, solve, with_pose_uncertainty
from tofcorr.diagnosis.sums.crossval import left_out_squares
from tofcorr.diagnosis.sums.folds import Folds, deal, draw_signs
from tofcorr.diagnosis.sums.moments import (
    Layout,
    Moments,
    cut_moments,
    gather_moments,
    pose_columns,
    with_changed,
)
from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.diagnosis.sums.parts import Parts, cut
from tofcorr.diagnosis.sums.probes import Probe, probes_for
from tofcorr.simulation.effects import CATALOGUE, CatalogueEffect, MapEffect
from tofcorr.simulation.effects.inputs import EffectInputs

# Steps towards the fit of effects that are not linear in their strength.
_BENDS = 3
_GROUP_OF_FORM = {"distance": "distance", "pixel": "pixel", "amplitude": "intensity"}
BASE_FORMS = tuple(_GROUP_OF_FORM)
"""Effects that are finer forms of the base model's own terms."""


@dataclass(frozen=True, kw_only=True)
class Study:
    """A recording under diagnosis.

    Attributes:
        options: Of the diagnosis.
        observations: The chosen pixels.
        fit: The base model.
        inputs: What effects look at.
        effects: Effects with columns, by name.
        maps: Effects with one value a cell of the image, by name.
        probes: Marks of effects beyond the catalogue, with columns, by name.
        missing: What cannot be judged, and for want of what.
        columns: Of base model and effects, shape (M, P).
        pose: Columns of an uncertain pose, shape (M, 3).
        residual: Of the base fit less the maps already chosen, shape (M,), metres.
        moments: Sums of these over the pixels of every pose.
        blocks: The same with the poses' uncertainty counted in.
        folds: Of the cross-validation.
        signs: Sign flips of the poses, shape (B, U).
        parts: Poses cut up, for effects that few images show; None where no such effect is known.
    """

    options: DiagnosisOptions
    observations: Observations
    fit: BaseFit
    inputs: EffectInputs
    effects: Mapping[str, CatalogueEffect]
    maps: Mapping[str, MapEffect]
    probes: Mapping[str, Probe]
    missing: Mapping[str, list[str]]
    columns: Tensor
    pose: Tensor
    residual: Tensor
    moments: Moments
    blocks: Blocks
    folds: Folds
    signs: Tensor
    parts: Parts | None = None
    _in_parts: dict[tuple[str, ...], Blocks] = field(init=False, repr=False, default_factory=dict)

    @property
    def weight(self) -> Tensor:
        """Weights of the pixels, 1 / m^2, shape (M,)."""
        return self.fit.trust / (self.blocks.dispersion * self.fit.sigma**2)

    @property
    def unit_of_pixel(self) -> Tensor:
        """Pose of every pixel, shape (M,), int64."""
        return self.observations.unit[self.observations.frame]

    @property
    def withheld_forms(self) -> list[str]:
        """Those of `BASE_FORMS` that the base model has no term of at all."""
        model = self.fit.model
        groups = {term.group for term in (*model.signal_terms, *model.pixel_terms)}
        return [form for form, group in _GROUP_OF_FORM.items() if group not in groups]

    def shown_by_few(self, name: str) -> bool:
        """Return whether an effect is one that few images show, to be tested by parts of them."""
        return name in self.effects and self.effects[name].in_few_images

    def in_parts(self, names: Sequence[str]) -> Blocks:
        """Return what each part of `parts` says of base model and some effects."""
        assert self.parts is not None
        key = tuple(names)
        if key not in self._in_parts:
            moments = cut_moments(
                self.moments, names, self.parts, self.columns, self.pose, self.residual, self.fit
            )
            own = self.blocks
            blocks = blocks_of(moments, own.pose_sd, own.dispersion, own.even_scale)
            self._in_parts[key] = blocks
        return self._in_parts[key]

    def left_out_squares(self, names: Sequence[str], weights: Tensor | None = None) -> Tensor:
        """Return the even sum of squares of each pose, fitted to all others, shape (U,), m^2.

        With an effect that few images show each part of a pose is fitted to all other parts.

        Args:
            names: Effects of the model.
            weights: How often each pose counts, shape (U,); None: once.
        """
        if self.parts is None or not any(self.shown_by_few(name) for name in names):
            return left_out_squares(self.blocks, names, weights)
        own = None if weights is None else weights[self.parts.pose]
        squares = left_out_squares(self.in_parts(names), names, own)
        return self.parts.per_pose(squares, self.blocks.num_units)

    def with_chosen(self, names: Sequence[str]) -> "Study":
        """Return the study with poses' uncertainty as it is once these effects are known."""
        named = [name for name in names if name in self.blocks.layout.effects]
        return replace(self, blocks=with_pose_uncertainty(self.moments, named))

    def with_residual(self, residual: Tensor) -> "Study":
        """Return the study of another residual (M,)."""
        moments = with_changed(
            self.moments, self.observations, self.columns, self.pose, residual, self.fit
        )
        blocks = with_pose_uncertainty(moments)
        return replace(self, residual=residual, moments=moments, blocks=blocks)

    def without_map(self, values: Tensor) -> "Study":
        """Return the study after taking a map's values (M,) off the residual."""
        return self.with_residual(self.residual - values)

    def bent(self, names: Sequence[str]) -> "Study":
        """Return the study with the columns of strong effects taken where the fit is.

        Columns are derivatives at zero; mixed or saturated signals are not linear in their
        strength. Here r = y - (shift(c) - J c) and J, the derivative at the fitted coefficients c,
        stand for residual and columns: the model with these effects is then fitted to second
        order. Models without them are not: they belong to the plain study.
        """
        best, best_loss = self, self._loss(names)
        strong = [n for n in names if n in self.effects and not self.effects[n].linear]
        if not strong:
            return self
        current = self
        for _ in range(_BENDS):
            current = current._expanded(self, names, strong)
            loss = current._loss(names)
            if not loss < best_loss:
                break
            best, best_loss = current, loss
        return best

    def _expanded(self, plain: "Study", names: Sequence[str], strong: Sequence[str]) -> "Study":
        members = self.blocks.layout.of(names)
        theta = dict(zip(members.tolist(), solve(self.blocks.even, names).tolist(), strict=True))
        columns, residual = plain.columns.clone(), plain.residual
        changed: list[int] = []
        for name in strong:
            low, high = self.blocks.layout.effects[name]
            effect = self.effects[name]
            own = torch.tensor([theta[i] for i in range(low, high)], dtype=torch.float64)
            own = own * effect.prior_sd()
            slope = effect.slope(self.inputs, own)
            residual = residual - (effect.shift(self.inputs, own) - slope @ own)
            columns[:, low:high] = slope * effect.prior_sd()
            changed += range(low, high)
        moments = with_changed(
            self.moments, self.observations, columns, self.pose, residual, self.fit, changed
        )
        blocks = with_pose_uncertainty(moments, names)
        return replace(self, columns=columns, residual=residual, moments=moments, blocks=blocks)

    def _loss(self, names: Sequence[str]) -> float:
        """Return the sum of squares of a model fitted to all poses, m^2."""
        return float((self.fit.share * self.residual_of(names) ** 2).sum())

    def residual_of(self, names: Sequence[str]) -> Tensor:
        """Return the residual of base model and effects fitted to all poses, shape (M,)."""
        members = self.blocks.layout.of(names)
        return self.residual - self.columns[:, members] @ solve(self.blocks.even, names)


def catalogue_for(
    options: DiagnosisOptions, inputs: EffectInputs
) -> tuple[dict[str, CatalogueEffect], dict[str, MapEffect], dict[str, list[str]]]:
    """Return effects with columns, effects with maps, and what is missing for others."""
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
    return effects, maps, missing


def build_study(
    options: DiagnosisOptions,
    observations: Observations,
    fit: BaseFit,
    inputs: EffectInputs,
    generator: torch.Generator,
) -> Study:
    """Compute all columns, sum them up, and deal folds and sign flips."""
    tests, num_units = options.tests, observations.num_units
    folds = deal(num_units, tests.folds, generator)
    signs = draw_signs(tests.flips, num_units, generator)
    effects, maps, missing = catalogue_for(options, inputs)
    probes = probes_for(inputs)
    columns, layout = _side_by_side(fit, inputs, effects, probes)
    pose = pose_columns(inputs)
    moments = gather_moments(observations, columns, pose, fit.residual, fit, layout)
    blocks = with_pose_uncertainty(moments)
    return Study(
        options=options,
        observations=observations,
        fit=fit,
        inputs=inputs,
        effects=effects,
        maps=maps,
        probes=probes,
        missing=missing,
        columns=columns,
        pose=pose,
        residual=fit.residual,
        moments=moments,
        blocks=blocks,
        folds=folds,
        signs=signs,
        parts=_cut_for(effects, observations, blocks, tests, generator),
    )


def _side_by_side(
    fit: BaseFit,
    inputs: EffectInputs,
    effects: Mapping[str, CatalogueEffect],
    probes: Mapping[str, Probe],
) -> tuple[Tensor, Layout]:
    """Return the columns of base model, effects and probes, (M, P), and where they stand."""
    base = fit.model.columns(fit.tool_from_camera)
    parts, prior = [base], [fit.model.prior_precision()]
    places, start = {}, base.shape[1]
    for name, source in (*effects.items(), *probes.items()):
        own = source.columns(inputs)
        if isinstance(source, CatalogueEffect):
            own = own * source.prior_sd()
        parts.append(own)
        prior.append(torch.ones(own.shape[1], dtype=torch.float64))
        places[name] = (start, start + own.shape[1])
        start += own.shape[1]
    layout = Layout(base=base.shape[1], effects=places, prior=torch.cat(prior))
    return torch.cat(parts, dim=1), layout


def _cut_for(
    effects: Mapping[str, CatalogueEffect],
    observations: Observations,
    blocks: Blocks,
    tests: TestOptions,
    generator: torch.Generator,
) -> Parts | None:
    """Cut the poses that would show most of the effects that few images show."""
    few = [blocks.layout.effects[name] for name in effects if effects[name].in_few_images]
    if not few:
        return None
    own = torch.cat([torch.arange(*place) for place in few])
    return cut(
        blocks.likely.gram.diagonal(dim1=1, dim2=2)[:, own].sum(1),
        observations.unit[observations.frame],
        observations.pixel,
        observations.recording.camera,
        tests.folds,
        tests.flips,
        generator,
    )
