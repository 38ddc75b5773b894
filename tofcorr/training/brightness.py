"""How bright the dark and bright parts of each recorded target are."""

import math

import numpy as np
import torch
from torch import Tensor

from tofcorr.pixels.dataset import Dataset
from tofcorr.training.support import sample_reflectivity

# Reflectivity of a checkerboard's dark squares relative to its bright ones, if none was recorded.
# Set by hand for printed boards in the near infrared.
_DARK = 1 / 8
# Ratio of bright to dark from which a target has more than one reflectivity; as in `support`.
_CONTRAST = 2.0
# Quantiles of the log amplitude that stand for dark and bright reflectivity. Set by hand.
_DARK_AND_BRIGHT = (0.1, 0.9)
# About how many pixels a frame these are measured on. Set by hand.
_SAMPLE_PIXELS = 500


def target_brightness(dataset: Dataset, frames: np.ndarray, hand_eye: Tensor) -> dict[str, Tensor]:
    """Return dark and bright log normalised amplitude of each target, with a checkerboard."""
    if not dataset.has_amplitude:
        return {str(name): torch.zeros(2, dtype=torch.float64) for name in set(dataset.targets)}
    rays = dataset.ray_directions()
    names = dataset.targets[frames]
    samples = {
        str(name): [
            sample_reflectivity(batch, rays, hand_eye, _SAMPLE_PIXELS)[1]
            for batch in dataset.batches(frames[names == name])
        ]
        for name in np.unique(names)
    }
    quantiles = torch.tensor(_DARK_AND_BRIGHT, dtype=torch.float64)
    # A target may have no pixel with light that is not too grazing.
    some = {name: logs for name, parts in samples.items() if (logs := torch.cat(parts)).numel()}
    found = {name: logs.quantile(quantiles) for name, logs in some.items()}
    if not found:
        return {str(name): torch.zeros(2, dtype=torch.float64) for name in names}
    if all(float(high - low) < math.log(_CONTRAST) for low, high in found.values()):
        bright = max(float(high) for _, high in found.values())
        found["checkerboard"] = torch.tensor([bright + math.log(_DARK), bright]).double()
    return found
