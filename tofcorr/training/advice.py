"""Which poses to record next, or first: drawn, and chosen by what they would tell."""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from tofcorr.conditions import CONDITIONS
from tofcorr.error_terms.domain import Domain, Interval
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.errors import ConfigError
from tofcorr.estimation.advice import (
    Views,
    choose_views,
    predicted_moments,
    view_information,
    worst_sigma,
)
from tofcorr.estimation.design import Design
from tofcorr.estimation.objective import Parameters
from tofcorr.estimation.planes import Walls, joint_image_equations
from tofcorr.estimation.uncertainty import PRIOR_SIGMA
from tofcorr.fit.result import Fit
from tofcorr.geometry import se3
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.planes import plane_in_frame, ray_plane_distance
from tofcorr.geometry.rays import ray_directions
from tofcorr.pixels.dataset import Dataset
from tofcorr.training.support import sample_reflectivity

# Reflectivity of a checkerboard's dark squares relative to its bright ones, if none was recorded.
# Set by hand for printed boards in the near infrared.
_DARK = 1 / 8
# Ratio of bright to dark from which a target has more than one reflectivity; as in `support`.
_CONTRAST = 2.0
# Quantiles of the log amplitude that stand for dark and bright reflectivity. Set by hand.
_DARK_AND_BRIGHT = (0.1, 0.9)
# About how many pixels a frame these are measured on. Set by hand.
_BRIGHTNESS_PIXELS = 500


def target_brightness(dataset: Dataset, frames: np.ndarray, hand_eye: Tensor) -> dict[str, Tensor]:
    """Return dark and bright log normalised amplitude of each target, with a checkerboard."""
    if not dataset.has_amplitude:
        return {str(name): torch.zeros(2, dtype=torch.float64) for name in set(dataset.targets)}
    rays = dataset.ray_directions()
    names = dataset.targets[frames]
    samples = {
        str(name): [
            sample_reflectivity(batch, rays, hand_eye, _BRIGHTNESS_PIXELS)[1]
            for batch in dataset.batches(frames[names == name])
        ]
        for name in np.unique(names)
    }
    quantiles = torch.tensor(_DARK_AND_BRIGHT, dtype=torch.float64)
    # A target may have no pixel with light that is not too grazing.
    some = {name: logs for name, parts in samples.items() if (logs := torch.cat(parts)).numel()}
    found = {name: logs.quantile(quantiles) for name, logs in some.items()}
    if not found:
        return {str(name): torch.zeros(2, dtype=torch.float64) for name in names}
    if all(float(high - low) < math.log(_CONTRAST) for low, high in found.values()):
        bright = max(float(high) for _, high in found.values())
        found["checkerboard"] = torch.tensor([bright + math.log(_DARK), bright]).double()
    return found


# Tilts, degrees, are drawn up to the largest recorded, but up to a limit between these two. Set by
# hand: what a robot arm reaches in front of a wall.
_TILT_DEG = (30.0, 40.0)
# Rolls, degrees, are drawn between plus and minus this. Set by hand.
_ROLL_DEG = 90.0
# Largest angle between a corner's ray and the wall's normal, degrees. Set by hand: the amplitude
# falls to a third there.
STEEPEST_INCIDENCE_DEG = 70.0
# Largest distance of a corner, as a multiple of the longest calibrated distance. Set by hand.
_FARTHEST = 1.05
# Nearest distance along the axis of a recorded pose that poses are drawn around, as a share of the
# shortest calibrated distance. Chosen: a fit that took the camera to the wall has all of them near
# zero, and says nothing of where poses should be.
_NEAREST = 0.5
# Poses that are drawn at most for each one that is wanted. Set by hand.
_TRIALS = 20


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

    def views(self) -> Views:
        """Return the views from these poses."""
        normal, offset = plane_in_frame(self.normal_world, self.offset, self.world_from_tool)
        return Views(normal, offset, self.brightness)


