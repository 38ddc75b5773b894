"""The one pass over the pixels: turns batches of images into their moments."""

import math
from collections.abc import Iterator, Sequence

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from tofcorr.estimation.design import Design
from tofcorr.estimation.few_pixels import moments_of_few
from tofcorr.estimation.images import Images
from tofcorr.estimation.moments import ImageMoments
from tofcorr.estimation.products import SignalProducts
from tofcorr.estimation.reduction import PixelReduction

# Pixels that a caller reads at once: a few megabytes. Set by timing on VGA recordings.
CHUNK_PIXELS = 131_072
# Pixels whose products are formed at once: on a CPU they stay in its cache, on a GPU they fill it.
# Set by timing.
_BLOCK_PIXELS = 20_480
_BLOCK_PIXELS_CUDA = 4_194_304
# Share of used pixels below which a pass over those alone is quicker. Set by timing.
_FEW = 0.1


class MomentAccumulator:
    """Turns batches of images into moments; holds what does not change from image to image.

    Works through small blocks of pixels, so that their products stay in the processor's cache and
    in memory already allocated: new memory pages cost more time than the arithmetic. Several
    threads may call it at once. Images may be float32. All that follows is float64: the residual is
    a thousandth of the distance, so that a loss, a difference of moments, keeps six digits less
    than they have.

    Args:
        design: The columns.
        device: Where to compute.
    """

    def __init__(self, design: Design, device: str = "cpu") -> None:
        self.design = design
        height = len(design.ray_directions)
        self._reduction = PixelReduction(
            lambda rows: _static_products(design, rows), height, device
        )
        self._products = SignalProducts(design, device)
        self._gather = _gather_index(design, self._products, self._reduction.num_static).to(device)
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
        count = batch.valid.count_nonzero((1, 2))
        used = [int(part.sum()) for part in count.split(step)]
        grams = [
            self._gram(batch, weights, slice(step * k, step * (k + 1)), pixels)
            for k, pixels in enumerate(used)
        ]
        moments = ImageMoments(
            torch.cat(grams),
            batch.normal_tool,
            batch.offset_tool,
            count.to(torch.float64),
            self.design.symbols,
        )
        return moments.to("cpu")

    def _gram(
        self, batch: Images, weights: Float[Tensor, "B H W"] | None, frames: slice, used: int
    ) -> Float[Tensor, "F S S"]:
        """Return the Gram matrices of some frames, shape (F, S, S), the quicker way.

        Args:
            batch: The images.
            weights: Of the pixels; None: 1 each.
            frames: Which of them.
            used: How many of their pixels are valid.
        """
        valid = batch.valid[frames]
        if valid.is_cuda or used > _FEW * valid.numel():
            return self._frames(batch, weights, frames, whole=used == valid.numel())
        numbers = range(len(batch.valid))[frames]
        return torch.stack([moments_of_few(self.design, batch, k, weights) for k in numbers])

    def _frames(
        self, batch: Images, weights: Float[Tensor, "B H W"] | None, frames: slice, *, whole: bool
    ) -> Float[Tensor, "F S S"]:
        """Return the Gram matrices of some frames, gathered from blocks of rows."""
        count, height, width = batch.valid[frames].shape
        step = max(1, self._block // (count * width))
        images = (batch.radial_distance, batch.amplitude, None if whole else batch.valid, weights)
        number = math.ceil(height / step)
        blocks = zip(*(_in_rows(image, frames, step, number) for image in images), strict=True)
        reduced = self._reduction.reduced(
            self._products(distance, distance if amplitude is None else amplitude, valid, weight)
            for distance, amplitude, valid, weight in blocks
        )
        functions, others = reduced.tensor_split([count * self._products.num_functions])
        sums = [
            self._reduction.sums(functions),
            self._reduction.sums(others, _NUM_RAY_PRODUCTS),
        ]
        by_frame = [part.unflatten(0, (-1, count)).transpose(0, 1).flatten(1) for part in sums]
        return self._products.with_distance(torch.cat(by_frame, dim=1)[:, self._gather])


def _in_rows(
    images: Shaped[Tensor, "B H W"] | None, frames: slice, step: int, number: int
) -> Sequence[Shaped[Tensor, "F h W"] | None]:
    """Return some frames in so many blocks of rows; without images None for each."""
    return [None] * number if images is None else images[frames].split(step, dim=1)


def _static_products(design: Design, rows: Tensor | slice) -> Iterator[Float[Tensor, "10 h W"]]:
    """Yield, for each pair of pixel functions, its product with the ten ray products.

    Those are xx, xy, xz, yy, yz, zz, x, y, z and 1; each yield has shape (10, h, W), for h rows.
    """
    x, y, z = design.ray_directions[rows].unbind(-1)
    functions = design.pixel_functions[:, rows]
    rays = torch.stack([x * x, x * y, x * z, y * y, y * z, z * z, x, y, z, torch.ones_like(x)])
    for a, b in zip(design.pixel_pairs.left, design.pixel_pairs.right, strict=True):
        yield functions[a] * functions[b] * rays


# Ray products of a pair of pixel functions. Derived: those of `_static_products`.
_NUM_RAY_PRODUCTS = 10
# Which ray product belongs to ray axes a and b; axis 3 stands for the constant column.
_RAY_PRODUCT = torch.tensor([[0, 1, 2, 6], [1, 3, 4, 7], [2, 4, 5, 8], [6, 7, 8, 9]])


def _gather_index(design: Design, products: SignalProducts, num_static: int) -> Int[Tensor, "S S"]:
    """Return, for each entry of the Gram matrix, which of a frame's sums it is.

    First come those of each function of the frame with every static image, then those of the other
    products, which only columns without a function of the pixel share, with the ray products.
    """
    columns = torch.arange(design.num_columns).repeat_interleave(3)
    axes = torch.arange(3).repeat(design.num_columns)
    signal = torch.cat([design.signal[columns], torch.zeros(1, dtype=torch.long)])
    pixel = torch.cat([design.pixel[columns], torch.zeros(1, dtype=torch.long)])
    axis = torch.cat([axes, torch.tensor([3])])
    product = products.index[signal[:, None], signal[None, :]]
    pixel_product = design.pixel_pairs.index[pixel[:, None], pixel[None, :]]
    static = pixel_product * _NUM_RAY_PRODUCTS + _RAY_PRODUCT[axis[:, None], axis[None, :]]
    others = product - products.num_functions
    of_others = products.num_functions * num_static + others * _NUM_RAY_PRODUCTS + static
    return torch.where(others < 0, product * num_static + static, of_others)
