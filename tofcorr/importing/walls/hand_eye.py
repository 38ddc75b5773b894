r"""Planes of many images gathered into walls, and the hand-eye transform with them.

A wall of normal :math:`w` is seen by the camera at pose :math:`(R_i, p_i)` with the normal
:math:`m` where :math:`w = R_i X m`, and a point :math:`x` of it lies in the world at
:math:`R_i (X x + t) + p_i`. Which planes show one wall is not known, nor are X and t. For the right
ones the planes of all images fall into a few places; so a start is looked for over all rotations,
by how many pairs of planes of different images agree, and for the best of them over translations.
From each start planes are gathered into walls, and everything is fitted jointly (`fit_jointly`).

A sensor of one ray sees no normals. Before named walls its start is looked for over the directions
of its ray.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from tofcorr.estimation.linear import NormalEquations
from tofcorr.estimation.moments import HAND_EYE_SYMBOLS, ImageMoments, Parameters
from tofcorr.estimation.planes import Walls, estimate_walls, joint_image_equations
from tofcorr.estimation.robust import robust_weights
from tofcorr.estimation.uncertainty import PRIOR_SIGMA
from tofcorr.geometry import se3
from tofcorr.importing.walls.gathering import (
    TILT,
    TYPICAL,
    SeenPlanes,
    WallPlanes,
    distances,
    gather,
)
from tofcorr.spread import sigma_from_mad

_ERROR = torch.tensor([0.05, 0.02], dtype=torch.float64)
"""What a camera that is not calibrated yet is off by: a constant (metres), and a share of the
distance. Both are held to that much, so that they cannot stand in for the hand-eye. Ten times as
much no camera has: mirrored images would coincide behind the camera, at a slope of two."""


_GRID = 20_000, math.radians(14.0)
"""Rotations of the grid, some 9 degrees apart, and the width of the search, within which half of
that lies."""

_USUAL = 0.3
"""Standard deviation of a translation before anything is known of it, metres: tools and brackets
rarely measure more. The search starts there, as far on either side, along each axis."""

_AS_GOOD = 0.02
"""Fits as good as the best, to this share, are alike: the images say nothing of a difference that
small. Then the one nearest the guess is taken."""


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
        return float(off.sum()) + len(self.walls.offset)


def match(planes: SeenPlanes, guess: Tensor, fewest: int) -> Joint:
    """Find the walls that the planes of many images show, and the hand-eye transform with them.

    Args:
        planes: The planes of all images.
        guess: A hand-eye transform (4, 4); it is tried, and decides what the images leave open.
        fewest: Images that make a wall.
    """
    few = _varied(planes)
    proposed = []
    for rotation in _candidate_rotations(few, guess[:3, :3]):
        translation, agreement = _candidate_translation(few, rotation, guess[:3, 3])
        proposed.append((agreement, se3.assemble(rotation, translation)))
    proposed.sort(key=lambda one: -one[0])
    # Places of a wrong rotation agree by chance alone.
    starts = [start for agreement, start in proposed[:6] if 2 * agreement >= proposed[0][0]]
    return _nearest_of_best([_followed(planes, start, fewest) for start in starts], guess)


def match_single_ray(planes: SeenPlanes, guess: Tensor, directions: int = 1500) -> Joint:
    """Find a one-pixel sensor's hand-eye and the walls it looked at.

    Args:
        planes: One point an image, its wall known by label.
        guess: A hand-eye transform (4, 4): it is tried, and decides what cannot be seen, which is
            the turn about the ray at least.
        directions: Directions of the ray that are tried: 1500 are some 5 degrees apart.
    """
    assert planes.label is not None
    ray = guess[:3, :3] @ torch.nn.functional.normalize(planes.points[0, 0], dim=0)
    # Directions spread evenly: a Fibonacci lattice.
    place = torch.arange(directions, dtype=torch.float64) + 0.5
    z, angle = 1 - 2 * place / directions, math.pi * (1 + math.sqrt(5)) * place
    radius = (1 - z.square()).sqrt()
    lattice = torch.stack([radius * angle.cos(), radius * angle.sin(), z], dim=1)
    along = torch.cat([ray[None], lattice])
    loss, origin, normal, offset = _alternated(planes, along, guess[:3, 3])
    fits = []
    # Neighbours on the grid lead to one fit.
    for k in _best_apart(along, -loss, math.cos(math.radians(6)), 12):
        turn = Rotation.align_vectors(along[k : k + 1].numpy(), ray[None].numpy())[0].as_matrix()
        start = se3.assemble(torch.from_numpy(turn) @ guess[:3, :3], origin[k])
        parameters = Parameters(start, torch.zeros(2, dtype=torch.float64))
        walls = WallPlanes(normal[k], offset[k])
        parameters, walls = _fit_assigned(planes, planes.label, parameters, walls, start)
        points = _corrected(planes, parameters).in_world(parameters.tool_from_camera)[0]
        off = (points[:, 0] * walls.normal[planes.label]).sum(dim=1) + walls.offset[planes.label]
        fits.append(Joint(parameters, walls, planes.label, off.abs()))
    return _nearest_of_best(fits, guess)


def _alternated(
    planes: SeenPlanes, along: Tensor, guess: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Fit walls and the sensor's origin in turn for each direction (K, 3) of its ray b.

    At pose (R, p) the sensor reads the distance D to its wall, n . (R (D b + t) + p) + d = 0. With
    the normals fixed, origin t and offsets d are linear; offsets are means over a wall's readings.

    Returns:
        Mean squared deviations (K,), origins (K, 3), normals (K, G, 3) on the sensor's side, and
        offsets (K, G).
    """
    label, rotation = planes.label, planes.rotation
    assert label is not None
    member = torch.nn.functional.one_hot(label).double()
    share = member / member.sum(dim=0)
    distance = planes.points[:, 0].norm(dim=1)[:, None]
    place = planes.world_from_tool[:, :3, 3]
    hit = place + distance * (rotation @ along[:, None, :, None])[..., 0]
    origin, loss, normal = guess.expand(len(along), 3), along[:, 0], along
    # An origin is known to 150 mm beforehand, a distance to 10 mm.
    prior = (TYPICAL / (_USUAL / 2)) ** 2
    for _ in range(12):
        points = hit + (rotation @ origin[:, None, :, None])[..., 0]
        centred = points - torch.einsum("mg,kma->kga", share, points)[:, label]
        second = torch.einsum("mg,kma,kmb->kgab", share, centred, centred)
        normal = torch.linalg.eigh(second).eigenvectors[..., 0]
        own = normal[:, label]
        lever = (own[:, :, None] @ rotation)[:, :, 0]
        lever = lever - torch.einsum("mg,kma->kga", share, lever)[:, label]
        part = (own * hit).sum(dim=2)
        part = part - torch.einsum("mg,km->kg", share, part)[:, label]
        hessian = lever.transpose(1, 2) @ lever + prior * torch.eye(3).double()
        right = (lever * part[:, :, None]).sum(dim=1) - prior * guess
        origin = -torch.linalg.solve(hessian, right[:, :, None])[:, :, 0]
        loss = (part + (lever * origin[:, None]).sum(dim=2)).square().mean(dim=1)
    sensor = place + (rotation @ origin[:, None, :, None])[..., 0]
    way = distance * (rotation @ along[:, None, :, None])[..., 0]
    offset = -(normal * torch.einsum("mg,kma->kga", share, sensor + way)).sum(dim=2)
    height = (normal * torch.einsum("mg,kma->kga", share, sensor)).sum(dim=2) + offset
    side = torch.where(height < 0, -1.0, 1.0)
    return loss, origin, normal * side[..., None], offset * side


