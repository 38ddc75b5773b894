"""What every door of the importer opens: depth images, read one at a time."""

from collections.abc import Sequence
from typing import NamedTuple, Protocol, Self

import numpy as np

from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.importing.report import RefusedViewError


class DepthImage(NamedTuple):
    """One image.

    Attributes:
        depth: Metres, float32, shape (H, W); NaN where there is no return.
        amplitude: The camera's own linear units, shape (H, W); None without amplitudes.
    """

    depth: np.ndarray
    amplitude: np.ndarray | None = None

    def of(self, camera: CameraIntrinsics) -> Self:
        """Return the image, unless a camera of other intrinsics took it.

        Raises:
            RefusedViewError: Depth or amplitude is of another size.
        """
        size = (camera.height, camera.width)
        for what, image in self._asdict().items():
            if image is not None and image.shape != size:
                raise RefusedViewError(
                    f"its {what} has {image.shape[1]}x{image.shape[0]} pixels, the intrinsics hold "
                    f"for {size[1]}x{size[0]}"
                )
        return self


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
