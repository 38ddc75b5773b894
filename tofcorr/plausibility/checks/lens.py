"""Does the lens model give every pixel a viewing ray?"""

import numpy as np

from tofcorr.geometry.rays import lens_misses
from tofcorr.plausibility.finding import Finding
from tofcorr.plausibility.look import Look

# Distance from a pixel to the image of its own ray from which the pixel has no ray, pixels. Chosen:
# where there is one, it is found to 1e-6, and where there is none, it is many pixels off.
_NO_RAY = 0.5


def check(look: Look) -> list[Finding]:
    """Count the pixels that the distortion polynomial does not reach."""
    used = np.isfinite(look.sample.stored)
    if not used.any():
        return []
    missed = lens_misses(look.sample.recording.camera).reshape(-1).numpy() > _NO_RAY
    share = float(missed[look.sample.pixel][used].mean())
    if share == 0:
        return []
    return [
        Finding(
            "lens",
            "doubtful",
            f"About {100 * share:.2g} % of the pixels have no viewing ray: `distortion` in "
            "recording.yaml turns back before it reaches them, so their points are wrong whatever "
            "their depth. Mask them (mask.npy), or calibrate the lens with views of a board that "
            "reach the corners; the order is k1 k2 p1 p2 k3 k4 k5 k6.",
        )
    ]
