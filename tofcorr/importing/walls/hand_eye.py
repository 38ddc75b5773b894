r"""Planes of many images gathered into walls, and the hand-eye transform with them.

A wall of normal :math:`w` is seen by the camera at pose :math:`(R_i, p_i)` with the normal
:math:`m` where :math:`w = R_i X m`, and a point :math:`x` of it lies in the world at
:math:`R_i (X x + t) + p_i`. Which planes show one wall is not known, nor are X and t. For the right
ones the planes of all images fall into a few places; so a start is looked for over all rotations,
by how many pairs of planes of different images agree, and for the best of them over translations.
From each start planes are gathered into walls, and everything is fitted jointly.

A sensor of one ray sees no normals. Before named walls its start is looked for over the directions
of its ray.

Walls of the world are rows (n, d) of n . x + d = 0, shape (G, 4), metres, n towards the camera.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from tofcorr.estimation.joint import estimate_walls
from tofcorr.estimation.linear import NormalEquations
from tofcorr.estimation.moments import ImageMoments, Parameters
from tofcorr.estimation.planes import Walls
from tofcorr.estimation.robust import robust_weights, sigma_from_mad
from tofcorr.estimation.uncertainty import PRIOR_SIGMA
from tofcorr.geometry import se3
from tofcorr.importing.walls.image_planes import SeenPlanes

TYPICAL = 0.01
"""What an uncalibrated camera's error typically measures, metres, beside a constant and a slope:
the standard deviation of a plane's place. Widths below are multiples of it."""

_TILT = math.radians(4.0)
"""The tilt that a camera's error gives a plane: twice that between two normals of one wall, three
times where the hand-eye is known to some degrees only."""

_ERROR = torch.tensor([0.05, 0.02], dtype=torch.float64)
"""What a camera that is not calibrated yet is off by: a constant (metres), and a share of the
distance. Both are held to that much, so that they cannot stand in for the hand-eye. Ten times as
much no camera has: mirrored images would coincide behind the camera, at a slope of two."""

_GRID = 20_000, math.radians(14.0)
"""Rotations that are tried, drawn evenly, and the width of the search: of so many all but one in a
million places have one nearer than that."""

_USUAL = 0.3
"""Standard deviation of a translation before anything is known of it, metres: tools and brackets
rarely measure more. The search starts there, as far on either side, along each axis."""

_AS_GOOD = 0.02
"""Fits as good as the best, to this share, are alike: the images say nothing of a difference that
small. Then the one nearest the guess is taken."""


def exact(tool_from_camera: Tensor) -> Parameters:
    """Return a hand-eye transform (4, 4) and a camera without error."""
    return Parameters(tool_from_camera, torch.zeros_like(_ERROR))


def distances(points: Tensor, normal: Tensor, walls: Tensor) -> Tensor:
    """Return how far planes are from walls (G, 4), shape (M, G), metres; infinite if turned away.

    The distance is the root mean square of a plane's points' distances.

    Args:
        points: Points of each plane in the world, shape (M, P, 3), metres.
        normal: Its normal there, shape (M, 3).
        walls: The walls.
    """
    off = torch.einsum("mpa,ga->mpg", points, walls[:, :3]) + walls[:, 3]
    facing = normal @ walls[:, :3].T > math.cos(3 * _TILT)
    return torch.where(facing, off.square().mean(dim=1).sqrt(), torch.inf)


