"""Sums over pixels of frame images times static images, fast where the static ones are smooth.

Rays and polynomials of the pixel are smooth along an image row and along a column, so a few
orthogonal polynomials represent them to rounding. Frame images are first projected onto those of
each segment of a row, which shrinks W numbers to a few dozen, then onto those of the columns; the
static images then need only as many. Where the static images are not smooth, an image stays as it
is and nothing is lost but speed.
"""

from collections.abc import Callable, Iterable, Iterator
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.polynomial.chebyshev import chebvander
from torch import Tensor

# Numbers of polynomials that are tried. Multiples of 8, which processors multiply quickly: on
# AVX-512, 24 columns take two thirds of the time of 21.
_POLYNOMIALS = (8, 16, 24, 32, 40, 48)
# Relative error at which a projection counts as exact. It bounds the relative error of a moment,
# and lies well below what the solvers resolve (1e-12). Set by hand.
_EXACT = 1e-13
# What the projection along the columns costs for each number that a pixel's row is projected to,
# in multiplications of the projection along rows; about 24 polynomials at half the speed. Set by
# timing: it decides how many segments a row is cut into.
_COST_OF_NUMBER = 48
# Segments of a row that are tried, at most. Set by hand: more cost more than they save.
_MOST_SEGMENTS = 20
# Rows, evenly spread, on which polynomials are tried before all rows are checked. Set by hand.
_ROWS_TRIED = 9
# Random sums of all static images that are checked in their place. Derived: an image that leaves
# over ten times `_EXACT` stays hidden if four normal numbers are all below a tenth, which happens
# once in 25,000 designs; one that leaves over more stays hidden more rarely.
_MIXTURES = 4
# Pixels of a static image worked on at once: ten such images stay in the cache. Set by hand.
_SLAB_PIXELS = 10_240
# Numbers of an image that no static image has more of than this share are left out of the sums.
# Derived: a thousand of them change a sum by less than `_EXACT`, relative to the images' norms.
_NEGLIGIBLE = 1e-15


StaticImages = Callable[[Tensor | slice], Iterable[Float[Tensor, "G h W"]]]
"""Yields rows of all static images, group by group."""


class PixelReduction:
    """Sums products of frame images with fixed static images.

    Args:
        static: Takes numbers of rows (h,), or a slice of them, and yields these rows of the static
            images anew at each call, in groups of shape (G, h, W), float64.
        height: Rows of an image, H.
        device: Where the sums are formed.

    Attributes:
        size: To how many numbers an image is reduced; H W if it is not.
        num_static: How many static images there are, S.
    """

    def __init__(self, static: StaticImages, height: int, device: str = "cpu") -> None:
        along_row, projected = _along_rows(static, height)
        along_column, projected = _along_columns(projected)
        self._along_row = None if along_row is None else along_row.to(device)
        self._along_column = None if along_column is None else along_column.T.to(device)
        self._reduced_height = projected.shape[1]
        self._row_size = projected.shape[2]
        static_numbers = projected.flatten(1)
        share = static_numbers.abs() / static_numbers.norm(dim=1, keepdim=True).clamp(min=1e-300)
        kept = (share.amax(0) > _NEGLIGIBLE).nonzero()[:, 0]
        self._kept = None if len(kept) == len(share.T) else kept.to(device)
        self._static = static_numbers[:, kept].T.contiguous().to(device)
        self.size, self.num_static = self._static.shape

    def reduced(self, blocks: Iterable[Float[Tensor, "*B _ W"]]) -> Float[Tensor, "N k n"]:
        """Return the reduction of images, given as blocks of rows, one after the other.

        Args:
            blocks: Contiguous in memory; the next one may overwrite the last.
        """
        row, whole = 0, None
        for images in blocks:
            rows = slice(row, row + images.shape[-2])
            row = rows.stop
            projected = self._along_rows_of(images)
            if self._along_column is not None:
                part = _products(self._along_column[:, rows], projected)
                whole = part if whole is None else whole.add_(part)
            else:
                if whole is None:
                    whole = projected.new_empty(
                        len(projected), self._reduced_height, self._row_size
                    )
                whole[:, rows] = projected
        assert whole is not None
        return whole

    def _along_rows_of(self, images: Float[Tensor, "*N h W"]) -> Float[Tensor, "N h n"]:
        height, count = images.shape[-2], images.shape[:-2].numel()
        if self._along_row is not None:
            images = _products(images.reshape(count, -1, len(self._along_row)), self._along_row)
        return images.reshape(count, height, self._row_size)

    def sums(
        self, reduced: Float[Tensor, "N k n"], number: int | None = None
    ) -> Float[Tensor, "N S"]:
        """Return sum_v images[n, v] static[s, v], shape (N, S), of reduced images.

        Args:
            reduced: The images.
            number: How many static images, S, the first ones; None: all.
        """
        numbers = reduced.flatten(1)
        if self._kept is not None:
            numbers = _chosen(numbers, self._kept)
        return numbers @ self._static[:, :number]

    def __call__(self, images: Float[Tensor, "*N H W"]) -> Float[Tensor, "N S"]:
        """Return sum_v images[n, v] static[s, v], shape (N, S), of images (..., H, W)."""
        return self.sums(self.reduced([images]))


