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
            f"depth and amplitude: expected float32, got {_numbers(depth)} and "
            f"{_numbers(amplitude)}. Convert depth to metres and both to float32."
        )


def _numbers(tensor: Tensor) -> str:
    """Return the type of a tensor's numbers in words: TorchScript knows types by number only."""
    whole = "int" if tensor.is_signed() else "uint"
    kind = "float" if tensor.is_floating_point() else whole
    return kind + str(8 * tensor.element_size())
