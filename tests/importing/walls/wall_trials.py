"""Distances of a single-pixel sensor beside robot poses, as a recording of 1 x 1 images.

For the trials of Sifferman et al. (2022), `$TOFCORR_REAL_DATA/wall_trials_l3cx`: a line of
`transforms.csv` is a pose, the line of `measurements.csv` with the same number its readings.
"""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from tofcorr.data.recording import Recording
from tofcorr.data.table import FrameRow
from tofcorr.data.writing import write_recording
from tofcorr.geometry.camera import CameraIntrinsics

MOUNTS = ("P1", "P2")
WALLS = ("R1", "R2", "W1", "W2")
# One pixel at the principal point: its ray is the optical axis.
ONE_PIXEL = CameraIntrinsics(
    width=1, height=1, matrix=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
)


def read_trial(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read poses (N, 4, 4) and the median distance at each (N,), in metres."""
    poses = [_numbers(line) for line in (folder / "transforms.csv").read_text().splitlines()]
    lines = (folder / "measurements.csv").read_text().splitlines()
    readings = [_numbers(line.partition(",")[2]) for line in lines]
    distance = [np.median(one) / 1e3 for one in readings if one]
    return np.array([pose for pose in poses if pose]).reshape(-1, 4, 4), np.array(distance)


def record_trials(
    real_data: Path, out: Path, mount: str, walls: Iterable[str] = WALLS
) -> Recording:
    """Write the trials of one mount before some walls as a recording; targets are the walls."""
    rows, depth = [], []
    for wall in walls:
        poses, distances = read_trial(real_data / "wall_trials_l3cx" / f"L3CX_{wall}_{mount}")
        for pose, distance in zip(poses, distances, strict=True):
            rows.append(
                FrameRow(
                    timestamp=float(len(rows)),
                    world_from_tool=_rigid(pose),
                    normal_world=np.array([0.0, 0.0, -1.0]),
                    offset=1.0,
                    target=wall,
                )
            )
            depth.append([[distance]])
    write_recording(out, camera=ONE_PIXEL, depth_kind="radial", rows=rows, depth=np.array(depth))
    return Recording.open(out)


def _rigid(pose: np.ndarray) -> np.ndarray:
    """Make the rotation exact: the file has it to six digits."""
    left, _, right = np.linalg.svd(pose[:3, :3])
    exact = pose.copy()
    exact[:3, :3] = left @ right
    return exact


def _numbers(line: str) -> list[float]:
    return [float(cell) for cell in line.split(",") if cell.strip()]
