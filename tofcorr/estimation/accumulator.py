r"""The one pass over the pixels: turns batches of images into their moments.

Every column of the error model is a signal function f(D, I) times a pixel function s(r, c), one
of them 1. With the viewing ray (x, y, z) the residual of a pixel is a combination of

.. math:: \{x, y, z\} \times \{D, f_k s_k\}, \; 1

and a moment sums, over the pixels of an image, the product of two signal functions of the frame
with a static image: a product of pixel functions and rays. Rays and polynomials of the pixel are
smooth along an image row and along a column, so a few orthogonal polynomials represent them to
rounding. Products of frames are first projected onto those of each segment of a row, which shrinks
W numbers to a few dozen, then onto those of the columns; the static images then need only as many.
Where these are not smooth, an image stays as it is and nothing is lost but speed.
"""

from collections.abc import Callable, Iterable, Iterator
from functools import lru_cache
from itertools import islice, pairwise
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.polynomial.chebyshev import chebvander
from torch import Tensor

from tofcorr.error_terms.base import Domain, SignalTerm
from tofcorr.error_terms.model import ErrorModel
from tofcorr.error_terms.signal_terms import SignalPolynomial
from tofcorr.estimation.moments import ImageMoments

# Random points at which products of functions are compared. Products whose randomly weighted sums
# over them agree to ten digits count as one function. Splines, which are zero on most points, need
# many. A wrong match could only merge products that differ by less than the rounding of their sums.
# Set by hand.
_PROBES = 2048


def distinct_products(values: Float[Tensor, "F probes"]) -> Int[Tensor, "F F"]:
    """Return which of the distinct products each product of two functions is, by their values.

    They are numbered as they appear, row by row: the functions' products with the first one first.
    """
    generator = torch.Generator().manual_seed(0)  # No result depends on the random points.
    random = torch.rand(values.shape[1], 2, generator=generator, dtype=values.dtype)
    fingerprints = torch.einsum("ap,bp,pk->abk", values, values, random).flatten(0, 1).tolist()
    number: dict[tuple[str, ...], int] = {}
    found = [number.setdefault(tuple(f"{x:.9e}" for x in one), len(number)) for one in fingerprints]
    return torch.tensor(found).view(len(values), len(values))


class Design:
    """The columns of one error model (or of the union of several) on one camera.

    Column 0 is the measured distance; the others follow `ErrorModel.coefficient_vector`: the
    constant, the signal terms, the pixel terms. Condition terms need no column of pixels: theirs is
    the constant's times a number a frame, see `ImageMoments.with_conditions`. `signal[k]` and
    `pixel[k]` say which signal function and which pixel function make up column k; function 0 is 1
    in both lists, and signal function 1 is the measured distance.

    Args:
        model: The error model; only its basis functions matter, not its coefficients.
        domain: The ranges that the model is scaled to.
        ray_directions: Unit viewing rays, shape (H, W, 3), float64.
    """

    def __init__(
        self, model: ErrorModel, domain: Domain, ray_directions: Float[Tensor, "H W 3"]
    ) -> None:
        self.signal_terms: list[SignalTerm] = list(model.signal_terms)  # type: ignore[arg-type]
        self.symbols = model.image_symbols()
        self.ray_directions = ray_directions
        height, width = ray_directions.shape[:2]
        rows = torch.arange(height).to(ray_directions)[:, None].expand(height, width)
        columns = torch.arange(width).to(ray_directions).expand(height, width)
        with torch.no_grad():
            bases = [term.basis(rows, columns) for term in model.pixel_terms]  # type: ignore[operator]
        self.pixel_functions = torch.cat([torch.ones_like(rows)[None], *bases])
        num_signal = sum(term.coefficients.numel() for term in self.signal_terms)
        num_pixel = len(self.pixel_functions) - 1
        self.signal = torch.tensor([1, 0, *range(2, 2 + num_signal), *[0] * num_pixel])
        self.pixel = torch.tensor([0, 0, *[0] * num_signal, *range(1, 1 + num_pixel)])
        probes = _probes(domain)
        self.signal_pairs = distinct_products(self.signal_functions(*probes))
        self.distance_as = self._affine(*probes)
        some = torch.linspace(0, self.pixel_functions[0].numel() - 1, _PROBES).long()
        self.pixel_pairs = distinct_products(self.pixel_functions.flatten(1)[:, some])

    @property
    def num_columns(self) -> int:
        """Columns without the ray: the distance and the coefficients."""
        return len(self.signal)

    def signal_functions(
        self, radial_distance: Float[Tensor, "*pixels"], amplitude: Float[Tensor, "*pixels"]
    ) -> Float[Tensor, "F *pixels"]:
        """Return 1, D and the signal terms' basis, shape (F, ...)."""
        with torch.no_grad():
            bases = [term.basis(radial_distance, amplitude) for term in self.signal_terms]
            ones = torch.ones_like(radial_distance)[None]
            return torch.cat([ones, radial_distance[None], *bases])

    def _affine(
        self, distance: Float[Tensor, "probes"], amplitude: Float[Tensor, "probes"]
    ) -> tuple[int, float, float] | None:
        """Return a signal function u and numbers c, h so that c + h u is the distance; or None."""
        number = 2
        for term in self.signal_terms:
            form = term.polynomial()
            if form is not None and form.variable == "distance":
                u = term.basis(distance, amplitude)[0].detach()
                if torch.allclose(form.centre + form.half_width * u, distance, rtol=1e-14):
                    return number, float(form.centre), float(form.half_width)
            number += len(term.symbols)
        return None


