"""What a simulator does along every covariate, fitted to its own frames.

The truth of a simulator is known, so that its error is known in every pixel of every frame. Base
terms, effects of the catalogue, and one value a pixel are fitted to it together, each with its
prior. Effects are added as long as the Bayesian information criterion falls. Nothing is named: what
matters is the sum at other covariates.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.base_fit import BaseFit
from tofcorr.diagnosis.sums.blocks import Blocks, with_pose_uncertainty
from tofcorr.diagnosis.sums.columns import Columns
from tofcorr.diagnosis.sums.left_out import LeftOutModel
from tofcorr.diagnosis.sums.moments import Moments, gather_moments, pose_columns
from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.simulation.effects import CATALOGUE, CatalogueEffect, MapEffect
from tofcorr.simulation.effects.inputs import EffectInputs

# Linearisations of effects that are not linear. Chosen: the third changes nothing any more.
_LINEARISATIONS = 2
# An effect is linearised again if it is larger than this, metres. Chosen, below any noise.
_WORTH_LINEARISING = 5e-5


@dataclass(frozen=True, kw_only=True)
class ErrorOfSimulator:
    """A fitted error of a simulator.

    Attributes:
        fit: The base model, fitted to the simulator's frames.
        effects: The effects fitted, with their coefficients.
        change: Of the base model's coefficients, shape (K,).
        covariance: Of base coefficients and scaled effect coefficients, shape (P, P).
        pattern: One value a pixel; None where the frames do not show it.
        misfit: Root mean square error on held-out poses in excess of noise, metres.
    """

    fit: BaseFit
    effects: tuple[CatalogueEffect, ...]
    change: Tensor
    covariance: Tensor
    pattern: MapEffect | None
    misfit: float

    def at(self, pixels: Observations, inputs: EffectInputs) -> tuple[Tensor, Tensor]:
        """Return the error of other pixels (M,), and columns (M, P) of what is uncertain, metres.

        Args:
            pixels: Of any recording of the same camera.
            inputs: What effects may depend on there, with the simulator's hand-eye transform.
        """
        columns = self.fit.model.on(pixels).error_columns(inputs.radial_distance)
        error = columns @ (self.fit.coefficients + self.change)
        parts = [columns]
        for effect in self.effects:
            error = error + effect.shift(inputs, effect.coefficients)
            parts.append(effect.slope(inputs, effect.coefficients) * effect.prior_sd())
        if self.pattern is not None:
            error = error + self.pattern.shift(inputs, self.pattern.coefficients)
        # The matrix is singular to rounding where the frames determine a coefficient very well.
        variance, turn = torch.linalg.eigh(self.covariance)
        return error, torch.cat(parts, dim=1) @ (turn * variance.clamp(min=0.0).sqrt())


def fit_error(
    frames: Observations,
    inputs: EffectInputs,
    fit: BaseFit,
    effects: tuple[CatalogueEffect, ...],
) -> ErrorOfSimulator:
    """Fit base terms and effects together to a simulator's frames.

    Args:
        frames: Its pixels.
        inputs: What effects may depend on there.
        fit: The base model, fitted to them with the exact hand-eye transform.
        effects: Which effects, with coefficients of zero.
    """
    base = fit.model.columns(fit.tool_from_camera)
    count = base.shape[1]
    effects = _needed(_moments(frames, inputs, fit, base, effects), effects, len(frames.measured))
    blocks, theta = _solved(_moments(frames, inputs, fit, base, effects))
    fitted = _by_effect(effects, theta[count:])
    for _ in range(_LINEARISATIONS):
        if not any(_size(each, inputs) > _WORTH_LINEARISING for each in fitted if not each.linear):
            break
        blocks, theta = _solved(_moments(frames, inputs, fit, base, fitted))
        fitted = _by_effect(fitted, theta[count:])
    residual = fit.residual - base @ theta[:count]
    for effect in fitted:
        residual = residual - effect.shift(inputs, effect.coefficients)
    pattern, fixed = _pattern(frames, inputs, residual, fit)
    names = tuple(blocks.layout.effects)
    gram, _, prior = blocks.likely.of(names)
    model = LeftOutModel(names=names, blocks=blocks, tiles=None, pose_count=blocks.count)
    return ErrorOfSimulator(
        fit=fit,
        effects=fitted,
        change=theta[:count],
        covariance=torch.linalg.inv(gram.sum(0) + prior),
        pattern=pattern,
        misfit=max(model.mean_square() - fit.floor**2 - fixed, 0.0) ** 0.5,
    )


def _moments(
    frames: Observations,
    inputs: EffectInputs,
    fit: BaseFit,
    base: Tensor,
    effects: tuple[CatalogueEffect, ...],
) -> Moments:
    """Return the sums of base terms and effects, linearised where they are."""
    residual, own = fit.residual, {}
    for effect in effects:
        slope = effect.slope(inputs, effect.coefficients)
        shift = effect.shift(inputs, effect.coefficients)
        residual = residual - (shift - slope @ effect.coefficients)
        own[effect.name] = slope * effect.prior_sd()
    columns = Columns(base=base, effects=own)
    layout = columns.layout(fit.model.prior_precision())
    return gather_moments(frames, columns, pose_columns(inputs), residual, fit, layout)


def _needed(
    moments: Moments, effects: tuple[CatalogueEffect, ...], pixels: int
) -> tuple[CatalogueEffect, ...]:
    """Return the effects that lower the Bayesian information criterion, best first.

    Args:
        moments: Sums of base terms and all effects.
        effects: The effects.
        pixels: Number of pixels; an effect must lower chi-squared by its logarithm a coefficient.
    """
    blocks, chosen = with_pose_uncertainty(moments), list[str]()
    while len(chosen) < len(effects):
        now = _explained(blocks, chosen)
        gains = {
            each.name: _explained(blocks, [*chosen, each.name])
            - now
            - len(each.coefficients) * math.log(pixels)
            for each in effects
            if each.name not in chosen
        }
        best = max(gains, key=lambda name: gains[name])
        if gains[best] <= 0:
            break
        chosen.append(best)
        blocks = with_pose_uncertainty(moments, chosen)
    return tuple(each for each in effects if each.name in chosen)


def _explained(blocks: Blocks, names: list[str]) -> float:
    """Return by how much base terms and effects lower chi-squared."""
    gram, score, prior = blocks.likely.of(names)
    total = score.sum(0)
    return float(total @ torch.linalg.solve(gram.sum(0) + prior, total))


def _solved(moments: Moments) -> tuple[Blocks, Tensor]:
    """Solve for all coefficients."""
    names = list(moments.layout.effects)
    plain = with_pose_uncertainty(moments, names)
    gram, score, precision = plain.likely.of(names)
    return plain, torch.linalg.solve(gram.sum(0) + precision, score.sum(0))


def _by_effect(effects: tuple[CatalogueEffect, ...], theta: Tensor) -> tuple[CatalogueEffect, ...]:
    """Return the effects with the coefficients of a solution, in their own units."""
    found, start = [], 0
    for effect in effects:
        end = start + len(effect.coefficients)
        found.append(effect.with_coefficients(theta[start:end] * effect.prior_sd()))
        start = end
    return tuple(found)


def _size(effect: CatalogueEffect, inputs: EffectInputs) -> float:
    return float(effect.shift(inputs, effect.coefficients).square().mean().sqrt())


def _pattern(
    frames: Observations, inputs: EffectInputs, residual: Tensor, fit: BaseFit
) -> tuple[MapEffect | None, float]:
    """Return what all frames share in a pixel, shrunk by its noise, and its mean square, m^2."""
    kinds = [kind for kind in CATALOGUE.values() if issubclass(kind, MapEffect)]
    kind = max(kinds, key=lambda each: len(each.contains))
    effect = kind.for_recording(inputs)
    cells, count = effect.cells_of(inputs)[:, 0], effect.num_cells(effect.shape)
    weight = fit.trust / fit.sigma**2
    zeros = torch.zeros(count, dtype=torch.float64)
    total = zeros.index_add(0, cells, weight).clamp(min=1e-12)
    mean = zeros.index_add(0, cells, weight * residual) / total
    # Products of different frames hold what they share, without the noise of each.
    pairs = total**2 - zeros.index_add(0, cells, weight**2)
    products = (mean * total) ** 2 - zeros.index_add(0, cells, (weight * residual) ** 2)
    shared = max(float(products.sum() / pairs.sum().clamp(min=1e-12)), 0.0)
    if shared == 0:
        return None, 0.0
    return effect.with_coefficients(mean * shared / (shared + 1 / total)), shared
