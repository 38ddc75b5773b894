"""Does the pose or the plane of single frames disagree with all others?"""

import numpy as np

from tofcorr.plausibility.finding import Finding, in_words
from tofcorr.plausibility.look import Look

# A frame disagrees if its misfit is so many times the median's, and so many metres; the second
# where errors of the camera cannot be taken off first. Chosen: see
# benchmarks/faults_in_recordings.py for clean recordings.
_TIMES, _LEAST, _LEAST_ROUGH = 5.0, 0.02, 0.04
# Share of the frames up to which they are single ones. Chosen: the alignment is robust to a third.
_MOST = 0.3
# Fewest frames among which one can disagree: the alignment takes three. Chosen.
_FEWEST = 6


def check(look: Look) -> list[Finding]:
    """Compare every frame's misfit under the robust alignment with the median's."""
    off = outlying_frames(look)
    if not off:
        return []
    frames = tuple(off)
    amounts = ", ".join(f"{1e3 * value:.0f}" for value in list(off.values())[:5])
    verb = "disagrees" if len(frames) == 1 else "disagree"
    return [
        Finding(
            "outlying poses",
            "doubtful",
            f"{in_words(frames).capitalize()} {verb} with all others by {amounts} mm (median "
            f"{1e3 * float(np.median(look.rms)):.0f} mm): wrong poses, planes or images; "
            "train, evaluate and select leave them out.",
            frames,
        )
    ]


def outlying_frames(look: Look) -> dict[int, float]:
    """Return the misfit of every frame that disagrees, metres, the worst first."""
    given = look.as_given
    if given is None or len(given.rms) < _FEWEST:
        return {}
    rms = look.rms
    least = _LEAST_ROUGH if look.shape is None else _LEAST
    off = np.flatnonzero(rms > max(_TIMES * float(np.median(rms)), least))
    if not len(off) or len(off) > _MOST * len(rms):
        return {}
    return {int(look.frames[k]): float(rms[k]) for k in off[np.argsort(-rms[off])]}
