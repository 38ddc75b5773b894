r"""The one pass over the pixels: turns batches of images into their moments.

Every column of the error model is a signal function f(D, I) times a pixel function s(r, c), one
of them 1. With the viewing ray (x, y, z) the residual of a pixel is a combination of

.. math:: \{x, y, z\} \times \{D, f_k s_k\}, \; 1

and a moment sums, over the pixels of an image, the product of two signal functions of the frame
with a static image: a product of pixel functions and rays. Rays and polynomials of the pixel are
smooth along an image row and along a column, so a few orthogonal polynomials represent them to
rounding. Products of frames are first projected onto those of each segment of a row, which shrinks
W numbers to a few dozen, then onto those of the columns; the static images then need only as many.
Where these are not smooth, pixel by pixel is summed, and nothing is lost but speed.
"""

from copy import copy
from functools import lru_cache
from itertools import combinations_with_replacement, islice, pairwise, product
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
from tofcorr.geometry.rays import Rays


def distinct_products(values: Float[Tensor, "F probes"]) -> Int[Tensor, "F F"]:
    """Return which of the distinct products each product of two functions is, by their values.

    Products whose randomly weighted sums agree to ten digits count as one function. A wrong match
    could only merge products that differ by less than the rounding of their sums. They are numbered
    as they appear, row by row: the functions' products with the first one first.
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

    def __init__(self, model: ErrorModel, domain: Domain, ray_directions: Rays) -> None:
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
        probes = domain.probes()[:2]
        self.signal_pairs = distinct_products(self.signal_functions(*probes))
        self.distance_as = self.affine(*probes)
        some = torch.linspace(0, self.pixel_functions[0].numel() - 1, len(probes[0])).long()
        self.pixel_pairs = distinct_products(self.pixel_functions.flatten(1)[:, some])

    def signal_functions(
        self, radial_distance: Float[Tensor, "*pixels"], amplitude: Float[Tensor, "*pixels"]
    ) -> Float[Tensor, "F *pixels"]:
        """Return 1, D and the signal terms' basis, shape (F, ...)."""
        with torch.no_grad():
            bases = [term.basis(radial_distance, amplitude) for term in self.signal_terms]
            ones = torch.ones_like(radial_distance)[None]
            return torch.cat([ones, radial_distance[None], *bases])

    def affine(
        self, distance: Float[Tensor, "probes"], amplitude: Float[Tensor, "probes"]
    ) -> tuple[int, float, float] | None:
        """Return a signal function u and numbers c, h so that c + h u is the distance; or None."""
        number = 2
        for term in self.signal_terms:
            form = term.polynomial()
            if form is not None and form.variable == "distance":
                u = term.basis(distance, amplitude)[0].detach()
                if torch.allclose(form.centre + form.half_width * u, distance, rtol=_EXACT):
                    return number, float(form.centre), float(form.half_width)
            number += len(term.symbols)
        return None


