"""The corrector compiled ahead of time by AOTInductor: one fused pass over the pixels."""

import shutil
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.export.parity import require_parity
from tofcorr.correction.export.staging import staged_file
from tofcorr.correction.state import CalibrationState
from tofcorr.errors import ConfigError

_METADATA_KEY = "tofcorr"


def export_pt2(corrector: DepthCorrector, path: Path | str, reference: CalibrationState) -> None:
    """Compile the corrector, compare it with the float64 model, and put it in place.

    The package is for the kind of processor (or GPU) that it was compiled on, takes batches
    (B, H, W) of any size, and assumes the mean conditions of the calibration. `load_pt2` reads
    it; so does `torch._inductor.aoti_load_package`, and libtorch in C++.

    Args:
        corrector: The float32 runtime, on the device to compile for.
        path: Where the `.pt2` shall appear; an older one is replaced.
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
    with staged_file(path) as part, tempfile.TemporaryDirectory() as work:
        built = _compile(corrector, device, Path(work) / "corrector.pt2")
        shutil.copyfile(built, part)
        require_parity(load_pt2(part), reference)


def load_pt2(path: Path | str) -> Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """Load a `.pt2` and return `corrected, valid = correct(depth, amplitude)`.

    Frames may be (H, W) or (B, H, W) on any device; results are on the device of the frames.
    """
    package = torch._inductor.aoti_load_package(str(path))
    device = package.get_metadata().get("AOTI_DEVICE_KEY", "cpu")

    def correct(depth: Tensor, amplitude: Tensor) -> tuple[Tensor, Tensor]:
        frames = (depth, amplitude) if depth.dim() == 3 else (depth[None], amplitude[None])
        corrected, valid = package(*(frame.to(device) for frame in frames))
        shape, home = depth.shape, depth.device
        return corrected.view(shape).to(home), valid.view(shape).to(home)

    return correct


def _compile(corrector: DepthCorrector, device: torch.device, path: Path) -> str:
    frames = torch.ones(2, corrector.height, corrector.width, device=device)
    batch = torch.export.Dim("batch", min=1)
    options = {
        # As many threads as the robot has, rather than as many as this machine.
        "cpp.dynamic_threads": True,
        "aot_inductor.metadata": {_METADATA_KEY: corrector.metadata()},
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.export.export(
            corrector, (frames, frames.clone()), dynamic_shapes=({0: batch}, {0: batch})
        )
        return torch._inductor.aoti_compile_and_package(
            program, package_path=str(path), inductor_configs=options
        )
