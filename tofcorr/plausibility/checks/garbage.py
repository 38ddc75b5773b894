"""Do the pixels of a frame lie on one plane?"""

import numpy as np

from tofcorr.geometry.ranges import range_of_wrapped
from tofcorr.plausibility.checks.wrapping import range_words
from tofcorr.plausibility.finding import Finding
from tofcorr.plausibility.look import Look

# Distance along the ray from its frame's plane at which a pixel counts as garbage, metres, and in
# robust standard deviations. Chosen: errors of a camera are centimetres.
FAR_OFF = 0.1
_SIGMAS = 8.0
# Share of garbage that is doubtful, and that is worth a note. Chosen: 1 % of pixels 0.7 m off bend
# a plane by about 7 mm.
_MANY, _SOME = 0.01, 0.003
# Mean over all pixels of how far garbage is off, metres, that is doubtful however few pixels it is.
# Chosen: as much as that.
_PULL = 0.007
# Squares of garbage, in times those of all other pixels, from which garbage dominates a fit, no
# unit. Chosen: they double the standard errors of least squares.
_OF_SQUARES = 4.0
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
    if share < _SOME and not bends(look):
        return []
    return [
        Finding(
            "garbage",
            "doubtful" if bends(look) else "note",
            f"{100 * share:.1f} % of the pixels lie more than {1e3 * FAR_OFF:.0f} mm off the plane "
            f"of their frame: {_what_they_are(look)}; {_what_to_do(look)}.",
        )
    ]


def _what_to_do(look: Look) -> str:
    """Say who leaves them out; see `training.left_out`."""
    if not (bends(look) or dominates(look)):
        return "mask them (mask.npy, or `mask: ransac` in the configuration)"
    return (
        "`tofcorr train`, `evaluate` and `select` leave them out, unless their configuration says "
        "which pixels count; mask.npy does so for every command"
    )


def _what_they_are(look: Look) -> str:
    frequency = look.sample.recording.modulation_frequency
    far = _far_off(look)
    if frequency is None or range_of_wrapped(far[far > 0], frequency) is None:
        return "edges, reflections or other surfaces"
    return f"most by {range_words(frequency)}, so they show a target beyond it"


def garbage_share(look: Look) -> float:
    """Return the share of the sampled pixels that lie far off the plane of their frame."""
    off = _far_off(look)
    return float((off > 0).mean()) if len(off) else 0.0


def bends(look: Look) -> bool:
    """Whether pixels far off bend a fit by least squares: many, or few that are very far off."""
    off = _far_off(look)
    return len(off) > 0 and bool((off > 0).mean() >= _MANY or off.mean() >= _PULL)


def dominates(look: Look) -> bool:
    """Whether pixels far off make most of the squares that a fit by least squares minimises."""
    off, known = _far_off(look), look.own.known
    others = float(np.mean(look.own.flatness[known] ** 2)) if known.any() else 0.0
    return len(off) > 0 and float(np.mean(off**2)) > _OF_SQUARES * others


def _far_off(look: Look) -> np.ndarray:
    """Return how far each usable pixel is off, shape (M,), metres; zero up to the limit."""
    known = look.own.known
    off = np.abs(look.own.off_by[known])
    valid = np.isfinite(off)
    limit = np.maximum(FAR_OFF, _SIGMAS * look.own.flatness[known])[:, None]
    return np.where(off > limit, off, 0.0)[valid]
