"""Whether a part of the images lies on the walls with the poses before or after their own.

Where one image or pose was dropped in the middle of a list, the first part is paired rightly and
shows the walls; the rest lies on them with the poses shifted.
"""

from collections.abc import Sequence

import numpy as np
import torch

from tofcorr.importing.posed.chosen import Chosen
from tofcorr.importing.posed.images import RadialImages
from tofcorr.importing.walls.found import FoundWalls
from tofcorr.importing.walls.gathering import WallPlanes, distances
from tofcorr.importing.walls.image_plane import ImagePlane
from tofcorr.importing.walls.seen_planes import seen_planes

_SHIFTS = (1, -1, 2, -2, 3, -3)
"""Shifts that are tried, the smaller first. Set by hand: more images are rarely
dropped in a row."""

_NEAR = 0.03
"""Metres within which a plane lies on a wall: three times a typical error, and far below the way
from stop to stop."""

_FEWEST = 4
"""Images that must lie on the walls with shifted poses: fewer do so by chance."""

_MOST_OF = 0.5
"""Share of the images off the walls that the shift must bring onto them. Set by hand: some show
only walls that the rightly paired part did not; a shift by chance brings hardly any."""


def shifted_part(
    images: RadialImages, chosen: Chosen, found: FoundWalls, names: Sequence[str]
) -> str | None:
    """Return a sentence about the part of the images whose poses are shifted; None without one.

    Args:
        images: All images.
        chosen: Those used, with poses.
        found: The walls, and the hand-eye transform that goes with them.
        names: What each image is called.
    """
    planes = [images.planes(k) for k in chosen.images.tolist()]
    poses = chosen.world_from_tool
    seeing = np.array([bool(own) for own in planes])
    off = seeing & ~_on_walls(planes, poses, found)
    for shift in _SHIFTS:
        fits = off & _on_walls(planes, np.roll(poses, shift, axis=0), found)
        if fits.sum() < max(_FEWEST, _MOST_OF * off.sum()):
            continue
        first, last = (names[int(chosen.images[k])] for k in np.flatnonzero(fits)[[0, -1]])
        return (
            f"{fits.sum()} of {seeing.sum()} images, '{first}' to '{last}', lie on the walls with "
            f"the poses shifted by {shift:+d} and not with their own: was an image or a pose "
            f"dropped before '{first}'?"
        )
    return None


def _on_walls(
    planes: Sequence[Sequence[ImagePlane]], poses: np.ndarray, found: FoundWalls
) -> np.ndarray:
    """Return which images have most of their planes on a wall, shape (N,)."""
    seen = seen_planes(planes, torch.from_numpy(np.array(poses)), 1)
    walls = WallPlanes(
        torch.from_numpy(np.stack([wall.normal_world for wall in found.walls])),
        torch.tensor([wall.offset for wall in found.walls], dtype=torch.float64),
    )
    hand_eye = torch.from_numpy(np.array(found.tool_from_camera))
    near = (distances(seen, hand_eye, walls).min(dim=1).values < _NEAR).to(torch.float64)
    votes = torch.zeros(len(planes), dtype=torch.float64)
    votes.index_add_(0, seen.image, 2 * near - 1)
    return (votes > 0).numpy()
