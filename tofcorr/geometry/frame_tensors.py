"""Refuses what is no tensor where a frame is expected: arrays, numbers, lists."""

from torch import Tensor

from tofcorr.errors import FrameError


def refuse_other_than_tensor(name: str, frame: object) -> None:
    """Refuse a frame that is no tensor, by the name that its caller knows.

    Raises:
        FrameError: It is something else; the message says how to make a tensor of it.
    """
    if not isinstance(frame, Tensor):
        raise FrameError(
            f"{name}: expected a torch tensor, got {type(frame).__name__}. Make one with "
            "torch.tensor(array), or torch.full(shape, number)."
        )
