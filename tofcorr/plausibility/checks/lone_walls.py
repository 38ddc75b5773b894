"""Are walls at unknown places seen often enough to be one wall?"""

import numpy as np

from tofcorr.plausibility.finding import Finding
from tofcorr.plausibility.free_walls import walls_of
from tofcorr.plausibility.look import Look

# Fewest frames of a wall at an unknown place: one frame determines about the three unknowns of the
# wall itself, as in training.
_FEWEST = 3
# Share of the frames that may show walls of fewer. Chosen: the other half still fixes the hand-eye.
_MOST_ALONE = 0.5


def check(look: Look) -> list[Finding]:
    """Count the frames of walls that hardly any other frame shows; only where walls are fitted."""
    if not look.fits or look.planes != "unknown":
        return []
    wall = walls_of(look.scene)
    alone = np.bincount(wall)[wall] < _FEWEST
    if alone.mean() <= _MOST_ALONE:
        return []
    remedy = "measure the planes, or record the poses of a robot"
    if look.sample.data.moves:
        remedy = "give all frames of one wall the same nx, ny, nz, d and target in frames.csv"
    return [
        Finding(
            "lone_walls",
            "impossible",
            f"{alone.sum()} of {len(wall)} frames have a plane that fewer than {_FEWEST} frames "
            "share, and the planes are to be estimated: a fit could place each wall where its "
            f"frame measured it, and would leave no error at all; {remedy}.",
        )
    ]
