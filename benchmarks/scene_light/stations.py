"""Recordings of a wall with a floor, a side wall or another wall, rendered whole, by a robot."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from benchmarks.scene_light.bounces import camera, measured
from benchmarks.scene_light.edges import smooth
from benchmarks.scene_light.rooms import FREQUENCY, Frame, looking, rays, rendered
from tofcorr.data.recording import Recording
from tofcorr.data.table import FrameRow
from tofcorr.data.writing import RecordingWriter
from tofcorr.geometry import se3

ROBOT = 3e-4  # metres and radians of a pose
MOUNT = (0.03, -0.02, 0.09, 0.02, -0.03, 1.2)  # of the camera on the tool: twist
ROOMS = {  # eye and its spread, the point looked at and its spread
    "wall_and_floor": ((0, 1.8, 0.9), (0.6, 0.6, 0.35), (0, 0, 0.65), (0.3, 0, 0.25)),
    "wall_and_side": ((1.0, 1.8, 0), (0.45, 0.6, 0.5), (0.8, 0, 0), (0.3, 0, 0.3)),
    "long_corner": ((1.4, 1.7, 0), (0.4, 0.5, 0.5), (0.5, 0.1, 0), (0.3, 0.1, 0.3)),
}


def stations(room: str, seed: int, count: int) -> np.ndarray:
    """Poses world_from_camera (N, 4, 4) before the wall y = 0."""
    draw = np.random.default_rng([seed, *room.encode(), 7])
    eye, spread, at, aim = (np.array(each, dtype=float) for each in ROOMS[room])
    return np.stack(
        [
            looking(
                eye + spread * draw.uniform(-1, 1, 3),
                at + aim * draw.uniform(-1, 1, 3),
                draw.normal(0, 0.4),
            )
            for _ in range(count)
        ]
    )


def frames_of(room: str, seed: int, count: int) -> tuple[np.ndarray, list[Frame]]:
    """Poses and frames, without the noise of the paths."""
    poses = stations(room, seed, count)
    frames = rendered(room, seed, count, poses=poses)
    return poses, [replace(one, ratio=smooth(one.ratio, one.shape)) for one in frames]


def on_wall(frame: Frame, pose: np.ndarray) -> np.ndarray:
    """Where a frame shows the wall y = 0, two pixels from its edges (H, W)."""
    from scipy.ndimage import binary_erosion

    y = (frame.distance[..., None] * rays()) @ pose[1, :3] + pose[1, 3]
    return binary_erosion(np.abs(y) < 1e-3, iterations=2, border_value=1)


def record(room: str, seed: int, count: int, out: Path) -> Recording:
    """Write a recording, with noise, base errors, and a hand-eye transform that is off."""
    draw = np.random.default_rng([seed, 3])
    mount = se3.exp(torch.tensor(MOUNT, dtype=torch.float64)).numpy()
    miss = se3.exp(torch.tensor(draw.normal(0, 5e-3, 6))).numpy()
    header = {"tool_from_camera": mount @ miss, "modulation_frequency": FREQUENCY}
    poses, frames = frames_of(room, seed, count)
    with RecordingWriter(out, camera=camera(), depth_kind="radial", **header) as writer:
        for number, (pose, frame) in enumerate(zip(poses, frames, strict=True)):
            distance, amplitude = measured(frame, draw)
            slip = se3.exp(torch.tensor(draw.normal(0, ROBOT, 6))).numpy()
            row = FrameRow(
                timestamp=4.0 * number,
                world_from_tool=pose @ np.linalg.inv(mount) @ slip,
                normal_world=np.array([0.0, 1.0, 0.0]),
                offset=0.0,
                target="wall",
            )
            writer.append(
                distance.numpy(),
                amplitude=amplitude.numpy(),
                mask=on_wall(frame, pose).astype(np.uint8),
                true_depth=frame.distance,
                row=row,
            )
    return Recording.open(out)
