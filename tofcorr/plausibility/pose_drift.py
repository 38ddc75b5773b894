"""Whether the robot's poses, or the wall, move steadily away while a recording is made.

The world shifts and turns in proportion to the frame's number, beside the errors of a camera. A
camera that warms up shifts its distances alike, by less.
"""

import math
from typing import NamedTuple

import numpy as np

from tofcorr.plausibility.linear_residuals import LinearResiduals
from tofcorr.plausibility.scene import Scene

# Fewest frames in which a drift is looked for. Chosen: twice as many as determine 25 unknowns.
_FEWEST_FRAMES = 16
# Drift that counts, metres, and in standard errors. Chosen: a camera that warms up drifts by about
# a centimetre, held-out errors grow by a third of the drift, and 80 clean recordings had 2 mm.
_LEAST, _SIGMAS = 0.025, 6.0


class PoseDrift(NamedTuple):
    """How far points move off their planes from the first frame to the last.

    Attributes:
        size: Root mean square over the points, metres.
        error: Its standard error, metres.
        rms: What is left of each frame's distance to its plane without it, shape (F,), metres.
        planes_off: That of it which a plane makes, shape (F,), metres.
    """

    size: float
    error: float
    rms: np.ndarray
    planes_off: np.ndarray

    @property
    def counts(self) -> bool:
        """Whether it is surely one, and larger than a camera's that warms up."""
        return self.size > max(_LEAST, _SIGMAS * self.error)


def pose_drift(scene: Scene, problem: LinearResiduals) -> PoseDrift | None:
    """Estimate the drift.

    Args:
        scene: Poses and planes, in the order in which they were recorded.
        problem: The residuals near their alignment.

    Returns:
        None where there are too few frames, or no robot moves.
    """
    count = len(scene.poses)
    if not scene.moves or count < _FEWEST_FRAMES:
        return None
    moved = np.broadcast_to(scene.normal[:, None], problem.world.shape)
    middle = problem.world[problem.used].mean(0)
    turned = np.cross(problem.world - middle, scene.normal[:, None])
    drift = np.concatenate([moved, turned], axis=-1)
    when = np.linspace(-0.5, 0.5, count)[:, None, None]
    joined = problem.with_columns(when * drift)
    found = joined.solved()
    own = slice(-drift.shape[-1], None)
    covariance = found.covariance[own, own]
    seen = drift[problem.used]
    size = math.sqrt(float(np.square(seen @ found.unknowns[own]).mean()))
    variance = float(np.einsum("na,ab,nb->n", seen, covariance, seen).mean())
    error = math.sqrt(variance) if variance >= 0 else math.inf
    return PoseDrift(
        size, error, problem.frame_rms(found.left), problem.frame_planes_off(found.left)
    )
