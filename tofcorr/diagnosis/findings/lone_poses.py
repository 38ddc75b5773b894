"""Poses that no other pose predicts, and that make most of the gap.

The gap is what a fit to all other poses misses in each pose. A pose that alone shows a range of
distances or angles is missed by any amount: the model is not wrong there, but unknown.
"""

from typing import NamedTuple

from torch import Tensor

from tofcorr.diagnosis.sums.blocks import solve
from tofcorr.diagnosis.sums.crossval import squares_at
from tofcorr.diagnosis.sums.left_out import left_out_model
from tofcorr.diagnosis.sums.study import Study

# A pose is alone if a fit to all others misses it by so many times the mean square that the fit to
# all poses leaves in it. Chosen: with 20 poses that are alike the ratio is below 3.
_ALONE = 8.0
# Share of the squared gap, at least, that such poses make where they are worth a line. Chosen.
_MOST = 0.5


class LonePoses(NamedTuple):
    """Poses that no other pose predicts.

    Attributes:
        frames: The first frame of each.
        distance: Nearest and farthest distance that they show, metres.
        share: What they make of the squared gap.
        others: The gap of all other poses, metres.
    """

    frames: tuple[int, ...]
    distance: tuple[float, float]
    share: float
    others: float


def lone_poses(study: Study, floor: float) -> LonePoses | None:
    """Return the poses that make most of the base model's gap because they are alone, or None.

    Args:
        study: The recording, before any effect was named.
        floor: Noise of a pixel that is no gap, metres.
    """
    model = left_out_model(study, ())
    square, count = model.squares(), model.pose_count
    alone = square > _ALONE * _left_by_all(study)
    gap = float(square.sum() - floor**2 * count.sum())
    share = float(square[alone].sum() - floor**2 * count[alone].sum()) / gap if gap > 0 else 0.0
    if not share > _MOST or bool(alone.all()):
        return None
    mean = float(square[~alone].sum() / count[~alone].sum())
    distance = study.inputs.radial_distance[alone[study.unit_of_pixel]]
    unit = study.observations.unit
    return LonePoses(
        frames=tuple(int((unit == pose).nonzero()[0]) for pose in alone.nonzero()[:, 0].tolist()),
        distance=(float(distance.min()), float(distance.max())),
        share=min(share, 1.0),
        others=max(mean - floor**2, 0.0) ** 0.5,
    )


def _left_by_all(study: Study) -> Tensor:
    """Return the even sum of squares that the fit to all poses leaves in each, (U,), m^2."""
    blocks = study.system.blocks
    return squares_at(blocks, (), solve(blocks.even, ()).expand(blocks.num_units, -1))
