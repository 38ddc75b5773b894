"""Images blurred by a Gaussian."""

import math

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

# Half width of the kernel in standard deviations: 0.3 % of a Gaussian lies beyond 3.
_KERNEL_SIGMAS = 3.0
# Samples per standard deviation of a wide Gaussian. Set by hand; the tests of `blur` bound what it
# changes in a smooth image.
_PIXELS_PER_SIGMA = 3.0


def blur(images: Tensor, sigma: float) -> Tensor:
    """Blur complex or real images (F, H, W) by a Gaussian of `sigma` pixels, edges repeated.

    A wide Gaussian is applied to images averaged over squares of a third of `sigma`.
    """
    size = images.shape[-2:]
    square = max(1, min(int(sigma / _PIXELS_PER_SIGMA), *size))
    if square == 1:
        return _gaussian(images, sigma)
    if images.is_complex():
        return torch.complex(blur(images.real, sigma), blur(images.imag, sigma))
    coarse = avg_pool2d(images[:, None], square, ceil_mode=True, count_include_pad=False)
    coarse = _gaussian(coarse[:, 0], sigma / square)[:, None]
    fine = interpolate(coarse, scale_factor=square, mode="bilinear", align_corners=False)
    return fine[:, 0, : size[0], : size[1]]


def _gaussian(images: Tensor, sigma: float) -> Tensor:
    half = max(1, round(_KERNEL_SIGMAS * sigma))
    half = max(0, min(half, images.shape[-1] - 1, images.shape[-2] - 1))
    weights = [math.exp(-0.5 * (place / sigma) ** 2) for place in range(-half, half + 1)]
    weights = [weight / sum(weights) for weight in weights]
    if images.is_complex():
        parts = torch.view_as_real(images)
        return torch.view_as_complex(_filtered(parts, weights).contiguous())
    return _filtered(images, weights)


def _filtered(images: Tensor, weights: list[float]) -> Tensor:
    """Filter images (F, H, W, ...) along rows and columns by symmetric weights (2 half + 1).

    Sums of shifted images: on a processor up to three times as fast as a convolution with one
    channel.
    """
    half = len(weights) // 2
    for axis in (1, 2):
        count = images.shape[axis]
        repeats = [half if each == axis else 1 for each in range(images.dim())]
        ends = images.narrow(axis, 0, 1), images.narrow(axis, count - 1, 1)
        wide = torch.cat([ends[0].repeat(repeats), images, ends[1].repeat(repeats)], axis)
        images = weights[half] * wide.narrow(axis, half, count)
        for place in range(half):
            pair = wide.narrow(axis, place, count) + wide.narrow(axis, 2 * half - place, count)
            images.add_(
                pair, alpha=weights[place]
            )  # Of a sum made above: its gradient stays right.
    return images
