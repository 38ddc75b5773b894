"""The one pass over the pixels: turns batches of images into their moments."""

import math
import threading
from collections.abc import Iterator
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tofcorr.estimation.design import Design, PairTable
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
    in memory already allocated: new memory pages cost more time than the arithmetic. Several
    threads may call it at once. All is float64: the residual is a thousandth of the distance, so
    that a loss, a difference of moments, keeps six digits less than they have.

    Args:
        design: The columns.
        device: Where to compute.
    """

    def __init__(self, design: Design, device: str = "cpu") -> None:
        self.design = design
        height = len(design.ray_directions)
        self._reduction = ColumnReduction(
            lambda rows: _static_products(design, rows), height, device
        )
        self._gather_signal, self._gather_static = (
            index.to(device) for index in _gather_indices(design)
        )
        self._runs = list(_runs(design.signal_pairs))
        self._num_products = len(design.signal_pairs.left)
        self._device = device
        self._of_thread = threading.local()
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
        distance, valid = batch.radial_distance[frames, rows], batch.valid[frames, rows]
        amplitude = distance if batch.amplitude is None else batch.amplitude[frames, rows]
        whole = bool(valid.all())
        if not whole:
            # Pixels of no weight may hold NaN, which zero times would not remove.
            distance = torch.where(valid, distance, 1.0)
            amplitude = torch.where(valid, amplitude, 1.0)
        functions = self.design.signal_functions(distance, amplitude)
        if not whole:
            functions *= valid
        weighted = functions
        if weights is not None:
            weighted = functions * torch.where(valid, weights[frames, rows], 0.0)
        products = self._room(len(distance), *distance.shape[1:])
        for run in self._runs:
            out = products[:, run.first : run.first + run.length].transpose(0, 1)
            right = weighted[run.right : run.right + run.length]
            torch.mul(right, functions[run.left], out=out)
        return products

    def _room(self, *shape: int) -> Float[Tensor, "F P h W"]:
        """Return memory for products, the same at every call: new pages take longer to get."""
        size = self._num_products * math.prod(shape)
        memory: Tensor | None = getattr(self._of_thread, "memory", None)
        if memory is None or len(memory) < size:
            memory = torch.empty(size, dtype=torch.float64, device=self._device)
            self._of_thread.memory = memory
        frames, *rest = shape
        return memory[:size].reshape(frames, self._num_products, *rest)


class _Run(NamedTuple):
    """Products `first` and after of one function, `left`, with `length` ones from `right` on."""

    first: int
    length: int
    left: int
    right: int


def _runs(pairs: PairTable) -> Iterator[_Run]:
    """Yield the distinct products in groups that one multiplication can form."""
    run: _Run | None = None
    for k, (a, b) in enumerate(zip(pairs.left.tolist(), pairs.right.tolist(), strict=True)):
        if run is not None and (a, b) == (run.left, run.right + run.length):
            run = run._replace(length=run.length + 1)
            continue
        if run is not None:
            yield run
        run = _Run(first=k, length=1, left=a, right=b)
    if run is not None:
        yield run


def _static_products(design: Design, rows: Tensor | slice) -> Iterator[Float[Tensor, "10 h W"]]:
    """Yield, for each pair of pixel functions, its product with the ten ray products.

    Those are xx, xy, xz, yy, yz, zz, x, y, z and 1; each yield has shape (10, h, W), for h rows.
    """
    x, y, z = design.ray_directions[rows].unbind(-1)
    functions = design.pixel_functions[:, rows]
    rays = torch.stack([x * x, x * y, x * z, y * y, y * z, z * z, x, y, z, torch.ones_like(x)])
    for a, b in zip(design.pixel_pairs.left, design.pixel_pairs.right, strict=True):
        yield functions[a] * functions[b] * rays


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
