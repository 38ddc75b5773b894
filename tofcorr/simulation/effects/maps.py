"""Effects with one value for each place in the image: too many for columns, drawn or listed."""

import math
from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from tofcorr.errors import ConfigError
from tofcorr.options import Options
from tofcorr.simulation.effects.base import CatalogueEffect, Coefficient
from tofcorr.simulation.effects.inputs import EffectInputs
from tofcorr.simulation.hooks import FrameState


class MapEffect(CatalogueEffect):
    """A delay of each cell of the image; a pixel may lie in several cells (its row, its column).

    The values have independent priors around zero. Diagnosis estimates them from the mean
    residual of the cells instead of fitting columns.
    """

    shape_type: ClassVar[type[Options]]

    @classmethod
    @abstractmethod
    def num_cells(cls, shape: Any) -> int:  # noqa: ANN401 - each its own shape
        """Return the number of values."""

    @classmethod
    @abstractmethod
    def cells(cls, shape: Any, rows: Tensor, columns: Tensor) -> Tensor:  # noqa: ANN401
        """Return the cells that pixels (M,) lie in, shape (M, G), int64."""

    @classmethod
    def terms(cls, shape: Options) -> tuple[Coefficient, ...]:
        """Return one coefficient a cell."""
        return tuple(
            Coefficient(f"cell_{number}", "m", 0.01) for number in range(cls.num_cells(shape))
        )

    def cells_of(self, inputs: EffectInputs) -> Tensor:
        """Return the cells of the chosen pixels, shape (M, G), int64."""
        width = inputs.camera.width
        row = torch.div(inputs.pixel, width, rounding_mode="floor")
        return self.cells(self.shape, row, torch.remainder(inputs.pixel, width))

    def shift(self, inputs: EffectInputs, coefficients: Tensor) -> Tensor:
        """Return the sum of the values of a pixel's cells, shape (M,), metres."""
        return coefficients[self.cells_of(inputs)].sum(-1)

    def columns(self, inputs: EffectInputs) -> Tensor:
        """Return membership of pixels in cells, shape (M, number of cells): large."""
        cells = self.cells_of(inputs)
        one_hot = torch.zeros(len(cells), self.num_cells(self.shape), dtype=torch.float64)
        return one_hot.scatter_add_(1, cells, torch.ones_like(cells, dtype=torch.float64))

    def on_delay(self, state: FrameState) -> None:
        """Delay every pixel by its values."""
        height, width = state.radial_distance.shape
        pixel = torch.arange(height * width)
        row = torch.div(pixel, width, rounding_mode="floor")
        cells = self.cells(self.shape, row, torch.remainder(pixel, width))
        state.delay = state.delay + self.coefficients[cells].sum(-1).reshape(height, width)


class FixedPatternShape(Options):
    """Image size, and the side of the squares that share one value."""

    height: int = 50
    width: int = 64
    block_px: int = 1


class FixedPattern(MapEffect):
    r"""One constant for every pixel, without any order: the fixed-pattern matrix.

    .. math:: \Delta d = o_{rc}, \quad o_{rc} \sim N(0, s^2)

    In a simulator's YAML either `rms_m` and `seed`, from which the values are drawn, or `values_m`,
    a list of rows.
    """

    name = "fixed_pattern"
    summary = "a constant of every single pixel"
    source = "Kahlmann et al. 2006 (fixed pattern noise matrix)"
    remedy = "twenty poses or more with the wall in all pixels"
    shape_type: ClassVar[type[Options]] = FixedPatternShape

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any], where: str) -> Self:
        """Draw or read the values."""
        options = _FixedPatternEntry.from_mapping(values, where)
        shape = FixedPatternShape(
            height=options.height, width=options.width, block_px=options.block_px
        )
        count = cls.num_cells(shape)
        if options.values_m is None:
            return cls(shape, _drawn(count, options.rms_m, options.seed))
        listed = torch.tensor([v for row in options.values_m for v in row], dtype=torch.float64)
        if len(listed) != count:
            raise ConfigError(f"{where}: expected {count} values_m, got {len(listed)}.")
        return cls(shape, listed)

    @classmethod
    def for_recording(cls, inputs: EffectInputs) -> Self:
        """Choose blocks so large that each is seen in ten frames or so."""
        height, width = inputs.camera.height, inputs.camera.width
        seen = len(inputs.pixel) / (height * width)
        block = max(1, math.ceil(math.sqrt(10.0 / max(seen, 1e-6))))
        block = max(block, math.ceil(math.sqrt(height * width / 16384)))
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

    def to_mapping(self) -> dict[str, Any]:
        """Return the values as a list of rows, rounded to 1 um."""
        values = self.coefficients.reshape(self._blocks(self.shape))
        listed = [[round(value, 6) for value in row] for row in values.tolist()]
        return {"name": self.name, **self.shape.to_mapping(), "values_m": listed}

    @staticmethod
    def _blocks(shape: Any) -> tuple[int, int]:  # noqa: ANN401 - a FixedPatternShape
        return math.ceil(shape.height / shape.block_px), math.ceil(shape.width / shape.block_px)


