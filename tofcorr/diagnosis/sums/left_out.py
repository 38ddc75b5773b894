"""How well a model predicts each pose from all others."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.blocks import Blocks, blocks_of
from tofcorr.diagnosis.sums.crossval import left_out_squares
from tofcorr.diagnosis.sums.moments import tile_moments
from tofcorr.diagnosis.sums.study import Study
from tofcorr.diagnosis.sums.tiles import Tiles


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
        """Return the even sum of squares of each pose, predicted by all others, (U,), m^2."""
        return self._squares(torch.ones_like(self.pose_count)[None])[0]

    def mean_square(self) -> float:
        """Return the mean of `squares` over all pixels, m^2."""
        return float(self.squares().sum() / self.pose_count.sum())

    def mean_squares(self, weights: Tensor) -> Tensor:
        """Return the mean square of resamples, each unit predicted by all others, (B,), m^2.

        Args:
            weights: How often each resample holds each pose, shape (B, U).
        """
        return (weights * self._squares(weights)).sum(1) / (weights @ self.pose_count)

    def _squares(self, weights: Tensor) -> Tensor:
        if self.tiles is None:
            return left_out_squares(self.blocks, self.names, weights)
        squares = left_out_squares(self.blocks, self.names, weights[:, self.tiles.pose])
        return self.tiles.per_pose(squares, len(self.pose_count))


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