def _gather(planes: SeenPlanes, parameters: Parameters, fewest: int) -> Tensor:
    """Gather planes of many images into walls (G, 4), that of most images first.

    Args:
        planes: The planes.
        parameters: The hand-eye transform, known to some centimetres, and the camera's error.
        fewest: Images that make a wall; planes whose walls are known make one each.
    """
    points, normal = planes.in_world(parameters)

    def fitted(members: Tensor) -> Tensor:
        return _plane_of(points[members], normal[members], planes.support[members])

    if planes.label is not None:
        return torch.stack([fitted(planes.label == k) for k in planes.label.unique()])
    left = torch.ones(len(planes), dtype=torch.bool)
    found = [torch.zeros(0, 4, dtype=torch.float64)]
    near = 6 * TYPICAL
    while int(left.sum()) >= fewest:
        # Of a wall that a tenth of the planes show, thirty of 300 propose it. A single image's own
        # error comes on top.
        seeds = left.nonzero()[:, 0]
        seeds = seeds[torch.linspace(0, len(seeds) - 1, min(len(seeds), 300)).long()]
        offset = -(points[seeds].mean(dim=1) * normal[seeds]).sum(dim=1, keepdim=True)
        proposed = torch.cat([normal[seeds], offset], dim=1)
        close = left[:, None] & (distances(points, normal, proposed) < near + 2 * TYPICAL)
        # The most planes; between equals the larger ones.
        best = (close * (1 + planes.support[:, None] / 1000)).sum(dim=0).argmax()
        members, wall = close[:, best], proposed[best]
        for _ in range(3):  # The choice hardly changes after the first.
            wall = fitted(members)
            members = left & (distances(points, normal, wall[None])[:, 0] < near)
            if not bool(members.any()):
                break
        if len(planes.image[members].unique()) < fewest:
            # No other wall has more images than this one.
            break
        found.append(wall[None])
        left &= ~members
    return torch.cat(found)


def _plane_of(points: Tensor, normal: Tensor, weight: Tensor) -> Tensor:
    """Fit a wall (4,) to the points of planes (M, P, 3); each plane's own normal counts as well."""
    share = weight / weight.sum()
    mean = (share[:, None] * points.mean(dim=1)).sum(dim=0)
    centred = points - mean
    second = torch.einsum("m,mpa,mpb->ab", share, centred, centred) / points.shape[1]
    facing = torch.nn.functional.normalize((share[:, None] * normal).sum(dim=0), dim=0)
    vector = torch.linalg.eigh(second).eigenvectors[:, 0]
    vector = vector * torch.where(vector @ facing < 0, -1.0, 1.0)
    # Points along a line leave a turn open: there the images' own normals decide.
    if float(vector @ facing) < math.cos(3 * _TILT):
        vector = facing
    return torch.cat([vector, -(mean @ vector)[None]])


@dataclass(frozen=True)
class Joint:
    """Hand-eye and walls, and which plane shows which wall.

    Attributes:
        parameters: The hand-eye transform; a constant and a slope of the camera's error.
        walls: The walls, shape (G, 4).
        wall: The wall of each plane, shape (M,); -1: none.
        deviation: How far each plane is from the wall nearest it, shape (M,), metres; infinite
            where it is turned away from all of them.
    """

    parameters: Parameters
    walls: Tensor
    wall: Tensor
    deviation: Tensor

    @property
    def tool_from_camera(self) -> Tensor:
        """The hand-eye transform, shape (4, 4)."""
        return self.parameters.tool_from_camera

    def reordered(self, order: Tensor) -> "Joint":
        """Return the fit with its walls in another order (G,)."""
        rank = torch.cat([order.argsort(), torch.tensor([-1])])
        return replace(self, walls=self.walls[order], wall=rank[self.wall])

    def cost(self) -> float:
        """Return how badly planes lie on walls: squared deviations, 9 at most a plane; 1 a wall.

        The unit is twice the typical deviation.
        """
        off = (self.deviation / (2 * TYPICAL)).square().clamp(max=9)
        return float(off.sum()) + len(self.walls)


def match(planes: SeenPlanes, fewest: int) -> Joint:
    """Find the walls that the planes of many images show, and the hand-eye transform with them.

    What the images leave open stays near the identity.

    Args:
        planes: The planes of all images.
        fewest: Images that make a wall.
    """
    # Some 90 planes, sorted by their poses: pairs grow with the square of their number.
    few = planes.take(torch.linspace(0, len(planes) - 1, min(len(planes), 90)).long())
    proposed = []
    for rotation in _candidate_rotations(few):
        translation, agreement = _candidate_translation(few, rotation)
        proposed.append((agreement, se3.assemble(rotation, translation)))
    proposed.sort(key=lambda one: -one[0])
    # Places of a wrong rotation agree by chance alone.
    starts = [start for agreement, start in proposed[:6] if 2 * agreement >= proposed[0][0]]
    return _nearest_of_best([_followed(planes, start, fewest) for start in starts])


