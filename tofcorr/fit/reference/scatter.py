"""How far images depart from each other, in the offset that each shows whatever its wall.

Noise is measured within each image. Errors that every image has alike, such as a fixed pattern of
the pixels, count there as noise and make no image depart from another. What is expected between
images is therefore compared with what is seen, in the images of the calibration itself.
"""

import torch
from torch import Tensor

from tofcorr.estimation.random_effects import Estimate, GroupSums, reduced

# Turns and shift of each image's own wall: the first of its effects.
_OF_WALL = 3
# Fewest pixels beyond the effects of an image that is compared: with fewer, its noise is hardly
# known. Chosen.
_FEWEST = 30
# Curvature below this share of the largest is rounding: before a frontal wall the offset is its
# shift. Chosen: there 1e-10 is left, and a wall that is tilted by a degree has 1e-4.
_RESOLVED = 1e-9


def own_noise(sums: GroupSums) -> Tensor:
    """Return the variance of an observation of weight 1 within each image, shape (G,).

    Args:
        sums: Of each image; its first unknown is the offset.
    """
    left = torch.stack([_squares_left(products, sums.random) for products in sums.products])
    return left / (sums.size - sums.random - 1).clamp(min=1)


def scatter(sums: GroupSums, found: Estimate) -> float:
    """Return the mean square of the images' departures over what is expected; 1: as expected.

    Args:
        sums: Of each image; the first unknown is the offset, the others are those of `found`.
        found: What the images say together, without an offset.
    """
    precision = 1 / found.variances.random
    precision[:_OF_WALL] = 0.0
    images = reduced(sums, own_noise(sums), precision)
    gain = images.precision[:, 0, 0]
    cross = images.precision[:, 0, 1:]
    score = images.right[:, 0] - cross @ found.mean
    expected = gain - ((cross @ found.covariance) * cross).sum(dim=1)
    told = (gain > 0) & (sums.size - sums.random > _FEWEST)
    departure, free = score[told].square() / gain[told], (expected[told] / gain[told]).clamp(min=0)
    return float(departure.sum() / free.sum()) if float(free.sum()) > 0 else 1.0


def _squares_left(products: Tensor, random: int) -> Tensor:
    """Return the sum of squares that offset, wall and shapes leave of one image's residuals."""
    size = len(products)
    kept = [0, *range(size - random - 1, size - 1)]
    own, right = products[kept][:, kept], products[kept, -1]
    scale = own.diagonal().clamp(min=1e-300).rsqrt()
    scaled = own * scale[:, None] * scale[None, :]
    inverted = torch.linalg.pinv(scaled, rtol=_RESOLVED, hermitian=True)
    return products[-1, -1] - (right * scale) @ inverted @ (right * scale)
