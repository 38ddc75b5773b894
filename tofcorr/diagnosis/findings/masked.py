"""Masks that leave little of the images.

A mask that a plane fit made from the depth leaves out the pixels with the largest errors. Of a
strong pattern of the sensor it leaves few pixels, and what is left of it looks like noise.
"""

import torch

from tofcorr.diagnosis.sums.observations import Observations

# Other poses that show a pixel on the target, on average, below which a warning is given. Derived:
# what two poses agree in is a pattern; one pose has nothing to agree with.
_LEAST_OTHERS = 1.0
# Share of the measured pixels that a mask leaves below which one is given too. Chosen: a board that
# fills a seventh of the image in width and height.
_LEAST_SHARE = 0.02


def mask_warning(observations: Observations) -> str:
    """Return a sentence or two for people; empty without a mask, or if it leaves enough."""
    if observations.recording.mask is None:
        return ""
    seen, measured = observations.usable, observations.distance_images > 0
    share = float(seen.sum() / measured.sum().clamp(min=1))
    poses = torch.zeros(seen.shape[1:], dtype=torch.float64)
    for unit in range(observations.num_units):
        poses += seen[observations.unit == unit].any(0)
    alone = float((poses * (poses - 1)).sum() / poses.sum().clamp(min=1)) < _LEAST_OTHERS
    if not alone and share >= _LEAST_SHARE:
        return ""
    found = f"The mask leaves {100 * share:.1f} % of the measured pixels"
    if alone:
        found += (
            ", and a typical one of these in one pose alone: a pattern of the sensor cannot be "
            "distinguished from noise"
        )
    return (
        f"{found}. A mask made from the depth, as by RANSAC, leaves out the pixels with large "
        "errors: widen its threshold."
    )
