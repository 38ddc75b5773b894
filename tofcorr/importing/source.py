"""What every door of the importer opens: depth images, read one at a time."""

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np

from tofcorr.geometry.intrinsics import CameraIntrinsics


class DepthImage(NamedTuple):
    """One image.

    Attributes:
        depth: Metres, float32, shape (H, W); NaN where there is no return.
        amplitude: The camera's own linear units, shape (H, W); None without amplitudes.
    """

    depth: np.ndarray
    amplitude: np.ndarray | None = None


class DepthSource(Protocol):
    """Images of one camera, in the order of their times."""

    @property
    def origin(self) -> str:
        """Where the images come from, for messages."""
        ...

    @property
    def names(self) -> Sequence[str]:
        """What each image is called."""
        ...

    @property
    def times(self) -> np.ndarray | None:
        """Seconds on the camera's clock, shape (N,), increasing; None without times."""
        ...

    @property
    def camera(self) -> CameraIntrinsics:
        """The camera's intrinsics."""
        ...

    def read(self, number: int) -> DepthImage:
        """Read one image.

        Raises:
            RefusedViewError: It cannot be used; the message says why.
        """
        ...
