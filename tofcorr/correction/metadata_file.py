"""What the metadata of a corrector or a look-up table must hold to be used."""

from typing import Annotated, Literal

from pydantic import BeforeValidator, ConfigDict

from tofcorr.correction.state_file import DepthKind
from tofcorr.geometry.camera import Distortion, PinholeMatrix
from tofcorr.options import Options
from tofcorr.options.numbers import FiniteNumber, PositiveNumber, Size, not_a_truth_value

_Range = tuple[FiniteNumber, FiniteNumber]


class ValidityMetadata(Options):
    """The calibrated ranges; a program may add keys."""

    model_config = ConfigDict(extra="ignore")

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


class CameraMetadata(Options):
    """The camera that a corrector was made for; what it does not say is not compared."""

    model_config = ConfigDict(extra="ignore")

    width: Size | None = None
    height: Size | None = None
    K: PinholeMatrix | None = None
    distortion: Distortion | None = None


class CorrectorMetadata(Options):
    """What is read of a corrector's metadata; the rest is for people."""

    model_config = ConfigDict(extra="ignore")

    needs_amplitude: bool = True
    depth_kind: DepthKind | None = None
    camera: CameraMetadata = CameraMetadata()


class LutMetadata(CorrectorMetadata):
    """What is read of a look-up table's metadata."""

    validity: ValidityMetadata
    lut: LutMark