def match_single_ray(planes: SeenPlanes) -> Joint:
    """Find a one-pixel sensor's hand-eye and the walls it looked at.

    What cannot be seen, the turn about the ray at least, stays near the identity.

    Args:
        planes: One point an image, its wall known by label.
    """
    assert planes.label is not None
    ray = torch.nn.functional.normalize(planes.points[0, 0], dim=0)
    # Directions spread evenly, some 5 degrees apart: a Fibonacci lattice.
    directions = 1500
    place = torch.arange(directions, dtype=torch.float64) + 0.5
    z, angle = 1 - 2 * place / directions, math.pi * (1 + math.sqrt(5)) * place
    radius = (1 - z.square()).sqrt()
    lattice = torch.stack([radius * angle.cos(), radius * angle.sin(), z], dim=1)
    along = torch.cat([ray[None], lattice])
    loss, origin, walls = _alternated(planes, along)
    fits = []
    # Neighbours on the grid lead to one fit.
    for k in _best_apart(along, -loss, math.cos(3 * _TILT / 2), 12):
        turn = Rotation.align_vectors(along[k : k + 1].numpy(), ray[None].numpy())[0].as_matrix()
        start = se3.assemble(torch.from_numpy(turn), origin[k])
        fitted = _fit_assigned(planes, planes.label, exact(start), walls[k], start)
        points = planes.in_world(fitted[0])[0][:, 0]
        own = fitted[1][planes.label]
        fits.append(Joint(*fitted, planes.label, ((points * own[:, :3]).sum(1) + own[:, 3]).abs()))
    return _nearest_of_best(fits)


