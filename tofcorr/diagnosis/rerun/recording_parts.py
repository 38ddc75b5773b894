"""Parts of a recording, written as recordings of their own."""

from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from tofcorr.data.recording import Recording
from tofcorr.data.writing import RecordingWriter
from tofcorr.observables.read import pose_groups


def halves(recording: Recording, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the frames of a random half of the poses, and those of the other half."""
    groups = pose_groups(recording)
    order = np.random.default_rng(seed).permutation(len(groups))
    parts = order[: (len(groups) + 1) // 2], order[(len(groups) + 1) // 2 :]
    first, second = (np.sort(np.concatenate([groups[k] for k in part])) for part in parts)
    return first, second


def subset(recording: Recording, frames: np.ndarray, path: Path) -> Recording:
    """Write some frames of a recording as a recording of their own."""
    with RecordingWriter.with_header_of(path, recording) as writer:
        for number in frames.tolist():
            images = _images(recording, number)
            writer.append(images.pop("depth"), row=recording.frames.row(number), **images)
    return Recording.open(path, check_contents=False)


def with_depth(recording: Recording, depth: Tensor, path: Path) -> Recording:
    """Write a recording anew with other depth (F, H, W)."""
    with RecordingWriter.with_header_of(path, recording) as writer:
        for number, image in enumerate(depth.numpy()):
            images = _images(recording, number) | {"depth": image}
            writer.append(images.pop("depth"), row=recording.frames.row(number), **images)
    return Recording.open(path, check_contents=False)


def _images(recording: Recording, number: int) -> dict[str, Any]:
    names = ("depth", "amplitude", "mask")
    read = {name: recording.read(name, np.array([number])) for name in names}
    return {name: None if image is None else image[0] for name, image in read.items()}
