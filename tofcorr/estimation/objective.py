r"""The point-to-plane loss and its derivatives, from moments or from pixels.

Both kinds have the same methods, so that a solver works on either. The loss is
:math:`\sum_i \sum_v w_v r_v^2` in square metres (times the unit of the weights).
"""

from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from tofcorr.estimation.moments import ImageMoments
from tofcorr.estimation.parameters import Parameters
from tofcorr.geometry import se3


class NormalEquations(NamedTuple):
    """The quadratic model of the loss at a point: loss + 2 g.d + d.H.d for a step d.

    Attributes:
        loss: Sum of weighted squared residuals.
        gradient: Half the gradient, shape (P,).
        hessian: Half the Gauss-Newton Hessian, shape (P, P).
    """

    loss: Tensor
    gradient: Tensor
    hessian: Tensor


# Least standard deviation of a residual, metres. On data without noise the loss is only rounding,
# and no standard error could be derived from it. A hundredth of a millimetre is far below any
# camera's noise.
_LEAST_RESIDUAL = 1e-5


def residual_variance(loss: float, hessian: Float[Tensor, "P P"], num_residuals: float) -> float:
    """Return the mean weighted squared residual, on which standard errors are based.

    Args:
        loss: Sum of weighted squared residuals.
        hessian: Half its Gauss-Newton Hessian, shape (P, P).
        num_residuals: How many residuals it sums.
    """
    # The largest curvature is that of an unknown that moves every residual by about one metre.
    least = _LEAST_RESIDUAL**2 * float(hessian.diagonal().max())
    return max(loss, least) / num_residuals


@runtime_checkable
class Objective(Protocol):
    """A sum of squared residuals as a function of the parameters."""

    def loss(self, parameters: Parameters) -> Float[Tensor, ""]:
        """Return the loss, a scalar through which autograd reaches the parameters."""
        ...

    def change(self, origin: Parameters, step: Float[Tensor, "P"]) -> Float[Tensor, ""]:
        """Return loss(origin.moved(step)) - loss(origin), differentiable in the step (P,).

        Near the optimum the loss is a small difference of large sums, too inexact for a line
        search. The change is computed without that cancellation.
        """
        ...

    def normal_equations(self, parameters: Parameters) -> NormalEquations:
        """Return loss, gradient and Gauss-Newton Hessian for a step of `Parameters.moved`."""
        ...

    @property
    def num_residuals(self) -> float:
        """How many residuals the loss sums."""
        ...


class MomentObjective:
    """The loss from per-image moments: microseconds, whatever the number of pixels.

    Args:
        moments: Moments of the images to fit.
    """

    def __init__(self, moments: ImageMoments) -> None:
        self.moments = moments

    @property
    def num_residuals(self) -> float:
        """How many residuals the loss sums."""
        return float(self.moments.count.sum())

    def image_losses(self, parameters: Parameters) -> Float[Tensor, "N"]:
        """Return the sum of squared residuals of each image, shape (N,)."""
        p = residual_vectors(self.moments, parameters)
        return torch.einsum("nq,nqr,nr->n", p, self.moments.gram, p)

    def loss(self, parameters: Parameters) -> Float[Tensor, ""]:
        """Return the loss, differentiable."""
        return self.image_losses(parameters).sum()

    def change(self, origin: Parameters, step: Float[Tensor, "P"]) -> Float[Tensor, ""]:
        """Return the change of the loss by a step, as d.G.(2p + d) with d the change of p."""
        p = residual_vectors(self.moments, origin)
        change = _residual_change(self.moments, origin, step)
        return torch.einsum("nq,nqr,nr->", change, self.moments.gram, 2 * p + change)

    def image_equations(
        self, parameters: Parameters, further: Float[Tensor, "N S F"] | None = None
    ) -> NormalEquations:
        """Return the normal equations of each image: (N,), (N, P) and (N, P, P).

        Args:
            parameters: Where.
            further: Derivatives of the residual vectors by further unknowns, shape (N, S, F); they
                come after the others.
        """
        p = residual_vectors(self.moments, parameters)
        jacobian = _jacobian(self.moments, parameters)
        if further is not None:
            jacobian = torch.cat([jacobian, further], dim=2)
        weighted = self.moments.gram @ jacobian
        loss = torch.einsum("nq,nqr,nr->n", p, self.moments.gram, p)
        gradient = (p[:, None, :] @ weighted)[:, 0]
        return NormalEquations(loss, gradient, jacobian.transpose(1, 2) @ weighted)

    def normal_equations(self, parameters: Parameters) -> NormalEquations:
        """Return loss, gradient and Gauss-Newton Hessian, summed over the images."""
        return NormalEquations(*(part.sum(dim=0) for part in self.image_equations(parameters)))


def residual_vectors(moments: ImageMoments, parameters: Parameters) -> Float[Tensor, "N S"]:
    """Return p_i = (b outer R^T m_i, m_i . t + e_i), shape (N, S), S = 3C + 1."""
    rotation = parameters.tool_from_camera[:3, :3]
    translation = parameters.tool_from_camera[:3, 3]
    normal_camera = moments.normal_tool @ rotation
    distance = moments.normal_tool @ translation + moments.offset_tool
    b = torch.cat([parameters.coefficients.new_ones(1), -parameters.coefficients])
    by_column = b[None, :, None] * normal_camera[:, None, :]
    return torch.cat([by_column.flatten(1), distance[:, None]], dim=1)


def _residual_change(
    moments: ImageMoments, origin: Parameters, step: Float[Tensor, "P"]
) -> Float[Tensor, "N S"]:
    """Return p(origin.moved(step)) - p(origin) without subtracting, shape (N, S)."""
    normal_camera = moments.normal_tool @ origin.tool_from_camera[:3, :3]
    by_coefficient = torch.cat([step.new_zeros(1), -step[origin.twist_size :]])
    change = by_coefficient[None, :, None] * normal_camera[:, None, :]
    distance = torch.zeros_like(moments.offset_tool)
    if origin.hand_eye_is_free:
        moved = se3.exp_minus_identity(step[:6])
        b = torch.cat([step.new_ones(1), -origin.coefficients]) + by_coefficient
        change = change + b[None, :, None] * (normal_camera @ moved[:3, :3])[:, None, :]
        distance = normal_camera @ moved[:3, 3]
    return torch.cat([change.flatten(1), distance[:, None]], dim=1)


def _jacobian(moments: ImageMoments, parameters: Parameters) -> Float[Tensor, "N S P"]:
    """Return the derivative of p_i with respect to a step, shape (N, S, P)."""
    normal_camera = moments.normal_tool @ parameters.tool_from_camera[:3, :3]
    num_images, num = len(normal_camera), parameters.coefficients.numel()
    b = torch.cat([parameters.coefficients.new_ones(1), -parameters.coefficients])
    size = 3 * (1 + num) + 1
    jacobian = normal_camera.new_zeros(num_images, size, parameters.size)
    first = parameters.twist_size
    if parameters.hand_eye_is_free:
        # (R exp(w))^T m = exp(-w) a = a + a x w: the derivative is the cross matrix of a.
        jacobian[:, -1, :3] = normal_camera
        turned = b[None, :, None, None] * _cross_matrix(normal_camera)[:, None]
        jacobian[:, :-1, 3:6] = turned.flatten(1, 2)
    for k in range(num):
        jacobian[:, 3 * (k + 1) : 3 * (k + 2), first + k] = -normal_camera
    return jacobian


def _cross_matrix(vectors: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3 3"]:
    """Return [v]x with [v]x w = v x w, shape (N, 3, 3)."""
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(-1, 3, 3)