def _best_apart(vectors: Tensor, score: Tensor, closest: float, most: int) -> list[int]:
    """Return the best of vectors (K, D), none of them with a larger product with a better one."""
    left, found = score.clone(), list[int]()
    while len(found) < most and bool((left > -torch.inf).any()):
        found.append(int(left.argmax()))
        left[vectors @ vectors[found[-1]] > closest] = -torch.inf
        left[found[-1]] = -torch.inf
    return found


def _nearest_of_best(fits: Sequence[Joint], guess: Tensor) -> Joint:
    least = min(joint.cost() for joint in fits)
    good = [joint for joint in fits if joint.cost() <= (1 + _AS_GOOD) * least + 1e-9]

    def turn(joint: Joint) -> float:
        return float(se3.rotation_angle(guess[:3, :3].T @ joint.tool_from_camera[:3, :3]))

    return min(good, key=turn)


def _varied(planes: SeenPlanes, most: int = 90) -> SeenPlanes:
    """Return about 90 planes, of images whose robot poses are turned as differently as can be.

    Pairs grow with the square of their number.
    """
    image, count = torch.unique_consecutive(planes.image, return_counts=True)
    rotation = planes.rotation[count.cumsum(0) - count].flatten(1)
    distance = torch.full((len(image),), torch.inf, dtype=torch.float64)
    taken: list[int] = []
    while int(count[taken].sum()) < min(most, len(planes)):
        taken.append(int(distance.argmax()))
        away = (rotation - rotation[taken[-1]]).square().sum(dim=1)
        distance = distance.minimum(away)
        distance[taken] = -1.0  # Of equal poses the others remain, in order.
    return planes.take(torch.isin(planes.image, image[taken]))


