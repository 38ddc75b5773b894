"""The depth that an ideal camera would have measured, where a simulator wrote it."""

import numpy as np
import torch
from torch import Tensor

from tofcorr.data.arrays import open_array, read_frames
from tofcorr.data.recording import Recording
from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.diagnosis.sums.prediction import predicted_distance
from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.rays import ray_directions

_FILE = "true_depth.npy"


def has_true_depth(recording: Recording) -> bool:
    """Return whether the recording holds the true depth."""
    return (recording.path / _FILE).exists()


def true_distance(frames: Observations) -> Tensor:
    """Return the true radial distance of the chosen pixels, shape (M,), metres.

    It is that of `true_depth.npy`, NaN where the file has none; without the file, that of the
    planes.

    Raises:
        CalibrationDataError: The file does not fit the recording.
    """
    recording = frames.recording
    if not has_true_depth(recording):
        return predicted_distance(frames, torch.from_numpy(recording.tool_from_camera))
    path = recording.path / _FILE
    array = open_array(path, np.float32, (recording.camera.height, recording.camera.width))
    if len(array) != recording.num_frames:
        raise CalibrationDataError(
            f"{path}: has {len(array)} frames; frames.csv has {recording.num_frames} rows."
        )
    depth = torch.full_like(frames.measured, torch.nan)
    for frame, (start, end) in enumerate(frames.frame_ends):
        image = torch.from_numpy(read_frames(array, np.array([frame]))[0]).double().reshape(-1)
        depth[start:end] = image[frames.pixel[start:end]]
    depth = torch.where(depth > 0, depth, torch.nan)
    if recording.depth_kind == "radial":
        return depth
    rays = ray_directions(recording.camera).reshape(-1, 3)[frames.pixel]
    return depth / rays[:, 2]
