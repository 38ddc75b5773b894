"""A sample of the pixels of all poses, a row each: what every measurement starts from."""

from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np

# Pixels of a pose that enter the sample: 60 poses then give 240 000 rows, whose mean variance is
# known to 0.3 %. Chosen to bound time and memory.
_MOST_OF_POSE = 4000


@dataclass(frozen=True, kw_only=True, eq=False)
class PixelTable:
    """Columns of equal length (M,), one row for each sampled pixel of each pose.

    Attributes:
        pose: Number of the pose.
        pixel: Flat index in the image.
        distance: To the plane of the images, metres; NaN where unknown.
        cosine: Of the angle of incidence; NaN where unknown.
        target: Number of the target's name, in alphabetical order of all names.
        amplitude: Mean over frames with a distance, counts; NaN where there is none.
        raw_amplitude: Mean over all frames, as recorded; NaN without amplitudes.
        of_repeats: Variance over repeated frames, m^2; NaN where fewer than two are valid.
        of_neighbours: Mean square of scaled second differences, m^2; NaN where there is none.
        of_nearest: Mean half square of the differences to nearest pixels of about the same
            brightness, m^2; NaN where there is none.
        frames: In how many frames the pixel looks at the target.
        missing: In how many of them it has no distance.
        saturated: In how many of them it is saturated.
    """

    pose: np.ndarray
    pixel: np.ndarray
    distance: np.ndarray
    cosine: np.ndarray
    target: np.ndarray
    amplitude: np.ndarray
    raw_amplitude: np.ndarray
    of_repeats: np.ndarray
    of_neighbours: np.ndarray
    of_nearest: np.ndarray
    frames: np.ndarray
    missing: np.ndarray
    saturated: np.ndarray

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.pose)

    @property
    def signal(self) -> np.ndarray:
        """Light returned relative to the same target at 1 m, seen head-on: cos / d^2."""
        return self.cosine / self.distance**2

    def select(self, rows: np.ndarray) -> Self:
        """Return some rows, by number or as a bool for each."""
        return replace(self, **{each.name: getattr(self, each.name)[rows] for each in fields(self)})

    @classmethod
    def join(cls, parts: list[Self]) -> Self:
        """Return the rows of all parts."""
        columns = {
            each.name: np.concatenate([getattr(part, each.name) for part in parts])
            for each in fields(cls)
        }
        return cls(**columns)


def sampled_pixels(size: int) -> np.ndarray:
    """Return which pixels of an image of `size` pixels are sampled, evenly spread; flat indices.

    They are the same in every image, so that two recordings can be compared pixel by pixel.
    """
    if size <= _MOST_OF_POSE:
        return np.arange(size)
    return (np.arange(_MOST_OF_POSE) * (size / _MOST_OF_POSE)).astype(np.int64)
