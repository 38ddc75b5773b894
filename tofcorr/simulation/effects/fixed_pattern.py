"""One constant offset for every pixel."""

import math
from collections.abc import Mapping
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from tofcorr.errors import ConfigError
from tofcorr.options import Options
from tofcorr.simulation.effects.base import MapEffect, drawn_values
from tofcorr.simulation.effects.inputs import EffectInputs

# Smallest mean number of measurements per block. Set by hand: averages noise to a third.
_PIXELS_PER_BLOCK = 10.0
# Largest number of blocks: the pixels of a VGA camera. Set by hand: a simulator's file of so many
# values, 5 MB, takes seconds to read.
_MOST_BLOCKS = 480 * 640


class FixedPatternShape(Options):
    """Image size, and the side of the square blocks of pixels that share one value."""

    height: int = 50
    width: int = 64
    block_px: int = 1


class _FixedPatternEntry(FixedPatternShape):
    rms_m: float = 0.0
    seed: int = 1
    values_m: tuple[tuple[float, ...], ...] | None = None


class FixedPatternEffect(MapEffect):
    r"""One constant for every pixel, independent of its neighbours: the fixed-pattern matrix.

    .. math:: \Delta d = o_{rc}, \quad o_{rc} \sim N(0, s^2)

    A simulator's YAML gives either `rms_m` and `seed`, from which the values are drawn, or
    `values_m`, a list of rows.
    """

    name = "fixed_pattern"
    summary = "a constant offset of every pixel"
    source = "Kahlmann et al. 2006 (fixed pattern noise matrix)"
    remedy = "twenty poses or more with the wall in all pixels"
    shape_type: ClassVar[type[Options]] = FixedPatternShape
    contains = (
        "row_column_pattern",
    )  # A per-pixel offset already contains row and column offsets.

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any], where: str) -> Self:
        """Draw or read the values."""
        options = _FixedPatternEntry.from_mapping(values, where)
        shape = FixedPatternShape(
            height=options.height, width=options.width, block_px=options.block_px
        )
        count = cls.num_cells(shape)
        if options.values_m is None:
            return cls(shape, drawn_values(count, options.rms_m, options.seed))
        listed = torch.tensor([v for row in options.values_m for v in row], dtype=torch.float64)
        if len(listed) != count:
            raise ConfigError(f"{where}: expected {count} values_m, got {len(listed)}.")
        return cls(shape, listed)

    @classmethod
    def for_recording(cls, inputs: EffectInputs) -> Self:
        """Choose blocks large enough for ten measurements each, and not too many of them."""
        height, width = inputs.camera.height, inputs.camera.width
        # Of large images only some pixels are chosen, most of them in all frames: how often the
        # pixel of a measurement is seen, in the mean over the measurements.
        visits = torch.bincount(inputs.pixel).double()
        seen = float(visits.square().sum() / visits.sum())
        block = math.ceil(math.sqrt(_PIXELS_PER_BLOCK / seen))
        block = max(block, math.ceil(math.sqrt(height * width / _MOST_BLOCKS)))
        return cls(FixedPatternShape(height=height, width=width, block_px=block))

    @classmethod
    def num_cells(cls, shape: FixedPatternShape) -> int:
        """Return the number of blocks."""
        return math.prod(cls._blocks(shape))

    @classmethod
    def cells(cls, shape: FixedPatternShape, rows: Tensor, columns: Tensor) -> Tensor:
        """Return the block of each pixel, shape (M, 1)."""
        across = cls._blocks(shape)[1]
        return (rows // shape.block_px * across + columns // shape.block_px)[:, None]

    def listed(self, decimals: int) -> dict[str, Any]:
        """Return name, shape and the values as a list of rows."""
        values = self.coefficients.reshape(self._blocks(self.shape))
        listed = [[round(value, decimals) for value in row] for row in values.tolist()]
        return {"name": self.name, **self.shape.to_mapping(), "values_m": listed}

    @staticmethod
    def _blocks(shape: Any) -> tuple[int, int]:  # noqa: ANN401 - a FixedPatternShape
        return math.ceil(shape.height / shape.block_px), math.ceil(shape.width / shape.block_px)
