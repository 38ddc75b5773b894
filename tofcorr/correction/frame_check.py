"""Refuses tensors that are not frames of the calibrated camera."""

import torch
from torch import Tensor


def check_frames(depth: Tensor, amplitude: Tensor, height: int, width: int) -> None:
    """Refuse all but a frame, or a batch of frames, of the camera in float32.

    Raises:
        ValueError: Shape or dtype differ (`torch.jit.Error` once scripted).
    """
    if depth.dim() not in (2, 3) or list(depth.shape[-2:]) != [height, width]:
        raise ValueError(
            f"depth: expected shape ({height}, {width}) or (B, {height}, {width}), the size of the "
            f"calibrated camera; got {list(depth.shape)}. Was the frame cropped, binned or "
            "transposed?"
        )
    if list(amplitude.shape) != list(depth.shape):
        raise ValueError(
            f"amplitude: expected the shape of depth, {list(depth.shape)}; "
            f"got {list(amplitude.shape)}."
        )
    if depth.dtype != torch.float32 or amplitude.dtype != torch.float32:
        raise ValueError(
            f"depth and amplitude: expected float32, got {depth.dtype} and "
            f"{amplitude.dtype}. Convert depth to metres and both to float32."
        )
