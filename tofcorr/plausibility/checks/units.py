"""Are depth and poses in metres?"""

import numpy as np

from tofcorr.plausibility.finding import Finding
from tofcorr.plausibility.look import Look

# Median distance, metres, from which it is doubtful and impossible that depth is in metres. Chosen:
# no time-of-flight camera before a wall is 100 m away, and few are 20 m away.
_FAR, _TOO_FAR = 20.0, 100.0
# From this median the depth counts as millimetres, below as centimetres. Chosen: 0.4 m or 4 m.
_MILLIMETRES = 400.0
# Median distance below which it is impossible, metres. Chosen: below the shortest of any camera.
_TOO_NEAR = 0.005
# Largest distance of a pose from the middle of the poses, metres. Chosen: no arm reaches 50 m.
_TOO_WIDE = 50.0


def check(look: Look) -> list[Finding]:
    """Look at the median distance and the extent of the poses."""
    return [*_depth(look), *_poses(look)]


def _depth(look: Look) -> list[Finding]:
    values = look.sample.stored[np.isfinite(look.sample.stored)]
    if not len(values):
        return []
    median = float(np.median(values))
    if median > _TOO_FAR:
        unit = "millimetres" if median > _MILLIMETRES else "centimetres"
        return [
            Finding(
                "units",
                "impossible",
                f"The median distance is {median:.4g} m: depth.npy seems to be in {unit}, or to "
                "hold amplitudes; write metres.",
            )
        ]
    if median < _TOO_NEAR:
        return [
            Finding(
                "units",
                "impossible",
                f"The median distance is {1e3 * median:.3g} mm: depth.npy seems to be in "
                "kilometres, or scaled twice; write metres.",
            )
        ]
    if median > _FAR:
        return [
            Finding(
                "units",
                "doubtful",
                f"The median distance is {median:.3g} m, far for a wall: is depth.npy in metres?",
            )
        ]
    return []


def _poses(look: Look) -> list[Finding]:
    poses = look.sample.column("world_from_tool")
    if poses is None or look.planes == "ignored":
        return []
    place = poses[:, :3, 3]
    extent = float(np.linalg.norm(place - np.median(place, axis=0), axis=1).max())
    if extent <= _TOO_WIDE:
        return []
    return [
        Finding(
            "units",
            "impossible",
            f"The poses extend over {extent:.4g} m: tx, ty, tz in frames.csv seem to be in "
            "millimetres; write metres.",
        )
    ]
