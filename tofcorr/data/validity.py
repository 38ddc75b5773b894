"""Which pixels may be used."""

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
    # Zero times NaN or infinity is NaN, above which nothing lies. Comparisons are not vectorised:
    # they take three times as long as the arithmetic.
    zero = distance * 0.0
    if amplitude is not None:
        zero.add_(amplitude, alpha=0.0)
    valid = distance > zero
    if amplitude is not None and saturation_amplitude is not None:
        valid &= amplitude < saturation_amplitude
    if mask is not None:
        valid &= mask.bool()
    return valid
