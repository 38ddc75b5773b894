r"""The change of the loss by a step, with its gradient in closed form.

The loss is a^T Q a, with a the entries of the matrix A of the unknowns (see `objective`). A step
changes a by d, and the loss by

.. math:: d^T (2 Q a + Q d) , \quad \text{gradient} \quad 2 J_d^T (Q a + Q d) .

With autograd through all these small operations a fit's L-BFGS took 9.7 ms in place of 5.8.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from tofcorr.estimation.parameters import Parameters
from tofcorr.geometry.se3_slope import exp_minus_identity_with_slope


class ChangeOfLoss(torch.autograd.Function):
    """Change of a^T Q a by a step, differentiable in the step, once."""

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,  # noqa: ANN401 - torch's own
        step: Float[Tensor, "P"],
        origin: Parameters,
        joint: Float[Tensor, "E E"],
        slope: Float[Tensor, "E"],
    ) -> Float[Tensor, ""]:
        """Return the change.

        Args:
            ctx: Keeps the gradient.
            step: As in `Parameters.moved`.
            origin: Where the step begins.
            joint: Q.
            slope: Q a at the origin. It is rounded in the same way whatever the step, so its
                rounding tilts the loss a little and adds no noise, in which a line search near the
                optimum would get lost.
        """
        moving = _Moving(origin, step)
        change = moving.change.flatten()
        further = joint @ change
        if ctx.needs_input_grad[0]:
            ctx.gradient = moving.gradient((2 * (slope + further)).view_as(moving.change))
        return change @ (2 * slope + further)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None, None]:  # type: ignore[override] # noqa: ANN401
        """Return the gradient by the step."""
        return gradient * ctx.gradient, None, None, None


class _Moving:
    """A step from a point, and what it changes of A.

    Attributes:
        change: Of A, without subtracting, shape (4, S).
    """

    def __init__(self, origin: Parameters, step: Float[Tensor, "P"]) -> None:
        self._rotation = origin.tool_from_camera[:3, :3]
        change_of_b = torch.cat([step.new_zeros(1), -step[origin.twist_size :]])
        self._b = torch.cat([step.new_ones(1), -origin.coefficients]) + change_of_b
        self._by_twist: Tensor | None = None
        normals = change_of_b[None, :, None] * self._rotation[:, None, :]
        self.change = step.new_zeros(4, normals[0].numel() + 1)
        self._to = self._rotation
        if origin.hand_eye_is_free:
            moved, self._by_twist = exp_minus_identity_with_slope(step[:6])
            turned = self._rotation @ moved[:3]
            normals += self._b[None, :, None] * turned[:, None, :3]
            self._to = self._rotation + turned[:, :3]
            self.change[:3, -1] = turned[:, 3]
        self.change[:3, :-1] = normals.flatten(1)

    def gradient(self, by_change: Float[Tensor, "4 S"]) -> Float[Tensor, "P"]:
        """Return the gradient by the step of what has this one by `change`."""
        normals = by_change[:3, :-1].unflatten(1, (-1, 3))
        by_coefficient = -(normals * self._to[:, None]).sum((0, 2))[1:]
        if self._by_twist is None:
            return by_coefficient
        turned = (normals * self._b[:, None]).sum(1)
        by_moved = self._rotation.T @ torch.cat([turned, by_change[:3, -1:]], dim=1)
        return torch.cat([(self._by_twist[:, :3] * by_moved).sum((1, 2)), by_coefficient])
