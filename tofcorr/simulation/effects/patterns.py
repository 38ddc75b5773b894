"""Effects with one value for each place in the image: too many for columns of a fit."""

import math
from abc import abstractmethod
from collections.abc import Mapping
from functools import lru_cache
from typing import Any, ClassVar, Self

import numpy as np
import torch
from pydantic import create_model
from torch import Tensor

from tofcorr.errors import ConfigError
from tofcorr.options import FiniteNumber, Options
from tofcorr.simulation.effects.base import (
    CatalogueEffect,
    Coefficient,
    EffectInputs,
    add_delay,
    inputs_from_state,
)
from tofcorr.simulation.hooks import FrameState

# Smallest mean number of measurements per block. Set by hand: averages noise to a third.
_PIXELS_PER_BLOCK = 10.0
# Largest number of blocks: the pixels of a VGA camera. Set by hand: a simulator's file of so many
# values, 5 MB, takes seconds to read.
_MOST_BLOCKS = 480 * 640


class MapEffect(CatalogueEffect):
    """A delay of each cell of the image; a pixel may lie in several cells (its row, its column).

    The values have independent priors around zero. The diagnosis estimates them from the mean
    residual of each cell instead of fitting columns.

    Class attributes:
        tables: Keys that list values in a simulator's YAML, each with the key of a root mean square
            by which they are drawn instead, from `seed` on, and the type of the list.
    """

    tables: ClassVar[dict[str, tuple[str, Any]]]
    form_error = 0.0  # A map holds every pattern of its kind.
    prior = 0.01

    @classmethod
    @abstractmethod
    def sizes(cls, shape: Any) -> list[tuple[int, ...]]:  # noqa: ANN401 - each its own shape
        """Return the size of each table."""

    @abstractmethod
    def cells_of(self, pixel: Tensor) -> Tensor:
        """Return the cells of pixels, flat indices (M,), shape (M, G), int64."""

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any], where: str) -> Self:
        """Draw or read the values.

        Raises:
            ConfigError: A key is unknown, a value is not a number, or there are too few or many.
        """
        fields: dict[str, Any] = {"seed": (int, 1)}
        for key, (rms, listed) in cls.tables.items():
            fields |= {rms: (FiniteNumber, 0.0), key: (listed | None, None)}
        kind: Any = create_model("Entry", __base__=cls.shape_type, **fields)
        entry = kind.from_mapping(values, where)
        shape = cls.shape_type(**{key: getattr(entry, key) for key in cls.shape_type.model_fields})
        parts = []
        for k, (key, (rms, _)) in enumerate(cls.tables.items()):
            listed, count = getattr(entry, key), math.prod(cls.sizes(shape)[k])
            if listed is None:
                parts.append(drawn_values(count, getattr(entry, rms), entry.seed + k))
            else:
                rows = [row if isinstance(row, tuple) else (row,) for row in listed]
                parts.append(torch.tensor([v for row in rows for v in row], dtype=torch.float64))
            if len(parts[-1]) != count:
                raise ConfigError(f"{where}: expected {count} {key}, got {len(parts[-1])}.")
        return cls(shape, torch.cat(parts))

    def listed(self, decimals: int) -> dict[str, Any]:
        """Return name, shape and values as lists, metres rounded to so many decimals."""
        sizes = self.sizes(self.shape)
        parts = self.coefficients.split([math.prod(size) for size in sizes])
        lists = [part.reshape(size) for part, size in zip(parts, sizes, strict=True)]
        listed = [np.round(values.numpy(), decimals).tolist() for values in lists]
        tables = dict(zip(self.tables, listed, strict=True))
        return {"name": self.name, **self.shape.to_mapping(), **tables}

    def to_mapping(self) -> dict[str, Any]:
        """Return an entry of a simulator's YAML, values rounded to 1 um."""
        return self.listed(decimals=6)

    @classmethod
    def terms(cls, shape: Options) -> tuple[Coefficient, ...]:
        """Return one coefficient per cell; 10 mm is the size that Kahlmann et al. (2006) report."""
        return _cell_terms(sum(map(math.prod, cls.sizes(shape))))

    def shift(self, inputs: EffectInputs, coefficients: Tensor) -> Tensor:
        """Return the sum of the values of a pixel's cells, shape (M,), metres."""
        return coefficients[self.cells_of(inputs.pixel)].sum(-1)

    def on_delay(self, state: FrameState) -> None:
        """Delay every pixel by its values."""
        add_delay(state, self.shift(inputs_from_state(state), self.coefficients))


