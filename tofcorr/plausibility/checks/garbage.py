"""Do the pixels of a frame lie on one plane?"""

import numpy as np

from tofcorr.plausibility.finding import Finding
from tofcorr.plausibility.look import Look

# Distance along the ray from its frame's plane at which a pixel counts as garbage, metres, and in
# robust standard deviations. Chosen: errors of a camera are centimetres.
FAR_OFF = 0.1
_SIGMAS = 8.0
# Share of garbage that is doubtful, and that is worth a note. Chosen: 1 % of pixels 0.7 m off bend
# a plane by about 7 mm.
MANY, _SOME = 0.01, 0.003
# Flatness above which no wall is seen at all, metres. Chosen.
_NOT_FLAT = 0.05


def check(look: Look) -> list[Finding]:
    """Count the pixels far off their frame's plane."""
    known = look.own.known
    if not known.any():
        return []
    flatness = float(np.median(look.own.flatness[known]))
    if flatness > _NOT_FLAT:
        return [
            Finding(
                "garbage",
                "impossible" if look.fits else "doubtful",
                f"The points of a frame lie {1e3 * flatness:.0f} mm off a plane of their own: the "
                "target is not flat, the mask shows something else, or the depth is decoded "
                "wrongly.",
            )
        ]
    share = garbage_share(look)
    if share < _SOME:
        return []
    return [
        Finding(
            "garbage",
            "doubtful" if share >= MANY else "note",
            f"{100 * share:.1f} % of the pixels lie more than {1e3 * FAR_OFF:.0f} mm off the plane "
            "of their frame: edges, reflections or other surfaces; mask them (mask.npy, or "
            "`mask: ransac` in the configuration).",
        )
    ]


def garbage_share(look: Look) -> float:
    """Return the share of the sampled pixels that lie far off the plane of their frame."""
    known = look.own.known
    if not known.any():
        return 0.0
    off = np.abs(look.own.off_by[known])
    valid = np.isfinite(off)
    limit = np.maximum(FAR_OFF, _SIGMAS * look.own.flatness[known])[:, None]
    return float((off[valid] > np.broadcast_to(limit, off.shape)[valid]).mean())
