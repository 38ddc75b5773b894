"""What spreads light over an image: blur, ghosts, and charge that runs along a line."""

import math

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample, interpolate

from tofcorr.geometry.camera import CameraIntrinsics

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


# The ghost of an image: light that lens and sensor threw back and forth.


def ghost(images: Tensor, camera: CameraIntrinsics, size: float) -> Tensor:
    """Return complex images (F, H, W) turned half round about the optical axis and made smaller.

    Outside the ghost, and where it shows what the image does not hold, it is dark.

    Args:
        images: Phasors.
        camera: Where the optical axis meets the image.
        size: Of the ghost, over that of the image.
    """
    height, width = images.shape[-2:]
    matrix = camera.matrix_tensor()
    row = torch.arange(height, dtype=torch.float64)
    column = torch.arange(width, dtype=torch.float64)
    y = matrix[1, 2] - (row - matrix[1, 2]) / size
    x = matrix[0, 2] - (column - matrix[0, 2]) / size
    # Places from -1 to 1 between the centres of the outermost pixels.
    y, x = 2 * y / max(height - 1, 1) - 1, 2 * x / max(width - 1, 1) - 1
    places = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
    parts = torch.view_as_real(images).movedim(-1, 1)
    turned = grid_sample(
        parts,
        places.to(parts.dtype).expand(len(parts), *places.shape),
        mode="bilinear",
        padding_mode="zeros",
        align_corners=True,
    )
    return torch.view_as_complex(turned.movedim(1, -1).contiguous())


# Charge that runs from full pixels along a line of the sensor (blooming).


# Pixels over which the charge falls by e, and how far it is followed. Set by hand: blooming of
# small pixels reaches a few of them.
_LENGTH_PX = 2.0
_REACH_PX = 4


def spilled(over: Tensor, axis: int) -> Tensor:
    """Return the charge that each pixel receives from the others on its line, like `over`.

    A pixel gives all that it has too much to its neighbours, equally to both sides and falling by
    e over two pixels. What would run beyond the edge of the image is lost.

    Args:
        over: Charge above the full level, of any shape, not negative.
        axis: The axis along which it runs.
    """
    count = over.shape[axis]
    weights = [math.exp(-place / _LENGTH_PX) for place in range(1, _REACH_PX + 1)]
    received = torch.zeros_like(over)
    for place, weight in enumerate(weights, start=1):
        if place >= count:
            break
        first, last = over.narrow(axis, 0, count - place), over.narrow(axis, place, count - place)
        share = weight / (2 * sum(weights))
        received.narrow(axis, place, count - place).add_(first, alpha=share)
        received.narrow(axis, 0, count - place).add_(last, alpha=share)
    return received
