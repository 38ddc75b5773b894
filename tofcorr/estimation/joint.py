"""Several cameras and what they share, estimated together: walls, and offsets of a robot's joints.

The unknowns of each camera come first, then those of the walls, then those of the joints. A wall
that two cameras see, and a joint that carries both, couple them; without such there is nothing to
do together. Each camera has its moments, so that no pixel is read again.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tofcorr.estimation.linear import NormalEquations
from tofcorr.estimation.moments import ImageMoments, MomentObjective, Parameters
from tofcorr.estimation.planes import Planes, Walls
from tofcorr.estimation.solvers import SolverOptions, minimise
from tofcorr.geometry.arm import PosedArm


@dataclass(frozen=True)
class View:
    """What one camera saw of the walls, and where the robot held it.

    Attributes:
        moments: Of its images.
        walls: Which wall each image shows, and from where, as recorded. Where the walls are
            estimated they are those of all cameras.
        arm: The robot at each image; None: its joints are exact.
        weight: What its loss counts beside that of the others.
    """

    moments: ImageMoments
    walls: Walls
    arm: PosedArm | None = None
    weight: float = 1.0


@dataclass(frozen=True, kw_only=True)
class Together(Parameters):
    """The unknowns of one camera and, after them, of further ones, of the walls and of the joints.

    Attributes:
        others: The further cameras.
        planes: The walls; None: they are known.
        offsets: What is added to each joint angle that is estimated, shape (J,), radians or metres.
        sigmas: Standard deviations of their priors, shape (J,).
        total: The sum of all steps from the start.
    """

    others: tuple[Parameters, ...] = ()
    planes: Planes | None = None
    offsets: Float[Tensor, "J"]
    sigmas: Float[Tensor, "J"]
    total: Float[Tensor, "P"]

    @classmethod
    def start(
        cls,
        cameras: Sequence[Parameters],
        planes: Planes | None,
        offsets: Float[Tensor, "J"],
        sigmas: Float[Tensor, "J"],
    ) -> "Together":
        """Return unknowns from which no step was taken."""
        first, *others = cameras
        size = sum(one.size for one in cameras) + (0 if planes is None else planes.size)
        total = torch.zeros(size + len(offsets), dtype=torch.float64)
        shared = {"planes": planes, "offsets": offsets, "sigmas": sigmas, "total": total}
        return cls(**vars(first), others=tuple(others), **shared)

    @property
    def size(self) -> int:
        """How many unknowns there are."""
        return len(self.total)

    @property
    def cameras(self) -> tuple[Parameters, ...]:
        """The unknowns of each camera."""
        own = Parameters(self.tool_from_camera, self.coefficients, self.hand_eye_is_free)
        return own, *self.others

    @property
    def _sizes(self) -> list[int]:
        planes = 0 if self.planes is None else self.planes.size
        return [*(one.size for one in self.cameras), planes, len(self.offsets)]

    def places(self) -> list[Int[Tensor, "_"]]:
        """Return which unknowns are those of each camera, then of the walls and of the joints."""
        return list(torch.arange(self.size).split(self._sizes))

    def moved(self, step: Float[Tensor, "P"]) -> "Together":
        """Return all unknowns after a step."""
        *own, of_planes, of_joints = step.split(self._sizes)
        moved = [one.moved(part) for one, part in zip(self.cameras, own, strict=True)]
        planes = None if self.planes is None else self.planes.moved(of_planes)
        offsets, total = self.offsets + of_joints, self.total + step
        return replace(self.with_cameras(moved), planes=planes, offsets=offsets, total=total)

    def with_cameras(self, cameras: Sequence[Parameters]) -> "Together":
        """Return the unknowns with those of the cameras replaced."""
        return replace(self, **vars(cameras[0]), others=tuple(cameras[1:]))

    def walls_of(self, view: View) -> Walls:
        """Return the walls as a camera sees them from these poses."""
        walls = view.walls
        if self.planes is not None:
            walls = replace(walls, **vars(self.planes))
        if view.arm is not None:
            walls = replace(walls, world_from_tool=view.arm.poses(self.offsets))
        return walls

    def equations(self, view: View, number: int) -> NormalEquations:
        """Return the normal equations of each image of a camera, in all unknowns."""
        own, places, walls = self.cameras[number], self.places(), self.walls_of(view)
        moments, further = walls.seen_by(view.moments), list[Tensor]()
        if self.planes is not None:
            further.append(walls.jacobian(moments, own))
        if view.arm is not None:
            slopes = moments.planes[:, None, None, :] @ view.arm.motions(self.offsets)
            further.append((slopes[:, :, 0] @ own.by_entries()).mT)
        joint = torch.cat(further, dim=2) if further else None
        found = MomentObjective(moments).image_equations(own, joint)
        there = torch.cat([places[number], *(places[-2:] if further else ())])
        count = len(found.loss)
        gradient = found.gradient.new_zeros(count, self.size)
        hessian = found.hessian.new_zeros(count, self.size, self.size)
        gradient[:, there] = found.gradient
        hessian[:, there[:, None], there] = found.hessian
        return NormalEquations(*(view.weight * part for part in (found.loss, gradient, hessian)))

    def all_equations(self, views: Sequence[View]) -> NormalEquations:
        """Return the normal equations of each image of all cameras, in all unknowns."""
        each = [self.equations(view, number) for number, view in enumerate(views)]
        return NormalEquations(*(torch.cat(parts) for parts in zip(*each, strict=True)))


class _JointObjective(MomentObjective):
    """The loss of several cameras as a function of all unknowns, with a prior."""

    def __init__(self, views: Sequence[View], prior: NormalEquations) -> None:
        super().__init__(views[0].moments)
        self._views, self._held = views, prior

    def normal_equations(self, parameters: Parameters) -> NormalEquations:
        """Return loss, gradient and Gauss-Newton Hessian for a step."""
        # Every point that the solver asks for is a step from the start.
        assert isinstance(parameters, Together)
        images = parameters.all_equations(self._views)
        return images.total().plus(self._held.at(parameters.total))


def estimate_together(
    views: Sequence[View],
    start: Together,
    prior: NormalEquations | None = None,
    solver: SolverOptions | None = None,
) -> Together:
    """Minimise the loss over the unknowns of all cameras and what they share.

    Args:
        views: What each camera saw.
        start: The unknowns of each camera, fitted alone, and what is shared as recorded.
        prior: A prior's normal equations at the start, on all unknowns or on the first of them;
            None: there is no prior.
        solver: How far; None: 100 steps at most.
    """
    # Keeps undetermined directions where they started: a prior of 100 mm and 100 mrad, weighed
    # against residuals of 1 mm, in square metres. That is too weak to move what the images do
    # determine, however far off the walls were recorded.
    ridge = torch.eye(start.size, dtype=torch.float64) / 100**2
    held = NormalEquations(ridge.new_zeros(()), ridge.new_zeros(start.size), ridge).plus(prior)
    solver = solver or SolverOptions(max_iterations=100)
    end = minimise(_JointObjective(views, held), start, solver).parameters
    assert isinstance(end, Together)
    return end


def estimate_walls(
    moments: ImageMoments,
    start: Parameters,
    walls: Walls,
    prior: NormalEquations | None = None,
    most_steps: int = 100,
) -> tuple[Parameters, Walls]:
    """Minimise the loss over the unknowns of one camera and the walls together.

    Args:
        moments: Of the images.
        start: The unknowns, fitted with the walls as recorded.
        walls: The walls as recorded: where to start.
        prior: A prior's normal equations at `start`; None: there is no prior.
        most_steps: Steps after which it ends in any case.
    """
    view, planes = View(moments, walls), Planes(walls.normal_world, walls.offset)
    together = Together.start([start], planes, *walls.offset.new_zeros(2, 0))
    end = estimate_together([view], together, prior, SolverOptions(max_iterations=most_steps))
    return end.cameras[0], end.walls_of(view)
