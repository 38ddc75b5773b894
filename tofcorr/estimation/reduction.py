"""Sums over pixels of frame images times static images, fast where the static ones are smooth.

Rays and polynomials of the pixel are smooth along an image row, so a few orthogonal polynomials
of the column represent all of them to rounding. Frame images are first projected onto those, which
shrinks them from W to a dozen numbers a row; the static images then need only as many. Where the
static images are not smooth, the projection is the identity and nothing is lost but speed.
"""

from collections.abc import Callable, Iterable

import torch
from jaxtyping import Float
from numpy.polynomial.chebyshev import chebvander
from torch import Tensor

# Degrees of the column polynomials that are tried, in this order. Set by hand.
_DEGREES = (8, 10, 12, 14, 16, 20, 24, 32)
# Relative error at which a projection counts as exact. It bounds the relative error of a moment,
# and lies well below what the solvers resolve (1e-12). Set by hand.
_EXACT = 1e-13
# The basis is widened to a multiple of so many columns. Set by timing on AVX-512: 24 columns take
# two thirds of the time of 21.
_QUICK_COLUMNS = 8
# Rows, evenly spread, on which a degree is tried before all rows are checked. Set by hand.
_ROWS_TRIED = 9
# Rows checked at once, so that no temporary is as large as an image. Set by hand.
_SLAB_ROWS = 32


StaticImages = Callable[[Tensor | slice], Iterable[Float[Tensor, "G h W"]]]
"""Yields rows of all static images, group by group."""


class ColumnReduction:
    """Sums products of frame images with fixed static images.

    Args:
        static: Takes numbers of rows (h,), or a slice of them, and yields these rows of the static
            images anew at each call, in groups of shape (G, h, W), float64.
        height: Rows of an image, H.
        device: Where the sums are formed.
    """

    def __init__(self, static: StaticImages, height: int, device: str = "cpu") -> None:
        basis = _column_basis(static, height)
        projected = None if basis is None else _projected(static, basis)
        if basis is not None and projected is not None:
            basis, projected = _padded(basis, projected)
        if basis is None or projected is None:
            basis, projected = None, torch.cat([group.flatten(1) for group in static(slice(None))])
        self._basis = None if basis is None else basis.to(device)
        self._static = projected.T.contiguous().to(device)

    def project(self, images: Float[Tensor, "B P h W"]) -> Float[Tensor, "B P h n"]:
        """Return rows of images (B, P, h, W) as numbers (B, P, h, n) that `sums` understands.

        They are in memory of their own: the caller may write the next rows over the images.
        """
        return images.clone() if self._basis is None else images @ self._basis

    def sums(self, projected: Float[Tensor, "B P H n"]) -> Float[Tensor, "B P S"]:
        """Return sum_v images[b, p, v] static[s, v], shape (B, P, S), of projected images."""
        return projected.flatten(2) @ self._static

    def __call__(self, images: Float[Tensor, "B P H W"]) -> Float[Tensor, "B P S"]:
        """Return sum_v images[b, p, v] static[s, v], shape (B, P, S), of images (B, P, H, W)."""
        return self.sums(self.project(images))


def _column_basis(static: StaticImages, height: int) -> Float[Tensor, "W n"] | None:
    """Return the fewest orthonormal polynomials (W, n) that span a few rows, or None."""
    groups = list(static(torch.linspace(0, height - 1, min(height, _ROWS_TRIED)).long()))
    width = groups[0].shape[-1]
    grid = torch.linspace(-1, 1, width, dtype=torch.float64)
    for degree in _DEGREES:
        if degree + 1 > width // 2:
            return None
        vandermonde = torch.as_tensor(chebvander(grid.numpy(), degree))
        basis = torch.linalg.qr(vandermonde).Q
        if all(_is_exact(group, group @ basis, basis) for group in groups):
            return basis
    return None


def _projected(static: StaticImages, basis: Float[Tensor, "W n"]) -> Float[Tensor, "S m"] | None:
    """Return all static images on the basis, shape (S, m), m = H n; None: not spanned."""
    parts: list[Tensor] = []
    for group in static(slice(None)):
        parts.append(group @ basis)
        if not _is_exact(group, parts[-1], basis):
            return None
    return torch.cat(parts).flatten(1)


def _padded(
    basis: Float[Tensor, "W n"], projected: Float[Tensor, "S m"]
) -> tuple[Float[Tensor, "W k"], Float[Tensor, "S l"]]:
    """Add polynomials of zero up to a number of columns that processors multiply quickly."""
    size = basis.shape[1]
    more = -size % _QUICK_COLUMNS
    wider = torch.nn.functional.pad(projected.unflatten(1, (-1, size)), (0, more))
    return torch.nn.functional.pad(basis, (0, more)), wider.flatten(1)


def _is_exact(
    images: Float[Tensor, "G H W"], projected: Float[Tensor, "G H n"], basis: Float[Tensor, "W n"]
) -> bool:
    allowed = _EXACT * torch.maximum(images.amax((1, 2)), -images.amin((1, 2))).clamp(min=1e-300)
    # By slabs of rows: fresh memory for whole images would cost more than the arithmetic.
    for image_rows, projected_rows in zip(
        images.split(_SLAB_ROWS, 1), projected.split(_SLAB_ROWS, 1), strict=True
    ):
        left_over = torch.sub(projected_rows @ basis.T, image_rows).abs_()
        if not bool((left_over.amax((1, 2)) <= allowed).all()):
            return False
    return True
