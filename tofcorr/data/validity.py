"""Which pixels may be used."""

import math

from torch import Tensor


def valid_pixels(
    distance: Tensor,
    amplitude: Tensor | None = None,
    mask: Tensor | None = None,
    saturation_amplitude: float | None = None,
) -> Tensor:
    """Return True where a pixel holds a usable measurement of the target.

    A pixel is usable if its distance is finite and positive (NaN or <= 0 means "no return"), it
    sees the target, and its amplitude, if recorded, is finite and below saturation.

    Args:
        distance: Measured distances of either kind, shape (..., H, W), metres.
        amplitude: Amplitudes, shape of `distance`; None if unknown.
        mask: Non-zero where the pixel sees the target, shape of `distance`; None: everywhere.
        saturation_amplitude: Pixels at or above it are not used; None if unknown.

    Returns:
        Shape of `distance`, bool.
    """
    # Comparisons, which NaN fails, take a third of the time of `isfinite`.
    valid = (distance > 0) & (distance < math.inf)
    if amplitude is not None:
        valid &= amplitude.abs() < math.inf
        if saturation_amplitude is not None:
            valid &= amplitude < saturation_amplitude
    if mask is not None:
        valid &= mask.bool()
    return valid
