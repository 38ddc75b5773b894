"""Sums over pixels of frame images times static images, fast where the static ones are smooth.

Rays and polynomials of the pixel are smooth along an image row, so a few orthogonal polynomials
of the column represent all of them to rounding. Frame images are first projected onto those, which
shrinks them from W to a dozen numbers a row; the static images then need only as many. Where the
static images are not smooth, the projection is the identity and nothing is lost but speed.
"""

import torch
from numpy.polynomial.chebyshev import chebvander
from torch import Tensor

# Degrees tried, and the relative error at which a projection counts as exact. It bounds the
# relative error of a moment, and lies well below what the solvers resolve.
_DEGREES = (8, 12, 16, 20, 24, 32)
_EXACT = 1e-13


class ColumnReduction:
    """Sums products of frame images with fixed static images.

    Args:
        static: The static images, shape (S, H, W), float64.
    """

    def __init__(self, static: Tensor) -> None:
        self._basis = _column_basis(static)
        projected = static if self._basis is None else static @ self._basis
        self._static = projected.flatten(1).T.contiguous()

    def __call__(self, images: Tensor) -> Tensor:
        """Return sum_v images[b, p, v] static[s, v], shape (B, P, S), of images (B, P, H, W)."""
        projected = images if self._basis is None else images @ self._basis
        return projected.flatten(2) @ self._static


def _column_basis(static: Tensor) -> Tensor | None:
    """Return the orthonormal polynomials (W, n) that span every row, or None if none do."""
    width = static.shape[-1]
    scale = static.abs().amax(dim=(1, 2), keepdim=True).clamp(min=1e-300)
    grid = torch.linspace(-1, 1, width, dtype=torch.float64)
    for degree in _DEGREES:
        if degree + 1 > width // 2:
            return None
        vandermonde = torch.as_tensor(chebvander(grid.numpy(), degree))
        basis = torch.linalg.qr(vandermonde).Q.to(static)
        left_over = static - static @ basis @ basis.T
        if bool((left_over.abs() <= _EXACT * scale).all()):
            return basis
    return None
