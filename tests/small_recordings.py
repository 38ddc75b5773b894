"""Recordings of a few pixels, for tests."""

from pathlib import Path
from typing import Any

import numpy as np
from cameras import camera, rigid
from scipy.spatial.transform import Rotation

from tofcorr.data.table import FrameRow
from tofcorr.data.writing import write_recording

NUM_FRAMES = 6
CAMERA = camera((7, 5), (9.0, 9.5), (3.2, 1.9), -0.08, 0.02, 0.0005, -0.0004, 0.0)


def drawn_transform(generator: np.random.Generator) -> np.ndarray:
    """Draw a rigid transform (4, 4)."""
    return rigid(Rotation.from_quat(generator.normal(size=4)), generator.normal(size=3))


def frame_rows(generator: np.random.Generator, num_frames: int = NUM_FRAMES) -> list[FrameRow]:
    """Draw rows with every optional column, a cell of `ambient` unknown."""
    rows = []
    for frame in range(num_frames):
        normal = generator.normal(size=3)
        rows.append(
            FrameRow(
                timestamp=0.1 * frame,
                world_from_tool=drawn_transform(generator),
                normal_world=normal / np.linalg.norm(normal),
                offset=float(generator.normal()),
                target="white" if frame % 2 else "checkerboard",
                pose_id=frame // 2,
                integration_time=1e-3 * (1 + frame),
                body_temperature=27.0 + 0.1 * frame,
                room_temperature=22.0,
                ambient=None if frame == 1 else 0.05,
            )
        )
    return rows


def small_images(generator: np.random.Generator, num_frames: int = NUM_FRAMES) -> dict[str, Any]:
    """Draw depth, amplitude, mask and raw; some pixels return nothing, some are masked out."""
    shape = (num_frames, CAMERA.height, CAMERA.width)
    depth = generator.uniform(0.5, 3.0, shape).astype(np.float32)
    depth[0, 0, :3] = [np.nan, 0.0, -1.0]
    return {
        "depth": depth,
        "amplitude": generator.uniform(0.0, 900.0, shape).astype(np.float32),
        "mask": (generator.uniform(size=shape) > 0.2).astype(np.uint8),
        "raw": generator.normal(size=(num_frames, 4, *shape[1:])).astype(np.float32),
    }


def write_small_recording(path: Path, seed: int = 0, **changes: Any) -> Path:
    """Write a recording with every optional part; `changes` replace parts of it."""
    generator = np.random.default_rng(seed)
    parts = {
        "camera": CAMERA,
        "depth_kind": "radial",
        "rows": frame_rows(generator),
        "modulation_frequency": 20e6,
        "saturation_amplitude": 800.0,
        "tool_from_camera": drawn_transform(generator),
        **small_images(generator),
    }
    write_recording(path, **(parts | changes))
    return path
