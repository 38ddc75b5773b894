"""The information in the images: effective residual variance, precision and covariance."""

import torch
from jaxtyping import Float
from torch import Tensor

from tofcorr.estimation.moments import ImageMoments
from tofcorr.estimation.objective import MomentObjective
from tofcorr.estimation.parameters import Parameters
from tofcorr.estimation.planes import Walls, marginal_hessian

PRIOR_SIGMA = 0.1
"""Standard deviation of the wide prior on every unknown: 100 mm, 100 mrad (5.7 degrees).

It is wider than the error of any depth camera and of any usable hand-eye guess. Set by hand.
"""

# Curvature below this share of the largest (each parameter scaled to its own) is rounding and
# counts as zero; float64 resolves 1e-16, and sums over pixels lose some digits. Set by hand.
_SINGULAR = 1e-10
# Least standard deviation of a residual, metres. Without it, rounding would look like information
# in data without noise. A hundredth of a millimetre is far below any camera's noise.
_LEAST_RESIDUAL = 1e-5


def effective_variance(moments: ImageMoments, optimum: Parameters) -> float:
    r"""Return the effective variance of a residual, which allows for correlated pixels.

    Were the pixels independent, the score :math:`g_i` of image i at the optimum would have the
    covariance :math:`s^2 (H_i - H_i H^{-1} H_i)`. The pixels of an image share its pose error and
    its target, so the scores vary more; :math:`s^2` is chosen to match their variation:

    .. math:: s^2 = \sum_i g_i^T H^{-1} g_i \Big/ \sum_i \mathrm{tr}(W_i - W_i^2),
        \quad W_i = H^{-1} H_i

    It is at least the mean squared residual.

    Returns:
        The variance in the unit of the loss: square metres where pixels have weight 1.
    """
    each = MomentObjective(moments).image_equations(optimum)
    least = max(float(each.loss.sum() / moments.count.sum().clamp(min=1)), _LEAST_RESIDUAL**2)
    scale, values, vectors = _scaled_eigh(each.hessian.sum(dim=0))
    known = values > 0
    whitening = vectors[:, known] / values[known].sqrt() / scale[:, None]
    scores = each.gradient @ whitening
    shares = whitening.T @ each.hessian @ whitening
    freedom = float(shares.diagonal(dim1=1, dim2=2).sum() - shares.square().sum())
    return max(float(scores.square().sum()) / freedom, least) if freedom > 0 else least


def information(
    moments: ImageMoments, optimum: Parameters, variance: float, walls: Walls | None = None
) -> Float[Tensor, "P P"]:
    """Return the precision of the unknowns that the images give, shape (P, P).

    Curvature that is only rounding is removed, so that a singular direction is exactly singular.

    Args:
        moments: Moments of the images fitted.
        optimum: The parameters at the optimum.
        variance: The effective variance of a residual.
        walls: Walls that were estimated as well: the precision is then the marginal one.
    """
    scale, values, vectors = _scaled_eigh(marginal_hessian(moments, optimum, walls))
    clean = (vectors * values) @ vectors.T
    return clean * scale[:, None] * scale[None, :] / variance


def _scaled_eigh(
    hessian: Float[Tensor, "P P"],
) -> tuple[Float[Tensor, "P"], Float[Tensor, "P"], Float[Tensor, "P P"]]:
    """Scale a Hessian to unit diagonal; return the scale, eigenvalues and eigenvectors.

    Eigenvalues that are only rounding are returned as 0.
    """
    scale = hessian.diagonal().clamp(min=1e-300).sqrt()
    values, vectors = torch.linalg.eigh(hessian / scale[:, None] / scale[None, :])
    return scale, torch.where(values < _SINGULAR * values.max(), 0.0, values), vectors


def posterior_covariance(precision: Float[Tensor, "*batch P P"]) -> Float[Tensor, "*batch P P"]:
    """Return the covariance (..., P, P) that precision matrices give with the wide prior."""
    prior = torch.eye(precision.shape[-1], dtype=precision.dtype) / PRIOR_SIGMA**2
    return torch.linalg.inv(precision + prior)
