"""The corrector as C99 source, for robots and controllers without any library."""

import ctypes
import os
import shutil
import subprocess
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import torch
from torch import Tensor

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.export.c_code.source import c_name, c_sources
from tofcorr.correction.export.parity import Correct, require_parity
from tofcorr.correction.state import CalibrationState
from tofcorr.errors import ConfigError, ExportError
from tofcorr.files import scratch_folder, staged_file


def export_c(corrector: DepthCorrector, path: Path | str, reference: CalibrationState) -> None:
    """Write source, header and test program, compile them, and compare with the float64 model.

    `NAME.c` gives `NAME_correct(depth, amplitude, corrected, valid)` and `NAME_metadata()`, which
    `NAME.h` declares. `NAME_test.c` is a program that compares both with the model on the machine
    that it runs on. Conditions are taken as the mean of the calibration.

    Args:
        corrector: Where the metadata come from.
        path: The `.c` file to write; the others are put beside it. Older ones are replaced.
        reference: The calibration that it must agree with.

    Raises:
        ConfigError: `path` is no name of a C file, there is no C compiler, or C cannot hold one
            of the terms.
        ExportError: The compiled source differs from the float64 model; nothing is written.
    """
    path = Path(path)
    name = c_name(path.stem)
    if path.suffix != ".c" or name != path.stem:
        raise ConfigError(
            f"{path}: expected a name such as {name}.c, of letters, digits and underscores."
        )
    compiler = c_compiler()
    sources = c_sources(reference, corrector.metadata(), name)
    with ExitStack() as stack:
        staged = {n: stack.enter_context(staged_file(path.with_name(n))) for n in sources}
        work = stack.enter_context(scratch_folder())
        for file_name, text in sources.items():
            (work / file_name).write_text(text, encoding="utf-8")
        require_parity(load_c(work / path.name, compiler=compiler), reference)
        for file_name, text in sources.items():
            staged[file_name].write_text(text, encoding="utf-8")


def c_compiler() -> str:
    """Return the C compiler: of the variable CC, or the first that is found.

    Raises:
        ConfigError: There is none.
    """
    given = os.environ.get("CC", "").split()
    found = next(filter(None, map(shutil.which, (*given[:1], "cc", "gcc", "clang"))), None)
    if found is None:
        raise ConfigError(
            "The c export is compiled, and no C compiler was found: install gcc or clang."
        )
    return found


def load_c(path: Path | str, flags: Sequence[str] = ("-O2",), compiler: str = "") -> Correct:
    """Compile a corrector and return `corrected, valid = correct(depth, amplitude)`.

    Args:
        path: The `.c` file, with its header beside it.
        flags: Of the compiler.
        compiler: The one to use; by default that of `c_compiler`.

    Returns:
        A function of float32 frames (H, W) or (B, H, W) on the CPU.

    Raises:
        ConfigError: There is no compiler.
        ExportError: The file does not compile.
    """
    path = Path(path)
    with scratch_folder() as work:
        library = work / "corrector.so"
        words = [*flags, "-std=c99", "-shared", "-fPIC", "-o", str(library), str(path)]
        done = subprocess.run(
            [compiler or c_compiler(), *words], capture_output=True, text=True, check=False
        )
        if done.returncode:
            raise ExportError(f"{path}: does not compile: {done.stderr.strip()[:500]}")
        loaded = ctypes.CDLL(str(library))
    run = loaded[f"{path.stem}_correct"]
    run.argtypes, run.restype = [ctypes.c_void_p] * 4, None

    def correct(depth: Tensor, amplitude: Tensor) -> tuple[Tensor, Tensor]:
        depth, amplitude = depth.contiguous(), amplitude.contiguous()
        corrected = torch.empty_like(depth)
        valid = torch.empty_like(depth, dtype=torch.bool)
        frames = [one.unsqueeze(0) if one.dim() == 2 else one for one in (depth, amplitude)]
        outputs = [one.unsqueeze(0) if one.dim() == 2 else one for one in (corrected, valid)]
        for pointers in zip(*frames, *outputs, strict=True):
            run(*(one.data_ptr() for one in pointers))
        return corrected, valid

    return correct
