"""A corrector read back, and what is read of what it says of itself in JSON."""

import json
import warnings
import zipfile
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from pydantic import BeforeValidator
from torch import nn

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.state import STATE_FILE, load_calibration
from tofcorr.errors import CalibrationDataError
from tofcorr.files import refuse_damaged
from tofcorr.geometry.camera import DepthKind, Distortion, PinholeMatrix
from tofcorr.options import (
    FiniteNumber,
    OpenOptions,
    Options,
    PositiveNumber,
    Size,
    not_a_truth_value,
)

_WHAT = "the corrector.ts of a run"
EMBEDDED = "calibration.pt"
"""What a TorchScript file calls the calibration that it holds, among its extra files."""
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


def load_corrector(path: Path, *, trusted: bool = False) -> tuple[nn.Module, CorrectorMetadata]:
    """Load a corrector for the CPU, and what it says of itself.

    A TorchScript file is a program: torch runs what stands in it as soon as it is loaded. It is
    built anew here from the calibration that the file holds beside its code, or that stands beside
    the file in the folder of a run.

    Args:
        path: The file.
        trusted: Whether the code of a file that holds no calibration may be run.

    Raises:
        CalibrationDataError: The file is missing, damaged, or no corrector; or it holds code alone
            and is not trusted.
    """
    refuse_damaged(path, _WHAT)
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
        inside = [archive.read(name) for name in names if name.endswith(f"/extra/{EMBEDDED}")]
    if inside:
        corrector: Any = DepthCorrector.from_state(load_calibration(path, inside[0]))
    elif path.with_name(STATE_FILE).exists():
        corrector = DepthCorrector.from_state(load_calibration(path.with_name(STATE_FILE)))
    elif trusted or not any("/code/" in name for name in names):
        corrector = _run(path)
    else:
        raise CalibrationDataError(
            f"{path}: holds a program and no calibration, as files of version 0.1 and of other "
            "programs do; loading it would run it. Export the run again, or say --trust-model if "
            "you know who wrote it."
        )
    try:
        metadata = json.loads(corrector.metadata())
    except (AttributeError, TypeError, ValueError, RuntimeError, RecursionError):
        metadata = None
    if not isinstance(metadata, dict):
        raise CalibrationDataError(f"{path}: without a corrector's metadata; expected {_WHAT}.")
    known = CorrectorMetadata.from_mapping(metadata, f"{path}, metadata", CalibrationDataError)
    return corrector, known


def _run(path: Path) -> nn.Module:
    """Load a TorchScript file, which runs its code."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            return torch.jit.load(str(path), map_location="cpu").eval()
    except (RuntimeError, ValueError, OSError, EOFError):
        raise CalibrationDataError(f"{path}: not a TorchScript module; expected {_WHAT}.") from None
