"""By how much the camera's lengths differ from the robot's: the scale of one against the other.

Poses, planes through the origin and hand-eye, all longer by a share, look exactly like distances
shorter by it: a recording cannot tell whether the robot or the camera is wrong.
"""

import math
from typing import NamedTuple

import numpy as np

from tofcorr.plausibility.alignment import Alignment
from tofcorr.plausibility.linear_residuals import LinearResiduals


class LengthScale(NamedTuple):
    """How much longer distances are than the poses say.

    Attributes:
        share: Without unit: 0.01 is one percent.
        error: Its standard error; infinite where it is not determined.
    """

    share: float
    error: float


def length_scale(given: Alignment, problem: LinearResiduals) -> LengthScale:
    """Estimate it beside errors of amplitude and place, with no other error over the distance."""
    longer = problem.cosine[..., None] * np.stack(
        [np.ones_like(problem.distance), problem.distance], axis=-1
    )
    columns = np.concatenate([problem.rigid, problem.beside_distance, longer], axis=-1)
    found = problem._replace(columns=columns).solved()
    variance = float(found.covariance[-1, -1])
    return LengthScale(
        share=given.slope - float(found.unknowns[-1]),
        error=math.sqrt(variance) if 0 <= variance < math.inf else math.inf,
    )
