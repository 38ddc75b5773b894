"""A calibration as numbers: from which training is resumed, and every format exported."""

import io
import pickle
from dataclasses import asdict, dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from tofcorr.correction.hand_eye import HandEye
from tofcorr.correction.hand_eye_accuracy import HandEyeAccuracy
from tofcorr.correction.model import CalibrationModel
from tofcorr.correction.state_file import DepthKind, StateEntry
from tofcorr.error_terms.domain import Domain
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.error_terms.residual import ResidualNetwork, ResidualNetworkOptions
from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.files.seal import refuse_damaged, sealed
from tofcorr.files.staged import staged_file
from tofcorr.geometry.camera import CameraIntrinsics, FrameNames
from tofcorr.options.messages import one_line

STATE_FILE = "state.pt"
"""Its name in a run folder."""

_FORMAT, _VERSION = "tofcorr-state", 1
_WHAT = "a calibration that tofcorr train wrote"
UNREADABLE = (OSError, RuntimeError, EOFError, pickle.UnpicklingError)
UNREADABLE += (ValueError, LookupError, TypeError, AttributeError)
"""What torch.load raises on a file that it cannot read; a damaged pickle adds the last ones."""
# Entries of the file that are fields of the state as they stand.
_AS_THEY_STAND = (
    *("name", "error_model", "coefficients", "tool_from_camera", "hand_eye_estimated"),
    *("depth_kind", "saturation_amplitude", "fixed_pattern", "covariance", "noise", "frames"),
)


@dataclass(frozen=True, kw_only=True)
class ResidualState:
    """A trained residual network.

    Attributes:
        options: Its size and bound.
        weights: `ResidualNetwork.weight_vector`, float64.
    """

    options: ResidualNetworkOptions
    weights: Tensor

    def network(self, domain: Domain) -> ResidualNetwork:
        """Build the network."""
        network = ResidualNetwork(self.options, domain)
        network.set_weight_vector(self.weights)
        return network


@dataclass(frozen=True, kw_only=True)
class CalibrationState:
    """Everything that a calibration found, and the ranges and camera it is valid for.

    Attributes:
        name: The model's name, for example EA.
        error_model: Its terms.
        domain: Image size and the calibrated ranges, which also scale the variables.
        coefficients: `ErrorModel.coefficient_vector`, shape (K,), float64.
        tool_from_camera: The hand-eye transform, shape (4, 4), float64, metres.
        hand_eye_estimated: Whether it was estimated, or known beforehand.
        camera: The lateral parameters.
        depth_kind: What the camera's depth means: along the ray, or along the optical axis.
        saturation_amplitude: Pixels at or above it are not valid; None if unknown.
        fixed_pattern: One offset a pixel, shape (H, W), float64, metres; None without that term.
        residual: The residual network; None if there is none.
        covariance: Of `coefficients`, shape (K, K), float64, square metres; None if unknown.
        noise: a, b, c of the variance a + b / A + c / A^2 of a measured distance at amplitude A,
            metres and the camera's units; None if unknown.
        frames: What the robot calls the coordinate frames.
        hand_eye_accuracy: Standard errors of `tool_from_camera`; None if unknown.
    """

    name: str
    error_model: ErrorModelOptions
    domain: Domain
    coefficients: Tensor
    tool_from_camera: Tensor
    hand_eye_estimated: bool
    camera: CameraIntrinsics
    depth_kind: DepthKind
    saturation_amplitude: float | None = None
    fixed_pattern: Tensor | None = None
    residual: ResidualState | None = None
    covariance: Tensor | None = None
    noise: tuple[float, float, float] | None = None
    frames: FrameNames = field(default_factory=FrameNames)
    hand_eye_accuracy: HandEyeAccuracy | None = None

    def model(self) -> CalibrationModel:
        """Build the float64 model with these coefficients."""
        error = ErrorModel(self.error_model, self.domain)
        error.set_coefficient_vector(self.coefficients)
        if error.fixed_pattern is not None and self.fixed_pattern is not None:
            error.fixed_pattern.offset.copy_(self.fixed_pattern)
        if self.residual is not None:
            error.residual = self.residual.network(self.domain)
        return CalibrationModel(
            error, HandEye(self.tool_from_camera, fixed=not self.hand_eye_estimated)
        )


