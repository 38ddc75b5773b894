"""The conditions of frames, from keywords in the units of `frames.csv` to SI units."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from tofcorr.conditions import CONDITIONS, condition
from tofcorr.errors import FrameError

Condition = float | Tensor | None
"""One number for all frames, or one for each: shape (...) of depth (..., H, W); None: unknown."""

# Conditions count up to this share of their range beyond it (no unit). Derived: a parabola that
# errs by 1 at most within a range errs by 2 an eighth of it further, by 7 half of it further.
_BEYOND = 0.125

_NAME_OF = {condition(name).column: name for name in CONDITIONS}


def conditions_of(
    given: Mapping[str, Condition],
    leading: Sequence[int],
    like: Tensor,
    ranges: Mapping[str, Sequence[float]],
) -> dict[str, Tensor]:
    """Return what is known of B frames, by attribute, in SI units, each of shape (B,), float64.

    Conditions are held to the ranges that the sensor was measured in, an eighth of them wider.
    Effects of temperature or exposure are polynomials: far beyond their range they can be
    centimetres off. A time is no such condition: effects of it settle.

    Args:
        given: By column of `frames.csv`.
        leading: The leading shape (...) of the depth (..., H, W).
        like: Whose device to use.
        ranges: Lowest and highest value first, by attribute.

    Raises:
        FrameError: There is no such condition, or it has neither one value nor one a frame.
    """
    known = {}
    for column, value in given.items():
        if column not in _NAME_OF:
            raise FrameError(
                f"'{column}' is no condition of a frame. Known: {', '.join(_NAME_OF)}."
            )
        if value is None:
            continue
        number = torch.as_tensor(value, dtype=torch.float64, device=like.device)
        if number.dim() and list(number.shape) != list(leading):
            raise FrameError(
                f"{column}: expected one number, or one for each frame, shape {list(leading)}; got "
                f"shape {list(number.shape)}."
            )
        name = _NAME_OF[column]
        number = number * condition(name).si_per_unit
        if name in ranges and name != "timestamp":
            low, high = ranges[name][:2]
            margin = _BEYOND * (high - low)
            number = number.clamp(low - margin, high + margin)
        known[name] = number.expand(tuple(leading)).reshape(-1)
    return known


def conditions_tensor(known: Mapping[str, Tensor], count: int, mean: Tensor) -> Tensor:
    """Return the conditions that error terms read, (B, C); what is unknown is at its mean."""
    values = []
    for number, name in enumerate(CONDITIONS):
        value = known.get(name)
        usual = mean[number].expand(count)
        if value is None:
            values.append(usual)
        else:
            value = value.to(mean.dtype)
            values.append(torch.where(torch.isnan(value), usual, value))
    return torch.stack(values, dim=-1)
