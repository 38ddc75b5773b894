"""Images of a checkerboard by ray casting: independent of the code that finds it again."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cameras
import cv2
import numpy as np
from importing.posed_scene import unit_rays

from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.importing.checkerboard.boards import Board, BoardPose

BOARD = Board(columns=5, rows=7, square_length=0.03)
LENS = (0.06, -0.12, 0.0008, -0.0005, 0.02)
CAMERA = cameras.camera((320, 240), (290.0, 288.0), (158.3, 121.6), *LENS)
# A Fibonacci lattice of points inside a pixel.
_SAMPLES = 21
_LATTICE_STEP = 13
_LENS_BLUR_PIXELS = 0.5


@dataclass(frozen=True, kw_only=True)
class Placement:
    """The board in the camera frame: x_camera = rotation x_board + translation."""

    rotation: np.ndarray
    translation: np.ndarray

    @property
    def normal(self) -> np.ndarray:
        return -self.rotation[:, 2] * np.sign(self.translation @ self.rotation[:, 2])

    @property
    def offset(self) -> float:
        return float(-self.normal @ self.translation)


def placement(
    distance: float,
    tilt_x: float = 0.0,
    tilt_y: float = 0.0,
    roll: float = 0.0,
    aside: Sequence[float] = (0.0, 0.0),
) -> Placement:
    """Put the board's centre at `distance` metres, shifted `aside` metres; angles in degrees."""
    angles = np.radians([tilt_x, tilt_y, roll])
    turns = [cv2.Rodrigues(np.eye(3)[axis] * angles[axis])[0] for axis in range(3)]
    rotation = turns[0] @ turns[1] @ turns[2]
    centre = np.array([*aside, distance]) - rotation @ BOARD.corner_points().mean(axis=0)
    return Placement(rotation=rotation, translation=centre)


def varied_placements(count: int, seed: int = 3) -> list[Placement]:
    generator = np.random.default_rng(seed)
    return [
        placement(
            generator.uniform(0.45, 0.8),
            *(generator.uniform(10, 30, 2) * generator.choice([-1, 1], 2)),
            roll=generator.uniform(-40, 40),
            aside=generator.uniform(-0.06, 0.06, 2).tolist(),
        )
        for _ in range(count)
    ]


def project(
    where: Placement, camera: CameraIntrinsics = CAMERA, points: np.ndarray | None = None
) -> np.ndarray:
    points = BOARD.corner_points() if points is None else points
    pose = cv2.Rodrigues(where.rotation)[0], where.translation
    lens = np.array(camera.matrix), np.array(camera.distortion)
    return cv2.projectPoints(points, *pose, *lens)[0][:, 0]


@lru_cache(maxsize=24)
def rays(camera: CameraIntrinsics, shift: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """Unit rays, shape (H, W, 3)."""
    matrix = np.array(camera.matrix)
    matrix[:2, 2] -= shift
    return unit_rays(matrix, camera.width, camera.height, camera.distortion)


def radial_distance(where: Placement, camera: CameraIntrinsics = CAMERA) -> np.ndarray:
    return -where.offset / (rays(camera) @ where.normal)


def infrared(where: Placement, camera: CameraIntrinsics = CAMERA) -> np.ndarray:
    """Counts of an actively lit board with a white border on a dark wall, uint16."""
    total = np.zeros((camera.height, camera.width))
    for i in range(_SAMPLES):
        # A lattice whose points share neither row nor column: edges along the grid blend finely.
        ray = rays(camera, (_centred(i), _centred(i * _LATTICE_STEP % _SAMPLES)))
        cosine = ray @ where.normal
        distance = -where.offset / cosine
        on_board = (distance[..., None] * ray - where.translation) @ where.rotation[:, :2]
        squares = on_board / BOARD.square_length
        total += _reflectivity(squares) * -cosine / distance**2
    blurred = cv2.GaussianBlur(total / _SAMPLES, (0, 0), _LENS_BLUR_PIXELS)
    return np.clip(3000 * blurred + 60, 0, 65535).astype(np.uint16)


def centre(pose: BoardPose, board: Board) -> np.ndarray:
    """Where a pose puts the centre of a board, camera frame."""
    return pose.rotation @ board.corner_points().mean(axis=0) + pose.translation


def _centred(sample: int) -> float:
    return (sample + 0.5) / _SAMPLES - 0.5


def _reflectivity(squares: np.ndarray) -> np.ndarray:
    column, row = np.floor(squares[..., 0]) + 1, np.floor(squares[..., 1]) + 1
    on_print = (column >= 0) & (column <= BOARD.columns) & (row >= 0) & (row <= BOARD.rows)
    on_paper = (column >= -1) & (column <= BOARD.columns + 1) & (row >= -1)
    on_paper &= row <= BOARD.rows + 1
    dark = on_print & ((column + row) % 2 == 0)
    return np.where(dark, 0.1, np.where(on_paper, 0.8, 0.05))


def write_view(
    folder: Path,
    name: str,
    where: Placement,
    *,
    error: float = 0.0,
    kind: str = "z",
    camera: CameraIntrinsics = CAMERA,
) -> None:
    """Write NAME_ir.png and NAME_depth.png (millimetres), reading `error` metres too far."""
    folder.mkdir(exist_ok=True)
    depth = radial_distance(where, camera) + error
    if kind == "z":
        depth = depth * rays(camera)[..., 2]
    counts = np.clip(np.round(1e3 * depth), 0, 65535).astype(np.uint16)
    cv2.imwrite(str(folder / f"{name}_ir.png"), infrared(where, camera))
    cv2.imwrite(str(folder / f"{name}_depth.png"), counts)


def angle_deg(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))
