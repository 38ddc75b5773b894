"""A room rendered by ray-plane intersection in NumPy alone: nothing of the package decides it."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cameras
import numpy as np
import torch
from importing.posed_scene import (
    FLOOR,
    FRONT,
    LEFT,
    Plane,
    looking,
    met,
    systematic_error,
    unit_rays,
)
from scipy.spatial.transform import Rotation

from tofcorr.data.recording import Recording
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import ray_directions
from tofcorr.importing.images import DepthImage
from tofcorr.importing.intrinsics import GivenIntrinsics
from tofcorr.importing.pose_track import PoseTrack
from tofcorr.importing.posed import import_posed
from tofcorr.importing.robot_images import PosedOptions, RobotImages
from tofcorr.importing.walls.finding import FoundWalls, walls_of_planes
from tofcorr.importing.walls.image_planes import WallOptions, planes_of_image

# Planes n . x + d = 0 of a room of 4 m by 5 m, z up, the robot near its middle: normals inwards.
SLANTED: Plane = ((-0.5, 0.8660254037844386, 0.0), 1.9)
ROOM = (FLOOR, FRONT, LEFT, SLANTED)
CUPBOARD: Plane = ((-1.0, 0.0, 0.0), 1.7)
"""A plane parallel to FRONT and 300 mm nearer; seen where |y| < 0.6 m."""


def pinhole(width: int = 64, height: int = 50, focal: float = 60.0) -> CameraIntrinsics:
    """Return a pinhole camera without distortion."""
    centre = (width - 1) / 2, (height - 1) / 2
    return cameras.camera((width, height), (focal, focal), centre)


@dataclass(frozen=True)
class Views:
    """What the robot and the camera recorded.

    Attributes:
        depth: Along the ray, shape (N, H, W), metres; NaN where nothing is met.
        amplitude: Shape (N, H, W).
        plane: Which plane of the room each pixel shows, shape (N, H, W); -1: none of them.
        world_from_tool: Shape (N, 4, 4).
    """

    depth: np.ndarray
    amplitude: np.ndarray
    plane: np.ndarray
    world_from_tool: np.ndarray


@dataclass(frozen=True)
class Room:
    """A room, a camera in it and the camera's errors.

    Attributes:
        camera: The camera.
        planes: The room's planes (normal, offset).
        tool_from_camera: The hand-eye transform.
        noise: Standard deviation of a distance, metres.
        error: Scale of the systematic errors: 1 is some 10 to 20 mm.
        clutter: Share of the pixels on boxes.
    """

    camera: CameraIntrinsics = field(default_factory=pinhole)
    planes: tuple[Plane, ...] = ROOM
    tool_from_camera: np.ndarray = field(default_factory=lambda: np.eye(4))
    noise: float = 0.003
    error: float = 1.0
    clutter: float = 0.0

    @property
    def rays(self) -> np.ndarray:
        """Unit rays of the camera, shape (H, W, 3)."""
        return unit_rays(np.array(self.camera.matrix), self.camera.width, self.camera.height)

    def views(self, world_from_camera: np.ndarray, generator: np.random.Generator) -> Views:
        """Render an image from each pose."""
        images = [self._image(pose, generator) for pose in world_from_camera]
        depth, amplitude, plane = (np.stack(part) for part in zip(*images, strict=True))
        tool = world_from_camera @ np.linalg.inv(self.tool_from_camera)
        return Views(depth, amplitude, plane, tool)

    def _image(
        self, pose: np.ndarray, generator: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        rays = self.rays

        def shown(number: int, points: np.ndarray) -> np.ndarray | bool:
            return self.planes[number] != CUPBOARD or np.abs(points[..., 1]) < 0.6

        nearest, cosine, plane = met(self.planes, rays @ pose[:3, :3].T, pose[:3, 3], shown)
        while np.mean(plane == -1) < self.clutter:
            box = _box(rays, generator)
            seen = box < nearest
            nearest[seen], cosine[seen], plane[seen] = box[seen], 0.7, -1
        depth = np.where(np.isfinite(nearest), nearest, np.nan)
        amplitude = 400 * cosine / depth**2 * rays[..., 2] ** 2
        error = 0.004 + 0.001 * (depth - 1.5)
        error = error + systematic_error(depth, amplitude, 0.03, (8e-3, -5e-3), -1.5e-5)
        measured = depth + self.error * error
        measured = measured + self.noise * generator.normal(size=depth.shape)
        return measured, np.nan_to_num(amplitude), plane


def _box(rays: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Return where rays meet a box at a random place in view; infinite elsewhere."""
    centre = rays.reshape(-1, 3)[generator.integers(rays.shape[0] * rays.shape[1])]
    centre = centre * generator.uniform(0.5, 0.9)
    turn = Rotation.from_quat(generator.normal(size=4)).as_matrix()
    half = generator.uniform(0.03, 0.10, 3)
    with np.errstate(divide="ignore", invalid="ignore"):
        slabs = (np.stack([-half, half])[:, None, None] + (centre @ turn)) / (rays @ turn)
    near, far = slabs.min(axis=0).max(axis=-1), slabs.max(axis=0).min(axis=-1)
    return np.where((near < far) & (near > 0), near, np.inf)


