r"""The point-to-plane loss and its derivatives, from moments or from pixels.

Both kinds have the same methods, so that a solver works on either. The loss is
:math:`\sum_i \sum_v w_v r_v^2` in square metres (times the unit of the weights).
"""

from functools import cached_property
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from tofcorr.estimation.change_of_loss import ChangeOfLoss
from tofcorr.estimation.linear import NormalEquations
from tofcorr.estimation.moments import ImageMoments
from tofcorr.estimation.parameters import Parameters

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

    A residual vector is linear in the image's plane, p_i = A^T h_i with h_i = (m_i, e_i) and one
    matrix A (4, S) of the unknowns. So the loss is a^T Q a, with a the entries of A and
    Q = sum_i h_i h_i^T outer G_i: after one sum over the images, it takes the same time for any
    number of them.

    Args:
        moments: Moments of the images to fit.
    """

    def __init__(self, moments: ImageMoments) -> None:
        self.moments = moments
        self._slope: tuple[Parameters, Tensor] | None = None

    @property
    def num_residuals(self) -> float:
        """How many residuals the loss sums."""
        return float(self.moments.count.sum())

    @cached_property
    def _joint(self) -> Float[Tensor, "E E"]:
        """Q, with E = 4 S; entry S k + q belongs to entry (k, q) of A."""
        planes, size = _planes(self.moments), self.moments.gram.shape[-1]
        pairs = (planes[:, :, None] * planes[:, None, :]).flatten(1)
        joint = (pairs.T @ self.moments.gram.flatten(1)).view(4, 4, size, size)
        return joint.transpose(1, 2).reshape(4 * size, 4 * size)

    def image_losses(self, parameters: Parameters) -> Float[Tensor, "N"]:
        """Return the sum of squared residuals of each image, shape (N,)."""
        p = residual_vectors(self.moments, parameters)
        return torch.einsum("nq,nqr,nr->n", p, self.moments.gram, p)

    def loss(self, parameters: Parameters) -> Float[Tensor, ""]:
        """Return the loss, differentiable."""
        return self.image_losses(parameters).sum()

    def change(self, origin: Parameters, step: Float[Tensor, "P"]) -> Float[Tensor, ""]:
        """Return the change of the loss by a step, see `ChangeOfLoss`."""
        change = ChangeOfLoss.apply(step, origin, self._joint, self._slope_at(origin))
        assert isinstance(change, Tensor)
        return change

    def _slope_at(self, origin: Parameters) -> Float[Tensor, "E"]:
        """Return Q a; a solver asks for many steps from one origin."""
        known = self._slope
        if known is None or known[0] is not origin:
            with torch.no_grad():
                known = origin, self._joint @ _of_planes(origin).flatten()
            self._slope = known
        return known[1]

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
        jacobian = torch.tensordot(_planes(self.moments), _jacobian(parameters), dims=1)
        if further is not None:
            jacobian = torch.cat([jacobian, further], dim=2)
        weighted = self.moments.gram @ jacobian
        loss = torch.einsum("nq,nqr,nr->n", p, self.moments.gram, p)
        gradient = (p[:, None, :] @ weighted)[:, 0]
        return NormalEquations(loss, gradient, jacobian.transpose(1, 2) @ weighted)

    def normal_equations(self, parameters: Parameters) -> NormalEquations:
        """Return loss, gradient and Gauss-Newton Hessian, summed over the images."""
        a = _of_planes(parameters).flatten()
        jacobian = _jacobian(parameters).flatten(0, 1)
        weighted = self._joint @ jacobian
        # Each image's loss by itself has lost fewer digits than a @ Q @ a.
        return NormalEquations(self.loss(parameters), a @ weighted, jacobian.T @ weighted)


def residual_vectors(moments: ImageMoments, parameters: Parameters) -> Float[Tensor, "N S"]:
    """Return p_i = (b outer R^T m_i, m_i . t + e_i), shape (N, S), S = 3C + 1."""
    return _planes(moments) @ _of_planes(parameters)


def _planes(moments: ImageMoments) -> Float[Tensor, "N 4"]:
    """Return each image's plane in the tool frame, normal and offset."""
    return torch.cat([moments.normal_tool, moments.offset_tool[:, None]], dim=1)


def _of_planes(parameters: Parameters) -> Float[Tensor, "4 S"]:
    """Return the matrix A whose rows a plane (m_i, e_i) sums to its residual vector."""
    rotation, translation = parameters.tool_from_camera[:3].split([3, 1], dim=1)
    b = torch.cat([parameters.coefficients.new_ones(1), -parameters.coefficients])
    normals = torch.cat([(b[None, :, None] * rotation[:, None, :]).flatten(1), translation], dim=1)
    offset = torch.nn.functional.pad(normals.new_ones(1, 1), (normals.shape[1] - 1, 0))
    return torch.cat([normals, offset])


def _jacobian(parameters: Parameters) -> Float[Tensor, "4 S P"]:
    """Return the derivative of A by a step."""
    rotation = parameters.tool_from_camera[:3, :3]
    num = parameters.coefficients.numel()
    b = torch.cat([parameters.coefficients.new_ones(1), -parameters.coefficients])
    jacobian = rotation.new_zeros(4, 3 * (1 + num) + 1, parameters.size)
    first = parameters.twist_size
    if parameters.hand_eye_is_free:
        # (R exp(w))^T m = exp(-w) a = a + a x w: the derivative is the cross matrix of a.
        jacobian[:3, -1, :3] = rotation
        turned = b[None, :, None, None] * _cross_matrix(rotation)[:, None]
        jacobian[:3, :-1, 3:6] = turned.flatten(1, 2)
    for k in range(num):
        jacobian[:3, 3 * (k + 1) : 3 * (k + 2), first + k] = -rotation
    return jacobian


def _cross_matrix(vectors: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3 3"]:
    """Return [v]x with [v]x w = v x w, shape (N, 3, 3)."""
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(-1, 3, 3)
