"""The conditions of frames, from keywords to the tensor that terms read."""

import torch
from torch import Tensor

from tofcorr.errors import FrameError

Condition = float | Tensor | None
"""One number for all frames, or one for each: shape (...) of depth (..., H, W); None: unknown."""

# The keywords in the order of `CONDITIONS`, and what turns their unit into SI. A microsecond is
# 1e-6 s.
_SI = {
    "timestamp_s": 1.0,
    "integration_time_us": 1e-6,
    "room_temperature_c": 1.0,
    "body_temperature_c": 1.0,
    "ambient": 1.0,
}


def conditions_tensor(
    given: dict[str, Condition], frames: torch.Size, mean: Tensor
) -> Tensor | None:
    """Return the conditions of frames, shape (C,) or (..., C); None if none is given.

    Args:
        given: By keyword; what is missing, None or NaN is taken as the mean.
        frames: The leading shape (...) of the depth (..., H, W).
        mean: The mean conditions of the calibration, shape (C,).

    Raises:
        FrameError: There is no such condition, or it has neither one value nor one a frame.
    """
    for name in given:
        if name not in _SI:
            raise FrameError(f"'{name}' is no condition of a frame. Known: {', '.join(_SI)}.")
    if all(value is None for value in given.values()):
        return None
    values = []
    for (name, unit), usual in zip(_SI.items(), mean.unbind(-1), strict=True):
        value = given.get(name)
        if value is None:
            values.append(usual)
            continue
        value = torch.as_tensor(value, device=mean.device).to(mean.dtype) * unit
        if value.dim() and value.shape != frames:
            raise FrameError(
                f"{name}: expected one number, or one for each frame, shape {list(frames)}; got "
                f"shape {list(value.shape)}."
            )
        values.append(torch.where(torch.isnan(value), usual, value))
    return torch.stack(torch.broadcast_tensors(*values), dim=-1)
