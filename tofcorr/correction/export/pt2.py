"""The corrector compiled ahead of time by AOTInductor: one fused pass over the pixels."""

import copy
import io
import shutil
import warnings
from pathlib import Path

import torch
from torch import Tensor, nn
from torch._inductor.package.package import load_package, package_aoti

from tofcorr.correction.corrector import (
    DepthCorrector,
    RuntimeRange,
    check_frames,
    separated,
)
from tofcorr.correction.export.parity import require_parity
from tofcorr.correction.loaded import LoadedCorrector
from tofcorr.correction.state import CalibrationState, with_calibration
from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.files import scratch_folder, staged_file
from tofcorr.options import one_line

_METADATA_KEY = "tofcorr"
_FRAME, _BATCH = "model", "batch"


def export_pt2(corrector: DepthCorrector, path: Path | str, reference: CalibrationState) -> None:
    """Compile the corrector, compare it with the float64 model, and move it into place.

    The package runs on the kind of processor (or GPU) that it was compiled on. Conditions are
    taken as the mean of the calibration. It holds two models: `model` takes one frame (H, W),
    `batch` takes (B, H, W) of any B. `load_pt2` reads both; so do libtorch in C++ and
    `torch._inductor.package.load_package`. There, validity is a uint8 of 0 and 1: the generated
    code would need longer to write bool than for the whole correction.

    Args:
        corrector: The float32 runtime, on the device to compile for.
        path: The `.pt2` to write; an older one is replaced.
        reference: The calibration that it must agree with.

    Raises:
        ConfigError: `path` does not end in .pt2, or there is no C++ compiler.
        ExportError: The compiled module differs from the float64 model; nothing is written.
    """
    path = Path(path)
    if path.suffix != ".pt2":
        raise ConfigError(f"{path}: torch loads such a package only by a name that ends in .pt2.")
    device = corrector.radial_of_z.device
    if device.type == "cpu" and not any(map(shutil.which, ("g++", "c++", "clang++"))):
        raise ConfigError("The pt2 export compiles C++ and found no compiler: install g++.")
    with staged_file(path) as part, scratch_folder() as work:
        built = work / "corrector.pt2"
        _compile(corrector, built)
        part.write_bytes(with_calibration(io.BytesIO(built.read_bytes()), reference))
        require_parity(load_pt2(part), reference)


def load_pt2(path: Path | str) -> LoadedCorrector:
    """Load a `.pt2`, which runs its code, for frames (H, W) or (B, H, W) on any device.

    The compiled code does not look at what it is given: others than frames of the camera in float32
    are refused here, with a ValueError.

    Raises:
        CalibrationDataError: It cannot be loaded; it may be compiled for another processor.
    """
    try:
        frame, batch = (load_package(str(path), name) for name in (_FRAME, _BATCH))
    except (RuntimeError, ValueError, LookupError, OSError) as error:
        why = one_line(" ".join(str(error).split()))
        said = "not a package of tofcorr export, or of another machine"
        raise CalibrationDataError(f"{path}: {said} ({why}).") from None
    metadata = frame.get_metadata()
    device = torch.device(metadata.get("AOTI_DEVICE_KEY", "cpu"))

    def correct(depth: Tensor, amplitude: Tensor) -> tuple[Tensor, Tensor]:
        # The package's own call would go through pytrees, which takes as long as a small frame.
        run = (frame if depth.dim() == 2 else batch).loader.run
        given = [tensor.to(device).contiguous() for tensor in (depth, amplitude)]
        corrected, valid = run(given)
        return corrected.to(depth.device), valid.view(torch.bool).to(depth.device)

    return LoadedCorrector(correct, lambda: metadata[_METADATA_KEY], path)


class CompilableCorrector(nn.Module):
    """What is compiled: the corrector with validity as uint8, and with few arrays to read.

    The generated code is bound by its memory traffic, then by its instructions: where constant and
    pixel terms are a sum of rows and columns, it reads these, which stay in the cache.

    Args:
        corrector: The float32 runtime; it is copied.
    """

    rows: Tensor
    columns: Tensor

    def __init__(self, corrector: DepthCorrector) -> None:
        super().__init__()
        self.corrector = copy.deepcopy(corrector)
        self.corrector.in_strips = False
        for module in self.corrector.modules():
            if isinstance(module, RuntimeRange):
                # The normalised amplitude is compared with its range; a rounding would show there.
                module.fused = not corrector.error.has_normalised
        error = self.corrector.error
        rows, columns, rest = separated(error.offset.double() / error.factor)
        self.register_buffer("rows", (error.factor * rows).float())
        self.register_buffer("columns", (error.factor * columns).float())
        self.is_separable = rest is None

    def forward(self, depth: Tensor, amplitude: Tensor) -> tuple[Tensor, Tensor]:
        """Return corrected depth, and validity as 0 and 1."""
        corrector = self.corrector
        check_frames(depth, amplitude, corrector.height, corrector.width)
        depth, amplitude = corrector.without_stray_light(depth, amplitude)
        corrected = torch.empty_like(depth)
        # By way of int32: the generated code converts float32 to uint8 in several times as long.
        valid = torch.empty_like(depth, dtype=torch.int32)
        offset = self.rows + self.columns if self.is_separable else corrector.error.offset
        corrector.correct(depth, amplitude, offset, 0, corrected, valid)
        if corrector.flying is not None:
            corrected, kept = corrector.flying(corrected, amplitude, valid > 0)
            return corrected, kept.to(torch.uint8)
        return corrected, valid.to(torch.uint8)


def _compile(corrector: DepthCorrector, path: Path) -> None:
    """Compile for one frame, whose loop is parallel over its pixels, and for batches."""
    device = corrector.radial_of_z.device
    frames = torch.ones(2, corrector.height, corrector.width, device=device)
    any_size = {0: torch.export.Dim("batch", min=1)}
    options = {
        "aot_inductor.package": True,
        "aot_inductor.metadata": {_METADATA_KEY: corrector.metadata()},
        # As many threads as the robot has, rather than as many as this machine.
        "cpp.dynamic_threads": True,
        "cpp.enable_floating_point_contract_flag": "fast",
    }
    files = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, shapes, given in (
            (_FRAME, None, (frames[0], frames[1])),
            (_BATCH, (any_size, any_size), (frames, frames.clone())),
        ):
            compilable = CompilableCorrector(corrector)
            program = torch.export.export(compilable, given, dynamic_shapes=shapes)
            files[name] = torch._inductor.aot_compile(program.module(), given, options=options)
        package_aoti(str(path), files)
