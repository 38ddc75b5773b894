"""How well a model predicts each pose from all others."""

from collections.abc import Sequence
from dataclasses import dataclass

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
