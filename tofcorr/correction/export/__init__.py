"""The corrector in the formats that robots load, each compared with the float64 model first."""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tofcorr.correction.corrector import DepthCorrector
    from tofcorr.correction.state import CalibrationState

FORMATS = {
    "torchscript": "TorchScript, loaded by torch or libtorch alone; any machine",
    "pt2": "compiled ahead of time for this kind of processor or GPU; the fastest",
    "onnx": "ONNX, for robots without torch (needs the extra 'onnx')",
    "lut": "NPZ look-up table for NumPy; agrees to 0.1 mm",
}
"""What can be written, and for whom."""


def export(
    name: str, corrector: "DepthCorrector", path: Path | str, reference: "CalibrationState"
) -> None:
    """Write the corrector in one of `FORMATS`, once it agrees with the float64 model.

    Raises:
        ConfigError: The format needs something that is not installed, or cannot hold the model.
        ExportError: The export differs from the model, or cannot be written; nothing is left.
    """
    module = import_module(f"tofcorr.correction.export.{name}")
    getattr(module, f"export_{name}")(corrector, path, reference)
