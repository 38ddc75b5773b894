"""Parts of images as units, for effects that only a few images show.

Poses are the unit of every test, for what disturbs an image disturbs all of it. An effect that
three images show cannot be tested so: three signs make eight flips, and a fit without one of the
three does not know the effect. The images in which it would be strongest are therefore cut into
tiles. Each tile keeps an offset and two tilts of its own for the uncertainty of the pose, so that
only what happens inside images speaks.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.folds import Folds, deal, draw_signs
from tofcorr.geometry.intrinsics import CameraIntrinsics

# So many poses are cut, each into this many tiles a side.
_CUT_POSES = 8
_TILES = 8


@dataclass(frozen=True, kw_only=True)
class Parts:
    """Poses left whole, then tiles of those that were cut: Q parts.

    Attributes:
        whole: Poses left whole, int64.
        pixels: Pixels of the other poses, tile after tile, int64.
        counts: How many of `pixels` each tile holds.
        pose: Pose of every part, shape (Q,), int64.
        folds: Of the cross-validation.
        signs: Sign flips, shape (B, Q).
    """

    whole: Tensor
    pixels: Tensor
    counts: list[int]
    pose: Tensor
    folds: Folds
    signs: Tensor

    def per_pose(self, values: Tensor, num_poses: int) -> Tensor:
        """Add up values of parts (Q,) over the poses, shape (U,)."""
        return torch.zeros(num_poses, dtype=values.dtype).index_add(0, self.pose, values)


def cut(
    energy: Tensor,
    pose: Tensor,
    pixel: Tensor,
    camera: CameraIntrinsics,
    folds: int,
    flips: int,
    generator: torch.Generator,
) -> Parts:
    """Cut the poses of most energy into tiles.

    Args:
        energy: How strongly each pose would show the effect, shape (U,).
        pose: Pose of every pixel, shape (M,), int64.
        pixel: Flat index of every pixel, shape (M,), int64.
        camera: For the size of the image.
        folds: How many.
        flips: How many.
        generator: Of folds and flips.
    """
    ranked = energy.sort(descending=True).indices
    strongest, whole = ranked[:_CUT_POSES], ranked[_CUT_POSES:].sort().values
    inside = torch.isin(pose, strongest).nonzero()[:, 0]
    row, column = pixel[inside] // camera.width, pixel[inside] % camera.width
    tile = (row * _TILES // camera.height) * _TILES + column * _TILES // camera.width
    label = pose[inside] * _TILES**2 + tile
    labels, counts = label.unique(return_counts=True)
    size = len(whole) + len(labels)
    dealt = deal(size, folds, generator)
    return Parts(
        whole=whole,
        pixels=inside[label.argsort(stable=True)],
        counts=counts.tolist(),
        pose=torch.cat([whole, labels // _TILES**2]),
        folds=dealt,
        signs=draw_signs(flips, size, generator),
    )
