"""Which poses to record next, or first: drawn around known ones, chosen by what they would tell.

Views of a wall are drawn, their moments predicted for a camera without error, and chosen one by
one: each the one that most shrinks the variances that remain.
"""

import math
from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from tofcorr.conditions import CONDITIONS
from tofcorr.data.recording import FrameBatch
from tofcorr.digits import aligned
from tofcorr.error_terms.base import Domain, Interval
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.errors import ConfigError
from tofcorr.estimation.accumulator import Design, MomentAccumulator
from tofcorr.estimation.moments import HAND_EYE_SYMBOLS, ImageMoments, Parameters
from tofcorr.estimation.planes import Walls, joint_image_equations
from tofcorr.estimation.uncertainty import (
    PRIOR_SIGMA,
    Direction,
    posterior_covariance,
    worst_axes,
    worst_sigma,
)
from tofcorr.fit.problem import Fit
from tofcorr.geometry import se3
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import SPEED_OF_LIGHT, plane_in_frame, ray_directions, ray_plane_distance
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.lattice import Lattice
from tofcorr.training.support import ENOUGH_REFLECTIVITY, sample_reflectivity

# Reflectivity of a checkerboard's dark squares relative to its bright ones, if none was recorded.
# Set by hand for printed boards in the near infrared.
_DARK = 1 / 8
# Largest angle between a corner's ray and the wall's normal, degrees. Set by hand: the amplitude
# falls to a third there.
_STEEPEST_INCIDENCE_DEG = 70.0


@dataclass(frozen=True, kw_only=True)
class Workspace:
    """Where the camera may go before the wall.

    Attributes:
        nearest: Shortest distance to the wall along the optical axis, metres.
        farthest: Longest such distance, metres.
        tilt_deg: Largest angle between the optical axis and the wall's normal.
        roll_deg: Largest turn about the optical axis, either way.
        wall_size: Width and height of the free wall around the point that the start pose looks
            at, metres; None: it is larger than every view.
        checkerboard: Whether the wall carries a pattern of dark and bright; else it is white.
        longest_ray: Longest distance from the camera to what a corner of the image shows, metres.
    """

    nearest: float
    farthest: float
    tilt_deg: float = 35.0
    roll_deg: float = 90.0
    wall_size: tuple[float, float] | None = None
    checkerboard: bool = False
    longest_ray: float = math.inf

    def __post_init__(self) -> None:
        """Refuse a workspace that no camera can be in.

        Raises:
            ConfigError: A number is out of range.
        """
        if not 0 < self.nearest <= self.farthest:
            ends = f"{self.nearest:g} to {self.farthest:g} m"
            raise ConfigError(f"The distances {ends} are no interval in front of the camera.")
        if not 0 < self.tilt_deg < _STEEPEST_INCIDENCE_DEG:
            most = f"between 0 and {_STEEPEST_INCIDENCE_DEG:g}"
            raise ConfigError(f"The tilt of {self.tilt_deg:g} degrees is not {most}.")

    @property
    def log_dark(self) -> float:
        """Log reflectivity of the wall's dark parts relative to its bright ones."""
        return math.log(_DARK) if self.checkerboard else 0.0


