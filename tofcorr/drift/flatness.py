"""How far a corrected wall departs from a plane."""

import math

import torch

from tofcorr.drift.corrected_images import CorrectedImage
from tofcorr.drift.projection import project_out
from tofcorr.fit.reference.linear_image import wall_moves

# Fewest pixels of a block whose mean counts: with fewer, the block's own variance, which is
# subtracted, is hardly known. Set by hand.
_FEWEST_IN_BLOCK = 4


def departure_from_plane(image: CorrectedImage) -> float:
    """Return the root mean square departure of the corrected wall from a plane, metres.

    Means over blocks of pixels are compared with the best plane; the variance that noise gives to
    such means is subtracted, so that noise alone gives about zero. Without a block of enough
    pixels: zero.
    """
    normal, offset = image.plane
    moves = wall_moves(image.points, normal)
    (residual,) = project_out(moves, image.points @ normal + offset)
    blocks, place = torch.unique(image.block, return_inverse=True)
    count = torch.bincount(place, minlength=len(blocks)).to(residual)
    mean = torch.zeros(len(blocks)).to(residual).index_add_(0, place, residual) / count
    squares = (residual - mean[place]).square()
    within = torch.zeros(len(blocks)).to(residual).index_add_(0, place, squares)
    enough = count >= _FEWEST_IN_BLOCK
    if not bool(enough.any()):
        return 0.0
    variance_of_mean = within[enough] / (count[enough] - 1) / count[enough]
    return math.sqrt(max(float((mean[enough].square() - variance_of_mean).mean()), 0.0))
