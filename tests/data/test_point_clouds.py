"""Point clouds of a recording, read by trimesh."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from optional import present
from small_recordings import CAMERA, NUM_FRAMES, write_small_recording

from tofcorr.data.recording import Recording
from tofcorr.data.writing import write_point_clouds
from tofcorr.geometry.rays import ray_directions

Frames = tuple[torch.Tensor, torch.Tensor]


def nearer_by_a_tenth(depth: torch.Tensor, amplitude: torch.Tensor) -> Frames:
    corrected = torch.where(depth > 0, depth - 0.1, torch.nan)
    return corrected, depth < 2.0


def read(path: Path) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return points (M, 3) and the properties of a cloud, read by trimesh."""
    cloud: Any = trimesh.load(path)
    data = cloud.metadata["_ply_raw"]["vertex"]["data"]
    return np.asarray(cloud.vertices), {name: data[name].ravel() for name in data.dtype.names}


@pytest.mark.parametrize("depth_kind", ["radial", "z"])
def test_points_lie_on_their_rays_at_the_measured_and_the_corrected_distance(
    depth_kind: str, tmp_path: Path
) -> None:
    recording = Recording.open(write_small_recording(tmp_path / "wall", depth_kind=depth_kind))
    write_point_clouds(nearer_by_a_tenth, recording, tmp_path / "clouds")
    assert len(list((tmp_path / "clouds").iterdir())) == 2 * NUM_FRAMES
    rays = ray_directions(CAMERA).numpy()
    depth = np.asarray(recording.depth[0], np.float64)
    returned = np.isfinite(depth) & (depth > 0)
    for name, moved in (("before", 0.0), ("after", 0.1)):
        points, values = read(tmp_path / "clouds" / f"frame_000_{name}.ply")
        along = points[:, 2] if depth_kind == "z" else np.linalg.norm(points, axis=1)
        np.testing.assert_allclose(along, depth[returned] - moved, rtol=1e-6)
        unit = points / np.linalg.norm(points, axis=1, keepdims=True)
        np.testing.assert_allclose(unit, rays[returned], atol=1e-6)
        amplitude = present(recording.amplitude)[0]
        np.testing.assert_array_equal(values["amplitude"], amplitude[returned])
    on_target = (depth < 2.0) & (present(recording.mask)[0] == 1)
    np.testing.assert_array_equal(values["valid"], on_target[returned])


def test_a_recording_without_amplitude_gives_points_without_it(tmp_path: Path) -> None:
    recording = Recording.open(write_small_recording(tmp_path / "wall", amplitude=None))
    write_point_clouds(nearer_by_a_tenth, recording, tmp_path / "clouds")
    _, values = read(tmp_path / "clouds" / "frame_005_before.ply")
    assert list(values) == ["x", "y", "z"]
