"""Which unknowns the images say anything about at all."""

from jaxtyping import Bool, Float
from torch import Tensor

# An unknown of less than this share of the largest curvature has none but rounding: unknowns are
# scaled to metres and radians, and the weakest that any recording resolves is far above it.
_LEAST = 1e-24
# Least curvature of all, so that equations of nothing but zeros have none either.
_TINY = 1e-300


def least_curvature(hessian: Float[Tensor, "P P"]) -> float:
    """Return the curvature up to which an unknown has none but rounding."""
    return max(_LEAST * max(hessian.diagonal().tolist(), default=0.0), _TINY)


def curved(hessian: Float[Tensor, "P P"]) -> Bool[Tensor, "P"]:
    """Return which unknowns change the loss.

    A turn about the only ray does not, nor the coefficient of a condition that never changed. Such
    an unknown stays where it is: whatever is solved for it is rounding over almost zero.
    """
    return hessian.diagonal() > least_curvature(hessian)
