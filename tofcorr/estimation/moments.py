r"""Per-image moments of the point-to-plane residual, from one pass over the pixels.

Image i holds the Gram matrix :math:`G_i = \sum_v w_v\, q_v q_v^T` of its pixels' columns

.. math:: q_v = (D, f_1 s_1, \dots, f_K s_K) \otimes (x, y, z), \; 1

so that for coefficients :math:`b = (1, -\beta)`, rotation R, translation t, and the target plane
(m, e) in the tool frame, the squared residuals of the image sum to :math:`p_i^T G_i p_i` with
:math:`p_i = (b \otimes R^T m_i, \; m_i \cdot t + e_i)`.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tofcorr.data.frames import FrameBatch, iterate_frames
from tofcorr.data.recording import Recording
from tofcorr.estimation.design import Design
from tofcorr.estimation.few_pixels import moments_of_few
from tofcorr.estimation.reduction import ColumnReduction

Weighting = Callable[[FrameBatch], Tensor]
"""Gives the weights of a batch's pixels, shape (B, H, W), in 1/m^2 or without unit."""

# Pixels read at once.
CHUNK_PIXELS = 131_072
# Pixels whose products are formed at once.
_BLOCK_PIXELS = 16_384
_BLOCK_PIXELS_CUDA = 4_194_304
# With a smaller share of used pixels, going through those alone is quicker.
_FEW = 0.1


@dataclass(frozen=True)
class ImageMoments:
    """The moments of each image, and the plane it looked at.

    Attributes:
        gram: Moment matrices, shape (N, 3C + 1, 3C + 1); entry 3j + a belongs to column j and ray
            axis a, the last to the constant 1.
        normal_tool: The target's unit normal in the tool frame, shape (N, 3).
        offset_tool: The target's offset in the tool frame, shape (N,), metres.
        count: Pixels used, shape (N,).
        symbols: The names of the coefficients, C - 1 of them.
    """

    gram: Tensor
    normal_tool: Tensor
    offset_tool: Tensor
    count: Tensor
    symbols: list[str]

    @property
    def num_images(self) -> int:
        """Images held."""
        return len(self.gram)

    @property
    def num_coefficients(self) -> int:
        """Coefficients of the error model."""
        return len(self.symbols)

    def images(self, chosen: Tensor | Sequence[int]) -> "ImageMoments":
        """Return the moments of some images, by index or by mask (N,)."""
        pick = torch.as_tensor(chosen, device=self.gram.device)
        return replace(
            self,
            gram=self.gram[pick],
            normal_tool=self.normal_tool[pick],
            offset_tool=self.offset_tool[pick],
            count=self.count[pick],
        )

    def weighted(self, weights: Tensor) -> "ImageMoments":
        """Return the moments with each image counted `weights` (N,) times, as a bootstrap does."""
        return replace(self, gram=self.gram * weights[:, None, None], count=self.count * weights)

    def columns(self, symbols: Sequence[str]) -> "ImageMoments":
        """Return the moments of the model that has only the coefficients named."""
        chosen = [0, *(1 + self.symbols.index(symbol) for symbol in symbols)]
        entries = [3 * j + a for j in chosen for a in range(3)] + [self.gram.shape[-1] - 1]
        pick = torch.tensor(entries, device=self.gram.device)
        gram = self.gram[:, pick[:, None], pick[None, :]]
        return replace(self, gram=gram, symbols=list(symbols))

    def with_conditions(self, functions: Tensor, symbols: Sequence[str]) -> "ImageMoments":
        """Return the moments with further columns that are the same for all pixels of an image.

        Such a column is the constant's times a number an image, so it needs no pass over pixels.

        Args:
            functions: The number of each image and column, shape (N, K).
            symbols: The columns' names.
        """
        size = self.gram.shape[-1]
        constant = 3 * (1 + self.symbols.index("c0"))
        spread = self.gram.new_zeros(self.num_images, size + 3 * len(symbols), size)
        spread[:, : size - 1, : size - 1] = torch.eye(size - 1, dtype=spread.dtype)
        spread[:, -1, -1] = 1.0
        for k in range(len(symbols)):
            for axis in range(3):
                row = size - 1 + 3 * k + axis
                spread[:, row, constant + axis] = functions[:, k].to(spread)
        gram = spread @ self.gram @ spread.transpose(1, 2)
        return replace(self, gram=gram, symbols=[*self.symbols, *symbols])

    def to(self, device: torch.device | str) -> "ImageMoments":
        """Return the moments on a device."""
        return replace(
            self,
            gram=self.gram.to(device),
            normal_tool=self.normal_tool.to(device),
            offset_tool=self.offset_tool.to(device),
            count=self.count.to(device),
        )


def concatenate(parts: Sequence[ImageMoments]) -> ImageMoments:
    """Join the moments of several passes over the same design.

    Raises:
        ValueError: There is nothing to join, or the designs differ.
    """
    if not parts:
        raise ValueError("There are no moments to join: no frame was read.")
    if any(part.symbols != parts[0].symbols for part in parts):
        raise ValueError("Moments of different error models cannot be joined.")
    return ImageMoments(
        torch.cat([part.gram for part in parts]),
        torch.cat([part.normal_tool for part in parts]),
        torch.cat([part.offset_tool for part in parts]),
        torch.cat([part.count for part in parts]),
        parts[0].symbols,
    )


