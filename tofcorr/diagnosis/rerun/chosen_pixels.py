"""The chosen pixels of a diagnosis as a recording of their own, with other distances."""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.geometry.rays import ray_directions


def recording_of(
    observations: Observations, distance: Tensor, tool_from_camera: Tensor
) -> Recording:
    """Return a recording in memory in which only the chosen pixels have a distance.

    Args:
        observations: Frames, pixels, planes and amplitudes.
        distance: Radial distance of each chosen pixel, shape (M,), metres; NaN: none.
        tool_from_camera: Hand-eye transform that its header states, shape (4, 4).
    """
    recording = observations.recording
    images = torch.full(observations.distance_images.shape, torch.nan, dtype=torch.float64)
    images.flatten(1)[observations.frame, observations.pixel] = distance
    depth = images.numpy()
    if recording.depth_kind == "z":
        depth = depth * ray_directions(recording.camera)[..., 2].numpy()
    amplitude = observations.amplitude_images
    return replace(
        recording,
        tool_from_camera=tool_from_camera.numpy(),
        frames=replace(
            recording.frames,
            normal_world=observations.facts.normal_world.numpy(),
            offset=observations.facts.offset.numpy(),
        ),
        depth=depth.astype(np.float32),
        amplitude=None if amplitude is None else amplitude.clamp(min=0.0).numpy(),
        mask=None,
        raw=None,
        true_depth=None,
        planes="recorded",
    )
