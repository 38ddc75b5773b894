"""A calibration as numbers: from which training is resumed, and every format exported."""

import io
import math
import platform
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Self

import torch
from pydantic import AfterValidator, ConfigDict, InstanceOf, model_validator
from torch import Tensor

from tofcorr.conditions import CONDITIONS
from tofcorr.correction.model import CalibrationModel, FrameCorrection, HandEye
from tofcorr.error_terms.base import Domain, Interval
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.error_terms.residual import ResidualNetwork, ResidualNetworkOptions
from tofcorr.errors import CalibrationDataError, Kind
from tofcorr.files import UNREADABLE, open_regular, refuse_damaged, sealed, staged_file
from tofcorr.geometry.camera import Camera, DepthKind, FrameNames
from tofcorr.options import (
    LARGEST_NUMBER,
    FiniteNumber,
    Number,
    Options,
    PositiveNumber,
    one_line,
    refused_in_words,
)
from tofcorr.scene_light.bounces import SecondBounces, SecondBouncesState
from tofcorr.scene_light.flying import FlyingPixels, FlyingPixelsState
from tofcorr.scene_light.remainder import Remainder, RemainderOptions
from tofcorr.scene_light.stray import StrayLight, StrayLightState
from tofcorr.version import __version__

STATE_FILE = "state.pt"
"""Its name in a run folder."""

_FORMAT = "tofcorr-state"
_EMBEDDED = "/calibration.pt"
"""How the archive of a program calls the calibration that it holds; once it was below `extra`."""
_WHAT = "a calibration that tofcorr train wrote"

_Three = tuple[FiniteNumber, FiniteNumber, FiniteNumber]


def _float64(values: Tensor) -> Tensor:
    if values.dtype != torch.float64 or values.layout != torch.strided:
        raise ValueError(f"expected a dense tensor of float64, got {values.dtype}")
    if not bool(values.isfinite().all()):
        raise ValueError("expected finite numbers")
    if bool((values.abs() > LARGEST_NUMBER).any()):
        raise ValueError(f"expected numbers of at most {LARGEST_NUMBER:g}")
    return values.detach().cpu().clone()


Float64 = Annotated[InstanceOf[Tensor], AfterValidator(_float64)]
"""Finite numbers, kept as a copy on the CPU."""


class HandEyeAccuracy(Options):
    """Standard errors of a hand-eye transform, and what the recording does not determine of it.

    Attributes:
        translation_se_mm: Along the axes of the frame that carries the camera, millimetres.
        rotation_se_deg: About the same axes, degrees.
        undetermined: Combinations of unknowns that the images do not determine, such as `t_z`. A
            prior was used for them, and the standard errors do not include them.
    """

    translation_se_mm: _Three
    rotation_se_deg: _Three
    undetermined: tuple[str, ...] = ()


class ResidualState(Options):
    """A trained residual network.

    Attributes:
        options: Its size and bound.
        weights: `ResidualNetwork.weight_vector`, float64.
    """

    options: ResidualNetworkOptions
    weights: Float64

    def network(self, domain: Domain) -> ResidualNetwork:
        """Build the network."""
        network = ResidualNetwork(self.options, domain)
        network.set_weight_vector(self.weights)
        return network


class RemainderState(Options):
    """A network of what the removal of second bounces leaves.

    Attributes:
        options: How it was trained.
        left_mm: On drawn scenes held out, without and with the network, RMS in millimetres.
        flat_mm: The same without what moves the plane of each surface.
        numbers: `Remainder.numbers`, float64.
    """

    options: RemainderOptions
    left_mm: tuple[Number, Number]
    flat_mm: tuple[Number, Number]
    numbers: Float64

    def to_mapping(self) -> dict[str, Any]:
        """Return the rest without the numbers."""
        return self.model_dump(mode="json", exclude={"numbers"})


class SceneLight(Options):
    """What a corrector removes of a frame besides the error of each pixel.

    Attributes:
        stray_light: Light that lens and sensor send to the wrong pixel, taken back before anything
            else; None: it is left.
        flying_pixels: Pixels that mix two surfaces; None: they are not looked for.
        second_bounces: Light that comes by further surfaces; None: it is left in.
    """

    stray_light: StrayLightState | None = None
    second_bounces: SecondBouncesState | None = None
    flying_pixels: FlyingPixelsState | None = None


