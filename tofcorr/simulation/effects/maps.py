"""Effects with one value for each place in the image: too many for columns of a fit."""

from abc import abstractmethod
from functools import lru_cache
from typing import Any, ClassVar

import torch
from torch import Tensor

from tofcorr.options import Options
from tofcorr.simulation.effects.base import CatalogueEffect, Coefficient
from tofcorr.simulation.effects.inputs import EffectInputs
from tofcorr.simulation.hooks import FrameState


class MapEffect(CatalogueEffect):
    """A delay of each cell of the image; a pixel may lie in several cells (its row, its column).

    The values have independent priors around zero. The diagnosis estimates them from the mean
    residual of each cell instead of fitting columns.
    """

    shape_type: ClassVar[type[Options]]
    form_error = 0.0  # A map holds every pattern of its kind.

    @classmethod
    @abstractmethod
    def num_cells(cls, shape: Any) -> int:  # noqa: ANN401 - each its own shape
        """Return the number of values."""

    @classmethod
    @abstractmethod
    def cells(cls, shape: Any, rows: Tensor, columns: Tensor) -> Tensor:  # noqa: ANN401
        """Return the cells that pixels (M,) lie in, shape (M, G), int64."""

    @abstractmethod
    def listed(self, decimals: int) -> dict[str, Any]:
        """Return name, shape and values as lists, metres rounded to so many decimals."""

    def to_mapping(self) -> dict[str, Any]:
        """Return an entry of a simulator's YAML, values rounded to 1 um."""
        return self.listed(decimals=6)

    @classmethod
    def terms(cls, shape: Options) -> tuple[Coefficient, ...]:
        """Return one coefficient per cell; 10 mm is the size that Kahlmann et al. (2006) report."""
        return _cell_terms(cls.num_cells(shape))

    def cells_of(self, inputs: EffectInputs) -> Tensor:
        """Return the cells of the chosen pixels, shape (M, G), int64."""
        width = inputs.camera.width
        row = torch.div(inputs.pixel, width, rounding_mode="floor")
        return self.cells(self.shape, row, torch.remainder(inputs.pixel, width))

    def cells_of_image(self, height: int, width: int) -> Tensor:
        """Return the cells of all pixels of an image, shape (H W, G), int64."""
        pixel = torch.arange(height * width)
        row = torch.div(pixel, width, rounding_mode="floor")
        return self.cells(self.shape, row, torch.remainder(pixel, width))

    def shift(self, inputs: EffectInputs, coefficients: Tensor) -> Tensor:
        """Return the sum of the values of a pixel's cells, shape (M,), metres."""
        return coefficients[self.cells_of(inputs)].sum(-1)

    def columns(self, inputs: EffectInputs) -> Tensor:
        """Return how often each pixel lies in each cell, shape (M, number of cells): large."""
        cells = self.cells_of(inputs)
        one_hot = torch.zeros(len(cells), self.num_cells(self.shape), dtype=torch.float64)
        return one_hot.scatter_add_(1, cells, torch.ones_like(cells, dtype=torch.float64))

    def on_delay(self, state: FrameState) -> None:
        """Delay every pixel by its values."""
        height, width = state.radial_distance.shape
        cells = self.cells_of_image(height, width)
        state.delay = state.delay + self.coefficients[cells].sum(-1).reshape(height, width)


def drawn_values(count: int, rms: float, seed: int) -> Tensor:
    """Draw `count` normal values (metres) with standard deviation `rms` from their own seed."""
    generator = torch.Generator().manual_seed(seed)
    return rms * torch.randn(count, generator=generator, dtype=torch.float64)


@lru_cache(maxsize=4)
def _cell_terms(count: int) -> tuple[Coefficient, ...]:
    """Return the coefficients of so many cells; a map is built many times, of thousands of them."""
    return tuple(Coefficient(f"cell_{number}", "m", 0.01) for number in range(count))
