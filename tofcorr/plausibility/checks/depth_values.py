"""Does the depth hold measured values: neither constant, nor clipped, nor rounded, nor none?"""

import numpy as np

from tofcorr.plausibility.finding import Finding, in_words
from tofcorr.plausibility.look import Look

# Fewest values to judge a distribution by. Chosen.
_FEWEST = 50
# Share of one value from which the depth counts as stuck. Chosen: far above any measured wall.
_STUCK = 0.9
# Share of one value from which pixels count as clipped, and how much commoner it must be than the
# twentieth commonest: rounded depth has many common values. Chosen.
_CLIPPED, _COMMONER = 0.01, 5.0
# Step of rounded depth, metres, that is worth a note, and that hides the errors to be calibrated.
# Chosen: a step of 20 mm adds 6 mm to the noise.
_COARSE, _TOO_COARSE = 0.004, 0.02
# Share of an image's sampled pixels without a return from which it counts as empty. Chosen.
_EMPTY = 0.95
# Share of empty frames above which the recording is doubtful. Chosen.
_MANY = 0.5


def check(look: Look) -> list[Finding]:
    """Look at how often values repeat, and at what is missing."""
    stored = look.sample.stored
    valid = np.isfinite(stored)
    values = stored[valid]
    if not len(values):
        return [
            Finding(
                "depth values",
                "impossible",
                "No pixel looked at holds a usable distance: depth.npy is NaN or zero there, "
                "saturated, or the mask is empty.",
            )
        ]
    found = _missing(look, valid)
    if len(values) >= _FEWEST:
        found += _repeated(values) or _rounded(values)
    return found


def _repeated(values: np.ndarray) -> list[Finding]:
    distinct, count = np.unique(values, return_counts=True)
    order = np.argsort(-count)
    share = count[order[0]] / len(values)
    value = distinct[order[0]]
    if share >= _STUCK:
        return [
            Finding(
                "depth values",
                "impossible",
                f"{100 * share:.0f} % of the pixels hold exactly {value:.4g} m: the depth is stuck "
                "at one value; record again.",
            )
        ]
    common = count[order[min(20, len(order) - 1)]] / len(values)
    if share >= _CLIPPED and share >= _COMMONER * common:
        return [
            Finding(
                "depth values",
                "doubtful",
                f"{100 * share:.1f} % of the pixels hold exactly {value:.4g} m: the depth is "
                "clipped, or the value stands for no return; write NaN there.",
            )
        ]
    return []


def _rounded(values: np.ndarray) -> list[Finding]:
    distinct = np.unique(values)
    if len(distinct) < 3:
        return []
    step = float(np.diff(distinct).min())
    if step < _COARSE or np.abs(distinct / step - np.round(distinct / step)).max() > 0.05:
        return []
    severity = "doubtful" if step >= _TOO_COARSE else "note"
    return [
        Finding(
            "depth values",
            severity,
            f"The depth comes in steps of {1e3 * step:.3g} mm: it was rounded; errors below that "
            "cannot be calibrated pixel by pixel.",
        )
    ]


def _missing(look: Look, valid: np.ndarray) -> list[Finding]:
    empty = np.flatnonzero(valid.mean(1) < 1 - _EMPTY)
    if not len(empty):
        return []
    frames = tuple(look.sample.frames[empty].tolist())
    severity = "doubtful" if len(empty) > _MANY * len(valid) else "note"
    return [
        Finding(
            "depth values",
            severity,
            f"Hardly any usable pixel is left in {in_words(frames)}: no return, saturated, or "
            "masked out.",
            frames,
        )
    ]