class CalibrationExtras(Options):
    """What a calibration knows beside its error model; older files lack most of it.

    Attributes:
        covariance: Of the coefficients, shape (K, K), float64, square metres; None if unknown.
        noise: a, b, c of the variance a + b / A + c / A^2 of a measured distance at amplitude A,
            metres and the camera's units; None if unknown.
        frames: What the robot calls the coordinate frames.
        hand_eye_accuracy: Standard errors of the hand-eye transform; None if unknown.
        joint_covariance: Of a step of the hand-eye transform (camera axes, if it was estimated) and
            the coefficients together, shape (P, P), float64, square metres and radians; None if
            unknown.
        residual_variance: Effective variance of a residual, in the unit of the loss; None if
            unknown.
        scene: What of the scene's light is removed from every frame.
        remainder: A network of what the removal of second bounces leaves; None: that stays.
    """

    covariance: Float64 | None = None
    noise: _Three | None = None
    frames: FrameNames = FrameNames()
    hand_eye_accuracy: HandEyeAccuracy | None = None
    joint_covariance: Float64 | None = None
    residual_variance: PositiveNumber | None = None
    scene: SceneLight = SceneLight()
    remainder: RemainderState | None = None

    def scene_mapping(self) -> dict[str, Any]:
        """Return what is removed of the scene's light, ready for YAML or JSON."""
        learned = {} if self.remainder is None else {"learned": self.remainder.to_mapping()}
        return self.scene.to_mapping() | learned

    def extras(self) -> "CalibrationExtras":
        """Return these alone."""
        own = {name: getattr(self, name) for name in CalibrationExtras.model_fields}
        return CalibrationExtras(**own)


class Setting(Options):
    """The camera that a correction is for, and what it is valid for.

    Attributes:
        camera: The lateral parameters.
        depth_kind: What the camera's depth means: along the ray, or along the optical axis.
        domain: Image size and the calibrated ranges, which also scale the variables.
        saturation_amplitude: Pixels at or above it are not valid; None if unknown.
        hand_eye_estimated: Whether the hand-eye transform was estimated, or known beforehand.
    """

    camera: Camera
    depth_kind: DepthKind
    domain: Domain
    saturation_amplitude: PositiveNumber | None = None
    hand_eye_estimated: bool


