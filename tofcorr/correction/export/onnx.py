"""The corrector as ONNX, for robots without torch."""

import io
import logging
import warnings
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path

import torch
from torch import Tensor

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.export.parity import require_parity
from tofcorr.correction.export.registry import format_named
from tofcorr.correction.state import CalibrationState
from tofcorr.files import staged_file

_METADATA_KEY = "tofcorr"


def export_onnx(corrector: DepthCorrector, path: Path | str, reference: CalibrationState) -> None:
    """Write the corrector as ONNX, compare it with the float64 model, and move it into place.

    Inputs `depth` and `amplitude`, outputs `corrected` and `valid`, all (B, H, W) with any B.
    Conditions are taken as the mean of the calibration. The file's properties hold the
    metadata under `tofcorr`.

    Args:
        corrector: The float32 runtime.
        path: The file to write; an older one is replaced.
        reference: The calibration that it must agree with.

    Raises:
        ConfigError: The optional packages are not installed.
        ExportError: onnxruntime's result differs from the float64 model; nothing is written.
    """
    with staged_file(path) as part:
        _write(corrector, part)
        require_parity(load_onnx(part), reference)


def load_onnx(path: Path | str) -> Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """Load an ONNX file and return `corrected, valid = correct(depth, amplitude)`.

    Frames may be (H, W) or (B, H, W).

    Raises:
        ConfigError: The optional packages are not installed.
    """
    format_named("onnx").require_packages()
    from onnxruntime import InferenceSession

    session = InferenceSession(str(path), providers=["CPUExecutionProvider"])

    def correct(depth: Tensor, amplitude: Tensor) -> tuple[Tensor, Tensor]:
        frames = (depth, amplitude) if depth.dim() == 3 else (depth[None], amplitude[None])
        names = ("depth", "amplitude")
        # A model that does not read the amplitude has no such input.
        known = {given.name for given in session.get_inputs()}
        feed = {n: f.cpu().numpy() for n, f in zip(names, frames, strict=True) if n in known}
        corrected, valid = map(torch.from_numpy, session.run(["corrected", "valid"], feed))
        return corrected.view(depth.shape), valid.view(depth.shape)

    return correct


def _write(corrector: DepthCorrector, path: Path) -> None:
    frames = torch.ones(2, corrector.height, corrector.width)
    batch = torch.export.Dim("batch", min=1)
    # The exporter reports its steps to standard output and as warnings, for developers only.
    with warnings.catch_warnings(), redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)
        program = torch.onnx.export(
            corrector,
            (frames, frames.clone()),
            input_names=["depth", "amplitude"],
            output_names=["corrected", "valid"],
            dynamic_shapes=({0: batch}, {0: batch}),
            dynamo=True,
            verbose=False,
        )
        if program is None:
            raise RuntimeError("torch.onnx.export returned nothing.")
        program.model.metadata_props[_METADATA_KEY] = corrector.metadata()
        program.save(str(path), external_data=False)