def save_calibration(path: Path | str, state: CalibrationState) -> None:
    """Write a calibration, whole or not at all; an older one in its place is replaced.

    Raises:
        CalibrationDataError: The file cannot be written.
    """
    path = Path(path)
    values = asdict(state) | {
        "format": _FORMAT,
        "version": _VERSION,
        "error_model": state.error_model.to_mapping(),
        "domain": asdict(state.domain),
        "coefficients": state.coefficients.detach().cpu().clone(),
        "tool_from_camera": state.tool_from_camera.detach().cpu().clone(),
        "residual": None,
        "frames": state.frames.to_mapping(),
    }
    if state.residual is not None:
        values["residual"] = {
            "options": state.residual.options.to_mapping(),
            "weights": state.residual.weights.detach().cpu().clone(),
        }
    # Named tuples would need a class to be read back: plain tuples do not.
    values["domain"] = {
        key: tuple(value) if isinstance(value, tuple) else value
        for key, value in values["domain"].items()
    }
    content = io.BytesIO()
    torch.save(values, content)
    with staged_file(path, CalibrationDataError) as part:
        part.write_bytes(sealed(content))


def load_calibration(path: Path | str) -> CalibrationState:
    """Read a calibration that `save_calibration` wrote.

    Raises:
        CalibrationDataError: There is no such file, or it is not a calibration.
    """
    path = Path(path)
    if not path.is_file():
        raise CalibrationDataError(
            f"{path}: there is no such file; a run folder of tofcorr train holds it."
        )
    refuse_damaged(path, _WHAT)
    try:
        values = torch.load(path, map_location="cpu", weights_only=True)
    except UNREADABLE:
        values = None
    if not isinstance(values, dict) or str(values.get("format")) != _FORMAT:
        raise CalibrationDataError(f"{path}: is not {_WHAT}.")
    version = one_line(str(values.get("version")))
    if version != str(_VERSION):
        raise CalibrationDataError(
            f"{path}: has version {version}, this package reads version {_VERSION}."
        )
    try:
        return _state(StateEntry.from_mapping(values, str(path)), path)
    except ConfigError as error:
        raise CalibrationDataError(str(error)) from None


def _state(entry: StateEntry, path: Path) -> CalibrationState:
    residual, accuracy = entry.residual, entry.hand_eye_accuracy
    state = CalibrationState(
        **{name: getattr(entry, name) for name in _AS_THEY_STAND},
        domain=entry.domain.domain(),
        camera=entry.camera.intrinsics(),
        residual=residual and ResidualState(options=residual.options, weights=residual.weights),
        hand_eye_accuracy=accuracy and accuracy.accuracy(),
    )
    _refuse_other_numbers(state, path)
    try:
        state.model()
    except ValueError as error:  # No rotation, for example.
        raise CalibrationDataError(f"{path}: {error}") from None
    return state


def _refuse_other_numbers(state: CalibrationState, path: Path) -> None:
    """Refuse more or fewer numbers than the terms have, which only the terms know."""
    try:
        model = ErrorModel(state.error_model, state.domain)
    except CalibrationDataError as error:
        raise CalibrationDataError(f"{path}: {error}") from None
    pattern, residual = model.fixed_pattern, state.residual
    network = None if residual is None else ResidualNetwork(residual.options, state.domain)
    own = {
        "coefficients": len(model.coefficient_vector()),
        "fixed_pattern": 0 if pattern is None else pattern.offset.numel(),
        "residual": 0 if network is None else len(network.weight_vector()),
    }
    stored = {"coefficients": state.coefficients, "fixed_pattern": state.fixed_pattern}
    stored["residual"] = None if residual is None else residual.weights
    for name, values in stored.items():
        found = 0 if values is None else values.numel()
        if found != own[name]:
            raise CalibrationDataError(
                f"{path}: '{name}' has {found} numbers; the terms that it names need {own[name]}."
            )
