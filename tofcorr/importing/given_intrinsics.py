"""Camera intrinsics as the user gives them, before the size of the images is known."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from tofcorr.data.header import FILE_NAME, build_header
from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.camera import CameraIntrinsics, Matrix3


@dataclass(frozen=True, kw_only=True)
class GivenIntrinsics:
    """Pinhole matrix and distortion of a camera.

    Attributes:
        matrix: The 3x3 pinhole matrix, pixels, pixel centres at integer coordinates.
        distortion: OpenCV's coefficients k1 k2 p1 p2 [k3 ...]; empty for none.
        size: Width and height of the images that they are valid for; None if unknown.
        source: Where they come from (a file, options), for messages.
        matrix_by_size: For a camera with several image sizes the matrix of each; `matrix` is then
            that of the first.
    """

    matrix: Matrix3
    distortion: tuple[float, ...]
    size: tuple[int, int] | None
    source: str
    matrix_by_size: Mapping[tuple[int, int], Matrix3] = field(default_factory=dict)

    def camera(self, size: tuple[int, int]) -> CameraIntrinsics:
        """Return the intrinsics for images of `size`, width and height.

        Raises:
            CalibrationDataError: They are valid for another size, or no camera has them.
        """
        if self.size is not None and self.size != size:
            raise CalibrationDataError(
                f"{self.source}: the intrinsics hold for {self.size[0]}x{self.size[1]} pixels, "
                f"the images have {size[0]}x{size[1]}."
            )
        if self.matrix_by_size and size not in self.matrix_by_size:
            sizes = ", ".join(f"{width}x{height}" for width, height in self.matrix_by_size)
            raise CalibrationDataError(
                f"{self.source}: the camera has images of {sizes} pixels, these have "
                f"{size[0]}x{size[1]}."
            )
        matrix = self.matrix_by_size.get(size, self.matrix)
        camera = CameraIntrinsics(
            width=size[0], height=size[1], matrix=matrix, distortion=self.distortion
        )
        try:
            build_header(camera, "z", None, None, None)
        except CalibrationDataError as error:
            message = str(error).replace(FILE_NAME, self.source)
            raise CalibrationDataError(message) from None
        if self.matrix[0][1] != 0:
            raise CalibrationDataError(
                f"{self.source}: the pinhole matrix has a skew of {self.matrix[0][1]:g}; OpenCV's "
                "board pose does not support it."
            )
        return camera


def intrinsics_from_numbers(
    focal_lengths: Sequence[float],
    centre: Sequence[float],
    distortion: Sequence[float],
    source: str,
    size: tuple[int, int] | None = None,
) -> GivenIntrinsics:
    """Build intrinsics from fx, fy (one number for both, or two), cx, cy and the distortion."""
    fx, fy = focal_lengths[0], focal_lengths[-1]
    cx, cy = centre
    return GivenIntrinsics(
        matrix=((fx, 0.0, cx), (0.0, fy, cy), (0.0, 0.0, 1.0)),
        distortion=tuple(distortion),
        size=size,
        source=source,
    )
