"""Smooth curves and maps through tables, as tensors."""

import torch
from torch import Tensor


class Curve:
    """A cubic spline through knots, constant beyond the first and the last one.

    With four knots or more (not-a-knot end conditions) it reproduces any cubic polynomial.

    Args:
        knots: Increasing, at least two.
        values: One per knot.
    """

    def __init__(self, knots: tuple[float, ...], values: tuple[float, ...]) -> None:
        from scipy.interpolate import CubicSpline, PPoly  # Slow to import; few commands need it.

        spline: PPoly = CubicSpline(knots, values)
        self._breaks = torch.from_numpy(spline.x.copy())
        self._coefficients = torch.from_numpy(spline.c.copy())

    def __call__(self, position: Tensor) -> Tensor:
        """Return the curve at `position`, any shape."""
        inside = position.clamp(self._breaks[0], self._breaks[-1])
        piece = torch.searchsorted(self._breaks, inside.detach().contiguous(), right=True) - 1
        piece = piece.clamp(0, len(self._breaks) - 2)
        step = inside - self._breaks[piece]
        value = torch.zeros_like(step)
        for coefficient in self._coefficients:
            value = value * step + coefficient[piece]
        return value


def image_from_lattice(values: tuple[tuple[float, ...], ...], height: int, width: int) -> Tensor:
    """Return the image (height, width) that interpolates a coarse lattice.

    The lattice spans the image evenly, from the centre of the first pixel to that of the last.
    Cubic splines along rows and columns interpolate between its points.
    """
    lattice = torch.tensor(values, dtype=torch.float64)
    return _refined(_refined(lattice, height).T, width).T


def _refined(rows: Tensor, count: int) -> Tensor:
    """Interpolate lattice rows (R, C) to (count, C)."""
    from scipy.interpolate import CubicSpline  # Slow to import; few commands need it.

    if len(rows) == 1:
        return rows.expand(count, -1)
    at = torch.linspace(0.0, 1.0, count, dtype=torch.float64)
    knots = torch.linspace(0.0, 1.0, len(rows), dtype=torch.float64).numpy()
    return torch.from_numpy(CubicSpline(knots, rows.numpy())(at.numpy()))