def draw_pool(
    dataset: Dataset,
    frames: np.ndarray,
    fit: Fit,
    generator: np.random.Generator,
    size: int = 300,
) -> PosePool | None:
    """Draw poses that look at the same wall, tilted, rolled and at other distances.

    Each is a recorded pose whose camera is turned about the point it looks at, rolled, and moved
    along its axis. The wall fills the image, nowhere too grazing or too far.

    Args:
        dataset: The recordings.
        frames: Global numbers of the frames that were fitted.
        fit: The calibration so far.
        generator: Source of randomness.
        size: How many.

    Returns:
        The poses; None if none was found where the wall fills the image, and for a fit that takes
        the camera to the wall.
    """
    hand_eye = fit.solution.parameters.tool_from_camera
    camera, normal, offset = _recorded_views(dataset, frames, hand_eye)
    axis = camera[:, :3, 2]
    distance = -((normal * camera[:, :3, 3]).sum(-1) + offset) / (normal * axis).sum(-1)
    nearest = _NEAREST * fit.domain.radial_distance.low
    usable = torch.isfinite(distance) & (distance > nearest)
    if not bool(usable.any()):
        return None
    camera, normal, offset, distance = (
        values[usable] for values in (camera, normal, offset, distance)
    )
    tilts = torch.rad2deg(torch.arccos((-(camera[:, :3, 2] * normal).sum(-1)).clamp(-1, 1)))
    steepest = min(max(float(tilts.max()), _TILT_DEG[0]), _TILT_DEG[1])
    rays = dataset.ray_directions()
    farthest = _FARTHEST * fit.domain.radial_distance.high
    brightness = target_brightness(dataset, frames, hand_eye)
    drawn, names = list[tuple[Tensor, int, str, list[float]]](), list(brightness)
    for _ in range(_TRIALS * size):
        k = int(generator.integers(len(distance)))
        tilt = steepest * generator.uniform()
        roll = _ROLL_DEG * generator.uniform(-1, 1)
        away = generator.uniform(float(distance.min()), float(distance.max()))
        azimuth = generator.uniform(0, 2 * math.pi)
        pose = moved_camera(camera[k], normal[k], distance[k], (tilt, azimuth, roll, away))
        if _fills_image(pose, normal[k], offset[k], rays, farthest):
            drawn.append((pose, k, names[len(drawn) % len(names)], [away, tilt, roll]))
        if len(drawn) == size:
            break
    if not drawn:
        return None
    chosen = [k for _, k, _, _ in drawn]
    return PosePool(
        world_from_tool=torch.stack([pose for pose, _, _, _ in drawn]) @ se3.inverse(hand_eye),
        normal_world=normal[chosen],
        offset=offset[chosen],
        target=[name for _, _, name, _ in drawn],
        brightness=torch.stack([brightness[name] for _, _, name, _ in drawn]),
        described=torch.tensor([text for _, _, _, text in drawn], dtype=torch.float64),
    )


