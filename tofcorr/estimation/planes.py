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
from typing import TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tofcorr.estimation.linear import Curvature, NormalEquations
from tofcorr.estimation.moments import ImageMoments, MomentObjective, Parameters
from tofcorr.geometry.rays import plane_in_frame, plane_moves, tangents

PlanesT = TypeVar("PlanesT", bound="Planes")


@dataclass(frozen=True)
class Planes:
    """Planes of the world.

    Attributes:
        normal_world: Unit normals, shape (G, 3).
        offset: d of n . x + d = 0, shape (G,), metres.
    """

    normal_world: Float[Tensor, "G 3"]
    offset: Float[Tensor, "G"]

    @property
    def size(self) -> int:
        """How many unknowns the planes have: three each."""
        return 3 * len(self.offset)

    def moved(self: PlanesT, step: Float[Tensor, "{self.size}"]) -> PlanesT:
        """Return the planes after a step (3G,): two turns in radians and a shift in metres each."""
        change = step.view(-1, 3)
        turned = self.normal_world + (change[:, :2, None] * tangents(self.normal_world)).sum(dim=1)
        normal = torch.nn.functional.normalize(turned, dim=1)
        return replace(self, normal_world=normal, offset=self.offset + change[:, 2])


@dataclass(frozen=True)
class Walls(Planes):
    """Walls of the world, and which image shows which.

    Attributes:
        index: The wall of each image, shape (N,).
        world_from_tool: The pose of each image, shape (N, 4, 4).
    """

    index: Int[Tensor, "N"]
    world_from_tool: Float[Tensor, "N 4 4"]

    def seen_by(self, moments: ImageMoments) -> ImageMoments:
        """Return the moments with these walls in place of those recorded."""
        walls = self.normal_world[self.index], self.offset[self.index]
        normal, offset = plane_in_frame(*walls, self.world_from_tool)
        return replace(moments, normal_tool=normal, offset_tool=offset)

    def jacobian(
        self, moments: ImageMoments, parameters: Parameters
    ) -> Float[Tensor, "N S {self.size}"]:
        """Return the derivative of each image's residual vector by a step, (N, 3C + 1, 3G)."""
        moves = plane_moves(self.normal_world)[self.index] @ self.world_from_tool
        own = (moves @ parameters.by_entries()).mT
        everywhere = own.new_zeros(*own.shape[:2], len(self.offset), 3)
        everywhere[torch.arange(len(own)), :, self.index] = own
        return everywhere.flatten(2)


def within_prior(
    moments: ImageMoments, at: Parameters, precision: Float[Tensor, "N 3 3"]
) -> ImageMoments:
    r"""Return moments whose loss is the least over each image's plane, within a prior.

    With the moves J of the residual vector p by two turns and a shift, and their precision P,

    .. math:: \min_\delta\, (p + J\delta)^T G\, (p + J\delta) + \delta^T P \delta
        = p^T \big(G - G J (J^T G J + P)^{-1} J^T G\big) p ,

    which is generalised least squares with the residuals' covariance :math:`1 + J P^{-1} J^T`.

    Args:
        moments: Of the images, with their planes as measured.
        at: Parameters near the solution; the moves hardly depend on them.
        precision: Inverse covariance of the steps of `plane_moves` in the tool frame, in the unit
            of the loss.
    """
    moves = (plane_moves(moments.normal_tool) @ at.by_entries()).mT
    lever = moments.gram @ moves
    moved = lever @ torch.linalg.solve(moves.mT @ lever + precision, lever.mT)
    return replace(moments, gram=moments.gram - moved)


def joint_image_equations(
    moments: ImageMoments, parameters: Parameters, walls: Walls | None
) -> NormalEquations:
    """Return each image's normal equations in the unknowns and, after them, those of the walls."""
    further = None if walls is None else walls.jacobian(moments, parameters)
    return MomentObjective(moments).image_equations(parameters, further)


def marginal_hessian(
    moments: ImageMoments, parameters: Parameters, walls: Walls | None
) -> Float[Tensor, "P P"]:
    """Return the curvature (P, P) of the loss minimised over the walls."""
    hessian = joint_image_equations(moments, parameters, walls).hessian.sum(dim=0)
    return marginal(hessian, torch.arange(parameters.size))


def marginal(hessian: Float[Tensor, "Q Q"], own: Int[Tensor, "P"]) -> Float[Tensor, "P P"]:
    """Return the curvature of some unknowns of a loss minimised over the others: Schur's."""
    others = torch.ones(len(hessian), dtype=torch.bool)
    others[own] = False
    if not bool(others.any()):
        return hessian
    cross = hessian[own][:, others]
    return hessian[own][:, own] - cross @ Curvature(hessian[others][:, others]).inverse @ cross.T
