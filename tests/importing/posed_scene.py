"""A robot that drives a depth camera through a room, rendered in NumPy alone.

Nothing of the package decides what is recorded: the laws of pinhole, plane and clock stand here a
second time.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from cameras import rigid
from scipy.spatial.transform import Rotation, Slerp

from tofcorr.examples import files

# Planes n . x + d = 0 around the robot, normals inwards, z up.
Plane = tuple[tuple[float, float, float], float]
FLOOR: Plane = ((0.0, 0.0, 1.0), 0.0)
FRONT: Plane = ((-1.0, 0.0, 0.0), 2.0)
LEFT: Plane = ((0.0, -1.0, 0.0), 2.2)
ROOM = (FLOOR, FRONT, LEFT)

FARTHEST = 6.5
"""Metres from which on nothing returns: 0.1 mm in 16 bits reach 6.55 m."""

HAND_EYE = rigid(Rotation.from_rotvec([0.3, -0.4, 1.1]), [0.05, -0.03, 0.08])

DISTORTION = (-0.06, 0.02, 0.0008, -0.0005, 0.0)
"""Of a plumb_bob lens."""


@dataclass(frozen=True, kw_only=True)
class Recorded(files.Recorded):
    """What the robot and the camera recorded, and what only this file knows of it.

    Attributes:
        stop: The stop that each image was taken at, shape (I,); -1: in motion.
        exact: The pose at which each image was taken, shape (I, 4, 4).
        tool_from_camera: The hand-eye transform, shape (4, 4).
    """

    stop: np.ndarray
    exact: np.ndarray
    tool_from_camera: np.ndarray

    def take(self, chosen: np.ndarray) -> "Recorded":
        """Return some of the images, with all poses."""
        names = ("depth_mm", "amplitude", "image_times", "stop", "exact")
        return replace(self, **{name: getattr(self, name)[chosen] for name in names})

    def one_a_stop(self) -> "Recorded":
        """Return the first image of each stop."""
        _, first = np.unique(self.stop, return_index=True)
        return self.take(first[self.stop[first] >= 0])

    def with_camera_fixed(self) -> "Recorded":
        """Return the same images of a robot that carries the walls before a camera on its base.

        What was `world` is then the robot's tool, and what was `tool` its base; the poses become
        base_from_tool.
        """
        poses, exact = np.linalg.inv(self.world_from_tool), np.linalg.inv(self.exact)
        return replace(self, world_from_tool=poses, exact=exact)

    def stamped_late(self, seconds: float) -> "Recorded":
        """Return the same with the image clock late by this much."""
        return replace(self, image_times=self.image_times + seconds)


@dataclass(frozen=True, kw_only=True)
class Drive:
    """A room, a camera and a robot's programme.

    Attributes:
        stops: How many.
        width: Pixels.
        height: Pixels.
        error: Scale of the camera's systematic errors: 1 is some 10 mm.
        noise: Standard deviation of a distance, metres.
        planes: Of the room.
        seed: Of poses and noise.
        rate: Images a second.
        dwell: Seconds of a stop.
        move: Seconds of a move.
        tool_from_camera: The hand-eye transform.
        distortion: Of the lens.
        one_wall: Whether all views look straight at the front wall, instead of around the room.
    """

    stops: int = 40
    width: int = 64
    height: int = 50
    error: float = 1.0
    noise: float = 0.003
    planes: tuple[Plane, ...] = ROOM
    seed: int = 0
    rate: float = 7.0
    dwell: float = 0.8
    move: float = 0.7
    tool_from_camera: np.ndarray = field(default_factory=HAND_EYE.copy)
    distortion: tuple[float, ...] = DISTORTION
    one_wall: bool = False

    def record(self) -> Recorded:
        """Drive, and record."""
        generator = np.random.default_rng(self.seed)
        hand_eye = self.tool_from_camera
        camera_poses = np.stack(
            [_looking_at_walls(generator, self.one_wall) for _ in range(self.stops)]
        )
        tool_poses = camera_poses @ np.linalg.inv(hand_eye)
        end = self.stops * (self.dwell + self.move) - self.move
        start = 1000.0
        pose_times = np.arange(0.0, end, 0.1)
        # A camera's own clock: its period jitters, and its stamps lie between those of the poses.
        period = 1 / self.rate
        image_times = np.arange(0.031, end - 0.1, period)
        image_times = image_times + generator.uniform(-0.1, 0.1, len(image_times)) * period
        exact, stop = self._at(tool_poses, image_times)
        images = [self._image(pose @ hand_eye, generator) for pose in exact]
        depth, amplitude = (np.stack(part) for part in zip(*images, strict=True))
        return Recorded(
            depth_mm=depth,
            amplitude=amplitude,
            image_times=start + image_times,
            stop=stop,
            pose_times=start + pose_times,
            world_from_tool=self._at(tool_poses, pose_times)[0],
            exact=exact,
            matrix=self._matrix(),
            distortion=self.distortion,
            tool_from_camera=hand_eye,
        )

    def _at(self, stops: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the poses at some times, and the stops (-1: in motion)."""
        cycle = self.dwell + self.move
        number = np.minimum((times // cycle).astype(int), len(stops) - 1)
        share = np.clip((times - number * cycle - self.dwell) / self.move, 0.0, 1.0)
        smooth = share * share * (3 - 2 * share)
        smooth[number == len(stops) - 1] = 0.0
        turned = Slerp(np.arange(len(stops)), Rotation.from_matrix(stops[:, :3, :3]))
        following = np.minimum(number + 1, len(stops) - 1)
        weight = smooth[:, None]
        place = (1 - weight) * stops[number, :3, 3] + weight * stops[following, :3, 3]
        return rigid(turned(number + smooth), place), np.where(share > 0, -1, number)

    def _matrix(self) -> np.ndarray:
        focal = 0.95 * self.width
        matrix = np.diag([focal, focal, 1.0])
        matrix[:2, 2] = self.width / 2 - 0.8, self.height / 2 + 0.3
        return matrix

    def _image(
        self, world_from_camera: np.ndarray, generator: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        rays = unit_rays(self._matrix(), self.width, self.height, self.distortion)
        world, place = rays @ world_from_camera[:3, :3].T, world_from_camera[:3, 3]
        nearest, cosine, _ = met(self.planes, world, place)
        returned = nearest < FARTHEST
        depth = np.where(returned, nearest, 1.0)
        # A wall with a pattern: the amplitude is not a function of distance and angle alone.
        met_at = place + depth[..., None] * world
        reflectivity = 0.7 + 0.3 * np.sign(np.sin(9 * met_at).prod(axis=-1) + 0.02)
        amplitude = 3000 * reflectivity * cosine / depth**2 * rays[..., 2] ** 2
        error = systematic_error(depth, amplitude, 0.02, (6e-3, -4e-3), -1.5e-6)
        noise = generator.normal(size=depth.shape)
        measured = depth + self.error * error + self.noise * noise
        z_mm = np.round(1e3 * measured * rays[..., 2])
        depth, counts = (np.where(returned, one, 0) for one in (z_mm, np.round(amplitude)))
        return depth.astype(np.uint16), counts.astype(np.uint16)


def unit_rays(
    matrix: np.ndarray, width: int, height: int, distortion: tuple[float, ...] = ()
) -> np.ndarray:
    """Return unit rays, shape (H, W, 3), the lens's distortion undone by iteration."""
    v, u = np.mgrid[:height, :width].astype(float)
    seen = np.stack([(u - matrix[0, 2]) / matrix[0, 0], (v - matrix[1, 2]) / matrix[1, 1]])
    k1, k2, p1, p2, k3 = (*distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]
    x, y = seen
    for _ in range(50 if distortion else 0):
        square = x * x + y * y
        radial = 1 + square * (k1 + square * (k2 + square * k3))
        x, y = (
            (seen[0] - 2 * p1 * x * y - p2 * (square + 2 * x * x)) / radial,
            (seen[1] - p1 * (square + 2 * y * y) - 2 * p2 * x * y) / radial,
        )
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def systematic_error(
    depth: np.ndarray, amplitude: np.ndarray, bowl: float, tilt: tuple[float, float], slope: float
) -> np.ndarray:
    """Return D + P + I: a quadratic in distance, a bowl and a tilt, a slope in amplitude."""
    row, column = np.indices(depth.shape) / np.reshape(depth.shape, (2, 1, 1)) - 0.5
    apart = depth - 1.5
    of_distance = 0.006 + 0.005 * apart - 0.003 * apart**2
    of_pixel = bowl * (row**2 + column**2) + tilt[0] * row + tilt[1] * column
    return of_distance + of_pixel + slope * amplitude


def _looking_at_walls(generator: np.random.Generator, one_wall: bool) -> np.ndarray:
    """Draw a camera pose near the middle of the room that looks at walls or floor, or at one."""
    place = np.array([0.6, 0.6, 0.9]) + generator.uniform(-0.4, 0.4, 3)
    at = generator.uniform([0.8, -0.6, -0.1], [2.0, 2.2, 1.0])
    if one_wall:  # Tilted by less than 35 degrees.
        at = place + np.array([1.0, *generator.uniform(-0.5, 0.5, 2)])
    return looking(place, at, generator.uniform(-np.pi, np.pi))


def looking(place: np.ndarray, at: np.ndarray, roll: float) -> np.ndarray:
    """Return the pose of a camera that looks at a point, rolled by an angle, shape (4, 4)."""
    z = (at - place) / np.linalg.norm(at - place)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    upright = Rotation.from_matrix(np.stack([x, np.cross(z, x), z], axis=1))
    return rigid(upright * Rotation.from_rotvec([0, 0, roll]), place)


def met(
    planes: Iterable[Plane],
    world: np.ndarray,
    place: np.ndarray,
    shown: Callable[[int, np.ndarray], np.ndarray | bool] = lambda number, points: True,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return where rays meet the nearest plane (infinite: nowhere), the cosine, and its number.

    Args:
        planes: n . x + d = 0.
        world: Unit rays in the world, shape (H, W, 3).
        place: Of the camera, shape (3,).
        shown: Tells which points of a plane are there at all.
    """
    nearest, cosine = np.full(world.shape[:2], np.inf), np.zeros(world.shape[:2])
    plane = np.full(world.shape[:2], -1)
    for k, (normal, offset) in enumerate(planes):
        towards = world @ np.array(normal)
        with np.errstate(divide="ignore", invalid="ignore"):
            far = -(np.array(normal) @ place + offset) / towards
            seen = (towards < -1e-3) & (far > 0.05) & (far < nearest)
            seen &= shown(k, place + far[..., None] * world)
        nearest[seen], cosine[seen], plane[seen] = far[seen], -towards[seen], k
    return nearest, cosine, plane
