"""The corrector as C99 source, for robots and controllers without any library.

Its text stands in the templates beside this file. A term is written as cubic pieces over equal
segments, which C evaluates without knowing the term.
"""

import ctypes
import os
import re
import shutil
import subprocess
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jinja2 import Environment, PackageLoader, StrictUndefined
from torch import Tensor

from tofcorr.correction.corrector import DepthCorrector, RuntimeErrorModel, polynomials, separated
from tofcorr.correction.export.parity import (
    Correct,
    probe_frames,
    require_parity,
)
from tofcorr.correction.model import AGREEMENT
from tofcorr.correction.state import CalibrationState
from tofcorr.error_terms.base import EVERYTHING, Axis, Domain, SignalTerm
from tofcorr.errors import ConfigError, ExportError
from tofcorr.files import scratch_folder, staged_file
from tofcorr.geometry.rays import ray_directions
from tofcorr.version import __version__


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
        raise ConfigError(f"{path}: expected a name such as {name}.c, of letters, digits and _.")
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
        raise ConfigError("For the c export, no C compiler was found: install gcc or clang.")
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
        batches = [one.view(-1, *one.shape[-2:]) for one in (depth, amplitude, corrected, valid)]
        for images in zip(*batches, strict=True):
            run(*(one.data_ptr() for one in images))
        return corrected, valid

    return correct


def c_name(stem: str) -> str:
    """Return the name that begins every public name in C, from the stem of the file's name."""
    name = re.sub(r"\W", "_", stem, flags=re.ASCII)
    return f"_{name}" if name[:1].isdigit() else name


def c_sources(state: CalibrationState, metadata: str, name: str) -> dict[str, str]:
    """Return the text of every file by the file's name.

    Args:
        state: The calibration.
        metadata: As `corrector.metadata()`.
        name: As `c_name` gives it.

    Raises:
        ConfigError: C cannot hold one of the terms.
    """
    environment = Environment(
        loader=PackageLoader("tofcorr.correction.export", ""),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,
    )
    environment.filters.update(
        f=lambda one: number(float(one)), d=long_number, lines=lines, exp=np.exp
    )
    values = _filled_in(state, metadata, name)
    return {
        f"{name}{end}": environment.get_template(f"corrector{end}.j2").render(values)
        for end in (".h", ".c", "_test.c")
    }


@torch.no_grad()
def _filled_in(state: CalibrationState, metadata: str, name: str) -> dict[str, Any]:
    """Return what the templates fill in, for frames of the mean conditions.

    Raises:
        ConfigError: A term cannot be held.
    """
    model, camera, is_z = state.model().error, state.camera, state.depth_kind == "z"
    limits, network = model.limits(state.domain), model.requires_grad_(requires_grad=False).residual
    amplitudes = limits.amplitude or EVERYTHING
    runtime = RuntimeErrorModel(model, limits, 1.0)
    row_error, column_error, rest = separated(model.pixel_error() + runtime.left_over)
    pieces = [pieces_of(term, limits) for term in polynomials(model)[1]]
    variables = {axis.variable for one in pieces for axis in one.axes}
    saturation, flying = state.saturation_amplitude, state.flying_pixels()
    if runtime.needs_amplitude and amplitudes.high < np.float32(saturation or 0.0):
        saturation = None  # The calibrated range excludes saturated pixels already.
    return {
        "title": comment(f"Depth correction {state.name}."),
        "version": __version__,
        "name": name,
        # Pixels that are corrected together: five arrays of them take a fifth of a first-level
        # cache of 32 KiB; fewer spend more on the ends of the loops. Set on benchmarks/runtime.py.
        "block": min(320, camera.width),
        "camera": camera,
        "row_error": row_error,
        "column_error": column_error,
        "error_image": rest,
        "z_of_radial": ray_directions(camera)[..., 2] if is_z or flying is not None else None,
        "limits": limits,
        "is_z": is_z,
        # The clamped distance is read in float32; depth along the axis is tested in double.
        "uses_distance": not is_z or "distance" in variables or runtime.distance.degree > 0,
        "saturation": saturation,
        "reads_amplitude": runtime.needs_amplitude or saturation,
        "flying": flying,
        "has_log": "log_amplitude" in variables or (network is not None and network.uses_amplitude),
        "runtime": runtime,
        "pieces": pieces,
        "network": network,
        "tolerance": AGREEMENT,
        "probes": _probes(state),
        "metadata": [*metadata.encode(), 0],
    }


