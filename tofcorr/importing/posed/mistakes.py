"""The usual mistakes in images and poses, and how each is undone."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from tofcorr.geometry import se3
from tofcorr.importing.posed.images import RadialImages
from tofcorr.importing.source import DepthImage
from tofcorr.plausibility.pose_mistakes import reordered, transposed

_LARGEST_SHIFT = 3
"""Lists are shifted by at most so many poses. Set by hand: each shift costs a search for walls, and
more than three images are rarely dropped in a row."""

_LEAST_MILLIMETRES = 50.0
"""A typical number of a depth image from here on is in millimetres, below in metres: cameras on
robots see from 0.05 to 50 m."""


@dataclass(frozen=True)
class Mistake:
    """A mistake, undone.

    Attributes:
        undone: What was done to undo it; follows 'by ... mm with'.
        advice: A question or advice to end the sentence.
        poses: Undoes it in the poses (N, 4, 4).
        image: Reads one image with it undone: distances along the ray, and where they are valid;
            None: images are as they should be.
    """

    undone: str
    advice: str
    poses: Callable[[np.ndarray], np.ndarray] = np.asarray
    image: Callable[[RadialImages, int], tuple[Tensor, Tensor]] | None = None


def possible_mistakes(*, amplitude: bool, lists: bool) -> list[Mistake]:
    """Return the mistakes to try, the likely ones first.

    Args:
        amplitude: Whether there are amplitude images, which may be taken for depth.
        lists: Whether images and poses are paired one to one, so that lists may be shifted.
    """
    shifted = _SHIFTED if lists else []
    exchanged = [_EXCHANGED] if amplitude else []
    return [_INVERSE, _REORDERED, _TRANSPOSED, _MIRRORED, *shifted, *_UNITS, *exchanged]


def _mirrored(images: RadialImages, number: int) -> tuple[Tensor, Tensor]:
    distance, valid = images.radial(number)
    return distance.flip(1), valid.flip(1)


def _exchanged(images: RadialImages, number: int) -> tuple[Tensor, Tensor]:
    image = images.read(number)
    assert image.amplitude is not None
    counts = np.where(image.amplitude > 0, image.amplitude, np.nan)
    unit = 1e-3 if np.nanmedian(counts) > _LEAST_MILLIMETRES else 1.0
    return images.along_rays(DepthImage((unit * counts).astype(np.float32)))


def _scaled(factor: float) -> Mistake:
    def image(images: RadialImages, number: int) -> tuple[Tensor, Tensor]:
        distance, valid = images.radial(number)
        return factor * distance, valid

    return Mistake(
        f"all distances multiplied by {factor:g}", "is --depth-unit-mm right?", image=image
    )


def _shifted(shift: int) -> Mistake:
    return Mistake(
        f"the poses shifted by {shift:+d}",
        "was an image or a pose dropped?",
        poses=lambda poses: np.roll(poses, shift, axis=0),
    )


NO_MISTAKE = Mistake("nothing undone", "")
_INVERSE = Mistake(
    "their inverses",
    "are the poses those of the base in the tool (--base-frame and --tool-frame exchanged), or is "
    "--eye-to-hand missing or too much?",
    poses=lambda poses: se3.inverse(torch.from_numpy(np.array(poses))).numpy(),
)
_REORDERED = Mistake(
    "quaternions read as w x y z",
    "write them as x y z w, or in a CSV whose header names qw, qx, qy, qz.",
    poses=reordered,
)
_TRANSPOSED = Mistake(
    "rotations inverted and translations as they are",
    "are the matrices written column by column, or the quaternions those of the inverse?",
    poses=transposed,
)
_MIRRORED = Mistake(
    "the columns mirrored",
    "does the camera's driver flip its images? Turn that off, or flip them back.",
    image=_mirrored,
)
_EXCHANGED = Mistake(
    "depth and amplitude exchanged", "swap --depth and --amplitude.", image=_exchanged
)
_UNITS = [_scaled(0.1), _scaled(10.0)]
_SHIFTED = [_shifted(sign * size) for size in range(1, _LARGEST_SHIFT + 1) for sign in (1, -1)]
