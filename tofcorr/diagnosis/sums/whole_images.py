"""All pixels of some frames, where the diagnosis has chosen some pixels of every frame."""

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.diagnosis.sums.pixel_noise import PixelNoise, brightness_of
from tofcorr.diagnosis.sums.robust_weights import Neighbours, robust_weights
from tofcorr.diagnosis.sums.shared_noise import SharedNoise, shared_noise

# About how many pixels are looked at, in at least so many frames. Chosen: correlations of
# neighbours are then known to a per cent.
_PIXELS, _LEAST_FRAMES = 400_000, 8


def whole_images(observations: Observations) -> Observations | None:
    """Return all pixels of some evenly spread frames; None where all pixels were chosen anyway."""
    if not observations.is_sample:
        return None
    usable = observations.usable
    counts = usable.flatten(1).sum(1)
    seen = torch.nonzero(counts)[:, 0]
    most = max(int(_PIXELS / counts[seen].double().mean()), _LEAST_FRAMES)
    frames = seen[torch.linspace(0, len(seen) - 1, min(most, len(seen))).round().long()]
    number, pixel = usable[frames].flatten(1).nonzero(as_tuple=True)
    frame, images = frames[number], observations.amplitude_images
    return replace(
        observations,
        frame=frame,
        pixel=pixel,
        measured=observations.distance_images.flatten(1)[frame, pixel].double(),
        amplitude=None if images is None else images.flatten(1)[frame, pixel].double(),
    )


def with_level_of_images(
    shared: SharedNoise,
    observations: Observations,
    noise: PixelNoise,
    residual_of: Callable[[Observations], Tensor],
) -> SharedNoise:
    """Return what neighbours share, its level from whole images where pixels were chosen.

    Chosen pixels have no near neighbours, in which a filter shows.

    Args:
        shared: As the chosen pixels show it.
        observations: The chosen pixels.
        noise: That differences between neighbours see.
        residual_of: Returns the residual of a fit in other pixels, metres.
    """
    whole = whole_images(observations)
    if whole is None:
        return shared
    residual, sigma = residual_of(whole), noise.at(brightness_of(whole), whole.frame)
    trust = robust_weights(residual, sigma, Neighbours(whole).common(residual))
    level = max(shared.level, shared_noise(whole, residual, sigma, trust).level)
    return replace(shared, level=level, whole=shared.whole * (shared.level / level) ** 2)
