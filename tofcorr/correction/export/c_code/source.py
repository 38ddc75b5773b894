"""Writes the corrector as C source: header, source and test program, from templates."""

import re
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from jinja2 import Environment, PackageLoader, StrictUndefined

from tofcorr.correction.corrector import (
    RuntimeErrorModel,
    separated,
    summed_polynomials,
)
from tofcorr.correction.export.c_code.pieces import pieces_of
from tofcorr.correction.export.parity import probe_frames
from tofcorr.correction.model import AGREEMENT
from tofcorr.correction.state import CalibrationState
from tofcorr.error_terms.base import EVERYTHING
from tofcorr.geometry.rays import ray_directions
from tofcorr.version import __version__


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
        loader=PackageLoader("tofcorr.correction.export.c_code", ""),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,
    )
    environment.filters.update(
        f=lambda one: number(float(one)), d=long_number, lines=lines, exp=np.exp
    )
    values = _values(state, metadata, name)
    return {
        f"{name}{end}": environment.get_template(f"corrector{end}.j2").render(values)
        for end in (".h", ".c", "_test.c")
    }


@torch.no_grad()
def _values(state: CalibrationState, metadata: str, name: str) -> dict[str, Any]:
    """Return what the templates fill in, for frames of the mean conditions.

    Raises:
        ConfigError: A term cannot be held.
    """
    model, camera, is_z = state.model().error, state.camera, state.depth_kind == "z"
    limits, network = model.limits(state.domain), model.requires_grad_(requires_grad=False).residual
    amplitudes = limits.amplitude or EVERYTHING
    runtime = RuntimeErrorModel(model, limits, 1.0)
    row_error, column_error, rest = separated(model.pixel_error() + runtime.left_over)
    pieces = [pieces_of(term, limits) for term in summed_polynomials(model)[1]]
    variables = {axis.variable for one in pieces for axis in one.axes}
    needs_amplitude = model.needs_amplitude()
    most = state.saturation_amplitude
    saturation = most is not None and not (needs_amplitude and amplitudes.high < np.float32(most))
    return {
        "title": comment(f"Depth correction {state.name}."),
        "version": __version__,
        "name": name,
        # Pixels that are corrected together: five arrays of them take a fifth of a first-level
        # cache of 32 KiB; fewer spend more on the ends of the loops. Set on benchmarks/runtime.py.
        "block": min(320, camera.width),
        "width": camera.width,
        "height": camera.height,
        "row_error": row_error,
        "column_error": column_error,
        "error_image": rest,
        "z_of_radial": ray_directions(camera)[..., 2] if is_z else None,
        "limits": limits,
        "saturation_amplitude": most,
        "is_z": is_z,
        # The clamped distance is read in float32; depth along the axis is tested in double.
        "uses_distance": not is_z or "distance" in variables or runtime.distance.degree > 0,
        "saturation": saturation,
        "needs_amplitude": needs_amplitude,
        "reads_amplitude": needs_amplitude or saturation,
        "has_log": "log_amplitude" in variables or (network is not None and network.uses_amplitude),
        "runtime": runtime,
        "normalised": runtime.has_normalised,
        "pieces": pieces,
        "network": network,
        "tolerance": AGREEMENT,
        "probes": _probes(state),
        "metadata": [*metadata.encode(), 0],
    }


def _probes(state: CalibrationState) -> list[tuple[int, float, float, float, bool]]:
    """Return pixels, their depth and amplitude, the depth as corrected and whether it is valid."""
    depth, amplitude = probe_frames(state)
    expected, valid = state.corrected(depth, amplitude)
    # 1 % of the pixels is of each kind of missing value: each kind is there five times.
    generator = torch.Generator().manual_seed(0)
    chosen = torch.randperm(depth[0].numel(), generator=generator)[:512].tolist()
    columns = (one[0].flatten()[chosen].tolist() for one in (depth, amplitude, expected, valid))
    return list(zip(chosen, *columns, strict=True))


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