@dataclass(frozen=True)
class PosePool:
    """Poses that the robot could take, around those it took.

    Attributes:
        world_from_tool: Shape (M, 4, 4); of the camera, without a robot.
        normal_world: The wall each would look at, shape (M, 3).
        offset: Its offset, shape (M,).
        target: What each would look at, M names.
        brightness: Log normalised amplitude of its dark and bright parts, shape (M, 2).
        described: Distance (m), tilt (degrees) and roll from the pose it was drawn from
            (degrees), shape (M, 3).
    """

    world_from_tool: Tensor
    normal_world: Tensor
    offset: Tensor
    target: list[str]
    brightness: Tensor
    described: Tensor

    def only(self, chosen: np.ndarray) -> "PosePool":
        """Return some of the poses, by number."""
        names = [target for k, target in enumerate(self.target) if k in chosen]
        parts = {k: v[chosen] for k, v in vars(self).items() if k != "target"}
        return PosePool(target=names, **parts)

    def moments(
        self, design: Design, tool_from_camera: Tensor, pixel_share: float = 1.0, enough: int = 4000
    ) -> ImageMoments:
        """Return the moments that views of a checkerboard would have if the camera had no error.

        Args:
            design: The columns.
            tool_from_camera: The hand-eye transform, shape (4, 4).
            pixel_share: Share of the pixels that are usable.
            enough: Larger images, which are smooth, are predicted from about this many pixels.
        """
        step = max(1, round((design.ray_directions[..., 0].numel() / enough) ** 0.5))
        design = copy(design)
        design.ray_directions = rays = design.ray_directions[::step, ::step]
        design.pixel_functions = design.pixel_functions[:, ::step, ::step]
        # Squares of four pixels a side; only their contrast matters.
        rows, columns = (torch.arange(size) // 4 for size in rays.shape[:2])
        bright = (rows[:, None] + columns) % 2
        planes = plane_in_frame(self.normal_world, self.offset, self.world_from_tool)
        normal, offset = plane_in_frame(*planes, tool_from_camera.expand(len(planes[1]), 4, 4))
        distance = ray_plane_distance(rays, normal, offset)
        cosine = -torch.einsum("hwa,ba->bhw", rays, normal)
        batch = FrameBatch(
            indices=torch.arange(len(offset)),
            radial_distance=distance,
            amplitude=self.brightness[:, bright].exp() * cosine / distance.square(),
            valid=distance.isfinite() & (cosine > 0),
            normal_tool=planes[0],
            offset_tool=planes[1],
        )
        return MomentAccumulator(design)(batch, torch.full_like(distance, pixel_share * step**2))


def draw_views(
    cameras: Tensor,
    plane: tuple[Tensor, Tensor],
    tool_from_camera: Tensor,
    space: Workspace,
    brightness: Mapping[str, Tensor],
    rays: Tensor,
    generator: np.random.Generator,
    size: int = 300,
) -> PosePool | None:
    """Draw cameras that look at the same points of a wall as given ones, turned, rolled and moved.

    With 150 to 1200 planned poses the expected rotation after 20 of them changes by a quarter,
    without a trend from 300 on.

    Args:
        cameras: world_from_camera, shape (N, 4, 4).
        plane: Of the wall that each looks at: normals towards the camera, shape (N, 3), and
            offsets, shape (N,).
        tool_from_camera: The hand-eye transform, shape (4, 4).
        space: Where the cameras may be.
        brightness: Of the targets, which are taken in turn.
        rays: Unit rays, shape (H, W, 3).
        generator: Source of randomness.
        size: How many are wanted; twenty times as many are drawn at most.

    Returns:
        The poses; None if none can be used.
    """
    normal, offset = plane
    count, distance = 20 * size, along_axis(cameras, plane)
    k = torch.from_numpy(generator.integers(len(distance), size=count))
    low = 0.0, 0.0, -space.roll_deg, space.nearest
    high = space.tilt_deg, 2 * math.pi, space.roll_deg, space.farthest
    wanted = torch.from_numpy(generator.uniform(low, high, (count, 4)))
    poses = _moved_cameras(cameras[k], normal[k], distance[k], wanted)
    used = _sees_wall(poses, normal[k], offset[k], rays, space).nonzero()[:size, 0]
    if not len(used):
        return None
    target = [list(brightness)[one % len(brightness)] for one in range(len(used))]
    return PosePool(
        world_from_tool=poses[used] @ se3.inverse(tool_from_camera),
        normal_world=normal[k[used]],
        offset=offset[k[used]],
        target=target,
        brightness=torch.stack([brightness[name] for name in target]),
        described=wanted[used][:, [3, 0, 2]],
    )


def along_axis(cameras: Tensor, plane: tuple[Tensor, Tensor]) -> Tensor:
    """Return the distances of cameras (N, 4, 4) to planes along their axes, shape (N,), metres."""
    normal, offset = plane
    height = (normal * cameras[:, :3, 3]).sum(-1) + offset
    return -height / (normal * cameras[:, :3, 2]).sum(-1)


def _moved_cameras(camera: Tensor, normal: Tensor, distance: Tensor, wanted: Tensor) -> Tensor:
    """Turn, roll and move cameras that keep looking at the same points of the wall.

    Args:
        camera: world_from_camera, shape (M, 4, 4).
        normal: The wall's normals, towards the camera, shape (M, 3).
        distance: From the camera to the wall along its axis, shape (M,).
        wanted: Tilt (degrees) and its azimuth (radians), roll (degrees), distance (metres), shape
            (M, 4).
    """
    tilt, azimuth, roll, away = wanted.mT[..., None]
    tilt, roll = torch.deg2rad(tilt), torch.deg2rad(roll)
    point = camera[:, :3, 3] + distance[:, None] * camera[:, :3, 2]
    across = normalize(torch.linalg.cross(normal, camera[:, :3, 0]), dim=1)
    aside = azimuth.cos() * torch.linalg.cross(across, normal) + azimuth.sin() * across
    axis = tilt.sin() * aside - tilt.cos() * normal
    x = camera[:, :3, 0]
    x = normalize(x - axis * (axis * x).sum(dim=1, keepdim=True), dim=1)
    y = torch.linalg.cross(axis, x)
    turned = x * roll.cos() + y * roll.sin(), y * roll.cos() - x * roll.sin(), axis
    return se3.assemble(torch.stack(turned, dim=2), point - away * axis)


def _sees_wall(
    camera: Tensor, normal: Tensor, offset: Tensor, rays: Tensor, space: Workspace
) -> Tensor:
    """Whether all corners of each image look at the wall, not too grazing, too far or beside it."""
    normal_camera, offset_camera = plane_in_frame(normal, offset, camera)
    corners = rays[[[0, 0, -1, -1]], [[0, -1, 0, -1]]]
    distance = ray_plane_distance(corners, normal_camera, offset_camera)[:, 0]
    steepest = math.cos(math.radians(_STEEPEST_INCIDENCE_DEG))
    seen = (distance <= space.longest_ray) & (-(normal_camera @ corners[0].T) >= steepest)
    if space.wall_size is not None:
        points = (corners[0] * distance[..., None]) @ camera[:, :3, :3].mT + camera[:, None, :3, 3]
        seen &= (points[..., :2].abs() <= torch.tensor(space.wall_size).double() / 2).all(dim=2)
    return seen.all(dim=1)


def draw_pool(
    dataset: Dataset,
    frames: np.ndarray,
    fit: Fit,
    generator: np.random.Generator,
    size: int = 300,
    space: Workspace | None = None,
    lattice: Lattice | None = None,
    *,
    checkerboard: bool = True,
) -> PosePool | None:
    """Draw poses that look at the same wall, tilted, rolled and at other distances.

    Each is a recorded pose whose camera is turned about the point it looks at, rolled, and moved
    along its axis. The wall fills the image, nowhere too grazing.

    Args:
        dataset: The recordings.
        frames: Global numbers of the frames that were fitted.
        fit: The calibration so far.
        generator: Source of randomness.
        size: How many.
        space: Where the camera may go, turned by `roll_deg` from recorded poses; None: at recorded
            distances, and nowhere a twentieth farther than any calibrated distance.
        lattice: That of the frames; None: it is read.
        checkerboard: Whether poses before a checkerboard are among them where every target has one
            reflectivity.

    Returns:
        The poses; None if none was found where the wall fills the image, and for a fit that takes
        the camera to the wall.
    """
    hand_eye, ranges = fit.solution.parameters.tool_from_camera, fit.domain.radial_distance
    *plane, world_from_tool = dataset.planes_and_poses(frames)
    camera = world_from_tool @ hand_eye
    distance = along_axis(camera, (plane[0], plane[1]))
    # A fit that took the camera to the wall says nothing of where poses should be.
    kept = torch.isfinite(distance) & (distance > ranges.low / 2)
    if not bool(kept.any()):
        return None
    camera, normal, offset, distance = (part[kept] for part in (camera, *plane, distance))
    facing = -(normal * camera[:, :3, 2]).sum(-1)
    recorded = float(torch.rad2deg(torch.arccos(facing.clamp(-1, 1))).max())
    # Up to the largest tilt recorded, within what a robot arm reaches in front of a wall.
    space = space or Workspace(
        nearest=float(distance.min()),
        farthest=float(distance.max()),
        tilt_deg=min(max(recorded, 30), 40),
        longest_ray=ranges.high * (1 + 1 / 20),
    )
    wall, rays = (normal, offset), dataset.ray_directions()
    brightness = target_brightness(dataset, frames, hand_eye, lattice)
    contrasts = [float(high - low) for low, high in brightness.values()]
    if checkerboard and dataset.has_amplitude and max(contrasts) < math.log(ENOUGH_REFLECTIVITY):
        bright = max(float(high) for _, high in brightness.values())
        brightness["checkerboard"] = torch.tensor([bright + math.log(_DARK), bright]).double()
    return draw_views(camera, wall, hand_eye, space, brightness, rays, generator, size)


def target_brightness(
    dataset: Dataset, frames: np.ndarray, hand_eye: Tensor, lattice: Lattice | None = None
) -> dict[str, Tensor]:
    """Return dark and bright log normalised amplitude of each target.

    Args:
        dataset: The recordings.
        frames: Global numbers of the frames.
        hand_eye: tool_from_camera, shape (4, 4).
        lattice: That of the frames; None: it is read.
    """
    names, found = dataset.targets[frames], {}
    if dataset.has_amplitude:
        frame, _, light = sample_reflectivity(dataset, frames, hand_eye, lattice)
        # A tenth of the pixels is darker than what stands for dark, a tenth brighter than bright.
        quantiles = torch.tensor([1 / 10, 9 / 10], dtype=torch.float64)
        for name in np.unique(names[frame]):
            found[str(name)] = light[torch.from_numpy(names[frame] == name)].quantile(quantiles)
    # A target may have no pixel with light that is not too grazing.
    return found or {str(name): torch.zeros(2, dtype=torch.float64) for name in np.unique(names)}


def advise(
    dataset: Dataset, pool: PosePool, fit: Fit, number: int = 5, enough: int = 4000
) -> tuple[list[int], dict[str, Any]]:
    """Choose the poses of a pool that would help most.

    Args:
        dataset: The recordings.
        pool: The poses to choose from.
        fit: The calibration so far.
        number: How many to choose.
        enough: Pixels of an image that its moments are predicted from.

    Returns:
        Their indices in the pool, and the advice for the report: the worst direction that poses
        can show, and each pose with the standard deviation of the worst one (mm or mrad) to expect
        once it is added.
    """
    precision, added = predicted_precision(pool, fit, dataset, enough)
    # What no pose shows is not what further poses are for.
    shown = [k for k, one in enumerate(fit.observability.directions) if not fit.is_unseen(one)]
    walls = torch.eye(len(precision) - len(fit.observability.vectors)).double()
    basis = torch.block_diag(fit.observability.vectors[:, shown], walls)
    precision, added = (basis.T @ each @ basis for each in (precision, added))
    sizes = torch.ones(len(shown)).double()
    order, covariances = choose_views(precision, added, number, sizes)
    covariances = covariances[:, : len(shown), : len(shown)]
    worst = [1e3 * worst_sigma(covariance) for covariance in covariances]
    names = "distance_m", "tilt_deg", "roll_by_deg"
    poses = [
        {
            "target": pool.target[k],
            **dict(zip(names, pool.described[k].tolist(), strict=True)),
            "world_from_tool": pool.world_from_tool[k].tolist() if dataset.moves else None,
            "worst_sigma_mm_or_mrad": sigma,
        }
        for k, sigma in zip(order, worst[1:], strict=True)
    ]
    weakest = next(one for one in fit.directions if not fit.is_unseen(one))
    now = {
        "direction": weakest.in_words(),
        "of": _kinds(weakest, fit.model.error),
        "sigma_mm_or_mrad": 1e3 * weakest.sigma,
    }
    return order, {**now, "worst_sigma_mm_or_mrad": worst[0], "poses": poses}


def predicted_precision(
    pool: PosePool, fit: Fit, dataset: Dataset, enough: int
) -> tuple[Tensor, Tensor]:
    """Return the precision of all unknowns of a fit now, and what each pose of a pool would add.

    Walls that were estimated are unknowns too, after the others; a pose sees the nearest of them.

    Args:
        pool: The poses, M of them.
        fit: The calibration so far.
        dataset: Gives the camera.
        enough: Pixels of an image that its moments are predicted from.

    Returns:
        Shapes (P, P) and (M, P, P).
    """
    best, design = fit.optimum, Design(fit.model.error, fit.domain, dataset.ray_directions())
    share = float(fit.moments.count.mean()) / (fit.domain.height * fit.domain.width)
    moments = pool.moments(design, best.tool_from_camera, share, enough)
    # Poses carry no information about condition terms.
    beyond = [symbol for symbol in fit.moments.symbols if symbol not in moments.symbols]
    moments = moments.with_conditions(torch.zeros(len(moments.gram), len(beyond)), beyond)
    walls = theirs = None if fit.walls is None else fit.walls.walls
    if walls is not None:
        apart = (pool.normal_world[:, None] - walls.normal_world).square().sum(dim=2)
        apart = apart + (pool.offset[:, None] - walls.offset).square()
        theirs = replace(walls, index=apart.argmin(dim=1), world_from_tool=pool.world_from_tool)
    before = fit.carried or fit.smoothness
    now = joint_image_equations(fit.moments, best, walls).total()
    now = now.plus(None if before is None else before.equations(best)).hessian
    added = joint_image_equations(moments, best, theirs).hessian
    return now / fit.residual_variance, added / fit.residual_variance


def _kinds(weakest: Direction, model: ErrorModel) -> list[str]:
    """Return which kinds of unknowns a direction consists of, the largest component first."""
    kinds = {symbol: f"{term.group} term" for term in model.terms() for symbol in term.symbols}
    kinds |= dict.fromkeys(HAND_EYE_SYMBOLS, "hand-eye transform")
    # c0, of no term, is the constant error of the distance.
    return list(dict.fromkeys(kinds.get(symbol, "distance term") for symbol in weakest.shares))


def choose_views(
    precision: Tensor, candidates: Tensor, number: int, sizes: Tensor | None = None
) -> tuple[list[int], Tensor]:
    """Choose views greedily, each the one that most shrinks the weak directions' variances.

    It has the smallest mean of the fourth powers of the directions' variances: between
    A-optimality (their sum) and E-optimality (the largest alone), which ignores all but one.

    Args:
        precision: Of the unknowns, from the recording, shape (P, P).
        candidates: The precision that each view would add, shape (M, P, P).
        number: How many to choose; each view can be chosen once.
        sizes: In which unit the standard deviation of each of the first unknowns counts, shape
            (K,); the others do not count. None: every one counts, in metres and radians.

    Returns:
        Their indices, and the covariances of the unknowns before, and after each view, shape
        (1 + chosen, P, P).
    """
    sizes = torch.ones(len(precision)).double() if sizes is None else sizes
    count, order = len(sizes), list[int]()
    covariances = [posterior_covariance(precision)]
    for _ in range(min(number, len(candidates))):
        after = posterior_covariance(precision + candidates)
        counted = after[:, :count, :count] / (sizes[:, None] * sizes)
        # The trace of a power is the sum of that power of the directions' variances.
        badness = torch.linalg.matrix_power(counted, 4).diagonal(dim1=-2, dim2=-1).sum(-1)
        badness[order] = torch.inf
        best = int(badness.argmin())
        order.append(best)
        precision = precision + candidates[best]
        covariances.append(after[best])
    return order, torch.stack(covariances)


@dataclass(frozen=True, kw_only=True, eq=False)
class PosePlan:
    """Poses to record, the most informative first.

    Attributes:
        start_from_tool: Poses of the tool relative to where it starts, shape (N, 4, 4), metres.
        described: Distance (m), tilt and roll (degrees) of each, shape (N, 3).
        expected: Standard errors of the hand-eye transform to be expected after the first k poses:
            of the worst axis of the translation, mm, and of the rotation, degrees, shape (N, 2);
            infinite while it is not determined.
    """

    start_from_tool: Tensor
    described: Tensor
    expected: Tensor

    def __repr__(self) -> str:
        """Return what to expect of all poses, and of the first half and quarter of them."""
        count = len(self.expected)
        return self._text({count // 4, count // 2, count} - {0})

    @property
    def details(self) -> str:
        """What to expect of the first k poses, for every k."""
        return self._text({*range(1, len(self.expected) + 1)})

    def _text(self, counts: set[int]) -> str:
        rows: list[tuple[str, ...]] = [("poses", "translation", "rotation")]
        for k in sorted(counts):
            shift, turn = self.expected[k - 1].tolist()
            known = f"{shift:.2f} mm", f"{turn:.3f} deg"
            sizes = ("unknown", "unknown") if math.isinf(shift + turn) else known
            rows.append((str(k), *sizes))
        *_, (count, shift, turn) = rows
        verdict = f"{count} poses determine the hand-eye transform to {shift} and {turn}."
        if shift == "unknown":
            verdict = f"{count} poses do not determine the hand-eye transform: plan more of them."
        expected = "Standard error to expect along the worst axis, by the number of poses:"
        return "\n".join([verdict, expected, *aligned(rows)])


def plan_poses(
    camera: CameraIntrinsics,
    model: ErrorModelOptions,
    workspace: Workspace,
    *,
    number: int = 24,
    start_distance: float | None = None,
    tool_from_camera: np.ndarray | None = None,
    residual: float = 2.5e-3,
    seed: int = 0,
) -> PosePlan:
    """Choose poses that determine the hand-eye transform, the model and the wall best.

    The robot starts where the camera looks squarely at the wall. Candidates keep looking at the
    same point of it, tilted, rolled and moved. They are chosen one by one, each the one that most
    reduces the variances that remain; the wall's own plane counts as unknown.

    Args:
        camera: The lateral parameters.
        model: The error terms.
        workspace: Where the camera may go.
        number: How many poses.
        start_distance: From the camera to the wall at the start, metres; None: the middle.
        tool_from_camera: A guess of the hand-eye transform, shape (4, 4), good to 0.1 m and some
            degrees; None: the tool's axes are the camera's.
        residual: RMS error of a pixel that the correction leaves, metres; the default is that of
            the simulated configurations. Expected standard errors are proportional to it.
        seed: Of the candidates.

    Raises:
        ConfigError: The wall is too small for every view.
    """
    hand_eye = torch.eye(4).double() if tool_from_camera is None else torch.tensor(tool_from_camera)
    middle = (workspace.nearest + workspace.farthest) / 2
    # In the axes of the start camera.
    normal = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64)
    offset = torch.tensor([start_distance or middle], dtype=torch.float64)
    wall, rays = (normal, offset), ray_directions(camera)
    start, random = torch.eye(4, dtype=torch.float64)[None], np.random.default_rng(seed)
    brightness = {"wall": torch.tensor([workspace.log_dark, 0.0]).double()}
    pool = draw_views(start, wall, hand_eye, workspace, brightness, rays, random)
    if pool is None:
        raise ConfigError("No view lies on the wall: allow shorter distances, or less tilt.")
    domain = domain_of_views(camera, workspace)
    design = Design(ErrorModel(model, domain), domain, rays)
    # An image counts for so many independent pixels: they share the errors of pose and target. Set
    # on the configurations demo, set2 and set3, where it counts for 140 to 330.
    share = min(1.0, 100 / (camera.height * camera.width))
    moments = pool.moments(design, hand_eye, share)
    here = Parameters(hand_eye, torch.zeros(len(moments.symbols)).double(), True)
    walls = Walls(normal, offset, torch.zeros(len(pool.target)).long(), pool.world_from_tool)
    information = joint_image_equations(moments, here, walls).hessian / residual**2
    order, covariances = choose_views(torch.zeros_like(information[0]), information, number)
    return PosePlan(
        start_from_tool=hand_eye @ pool.world_from_tool[order],
        described=pool.described[order],
        expected=torch.tensor([_expected(covariance) for covariance in covariances[1:]]),
    )


def domain_of_views(camera: CameraIntrinsics, workspace: Workspace) -> Domain:
    """Return ranges that scale the variables; any that contain the views serve."""
    grazing = math.cos(math.radians(_STEEPEST_INCIDENCE_DEG))
    dark, far = grazing * math.exp(workspace.log_dark), workspace.farthest / grazing
    return Domain(
        height=camera.height,
        width=camera.width,
        radial_distance=Interval(workspace.nearest, far),
        amplitude=Interval(dark / far**2, 1 / workspace.nearest**2),
        normalised_amplitude=Interval(dark, 1.0),
        modulation_frequency=SPEED_OF_LIGHT / (2 * far),
        conditions=dict.fromkeys(CONDITIONS, (0.0, 1.0, 0.5)),
    )


def _expected(covariance: Tensor) -> tuple[float, float]:
    """Return the standard errors of the worst axes, mm and degrees, from that of all unknowns."""
    # As in `observability`: half of the wide prior's variance.
    known = (one if 2 * one**2 < PRIOR_SIGMA**2 else math.inf for one in worst_axes(covariance))
    shift, turn = known
    return 1e3 * shift, math.degrees(turn)
