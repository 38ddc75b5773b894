"""How badly the planes of images lie on the walls that were found."""

import numpy as np

from tofcorr.importing.walls.found import FoundWalls

SUSPICIOUS_MM = 20.0
"""Misfit from which a mistake is suspected, millimetres: twice what an uncalibrated camera
leaves."""

MOST_MM = 60.0
"""What a plane that lies on no wall counts, millimetres: the nearness at which planes are gathered
into walls."""


def misfit_mm(found: FoundWalls | None) -> float:
    """Return how far planes are from their walls, root mean square, millimetres.

    A plane on no wall counts 60 mm; so does every plane where no wall was found (None).
    """
    if found is None:
        return MOST_MM
    on_wall = len(found.views)
    off = sum("plane" in one.view for one in found.left_out)
    square = on_wall * min(found.deviation_mm, MOST_MM) ** 2 + off * MOST_MM**2
    return float(np.sqrt(square / max(on_wall + off, 1)))
