"""Leaves out pixels whose raw error is far from the median raw error.

Mixed pixels at edges, reflections and misplaced masks are off by decimetres; the errors to be
calibrated are centimetres. In a squared loss a few such pixels would outweigh all others.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tofcorr.data.frames import FrameBatch
from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.planes import ray_plane_distance
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.hand_eye import recorded_hand_eye

# The median is taken over a regular sample of about this many pixels. Set by hand.
_SAMPLE_PIXELS = 2_000_000


@dataclass(frozen=True)
class OutlierWindow:
    """The interval of raw errors in which pixels are used.

    The raw error is measured minus true distance along the ray, the true one from the target's
    plane under the recorded hand-eye transform.

    Attributes:
        centre: Median raw error of all usable pixels, metres.
        half_width: Largest distance of a raw error from the median, metres.
        tool_from_camera: The recorded hand-eye transform, shape (4, 4).
        ray_directions: Unit rays in the camera frame, shape (H, W, 3).
    """

    centre: float
    half_width: float
    tool_from_camera: Float[Tensor, "4 4"]
    ray_directions: Float[Tensor, "H W 3"]

    def raw_error(self, batch: FrameBatch) -> Float[Tensor, "B H W"]:
        """Return raw errors, shape (B, H, W), metres; NaN where a ray meets no plane."""
        transform = self.tool_from_camera.to(batch.normal_tool)
        normal = batch.normal_tool @ transform[:3, :3]
        offset = batch.normal_tool @ transform[:3, 3] + batch.offset_tool
        rays = self.ray_directions.to(batch.radial_distance)
        return batch.radial_distance - ray_plane_distance(rays, normal, offset)

    def __call__(self, batch: FrameBatch) -> Bool[Tensor, "B H W"]:
        """Return True where a pixel lies outside the window, shape (B, H, W)."""
        # A comparison with NaN is False: pixels without a plane count as outside.
        return ~((self.raw_error(batch) - self.centre).abs() <= self.half_width)


def without_outliers(
    dataset: Dataset, window_mm: float | None, frames: Sequence[int] | np.ndarray | None = None
) -> Dataset:
    """Return the data set with every pixel left out whose raw error is off by more than a window.

    Args:
        dataset: The recordings.
        window_mm: Largest distance from the median raw error, millimetres; None keeps all.
        frames: Global numbers of the frames that the median is taken over; None: all.

    Raises:
        CalibrationDataError: No usable pixel looks at its plane.
    """
    if window_mm is None:
        return dataset
    camera = dataset.first.camera
    window = OutlierWindow(
        0.0, window_mm / 1e3, recorded_hand_eye(dataset), dataset.ray_directions()
    )
    num_frames = dataset.num_frames if frames is None else len(frames)
    step = -(-num_frames * camera.height * camera.width // _SAMPLE_PIXELS)
    errors = [
        window.raw_error(batch)[batch.valid & batch.radial_distance.isfinite()][::step]
        for batch in dataset.batches(frames)
    ]
    finite = torch.cat(errors)
    finite = finite[finite.isfinite()]
    if not finite.numel():
        raise CalibrationDataError(
            f"{dataset.first.path}: outlier_window_mm needs pixels that look at their plane, and "
            "there are none; check the planes in frames.csv and tool_from_camera."
        )
    return replace(dataset, exclude=replace(window, centre=float(np.median(finite.numpy()))))
