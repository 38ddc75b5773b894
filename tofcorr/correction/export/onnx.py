"""The corrector as ONNX, for robots without torch."""

import copy
import io
import logging
import warnings
from contextlib import redirect_stdout
from pathlib import Path

import torch
from torch import Tensor

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.export.parity import require_parity
from tofcorr.correction.export.registry import format_named
from tofcorr.correction.loaded import LoadedCorrector
from tofcorr.correction.state import CalibrationState
from tofcorr.errors import CalibrationDataError
from tofcorr.files import open_regular, reading, staged_file

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


def load_onnx(path: Path | str) -> LoadedCorrector:
    """Load an ONNX file; it is data, of which nothing is run but ONNX's own operators.

    Raises:
        ConfigError: The optional packages are not installed.
        CalibrationDataError: There is no such file, or it is not such a corrector.
    """
    format_named("onnx").require_packages()
    from onnxruntime import InferenceSession
    from onnxruntime.capi import (
        onnxruntime_pybind11_state as refusals,  # pyright: ignore[reportAttributeAccessIssue]
    )

    refused = refusals.Fail, refusals.InvalidProtobuf, refusals.InvalidGraph
    with reading(path), open_regular(path) as file:
        try:
            # Of bytes: a path would let the file name others to be read.
            session = InferenceSession(file.read(), providers=["CPUExecutionProvider"])
        except (*refused, refusals.InvalidArgument, refusals.RuntimeException):
            said = f"{path}: is not an ONNX file of tofcorr export, or is damaged."
            raise CalibrationDataError(said) from None
    names = {given.name for given in session.get_inputs()}

    def correct(depth: Tensor, amplitude: Tensor) -> tuple[Tensor, Tensor]:
        frames = {"depth": depth, "amplitude": amplitude}
        # A model that does not read the amplitude has no such input; all take batches.
        size = (-1, *depth.shape[-2:])
        feed = {name: frames[name].cpu().reshape(size).numpy() for name in names}
        found = session.run(["corrected", "valid"], feed)
        corrected, valid = (torch.from_numpy(one).to(depth.device) for one in found)
        return corrected.view(depth.shape), valid.view(depth.shape)

    held = session.get_modelmeta().custom_metadata_map
    return LoadedCorrector(correct, lambda: held.get(_METADATA_KEY, ""), path)


def _write(corrector: DepthCorrector, path: Path) -> None:
    corrector = copy.copy(corrector)
    corrector.in_strips = False
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
