"""The camera: intrinsics, how a file describes them, and the names of its coordinate frames."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal, Self, TypeVar

import torch
from pydantic import AfterValidator, ConfigDict, Field, model_validator
from torch import Tensor

from tofcorr.errors import FrameError
from tofcorr.options import Number, OpenOptions, Options, Size

DepthKind = Literal["radial", "z"]
"""What a camera's depth means: along the ray, or along the optical axis."""
Matrix3 = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]


_MOST_PIXELS = 2**23
"""Most pixels of an image, 4096 x 2048. Five times the largest time-of-flight sensor. The sensor of
such a camera is read within 12 s of CPU time and 2.3 GB; both grow with the pixels."""
DISTORTION_LENGTHS = (0, 4, 5, 8, 12, 14)
"""The OpenCV models: none, k1 k2 p1 p2, + k3, + k4 k5 k6, + thin prism, + tilted sensor."""
_FOCAL_LENGTHS = (1e-3, 1e9)
"""Shortest and longest focal length, pixels. Chosen: beyond both, the rays of all pixels are
equal or at right angles, to rounding errors."""

_SizeT = TypeVar("_SizeT", bound=Any)
Row3 = tuple[Number, Number, Number]


def _pinhole_matrix(rows: Matrix3) -> Matrix3:
    if rows[1][0] != 0 or rows[2][0] != 0 or rows[2][1] != 0 or rows[2][2] != 1:
        raise ValueError("K must be upper triangular with a last row of 0 0 1")
    shortest, longest = _FOCAL_LENGTHS
    if not all(shortest <= rows[i][i] <= longest for i in (0, 1)):
        raise ValueError(f"the focal lengths of K must be {shortest:g} to {longest:g} pixels")
    return rows


def _opencv_distortion(coefficients: tuple[float, ...]) -> tuple[float, ...]:
    if len(coefficients) not in DISTORTION_LENGTHS:
        given = f"got {len(coefficients)} in OpenCV's order"
        raise ValueError(f"expected 0, 4, 5, 8, 12 or 14 coefficients, {given}")
    return coefficients


PinholeMatrix = Annotated[tuple[Row3, Row3, Row3], AfterValidator(_pinhole_matrix)]
Distortion = Annotated[tuple[Number, ...], AfterValidator(_opencv_distortion)]


@dataclass(frozen=True, kw_only=True)
class CameraIntrinsics:
    """Image size, pinhole matrix and lens distortion.

    Attributes:
        width: Columns of the image.
        height: Rows of the image.
        matrix: The 3x3 pinhole matrix in pixels, pixel centres at integer coordinates.
        distortion: OpenCV's coefficients k1 k2 p1 p2 [k3 [k4 k5 k6 [...]]]; empty for none.
    """

    __pydantic_config__ = ConfigDict(extra="forbid")  # For the files that hold one.

    width: Size
    height: Size
    matrix: PinholeMatrix
    distortion: Distortion = ()

    def section(self) -> dict[str, Any]:
        """Return the keys of the section `camera` of a file, as plain values."""
        return {
            "width": self.width,
            "height": self.height,
            "K": [list(row) for row in self.matrix],
            "distortion": list(self.distortion),
        }

    def crop(self, top: int, left: int, height: int, width: int) -> "CameraIntrinsics":
        """Return the camera of a part of the image, from row `top` and column `left` on.

        Raises:
            FrameError: The part is not inside the image.
        """
        inside = 0 <= top < top + height <= self.height and 0 <= left < left + width <= self.width
        if not inside:
            part = f"rows {top} to {top + height - 1}, columns {left} to {left + width - 1}"
            raise FrameError(
                f"a crop of {part}: the image has {self.height} x {self.width} pixels."
            )
        return self._scaled(height, width, (1.0, 1.0), (float(left), float(top)))

    def resize(self, height: int, width: int) -> "CameraIntrinsics":
        """Return the camera of the image resized, with its outer edges kept.

        Pixel centres are integers, so pixel u of the old image lies at (u + 1/2) s - 1/2.
        """
        scale = width / self.width, height / self.height
        return self._scaled(height, width, scale, tuple((1 / s - 1) / 2 for s in scale))

    def bin(self, number: int) -> "CameraIntrinsics":
        """Return the camera whose pixels are the means of squares of `number` x `number` pixels.

        What the last rows and columns lack of a square is cut off.
        """
        height, width = self.height // number, self.width // number
        return self.crop(0, 0, number * height, number * width).resize(height, width)

    def _scaled(
        self, height: int, width: int, scale: tuple[float, ...], origin: tuple[float, ...]
    ) -> "CameraIntrinsics":
        """Return the camera in pixels (u - origin) scale."""
        (fx, skew, cx), (_, fy, cy), last = self.matrix
        (sx, sy), (u, v) = scale, origin
        matrix = ((sx * fx, sx * skew, sx * (cx - u)), (0.0, sy * fy, sy * (cy - v)), last)
        return CameraIntrinsics(
            width=width, height=height, matrix=matrix, distortion=self.distortion
        )

    def matrix_tensor(self) -> Tensor:
        """Return the pinhole matrix, shape (3, 3), float64."""
        return torch.tensor(self.matrix, dtype=torch.float64)


def _bounded(size: _SizeT) -> _SizeT:
    if size.width * size.height > _MOST_PIXELS:
        given = f"an image of {size.width} x {size.height} pixels is larger than any that is read"
        raise ValueError(f"{given} here: at most {_MOST_PIXELS} pixels")
    return size


Camera = Annotated[CameraIntrinsics, AfterValidator(_bounded)]
"""A camera in a file: of bounded size."""


class CameraSection(OpenOptions):
    """The section `camera` of `recording.yaml`."""

    width: Size
    height: Size
    K: PinholeMatrix
    distortion: Distortion

    @model_validator(mode="after")
    def _of_bounded_size(self) -> Self:
        return _bounded(self)

    def intrinsics(self) -> CameraIntrinsics:
        """Return the camera for the functions of `tofcorr.geometry`."""
        return CameraIntrinsics(
            width=self.width, height=self.height, matrix=self.K, distortion=self.distortion
        )


def _printable(name: str) -> str:
    if not name.isprintable() or name != name.strip():
        raise ValueError("a frame's name is one line of text without spaces around it")
    return name


FrameName = Annotated[str, Field(min_length=1, max_length=200), AfterValidator(_printable)]


class FrameNames(Options):
    """What the robot calls its coordinate frames; for reports and exports.

    Attributes:
        world: The frame of the planes: the robot's base, or, for a camera that stands still, the
            tool that carries the target.
        tool: The frame that carries the camera: the tool, or, for a camera that stands still, the
            base.
        camera: The camera's optical frame.
        eye_to_hand: Whether the camera stands still and the robot carries the target.
    """

    world: FrameName = "world"
    tool: FrameName = "tool"
    camera: FrameName = "camera"
    eye_to_hand: bool = False
