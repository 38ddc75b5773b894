"""Frames in memory for the benchmarks: a wall, tilted views, errors outside the models."""

import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from tofcorr.data.recording import FrameBatch
from tofcorr.data.table import FrameRow
from tofcorr.data.writing import RecordingWriter
from tofcorr.error_terms.base import Domain, Interval
from tofcorr.geometry import se3
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import plane_in_frame, ray_directions, ray_plane_distance

TOOL_FROM_CAMERA = (0.05, 0.02, 0.12, 0.3, -0.5, 1.2)
"""Twist of the true hand-eye transform, metres and radians."""


def camera_of(height: int, width: int) -> CameraIntrinsics:
    """Return a camera with the view of a 50 x 64 one of 90 pixels focal length."""
    focal = 90.0 * width / 64
    matrix = ((focal, 0.0, width / 2 + 0.2), (0.0, focal, height / 2 - 0.7), (0.0, 0.0, 1.0))
    distortion = (-0.08, 0.02, 0.0005, -0.0004, 0.0)
    return CameraIntrinsics(width=width, height=height, matrix=matrix, distortion=distortion)


def frames_in_memory(
    num_frames: int, camera: CameraIntrinsics, generator: torch.Generator
) -> tuple[FrameBatch, Domain]:
    """Draw frames of a checkered wall with a smooth error, 4 mm noise and robot noise.

    Args:
        num_frames: How many.
        camera: The lateral parameters.
        generator: Source of all randomness.

    Returns:
        The frames, and the domain that they cover.
    """
    rays = ray_directions(camera)
    draw = {"generator": generator, "dtype": torch.float64}
    hand_eye = se3.exp(torch.tensor(TOOL_FROM_CAMERA, dtype=torch.float64))
    turn = torch.randn(num_frames, 3, **draw) * torch.tensor([0.35, 0.35, 1.0])
    facing = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
    world_from_camera = facing @ se3.exp(torch.cat([torch.zeros_like(turn), turn], dim=1))
    place = torch.randn(num_frames, 3, **draw) * 0.2
    place[:, 2] = 0.6 + 1.2 * torch.rand(num_frames, **draw)
    world_from_camera[:, :3, 3] = place
    normal = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(num_frames, 3)
    offset = torch.zeros(num_frames, dtype=torch.float64)
    true = ray_plane_distance(rays, *plane_in_frame(normal, offset, world_from_camera))
    valid = torch.isfinite(true) & (true < 3)
    true = torch.where(valid, true, 1.0)
    amplitude = 300 / true**2 * (0.1 + 0.9 * torch.rand(true.shape, **draw))
    measured = true + _error(true, amplitude) + 0.004 * torch.randn(true.shape, **draw)
    wobble = se3.exp(3e-4 * torch.randn(num_frames, 6, **draw))
    world_from_tool = world_from_camera @ se3.inverse(hand_eye) @ wobble
    normal_tool, offset_tool = plane_in_frame(normal, offset, world_from_tool)
    batch = FrameBatch(
        indices=torch.arange(num_frames),
        radial_distance=measured,
        amplitude=amplitude,
        valid=valid,
        normal_tool=normal_tool,
        offset_tool=offset_tool,
    )
    return batch, _domain(batch, camera)


def write_vga(path: Path, num_frames: int) -> None:
    """Write a recording of VGA frames, eight different ones again and again: to be timed, only.

    The planes are given in the tool frame, as if the world moved with it.
    """
    camera = camera_of(480, 640)
    few, _ = frames_in_memory(8, camera, torch.Generator().manual_seed(3))
    assert few.amplitude is not None
    depth = torch.where(few.valid, few.radial_distance, 0.0).float().numpy()
    amplitude = few.amplitude.float().numpy()
    with RecordingWriter(path, camera=camera, depth_kind="radial") as writer:
        for k in range(num_frames):
            row = FrameRow(
                timestamp=float(k),
                world_from_tool=np.eye(4),
                normal_world=few.normal_tool[k % 8].numpy(),
                offset=float(few.offset_tool[k % 8]),
                target="checkerboard",
            )
            writer.append(depth[k % 8], row=row, amplitude=amplitude[k % 8])


def _error(distance: Tensor, amplitude: Tensor) -> Tensor:
    height, width = distance.shape[-2:]
    rows = torch.linspace(-1, 1, height, dtype=torch.float64)[:, None]
    columns = torch.linspace(-1, 1, width, dtype=torch.float64)
    wave = 0.02 * torch.sin(4 * math.pi * distance / 1.875)
    return wave + 0.008 * (rows**2 + columns**2) - 3e-5 * amplitude


def _domain(batch: FrameBatch, camera: CameraIntrinsics) -> Domain:
    distance, amplitude = batch.radial_distance[batch.valid], batch.amplitude
    assert amplitude is not None
    amplitude = amplitude[batch.valid]
    return Domain(
        height=camera.height,
        width=camera.width,
        radial_distance=_interval(distance),
        amplitude=_interval(amplitude),
        normalised_amplitude=_interval(amplitude * distance * distance),
    )


def _interval(values: Tensor) -> Interval:
    return Interval(float(values.min()), float(values.max()))
