"""Is the target beyond the unambiguous range, where a phase camera measures it one range nearer?"""

import numpy as np

from tofcorr.geometry.ranges import (
    multiples_in_words,
    range_of_wrapped,
    unambiguous_range,
    wrapped,
)
from tofcorr.plausibility.finding import Finding
from tofcorr.plausibility.look import Look

# Share of the pixels that must be whole unambiguous ranges off to explain why frames are off their
# planes. Chosen: fewer do not put a third of the frames off, and they are garbage.
_MANY = 0.1
# Error from which a pixel is far off, metres. Chosen: errors of a camera are centimetres.
_FAR = 0.1


def check(look: Look) -> list[Finding]:
    """Count the pixels that are whole unambiguous ranges off the recorded planes."""
    frequency = look.sample.recording.modulation_frequency
    if frequency is None:
        return []
    errors = _errors(look)
    share = float(wrapped(errors, frequency).mean()) if len(errors) else 0.0
    if share < _MANY or range_of_wrapped(errors[np.abs(errors) > _FAR], frequency) is None:
        return []
    return [
        Finding(
            "wrapping",
            "impossible" if look.fits else "doubtful",
            f"{100 * share:.0f} % of the pixels are off the recorded planes by "
            f"{range_words(frequency)}: they show targets beyond it. Mask them, or record nearer "
            "than that.",
            spoils=True,
        )
    ]


def range_words(frequency: float) -> str:
    """Return the unambiguous range of a modulation frequency (Hz), to follow "off by"."""
    multiples = multiples_in_words(unambiguous_range(frequency))
    return f"{multiples} of {1e-6 * frequency:.4g} MHz"


def _errors(look: Look) -> np.ndarray:
    """Return measured less true distances under the best alignment, shape (M,), metres."""
    given, scene = look.as_given, look.scene
    if given is None or look.planes != "known":
        return np.zeros(0)
    cameras = scene.poses @ given.hand_eye
    rays = np.einsum("fab,fpb->fpa", cameras[:, :3, :3], look.rays[look.usable])
    height = np.einsum("fa,fa->f", cameras[:, :3, 3], scene.normal) + scene.offset
    with np.errstate(divide="ignore", invalid="ignore"):
        true = -height[:, None] / np.einsum("fpa,fa->fp", rays, scene.normal)
    errors = look.distance[look.usable] - (1 + given.slope) * true - given.constant
    return np.asarray(errors[np.isfinite(errors)])
