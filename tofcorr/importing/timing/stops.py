"""The stretches of time in which the robot stood still."""

from dataclasses import dataclass

import numpy as np
import torch

from tofcorr.geometry import se3
from tofcorr.importing.poses.track import PoseTrack

STILL_METRES = 5e-4
"""Within a stop the tool moves less than this, metres: a few times the repeatability of an
industrial arm (0.05 to 0.1 mm) and below what a depth pixel resolves."""

STILL_RADIANS = 1e-3
"""Within a stop the tool turns less than this, radians: 1 mm at 1 m."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Stops:
    """Which images were taken while the robot stood still.

    Attributes:
        number: The stop that each image belongs to, shape (N,); -1 while moving.
    """

    number: np.ndarray

    @property
    def count(self) -> int:
        """How many stops hold an image."""
        return len(np.unique(self.number[self.number >= 0]))


def find_stops(track: PoseTrack, times: np.ndarray, margin: float) -> Stops:
    """Tell the images of stops from those of movements.

    An image is still if the tool hardly moves from `margin` before it to `margin` after it. Still
    images that follow one another without a movement between them are one stop.

    Args:
        track: The poses, with time stamps.
        times: Of the images on the clock of the track, shape (N,), increasing, seconds.
        margin: Seconds; at least the exposure and the uncertainty of the lag.
    """
    assert track.timestamp is not None
    low, high = track.timestamp[0], track.timestamp[-1]
    here = track.at(times)
    still = np.ones(len(times), dtype=bool)
    for shift in (-margin, margin):
        still &= _near(here, track.at(np.clip(times + shift, low, high)))
    number = np.full(len(times), -1)
    current, last = -1, -1
    for k in np.flatnonzero(still):
        moved = last < 0 or not _near(here[k : k + 1], here[last : last + 1])[0]
        if moved or not still[last : k + 1].all():
            current += 1
        number[k], last = current, k
    return Stops(number=number)


def _near(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Whether pairs of poses (N, 4, 4) differ by less than a stop allows, shape (N,)."""
    distance = np.linalg.norm(first[:, :3, 3] - second[:, :3, 3], axis=1)
    turn = np.einsum("nij,nik->njk", first[:, :3, :3], second[:, :3, :3])
    angle = se3.rotation_angle(torch.from_numpy(turn)).numpy()
    return (distance < STILL_METRES) & (angle < STILL_RADIANS)
