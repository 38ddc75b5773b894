"""Is the amplitude one: neither constant, nor saturated unmarked, nor the depth again?"""

import numpy as np

from tofcorr.plausibility.finding import Finding
from tofcorr.plausibility.look import Look

# Fewest values to judge by. Chosen.
_FEWEST = 50
# Robust spread over median below which the amplitude counts as constant. Chosen: the light falls
# with the square of the distance, and by a few percent over any image.
_CONSTANT = 1e-3
# Share of pixels at the largest amplitude from which they count as saturated. Chosen.
_SATURATED = 0.01
# Correlation of amplitude and distance above which one is taken for the other. Chosen.
_SAME = 0.999


def check(look: Look) -> list[Finding]:
    """Look at the amplitude's spread, its largest value, and its relation to the depth."""
    sample = look.sample
    if sample.amplitude is None:
        return []
    usable = np.isfinite(sample.amplitude) & np.isfinite(sample.stored)
    values, depth = sample.amplitude[usable], sample.stored[usable]
    if len(values) < _FEWEST:
        return []
    median = float(np.median(values))
    low, high = np.quantile(values, [0.05, 0.95])
    if high - low <= _CONSTANT * max(median, 1e-12):
        return [
            Finding(
                "amplitude",
                "doubtful",
                f"The amplitude is {median:.4g} nearly everywhere: it was not measured; remove "
                "amplitude.npy, and use a model without an intensity term.",
            )
        ]
    if np.ptp(depth) > 0 and np.corrcoef(values, depth)[0, 1] > _SAME:
        return [
            Finding(
                "amplitude",
                "doubtful",
                "The amplitude follows the depth exactly: amplitude.npy seems to hold depth again.",
            )
        ]
    return _saturated(values)


def _saturated(values: np.ndarray) -> list[Finding]:
    largest = values.max()
    share = float((values >= largest).mean())
    if share < _SATURATED:
        return []
    return [
        Finding(
            "amplitude",
            "doubtful",
            f"{100 * share:.1f} % of the pixels have the largest amplitude, {largest:.6g}: they "
            "are saturated and their depth is wrong; set saturation_amplitude in recording.yaml.",
        )
    ]
