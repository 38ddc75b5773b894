"""Whether some of the frames see from a camera that sits elsewhere on the tool.

A knock, or a camera taken off and mounted again, turns and shifts what every later frame sees; a
robot program that changes its tool frame does so for some frames, in any order. Offsets and tilts
of the frames' planes under two hand-eye transforms are compared with those under one. What a change
of the distances by a constant explains is no step.
"""

import math
from typing import NamedTuple

import numpy as np

from tofcorr.plausibility.frame_offsets import FrameOffsets, stacked

# Fewest frames of either part, and the least share of all. Chosen: six unknowns, three from a
# frame; smaller parts are single wrong poses.
_FEWEST, _SMALLER = 6, 1 / 6
# Moments of a step that are tried, at most. Chosen: off by an eightieth of the frames at most.
_MOMENTS = 41
# Prior standard deviation of a step, metres and radians. Chosen: who moves a camera by more starts
# anew; without it, the parts could disagree by metres in what they do not determine.
_PRIOR = 0.05
# A step counts if F, with six degrees of freedom, is at least this large; if it takes off at least
# this share of the frames' sum of squares; and if it moves points by so many metres. Of 24
# recordings of 20 or 40 frames, knocked by 8 mm and a degree, all had that, F from 17 and the share
# from 0.76 on. Of 361 clean ones, or with another error, two had it: poses of another time, and an
# error of 2.4 mm with a room temperature that was not recorded.
_LEAST_F, _LEAST_SHARE, _LEAST_SIZE = 15.0, 0.7, 1e-3
# The first two from fewer frames than these. Of 20 recordings of 14 to 19 frames, knocked by 8 mm
# and a degree, 18 had that, and none of 220 clean ones or with another error, whose F reached 29.
_FEW, _LEAST_F_OF_FEW, _LEAST_SHARE_OF_FEW = 20, 50.0, 0.9


class CameraStep(NamedTuple):
    """Two parts of the frames, and what a camera elsewhere in one of them explains.

    Attributes:
        frames: Indices of the frames of one part, rising.
        size: How far the step moves points off their planes, root mean square over the frames of
            the smaller part, metres.
        ratio: F: what each of its six unknowns takes off, over the variance that is left.
        share: Share of the sum of squares that it takes off.
        compared: Number of frames of both parts.
    """

    frames: np.ndarray
    size: float
    ratio: float
    share: float
    compared: int

    @property
    def counts(self) -> bool:
        """Whether there surely is one, its moment chosen of some, and whether it matters."""
        if self.compared < _FEW:
            found = self.ratio > _LEAST_F_OF_FEW and self.share > _LEAST_SHARE_OF_FEW
        else:
            found = self.ratio > _LEAST_F and self.share > _LEAST_SHARE
        return found and self.size > _LEAST_SIZE


def camera_step(seen: FrameOffsets) -> CameraStep | None:
    """Look for a step at one of some moments; None where there are too few frames."""
    number = len(seen.frame)
    least = fewest(number)
    if number < 2 * least:
        return None
    compare = Comparison(seen)
    moments = np.unique(np.linspace(least, number - least, _MOMENTS).astype(int))
    tried = [compare(np.arange(number) >= moment) for moment in moments]
    return max(tried, key=lambda one: one.ratio)


def fewest(number: int) -> int:
    """Return how many of the frames the smaller part must have."""
    return max(_FEWEST, int(_SMALLER * number))


class Comparison:
    """Compares one hand-eye transform with two.

    Args:
        seen: The frames.
    """

    def __init__(self, seen: FrameOffsets) -> None:
        self.seen = seen
        self._basis = np.linalg.qr(stacked(seen.columns))[0]
        self._left = self.beside(stacked(seen.residual))[:, 0]

    def beside(self, columns: np.ndarray) -> np.ndarray:
        """Return what the calibration's unknowns leave of columns (3 N, K)."""
        return columns - self._basis @ (self._basis.T @ columns)

    def unknowns(self, chosen: np.ndarray) -> np.ndarray:
        """Return the step of the chosen frames (N,): constant and twist, shape (7,)."""
        columns = self.beside(stacked(self.seen.step * chosen[:, None, None]))
        return self._solved(columns)[0]

    def __call__(self, chosen: np.ndarray) -> CameraStep:
        """Compare a step of the distances with one of the camera as well, for chosen frames."""
        count, seen = len(chosen), self.seen
        columns = self.beside(stacked(seen.step * chosen[:, None, None]))
        constant, left = columns[:, :1], self._left
        before = left - constant @ np.linalg.lstsq(constant, left, rcond=None)[0]
        square = float(before @ before)
        unknowns, prior = self._solved(columns)
        now = left - columns @ unknowns
        gained = square - float(now @ now) - prior * float(unknowns @ unknowns)
        freedom = len(left) - self._basis.shape[1] - columns.shape[1]
        ratio = gained / (columns.shape[1] - 1) / max(float(now @ now) / max(freedom, 1), 1e-18)
        smaller = max(min(int(chosen.sum()), count - int(chosen.sum())), 1)
        return CameraStep(
            frames=seen.frame[chosen],
            size=math.sqrt(max(gained, 0.0) / smaller),
            ratio=ratio if freedom > 0 else 0.0,
            share=gained / max(square, 1e-18),
            compared=count,
        )

    def _solved(self, columns: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the unknowns of columns under their prior, and its weight."""
        left = self._left
        prior = max(float(left @ left) / len(left), 1e-18) / _PRIOR**2
        held = np.concatenate([columns, math.sqrt(prior) * np.eye(columns.shape[1])])
        stated = np.concatenate([left, np.zeros(columns.shape[1])])
        return np.linalg.lstsq(held, stated, rcond=None)[0], prior