class RowColumnPatternShape(Options):
    """Image size."""

    height: int = 50
    width: int = 64


class RowColumnPattern(MapEffect):
    r"""One constant for every row and one for every column.

    .. math:: \Delta d = o_r + o_c

    Rows are addressed and columns converted one by one; each has its own delay. In a simulator's
    YAML either `row_rms_m`, `column_rms_m` and `seed`, or `rows_m` and `columns_m`.
    """

    name = "row_column_pattern"
    summary = "a constant of every row and every column"
    source = "row addressing and column converters of area sensors (EMVA 1288)"
    remedy = "twenty poses or more with the wall in all pixels"
    shape_type: ClassVar[type[Options]] = RowColumnPatternShape

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any], where: str) -> Self:
        """Draw or read the values."""
        options = _RowColumnEntry.from_mapping(values, where)
        shape = RowColumnPatternShape(height=options.height, width=options.width)
        rows = _drawn(options.height, options.row_rms_m, options.seed)
        columns = _drawn(options.width, options.column_rms_m, options.seed + 1)
        if options.rows_m is not None:
            rows = torch.tensor(options.rows_m, dtype=torch.float64)
        if options.columns_m is not None:
            columns = torch.tensor(options.columns_m, dtype=torch.float64)
        if (len(rows), len(columns)) != (options.height, options.width):
            raise ConfigError(
                f"{where}: expected {options.height} rows_m and {options.width} columns_m, "
                f"got {len(rows)} and {len(columns)}."
            )
        return cls(shape, torch.cat([rows, columns]))

    @classmethod
    def for_recording(cls, inputs: EffectInputs) -> Self:
        """Take the recording's image size."""
        camera = inputs.camera
        return cls(RowColumnPatternShape(height=camera.height, width=camera.width))

    @classmethod
    def num_cells(cls, shape: RowColumnPatternShape) -> int:
        """Return the number of rows and columns."""
        return shape.height + shape.width

    @classmethod
    def cells(cls, shape: RowColumnPatternShape, rows: Tensor, columns: Tensor) -> Tensor:
        """Return row and column of each pixel, shape (M, 2)."""
        return torch.stack([rows, shape.height + columns], dim=-1)

    def to_mapping(self) -> dict[str, Any]:
        """Return the values of rows and columns, rounded to 1 um."""
        values = [round(value, 6) for value in self.coefficients.tolist()]
        height = self.shape.to_mapping()["height"]
        return {
            "name": self.name,
            **self.shape.to_mapping(),
            "rows_m": values[:height],
            "columns_m": values[height:],
        }


class _FixedPatternEntry(FixedPatternShape):
    rms_m: float = 0.0
    seed: int = 1
    values_m: tuple[tuple[float, ...], ...] | None = None


class _RowColumnEntry(RowColumnPatternShape):
    row_rms_m: float = 0.0
    column_rms_m: float = 0.0
    seed: int = 1
    rows_m: tuple[float, ...] | None = None
    columns_m: tuple[float, ...] | None = None


def _drawn(count: int, rms: float, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return rms * torch.randn(count, generator=generator, dtype=torch.float64)
