"""What is read of what a corrector says of itself in JSON."""

from typing import Annotated, Literal

from pydantic import BeforeValidator

from tofcorr.geometry.camera import DepthKind, Distortion, PinholeMatrix
from tofcorr.options import (
    FiniteNumber,
    OpenOptions,
    Options,
    PositiveNumber,
    Size,
    not_a_truth_value,
)

_Range = tuple[FiniteNumber, FiniteNumber]


class ValidityMetadata(OpenOptions):
    """The calibrated ranges; a program may add keys."""

    radial_distance_m: _Range
    amplitude: _Range | None = None
    normalised_amplitude: _Range | None = None
    saturation_amplitude: PositiveNumber | None = None


class LutMark(Options):
    """What a look-up table says of itself.

    Attributes:
        format: Always the same.
        version: Of the format.
        sha256: Digest of its arrays; files of older versions have none.
    """

    format: Literal["tofcorr-lut"]
    version: Annotated[Literal[1], BeforeValidator(not_a_truth_value)]
    sha256: str | None = None


class CameraMetadata(OpenOptions):
    """The camera that a corrector was made for; what it does not say is not compared."""

    width: Size | None = None
    height: Size | None = None
    K: PinholeMatrix | None = None
    distortion: Distortion | None = None


class CorrectorMetadata(OpenOptions):
    """What is read of a corrector's metadata; the rest is for people."""

    needs_amplitude: bool = True
    depth_kind: DepthKind | None = None
    camera: CameraMetadata = CameraMetadata()


class LutMetadata(CorrectorMetadata):
    """What is read of a look-up table's metadata."""

    validity: ValidityMetadata
    lut: LutMark