def advise(
    dataset: Dataset, pool: PosePool, fit: Fit, number: int = 5
) -> tuple[list[int], dict[str, Any]]:
    """Choose the poses of a pool that would help most.

    Args:
        dataset: The recordings.
        pool: The poses to choose from.
        fit: The calibration so far.
        number: How many to choose.

    Returns:
        Their indices in the pool, and the advice for the report: each pose with the standard
        deviation of the worst direction (mm or mrad) to expect once it is added.
    """
    best = fit.solution.parameters
    design = Design(fit.model.error, fit.domain, dataset.ray_directions())
    camera = dataset.first.camera
    share = float(fit.moments.count.mean()) / (camera.height * camera.width)
    moments = predicted_moments(design, best.tool_from_camera, pool.views(), share)
    # Poses carry no information about condition terms.
    beyond = [symbol for symbol in fit.moments.symbols if symbol not in moments.symbols]
    if beyond:
        moments = moments.with_conditions(torch.zeros(moments.num_images, len(beyond)), beyond)
    added = view_information(moments, best, fit.observability.variance)
    choice = choose_views(fit.observability.precision, added, number)
    spreads = choice.covariances.diagonal(dim1=-2, dim2=-1).clamp(min=0.0).sqrt()
    worst = [1e3 * worst_sigma(covariance) for covariance in choice.covariances]
    poses = [
        {
            "target": pool.target[k],
            "distance_m": float(pool.described[k, 0]),
            "tilt_deg": float(pool.described[k, 1]),
            "roll_by_deg": float(pool.described[k, 2]),
            "world_from_tool": pool.world_from_tool[k].tolist() if dataset.moves else None,
            "worst_sigma_mm_or_mrad": worst[1 + place],
        }
        for place, k in enumerate(choice.order)
    ]
    advice: dict[str, Any] = {"worst_sigma_mm_or_mrad": worst[0], "poses": poses}
    if best.hand_eye_is_free:
        before, after = 1e3 * spreads[0, :6], 1e3 * spreads[-1, :6]
        advice["hand_eye_sigma_mm_or_mrad"] = {"before": before.tolist(), "after": after.tolist()}
    return choice.order, advice


