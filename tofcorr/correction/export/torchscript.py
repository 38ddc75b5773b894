"""The corrector as TorchScript: the file that a robot loads with torch alone."""

import io
import platform
import sys
import warnings
from pathlib import Path
from typing import Any

import torch

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.export.parity import require_parity
from tofcorr.correction.loaded import LoadedCorrector
from tofcorr.correction.state import CalibrationState, with_calibration
from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.files import staged_file

_UNSUPPORTED = (3, 14)
"""From this Python on torch says that TorchScript is not supported and may break."""


def export_torchscript(
    corrector: DepthCorrector, path: Path | str, reference: CalibrationState
) -> None:
    """Script the corrector, compare what loads back with the float64 model, and move it into place.

    Args:
        corrector: The float32 runtime.
        path: The file to write; an older one is replaced.
        reference: The calibration that it must agree with.

    Raises:
        ConfigError: This torch, or this Python, has no TorchScript.
        ExportError: The scripted module differs from the float64 model, or the file cannot be
            written; nothing is written.
    """
    jit = _torchscript()
    with staged_file(path) as part:
        content = io.BytesIO()
        jit.save(scripted(corrector), content)
        part.write_bytes(with_calibration(content, reference))
        require_parity(load_torchscript(part), reference)


def scripted(corrector: DepthCorrector) -> Any:  # noqa: ANN401 - a module of TorchScript
    """Return the corrector compiled by TorchScript, with every method that a file has."""
    jit = _torchscript()
    with warnings.catch_warnings():
        # Scripting is deprecated from torch 2.13 on and works up to Python 3.13.
        warnings.filterwarnings("ignore", message=".*torch.jit")
        return jit.script(corrector)


def load_torchscript(path: Path | str) -> LoadedCorrector:
    """Load a TorchScript file for the CPU, which runs its code.

    Raises:
        ConfigError: This torch, or this Python, has no TorchScript.
        CalibrationDataError: It is no TorchScript file, or no corrector.
    """
    jit = _torchscript()
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*torch.jit")
            module = jit.load(str(path), map_location="cpu")
    except (RuntimeError, ValueError, OSError, EOFError):
        raise CalibrationDataError(f"{path}: not a TorchScript module.") from None
    return LoadedCorrector(module, lambda: str(module.metadata()), path)


def _torchscript() -> Any:  # noqa: ANN401 - a module that later versions of torch may lack
    jit: Any = getattr(torch, "jit", None)
    if not hasattr(jit, "script") or sys.version_info >= _UNSUPPORTED:
        version = f"torch {torch.__version__} on Python {platform.python_version()}"
        advice = "Export pt2, onnx or lut; tofcorr.load_corrector opens those, and the run folder"
        raise ConfigError(f"{version} has no TorchScript. {advice}.")
    return jit