def _probes(state: CalibrationState) -> list[tuple[int, float, float, float, bool]]:
    """Return pixels, their depth and amplitude, the depth as corrected and whether it is valid."""
    frames = probe_frames(state)
    # 1 % of the pixels is of each kind of missing value: each kind is there five times.
    generator = torch.Generator().manual_seed(0)
    chosen = torch.randperm(frames[0][0].numel(), generator=generator)[:512]
    if state.scene.flying_pixels is not None:
        # Neighbours decide with it: the middle of the frame with an edge, and nothing around it.
        row, column = ((torch.arange(size) - size // 2).abs() < 12 for size in frames[0].shape[1:])
        chosen = (row[:, None] & column).flatten().nonzero()[:, 0]
    alone = [torch.zeros_like(one[-1]) for one in frames]
    for one, frame in zip(alone, frames, strict=True):
        one.view(-1)[chosen] = frame[-1].flatten()[chosen]
    columns = (one.flatten()[chosen].tolist() for one in (*alone, *state.corrected(*alone)))
    return list(zip(chosen.tolist(), *columns, strict=True))


def comment(text: str) -> str:
    """Return a text that neither ends a comment nor begins one."""
    return " ".join(text.split()).replace("*/", "* /").replace("/*", "/ *")


def number(value: float) -> str:
    """Return a constant of type float, with all its digits."""
    return _special(value) or f"{np.float32(value):.8e}f"


def long_number(value: float) -> str:
    """Return a constant of type double, with all its digits."""
    return _special(value) or f"{value:.16e}"


def lines(words: Iterable[object], in_a_line: int = 6) -> str:
    """Return words behind commas, so many in a line."""
    every = list(map(str, words))
    parts = (every[k : k + in_a_line] for k in range(0, len(every), in_a_line))
    return "\n".join("  " + ", ".join(part) + "," for part in parts)


def _special(value: float) -> str | None:
    if np.isnan(value):
        return "NAN"
    return f"{'-' if value < 0 else ''}INFINITY" if np.isinf(value) else None


@dataclass(frozen=True, kw_only=True)
class Pieces:
    """A function of one or two variables as cubics of the place within a segment.

    Attributes:
        axes: The variables, with the number of segments of these pieces.
        coefficients: Of 1, t, t^2, t^3, float32, shape (S, 4) for one axis; for two (S, R, 4, 4),
            the powers of the first variable first.
    """

    axes: tuple[Axis, ...]
    coefficients: np.ndarray


def pieces_of(term: SignalTerm, limits: Domain) -> Pieces:
    """Return the pieces of a term over the calibrated ranges, to a fifth of `AGREEMENT`.

    Each segment is halved until they follow the term, at most seven times: 2^7 pieces of a smooth
    function over the whole range resolve more than any calibration does.

    With two variables, 4096 times 64 numbers of 4 bytes fill a quarter of a megabyte, which still
    stays in a second-level cache: there are no more pieces.

    Raises:
        ConfigError: So many pieces as there may be do not follow the term.
    """
    axes = term.axes() or _smooth(term, limits)
    for halvings in range(8):
        finer = tuple(axis._replace(segments=axis.segments * 2**halvings) for axis in axes)
        if np.prod([axis.segments for axis in finer]) > 4096 and halvings:
            break
        found = _interpolated(term, finer)
        if _error(term, found) < AGREEMENT / 5:
            return found
    name = term.options.kind
    raise ConfigError(f"Term {name} changes too quickly for c: export torchscript, pt2 or onnx.")


def _smooth(term: SignalTerm, limits: Domain) -> tuple[Axis, ...]:
    distance = Axis("distance", *limits.radial_distance)
    amplitude = Axis("amplitude", *(limits.amplitude or EVERYTHING))
    return (distance, amplitude) if term.needs_amplitude else (distance,)


def _interpolated(term: SignalTerm, axes: tuple[Axis, ...]) -> Pieces:
    """Return the cubics through the term's values at the Chebyshev points of every segment."""
    # A cubic through the Chebyshev points is within a factor of two of the best.
    points = 0.5 - 0.5 * np.cos(np.pi * (2 * np.arange(4) + 1) / 8)
    to_powers = np.linalg.inv(np.vander(points, 4, increasing=True))
    values = _values(term, axes, points)
    for _ in axes:  # Along the last axis, which becomes the first of those within a segment.
        values = np.moveaxis(values @ to_powers.T, -1, -len(axes))
    return Pieces(axes=axes, coefficients=values.astype(np.float32))


def _error(term: SignalTerm, pieces: Pieces) -> float:
    """Return the largest error of the pieces at probes of every segment, metres."""
    places = np.linspace(0.0, 1.0, 13)  # More than three times the points that fix a cubic.
    powers, found = np.vander(places, 4, increasing=True), pieces.coefficients
    for _ in pieces.axes:
        found = np.moveaxis(found @ powers.T, -1, -len(pieces.axes))
    return float(np.abs(found - _values(term, pieces.axes, places)).max())


def _values(term: SignalTerm, axes: tuple[Axis, ...], places: np.ndarray) -> np.ndarray:
    """Return the term at places (P,) of each segment: shape (S, P), or (S, R, P, P)."""
    grids = []
    for axis in axes:
        step = (axis.high - axis.low) / axis.segments
        grids.append(axis.low + step * (np.arange(axis.segments)[:, None] + places))
    flat = [grid.ravel() for grid in grids]
    mesh = np.meshgrid(*flat, indexing="ij")
    given = {axis.variable: values for axis, values in zip(axes, mesh, strict=True)}
    if "log_amplitude" in given:
        given["amplitude"] = np.exp(given["log_amplitude"])
    distance = given.get("distance", np.ones_like(mesh[0]))
    amplitude = given.get("amplitude", np.ones_like(mesh[0]))
    with torch.no_grad():
        found = term(torch.from_numpy(distance), torch.from_numpy(amplitude)).numpy()
    if len(axes) == 1:
        return found.reshape(grids[0].shape)
    shape = (*grids[0].shape, *grids[1].shape)
    return found.reshape(shape).transpose(0, 2, 1, 3)
