"""Hand-eye and walls fitted together, to the points that stand for the planes."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tofcorr.estimation.linear import NormalEquations
from tofcorr.estimation.moments import ImageMoments
from tofcorr.estimation.objective import Parameters
from tofcorr.estimation.planes import Walls, estimate_walls
from tofcorr.estimation.statistics import robust_weights
from tofcorr.estimation.uncertainty import PRIOR_SIGMA
from tofcorr.geometry import se3
from tofcorr.importing.walls.gathering import WallPlanes, distances, points_in_world
from tofcorr.importing.walls.seen_planes import SeenPlanes
from tofcorr.spread import sigma_from_mad

# What a camera that is not calibrated yet is off by: a constant (metres), and a share of the
# distance. Both are held to that much, so that they cannot stand in for the hand-eye.
_CONSTANT, _SLOPE = 0.05, 0.02
# A constant (metres) and a slope that no camera has: planes that need more do not coincide. Ten
# standard deviations of the above; mirrored images would coincide behind the camera, at a slope of
# two.
_IMPOSSIBLE_CONSTANT, _IMPOSSIBLE_SLOPE = 0.5, 0.2
# What the prior on both is multiplied with where they are held at zero: it leaves micrometres.
_STIFF = 1e8
# Standard deviation of a plane's place under those two alone, metres: what the rest of an
# uncalibrated camera's error typically measures.
TYPICAL = 0.01
# How often planes are assigned to walls anew, and reweighted within one fit. Set by hand:
# assignments rarely change after the second time.
_PASSES = 6
_REWEIGHTINGS = 4
# Steps of the fit between two reweightings. Set by hand: weights of planes that coincide settle
# with fewer, and those of planes that never will are not worth more.
_FEW_STEPS = 4
# A plane farther from every wall than this many typical deviations is an outlier, but never one
# nearer than the least gate (metres). Set by hand: five deviations come by chance in one of a
# million planes, and 50 mm are five times a typical camera's error.
_GATE, _LEAST_GATE = 5.0, 0.05


@dataclass(frozen=True)
class Joint:
    """Hand-eye and walls, and which plane shows which wall.

    Attributes:
        parameters: The hand-eye transform; a constant and a slope of the camera's error.
        walls: The walls.
        wall: The wall of each plane, shape (M,); -1: none.
        deviation: How far each plane is from the wall nearest it, shape (M,), metres; infinite
            where it is turned away from all of them.
    """

    parameters: Parameters
    walls: WallPlanes
    wall: Tensor
    deviation: Tensor

    @property
    def tool_from_camera(self) -> Tensor:
        """The hand-eye transform, shape (4, 4)."""
        return self.parameters.tool_from_camera

    def reordered(self, order: Tensor) -> "Joint":
        """Return the fit with its walls in another order (G,)."""
        rank = torch.cat([order.argsort(), torch.tensor([-1])])
        walls = WallPlanes(self.walls.normal[order], self.walls.offset[order])
        return replace(self, walls=walls, wall=rank[self.wall])

    def cost(self) -> float:
        """Return how badly planes lie on walls: squared deviations, 9 at most a plane; 1 a wall.

        The unit is twice the typical deviation.
        """
        off = (self.deviation / (2 * TYPICAL)).square().clamp(max=9.0)
        return float(off.sum()) + len(self.walls)


def fit_jointly(planes: SeenPlanes, tool_from_camera: Tensor, walls: WallPlanes) -> Joint:
    """Fit hand-eye, walls and a constant error, planes that lie on no wall counting for little.

    Args:
        planes: The planes of all images.
        tool_from_camera: Where to start, shape (4, 4).
        walls: Where to start, some centimetres off.
    """
    start = Parameters(tool_from_camera, torch.zeros(2, dtype=torch.float64))
    joint = _assigned(planes, start, walls)
    for _ in range(_PASSES):
        before = joint.wall
        chosen = joint.wall >= 0
        if not bool(chosen.any()):
            return joint
        parameters, walls = fit_assigned(
            planes.take(chosen), joint.wall[chosen], joint.parameters, joint.walls, tool_from_camera
        )
        joint = _assigned(planes, parameters, walls)
        if bool((joint.wall == before).all()):
            break
    return joint


def fit_assigned(
    planes: SeenPlanes, wall: Tensor, start: Parameters, walls: WallPlanes, centre: Tensor
) -> tuple[Parameters, WallPlanes]:
    """Fit hand-eye and walls to planes whose walls are known, robustly.

    Args:
        planes: The planes.
        wall: The wall of each, shape (M,).
        start: Hand-eye and error to start from.
        walls: Walls to start from.
        centre: Where the hand-eye transform (4, 4) stays in what the planes leave open.
    """
    moments = point_moments(planes)
    found = Walls(walls.normal, walls.offset, wall, planes.world_from_tool)
    for _ in range(_REWEIGHTINGS):
        weight = _robust(planes, start, found)
        weighted = moments.weighted(weight)
        fitted = estimate_walls(weighted, start, found, _held(start, centre), _FEW_STEPS)
        if _is_impossible(fitted[0]):
            none = replace(start, coefficients=torch.zeros_like(start.coefficients))
            fitted = estimate_walls(weighted, none, found, _held(none, centre, _STIFF), _FEW_STEPS)
        start, found = fitted
    return start, WallPlanes(found.normal_world, found.offset)


def point_moments(planes: SeenPlanes) -> ImageMoments:
    """Return the moments of the planes' points, with a constant and a slope for coefficients.

    Normals and offsets in the tool frame are left at zero: walls put theirs in.
    """
    distance = planes.points.norm(dim=2, keepdim=True)
    ray = planes.points / distance
    columns = torch.cat([distance, torch.ones_like(distance), distance], dim=2)
    product = (columns[:, :, :, None] * ray[:, :, None, :]).flatten(2)
    product = torch.cat([product, torch.ones_like(distance)], dim=2)
    count, zero = len(planes), torch.zeros(len(planes), dtype=torch.float64)
    return ImageMoments(
        gram=product.transpose(1, 2) @ product,
        normal_tool=torch.zeros(count, 3, dtype=torch.float64),
        offset_tool=zero,
        count=torch.full_like(zero, planes.points.shape[1]),
        symbols=["c0", "slope"],
    )


def held_error() -> Tensor:
    """Return half the Hessian of the prior on constant and slope, shape (8, 8)."""
    hessian = torch.zeros(8, 8, dtype=torch.float64)
    hessian[-2, -2], hessian[-1, -1] = (TYPICAL / _CONSTANT) ** 2, (TYPICAL / _SLOPE) ** 2
    return hessian


def _is_impossible(parameters: Parameters) -> bool:
    constant, slope = parameters.coefficients.abs().tolist()
    return constant > _IMPOSSIBLE_CONSTANT or slope > _IMPOSSIBLE_SLOPE


def _held(start: Parameters, centre: Tensor, stiff: float = 1.0) -> NormalEquations:
    """Return the normal equations of the prior: a small error, a hand-eye near `centre` (4, 4).

    Along what the images determine it is far too weak to matter, unless `stiff` holds the error.
    """
    hessian = stiff * held_error()
    hessian[:6, :6] = torch.eye(6).double() * (TYPICAL / PRIOR_SIGMA) ** 2
    turned = se3.log(se3.inverse(centre) @ start.tool_from_camera)
    step = torch.cat([turned, start.coefficients])
    return NormalEquations(step @ hessian @ step, hessian @ step, hessian)


def _robust(planes: SeenPlanes, parameters: Parameters, walls: Walls) -> Tensor:
    """Return how much each plane counts, shape (M,): Cauchy's weights of its distance."""
    points = points_in_world(corrected(planes, parameters), parameters.tool_from_camera)
    off = (points * walls.normal_world[walls.index][:, None]).sum(dim=2)
    off = (off + walls.offset[walls.index][:, None]).square().mean(dim=1).sqrt()
    return robust_weights(off / max(sigma_from_mad(float(off.median())), TYPICAL / 10), "cauchy")


