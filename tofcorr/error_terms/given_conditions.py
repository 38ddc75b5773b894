"""The conditions of frames as a caller gives them, in the form that error terms read."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from tofcorr.conditions import CONDITIONS, condition
from tofcorr.errors import FrameError

Condition = float | Tensor | None
"""One number for all frames, or one for each: shape (...) of depth (..., H, W); None: unknown."""

_NAME_OF = {condition(name).column: name for name in CONDITIONS}


def in_si_units(
    given: Mapping[str, Condition], frames: Sequence[int], dtype: torch.dtype, device: torch.device
) -> dict[str, Tensor]:
    """Return the conditions that are given, by attribute of `Conditions`, in its units.

    Args:
        given: By column of `frames.csv`, in the units of the columns.
        frames: The leading shape (...) of the depth (..., H, W).
        dtype: Of the result.
        device: Of the result.

    Returns:
        Tensors of shape () or (...), as they were given; NaN: unknown of that frame.

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
        number = torch.as_tensor(value, device=device).to(dtype)
        if number.dim() and list(number.shape) != list(frames):
            raise FrameError(
                f"{column}: expected one number, or one for each frame, shape {list(frames)}; got "
                f"shape {list(number.shape)}."
            )
        name = _NAME_OF[column]
        known[name] = number * condition(name).si_per_unit
    return known


def with_means(known: Mapping[str, Tensor], mean: Tensor) -> Tensor:
    """Return the conditions in the order of `CONDITIONS`; what is unknown is taken as the mean.

    Args:
        known: As `in_si_units` returns them.
        mean: The mean conditions of the calibration, shape (C,).

    Returns:
        Shape (..., C), or (C,) if none was given for each frame; dtype and device of `mean`.
    """
    values = []
    for name, usual in zip(CONDITIONS, mean.unbind(-1), strict=True):
        value = known[name].to(mean.dtype) if name in known else usual
        values.append(torch.where(torch.isnan(value), usual, value))
    return torch.stack(torch.broadcast_tensors(*values), dim=-1)
