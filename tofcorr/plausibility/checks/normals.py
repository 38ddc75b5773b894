"""Do the planes' normals point to the camera?"""

import numpy as np

from tofcorr.plausibility.alignment import Alignment
from tofcorr.plausibility.finding import Finding, in_words
from tofcorr.plausibility.look import Look

# Misfit up to which the alignment can be believed, metres. Chosen.
_ALIGNED = 0.05
# Angle from which a normal counts as turned round, degrees; 180 would be exactly. Chosen.
_TURNED = 135.0


def check(look: Look) -> list[Finding]:
    """Compare the recorded normals, seen from the camera, with those of the points."""
    found = look.as_given
    if found is None or look.planes != "known" or found.misfit > _ALIGNED:
        return []
    # A few noisy pixels tell their plane badly. A turned normal has the camera behind its plane.
    turned = np.degrees(np.nan_to_num(found.angle)) > _TURNED
    away = np.flatnonzero(turned & (_camera_from_planes(look, found) < 0))
    if not len(away):
        return []
    frames = tuple(look.frames[away].tolist())
    which = "all frames" if len(away) == len(found.angle) else in_words(frames)
    return [
        Finding(
            "normals",
            "impossible",
            f"The normals of the planes point away from the camera in {which}, by "
            f"{np.degrees(np.median(found.angle[away])):.0f} degrees: write -nx, -ny, -nz, -d.",
            frames,
        )
    ]


def _camera_from_planes(look: Look, found: Alignment) -> np.ndarray:
    """Return how far the camera is on the side of each recorded normal, shape (F,), metres."""
    normal, offset = look.scene.planes_in_tool()
    return normal @ found.hand_eye[:3, 3] + offset