def _recorded_views(
    dataset: Dataset, frames: np.ndarray, tool_from_camera: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return world_from_camera (N, 4, 4), and normals (N, 3) and offsets (N,) in the world."""
    cameras, normals, offsets = [], [], []
    for recording, _, local in dataset.by_recording(frames):
        table = recording.frames
        cameras.append(torch.from_numpy(table.world_from_tool[local]) @ tool_from_camera)
        normals.append(torch.from_numpy(table.normal_world[local]))
        offsets.append(torch.from_numpy(table.offset[local]))
    return torch.cat(cameras), torch.cat(normals), torch.cat(offsets)


def moved_camera(
    camera: Tensor, normal: Tensor, distance: Tensor, wanted: tuple[float, float, float, float]
) -> Tensor:
    """Turn, roll and move a camera that keeps looking at the same point of the wall.

    Args:
        camera: world_from_camera, shape (4, 4).
        normal: The wall's normal, towards the camera, shape (3,).
        distance: From the camera to the wall along its axis.
        wanted: Tilt (degrees) and its azimuth (radians), roll (degrees), distance (metres).
    """
    tilt, azimuth, roll, away = wanted
    point = camera[:3, 3] + distance * camera[:3, 2]
    across = torch.linalg.cross(normal, camera[:3, 0])
    across = across / across.norm()
    along = torch.linalg.cross(across, normal)
    aside = math.cos(azimuth) * along + math.sin(azimuth) * across
    axis = -math.cos(math.radians(tilt)) * normal + math.sin(math.radians(tilt)) * aside
    x = camera[:3, 0] - axis * (camera[:3, 0] @ axis)
    x = x / x.norm()
    turned = torch.stack([x, torch.linalg.cross(axis, x), axis], dim=1)
    c, s = math.cos(math.radians(roll)), math.sin(math.radians(roll))
    spin = [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]
    return se3.assemble(turned @ torch.tensor(spin, dtype=torch.float64), point - away * axis)


def _fills_image(
    camera: Tensor, normal: Tensor, offset: Tensor, rays: Tensor, farthest: float
) -> bool:
    normal_camera, offset_camera = plane_in_frame(normal, offset, camera)
    corners = rays[[0, 0, -1, -1], [0, -1, 0, -1]][None]
    distance = ray_plane_distance(corners, normal_camera, offset_camera)
    cosine = -(corners @ normal_camera)
    steepest = math.cos(math.radians(STEEPEST_INCIDENCE_DEG))
    return bool(((distance <= farthest) & (cosine >= steepest)).all())


# Poses drawn, of which the plan's are chosen, and trials for each. Set by hand: with 150 to 1200
# poses the expected rotation after 20 changes by a quarter, without a trend from 300 on.
_CANDIDATES, _WORKSPACE_TRIALS = 300, 20


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
    """

    nearest: float
    farthest: float
    tilt_deg: float = 35.0
    roll_deg: float = 90.0
    wall_size: tuple[float, float] | None = None
    checkerboard: bool = False

    def __post_init__(self) -> None:
        """Refuse a workspace that no camera can be in.

        Raises:
            ConfigError: A number is out of range.
        """
        if not 0 < self.nearest < self.farthest:
            raise ConfigError(
                f"The distances {self.nearest:g} to {self.farthest:g} m are not an interval in "
                "front of the camera."
            )
        if not 0 < self.tilt_deg < STEEPEST_INCIDENCE_DEG:
            raise ConfigError(
                f"The tilt of {self.tilt_deg:g} degrees is not between 0 and "
                f"{STEEPEST_INCIDENCE_DEG:g}."
            )


def draw_views(
    camera: CameraIntrinsics, workspace: Workspace, distance: float, generator: np.random.Generator
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return cameras (M, 4, 4) in the start camera's frame, their description, and the wall."""
    normal = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    offset = torch.tensor(distance, dtype=torch.float64)
    start = torch.eye(4, dtype=torch.float64)
    corners = ray_directions(camera)[[0, 0, -1, -1], [0, -1, 0, -1]]
    found, described = [], []
    for _ in range(_WORKSPACE_TRIALS * _CANDIDATES):
        tilt = workspace.tilt_deg * generator.uniform()
        roll = workspace.roll_deg * generator.uniform(-1, 1)
        away = generator.uniform(workspace.nearest, workspace.farthest)
        azimuth = generator.uniform(0, 2 * math.pi)
        pose = moved_camera(start, normal, offset, (tilt, azimuth, roll, away))
        if _on_wall(pose, corners, normal, offset, workspace.wall_size):
            found.append(pose)
            described.append([away, tilt, roll])
        if len(found) == _CANDIDATES:
            break
    if not found:
        raise ConfigError(
            "No view between the given distances lies on the wall: allow shorter distances, less "
            "tilt, or give the wall's size."
        )
    return torch.stack(found), torch.tensor(described, dtype=torch.float64), normal, offset


def _on_wall(
    pose: Tensor,
    corners: Tensor,
    normal: Tensor,
    offset: Tensor,
    wall_size: tuple[float, float] | None,
) -> bool:
    """Whether all corners of the image look at the wall, not too grazing."""
    normal_camera, offset_camera = plane_in_frame(normal, offset, pose)
    cosine = -(corners @ normal_camera)
    if not bool((cosine >= math.cos(math.radians(STEEPEST_INCIDENCE_DEG))).all()):
        return False
    if wall_size is None:
        return True
    distance = ray_plane_distance(corners[None], normal_camera, offset_camera)[0]
    points = (corners * distance[:, None]) @ pose[:3, :3].T + pose[:3, 3]
    return bool((points[:, :2].abs() <= torch.tensor(wall_size, dtype=torch.float64) / 2).all())


# How many independent pixels an image counts for: its pixels share the errors of pose and target.
# Set on the configurations demo, set2 and set3, where an image counts for 140 to 330.
_INDEPENDENT_PIXELS = 100
# A direction counts as determined below this share of the wide prior's standard deviation; as in
# `observability`.
_DETERMINED = math.sqrt(0.5)
# Reflectivity of a checkerboard's dark squares relative to its bright ones, as in `next_poses`.
_LOG_DARK = math.log(1 / 8)


class HandEyeErrors(NamedTuple):
    """Expected standard errors of the hand-eye transform; infinite while it is not determined.

    Attributes:
        translation_mm: Of the worst axis of the translation.
        rotation_deg: About the worst axis.
    """

    translation_mm: float
    rotation_deg: float


@dataclass(frozen=True, kw_only=True, eq=False)
class PosePlan:
    """Poses to record, the most informative first.

    Attributes:
        start_from_tool: Poses of the tool relative to where it starts, shape (N, 4, 4), metres.
        described: Distance (m), tilt and roll (degrees) of each, shape (N, 3).
        expected: What is to be expected after the first k poses, N entries.
    """

    start_from_tool: Tensor
    described: Tensor
    expected: tuple[HandEyeErrors, ...]

    def __repr__(self) -> str:
        """Return the expected standard errors after every few poses, as a table."""
        lines = ["poses   hand-eye: worst axis of translation    rotation"]
        count = len(self.expected)
        for k in sorted({*range(5, count, 5), count}):
            found = self.expected[k - 1]
            if math.isinf(found.translation_mm + found.rotation_deg):
                lines.append(f"{k:5d}   not determined")
            else:
                lines.append(
                    f"{k:5d}   {found.translation_mm:24.2f} mm {found.rotation_deg:16.3f} deg"
                )
        return "\n".join(lines)


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
    generator = np.random.default_rng(seed)
    candidates = draw_views(camera, workspace, start_distance or middle, generator)
    cameras, described, normal, offset = candidates
    world_from_tool = cameras @ se3.inverse(hand_eye)
    normals, offsets = normal.expand(len(cameras), 3), offset.expand(len(cameras))
    normal_tool, offset_tool = plane_in_frame(normals, offsets, world_from_tool)
    brightness = torch.tensor([_LOG_DARK if workspace.checkerboard else 0.0, 0.0]).double()
    views = Views(normal_tool, offset_tool, brightness.expand(len(cameras), 2))
    domain = _domain(camera, workspace)
    error = ErrorModel(model, domain)
    design = Design(error, domain, ray_directions(camera))
    share = min(1.0, _INDEPENDENT_PIXELS / (camera.height * camera.width))
    moments = predicted_moments(design, hand_eye, views, share)
    here = Parameters(hand_eye, torch.zeros(len(moments.symbols)).double(), True)
    index = torch.zeros(len(cameras), dtype=torch.long)
    walls = Walls(normal[None], offset[None], index, world_from_tool)
    information = joint_image_equations(moments, here, walls).hessian / residual**2
    nothing = torch.zeros_like(information[0])
    choice = choose_views(nothing, information, number)
    first_from_tool = hand_eye @ world_from_tool[choice.order]
    return PosePlan(
        start_from_tool=first_from_tool,
        described=described[choice.order],
        expected=tuple(_expected(covariance) for covariance in choice.covariances[1:]),
    )


def _domain(camera: CameraIntrinsics, workspace: Workspace) -> Domain:
    """Return ranges that scale the variables; any that contain the views serve."""
    grazing = math.cos(math.radians(STEEPEST_INCIDENCE_DEG))
    dark = grazing * math.exp(_LOG_DARK if workspace.checkerboard else 0.0)
    far = workspace.farthest / grazing
    return Domain(
        height=camera.height,
        width=camera.width,
        radial_distance=Interval(workspace.nearest, far),
        amplitude=Interval(dark / far**2, 1 / workspace.nearest**2),
        normalised_amplitude=Interval(dark, 1.0),
        modulation_frequency=20e6,
        conditions=dict.fromkeys(CONDITIONS, (0.0, 1.0, 0.5)),
    )


def _expected(covariance: Tensor) -> HandEyeErrors:
    """Return the standard errors of the worst axes, from the covariance of all unknowns."""

    def worst(part: Tensor) -> float:
        sigma = float(torch.linalg.eigvalsh(part)[-1].clamp(min=0).sqrt())
        return sigma if sigma < _DETERMINED * PRIOR_SIGMA else math.inf

    return HandEyeErrors(1e3 * worst(covariance[:3, :3]), math.degrees(worst(covariance[3:6, 3:6])))
