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
    """Images of one camera, in the order of their times.

    Attributes:
        origin: Where they come from, for messages.
        names: What each image is called.
        times: Seconds on the camera's clock, shape (N,), increasing; None without times.
        camera: The camera's intrinsics.
    """

    origin: str
    names: Sequence[str]
    times: np.ndarray | None
    camera: CameraIntrinsics

    def read(self, number: int) -> DepthImage:
        """Read one image.

        Raises:
            RefusedViewError: It cannot be used; the message says why.
        """
        ...