def poses_in_room(
    number: int, generator: np.random.Generator, towards: tuple[float, float, float] | None = None
) -> np.ndarray:
    """Draw camera poses near the middle of the room, shape (N, 4, 4), looking at walls and floor.

    Args:
        number: How many.
        generator: Draws them.
        towards: Look about there; None: each at a random place of the walls or the floor.
    """
    poses = []
    for _ in range(number):
        place = np.array([0.3, 0.2, 0.9]) + generator.uniform(-0.45, 0.45, 3)
        around = generator.uniform([0.6, -1.2, -0.2], [2.0, 2.2, 1.1])
        if towards is not None:
            around = np.array(towards) + generator.uniform(-0.7, 0.7, 3)
        poses.append(looking(place, around, generator.uniform(-np.pi, np.pi)))
    return np.stack(poses)


def hand_eye_anywhere(generator: np.random.Generator) -> np.ndarray:
    """Draw a hand-eye transform: any rotation, up to 150 mm along each axis."""
    turn = Rotation.from_quat(generator.normal(size=4))
    return cameras.rigid(turn, generator.uniform(-0.15, 0.15, 3))


RADIAL = PosedOptions(depth_kind="radial")


def imported(
    out: Path,
    camera: CameraIntrinsics,
    poses: np.ndarray,
    depth: np.ndarray,
    amplitude: np.ndarray | None = None,
    targets: np.ndarray | None = None,
    options: PosedOptions = RADIAL,
) -> tuple[Recording, dict[str, Any]]:
    """Import depth, by default along the ray, and poses of the tool, paired in their order."""
    names = [str(k) for k in range(len(depth))]

    def read(k: int) -> DepthImage:
        counts = None if amplitude is None else amplitude[k].astype(np.float32)
        return DepthImage(depth[k].astype(np.float32), counts)

    images = RobotImages(
        origin="room",
        names=names,
        intrinsics=GivenIntrinsics(
            matrix=camera.matrix, distortion=camera.distortion, source="room"
        ),
        read=read,
        track=PoseTrack.checked(poses, "room"),
        targets=targets,
    )
    report = import_posed(images, out, options)
    return Recording.open(out), report


def found_in(
    room: Room, views: Views, options: WallOptions | None = None, targets: np.ndarray | None = None
) -> FoundWalls:
    """Find the walls of views."""
    return found_in_images(views.depth, room.camera, views.world_from_tool, options, targets)


def found_in_images(
    depth: Sequence[np.ndarray] | np.ndarray,
    camera: CameraIntrinsics,
    world_from_tool: np.ndarray,
    options: WallOptions | None = None,
    targets: np.ndarray | None = None,
) -> FoundWalls:
    """Find the walls of images of distances (H, W) along the ray; NaN: no return."""
    images = [torch.from_numpy(np.array(one, dtype=float)) for one in depth]
    given, rays, named = options or WallOptions(), ray_directions(camera), targets is not None
    planes = [planes_of_image(one, one.isfinite(), rays, given, named=named) for one in images]
    names, pixels = [f"image {k}" for k in range(len(images))], camera.width * camera.height
    return walls_of_planes(planes, names, pixels, world_from_tool, given, "room", targets)


def looking_straight(number: int, roll: float, generator: np.random.Generator) -> np.ndarray:
    """Draw camera poses (N, 4, 4) that look at FRONT head-on, rolled by up to `roll` radians."""
    places = poses_in_room(number, generator)[:, :3, 3]
    straight = Rotation.from_matrix([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    rolls = Rotation.from_rotvec(roll * generator.uniform(-1, 1, (number, 1)) * [0, 0, 1])
    return cameras.rigid(straight * rolls, places)
