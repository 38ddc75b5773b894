"""Does the camera's temperature change?"""

import numpy as np

from tofcorr.plausibility.finding import Finding
from tofcorr.plausibility.look import Look

# Fewest frames in which a camera's temperature must change. Chosen.
_FEWEST = 10


def check(look: Look) -> list[Finding]:
    """Look at the column of the camera's own temperature."""
    values = look.sample.column("body_temperature")
    if values is None:
        return []
    known = values[np.isfinite(values)]
    if len(known) < _FEWEST or np.ptp(known) > 0:
        return []
    return [
        Finding(
            "temperatures",
            "note",
            f"body_temperature_c is {known[0]:g} in all frames: the sensor was not read, or the "
            "camera was warm; temperature terms cannot be estimated.",
        )
    ]