def _alternated(planes: SeenPlanes, along: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Fit walls and the sensor's origin in turn for each direction (K, 3) of its ray b.

    At pose (R, p) the sensor reads the distance D to its wall, n . (R (D b + t) + p) + d = 0. With
    the normals fixed, origin t and offsets d are linear; offsets are means over a wall's readings.

    Returns:
        Mean squared deviations (K,), origins (K, 3), and walls (K, G, 4) that face the sensor.
    """
    label, rotation = planes.label, planes.rotation
    assert label is not None
    member = torch.nn.functional.one_hot(label).double()
    share = member / member.sum(dim=0)

    def mean(values: Tensor) -> Tensor:
        """Return the means (K, G, ...) over each wall's readings of values (K, M, ...)."""
        return torch.einsum("mg,km...->kg...", share, values)

    def turned(vectors: Tensor) -> Tensor:
        """Return vectors (K, 3) of the tool in the world at each pose, shape (K, M, 3)."""
        return (rotation @ vectors[:, None, :, None])[..., 0]

    way = planes.points[:, 0].norm(dim=1)[:, None] * turned(along)
    hit = planes.world_from_tool[:, :3, 3] + way
    origin, loss, normal = torch.zeros_like(along), along[:, 0], along
    # An origin is known to 150 mm beforehand, a distance to 10 mm.
    prior = (TYPICAL / (_USUAL / 2)) ** 2
    for _ in range(12):
        points = hit + turned(origin)
        centred = points - mean(points)[:, label]
        second = torch.einsum("mg,kma,kmb->kgab", share, centred, centred)
        normal = torch.linalg.eigh(second).eigenvectors[..., 0]
        own = normal[:, label]
        lever = (own[:, :, None] @ rotation)[:, :, 0]
        lever = lever - mean(lever)[:, label]
        part = (own * hit).sum(dim=2)
        part = part - mean(part)[:, label]
        hessian = lever.mT @ lever + prior * torch.eye(3).double()
        origin = -torch.linalg.solve(hessian, lever.mT @ part[:, :, None])[:, :, 0]
        loss = (part + (lever * origin[:, None]).sum(dim=2)).square().mean(dim=1)
    normal = torch.where((normal * mean(way)).sum(dim=2, keepdim=True) > 0, -normal, normal)
    offset = -(normal * mean(hit + turned(origin))).sum(dim=2, keepdim=True)
    return loss, origin, torch.cat([normal, offset], dim=2)


def _best_apart(vectors: Tensor, score: Tensor, closest: float, most: int) -> list[int]:
    """Return the best of vectors (K, D), none of them with a larger product with a better one."""
    left, found = score.clone(), list[int]()
    while len(found) < most and bool((left > -torch.inf).any()):
        found.append(int(left.argmax()))
        left[vectors @ vectors[found[-1]] > closest] = -torch.inf
        left[found[-1]] = -torch.inf
    return found


def _nearest_of_best(fits: Sequence[Joint]) -> Joint:
    least = min(joint.cost() for joint in fits)
    good = [joint for joint in fits if joint.cost() <= (1 + _AS_GOOD) * least]
    return min(good, key=lambda joint: float(se3.rotation_angle(joint.tool_from_camera)))


def _candidate_rotations(planes: SeenPlanes) -> Tensor:
    """Return rotations tool_from_camera that make normals coincide, the best first.

    Returns:
        Rotations (K, 3, 3): those under which at least half as many pairs agree as under the best,
        no two of which put the normals into the same directions.
    """
    weight = planes.support.sqrt()
    pair = torch.where(planes.may_be_one_wall(), weight[:, None] * weight, 0.0).float().flatten()

    def turned(rotations: Tensor) -> Tensor:
        """Return the normals in the world under each rotation, shape (K, M, 3)."""
        return torch.einsum("mab,kbc,mc->kma", planes.rotation, rotations, planes.normal)

    def score(rotations: Tensor, width: float) -> Tensor:
        """Return the weight of pairs that agree to within about an angle, shape (K,)."""
        # The Gaussian of an angle, through its cosine: falls to 1 / e at the width.
        steep = 1 / (1 - math.cos(width))
        # What is less counts for nothing; exponentials near underflow take five times as long.
        least = math.log(torch.finfo(torch.float32).tiny) / 2
        normals = (turned(part).float() for part in rotations.split(100))
        near = ((steep * (one @ one.mT - 1)).clamp_(min=least) for one in normals)
        return torch.cat([one.exp_().flatten(1) @ pair for one in near]).double()

    number, coarse = _GRID
    fine = coarse / 3
    drawn = Rotation.from_quat(np.random.default_rng(0).normal(size=(number, 4))).as_matrix()
    grid = torch.cat([torch.eye(3).double()[None], torch.from_numpy(drawn)])
    left = score(grid, coarse)
    left[0] = torch.inf  # The identity is refined in any case.
    # The trace of a rotation by an angle a is 1 + 2 cos a.
    found = grid[_best_apart(grid.flatten(1), left, 1 + 2 * math.cos(coarse), 80)]
    # From wide to narrow: the best of each rotation's neighbours, if it is better. Where the poses
    # say nothing of a turn, none is made.
    cube = torch.cartesian_prod(*[torch.tensor([0.0, -1.0, 1.0], dtype=torch.float64)] * 3)
    radius = coarse / 2
    while radius > coarse / 100:
        twists = torch.cat([torch.zeros_like(cube), radius * cube], dim=1)
        tried = found[:, None] @ se3.exp(twists)[:, :3, :3]
        scores = score(tried.flatten(0, 1), max(fine, 2 * radius)).unflatten(0, (-1, len(cube)))
        scores[:, 0] *= 1 + math.sqrt(torch.finfo(torch.float32).eps)
        found = tried[torch.arange(len(found)), scores.argmax(dim=1)]
        radius /= math.sqrt(2)
    final = score(found, fine)
    order = final.argsort(descending=True, stable=True)
    found = found[order[2 * final[order] >= final.max()]]
    # A turn that the images cannot see makes no other rotation; of such ones the first stays.
    normal = turned(found)
    kept: list[int] = []
    for k in range(len(found)):
        apart = (normal[kept] - normal[k]).norm(dim=2).mean(dim=1)
        if not bool((apart < _TILT).any()):
            kept.append(k)
    return found[kept]


def _candidate_translation(planes: SeenPlanes, rotation: Tensor) -> tuple[Tensor, float]:
    """Find the translation tool_from_camera under which most pairs of planes agree.

    Along the wall's normal two images of one wall agree, which is linear in the translation; two
    parallel walls disagree by their distance. What the images leave open stays near zero.

    Args:
        planes: The planes of all images.
        rotation: The rotation tool_from_camera, shape (3, 3).

    Returns:
        The translation (3,) in metres, and how many pairs agree, counted by their size.
    """
    points, normal = planes.in_world(exact(se3.assemble(rotation, torch.zeros_like(rotation[0]))))
    direction = normal  # Of each plane the mean normal of those of its direction (mean shift).
    for _ in range(4):
        near = (direction @ normal.T > math.cos(2 * _TILT)) * planes.support
        direction = torch.nn.functional.normalize(near @ normal, dim=1)
    same = direction @ direction.T > math.cos(_TILT / 4)
    first, second = (same & planes.may_be_one_wall()).triu().nonzero().unbind(dim=1)
    if not len(first):
        return torch.zeros_like(rotation[0]), 0.0
    weight = (planes.support[first] * planes.support[second]).sqrt()
    towards, middle = direction[first], points.mean(dim=1)
    apart = (towards * (middle[first] - middle[second])).sum(dim=1)
    lever = (towards[:, None] @ (planes.rotation[first] - planes.rotation[second]))[:, 0]
    found = torch.cartesian_prod(*[torch.tensor([-_USUAL, 0.0, _USUAL]).double()] * 3)
    narrow, width = 3 * TYPICAL, 40 * TYPICAL
    prior = torch.eye(3, dtype=torch.float64) * (narrow / _USUAL) ** 2 * weight.mean()
    for _ in range(12):  # From wide, when the translation is open, to the camera's error alone.
        agree = weight * (-((apart + found @ lever.T) / width).square()).exp()
        hessian = torch.einsum("kp,pa,pb->kab", agree, lever, lever) + prior
        right = (agree * apart) @ lever
        found = -torch.linalg.solve(hessian, right[:, :, None])[:, :, 0]
        width = max(narrow, width / math.sqrt(2))
    score = (-((apart + found @ lever.T) / narrow).square()).exp() @ weight
    good = score >= (1 - _AS_GOOD) * score.max()
    best = found[good].norm(dim=1).argmin()
    return found[good][best], float(score[good][best])


def _followed(planes: SeenPlanes, transform: Tensor, fewest: int) -> Joint:
    """Gather walls under a proposed hand-eye transform (4, 4), and fit everything."""
    joint = _fit_jointly(planes, transform, _gather(planes, exact(transform), fewest))
    for _ in range(2):
        # Better known poses show further walls, and which walls are one.
        walls = _gather(planes, joint.parameters, fewest)
        again = _fit_jointly(planes, joint.tool_from_camera, walls)
        if again.cost() >= joint.cost():
            break
        joint = again
    # Walls that too few images show after all are dropped; those that are known stay.
    count = [len(planes.image[joint.wall == k].unique()) for k in range(len(joint.walls))]
    kept = torch.tensor(count) >= (fewest if planes.label is None else 0)
    if bool(kept.all()):
        return joint
    return _fit_jointly(planes, joint.tool_from_camera, joint.walls[kept])


def _fit_jointly(planes: SeenPlanes, tool_from_camera: Tensor, walls: Tensor) -> Joint:
    """Fit hand-eye, walls and a constant error, planes that lie on no wall counting for little.

    Args:
        planes: The planes of all images.
        tool_from_camera: Where to start, shape (4, 4).
        walls: Where to start, some centimetres off, shape (G, 4).
    """
    joint = _assigned(planes, exact(tool_from_camera), walls)
    for _ in range(6):  # Assignments rarely change after the second time.
        before, chosen = joint.wall, joint.wall >= 0
        if not bool(chosen.any()):
            break
        own = planes.take(chosen)
        fitted = _fit_assigned(own, before[chosen], joint.parameters, joint.walls, tool_from_camera)
        joint = _assigned(planes, *fitted)
        if bool((joint.wall == before).all()):
            break
    return joint


def _fit_assigned(
    planes: SeenPlanes, wall: Tensor, start: Parameters, walls: Tensor, centre: Tensor
) -> tuple[Parameters, Tensor]:
    """Fit hand-eye and walls to planes whose walls are known, robustly.

    Weights of planes that coincide settle with four reweightings of four steps each, and those of
    planes that never will are not worth more.

    Args:
        planes: The planes.
        wall: The wall of each, shape (M,).
        start: Hand-eye and error to start from.
        walls: Walls to start from, shape (G, 4).
        centre: Where the hand-eye transform (4, 4) stays in what the planes leave open.
    """
    moments = _point_moments(planes)
    found = Walls(walls[:, :3], walls[:, 3], wall, planes.world_from_tool)
    for _ in range(4):
        points = planes.in_world(start)[0]
        off = (points * found.normal_world[wall][:, None]).sum(dim=2) + found.offset[wall][:, None]
        off = off.square().mean(dim=1).sqrt()
        scale = max(sigma_from_mad(float(off.median())), TYPICAL / 10)
        weighted = moments.weighted(robust_weights(off / scale, "cauchy"))
        fitted = estimate_walls(weighted, start, found, _held(start, centre), 4)
        if bool((fitted[0].coefficients.abs() > 10 * _ERROR).any()):
            # Held at zero, to micrometres.
            none = exact(start.tool_from_camera)
            fitted = estimate_walls(weighted, none, found, _held(none, centre, 10**8), 4)
        start, found = fitted
    return start, torch.cat([found.normal_world, found.offset[:, None]], dim=1)


def _point_moments(planes: SeenPlanes) -> ImageMoments:
    """Return the moments of the planes' points, with a constant and a slope for coefficients.

    Normals and offsets in the tool frame are left at zero: walls put theirs in.
    """
    distance = planes.points.norm(dim=2, keepdim=True)
    one = torch.ones_like(distance)
    columns = torch.cat([distance, one, distance], dim=2)
    product = (columns[:, :, :, None] * (planes.points / distance)[:, :, None, :]).flatten(2)
    product = torch.cat([product, one], dim=2)
    return ImageMoments(
        gram=product.mT @ product,
        normal_tool=torch.zeros_like(planes.normal),
        offset_tool=torch.zeros_like(planes.support),
        count=one.sum(dim=(1, 2)),
        symbols=["c0", "slope"],
    )


def _held(start: Parameters, centre: Tensor, stiff: float = 1.0) -> NormalEquations:
    """Return the normal equations of the prior: a small error, a hand-eye near `centre` (4, 4).

    Along what the images determine it is far too weak to matter, unless `stiff` holds the error.
    """
    sigma = torch.cat([torch.full((6,), PRIOR_SIGMA, dtype=torch.float64), _ERROR / stiff**0.5])
    hessian = torch.diag((TYPICAL / sigma) ** 2)
    step = exact(centre).step_to(start)
    return NormalEquations(step @ hessian @ step, hessian @ step, hessian)


def _assigned(planes: SeenPlanes, parameters: Parameters, walls: Tensor) -> Joint:
    """Give each plane the wall nearest it, at most one plane of an image to each wall.

    Five typical deviations off, but never nearer than 50 mm, a plane is an outlier: by chance one
    in a million is so far.
    """
    distance = distances(*planes.in_world(parameters), walls)
    if planes.label is not None:
        other = torch.arange(len(walls)) != planes.label[:, None]
        distance = torch.where(other, torch.inf, distance)
    # No wall is infinitely far.
    deviation, wall = torch.nn.functional.pad(distance, (0, 1), value=torch.inf).min(dim=1)
    gate = 5 * max(TYPICAL, float(deviation[deviation.isfinite()].nanmedian().nan_to_num(0.0)))
    wall = torch.where(deviation <= gate, wall, -1)
    order = deviation.argsort(stable=True)
    pairs = torch.stack([planes.image, wall], dim=1)[order].numpy()
    nearest = order[np.unique(pairs, axis=0, return_index=True)[1]]
    alone = torch.full_like(wall, -1).index_copy(0, nearest, wall[nearest])
    return Joint(parameters, walls, alone, deviation)