def corrected(planes: SeenPlanes, parameters: Parameters) -> SeenPlanes:
    """Return the planes with the constant and the slope taken off their points' distances."""
    constant, slope = parameters.coefficients
    distance = planes.points.norm(dim=2, keepdim=True)
    return replace(planes, points=planes.points * (1 - slope - constant / distance))


def _assigned(planes: SeenPlanes, parameters: Parameters, walls: WallPlanes) -> Joint:
    """Give each plane the wall nearest it, at most one plane of an image to each wall."""
    count = len(planes)
    if not len(walls):
        nothing = torch.full((count,), torch.inf, dtype=torch.float64)
        return Joint(parameters, walls, torch.full((count,), -1), nothing)
    distance = distances(corrected(planes, parameters), parameters.tool_from_camera, walls)
    if planes.label is not None:
        other = torch.arange(len(walls)) != planes.label[:, None]
        distance = torch.where(other, torch.inf, distance)
    deviation, wall = distance.min(dim=1)
    typical = deviation[deviation.isfinite()]
    gate = _LEAST_GATE
    if len(typical):
        gate = max(gate, _GATE * float(typical.median()))
    wall = torch.where(deviation <= gate, wall, -1)
    order = deviation.argsort(stable=True).tolist()
    taken: set[tuple[int, int]] = set()
    for k in order:
        key = (int(planes.image[k]), int(wall[k]))
        if key in taken and key[1] >= 0:
            wall[k] = -1
        taken.add(key)
    return Joint(parameters, walls, wall, deviation)
