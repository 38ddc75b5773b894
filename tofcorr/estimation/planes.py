r"""Walls in unknown places, estimated together with the hand-eye and the coefficients.

A wall of the world is n . x + d = 0; images of one wall share it, whatever the robot's pose. It has
three degrees of freedom: the normal turns by a small vector a in its tangent plane,
:math:`n' = (n + T a) / |n + T a|`, and d shifts. The residual of an image stays a product with its
moments, so that no further pass over the pixels is needed.

The robot's base fixes the world frame, so there is no gauge to fix. Where the poses cannot separate
wall, hand-eye and constant error (t_z, d and c0 without tilt), the direction is reported as
undetermined like any other.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tofcorr.estimation.linear import NormalEquations
from tofcorr.estimation.moments import ImageMoments
from tofcorr.estimation.objective import MomentObjective
from tofcorr.estimation.parameters import Parameters
from tofcorr.geometry.planes import plane_in_frame, tangents

# Keeps undetermined directions where they started: a prior of 100 mm and 100 mrad, weighed against
# residuals of 1 mm, in square metres. That is too weak to move what the images do determine,
# however far off the walls were recorded.
_RIDGE = (1e-3 / 0.1) ** 2
# Most steps; a few tens are usual. Set by hand.
_MOST_STEPS = 100
# Length of the last step, in standard errors: the default tolerance of the solvers.
_CONVERGED = 1e-6
# Damping relative to the curvature, at the start, at least and at most (Marquardt's). Beyond the
# largest, a step is too short to change the loss. Set by hand.
_FIRST_DAMPING = 1e-9
_LEAST_DAMPING = 1e-12
_LARGEST_DAMPING = 1e9


@dataclass(frozen=True)
class Walls:
    """Walls of the world, and which image shows which.

    Attributes:
        normal_world: Unit normals, shape (G, 3).
        offset: d of n . x + d = 0, shape (G,), metres.
        index: The wall of each image, shape (N,).
        world_from_tool: The pose of each image, shape (N, 4, 4).
    """

    normal_world: Float[Tensor, "G 3"]
    offset: Float[Tensor, "G"]
    index: Int[Tensor, "N"]
    world_from_tool: Float[Tensor, "N 4 4"]

    @property
    def size(self) -> int:
        """How many unknowns the walls have: three each."""
        return 3 * len(self.offset)

    def moved(self, step: Float[Tensor, "{self.size}"]) -> "Walls":
        """Return the walls after a step (3G,): two turns in radians and a shift in metres each."""
        change = step.view(-1, 3)
        turned = self.normal_world + (change[:, :2, None] * self.tangents()).sum(dim=1)
        normal = torch.nn.functional.normalize(turned, dim=1)
        return replace(self, normal_world=normal, offset=self.offset + change[:, 2])

    def tangents(self) -> Float[Tensor, "G 2 3"]:
        """Return two unit vectors across each normal, shape (G, 2, 3)."""
        return tangents(self.normal_world)

    def seen_by(self, moments: ImageMoments) -> ImageMoments:
        """Return the moments with these walls in place of those recorded."""
        normal, offset = plane_in_frame(
            self.normal_world[self.index], self.offset[self.index], self.world_from_tool
        )
        return replace(moments, normal_tool=normal, offset_tool=offset)

    def jacobian(
        self, moments: ImageMoments, parameters: Parameters
    ) -> Float[Tensor, "N S {self.size}"]:
        """Return the derivative of each image's residual vector by a step, (N, 3C + 1, 3G)."""
        tangents = self.tangents()[self.index]
        in_tool = tangents @ self.world_from_tool[:, :3, :3]
        lever = (tangents * self.world_from_tool[:, None, :3, 3]).sum(dim=-1)
        rotation, translation = (
            parameters.tool_from_camera[:3, :3],
            parameters.tool_from_camera[:3, 3],
        )
        b = torch.cat([parameters.coefficients.new_ones(1), -parameters.coefficients])
        in_camera = in_tool @ rotation
        rows = (b[None, :, None, None] * in_camera.transpose(1, 2)[:, None]).flatten(1, 2)
        own = rows.new_zeros(len(rows), rows.shape[1] + 1, 3)
        own[:, :-1, :2] = rows
        own[:, -1, :2] = in_tool @ translation + lever
        own[:, -1, 2] = 1.0
        everywhere = own.new_zeros(*own.shape[:2], len(self.offset), 3)
        everywhere[torch.arange(len(own)), :, self.index] = own
        return everywhere.flatten(2)


