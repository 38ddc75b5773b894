"""What the mathematics needs of measured images, wherever they come from."""

from typing import Protocol, runtime_checkable

from jaxtyping import Bool, Float
from torch import Tensor


@runtime_checkable
class Images(Protocol):
    """Some images, each of a plane that is known in the tool frame.

    `tofcorr.data.frames.FrameBatch` fits, and so do predicted images.
    """

    @property
    def radial_distance(self) -> Float[Tensor, "B H W"]:
        """Distances along the rays, shape (B, H, W), metres; undefined where not `valid`."""
        ...

    @property
    def amplitude(self) -> Float[Tensor, "B H W"] | None:
        """Amplitudes, shape (B, H, W), in the camera's units; None if not recorded."""
        ...

    @property
    def valid(self) -> Bool[Tensor, "B H W"]:
        """Where a pixel may be used, shape (B, H, W), bool."""
        ...

    @property
    def normal_tool(self) -> Float[Tensor, "B 3"]:
        """Unit normals of the planes n . x + d = 0 in the tool frame, shape (B, 3)."""
        ...

    @property
    def offset_tool(self) -> Float[Tensor, "B"]:
        """Their offsets d, shape (B,), metres."""
        ...
