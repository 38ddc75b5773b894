"""One constant offset for every row and one for every column."""

from collections.abc import Mapping
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from tofcorr.errors import ConfigError
from tofcorr.options import Options
from tofcorr.simulation.effects.base import MapEffect, drawn_values
from tofcorr.simulation.effects.inputs import EffectInputs


class RowColumnPatternShape(Options):
    """Image size."""

    height: int = 50
    width: int = 64


class _RowColumnEntry(RowColumnPatternShape):
    row_rms_m: float = 0.0
    column_rms_m: float = 0.0
    seed: int = 1
    rows_m: tuple[float, ...] | None = None
    columns_m: tuple[float, ...] | None = None


class RowColumnPatternEffect(MapEffect):
    r"""One constant for every row and one for every column.

    .. math:: \Delta d = o_r + o_c

    Rows are addressed and columns are converted one by one; each has its own delay. A simulator's
    YAML gives either `row_rms_m`, `column_rms_m` and `seed`, or `rows_m` and `columns_m`.
    """

    name = "row_column_pattern"
    summary = "a constant offset of every row and every column"
    source = "row addressing and column converters of area sensors (EMVA 1288)"
    remedy = "twenty poses or more with the wall in all pixels"
    shape_type: ClassVar[type[Options]] = RowColumnPatternShape

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any], where: str) -> Self:
        """Draw or read the values."""
        options = _RowColumnEntry.from_mapping(values, where)
        shape = RowColumnPatternShape(height=options.height, width=options.width)
        rows = drawn_values(options.height, options.row_rms_m, options.seed)
        columns = drawn_values(options.width, options.column_rms_m, options.seed + 1)
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

    def listed(self, decimals: int) -> dict[str, Any]:
        """Return name, shape and the values of rows and columns."""
        values = [round(value, decimals) for value in self.coefficients.tolist()]
        height = self.shape.to_mapping()["height"]
        return {
            "name": self.name,
            **self.shape.to_mapping(),
            "rows_m": values[:height],
            "columns_m": values[height:],
        }