def joint_image_equations(
    moments: ImageMoments, parameters: Parameters, walls: Walls | None
) -> NormalEquations:
    """Return each image's normal equations in the unknowns and, after them, those of the walls."""
    objective = MomentObjective(moments)
    if walls is None:
        return objective.image_equations(parameters)
    return objective.image_equations(parameters, walls.jacobian(moments, parameters))


def marginal_hessian(
    moments: ImageMoments, parameters: Parameters, walls: Walls | None
) -> Float[Tensor, "P P"]:
    """Return the curvature (P, P) of the loss minimised over the walls: a Schur complement."""
    hessian = joint_image_equations(moments, parameters, walls).hessian.sum(dim=0)
    if walls is None:
        return hessian
    size = parameters.size
    own, cross, other = hessian[:size, :size], hessian[:size, size:], hessian[size:, size:]
    scale = other.diagonal().clamp(min=1e-300).sqrt()
    inverse = torch.linalg.pinv(other / scale[:, None] / scale[None, :], hermitian=True)
    return own - cross / scale @ inverse @ (cross / scale).T


def estimate_walls(
    moments: ImageMoments,
    start: Parameters,
    walls: Walls,
    prior: NormalEquations | None = None,
    most_steps: int = _MOST_STEPS,
) -> tuple[Parameters, Walls]:
    """Minimise the loss over the unknowns and the walls together (Levenberg-Marquardt).

    Args:
        moments: Of the images.
        start: The unknowns, fitted with the walls as recorded.
        walls: The walls as recorded: where to start.
        prior: A prior's normal equations at `start`; None: there is no prior.
        most_steps: Steps after which it ends in any case.
    """
    total = torch.zeros(start.size + walls.size, dtype=torch.float64)
    num_residuals = float(moments.count.sum().clamp(min=1))
    if prior is not None:
        prior = _padded(prior, len(total))
    parameters, here, damping = start, walls, _FIRST_DAMPING
    for _ in range(most_steps):
        equations = _with_prior(
            joint_image_equations(here.seen_by(moments), parameters, here), total, prior
        )
        step = -_solve(equations, 0.0)
        if (
            float(-(step @ equations.gradient))
            < _CONVERGED**2 * float(equations.loss) / num_residuals
        ):
            break
        better = None
        while better is None and damping < _LARGEST_DAMPING:
            step = -_solve(equations, damping)
            trial = parameters.moved(step[: start.size]), here.moved(step[start.size :])
            change = total + step
            loss = _loss(moments, *trial, change, prior)
            better = trial if loss <= equations.loss else None
            damping = max(damping / 10, _LEAST_DAMPING) if better else damping * 10
        if better is None:
            break
        (parameters, here), total = better, total + step
    return parameters.detached(), here


def _padded(prior: NormalEquations, size: int) -> NormalEquations:
    own = len(prior.gradient)
    gradient = torch.zeros(size, dtype=torch.float64)
    hessian = torch.zeros(size, size, dtype=torch.float64)
    gradient[:own], hessian[:own, :own] = prior.gradient, prior.hessian
    return NormalEquations(prior.loss, gradient, hessian)


def _with_prior(
    each: NormalEquations, total: Float[Tensor, "P"], prior: NormalEquations | None
) -> NormalEquations:
    loss, gradient, hessian = (part.sum(dim=0) for part in each)
    loss = loss + _RIDGE * total @ total
    gradient = gradient + _RIDGE * total
    hessian = hessian + _RIDGE * torch.eye(len(total), dtype=torch.float64)
    if prior is not None:
        loss = loss + 2 * prior.gradient @ total + total @ prior.hessian @ total
        gradient = gradient + prior.gradient + prior.hessian @ total
        hessian = hessian + prior.hessian
    return NormalEquations(loss, gradient, hessian)


def _loss(
    moments: ImageMoments,
    parameters: Parameters,
    walls: Walls,
    total: Float[Tensor, "P"],
    prior: NormalEquations | None,
) -> Float[Tensor, ""]:
    loss = MomentObjective(walls.seen_by(moments)).loss(parameters) + _RIDGE * total @ total
    if prior is not None:
        loss = loss + 2 * prior.gradient @ total + total @ prior.hessian @ total
    return loss


def _solve(equations: NormalEquations, damping: float) -> Float[Tensor, "P"]:
    scale = equations.hessian.diagonal().clamp(min=1e-300).sqrt()
    hessian = equations.hessian / scale[:, None] / scale[None, :]
    damped = hessian + damping * torch.eye(len(scale), dtype=torch.float64)
    return torch.linalg.solve(damped, equations.gradient / scale) / scale