class CalibrationState(CalibrationExtras, Setting):
    """Everything that a calibration found, and the ranges and camera it is valid for.

    Attributes:
        name: The model's name, for example EA.
        error_model: Its terms.
        coefficients: `ErrorModel.coefficient_vector`, shape (K,), float64.
        tool_from_camera: The hand-eye transform, shape (4, 4), float64, metres.
        fixed_pattern: One offset a pixel, shape (H, W), float64, metres; None without that term.
        residual: The residual network; None if there is none.
    """

    model_config = ConfigDict(protected_namespaces=())

    name: str
    error_model: ErrorModelOptions
    coefficients: Float64
    tool_from_camera: Float64
    fixed_pattern: Float64 | None = None
    residual: ResidualState | None = None

    @model_validator(mode="after")
    def _numbers_fit(self) -> Self:
        """Refuse more or fewer numbers than the terms have, and a transform that is not rigid."""
        size = (self.domain.height, self.domain.width)
        if (self.camera.height, self.camera.width) != size:
            raise ValueError("'camera' and 'domain' disagree on the size of the image")
        model, residual = ErrorModel(self.error_model, self.domain), self.residual
        number = len(model.symbols())
        network = residual and ResidualNetwork(residual.options, self.domain)
        joint, both = self.joint_covariance, number + 6 * self.hand_eye_estimated
        for name, values, shape in (
            ("coefficients", self.coefficients, (number,)),
            ("tool_from_camera", self.tool_from_camera, (4, 4)),
            ("covariance", self.covariance, self.covariance is not None and (number, number)),
            ("joint_covariance", joint, joint is not None and (both, both)),
            ("fixed_pattern", self.fixed_pattern, model.fixed_pattern is not None and size),
            ("residual", residual and residual.weights, network and network.weight_vector().shape),
        ):
            found = None if values is None else tuple(values.shape)
            if found != (shape or None):
                raise ValueError(f"'{name}': expected shape {shape or None}, got {found}")
        HandEye(self.tool_from_camera)
        return self

    @classmethod
    def of(cls, error: ErrorModel, **known: Any) -> Self:  # noqa: ANN401 - the other fields
        """Return the numbers of an error model as a calibration, beside what else is known.

        An untrained network adds nothing, and is left out: not every format can hold a network.
        """
        pattern, network = error.fixed_pattern, error.residual
        residual = None
        if network is not None and bool(network.weights.any()):
            weights = network.weight_vector().double()
            residual = ResidualState(options=network.options, weights=weights)
        return cls(
            coefficients=error.coefficient_vector().double(),
            fixed_pattern=None if pattern is None else pattern.offset.double(),
            residual=residual,
            **known,
        )

    def model(self) -> CalibrationModel:
        """Build the float64 model with these coefficients."""
        error = ErrorModel(self.error_model, self.domain)
        error.set_coefficient_vector(self.coefficients)
        if error.fixed_pattern is not None and self.fixed_pattern is not None:
            error.fixed_pattern.offset.copy_(self.fixed_pattern)
        if self.residual is not None:
            error.residual = self.residual.network(self.domain)
        hand_eye = HandEye(self.tool_from_camera, fixed=not self.hand_eye_estimated)
        return CalibrationModel(error, hand_eye)

    def correction(self) -> FrameCorrection:
        """Build the correction in float64: the reference of the runtime and of every export."""
        model = self.model()
        of_frames = (model.error, model.hand_eye, self.domain, self.saturation_amplitude)
        return FrameCorrection(self.camera, self.depth_kind, *of_frames)

    @torch.no_grad()
    def corrected(self, depth: Tensor, amplitude: Tensor) -> tuple[Tensor, Tensor]:
        """Correct frames (..., H, W) in float64: return corrected depth and where it is valid."""
        reference, frames = self.correction(), (depth.double(), amplitude.double())
        flying, stray = self.flying_pixels(), self.stray_light()
        bounces, scale = self.second_bounces(), reference.geometry.radial_of_depth
        if stray is not None:
            radial, light = stray.double()(frames[0] * scale, frames[1])
            frames = radial / scale, light
        corrected, valid = reference(*frames), reference.valid(*frames)
        if bounces is not None:
            corrected = bounces.double()(corrected * scale, frames[1]) / scale
        if flying is None:
            return corrected, valid
        return flying.double()(corrected, frames[1], valid)

    def stray_light(self) -> StrayLight | None:
        """Build what takes stray light back; None: it is left."""
        wanted = self.scene.stray_light
        return wanted and StrayLight(self.camera, wanted)

    def second_bounces(self) -> SecondBounces | None:
        """Build what removes second bounces of light; None: it is not asked for."""
        wanted, learned = self.scene.second_bounces, self.remainder
        if wanted is None:
            return None
        bounces = SecondBounces(self.camera, wanted)
        if learned is not None:
            bounces.remainder = Remainder(bounces.rows, learned.options.width)
            bounces.remainder.set_numbers(learned.numbers)
        return bounces

    def flying_pixels(self) -> FlyingPixels | None:
        """Build what finds flying pixels; None: it is not asked for."""
        wanted = self.scene.flying_pixels
        return wanted and FlyingPixels(self.camera, self.depth_kind, wanted)


def corrector_metadata(state: CalibrationState) -> dict[str, object]:
    """Return camera, model, validity range and versions, ready for JSON."""
    error = state.model().error
    limits = error.limits(state.domain)
    return {
        "format": "tofcorr-corrector",
        "version": 1,
        "model": state.name,
        "terms": state.error_model.to_mapping()["terms"],
        "residual_network": state.residual and state.residual.options.to_mapping(),
        "symbols": error.symbols(),
        "coefficients": state.coefficients.tolist(),
        "needs_amplitude": error.needs_amplitude() or state.scene != SceneLight(),
        "scene": state.scene_mapping(),
        "sign": "error = measured - true; corrected = measured - error",
        "depth_kind": state.depth_kind,
        "camera": state.camera.section(),
        "validity": {
            "radial_distance_m": list(limits.radial_distance),
            "amplitude": _finite(limits.amplitude),
            "normalised_amplitude": _finite(limits.normalised_amplitude),
            "saturation_amplitude": state.saturation_amplitude,
            "conditions": {name: list(known) for name, known in state.domain.conditions.items()},
        },
        "conditions_assumed": dict(zip(CONDITIONS, state.domain.mean_conditions(), strict=True)),
        "tool_from_camera": state.tool_from_camera.tolist(),
        "versions": {
            "tofcorr": __version__,
            "torch": str(torch.__version__),
            "python": platform.python_version(),
        },
    }


