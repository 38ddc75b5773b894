"""What a corrector says of itself, as JSON in every exported file; and a corrector read back."""

import json
import math
import platform
import warnings
from pathlib import Path
from typing import Annotated, Literal

import torch
from pydantic import BeforeValidator, ConfigDict
from torch.jit import ScriptModule

from tofcorr.conditions import CONDITIONS
from tofcorr.correction.state import CalibrationState
from tofcorr.error_terms.domain import Interval
from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.files import refuse_damaged
from tofcorr.geometry.camera import DepthKind, Distortion, PinholeMatrix
from tofcorr.options import FiniteNumber, Options, PositiveNumber, Size, not_a_truth_value
from tofcorr.version import __version__

_WHAT = "the corrector.ts of a run"
_Range = tuple[FiniteNumber, FiniteNumber]


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
        "needs_amplitude": error.needs_amplitude(),
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


def load_corrector(path: Path) -> tuple[ScriptModule, CorrectorMetadata]:
    """Load a corrector for the CPU, and what it says of itself.

    Raises:
        CalibrationDataError: The file is missing, damaged, or no corrector.
    """
    refuse_damaged(path, _WHAT)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            corrector = torch.jit.load(str(path), map_location="cpu").eval()
    except (RuntimeError, ValueError, OSError, EOFError):
        raise CalibrationDataError(f"{path}: not a TorchScript module; expected {_WHAT}.") from None
    try:
        metadata = json.loads(corrector.metadata())
    except (AttributeError, TypeError, ValueError, RuntimeError, RecursionError):
        metadata = None
    if not isinstance(metadata, dict):
        raise CalibrationDataError(
            f"{path}: a TorchScript module, but without a corrector's metadata; expected {_WHAT}."
        )
    try:
        return corrector, CorrectorMetadata.from_mapping(metadata, f"{path}, metadata")
    except ConfigError as error:
        raise CalibrationDataError(str(error)) from None
