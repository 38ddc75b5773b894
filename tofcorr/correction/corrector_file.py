"""A corrector read back from its file."""

import json
import warnings
from pathlib import Path

import torch
from torch.jit import ScriptModule

from tofcorr.correction.metadata_file import CorrectorMetadata
from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.files.seal import refuse_damaged

_WHAT = "the corrector.ts of a run"


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
