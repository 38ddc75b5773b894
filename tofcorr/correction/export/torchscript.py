"""The corrector as TorchScript: the file that a robot loads with torch alone."""

import io
import warnings
from pathlib import Path

import torch

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.export.parity import require_parity
from tofcorr.correction.metadata import EMBEDDED
from tofcorr.correction.state import CalibrationState, calibration_bytes
from tofcorr.files import sealed, staged_file


def export_torchscript(
    corrector: DepthCorrector, path: Path | str, reference: CalibrationState
) -> None:
    """Script the corrector, compare what loads back with the float64 model, and move it into place.

    Args:
        corrector: The float32 runtime.
        path: The file to write; an older one is replaced.
        reference: The calibration that it must agree with.

    Raises:
        ExportError: The scripted module differs from the float64 model, or the file cannot be
            written; nothing is written.
    """
    with staged_file(path) as part:
        with warnings.catch_warnings():
            # Scripting is deprecated from torch 2.13 on and works up to Python 3.13.
            warnings.filterwarnings("ignore", message=".*torch.jit")
            content = io.BytesIO()
            # Beside the code: `tofcorr correct` builds the corrector from it and runs no code.
            own = {EMBEDDED: calibration_bytes(reference)}
            torch.jit.save(torch.jit.script(corrector), content, _extra_files=own)
            part.write_bytes(sealed(content))
            loaded = torch.jit.load(str(part))
        require_parity(loaded, reference)
