"""Do the poses move, and often enough?"""

import numpy as np

from tofcorr.plausibility.finding import Finding
from tofcorr.plausibility.look import Look

# Poses nearer than this are one, metres and entries of the rotation. Chosen: a tenth of what robots
# repeat to.
_SAME = 1e-5
# How far the wall's distance may change between frames of one pose and plane, metres, and as a
# share of it. Chosen: warm-up and noise are below.
_CHANGE, _RELATIVE = 0.02, 0.03
# Distinct poses below which a hand-eye transform cannot be determined, and is rough. Chosen: six
# unknowns, three from each image of a wall, and as many again for the camera's errors.
_FEWEST, _FEW = 3, 8


def check(look: Look) -> list[Finding]:
    """Count distinct poses, and compare what moves in the depth with what moves in the poses."""
    if not look.fits or look.planes == "ignored":
        return []
    poses = np.asarray(look.sample.column("world_from_tool"))
    planes = np.column_stack(
        [np.asarray(look.sample.column(name)) for name in ("normal_world", "offset")]
    )
    number = _distinct(poses.reshape(len(poses), -1))
    if len(poses) < 2:
        return [
            Finding("stillness", "impossible", "The recording holds one frame; record more poses.")
        ]
    if number == 1:
        return _still(look) if _distinct(planes) == 1 else []
    return _few(number)


def _few(number: int) -> list[Finding]:
    """Judge how many distinct poses there are; one alone is no robot."""
    if number < _FEWEST:
        return [
            Finding(
                "stillness",
                "impossible",
                f"The frames have {number} distinct poses; {_FEWEST} at least are needed for a "
                "hand-eye transform.",
            )
        ]
    if number < _FEW:
        return [
            Finding(
                "stillness",
                "doubtful",
                f"Only {number} distinct poses: hand-eye and errors can hardly be told apart; "
                f"record {_FEW} or more, tilted and at several distances.",
            )
        ]
    return []


def _still(look: Look) -> list[Finding]:
    """Judge a recording in which neither pose nor plane changes."""
    distance = np.nanmedian(np.where(look.usable[:, None], look.distance, np.nan), axis=1)
    distance = distance[np.isfinite(distance)]
    change = float(distance.max() - distance.min()) if len(distance) else 0.0
    kind = "identity" if not look.sample.data.moves else "same"
    if change > max(_CHANGE, _RELATIVE * float(np.median(distance))):
        return [
            Finding(
                "stillness",
                "impossible",
                f"All poses are the {kind} and all frames have one plane, yet the wall's distance "
                f"changes by {1e3 * change:.0f} mm: the robot's poses were not recorded; write "
                "world_from_tool of each frame, or the plane of each in the camera's frame.",
            )
        ]
    return [
        Finding(
            "stillness",
            "impossible",
            f"All poses are the {kind} and the wall stays where it is: one view determines "
            "neither distance errors nor a hand-eye transform; record other poses.",
        )
    ]


def _distinct(rows: np.ndarray) -> int:
    return len(np.unique(np.round(rows / _SAME).astype(np.int64), axis=0))
