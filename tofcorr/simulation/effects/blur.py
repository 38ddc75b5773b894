"""Images blurred by a Gaussian."""

import torch
from kornia.filters import gaussian_blur2d
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
    if images.is_complex():
        return torch.complex(blur(images.real, sigma), blur(images.imag, sigma))
    size = images.shape[-2:]
    square = max(1, min(int(sigma / _PIXELS_PER_SIGMA), *size))
    coarse = images[:, None]
    if square > 1:
        coarse = avg_pool2d(coarse, square, ceil_mode=True, count_include_pad=False)
    coarse = _gaussian(coarse, sigma / square)
    if square > 1:
        coarse = interpolate(coarse, scale_factor=square, mode="bilinear", align_corners=False)
    return coarse[:, 0, : size[0], : size[1]]


def _gaussian(images: Tensor, sigma: float) -> Tensor:
    half = max(1, round(_KERNEL_SIGMAS * sigma))
    half = max(0, min(half, images.shape[-1] - 1, images.shape[-2] - 1))
    width = 2 * half + 1
    return gaussian_blur2d(images, (width, width), (sigma, sigma), "replicate")
