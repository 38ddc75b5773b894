"""Masks that look at each image alone are computed once, and remembered for every further pass."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from tofcorr.data.frames import FrameBatch

# Bytes of masks that are kept, at eight pixels a byte; later images are looked at anew in each
# pass. Chosen: 7000 images of 640 x 480 pixels.
_MOST_BYTES = 1 << 28

Mask = Callable[[FrameBatch], Bool[Tensor, "B H W"]]
"""Returns True where a valid pixel of a batch is not used."""


@dataclass(frozen=True, eq=False)
class Remembered:
    """A mask with a memory of each frame's image.

    Attributes:
        mask: What is remembered. It must say the same of a frame each time, whatever other frames
            are in its batch.
    """

    mask: Mask
    _known: dict[int, np.ndarray] = field(default_factory=dict)

    def __call__(self, batch: FrameBatch) -> Bool[Tensor, "B H W"]:
        """Return what the mask says of a batch, whose `indices` are the frames' global numbers."""
        frames, shape = batch.indices.tolist(), batch.valid.shape
        if all(frame in self._known for frame in frames):
            packed = np.stack([self._known[frame] for frame in frames])
            flat = np.unpackbits(packed, axis=1, count=shape[1] * shape[2])
            return torch.from_numpy(flat.astype(bool)).reshape(shape).to(batch.valid.device)
        masked = self.mask(batch)
        packed = np.packbits(masked.flatten(1).cpu().numpy(), axis=1)
        if (len(self._known) + len(packed)) * packed.shape[1] <= _MOST_BYTES:
            self._known.update(zip(frames, packed, strict=True))
        return masked
