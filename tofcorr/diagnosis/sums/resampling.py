"""Cross-validation folds, sign flips, and image tiles as the units of a test.

Poses are the units of every test but that of effects that only a few images show, because one
disturbance affects a whole image. An effect that only three images show cannot be tested in this
way: three signs allow only eight flips, and a fit without one of the three hardly determines the
effect. The images in which the effect would be strongest are therefore cut into tiles. Each tile
has an uncertain offset and two tilts of its own, so that only what happens inside images counts.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from tofcorr.geometry.camera import CameraIntrinsics


def draw_folds(num_units: int, count: int, generator: torch.Generator) -> Tensor:
    """Assign units at random to folds of equal size; no more folds than units.

    Returns:
        Which units each fold holds out, shape (folds, U), float64.
    """
    count = min(count, num_units)
    of_unit = torch.empty(num_units, dtype=torch.int64)
    order = torch.randperm(num_units, generator=generator)
    of_unit[order] = torch.arange(num_units) % count
    return (of_unit == torch.arange(count)[:, None]).double()


def draw_signs(flips: int, num_units: int, generator: torch.Generator) -> Tensor:
    """Draw a sign for every unit and flip, shape (flips, U)."""
    return 2.0 * torch.randint(0, 2, (flips, num_units), generator=generator).double() - 1.0


# Number of poses that are cut, and tiles a side of the image. Chosen, not derived: 512 tiles are
# enough units for the sign flips, and each still holds dozens of pixels.
_CUT_POSES = 8
_TILES = 8
# Least side of a tile, pixels, where a filter leaves neighbours with noise in common. Chosen: after
# a Gaussian of 1.2 pixels the signs of tiles of six by four allow for half of the variance of slow
# signals, those of eight for two thirds. Tiles of twelve would allow for four fifths, but are so
# few in images of 32x24 that saturation of 14 mm was not found.
_LEAST_FILTERED = 8


@dataclass(frozen=True, kw_only=True)
class Tiles:
    """Poses left whole, then the tiles of the poses that were cut: Q units.

    Attributes:
        whole: Poses left whole, int64.
        pixels: Pixels of the other poses, tile after tile, int64.
        counts: How many of `pixels` each tile holds.
        pose: Pose of every unit, shape (Q,), int64.
        folds: Which units each fold of the cross-validation holds out, shape (folds, Q), float64.
        signs: Sign flips, shape (B, Q).
    """

    whole: Tensor
    pixels: Tensor
    counts: list[int]
    pose: Tensor
    folds: Tensor
    signs: Tensor

    def per_pose(self, values: Tensor, num_poses: int) -> Tensor:
        """Add up values of the units (..., Q) over the poses, shape (..., U)."""
        sums = torch.zeros(*values.shape[:-1], num_poses, dtype=values.dtype)
        return sums.index_add(-1, self.pose, values)


def cut_into_tiles(
    energy: Tensor,
    pose: Tensor,
    pixel: Tensor,
    camera: CameraIntrinsics,
    folds: int,
    flips: int,
    generator: torch.Generator,
    *,
    filtered: bool = False,
) -> Tiles:
    """Cut the poses with the most energy into tiles.

    Args:
        energy: How strongly each pose would show the effects, shape (U,).
        pose: Pose of every pixel, shape (M,), int64.
        pixel: Flat index of every pixel, shape (M,), int64.
        camera: Gives the image size.
        folds: Number of folds.
        flips: Number of sign flips.
        generator: Of folds and flips.
        filtered: Whether neighbouring pixels share noise.
    """
    ranked = energy.sort(descending=True).indices
    strongest, whole = ranked[:_CUT_POSES], ranked[_CUT_POSES:].sort().values
    inside = torch.isin(pose, strongest).nonzero()[:, 0]
    row, column = pixel[inside] // camera.width, pixel[inside] % camera.width
    least = _LEAST_FILTERED if filtered else 1
    down, across = (min(_TILES, max(1, n // least)) for n in (camera.height, camera.width))
    tile = (row * down // camera.height) * _TILES + column * across // camera.width
    label = pose[inside] * _TILES**2 + tile
    labels, counts = label.unique(return_counts=True)
    size = len(whole) + len(labels)
    assigned = draw_folds(size, folds, generator)
    return Tiles(
        whole=whole,
        pixels=inside[label.argsort(stable=True)],
        counts=counts.tolist(),
        pose=torch.cat([whole, labels // _TILES**2]),
        folds=assigned,
        signs=draw_signs(flips, size, generator),
    )
