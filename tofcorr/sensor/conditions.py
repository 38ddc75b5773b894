"""The conditions of frames, held to the ranges that a sensor was measured in."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from tofcorr.error_terms.given_conditions import Condition, in_si_units

# Conditions count up to this share of their range beyond it (no unit). Derived: a parabola that
# errs by 1 at most within a range errs by 2 an eighth of it further, by 7 half of it further.
_BEYOND = 0.125


def conditions_of(
    given: Mapping[str, Condition],
    leading: Sequence[int],
    device: torch.device,
    ranges: Mapping[str, Sequence[float]],
) -> dict[str, Tensor]:
    """Return what is known of B frames, by attribute, in SI units, each of shape (B,), float64.

    Conditions are held to the ranges that the sensor was measured in, an eighth of them wider.
    Effects of temperature or exposure are polynomials: far beyond their range they can be
    centimetres off. A time is no such condition: effects of it settle.

    Args:
        given: By column of `frames.csv`.
        leading: The leading shape (...) of the depth (..., H, W).
        device: Of the result.
        ranges: Lowest and highest value first, by attribute.

    Raises:
        FrameError: There is no such condition, or it has neither one value nor one a frame.
    """
    known = in_si_units(given, leading, torch.float64, device)
    for name, number in known.items():
        if name in ranges and name != "timestamp":
            low, high = ranges[name][:2]
            margin = _BEYOND * (high - low)
            known[name] = number.clamp(low - margin, high + margin)
    return {name: number.expand(tuple(leading)).reshape(-1) for name, number in known.items()}
