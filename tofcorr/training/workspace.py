"""Where a camera may go before a wall, and views drawn there."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from tofcorr.errors import ConfigError
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.planes import plane_in_frame, ray_plane_distance
from tofcorr.geometry.rays import ray_directions
from tofcorr.training.next_poses import STEEPEST_INCIDENCE_DEG, moved_camera

# Poses drawn, of which the plan's are chosen, and trials for each. Set by hand: with 150 to 1200
# poses the expected rotation after 20 changes by a quarter, without a trend from 300 on.
_CANDIDATES, _TRIALS = 300, 20


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
    for _ in range(_TRIALS * _CANDIDATES):
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
