"""What a robot and a camera recorded, as files of the formats that other programs write."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from tofcorr.options import dump_yaml


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """Images of a camera, and the poses of the robot that carried it.

    Attributes:
        depth_mm: z-depth, shape (I, H, W), uint16, millimetres; 0: no return.
        amplitude: Counts, shape (I, H, W), uint16.
        image_times: Stamps of the images, shape (I,), seconds.
        pose_times: Stamps of the poses, shape (P,), seconds.
        world_from_tool: The poses, shape (P, 4, 4).
        matrix: The pinhole matrix, shape (3, 3).
        distortion: Of the lens, OpenCV's order.
    """

    depth_mm: np.ndarray
    amplitude: np.ndarray
    image_times: np.ndarray
    pose_times: np.ndarray
    world_from_tool: np.ndarray
    matrix: np.ndarray
    distortion: tuple[float, ...]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the images."""
        return self.depth_mm.shape[2], self.depth_mm.shape[1]


def write_png(recorded: Recorded, folder: Path, names: Iterable[str]) -> None:
    """Write 16-bit images `depth/NAME.png`, millimetres, and `ir/NAME.png`, counts.

    Args:
        recorded: The images.
        folder: Where `depth` and `ir` are made.
        names: Of the images.
    """
    for kind, images in (("depth", recorded.depth_mm), ("ir", recorded.amplitude)):
        (folder / kind).mkdir(parents=True)
        for name, image in zip(names, images, strict=True):
            cv2.imwrite(str(folder / kind / f"{name}.png"), image)


def write_intrinsics(recorded: Recorded, path: Path) -> Path:
    """Write image size, K and distortion as YAML; return where."""
    width, height = recorded.size
    values: dict[str, Any] = {"width": width, "height": height, "K": recorded.matrix.tolist()}
    path.write_text(dump_yaml(values | {"distortion": [*recorded.distortion]}), encoding="utf-8")
    return path


def write_tum(times: np.ndarray, poses: np.ndarray, path: Path) -> Path:
    """Write lines `timestamp tx ty tz qx qy qz qw`, metres, as TUM's datasets do; return where."""
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    rows = np.column_stack([times, poses[:, :3, 3], turns])
    np.savetxt(path, rows, fmt=["%.6f"] + ["%.9f"] * 7, header="timestamp tx ty tz qx qy qz qw")
    return path


def write_matrices(poses: np.ndarray, path: Path) -> Path:
    """Write 16 numbers a line, metres; return where."""
    np.savetxt(path, poses.reshape(len(poses), 16), fmt="%.9f")
    return path