def _probes(domain: Domain) -> tuple[Float[Tensor, "probes"], Float[Tensor, "probes"]]:
    """Return random distances and amplitudes of the domain, always the same ones."""
    random = torch.rand(2, _PROBES, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    low, high = domain.radial_distance
    distance = low + (high - low) * random[0]
    if domain.amplitude is None:
        return distance, torch.ones_like(distance)
    low, high = domain.amplitude
    return distance, low + (high - low) * random[1]


CHUNK_PIXELS = 131_072
"""Pixels that a caller reads at once: a few megabytes. Set by timing on VGA recordings."""
# Pixels whose products are formed at once: on a CPU they stay in its cache, on a GPU they fill it.
# Set by timing.
_BLOCK_PIXELS, _BLOCK_PIXELS_CUDA = 20_480, 4_194_304
# Relative error at which a projection counts as exact. It bounds the relative error of a moment,
# and lies well below what the solvers resolve (1e-12). Set by hand.
_EXACT = 1e-13
# Numbers of polynomials that are tried. Multiples of 8, which processors multiply quickly: on
# AVX-512, 24 columns take two thirds of the time of 21.
_POLYNOMIALS = range(8, 49, 8)


StaticImages = Callable[[Tensor | slice], Iterable[Float[Tensor, "G h W"]]]
"""Yields rows of all static images, group by group."""


Images = Any
"""`tofcorr.data.recording.FrameBatch`, or what has its images, planes and valid pixels."""


class MomentAccumulator:
    """Turns batches of images into moments; holds what does not change from image to image.

    Works through small blocks of pixels, so that their products stay in the processor's cache.
    Several threads may call it at once. Images may be float32. All that follows is float64: the
    residual is a thousandth of the distance, so that a loss, a difference of moments, keeps six
    digits less than they have.

    Where a term holds an affine function of the distance, as every polynomial of it does, products
    with the distance are not formed: their sums are combinations of others.

    Args:
        design: The columns.
        device: Where to compute.

    Attributes:
        few_pixels: Share of used pixels below which a pass over those alone is quicker. Set by
            timing.
        formed: The pairs of signal functions whose products are formed.
    """

    few_pixels = 0.1

    def __init__(self, design: Design, device: str = "cpu") -> None:
        self.design, self._device = design, device
        height = len(design.ray_directions)
        self._reduction = PixelReduction(
            lambda rows: _static_products(design, rows), height, device
        )
        pairs = design.signal_pairs
        self._kept = [k for k in range(len(pairs)) if k != 1 or design.distance_as is None]
        # The functions themselves first: products with 1. Then one pair for each other product.
        place = {int(pairs[0, k]): n for n, k in enumerate(self._kept)}
        self.formed = [(0, n) for n in range(len(self._kept))]
        for a in range(1, len(self._kept)):
            for b in range(a, len(self._kept)):
                product = int(pairs[self._kept[a], self._kept[b]])
                if product not in place:
                    place[product] = len(self.formed)
                    self.formed.append((a, b))
        index = torch.tensor([[place.get(k, 0) for k in row] for row in pairs.tolist()])
        self._gather = self._gather_index(index).to(device)
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
        count = batch.valid.count_nonzero((1, 2))
        grams = []
        for frames in torch.arange(len(count)).split(max(1, self._block // size)):
            chosen, used = slice(int(frames[0]), int(frames[-1]) + 1), int(count[frames].sum())
            if batch.valid.is_cuda or used > self.few_pixels * size * len(frames):
                whole = used == size * len(frames)
                grams.append(self._frames(batch, weights, chosen, whole=whole))
            else:
                each = (moments_of_few(self.design, batch, int(k), weights) for k in frames)
                grams.append(torch.stack(list(each)))
        gram, number = torch.cat(grams), count.to(torch.float64)
        planes = batch.normal_tool, batch.offset_tool
        return ImageMoments(gram, *planes, number, self.design.symbols).to("cpu")

    def _frames(
        self, batch: Images, weights: Float[Tensor, "B H W"] | None, frames: slice, *, whole: bool
    ) -> Float[Tensor, "F S S"]:
        """Return the Gram matrices of some frames, gathered from blocks of rows.

        Args:
            batch: The images.
            weights: Of the pixels; None: 1 each.
            frames: Which of them.
            whole: Whether all of their pixels are valid.
        """
        count, height, width = batch.valid[frames].shape
        step = max(1, self._block // (count * width))

        valid = None if whole else batch.valid
        others = batch.amplitude, valid, weights
        # Each block is written over the last: it is in the cache.
        memory = torch.empty(
            len(self.formed) * count * step * width, dtype=torch.float64, device=self._device
        )

        def blocks() -> Iterator[Float[Tensor, "F B h W"]]:
            for row in range(0, height, step):
                at = frames, slice(row, row + step)
                rest = (one if one is None else one[at] for one in others)
                yield self._products(batch.radial_distance[at], *rest, memory=memory)

        reduced = self._reduction.reduced(blocks())
        functions, products = reduced.tensor_split([count * len(self._kept)])
        sums = self._reduction.sums(functions), self._reduction.sums(products, 10)
        by_frame = [part.unflatten(0, (-1, count)).transpose(0, 1).flatten(1) for part in sums]
        return self._with_distance(torch.cat(by_frame, dim=1)[:, self._gather])

    def _products(
        self,
        distance: Float[Tensor, "B h W"],
        amplitude: Float[Tensor, "B h W"] | None,
        valid: Bool[Tensor, "B h W"] | None,
        weights: Float[Tensor, "B h W"] | None,
        *,
        memory: Float[Tensor, "M"],
    ) -> Float[Tensor, "F B h W"]:
        """Return w f_a f_b of the products formed; zero where not valid.

        Args:
            distance: Radial distances, metres; any number where not valid.
            amplitude: The camera's units; any number where not valid; None: not recorded.
            valid: Which pixels are used; None: all.
            weights: Of the pixels; None: 1 each.
            memory: Where they are written.
        """
        if amplitude is None:
            amplitude = distance
        if valid is not None:
            distance, amplitude = (torch.where(valid, one, 1.0) for one in (distance, amplitude))
        products = memory[: len(self.formed) * distance.numel()].view(-1, *distance.shape)
        rows = products.unbind()
        functions = iter(rows)
        next(functions).fill_(1.0)
        if 1 in self._kept:
            next(functions).copy_(distance)
        for term in self.design.signal_terms:
            own = list(islice(functions, len(term.symbols)))
            if isinstance(term, SignalPolynomial):
                _write_powers(term, distance, amplitude, own)
            else:
                for row, values in zip(
                    own, term.basis(distance.double(), amplitude.double()), strict=True
                ):
                    row.copy_(values.detach())
        if valid is not None:
            products[: len(self._kept)].mul_(valid)
        for row, (a, b) in zip(functions, self.formed[len(self._kept) :], strict=True):
            torch.mul(rows[a], rows[b], out=row)
        if weights is not None:
            products.mul_(weights if valid is None else torch.where(valid, weights, 0.0))
        return products

    def _with_distance(self, gram: Float[Tensor, "B S S"]) -> Float[Tensor, "B S S"]:
        """Fill in the rows and columns of the distance in Gram matrices, and return them.

        Like the distance, they are combinations of those of the constant and of its polynomial.
        """
        if self.design.distance_as is not None:
            function, centre, scale = self.design.distance_as
            place = 3 * self.design.signal.tolist().index(function)
            gram[:, :3] = centre * gram[:, 3:6] + scale * gram[:, place : place + 3]
            gram[:, :, :3] = centre * gram[:, :, 3:6] + scale * gram[:, :, place : place + 3]
        return gram

    def _gather_index(self, product_of: Int[Tensor, "F F"]) -> Int[Tensor, "S S"]:
        """Return, for each entry of the Gram matrix, which of a frame's sums it is.

        First come those of each function of the frame with every static image, then those of the
        other products, which only columns without a function of the pixel share, with the ray
        products.
        """
        design, functions = self.design, len(self._kept)
        columns = torch.arange(design.num_columns).repeat_interleave(3)
        zero = torch.zeros(1, dtype=torch.long)
        signal = torch.cat([design.signal[columns], zero])
        pixel = torch.cat([design.pixel[columns], zero])
        axis = torch.cat([torch.arange(3).repeat(design.num_columns), zero + 3])
        left, right = torch.triu_indices(4, 4)
        ray_product = torch.zeros(4, 4, dtype=torch.long)
        ray_product[left, right] = ray_product[right, left] = torch.arange(10)
        product = product_of[signal[:, None], signal]
        static = design.pixel_pairs[pixel[:, None], pixel] * 10
        static = static + ray_product[axis[:, None], axis]
        num_static = self._reduction.num_static
        of_others = functions * num_static + (product - functions) * 10 + static
        return torch.where(product < functions, product * num_static + static, of_others)


def _write_powers(
    term: SignalPolynomial,
    distance: Float[Tensor, "B h W"],
    amplitude: Float[Tensor, "B h W"],
    rows: list[Tensor],
) -> None:
    """Write u, u^2, ... of the term's scaled variable u to rows.

    Pixel by pixel: scaled in the sums, roundings of the factors made the solver search on.
    """
    scaled, (centre, half_width) = rows[0], term.scale()
    scaled.copy_(distance if term.variable == "distance" else amplitude)
    if term.variable == "normalised_amplitude":
        scaled.mul_(distance).mul_(distance)
    if term.variable == "log_amplitude":
        scaled.clamp_(min=float(term.floor)).log_()
    scaled.sub_(centre).mul_(1 / half_width)
    for before, row in pairwise(rows):
        torch.mul(before, scaled, out=row)


def _static_products(design: Design, rows: Tensor | slice) -> Iterator[Float[Tensor, "10 h W"]]:
    """Yield, for each pair of pixel functions, its product with the ten ray products.

    Those are the distinct products of x, y, z and 1; each yield has shape (10, h, W), for h rows.
    """
    functions = design.pixel_functions[:, rows]
    axes = torch.cat([design.ray_directions[rows].movedim(-1, 0), functions[:1]])
    left, right = torch.triu_indices(4, 4)
    rays = axes[left] * axes[right]
    for product in range(int(design.pixel_pairs.max()) + 1):
        a, b = (design.pixel_pairs == product).nonzero()[0]
        yield functions[a] * functions[b] * rays


def moments_of_few(
    design: Design, batch: Images, frame: int, weights: Float[Tensor, "B H W"] | None = None
) -> Float[Tensor, "S S"]:
    """Return the Gram matrix of one image, as `MomentAccumulator` does, pixel by used pixel.

    The factored pass costs the same however many pixels are used; this one costs (3C + 1)^2 a used
    pixel. A target that fills a small part of the image is quicker this way.

    Args:
        design: The columns.
        batch: Some images.
        frame: Which one of them.
        weights: Weights of the pixels, shape (B, H, W); 1 each if None.

    Returns:
        Shape (S, S) with S = 3C + 1.
    """
    valid = batch.valid[frame]
    size = 3 * design.num_columns + 1
    gram = torch.zeros(size, size, dtype=torch.float64, device=valid.device)
    # The products of so many pixels stay in the processor's cache. Set by timing.
    for rows, columns in zip(
        *(index.split(8_192) for index in torch.nonzero(valid, as_tuple=True)), strict=True
    ):
        distance = batch.radial_distance[frame, rows, columns].double()
        given = distance if batch.amplitude is None else batch.amplitude[frame, rows, columns]
        signal = design.signal_functions(distance, given.double())[design.signal]
        column = signal * design.pixel_functions[:, rows, columns][design.pixel]
        rays = design.ray_directions[rows, columns].T.to(column)
        products = torch.cat([(column[:, None] * rays).flatten(0, 1), torch.ones_like(column[:1])])
        own = products if weights is None else products * weights[frame, rows, columns]
        gram += own @ products.T
    return gram


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
        self._along_row = along_row if along_row is None else along_row.to(device)
        self._along_column = along_column if along_column is None else along_column.T.to(device)
        self._shape = projected.shape[1:]
        # A thousand numbers that no static image has more of than this share change a sum by less
        # than `_EXACT`, relative to the images' norms.
        tiny = torch.finfo(projected.dtype).tiny
        numbers = torch.nn.functional.normalize(projected.flatten(1), dim=1, eps=tiny).abs()
        self._used = (numbers.amax(0) > _EXACT / 100).nonzero()[:, 0].to(device)
        self._static = projected.flatten(1).T.to(device)[self._used].contiguous()
        self.size, self.num_static = self._static.shape

    def reduced(self, blocks: Iterable[Float[Tensor, "*B _ W"]]) -> Float[Tensor, "N k n"]:
        """Return the reduction of images, given as blocks of rows, one after the other."""
        row, whole = 0, None
        for images in blocks:
            height, count = images.shape[-2], images.shape[:-2].numel()
            projected = images
            if self._along_row is not None:
                segments = images.reshape(count, -1, len(self._along_row))
                projected = _products(segments, self._along_row)
            projected = projected.reshape(count, height, self._shape[1])
            if whole is None:
                whole = projected.new_zeros(count, *self._shape)
            if self._along_column is not None:
                whole += _products(self._along_column[:, row : row + height], projected)
            else:
                whole[:, row : row + height] = projected
            row += height
        assert whole is not None
        return whole

    def sums(
        self, reduced: Float[Tensor, "N k n"], number: int | None = None
    ) -> Float[Tensor, "N S"]:
        """Return sum_v images[n, v] static[s, v], shape (N, S), of reduced images.

        Args:
            reduced: The images.
            number: How many static images, S, the first ones; None: all.
        """
        return reduced.flatten(1).index_select(1, self._used) @ self._static[:, :number]

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


def _along_rows(
    static: StaticImages, height: int
) -> tuple[Float[Tensor, "w n"] | None, Float[Tensor, "S H m"]]:
    """Return polynomials of a segment of a row, or None, and all static images projected."""
    # A few rows, evenly spread, on which polynomials are tried before all rows are checked.
    tried = torch.cat(list(static(torch.linspace(0, height - 1, min(height, 9)).long())))
    factors, width = _factors(tried), tried.shape[-1]
    mixed = torch.tensordot(factors, tried, dims=1)
    # Up to 20 segments are tried, those first that cost the least. The projection along the columns
    # costs as much for each number that a row is projected to as 48 multiplications of that along
    # rows: about 24 polynomials at half the speed. Set by timing.
    costs = sorted(
        (number + 48 * segments * number / width, width // segments, number)
        for segments in range(1, 21)
        for number in _POLYNOMIALS
        if width % segments == 0 and 2 * number <= width // segments
    )
    for _, length, number in costs:
        basis = _polynomials(length, number)
        if _left_over(basis, mixed) <= _EXACT:
            projected = _projected(static, (height, width), basis, factors)
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
        if left_over > 10 * _EXACT:
            continue
        projected = _products(basis.T, images)
        if left_over > _EXACT:
            # What a mixture leaves over may be the roundings of all images together.
            off = (images - _products(basis, projected)).abs().amax((1, 2))
            if bool((off > _EXACT * images.abs().amax((1, 2))).any()):
                continue
        return basis, projected
    return None, images


@lru_cache(maxsize=64)
def _polynomials(length: int, number: int) -> Float[Tensor, "l n"]:
    """Return orthonormal polynomials on so many evenly spread points; shared, not to be written."""
    grid = np.linspace(-1, 1, length)
    return torch.linalg.qr(torch.as_tensor(chebvander(grid, number - 1))).Q


def _projected(
    static: StaticImages,
    shape: tuple[int, int],
    basis: Float[Tensor, "w n"],
    factors: Float[Tensor, "M S"],
) -> Float[Tensor, "S H m"] | None:
    """Return all static images on the basis of each segment of a row; None: not spanned."""
    height, width = shape
    # Ten images of so many pixels stay in the cache. Set by hand.
    step = max(1, 10_240 // width)
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
        if _left_over(basis, mixed) > _EXACT:
            return None
        slabs.append(torch.cat(numbers))
    return torch.cat(slabs, dim=1)


def _factors(images: Float[Tensor, "S H W"]) -> Float[Tensor, "M S"]:
    """Return the factors of images in random sums of them, each image scaled to at most 1.

    Four sums are checked in place of all images: one that leaves over ten times `_EXACT` stays
    hidden if four normal numbers are all below a tenth, once in 25,000 designs; one that leaves
    over more stays hidden more rarely.
    """
    size = images.abs().amax((1, 2))
    size = torch.where(size > 0, size, size.max().clamp(min=torch.finfo(size.dtype).tiny))
    # No result depends on the seed.
    generator = torch.Generator().manual_seed(0)
    return torch.randn(4, len(images), generator=generator, dtype=size.dtype) / size


def _left_over(basis: Float[Tensor, "w n"], mixed: Float[Tensor, "*M W"]) -> float:
    """Return the largest number that the basis leaves of images, of which these are random sums."""
    segments = mixed.reshape(-1, len(basis))
    return float(torch.addmm(segments, segments @ basis, basis.T, alpha=-1).abs().max())