# Pixels whose products are formed at once: on a CPU they stay in its cache, on a GPU they fill it.
# Set by timing.
_BLOCK_PIXELS, _BLOCK_PIXELS_CUDA = 20_480, 4_194_304
# Relative error at which a projection counts as exact. It bounds the relative error of a moment,
# and lies well below what the solvers resolve (1e-12). Set by hand.
_EXACT = 1e-13
# Numbers of polynomials that are tried. Multiples of 8, which processors multiply quickly: on
# AVX-512, 24 columns take two thirds of the time of 21.
_POLYNOMIALS = range(16, 49, 8)

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
        self.design = design
        self._smooth = [part.to(device) for part in on_polynomials(design)]
        pairs = design.signal_pairs
        self._kept = [k for k in range(len(pairs)) if k != 1 or design.distance_as is None]
        # The functions themselves first: products with 1. Then one pair for each other product.
        place = {int(pairs[0, k]): n for n, k in enumerate(self._kept)}
        self.formed = [(0, n) for n in range(len(self._kept))]
        for a, b in combinations_with_replacement(range(1, len(self._kept)), 2):
            product = int(pairs[self._kept[a], self._kept[b]])
            if product not in place:
                place[product] = len(self.formed)
                self.formed.append((a, b))
        index = torch.tensor([[place.get(k, 0) for k in row] for row in pairs.tolist()])
        self._gather = _gather_index(design, index).to(device)
        self._block = _BLOCK_PIXELS_CUDA if device.startswith("cuda") else _BLOCK_PIXELS

    def on(self, model: ErrorModel, domain: Domain) -> "MomentAccumulator":
        """Return one for the same terms scaled to another domain; it shares all static images."""
        other, other.design = copy(self), copy(self.design)
        other.design.signal_terms = list(model.signal_terms)  # type: ignore[arg-type]
        other.design.distance_as = other.design.affine(*domain.probes()[:2])
        return other

    def __call__(
        self, batch: Images, weights: Float[Tensor, "B H W"] | None = None
    ) -> ImageMoments:
        """Return the moments of one batch, on the CPU.

        Args:
            batch: Frames on the accumulator's device.
            weights: Weights of the pixels, shape (B, H, W); 1 each if None.
        """
        size, count = batch.valid[0].numel(), batch.valid.count_nonzero((1, 2)).cpu()
        grams = []
        for frames in torch.arange(len(count)).split(max(1, self._block // size)):
            many = batch.valid.is_cuda or count[frames].sum() > self.few_pixels * size * len(frames)
            if self._smooth and many:
                chosen = slice(int(frames[0]), int(frames[-1]) + 1)
                grams.append(self._frames(batch, weights, chosen).cpu())
            else:
                each = (moments_of_few(self.design, batch, int(k), weights) for k in frames)
                grams.append(torch.stack(list(each)))
        planes = batch.normal_tool.cpu(), batch.offset_tool.cpu()
        return ImageMoments(torch.cat(grams), *planes, count.double(), self.design.symbols)

    def _frames(
        self, batch: Images, weights: Float[Tensor, "B H W"] | None, frames: slice
    ) -> Float[Tensor, "F S S"]:
        """Return the Gram matrices of some frames, gathered from blocks of rows."""
        count, height, width = batch.valid[frames].shape
        step = max(1, self._block // (count * width))
        along_row, along_column, static = self._smooth
        valid = None if bool(batch.valid[frames].all()) else batch.valid
        # Each block is written over the last: it is in the cache.
        size = len(self.formed) * count * step * width
        memory = self._gather.new_empty(size, dtype=torch.float64)
        blocks = []
        for row in range(0, height, step):
            at = frames, slice(row, row + step)
            others = (one if one is None else one[at] for one in (batch.amplitude, valid, weights))
            products = self._products(batch.radial_distance[at], *others, memory=memory)
            segments = products.view(len(products) * count, -1, len(along_row))
            by_row = _product(segments, along_row).view(len(segments), -1, static.shape[2])
            blocks.append(_product(along_column[row : row + step].T, by_row))
        sums = torch.stack(blocks).sum(dim=0).flatten(1) @ static.flatten(1).T
        by_frame = sums.unflatten(0, (-1, count)).transpose(0, 1).flatten(1)
        return self._with_distance(by_frame[:, self._gather])

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
                basis = term.basis(distance.double(), amplitude.double()).detach()
                for row, values in zip(own, basis, strict=True):
                    row.copy_(values)
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


def _gather_index(design: Design, product_of: Int[Tensor, "F F"]) -> Int[Tensor, "S S"]:
    """Return, for each entry of the Gram matrix, which of a frame's sums it is.

    Each product of signal functions is summed over every static image, one product after the other.
    """
    number = len(design.signal)
    columns = torch.arange(number).repeat_interleave(3)
    zero = torch.zeros(1, dtype=torch.long)
    signal, pixel = (torch.cat([part[columns], zero]) for part in (design.signal, design.pixel))
    axis = torch.cat([torch.arange(3).repeat(number), zero + 3])
    left, right = torch.triu_indices(4, 4)
    ray_product = torch.zeros(4, 4, dtype=torch.long)
    ray_product[left, right] = ray_product[right, left] = torch.arange(10)
    static = design.pixel_pairs[pixel[:, None], pixel] * 10 + ray_product[axis[:, None], axis]
    num_static = 10 * (int(design.pixel_pairs.max()) + 1)
    return product_of[signal[:, None], signal] * num_static + static


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


def moments_of_few(
    design: Design, batch: Images, frame: int, weights: Float[Tensor, "B H W"] | None = None
) -> Float[Tensor, "S S"]:
    """Return the Gram matrix of one image, as `MomentAccumulator` does, pixel by used pixel.

    The factored pass costs the same however many pixels are used, and needs smooth images; this one
    costs (3C + 1)^2 a used pixel. A target that fills a small part of the image is quicker so.

    Args:
        design: The columns.
        batch: Some images.
        frame: Which one of them.
        weights: Weights of the pixels, shape (B, H, W); 1 each if None.

    Returns:
        Shape (S, S) with S = 3C + 1.
    """
    size = 3 * len(design.signal) + 1
    gram = torch.zeros(size, size, dtype=torch.float64)
    images = batch.radial_distance, batch.amplitude, weights
    measured, amplitude, weight = (one if one is None else one[frame].cpu() for one in images)
    assert measured is not None
    # The products of so many pixels stay in the processor's cache. Set by timing.
    for used in torch.nonzero(batch.valid[frame].cpu()).split(8_192):
        rows, columns = used.unbind(dim=1)
        distance = measured[rows, columns].double()
        given = distance if amplitude is None else amplitude[rows, columns]
        signal = design.signal_functions(distance, given.double())[design.signal]
        column = signal * design.pixel_functions[:, rows, columns][design.pixel]
        rays = design.ray_directions[rows, columns].T.to(column)
        products = torch.cat([(column[:, None] * rays).flatten(0, 1), torch.ones_like(column[:1])])
        own = products if weight is None else products * weight[rows, columns]
        gram += own @ products.T
    return gram


def on_polynomials(design: Design) -> tuple[Tensor, ...]:
    """Return the static images on polynomials along segments of rows and along columns.

    The fewest polynomials are taken that represent every image to rounding, on the longest segments
    of a row: each number that a row is projected to is projected along the columns as well.

    Returns:
        Polynomials of a segment of a row, shape (w, n), and of a column, (H, k), and the images'
        numbers on them, (S, k, W / w n). Nothing where none that are tried represent them.
    """
    height, width = design.pixel_functions.shape[1:]
    for number, segments in product(_POLYNOMIALS, range(1, width + 1)):
        if width % segments == 0 and 2 * number <= width // segments:
            along_row = _polynomials(width // segments, number)
            if (by_row := _by_row(design, along_row)) is not None:
                break
    else:
        return ()
    for number in _POLYNOMIALS:
        along_column = _polynomials(height, number)
        projected = _projected(by_row.mT, along_column)
        if 2 * number <= height and projected is not None:
            return along_row, along_column, projected.mT.contiguous()
    return ()


def _by_row(design: Design, along_row: Float[Tensor, "w n"]) -> Float[Tensor, "S H m"] | None:
    """Return the static images on polynomials of each segment of a row; None: not spanned.

    They are the products of two pixel functions with the ten distinct products of x, y, z and 1.
    """
    numbers = range(int(design.pixel_pairs.max()) + 1)
    pairs = torch.stack([(design.pixel_pairs == k).nonzero()[0] for k in numbers])
    left, right = torch.triu_indices(4, 4)
    found = []
    # All images of so many rows take a few megabytes.
    for rows in torch.arange(len(design.ray_directions)).split(16):
        functions = design.pixel_functions[:, rows]
        axes = torch.cat([design.ray_directions[rows].movedim(-1, 0), functions[:1]])
        products = functions[pairs[:, 0]] * functions[pairs[:, 1]]
        images = products[:, None] * (axes[left] * axes[right])
        segments = images.view(images.shape[:2].numel(), -1, len(along_row))
        if (projected := _projected(segments, along_row)) is None:
            return None
        found.append(projected.view(len(segments), len(rows), -1))
    return torch.cat(found, dim=1)


def _projected(
    images: Float[Tensor, "S R w"], basis: Float[Tensor, "w n"]
) -> Float[Tensor, "S R n"] | None:
    """Return the lines of images on orthonormal functions; None where these do not span them.

    What they do not span of any image shows in a random mixture of all, each scaled alike.
    """
    projected = _product(images, basis)
    largest = projected.abs().amax((1, 2)).clamp(min=torch.finfo(basis.dtype).tiny)
    generator = torch.Generator().manual_seed(0)  # No result depends on the factors.
    factors = torch.empty(len(images), dtype=basis.dtype).uniform_(-1, 1, generator=generator)
    factors = (factors + factors.sign()) / largest  # None of them small.
    mixed, mixed_projected = (torch.tensordot(factors, part, 1) for part in (images, projected))
    left = (mixed - mixed_projected @ basis.T).abs().max()
    # A row of ones has the coefficient sqrt(w); the roundings of S images add up to sqrt(S) of one.
    return projected if left * len(basis) ** 0.5 <= _EXACT * len(images) ** 0.5 else None


def _product(left: Tensor, right: Tensor) -> Float[Tensor, "N a c"]:
    """Return the products of matrices (N, a, b) and (b, c), or (a, b) and (N, b, c).

    On a CPU by NumPy: torch's library, Intel's, takes twice the time for thin matrices on an AMD
    processor. One product an image is small enough for NumPy's library to compute it in the
    caller's thread; threads of its own would wait for those of torch.
    """
    if left.is_cuda:
        return left @ right
    return torch.from_numpy(np.matmul(left.numpy(), right.numpy()))


@lru_cache(maxsize=64)
def _polynomials(length: int, number: int) -> Float[Tensor, "l n"]:
    """Return orthonormal polynomials on so many evenly spread points; shared, not to be written."""
    grid = np.linspace(-1, 1, length)
    return torch.linalg.qr(torch.as_tensor(chebvander(grid, number - 1))).Q
