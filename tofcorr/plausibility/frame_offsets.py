"""Each frame reduced to the offset and the two tilts of its plane, which is all that poses move."""

from typing import NamedTuple, Self

import numpy as np

from tofcorr.plausibility.linear_residuals import LinearResiduals
from tofcorr.plausibility.scene import Scene

# Fewest frames. Chosen: the unknowns of camera and error, some twenty, and those of a step leave
# fourteen of the three numbers of each.
FEWEST = 14
"""Distinct poses from which offsets and tilts are compared."""

# Frames with so many times the median residual are left out, if they are no larger a share than
# this. Chosen, as for single wrong poses; more of them may be a part by itself.
_OUTLYING, _SINGLE = 5.0, 0.1


class FrameOffsets(NamedTuple):
    """N frames of distinct poses, weighted, metres.

    Attributes:
        frame: Index of each in the scene, shape (N,), rising.
        columns: Change of offset and tilts by what a calibration leaves open, shape (N, 3, K).
        residual: Offset and tilts off the recorded plane, shape (N, 3, 1).
        step: Their change by a constant of the distance and by a twist of the camera on the tool,
            shape (N, 3, 7).
    """

    frame: np.ndarray
    columns: np.ndarray
    residual: np.ndarray
    step: np.ndarray

    def some(self, kept: np.ndarray) -> Self:
        """Return some of the frames."""
        return type(self)(*(one[kept] for one in self))


def frame_offsets(scene: Scene, problem: LinearResiduals) -> FrameOffsets | None:
    """Reduce the residuals of a scene; None where there are too few frames, or no robot moves.

    Args:
        scene: Poses and planes, in the order in which they were recorded.
        problem: The residuals near their alignment.
    """
    chosen = one_of_each_pose(scene.poses)
    if not scene.moves or len(chosen) < FEWEST:
        return None
    step = np.concatenate([problem.cosine[..., None], problem.rigid], axis=-1)
    parts = [problem.columns, problem.residual[..., None], step]
    found = FrameOffsets(chosen, *(part[chosen] for part in _reduced(problem, parts)))
    return found.some(_agreeing(found.columns, found.residual))


def one_of_each_pose(poses: np.ndarray) -> np.ndarray:
    """Return indices of frames of distinct poses: repeats of one share its error."""
    rounded = np.round(poses.reshape(len(poses), -1), 5)
    return np.sort(np.unique(rounded, axis=0, return_index=True)[1])


def _reduced(problem: LinearResiduals, parts: list[np.ndarray]) -> list[np.ndarray]:
    """Return columns (F, P, K) reduced to offset and tilts of each frame, (F, 3, K), weighted."""
    directions = problem.plane_directions()
    count = np.maximum(problem.used.sum(1), 1)
    weight = np.sqrt(problem.weight.max(1))
    scale = weight / max(float(np.median(weight)), 1e-12) / np.sqrt(count)
    return [np.einsum("f,fpa,fpk->fak", scale, directions, part, optimize=True) for part in parts]


def _agreeing(columns: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """Return which frames (F,) do not, as single ones, disagree with all others."""
    kept = np.ones(len(columns), dtype=bool)
    for _ in range(2):
        fitted = np.linalg.lstsq(stacked(columns[kept]), stacked(residual[kept]), rcond=None)[0]
        left = np.linalg.norm(residual - columns @ fitted, axis=(1, 2))
        kept = left < _OUTLYING * np.median(left)
    return kept if (~kept).mean() <= _SINGLE else np.ones_like(kept)


def stacked(parts: np.ndarray) -> np.ndarray:
    """Return (F, 3, K) as (3 F, K)."""
    return parts.reshape(-1, parts.shape[-1])