def _products(left: Tensor, right: Tensor) -> Float[Tensor, "N a c"]:
    """Return the products of matrices (N, a, b) and (b, c), or (a, b) and (N, b, c).

    On a CPU by NumPy: torch's library, Intel's, takes twice the time for thin matrices on an AMD
    processor. One product an image is small enough for NumPy's library to compute it in the
    caller's thread; threads of its own would wait for those of torch.
    """
    if left.is_cuda:
        return left @ right
    return torch.from_numpy(np.matmul(left.numpy(), right.numpy()))


def _chosen(numbers: Float[Tensor, "N k"], kept: Int[Tensor, "n"]) -> Float[Tensor, "N n"]:
    """Return some of the columns; on a CPU by NumPy, which takes less than half of torch's time."""
    if numbers.is_cuda:
        return numbers[:, kept]
    return torch.from_numpy(np.take(numbers.numpy(), kept.numpy(), axis=1))


def _along_rows(
    static: StaticImages, height: int
) -> tuple[Float[Tensor, "w n"] | None, Float[Tensor, "S H m"]]:
    """Return polynomials of a segment of a row, or None, and all static images projected."""
    some = torch.linspace(0, height - 1, min(height, _ROWS_TRIED)).long()
    tried = torch.cat(list(static(some)))
    factors = _factors(tried)
    mixed = torch.tensordot(factors, tried, dims=1)
    for basis in _row_bases(tried.shape[-1]):
        if _spans(basis, mixed):
            projected = _projected(static, (height, tried.shape[-1]), basis, factors)
            if projected is not None:
                return basis, projected
    return None, torch.cat(list(static(slice(None))))


def _along_columns(
    images: Float[Tensor, "S H m"],
) -> tuple[Float[Tensor, "H n"] | None, Float[Tensor, "S k m"]]:
    """Return polynomials of an image column, or None, and images projected onto them."""
    height = images.shape[1]
    mixed = torch.tensordot(_factors(images), images, dims=1).transpose(1, 2)
    for number in _POLYNOMIALS:
        if 2 * number > height:
            break
        basis = _polynomials(height, number)
        left_over = _left_over(basis, mixed)
        # What a mixture leaves over may be the roundings of all images together.
        if left_over <= _EXACT or (left_over <= 10 * _EXACT and _spans_each(basis, images)):
            return basis, _products(basis.T, images)
    return None, images


def _spans_each(basis: Float[Tensor, "H n"], images: Float[Tensor, "S H m"]) -> bool:
    """Whether polynomials along columns span each of some images."""
    left_over = images - _products(basis, _products(basis.T, images))
    return bool((left_over.abs().amax((1, 2)) <= _EXACT * images.abs().amax((1, 2))).all())


def _row_bases(width: int) -> Iterator[Float[Tensor, "w n"]]:
    """Yield polynomials of segments of a row, those first that cost the least."""
    found = [
        (number + _COST_OF_NUMBER * segments * number / width, width // segments, number)
        for segments in range(1, _MOST_SEGMENTS + 1)
        for number in _POLYNOMIALS
        if width % segments == 0 and 2 * number <= width // segments
    ]
    for _, length, number in sorted(found):
        yield _polynomials(length, number)


@lru_cache(maxsize=64)
def _polynomials(length: int, number: int) -> Float[Tensor, "l n"]:
    """Return orthonormal polynomials on so many evenly spread points; shared, not to be written."""
    grid = torch.linspace(-1, 1, length, dtype=torch.float64)
    return torch.linalg.qr(torch.as_tensor(chebvander(grid.numpy(), number - 1))).Q


def _projected(
    static: StaticImages,
    shape: tuple[int, int],
    basis: Float[Tensor, "w n"],
    factors: Float[Tensor, "M S"],
) -> Float[Tensor, "S H m"] | None:
    """Return all static images on the basis of each segment of a row; None: not spanned."""
    height, width = shape
    step = max(1, _SLAB_PIXELS // width)
    slabs: list[Tensor] = []
    for row in range(0, height, step):
        numbers: list[Tensor] = []
        mixed = factors.new_zeros(len(factors), min(step, height - row) * width)
        first = 0
        for group in static(slice(row, row + step)):
            segments = group.reshape(len(group), -1, len(basis))
            numbers.append(_products(segments, basis).view(*group.shape[:2], -1))
            mixed.addmm_(factors[:, first : first + len(group)], group.flatten(1))
            first += len(group)
        if not _spans(basis, mixed):
            return None
        slabs.append(torch.cat(numbers))
    return torch.cat(slabs, dim=1)


def _factors(images: Float[Tensor, "S H W"]) -> Float[Tensor, "M S"]:
    """Return the factors of images in random sums of them, each image scaled to at most 1."""
    size = images.abs().amax((1, 2))
    size = torch.where(size > 0, size, size.max().clamp(min=1e-300))
    # No result depends on the seed.
    generator = torch.Generator().manual_seed(0)
    return torch.randn(_MIXTURES, len(images), generator=generator, dtype=size.dtype) / size


def _spans(basis: Float[Tensor, "w n"], mixed: Float[Tensor, "*M W"]) -> bool:
    """Whether the basis spans all images, of which `mixed` are random sums."""
    return _left_over(basis, mixed) <= _EXACT


def _left_over(basis: Float[Tensor, "w n"], mixed: Float[Tensor, "*M W"]) -> float:
    """Return the largest number that the basis leaves of images."""
    segments = mixed.reshape(-1, len(basis))
    return float(torch.addmm(segments, segments @ basis, basis.T, alpha=-1).abs().max())
