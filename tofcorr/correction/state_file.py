"""What a file of a calibration must hold: keys, types, shapes and ranges."""

from typing import Annotated, Any, Literal, Self

import torch
from pydantic import AfterValidator, ConfigDict, Field, InstanceOf, field_validator, model_validator
from torch import Tensor

from tofcorr.conditions import CONDITIONS
from tofcorr.correction.hand_eye_accuracy import HandEyeAccuracy
from tofcorr.error_terms.domain import Domain, Interval
from tofcorr.error_terms.model import ErrorModelOptions
from tofcorr.error_terms.residual import ResidualNetworkOptions
from tofcorr.geometry.camera import (
    CameraIntrinsics,
    Distortion,
    FrameNames,
    ImageSize,
    PinholeMatrix,
)
from tofcorr.options import Options
from tofcorr.options.numbers import LARGEST_NUMBER, FiniteNumber, PositiveNumber

DepthKind = Literal["radial", "z"]
_Three = tuple[FiniteNumber, FiniteNumber, FiniteNumber]


def _ordered(ends: tuple[float, float]) -> tuple[float, float]:
    if ends[0] > ends[1]:
        raise ValueError("the first end of a range is the lower one")
    return ends


_Range = Annotated[tuple[FiniteNumber, FiniteNumber], AfterValidator(_ordered)]


def _float64(values: Tensor) -> Tensor:
    if values.dtype != torch.float64 or values.layout != torch.strided:
        raise ValueError(f"expected a dense tensor of float64, got {values.dtype}")
    if not bool(values.isfinite().all()):
        raise ValueError("expected finite numbers")
    if values.numel() and float(values.abs().max()) > LARGEST_NUMBER:
        raise ValueError(f"expected numbers of at most {LARGEST_NUMBER:g}")
    return values


Float64 = Annotated[InstanceOf[Tensor], AfterValidator(_float64)]


class CameraEntry(ImageSize):
    """The lateral parameters."""

    matrix: PinholeMatrix
    distortion: Distortion = ()

    def intrinsics(self) -> CameraIntrinsics:
        """Return the camera."""
        return CameraIntrinsics(
            width=self.width, height=self.height, matrix=self.matrix, distortion=self.distortion
        )


class DomainEntry(ImageSize):
    """Image size and calibrated ranges."""

    radial_distance: _Range
    amplitude: _Range | None = None
    normalised_amplitude: _Range | None = None
    modulation_frequency: PositiveNumber | None = None
    conditions: dict[str, _Three] = Field(default_factory=dict)

    @field_validator("conditions")
    @classmethod
    def _known(cls, given: dict[str, _Three]) -> dict[str, _Three]:
        for name in given:
            if name not in CONDITIONS:
                raise ValueError(f"'{name}' is no condition; known: {', '.join(CONDITIONS)}")
        return given

    def domain(self) -> Domain:
        """Return the ranges."""
        return Domain(
            height=self.height,
            width=self.width,
            radial_distance=Interval(*self.radial_distance),
            amplitude=_interval(self.amplitude),
            normalised_amplitude=_interval(self.normalised_amplitude),
            modulation_frequency=self.modulation_frequency,
            conditions=self.conditions,
        )


class AccuracyEntry(Options):
    """Standard errors of the hand-eye transform."""

    translation_se_mm: _Three
    rotation_se_deg: _Three
    undetermined: tuple[str, ...] = ()

    def accuracy(self) -> HandEyeAccuracy:
        """Return the standard errors."""
        return HandEyeAccuracy(
            translation_se_mm=self.translation_se_mm,
            rotation_se_deg=self.rotation_se_deg,
            undetermined=self.undetermined,
        )


class ResidualEntry(Options):
    """A trained residual network."""

    options: ResidualNetworkOptions
    weights: Float64


class ExtraEntry(Options):
    """What a calibration knows beyond what its output depends on; older files lack most of it.

    Attributes:
        covariance: Shape (K, K).
        noise: Of a measured distance.
        frames: Names of the coordinate frames.
        hand_eye_accuracy: Standard errors.
    """

    covariance: Float64 | None = None
    noise: _Three | None = None
    frames: FrameNames = FrameNames()
    hand_eye_accuracy: AccuracyEntry | None = None

    @field_validator("covariance")
    @classmethod
    def _square(cls, given: Tensor | None) -> Tensor | None:
        if given is not None and (given.dim() != 2 or given.shape[0] != given.shape[1]):
            raise ValueError(f"expected shape (K, K), got {tuple(given.shape)}")
        return given


class StateEntry(ExtraEntry):
    """The whole file; attributes as in `CalibrationState`."""

    model_config = ConfigDict(protected_namespaces=())

    format: Literal["tofcorr-state"]
    version: Literal[1]
    name: str
    error_model: ErrorModelOptions
    domain: DomainEntry
    coefficients: Float64
    tool_from_camera: Float64
    hand_eye_estimated: bool
    camera: CameraEntry
    depth_kind: DepthKind
    saturation_amplitude: PositiveNumber | None = None
    fixed_pattern: Float64 | None = None
    residual: ResidualEntry | None = None

    @model_validator(mode="after")
    def _shapes_agree(self) -> Self:
        size = (self.domain.height, self.domain.width)
        if (self.camera.height, self.camera.width) != size:
            raise ValueError("'camera' and 'domain' disagree on the size of the image")
        number = self.coefficients.numel()
        wanted: dict[str, tuple[Any, tuple[int, ...]]] = {
            "coefficients": (self.coefficients, (number,)),
            "tool_from_camera": (self.tool_from_camera, (4, 4)),
            "covariance": (self.covariance, (number, number)),
            "fixed_pattern": (self.fixed_pattern, size),
        }
        for name, (values, shape) in wanted.items():
            if values is not None and tuple(values.shape) != shape:
                raise ValueError(f"'{name}': expected shape {shape}, got {tuple(values.shape)}")
        return self


def _interval(ends: tuple[float, float] | None) -> Interval | None:
    return None if ends is None else Interval(*ends)
