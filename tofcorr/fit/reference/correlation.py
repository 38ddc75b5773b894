r"""How many times fewer independent pixels an image has than it seems.

Errors of neighbouring pixels are alike: filters of the camera, the print of a board, and multipath
see to that. A fit that takes them as independent believes itself far too sure. With
:math:`S_b` the sum of the residuals of block b, :math:`\sum_b S_b^2` grows with the size of the
blocks until they are larger than what is alike; how much larger it is then than for independent
pixels is the design effect of survey sampling (Kish 1965).
"""

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from tofcorr.fit.reference.linear_image import LinearImage

# Sides of the blocks, pixels. Chosen: twice as large each, up to a tenth of an image; what is alike
# over more bends the image, and has its own effects.
_SIDES = (2, 4, 8, 16, 32)
# Fewest blocks for each quantity that was fitted to the image: with fewer the fit leaves nothing of
# a block's mean. Chosen.
_BLOCKS_OF_UNKNOWN = 2
# Standard deviations by which larger blocks must show more than smaller ones to be believed: by
# chance they do once in forty times.
_SURELY = 2.0


@dataclass
class Correlation:
    """Adds up, image by image, how much alike neighbouring residuals are."""

    _sums: Tensor = field(default_factory=lambda: torch.zeros(len(_SIDES), 3, dtype=torch.float64))

    def add(self, image: LinearImage, weight: Tensor) -> None:
        """Add an image, without its plane and its smooth shapes.

        Args:
            image: The image.
            weight: Of its pixels, shape (M,): one over the variance that their noise has.
        """
        self._sums += _squares(image, weight.sqrt())

    def design_effect(self) -> float:
        """Return the variance of a sum of neighbouring residuals over that of independent ones.

        At least 1, which stands for independent pixels.
        """
        effect = 1.0
        for seen, expected, freedom in self._sums.tolist():
            if freedom > 0 and seen / expected * (1 - _SURELY * math.sqrt(2 / freedom)) > effect:
                effect = seen / expected
        return effect


def _squares(image: LinearImage, root: Tensor) -> Tensor:
    """Return squares of block sums, what independent pixels would give, and degrees of freedom.

    One line for each side of blocks, shape (K, 3); zeros where there are too few blocks.
    """
    own = torch.cat([image.gain[:, None], image.moves, image.shapes], dim=1)
    q = torch.linalg.qr(own * root[:, None]).Q
    residual = image.residual * root
    residual = residual - q @ (q.T @ residual)
    pixels, unknowns = q.shape
    noise = residual.square().sum() / max(pixels - unknowns, 1)
    lines = torch.zeros(len(_SIDES), 3).to(residual)
    for line, side in zip(lines, _SIDES, strict=True):
        names, block = torch.unique(
            image.rows // side * 10_000 + image.columns // side, return_inverse=True
        )
        if len(names) < _BLOCKS_OF_UNKNOWN * unknowns or noise <= 0:
            continue
        sums = torch.zeros(len(names), 1 + unknowns).to(residual)
        sums = sums.index_add_(0, block, torch.cat([residual[:, None], q], dim=1))
        line[0] = sums[:, 0].square().sum() / noise
        line[1] = pixels - sums[:, 1:].square().sum()
        line[2] = len(names) - unknowns
    return lines
