"""Whether the frames see from two places on the tool, in any order.

Where a robot program changes its tool frame, some poses are of another frame of the robot. Which
ones is not known: a few frames drawn at random fix a twist of the camera, those that agree best
with one of many such twists are one part, and parts and twists are then improved in turn.
"""

import numpy as np

from tofcorr.plausibility.camera_step import CameraStep, Comparison, fewest
from tofcorr.plausibility.frame_offsets import FrameOffsets, stacked

# Twists that are tried, and frames that fix one. Chosen: of two parts of half the frames, one draw
# in four is of one part alone; three frames have nine numbers, a constant and a twist seven.
_TWISTS, _FRAMES = 100, 3
# Best of these that are improved, and most times each is. Chosen: of 20 recordings of 22 poses, 60
# starts found the true parts in all; most settle in five steps.
_STARTS, _STEPS = 60, 30
# Share of a twist's mean information that is added to each of its directions. Chosen: it only
# decides what three frames do not determine.
_RIDGE = 1e-4
# Chosen: two hand-eye transforms have twelve unknowns, and some parts of few frames always differ.
FEWEST = 20
"""Distinct poses from which two parts are looked for."""

# Two parts count if F is at least this large, if the second hand-eye transform takes off at least
# this share of the sum of squares, and if it moves points by so many metres. All are larger than
# for a step at one moment, since the parts are chosen to differ. Of 24 recordings of 24 or 40
# frames, half of them of a tool frame 20 mm and 2 degrees away, all had that; of 391 others none:
# the largest share was 0.88, of poses 12 mm late.
_LEAST_F, _LEAST_SHARE, _LEAST_SIZE = 50.0, 0.9, 1e-3


def camera_parts(seen: FrameOffsets) -> CameraStep | None:
    """Return the two parts of the frames that differ most; None where they do not count.

    Args:
        seen: The frames.
    """
    if len(seen.frame) < FEWEST:
        return None
    compare = Comparison(seen)
    found = [one for start in _starts(seen) if (one := _improved(compare, start)) is not None]
    best = max((compare(one) for one in found), key=lambda one: one.share, default=None)
    if best is None or best.ratio < _LEAST_F:
        return None
    return best if best.share > _LEAST_SHARE and best.size > _LEAST_SIZE else None


def _starts(seen: FrameOffsets) -> list[np.ndarray]:
    """Return halves of the frames, (N,) bool, that agree best with a twist of some frames."""
    number = len(seen.frame)
    step = seen.step / np.maximum(np.sqrt(np.square(seen.step).mean(axis=(0, 1))), 1e-12)
    order = np.random.default_rng(number).random((_TWISTS, number)).argsort(axis=1)
    drawn = order[:, :_FRAMES]
    columns = step[drawn].reshape(_TWISTS, -1, step.shape[-1])
    transposed = columns.transpose(0, 2, 1)
    matrix = transposed @ columns
    ridge = _RIDGE * np.trace(matrix, axis1=1, axis2=2)[:, None, None] * np.eye(step.shape[-1])
    twist = np.linalg.solve(
        matrix + ridge, transposed @ seen.residual[drawn].reshape(_TWISTS, -1, 1)
    )[..., 0]
    off = np.square(seen.residual[..., 0] - np.einsum("fak,sk->sfa", step, twist)).sum(axis=2)
    agreeing = np.sort(off, axis=1)[:, : number // 2].sum(axis=1)
    best = off[np.argsort(agreeing)[:_STARTS]]
    return [one <= np.median(one) for one in best]


def _improved(compare: Comparison, chosen: np.ndarray) -> np.ndarray | None:
    """Put every frame to the part that explains it better, until none changes."""
    least = fewest(len(chosen))
    for _ in range(_STEPS):
        if min(int(chosen.sum()), int((~chosen).sum())) < least:
            return None
        nearer = _explained_better(compare, chosen)
        if (nearer == chosen).all():
            break
        chosen = nearer
    return chosen


def _explained_better(compare: Comparison, chosen: np.ndarray) -> np.ndarray:
    """Return which frames (N,) the step of the chosen ones explains better than no step."""
    seen, unknowns = compare.seen, compare.unknowns(chosen)
    step = (seen.step @ unknowns)[..., None]
    explained = stacked(seen.residual - step * chosen[:, None, None])
    left = compare.beside(explained).reshape(seen.residual.shape)
    first = left + step * chosen[:, None, None]
    return np.square(first - step).sum(axis=(1, 2)) < np.square(first).sum(axis=(1, 2))