def drawn_values(count: int, rms: float, seed: int) -> Tensor:
    """Draw `count` normal values (metres) with standard deviation `rms` from their own seed."""
    generator = torch.Generator().manual_seed(seed)
    return rms * torch.randn(count, generator=generator, dtype=torch.float64)


@lru_cache(maxsize=4)
def _cell_terms(count: int) -> tuple[Coefficient, ...]:
    """Return the coefficients of so many cells; a map is built many times, of thousands of them."""
    return tuple(Coefficient(f"cell_{number}", "m", MapEffect.prior) for number in range(count))


class ImageShape(Options):
    """Image size."""

    height: int = 50
    width: int = 64


class FixedPatternShape(ImageShape):
    """Image size, and the side of the square blocks of pixels that share one value."""

    block_px: int = 1


class FixedPatternEffect(MapEffect, shape=FixedPatternShape):
    r"""One constant for every pixel, independent of its neighbours: the fixed-pattern matrix.

    .. math:: \Delta d = o_{rc}, \quad o_{rc} \sim N(0, s^2)

    A simulator's YAML gives either `rms_m` and `seed`, from which the values are drawn, or
    `values_m`, a list of rows.

    Source: Kahlmann et al. 2006 (fixed pattern noise matrix).
    """

    name = "fixed_pattern"
    summary = "a constant offset of every pixel"
    remedy = "twenty poses or more with the wall in all pixels"
    # A per-pixel offset already contains row and column offsets.
    contains = ("row_column_pattern",)
    tables = {"values_m": ("rms_m", tuple[tuple[float, ...], ...])}  # noqa: RUF012 - typed above

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
    def sizes(cls, shape: FixedPatternShape) -> list[tuple[int, ...]]:
        """Return the number of blocks down and across."""
        side = shape.block_px
        return [(math.ceil(shape.height / side), math.ceil(shape.width / side))]

    def cells_of(self, pixel: Tensor) -> Tensor:
        """Return the block of each pixel, shape (M, 1)."""
        (_, across), side = self.sizes(self.shape)[0], self.shape.block_px
        row, column = pixel // self.shape.width, pixel % self.shape.width
        return (row // side * across + column // side)[:, None]


class RowColumnPatternEffect(MapEffect, shape=ImageShape):
    r"""One constant for every row and one for every column.

    .. math:: \Delta d = o_r + o_c

    Rows are addressed and columns are converted one by one; each has its own delay. A simulator's
    YAML gives either `row_rms_m`, `column_rms_m` and `seed`, or `rows_m` and `columns_m`.

    Source: row addressing and column converters of area sensors (EMVA 1288).
    """

    name = "row_column_pattern"
    summary = "a constant offset of every row and every column"
    remedy = "twenty poses or more with the wall in all pixels"
    tables = {  # noqa: RUF012 - typed above
        "rows_m": ("row_rms_m", tuple[float, ...]),
        "columns_m": ("column_rms_m", tuple[float, ...]),
    }

    @classmethod
    def for_recording(cls, inputs: EffectInputs) -> Self:
        """Take the recording's image size."""
        return cls(ImageShape(height=inputs.camera.height, width=inputs.camera.width))

    @classmethod
    def sizes(cls, shape: ImageShape) -> list[tuple[int, ...]]:
        """Return the number of rows and columns."""
        return [(shape.height,), (shape.width,)]

    def cells_of(self, pixel: Tensor) -> Tensor:
        """Return row and column of each pixel, shape (M, 2)."""
        height, width = self.shape.height, self.shape.width
        return torch.stack([pixel // width, height + pixel % width], dim=-1)