def stack(parts: Iterable[ImageMoments], num_images: int) -> ImageMoments:
    """Join the moments of successive batches of one pass, `num_images` in all.

    Each is copied into memory set aside beforehand. Kept as they come, small results would settle
    between the large temporary arrays, and the heap would grow by a batch with every batch.

    Raises:
        ValueError: There is nothing to join.
    """
    whole: ImageMoments | None = None
    filled = 0
    for part in parts:
        if whole is None:
            whole = _room_for(part, num_images)
        places = slice(filled, filled + part.num_images)
        for name in _PER_IMAGE:
            getattr(whole, name)[places] = getattr(part, name)
        filled += part.num_images
    if whole is None:
        raise ValueError("There are no moments to join: no frame was read.")
    return whole


_PER_IMAGE = ("gram", "normal_tool", "offset_tool", "count")


def _room_for(part: ImageMoments, num_images: int) -> ImageMoments:
    room = {
        n: getattr(part, n).new_empty(num_images, *getattr(part, n).shape[1:]) for n in _PER_IMAGE
    }
    return replace(part, **room)


def recording_moments(
    recording: Recording,
    design: Design,
    indices: Sequence[int] | None = None,
    *,
    weighting: Weighting | None = None,
    device: str = "cpu",
) -> ImageMoments:
    """Read a recording once, in chunks, and return the moments of its images.

    Args:
        recording: The memory-mapped recording.
        design: The columns.
        indices: The frames to read, in this order; all of them if None.
        weighting: Weights of the pixels; 1 each if None.
        device: Where to compute; the moments are returned on the CPU.
    """
    accumulator = MomentAccumulator(design, device)
    parts = (
        accumulator(batch, weighting(batch) if weighting else None)
        for batch in iterate_frames(recording, indices, chunk_pixels=CHUNK_PIXELS, device=device)
    )
    return stack(parts, recording.num_frames if indices is None else len(indices))


class MomentAccumulator:
    """Turns batches of frames into moments; holds what does not change from frame to frame.

    Works through small blocks of pixels, whose products stay in the processor's cache and in
    memory that is already there: fresh pages cost more than the arithmetic.

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

    def __call__(self, batch: FrameBatch, weights: Tensor | None = None) -> ImageMoments:
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

    def _gram(self, batch: FrameBatch, weights: Tensor | None, frames: slice) -> Tensor:
        """Return the Gram matrices of some frames, shape (F, S, S), the quicker way."""
        valid = batch.valid[frames]
        if valid.is_cuda or int(valid.sum()) > _FEW * valid.numel():
            return self._frames(batch, weights, frames)
        numbers = range(len(batch.valid))[frames]
        return torch.stack([moments_of_few(self.design, batch, k, weights) for k in numbers])

    def _frames(self, batch: FrameBatch, weights: Tensor | None, frames: slice) -> Tensor:
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
        self, batch: FrameBatch, weights: Tensor | None, frames: slice, rows: slice
    ) -> Tensor:
        """Return w f_a f_b for the distinct pairs, shape (B, P, h, W); zero where not valid."""
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


def _static_products(design: Design) -> Iterator[Tensor]:
    """Yield, for each pair of pixel functions, its product with the ten ray products.

    Those are xx, xy, xz, yy, yz, zz, x, y, z and 1; each yield has shape (10, H, W).
    """
    x, y, z = design.ray_directions.unbind(-1)
    rays = torch.stack([x * x, x * y, x * z, y * y, y * z, z * z, x, y, z, torch.ones_like(x)])
    for a, b in zip(design.pixel_pairs.left, design.pixel_pairs.right, strict=True):
        yield design.pixel_functions[a] * design.pixel_functions[b] * rays


# Which ray product belongs to ray axes a and b; axis 3 stands for the constant column.
_RAY_PRODUCT = torch.tensor([[0, 1, 2, 6], [1, 3, 4, 7], [2, 4, 5, 8], [6, 7, 8, 9]])


def _gather_indices(design: Design) -> tuple[Tensor, Tensor]:
    """Return, for each entry of the Gram matrix, its signal product and its static product."""
    columns = torch.arange(design.num_columns).repeat_interleave(3)
    axes = torch.arange(3).repeat(design.num_columns)
    signal = torch.cat([design.signal[columns], torch.zeros(1, dtype=torch.long)])
    pixel = torch.cat([design.pixel[columns], torch.zeros(1, dtype=torch.long)])
    axis = torch.cat([axes, torch.tensor([3])])
    signal_product = design.signal_pairs.index[signal[:, None], signal[None, :]]
    pixel_product = design.pixel_pairs.index[pixel[:, None], pixel[None, :]]
    return signal_product, pixel_product * 10 + _RAY_PRODUCT[axis[:, None], axis[None, :]]
