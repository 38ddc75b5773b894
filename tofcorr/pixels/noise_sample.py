"""The noise of a data set, from frames taken without moving or from neighbouring pixels."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tofcorr.estimation.noise import DistanceNoise, fit_noise, neighbour_differences
from tofcorr.pixels.dataset import Dataset

# About how many differences the noise is fitted to. Set by hand.
_SAMPLE = 500_000
# Without repeated poses, neighbours are compared in evenly spread images of about this many pixels
# in all, but in no fewer images than that. More would hardly change the result. Set by hand.
_ENOUGH_PIXELS = 2_000_000
_FEWEST_FRAMES = 8


def estimate_noise(dataset: Dataset, frames: Sequence[int] | np.ndarray) -> DistanceNoise:
    """Return the noise of a measured distance as a function of its amplitude.

    It is estimated from frames of one pose. Without any, neighbouring pixels give an upper bound.

    Args:
        dataset: The recordings.
        frames: Global numbers of the frames.

    Raises:
        CalibrationDataError: There are no amplitudes, too few pixels, or most differences are zero.
    """
    dataset.require("amplitude", "the noise model")
    frames = np.asarray(frames)
    poses = dataset.pose_groups()[frames]
    _, group, count = np.unique(poses, return_inverse=True, return_counts=True)
    repeated = frames[count[group] > 1]
    if len(repeated):
        parts = [
            _repeat_differences(dataset, frames[group == k]) for k in np.flatnonzero(count > 1)
        ]
    else:
        camera = dataset.first.camera
        enough = max(_ENOUGH_PIXELS // (camera.height * camera.width), _FEWEST_FRAMES)
        some = np.linspace(0, len(frames) - 1, min(len(frames), enough)).astype(int)
        parts = _all_neighbours(dataset, frames[some])
    share = max(sum(len(part[0]) for part in parts) // _SAMPLE, 1)
    difference = torch.cat([part[0][::share] for part in parts])
    amplitude = torch.cat([part[1][::share] for part in parts])
    return fit_noise(difference, amplitude, "repeats" if len(repeated) else "neighbours")


def _repeat_differences(
    dataset: Dataset, frames: np.ndarray
) -> tuple[Float[Tensor, "S"], Float[Tensor, "S"]]:
    """Return differences between successive frames of one pose, less their median."""
    batches = list(dataset.batches(frames))
    distance = torch.cat([batch.radial_distance for batch in batches])
    amplitude = torch.cat([_amplitude(batch.amplitude) for batch in batches])
    valid = torch.cat([batch.valid for batch in batches])
    differences, amplitudes = [], []
    for k in range(0, len(distance) - 1, 2):
        both = valid[k] & valid[k + 1]
        change = (distance[k + 1] - distance[k])[both]
        if change.numel():
            differences.append(change - change.median())
            amplitudes.append((amplitude[k] + amplitude[k + 1])[both] / 2)
    empty = distance.new_zeros(0)
    return torch.cat([*differences, empty]), torch.cat([*amplitudes, empty])


def _all_neighbours(dataset: Dataset, frames: np.ndarray) -> list[tuple[Tensor, Tensor]]:
    rays = dataset.ray_directions()
    return [
        neighbour_differences(batch.radial_distance, _amplitude(batch.amplitude), batch.valid, rays)
        for batch in dataset.batches(frames)
    ]


def _amplitude(amplitude: Tensor | None) -> Tensor:
    assert amplitude is not None
    return amplitude