def _finite(interval: Interval | None) -> list[float] | None:
    """Return the interval, or None for one without ends."""
    return list(interval) if interval and all(map(math.isfinite, interval)) else None


def save_calibration(path: Path | str, state: CalibrationState) -> None:
    """Write a calibration, whole or not at all; an older one in its place is replaced.

    Raises:
        CalibrationDataError: The file cannot be written.
    """
    save_values(path, _FORMAT, state.model_dump(), CalibrationDataError)


def load_calibration(path: Path | str, content: bytes | None = None) -> CalibrationState:
    """Read a calibration that `save_calibration` wrote.

    Args:
        path: The file.
        content: Of the calibration, if it stands inside the file.

    Raises:
        CalibrationDataError: There is no such file, or it is not a calibration.
    """
    path = Path(path)
    refuse_damaged(path, _WHAT, content)
    values = read_values(path, _FORMAT, content)
    if values is None:
        raise CalibrationDataError(f"{path}: is not {_WHAT}.")
    with refused_in_words(CalibrationState, str(path), CalibrationDataError):
        return CalibrationState.model_validate(values)


def _tensors(values: object) -> Iterator[Tensor]:
    """Yield the dense tensors of plain values, nested as they are."""
    if isinstance(values, Tensor) and values.layout == torch.strided:
        yield values
    elif isinstance(values, Mapping | list | tuple):
        for value in values.values() if isinstance(values, Mapping) else values:
            yield from _tensors(value)


def values_of(form: str, values: dict[str, Any]) -> bytes:
    """Return plain values and tensors as the sealed content of a file for `read_values`."""
    content = io.BytesIO()
    torch.save({"format": form, "version": 1, **values}, content)
    return sealed(content)


def with_calibration(archive: io.BytesIO, state: CalibrationState) -> bytes:
    """Return the archive of a program, sealed, with the calibration from which it can be rebuilt.

    It stands beside the code; `held_calibration` reads it and runs none.
    """
    with zipfile.ZipFile(archive, "a") as file:
        root = file.namelist()[0].partition("/")[0]
        # Of the earliest date that zip knows, as the seal.
        file.writestr(
            zipfile.ZipInfo(f"{root}/tofcorr{_EMBEDDED}"), values_of(_FORMAT, state.model_dump())
        )
    return sealed(archive)


def held_calibration(path: Path) -> CalibrationState | None:
    """Return the calibration that a program holds, or that stands beside it in a run folder.

    Raises:
        CalibrationDataError: It is damaged.
    """
    with zipfile.ZipFile(path) as archive:
        inside = [archive.read(name) for name in archive.namelist() if name.endswith(_EMBEDDED)]
    if inside:
        return load_calibration(path, inside[0])
    beside = path.with_name(STATE_FILE)
    return load_calibration(beside) if beside.exists() else None


def save_values(path: Path | str, form: str, values: dict[str, Any], kind: Kind) -> None:
    """Write plain values and tensors for `read_values`, whole or not at all.

    Raises:
        TofcorrError: Of kind `kind`: the file cannot be written.
    """
    with staged_file(path, kind) as part:
        part.write_bytes(values_of(form, values))


def read_values(path: Path, form: str, content: bytes | None = None) -> dict[str, Any] | None:
    """Return the values of a file that `save_values` wrote; None: of another format.

    No code of the file is run, and no tensor is larger than its numbers in the file.

    Raises:
        CalibrationDataError: It has another version.
    """
    try:
        with open_regular(path) if content is None else io.BytesIO(content) as file:
            values = torch.load(file, map_location="cpu", weights_only=True)
        expanded = any(one.nbytes > one.untyped_storage().nbytes() for one in _tensors(values))
    except UNREADABLE:
        return None
    if expanded or not isinstance(values, dict) or str(values.get("format")) != form:
        return None
    found = one_line(str(values.get("version")))
    if found != "1":
        raise CalibrationDataError(f"{path}: has version {found}, this package reads 1.")
    return {key: value for key, value in values.items() if key not in ("format", "version")}
