"""The camera of a correction, as buffers."""

import torch
from torch import Tensor, nn

from tofcorr.correction.state import DepthKind
from tofcorr.errors import FrameError
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.ranges import refuse_other_than_tensor
from tofcorr.geometry.rays import ray_directions

# OpenCV's longest list of distortion coefficients; shorter ones are filled with zeros, so that
# the buffer has one shape for every camera.
_MOST_COEFFICIENTS = 14


class CameraGeometry(nn.Module):
    """Image size, pinhole matrix, distortion and rays of a camera, and what its depth means.

    Args:
        camera: The lateral parameters.
        depth_kind: `radial`: depth is along the ray; `z`: along the optical axis.

    Attributes:
        matrix: The pinhole matrix K, shape (3, 3), pixels.
        distortion: OpenCV's coefficients, filled with zeros, shape (14,).
        ray_directions: Unit rays in the camera frame, shape (H, W, 3).
        radial_of_depth: Radial distance over depth, shape (H, W): 1 for radial depth.
    """

    matrix: Tensor
    distortion: Tensor
    ray_directions: Tensor
    radial_of_depth: Tensor

    def __init__(self, camera: CameraIntrinsics, depth_kind: DepthKind) -> None:
        super().__init__()
        distortion = torch.zeros(_MOST_COEFFICIENTS, dtype=torch.float64)
        distortion[: len(camera.distortion)] = torch.tensor(camera.distortion)
        self.register_buffer("matrix", camera.matrix_tensor())
        self.register_buffer("distortion", distortion)
        self.register_buffer("ray_directions", ray_directions(camera).clone())
        size = (camera.height, camera.width)
        self.register_buffer("radial_of_depth", torch.ones(size, dtype=torch.float64))
        self.set_depth_kind(depth_kind)

    @torch.no_grad()
    def set_depth_kind(self, depth_kind: DepthKind) -> None:
        """State what depth means."""
        self.radial_of_depth.fill_(1.0)
        if depth_kind == "z":
            self.radial_of_depth.div_(self.ray_directions[..., 2])

    def points(self, depth: Tensor) -> Tensor:
        """Return the points of depths (..., H, W) in the camera frame, (..., H, W, 3), metres."""
        rays = self.ray_directions * self.radial_of_depth[..., None]
        return depth[..., None] * rays.to(depth.dtype)

    def check(self, depth: Tensor, amplitude: Tensor | None) -> None:
        """Refuse tensors that are not frames of the camera.

        Raises:
            FrameError: Shape or dtype are not those of the camera's frames.
        """
        for name, frame in (("depth", depth), ("amplitude", amplitude)):
            if frame is not None:
                refuse_other_than_tensor(name, frame)
        size = list(self.radial_of_depth.shape)
        if depth.dim() < 2 or list(depth.shape[-2:]) != size:
            raise FrameError(
                f"depth: expected shape (..., {size[0]}, {size[1]}), the size of the camera; got "
                f"{list(depth.shape)}. Was the frame cropped, binned or transposed?"
            )
        if amplitude is not None and amplitude.shape != depth.shape:
            raise FrameError(
                f"amplitude: expected the shape of depth, {list(depth.shape)}; got "
                f"{list(amplitude.shape)}."
            )
        for name, frame in (("depth", depth), ("amplitude", amplitude)):
            if frame is not None and not frame.dtype.is_floating_point:
                raise FrameError(
                    f"{name}: expected a floating-point type, got {frame.dtype}. Convert with "
                    f"{name}.float(), and depth to metres."
                )
