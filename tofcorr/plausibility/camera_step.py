"""Whether the camera sits elsewhere on the tool from some frame on.

A knock, or a camera taken off and mounted again, turns and shifts what every later frame sees. Each
frame is reduced to the offset and the two tilts of its plane; those of two hand-eye transforms are
compared with those of one. What a change of the distances by a constant explains is no step.
"""

import math
from typing import NamedTuple

import numpy as np

from tofcorr.plausibility.linear_residuals import LinearResiduals
from tofcorr.plausibility.scene import Scene

# Fewest frames, and fewest on either side of a step. Chosen: six unknowns, three from a frame.
_FEWEST_FRAMES, _FEWEST_OF_PART = 20, 6
# Moments of a step that are tried, at most. Chosen: off by an eightieth of the frames at most.
_MOMENTS = 41
# Prior standard deviation of a step, metres and radians. Chosen: who moves a camera by more starts
# anew; without it, frames on either side could disagree by metres in what they do not determine.
_PRIOR = 0.05
# Frames with so many times the median residual are left out. Chosen, as for single wrong poses.
_OUTLYING = 5.0
# A step counts if F, with six degrees of freedom, is at least this large; if it takes off at least
# this share of the frames' sum of squares; and if it moves points by so many metres. Of 24
# recordings of 20 or 40 frames, knocked by 8 mm and a degree, all had that, F from 17 and the share
# from 0.76 on. Of 361 clean ones, or with another error, two had it: poses of another time, and an
# error of 2.4 mm with a room temperature that was not recorded.
_LEAST_F, _LEAST_SHARE, _LEAST_SIZE = 15.0, 0.7, 1e-3


class CameraStep(NamedTuple):
    """The step that fits best.

    Attributes:
        frame: Index of the first frame after it.
        size: How far it moves points off their planes, root mean square over the frames of the
            smaller part, metres.
        ratio: F: what each of its six unknowns takes off, over the variance that is left.
        share: Share of the sum of squares that it takes off.
    """

    frame: int
    size: float
    ratio: float
    share: float

    @property
    def counts(self) -> bool:
        """Whether there surely is one, and whether it matters."""
        found = self.ratio > _LEAST_F and self.share > _LEAST_SHARE
        return found and self.size > _LEAST_SIZE


def camera_step(scene: Scene, problem: LinearResiduals) -> CameraStep | None:
    """Look for a step at one of some moments.

    Args:
        scene: Poses and planes, in the order in which they were recorded.
        problem: The residuals near their alignment.

    Returns:
        None where there are too few frames, or no robot moves.
    """
    chosen = _one_of_each_pose(scene.poses)
    if not scene.moves or len(chosen) < _FEWEST_FRAMES:
        return None
    step = np.concatenate([problem.cosine[..., None], problem.rigid], axis=-1)
    parts = [problem.columns, problem.residual[..., None], step]
    columns, residual, step = (part[chosen] for part in _of_frames(problem, parts))
    kept = _agreeing(columns, residual)
    number = int(kept.sum())
    least = max(_FEWEST_OF_PART, number // 6)
    if number < 2 * least:
        return None
    basis = np.linalg.qr(_stacked(columns[kept]))[0]
    moments = np.unique(np.linspace(least, number - least, _MOMENTS).astype(int))
    tried = [_step(basis, residual[kept], step[kept], int(moment)) for moment in moments]
    best = max(tried, key=lambda one: one.ratio)
    return best._replace(frame=int(chosen[kept][best.frame]))


def _one_of_each_pose(poses: np.ndarray) -> np.ndarray:
    """Return indices of frames of distinct poses: repeats of one share its error."""
    rounded = np.round(poses.reshape(len(poses), -1), 5)
    return np.sort(np.unique(rounded, axis=0, return_index=True)[1])


def _of_frames(problem: LinearResiduals, parts: list[np.ndarray]) -> list[np.ndarray]:
    """Return columns (F, P, K) reduced to offset and tilts of each frame, (F, 3, K), weighted."""
    directions = problem.plane_directions()
    count = np.maximum(problem.used.sum(1), 1)
    weight = np.sqrt(problem.weight.max(1))
    scale = weight / max(float(np.median(weight)), 1e-12) / np.sqrt(count)
    return [np.einsum("f,fpa,fpk->fak", scale, directions, part, optimize=True) for part in parts]


def _agreeing(columns: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """Return which frames (F,) do not disagree with all others."""
    kept = np.ones(len(columns), dtype=bool)
    for _ in range(2):
        fitted = np.linalg.lstsq(_stacked(columns[kept]), _stacked(residual[kept]), rcond=None)[0]
        left = np.linalg.norm(residual - columns @ fitted, axis=(1, 2))
        kept = left < _OUTLYING * np.median(left)
    return kept


def _step(basis: np.ndarray, residual: np.ndarray, step: np.ndarray, moment: int) -> CameraStep:
    """Compare a step of the distances with one of the camera as well (first of the columns)."""
    count = len(residual)
    after = (np.arange(count) >= moment)[:, None, None]
    left = _beside(basis, _stacked(residual))[:, 0]
    columns = _beside(basis, _stacked(step * after))
    before = left - columns[:, :1] @ np.linalg.lstsq(columns[:, :1], left, rcond=None)[0]
    freedom = len(left) - basis.shape[1] - columns.shape[1]
    square = float(before @ before)
    prior = max(square / len(left), 1e-18) / _PRIOR**2
    held = np.concatenate([columns, math.sqrt(prior) * np.eye(columns.shape[1])])
    stated = np.concatenate([left, np.zeros(columns.shape[1])])
    unknowns = np.linalg.lstsq(held, stated, rcond=None)[0]
    now = left - columns @ unknowns
    gained = square - float(now @ now) - prior * float(unknowns @ unknowns)
    ratio = gained / (columns.shape[1] - 1) / max(float(now @ now) / max(freedom, 1), 1e-18)
    size = math.sqrt(max(gained, 0.0) / min(moment, count - moment))
    return CameraStep(moment, size, ratio if freedom > 0 else 0.0, gained / max(square, 1e-18))


def _beside(basis: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return what an orthonormal basis leaves of columns."""
    return columns - basis @ (basis.T @ columns)


def _stacked(parts: np.ndarray) -> np.ndarray:
    """Return (F, 3, K) as (3 F, K)."""
    return parts.reshape(-1, parts.shape[-1])
