"""The noise of single pixels is no error of lens, poses or target."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from tofcorr.data.recording import Recording
from tofcorr.geometry.rays import ray_directions
from tofcorr.pixels.dataset import Dataset
from tofcorr.plausibility.examine import examine

# Of one pixel, metres. Larger than what is tolerated of poses and lens.
_NOISE = 0.04
_DRAWS = 9


def _flat_wall(clean: Path, generator: np.random.Generator) -> Recording:
    """The poses of a recording before walls without any error but noise."""
    recording = Recording.open(clean)
    table, hand_eye = recording.frames, recording.tool_from_camera
    camera = table.world_from_tool @ hand_eye
    normal = np.einsum("fba,fb->fa", camera[:, :3, :3], table.normal_world)
    offset = (table.normal_world * camera[:, :3, 3]).sum(1) + table.offset
    rays = ray_directions(recording.camera).numpy()
    distance = -offset[:, None, None] / np.einsum("hwa,fa->fhw", rays, normal)
    distance += _NOISE * generator.standard_normal(distance.shape)
    depth = distance * rays[..., 2] if recording.depth_kind == "z" else distance
    return replace(recording, depth=depth.astype(np.float32), amplitude=None, mask=None)


def test_noise_bends_no_wall(clean: Path) -> None:
    # The places of the points had the noise of their distances. So the square of a place followed
    # the residual, and a flat wall before a noisy camera was bent by a centimetre.
    generator = np.random.default_rng(416)
    seen = [examine(Dataset((_flat_wall(clean, generator),))).look.shape for _ in range(_DRAWS)]
    shapes = [shape for shape in seen if shape is not None]
    assert len(shapes) == _DRAWS
    curvatures = [shape["curvature"] for shape in shapes]
    standardised = np.array([one.value / one.error for one in curvatures])
    # The mean of nine estimates without bias has a third of a standard error; three of these.
    assert np.abs(standardised.mean(axis=0)).max() < 1.0