def rotation_grid(number: int) -> Tensor:
    """Return rotations spread evenly: a super-Fibonacci spiral (Alexa 2022), shape (K, 3, 3)."""
    # The constants of the paper: the square root of 2 and the real root of p^4 = p + 4.
    phi, psi = math.sqrt(2.0), 1.533751168755204288118041
    s = torch.arange(number, dtype=torch.float64) + 0.5
    r, big_r = (s / number).sqrt(), (1 - s / number).sqrt()
    a, b = 2 * math.pi * s / phi, 2 * math.pi * s / psi
    quaternion = torch.stack([r * a.sin(), r * a.cos(), big_r * b.sin(), big_r * b.cos()], dim=1)
    return torch.from_numpy(Rotation.from_quat(quaternion.numpy()).as_matrix())


def _candidate_rotations(planes: SeenPlanes, guess: Tensor) -> Tensor:
    """Return rotations tool_from_camera that make normals coincide, the best first.

    Args:
        planes: The planes.
        guess: A rotation to try besides those of the grid, shape (3, 3).

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
        """Return the weight of pairs that agree to within about an angle, shape (K,).

        Rotations are split so that their cosines (3 MB) stay in a processor's cache.
        """
        steep = 1 / (1 - math.cos(width))
        scores = []
        for part in rotations.split(100):
            normal = turned(part).float()
            # The Gaussian of an angle, through its cosine: falls to 1 / e at the width.
            agree = torch.baddbmm(
                torch.tensor(-steep), normal, normal.transpose(1, 2), alpha=steep
            ).exp_()
            scores.append(agree.flatten(1) @ pair)
        return torch.cat(scores).double()

    number, coarse = _GRID
    fine = coarse / 3
    grid = torch.cat([guess[None], rotation_grid(number)])
    left = score(grid, coarse)
    left[0] = torch.inf  # The guess is refined in any case.
    # The trace of a rotation by an angle a is 1 + 2 cos a.
    close = 1 + 2 * math.cos(math.radians(15))
    found = grid[_best_apart(grid.flatten(1), left, close, 80)]
    # From wide to narrow: the best of each rotation's neighbours, if it is better. Where the poses
    # say nothing of a turn, none is made.
    cube = torch.cartesian_prod(*[torch.tensor([0.0, -1.0, 1.0], dtype=torch.float64)] * 3)
    radius = coarse / 2
    while radius > coarse / 100:
        twists = torch.cat([torch.zeros_like(cube), radius * cube], dim=1)
        tried = found[:, None] @ se3.exp(twists)[:, :3, :3]
        scores = score(tried.flatten(0, 1), max(fine, 2 * radius)).unflatten(0, (-1, len(cube)))
        scores[:, 0] *= 1 + 1e-4
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
        if not bool((apart < TILT).any()):
            kept.append(k)
    return found[kept]


def _candidate_translation(
    planes: SeenPlanes, rotation: Tensor, guess: Tensor
) -> tuple[Tensor, float]:
    """Find the translation tool_from_camera under which most pairs of planes agree.

    Along the wall's normal two images of one wall agree, which is linear in the translation; two
    parallel walls disagree by their distance.

    Args:
        planes: The planes of all images.
        rotation: The rotation tool_from_camera, shape (3, 3).
        guess: A translation, shape (3,): what the images leave open stays near it.

    Returns:
        The translation (3,) in metres, and how many pairs agree, counted by their size.
    """
    start = se3.assemble(rotation, torch.zeros_like(guess))
    points, normal = planes.in_world(start)
    direction = normal  # Of each plane the mean normal of those of its direction (mean shift).
    for _ in range(4):
        near = (direction @ normal.T > math.cos(2 * TILT)) * planes.support
        direction = torch.nn.functional.normalize(near @ normal, dim=1)
    same = direction @ direction.T > math.cos(TILT / 4)
    pair = (same & planes.may_be_one_wall()).triu().nonzero()
    first, second = pair[:, 0], pair[:, 1]
    if not len(pair):
        return guess, 0.0
    weight = (planes.support[first] * planes.support[second]).sqrt()
    towards, middle = direction[first], points.mean(dim=1)
    apart = (towards * (middle[first] - middle[second])).sum(dim=1)
    lever = (towards[:, None] @ (planes.rotation[first] - planes.rotation[second]))[:, 0]
    found = guess + torch.cartesian_prod(*[torch.tensor([-_USUAL, 0.0, _USUAL]).double()] * 3)
    narrow, width = 3 * TYPICAL, 40 * TYPICAL
    prior = torch.eye(3, dtype=torch.float64) * (narrow / _USUAL) ** 2 * weight.mean()
    for _ in range(12):  # From wide, when the translation is open, to the camera's error alone.
        agree = weight * (-((apart + found @ lever.T) / width).square()).exp()
        hessian = torch.einsum("kp,pa,pb->kab", agree, lever, lever) + prior
        right = torch.einsum("kp,pa->ka", agree * apart, lever) - prior @ guess
        found = -torch.linalg.solve(hessian, right[:, :, None])[:, :, 0]
        width = max(narrow, 0.7 * width)
    score = (-((apart + found @ lever.T) / narrow).square()).exp() @ weight
    good = score >= (1 - _AS_GOOD) * score.max()
    best = int((found[good] - guess).norm(dim=1).argmin())
    return found[good][best], float(score[good][best])


def _followed(planes: SeenPlanes, transform: Tensor, fewest: int) -> Joint:
    """Gather walls under a proposed hand-eye transform (4, 4), and fit everything."""
    joint = fit_jointly(planes, transform, gather(planes, transform, fewest))
    for _ in range(2):
        # Better known poses show further walls, and which walls are one.
        walls = gather(_corrected(planes, joint.parameters), joint.tool_from_camera, fewest)
        again = fit_jointly(planes, joint.tool_from_camera, walls)
        if again.cost() >= joint.cost():
            break
        joint = again
    if planes.label is not None:
        return joint
    # Walls that too few images show after all are dropped.
    count = [len(planes.image[joint.wall == k].unique()) for k in range(len(joint.walls.offset))]
    kept = torch.tensor([number >= fewest for number in count], dtype=torch.bool)
    if bool(kept.all()):
        return joint
    walls = WallPlanes(joint.walls.normal[kept], joint.walls.offset[kept])
    return fit_jointly(planes, joint.tool_from_camera, walls)


def fit_jointly(planes: SeenPlanes, tool_from_camera: Tensor, walls: WallPlanes) -> Joint:
    """Fit hand-eye, walls and a constant error, planes that lie on no wall counting for little.

    Args:
        planes: The planes of all images.
        tool_from_camera: Where to start, shape (4, 4).
        walls: Where to start, some centimetres off.
    """
    start = Parameters(tool_from_camera, torch.zeros(2, dtype=torch.float64))
    joint = _assigned(planes, start, walls)
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
    planes: SeenPlanes, wall: Tensor, start: Parameters, walls: WallPlanes, centre: Tensor
) -> tuple[Parameters, WallPlanes]:
    """Fit hand-eye and walls to planes whose walls are known, robustly.

    Weights of planes that coincide settle with four reweightings of four steps each, and those of
    planes that never will are not worth more.

    Args:
        planes: The planes.
        wall: The wall of each, shape (M,).
        start: Hand-eye and error to start from.
        walls: Walls to start from.
        centre: Where the hand-eye transform (4, 4) stays in what the planes leave open.
    """
    moments = _point_moments(planes)
    found = Walls(walls.normal, walls.offset, wall, planes.world_from_tool)
    for _ in range(4):
        points = _corrected(planes, start).in_world(start.tool_from_camera)[0]
        off = (points * found.normal_world[wall][:, None]).sum(dim=2) + found.offset[wall][:, None]
        off = off.square().mean(dim=1).sqrt()
        scale = max(sigma_from_mad(float(off.median())), TYPICAL / 10)
        weighted = moments.weighted(robust_weights(off / scale, "cauchy"))
        fitted = estimate_walls(weighted, start, found, _held(start, centre), 4)
        if bool((fitted[0].coefficients.abs() > 10 * _ERROR).any()):
            # Held at zero, to micrometres.
            none = replace(start, coefficients=torch.zeros_like(start.coefficients))
            fitted = estimate_walls(weighted, none, found, _held(none, centre, 1e8), 4)
        start, found = fitted
    return start, WallPlanes(found.normal_world, found.offset)


def _point_moments(planes: SeenPlanes) -> ImageMoments:
    """Return the moments of the planes' points, with a constant and a slope for coefficients.

    Normals and offsets in the tool frame are left at zero: walls put theirs in.
    """
    distance = planes.points.norm(dim=2, keepdim=True)
    ray = planes.points / distance
    columns = torch.cat([distance, torch.ones_like(distance), distance], dim=2)
    product = (columns[:, :, :, None] * ray[:, :, None, :]).flatten(2)
    product = torch.cat([product, torch.ones_like(distance)], dim=2)
    zero = torch.zeros(len(planes), dtype=torch.float64)
    return ImageMoments(
        gram=product.transpose(1, 2) @ product,
        normal_tool=zero[:, None].expand(-1, 3),
        offset_tool=zero,
        count=torch.full_like(zero, planes.points.shape[1]),
        symbols=["c0", "slope"],
    )


def _held(start: Parameters, centre: Tensor, stiff: float = 1.0) -> NormalEquations:
    """Return the normal equations of the prior: a small error, a hand-eye near `centre` (4, 4).

    Along what the images determine it is far too weak to matter, unless `stiff` holds the error.
    """
    sigma = torch.cat([torch.full((6,), PRIOR_SIGMA, dtype=torch.float64), _ERROR / stiff**0.5])
    hessian = torch.diag((TYPICAL / sigma) ** 2)
    turned = se3.log(se3.inverse(centre) @ start.tool_from_camera)
    step = torch.cat([turned, start.coefficients])
    return NormalEquations(step @ hessian @ step, hessian @ step, hessian)


def _corrected(planes: SeenPlanes, parameters: Parameters) -> SeenPlanes:
    """Return the planes with the constant and the slope taken off their points' distances."""
    constant, slope = parameters.coefficients
    distance = planes.points.norm(dim=2, keepdim=True)
    return replace(planes, points=planes.points * (1 - slope - constant / distance))


