"""Which poses to add to a recording, and the uncertainty to expect with them."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tofcorr.estimation.advice import (
    Views,
    choose_views,
    predicted_moments,
    view_information,
    worst_sigma,
)
from tofcorr.estimation.design import Design
from tofcorr.fit.fitting import Fit
from tofcorr.geometry import se3
from tofcorr.geometry.planes import plane_in_frame, ray_plane_distance
from tofcorr.pixels.dataset import Dataset
from tofcorr.training.brightness import target_brightness

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
