"""Several processes, on one machine or many, share the pass over the pixels.

Each of n processes takes every n-th frame. They exchange sums over frames, whose size does not
depend on that of the images. They are started by `torchrun`; in a single process the functions
here return their input.
"""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

import numpy as np
import torch
from torch import distributed

ValueT = TypeVar("ValueT")
_alone = ContextVar("alone", default=False)


@contextmanager
def process_group(device: str) -> Iterator[str]:
    """Join the processes that `torchrun` started, for the length of the block.

    Args:
        device: `cpu` (gloo) or `cuda` (nccl).

    Yields:
        The device of this process: one GPU each, by its number on the machine.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield device
        return
    on_gpu = device.startswith("cuda")
    if on_gpu:
        device = f"cuda:{os.environ['LOCAL_RANK']}"
        torch.cuda.set_device(device)
    distributed.init_process_group("nccl" if on_gpu else "gloo")
    try:
        yield device
    finally:
        distributed.destroy_process_group()


def is_first() -> bool:
    """Whether this process is the one that writes and prints."""
    return not distributed.is_initialized() or distributed.get_rank() == 0


@contextmanager
def alone() -> Iterator[None]:
    """Let this process read all frames itself for the length of the block."""
    reset = _alone.set(True)
    try:
        yield
    finally:
        _alone.reset(reset)


def _sharing() -> bool:
    return distributed.is_initialized() and not _alone.get()


def own_share(frames: Sequence[int] | np.ndarray) -> np.ndarray:
    """Return the frames that this process reads."""
    frames = np.asarray(frames)
    if not _sharing():
        return frames
    return frames[distributed.get_rank() :: distributed.get_world_size()]


def everyones(value: ValueT) -> list[ValueT]:
    """Return the values that all processes pass, in the order of their ranks."""
    if not _sharing():
        return [value]
    values: list[ValueT | None] = [None] * distributed.get_world_size()
    distributed.all_gather_object(values, value)
    return values  # type: ignore[return-value]
