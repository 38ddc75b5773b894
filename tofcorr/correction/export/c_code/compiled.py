"""Compiles a corrector written in C and calls it: the check of an export, and of its speed."""

import ctypes
import os
import shutil
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from tofcorr.errors import ConfigError, ExportError
from tofcorr.files.staged import scratch_folder

Correct = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
_COMPILERS = ("cc", "gcc", "clang")


def c_compiler() -> str:
    """Return the C compiler: of the variable CC, or the first that is found.

    Raises:
        ConfigError: There is none.
    """
    given = os.environ.get("CC", "").split()
    found = next(filter(None, map(shutil.which, (*given[:1], *_COMPILERS))), None)
    if found is None:
        raise ConfigError(
            "The c export is compiled and compared with the model, and no C compiler was found: "
            "install gcc or clang."
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