def _assigned(planes: SeenPlanes, parameters: Parameters, walls: WallPlanes) -> Joint:
    """Give each plane the wall nearest it, at most one plane of an image to each wall.

    Five typical deviations off, but never nearer than 50 mm, a plane is an outlier: by chance one
    in a million is so far.
    """
    count, known = len(planes), len(walls.offset)
    if not known:
        nothing = torch.full((count,), torch.inf, dtype=torch.float64)
        return Joint(parameters, walls, torch.full((count,), -1), nothing)
    distance = distances(_corrected(planes, parameters), parameters.tool_from_camera, walls)
    if planes.label is not None:
        other = torch.arange(known) != planes.label[:, None]
        distance = torch.where(other, torch.inf, distance)
    deviation, wall = distance.min(dim=1)
    finite = deviation[deviation.isfinite()]
    gate = 5 * max(TYPICAL, float(finite.median()) if len(finite) else 0.0)
    wall = torch.where(deviation <= gate, wall, -1)
    taken: set[tuple[int, int]] = set()
    for k in deviation.argsort(stable=True).tolist():
        key = (int(planes.image[k]), int(wall[k]))
        if key in taken:
            wall[k] = -1
        taken.add(key)
    return Joint(parameters, walls, wall, deviation)


def undetermined(planes: SeenPlanes, joint: Joint, names: Sequence[str]) -> list[str]:
    """Name the directions of hand-eye and walls that the planes do not determine.

    A direction is undetermined if the planes, each known to 10 mm, say less about it than a prior
    of 100 mm and 100 mrad.

    Args:
        planes: The planes of all images.
        joint: The fit.
        names: The walls' names.
    """
    chosen = joint.wall >= 0
    if not bool(chosen.any()):
        return ["everything: no wall was found"]
    planes = planes.take(chosen)
    walls = Walls(*joint.walls, joint.wall[chosen], planes.world_from_tool)
    moments = walls.seen_by(_point_moments(planes))
    each = joint_image_equations(moments, joint.parameters, walls)
    precision = each.hessian.sum(dim=0) / TYPICAL**2
    precision[6:8, 6:8] += torch.diag(1 / _ERROR**2)
    prior = torch.eye(len(precision), dtype=precision.dtype) / PRIOR_SIGMA**2
    variance, vectors = torch.linalg.eigh(torch.linalg.inv(precision + prior))
    symbols = [f"{symbol} of the hand-eye" for symbol in HAND_EYE_SYMBOLS]
    symbols += ["constant error", "slope of the error"]
    for name in names:
        symbols += [f"the tilt of {name}", f"the tilt of {name}", f"the distance of {name}"]
    # Turn the basis of what the prior determines more than the planes do into one whose directions
    # concern few unknowns, and name those of a fifth of the largest component or more.
    left, found = vectors[:, 2 * variance > PRIOR_SIGMA**2], []
    for _ in range(left.shape[1]):
        inside = left @ left.T
        vector = inside[:, int(inside.diagonal().argmax())]
        vector = vector / vector.norm()
        left = left - vector[:, None] * (vector @ left)
        size = vector.abs()
        order = [k for k in size.argsort(descending=True).tolist() if 5 * size[k] > size.max()]
        found.append(" against ".join(dict.fromkeys(symbols[k] for k in order)))
    return list(dict.fromkeys(found))
