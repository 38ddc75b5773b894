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

from tofcorr.diagnosis.options import TestOptions
from tofcorr.diagnosis.sums.observations import Observations


def draw_folds(num_units: int, count: int, generator: torch.Generator) -> Tensor:
    """Assign units at random to folds of equal size; no more folds than units.

    Returns:
        Which units each fold holds out, shape (folds, U), float64.
    """
    count = min(count, num_units)
    order = torch.randperm(num_units, generator=generator)
    of_unit = (torch.arange(num_units) % count)[order.argsort()]
    return (of_unit == torch.arange(count)[:, None]).double()


def draw_signs(flips: int, num_units: int, generator: torch.Generator) -> Tensor:
    """Draw a sign for every unit and flip, shape (flips, U)."""
    return 2.0 * torch.randint(0, 2, (flips, num_units), generator=generator).double() - 1.0


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
    observations: Observations,
    energy: Tensor,
    tests: TestOptions,
    generator: torch.Generator,
    filtered: bool,
) -> Tiles:
    """Cut the eight poses with the most energy into tiles, eight along each side of the image.

    Both are chosen, not derived: 512 tiles are enough units for the sign flips, and each still
    holds dozens of pixels.

    Args:
        observations: The pixels.
        energy: How strongly each pose would show the effects, shape (U,).
        tests: Numbers of folds and sign flips.
        generator: Of folds and flips.
        filtered: Whether neighbouring pixels share noise. No side of a tile is then below eight
            pixels: after a Gaussian of 1.2 pixels the signs of tiles of six by four allow for half
            of the variance of slow signals, those of eight for two thirds. Tiles of twelve would
            allow for four fifths, but are so few in images of 32x24 that saturation of 14 mm was
            not found.
    """
    camera, pose = observations.recording.camera, observations.unit[observations.frame]
    side, most_poses = 8, 8
    ranked = energy.sort(descending=True).indices
    strongest, whole = ranked[:most_poses], ranked[most_poses:].sort().values
    inside = torch.isin(pose, strongest).nonzero()[:, 0]
    pixel = observations.pixel[inside]
    least = 8 if filtered else 1
    down, across = (min(side, max(1, n // least)) for n in (camera.height, camera.width))
    row, column = pixel // camera.width * down, pixel % camera.width * across
    tile = row // camera.height * side + column // camera.width
    label = pose[inside] * side**2 + tile
    labels, counts = label.unique(return_counts=True)
    size = len(whole) + len(labels)
    return Tiles(
        whole=whole,
        pixels=inside[label.argsort(stable=True)],
        counts=counts.tolist(),
        pose=torch.cat([whole, labels // side**2]),
        folds=draw_folds(size, tests.folds, generator),
        signs=draw_signs(tests.flips, size, generator),
    )
