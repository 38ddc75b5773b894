"""The one pass over the pixels: turns batches of images into their moments."""

from collections.abc import Iterator

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tofcorr.estimation.design import Design
from tofcorr.estimation.few_pixels import moments_of_few
from tofcorr.estimation.images import Images
from tofcorr.estimation.moments import ImageMoments
from tofcorr.estimation.reduction import ColumnReduction

# Pixels that a caller reads at once: a few megabytes. Set by timing on VGA recordings.
CHUNK_PIXELS = 131_072
# Pixels whose products are formed at once: on a CPU they stay in its cache, on a GPU they fill it.
# Set by timing.
_BLOCK_PIXELS = 16_384
_BLOCK_PIXELS_CUDA = 4_194_304
# Share of used pixels below which a pass over those alone is quicker. Set by timing.
_FEW = 0.1


class MomentAccumulator:
    """Turns batches of images into moments; holds what does not change from image to image.

    Works through small blocks of pixels, so that their products stay in the processor's cache and
    in memory already allocated: new memory pages cost more time than the arithmetic.

    Args:
        design: The columns.
        device: Where to compute.
    """

    def __init__(self, design: Design, device: str = "cpu") -> None:
        self.design = design
        self._reduction = ColumnReduction(lambda: _static_products(design), device)
        self._gather_signal, self._gather_static = (
            index.to(device) for index in _gather_indices(design)
        )
        self._left = design.signal_pairs.left.tolist()
        self._right = design.signal_pairs.right.tolist()
        self._block = _BLOCK_PIXELS_CUDA if device.startswith("cuda") else _BLOCK_PIXELS

    def __call__(
        self, batch: Images, weights: Float[Tensor, "B H W"] | None = None
    ) -> ImageMoments:
        """Return the moments of one batch, on the CPU.

        Args:
            batch: Frames on the accumulator's device.
            weights: Weights of the pixels, shape (B, H, W); 1 each if None.
        """
        size = batch.valid[0].numel()
        step = max(1, self._block // size)
        grams = [
            self._gram(batch, weights, slice(first, first + step))
            for first in range(0, len(batch.valid), step)
        ]
        count = batch.valid.sum(dim=(1, 2)).to(torch.float64)
        moments = ImageMoments(
            torch.cat(grams), batch.normal_tool, batch.offset_tool, count, self.design.symbols
        )
        return moments.to("cpu")

    def _gram(
        self, batch: Images, weights: Float[Tensor, "B H W"] | None, frames: slice
    ) -> Float[Tensor, "F S S"]:
        """Return the Gram matrices of some frames, shape (F, S, S), the quicker way."""
        valid = batch.valid[frames]
        if valid.is_cuda or int(valid.sum()) > _FEW * valid.numel():
            return self._frames(batch, weights, frames)
        numbers = range(len(batch.valid))[frames]
        return torch.stack([moments_of_few(self.design, batch, k, weights) for k in numbers])

    def _frames(
        self, batch: Images, weights: Float[Tensor, "B H W"] | None, frames: slice
    ) -> Float[Tensor, "F S S"]:
        """Return the Gram matrices of some frames, gathered from blocks of rows."""
        valid = batch.valid[frames]
        height, width = valid.shape[1:]
        step = max(1, self._block // (len(valid) * width))
        projected = [
            self._reduction.project(self._products(batch, weights, frames, slice(row, row + step)))
            for row in range(0, height, step)
        ]
        sums = self._reduction.sums(torch.cat(projected, dim=2))
        return sums[:, self._gather_signal, self._gather_static]

    def _products(
        self, batch: Images, weights: Float[Tensor, "B H W"] | None, frames: slice, rows: slice
    ) -> Float[Tensor, "F P h W"]:
        """Return w f_a f_b for the distinct pairs, shape (F, P, h, W); zero where not valid."""
        valid = batch.valid[frames, rows]
        weight = valid.to(torch.float64)
        if weights is not None:
            weight = torch.where(valid, weights[frames, rows], 0.0)
        # Pixels of no weight may hold NaN, which zero times would not remove.
        distance = torch.where(valid, batch.radial_distance[frames, rows], 1.0)
        amplitude = distance
        if batch.amplitude is not None:
            amplitude = torch.where(valid, batch.amplitude[frames, rows], 1.0)
        functions = self.design.signal_functions(distance, amplitude)
        weighted = functions * weight
        shape = (len(weight), len(self._left), *weight.shape[1:])
        products = torch.empty(shape, dtype=weight.dtype, device=weight.device)
        for k, (a, b) in enumerate(zip(self._left, self._right, strict=True)):
            torch.mul(functions[a], weighted[b], out=products[:, k])
        return products


def _static_products(design: Design) -> Iterator[Float[Tensor, "10 H W"]]:
    """Yield, for each pair of pixel functions, its product with the ten ray products.

    Those are xx, xy, xz, yy, yz, zz, x, y, z and 1; each yield has shape (10, H, W).
    """
    x, y, z = design.ray_directions.unbind(-1)
    rays = torch.stack([x * x, x * y, x * z, y * y, y * z, z * z, x, y, z, torch.ones_like(x)])
    for a, b in zip(design.pixel_pairs.left, design.pixel_pairs.right, strict=True):
        yield design.pixel_functions[a] * design.pixel_functions[b] * rays


# Which ray product belongs to ray axes a and b; axis 3 stands for the constant column.
_RAY_PRODUCT = torch.tensor([[0, 1, 2, 6], [1, 3, 4, 7], [2, 4, 5, 8], [6, 7, 8, 9]])


def _gather_indices(design: Design) -> tuple[Int[Tensor, "S S"], Int[Tensor, "S S"]]:
    """Return, for each entry of the Gram matrix, its signal product and its static product."""
    columns = torch.arange(design.num_columns).repeat_interleave(3)
    axes = torch.arange(3).repeat(design.num_columns)
    signal = torch.cat([design.signal[columns], torch.zeros(1, dtype=torch.long)])
    pixel = torch.cat([design.pixel[columns], torch.zeros(1, dtype=torch.long)])
    axis = torch.cat([axes, torch.tensor([3])])
    signal_product = design.signal_pairs.index[signal[:, None], signal[None, :]]
    pixel_product = design.pixel_pairs.index[pixel[:, None], pixel[None, :]]
    return signal_product, pixel_product * 10 + _RAY_PRODUCT[axis[:, None], axis[None, :]]
